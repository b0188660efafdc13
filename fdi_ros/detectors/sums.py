# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Evidence at four time scales: Shiryaev-Roberts sums over channels, signs and sizes of a fault.

The values are innovations of samples, blocks and longer times. For a large sum, the onset
of the fault is estimated, and its size relative to the scatter since the onset.
"""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import (
    MAX_CHANNELS,
    Channels,
    Real,
    Whole,
    compiled,
    record,
)
from fdi_ros.estimator.estimator import Constants, Estimator
from fdi_ros.estimator.noise import (
    BLOCK,
    BURST_FACTOR,
    FAR,
    LONG,
    SAMPLE,
    SCALES,
    update_block_noise,
    update_long_noise,
    update_sample_noise,
)
from fdi_ros.estimator.shared_noise import update_shared
from fdi_ros.model.samples import Array

SIZES, KEPT = 6, 64
"""Number of sizes of a fault, and of stored values of each time scale."""
#: Blocks in a value of each time scale. The first one has samples.
BLOCKS_PER_VALUE = (0, 1, 6, 48)
SMALLEST = 0.2
"""Smallest size of a fault, in standard deviations at its time scale. Each further size is
twice as large, up to 6.4. Sizes in between cost at most 11 % of the delay, and smaller
faults are found at a longer time scale."""
#: Number of sizes left out at the longest time scale: below 0.8 is a walk of the bias.
FIRST_LONG = 2
#: Values are limited to this many standard deviations (Huber 1965).
STEP_LIMIT = 7.0
#: Sums are limited to this multiple of the threshold, so that past faults fade.
CEILING = 1e6
Sums = Annotated[NDArray[np.float64], "f8", (2, MAX_CHANNELS, SIZES)]
Series = Annotated[NDArray[np.float64], "f8", (KEPT, MAX_CHANNELS)]
Firsts = Annotated[NDArray[np.int64], "i8", (KEPT,)]


@record
class Scale:
    """Evidence of one time scale."""

    filled: Whole  # blocks in the value being filled
    values: Channels  # sum of A y over these blocks, s/rad
    information: Channels  # sum of A_ii over these blocks, s^2/rad^2
    newest: Whole  # index of the last value
    kept: Whole  # number of stored values
    series: Series  # values, in standard deviations
    first: Firsts  # number of the first sample in each value
    sums: Sums  # by sign, channel and size
    total: Real  # of all sums


Scales = Annotated[list[Scale], SCALES]


@compiled
def add_evidence(
    params: Constants, kf: Estimator, scale: Scale, at: int, first_sample: int
) -> None:
    """Add the last values y of a time scale to its sums, R <- (1 + R) exp(s y - s^2 / 2)."""
    first = FIRST_LONG if at == LONG else 0
    ceiling = CEILING * params.limit
    scale.first[scale.newest] = first_sample
    scale.kept = min(scale.kept + 1, KEPT)
    scale.total = 0.0
    for i in range(params.sensors.n):
        if not kf.judged >> i & 1:
            continue
        y = scale.series[scale.newest, i]
        cap = kf.noise.cap[at, i]
        for side in range(2):
            sums = scale.sums[side, i]
            total = 0.0
            size = SMALLEST
            along = y if side == 0 else -y
            factor = math.exp(SMALLEST * min(along, STEP_LIMIT))
            for k in range(SIZES):
                if k >= first:
                    sums[k] = min(
                        (1.0 + sums[k])
                        * min(factor * math.exp(-0.5 * size * size), cap),
                        ceiling,
                    )
                    total += sums[k]
                factor *= factor
                size *= 2.0
            scale.total += total


@compiled
def value_at(scale: Scale, back: int, i: int) -> float:
    """Return the value of channel i that is ``back`` values before the last one."""
    return scale.series[(scale.newest - back + KEPT) % KEPT, i]


@compiled
def scatter_of(scale: Scale, i: int, sign: float, count: int, mean: float) -> float:
    """Return the variance of a mean of the last values, times their number.

    The larger estimate counts, from single values or from batches.
    """
    worst = 0.0
    size = 1
    while count // size >= 4 or size == 1:
        batches = count // size
        squares = 0.0
        for b in range(batches):
            total = 0.0
            for k in range(b * size, (b + 1) * size):
                total += sign * value_at(scale, k, i) - mean
            squares += total * total
        worst = max(worst, squares / size / max(batches - 1.0, 1.0))
        size *= 2
    return worst


@compiled
def look_back(
    params: Constants, kf: Estimator, scale: Scale, i: int, sign: float
) -> tuple[int, float]:
    """Estimate the onset of a fault of channel i, and its evidence against the scatter.

    Returns
    -------
    tuple
        Number of values since the onset, and the logarithm of Student's likelihood ratio
        with the degrees of freedom of the learned noise and of the values.
    """
    best = 0.0
    since = 0
    total = 0.0
    for k in range(scale.kept):
        total += sign * value_at(scale, k, i)
        t = total / math.sqrt(k + 1.0)
        if t > best:
            best = t
            since = k + 1
    if since < 2:
        return since, 0.0
    mean = best / math.sqrt(since)
    trust = kf.noise.degrees[i]
    squares = 0.0
    count = 0
    for j in range(params.sensors.n):
        if kf.judged >> j & 1:
            count += 1
            for k in range(since - 1):
                step = value_at(scale, k, j) - value_at(scale, k + 1, j)
                squares += min(0.5 * step * step, FAR)
    # A rate explains three dimensions of the channels.
    checks = max(count - 3.0, 1.0)
    pooled = (trust + squares / max(count, 1) * checks) / (
        trust + checks * (since - 1.0)
    )
    degrees = trust + since - 1.0
    scatter = scatter_of(scale, i, sign, since, mean)
    variance = max((trust + (since - 1.0) * scatter) / degrees, pooled)
    return since, 0.5 * (degrees + 1.0) * math.log(
        1.0 + mean * mean * since / variance / degrees
    )


@compiled
def normal_variance(kf: Estimator, i: int) -> float:
    """Return the variance of the statistic of a sample, by recent noise and by slow noise."""
    noise = kf.noise
    slow = noise.now.level[BLOCK, i] * noise.unknown[i] * noise.longest[i]
    return max(1.0, BURST_FACTOR * noise.recent_ratio[i], slow)


@compiled
def update_from_sample(
    params: Constants, kf: Estimator, scales: Scales, learns: bool
) -> None:
    """Update noise and sums with the statistics of a sample."""
    scale = scales[SAMPLE]
    noise = kf.noise
    noise.seen[SAMPLE] += 1.0
    scale.newest = (scale.newest + 1) % KEPT
    for i in range(params.sensors.n):
        scale.series[scale.newest, i] = 0.0
        if kf.judged >> i & 1:
            scale.series[scale.newest, i] = kf.statistic[i] / math.sqrt(
                normal_variance(kf, i)
            )
    update_shared(params, kf)
    update_sample_noise(
        noise,
        params.sensors.n,
        kf.judged,
        kf.statistic,
        kf.inflation,
        learns,
        kf.samples % 2,
    )
    add_evidence(params, kf, scale, SAMPLE, kf.samples)


@compiled
def update_from_block(
    params: Constants, kf: Estimator, scales: Scales, learns: bool
) -> None:
    """Update noise and sums of the longer time scales with the innovations of a block."""
    noise = kf.noise
    n = params.sensors.n
    mask = kf.masks[1] & kf.judged
    information = kf.block_parity.information
    for k in range(1, SCALES):
        scale = scales[k]
        for i in range(n):
            if mask >> i & 1:
                scale.values[i] += kf.block_values[i]
                scale.information[i] += information[i, i]
        scale.filled += 1
        if scale.filled < BLOCKS_PER_VALUE[k]:
            continue
        noise.seen[k] += 1.0
        scale.newest = (scale.newest + 1) % KEPT
        known = 0
        for i in range(n):
            if scale.information[i] > 0.0:
                known |= 1 << i
                scale.values[i] /= math.sqrt(scale.information[i])
        if k == BLOCK:
            update_block_noise(noise, n, known, scale.values, params.expected, learns)
        else:
            update_long_noise(noise, k, n, known, scale.values, learns)
        for i in range(n):
            scale.series[scale.newest, i] = (
                scale.values[i] / math.sqrt(noise.unknown[i]) if known >> i & 1 else 0.0
            )
            scale.values[i] = scale.information[i] = 0.0
        scale.filled = 0
        add_evidence(
            params,
            kf,
            scale,
            k,
            kf.samples - (BLOCKS_PER_VALUE[k] + 1) * params.length + 1,
        )


@compiled
def mean_of(params: Constants, kf: Estimator, scales: Scales) -> float:
    """Return the mean of all sums."""
    total = 0.0
    channels = 0
    for k in range(SCALES):
        total += scales[k].total
    for i in range(params.sensors.n):
        channels += kf.judged >> i & 1
    return total / max(2 * (SCALES * SIZES - FIRST_LONG) * channels, 1)


@compiled
def fill_scores(
    params: Constants, kf: Estimator, scales: Scales, scores: Array
) -> None:
    """Write log(1 + largest sum) of each judged channel to scores (n,), NaN for others."""
    for i in range(params.sensors.n):
        largest = 0.0
        for k in range(SCALES):
            sums = scales[k].sums
            for s in range(SIZES):
                largest = max(largest, sums[0, i, s], sums[1, i, s])
        here = kf.judged & kf.mask & (1 << i)
        scores[i] = math.log(1.0 + largest) if here else math.nan


@compiled
def forget_sums(params: Constants, scales: Scales) -> None:
    """Reset all sums."""
    for k in range(SCALES):
        scale = scales[k]
        scale.kept = scale.filled = 0
        scale.total = 0.0
        for i in range(params.sensors.n):
            scale.values[i] = scale.information[i] = 0.0
            for s in range(SIZES):
                scale.sums[0, i, s] = scale.sums[1, i, s] = 0.0
