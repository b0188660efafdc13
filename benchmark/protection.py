# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The protection level beside the error of the fused rate under the worst fault of one channel.

The settings allow 1e-5 at a prior of 1e-3 for each channel, so that one sample in 100 may exceed the level while a
channel is faulty. A bias of 1 to 12 sigma begins after 20 s; at each age of it, 10 ms to 10 s, the error of each axis
over its level is taken of all trials, and of these ratios the 99 % point. worst: the largest over sizes, ages and axes;
level over: its inverse, how much larger than needed the level is (below 1: it does not hold); at: where. growth: level
after an hour at rest over that at the start; healthy: largest error over level without a fault; no level: share of the
samples with none.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from trials import IDEAL, RATE, Array, Asked, Flight, Row, Sines, fresh, labelled

from fdi_ros import Pipeline

SETTINGS = {
    **IDEAL,
    "integrity.risk": 1e-5,
    "integrity.fault_rate": (1e-3,),
    "integrity.exposure": 1.0,
}
POINT = 0.99
SIZES = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 12.0)
"""sigma."""
AGES = (0, 1, 2, 4, 9, 19, 49, 99, 199, 499, 999)
"""Samples since the fault began."""
CALM, WATCHED, HOUR = 20.0, 11.0, 3600.0
"""s."""
FIGURES = {
    **dict.fromkeys(("worst", "level_over", "growth", "healthy"), ".2f"),
    "sigma": ".0f",
    "age": "d",
    "no_level": ".1%",
}
MOTIONS = {"at rest": 0.0, "in motion": 0.5}


def ratios(pipeline: Pipeline, flight: Flight, added: Array) -> tuple[Array, Array]:
    """Error over level (N, 3), 0 where there is no rate or no level; and the level of the first axis (N,)."""
    output = fresh(pipeline, flight.block(added))
    ratio = np.abs(output.rate - flight.truth) / output.level
    return np.where(np.isfinite(ratio), ratio, 0.0), output.level[:, 0]


def measure(asked: Asked) -> Iterator[Row]:
    """Faults at rest and in motion, and what an hour at rest does to the level."""
    trials = asked.count(50)
    for label, pipeline, motion in labelled(asked, SETTINGS, MOTIONS):
        worst: tuple[float, float, int] = (0.0, 0.0, 0)
        without, healthy = [], 0.0
        for size in SIZES:
            at = []
            for k in range(trials):
                rng = asked.rng("level", label, size, k)
                flight = Flight.of(pipeline, rng, CALM + WATCHED, Sines.drawn(MOTIONS[motion], rng))
                added, onset = rng.standard_normal(flight.shape), round(CALM * RATE)
                added[onset:, int(rng.integers(flight.shape[1]))] += rng.choice([-1, 1]) * size
                ratio, level = ratios(pipeline, flight, added)
                at.append(ratio[onset + np.array(AGES)])
                without.append(float((~np.isfinite(level[onset:])).mean()))
                healthy = max(healthy, float(ratio[round(onset / 2) : onset].max()))
            points = np.quantile(at, POINT, axis=0).max(axis=1)
            worst = max(worst, (float(points.max()), size, AGES[int(points.argmax())]))
        figures: dict[str, Any] = {"worst": worst[0], "level_over": 1 / worst[0], "sigma": worst[1], "age": worst[2]}
        yield f"{label}, {trials} of each size", {**figures, "healthy": healthy, "no_level": float(np.mean(without))}
    for label, pipeline, _ in labelled(asked, SETTINGS, ("an hour at rest",)):
        growth, largest = [], 0.0
        for k in range(max(trials // 50, 1)):
            rng = asked.rng("level", label, k)
            flight = Flight.of(pipeline, rng, HOUR, Sines.drawn(0.0, rng))
            added = rng.standard_normal(flight.shape)
            ratio, level = ratios(pipeline, flight, added)
            growth.append(float(level[-1] / level[round(CALM * RATE)]))
            largest = max(largest, float(ratio[round(CALM * RATE) :].max()))
        yield label, {"growth": float(np.median(growth)), "healthy": largest}
