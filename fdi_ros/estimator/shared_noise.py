# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

r"""Noise common to channels: vibration. The weights, the published covariance and the outliers follow from this noise.

The variances v of `fdi_ros.estimator.noise` assume independent channels. Vibration is
not independent: units see one rotation of the body with gains and phases of their own,
or each channel has a line of its own, and no v explains the parity. This module
measures the covariance R of the innovations about their half-second mean, over a
second, and the part of R that channels of variances v do not explain. With
``A = V^-1 - V^-1 H (H' V^-1 H)^-1 H' V^-1``, G the gain of the rate,
``E = I - H pinv(H)`` and k = n - 3:

- level ``q = tr(A R) / k``: noise of any colour beyond v, which differences of
  neighbours do not show.
- dimensions ``tr(A R)^2 / tr(A R A R)``: k for independent channels, two for a line, in
  any number of channels.
- coherence ``sum c_i' Q^-1 c_i / sum d_i``, with ``Q``, ``c_i``, ``d_i`` the mean
  products of G d and (A d)_i of fourth differences d: in vibration the differences of
  channels follow their common rate, in independent noise never.
- vibration s of the body, from the same differences and from the rate within a block.

The parity shows k in n of each of the two dimensions of a line. Where dimensions or
coherence indicate a line, the variance of every channel is at least
``tr(E R) / (k - 1)``, the mean of its posterior. The variance is also at least `UNEQUAL`^2 of the
vibration along the channel, as parity does not show an error common to all units.

Of two parallel channels the parity shows only the sum of the variances. The correlation
of their difference with the common rate, ``(G' Q^-1 c)_i / A_ii``, separates them
(likelihood of the full covariance ``H M H' + V``, M profiled out).
"""

from __future__ import annotations

import math

from fdi_ros.compiling.compiled import compiled
from fdi_ros.core.algebra import dot, invert, quadratic, variance_along
from fdi_ros.core.parity import apply_gain, fill_parity
from fdi_ros.core.subsets import number_in
from fdi_ros.estimator.estimator import Constants, Estimator
from fdi_ros.estimator.noise import BURST_FACTOR, FAR, PAST, THREE_SIGMA, SharedNoise
from fdi_ros.model.samples import Array

MEMORY = 2.0  # averaging time of all quantities of this module, in half seconds
# Excess of the inverse of the dimensions if all noise is one line: 1/2 - 1/3.
LINE_EXCESS = 1.0 / 6.0
INCOHERENT = 0.25  # squared correlation that independent noise may have in one second
COHERENT = 1.0 - INCOHERENT  # squared correlation from which all noise counts as a line
STEADY_ENERGY = 4.0
"""Largest energy of the differences of the rate, in units of the noise, at which they
may shift variance between parallel channels. In stronger motion a channel that sees a
tenth more of it would look noisier. At this limit its variance is wrong by a sixth."""
UNEQUAL = 0.15  # relative difference of the units' response to vibration: logs show 0.04 to 0.6
# values of a block that are independent of one another: all four at 100 Hz
INDEPENDENT = 4.0
# Blocks, 10 s, over which the level of checked channels is averaged.
MOST_CHECKED = 250.0
# Share of Q, and of 1e-11 (rad/s)^2, added to the diagonal of Q so that Q has an
# inverse even if nothing measures the rate about an axis.
NEAR_SINGULAR = 1e-3


@compiled
def begin_shared(shared: SharedNoise, n: int, expected: Array) -> None:
    """Begin with independent channels of the expected variances (n,), (rad/s)^2. ``shared`` must be all zero."""
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
    if kf.spiked == kf.mask:
        # A spike whose channels are not known is no vibration.
        shared.fresh = 0
        return
    if kf.judged:
        update_covariance(params, kf)
    shared.rate_count += 1
    for a in range(3):
        shared.rate_sum[a] += kf.rate[a]
        shared.rate_squares[a] += kf.rate[a] * kf.rate[a]
    if shared.fresh % params.stride == 0:
        if shared.fresh >= PAST * params.stride:
            add_fourth_difference(params, kf)
        for i in range(params.sensors.n):
            for k in range(PAST - 1, 0, -1):
                shared.past[k, i] = shared.past[k - 1, i]
            shared.past[0, i] = kf.imputed[i]
    shared.fresh += 1


