"""Random walk of the biases relative to each other, from parity vectors in motion.

Means over windows of a second or more, ``y_k = b(t_k) + e_k``: the errors e of the means are whatever the recording
shows between neighbours (vibration, colour, what is left of the axes' errors), not what white noise would leave. Each
component of the parity vector has its own; the walk is common. Restricted maximum likelihood on contrasts: with the
covariance of a walk diagonalised once, both variances are one-dimensional matters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from fdi_ros.calibration.data import Array

MAX_WINDOWS = 64
SHORTEST = 1.0
"""Windows are at least this long, s: longer than vibration and colour are correlated."""
LEAST_WINDOWS = 8
"""With fewer no walk is told from noise."""
SHOWN = 4.0
"""A walk is shown if it raises the log-likelihood by more."""
POSSIBLE = 2.0
"""It may be as large as lowers the log-likelihood by no more."""
REACH = 5.0
"""Logarithm of the ratio of noises that is searched to either side."""
CLOSE = 0.05
"""Logarithm to which that is found."""
SMALLEST, LARGEST = 1e-7, 1e-1
"""rad/s per square root of a second."""


@dataclass(frozen=True)
class Walk:
    """Course of the parity vector's mean.

    Attributes
    ----------
    walk
        rad/s per square root of a second; 0: none shown.
    possible
        Largest walk that the recording does not rule out, rad/s per square root of a second; infinite: too short.
    time
        (T,) s.
    course
        (T, m) rad/s.
    std
        (m,) standard error of its mean over the recording, rad/s.
    """

    walk: float
    possible: float
    time: Array
    course: Array
    std: Array


def find_walk(seconds: Array, p: Array, duration: float) -> Walk:
    """Find the walk in parity vectors (K, m) rad/s at times (K,) s."""
    length = max(SHORTEST, duration / MAX_WINDOWS)
    number = (seconds / length).astype(np.int64)
    window, first, count = np.unique(number, return_index=True, return_counts=True)
    value = np.add.reduceat(p, first, axis=0) / count[:, None]
    full = count > 0.5 * count.max()
    time, value = (window[full] + 0.5) * length, value[full]
    grid = np.linspace(0.0, duration, 201)
    if len(time) < LEAST_WINDOWS:
        mean = value.mean(axis=0)
        std = value.std(axis=0) / np.sqrt(max(len(time) - 1, 1))
        return Walk(0.0, np.inf, grid, np.tile(mean, (len(grid), 1)), std)
    apart = np.abs(time[:, None] - time)
    contrasts = np.linalg.svd(np.ones((1, len(time))))[2][1:]
    eigen, vectors = np.linalg.eigh(-contrasts @ apart @ contrasts.T / 2)
    y = vectors.T @ contrasts @ value
    noise = np.sqrt(np.mean(y**2, axis=0))

    def given(log_walk: float) -> tuple[float, Array]:
        """Log-likelihood, and noise (m,), with a walk."""
        fitted = _fit(y, eigen, np.log(noise), (log_walk, log_walk))
        return fitted[0], fitted[2]

    top, walk, spread = _fit(y, eigen, np.log(noise), (float(np.log(SMALLEST)), float(np.log(LARGEST))))
    none, alone = given(float(np.log(SMALLEST)))
    shown = top - none > SHOWN
    low, high = np.log(walk), np.log(LARGEST)
    while high - low > CLOSE:
        middle = float((low + high) / 2)
        low, high = (middle, high) if given(middle)[0] > top - POSSIBLE else (low, middle)
    possible = float(np.exp(high))
    q, s = (walk, spread) if shown else (0.0, alone)
    found = [_kriged(time, column, q, sigma, grid) for column, sigma in zip(value.T, s, strict=True)]
    return Walk(q, possible, grid, np.column_stack([c for c, _ in found]), np.array([e for _, e in found]))


def _fit(y: Array, eigen: Array, log_noise: Array, bounds: tuple[float, float]) -> tuple[float, float, Array]:
    """Log-likelihood, walk and noise (m,) that suit contrasts y (K, m) best; eigen (K,) of a walk of size 1."""

    def loss(theta: Array) -> tuple[float, Array]:
        q2, s2 = np.exp(2 * theta[0]), np.exp(2 * theta[1:])
        variance = q2 * eigen[:, None] + s2
        value = 0.5 * float((np.log(variance) + y**2 / variance).sum())
        slope = 0.5 * (1 / variance - y**2 / variance**2)
        return value, 2 * np.concatenate([[q2 * float((slope * eigen[:, None]).sum())], s2 * slope.sum(axis=0)])

    first = float(np.clip(np.median(log_noise) - 0.5 * np.log(eigen.max()), *bounds))
    limits = [bounds, *((level - REACH, level + REACH) for level in log_noise)]
    found = minimize(loss, np.append(first, log_noise), jac=True, method="L-BFGS-B", bounds=limits)
    return -float(found.fun), float(np.exp(found.x[0])), np.exp(found.x[1:])


def _kriged(time: Array, value: Array, walk: float, sigma: float, grid: Array) -> tuple[Array, float]:
    """Course (T,) of one component and the standard error of its mean over the grid, by ordinary kriging."""
    constant = walk**2 / 2 * (2 * np.ptp(time) + 1.0)
    covariance = constant - walk**2 / 2 * np.abs(time[:, None] - time) + sigma**2 * np.eye(len(time))
    across = constant - walk**2 / 2 * np.abs(grid[:, None] - time)
    inverse = np.linalg.inv(covariance)
    ones = np.ones(len(time))
    information = float(ones @ inverse @ ones)
    level = float(ones @ inverse @ value) / information
    course = level + across @ inverse @ (value - level)
    mean = across.mean(axis=0)
    among = constant - walk**2 / 2 * np.abs(grid[:, None] - grid).mean()
    variance = among - mean @ inverse @ mean + (1 - mean @ inverse @ ones) ** 2 / information
    return course, float(np.sqrt(max(variance, 0.0)))
