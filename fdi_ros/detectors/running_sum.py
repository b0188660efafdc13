"""One-sided running sums kept between zero and a cap, over a block at once and equal for every cut of the stream.

``S_t = min(cap, max(0, S_{t-1} + d_t))`` in whole numbers: sums of integers do not depend on how they are grouped,
so a block of any length gives the same S to the last bit, and the cap keeps S bounded after ten hours of drift.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from fdi_ros.errors import ConfigError

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

_erfc = np.frompyfunc(math.erfc, 1, 1)


def bounded_sums(start: Integers, steps: Integers, cap: int) -> Integers:
    """Return the running sums S (k, N) from their start values (k,) and steps d (k, N)."""
    total = np.add.accumulate(steps, axis=1)
    total += start[:, None]
    sums = total - np.minimum(np.minimum.accumulate(total, axis=1), 0)
    # As long as a sum stays below the cap, the cap changes nothing; the few that reach it are done again.
    capped = (sums.max(axis=1) > cap).nonzero()[0]
    if len(capped):
        sums[capped] = _composed(start[capped], steps[capped], cap)
    return sums


def _composed(start: Integers, steps: Integers, cap: int) -> Integers:
    """As `bounded_sums`, by composing the maps x -> clip(x + shift, low, high) pairwise, log2(N) times.

    Two such maps one after the other are again one: that makes the recursion a prefix scan.
    """
    shift, low, high = steps.copy(), np.zeros_like(steps), np.full_like(steps, cap)
    distance = 1
    while distance < steps.shape[1]:
        before, after = np.s_[:, :-distance], np.s_[:, distance:]
        floor, ceiling = low[after].copy(), high[after].copy()
        low[after], high[after] = (
            np.clip(low[before] + shift[after], floor, ceiling),
            np.clip(high[before] + shift[after], floor, ceiling),
        )
        shift[after] = shift[after] + shift[before]
        distance *= 2
    return np.clip(start[:, None] + shift, low, high)


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
        raise ConfigError(f"run length is {run_length:.4g} samples a sum, expected above {shortest:.3g}")
    # ln(1 + x + 2 k^2 L) is close from below; expm1(x) - x is convex, so Newton converges from there.
    target = 2 * reference**2 * run_length
    x = math.log1p(target)
    for _ in range(20):
        x += (target + x - math.expm1(x)) / math.expm1(x)
    return x / (2 * reference) - mean_overshoot(reference)


def _tail(x: Array) -> Array:
    return np.asarray(_erfc(x), dtype=np.float64)
