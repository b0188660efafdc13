# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A block of 40 ms: its motion, its innovations, and the correction of the states by it."""

from __future__ import annotations

import math

from fdi_ros.compiling.compiled import compiled
from fdi_ros.core.algebra import along, dot_in, square, variance_along
from fdi_ros.core.parity import (
    LEAST_IN_RESIDUAL,
    UNKNOWN_RATE,
    fill_joint_parity,
    fill_parity,
)
from fdi_ros.core.subsets import number_in
from fdi_ros.estimator.displacement import add_displacement_of_block
from fdi_ros.estimator.error_states import (
    ONE,
    RATE_X,
    SIGNALS,
    SPEED,
    TURN,
    fill_signals,
    keep_least_variance,
    project,
    subtract_errors,
    update,
)
from fdi_ros.estimator.estimator import (
    BLOCK_TIME,
    FAST_STAGES,
    LEAST_NOISE_SHARE,
    REST_BLOCKS,
    SLOW_MOTION,
    Constants,
    Estimator,
    update_weights,
    usual_chi,
)
from fdi_ros.estimator.noise import MOTION, REST
from fdi_ros.estimator.shared_noise import UNEQUAL
from fdi_ros.model.samples import Array

TURNING_RATIO = 20.0
"""Ratio of the squared angular acceleration to its noise variance from which the body
turns. If noise passed for motion, delays of zero would be learned."""
FAST_GAIN = 1.0 - math.exp(-2.0 * math.pi * SLOW_MOTION * BLOCK_TIME)
"""Gain of one stage of the high pass, per block."""
PEAK = 0.8  # factor per block on the peaks of motion: they fade within half a second


@compiled
def fused_variance(params: Constants, kf: Estimator, variance: Array) -> float:
    """Largest variance of the fused rate about an axis by independent noise, (rad/s)^2.

    ``variance`` (n,) is the noise of the channels, (rad/s)^2.
    """
    largest = 0.0
    for a in range(3):
        gain = kf.fused.gain[a]
        largest = max(largest, variance_along(gain, variance, params.sensors.n))
    return largest


@compiled
def update_acceleration(params: Constants, kf: Estimator) -> float:
    """Angular acceleration in the middle of the block before, into ``kf.acceleration``. Return its variance by noise.

    It is the difference of block means. Where the rates at the ends of the block
    contradict that difference, as under vibration faster than a block, ``kf.shaken``
    holds the square of the contradiction.
    """
    ahead = kf.times[0] - kf.times[1]
    behind = kf.times[1] - kf.times[2]
    span = kf.ended[1] - kf.ended[2]
    # Weights of the two differences, exact to second order for unequal distances.
    first = behind / (ahead * (kf.times[0] - kf.times[2]))
    last = ahead / (behind * (kf.times[0] - kf.times[2]))
    contradiction = 0.0
    for a in range(3):
        later = kf.rates[0, a] - kf.rates[1, a]
        earlier = kf.rates[1, a] - kf.rates[2, a]
        kf.acceleration[a] = first * later + last * earlier
        between_ends = (kf.ends[1, a] - kf.ends[2, a]) / span
        deviation = between_ends - kf.acceleration[a]
        contradiction += deviation * deviation
    weights = first * first + last * last + (last - first) * (last - first)
    noise = weights * fused_variance(params, kf, kf.noise.now.block) / params.length
    of_ends = fused_variance(params, kf, kf.noise.now.sample) * (2.0 / (span * span))
    is_whole = span <= 2.0 * params.length * params.period
    # Vibration faster than a block is not resolved, so its traces must not be learned as a delay.
    is_shaken = is_whole and contradiction > TURNING_RATIO * of_ends
    kf.shaken = contradiction if is_shaken else 0.0
    kf.usual_shaken += (kf.shaken - kf.usual_shaken) / REST_BLOCKS
    return noise


@compiled
def update_angular_acceleration(params: Constants, kf: Estimator) -> None:
    """Update the angular acceleration along each channel in the block before, and the extra variance.

    The extra variance goes beyond noise and states: the second order of delays, the
    sampling instants of single channels, and scale errors that are not linear in the
    rate.
    """
    noise = update_acceleration(params, kf)
    kf.turn_noise = noise
    # At rest a rate on which no channels agree is a fault, not motion.
    is_fast = square(kf.acceleration) > TURNING_RATIO * noise + kf.shaken
    kf.turning = is_fast and kf.noise.regime == MOTION
    for i in range(params.sensors.n):
        if kf.noise.regime == REST:
            kf.angular_acceleration[i] = 0.0
            kf.extra[i] = kf.unresolved_variance[i] = 0.0
        else:
            update_extra_variance(params, kf, i)


