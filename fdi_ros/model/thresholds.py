# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""From a false-alarm rate to a threshold: chi-square, normal, and the largest of correlated normals.

NumPy and the standard library only: chi-square tails of whole degrees of freedom are finite sums.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from fdi_ros.arrays import Array
from fdi_ros.errors import ConfigError

DEFAULT_PROBABILITY = 1e-6
"""Per sample."""
DEFAULT_RUN_LENGTH, MIN_RUN_LENGTH, MAX_RUN_LENGTH = 3.6e8, 2.0, 1e15
"""Samples; the default is one false alarm in 1000 hours at 100 Hz."""
OPTIONS = ("run_length", "false_alarm_probability", "false_alarms_per_hour", "sample_rate")
"""Names of its fields among the options of a detector."""


@dataclass(frozen=True)
class FalseAlarmRate:
    """A false-alarm rate as it is asked for; stated in no way, each reading has its default.

    Parameters
    ----------
    probability
        Per sample, 0 to 1, both excluded.
    per_hour
        Expected false alarms per hour, > 0; needs the sample rate.
    run_length
        Mean samples to a false alarm.
    sample_rate
        Hz, > 0.

    Raises
    ------
    ConfigError
        If it is stated in two ways, or a value is out of its range.
    """

    probability: float | None = None
    per_hour: float | None = None
    run_length: float | None = None
    sample_rate: float | None = None

    def __post_init__(self) -> None:
        given = [name for name, value in self._named().items() if value is not None and name != "sample_rate"]
        if len(given) > 1:
            raise ConfigError(f"give {' or '.join(given)}, not both")
        if self.per_hour is not None:
            if not self.per_hour > 0 or not math.isfinite(self.per_hour):
                raise ConfigError(f"false_alarms_per_hour is {self.per_hour:g}, expected > 0")
            if self.sample_rate is None or not self.sample_rate > 0 or not math.isfinite(self.sample_rate):
                raise ConfigError(f"false_alarms_per_hour needs a sample_rate > 0 Hz, got {self.sample_rate}")

    def per_sample(self) -> float:
        """Probability of a false alarm in one sample; `DEFAULT_PROBABILITY` if nothing is stated.

        Raises
        ------
        ConfigError
            If it is not between 0 and 1.
        """
        probability = DEFAULT_PROBABILITY if self.probability is None else self.probability
        if self.per_hour is not None and self.sample_rate is not None:
            probability = self.per_hour / (3600.0 * self.sample_rate)
        elif self.run_length is not None:
            probability = 1 / self.mean_run_length()
        if not 0 < probability < 1:
            raise ConfigError(f"false-alarm probability per sample is {probability:g}, expected between 0 and 1")
        return probability

    def mean_run_length(self) -> float:
        """Mean samples to a false alarm; `DEFAULT_RUN_LENGTH` if nothing is stated.

        Raises
        ------
        ConfigError
            If it is not `MIN_RUN_LENGTH` to `MAX_RUN_LENGTH`.
        """
        samples = DEFAULT_RUN_LENGTH if self.run_length is None else self.run_length
        if self.per_hour is not None or self.probability is not None:
            samples = 1 / self.per_sample()
        if not MIN_RUN_LENGTH <= samples <= MAX_RUN_LENGTH:
            raise ConfigError(f"run_length is {samples:g} samples, expected {MIN_RUN_LENGTH:g} to {MAX_RUN_LENGTH:g}")
        return samples

    def as_options(self, accepted: Collection[str] = OPTIONS) -> dict[str, float]:
        """Return the options of a detector that state the same.

        Parameters
        ----------
        accepted
            Options that the detector takes; one that takes a run length and no probability gets the run length.
        """
        options = self._named()
        if self.probability is not None and "run_length" in accepted and "false_alarm_probability" not in accepted:
            options["run_length"] = max(1 / self.probability, MIN_RUN_LENGTH)
        return {name: value for name, value in options.items() if value is not None and name in accepted}

    def _named(self) -> dict[str, float | None]:
        return dict(zip(OPTIONS, (self.run_length, self.probability, self.per_hour, self.sample_rate), strict=True))


_erfc = np.frompyfunc(math.erfc, 1, 1)


# Thresholds ----------------------------------------------------------------------------------------------------------


def normal_isf(probability: float) -> float:
    """Upper quantile of the standard normal."""
    return -NormalDist().inv_cdf(probability)


