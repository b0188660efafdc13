# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

r"""Noise that channels have together: vibration. From it follow the weights, the published covariance and the outliers.

The variances v of `fdi_ros.estimator.noise` take channels for independent. Vibration is not: units see one rotation of
the body with gains and phases of their own, or each channel a line of its own, and no v explains what the parity shows
of it. So here the covariance R of the innovations about their mean of half a second is measured, over a second, and
what of it channels of variances v would not show. With ``A = V^-1 - V^-1 H (H' V^-1 H)^-1 H' V^-1``, ``G`` the gain of
the rate, ``E = I - H pinv(H)`` and k = n - 3:

- level ``q = tr(A R) / k``: noise of any colour beyond v, whose differences of neighbours do not show it;
- dimensions ``tr(A R)^2 / tr(A R A R)``: k where channels are independent, two of a line, however many channels it has;
- coherence ``sum c_i' Q^-1 c_i / sum d_i``, with ``Q``, ``c_i``, ``d_i`` the mean products of G d and (A d)_i of fourth
  differences d: what channels differ by goes with what they have in common; of independent ones never;
- vibration s of the body, of the same differences and of the rate within a block: units differ in what they make of it.

A line has two dimensions, of which the parity shows k in n each: where dimensions or coherence say so, the variance of
every channel is at least ``tr(E R) / (k - 1)``, the mean of its posterior. And at least `UNEQUAL`^2 of the vibration
along it, for parity does not show by how much all units are wrong.

Where two parallel channels differ, the parity knows the sum of their variances alone; the correlation of what they
differ by with what they have in common, ``(G' Q^-1 c)_i / A_ii``, tells which is noisier (the likelihood of the full
covariance ``H M H' + V`` with M profiled out).
"""

from __future__ import annotations

import math

from fdi_ros.compiling.compiled import compiled
from fdi_ros.core.parity import apply_gain, fill_parity, invert
from fdi_ros.estimator.estimator import Constants, Estimator
from fdi_ros.estimator.noise import BURST, FAR, PAST, THREE_SIGMA, SharedNoise
from fdi_ros.model.samples import Array

MEMORY = 2.0  # half seconds that everything here is a mean of
LINE = (
    1.0 / 6.0
)  # excess of the inverse of the dimensions where all is a line: two dimensions in a parity of three
INCOHERENT = 0.25  # squared correlation that chance reaches in a second
COHERENT = 1.0 - INCOHERENT  # from which all is coherent: as far from one
STEADY = 4.0
"""Energy of the differences of the rate, over that of noise, up to which the variances follow it: motion of which
parallel channels see a tenth more or less makes a variance wrong by a sixth there."""
UNEQUAL = 0.15  # by how much units see vibration differently; logs show 0.04 to 0.6
INDEPENDENT = (
    4.0  # values of a block that are independent of one another: all four at 100 Hz
)
MOST_CHECKED = 250.0  # blocks (10 s) that the level while checked is a mean of
NEAR_SINGULAR = 1e-3  # share added to Q, and of 1e-11 (rad/s)^2: there may be an axis about which nothing is measured


@compiled
def begin_shared(shared: SharedNoise, n: int, expected: Array) -> None:
    """Begin with independent channels of the variances expected (n,), (rad/s)^2; ``shared`` is all zero."""
    shared.excess = 1.0
    for i in range(n):
        shared.level[i] = shared.outer[i, i] = expected[i]
        shared.ones[i] = 1.0
    for a in range(3):
        shared.inverse[a, a] = 1.0


@compiled
def update_shared(params: Constants, kf: Estimator) -> None:
    """Take the innovations of a sample and, every 20 ms, fourth differences of the corrected values."""
    shared = kf.shared
    if kf.judged:
        update_covariance(params, kf)
    for a in range(3):
        shared.rate_sum[a] += kf.rate[a]
        shared.rate_squares[a] += kf.rate[a] * kf.rate[a]
    if shared.fresh % params.stride == 0:
        if shared.fresh >= PAST * params.stride:
            add_fourth_difference(params, kf)
        for i in range(params.sensors.n):
            for k in range(PAST - 1, 0, -1):
                shared.past[k, i] = shared.past[k - 1, i]
            shared.past[0, i] = kf.corrected[i]
    shared.fresh += 1


@compiled
def update_covariance(params: Constants, kf: Estimator) -> None:
    """Take the innovations about their mean of half a second into R; what is absent leaves its rows as they are."""
    shared, n, largest = kf.shared, params.sensors.n, 0.0
    for i in range(n):
        largest = max(largest, abs(kf.statistic[i]))
    half = params.length / params.adaptation_gain
    shared.count = min(shared.count + 1.0, MEMORY * half)
    share = min(1.0, (math.sqrt(FAR) / max(largest, 1.0)) ** 2)
    for i in range(n):
        if shared.kept >> i & 1:
            innovation = kf.innovation[i] - shared.local[i]
            shared.local[i] += innovation / half
            shared.difference[i] = innovation
            for j in range(i + 1):
                if shared.kept >> j & 1:
                    shared.outer[i, j] += (
                        share * innovation * shared.difference[j] - shared.outer[i, j]
                    ) / shared.count