@compiled
def update_extra_variance(params: Constants, kf: Estimator, i: int) -> None:
    """Update the angular acceleration along channel i in motion, and its extra variance."""
    ahead = kf.times[0] - kf.times[1]
    behind = kf.times[1] - kf.times[2]
    noise = kf.turn_noise
    axis = params.sensors.axes[i]
    turn = along(axis, kf.acceleration)
    speed = along(axis, kf.rates[1])
    jerk = newest_turn = 0.0
    for a in range(3):
        after = (kf.rates[0, a] - kf.rates[1, a]) / ahead
        before = (kf.rates[1, a] - kf.rates[2, a]) / behind
        newest_turn += axis[a] * after
        jerk += axis[a] * 2.0 * (after - before) / (ahead + behind)
    kf.angular_acceleration[i] = turn if kf.turning else 0.0
    largest_turn = max(abs(turn), abs(newest_turn))
    surely_turns = max(largest_turn - 2.0 * math.sqrt(noise), 0.0)
    timing_error = params.timing[i] * surely_turns
    nonlinear_error = params.nonlinearity[i] * speed
    kf.extra[i] = timing_error * timing_error + nonlinear_error * nonlinear_error
    kf.unresolved_variance[i] = 0.0
    place = params.layout.delays[params.unit[i]]
    if place < 0:
        return
    states = kf.states
    delay_square = states.p[place, place] + states.x[place] * states.x[place]
    second_order = 0.5 * delay_square * jerk if kf.turning else 0.0
    kf.unresolved_variance[i] = delay_square * (noise + kf.shaken)
    kf.extra[i] += kf.unresolved_variance[i] + second_order * second_order


@compiled
def judge_block(params: Constants, kf: Estimator) -> float:
    """Work out the innovations A (y - C x) of the block before. Return the block's weight: 1, or less if improbable."""
    n = params.sensors.n
    noise = kf.noise
    layout = params.layout
    for a in range(3):
        kf.signal_rate[a] = kf.rates[1, a] if noise.regime == MOTION else 0.0
    fill_signals(layout, kf.signal_rate, kf.angular_acceleration, kf.block_at.signals)
    project(layout, kf.states, kf.block_at)
    mask = kf.masks[1]
    for i in range(n):
        # Samples of a slower unit lie elsewhere in the block.
        kf.means[1, i] -= kf.angular_acceleration[i] * kf.middles[1, i]
        for j in range(n):
            kf.matrix[i, j] = kf.block_at.covariance[i, j]
        kf.block_noise[i] = noise.now.block[i] * noise.longest[i] / params.length
        kf.matrix[i, i] += kf.block_noise[i] + kf.extra[i] + kf.force_variance
    add_displacement_of_block(params, kf, kf.matrix)
    fill_joint_parity(kf.block_parity, params.sensors, mask, kf.matrix, UNKNOWN_RATE)
    subtract_errors(
        layout, kf.states, kf.block_at.signals, kf.means[1], kf.block_innovation
    )
    chi = 0.0
    information = kf.block_parity.information
    for i in range(n):
        kf.block_values[i] = 0.0
        noise.share[i] = 1.0
        if mask >> i & 1:
            kf.block_values[i] = dot_in(information[i], kf.block_innovation, n, mask)
            chi += kf.block_values[i] * kf.block_innovation[i]
        if information[i, i] > 0.0:
            by_noise = variance_along(information[i], kf.block_noise, n)
            noise.share[i] = max(by_noise / information[i, i], LEAST_NOISE_SHARE)
        for j in range(n):
            kf.block_information[i, j] = information[i, j]
    free = number_in(mask, n) - 3.0
    return min(1.0, usual_chi(free) / max(chi, 1e-9))


