# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A unit that is wrong as a whole: is a healthy channel named, and is the delay of its stamps told and taken off.

Flights of two minutes of small MEMS units in white noise with angular accelerations up to 20 rad/s^2, as recordings of
one Imu topic for each unit, through a replay. One unit has late (or early) stamps, a clock that runs away, jittering
stamps, a gain, repeats its values, or drifts as if the body turned. With "array" its samples arrive with the others.

other: flights with a channel of another unit FAULTY; single: one of this unit, but not all three; unit: all three and
nothing else; in sets: channels AMBIGUOUS; unjudged: share of time after 20 s in which channels are not checked. told:
flights with a delay reported at the end; off: its rms error between units, ms; sigmas: the largest in stated standard
deviations. nees: NEES/3 of the fused rate after 20 s, where it is given; which unit's stamps are right cannot be seen,
so that the smaller one counts of the truth at the stamps of the others and at those of this unit. `imus.max_skew` is
0.1 ms: else stamps that are late by less than it are taken for the time of the others, and nothing of them is left.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from flights import Kept
from trials import (
    START,
    Array,
    Asked,
    Flight,
    Rng,
    Row,
    faulty,
    is_state,
    ways,
    write_bag,
)

from fdi_ros import Block, Config, Pipeline
from fdi_ros.experiments.flight import GyroErrors
from fdi_ros.monitor.output import ChannelState, Output
from fdi_ros.replay.run import replay

LENGTH, ONSET = (
    120.0,
    20.0,
)  # of a flight, and when a fault begins that is not there from the start, s
COUNTED = ("other", "single", "unit", "in_sets")
FIGURES = {
    "flights": "d",
    **dict.fromkeys(COUNTED, "d"),
    "unjudged": ".1%",
    "told": "d",
    **dict.fromkeys(("off", "sigmas", "nees"), ".2f"),
}

Late = Callable[
    [Array, Rng], Array
]  # by how much the stamps of the unit are late, (N,) s, at times (N,) s
Change = Callable[[Array, Array, Array, Rng], Array]
"""What the unit shows instead: of times (N,) s, values (N, 3) rad/s and axes (3, 3)."""


def constant(late: float) -> Late:
    return lambda seconds, rng: np.full(len(seconds), late)


def running(share: float) -> Late:
    return lambda seconds, rng: share * rng.choice([-1.0, 1.0]) * seconds


def jittering(std: float) -> Late:
    # A stamp never comes before that of the sample before.
    return lambda seconds, rng: np.clip(
        std * rng.standard_normal(len(seconds)), -0.0045, 0.0045
    )


def gain(factor: float) -> Change:
    return lambda seconds, shown, axes, rng: factor * shown


def repeating(length: float, period: float = 10.0) -> Change:
    def change(seconds: Array, shown: Array, axes: Array, rng: Rng) -> Array:
        held = (seconds >= ONSET) & ((seconds - ONSET) % period < length)
        rows = np.where(held, 0, np.arange(len(seconds)))
        return np.asarray(shown[np.maximum.accumulate(rows)])

    return change


def turning(growth: float, step: float = 0.0) -> Change:
    """Turn on the whole as the body does, by a step, rad/s, or ever more, rad/s^2."""

    def change(seconds: Array, shown: Array, axes: Array, rng: Rng) -> Array:
        direction = rng.standard_normal(3)
        course = (seconds >= ONSET) * (step + growth * (seconds - ONSET))
        return shown + course[:, None] * (
            axes @ (direction / np.linalg.norm(direction))
        )

    return change


LATE: dict[str, Late] = {
    **{
        f"late by {late:g} ms": constant(1e-3 * late)
        for late in (0, 0.5, 1, 2, 3, 5, 10, 20, 50)
    },
    **{f"early by {late:g} ms": constant(-1e-3 * late) for late in (0.5, 2, 5, 10)},
    **{f"clock {share:g} ppm off": running(1e-6 * share) for share in (20, 100, 200)},
    **{f"jitter {std:g} ms": jittering(1e-3 * std) for std in (1, 3)},
}
CHANGES: dict[str, Change] = {
    "gain 0.95": gain(0.95),
    "gain 1.05": gain(1.05),
    "repeats for 0.1 s": repeating(0.1),
    "drift 0.002 rad/s^2": turning(0.002),
    "drift 0.02 rad/s^2": turning(0.02),
    "step 0.05 rad/s": turning(0.0, 0.05),
}