def chi2_sf(x: Array | float, dof: int) -> Array:
    """P(chi-square with whole dof > x), elementwise; the closed sums of Abramowitz and Stegun 26.4.4-5."""
    half = np.asarray(x, dtype=np.float64) / 2
    if dof % 2 == 0:
        terms = [half**k / math.factorial(k) for k in range(dof // 2)]
        return np.asarray(np.exp(-half) * sum(terms), dtype=np.float64)
    terms = [half ** (k + 0.5) / math.gamma(k + 1.5) for k in range((dof - 1) // 2)]
    return np.asarray(_erfc(np.sqrt(half)) + np.exp(-half) * sum(terms), dtype=np.float64)


def chi2_isf(probability: float, dof: int) -> float:
    """Threshold that a chi-square with whole dof exceeds with the given probability."""
    start = max(normal_isf(probability), 0.0) ** 2 + dof
    return _solve(lambda x: float(chi2_sf(x, dof)), probability, start)


def max_normal_threshold(directions: Array, probability: float) -> float:
    """Exact threshold of ``max_i |w_i|`` for standard normal w_i = directions_i . p, p white in m dimensions.

    Up to m = 3 the chi-square tail of ``(t / M(u))^2``, ``M(u) = max_i |directions_i . u|``, is averaged over the
    unit sphere by quadrature. Above, over samples drawn beyond the threshold along each direction in turn
    (Naiman and Priebe 2001), which keeps its relative accuracy far into the tail.

    Parameters
    ----------
    directions
        Unit vectors in parity space, (n, m).
    probability
        P(max_i |w_i| > threshold), 0 to 1.
    """
    unique = _distinct(directions)
    m = unique.shape[1]
    tail = _sphere_tail(unique) if m <= 3 else _union_tail(unique)
    bonferroni = normal_isf(probability / (2 * len(unique)))
    return _solve(tail, probability, bonferroni)


def _distinct(directions: Array) -> Array:
    kept: list[int] = []
    for i, direction in enumerate(directions):
        if all(abs(direction @ directions[j]) < 1 - 1e-9 for j in kept):
            kept.append(i)
    return directions[kept]


def _sphere_tail(directions: Array) -> Callable[[float], float]:
    points, weights = _half_sphere(directions.shape[1])
    largest = np.abs(points @ directions.T).max(axis=1)
    inverse = np.divide(1.0, largest, out=np.full_like(largest, 1e3), where=largest > 1e-3)

    def tail(t: float) -> float:
        return float(weights @ chi2_sf((t * inverse) ** 2, directions.shape[1]))

    return tail


def _half_sphere(m: int) -> tuple[Array, Array]:
    if m == 1:
        return np.ones((1, 1)), np.ones(1)
    angle = np.pi * (np.arange(360) + 0.5) / 180
    circle = np.column_stack([np.cos(angle / 2), np.sin(angle / 2)])
    if m == 2:
        return circle, np.full(len(circle), 1 / len(circle))
    nodes, weights = np.polynomial.legendre.leggauss(48)
    height, height_weight = (nodes + 1) / 2, weights / 2
    azimuth = np.pi * (np.arange(128) + 0.5) / 64
    radius = np.sqrt(1 - height**2)
    points = np.stack(
        [
            np.outer(radius, np.cos(azimuth)),
            np.outer(radius, np.sin(azimuth)),
            np.repeat(height[:, None], len(azimuth), axis=1),
        ],
        axis=-1,
    ).reshape(-1, 3)
    return points, np.repeat(height_weight / len(azimuth), len(azimuth))


def _union_tail(directions: Array, most_draws: int = 4096) -> Callable[[float], float]:
    # Seeded once: the threshold is a function of the geometry, the same in every run.
    rng = np.random.default_rng(20190101)
    n, m = directions.shape
    # The more directions share in the estimate, the fewer draws each needs: the cost grows with n squared, not cubed.
    draws = min(most_draws, 16 * most_draws // n)
    white = rng.standard_normal((draws, m)) @ directions.T
    log_levels = np.log((rng.permutation(draws) + 0.5) / draws)
    nodes = np.linspace(log_levels.min(), 0.0, 257)
    correlation = directions @ directions.T

    def tail(t: float) -> float:
        single = math.erfc(t / math.sqrt(2))
        # 257 quantiles and straight lines between them: within 1e-5, and all draws at once.
        along = np.interp(log_levels, nodes, [normal_isf(math.exp(node) * single / 2) for node in nodes])
        total = 0.0
        for i in range(n):
            w = (along - white[:, i])[:, None] * correlation[i]
            w += white
            # Comparing i's own value, rounded, with t would lose the one exceedance that is certain.
            w[:, i] = 0.0
            others = (np.abs(w, out=w) > t).sum(axis=1)
            total += single * float(np.mean(1 / (1 + others)))
        return total

    return tail


def _solve(tail: Callable[[float], float], probability: float, start: float) -> float:
    """Root of log tail(t) = log probability by secant; tails are log-concave, so it converges in a few steps."""
    target = math.log(probability)
    older, newer = start, start + 0.05
    f_older, f_newer = math.log(tail(older)) - target, math.log(tail(newer)) - target
    for _ in range(60):
        if abs(newer - older) < 1e-9 * newer or f_newer == f_older:
            break
        step = f_newer * (newer - older) / (f_newer - f_older)
        older, f_older = newer, f_newer
        newer = max(newer - step, 0.2 * newer)
        f_newer = math.log(tail(newer)) - target
    return newer
