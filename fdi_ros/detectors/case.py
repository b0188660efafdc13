# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Open a case where the evidence stands against the noise of its own time, and name its channels.

When a case opens, the error states return to their values before the onset
(`predict_from`), and `fdi_ros.detectors.naming` explains the mean since the onset against
every uncertainty of the sensors. A case ends when its evidence is gone, or when its
channels are excluded.
"""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import (
    MAX_CHANNELS,
    Channels,
    Flag,
    Mask,
    Real,
    Square,
    Whole,
    compiled,
    record,
)
from fdi_ros.core.algebra import dot, invert
from fdi_ros.core.subsets import number_in
from fdi_ros.detectors.naming import (
    FEW_CHECKS,
    Inference,
    explain_with_misfit,
    leaves_noise,
    redundancy,
    set_mean,
    unexplained,
)
from fdi_ros.detectors.onset import explain_change, samples_of_change
from fdi_ros.detectors.returning import (
    References,
    believe_noise,
    find_returned,
    keep_reference,
    return_biases,
)
from fdi_ros.detectors.sums import (
    BLOCKS_PER_VALUE,
    KEPT,
    SIZES,
    Scale,
    Scales,
    forget_sums,
    look_back,
    normal_variance,
    value_at,
)
from fdi_ros.estimator.error_states import ErrorStates, copy_states
from fdi_ros.estimator.estimator import (
    BLOCK_TIME,
    LEAST_NOISE_SHARE,
    LONG_TIME,
    SNAPSHOT_TIME,
    TIERS,
    Constants,
    Estimator,
    update_weights,
)
from fdi_ros.estimator.noise import (
    BLOCK,
    QUARTER,
    SAMPLE,
    SCALES,
    THREE_SIGMA,
    update_unknown,
)
from fdi_ros.estimator.rectification import move_of_healthy_bias
from fdi_ros.estimator.snapshots import (
    add_to_biases,
    is_after_hole,
    move_biases,
    predict_from,
    widen_scales,
)
from fdi_ros.model.samples import Array

OPENING_SHARE = 0.6
"""Log odds that open a case, as a share of the logarithm of the run length. The sums need
the whole logarithm, but here every uncertainty counts in full."""
LEAST_ODDS = 2.0
"""Log odds of the likeliest hypothesis below which a case ends: hardly better than none. A refused
case with more leaves its channels in doubt, until no hypothesis is likelier than none. In four healthy
real flights, where old evidence stands at its limit for up to 40 % of the time, the median log odds of
refused cases are -1.5 to 0.1."""
# Channels are named again when the time that is explained has grown by 1 / RENAME.
RENAME = 16
SETTLED_ALONE, SETTLED_AMONG_FEW = 0.2, 0.5
SETTLED_TOGETHER = 2.0 * SETTLED_AMONG_FEW
"""Time that a name must stand before it is declared, s: one channel, one channel with at
most `FEW_CHECKS` checks, two channels. Several faults look like one at first, and with
few checks three faults explain any mean."""
CLEAR_ODDS = 5000.0
"""Log odds from which a single fault is named at once. A second error a twentieth as large
would then show by five standard deviations, (0.05^2) 2 CLEAR = 25."""
HEALTHY_SIGMAS, HEALTHY_SHARE = 6.0, 0.3
"""Largest rest of a healthy channel in a block, after the errors of the named channels: this
many standard deviations, which noise does not reach in a flight, plus this share of the
named error, because the axes are not exactly known."""
# least share of the variance of a channel that others do not explain
MIN_INDEPENDENT_SHARE = 1e-3
WARMS = 30.0
"""Time within which all biases may move by `LARGEST_MOVES` without a fault, s: the sensors
warm, rectify vibration, or feel a boost begin and end."""
LARGEST_MOVES = 2.0
"""Largest shifts of all biases within `WARMS`, over `Constants.largest_move`: a boost
moves them twice."""
UNSOLVED = 10.0
"""Time after which a case that no hypothesis explains ends, s. The error model is wrong there,
and while all channels are suspects, the estimator learns nothing better."""
LOUDER = 3.0
"""Excess of the noise variance since the onset, over the learned variance, from which the noise has
grown: the samples of a fault are as noisy as before."""
FEWEST_STEPS = 16
"""Smallest number of differences that show how noisy the last samples are. The two largest ones are
left out, because the onset of a fault is no noise."""
STEADY_RATIO = 9.0
"""Square of the mean since the onset over the noise of single samples, from which the values are
those of a fault: a filter spreads the onset of a fault over some samples, which is no noise."""
SUDDEN = 8.0  # log odds of a change at the onset, which no slow move explains
SLOWLY = 2.5
"""Time in which a healthy bias moves by `Constants.bias_move`, standard deviation, s. A thermal
shock of 6 mrad/s in 5 s is 2.5 times as fast and changes by less than noise."""
SLOW = 2.0
"""Time from the onset to a candidate, s, from which the evidence has grown slowly, up to `WARMS`:
a step of 0.02 rad/s opens a case within 0.6 s, and what grows for longer is no warming."""
STARTS = 0.25  # s within which a boost or motors start
UNSTEADY = 0.25
"""Largest variance of the error of a channel beside noise, over the square of its mean, that is
still a shift: sines, as gains and delays show in turns, have much more."""
LONGEST_WAIT = 0.5
"""Longest time from a refused case to the next one, s. Another fault is named nearly as soon as
without the refused case."""
#: Number of times over which a slow drift is searched.
DRIFT_TIMES = 4
LONGEST_DRIFT = WARMS * (1 << DRIFT_TIMES)
"""Longest time over which a slow drift is searched, s: 480. The search tries
`DRIFT_TIMES` times, each half as long as the one before: 480, 240, 120 and 60."""
# time after a gap before the mean starts anew, s: equal to the time that a name must stand
LEAST_RETURN = 0.2
# peak rate of a move over its mean rate: warming is fastest at the beginning
LARGEST_RATE_RATIO = 2.5


@record
class Case:
    """An alarm, with the channels under suspicion."""

    open: Flag
    onset: Whole  # first sample of the fault
    next: Whole  # sample at which channels are named again
    candidate: Mask  # channels that the last mean names
    since: Whole  # sample since which the last means name the same channels
    isolated: Mask  # faulty channels, named for long enough
    suspects: Mask  # a set with at least one faulty channel
    witnesses: Mask  # channels present when the suspects were found
    louder: Flag  # a channel has become noisier
    healthy_move: Real  # standard deviation of the move of each healthy bias since the onset, rad/s
    sudden: Mask  # channels that the change at the onset names
    unsolved: Real  # time without an explaining hypothesis, less the time with one, s
    # time in which faults of channels i and j, or of i alone, left more than noise, less
    # the time in which they did not, s
    unfit: Square
    retry: Whole  # earliest sample at which a case may open again
    # channels of the last case that evidence opened and odds refused, or all: no fault explains it
    doubtful: Mask
    before: ErrorStates  # states when the case opened
    moved: Real  # recent move of all biases, rad/s
    moved_at: Real  # time of the last move, s since the start
    moved_since: Whole  # first sample that showed the last move
    reference: Channels  # biases before the last move, rad/s
    farthest: Real  # from these without a fault, rad/s
    references: References  # biases before the last moves
    inference: Inference


@record
class State:
    """Memory of the method between samples."""

    begun: Flag
    restored: Flag  # 1: the states come from an earlier run
    cleared: Flag  # 1: the next sample drops all suspicion
    declared: Mask  # channels declared up to that moment
    stamp: Whole  # stamp of the last sample, ns
    estimator: Estimator
    scales: Scales
    information: Annotated[  # of each kept block, s^2/rad^2
        NDArray[np.float64], "f8", (KEPT, MAX_CHANNELS, MAX_CHANNELS)
    ]
    case: Case


@compiled
def forget_evidence(params: Constants, state: State) -> None:
    """Restart all sums and end the case. The states and the noise stay."""
    state.case.open = False
    state.case.doubtful = 0
    state.case.isolated = state.case.suspects = state.estimator.excluded_from_rate = (
        state.estimator.under_test
    ) = 0
    forget_sums(params, state.scales)


@compiled
def look_for_case(params: Constants, state: State) -> None:
    """Open a case on the time scale whose evidence best stands against the noise of the same time."""
    kf = state.estimator
    case = state.case
    best = math.log(params.limit)
    found = False
    for at in range(SCALES):
        scale = state.scales[at]
        largest = 0.0
        channel = -1
        sign = 1.0
        for i in range(params.sensors.n):
            for side in range(2):
                for s in range(SIZES):
                    if scale.sums[side, i, s] > largest:
                        largest = scale.sums[side, i, s]
                        channel = i
                        sign = 1.0 - 2.0 * side
        if channel < 0 or largest < params.limit:
            continue
        since, evidence = look_back(params, kf, scale, channel, sign)
        evidence = min(evidence, since * math.log(kf.noise.cap[at, channel]))
        samples = max(BLOCKS_PER_VALUE[at] * params.length, 1)
        if since >= 2 and since * samples >= params.least and evidence >= best:
            best = evidence
            found = True
            case.onset = scale.first[(scale.newest - since + 1 + KEPT) % KEPT]
    stands = found and open_case(params, state, OPENING_SHARE * math.log(params.limit))
    inference = case.inference
    # A shift of all biases calls every channel healthy.
    healthy = inference.log_odds < 0.0 or inference.shift > 0.0
    if stands or not found or healthy:
        case.doubtful = 0
    elif inference.log_odds >= LEAST_ODDS:
        case.doubtful = inference.union


@compiled
def look_for_drift(params: Constants, state: State) -> None:
    """Open a case where a bias changes faster than biases do.

    An estimate has the variance by which the prior variance has fallen, so
    ``x^2 / (prior - P)`` is the square of a standard normal value.
    """
    kf = state.estimator
    case = state.case
    layout = params.layout
    worst = 0.0
    if case.moved > 0.0 and kf.seconds - case.moved_at < LONGEST_DRIFT:
        return
    for r in range(layout.n, layout.count):
        if 0 <= layout.feeds[r] < layout.n:
            prior = layout.prior[r] * layout.prior[r]
            learned = max(prior - kf.states.p[r, r], LEAST_NOISE_SHARE * prior)
            worst = max(worst, kf.states.x[r] * kf.states.x[r] / learned)
    if worst < 2.0 * math.log(params.limit):
        return
    for k in range(DRIFT_TIMES):
        seconds = LONGEST_DRIFT / (1 << k)
        if not case.open and kf.seconds > seconds:
            case.onset = kf.samples - int(seconds / params.period)
            open_case(params, state, OPENING_SHARE * math.log(params.limit))


@compiled
def look_for_change_in_hole(params: Constants, state: State) -> None:
    """Open a case where a bias has changed over a hole in the stream by more than it may.

    Shortly after a hole slow noise is unknown, and the states absorb what the sums do not see.
    """
    kf = state.estimator
    case = state.case
    n = params.sensors.n
    worst = 0.0
    information = kf.parity.information
    before = case.before
    if (
        case.open
        or not is_after_hole(params, kf)
        or not predict_from(params, kf, kf.hole_at, before)
    ):
        return
    for i in range(n):
        change = prior = posterior = 0.0
        for j in range(n):
            change += information[i, j] * (kf.states.x[j] - before.x[j])
            for k in range(n):
                share = information[i, j] * information[i, k]
                prior += share * before.p[j, k]
                posterior += share * kf.states.p[j, k]
        if kf.judged >> i & 1:
            worst = max(
                worst,
                change * change / max(prior - posterior, LEAST_NOISE_SHARE * prior),
            )
    if worst >= 2.0 * math.log(params.limit):
        case.onset = kf.hole_sample + 1
        open_case(params, state, OPENING_SHARE * math.log(params.limit))


@compiled
def open_case(params: Constants, state: State, least: float) -> bool:
    """Return to the states before the onset, and keep the case only if a hypothesis stands.

    A hypothesis stands where its log odds, with every uncertainty counted, pass ``least``.
    Return False if none does.
    """
    kf = state.estimator
    case = state.case
    case.onset = max(case.onset, 1)
    case.open = True
    case.candidate = 0
    case.isolated = 0
    case.suspects = case.witnesses = 0
    case.unsolved = 0.0
    copy_states(params.layout, kf.states, case.before)
    since = (kf.samples - case.onset) * params.period
    predict_from(params, kf, time_before(params, kf, case), kf.states)
    # Stamps may be a block off.
    if kf.seconds - since < kf.changed_at - BLOCK_TIME:
        # Some samples since the onset belong to another specific force.
        change = params.g_sensitivity * kf.largest_change
        add_to_biases(params, kf.states, change, 0.0)
    name_channels(params, state)
    if case.open and case.inference.log_odds < least:
        copy_states(params.layout, case.before, kf.states)
        case.open = False
        kf.excluded_from_rate = 0
        update_weights(params, kf)
        wait = min((kf.samples - case.onset) // 4, int(LONGEST_WAIT / params.period))
        case.retry = kf.samples + 1 + wait
        return False
    return True


@compiled
def time_before(params: Constants, kf: Estimator, case: Case) -> float:
    """Return a time that is surely before the onset, s since the start: the onset is not known exactly."""
    if case.onset == kf.hole_sample + 1:
        return kf.hole_at
    since = (kf.samples - case.onset) * params.period
    return kf.seconds - since - max(SNAPSHOT_TIME, 0.3 * since)


@compiled
def follow_moves(params: Constants, state: State) -> None:
    """Look every quarter of a second whether all biases have returned from a move, and take those from before it.

    While a case is open, their evidence must exceed that of the likeliest fault.
    """
    kf = state.estimator
    case = state.case
    inference = case.inference
    lately = case.moved > 0.0 and kf.seconds - case.moved_at < WARMS
    due = kf.all_blocks % BLOCKS_PER_VALUE[QUARTER] == 0
    if not due or not (lately or case.open) or case.references.count == 0:
        return
    size = BLOCKS_PER_VALUE[QUARTER] * params.length
    least = OPENING_SHARE * math.log(params.limit)
    if case.open:
        least = max(least, inference.log_odds)
    inference.moved = 0.0
    fill_louder(params, state, size)
    set_mean(params, kf, inference, size)
    believe_noise(params, kf, inference)
    best = find_returned(params, kf, case.references, inference, least)
    if best >= 0:
        return_biases(params, kf, case.references, best, inference.mask)
        forget_evidence(params, state)
        update_weights(params, kf)


@compiled
def keep_information(params: Constants, state: State) -> None:
    """Keep the information matrix of the last block beside its values.

    A channel that went silent since that block has no value there, and no information.
    """
    kf = state.estimator
    kept = state.information[state.scales[BLOCK].newest]
    known = kf.masks[1] & kf.judged
    for i in range(params.sensors.n):
        for j in range(params.sensors.n):
            both = known >> i & known >> j & 1
            kept[i, j] = kf.block_information[i, j] if both else 0.0


@compiled
def shows_others(params: Constants, state: State, named: int) -> bool:
    """Whether single blocks since the onset show errors of channels other than the named ones.

    At most three channels can be named. The mean of two faults that come and go, or that
    begin one after the other, may look like a fault of a third channel. The error of one
    channel has the same direction in every block, whatever its size there.
    """
    scale = state.scales[BLOCK]
    for back in range(scale.kept):
        place = (scale.newest - back + KEPT) % KEPT
        if scale.first[place] < state.case.onset - params.length:
            break
        if block_shows_others(params, state, named, place):
            return True
    return False


@compiled
def block_shows_others(params: Constants, state: State, named: int, place: int) -> bool:
    """Whether one block shows errors of channels other than the named ones.

    The correlations are those of the block itself: they change with the motion.
    """
    kf = state.estimator
    inference = state.case.inference
    n = params.sensors.n
    information = state.information[place]
    count = 0
    for i in range(n):
        if named >> i & 1:
            if count == 3 or not information[i, i] > 0.0:
                return False
            fill_correlations(information, i, named, inference.matrix[count])
            # The matrix of channels that look alike is singular.
            inference.matrix[count, count] += MIN_INDEPENDENT_SHARE
            count += 1
    invert(inference.matrix, count, inference.inverse)
    for j in range(n):
        is_other = (kf.judged & ~named) >> j & 1
        if is_other and information[j, j] > 0.0:
            # regression on the named channels
            fill_correlations(information, j, named, inference.along)
            variance = 1.0
            for p in range(count):
                share = dot(inference.inverse[p], inference.along, count)
                inference.amplitude[p] = share
                variance -= share * inference.along[p]
            if variance > MIN_INDEPENDENT_SHARE and shows_other(
                params, state, named, j, place, variance
            ):
                return True
    return False


@compiled
def shows_other(
    params: Constants, state: State, named: int, j: int, place: int, variance: float
) -> bool:
    """Whether channel j shows more in a block than the named channels explain.

    ``amplitude`` holds the regression of channel j on each of the named channels.
    """
    values = state.scales[BLOCK].series[place]
    largest = 0.0
    p = 0
    other = values[j]
    for i in range(params.sensors.n):
        if named >> i & 1:
            other -= state.case.inference.amplitude[p] * values[i]
            largest = max(largest, abs(values[i]))
            p += 1
    return abs(other) > HEALTHY_SIGMAS * math.sqrt(variance) + HEALTHY_SHARE * largest


@compiled
def fill_correlations(information: Array, i: int, named: int, out: Array) -> None:
    """Fill the correlations of the residual of channel i with those of the named channels."""
    q = 0
    for j in range(len(information)):
        if named >> j & 1:
            scale = math.sqrt(information[i, i] * information[j, j])
            out[q] = information[i, j] / scale
            q += 1


@compiled
def widen(params: Constants, state: State) -> None:
    """Suspect further channels where blocks show them: the rest of the unit, if that explains all."""
    inference = state.case.inference
    named = inference.common
    inference.common = 0
    for unit in range(params.units):
        inside = params.members[unit] & inference.mask
        if named == inside:
            # A whole unit is not named, but the set that the odds give stays.
            return
        holds = named & ~inside == 0 and inside != inference.mask
        if holds and not shows_others(params, state, inside):
            inference.union = inside
            return
    inference.union = inference.judged
    inference.fitted = False


@compiled
def name_channels(params: Constants, state: State) -> None:
    """Name the channels that explain the mean since the onset, or the last half of a long one."""
    kf = state.estimator
    case = state.case
    inference = state.case.inference
    size = kf.samples - case.onset + 1
    if is_after_hole(params, kf):
        # Moves in the hole are in the variances of the biases.
        case.healthy_move = 0.0
    elif not case.isolated:
        # Once a channel is named, the allowed move stays, and so does the name.
        case.healthy_move = move_of_healthy_bias(params, kf, size * params.period)
    if size * params.period > LONG_TIME:
        # A drift is largest at the end.
        size = size // 2 + 1
    if (kf.samples - kf.returned) * params.period > LEAST_RETURN:
        # A mean across a gap belongs to different motion.
        size = min(size, kf.samples - kf.returned + 1)
    # A fault that began suddenly has been the candidate since then.
    since = case.since if case.candidate else kf.samples
    grown = (since - case.onset) * params.period
    inference.slow = params.bias_move > 0.0 and SLOW < grown < WARMS
    case.louder = fill_louder(params, state, size)
    if case.isolated == 0 and case.healthy_move > 0.0 and params.bias_move > 0.0:
        find_sudden(params, kf, case)
    if explain_beside_moves(params, state, size):
        return
    steps = max(size // RENAME, 1)
    case.next = kf.samples + steps
    follow_fits(params, case, steps * params.period)
    if gives_up(params, state, steps * params.period):
        return
    if inference.common and shows_others(params, state, inference.common):
        widen(params, state)
    if not lacks_witnesses(case):
        case.witnesses = inference.mask
    case.suspects = inference.union
    isolate(params, kf, case)
    leave_aside(params, state)


@compiled
def find_sudden(params: Constants, kf: Estimator, case: Case) -> None:
    """Find the channels that explain the change at the onset: healthy biases move slowly."""
    inference = case.inference
    size = samples_of_change(params, kf, SLOWLY)
    case.sudden = 0
    if case.onset + size <= kf.samples + 1:
        inference.moved = params.bias_move * size * params.period / SLOWLY
        inference.may_shift = True
        slow = inference.slow
        inference.slow = False
        explained = explain_change(params, kf, inference, case.onset, size)
        if explained and inference.fitted and inference.log_odds > SUDDEN:
            case.sudden = inference.likeliest
        inference.slow = slow and not case.sudden


@compiled
def explain_beside_moves(params: Constants, state: State, size: int) -> bool:
    """Explain the mean of the last ``size`` samples; return whether all biases have shifted.

    A shift that is too young to be accepted is no suspicion against any channel. No channel
    is named while a shift is likely. A shift is compared with faults before moves of single
    biases are allowed for, which would hide that other channels are quiet.
    """
    case = state.case
    inference = state.case.inference
    inference.may_shift = case.isolated == 0 and params.largest_move > 0.0
    explain_case(params, state.estimator, case, size, 0.0)
    age = (state.estimator.samples - case.onset) * params.period
    shifted = inference.shift > 0.0 and inference.fitted and is_steady(params, state)
    if (
        shifted
        and lately_moved(state) + inference.shift <= LARGEST_MOVES * params.largest_move
    ):
        if age > SETTLED_AMONG_FEW:
            let_biases_move(params, state, inference.shift)
        else:
            case.next = state.estimator.samples + 1
        return True
    if case.sudden and inference.common == case.sudden:
        case.healthy_move = 0.0
    if case.healthy_move > 0.0:
        may_be_shift = inference.may_be_shift
        inference.may_shift = False
        explain_case(params, state.estimator, case, size, case.healthy_move)
        inference.may_be_shift = may_be_shift
        if may_be_shift:
            inference.common = 0
    return False


@compiled
def fill_louder(params: Constants, state: State, size: int) -> bool:
    """Find how much noisier than learned the last ``size`` samples are; return whether any channel is.

    A channel that becomes noisy shows means that its learned noise does not explain.
    """
    kf = state.estimator
    scale = state.scales[SAMPLE]
    inference = state.case.inference
    is_louder = False
    for i in range(params.sensors.n):
        inference.louder[i] = 0.0
        if kf.judged >> i & 1:
            steps = min(max(size - 1, FEWEST_STEPS), KEPT - 1)
            grown = mean_step(scale, i, steps, 2)
            if 1 < size <= FEWEST_STEPS:
                grown = max(grown, mean_step(scale, i, size - 1, size > 3))
            if square_of_mean(scale, i, min(size, KEPT)) > STEADY_RATIO * grown:
                continue
            # The statistic shows a share of the noise of its channel.
            own = kf.parity.information[i, i] * kf.noise.now.sample[i]
            share = min(max(own, LEAST_NOISE_SHARE), 1.0)
            excess = (grown * normal_variance(kf, i) - 1.0) / share
            inference.louder[i] = max(excess - LOUDER, 0.0) * kf.noise.now.sample[i]
            is_louder = is_louder or inference.louder[i] > 0.0
    return is_louder


@compiled
def square_of_mean(scale: Scale, i: int, count: int) -> float:
    """Return the square of the mean of the last values of channel i."""
    total = 0.0
    for k in range(count):
        total += value_at(scale, k, i)
    return (total / count) ** 2


@compiled
def mean_step(scale: Scale, i: int, steps: int, without: int) -> float:
    """Return half the mean square of the last differences of channel i, without the largest ones.

    ``without`` counts these, at most 2. White noise of variance one gives one.
    """
    squares = first = second = 0.0
    for k in range(steps):
        step = value_at(scale, k, i) - value_at(scale, k + 1, i)
        square = 0.5 * step * step
        squares += square
        if square > first:
            second = first
            first = square
        else:
            second = max(second, square)
    if without < 2:
        return (squares - without * first) / (steps - without)
    # These two of m squares of normal values have a sum of 3.5 log m - 2.6 on average.
    return (squares - first - second) / (steps - 3.5 * math.log(steps) + 2.6)


@compiled
def is_steady(params: Constants, state: State) -> bool:
    """Whether the errors of all channels have stayed the same since `STARTS` after the onset.

    A gain or a delay of a unit varies with the motion, a shift of the biases does not.
    """
    kf = state.estimator
    scale = state.scales[BLOCK]
    seconds = (kf.samples - state.case.onset) * params.period - STARTS
    count = min(int(seconds / BLOCK_TIME), scale.kept)
    for i in range(params.sensors.n):
        total = squares = 0.0
        for back in range(count):
            value = value_at(scale, back, i)
            total += value
            squares += value * value
        if count * squares > (1.0 + UNSTEADY) * total * total + THREE_SIGMA * count**2:
            return False
    return True


@compiled
def gives_up(params: Constants, state: State, seconds: float) -> bool:
    """Give up a case that no hypothesis explains; return whether that was done.

    It must have been unexplained for `UNSOLVED`.

    ``seconds`` is the time since the last call. Afterwards all sensor errors are as
    uncertain as at the start, and the biases by as much as the channels differ.
    """
    kf = state.estimator
    case = state.case
    layout = params.layout
    inference = state.case.inference
    unclear = inference.may_be_shift or not inference.fitted
    unsolved = case.isolated == 0 and unclear
    case.unsolved = max(case.unsolved + (seconds if unsolved else -seconds), 0.0)
    if params.largest_move == 0.0 or case.unsolved < UNSOLVED:
        return False
    std = unexplained(inference, params.sensors.n)
    move_biases(params, kf, std, 0.0)
    for r in range(params.sensors.n, layout.count):
        kf.states.p[r, r] += layout.prior[r] * layout.prior[r]
    # The snapshots are wrong too, and too certain: discard them.
    for tier in range(TIERS):
        kf.taken[tier] = 0
    kf.noise.regime_seconds[kf.noise.regime] = 0.0
    update_unknown(kf.noise, params.sensors.n, 0.0)
    forget_evidence(params, state)
    update_weights(params, kf)
    return True


@compiled
def explain_case(
    params: Constants, kf: Estimator, case: Case, size: int, moved: float
) -> None:
    """Explain the mean of the last ``size`` samples, where each bias may have moved by ``moved``, rad/s."""
    case.inference.moved = moved
    set_mean(params, kf, case.inference, size)
    explain_with_misfit(params, case.inference)
    if lacks_witnesses(case):
        keep_suspects(case)


@compiled
def follow_fits(params: Constants, case: Case, seconds: float) -> None:
    """Follow for how long each fault of one channel or two has not explained the mean.

    A mean that is noise without any fault, as in slow motion, says nothing of them.
    """
    inference = case.inference
    n = params.sensors.n
    if leaves_noise(inference, n, 0, 0.0):
        return
    for k in range(inference.small):
        members = inference.members[k]
        first, last = ends_of(members, n)
        fits = leaves_noise(inference, n, members, inference.fits[k])
        unfit = case.unfit[first, last] + (-seconds if fits else seconds)
        case.unfit[first, last] = min(max(unfit, 0.0), UNSOLVED)


@compiled
def ends_of(mask: int, n: int) -> tuple[int, int]:
    """Return the first and the last channel of a set, of n."""
    first = last = -1
    for i in range(n):
        if mask >> i & 1:
            last = i
            if first < 0:
                first = i
    return first, last


@compiled
def has_fitted(case: Case, n: int) -> bool:
    """Whether the likeliest hypothesis has explained the mean for as long as it has not.

    The mean of a unit that is wrong as a whole looks like a fault of one channel at times.
    """
    if number_in(case.inference.likeliest, n) > 2:
        return True
    first, last = ends_of(case.inference.likeliest, n)
    return case.unfit[first, last] == 0.0


@compiled
def unfit_channels(case: Case, n: int) -> int:
    """Return the channels of which a fault of each alone has not explained the means lately."""
    mask = 0
    for i in range(n):
        if case.unfit[i, i] > 0.0:
            mask |= 1 << i
    return mask


@compiled
def fade_fits(case: Case, n: int, seconds: float) -> None:
    """Forget within `WARMS` without a case which faults have not explained the mean."""
    forget_fits(case, n, seconds * UNSOLVED / WARMS)


@compiled
def forget_fits(case: Case, n: int, seconds: float) -> None:
    """Forget ``seconds`` of the time in which faults have not explained the mean."""
    for i in range(n):
        for j in range(n):
            case.unfit[i, j] = max(case.unfit[i, j] - seconds, 0.0)


@compiled
def isolate(params: Constants, kf: Estimator, case: Case) -> None:
    """Isolate the channels that all likely hypotheses have had in common for long enough."""
    inference = case.inference
    if lacks_witnesses(case) and inference.common == case.isolated:
        # Nothing is learned of the candidate: the time that it has stood pauses.
        case.since += case.next - kf.samples
        return
    if inference.common != case.candidate:
        case.candidate = inference.common
        case.since = kf.samples
    stood = (kf.samples - case.since) * params.period
    # A single outlying value decides nothing, whatever the odds.
    may_be_spike = 0 < kf.far_samples < params.least
    settled = stood >= time_to_settle(params, inference)
    fitted = settled and inference.common and has_fitted(case, params.sensors.n)
    if fitted and not may_be_spike:
        case.isolated = inference.common
    elif not inference.common & case.isolated:
        case.isolated = 0


@compiled
def time_to_settle(params: Constants, inference: Inference) -> float:
    """Return the time that a name must stand before it is declared, s."""
    if inference.common & (inference.common - 1):
        return SETTLED_TOGETHER
    if inference.log_odds >= CLEAR_ODDS:
        return 0.0
    if redundancy(inference.mask, params.sensors.n) > FEW_CHECKS:
        return SETTLED_ALONE
    return SETTLED_AMONG_FEW


@compiled
def lacks_witnesses(case: Case) -> bool:
    """Whether channels are missing that were present when the suspects were found, suspects aside."""
    found = case.suspects | case.isolated
    return found != 0 and case.witnesses & ~case.inference.mask & ~found != 0


@compiled
def keep_suspects(case: Case) -> None:
    """Keep the suspects where the remaining channels do not clear them.

    The remaining channels may be unable to distinguish two units, but earlier ones were able.
    """
    inference = case.inference
    if inference.union & case.suspects:
        inference.common = case.isolated
        inference.union = case.suspects
        inference.fitted = True


@compiled
def lately_moved(state: State) -> float:
    """Return the recent move of all biases, standard deviation, rad/s."""
    case = state.case
    passed = state.estimator.seconds - case.moved_at
    return case.moved * math.exp(-passed / WARMS)


@compiled
def let_biases_move(params: Constants, state: State, std: float) -> None:
    """Accept a move of all biases with this standard deviation, rad/s."""
    kf = state.estimator
    case = state.case
    n = params.sensors.n
    if predict_from(params, kf, time_before(params, kf, case), case.before):
        keep_reference(params, kf, case.before, case.references)
    case.moved = lately_moved(state) + std
    case.moved_at = kf.seconds
    case.moved_since = case.onset
    case.farthest = case.moved + params.largest_move
    for i in range(n):
        case.reference[i] = kf.states.x[i]
    move_biases(params, kf, std, 0.5 * params.largest_move / WARMS)
    # A bias that moves as a turn begins has been learned as a scale error.
    widen_scales(params, kf.states)
    kf.noise.regime_seconds[kf.noise.regime] = 0.0
    update_unknown(kf.noise, n, 0.0)
    forget_evidence(params, state)
    update_weights(params, kf)


@compiled
def goes_too_far(params: Constants, state: State) -> bool:
    """Whether a bias has gone farther or faster than a move of all biases may: a fault, not a move."""
    kf = state.estimator
    case = state.case
    feeds = params.layout.feeds
    if case.moved == 0.0 or kf.seconds - case.moved_at > WARMS:
        return False
    for r in range(params.layout.count):
        far = (
            r < params.sensors.n
            and abs(kf.states.x[r] - case.reference[r]) > case.farthest
        )
        if far or (
            0 <= feeds[r] < params.sensors.n
            and abs(kf.states.x[r]) * WARMS > LARGEST_RATE_RATIO * params.largest_move
        ):
            return True
    return False


@compiled
def undo_move(params: Constants, state: State) -> None:
    """Open a case at the onset of a supposed move of all biases, and accept no move for `WARMS`."""
    case = state.case
    case.onset = case.moved_since
    case.moved = math.e * LARGEST_MOVES * params.largest_move
    case.moved_at = state.estimator.seconds
    # The way that the bias has gone is evidence by itself.
    open_case(params, state, LEAST_ODDS)


@compiled
def leave_aside(params: Constants, state: State) -> None:
    """Keep doubtful channels out of the learned states, and out of the rate if the others give one."""
    kf = state.estimator
    case = state.case
    kf.under_test = case.suspects | case.isolated
    kf.excluded_from_rate = 0
    for wanted in (kf.under_test, case.isolated, case.inference.likeliest):
        if kf.excluded_from_rate == 0 and params.spans[kf.mask & ~wanted]:
            kf.excluded_from_rate = wanted
    update_weights(params, kf)


@compiled
def follow_case(params: Constants, state: State) -> None:
    """Name the channels of an open case again when it has grown, and end it without evidence.

    A mean that fades in a second of quiet noise may be a fault that comes and goes.
    """
    kf = state.estimator
    case = state.case
    if kf.samples < case.next:
        return
    name_channels(params, state)
    if (
        case.open
        and case.inference.log_odds < LEAST_ODDS
        and (case.louder or (kf.samples - case.onset) * params.period > 1.0)
    ):
        forget_evidence(params, state)
        update_weights(params, kf)