@compiled
def update_incoherent(params: Constants, kf: Estimator) -> None:
    """Update how much each channel deviates from the others beside what a delay explains.

    The deviation of a late channel is proportional to its angular acceleration. Noise and
    vibration that units do not share deviate and pass for angular acceleration alike,
    and the learned noise may be far too small for them.
    """
    share = 1.0 / REST_BLOCKS
    for i in range(params.sensors.n):
        own = kf.block_information[i, i]
        if not kf.masks[1] >> i & 1 or not own > 0.0:
            continue
        turn = kf.angular_acceleration[i]
        begins = kf.deviation_square[i] == 0.0
        slope = kf.deviation_turn[i] / max(kf.turn_square[i], 1e-12)
        value = kf.block_values[i] / own
        kf.deviation[i] += share * (value - kf.deviation[i])
        value -= kf.deviation[i]
        kf.deviation_square[i] += share * (value * value - kf.deviation_square[i])
        kf.deviation_turn[i] += share * (value * turn - kf.deviation_turn[i])
        kf.turn_square[i] += share * (turn * turn - kf.turn_square[i])
        # A delay that was not known yet must not pass for noise.
        rest = 0.0 if begins else value - slope * turn
        slope = kf.deviation_turn[i] / max(kf.turn_square[i], 1e-12)
        lately = kf.deviation_square[i] - slope * kf.deviation_turn[i]
        # The other channels have at least half of it.
        kf.incoherent[i] = 0.5 * max(lately, rest * rest)


@compiled
def update_fast_motion(kf: Estimator) -> None:
    """Update how much of the squared angular acceleration is faster than `SLOW_MOTION`."""
    share = 1.0 / REST_BLOCKS
    fast = total = 0.0
    for a in range(3):
        value = kf.rates[1, a]
        for stage in range(FAST_STAGES):
            kf.slow_rates[stage, a] += FAST_GAIN * (value - kf.slow_rates[stage, a])
            value -= kf.slow_rates[stage, a]
        change = value - kf.fast_rate[a]
        kf.fast_rate[a] = value
        fast += change * change
        change = kf.rates[1, a] - kf.rates[2, a]
        total += change * change
    square_of_span = kf.span * kf.span
    kf.fast_square += share * (fast / square_of_span - kf.fast_square)
    kf.all_square += share * (total / square_of_span - kf.all_square)


@compiled
def fast_share(params: Constants, kf: Estimator) -> float:
    """Return the share of the squared angular acceleration that is faster than `SLOW_MOTION`.

    The noise that the settings expect is no motion. The learned noise contains vibration.
    """
    noise = fused_variance(params, kf, params.expected) / params.length
    change = 6.0 * noise / (kf.span * kf.span)  # of two blocks, about three axes
    return max(kf.fast_square - change, 0.0) / max(kf.all_square, 1e-12)


@compiled
def contradiction(params: Constants, kf: Estimator, u: int) -> float:
    """Variance of the delay that the channels of unit u show beside one delay of them all, s^2.

    Vibration reaches every axis of a unit with a phase of its own, which looks like a
    delay of that axis alone.
    """
    product = turns = squares = 0.0
    for i in range(params.sensors.n):
        if params.unit[i] == u:
            product += kf.deviation_turn[i]
            turns += kf.turn_square[i]
            squares += kf.deviation_square[i]
    turns = max(turns, 1e-12)
    return max(squares - product * product / turns, 0.0) / turns


@compiled
def unlearnable(error: float, inside: float, signal_square: float) -> float:
    """Return the variance of a scale error that no number of samples removes.

    ``error`` is the error variance of a channel, ``signal_square`` the mean square of the
    signal, and ``inside`` the part of it that may be vibration. Units see
    vibration differently, so vibration looks like a scale error of the signal.
    """
    signal_square = max(signal_square, 1e-12)
    return error / signal_square * min(1.0, inside / signal_square)


@compiled
def mean_variance(params: Constants, kf: Estimator, i: int, unknown: float) -> float:
    """Noise variance of a block's mean of channel i, (rad/s)^2.

    ``unknown`` is the factor for slow noise that was not measured yet. 1 leaves it out.
    """
    noise = kf.noise
    return noise.now.block[i] * noise.longest[i] * unknown / params.length


@compiled
def hidden_vibration(
    params: Constants, kf: Estimator, i: int, a: int, unknown: float
) -> float:
    """Mean square of the vibration about axis a that may hide in the noise of channel i, (rad/s)^2."""
    noise = kf.noise
    axis = params.sensors.axes[i, a]
    share = axis * axis / (UNEQUAL * UNEQUAL * params.length)
    return share * noise.now.block[i] * noise.longest[i] * unknown


@compiled
def largest_vibration(params: Constants, kf: Estimator) -> float:
    """Largest mean square of a vibration that the units may see differently, (rad/s)^2."""
    largest = 0.0
    for a in range(3):
        largest = max(largest, kf.shared.vibration[a])
        for i in range(params.sensors.n):
            largest = max(largest, hidden_vibration(params, kf, i, a, 1.0))
    return largest


