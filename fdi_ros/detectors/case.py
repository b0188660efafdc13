# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The case that evidence opens: whether it stands against the noise of its own time.

As a case is opened, the states go back to before the onset (`predict_from`), and the
mean since then is to be explained (`fdi_ros.detectors.naming`) against all that is not
known of the sensors. A case lasts until its evidence has gone, or its channels are left
out.
"""

from __future__ import annotations

import math

from fdi_ros.compiling.compiled import (
    Channels,
    Flag,
    Mask,
    Real,
    Whole,
    compiled,
    record,
)
from fdi_ros.core.algebra import dot, invert
from fdi_ros.detectors.naming import (
    MISFIT,
    Inference,
    checks,
    explain,
    moved_by,
    set_mean,
)
from fdi_ros.detectors.sums import (
    KEPT,
    PER_BLOCK,
    SIZES,
    Scales,
    forget_sums,
    look_back,
    value_at,
)
from fdi_ros.estimator.error_states import ErrorStates, copy_states
from fdi_ros.estimator.estimator import (
    LEAST_SHARE,
    LONG_TIME,
    SNAPSHOT_TIME,
    Constants,
    Estimator,
    update_weights,
)
from fdi_ros.estimator.noise import BLOCK, SCALES, update_unknown
from fdi_ros.estimator.snapshots import is_after_hole, move_biases, predict_from
from fdi_ros.model.samples import Array

STANDS = 0.6
"""Share of the logarithm of the run length that a hypothesis has, against all that is
not known, to open a case: less than the sums need, as what is not known is counted here
in full."""
ENDS = 2.0  # log odds of the likeliest hypothesis below which a case ends: hardly better than none
# channels are named again when the time since the onset has grown by this part: little
# is new before
RENAME = 16
SETTLED, SETTLED_AMONG_FEW = 0.2, 0.5
SETTLED_TOGETHER = 2.0 * SETTLED_AMONG_FEW
"""s that a name must stand, of one channel, where at most `FEW_CHECKS` check it, and of
two: several faults look like one at first, and with so few checks three faults explain
anything."""
FEW_CHECKS = 3
CLEAR = 5000.0
"""Log odds of a single fault from which it is named at once: a second error a twentieth
as large would show by five standard deviations, (0.05^2) 2 CLEAR = 25."""
OTHERS, TURNED = 6.0, 0.3
"""What is left of other channels in a block, if only those named are faulty: within so
many standard deviations, that noise does not reach in a flight, and so much of the
others' error, as axes are learned while they are watched."""
ALIKE = 1e-3  # least share of the variance of a channel that others do not explain
LARGEST_MOVE, WARMS = 0.04, 30.0
"""All biases may move by so many rad/s within so many s (warming, rectified vibration):
that is no fault."""
DRIFT_TIMES = 4
LONGEST_DRIFT = WARMS * (1 << DRIFT_TIMES)
"""A slow drift is looked for over so many s (480), as long as states are kept, and half
as long, so many times."""
# s after a gap from which the mean begins anew: as long as a name must stand
LEAST_RETURN = 0.2
# by so much at once at most: motors that start move biases by some 5 mrad/s, and no
# more
LARGEST_STEP = 0.015
FASTEST = (
    2.5  # and so many times as fast as that for a moment: warming is quickest at first
)


@record
class Case:
    """An alarm that stands."""

    open: Flag
    onset: Whole  # number of its first sample
    next: Whole  # sample at which channels are named again
    candidate: Mask  # channels that could be named
    since: Whole  # sample since which they could
    isolated: Mask  # faulty for certain
    suspects: Mask  # at least one of them is faulty
    witnesses: Mask  # channels that those were found among
    retry: Whole  # no case is opened before this sample
    before: ErrorStates  # the states as they were when it was opened
    moved: Real  # how far all biases have moved lately, rad/s
    moved_at: Real  # when they last have, s since the start
    moved_since: Whole  # number of the first sample that showed it
    reference: Channels  # biases before, rad/s
    inference: Inference


@record
class State:
    """Memory of the method."""

    begun: Flag
    restored: Flag  # the states are those of a former run
    cleared: Flag  # all suspicion is to be forgotten
    declared: Mask  # channels that were declared until then
    stamp: Whole  # of the last sample, ns
    estimator: Estimator
    scales: Scales
    case: Case