@compiled
def update_covariance(params: Constants, kf: Estimator) -> None:
    """Take the innovations about their half-second mean into R. Absent channels keep their variances.

    Their covariances with the others fade by the root of what the variances of these
    fade by: otherwise R would not be a covariance any more.
    """
    shared = kf.shared
    n = params.sensors.n
    largest = 0.0
    for i in range(n):
        largest = max(largest, abs(kf.statistic[i]))
    half = params.length / params.adaptation_gain
    shared.count = min(shared.count + 1.0, MEMORY * half)
    share = min(1.0, (math.sqrt(FAR) / max(largest, 1.0)) ** 2)
    fading = math.sqrt(1.0 - 1.0 / shared.count)
    for i in range(n):
        if shared.kept >> i & 1:
            innovation = kf.innovation[i] - shared.local[i]
            shared.local[i] += innovation / half
            shared.difference[i] = innovation
        for j in range(i + 1):
            if shared.kept >> i & shared.kept >> j & 1:
                product = share * shared.difference[i] * shared.difference[j]
                shared.outer[i, j] += (product - shared.outer[i, j]) / shared.count
            elif (shared.kept >> i | shared.kept >> j) & 1:
                shared.outer[i, j] *= fading


@compiled
def add_fourth_difference(params: Constants, kf: Estimator) -> None:
    """Sum the products of what channels have in common and what they differ by, of one fourth difference.

    In white noise its standard deviation is sqrt(70) times the one of the values.
    """
    shared = kf.shared
    n = params.sensors.n
    past = shared.past
    for i in range(n):
        shared.difference[i] = 0.0
        if shared.kept >> i & 1:
            ends = kf.imputed[i] + past[3, i]
            shared.difference[i] = (
                ends - 4.0 * (past[0, i] + past[2, i]) + 6.0 * past[1, i]
            ) / math.sqrt(70.0)
    apply_gain(shared.alone.gain, n, shared.difference, shared.common)
    size = quadratic(shared.inverse, shared.common, 3)
    for a in range(3):
        for b in range(3):
            shared.common_sum[a, b] += shared.common[a] * shared.common[b]
    share = min(1.0, THREE_SIGMA / max(size, 1e-12))
    shared.taken += 1
    for i in range(n):
        if shared.kept >> i & 1:
            apart = dot(shared.alone.information[i], shared.difference, n)
            shared.apart_sum[i] += share * apart * apart
            for a in range(3):
                shared.mixed_sum[a, i] += share * shared.common[a] * apart


@compiled
def update_shape(params: Constants, kf: Estimator) -> None:
    """Work out the parity of the channels in use by their noise alone: once a block, and as they change.

    What was measured of others before stands: missing channels make no noise smaller.
    At rest, and in motion, R begins anew with the variances of that time.
    """
    shared = kf.shared
    n = params.sensors.n
    noise = kf.noise
    kept = kf.mask & ~kf.excluded_from_rate & ~kf.beyond
    if not params.spans[kept]:
        kept = kf.mask
    if kept == shared.kept and kf.filled > 0:
        return
    fill_parity(shared.alone, params.sensors, kept, noise.now.sample)
    if kept != shared.kept:
        # Differences are of samples of the same channels.
        shared.kept = kept
        shared.fresh = 0
        fill_parity(shared.even, params.sensors, kept, shared.ones)
    if noise.regime != shared.regime:
        shared.regime = noise.regime
        shared.count = 0.5 * params.length / params.adaptation_gain
        for i in range(n):
            shared.local[i] = 0.0
            for j in range(n):
                shared.outer[i, j] = noise.now.sample[i] if i == j else 0.0


@compiled
def update_shared_level(params: Constants, kf: Estimator) -> None:
    """Find the variance of each channel now, once a block, with noise that independent channels do not explain."""
    shared = kf.shared
    n = params.sensors.n
    noise = kf.noise
    checks = number_in(shared.kept, n) - 3.0
    shared.coherent = update_coherence(params, kf)
    update_vibration(params, kf)
    pooled = 0.0
    if checks > 0.0:
        by_dimensions = update_dimensions(params, kf, checks)
        shared.coherent = max(shared.coherent, by_dimensions)
        pooled = pooled_variance(shared, n) / max(checks - 1.0, 0.5)
        before = shared.checked_blocks[noise.regime]
        shared.checked_blocks[noise.regime] = min(before + 1.0, MOST_CHECKED)
    for i in range(n):
        own = noise.now.sample[i]
        level = own * max(1.0, BURST_FACTOR * noise.recent_ratio[i], shared.excess)
        seen = variance_along(params.sensors.axes[i], shared.vibration, 3)
        if checks > 0.0:
            level = max(level, own + UNEQUAL * UNEQUAL * seen)
            level += shared.coherent * max(pooled - level, 0.0)
            follow_checked(shared, noise.regime, i, level)
        else:
            # Without redundancy vibration of the body and of one sensor look alike.
            level = max(level, own + seen)
            level = max(level, shared.checked[noise.regime, i])
        shared.level[i] = level