@compiled
def unshared_vibration(params: Constants, kf: Estimator, i: int) -> float:
    """Largest mean square of what the unit of channel i and the first do not share, (rad/s)^2."""
    largest = 0.0
    for j in range(params.sensors.n):
        if params.unit[j] == 0 or params.unit[j] == params.unit[i]:
            largest = max(largest, kf.incoherent[j])
    return largest


@compiled
def keep_rate_variances(params: Constants, kf: Estimator, a: int) -> None:
    """Set the least variance of the states by the rate about axis a."""
    n = params.sensors.n
    inside = kf.shared.vibration[a]
    for i in range(n):
        unknown = kf.noise.unknown[i]
        inside = max(inside, hidden_vibration(params, kf, i, a, unknown))
    # A vibration peak is not motion.
    rate_square = kf.signal_rate[a] * kf.signal_rate[a]
    kf.usual_rate[a] += (rate_square - kf.usual_rate[a]) / REST_BLOCKS
    for i in range(n):
        error = mean_variance(params, kf, i, kf.noise.unknown[i])
        least = unlearnable(error, inside, kf.usual_rate[a])
        keep_least_variance(params.layout, i, RATE_X + a, least, kf.least_variance)


@compiled
def keep_speed_variance(params: Constants, kf: Estimator, i: int) -> None:
    """Set the least variance of the state by the rate along channel i."""
    speed_square = inside = 0.0
    for a in range(3):
        share = params.sensors.axes[i, a] * params.sensors.axes[i, a]
        speed_square += share * kf.usual_rate[a]
        inside += share * kf.shared.vibration[a]
    error = mean_variance(params, kf, i, kf.noise.unknown[i])
    inside = max(inside, error / (UNEQUAL * UNEQUAL))
    least = unlearnable(error, inside, speed_square)
    keep_least_variance(params.layout, i, SPEED, least, kf.least_variance)


@compiled
def keep_delay_variance(
    params: Constants, kf: Estimator, i: int, vibration: float
) -> None:
    """Set the least variance of the delay of channel i.

    ``vibration`` is the mean square of the vibration that may pass for an angular
    acceleration, (rad/s)^2. The noise counts with the square root of the unknown slow
    noise: with the full factor no delay is learned in the first seconds of motion.
    """
    error = mean_variance(params, kf, i, math.sqrt(kf.noise.unknown[i]))
    error = max(error, kf.incoherent[i])
    turn = kf.angular_acceleration[i]
    # A delay is that against the first unit.
    unshared = unshared_vibration(params, kf, i) / (UNEQUAL * UNEQUAL)
    inside = 0.5 * max(vibration, unshared) / (kf.span * kf.span)
    least = unlearnable(error, inside, turn * turn)
    keep_least_variance(params.layout, i, TURN, least, kf.least_variance)


@compiled
def update_least_variances(params: Constants, kf: Estimator) -> None:
    """Find the variance that each state of the motion keeps at least. Biases keep none."""
    for r in range(params.layout.count):
        kf.least_variance[r] = 0.0
    if kf.rest:
        return
    for a in range(3):
        keep_rate_variances(params, kf, a)
    vibration = largest_vibration(params, kf)
    for i in range(params.sensors.n):
        keep_speed_variance(params, kf, i)
        keep_delay_variance(params, kf, i, vibration)


@compiled
def learn(params: Constants, kf: Estimator, weight: float) -> None:
    """Correct the states by the block before. At rest the rate is zero, so the estimated rate is no signal."""
    n = params.sensors.n
    layout = params.layout
    kept = kf.masks[1] & ~kf.under_test
    if kf.rest:
        for i in range(n):
            for j in range(n):
                kf.matrix[i, j] -= kf.block_at.covariance[i, j]
            for k in range(SIGNALS):
                if layout.by[k] != ONE:
                    kf.block_at.signals[i, k] = 0.0
        project(layout, kf.states, kf.block_at)
        for i in range(n):
            for j in range(n):
                kf.matrix[i, j] += kf.block_at.covariance[i, j]
        subtract_errors(
            layout, kf.states, kf.block_at.signals, kf.means[1], kf.block_innovation
        )
    if kf.rest or kept != kf.masks[1]:
        prior_information = (
            1.0 / (params.rest_std * params.rest_std) if kf.rest else UNKNOWN_RATE
        )
        fill_joint_parity(
            kf.block_parity, params.sensors, kept, kf.matrix, prior_information
        )
    update_least_variances(params, kf)
    for u in range(1, params.units):
        place = layout.delays[u]
        kf.delay_variance_before[u] = kf.states.p[place, place]
    update(
        layout,
        kf.states,
        kf.block_at,
        kf.block_parity.information,
        kf.block_innovation,
        weight,
        kf.least_variance,
    )
    follow_taught_delays(params, kf)