@compiled
def forget_evidence(params: Constants, state: State) -> None:
    """Begin all sums anew, and end the case; the states and the noise stay."""
    state.case.open = False
    state.case.isolated = state.case.suspects = state.estimator.excluded_from_rate = (
        state.estimator.under_test
    ) = 0
    forget_sums(params, state.scales)


@compiled
def look_for_case(params: Constants, state: State) -> None:
    """Look for a time scale whose evidence stands against the noise of that same time; open the case there."""
    kf, case, best, found = state.estimator, state.case, math.log(params.limit), False
    for at in range(SCALES):
        scale, largest, channel, sign = state.scales[at], 0.0, -1, 1.0
        for i in range(params.sensors.n):
            for side in range(2):
                for s in range(SIZES):
                    if scale.sums[side, i, s] > largest:
                        largest, channel, sign = (
                            scale.sums[side, i, s],
                            i,
                            1.0 - 2.0 * side,
                        )
        if channel < 0 or largest < params.limit:
            continue
        since, evidence = look_back(params, kf, scale, channel, sign)
        evidence = min(evidence, since * math.log(kf.noise.cap[at, channel]))
        samples = max(PER_BLOCK[at] * params.length, 1)
        if since >= 2 and since * samples >= params.least and evidence >= best:
            best, found = evidence, True
            case.onset = scale.first[(scale.newest - since + 1 + KEPT) % KEPT]
    if found:
        open_case(params, state)


@compiled
def look_for_drift(params: Constants, state: State) -> None:
    """Open a case where the rate of change of a bias is none of those that biases have.

    What is learned of it has the variance that is lost: ``x^2 / (prior - P)`` is the
    square of a normal value.
    """
    kf, case, layout, worst = state.estimator, state.case, params.layout, 0.0
    if case.moved > 0.0 and kf.seconds - case.moved_at < LONGEST_DRIFT:
        return
    for r in range(layout.n, layout.count):
        if 0 <= layout.feeds[r] < layout.n:
            prior = layout.prior[r] * layout.prior[r]
            learned = max(prior - kf.states.p[r, r], LEAST_SHARE * prior)
            worst = max(worst, kf.states.x[r] * kf.states.x[r] / learned)
    if worst < 2.0 * math.log(params.limit):
        return
    for k in range(DRIFT_TIMES):
        seconds = LONGEST_DRIFT / (1 << k)
        if not case.open and kf.seconds > seconds:
            case.onset = kf.samples - int(seconds / params.period)
            open_case(params, state)


@compiled
def look_for_change_in_hole(params: Constants, state: State) -> None:
    """Open a case where a bias is another than before a hole in the stream, by more than it may have moved meanwhile.

    At first after a hole slow noise is unknown, and the states follow what the sums do not see.
    """
    kf, case, n, worst = state.estimator, state.case, params.sensors.n, 0.0
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
                worst, change * change / max(prior - posterior, LEAST_SHARE * prior)
            )
    if worst >= 2.0 * math.log(params.limit):
        case.onset = kf.hole_sample + 1
        open_case(params, state)


@compiled
def open_case(params: Constants, state: State) -> None:
    """Go back to before the onset, and see whether a hypothesis stands against all that is not known of the sensors."""
    kf, case = state.estimator, state.case
    case.onset = max(case.onset, 1)
    case.open, case.candidate, case.isolated = True, 0, 0
    case.suspects = case.witnesses = 0
    copy_states(params.layout, kf.states, case.before)
    since = (kf.samples - case.onset) * params.period
    before = kf.seconds - since - max(SNAPSHOT_TIME, 0.3 * since)
    if case.onset == kf.hole_sample + 1:
        before = kf.hole_at
    predict_from(params, kf, before, kf.states)
    name_channels(params, state)
    if case.open and case.inference.log_odds < STANDS * math.log(params.limit):
        copy_states(params.layout, case.before, kf.states)
        case.open = False
        kf.excluded_from_rate = 0
        update_weights(params, kf)
        case.retry = kf.samples + 1 + (kf.samples - case.onset) // 4


