# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The protection level beside the error of the fused rate under the worst fault of one channel.

The settings allow 1e-5 in a sample at a prior of 1e-3 for a fault of any channel: one sample in 100 may exceed the
level while a channel is faulty. A bias of 2 to 10 sigma begins after 15 s, or one of 8 after an hour at rest; at each
age of it, 10 ms to 2 s, the error of each axis over its level is taken of all trials, and of these the 99 % point
(the largest of fewer than 100). worst: the largest over sizes, ages and axes; level over: its inverse, by how much the
level is larger than needed (below 1: it does not hold); sigma, age: where. growth: level when the fault begins over
that after 15 s; healthy: largest ratio before the fault; no level: share of the samples with none.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from trials import IDEAL, RATE, Asked, Flight, Row, Sines, fresh

from fdi_ros import Pipeline

PRIOR = 1e-3
SETTINGS = {**IDEAL, "integrity.risk": 1e-5, "integrity.exposure": 1.0}
POINT = 0.99
SIZES = (2.0, 4.0, 6.0, 8.0, 10.0)
"""sigma; the fourth alone after an hour."""
AGES = np.array([0, 1, 2, 4, 9, 19, 49, 99, 199])
"""Samples since the fault began."""
SETTLED, WATCHED, HOUR = 15.0, 2.5, 3600.0
"""s."""
FIGURES = {
    **dict.fromkeys(("worst", "level_over", "growth", "healthy"), ".2f"),
    "sigma": ".0f",
    "age": "d",
    "no_level": ".1%",
    "trials": "d",
}
MOTIONS = {"at rest": (0.0, SETTLED), "in motion": (0.5, SETTLED), "an hour at rest": (0.0, HOUR)}
"""Amplitude, rad/s, and when the fault begins, s."""


def measure(asked: Asked) -> Iterator[Row]:
    """Faults at rest, in motion, and after an hour at rest (a fifth of the trials)."""
    for mounting, config in asked.configs(SETTINGS).items():
        rate = {"integrity.fault_rate": (PRIOR / (3 * len(config.topics)),)}
        pipeline = Pipeline.from_config(config.replaced(rate))
        for motion, (amplitude, begin) in MOTIONS.items():
            if not asked.wants(label := f"{mounting}, {motion}"):
                continue
            trials = asked.count(100) if begin < HOUR else max(asked.count(100) // 5, 1)
            worst, healthy, growth, without = (0.0, 0.0, 0), 0.0, [], []
            settled = round(SETTLED * RATE)
            for size in SIZES if begin < HOUR else SIZES[3:4]:
                ratios = []
                for k in range(trials):
                    rng = asked.rng("level", label, size, k)
                    flight = Flight.of(pipeline, rng, begin + WATCHED, Sines.drawn(amplitude, rng))
                    added, onset = rng.standard_normal(flight.shape), round(begin * RATE)
                    added[onset:, int(rng.integers(flight.shape[1]))] += rng.choice([-1, 1]) * size
                    output = fresh(pipeline, flight.block(added))
                    # No rate, or no level, claims nothing.
                    ratio = np.nan_to_num(np.abs(output.rate - flight.truth) / output.level)
                    ratios.append(ratio[onset + AGES])
                    healthy = max(healthy, float(ratio[settled - round(5 * RATE) : onset].max()))
                    growth.append(float(output.level[onset - 1, 0] / output.level[settled - 1, 0]))
                    without.append(float((~np.isfinite(output.level[onset:, 0])).mean()))
                points = np.quantile(ratios, POINT, axis=0, method="higher").max(axis=1)
                worst = max(worst, (float(points.max()), size, int(AGES[points.argmax()])))
            figures = dict(zip(("worst", "sigma", "age"), worst, strict=True))
            figures |= {"level_over": 1 / worst[0] if worst[0] else None, "growth": float(np.median(growth))}
            yield label, {**figures, "healthy": healthy, "no_level": float(np.mean(without)), "trials": trials}
