# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Find the channels that explain a mean: odds of every hypothesis, smallest set with the faulty channel.

The mean y (n,) of the values over some time, less their estimated errors, is
``H w + D f + e``. Here e is normal with covariance M, f are the errors, and D (n, k) holds
the directions of a hypothesis: a channel, a pair, a whole unit, its gain, its delay.
docs/methods.md#naming has the mathematics in the same symbols.
"""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import (
    MAX_CHANNELS,
    MAX_UNITS,
    Channels,
    Flag,
    Mask,
    Real,
    Square,
    Vector,
    Whole,
    compiled,
    record,
)
from fdi_ros.core.algebra import (
    along,
    dot,
    dot_in,
    factorise,
    invert,
    square,
)
from fdi_ros.core.parity import UNKNOWN_RATE, fill_joint_parity
from fdi_ros.core.records import Matrix, Parity
from fdi_ros.estimator.displacement import add_displacement_of_mean
from fdi_ros.estimator.error_states import (
    SIGNALS,
    SPEED,
    Layout,
    Projection,
    fill_signals,
    project,
    subtract_errors,
)
from fdi_ros.estimator.estimator import (
    FEWEST_BLOCKS,
    Constants,
    Estimator,
    Total,
    total_before,
)
from fdi_ros.estimator.noise import BLOCK, BURST_FACTOR, MOTION, Noise
from fdi_ros.model.geometry import ROUNDING
from fdi_ros.model.samples import Array

SHIFTS, SMALLEST_SHIFT = 5, 1.0 / 16.0
"""Number of sizes of a shift of all biases, and the smallest one, standard deviation over
`Constants.largest_move`. Each further size is twice as large, up to 40 mrad/s of gyros: a
boost of 10 g moves a gyro of 2 mrad/s a g by 20, and at its end by as much again."""
WRONG_GAINS = (0.125, 0.25, 0.5, 2.0, 4.0, 8.0)
"""Gains of a unit with a wrong range. Chips offer up to four ranges, each twice the one before, so the
set one may be too large or too small by these. Each has its inverse here: of two units, one with a
gain of 8 and the other one with 1/8 look alike. Without these hypotheses, while the axis of the turn
hardly moves, a healthy channel of another unit is named."""
STEADY = 0.5
"""Least mean rate over the mean of its size, of a turn whose axis hardly moves. In any other a wrong
range is no constant error, but explains the mean of a slow drift by chance: with it, a drift of
0.02 deg/s^2 of one gyro of six is named after 1 500 s in place of 240."""
SHOWN_SHARE = 0.9
"""Least fused mean rate over the smaller reading of the turn that a wrong range assumes: the fused
rate lies between both readings. At rest a fault of one channel is an apparent rate in its first
samples, and without this bound a turn that nothing shows stands beside its name for 2 s."""
MOST_HYPOTHESES = (
    MAX_CHANNELS
    + MAX_CHANNELS * (MAX_CHANNELS - 1) // 2
    + (4 + len(WRONG_GAINS)) * MAX_UNITS
    + SHIFTS
)
"""Largest number of hypotheses: channels, pairs, ten for each unit, shifts of all biases."""
COINCIDENCE = 0.1
"""Prior odds, against one channel, of all pairs with that channel and of each way in which
any unit is wrong. The value is deliberately large. With three parallel gyros, the same
fault in two looks like the opposite fault in the third, and only the odds of such a
coincidence protect the healthy third."""
TWO_CHECKS = COINCIDENCE / 2
"""Factor on the odds of pairs where only two checks exist. A pair of five channels explains
any mean, so with full odds no fault would ever be named."""
GAIN_STD, DELAY_STD = 0.1, 0.03
"""Standard deviations for a unit that is wrong as a whole: of its gain (a wrong range), and
of its delay in s (a clock that was set, by 40 ms for instance)."""
WARMS_BY = 3.0
"""Standard deviation of moves of all biases of one unit, over that of single biases: its temperature
changes. Without this hypothesis, one channel of a unit whose three biases move is named where
the pairs with it are likelier than the other one."""
# share of the samples that a channel must deliver before its mean counts
LEAST_PRESENCE = 0.9
# log odds that each free amplitude costs: its size may lie anywhere in four decades
AMPLITUDE_COST = 1.3
# possible error of the model (axes, scale factors) as a share of the largest error
MISFIT = 0.004
FIT, FIT_PER_CHECK = 6.0, 2.5
"""Largest chi-square of the unexplained rest: a constant, and a part for each degree of
freedom. Noise alone exceeds the limit at most once in 240 cases."""
SHIFTED, SHIFTED_AMONG_FEW = 0.1, 0.01
"""Prior odds, against one channel, of a shift of all biases, and with at most `FEW_CHECKS`
checks. With 0.03, a healthy gyro is named in 6 of 320 simulated flights with boosts, motors
and heat, with 0.1 in 4. With 0.1 among few, 0.02 rad/s on a cone of six is never named."""
SHIFTED_SLOWLY = 1.0
"""The same where the evidence has grown slowly, as while sensors warm: a sudden fault shows
sooner. Else a healthy gyro of six is named in 7 of 72 simulated flights that warm by 20 mrad/s.
Not where more than `FEW_CHECKS` checks find all errors in one unit: the drift of an IMU that ended
in a real crash was never declared so."""
FEW_CHECKS = 3
"""With so few checks, three faults or a shift explain any mean."""
SET_MARGIN = 5.0
"""Accepted risk that a set misses one of several faulty channels, as a multiple of the
risk of a wrong name. The risk that it misses all is far smaller."""
#: Log odds of what is impossible. Infinity would give NaN in differences.
NO_LOG = -1e300

Odds = Annotated[NDArray[np.float64], "f8", (MOST_HYPOTHESES,)]
Sets = Annotated[NDArray[np.int64], "i8", (MOST_HYPOTHESES,)]
Wholes = Annotated[NDArray[np.uint8], "u1", (MOST_HYPOTHESES,)]
Errors = Annotated[NDArray[np.float64], "f8", (MOST_HYPOTHESES, MAX_CHANNELS)]
Directions = Annotated[NDArray[np.float64], "f8", (3, MAX_CHANNELS)]


@record
class Inference:
    """The mean to explain, the odds of all hypotheses, and the answer."""

    mask: Mask  # channels of the mean
    judged: Mask  # channels of the mean whose faults show
    before: Total  # sums of all samples before the mean
    middle: Total  # sums of all samples before the onset
    until: Total  # sums of all samples up to the end of the change at the onset
    y: Channels  # values less their estimated errors, rad/s
    bias: Channels  # estimated biases, with those from the start, rad/s
    covariance: Square  # M, (rad/s)^2
    steady: Flag  # 1: the vehicle turns, and the axis of the turn hardly moves
    louder: Channels  # variance of a sample since the onset beyond the learned one, (rad/s)^2
    moved: Real  # by which each bias may have moved since the onset, rad/s
    rate: Vector  # mean body rate, rad/s
    # recent peak of the angular acceleration along each channel, rad/s^2
    angular_acceleration: Channels
    change: Vector  # change of the body rate over the mean, rad/s
    at: Projection  # projection of the error states in the motion of the mean
    parity: Parity
    u: Channels  # A y, s/rad
    whitened: Channels  # u in units of its standard deviation with a shift
    gain: Channels  # of each channel with a wrong range
    of_range: Channels  # values less the errors of the biases with a wrong range, rad/s
    total: Real  # y' A y / 2
    direction: Directions
    matrix: Matrix
    inverse: Matrix
    along: Vector  # D' u
    amplitude: Vector  # estimated f, rad/s
    fit: Real  # part of ``total`` that the last hypothesis explains with its best amplitude
    count: Whole  # number of hypotheses
    small: Whole  # the first ones, of one channel or two
    odds: Odds  # log odds, later shares
    fits: Odds  # ``fit`` of each hypothesis
    errors: Errors  # error of each channel by each hypothesis, rad/s
    members: Sets  # channels of each hypothesis
    whole: Wholes  # 1: the hypothesis calls the gyros healthy
    may_shift: Flag  # 1: all biases may have shifted
    slow: Flag  # 1: the evidence has grown slowly
    alone: Flag  # 1: errors of one unit leave only noise
    shifts: Odds  # standard deviation of the shift in each hypothesis, rad/s; 0: none
    # The answer:
    log_odds: Real  # log odds of the likeliest hypothesis against no fault
    # faulty channels: all likely hypotheses have them in common, and the likeliest fits
    common: Mask
    union: Mask  # a set with at least one faulty channel
    likeliest: Mask  # channels of the likeliest hypothesis
    fit_of_best: Real  # part of ``total`` that the likeliest hypothesis explains
    shift: Real  # of the likeliest hypothesis, rad/s; 0: no shift
    may_be_shift: Flag  # 1: a shift is among the likely hypotheses
    fitted: Flag  # 1: the likeliest hypothesis leaves only noise
    error: Channels  # error of each channel if no other is faulty, rad/s
    largest: Real  # largest error within the likeliest hypothesis, rad/s
    # mean products of the errors over all hypotheses, by their odds, (rad/s)^2
    error_products: Square


@compiled
def set_mean_speed(
    layout: Layout, kf: Estimator, before: Total, share: float, signals: Array
) -> None:
    """Put a share of the absolute rates summed since ``before`` into signals (n, `SIGNALS`), rad/s.

    In a turn to and fro the mean rate is zero, but the mean absolute rate is not.
    """
    for k in range(SIGNALS):
        if layout.by[k] == SPEED:
            for i in range(layout.n):
                signals[i, k] = share * (kf.total.speed[i] - before.speed[i])


@compiled
def set_mean(params: Constants, kf: Estimator, inference: Inference, size: int) -> None:
    """Set up the mean of the last ``size`` samples and its covariance."""
    n = params.sensors.n
    layout = params.layout
    before = inference.before
    total_before(kf, kf.samples - size + 1, before, n)
    # Sums exist only for some earlier moments.
    size = kf.samples - before.sample
    fill_mean(params, kf, inference, size)
    signals = inference.at.signals
    fill_signals(layout, inference.rate, inference.angular_acceleration, signals)
    moves = 1.0 if kf.noise.regime == MOTION else 0.0
    set_mean_speed(layout, kf, before, moves / size, signals)
    subtract_errors(layout, kf.states, signals, inference.y, inference.y)
    project(layout, kf.states, inference.at)
    for i in range(n):
        for j in range(n):
            inference.covariance[i, j] = inference.at.covariance[i, j]
    add_noise(params, kf, inference, size)
    add_line(params, kf, inference, size)


@compiled
def fill_mean(
    params: Constants, kf: Estimator, inference: Inference, size: int
) -> None:
    """Compute the means of the values and of the motion since ``before``."""
    n = params.sensors.n
    before = inference.before
    inference.mask = 0
    for i in range(n):
        count = kf.total.count[i] - before.count[i]
        if kf.mask >> i & 1 and count > LEAST_PRESENCE * size:
            inference.mask |= 1 << i
            # A value that may still prove to be a spike counts while it lasts.
            total = kf.total.values[i] + kf.spike_sum[i]
            inference.y[i] = (total - before.values[i]) / count
        inference.bias[i] = kf.start_bias[i] + kf.states.x[i]
    inference.judged = inference.mask & kf.judged
    # At rest an apparent rate is the fault itself, not motion.
    moves = 1.0 if kf.noise.regime == MOTION else 0.0
    inference.steady = moves > 0.0 and turns_steadily(params, before, kf.total)
    for a in range(3):
        inference.rate[a] = moves * (kf.total.rate[a] - before.rate[a]) / size
        inference.change[a] = kf.rate[a] - before.instant[a]
    for i in range(n):
        change = moves * along(params.sensors.axes[i], inference.change)
        inference.angular_acceleration[i] = change / (size * params.period)


@compiled
def turns_steadily(params: Constants, since: Total, until: Total) -> bool:
    """Whether the axis of the turn hardly moves between two moments (`STEADY`)."""
    by_mean = by_size = 0.0
    for i in range(params.sensors.n):
        mean = 0.0
        for a in range(3):
            mean += params.sensors.axes[i, a] * (until.rate[a] - since.rate[a])
        size = until.speed[i] - since.speed[i]
        by_mean += mean * mean
        by_size += size * size
    return by_mean > STEADY * STEADY * by_size


@compiled
def noise_of_mean(params: Constants, noise: Noise, i: int, size: int) -> float:
    """Return the noise variance of the mean of ``size`` samples of channel i, (rad/s)^2."""
    variance = noise.now.sample[i]
    slow = noise.longest[i]
    if size >= params.length:
        colour = max(1.0, noise.now.level[BLOCK, i] * slow)
        variance *= noise.unknown[i] * colour
    else:
        burst = variance * max(1.0, BURST_FACTOR * noise.recent_ratio[i])
        variance = max(burst, noise.now.block[i] * slow * size / params.length)
    return variance / size


@compiled
def variance_by_turn(
    params: Constants, kf: Estimator, inference: Inference, i: int, size: int
) -> float:
    """Return the variance of the mean of channel i by what no state describes of a turn, (rad/s)^2.

    A late sample of a channel is off by the angular acceleration, and the mean of that is
    the change of the rate over the mean, whatever is between. In a few blocks the change
    is not known so well, and the peak counts. It counts, and fades, also for accelerometers,
    because what they rectify of a vibration is no part of that change.
    """
    moves = 1.0 if kf.noise.regime == MOTION else 0.0
    place = params.layout.delays[params.unit[i]]
    delay_variance = kf.states.p[place, place] if place >= 0 else 0.0
    swing = moves * kf.peak_turn[i]
    rectifies = params.louder < math.inf
    if rectifies or size < FEWEST_BLOCKS * params.length:
        part = min(1.0, FEWEST_BLOCKS * params.length / size)
        return part * (kf.peak_extra[i] + delay_variance * swing * swing)
    timing_error = params.timing[i] * inference.angular_acceleration[i]
    if place >= 0:
        delay_variance += kf.states.x[place] * kf.states.x[place]
    # The mean of the second derivative of the rate is the change of the first.
    second_order = delay_variance * swing / (size * params.period)
    return (
        timing_error * timing_error
        + second_order * second_order
        + kf.peak_unresolved[i] * params.length / size
    )


@compiled
def add_noise(
    params: Constants, kf: Estimator, inference: Inference, size: int
) -> None:
    """Add noise and moves of the biases, and what delays and nonlinearity make in motion."""
    moves = 1.0 if kf.noise.regime == MOTION else 0.0
    for i in range(params.sensors.n):
        noise = noise_of_mean(params, kf.noise, i, size)
        noise += inference.louder[i] / size
        speed = moves * (kf.total.speed[i] - inference.before.speed[i]) / size
        nonlinear_error = params.nonlinearity[i] * speed
        moved = inference.moved * inference.moved
        inference.covariance[i, i] += noise + nonlinear_error * nonlinear_error
        inference.covariance[i, i] += moved + kf.force_variance
        inference.covariance[i, i] += variance_by_turn(params, kf, inference, i, size)
    add_displacement_of_mean(params, kf, inference.before, size, inference.covariance)


@compiled
def add_line(params: Constants, kf: Estimator, inference: Inference, size: int) -> None:
    """Add vibration to the covariance: channels with the same line are not independent."""
    n = params.sensors.n
    longest = kf.noise.longest
    for i in range(n):
        for j in range(n):
            slow = 1.0
            if size >= params.length:
                slow = math.sqrt(longest[i] * longest[j])
            inference.covariance[i, j] += kf.shared.line_covariance[i, j] * slow / size


@compiled
def redundancy(mask: int, n: int) -> int:
    """Return how many channels a set has beyond the three that determine a rate."""
    count = -3
    for i in range(n):
        count += mask >> i & 1
    return count


@compiled
def reduce(inference: Inference, n: int, k: int) -> None:
    """Compute D' u and D' A D for the first k directions."""
    direction = inference.direction
    information = inference.parity.information
    for p in range(k):
        inference.along[p] = dot(direction[p], inference.u, n)
        for q in range(p + 1):
            total = 0.0
            for i in range(n):
                if direction[p, i] != 0.0:
                    for j in range(n):
                        total += direction[p, i] * information[i, j] * direction[q, j]
            inference.matrix[p, q] = inference.matrix[q, p] = total


@compiled
def log_ratio(inference: Inference, n: int, k: int, given: float) -> float:
    """Return the log likelihood ratio of errors along the first k directions.

    ``given`` is the variance of the amplitudes; with 0 the estimate takes its place.
    """
    reduce(inference, n, k)
    for p in range(k):
        # The matrix of channels that look alike is singular.
        inference.matrix[p, p] += ROUNDING * inference.matrix[p, p]
        if not inference.matrix[p, p] > 0.0:
            return NO_LOG
    invert(inference.matrix, k, inference.inverse)
    inference.fit = 0.0
    t = given
    for p in range(k):
        inference.amplitude[p] = dot(inference.inverse[p], inference.along, k)
        inference.fit += 0.5 * inference.amplitude[p] * inference.along[p]
        if given == 0.0:
            t += (
                inference.amplitude[p] * inference.amplitude[p]
                + inference.inverse[p, p]
            ) / k
    for p in range(k):
        inference.matrix[p, p] += 1.0 / t
    log_det = invert(inference.matrix, k, inference.inverse) + k * math.log(t)
    gain = 0.0
    for p in range(k):
        for q in range(k):
            gain += (
                0.5 * inference.along[p] * inference.inverse[p, q] * inference.along[q]
            )
    return gain - 0.5 * log_det


@compiled
def add(
    inference: Inference, n: int, k: int, log_odds: float, members: int, whole: bool
) -> None:
    """Add the hypothesis of k directions whose ratio was computed last."""
    for i in range(n):
        inference.errors[inference.count, i] = 0.0
        for p in range(k):
            inference.errors[inference.count, i] += (
                inference.direction[p, i] * inference.amplitude[p]
            )
    inference.odds[inference.count] = log_odds
    inference.fits[inference.count] = inference.fit
    inference.members[inference.count] = members
    inference.shifts[inference.count] = 0.0
    inference.whole[inference.count] = whole
    inference.count += 1


@compiled
def set_direction(inference: Inference, n: int, k: int, channel: int) -> None:
    """Make direction k the unit vector of a channel."""
    for i in range(n):
        inference.direction[k, i] = 1.0 if i == channel else 0.0


@compiled
def add_channels(inference: Inference, n: int) -> None:
    """Add each channel, and each pair where enough checks exist."""
    free = redundancy(inference.mask, n)
    information = inference.parity.information
    for i in range(n):
        inference.error[i] = 0.0
        if inference.judged >> i & 1:
            set_direction(inference, n, 0, i)
            odds = log_ratio(inference, n, 1, 0.0)
            inference.error[i] = inference.amplitude[0]
            add(inference, n, 1, odds - AMPLITUDE_COST, 1 << i, False)
    if free < 2:
        return
    prior = (
        math.log((COINCIDENCE if free > 2 else TWO_CHECKS * COINCIDENCE) / n)
        - 2.0 * AMPLITUDE_COST
    )
    for i in range(n):
        for j in range(i):
            if inference.judged >> i & 1 and inference.judged >> j & 1:
                aii = information[i, i]
                ajj = information[j, j]
                aij = information[i, j]
                # One of two indistinguishable channels is enough.
                if aii * ajj - aij * aij > 1e-3 * aii * ajj:
                    set_direction(inference, n, 0, i)
                    set_direction(inference, n, 1, j)
                    add(
                        inference,
                        n,
                        2,
                        prior + log_ratio(inference, n, 2, 0.0),
                        1 << i | 1 << j,
                        False,
                    )


@compiled
def add_units(params: Constants, inference: Inference) -> None:
    """Add each whole unit: any errors of its channels, moves of its biases, its gain, its delay."""
    n = params.sensors.n
    axes = params.sensors.axes
    rate = inference.rate
    prior = math.log(COINCIDENCE / max(params.units, 1))
    inference.alone = False
    for unit in range(params.units):
        inside = params.members[unit] & inference.mask
        count = 0
        for i in range(n):
            if inside >> i & 1 and count < 3:
                set_direction(inference, n, count, i)
                count += 1
        if count < 2 or inside == inference.mask:
            continue
        # The others check only some axes of the unit: the rest explains as much.
        add(
            inference,
            n,
            count,
            prior - count * AMPLITUDE_COST + log_ratio(inference, n, count, 0.0),
            inside,
            False,
        )
        explains = leaves_noise(inference, n, inside, inference.fit)
        inference.alone = explains or inference.alone != 0
        if inference.moved > 0.0:
            std = WARMS_BY * inference.moved
            odds = log_ratio(inference, n, count, std * std)
            add(inference, n, count, prior + odds, inside, True)
        for way in range(2):
            std = GAIN_STD if way == 0 else DELAY_STD
            for i in range(n):
                size = inference.angular_acceleration[i]
                if way == 0:
                    size = along(axes[i], rate)
                inference.direction[0, i] = size if inside >> i & 1 else 0.0
            odds = log_ratio(inference, n, 1, std * std)
            if odds > NO_LOG:
                whole = way == 1 or not params.gain_is_fault
                add(inference, n, 1, prior + odds, inside, whole)
        add_ranges(params, inference, inside, prior)


@compiled
def add_ranges(
    params: Constants, inference: Inference, inside: int, prior: float
) -> None:
    """Add each wrong range of a unit, which shows rate and biases times a gain, to the mean of a steady turn.

    The determinants are those of the unknown rate. Where what the biases have in common
    is unknown, a rate and biases with a wrong range explain any mean, and only these tell.
    The prior is flat in the geometric mean of the right and the wrong reading of the rate.
    So of two units, one with a gain and the other one with its inverse are equally likely.
    """
    if not inference.steady:
        return
    n = params.sensors.n
    known = factorise(inference.parity.normal, 3, inference.inverse)
    for gain in WRONG_GAINS:
        set_range(params, inference, inside, gain)
        inference.fit = inference.total - rest_of_range(params, inference)
        shown = SHOWN_SHARE * min(gain, 1.0)
        assumed = dot(inference.amplitude, inference.amplitude, 3)
        if square(inference.rate) < shown * shown * assumed:
            continue
        log_det = factorise(inference.matrix, 3, inference.inverse)
        for i in range(n):
            reading = inference.bias[i]
            reading += along(params.sensors.axes[i], inference.amplitude)
            inference.direction[0, i] = reading if inside >> i & 1 else 0.0
        inference.amplitude[0] = gain - 1.0
        odds = prior - math.log(len(WRONG_GAINS)) + inference.fit
        odds += 0.5 * (known - log_det) + 1.5 * math.log(gain)
        add(inference, n, 1, odds, inside, False)


@compiled
def set_range(
    params: Constants, inference: Inference, inside: int, gain: float
) -> None:
    """Set the gain of each channel where one unit has a wrong range, and the values without scaled biases."""
    for i in range(params.sensors.n):
        inference.gain[i] = gain if inside >> i & 1 else 1.0
        excess = inference.gain[i] - 1.0
        inference.of_range[i] = inference.y[i] - excess * inference.bias[i]


@compiled
def rest_of_range(params: Constants, inference: Inference) -> float:
    """Return half the chi-square that the likeliest rate leaves with the gains set.

    ``inference.amplitude`` is that rate, rad/s.
    """
    n = params.sensors.n
    axes = params.sensors.axes
    gain = inference.gain
    weight = inference.parity.weight
    for a in range(3):
        inference.along[a] = 0.0
        for b in range(3):
            inference.matrix[a, b] = UNKNOWN_RATE if a == b else 0.0
    rest = 0.0
    for i in range(n):
        if inference.mask >> i & 1:
            weighted = dot_in(weight[i], inference.of_range, n, inference.mask)
            rest += 0.5 * inference.of_range[i] * weighted
            for a in range(3):
                inference.along[a] += gain[i] * axes[i, a] * weighted
            for j in range(n):
                both = gain[i] * weight[i, j] * gain[j]
                for a in range(3):
                    for b in range(a + 1):
                        inference.matrix[a, b] += axes[i, a] * both * axes[j, b]
    invert(inference.matrix, 3, inference.inverse)
    for a in range(3):
        inference.amplitude[a] = dot(inference.inverse[a], inference.along, 3)
    return rest - 0.5 * dot(inference.amplitude, inference.along, 3)


@compiled
def add_shifts(inference: Inference, n: int, largest: float) -> None:
    """Add shifts of all biases, as where motors start or a boost begins: no channel is faulty.

    ``largest`` is the size of the largest one, rad/s.
    """
    few = redundancy(inference.mask, n) <= FEW_CHECKS
    likely = SHIFTED_AMONG_FEW if few else SHIFTED
    if inference.slow and (few or not inference.alone):
        likely = SHIFTED_SLOWLY
    prior = math.log(likely / SHIFTS)
    std = SMALLEST_SHIFT * largest
    set_direction(inference, n, 0, -1)
    for _ in range(SHIFTS):
        odds = prior + log_ratio_of_shift(inference, n, std)
        add(inference, n, 1, odds, 0, True)
        inference.shifts[inference.count - 1] = std
        std *= 2.0


@compiled
def log_ratio_of_shift(inference: Inference, n: int, std: float) -> float:
    """Return the log likelihood ratio of independent errors of all channels, rad/s.

    With T = std^2 I the ratio is ``u' (A + T^-1)^-1 u / 2 - log det(I + T A) / 2``.
    ``inference.fit`` is its first part.
    """
    information = inference.parity.information
    factor = inference.parity.weight
    whitened = inference.whitened
    for i in range(n):
        for j in range(i):
            factor[i, j] = information[i, j]
        factor[i, i] = information[i, i] + 1.0 / (std * std)
    log_det = factorise(factor, n, factor) + 2.0 * n * math.log(std)
    inference.fit = 0.0
    for i in range(n):
        rest = inference.u[i] - dot(factor[i], whitened, i)
        whitened[i] = rest / factor[i, i]
        inference.fit += 0.5 * whitened[i] * whitened[i]
    return inference.fit - 0.5 * log_det


@compiled
def update_spread(inference: Inference, n: int, total: float) -> None:
    """Update the mean products of the errors over all hypotheses.

    ``inference.odds`` holds the share of each hypothesis, times ``total``.
    """
    for i in range(n):
        for j in range(n):
            inference.error_products[i, j] = 0.0
    for k in range(inference.count):
        share = inference.odds[k] / total
        if share > 1e-4:
            for i in range(n):
                for j in range(n):
                    inference.error_products[i, j] += (
                        share * inference.errors[k, i] * inference.errors[k, j]
                    )


@compiled
def largest_of(inference: Inference) -> int:
    """Return the index of the likeliest hypothesis not yet taken."""
    best = 0
    for k in range(inference.count):
        if inference.odds[k] > inference.odds[best]:
            best = k
    return best


@compiled
def leaves_noise(inference: Inference, n: int, members: int, fit: float) -> bool:
    """Whether a hypothesis leaves only noise of the mean, of which it explains ``fit``."""
    free = redundancy(inference.mask & ~members, n)
    rest = 2.0 * (inference.total - fit)
    return rest <= FIT + FIT_PER_CHECK * max(free, 0)


@compiled
def update_best(inference: Inference, n: int) -> None:
    """Record the likeliest hypothesis, and whether it leaves only noise."""
    best = largest_of(inference)
    inference.log_odds = inference.odds[best]
    inference.likeliest = inference.members[best]
    inference.shift = inference.shifts[best]
    inference.fit_of_best = inference.fits[best]
    inference.fitted = leaves_noise(
        inference, n, inference.likeliest, inference.fit_of_best
    )
    inference.largest = 0.0
    for i in range(n):
        if inference.likeliest >> i & 1:
            inference.largest = max(inference.largest, abs(inference.error[i]))


@compiled
def choose(inference: Inference, n: int, confidence: float) -> None:
    """Take the likeliest hypotheses until their odds add up to the confidence.

    A channel in all these hypotheses is faulty. If one hypothesis is a shift,
    or a unit that measures motion wrongly, all gyros may be healthy and no channel is
    named.
    """
    update_best(inference, n)
    top = inference.log_odds
    total = 0.0
    for k in range(inference.count):
        inference.odds[k] = math.exp(max(inference.odds[k] - top, -700.0))
        total += inference.odds[k]
    update_spread(inference, n, total)
    mass = 0.0
    union = 0
    common = -1
    enough = 1.0 - SET_MARGIN * (1.0 - confidence)
    some_whole = False
    inference.may_be_shift = False
    for _ in range(inference.count):
        if mass >= confidence * total:
            break
        best = largest_of(inference)
        # A set of one channel would look like a name, so the next one joins.
        if mass < enough * total or union & (union - 1) == 0:
            union |= inference.members[best]
        mass += inference.odds[best]
        inference.odds[best] = 0.0
        common &= inference.members[best]
        some_whole = some_whole or inference.whole[best] != 0
        if inference.shifts[best] > 0.0:
            inference.may_be_shift = True
    # Three channels are a unit. All pairs in it are unlikely, so each of the three is faulty.
    few = redundancy(common, n) <= 0
    named = inference.fitted and common > 0 and few and not some_whole
    inference.common = common if named else 0
    explained = inference.fitted and inference.shift == 0.0
    inference.union = union if explained else inference.judged


@compiled
def fill_total(params: Constants, inference: Inference) -> float:
    """Calculate u = A y and y' A y / 2 of the mean; return log determinants as `fill_joint_parity` does."""
    n = params.sensors.n
    log_det = fill_joint_parity(
        inference.parity,
        params.sensors,
        inference.mask,
        inference.covariance,
        UNKNOWN_RATE,
    )
    inference.total = 0.0
    for i in range(n):
        information = inference.parity.information[i]
        inference.u[i] = dot_in(information, inference.y, n, inference.mask)
        if inference.mask >> i & 1:
            inference.total += 0.5 * inference.u[i] * inference.y[i]
    return log_det


@compiled
def explain(params: Constants, inference: Inference) -> None:
    """Find the smallest set of hypotheses that holds the truth with the wanted confidence."""
    n = params.sensors.n
    fill_total(params, inference)
    inference.count = 0
    add_channels(inference, n)
    inference.small = inference.count
    add_units(params, inference)
    if inference.may_shift:
        add_shifts(inference, n, params.largest_move)
    choose(inference, n, params.confidence)


@compiled
def explain_with_misfit(params: Constants, inference: Inference) -> None:
    """Explain the mean with a model error in proportion to the fault."""
    explain(params, inference)
    misfit = MISFIT * inference.largest
    for i in range(params.sensors.n):
        inference.covariance[i, i] += misfit * misfit
    explain(params, inference)


@compiled
def unexplained(inference: Inference, n: int) -> float:
    """Return the standard deviation of independent errors of all channels that explains the mean, rad/s."""
    trace = 0.0
    for i in range(n):
        if inference.mask >> i & 1:
            trace += inference.parity.information[i, i]
    square = max(2.0 * inference.total - redundancy(inference.mask, n), 0.0) / max(
        trace, 1e-12
    )
    return math.sqrt(square)
