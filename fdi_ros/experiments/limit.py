# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The best that any method could do: Bayes decisions on one sample, optimal stopping over many.

One sample. Whatever a method does with a sample, without knowledge of the rate it can use the parity vector alone.
With f_0 the density of the parity vector of healthy channels and f_i that with channel i faulty, prior P_i, the
decision that names the right channel most often at a given false-alarm rate names ``argmax P_i f_i`` and declares
it where ``max_i P_i f_i / f_0`` exceeds a level (Neyman and Pearson's lemma, one region per channel). Both
probabilities are integrals over parity space.

Many samples. No method with mean run length G to a false alarm has a worst-case mean delay below that of the CUSUM
tuned to the very change (Lorden 1971, first order; Moustakides 1986, exactly).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fdi_ros.errors import StudyError
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.samples import Array
from fdi_ros.model.thresholds import half_sphere, solve_log
from fdi_ros.scoring import settled

MAX_DIMENSIONS = 6
"""Dimensions of parity space up to which a limit is worth its time."""
RADII, AROUND = 240, 96
"""Radii, and directions once around, of the grid."""
DRAWS = 400_000
"""Points drawn instead of a grid where parity space has more than three dimensions."""


@dataclass(frozen=True)
class Rule:
    """Points of parity space in standard deviations, and weights: integrals over it become sums."""

    points: Array
    """(Q, m)"""
    log_weight: Array
    """(Q,)"""


@dataclass(frozen=True)
class Limit:
    """Best possible figures over all false-alarm rates."""

    false_alarm: Array
    """(Q,) probability of an alarm on healthy channels, increasing."""
    declared: Array
    """(Q,) probability that a fault is declared, on whatever channel."""
    right: Array
    """(Q,) probability that it is declared and the right channel named."""

    def shares(self, false_alarms: Sequence[float]) -> dict[str, list[float]]:
        """Best possible shares declared, and declared with the right channel named, at some false-alarm rates."""
        declared, right = zip(*map(self.at, false_alarms), strict=True)
        return {"declared": [settled(share) for share in declared], "right": [settled(share) for share in right]}

    def at(self, false_alarm: float) -> tuple[float, float]:
        """Probabilities (declared, right) at a false-alarm rate."""
        x = math.log(false_alarm)
        known = np.log(np.maximum(self.false_alarm, 1e-300))
        return float(np.interp(x, known, self.declared)), float(np.interp(x, known, self.right))


def limit_points(shares: Mapping[str, Sequence[float]], false_alarms: Sequence[float]) -> list[dict[str, float]]:
    """Best possible shares, one by one with their false-alarm rates: as the result of a study has them."""
    each = zip(false_alarms, shares["declared"], shares["right"], strict=True)
    return [{"false_alarm": alarm, "declared": declared, "right": right} for alarm, declared, right in each]


def grid(m: int, reach: float, radii: int = RADII, around: int = AROUND) -> Rule:
    """Rule over half of parity space, out to `reach` standard deviations; everything is even, so half is enough.

    Radius and direction each by themselves, up to three dimensions.
    """
    if not 1 <= m <= 3:
        raise StudyError(f"quadrature in parity space has 1 to 3 dimensions, got {m}")
    nodes, weights = np.polynomial.legendre.leggauss(radii)
    radius, radial = reach * (nodes + 1) / 2, reach * weights / 2 * (reach * (nodes + 1) / 2) ** (m - 1)
    direction, share = half_sphere(m, circle=around, around=around, heights=around // 3)
    solid = share * (1.0, np.pi, 2 * np.pi)[m - 1]
    points = (radius[:, None, None] * direction).reshape(-1, m)
    return Rule(points, np.log(2 * np.outer(radial, solid)).ravel())


def log_normal(points: Array, covariance: Array) -> Array:
    """Logarithm of the density of a normal parity vector, (Q,), covariance (m, m)."""
    factor = np.linalg.cholesky(covariance)
    # One product: solving for a million right-hand sides takes several times as long, and the factor is small.
    white = np.linalg.inv(factor) @ points.T
    return -0.5 * (white**2).sum(axis=0) - float(np.log(np.diag(factor)).sum()) - 0.5 * len(factor) * _LOG_2PI


def log_faulty(points: Array, direction: Array, sizes: Array, covariance: Array) -> Array:
    """Logarithm of the density (Q,) with a fault along one direction, each of its sizes and either sign alike.

    Parameters
    ----------
    points
        (Q, m).
    direction
        (m,) what a unit error adds.
    sizes
        (K,) of the error.
    covariance
        Of the other errors, (m, m).
    """
    precise = np.linalg.inv(covariance)
    along, own = points @ (precise @ direction), float(direction @ precise @ direction)
    shape = np.abs(np.outer(sizes, along)) - 0.5 * own * (sizes**2)[:, None] + math.log(0.5 / len(sizes))
    # ln(e^x + e^-x) = |x| + ln(1 + e^(-2 |x|)): neither overflows.
    terms = shape + np.log1p(np.exp(-2 * np.abs(np.outer(sizes, along))))
    top = terms.max(axis=0)
    return log_normal(points, covariance) + top + np.log(np.exp(terms - top).sum(axis=0))


def best_decisions(rule: Rule, healthy: Array, faulty: Array) -> Limit:
    """Best figures from the log densities of healthy channels (Q,) and of each one faulty, prior included (n, Q)."""
    best = faulty.max(axis=0)
    order = np.argsort(healthy - best, kind="stable")
    weight = rule.log_weight[order]
    return Limit(
        np.cumsum(np.exp(healthy[order] + weight)),
        np.cumsum(np.exp(faulty[:, order] + weight).sum(axis=0)),
        np.cumsum(np.exp(best[order] + weight)),
    )


def fault_of_size(geometry: Geometry, size: float) -> Limit:
    """Limit for unit white noise and one fault of a size, in standard deviations; any channel, either sign alike."""
    directions = geometry.parity.T
    m = directions.shape[1]
    rule = grid(m, size + 7.0) if m <= 3 else _drawn(directions, size)
    each = [log_faulty(rule.points, u, np.array([size]), np.eye(m)) - math.log(geometry.n) for u in directions]
    return best_decisions(rule, log_normal(rule.points, np.eye(m)), np.array(each))


def _drawn(directions: Array, size: float) -> Rule:
    """Rule of random points, half from healthy channels and half from faulty ones; seeded, the same in every run."""
    rng = np.random.default_rng(19710101)
    n, m = directions.shape
    points = rng.standard_normal((DRAWS, m))
    half = DRAWS // 2
    struck = size * rng.choice([-1.0, 1.0], half)
    points[:half] += struck[:, None] * directions[rng.integers(n, size=half)]
    each = np.array([log_faulty(points, u, np.array([size]), np.eye(m)) for u in directions])
    healthy = log_normal(points, np.eye(m))
    mixed = np.logaddexp(healthy, np.logaddexp.reduce(each, axis=0) - math.log(n)) - math.log(2)
    return Rule(points, -mixed - math.log(DRAWS))


def lorden_delay(shift: float, run_length: float) -> float:
    """First-order bound on the worst-case mean delay, samples: ln(G) over the information ``shift^2 / 2`` of a sample.

    Parameters
    ----------
    shift
        Change of the mean of a standard normal, > 0: the fault in standard deviations times sqrt(S_ii).
    run_length
        Mean number G of samples to a false alarm.
    """
    return math.log(run_length) / (0.5 * shift**2)


def moustakides_delay(shift: float, run_length: float) -> float:
    """Least possible worst-case mean delay, samples: that of the CUSUM tuned to the change, at its run length.

    Parameters as in `lorden_delay`.
    """
    limit = solve_log(lambda limit: cusum_run_length(limit, shift / 2, 0.0), run_length, math.log(run_length) / shift)
    return cusum_run_length(limit, shift / 2, shift)


def cusum_run_length(limit: float, reference: float, mean: float) -> float:
    """Mean number of samples until a one-sided CUSUM ``s = max(0, s + x - reference)`` of normal x reaches its limit.

    From s = 0; the integral equation of Page (1954) by Gauss-Legendre quadrature.

    Parameters
    ----------
    limit, reference
        In standard deviations of x.
    mean
        Of x.
    """
    if limit <= 0:
        return 1 / _above(reference - mean)
    # The kernel is one standard deviation wide: a few nodes in each.
    nodes = 60 + math.ceil(2 * limit)
    node, weight = np.polynomial.legendre.leggauss(nodes)
    at, weight = limit * (node + 1) / 2, limit * weight / 2
    start = np.concatenate([[0.0], at])
    step = at - start[:, None] + reference - mean
    matrix = np.zeros((nodes + 1, nodes + 1))
    matrix[:, 1:] = np.exp(-0.5 * step**2) * weight / math.sqrt(2 * math.pi)
    matrix[:, 0] = [1 - _above(reference - mean - s) for s in start]
    return float(np.linalg.solve(np.eye(nodes + 1) - matrix, np.ones(nodes + 1))[0])


def _above(x: float) -> float:
    return 0.5 * math.erfc(x / math.sqrt(2))


_LOG_2PI = math.log(2 * math.pi)
