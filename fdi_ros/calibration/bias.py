# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Biases of the channels over a recording, with a random walk of the bias in the uncertainty.

**With rest** (`bias_at_rest`), of each channel by itself: means over parts at rest, ``y_k = b(t_k) + e_k`` with
``var e_k = level^2 / count_k``, and a bias that walks: ``var(b(s) - b(t)) = walk^2 |s - t|``. Its level at the start is
unknown, so all is done on contrasts: estimates are the best linear unbiased ones (ordinary kriging, variogram
``walk^2 |h| / 2``), the walk is found by maximum restricted likelihood.

**In motion** (`relative_bias`), of the channels relative to each other: means of the parity vector over windows of a
second or more, where the errors e of the means are whatever the recording shows between neighbours (vibration, colour,
what is left of the axes' errors), not what white noise would leave. Each component of the parity vector has its own;
the walk is common. With the covariance of a walk diagonalised once, both variances are one-dimensional problems.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize, minimize_scalar

from fdi_ros.calibration.data import MEDIAN_TO_RMS, Array, Data, Index, Mask
from fdi_ros.calibration.rest import Rest
from fdi_ros.model.geometry import Geometry

MAX_PARTS = 64
"""Means at most: the work grows with their number cubed."""
POINTS = 201
"""Times at which a bias is estimated, evenly over the recording."""
SHOWN_GAIN = 4.0
"""A walk is shown, and a channel has one of its own, if that raises the log-likelihood by more."""
POSSIBLE = 2.0
"""A walk may be as large as lowers the log-likelihood by no more."""
SMALLEST_WALK, LARGEST_WALK = 1e-8, 1e-2
"""Of a channel at rest, rad/s per square root of a second; the smallest is none."""
COLOURED = 1.5
"""Means of neighbouring windows that differ by more than this times what white noise makes of it, squared: colour."""
LEAST_PAIRS = 8
"""Neighbouring windows from which that is taken at least."""
SHORTEST = 1.0
"""Windows in motion are at least this long, s: longer than vibration and colour are correlated."""
LEAST_MEANS = 8
"""With fewer, a walk cannot be distinguished from noise."""
LOG_PARITY_WALKS = (float(np.log(1e-7)), float(np.log(1e-1)))
"""Logarithms of the smallest walk of the parity vector, which is none, and of the largest, of rad/s per sqrt(s)."""
NOISE_REACH = 5.0
"""Logarithm of the ratio of noises that is searched to either side."""
CLOSE = 0.05
"""Logarithm to which the largest possible walk is found."""


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
    curve
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
    curve: Array
    shown: bool
    possible: float

    def at(self, seconds: Array) -> Array:
        """Estimate (N, n) rad/s at times (N,) s."""
        return np.column_stack([np.interp(seconds, self.time, curve) for curve in self.curve.T])


@dataclass(frozen=True)
class _Parts:
    """Means of one channel over parts at rest: times, values, and the variances of their noise, (K,) each."""

    time: Array
    value: Array
    noise: Array


def bias_at_rest(data: Data, rest: Rest, level: Array) -> Bias:
    """Estimate the biases from the windows at rest.

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
    time = np.linspace(0.0, data.duration, POINTS)
    found = [_krige(part, q, time) for part, q in zip(parts, walk, strict=True)]
    return Bias(
        np.array([mean for mean, _, _ in found]),
        np.array([std for _, std, _ in found]),
        walk,
        time,
        np.column_stack([curve for _, _, curve in found]),
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
    apart = MEDIAN_TO_RMS * float(np.median(np.abs(np.diff(mean)[pairs])))
    ratio = apart**2 / 2 * float(np.median(samples)) / level**2
    return ratio if ratio > COLOURED else 1.0


def _covariance(part: _Parts, walk: float) -> Array:
    """Of the values, up to what their common level adds: minus the variogram, plus the noise."""
    apart = np.abs(part.time[:, None] - part.time)
    # The constant makes it positive definite; contrasts do not depend on it.
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
    """Return whether the parts show the walk that suits them best, and how large it may be."""
    parts = [part for part in parts if len(part.time) > 2]

    def likelihood(q: float) -> float:
        return sum(_log_likelihood(part, q) for part in parts)

    if not parts:
        return False, np.inf
    top = likelihood(max(walk, SMALLEST_WALK))
    tried = np.geomspace(max(walk, 1e-6), LARGEST_WALK, 30)
    possible = next((float(q) for q in tried if likelihood(float(q)) < top - POSSIBLE), LARGEST_WALK)
    return top - likelihood(SMALLEST_WALK) > SHOWN_GAIN, possible


def _best_walk(parts: list[_Parts]) -> float:
    """Walk that suits all channels best, 0 where the likelihood is no higher with one."""
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
    return own if gain > SHOWN_GAIN else common


def _krige(part: _Parts, walk: float, time: Array) -> tuple[float, float, Array]:
    """Average over the times, its standard error, and the estimate at each of them (T,)."""
    factor = cho_factor(_covariance(part, walk))
    constant = walk**2 / 2 * (2 * np.ptp(part.time) + 1.0)
    to_parts = constant - walk**2 / 2 * np.abs(time[:, None] - part.time)
    ones = np.ones(len(part.time))
    inverse_ones = cho_solve(factor, ones)
    information = ones @ inverse_ones
    level = float(inverse_ones @ part.value / information)
    curve = level + to_parts @ cho_solve(factor, part.value - level)
    mean_to_parts = to_parts.mean(axis=0)
    among = constant - walk**2 / 2 * np.abs(time[:, None] - time).mean()
    lack = 1 - mean_to_parts @ inverse_ones
    variance = among - mean_to_parts @ cho_solve(factor, mean_to_parts) + lack**2 / information
    return float(curve.mean()), float(np.sqrt(max(variance, 0.0))), curve


def relative_bias(data: Data, together: Array, geometry: Geometry, common: Array | None) -> Bias:
    """Estimate the biases of the channels relative to each other in motion.

    Parameters
    ----------
    data
        The recording.
    together
        (N, n) band-limited channels with the delays taken off, rad/s; NaN where there are none.
    geometry
        Calibrated axes.
    common
        (n,) biases at rest, rad/s, that fix what all have in common; None: left zero.
    """
    V = geometry.parity
    rows = np.isfinite(together).all(axis=1)
    parity = _parity_mean(data.seconds[rows], together[rows] @ V.T, data.duration)
    # Of all biases with these disagreements the smallest: the rest is a rotation of the whole.
    base = np.zeros(geometry.n) if common is None else geometry.axes @ (geometry.least_squares @ common)
    curve = parity.curve @ V + base
    error = np.sqrt(np.maximum((V**2).T @ parity.std**2, 0))
    walk = np.full(geometry.n, parity.walk)
    return Bias(curve.mean(axis=0), error, walk, parity.time, curve, parity.walk > 0, parity.possible)


@dataclass(frozen=True)
class _ParityMean:
    """Mean of the parity vector over time.

    Attributes
    ----------
    walk
        rad/s per square root of a second; 0: none shown.
    possible
        Largest walk that the recording does not rule out, rad/s per square root of a second; infinite: too short.
    time
        (T,) s.
    curve
        (T, m) estimate at these times, rad/s.
    std
        (m,) standard error of its mean over the recording, rad/s.
    """

    walk: float
    possible: float
    time: Array
    curve: Array
    std: Array


def _parity_mean(seconds: Array, p: Array, duration: float) -> _ParityMean:
    """Estimate the mean of parity vectors (K, m) rad/s at times (K,) s, and its walk."""
    length = max(SHORTEST, duration / MAX_PARTS)
    number = (seconds / length).astype(np.int64)
    window, first, count = np.unique(number, return_index=True, return_counts=True)
    value = np.add.reduceat(p, first, axis=0) / count[:, None]
    full = count > 0.5 * count.max()
    time, value = (window[full] + 0.5) * length, value[full]
    grid = np.linspace(0.0, duration, POINTS)
    if len(time) < LEAST_MEANS:
        mean = value.mean(axis=0)
        std = value.std(axis=0) / np.sqrt(max(len(time) - 1, 1))
        return _ParityMean(0.0, np.inf, grid, np.tile(mean, (len(grid), 1)), std)
    apart = np.abs(time[:, None] - time)
    contrasts = np.linalg.svd(np.ones((1, len(time))))[2][1:]
    eigen, vectors = np.linalg.eigh(-contrasts @ apart @ contrasts.T / 2)
    y = vectors.T @ contrasts @ value
    noise = np.sqrt(np.mean(y**2, axis=0))

    def given(log_walk: float) -> tuple[float, Array]:
        """Log-likelihood, and noise (m,), with a walk."""
        fitted = _fit_walk(y, eigen, np.log(noise), (log_walk, log_walk))
        return fitted[0], fitted[2]

    top, walk, spread = _fit_walk(y, eigen, np.log(noise), LOG_PARITY_WALKS)
    none, alone = given(LOG_PARITY_WALKS[0])
    shown = top - none > SHOWN_GAIN
    low, high = np.log(walk), LOG_PARITY_WALKS[1]
    while high - low > CLOSE:
        middle = float((low + high) / 2)
        low, high = (middle, high) if given(middle)[0] > top - POSSIBLE else (low, middle)
    possible = float(np.exp(high))
    q, s = (walk, spread) if shown else (0.0, alone)
    found = [_krige_mean(time, column, q, sigma, grid) for column, sigma in zip(value.T, s, strict=True)]
    return _ParityMean(q, possible, grid, np.column_stack([c for c, _ in found]), np.array([e for _, e in found]))


def _fit_walk(y: Array, eigen: Array, log_noise: Array, bounds: tuple[float, float]) -> tuple[float, float, Array]:
    """Log-likelihood, walk and noise (m,) that suit contrasts y (K, m) best; eigen (K,) of a walk of size 1."""

    def loss(theta: Array) -> tuple[float, Array]:
        q2, s2 = np.exp(2 * theta[0]), np.exp(2 * theta[1:])
        variance = q2 * eigen[:, None] + s2
        value = 0.5 * float((np.log(variance) + y**2 / variance).sum())
        slope = 0.5 * (1 / variance - y**2 / variance**2)
        return value, 2 * np.concatenate([[q2 * float((slope * eigen[:, None]).sum())], s2 * slope.sum(axis=0)])

    first = float(np.clip(np.median(log_noise) - 0.5 * np.log(eigen.max()), *bounds))
    limits = [bounds, *((level - NOISE_REACH, level + NOISE_REACH) for level in log_noise)]
    found = minimize(loss, np.append(first, log_noise), jac=True, method="L-BFGS-B", bounds=limits)
    return -float(found.fun), float(np.exp(found.x[0])), np.exp(found.x[1:])


def _krige_mean(time: Array, value: Array, walk: float, sigma: float, grid: Array) -> tuple[Array, float]:
    """Curve (T,) of one component and the standard error of its mean over the grid, by ordinary kriging."""
    constant = walk**2 / 2 * (2 * np.ptp(time) + 1.0)
    covariance = constant - walk**2 / 2 * np.abs(time[:, None] - time) + sigma**2 * np.eye(len(time))
    across = constant - walk**2 / 2 * np.abs(grid[:, None] - time)
    inverse = np.linalg.inv(covariance)
    ones = np.ones(len(time))
    information = float(ones @ inverse @ ones)
    level = float(ones @ inverse @ value) / information
    curve = level + across @ inverse @ (value - level)
    mean = across.mean(axis=0)
    among = constant - walk**2 / 2 * np.abs(grid[:, None] - grid).mean()
    variance = among - mean @ inverse @ mean + (1 - mean @ inverse @ ones) ** 2 / information
    return curve, float(np.sqrt(max(variance, 0.0)))