@compiled
def add_fourth_difference(params: Constants, kf: Estimator) -> None:
    """Sum the products of what channels have in common and what they differ by, of one fourth difference.

    Of white noise its standard deviation is that of the values times the root of 70.
    """
    shared, n = kf.shared, params.sensors.n
    past = shared.past
    for i in range(n):
        shared.difference[i] = 0.0
        if shared.kept >> i & 1:
            ends = kf.corrected[i] + past[3, i]
            shared.difference[i] = (
                ends - 4.0 * (past[0, i] + past[2, i]) + 6.0 * past[1, i]
            ) / math.sqrt(70.0)
    apply_gain(shared.alone.gain, n, shared.difference, shared.common)
    size = 0.0
    for a in range(3):
        for b in range(3):
            size += shared.common[a] * shared.inverse[a, b] * shared.common[b]
            shared.common_sum[a, b] += shared.common[a] * shared.common[b]
    share = min(1.0, THREE_SIGMA / max(size, 1e-12))
    shared.taken += 1
    for i in range(n):
        if shared.kept >> i & 1:
            apart = 0.0
            for j in range(n):
                apart += shared.alone.information[i, j] * shared.difference[j]
            shared.apart_sum[i] += share * apart * apart
            for a in range(3):
                shared.mixed_sum[a, i] += share * shared.common[a] * apart


@compiled
def update_shape(params: Constants, kf: Estimator) -> None:
    """Work out the parity of the channels in use by their noise alone: once a block, and as they change.

    What was measured of others before stands: missing channels make no noise smaller. At rest, and in motion, R begins
    anew with the variances of that time.
    """
    shared, n, noise = kf.shared, params.sensors.n, kf.noise
    kept = kf.mask & ~kf.excluded_from_rate & ~kf.beyond
    if not params.spans[kept]:
        kept = kf.mask
    if kept == shared.kept and kf.filled > 0:
        return
    fill_parity(shared.alone, params.sensors, kept, noise.now.sample)
    if kept != shared.kept:
        # Differences are of samples of the same channels.
        shared.kept, shared.fresh = kept, 0
        fill_parity(shared.even, params.sensors, kept, shared.ones)
    if noise.regime != shared.regime:
        shared.regime, shared.count = (
            noise.regime,
            0.5 * params.length / params.adaptation_gain,
        )
        for i in range(n):
            shared.local[i] = 0.0
            for j in range(n):
                shared.outer[i, j] = noise.now.sample[i] if i == j else 0.0


@compiled
def update_shared_level(params: Constants, kf: Estimator) -> None:
    """Find the variance of each channel now, with all that independent channels do not explain; once a block."""
    shared, n, noise, k = kf.shared, params.sensors.n, kf.noise, -3.0
    for i in range(n):
        k += shared.kept >> i & 1
    coherent = update_coherence(params, kf)
    update_vibration(params, kf)
    pooled = 0.0
    if k > 0.0:
        coherent = max(coherent, update_dimensions(params, kf, k))
        for i in range(n):
            for j in range(i + 1):
                pooled += (
                    (1.0 if i == j else 2.0)
                    * shared.even.information[i, j]
                    * shared.outer[i, j]
                )
        pooled /= max(k - 1.0, 0.5)
    shared.coherent = coherent
    blocks = min(shared.checked_blocks[noise.regime] + 1.0, MOST_CHECKED)
    if k > 0.0:
        shared.checked_blocks[noise.regime] = blocks
    share = 1.0 / blocks
    for i in range(n):
        level = noise.now.sample[i] * max(1.0, BURST * noise.quick[i], shared.excess)
        seen = 0.0
        for a in range(3):
            seen += (
                params.sensors.axes[i, a]
                * params.sensors.axes[i, a]
                * shared.vibration[a]
            )
        if k > 0.0:
            level = max(level, noise.now.sample[i] + UNEQUAL * UNEQUAL * seen)
            level += coherent * max(pooled - level, 0.0)
            before = shared.checked[noise.regime, i]
            shared.checked[noise.regime, i] += share * (level - before)
        else:
            # Without redundancy vibration of the body and of one sensor look alike.
            level = max(level, noise.now.sample[i] + seen)
            level = max(level, shared.checked[noise.regime, i])
        shared.level[i] = level


