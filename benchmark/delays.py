# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Samples from a fault to its declaration, in white noise, beside the optimal bound, through the whole monitor.

A bias of 0.5 to 8 standard deviations of the channel's noise comes after a calm minute: start-up learning at rest, then
motion. It shifts the normalised residual of the channel by sqrt(S_ii) times as much: S_ii is 1/2 on the cone of six
channels and 2/3 on three parallel units. The bound is that of a CUSUM which knows channel and size (Moustakides 1986),
by Markov chain, at one false alarm in 3.6e8 samples: 0.001 an hour at 100 Hz.

    python benchmark/delays.py [--detector NAME] [--trials 400] [--quick] [--json FILE]

declared: mean samples to the first declaration that names the channel or a set that holds it, the first faulty sample
counted; named: until it stands alone; silent: nothing within the time watched, which then counts as the delay; wrong: a
sound channel was named; early: something was declared before; unjudged: the start-up was refused. Neither of these two
counts as a delay.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from trials import (
    IDEAL,
    Rng,
    Table,
    arguments_of,
    by_mounting,
    configs_of,
    faulty,
    flight_of,
    in_set,
    size_of,
    unchecked,
)

from fdi_ros import Pipeline
from fdi_ros.experiments.limit import moustakides_delay
from fdi_ros.monitor.build import build_geometry

SIZES = (0.5, 1.0, 2.0, 4.0, 6.0, 8.0)
"""Of the bias, in standard deviations of the noise."""
RUN_LENGTH = 3.6e8
"""Samples to a false alarm."""
CALM = 60.0
"""Before the fault, s."""
WATCHED = 60.0
"""After it, s."""


class Outcome(NamedTuple):
    """What came of a fault."""

    declared: float
    """Samples to the declaration; inf: none."""
    named: float
    wrong: bool
    early: bool
    unjudged: bool
    watched: float
    """Samples watched after it: what counts as the delay of a fault that is not declared."""


def trial(pipeline: Pipeline, rng: Rng, size: float) -> Outcome:
    """Fly once, with a fault of so many standard deviations."""
    flight = flight_of(pipeline, rng, CALM + WATCHED, ideal=True)
    unit, block = flight.unit, flight.block(rng.standard_normal(flight.clean.shape))
    channel = int(rng.integers(unit.geometry.n))
    onset = round(CALM * unit.sample_rate)
    block.z[onset:, channel] += rng.choice([-1.0, 1.0]) * size * unit.noise_std[channel]
    output = pipeline.process(block)
    alone, among = faulty(output), in_set(output)
    early = bool((alone | among)[:onset].any())
    wrong = bool(np.delete(alone[onset:], channel, axis=1).any())
    unjudged = bool(unchecked(output)[onset - 1].any())
    declared, named = first(alone[onset:, channel] | among[onset:, channel]), first(alone[onset:, channel])
    return Outcome(declared, named, wrong, early, unjudged, WATCHED * unit.sample_rate)


def first(rows: np.ndarray) -> float:
    """Count samples up to and with the first that is true; inf: none is."""
    return float(rows.argmax() + 1) if rows.any() else np.inf


def main() -> None:
    about = {"trials": {"type": int, "default": 400, "help": "of each size and mounting; 50 with --quick"}}
    arguments = arguments_of(__doc__, **about)
    count = size_of(arguments, "trials", 50)
    table = Table(
        mounting="<9",
        sigma=">5.1f",
        bound=">6.1f",
        declared=">9.1f",
        error=">7.1f",
        times_bound=">8.2f",
        named=">9.1f",
        **dict.fromkeys(("silent", "unnamed", "wrong", "early", "unjudged"), ">7.1%"),
        took_s=">7.1f",
    )
    settings = {**IDEAL, "detector.false_alarms_per_hour": 0.001}
    configs = configs_of(arguments, settings)
    share = {name: math.sqrt(build_geometry(config).S[0, 0]) for name, config in configs.items()}
    for mounting, size, outcomes, took in by_mounting(arguments, count, trial, SIZES, settings):
        bound = moustakides_delay(size * share[mounting], RUN_LENGTH)
        watched = [o for o in outcomes if not (o.early or o.unjudged)]
        declared, named = (np.array([o[k] for o in watched]) for k in (0, 1))
        most = outcomes[0].watched
        mean = float(np.minimum(declared, most).mean()) if watched else None
        table.add(
            mounting=mounting,
            sigma=size,
            bound=bound,
            declared=mean,
            error=float(np.minimum(declared, most).std() / np.sqrt(len(watched))) if watched else None,
            times_bound=mean / bound if mean else None,
            named=float(np.minimum(named, most).mean()) if watched else None,
            silent=float(np.isinf(declared).sum()) / count,
            unnamed=float(np.isinf(named).sum()) / count,
            **{name: sum(getattr(o, name) for o in outcomes) / count for name in ("wrong", "early", "unjudged")},
            took_s=took,
        )
    table.write(arguments)


if __name__ == "__main__":
    main()
