# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Several faults at once or one after the other: is a healthy channel ever named, and are the guilty ones in the set.

Flights of 40 s of small MEMS units in white noise; from 10 s on channels are faulty, 8 to 50 sigma (three of one unit:
7 to 28) with random signs. Input: one Imu topic for each unit, or one array of the same channels.

wrong: a healthy channel was FAULTY at any time; held: at the end every guilty channel is FAULTY or in a set, no healthy
one FAULTY; named: all of them FAULTY; early: something was declared before the fault; unjudged: the channels were not
checked when it began, which counts as nothing else. set size: mean of channels in the set at the end, where there is
one; delay: median to the first declaration, s.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from trials import (
    Array,
    Asked,
    Flight,
    Mask,
    Rng,
    Row,
    faulty,
    first,
    fresh,
    is_state,
    ways,
)

from fdi_ros import Pipeline
from fdi_ros.experiments.flight import GyroErrors
from fdi_ros.monitor.output import ChannelState

LENGTH, ONSET = 40.0, 10.0  # of a flight, and when faults begin, s
GROWTH = 5.0  # a ramp has its size after so long, s
COUNTED = ("wrong", "held", "named", "early", "unjudged")
FIGURES = {
    "flights": "d",
    **dict.fromkeys(COUNTED, "d"),
    "set_size": ".1f",
    "delay": ".2f",
}

Courses = Callable[
    [Array, Rng, int], Array
]  # errors of the guilty channels, (N, k) in sigma, at times (N,) s


def sizes(rng: Rng, count: int, least: float = 8.0, most: float = 50.0) -> Array:
    """(count,) with either sign, in sigma, evenly spread over the logarithm."""
    return least * (most / least) ** rng.random(count) * rng.choice([-1.0, 1.0], count)


def biases(seconds: Array, rng: Rng, count: int) -> Array:
    return (seconds >= ONSET)[:, None] * sizes(rng, count)


def ramps(seconds: Array, rng: Rng, count: int) -> Array:
    return np.maximum(seconds - ONSET, 0)[:, None] / GROWTH * sizes(rng, count)


def of_a_unit(seconds: Array, rng: Rng, count: int) -> Array:
    return (seconds >= ONSET)[:, None] * sizes(rng, count, 7.0, 28.0)


def sequence(seconds: Array, rng: Rng, count: int) -> Array:
    return (
        seconds[:, None] >= ONSET + np.array([0.0, rng.choice([0.05, 0.5, 5.0])])
    ) * sizes(rng, count)


def intermittent(seconds: Array, rng: Rng, count: int) -> Array:
    periods, duties = rng.uniform(0.2, 3.0, count), rng.uniform(0.1, 0.6, count)
    on = (seconds[:, None] >= ONSET) & (
        (seconds[:, None] - ONSET) % periods < duties * periods
    )
    return on * sizes(rng, count)


KINDS: dict[str, tuple[int, Courses]] = {
    "one bias": (1, biases),
    "two biases": (2, biases),
    "three biases": (3, biases),
    "two ramps": (2, ramps),
    "whole unit": (0, of_a_unit),
    "sequence of two": (2, sequence),
    "two intermittent": (2, intermittent),
}
"""Guilty channels (0: one whole unit), and their errors."""


def fly(pipeline: Pipeline, rng: Rng, count: int, courses: Courses) -> dict[str, Any]:
    """Fly once; return what came of it."""
    flight = Flight.of(pipeline, rng, LENGTH, None, GyroErrors())
    seconds, n = flight.seconds, flight.shape[1]
    channels: NDArray[Any] = 3 * rng.integers(n // 3) + np.arange(3)
    if count:
        channels = rng.choice(n, count, replace=False)
    guilty: Mask = np.isin(np.arange(n), channels)
    added = rng.standard_normal(flight.shape)
    added[:, channels] += courses(seconds, rng, len(channels))
    output = fresh(pipeline, flight.block(added))
    alone, among = faulty(output), is_state(output, ChannelState.AMBIGUOUS)
    onset = int(np.searchsorted(seconds, ONSET))
    declared = alone | among
    if is_state(output, ChannelState.UNCHECKED)[onset - 1].any():
        return {"unjudged": True}
    hit, wrong = declared[-1, guilty], bool(alone[:, ~guilty].any())
    return {
        "wrong": wrong,
        "held": bool(hit.all()) and not wrong,
        "named": bool(alone[-1, guilty].all()) and not wrong,
        "early": bool(declared[:onset].any()),
        "set_size": int(among[-1].sum()),
        "delay": (first(declared[onset:].any(axis=1)) - 1)
        / pipeline.config.sample_rate,
    }


def measure(asked: Asked) -> Iterator[Row]:
    """Every kind, mounting and input."""
    flights = asked.count(20)
    for label, mounting, config, name in ways(asked, None, KINDS):
        pipeline = Pipeline.from_config(config)
        outcomes = [
            fly(pipeline, asked.rng("several", mounting, name, k), *KINDS[name])
            for k in range(flights)
        ]
        sets = [o["set_size"] for o in outcomes if o.get("set_size")]
        counts = {word: sum(o.get(word, False) for o in outcomes) for word in COUNTED}
        size, delays = (
            float(np.mean(sets)) if sets else None,
            [o.get("delay", np.inf) for o in outcomes],
        )
        yield (
            label,
            {
                "flights": flights,
                **counts,
                "set_size": size,
                "delay": float(np.median(delays)),
            },
        )
