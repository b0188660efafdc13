# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A block of 40 ms: motion or rest, innovations, the correction of the states, and those kept from moments before.

Delays that are sure leave the states for `restamp`, and after a hole the blocks begin anew. The states kept are 0.12 to
490 s apart, eight of each distance; after a fault the estimator goes back to them. The test of rest (`rests`) is also
that of calibration and inspection; the average of the biases at the start has one of its own, which needs no estimator
(`core/bias.py`), and so has the check of values that repeat (`stands` in `core/health.py`).
"""

from __future__ import annotations

import math

from fdi_ros.compiling.compiled import compiled
from fdi_ros.core.parity import UNKNOWN_RATE, eliminate_rate, weigh_together
from fdi_ros.estimator.error_states import (
    ONE,
    RATE_X,
    SIGNALS,
    TURN,
    ErrorStates,
    copy_states,
    find_signals,
    predict,
    project,
    subtract_errors,
    update,
)
from fdi_ros.estimator.estimator import (
    LEAST_SHARE,
    REST_BLOCKS,
    SNAPSHOTS,
    TIERS,
    Constants,
    Estimator,
    usual_chi,
    weigh,
)
from fdi_ros.estimator.noise import MOTION, REST, THREE_SIGMA
from fdi_ros.estimator.shared_noise import UNEQUAL
from fdi_ros.model.samples import Array

QUIET, LIVED = 3.0, 2.0
"""At rest the variance of blocks is at most so many times what it was at rest before, once that was so many s."""
REST_STD = 3e-4
"""rad/s; of the rate at rest: the turn of the earth, and a table that trembles."""
UNLEARNED = 0.003
"""rad/s; biases of which less is known do not make a larger rate one of rest: it may be a turn."""
REST_CHI, REST_LAST = 1.6, 12.0
"""At rest the scatter of those is at most so many times that of noise, the square of their mean at most `THREE_SIGMA`
variances and of the last one's distance from it so many."""


