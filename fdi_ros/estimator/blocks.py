# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A block of 40 ms: motion or rest, innovations, the correction of the states, and those kept from moments before.

After a fault the estimator goes back to states kept 0.12 to 490 s before, eight of each distance. The test of rest
(`rests`) is also that of calibration and inspection; the average of the biases at the start has one of its own, which
needs no estimator (`core/bias.py`), and so has the check of values that repeat (`is_at_rest` in `core/health.py`).
"""

from __future__ import annotations

import math

from fdi_ros.compiling.compiled import compiled
from fdi_ros.core.subsets import UNKNOWN_RATE, fill_joint_parity
from fdi_ros.estimator.error_states import (
    ONE,
    RATE_X,
    SIGNALS,
    TURN,
    ErrorStates,
    copy_states,
    fill_signals,
    keep_least_variance,
    predict,
    project,
    subtract_errors,
    update,
)
from fdi_ros.estimator.estimator import (
    LEAST_SHARE,
    LONG_TIME,
    REST_BLOCKS,
    SNAPSHOTS,
    TIERS,
    Constants,
    Estimator,
    update_weights,
    usual_chi,
)
from fdi_ros.estimator.noise import MOTION, REST, THREE_SIGMA
from fdi_ros.estimator.shared_noise import UNEQUAL
from fdi_ros.model.samples import Array

QUIET = (
    3.0  # variance of blocks over that of rest before: a hover in vibration has more
)
REST_STD = 3e-4  # rad/s; of the rate at rest: the rotation of the earth, and a table that vibrates
UNLEARNED = 0.003  # rad/s; biases of which less is known do not make a larger rate one of rest: it may be a turn
REST_CHI = 1.6  # scatter of the blocks of a second over that of noise: 72 degrees of freedom exceed it once in 1000
REST_LAST = 12.0  # square of the last block's distance from their mean: soon enough for motion that begins


@compiled
def rests(
    rates: Array, newest: int, variance: Array, bias_variance: Array, floor: float
) -> bool:
    """Whether the rates (`REST_BLOCKS`, c) of blocks, rad/s, scatter as noise does, about zero.

    In any order, of the body or as single channels measure it; ``newest``: place of the last. ``variance``,
    ``bias_variance`` (c,): of the noise of each and of what is not known of the biases, (rad/s)^2; ``floor``: of the
    rate at rest.
    """
    scatter = largest = last = 0.0
    for a in range(rates.shape[1]):
        mean = 0.0
        for k in range(REST_BLOCKS):
            mean += rates[k, a] / REST_BLOCKS
        for k in range(REST_BLOCKS):
            gap = rates[k, a] - mean
            scatter += gap * gap / (variance[a] + floor)
            if k == newest:
                last = max(last, gap * gap / (variance[a] + floor))
        largest = max(
            largest,
            mean * mean / (floor + variance[a] / REST_BLOCKS + bias_variance[a]),
        )
    return (
        scatter < rates.shape[1] * (REST_BLOCKS - 1) * REST_CHI
        and largest < THREE_SIGMA
        and last < REST_LAST
    )


UNWATCHED, LONG_HOLE = 3e-4, 3600.0
"""Random walk of a bias over a hole, rad/s/sqrt(s), which has gone its way, of a turn-on bias, in an hour."""
AFTER_HOLE = 5.0 * LONG_TIME
"""s of samples after a hole in which biases are compared with those before: five comparisons, and by then the states
know what they can learn of the biases."""


@compiled
def keep_snapshot(params: Constants, kf: Estimator) -> None:
    """Keep the states, so that they can be had again from before a fault."""
    tier = 0
    while tier < TIERS:
        snapshot = kf.snapshots[tier * SNAPSHOTS + kf.taken[tier] % SNAPSHOTS]
        snapshot.seconds = kf.seconds
        copy_states(params.layout, kf.states, snapshot.states)
        for u in range(params.units):
            snapshot.late[u] = kf.late[u]
        kf.taken[tier] += 1
        if kf.taken[tier] % SNAPSHOTS != 1:
            return
        tier += 1


@compiled
def pass_hole(params: Constants, kf: Estimator, seconds: float) -> None:
    """Let the biases be others after a hole, in all states kept too: what changed in it is compared with those."""
    if not is_after_hole(params, kf):
        kf.hole_at, kf.hole_sample = kf.seconds - seconds, kf.samples
    move_biases(params, kf, UNWATCHED * math.sqrt(min(seconds, LONG_HOLE)), 0.0)


@compiled
def is_after_hole(params: Constants, kf: Estimator) -> bool:
    """Whether there was a hole in the stream lately."""
    return (
        kf.hole_sample > 0
        and (kf.samples - kf.hole_sample) * params.period < AFTER_HOLE
    )


@compiled
def move_biases(params: Constants, kf: Estimator, std: float, rate_std: float) -> None:
    """Let all biases be others by so much, rad/s, and their rates of change, rad/s^2; now and in all states kept."""
    add_to_biases(params, kf.states, std, rate_std)
    for k in range(TIERS * SNAPSHOTS):
        add_to_biases(params, kf.snapshots[k].states, std, rate_std)


@compiled
def add_to_biases(
    params: Constants, states: ErrorStates, std: float, rate_std: float
) -> None:
    """Add to the variances of the biases and of their rates of change."""
    for r in range(params.layout.count):
        if r < params.sensors.n:
            states.p[r, r] += std * std
        elif 0 <= params.layout.feeds[r] < params.sensors.n:
            states.p[r, r] += rate_std * rate_std


@compiled
def inflate_delays(params: Constants, kf: Estimator, units: int) -> None:
    """Let delays be others: of the units all of whose channels are among some; of the first, against which all are."""
    for u in range(1, params.units):
        if params.members[u] & ~units == 0 or params.members[0] & ~units == 0:
            place = params.layout.delays[u]
            kf.states.p[place, place] += (
                params.layout.prior[place] * params.layout.prior[place]
            )
            # The states kept are surer than what is known now.
            for tier in range(TIERS):
                kf.taken[tier] = 0


@compiled
def predict_from(
    params: Constants, kf: Estimator, seconds: float, states: ErrorStates
) -> bool:
    """Predict the states of now from the last snapshot before a time, s; return whether there is one."""
    best, latest = -1, 0.0
    for tier in range(TIERS):
        for k in range(min(kf.taken[tier], SNAPSHOTS)):
            snapshot = kf.snapshots[tier * SNAPSHOTS + k]
            if snapshot.seconds <= seconds and (best < 0 or snapshot.seconds > latest):
                best, latest = tier * SNAPSHOTS + k, snapshot.seconds
    if best < 0:
        return False
    snapshot = kf.snapshots[best]
    copy_states(params.layout, snapshot.states, states)
    for u in range(1, params.units):
        states.x[params.layout.delays[u]] += snapshot.late[u] - kf.late[u]
    predict(params.layout, states, kf.seconds - latest)
    return True


TURNING = 20.0
"""Square of an angular acceleration in variances of its noise from which it is one: a difference that is noise must
not be taken for motion, or delays would be learned as zero."""
PEAK = 0.8  # what a peak of motion fades to with every block: gone in half a second
TAKE_OFF = 0.002  # s; a smaller delay is an error state, whose first order is enough
SURE = 25.0  # square of a delay in its variances from which it is sure: it moves the values of all that come after
LONGEST_DELAY = (
    0.06  # s that are made up for at most: what `RESTAMP_SAMPLES` hold at 16 kHz
)


@compiled
def update_acceleration(params: Constants, kf: Estimator) -> float:
    """Angular acceleration in the middle of the block before, into ``kf.acceleration``; return its variance by noise.

    It is that of the means of blocks; where the rates at the ends of the block say otherwise, as in vibration that
    blocks are too slow for, that of those, unless samples between them are missing.
    """
    ahead, behind = kf.times[0] - kf.times[1], kf.times[1] - kf.times[2]
    span, whole = kf.ended[1] - kf.ended[2], kf.times[0] - kf.times[2]
    # Second-order differences of means whose samples may be apart by more than others.
    first, last = behind / (ahead * whole), ahead / (behind * whole)
    worst = single = apart = 0.0
    for a in range(3):
        total = alone = 0.0
        for i in range(params.sensors.n):
            square = kf.fused.gain[a, i] * kf.fused.gain[a, i]
            total += square * kf.noise.now.block[i]
            alone += square * kf.noise.now.sample[i]
        worst, single = max(worst, total), max(single, alone)
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
    if apart <= TURNING * single or span > 2.0 * params.length * params.period:
        return noise
    # Of vibration that blocks are too slow for nobody knows what it is: what channels see of it is no delay.
    kf.shaken = apart
    return noise


@compiled
def update_angular_acceleration(params: Constants, kf: Estimator) -> None:
    """Angular acceleration along each channel in the block before, and what of it is not linear.

    The variance beyond noise and states: the second order of delays, sampling instants of single channels, and what is
    not linear in the rate.
    """
    n, states = params.sensors.n, kf.states
    ahead, behind = kf.times[0] - kf.times[1], kf.times[1] - kf.times[2]
    noise, square = update_acceleration(params, kf), 0.0
    for a in range(3):
        square += kf.acceleration[a] * kf.acceleration[a]
    # At rest a rate that none of the channels agree on is a fault, and no motion.
    turning = square > TURNING * noise + kf.shaken and kf.noise.regime == MOTION
    kf.turning, kf.turn_noise = turning, noise
    speed = kf.rates[1, 0] ** 2 + kf.rates[1, 1] ** 2 + kf.rates[1, 2] ** 2
    if kf.noise.regime == REST:
        for i in range(n):
            kf.angular_acceleration[i] = kf.extra[i] = 0.0
        return
    for i in range(n):
        along = jerk = lately = 0.0
        for a in range(3):
            h = params.sensors.axes[i, a]
            along += h * kf.acceleration[a]
            after, before = (
                (kf.rates[0, a] - kf.rates[1, a]) / ahead,
                (kf.rates[1, a] - kf.rates[2, a]) / behind,
            )
            lately += h * after
            jerk += h * 2.0 * (after - before) / (ahead + behind)
        kf.angular_acceleration[i] = along if turning else 0.0
        swift = params.timing[i] * max(
            max(abs(along), abs(lately)) - 2.0 * math.sqrt(noise), 0.0
        )
        kf.extra[i] = swift * swift + params.nonlinearity * params.nonlinearity * speed
        place = params.layout.delays[params.unit[i]]
        if place >= 0:
            second = states.p[place, place] + states.x[place] * states.x[place]
            kf.extra[i] += second * (noise + kf.shaken) + (
                (0.5 * second * jerk) ** 2 if turning else 0.0
            )


@compiled
def judge_block(params: Constants, kf: Estimator) -> float:
    """Work out the innovations A (y - C x) of the block before; return its weight: 1, or less if improbable."""
    n, noise, layout = params.sensors.n, kf.noise, params.layout
    for a in range(3):
        kf.signal_rate[a] = kf.rates[1, a] if noise.regime == MOTION else 0.0
    fill_signals(layout, kf.signal_rate, kf.angular_acceleration, kf.block_at.signals)
    project(layout, kf.states, kf.block_at)
    mask = kf.masks[1]
    for i in range(n):
        # Of a unit that is slower than the others the samples lie otherwise in the block.
        kf.means[1, i] -= kf.angular_acceleration[i] * kf.middles[1, i]
        for j in range(n):
            kf.matrix[i, j] = kf.block_at.covariance[i, j]
        kf.matrix[i, i] += (
            noise.now.block[i] * noise.longest[i] / params.length + kf.extra[i]
        )
    fill_joint_parity(kf.block_parity, params.sensors, mask, kf.matrix, UNKNOWN_RATE)
    subtract_errors(
        layout, kf.states, kf.block_at.signals, kf.means[1], kf.block_innovation
    )
    chi, free = 0.0, -3.0
    for i in range(n):
        total = share = 0.0
        information = kf.block_parity.information
        if mask >> i & 1:
            for j in range(n):
                if mask >> j & 1:
                    total += information[i, j] * kf.block_innovation[j]
                    variance = noise.now.block[j] * noise.longest[j] / params.length
                    share += information[i, j] * information[i, j] * variance
            chi += total * kf.block_innovation[i]
            free += 1.0
        for j in range(n):
            kf.block_information[i, j] = information[i, j]
        kf.block_values[i] = total
        noise.share[i] = (
            max(share / information[i, i], LEAST_SHARE)
            if information[i, i] > 0.0
            else 1.0
        )
    return min(1.0, usual_chi(free) / max(chi, 1e-9))


@compiled
def update_rest(params: Constants, kf: Estimator) -> None:
    """Whether the vehicle has rested for the last second: the rate scatters as noise does, about zero."""
    for a in range(3):
        kf.rest_rates[kf.rest_count % REST_BLOCKS, a] = kf.rates[1, a]
    newest = kf.rest_count % REST_BLOCKS
    kf.rest_count += 1
    kf.rest = False
    if kf.rest_count < REST_BLOCKS:
        return
    n = params.sensors.n
    for a in range(3):
        variance = known = 0.0
        for i in range(n):
            gain, part = kf.fused.gain[a, i], 0.0
            if gain != 0.0:
                variance += gain * gain * kf.noise.now.block[i] / params.length
                for j in range(n):
                    part += kf.fused.gain[a, j] * kf.at.covariance[i, j]
                known += gain * part
        kf.rest_noise[a] = variance
        # Where little is known of the biases, a steady turn looks like them.
        kf.rest_bias_variance[a] = min(known, UNLEARNED * UNLEARNED)
    kf.rest = rests(
        kf.rest_rates,
        newest,
        kf.rest_noise,
        kf.rest_bias_variance,
        params.rest_std * params.rest_std,
    )
    if kf.noise.lived[REST] > LONG_TIME:
        # A hover in vibration may turn as little: it is known by its noise.
        for i in range(n):
            if (
                kf.masks[1] >> i & 1
                and kf.noise.now.block[i] > QUIET * kf.noise.kept[REST].block[i]
            ):
                kf.rest = kf.rest and kf.noise.regime == REST


@compiled
def unlearnable(error: float, inside: float, square: float) -> float:
    """Variance of an error by a signal that no number of samples takes away, in units of one.

    Vibration that units see differently is an error of both sides: of what a channel has (variance ``error``),
    ``inside`` may be in the signal (``square``). As long as it lasts, it looks like an error of the share that it has
    in the signal.
    """
    return error / max(square, 1e-12) * min(1.0, inside / max(square, 1e-12))


@compiled
def update_least_variances(params: Constants, kf: Estimator) -> None:
    """Variance that each state of the motion keeps at least, into ``kf.taught``; biases have no motion in them."""
    layout, noise, n = params.layout, kf.noise, params.sensors.n
    for r in range(layout.count):
        kf.taught[r] = 0.0
    if kf.rest:
        return
    quick = 0.0
    for a in range(3):
        inside = kf.shared.vibration[a]
        quick = max(quick, inside)
        for i in range(n):
            along = (
                params.sensors.axes[i, a]
                * params.sensors.axes[i, a]
                / (UNEQUAL * UNEQUAL * params.length)
            )
            inside = max(
                inside, along * noise.now.block[i] * noise.longest[i] * noise.unknown[i]
            )
            quick = max(quick, along * noise.now.block[i] * noise.longest[i])
        # A peak of vibration is no motion.
        kf.usual_rate[a] += (
            kf.signal_rate[a] * kf.signal_rate[a] - kf.usual_rate[a]
        ) / REST_BLOCKS
        for i in range(n):
            error = (
                noise.now.block[i] * noise.longest[i] * noise.unknown[i] / params.length
            )
            least = unlearnable(error, inside, kf.usual_rate[a])
            keep_least_variance(layout, i, RATE_X + a, least, kf.taught)
    for i in range(n):
        # As differences of two blocks have it. Of what is not known of slow noise the root: no delay would be learned
        # in the first seconds of motion.
        error = (
            noise.now.block[i]
            * noise.longest[i]
            * math.sqrt(noise.unknown[i])
            / params.length
        )
        turn = kf.angular_acceleration[i] * kf.angular_acceleration[i]
        least = unlearnable(error, 0.5 * quick / (kf.span * kf.span), turn)
        keep_least_variance(layout, i, TURN, least, kf.taught)


@compiled
def learn(params: Constants, kf: Estimator, weight: float) -> None:
    """Correct the states by the block before; at rest the rate is zero, and the estimated one no signal."""
    n, layout = params.sensors.n, params.layout
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
        known = 1.0 / (params.rest_std * params.rest_std) if kf.rest else UNKNOWN_RATE
        fill_joint_parity(kf.block_parity, params.sensors, kept, kf.matrix, known)
    update_least_variances(params, kf)
    update(
        layout,
        kf.states,
        kf.block_at,
        kf.block_parity.information,
        kf.block_innovation,
        weight,
        kf.taught,
    )


@compiled
def predict_innovation_covariance(params: Constants, kf: Estimator) -> None:
    """Work out what the next samples are judged with: the uncertainty of the states in the motion of the moment."""
    n, layout, square, ahead = (
        params.sensors.n,
        params.layout,
        0.0,
        kf.times[0] - kf.times[1],
    )
    for a in range(3):
        change = (kf.rates[0, a] - kf.rates[1, a]) / ahead
        square += change * change
    moves = kf.noise.regime == MOTION
    begins = kf.turning or (moves and square > 4.0 * TURNING * kf.turn_noise)
    for i in range(n):
        quick = 0.0
        for a in range(3):
            quick += (
                params.sensors.axes[i, a] * (kf.rates[0, a] - kf.rates[1, a]) / ahead
            )
        if not begins:
            quick = 0.0
        if abs(kf.angular_acceleration[i]) > abs(quick):
            quick = kf.angular_acceleration[i]
        kf.peak_turn[i] = (
            quick
            if abs(quick) > PEAK * abs(kf.peak_turn[i])
            else PEAK * kf.peak_turn[i]
        )
        kf.peak_extra[i] = max(PEAK * kf.peak_extra[i], kf.extra[i])
    for a in range(3):
        kf.signal_rate[a] = kf.rates[0, a] if moves else 0.0
    fill_signals(layout, kf.signal_rate, kf.peak_turn, kf.at.signals)
    project(layout, kf.states, kf.at)
    for i in range(n):
        kf.at.covariance[i, i] += kf.peak_extra[i]
    kf.speed_squared = kf.rates[0, 0] ** 2 + kf.rates[0, 1] ** 2 + kf.rates[0, 2] ** 2
    update_weights(params, kf)


@compiled
def update_time_offsets(params: Constants, kf: Estimator) -> None:
    """Find by how much values lie before the stamp, if the earliest unit is in time, and how far units are apart.

    `restamp` brings all units to the instant of the latest, the states what is left to that of the first unit.
    """
    latest = earliest = least = most = 0.0
    for u in range(1, params.units):
        late = kf.late[u]
        remaining = late + kf.states.x[params.layout.delays[u]]
        latest, earliest = max(latest, late), min(earliest, late)
        most, least = max(most, remaining), min(least, remaining)
    kf.behind, kf.spread = latest - earliest, most - least


@compiled
def transfer_delays(params: Constants, kf: Estimator) -> bool:
    """Move delays that are sure from their states to ``late``, which `restamp` makes up for; return whether any was."""
    changed = False
    for u in range(1, params.units):
        place = params.layout.delays[u]
        delay, variance = kf.states.x[place], kf.states.p[place, place]
        if abs(delay) > TAKE_OFF and delay * delay > SURE * variance:
            step = min(
                max(delay, -LONGEST_DELAY - kf.late[u]), LONGEST_DELAY - kf.late[u]
            )
            kf.late[u] += step
            kf.states.x[place] -= step
            changed = changed or step != 0.0
    return changed