@compiled
def pooled_variance(shared: SharedNoise, n: int) -> float:
    """Trace of R with the projector of channels alike, (rad/s)^2."""
    total = 0.0
    for i in range(n):
        for j in range(i + 1):
            weight = 1.0 if i == j else 2.0
            total += weight * shared.even.information[i, j] * shared.outer[i, j]
    return total


@compiled
def follow_checked(shared: SharedNoise, regime: int, i: int, level: float) -> None:
    """Average the variance that channel i has while it is checked, at rest or in motion."""
    share = 1.0 / shared.checked_blocks[regime]
    before = shared.checked[regime, i]
    shared.checked[regime, i] += share * (level - before)


@compiled
def update_line(params: Constants, kf: Estimator) -> None:
    """Remember what of R is a line, while nothing is suspicious: the onset of a fault is in R for a second."""
    shared = kf.shared
    adaptation_gain = params.adaptation_gain / MEMORY
    for i in range(params.sensors.n):
        for j in range(params.sensors.n):
            now = shared.coherent * shared.outer[max(i, j), min(i, j)]
            shared.line_covariance[i, j] += adaptation_gain * (
                now - shared.line_covariance[i, j]
            )


@compiled
def update_dimensions(params: Constants, kf: Estimator, k: float) -> float:
    """Find the level of R over the variances. Return the share of R that is a line, by its dimensions."""
    shared = kf.shared
    n = params.sensors.n
    first = 0.0
    second = 0.0
    product = shared.product
    for i in range(n):
        for j in range(i):
            shared.outer[j, i] = shared.outer[i, j]
    for i in range(n):
        for j in range(n):
            product[i, j] = dot(shared.alone.information[i], shared.outer[j], n)
        first += product[i, i]
    for i in range(n):
        for j in range(n):
            second += product[i, j] * product[j, i]
    shared.excess = max(first / k, 1.0)
    chance = (k + 1.0) * params.length / (k * INDEPENDENT * shared.count)
    excess = second / max(first * first, 1e-30) - 1.0 / k - chance
    return min(max(excess / LINE_EXCESS, 0.0), 1.0)


@compiled
def update_coherence(params: Constants, kf: Estimator) -> float:
    """Average the products of a block, correct each variance by them. Return the coherent share."""
    shared = kf.shared
    n = params.sensors.n
    noise = kf.noise
    adaptation_gain = params.adaptation_gain / MEMORY if shared.taken else 0.0
    count = max(shared.taken, 1)
    steady = update_common(shared, adaptation_gain, count) < STEADY_ENERGY
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
        # One correlation corrects once: values missing leave blocks without a new one.
        if steady and shared.taken and shared.alone.information[i, i] > 0.0:
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
    """Update Q by the common rate and invert Q. Return the energy of Q over noise."""
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
    """Find the mean square of the vibration of the body about each axis: what of the rate is too quick for motion.

    A block of which samples were left out, as spikes, shows nothing of the vibration.
    """
    shared = kf.shared
    length = float(params.length)
    share = params.adaptation_gain / MEMORY
    if shared.rate_count != params.length:
        share = 0.0
    shared.rate_count = 0
    for a in range(3):
        noise = shared.alone.inverse[a, a]
        within = 0.0
        if length > 2.0 and kf.blocks > 1:
            # About a line through the samples of the block.
            slope = kf.rates[0, a] - kf.rates[1, a]
            about = (
                shared.rate_squares[a]
                - shared.rate_sum[a] * shared.rate_sum[a] / length
            )
            within = (
                about - slope * slope * (length * length - 1.0) / (12.0 * length)
            ) / (length - 2.0)
        shared.within[a] += share * (within - shared.within[a])
        shared.rate_sum[a] = shared.rate_squares[a] = 0.0
        shared.vibration[a] = max(
            shared.within[a] - noise, shared.square[a, a] - noise, 0.0
        )
        if length <= 2.0:
            # Two samples are always on a line.
            shared.present[a] = shared.vibration[a]
        elif share > 0.0:
            shared.present[a] = max(within - noise, 0.0)