@compiled
def shows_others(params: Constants, state: State, named: int) -> bool:
    """Whether single blocks since the onset show errors of other channels than those named, at most three.

    The mean of two that come and go, or that began one after the other, may look like a
    third. That of a channel points its own way in every block, however large it is in
    each.
    """
    kf, inference, n = state.estimator, state.case.inference, params.sensors.n
    information, count = kf.block_information, 0
    for i in range(n):
        if named >> i & 1:
            if count == 3 or not information[i, i] > 0.0:
                return False
            fill_correlations(information, i, named, inference.matrix[count])
            # Channels that look alike have no matrix that can be inverted.
            inference.matrix[count, count] += ALIKE
            count += 1
    invert(inference.matrix, count, inference.inverse)
    for j in range(n):
        if not named >> j & 1 and kf.judged >> j & 1 and information[j, j] > 0.0:
            # Regression on those named.
            fill_correlations(information, j, named, inference.along)
            variance = 1.0
            for p in range(count):
                share = dot(inference.inverse[p], inference.along, count)
                inference.amplitude[p] = share
                variance -= share * inference.along[p]
            if variance > ALIKE and shows_other(params, state, named, j, variance):
                return True
    return False


@compiled
def shows_other(
    params: Constants, state: State, named: int, j: int, variance: float
) -> bool:
    """Whether channel j shows more in a block than those named explain, by the shares in ``amplitude``."""
    case, scale = state.case, state.scales[BLOCK]
    for back in range(scale.kept):
        first = scale.first[(scale.newest - back + KEPT) % KEPT]
        if first < case.onset - params.length:
            break
        other, largest, p = value_at(scale, back, j), 0.0, 0
        for i in range(params.sensors.n):
            if named >> i & 1:
                x = value_at(scale, back, i)
                other -= case.inference.amplitude[p] * x
                largest = max(largest, abs(x))
                p += 1
        if abs(other) > OTHERS * math.sqrt(variance) + TURNED * largest:
            return True
    return False


@compiled
def fill_correlations(information: Array, i: int, named: int, out: Array) -> None:
    """Correlations of what is left over of channel i with that of those named, at most three."""
    q = 0
    for j in range(len(information)):
        if named >> j & 1:
            scale = math.sqrt(information[i, i] * information[j, j])
            out[q] = information[i, j] / scale
            q += 1


@compiled
def widen(params: Constants, state: State) -> None:
    """Suspect more channels than those named, as blocks show others: those of their unit, if these explain all."""
    inference = state.case.inference
    named = inference.common
    inference.common = 0
    for unit in range(params.units):
        inside = params.members[unit] & inference.mask
        holds = named & ~inside == 0 and named != inside and inside != inference.mask
        if holds and not shows_others(params, state, inside):
            inference.union = inside
            return
    inference.union, inference.fitted = inference.judged, False


