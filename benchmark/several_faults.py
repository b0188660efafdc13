# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Several faults at once or one after the other: is a sound channel ever named, and are the guilty ones in the set.

Short flights of small MEMS units in white noise, at rest for 6 s, then in motion; from 10 s on two channels are
faulty, or a whole unit with random signs. Sizes are 8 to 50 standard deviations of a channel's noise, signs random.

    python benchmark/several_faults.py [--detector NAME] [--flights 200] [--quick] [--json FILE]

wrong: a sound channel was FAULTY at any time; held: at the end every guilty channel is FAULTY or in a set, no sound one
FAULTY; named: all of them FAULTY; partly: some of them; missed: none; early: something was declared before the fault;
unjudged: the start-up was refused, which counts as nothing else.
set size: mean number of channels in the set at the end, where there is one; delay: median to the first declaration.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from trials import (
    Array,
    Mask,
    Rng,
    Table,
    Unit,
    arguments_of,
    by_mounting,
    faulty,
    flight_of,
    in_set,
    size_of,
    unchecked,
)

from fdi_ros import Pipeline

LENGTH, ONSET = 40.0, 10.0
"""Of a flight, and when faults begin, s."""
SIZES = (8.0, 50.0)
"""In noise_std."""
GROWTH = 5.0
"""A ramp has its size after so long, s."""

COUNTED = ("wrong", "held", "named", "partly", "missed", "early", "unjudged")

Channels = NDArray[np.int64]
Signature = tuple[Array, Mask]
"""What faults add, (N, n) in noise_std, and which channels are guilty, (n,)."""


def sizes(rng: Rng, count: int) -> Array:
    """(count,) with either sign, in noise_std, evenly spread over the logarithm."""
    return SIZES[0] * (SIZES[1] / SIZES[0]) ** rng.random(count) * rng.choice([-1.0, 1.0], count)


def placed(unit: Unit, seconds: Array, channels: Channels, courses: Array) -> Signature:
    """Signature of channels (k,) that follow courses (N, k)."""
    added, guilty = np.zeros((len(seconds), unit.geometry.n)), np.zeros(unit.geometry.n, dtype=bool)
    added[:, channels], guilty[channels] = courses, True
    return added, guilty


def pair(unit: Unit, rng: Rng) -> Channels:
    return rng.choice(unit.geometry.n, 2, replace=False)


def two_biases(unit: Unit, seconds: Array, rng: Rng) -> Signature:
    return placed(unit, seconds, pair(unit, rng), (seconds >= ONSET)[:, None] * sizes(rng, 2))


def two_ramps(unit: Unit, seconds: Array, rng: Rng) -> Signature:
    return placed(unit, seconds, pair(unit, rng), np.maximum(seconds - ONSET, 0)[:, None] / GROWTH * sizes(rng, 2))


def whole_unit(unit: Unit, seconds: Array, rng: Rng) -> Signature:
    channels = 3 * rng.integers(unit.geometry.n // 3) + np.arange(3)
    return placed(unit, seconds, channels, (seconds >= ONSET)[:, None] * sizes(rng, 3))


def sequence(unit: Unit, seconds: Array, rng: Rng) -> Signature:
    onsets = ONSET + np.array([0.0, rng.choice([0.05, 0.5, 5.0])])
    return placed(unit, seconds, pair(unit, rng), (seconds[:, None] >= onsets) * sizes(rng, 2))


def intermittent(unit: Unit, seconds: Array, rng: Rng) -> Signature:
    periods, duties = rng.uniform(0.2, 3.0, 2), rng.uniform(0.1, 0.6, 2)
    on = (seconds[:, None] >= ONSET) & ((seconds[:, None] - ONSET) % periods < duties * periods)
    return placed(unit, seconds, pair(unit, rng), on * sizes(rng, 2))


def one_bias(unit: Unit, seconds: Array, rng: Rng) -> Signature:
    channel = rng.choice(unit.geometry.n, 1)
    return placed(unit, seconds, channel, (seconds >= ONSET)[:, None] * sizes(rng, 1))


KINDS: dict[str, Callable[[Unit, Array, Rng], Signature]] = {
    "one bias": one_bias,
    "two biases": two_biases,
    "two ramps": two_ramps,
    "whole unit": whole_unit,
    "sequence of two": sequence,
    "two intermittent": intermittent,
}


def fly(pipeline: Pipeline, rng: Rng, kind: str) -> dict[str, Any]:
    """Fly once; return what came of it."""
    flight = flight_of(pipeline, rng, LENGTH)
    seconds = flight.seconds
    added, guilty = KINDS[kind](flight.unit, seconds, rng)
    output = pipeline.process(flight.block(rng.standard_normal(added.shape) + added))
    alone, among, onset = faulty(output), in_set(output), int(np.searchsorted(seconds, ONSET))
    declared: Mask = alone | among
    any_declared = np.asarray(declared.any(axis=1))
    found = declared[-1, guilty]
    wrong = bool(alone[:, ~guilty].any())
    if unchecked(output)[onset - 1].any():
        return {**dict.fromkeys(COUNTED, False), "unjudged": True, "set_size": 0, "delay": np.inf}
    return {
        "wrong": wrong,
        "held": bool(found.all()) and not wrong,
        "named": bool(alone[-1, guilty].all()) and not wrong,
        "partly": bool(found.any() and not found.all()),
        "missed": not found.any(),
        "unjudged": False,
        "early": bool(declared[:onset].any()),
        "set_size": int(among[-1].sum()),
        "delay": float(seconds[any_declared.argmax()] - ONSET) if any_declared.any() else np.inf,
    }


def main() -> None:
    about: dict[str, dict[str, Any]] = {
        "flights": {"type": int, "default": 200, "help": "of each kind and mounting; 40 with --quick"}
    }
    arguments = arguments_of(__doc__, **about)
    flights = size_of(arguments, "flights", 40)
    table = Table(
        mounting="<9",
        faults="<17",
        flights=">7d",
        **dict.fromkeys(COUNTED, ">6d"),
        set_size=">8.1f",
        delay=">7.2f",
        took_s=">7.1f",
    )
    for mounting, kind, outcomes, took in by_mounting(arguments, flights, fly, KINDS):
        sets = [o["set_size"] for o in outcomes if o["set_size"]]
        table.add(
            {"outcomes": outcomes},
            mounting=mounting,
            faults=kind,
            flights=flights,
            **{name: sum(o[name] for o in outcomes) for name in COUNTED},
            set_size=float(np.mean(sets)) if sets else 0.0,
            delay=float(np.median([o["delay"] for o in outcomes])),
            took_s=took,
        )
    table.write(arguments)


if __name__ == "__main__":
    main()
