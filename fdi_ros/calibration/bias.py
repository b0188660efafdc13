"""Bias of each channel from its times at rest, with a random walk of the bias in the uncertainty.

Means over parts at rest, ``y_k = b(t_k) + e_k`` with ``var e_k = level^2 / count_k``, and a bias that walks:
``var(b(s) - b(t)) = walk^2 |s - t|``. Its level at the start is unknown, so all is done on contrasts: estimates are
the best linear unbiased ones (ordinary kriging, variogram ``walk^2 |h| / 2``), the walk is found by maximum
restricted likelihood.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize_scalar

from fdi_ros.calibration.data import Array, Data, Index, Mask, Rest

MAX_PARTS = 64
"""Parts at rest at most: what is worked out grows with their number cubed."""
LARGEST_WALK = 1e-2
"""rad/s per square root of a second."""
COLOURED = 1.5
"""Means of neighbouring windows that differ by more than this times what white noise makes of it, squared: colour."""
LEAST_PAIRS = 8
"""Neighbouring windows that tell."""
OWN_WALK = 4.0
"""A channel has a walk of its own if that raises its log-likelihood by more; a walk is shown at all likewise."""
POSSIBLE = 2.0
"""A walk may be as large as lowers the log-likelihood by no more."""
SMALLEST_WALK = 1e-8
"""rad/s per square root of a second: none."""


@dataclass(frozen=True)
class Bias:
    """Bias of every channel.

    Attributes
    ----------
    mean
        (n,) average over the recording, rad/s.
    std
        (n,) its standard error, rad/s.
    walk
        (n,) random walk, rad/s per square root of a second.
    time
        (T,) s.
    course
        (T, n) estimate at these times, rad/s.
    shown
        Whether the recording shows a walk.
    possible
        Largest walk that it does not rule out, rad/s per square root of a second.
    """

    mean: Array
    std: Array
    walk: Array
    time: Array
    course: Array
    shown: bool
    possible: float

    def at(self, seconds: Array) -> Array:
        """Estimate (N, n) rad/s at times (N,) s."""
        return np.column_stack([np.interp(seconds, self.time, course) for course in self.course.T])


@dataclass(frozen=True)
class _Parts:
    """Means of one channel over parts at rest: times, values, and the variances of their noise, (K,) each."""

    time: Array
    value: Array
    noise: Array


def estimate_bias(data: Data, rest: Rest, level: Array) -> Bias:
    """Bias from the windows at rest.

    Parameters
    ----------
    data, rest
        The recording and where it is at rest; every channel must be so in one window at least.
    level
        (n,) standard deviation of one sample at rest, rad/s.
    """
    n = data.z.shape[1]
    parts = [_parts(data, rest, level, i) for i in range(n)]
    common = _best_walk(parts)
    shown, possible = _evidence(parts, common)
    walk = np.array([_own_walk(part, common) for part in parts])
    time = np.linspace(0.0, data.duration, 201)
    found = [_kriged(part, q, time) for part, q in zip(parts, walk, strict=True)]
    return Bias(
        np.array([mean for mean, _, _ in found]),
        np.array([std for _, std, _ in found]),
        walk,
        time,
        np.column_stack([course for _, _, course in found]),
        shown,
        possible,
    )


def _parts(data: Data, rest: Rest, level: Array, channel: int) -> _Parts:
    """Join windows at rest that follow each other until there are few enough."""
    starts = data.starts
    chosen: Mask = rest.window & rest.fits[:, channel]
    window = np.flatnonzero(chosen)
    count = np.isfinite(data.z[:, channel]).astype(np.float64)
    samples = np.add.reduceat(count, starts[:-1])[window]
    middle = data.seconds[(starts[window] + starts[window + 1] - 1) // 2]
    group = np.arange(len(window)) * min(MAX_PARTS, len(window)) // max(len(window), 1)
    first = np.searchsorted(group, np.arange(group[-1] + 1))
    total = np.add.reduceat(samples, first)
    value = np.add.reduceat(samples * rest.mean[window, channel], first) / total
    noise = level[channel] ** 2 / total * _colour(rest.mean[window, channel], samples, window, level[channel])
    return _Parts(np.add.reduceat(samples * middle, first) / total, value, noise)


def _colour(mean: Array, samples: Array, window: Index, level: float) -> float:
    """How many times larger the variance of means (K,) over windows is than white noise would have it, 1 at least."""
    pairs = np.diff(window) == 1
    if pairs.sum() < LEAST_PAIRS:
        return 1.0
    apart = 1.4826 * float(np.median(np.abs(np.diff(mean)[pairs])))
    ratio = apart**2 / 2 * float(np.median(samples)) / level**2
    return ratio if ratio > COLOURED else 1.0


def _covariance(part: _Parts, walk: float) -> Array:
    """Of the values, up to what their common level adds: minus the variogram, plus the noise."""
    apart = np.abs(part.time[:, None] - part.time)
    # The constant makes it positive definite; contrasts do not see it.
    return walk**2 / 2 * (2 * np.ptp(part.time) + 1.0 - apart) + np.diag(part.noise)


def _log_likelihood(part: _Parts, walk: float) -> float:
    """Restricted log-likelihood of a walk."""
    factor = cho_factor(_covariance(part, walk))
    ones = np.ones(len(part.time))
    inverse_ones = cho_solve(factor, ones)
    information = ones @ inverse_ones
    level = inverse_ones @ part.value / information
    centred = part.value - level
    log_determinant = 2 * np.log(np.diag(factor[0])).sum() + np.log(information)
    return float(-0.5 * (log_determinant + centred @ cho_solve(factor, centred)))


def _evidence(parts: list[_Parts], walk: float) -> tuple[bool, float]:
    """Whether the parts show the walk that suits them best, and how large it may be."""
    parts = [part for part in parts if len(part.time) > 2]

    def likelihood(q: float) -> float:
        return sum(_log_likelihood(part, q) for part in parts)

    if not parts:
        return False, np.inf
    top = likelihood(max(walk, SMALLEST_WALK))
    tried = np.geomspace(max(walk, 1e-6), LARGEST_WALK, 30)
    possible = next((float(q) for q in tried if likelihood(float(q)) < top - POSSIBLE), LARGEST_WALK)
    return top - likelihood(SMALLEST_WALK) > OWN_WALK, possible


def _best_walk(parts: list[_Parts]) -> float:
    """Walk that suits all channels best, 0 where nothing speaks for one."""
    parts = [part for part in parts if len(part.time) > 2]
    if not parts:
        return 0.0

    def loss(log_walk: float) -> float:
        return -sum(_log_likelihood(part, float(np.exp(log_walk))) for part in parts)

    found = minimize_scalar(loss, bounds=(np.log(SMALLEST_WALK), np.log(LARGEST_WALK)), method="bounded")
    walk = float(np.exp(found.x))
    return walk if found.fun < loss(np.log(SMALLEST_WALK)) else 0.0


def _own_walk(part: _Parts, common: float) -> float:
    own = _best_walk([part])
    gain = _log_likelihood(part, own) - _log_likelihood(part, common) if len(part.time) > 2 else 0.0
    return own if gain > OWN_WALK else common


def _kriged(part: _Parts, walk: float, time: Array) -> tuple[float, float, Array]:
    """Average over the times, its standard error, and the estimate at each of them (T,)."""
    factor = cho_factor(_covariance(part, walk))
    constant = walk**2 / 2 * (2 * np.ptp(part.time) + 1.0)
    to_parts = constant - walk**2 / 2 * np.abs(time[:, None] - part.time)
    ones = np.ones(len(part.time))
    inverse_ones = cho_solve(factor, ones)
    information = ones @ inverse_ones
    level = float(inverse_ones @ part.value / information)
    course = level + to_parts @ cho_solve(factor, part.value - level)
    mean_to_parts = to_parts.mean(axis=0)
    among = constant - walk**2 / 2 * np.abs(time[:, None] - time).mean()
    lack = 1 - mean_to_parts @ inverse_ones
    variance = among - mean_to_parts @ cho_solve(factor, mean_to_parts) + lack**2 / information
    return float(course.mean()), float(np.sqrt(max(variance, 0.0))), course