@compiled
def update_line(params: Constants, kf: Estimator) -> None:
    """Remember what of R is a line, while nothing is suspicious: the onset of a fault is in R for a second."""
    shared, adaptation_gain = kf.shared, params.adaptation_gain / MEMORY
    for i in range(params.sensors.n):
        for j in range(params.sensors.n):
            now = shared.coherent * shared.outer[max(i, j), min(i, j)]
            shared.line[i, j] += adaptation_gain * (now - shared.line[i, j])


@compiled
def update_dimensions(params: Constants, kf: Estimator, k: float) -> float:
    """Find the level of R over that of the variances; return the share of it that is a line, by its dimensions."""
    shared, n, first, second = kf.shared, params.sensors.n, 0.0, 0.0
    product = kf.block_parity.weight
    for i in range(n):
        for j in range(i):
            shared.outer[j, i] = shared.outer[i, j]
    for i in range(n):
        for j in range(n):
            total = 0.0
            for m in range(n):
                total += shared.alone.information[i, m] * shared.outer[m, j]
            product[i, j] = total
        first += product[i, i]
    for i in range(n):
        for j in range(n):
            second += product[i, j] * product[j, i]
    shared.excess = max(first / k, 1.0)
    chance = (k + 1.0) * params.length / (k * INDEPENDENT * shared.count)
    excess = second / max(first * first, 1e-30) - 1.0 / k - chance
    return min(max(excess / LINE, 0.0), 1.0)


@compiled
def update_coherence(params: Constants, kf: Estimator) -> float:
    """Take the products of a block into their means, and what they say of each variance; return the coherent share."""
    shared, n, noise = kf.shared, params.sensors.n, kf.noise
    adaptation_gain, count = (
        params.adaptation_gain / MEMORY if shared.taken else 0.0,
        max(shared.taken, 1),
    )
    steady = update_common(shared, adaptation_gain, count) < STEADY
    explained = total = 0.0
    for i in range(n):
        noise.cross[i] = along = 0.0
        shared.apart[i] += adaptation_gain * (
            shared.apart_sum[i] / count - shared.apart[i]
        )
        for a in range(3):
            shared.mixed[a, i] += adaptation_gain * (
                shared.mixed_sum[a, i] / count - shared.mixed[a, i]
            )
            shared.mixed_sum[a, i] = 0.0
        for a in range(3):
            for b in range(3):
                part = shared.inverse[a, b] * shared.mixed[b, i]
                explained += shared.mixed[a, i] * part
                along += shared.alone.gain[a, i] * part
        total += shared.apart[i]
        shared.apart_sum[i] = 0.0
        if steady and shared.alone.information[i, i] > 0.0:
            noise.cross[i] = min(
                max(2.0 * along / shared.alone.information[i, i], -THREE_SIGMA),
                THREE_SIGMA,
            )
    shared.taken = 0
    return min(
        max(
            (explained / max(total, 1e-30) - INCOHERENT) / (COHERENT - INCOHERENT), 0.0
        ),
        1.0,
    )


@compiled
def update_common(shared: SharedNoise, adaptation_gain: float, count: int) -> float:
    """Take what channels have in common into Q, and invert it; return its energy over that of noise."""
    over = 0.0
    for a in range(3):
        for b in range(3):
            shared.square[a, b] += adaptation_gain * (
                shared.common_sum[a, b] / count - shared.square[a, b]
            )
            shared.common_sum[a, b] = 0.0
            over += (
                shared.alone.normal[max(a, b), min(a, b)] * shared.square[a, b] / 3.0
            )
            shared.factor[a, b] = shared.square[a, b]
        shared.factor[a, a] = (
            shared.factor[a, a] * (1.0 + NEAR_SINGULAR) + NEAR_SINGULAR * 1e-11
        )
    invert(shared.factor, 3, shared.inverse)
    return over


@compiled
def update_vibration(params: Constants, kf: Estimator) -> None:
    """Find the mean square of the vibration of the body about each axis: what of the rate is too quick for motion."""
    shared, length = kf.shared, float(params.length)
    for a in range(3):
        noise, within = shared.alone.inverse[a, a], 0.0
        if length > 2.0 and kf.blocks > 0:
            # About a line through the samples of the block.
            slope = kf.rates[0, a] - kf.rates[1, a]
            about = (
                shared.rate_squares[a]
                - shared.rate_sum[a] * shared.rate_sum[a] / length
            )
            within = (
                about - slope * slope * (length * length - 1.0) / (12.0 * length)
            ) / (length - 2.0)
        shared.within[a] += (
            params.adaptation_gain / MEMORY * (within - shared.within[a])
        )
        shared.rate_sum[a] = shared.rate_squares[a] = 0.0
        shared.vibration[a] = max(
            shared.within[a] - noise, shared.square[a, a] - noise, 0.0
        )
