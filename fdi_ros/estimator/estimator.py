# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Estimator of the sensor errors, and its innovations.

The present states correct a sample (`correct_sample`), and the mean of a block of 40 ms
corrects the states (`blocks.py`). In motion the rate is eliminated. At rest the rate is
known to be zero, so the common part of the biases shows too. The filter takes every
block at once. Snapshots of the states are kept 0.12, 1, 8, 61 and 490 s apart. After a
fault the filter goes on from a snapshot before the onset (`predict_from`), which undoes
all that was absorbed. Innovations, whitened with the uncertainty of all states, go to
the detector.
"""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import (
    MAX_CHANNELS,
    MAX_UNITS,
    Axes,
    Channels,
    Counts,
    Flag,
    Mask,
    Real,
    Square,
    Units,
    Vector,
    Whole,
    compiled,
    record,
)
from fdi_ros.core.algebra import along, dot, quadratic, residual, square, variance_along
from fdi_ros.core.parity import UNKNOWN_RATE, apply_gain, fill_joint_parity, fill_parity
from fdi_ros.core.records import Matrix, Parity, Sensors
from fdi_ros.estimator.error_states import (
    ErrorStates,
    Layout,
    Projection,
    States,
    fill_signals,
    subtract_errors,
)
from fdi_ros.estimator.noise import (
    MOTION,
    THREE_SIGMA,
    Noise,
    SharedNoise,
    change_regime,
)
from fdi_ros.model.samples import Array

BLOCK_TIME = 0.04  # s: four samples at 100 Hz, short against the motion of a vehicle
LONG_TIME = 2.0
"""Longest time scale of evidence, s. Under suspicion the states are held for at most
this time: held longer, their errors would be the same in all blocks. If an onset is
older than this, only the second half of the time since then is explained."""
BEGINS = 16.0
"""Motion begins where the squared rate exceeds this many of its variances, and
`THREE_SIGMA` times the part that no rate explains: a fault looks like motion too."""
SNAPSHOT_TIME, TIERS, SNAPSHOTS = 3.0 * BLOCK_TIME, 5, 8
"""s between snapshots (three blocks), tiers, snapshots per tier. Every eighth of a tier
enters the next."""
SLOW_MOTION = 1.0
"""Frequency up to which all units of a body move alike, Hz. Mounts and frames swing from 2 Hz on."""
FAST_STAGES = 4
"""Stages of the high pass above `SLOW_MOTION`. They leave 0.01 % of the energy at 0.35 Hz,
6 % at 1 Hz and 41 % at 2 Hz."""
FEWEST_BLOCKS = 3  # consecutive blocks from which the angular acceleration follows
REST_BLOCKS = round(1.0 / BLOCK_TIME)  # blocks without motion that are rest: a second
BLOCKS_PER_COARSE = round(LONG_TIME / BLOCK_TIME)
SAMPLES, BLOCKS, COARSE = (
    256,
    1024,
    512,
)  # totals kept: of the last samples, of blocks, and of every `BLOCKS_PER_COARSE`th block
# Smallest share of noise in the variance of a statistic. A smaller share is rounding.
LEAST_NOISE_SHARE = 0.02
# Smallest share of a channel's variance that must remain in its residual. With less, no
# residual shows a fault of the channel.
SENSITIVE = 1e-6
# Smallest information about a channel, as a share of the information with all sensor
# errors known. At this value a fault must be ten times as large to show.
CHECKABLE = 0.01
Block = Annotated[NDArray[np.float64], "f8", (2, MAX_CHANNELS)]
Rates = Annotated[NDArray[np.float64], "f8", (3, 3)]
Window = Annotated[NDArray[np.float64], "f8", (REST_BLOCKS, 3)]
Sets = Annotated[NDArray[np.uint8], "u1", (1 << MAX_CHANNELS,)]


# Time without a value of a channel that counts as a gap, s. A lost message is none.
LEAST_GAP = 0.2
# Squared rate, (rad/s)^2, up to which the state uncertainty hardly grows with the
# motion: 0.6 deg/s.
SLOW_TURN = 1e-4


@record
class Constants:
    """Constants of the estimator and of the detector that tests its innovations. The detector fills them."""

    sensors: Sensors
    layout: Layout
    units: Whole
    unit: Counts  # number of the unit of each channel
    members: Annotated[NDArray[np.int64], "i8", (MAX_UNITS,)]  # channels of each unit
    length: Whole  # samples of a block
    period: Real  # of the samples, s
    adaptation_gain: Real  # of the noise of the moment, per block
    expected: Channels  # variance of a sample, (rad/s)^2
    timing: Channels  # standard deviation of the sampling instant of each channel, s
    louder: Real  # as of `fdi_ros.model.quantity.Quantity`
    gain_is_fault: Flag  # as of `fdi_ros.model.quantity.Quantity`
    # standard deviation of errors not linear in the rate, share of the rate along each
    nonlinearity: Channels
    rest_std: Real  # of the rate at rest, rad/s
    # of a bias, standard deviation, (rad/s)/(m/s^2), or 0
    g_sensitivity: Real
    turn_on_std: Real  # bias from one start to the next, rad/s. 0: not known
    bias_move: Real  # of a healthy bias in flight, standard deviation, rad/s
    rectified: Real  # as of `fdi_ros.model.quantity.Quantity`
    largest_move: Real  # of all healthy biases together within half a minute, rad/s
    determines: Sets  # sets of channels that give a rate
    spans: Sets  # of the sets that give a rate, those with redundancy
    least: Whole  # samples that a fault lasts
    limit: Real  # of the mean of all sums: the mean run length, samples
    confidence: Real
    stride: Whole  # samples between the values that are differenced


@record
class Total:
    """Sums of all samples so far, to have means over any time."""

    sample: Whole  # number of the last sample summed
    values: Channels  # rad/s
    count: Channels  # samples that each channel has delivered
    rate: Vector  # rad/s
    speed: Channels  # absolute rate along each channel, rad/s
    instant: Vector  # rate of that sample alone, rad/s
    turned: Matrix  # centripetal part of the displacement, rad^2/s^2
    spin: Vector  # rate of the gyros in that sample, rad/s


@record
class Snapshot:
    """The states at a moment."""

    seconds: Real  # since the start, or negative without a snapshot
    states: ErrorStates
    late: Units  # delays that `restamp` made up for then, s
    force: Vector  # specific force that the biases belong to, m/s^2


@record
class Estimator:
    """All that the estimator remembers."""

    samples: Whole
    seconds: Real  # since the start
    mask: Mask  # channels of the last sample
    excluded_from_rate: Mask  # channels under doubt that the rate leaves out
    beyond: Mask  # channels of the last sample that were out of range
    under_test: Mask  # channels under doubt, which the states learn nothing from
    present_at: Counts  # number of the last sample of each channel
    returned: Whole  # number of the sample at which the last gap of a channel ended
    learned_at: Real  # the states are of this time, s since the start
    states: ErrorStates
    noise: Noise
    late: Units  # delays that `restamp` makes up for, s
    # by how much corrected values lie before the stamp, if the earliest unit is in
    # time, s
    behind: Real
    largest_delay: Real  # largest delay between units, s
    chi_ratio: Real  # chi-square of the last sample over the largest usual, at least 1
    outliers: Mask  # channels of the last sample that are too far off to be used in it
    spiked: Mask  # the outliers that are spikes; all, if the culprit is not known
    spikes: Counts  # of each channel so far
    # square of the last deviation of a channel from the others, (rad/s)^2, until they
    # agree again or one is declared, or 0
    doubt: Channels
    judged_at: Real  # time of the last sample with redundancy, s since the start
    clean: Parity  # without the outliers
    clean_values: Channels  # A y of that, s/rad
    clean_rate: Vector  # of that, rad/s
    rate: Vector  # of the last sample, rad/s
    start_bias: Channels  # bias that the values do not contain, rad/s
    far_bias: Channels  # bias far beyond its prior, rad/s, or 0
    bias_error: Channels  # of all biases if that one is a fault, rad/s
    corrected: Channels  # values less their estimated errors, rad/s
    # the same, with the rate of the others in place of a spike, rad/s
    imputed: Channels
    innovation: Channels  # corrected values less the rate along each channel, rad/s
    statistic: Channels  # (A y)_i of the last sample over its standard deviation in this motion
    distance: Channels  # ``|A y|_i / sqrt(A_ii)`` of the last sample
    share: Channels  # of noise in the variance of each statistic; the rest is state uncertainty
    inflation: Channels  # its inverse, in this motion
    # information of each channel if all errors of the sensors were known, s^2/rad^2
    ideal_information: Channels
    # variance of each channel by noise and states, (rad/s)^2
    channel_variance: Channels
    judged: Mask  # channels that the others check
    checked: Mask  # judged channels whose state uncertainty hides no fault
    excess: Real  # largest variance of a residual over the one expected, at least 1
    speed_squared: Real  # of the rate of the last block, (rad/s)^2
    parity: Parity  # of a sample
    expected_parity: Parity  # of a sample in the noise expected
    fused: Parity  # of a sample, without the channels left aside
    at: Projection  # of a sample
    least_variance: States  # of each state, or 0 without a bound
    usual_rate: Vector  # mean square of the rate of the last second, (rad/s)^2
    shared: SharedNoise
    zero: Vector  # in place of a rate that is not known yet
    signal_rate: Vector  # rate that multiplies the states, rad/s, zero at rest
    # Of the block being filled, and the last ones:
    filled: Whole
    far_samples: Whole  # samples in a row that are far off
    spike_channels: Mask  # culprits in these
    spike_sum: Channels  # sum of their deviations, which the totals lack, rad/s
    sum_values: Channels  # rad/s
    sum_count: Channels  # samples that each channel has delivered
    sum_time: Channels  # when each has, s since the block begins
    sum_rate: Vector  # rad/s
    sum_seconds: Real  # of all samples, s since the block begins
    begun: Real  # begin of the block, s since the start
    span: Real  # s, from one block to the next
    blocks: Whole  # completed in a row
    all_blocks: Whole
    # Of the last blocks, the newest first. A block is judged when the next one is
    # there: its acceleration needs both.
    means: Block  # of the values, rad/s
    middles: Block  # of the samples of each channel, from the middle of the block, s
    masks: Annotated[NDArray[np.int64], "i8", (2,)]
    rates: Rates  # of the last three blocks, rad/s
    ends: Rates  # of the last sample of each, rad/s
    times: Vector  # means of the times of their samples, s since the start
    ended: Vector  # times of their last samples, s since the start
    acceleration: Vector  # of the body in the middle of the block before, rad/s^2
    block_parity: Parity
    block_at: Projection
    matrix: Annotated[
        NDArray[np.float64], "f8", (MAX_CHANNELS, MAX_CHANNELS)
    ]  # M of a block, or of a sample, (rad/s)^2
    # A of all its channels, whatever is learned from, s^2/rad^2
    block_information: Square
    block_noise: Channels  # variance of the mean of a block by noise, (rad/s)^2
    block_innovation: Channels  # rad/s
    block_values: Channels  # A y, s/rad
    angular_acceleration: Channels  # along each channel, rad/s^2, zero where only noise
    # Of the last second of blocks of each channel, against the others: mean deviation,
    # rad/s; its mean square about that mean, (rad/s)^2; its mean product with the angular
    # acceleration, rad^2/s^3; and the mean square of that acceleration, (rad/s^2)^2.
    deviation: Channels
    deviation_square: Channels
    deviation_turn: Channels
    turn_square: Channels
    # variance of that deviation, halved, beside what a delay explains, (rad/s)^2
    incoherent: Channels
    # state of each stage of the high pass above `SLOW_MOTION`, rad/s
    slow_rates: Annotated[NDArray[np.float64], "f8", (FAST_STAGES, 3)]
    fast_rate: Vector  # what it leaves of the rate of the block before, rad/s
    fast_square: Real  # mean square of the change of that in a second, (rad/s^2)^2
    all_square: Real  # mean square of the change of the rate, (rad/s^2)^2
    # standard deviation of the part of each delay state that vibration may have taught, s
    taught_delay: Units
    delay_variance_before: Units  # of each delay state before the last block, s^2
    turning: Flag  # the angular acceleration exceeds noise
    shaken: Real  # square of the acceleration that blocks are too slow for, (rad/s^2)^2
    usual_shaken: Real  # its average in the last second, (rad/s^2)^2
    turn_noise: Real  # its variance, (rad/s^2)^2
    peak_turn: Channels  # lately largest, rad/s^2
    extra: Channels  # variance of a block beyond noise and states, (rad/s)^2
    peak_extra: Channels  # lately largest, (rad/s)^2
    unresolved_variance: Channels  # part of `extra` by turns that blocks do not resolve
    peak_unresolved: Channels  # lately largest, (rad/s)^2
    nonlinear_variance: Channels  # variance by nonlinearity, lately largest, (rad/s)^2
    displaced: Channels  # variance by unknown positions, lately largest, (rad/s)^2
    may_be_apart: Flag  # positions of accelerometers are not known
    position_std: Channels  # of them, m over the natural size
    spin_sum: Vector  # of the block being filled, rad/s
    spins: Rates  # means of the last three blocks, rad/s
    # while a covariance by unknown positions is worked out: angular acceleration, what
    # a block does not resolve of it, rad/s^2, centripetal part, rad^2/s^2, and effect on
    # each channel, rad/s
    spin_change: Vector
    unresolved: Vector
    turned: Matrix
    displacement: Axes
    allowed: Channels  # part of `displaced` that the covariance of samples contains
    has_force: Flag  # a specific force has come
    force: Vector  # smoothed specific force, m/s^2
    reference_force: Vector  # specific force that the biases belong to, m/s^2
    near_at: Real  # when the force was last near the reference, s since the start
    changed_at: Real  # when the reference last changed, s since the start
    largest_change: Real  # of the reference, m/s^2
    force_variance: Real  # of a gyro by g-sensitivity, lately largest, (rad/s)^2
    counted_variance: Real  # part of it that the covariance of samples contains
    strongest_vibration: Real  # mean square of the strongest lately, (rad/s)^2
    usual_vibration: Real  # mean square when it last changed, (rad/s)^2
    vibration_changes: Flag  # in the last block, from the usual one
    vibration_changed_at: Real  # when it last did, s since the start
    rest_rates: Window  # of the last blocks, rad/s
    rest_noise: Vector  # variance of the rate of a block, (rad/s)^2
    rest_bias_variance: Vector  # variance of the rate by the biases, (rad/s)^2
    known_variance: Vector  # the same, however large
    steady_seconds: Real  # time for which the rate has not changed, s
    steady_rate: Vector  # rate that may be biases, rad/s, or 0
    alike_bias: Channels  # the same along each channel, if priors do not explain it
    rest_count: Whole  # blocks in `rest_rates`
    rest: Flag
    unseen: Flag  # nothing is known yet of the motion since a hole
    # when the first of the last holes in the stream began, s since the start
    hole_at: Real
    hole_sample: Whole  # number of the last sample before the hole; 0: no hole
    used_at: Real  # of the last sample that was used, s since the start
    held_seconds: Real  # s that the states have been held
    delays_checked_at: Real  # when delays were last looked at, s
    snapshot_at: Real  # when the last snapshot was kept, s
    # Totals since the start:
    total: Total
    last_samples: Annotated[list[Total], SAMPLES]
    last_blocks: Annotated[list[Total], BLOCKS]
    last_coarse: Annotated[list[Total], COARSE]
    snapshots: Annotated[list[Snapshot], TIERS * SNAPSHOTS]
    taken: Annotated[NDArray[np.int64], "i8", (TIERS,)]


@compiled
def update_weights(params: Constants, kf: Estimator) -> None:
    """Work out the information and gain with which samples of the channels present are judged and fused.

    The state uncertainty is the same error in all samples until the next block. It
    counts twice the samples of a block, or the sums would treat it as white.
    """
    n = params.sensors.n
    noise = kf.noise
    lasting = 2.0 * params.length
    for i in range(n):
        # Nonlinearity bounds what any channel can show in a turn, and is not ignorance.
        kf.channel_variance[i] = (
            noise.now.sample[i] + lasting * kf.nonlinear_variance[i]
        )
    fill_parity(kf.parity, params.sensors, kf.mask, kf.channel_variance)
    for i in range(n):
        kf.ideal_information[i] = kf.parity.information[i, i]
    for i in range(n):
        for j in range(n):
            kf.matrix[i, j] = lasting * kf.at.covariance[i, j]
        kf.matrix[i, i] += noise.now.sample[i]
    fill_joint_parity(kf.parity, params.sensors, kf.mask, kf.matrix, UNKNOWN_RATE)
    kf.judged = kf.checked = 0
    for i in range(n):
        information = kf.parity.information[i, i]
        if kf.mask >> i & 1 and information * kf.matrix[i, i] > SENSITIVE:
            kf.judged |= 1 << i
            share = variance_along(kf.parity.information[i], noise.now.sample, n)
            kf.share[i] = max(share / information, LEAST_NOISE_SHARE)
            # Scale the state uncertainty to 100 Hz, so that the check does not depend
            # on the sample rate.
            hidden = kf.ideal_information[i] / information - 1.0
            if hidden * (2.0 * BLOCK_TIME * 100.0) / lasting < 1.0 / CHECKABLE - 1.0:
                kf.checked |= 1 << i
        kf.channel_variance[i] = kf.shared.level[i] + kf.at.covariance[i, i]
    kept = kf.mask & ~kf.excluded_from_rate & ~kf.beyond
    if not params.spans[kept]:
        kept = kf.mask
    fill_parity(kf.fused, params.sensors, kept, kf.channel_variance)


@compiled
def correct_sample(
    params: Constants, kf: Estimator, values: Array, gain: Array
) -> None:
    """Correct a sample (n,) by the present states. Update its rate, by a gain (3, n), and its innovations."""
    n = params.sensors.n
    layout = params.layout
    signals = kf.at.signals
    innovation = kf.innovation
    fill_signals(layout, kf.zero, kf.angular_acceleration, signals)
    subtract_errors(layout, kf.states, signals, values, innovation)
    apply_gain(gain, n, innovation, kf.rate)
    if kf.noise.regime == MOTION:
        fill_signals(layout, kf.rate, kf.angular_acceleration, signals)
    subtract_errors(layout, kf.states, signals, values, kf.corrected)
    apply_gain(gain, n, kf.corrected, kf.rate)
    for i in range(n):
        innovation[i] = 0.0
        if kf.mask >> i & 1:
            innovation[i] = residual(kf.corrected[i], params.sensors.axes[i], kf.rate)


@compiled
def watch_for_motion(params: Constants, kf: Estimator) -> None:
    """End rest where the channels agree on a rate."""
    n = params.sensors.n
    noise = kf.noise
    speed_squared = square(kf.rate)
    if noise.regime == MOTION or not speed_squared > 0.0:
        return
    variance = 0.0
    for a in range(3):
        for i in range(n):
            gain = kf.fused.gain[a, i]
            variance += gain * gain * (noise.now.sample[i] + kf.at.covariance[i, i])
    if speed_squared <= BEGINS * variance:
        return
    explained = 0.0
    for i in range(n):
        if kf.mask >> i & 1:
            turn = along(params.sensors.axes[i], kf.rate)
            explained += turn * turn / noise.now.sample[i]
    unexplained = quadratic(kf.parity.information, kf.innovation, n)
    if explained > THREE_SIGMA * unexplained:
        change_regime(noise, n, MOTION, True)
        update_weights(params, kf)


@compiled
def usual_chi(free: float) -> float:
    """Return the largest usual chi-square with ``free`` degrees of freedom, at least 1.

    This is the mean plus four standard deviations, plus 4.
    """
    return max(free, 1.0) + 4.0 * math.sqrt(2.0 * max(free, 1.0)) + 4.0


@compiled
def excess_over_usual(chi: float, free: float) -> float:
    """Return by how much a chi-square exceeds the largest usual one, at least 1.

    One direction of the rate may have all of the excess.
    """
    return max(1.0, 1.0 + chi - usual_chi(free))


@compiled
def motion_ratio(kf: Estimator, rate: Vector) -> float:
    """Growth of the state uncertainty since the last block, at a rate (3,), rad/s."""
    return max((square(rate) + SLOW_TURN) / (kf.speed_squared + SLOW_TURN), 1.0)


@compiled
def update_statistics(params: Constants, kf: Estimator) -> None:
    """Normalise the innovations of a sample. The state uncertainty grows with the motion."""
    n = params.sensors.n
    more = motion_ratio(kf, kf.rate)
    chi = 0.0
    free = -3.0
    for i in range(n):
        kf.statistic[i] = 0.0
        kf.inflation[i] = 1.0
        if kf.judged >> i & 1:
            total = dot(kf.parity.information[i], kf.innovation, n)
            variance = kf.share[i] + more * (1.0 - kf.share[i])
            kf.statistic[i] = total / math.sqrt(kf.parity.information[i, i] * variance)
            kf.inflation[i] = variance / kf.share[i]
            chi += (
                total
                * kf.innovation[i]
                / max(kf.shared.level[i] / kf.noise.now.sample[i], 1.0)
            )
            free += 1.0
        kf.distance[i] = abs(kf.statistic[i]) * math.sqrt(kf.share[i] * kf.inflation[i])
    kf.chi_ratio = excess_over_usual(chi, free)


@compiled
def copy_total(n: int, source: Total, target: Total) -> None:
    """Copy sums."""
    target.sample = source.sample
    for i in range(n):
        target.values[i] = source.values[i]
        target.count[i] = source.count[i]
        target.speed[i] = source.speed[i]
    for a in range(3):
        target.rate[a] = source.rate[a]
        target.instant[a] = source.instant[a]
        target.spin[a] = source.spin[a]
        for b in range(3):
            target.turned[a, b] = source.turned[a, b]


@compiled
def follow_gaps(params: Constants, kf: Estimator) -> None:
    """Note when channels return from a gap. A unit that is slower than the others has none."""
    for i in range(params.sensors.n):
        if kf.mask >> i & 1:
            before = kf.present_at[i]
            if before > 0 and (kf.samples - before) * params.period > LEAST_GAP:
                kf.returned = kf.samples
            kf.present_at[i] = kf.samples


@compiled
def add_speed(params: Constants, total: Total) -> None:
    """Add the absolute rate along each channel, rad/s."""
    for i in range(params.sensors.n):
        total.speed[i] += abs(along(params.sensors.axes[i], total.instant))


@compiled
def add_to_total(kf: Estimator, i: int, value: float) -> None:
    """Add a value to the total of its channel, without what may still turn out to be a spike."""
    spike = kf.corrected[i] - kf.imputed[i]
    if kf.far_samples == 0:
        kf.spike_sum[i] = 0.0
    elif kf.spiked == 0:
        # The deviation lasts, so it was no spike: add it after all.
        kf.total.values[i] += kf.spike_sum[i]
        kf.spike_sum[i] = 0.0
    else:
        kf.spike_sum[i] += spike
    kf.total.values[i] += value - spike
    kf.total.count[i] += 1.0


@compiled
def add_sample(params: Constants, kf: Estimator, values: Array, seconds: float) -> bool:
    """Add a sample to the totals and, unless a spike, to the block. Return whether the block is complete."""
    n = params.sensors.n
    total = kf.total
    total.sample = kf.samples
    if kf.filled == 0:
        kf.begun = kf.seconds - seconds
    for i in range(n):
        if kf.mask >> i & 1:
            add_to_total(kf, i, values[i])
        if kf.mask >> i & 1 and kf.spiked == 0:
            kf.sum_values[i] += values[i]
            kf.sum_count[i] += 1.0
            kf.sum_time[i] += kf.seconds - kf.begun
    kf.sum_seconds += kf.seconds - kf.begun
    for a in range(3):
        if kf.spiked == 0:
            total.instant[a] = kf.rate[a]
        total.rate[a] += total.instant[a]
        kf.sum_rate[a] += total.instant[a]
    add_speed(params, total)
    copy_total(n, total, kf.last_samples[kf.samples % SAMPLES])
    kf.filled += 1
    if kf.filled < params.length:
        return False
    close_block(params, kf)
    copy_total(n, total, kf.last_blocks[kf.all_blocks % BLOCKS])
    if kf.all_blocks % BLOCKS_PER_COARSE == 0:
        copy_total(
            n, total, kf.last_coarse[kf.all_blocks // BLOCKS_PER_COARSE % COARSE]
        )
    return True


@compiled
def close_block(params: Constants, kf: Estimator) -> None:
    """Take the means of a block that is complete, and begin the next one."""
    n = params.sensors.n
    present = 0
    middle = kf.sum_seconds / params.length
    for i in range(n):
        # A unit may be slower than the others.
        if 2.0 * kf.sum_count[i] >= params.length:
            present |= 1 << i
        kf.means[1, i] = kf.means[0, i]
        count = max(kf.sum_count[i], 1.0)
        kf.means[0, i] = kf.sum_values[i] / count
        kf.middles[1, i] = kf.middles[0, i]
        kf.middles[0, i] = kf.sum_time[i] / count - middle
        kf.sum_values[i] = kf.sum_count[i] = kf.sum_time[i] = 0.0
    kf.masks[1] = kf.masks[0]
    kf.masks[0] = present
    for a in range(3):
        kf.rates[2, a] = kf.rates[1, a]
        kf.rates[1, a] = kf.rates[0, a]
        kf.ends[2, a] = kf.ends[1, a]
        kf.ends[1, a] = kf.ends[0, a]
        kf.ends[0, a] = kf.total.instant[a]
        kf.rates[0, a] = kf.sum_rate[a] / params.length
        kf.sum_rate[a] = 0.0
    kf.times[2] = kf.times[1]
    kf.times[1] = kf.times[0]
    kf.times[0] = kf.begun + middle
    kf.ended[2] = kf.ended[1]
    kf.ended[1] = kf.ended[0]
    kf.ended[0] = kf.seconds
    kf.sum_seconds = 0.0
    kf.filled = 0
    kf.span = kf.seconds - kf.begun
    kf.blocks += 1
    kf.all_blocks += 1


@compiled
def total_before(kf: Estimator, sample: int, out: Total, n: int) -> None:
    """Copy the sums at the last stored moment before a sample to ``out``.

    If all stored moments are later, the oldest one is copied.
    """
    if kf.samples - sample < SAMPLES - 1:
        copy_total(n, kf.last_samples[(sample - 1) % SAMPLES], out)
        return
    for back in range(min(BLOCKS, kf.all_blocks)):
        kept = kf.last_blocks[(kf.all_blocks - back) % BLOCKS]
        if kept.sample < sample:
            copy_total(n, kept, out)
            return
    found = kf.last_coarse[kf.all_blocks // BLOCKS_PER_COARSE % COARSE]
    for back in range(min(COARSE, kf.all_blocks // BLOCKS_PER_COARSE)):
        found = kf.last_coarse[(kf.all_blocks // BLOCKS_PER_COARSE - back) % COARSE]
        if found.sample < sample:
            break
    copy_total(n, found, out)


@compiled
def drop_block(kf: Estimator, n: int) -> None:
    """Begin the block anew: a block with a hole has no time of its own."""
    kf.filled = 0
    kf.sum_seconds = 0.0
    for i in range(n):
        kf.sum_values[i] = kf.sum_count[i] = kf.sum_time[i] = 0.0
    kf.shared.rate_count = 0
    for a in range(3):
        kf.sum_rate[a] = kf.spin_sum[a] = 0.0
        kf.shared.rate_sum[a] = kf.shared.rate_squares[a] = 0.0


@compiled
def forget_motion(kf: Estimator, n: int) -> None:
    """Forget the motion: blocks, rest, accelerations and differences of samples."""
    drop_block(kf, n)
    kf.blocks = 0
    kf.shared.fresh = 0
    kf.rest_count = 0
    kf.rest = False
    kf.unseen = kf.samples > 0
    for i in range(n):
        kf.angular_acceleration[i] = kf.extra[i] = 0.0
        kf.unresolved_variance[i] = 0.0
        kf.deviation[i] = kf.deviation_square[i] = 0.0
        kf.deviation_turn[i] = kf.turn_square[i] = 0.0
