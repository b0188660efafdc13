# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The smallest errors that are found by waiting: at rest, in fast turns, in vibration."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fdi_ros.config.config import Config
from fdi_ros.model.geometry import Array, Geometry
from fdi_ros.model.noise import NoiseModel
from fdi_ros.monitor.build import alarm_probability

WAITS = (0.02, 0.1, 0.5, 2.0)
"""Times within which a fault may be found, s."""
VIBRATION = 5.0
"""Times by which vibration raises the noise, where noise_std is that at rest."""
LEAST_SAMPLES = 1.5
"""Below so many samples a mean delay is not computed: it depends on single samples."""


@dataclass(frozen=True)
class Waiting:
    """Smallest errors that are found by waiting, in one condition."""

    condition: str
    size: Array
    """(waits, n) rad/s, in the order of WAITS; infinite: never, NaN: the wait is shorter than two samples."""


def waiting(config: Config, geometry: Geometry, noise: NoiseModel) -> tuple[Waiting, ...]:
    """Smallest errors found by waiting: at rest, while turning as fast as integrity.max_rate, and in vibration.

    White noise averages out in time. What scale and timing errors make of a turn does not while the turn lasts: they
    stay the same from sample to sample and add to the variance of the mean.
    """
    limits = config.integrity
    white = noise.noise_std**2
    lasting = (noise.scale_std * limits.max_rate) ** 2 + (noise.timing_std * limits.max_acceleration) ** 2
    turning = f"turning, {limits.max_rate:g} rad/s and {limits.max_acceleration:g} rad/s^2"
    return tuple(
        Waiting(condition, np.array([_found_within(config, geometry, wait, *variances) for wait in WAITS]))
        for condition, *variances in (
            ("at rest", white, np.zeros_like(white)),
            (turning, white, lasting),
            (f"in vibration, noise {VIBRATION:g} times", VIBRATION**2 * white, np.zeros_like(white)),
        )
    )


def _found_within(config: Config, geometry: Geometry, wait: float, white: Array, lasting: Array) -> Array:
    """Error (n,) rad/s of each channel that is found within a time, s, on average."""
    samples = wait * config.sample_rate
    if samples < LEAST_SAMPLES:
        return np.full(geometry.n, np.nan)
    V = geometry.parity
    inverse = np.linalg.inv((V * (white + samples * lasting)) @ V.T)
    gain = np.sqrt(np.maximum(np.einsum("ai,ab,bi->i", V, inverse, V), 0))
    shift = smallest_shift(samples, 1 / alarm_probability(config))
    with np.errstate(divide="ignore"):
        return np.where(geometry.detectable, shift / gain, np.inf)


def smallest_shift(samples: float, run_length: float) -> float:
    """Shift of a normal variable, in standard deviations, that the best sequential test finds within a mean delay.

    No test whose mean run length to a false alarm is A has a worst-case mean delay to a shift s below about
    ``2 ln(A) / s^2`` (Lorden 1971); the CUSUM tuned to s attains the least there is (Moustakides 1986). Its run
    lengths in closed form (Siegmund 1985): with x the level in units of 1/s,

        A = 2 (exp(x) - x - 1) / s^2,    delay = 2 (exp(-x) + x - 1) / s^2

    Parameters
    ----------
    samples
        Mean delay, samples, > 1.
    run_length
        Mean number A of samples to a false alarm.
    """
    shift = math.sqrt(2 * math.log(run_length) / samples)
    level = math.log(run_length)
    for _ in range(50):
        level = math.log(run_length * shift**2 / 2 + level + 1)
        shift = math.sqrt(2 * (math.exp(-level) + level - 1) / samples)
    return shift