def outputs(config: Config, block: Block, late: Array) -> tuple[list[Output], Pipeline]:
    """Judge samples as they would be recorded."""
    pipeline = Pipeline.from_config(config)
    if config.input == "channels":
        return [pipeline.process(block)], pipeline
    kept = Kept()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "flight"
        write_bag(block, config.topics, path, late)
        replay(path, config, sinks=[kept])
    assert kept.pipeline is not None
    return kept.outputs, kept.pipeline


def fly(config: Config, rng: Rng, kind: str) -> dict[str, Any]:
    """Fly once; return what came of it."""
    flight = Flight.of(Pipeline.from_config(config), rng, LENGTH, None, GyroErrors())
    seconds, units = flight.seconds, flight.shape[1] // 3
    unit = int(rng.integers(units))
    own = slice(3 * unit, 3 * unit + 3)
    late = np.zeros((len(seconds), units))
    if kind in LATE:
        late[:, unit] = LATE[kind](seconds, rng)
    # Samples of an array have one stamp, whenever they were taken; messages have their own.
    noise = rng.standard_normal(flight.shape)
    block = (flight if config.input == "imus" else replace(flight, late=late)).block(
        noise
    )
    if kind in CHANGES:
        block.z[:, own] = CHANGES[kind](
            seconds, block.z[:, own], flight.gyros.axes[own], rng
        )
    given, pipeline = outputs(config, block, late)
    stamp, rate = (
        np.concatenate([o.stamp for o in given]),
        np.concatenate([o.rate for o in given]),
    )
    after = (stamp - START) * 1e-9 >= ONSET
    at, valid = (stamp - START) * 1e-9, after & np.isfinite(rate).all(axis=1)
    information = np.linalg.inv(np.concatenate([o.covariance for o in given])[valid])
    nees = []
    for shift in (0.0, np.interp(at, seconds, late[:, unit])):
        error = (rate - flight.motion.rate_at(at - shift))[valid]
        nees.append(
            float(np.einsum("ki,kij,kj->k", error, information, error).mean()) / 3
        )
    alone = np.concatenate([faulty(o) for o in given]).any(axis=0)
    unchecked = np.concatenate([is_state(o, ChannelState.UNCHECKED) for o in given])
    other = bool(np.delete(alone, own).any())
    return {
        "other": other,
        "single": bool(alone[own].any() and not alone[own].all()),
        "unit": bool(alone[own].all()) and not other,
        "in_sets": any(bool(is_state(o, ChannelState.AMBIGUOUS).any()) for o in given),
        "unjudged": float(unchecked[after].any(axis=1).mean()),
        "off": delay_error(pipeline, late[-1] - flight.gyros.delay[::3])
        if "jitter" not in kind
        else None,
        "nees": min(nees) if valid.any() else None,
    }


def delay_error(pipeline: Pipeline, late: Array) -> tuple[float, float] | None:
    """Rms error, s, of the delays between units that are reported, and the largest in their standard deviations."""
    status = pipeline.status()
    delays, std = np.array(status.delays), np.array(status.delay_std)
    if len(delays) != len(late) or not np.isfinite(delays).all():
        return None
    error = delays - late
    # Delays common to all units cannot be seen.
    against = np.abs(error - error[0])[1:] / np.maximum(std[1:], 1e-9)
    return float(np.sqrt(((error - error.mean()) ** 2).sum() / (len(late) - 1))), float(
        against.max()
    )


def measure(asked: Asked) -> Iterator[Row]:
    """Every kind, mounting and input."""
    flights = asked.count(2)
    for label, mounting, config, kind in ways(
        asked, {"imus.max_skew": 1e-4}, (*LATE, *CHANGES)
    ):
        outcomes = [
            fly(config, asked.rng("unit", mounting, kind, k), kind)
            for k in range(flights)
        ]
        told = np.array([o["off"] for o in outcomes if o["off"] is not None])
        nees = [o["nees"] for o in outcomes if o["nees"] is not None]
        figures = {
            "unjudged": float(np.mean([o["unjudged"] for o in outcomes])),
            "told": len(told),
            "off": 1e3 * float(np.sqrt((told[:, 0] ** 2).mean()))
            if len(told)
            else None,
            "sigmas": float(told[:, 1].max()) if len(told) else None,
            "nees": float(np.mean(nees)) if nees else None,
        }
        yield (
            label,
            {
                "flights": flights,
                **{name: sum(o[name] for o in outcomes) for name in COUNTED},
                **figures,
            },
        )
