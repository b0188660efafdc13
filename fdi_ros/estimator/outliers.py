# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Outliers, which are too far off for their sample, and spikes, which are outliers of a few samples.

The first hypothesis that leaves only noise explains an outlier: one channel, then one unit.
Parity cannot distinguish some hypotheses, as with two parallel units. Then the one that
changes the rate least since the last sample is taken, if by far. Otherwise all their
channels are excluded. A spike is counted and kept out of the estimated rate, the blocks and
the learned vibration. The evidence for faults uses all values unchanged.
"""

from __future__ import annotations

import math

from fdi_ros.compiling.compiled import compiled
from fdi_ros.core.parity import UNKNOWN_RATE, apply_gain, fill_joint_parity
from fdi_ros.estimator.estimator import (
    LEAST_GAP,
    Constants,
    Estimator,
    correct_sample,
    excess_over_usual,
    motion_ratio,
    usual_chi,
)
from fdi_ros.estimator.noise import BURST_FACTOR, FAR, THREE_SIGMA
from fdi_ros.model.samples import Array

OUTLIER = 5.5  # standard deviations, reached by normal noise in one of 2e7 values
# share of the largest distance from which a channel is also a candidate
CANDIDATE_SHARE = 0.95
# longest spike: re-stamping spreads a single value over its neighbours
SPIKE_SAMPLES = 4
SPIKE_MISFIT = 1e-4
"""Share of the chi-square that a true hypothesis may leave: 1 % of the spike shows in other
channels, because their scale errors were corrected at a rate that contains the spike."""
# ratio of squared changes of the rate below which the smaller one decides
CLOSER = 0.25


@compiled
def find_outliers(params: Constants, kf: Estimator, values: Array) -> None:
    """Find the outliers of a sample, and correct the sample without possible spikes."""
    kf.outliers = kf.spiked = 0
    if stays_in_doubt(params, kf):
        # The faulty channels alone may have given this rate: nothing is learned from it.
        kf.spiked = kf.mask
        for i in range(params.sensors.n):
            kf.imputed[i] = kf.corrected[i]
        return
    burst = 1.0
    farthest = 0.0
    for i in range(params.sensors.n):
        kf.imputed[i] = kf.corrected[i]
        burst = max(burst, excess_of(kf, i))
        farthest = max(farthest, kf.distance[i])
    if largest_of(params, kf, 1.0) <= OUTLIER:
        end_spike(params, kf)
        return
    candidates = 0
    for i in range(params.sensors.n):
        # The distance of the culprit is the largest (Cauchy and Schwarz).
        if kf.distance[i] > CANDIDATE_SHARE * farthest:
            candidates |= 1 << i
    if kf.far_samples >= SPIKE_SAMPLES:
        # A lasting deviation is no spike: the evidence decides which channels are wrong.
        ratio = motion_ratio(kf, kf.rate)
        if largest_of(params, kf, ratio) > OUTLIER:
            kf.outliers = candidates
            kf.far_samples += 1
        else:
            end_spike(params, kf)
        return
    explain_outliers(params, kf, values, candidates, burst)


@compiled
def stays_in_doubt(params: Constants, kf: Estimator) -> bool:
    """Update the doubt about each channel. Return whether a sample in doubt is not checked at all.

    All channels that disagree with a fault may be missing between its first samples.
    """
    doubted = False
    for i in range(params.sensors.n):
        if kf.judged >> i & 1:
            square = kf.distance[i] * kf.distance[i]
            usual = excess_of(kf, i) * kf.share[i] * kf.inflation[i]
            far = square > OUTLIER * OUTLIER * usual
            kf.doubt[i] = square / kf.parity.information[i, i] if far else 0.0
        elif kf.mask >> i & 1:
            doubted = doubted or kf.doubt[i] > 0.0
    if kf.judged:
        kf.judged_at = kf.seconds
    return doubted and kf.judged == 0 and kf.seconds - kf.judged_at < LEAST_GAP


@compiled
def forget_doubt(kf: Estimator, n: int) -> None:
    """End the doubt about all channels, because the evidence has decided."""
    for i in range(n):
        kf.doubt[i] = 0.0


@compiled
def explain_outliers(
    params: Constants, kf: Estimator, values: Array, candidates: int, burst: float
) -> None:
    """Find the channels that explain an outlying sample, and whether they may be a spike."""
    fill_sample_covariance(params, kf)
    limit = SPIKE_MISFIT * chi_without(params, kf, 0)
    chosen = choose(params, kf, candidates, burst, limit)
    if chosen == 0:
        chosen = remove_farthest(params, kf, burst)
    if params.determines[kf.mask & ~chosen]:
        chi_without(params, kf, chosen)
    # A rate that contains the spike would excuse the spike as a scale error.
    largest = largest_of(params, kf, motion_ratio(kf, kf.clean_rate))
    if largest > OUTLIER:
        kf.outliers = chosen
    if largest * largest > FAR:
        kf.far_samples += 1
        leave_spike_out(params, kf, values, burst)
    else:
        end_spike(params, kf)


@compiled
def excess_of(kf: Estimator, i: int) -> float:
    """Return the present noise variance of a channel over the learned one."""
    level = kf.shared.level[i] / kf.noise.now.sample[i]
    return max(1.0, BURST_FACTOR * kf.noise.recent_ratio[i], level)


@compiled
def largest_of(params: Constants, kf: Estimator, ratio: float) -> float:
    """Return the largest distance of a channel, standard deviations.

    ``ratio``: present variance of the state uncertainty over the one in the sample.
    """
    largest = 0.0
    for i in range(params.sensors.n):
        variance = kf.share[i] + ratio * (1.0 - kf.share[i])
        size = kf.distance[i] / math.sqrt(excess_of(kf, i) * variance)
        largest = max(largest, size)
    return largest


@compiled
def fill_sample_covariance(params: Constants, kf: Estimator) -> None:
    """Fill the covariance M by which a sample is judged."""
    for i in range(params.sensors.n):
        for j in range(params.sensors.n):
            kf.matrix[i, j] = 2.0 * params.length * kf.at.covariance[i, j]
        kf.matrix[i, i] += kf.noise.now.sample[i]


@compiled
def chi_without(params: Constants, kf: Estimator, without: int) -> float:
    """Return the chi-square of the sample without some channels. ``kf.clean_rate`` gets the rate of the others."""
    n = params.sensors.n
    parity = kf.clean
    mask = kf.mask & ~without
    fill_joint_parity(parity, params.sensors, mask, kf.matrix, UNKNOWN_RATE)
    apply_gain(parity.gain, n, kf.corrected, kf.clean_rate)
    chi = 0.0
    for i in range(n):
        kf.clean_values[i] = 0.0
        for j in range(n):
            if mask >> i & mask >> j & 1:
                kf.clean_values[i] += parity.information[i, j] * kf.corrected[j]
        if mask >> i & 1:
            chi += kf.clean_values[i] * kf.corrected[i]
    return chi


@compiled
def change_without(
    params: Constants, kf: Estimator, without: int, burst: float, limit: float
) -> float:
    """Return the squared change of the rate since the last sample if some channels are wrong, (rad/s)^2.

    The result is negative if the other channels disagree or give no rate. ``burst`` is the
    variance over the learned one, ``limit`` the chi-square allowed beyond noise.
    """
    if not params.determines[kf.mask & ~without]:
        return -1.0
    chi = chi_without(params, kf, without)
    free = -3.0
    for i in range(params.sensors.n):
        free += (kf.mask & ~without) >> i & 1
    if chi > burst * usual_chi(free) + limit:
        return -1.0
    change = 0.0
    for a in range(3):
        step = kf.clean_rate[a] - kf.total.instant[a]
        # The noise of the two rates is not a change.
        change += max(step * step, THREE_SIGMA * kf.clean.inverse[a, a])
    return change


@compiled
def choose(
    params: Constants, kf: Estimator, candidates: int, burst: float, limit: float
) -> int:
    """Return the channel, or the channels of the unit, that explains the sample, or 0.

    A channel is preferred. A unit is chosen where the unit changes the rate far less,
    because some spikes of a unit look like a spike of one channel of another unit. If
    the best explanation is not clearly better than the next one, all candidates are
    returned, or, where units explain best, all channels of the sample.
    """
    channel = 0
    of_channel = next_channel = math.inf
    for i in range(params.sensors.n):
        if candidates >> i & 1:
            change = change_without(params, kf, 1 << i, burst, limit)
            if change >= 0.0:
                next_channel = min(next_channel, max(change, of_channel))
                if change < of_channel:
                    of_channel = change
                    channel = 1 << i
    unit = 0
    of_unit = next_unit = math.inf
    for u in range(params.units):
        inside = params.members[u] & kf.mask
        change = change_without(params, kf, inside, burst, limit) if inside else -1.0
        if change >= 0.0:
            next_unit = min(next_unit, max(change, of_unit))
            if change < of_unit:
                of_unit = change
                unit = inside
    if CLOSER * of_channel <= of_unit or (unit == 0 and channel):
        return channel if decides(kf, of_channel, next_channel) else candidates
    return unit if decides(kf, of_unit, next_unit) else kf.mask


@compiled
def decides(kf: Estimator, least: float, second: float) -> bool:
    """Whether the least change of the rate is smaller by far. After a hole no rate is known."""
    return second == math.inf or (kf.blocks > 0 and least < CLOSER * second)


@compiled
def remove_farthest(params: Constants, kf: Estimator, burst: float) -> int:
    """Return channels of several units: remove the farthest until the rest is noise."""
    without = 0
    for _ in range(params.sensors.n):
        chi = chi_without(params, kf, without)
        free = -3.0
        farthest = -1
        most = 0.0
        for i in range(params.sensors.n):
            information = kf.clean.information[i, i]
            if (kf.mask & ~without) >> i & 1 and information > 0.0:
                free += 1.0
                size = kf.clean_values[i] * kf.clean_values[i] / information
                if size > most:
                    farthest = i
                    most = size
        if chi <= burst * usual_chi(free) or farthest < 0:
            break
        if not params.spans[kf.mask & ~without & ~(1 << farthest)]:
            break
        without |= 1 << farthest
    return without


@compiled
def leave_spike_out(
    params: Constants, kf: Estimator, values: Array, burst: float
) -> None:
    """Correct a sample by the rate of the channels without outliers, and impute the outliers."""
    kf.spiked = kf.outliers
    if not params.determines[kf.mask & ~kf.spiked]:
        kf.spiked = kf.mask
        return
    chi = chi_without(params, kf, kf.spiked)
    free = -3.0
    for i in range(params.sensors.n):
        free += (kf.mask & ~kf.spiked) >> i & 1
    kf.chi_ratio = excess_over_usual(chi / burst, free)
    correct_sample(params, kf, values, kf.clean.gain)
    for i in range(params.sensors.n):
        kf.imputed[i] = kf.corrected[i]
        if kf.spiked >> i & 1:
            kf.imputed[i] -= kf.innovation[i]
            # Some channels of an excluded unit may be correct.
            if kf.innovation[i] ** 2 > OUTLIER * OUTLIER * kf.channel_variance[i]:
                kf.spike_channels |= 1 << i
            kf.innovation[i] = 0.0


@compiled
def end_spike(params: Constants, kf: Estimator) -> None:
    """Count a spike that has just ended, for its channels if they are known.

    A deviation that ends because its channel is excluded or under test is a fault.
    """
    channels = kf.spike_channels & kf.mask & ~kf.under_test
    if 0 < kf.far_samples <= SPIKE_SAMPLES:
        for i in range(params.sensors.n):
            kf.spikes[i] += channels >> i & 1
    kf.spike_channels = 0
    kf.far_samples = 0
