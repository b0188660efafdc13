# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A block of 40 ms: its motion, its innovations, and the correction of the states by it."""

from __future__ import annotations

import math

from fdi_ros.compiling.compiled import compiled
from fdi_ros.core.algebra import dot_in, variance_along
from fdi_ros.core.parity import UNKNOWN_RATE, fill_joint_parity, fill_parity
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
    LEAST_NOISE_SHARE,
    REST_BLOCKS,
    Constants,
    Estimator,
    update_weights,
    usual_chi,
)
from fdi_ros.estimator.noise import MOTION, REST
from fdi_ros.estimator.shared_noise import UNEQUAL

TURNING_RATIO = 20.0
"""Ratio of the squared angular acceleration to its noise variance from which the body
turns. If noise passed for motion, delays of zero would be learned."""
# Smallest share of a channel's error in its residual. Below it no method judges the
# channel.
LEAST_REDUNDANCY = 1e-3
PEAK = 0.8  # factor per block on the peaks of motion: they fade within half a second


@compiled
def update_acceleration(params: Constants, kf: Estimator) -> float:
    """Angular acceleration in the middle of the block before, into ``kf.acceleration``; return its variance by noise.

    It is the difference of block means. Where the rates at the ends of the block
    contradict that difference, as under vibration faster than a block, ``kf.shaken``
    holds the square of the contradiction.
    """
    ahead = kf.times[0] - kf.times[1]
    behind = kf.times[1] - kf.times[2]
    span = kf.ended[1] - kf.ended[2]
    whole = kf.times[0] - kf.times[2]
    # Weights of the two differences, exact to second order for unequal distances.
    first = behind / (ahead * whole)
    last = ahead / (behind * whole)
    worst = single = apart = 0.0
    for a in range(3):
        total = alone = 0.0
        for i in range(params.sensors.n):
            square = kf.fused.gain[a, i] * kf.fused.gain[a, i]
            total += square * kf.noise.now.block[i]
            alone += square * kf.noise.now.sample[i]
        worst = max(worst, total)
        single = max(single, alone)
        kf.acceleration[a] = first * (kf.rates[0, a] - kf.rates[1, a]) + last * (
            kf.rates[1, a] - kf.rates[2, a]
        )
        between = (kf.ends[1, a] - kf.ends[2, a]) / span
        apart += (between - kf.acceleration[a]) * (between - kf.acceleration[a])
    single *= 2.0 / (span * span)
    kf.shaken = 0.0
    noise = (
        (first * first + last * last + (last - first) * (last - first))
        * worst
        / params.length
    )
    if apart <= TURNING_RATIO * single or span > 2.0 * params.length * params.period:
        return noise
    # Vibration faster than a block is not resolved, so its traces must not be learned as a delay.
    kf.shaken = apart
    return noise


@compiled
def update_angular_acceleration(params: Constants, kf: Estimator) -> None:
    """Update the angular acceleration along each channel in the block before, and the extra variance.

    The extra variance goes beyond noise and states: the second order of delays, the
    sampling instants of single channels, and scale errors that are not linear in the
    rate.
    """
    n = params.sensors.n
    states = kf.states
    ahead = kf.times[0] - kf.times[1]
    behind = kf.times[1] - kf.times[2]
    noise = update_acceleration(params, kf)
    square = 0.0
    for a in range(3):
        square += kf.acceleration[a] * kf.acceleration[a]
    # At rest a rate on which no channels agree is a fault, not motion.
    turning = square > TURNING_RATIO * noise + kf.shaken and kf.noise.regime == MOTION
    kf.turning = turning
    kf.turn_noise = noise
    if kf.noise.regime == REST:
        for i in range(n):
            kf.angular_acceleration[i] = kf.extra[i] = 0.0
        return
    for i in range(n):
        along = jerk = lately = speed = 0.0
        for a in range(3):
            h = params.sensors.axes[i, a]
            along += h * kf.acceleration[a]
            speed += h * kf.rates[1, a]
            after = (kf.rates[0, a] - kf.rates[1, a]) / ahead
            before = (kf.rates[1, a] - kf.rates[2, a]) / behind
            lately += h * after
            jerk += h * 2.0 * (after - before) / (ahead + behind)
        kf.angular_acceleration[i] = along if turning else 0.0
        timing_error = params.timing[i] * max(
            max(abs(along), abs(lately)) - 2.0 * math.sqrt(noise), 0.0
        )
        nonlinear_error = params.nonlinearity[i] * speed
        kf.extra[i] = timing_error * timing_error + nonlinear_error * nonlinear_error
        place = params.layout.delays[params.unit[i]]
        if place >= 0:
            second = states.p[place, place] + states.x[place] * states.x[place]
            kf.extra[i] += second * (noise + kf.shaken) + (
                (0.5 * second * jerk) ** 2 if turning else 0.0
            )