@compiled
def rests(rates: Array, newest: int, variance: Array, bias_variance: Array, floor: float) -> bool:
    """Whether the rates of `REST_BLOCKS` blocks scatter as noise does, about zero.

    Parameters
    ----------
    rates
        (`REST_BLOCKS`, c) rad/s, in any order: of the body, or as single channels measure it.
    newest
        Place of the last of them.
    variance
        (c,) of the noise of each, (rad/s)^2.
    bias_variance
        (c,) of what is not known of the biases, (rad/s)^2.
    floor
        Variance of the rate at rest, (rad/s)^2.
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
        largest = max(largest, mean * mean / (floor + variance[a] / REST_BLOCKS + bias_variance[a]))
    return scatter < rates.shape[1] * (REST_BLOCKS - 1) * REST_CHI and largest < THREE_SIGMA and last < REST_LAST


UNWATCHED, LONG_HOLE = 3e-4, 3600.0
"""Random walk of a bias over a hole in the stream, rad/s/sqrt(s), which has gone its way in so many s."""
AFTER_HOLE = 10.0
"""s of samples after a hole in which biases are compared with those before: five comparisons, and by then the states
know what they can learn of the biases."""


@compiled
def keep_snapshot(params: Constants, est: Estimator) -> None:
    """Keep the states, so that they can be had again from before a fault."""
    tier = 0
    while tier < TIERS:
        snapshot = est.snapshots[tier * SNAPSHOTS + est.taken[tier] % SNAPSHOTS]
        snapshot.seconds = est.seconds
        copy_states(params.layout, est.states, snapshot.states)
        for u in range(params.units):
            snapshot.late[u] = est.late[u]
        est.taken[tier] += 1
        if est.taken[tier] % SNAPSHOTS != 1:
            return
        tier += 1


@compiled
def pass_hole(params: Constants, est: Estimator, seconds: float) -> None:
    """Let the biases be others after a hole: nobody has watched them, and the sensors may have been switched off.

    The states kept from before it stay, as little sure of the biases: what changed in the hole is compared with them.
    """
    if not is_after_hole(params, est):
        est.hole_at, est.hole_sample = est.seconds - seconds, est.samples
    move_biases(params, est, UNWATCHED * math.sqrt(min(seconds, LONG_HOLE)), 0.0)


@compiled
def is_after_hole(params: Constants, est: Estimator) -> bool:
    """Whether there was a hole in the stream lately."""
    return est.hole_sample > 0 and (est.samples - est.hole_sample) * params.period < AFTER_HOLE


@compiled
def move_biases(params: Constants, est: Estimator, std: float, rate_std: float) -> None:
    """Let all biases be others by so much, rad/s, and their rates of change, rad/s^2; now and in all states kept."""
    add_to_biases(params, est.states, std, rate_std)
    for k in range(TIERS * SNAPSHOTS):
        add_to_biases(params, est.snapshots[k].states, std, rate_std)


@compiled
def add_to_biases(params: Constants, states: ErrorStates, std: float, rate_std: float) -> None:
    """Add to the variances of the biases and of their rates of change."""
    for r in range(params.layout.count):
        if r < params.sensors.n:
            states.p[r, r] += std * std
        elif 0 <= params.layout.feeds[r] < params.sensors.n:
            states.p[r, r] += rate_std * rate_std


@compiled
def inflate_delays(params: Constants, est: Estimator, units: int) -> None:
    """Let delays be others: of the units all of whose channels are among some; of the first, against which all are."""
    for u in range(1, params.units):
        if params.members[u] & ~units == 0 or params.members[0] & ~units == 0:
            place = params.layout.delays[u]
            est.states.p[place, place] += params.layout.prior[place] * params.layout.prior[place]
            forget_snapshots(est)


@compiled
def forget_snapshots(est: Estimator) -> None:
    """Forget all states before now: they were surer than what is known now."""
    for tier in range(TIERS):
        est.taken[tier] = 0


@compiled
def predict_from(params: Constants, est: Estimator, seconds: float, states: ErrorStates) -> bool:
    """Predict the states of now from the last snapshot before a time, s; return whether there is one."""
    best, latest = -1, 0.0
    for tier in range(TIERS):
        for k in range(min(est.taken[tier], SNAPSHOTS)):
            snapshot = est.snapshots[tier * SNAPSHOTS + k]
            if snapshot.seconds <= seconds and (best < 0 or snapshot.seconds > latest):
                best, latest = tier * SNAPSHOTS + k, snapshot.seconds
    if best < 0:
        return False
    snapshot = est.snapshots[best]
    copy_states(params.layout, snapshot.states, states)
    for u in range(1, params.units):
        states.x[params.layout.delays[u]] += snapshot.late[u] - est.late[u]
    predict(params.layout, states, est.seconds - latest)
    return True


TURNING = 20.0
"""Square of an angular acceleration in variances of its noise from which it is one: a difference that is noise must
not be taken for motion, or delays would be learned as zero."""
PEAK = 0.8
"""What a peak of motion fades to with every block."""
TAKE_OFF, SURE = 0.002, 25.0
"""A delay is sure beyond so many s, and the square of so many standard deviations."""
LONGEST_DELAY = 0.06
"""s that are made up for at most."""


@compiled
def find_acceleration(params: Constants, est: Estimator) -> float:
    """Angular acceleration in the middle of the block before, into ``est.acceleration``; return its variance by noise.

    It is that of the means of blocks; where the rates at the ends of the block say otherwise, as in vibration that
    blocks are too slow for, that of those, unless samples between them are missing.
    """
    ahead, behind = est.times[0] - est.times[1], est.times[1] - est.times[2]
    span, whole = est.ended[1] - est.ended[2], est.times[0] - est.times[2]
    # Second-order differences of means whose samples may be apart by more than others.
    first, last = behind / (ahead * whole), ahead / (behind * whole)
    worst = single = apart = 0.0
    for a in range(3):
        total = alone = 0.0
        for i in range(params.sensors.n):
            square = est.fused.gain[a, i] * est.fused.gain[a, i]
            total += square * est.noise.now.block[i]
            alone += square * est.noise.now.sample[i]
        worst, single = max(worst, total), max(single, alone)
        est.acceleration[a] = first * (est.rates[0, a] - est.rates[1, a]) + last * (est.rates[1, a] - est.rates[2, a])
        between = (est.ends[1, a] - est.ends[2, a]) / span
        apart += (between - est.acceleration[a]) * (between - est.acceleration[a])
    single *= 2.0 / (span * span)
    est.shaken = 0.0
    noise = (first * first + last * last + (last - first) * (last - first)) * worst / params.length
    if apart <= TURNING * single or span > 2.0 * params.length * params.period:
        return noise
    # Of vibration that blocks are too slow for nobody knows what it is: what channels see of it is no delay.
    est.shaken = apart
    return noise


@compiled
def find_turning(params: Constants, est: Estimator) -> None:
    """Angular acceleration along each channel in the block before, and what of it is not linear.

    The variance beyond noise and states: the second order of delays, sampling instants of single channels, and what is
    not linear in the rate.
    """
    n, states = params.sensors.n, est.states
    ahead, behind = est.times[0] - est.times[1], est.times[1] - est.times[2]
    noise, square = find_acceleration(params, est), 0.0
    for a in range(3):
        square += est.acceleration[a] * est.acceleration[a]
    # At rest a rate that none of the channels agree on is a fault, and no motion.
    turning = square > TURNING * noise + est.shaken and est.noise.regime == MOTION
    est.turning, est.turn_noise = turning, noise
    speed = est.rates[1, 0] ** 2 + est.rates[1, 1] ** 2 + est.rates[1, 2] ** 2
    if est.noise.regime == REST:
        for i in range(n):
            est.turn[i] = est.extra[i] = 0.0
        return
    for i in range(n):
        along = jerk = lately = 0.0
        for a in range(3):
            h = params.sensors.axes[i, a]
            along += h * est.acceleration[a]
            after, before = (est.rates[0, a] - est.rates[1, a]) / ahead, (est.rates[1, a] - est.rates[2, a]) / behind
            lately += h * after
            jerk += h * 2.0 * (after - before) / (ahead + behind)
        est.turn[i] = along if turning else 0.0
        swift = params.timing[i] * max(max(abs(along), abs(lately)) - 2.0 * math.sqrt(noise), 0.0)
        est.extra[i] = swift * swift + params.bent * params.bent * speed
        place = params.layout.delays[params.unit[i]]
        if place >= 0:
            second = states.p[place, place] + states.x[place] * states.x[place]
            est.extra[i] += second * (noise + est.shaken) + ((0.5 * second * jerk) ** 2 if turning else 0.0)


@compiled
def judge_block(params: Constants, est: Estimator) -> float:
    """Work out the innovations A (y - C x) of the block before; return its weight: 1, or less if improbable.

    Its means are put to its middle, and the share of noise in the statistics of blocks is noted.
    """
    n, noise, layout = params.sensors.n, est.noise, params.layout
    for a in range(3):
        est.signal_rate[a] = est.rates[1, a] if noise.regime == MOTION else 0.0
    find_signals(layout, est.signal_rate, est.turn, est.block_at.signals)
    project(layout, est.states, est.block_at)
    mask = est.masks[1]
    for i in range(n):
        # Of a unit that is slower than the others the samples lie otherwise in the block.
        est.means[1, i] -= est.turn[i] * est.middles[1, i]
        for j in range(n):
            est.matrix[i, j] = est.block_at.covariance[i, j]
        est.matrix[i, i] += noise.now.block[i] * noise.longest[i] / params.length + est.extra[i]
    weigh_together(est.block_parity, n, mask, est.matrix)
    eliminate_rate(est.block_parity, n, params.sensors.axes, UNKNOWN_RATE)
    subtract_errors(layout, est.states, est.block_at.signals, est.means[1], est.block_innovation)
    chi, free = 0.0, -3.0
    for i in range(n):
        total = share = 0.0
        information = est.block_parity.information
        if mask >> i & 1:
            for j in range(n):
                if mask >> j & 1:
                    total += information[i, j] * est.block_innovation[j]
                    variance = noise.now.block[j] * noise.longest[j] / params.length
                    share += information[i, j] * information[i, j] * variance
            chi += total * est.block_innovation[i]
            free += 1.0
        for j in range(n):
            est.block_information[i, j] = information[i, j]
        est.block_values[i] = total
        noise.share[i] = max(share / information[i, i], LEAST_SHARE) if information[i, i] > 0.0 else 1.0
    return min(1.0, usual_chi(free) / max(chi, 1e-9))


@compiled
def find_rest(params: Constants, est: Estimator) -> None:
    """Whether the vehicle has rested for the last second: the rate scatters as noise does, about zero."""
    for a in range(3):
        est.rest_rates[est.rest_count % REST_BLOCKS, a] = est.rates[1, a]
    newest = est.rest_count % REST_BLOCKS
    est.rest_count += 1
    est.rest = False
    if est.rest_count < REST_BLOCKS:
        return
    n = params.sensors.n
    for a in range(3):
        variance = known = 0.0
        for i in range(n):
            gain, part = est.fused.gain[a, i], 0.0
            if gain != 0.0:
                variance += gain * gain * est.noise.now.block[i] / params.length
                for j in range(n):
                    part += est.fused.gain[a, j] * est.at.covariance[i, j]
                known += gain * part
        est.rest_noise[a] = variance
        # Where little is known of the biases, a steady turn looks like them.
        est.rest_bias_variance[a] = min(known, UNLEARNED * UNLEARNED)
    est.rest = rests(est.rest_rates, newest, est.rest_noise, est.rest_bias_variance, params.rest_std * params.rest_std)
    if est.noise.lived[REST] > LIVED:
        # A hover in vibration may turn as little: it is known by its noise.
        for i in range(n):
            if est.masks[1] >> i & 1 and est.noise.now.block[i] > QUIET * est.noise.kept[REST].block[i]:
                est.rest = est.rest and est.noise.regime == REST


@compiled
def unlearnable(error: float, inside: float, square: float) -> float:
    """Variance of an error by a signal that no number of samples takes away, in units of one.

    Vibration that units see differently is an error of both sides: of what a channel has, ``inside`` may be in the
    signal. As long as it lasts, it looks like an error of the share that it has in the signal.

    Parameters
    ----------
    error
        Variance of the channel.
    inside
        Of the vibration that may be in the signal.
    square
        Of the signal.
    """
    return error / max(square, 1e-12) * min(1.0, inside / max(square, 1e-12))


@compiled
def find_unlearnable(params: Constants, est: Estimator) -> None:
    """Variance that each state of the motion keeps at least, into ``est.taught``; biases have no motion in them."""
    layout, noise, at, n = params.layout, est.noise, est.block_at, params.sensors.n
    for r in range(layout.count):
        est.taught[r] = 0.0
    if est.rest:
        return
    quick = 0.0
    for a in range(3):
        inside = est.shared.vibration[a]
        quick = max(quick, inside)
        for i in range(n):
            along = params.sensors.axes[i, a] * params.sensors.axes[i, a] / (UNEQUAL * UNEQUAL * params.length)
            inside = max(inside, along * noise.now.block[i] * noise.longest[i] * noise.unknown[i])
            quick = max(quick, along * noise.now.block[i] * noise.longest[i])
        # A peak of vibration is no motion.
        est.usual_rate[a] += (est.signal_rate[a] * est.signal_rate[a] - est.usual_rate[a]) / REST_BLOCKS
        for i in range(n):
            error = noise.now.block[i] * noise.longest[i] * noise.unknown[i] / params.length
            est.taught[layout.place[i, RATE_X + a]] = unlearnable(error, inside, est.usual_rate[a])
    for i in range(n):
        place, turn = layout.place[i, TURN], at.signals[i, TURN]
        if place >= 0:
            # As differences of two blocks have it. Of what is not known of slow noise the root: no delay would be
            # learned in the first seconds of motion.
            error = noise.now.block[i] * noise.longest[i] * math.sqrt(noise.unknown[i]) / params.length
            least = unlearnable(error, 0.5 * quick / (est.span * est.span), turn * turn)
            # A unit learns from that of its axes which turns most.
            est.taught[place] = least if est.taught[place] == 0.0 else min(est.taught[place], least)


@compiled
def learn(params: Constants, est: Estimator, weight: float) -> None:
    """Correct the states by the block before.

    At rest the rate is known to be zero. The estimated one would be the noise of the values themselves, and is no
    signal there.
    """
    n, layout = params.sensors.n, params.layout
    kept = est.masks[1] & ~est.doubted
    if est.rest:
        for i in range(n):
            for j in range(n):
                est.matrix[i, j] -= est.block_at.covariance[i, j]
            for k in range(ONE + 1, SIGNALS):
                est.block_at.signals[i, k] = 0.0
        project(layout, est.states, est.block_at)
        for i in range(n):
            for j in range(n):
                est.matrix[i, j] += est.block_at.covariance[i, j]
        subtract_errors(layout, est.states, est.block_at.signals, est.means[1], est.block_innovation)
    if est.rest or kept != est.masks[1]:
        weigh_together(est.block_parity, n, kept, est.matrix)
        known = 1.0 / (params.rest_std * params.rest_std) if est.rest else UNKNOWN_RATE
        eliminate_rate(est.block_parity, n, params.sensors.axes, known)
    find_unlearnable(params, est)
    update(layout, est.states, est.block_at, est.block_parity.information, est.block_innovation, weight, est.taught)


@compiled
def foresee(params: Constants, est: Estimator) -> None:
    """Work out what the next samples are judged with: the uncertainty of the states in the motion of the moment."""
    n, layout, square, ahead = params.sensors.n, params.layout, 0.0, est.times[0] - est.times[1]
    for a in range(3):
        change = (est.rates[0, a] - est.rates[1, a]) / ahead
        square += change * change
    moves = est.noise.regime == MOTION
    begins = est.turning or (moves and square > 4.0 * TURNING * est.turn_noise)
    for i in range(n):
        quick = 0.0
        for a in range(3):
            quick += params.sensors.axes[i, a] * (est.rates[0, a] - est.rates[1, a]) / ahead
        if not begins:
            quick = 0.0
        if abs(est.turn[i]) > abs(quick):
            quick = est.turn[i]
        est.peak_turn[i] = quick if abs(quick) > PEAK * abs(est.peak_turn[i]) else PEAK * est.peak_turn[i]
        est.peak_extra[i] = max(PEAK * est.peak_extra[i], est.extra[i])
    for a in range(3):
        est.signal_rate[a] = est.rates[0, a] if moves else 0.0
    find_signals(layout, est.signal_rate, est.peak_turn, est.at.signals)
    project(layout, est.states, est.at)
    for i in range(n):
        est.at.covariance[i, i] += est.peak_extra[i]
    est.speed_squared = est.rates[0, 0] ** 2 + est.rates[0, 1] ** 2 + est.rates[0, 2] ** 2
    weigh(params, est)


@compiled
def find_behind(params: Constants, est: Estimator) -> None:
    """Find by how much values lie before the stamp, if the earliest unit is in time, and how far units are apart.

    `restamp` brings all units to the instant of the latest, the states what is left to that of the first unit.
    """
    latest = earliest = least = most = 0.0
    for u in range(1, params.units):
        late = est.late[u]
        left = late + est.states.x[params.layout.delays[u]]
        latest, earliest = max(latest, late), min(earliest, late)
        most, least = max(most, left), min(least, left)
    est.behind, est.spread = latest - earliest, most - least


@compiled
def transfer_delays(params: Constants, est: Estimator) -> bool:
    """Move delays that are sure from their states to ``late``, which `restamp` makes up for; return whether any was."""
    changed = False
    for u in range(1, params.units):
        place = params.layout.delays[u]
        delay, variance = est.states.x[place], est.states.p[place, place]
        if abs(delay) > TAKE_OFF and delay * delay > SURE * variance:
            step = min(max(delay, -LONGEST_DELAY - est.late[u]), LONGEST_DELAY - est.late[u])
            est.late[u] += step
            est.states.x[place] -= step
            changed = changed or step != 0.0
    return changed
