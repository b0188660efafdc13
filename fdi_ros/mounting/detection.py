"""Which errors of a mounting are found: in one sample, and by waiting."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fdi_ros.config.config import Config
from fdi_ros.model.geometry import Array, Geometry
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.thresholds import max_normal_threshold, normal_isf
from fdi_ros.monitor.build import alarm_probability
from fdi_ros.report.unit import RADIANS, Unit

DETECTION = 0.99
"""Probability with which the smallest detectable error is seen in one sample."""
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


def smallest_detectable(geometry: Geometry, noise: NoiseModel, probability: float) -> Array:
    """Error (n,) rad/s of each channel that one sample at rest shows with probability DETECTION.

    The test is the largest normalised residual at a false-alarm probability. A channel's own residual, whitened, is
    ``w_i = error sqrt(v_i' (V R V')^-1 v_i) + N(0, 1)``; that some other one passes the threshold first is left out.
    """
    inverse, gain = _whitened(geometry, noise.noise_std**2)
    root = np.linalg.cholesky(inverse)
    directions = (root.T @ geometry.parity).T[geometry.detectable]
    threshold = max_normal_threshold(directions / np.linalg.norm(directions, axis=1)[:, None], probability)
    with np.errstate(divide="ignore"):
        return np.where(geometry.detectable, (threshold + normal_isf(1 - DETECTION)) / gain, np.inf)


def _whitened(geometry: Geometry, variance: Array) -> tuple[Array, Array]:
    """Inverse covariance of the parity vector, and the shift (n,) of it, whitened, per error of each channel."""
    V = geometry.parity
    inverse: Array = np.asarray(np.linalg.inv((V * variance) @ V.T), dtype=np.float64)
    return inverse, np.sqrt(np.maximum(np.einsum("ai,ab,bi->i", V, inverse, V), 0))


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
    _, gain = _whitened(geometry, white + samples * lasting)
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


def summary_line(
    geometry: Geometry, noise: NoiseModel, probability: float, unit: Unit = RADIANS, agree: bool = True
) -> str:
    """Return what a mounting can do in one line, as for the log of a node.

    Parameters
    ----------
    geometry, noise
        Of the monitor.
    probability
        False-alarm probability per sample.
    unit
        Of the errors.
    agree
        The channels are not known to contradict each other: else it is left open which faults can be named.
    """
    smallest = smallest_detectable(geometry, noise.for_channels(geometry.n), probability)
    seen = smallest[np.isfinite(smallest)]
    span = f"{seen.min() * unit.factor:.3g} to {seen.max() * unit.factor:.3g} {unit.name}" if len(seen) else "none"
    isolable, n = int(geometry.isolable.sum()), geometry.n
    words = f"{n} channels, GDOP {geometry.gdop:.2f}; seen in one sample at rest with {DETECTION:.0%}: errors of {span}"
    if not agree:
        return f"{words}; which faults can be named is not known: channels contradict each other"
    groups = [group for group in geometry.groups if len(group) > 1]
    if isolable == n:
        return f"{words}; any single fault can be named"
    alike = "; ".join(" or ".join(geometry.channel_names[i] for i in group) for group in groups)
    return f"{words}; {isolable} of {n} single faults can be named, not told apart: {alike or 'faults never seen'}"