@compiled
def name_channels(params: Constants, state: State) -> None:
    """Name the channels that explain the mean since the onset, or of its last half if that is long ago."""
    kf, case, inference = state.estimator, state.case, state.case.inference
    size = kf.samples - case.onset + 1
    if size * params.period > LONG_TIME:
        # A drift is largest at last.
        size = size // 2 + 1
    if (kf.samples - kf.returned) * params.period > LEAST_RETURN:
        # Means over a gap are of another motion.
        size = min(size, kf.samples - kf.returned + 1)
    explain_mean(params, kf, inference, size)
    if lacks_witnesses(case):
        keep_suspects(case)
    std = 0.0 if case.isolated else moved_by(inference, params.sensors.n)
    if std > 0.0 and let_biases_move(params, state, std):
        return
    case.next = kf.samples + max(size // RENAME, 1)
    if inference.common and shows_others(params, state, inference.common):
        widen(params, state)
    if not lacks_witnesses(case):
        case.witnesses = inference.mask
    case.suspects = inference.union
    isolate(params, kf, case)
    leave_aside(params, state)


@compiled
def explain_mean(
    params: Constants, kf: Estimator, inference: Inference, size: int
) -> None:
    """Explain the mean of the last ``size`` samples, by a model that may be wrong by a share of the error found."""
    set_mean(params, kf, inference, size)
    explain(params, inference)
    misfit = MISFIT * inference.largest
    for i in range(params.sensors.n):
        inference.covariance[i, i] += misfit * misfit
    explain(params, inference)


@compiled
def isolate(params: Constants, kf: Estimator, case: Case) -> None:
    """Call channels faulty that all likely hypotheses have had in common for long enough."""
    inference = case.inference
    if inference.common != case.candidate:
        case.candidate, case.since = inference.common, kf.samples
    stood = (kf.samples - case.since) * params.period
    # One value that is far off decides nothing, whatever the odds.
    may_be_spike = 0 < kf.far_samples < params.least
    settled = stood >= time_to_settle(params, inference)
    if inference.common and settled and not may_be_spike:
        case.isolated = inference.common
    elif not inference.common & case.isolated:
        case.isolated = 0


@compiled
def time_to_settle(params: Constants, inference: Inference) -> float:
    """How long a name must stand, s."""
    if inference.common & (inference.common - 1):
        return SETTLED_TOGETHER
    if inference.log_odds >= CLEAR:
        return 0.0
    if checks(inference.mask, params.sensors.n) > FEW_CHECKS:
        return SETTLED
    return SETTLED_AMONG_FEW


@compiled
def lacks_witnesses(case: Case) -> bool:
    """Whether channels are away that the suspects were found among, and that are none of them."""
    found = case.suspects | case.isolated
    return found != 0 and case.witnesses & ~case.inference.mask & ~found != 0


@compiled
def keep_suspects(case: Case) -> None:
    """Keep what is known of the suspects, if the channels that are left do not clear them.

    The others may not tell two units apart; who was wrong before is.
    """
    inference = case.inference
    if inference.union & case.suspects:
        inference.common, inference.union = case.isolated, case.suspects
        inference.fitted = True


@compiled
def let_biases_move(params: Constants, state: State, std: float) -> bool:
    """Go on with biases that have all moved by so much, rad/s, if that is not too far; return whether it is done."""
    kf, case, n = state.estimator, state.case, params.sensors.n
    lately = case.moved * math.exp(-(kf.seconds - case.moved_at) / WARMS) + std
    if lately > LARGEST_MOVE or std > LARGEST_STEP:
        return False
    case.moved, case.moved_at, case.moved_since = lately, kf.seconds, case.onset
    for i in range(n):
        case.reference[i] = kf.states.x[i]
    move_biases(params, kf, std, 0.5 * LARGEST_MOVE / WARMS)
    kf.noise.lived[kf.noise.regime] = 0.0
    update_unknown(kf.noise, n, 0.0)
    forget_evidence(params, state)
    update_weights(params, kf)
    return True


@compiled
def goes_too_far(params: Constants, state: State) -> bool:
    """Whether a bias goes farther or faster since all have moved than they may: what passed for a move is a fault."""
    kf, case, feeds = state.estimator, state.case, params.layout.feeds
    if case.moved == 0.0 or kf.seconds - case.moved_at > WARMS:
        return False
    for r in range(params.layout.count):
        far = (
            r < params.sensors.n
            and abs(kf.states.x[r] - case.reference[r]) > LARGEST_MOVE
        )
        if far or (
            0 <= feeds[r] < params.sensors.n
            and abs(kf.states.x[r]) * WARMS > FASTEST * LARGEST_MOVE
        ):
            return True
    return False


@compiled
def undo_move(params: Constants, state: State) -> None:
    """Open a case where all biases seemed to move; for `WARMS` no move is believed, as if they had moved too far."""
    case = state.case
    case.onset, case.moved, case.moved_at = (
        case.moved_since,
        math.e * LARGEST_MOVE,
        state.estimator.seconds,
    )
    open_case(params, state)


@compiled
def leave_aside(params: Constants, state: State) -> None:
    """Leave channels under doubt out of the rate, as far as the others give one, and out of what is learned."""
    kf, case = state.estimator, state.case
    kf.under_test = case.suspects | case.isolated
    kf.excluded_from_rate = 0
    for wanted in (kf.under_test, case.isolated, case.inference.likeliest):
        if kf.excluded_from_rate == 0 and params.spans[kf.mask & ~wanted]:
            kf.excluded_from_rate = wanted
    update_weights(params, kf)


@compiled
def follow_case(params: Constants, state: State) -> None:
    """Name the channels of an open case again when it has grown; end it when its evidence has gone."""
    kf, case = state.estimator, state.case
    if kf.samples < case.next:
        return
    name_channels(params, state)
    if (
        case.open
        and case.inference.log_odds < ENDS
        and (kf.samples - case.onset) * params.period > 1.0
    ):
        forget_evidence(params, state)
        update_weights(params, kf)
