# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Mean run length of one-sided running sums ``S_t = max(0, S_{t-1} + w_t - k)``: Siegmund's approximation."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from fdi_ros.errors import ConfigError

Array = NDArray[np.float64]

_erfc = np.frompyfunc(math.erfc, 1, 1)


@lru_cache(maxsize=16)
def mean_overshoot(reference: float) -> float:
    """By how much a sampled running sum is harder to bring to its threshold than a continuous one, on both ends.

    ``-ln nu(2 k) / k`` with ``nu(x) = 2 / x^2 exp(-2 sum_n Phi(-x sqrt(n) / 2) / n)`` (Siegmund, Sequential Analysis,
    1985, eq. 4.37), which is his constant 1.166 for small k and 1.137 at k = 1.
    """
    if reference < 0.1:
        return 1.166
    n = np.arange(1.0, 5000.0)
    tails = float((_tail(reference * np.sqrt(n / 2)) / n).sum())
    return (math.log(2 * reference**2) + tails) / reference


def siegmund_run_length(threshold: float, reference: float) -> float:
    """Mean samples until a sum of standard normal steps less k, from 0, reaches a threshold for the first time.

    Siegmund 1985: ``(exp(2 k b) - 1 - 2 k b) / (2 k^2)`` with b the threshold plus `mean_overshoot`.
    """
    x = 2 * reference * (threshold + mean_overshoot(reference))
    return (math.expm1(x) - x) / (2 * reference**2)


def threshold_for(run_length: float, reference: float, correlation: Array) -> float:
    """Threshold, in standard deviations, of correlated sums for the mean run length to the first false alarm of any.

    Sums whose samples are correlated alarm together at times. Given that one crosses the threshold, its samples
    drift by +k, those of another by ``(2 rho - 1) k``; the other is then at a normally distributed distance D from the
    threshold, ``2 k D`` having mean mu = ``4 (1 - rho) k b`` and variance 2 mu, and goes on to cross it with
    probability exp(-2 k D). The mean of that is ``erfc(sqrt((1 - rho) k b))``. Crossings that are shared count once.

    Parameters
    ----------
    run_length
        Samples, of all sums together.
    reference
        k: what is subtracted from every sample, in standard deviations.
    correlation
        rho between the samples of the sums, (K, K).

    Raises
    ------
    ConfigError
        If the run length is so short that no threshold above zero gives it.
    """
    count, overshoot = len(correlation), mean_overshoot(reference)
    apart = 1 - np.clip(correlation[~np.eye(count, dtype=bool)], -1, 1)
    single, threshold = count * run_length, 0.0
    for _ in range(8):
        threshold = _single_threshold(single, reference)
        b = threshold + overshoot
        shared = float(_tail(np.sqrt(apart * reference * b)).sum()) / count
        effective = count * max(1 - shared / 2, 1 / (1 + shared))
        # A crossing takes b / k samples; of several sums, that time passes only once.
        single = max(effective * (run_length - b / reference) + b / reference, run_length)
    return threshold


def _single_threshold(run_length: float, reference: float) -> float:
    shortest = siegmund_run_length(0.0, reference)
    if run_length <= shortest:
        raise ConfigError(f"run length is {run_length:.4g} samples per sum, expected above {shortest:.3g}")
    # ln(1 + x + 2 k^2 L) is close from below; expm1(x) - x is convex, so Newton converges from there.
    target = 2 * reference**2 * run_length
    x = math.log1p(target)
    for _ in range(20):
        x += (target + x - math.expm1(x)) / math.expm1(x)
    return x / (2 * reference) - mean_overshoot(reference)


def _tail(x: Array) -> Array:
    return np.asarray(_erfc(x), dtype=np.float64)
