# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""False declarations of healthy gyros in noise of many kinds, where 10 an hour are asked for.

Flights of ten minutes as a small vehicle flies, axes and clocks as the config says, noise as strong as it says. A
flight ends with its first declaration: every one is a fresh start. over asked: realised over asked, by the time flown.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.signal import lfilter
from trials import IDEAL, RATE, Array, Asked, Flight, Noise, Rng, Row, labelled, white

FIGURES = {"events": "d", "hours": ".2f", "an_hour": ".2f", "over_asked": ".3f", "error": ".3f"}
ASKED = 10.0
"""An hour."""
LENGTH = 600.0
"""Of a flight, s."""


def student(freedom: float) -> Noise:
    """Student's t, of unit variance."""
    return lambda rng, rows, n: rng.standard_t(freedom, (rows, n)) / np.sqrt(freedom / (freedom - 2))


def laplace(rng: Rng, rows: int, n: int) -> Array:
    """Two-sided exponential."""
    return rng.laplace(size=(rows, n)) / np.sqrt(2)


def autoregressive(phi: float) -> Noise:
    """Of first order."""

    def noise(rng: Rng, rows: int, n: int) -> Array:
        steps = rng.standard_normal((rows, n))
        steps[0] /= np.sqrt(1 - phi**2)
        return np.asarray(lfilter([np.sqrt(1 - phi**2)], [1.0, -phi], steps, axis=0))

    return noise


def volatile(of_each: bool) -> Noise:
    """White noise whose strength changes within half a second, by a factor of 1.6, of each channel or of all alike."""

    def noise(rng: Rng, rows: int, n: int) -> Array:
        level = autoregressive(np.exp(-1 / (0.5 * RATE)))(rng, rows, n if of_each else 1)
        return np.asarray(rng.standard_normal((rows, n)) * np.exp(0.5 * level - 0.25))

    return noise


def bursts(rng: Rng, rows: int, n: int) -> Array:
    """White noise, and on one unit narrow-band noise of 3 sigma that comes within 0.2 s and goes, 20 % of the time."""
    noise = rng.standard_normal((rows, n))
    unit = 3 * int(rng.integers(n // 3))
    for begin in np.flatnonzero(rng.random(rows) < 1 / (5 * RATE)).tolist():
        length = min(int(RATE * rng.uniform(0.4, 2.0)), rows - begin)
        radius, turn = np.exp(-np.pi * 2.0 / RATE), 2 * np.pi * rng.uniform(10, 45) / RATE
        tone = lfilter([1.0], [1.0, -2 * radius * np.cos(turn), radius**2], rng.standard_normal((length + 50, 3)), 0)
        edge = np.minimum(np.arange(length), np.arange(length)[::-1]) / (0.2 * RATE)
        noise[begin : begin + length, unit : unit + 3] += 3.0 * tone[50:] / tone.std() * np.minimum(edge, 1)[:, None]
    return noise


NOISES: dict[str, Noise] = {
    "white": white,
    "t3": student(3),
    "t4": student(4),
    "Laplace": laplace,
    "AR 0.8": autoregressive(0.8),
    "AR 0.95": autoregressive(0.95),
    "volatile, each channel": volatile(True),
    "volatile, all alike": volatile(False),
    "local vibration": bursts,
}


def measure(asked: Asked) -> Iterator[Row]:
    """Count the declarations in so many hours of each noise."""
    for label, pipeline, name in labelled(asked, {**IDEAL, "detector.false_alarms_per_hour": ASKED}, NOISES):
        events, flown = 0, 0.0
        for k in range(round(asked.count(3) * 3600 / LENGTH)):
            rng = asked.rng("false", label, k)
            flight = Flight.of(pipeline, rng, LENGTH, None)
            block = flight.block(NOISES[name](rng, *flight.shape))
            pipeline.restart()
            for output in pipeline.steps(block):
                flown += len(output) / RATE / 3600
                if any(event.declares for event in output.events):
                    events += 1
                    break
        hourly, one = events / flown, pipeline.config.detector.false_alarms_per_hour * flown
        over = {"over_asked": events / one, "error": max(events, 1) ** 0.5 / one}
        yield label, {"events": events, "hours": flown, "an_hour": hourly, **over}