@compiled
def judge_block(params: Constants, kf: Estimator) -> float:
    """Work out the innovations A (y - C x) of the block before; return the block's weight: 1, or less if improbable."""
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
def unlearnable(error: float, inside: float, square: float) -> float:
    """Return the variance of a scale error that no number of samples removes.

    ``error`` is the error variance of a channel, ``square`` the mean square of the
    signal, and ``inside`` the part of ``square`` that may be vibration. Units see
    vibration differently, so vibration looks like a scale error of the signal.
    """
    return error / max(square, 1e-12) * min(1.0, inside / max(square, 1e-12))


@compiled
def update_least_variances(params: Constants, kf: Estimator) -> None:
    """Find the variance that each state of the motion keeps at least; biases keep none."""
    layout = params.layout
    noise = kf.noise
    n = params.sensors.n
    for r in range(layout.count):
        kf.least_variance[r] = 0.0
    if kf.rest:
        return
    largest_vibration = 0.0
    for a in range(3):
        inside = kf.shared.vibration[a]
        largest_vibration = max(largest_vibration, inside)
        for i in range(n):
            along = (
                params.sensors.axes[i, a]
                * params.sensors.axes[i, a]
                / (UNEQUAL * UNEQUAL * params.length)
            )
            inside = max(
                inside, along * noise.now.block[i] * noise.longest[i] * noise.unknown[i]
            )
            largest_vibration = max(
                largest_vibration, along * noise.now.block[i] * noise.longest[i]
            )
        # A vibration peak is not motion.
        kf.usual_rate[a] += (
            kf.signal_rate[a] * kf.signal_rate[a] - kf.usual_rate[a]
        ) / REST_BLOCKS
        for i in range(n):
            error = (
                noise.now.block[i] * noise.longest[i] * noise.unknown[i] / params.length
            )
            least = unlearnable(error, inside, kf.usual_rate[a])
            keep_least_variance(layout, i, RATE_X + a, least, kf.least_variance)
    for i in range(n):
        along = inside = 0.0
        for a in range(3):
            share = params.sensors.axes[i, a] * params.sensors.axes[i, a]
            along += share * kf.usual_rate[a]
            inside += share * kf.shared.vibration[a]
        error = noise.now.block[i] * noise.longest[i] * noise.unknown[i] / params.length
        inside = max(inside, error / (UNEQUAL * UNEQUAL))
        least = unlearnable(error, inside, along)
        keep_least_variance(layout, i, SPEED, least, kf.least_variance)
        # Noise variance of a block as above, but with the square root of the unknown
        # slow noise: with the full factor no delay is learned in the first seconds of
        # motion.
        error = (
            noise.now.block[i]
            * noise.longest[i]
            * math.sqrt(noise.unknown[i])
            / params.length
        )
        error = max(error, kf.incoherent[i])
        largest_vibration = max(
            largest_vibration, kf.incoherent[i] / (UNEQUAL * UNEQUAL)
        )
        turn = kf.angular_acceleration[i] * kf.angular_acceleration[i]
        least = unlearnable(error, 0.5 * largest_vibration / (kf.span * kf.span), turn)
        keep_least_variance(layout, i, TURN, least, kf.least_variance)


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
    update(
        layout,
        kf.states,
        kf.block_at,
        kf.block_parity.information,
        kf.block_innovation,
        weight,
        kf.least_variance,
    )


@compiled
def predict_innovation_covariance(params: Constants, kf: Estimator) -> None:
    """Predict the covariance of the next samples from the state uncertainty in the present motion."""
    n = params.sensors.n
    layout = params.layout
    square = 0.0
    ahead = kf.times[0] - kf.times[1]
    for a in range(3):
        change = (kf.rates[0, a] - kf.rates[1, a]) / ahead
        square += change * change
    moves = kf.noise.regime == MOTION
    begins = kf.turning or (moves and square > 4.0 * TURNING_RATIO * kf.turn_noise)
    for i in range(n):
        turn = speed = 0.0
        for a in range(3):
            h = params.sensors.axes[i, a]
            turn += h * (kf.rates[0, a] - kf.rates[1, a]) / ahead
            speed += h * kf.rates[0, a]
        if not begins:
            turn = 0.0
        if abs(kf.angular_acceleration[i]) > abs(turn):
            turn = kf.angular_acceleration[i]
        kf.peak_turn[i] = (
            turn if abs(turn) > PEAK * abs(kf.peak_turn[i]) else PEAK * kf.peak_turn[i]
        )
        kf.peak_extra[i] = max(PEAK * kf.peak_extra[i], kf.extra[i])
        nonlinear_error = params.nonlinearity[i] * speed if moves else 0.0
        kf.nonlinear_variance[i] = max(
            PEAK * kf.nonlinear_variance[i], nonlinear_error * nonlinear_error
        )
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
    kf.speed_squared = kf.rates[0, 0] ** 2 + kf.rates[0, 1] ** 2 + kf.rates[0, 2] ** 2
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
        if information[i, i] * params.expected[i] < LEAST_REDUNDANCY:
            continue
        variance = 0.0
        for j in range(n):
            for k in range(n):
                together = kf.at.covariance[j, k] + kf.shared.line_covariance[j, k]
                if j == k:
                    together += kf.noise.now.sample[j]
                variance += information[i, j] * together * information[i, k]
        kf.excess = max(kf.excess, variance / information[i, i])