@compiled
def follow_taught_delays(params: Constants, kf: Estimator) -> None:
    """Follow the part of each delay that fast motion has taught in which the axes of a unit contradict.

    A block leaves a share g of a delay x as it was: x <- g x + (1 - g) d. If d is wrong
    by the same amount in all blocks of a vibration, its error follows the same equation.
    """
    if kf.rest or params.units < 2:
        return
    share = 0.5 * fast_share(params, kf)
    of_first = contradiction(params, kf, 0)
    for u in range(1, params.units):
        place = params.layout.delays[u]
        before = kf.delay_variance_before[u]
        kept = kf.states.p[place, place] / before if before > 0.0 else 1.0
        wrong = math.sqrt(share * (of_first + contradiction(params, kf, u)))
        kf.taught_delay[u] = kept * kf.taught_delay[u] + (1.0 - kept) * wrong


@compiled
def update_peaks(
    params: Constants, kf: Estimator, i: int, moves: bool, turns: bool
) -> None:
    """Update the peaks of channel i, which fade: angular acceleration and extra variances."""
    ahead = kf.times[0] - kf.times[1]
    axis = params.sensors.axes[i]
    turn = 0.0
    if turns:
        for a in range(3):
            turn += axis[a] * (kf.rates[0, a] - kf.rates[1, a]) / ahead
    if abs(kf.angular_acceleration[i]) > abs(turn):
        turn = kf.angular_acceleration[i]
    faded = PEAK * kf.peak_turn[i]
    kf.peak_turn[i] = turn if abs(turn) > abs(faded) else faded
    kf.peak_extra[i] = max(PEAK * kf.peak_extra[i], kf.extra[i])
    faded = PEAK * kf.peak_unresolved[i]
    kf.peak_unresolved[i] = max(faded, kf.unresolved_variance[i])
    speed = along(axis, kf.rates[0])
    nonlinear_error = params.nonlinearity[i] * speed if moves else 0.0
    faded = PEAK * kf.nonlinear_variance[i]
    kf.nonlinear_variance[i] = max(faded, nonlinear_error * nonlinear_error)


@compiled
def predict_innovation_covariance(params: Constants, kf: Estimator) -> None:
    """Predict the covariance of the next samples from the state uncertainty in the present motion."""
    n = params.sensors.n
    layout = params.layout
    ahead = kf.times[0] - kf.times[1]
    newest = 0.0
    for a in range(3):
        change = (kf.rates[0, a] - kf.rates[1, a]) / ahead
        newest += change * change
    moves = kf.noise.regime == MOTION
    turn_begins = moves and newest > 4.0 * TURNING_RATIO * kf.turn_noise
    for i in range(n):
        update_peaks(params, kf, i, moves, kf.turning or turn_begins)
    for a in range(3):
        kf.signal_rate[a] = kf.rates[0, a] if moves else 0.0
    fill_signals(layout, kf.signal_rate, kf.peak_turn, kf.at.signals)
    project(layout, kf.states, kf.at)
    for i in range(n):
        kf.displaced[i] *= PEAK
        kf.allowed[i] = kf.displaced[i]
        lately = kf.peak_extra[i] + kf.displaced[i] + kf.force_variance
        kf.at.covariance[i, i] += lately
    kf.counted_variance = kf.force_variance
    kf.speed_squared = square(kf.rates[0])
    update_weights(params, kf)


@compiled
def update_excess(params: Constants, kf: Estimator) -> None:
    """Find the largest variance of a residual over the one expected.

    A is the information with the noise expected, S the covariance of the noise of the
    moment, of lasting vibration and of the state uncertainty. The excess is the largest
    ``(A S A)_ii / A_ii``, at least 1.
    """
    n = params.sensors.n
    information = kf.expected_parity.information
    fill_parity(kf.expected_parity, params.sensors, kf.mask, params.expected)
    kf.excess = 1.0
    for i in range(n):
        if information[i, i] * params.expected[i] < LEAST_IN_RESIDUAL:
            continue
        variance = 0.0
        for j in range(n):
            for k in range(n):
                together = kf.at.covariance[j, k] + kf.shared.line_covariance[j, k]
                if j == k:
                    together += kf.noise.now.sample[j]
                variance += information[i, j] * together * information[i, k]
        kf.excess = max(kf.excess, variance / information[i, i])
