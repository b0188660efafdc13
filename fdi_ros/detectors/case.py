# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Evidence at four time scales, and the case that it opens: whether it stands against the noise of its own time.

Evidence is Shiryaev-Roberts sums over channels, signs and sizes of a fault. A large sum is looked back at: since when
its channel is off, and how far beyond the scatter of that same time. As a case is opened, the states go back to before
the onset (`predict_from`), and the mean since then is to be explained (`fdi_ros.detectors.naming`) against all that is
not known of the sensors.
"""

from __future__ import annotations

import math
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import (
    MAX_CHANNELS,
    Channels,
    Flag,
    Mask,
    Real,
    Whole,
    compiled,
    record,
)
from fdi_ros.detectors.naming import (
    MISFIT,
    Inference,
    checks,
    explain,
    moved_by,
    set_mean,
)
from fdi_ros.estimator.blocks import is_after_hole, move_biases, predict_from
from fdi_ros.estimator.error_states import ErrorStates, copy_states
from fdi_ros.estimator.estimator import (
    LEAST_SHARE,
    LONG_TIME,
    SNAPSHOT_TIME,
    Constants,
    Estimator,
    update_weights,
)
from fdi_ros.estimator.noise import (
    BLOCK,
    BURST,
    FAR,
    LONG,
    SAMPLE,
    SCALES,
    update_block_noise,
    update_long_noise,
    update_sample_noise,
    update_unknown,
)
from fdi_ros.estimator.shared_noise import update_shared
from fdi_ros.model.samples import Array

SIZES, KEPT = 6, 64  # of a fault; values of each time scale that are looked back at
PER_BLOCK = (0, 1, 6, 48)  # blocks in a value of each time scale; 0: samples
SMALLEST = 0.2
"""Smallest size of a fault, in standard deviations at its time scale; each next one is twice as large, up to 6.4. From
one to the next at most 11 % of the delay are lost, and smaller faults are found at a longer time scale."""
FIRST_LONG = 2  # sizes left out at the longest time scale: less than 0.8 there is a walk of the bias
STEP_LIMIT = 7.0  # a value counts as this many standard deviations at most (Huber 1965): beyond the largest size
CEILING = (
    1e6  # sums stay below so many times the threshold: what has passed is forgotten
)
STANDS = 0.6
"""Share of the logarithm of the run length that a hypothesis has, against all that is not known, to open a case: less
than the sums need, as what is not known is counted here in full."""
ENDS = 2.0  # log odds of the likeliest hypothesis below which a case ends: hardly better than none
RENAME = 16  # channels are named again when the time since the onset has grown by this part: little is new before
SETTLED, SETTLED_AMONG_FEW = 0.2, 0.5
SETTLED_TOGETHER = 2.0 * SETTLED_AMONG_FEW
"""s that a name must stand, of one channel, where at most `FEW_CHECKS` check it, and of two: several faults look like
one at first, and with so few checks three faults explain anything."""
FEW_CHECKS = 3
CLEAR = 5000.0
"""Log odds of a single fault from which it is named at once: a second error a twentieth as large would show by
five standard deviations, (0.05^2) 2 CLEAR = 25."""
OTHERS, TURNED = 6.0, 0.3
"""What is left of other channels in a block, if only those named are faulty: within so many standard deviations, that
noise does not reach in a flight, and so much of the others' error, as axes are learned while they are watched."""
LARGEST_MOVE, WARMS = 0.04, 30.0
"""All biases may move by so many rad/s within so many s (warming, rectified vibration): that is no fault."""
DRIFT_TIMES = 4
LONGEST_DRIFT = WARMS * (1 << DRIFT_TIMES)
"""A slow drift is looked for over so many s (480), as long as states are kept, and half as long, so many times."""
LARGEST_STEP = 0.015  # by so much at once at most: motors that start move biases by some 5 mrad/s, and no more
FASTEST = (
    2.5  # and so many times as fast as that for a moment: warming is quickest at first
)
Sums = Annotated[NDArray[np.float64], "f8", (2, MAX_CHANNELS, SIZES)]
Series = Annotated[NDArray[np.float64], "f8", (KEPT, MAX_CHANNELS)]
Firsts = Annotated[NDArray[np.int64], "i8", (KEPT,)]


@record
class Scale:
    """Evidence of one time scale."""

    filled: Whole  # blocks in the value being filled
    values: Channels  # sum of their A y, s/rad
    information: Channels  # sum of their A_ii, s^2/rad^2
    newest: Whole  # place of the last value
    kept: Whole  # values that may be looked back at
    series: Series  # values, in standard deviations
    first: Firsts  # number of the first sample in each
    sums: Sums
    total: Real  # of all sums


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
    scales: Annotated[list[Scale], SCALES]
    case: Case


# The sums -------------------------------------------------------------------------------------------------------------


@compiled
def add_evidence(
    params: Constants, kf: Estimator, scale: Scale, at: int, first_sample: int
) -> None:
    """Take the last values y of a time scale, in its series, into its sums: R <- (1 + R) exp(s y - s^2 / 2)."""
    first, ceiling = FIRST_LONG if at == LONG else 0, CEILING * params.limit
    scale.first[scale.newest] = first_sample
    scale.kept = min(scale.kept + 1, KEPT)
    scale.total = 0.0
    for i in range(params.sensors.n):
        if not kf.judged >> i & 1:
            continue
        y, cap = scale.series[scale.newest, i], kf.noise.cap[at, i]
        for side in range(2):
            sums, total, size = scale.sums[side, i], 0.0, SMALLEST
            factor = math.exp(SMALLEST * min(y if side == 0 else -y, STEP_LIMIT))
            for k in range(SIZES):
                if k >= first:
                    sums[k] = min(
                        (1.0 + sums[k])
                        * min(factor * math.exp(-0.5 * size * size), cap),
                        ceiling,
                    )
                    total += sums[k]
                factor *= factor
                size *= 2.0
            scale.total += total


@compiled
def value_at(scale: Scale, back: int, i: int) -> float:
    """Return the value of channel i so many before the last one."""
    return scale.series[(scale.newest - back + KEPT) % KEPT, i]


@compiled
def scatter_of(scale: Scale, i: int, sign: float, count: int, mean: float) -> float:
    """Variance of a mean of the last values times their number: of single ones, or of batches if that is more."""
    worst, size = 0.0, 1
    while count // size >= 4 or size == 1:
        batches, squares = count // size, 0.0
        for b in range(batches):
            total = 0.0
            for k in range(b * size, (b + 1) * size):
                total += sign * value_at(scale, k, i) - mean
            squares += total * total
        worst = max(worst, squares / size / max(batches - 1.0, 1.0))
        size *= 2
    return worst


@compiled
def look_back(
    params: Constants, kf: Estimator, scale: Scale, i: int, sign: float
) -> tuple[int, float]:
    """Find since when channel i is off, and the evidence for it against the noise of that same time.

    Returns
    -------
    Values since the onset, and the logarithm of the likelihood ratio: Student's, with the degrees of freedom that the
    learned noise counts for and those of the values themselves.
    """
    best, since, total = 0.0, 0, 0.0
    for k in range(scale.kept):
        total += sign * value_at(scale, k, i)
        t = total / math.sqrt(k + 1.0)
        if t > best:
            best, since = t, k + 1
    if since < 2:
        return since, 0.0
    mean, trust = best / math.sqrt(since), kf.noise.degrees[i]
    squares, count = 0.0, 0
    for j in range(params.sensors.n):
        if kf.judged >> j & 1:
            count += 1
            for k in range(since - 1):
                step = value_at(scale, k, j) - value_at(scale, k + 1, j)
                squares += min(0.5 * step * step, FAR)
    # Of so many channels three fewer differ from what a rate explains.
    checks = max(count - 3.0, 1.0)
    pooled = (trust + squares / max(count, 1) * checks) / (
        trust + checks * (since - 1.0)
    )
    degrees = trust + since - 1.0
    scatter = scatter_of(scale, i, sign, since, mean)
    variance = max((trust + (since - 1.0) * scatter) / degrees, pooled)
    return since, 0.5 * (degrees + 1.0) * math.log(
        1.0 + mean * mean * since / variance / degrees
    )


@compiled
def update_from_sample(params: Constants, state: State, learns: bool) -> None:
    """Take the statistics of a sample into the noise and the sums."""
    kf, scale = state.estimator, state.scales[SAMPLE]
    noise = kf.noise
    noise.seen[SAMPLE] += 1.0
    scale.newest = (scale.newest + 1) % KEPT
    for i in range(params.sensors.n):
        scale.series[scale.newest, i] = 0.0
        if kf.judged >> i & 1:
            slow = noise.now.level[BLOCK, i] * noise.unknown[i] * noise.longest[i]
            scale.series[scale.newest, i] = kf.statistic[i] / math.sqrt(
                max(1.0, BURST * noise.quick[i], slow)
            )
    update_shared(params, kf)
    update_sample_noise(
        noise,
        params.sensors.n,
        kf.judged,
        kf.statistic,
        kf.inflation,
        learns,
        kf.samples % 2,
    )
    add_evidence(params, kf, scale, SAMPLE, kf.samples)


@compiled
def update_from_block(params: Constants, state: State, learns: bool) -> None:
    """Take the innovations of a block into the noise and the sums of the longer time scales."""
    kf, noise, n = state.estimator, state.estimator.noise, params.sensors.n
    mask, information = kf.masks[1] & kf.judged, kf.block_parity.information
    for k in range(1, SCALES):
        scale = state.scales[k]
        for i in range(n):
            if mask >> i & 1:
                scale.values[i] += kf.block_values[i]
                scale.information[i] += information[i, i]
        scale.filled += 1
        if scale.filled < PER_BLOCK[k]:
            continue
        noise.seen[k] += 1.0
        scale.newest = (scale.newest + 1) % KEPT
        known = 0
        for i in range(n):
            if scale.information[i] > 0.0:
                known |= 1 << i
                scale.values[i] /= math.sqrt(scale.information[i])
        if k == BLOCK:
            update_block_noise(noise, n, known, scale.values, params.expected, learns)
        else:
            update_long_noise(noise, k, n, known, scale.values, learns)
        for i in range(n):
            scale.series[scale.newest, i] = (
                scale.values[i] / math.sqrt(noise.unknown[i]) if known >> i & 1 else 0.0
            )
            scale.values[i] = scale.information[i] = 0.0
        scale.filled = 0
        add_evidence(
            params, kf, scale, k, kf.samples - (PER_BLOCK[k] + 1) * params.length + 1
        )


@compiled
def mean_of(params: Constants, state: State) -> float:
    """Mean of all sums."""
    total, channels = 0.0, 0
    for k in range(SCALES):
        total += state.scales[k].total
    for i in range(params.sensors.n):
        channels += state.estimator.judged >> i & 1
    return total / max(2 * (SCALES * SIZES - FIRST_LONG) * channels, 1)


@compiled
def fill_scores(params: Constants, state: State, scores: Array) -> None:
    """Logarithm of one plus the largest sum of each channel that is judged, NaN of others; scores (n,) takes them."""
    for i in range(params.sensors.n):
        largest = 0.0
        for k in range(SCALES):
            sums = state.scales[k].sums
            for s in range(SIZES):
                largest = max(largest, sums[0, i, s], sums[1, i, s])
        here = state.estimator.judged & state.estimator.mask & (1 << i)
        scores[i] = math.log(1.0 + largest) if here else math.nan


@compiled
def forget_evidence(params: Constants, state: State) -> None:
    """Begin all sums anew, and end the case; the states and the noise stay."""
    state.case.open = False
    state.case.isolated = state.case.suspects = state.estimator.excluded_from_rate = (
        state.estimator.under_test
    ) = 0
    for k in range(SCALES):
        scale = state.scales[k]
        scale.kept = scale.filled = 0
        scale.total = 0.0
        for i in range(params.sensors.n):
            scale.values[i] = scale.information[i] = 0.0
            for s in range(SIZES):
                scale.sums[0, i, s] = scale.sums[1, i, s] = 0.0


# The case -------------------------------------------------------------------------------------------------------------


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

    What is learned of it has the variance that is lost: ``x^2 / (prior - P)`` is the square of a normal value.
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
    """Whether single blocks since the onset show errors of other channels than those named.

    The mean of two that come and go, or that began one after the other, may look like a third. That of a channel points
    its own way in every block, however large it is in each.
    """
    kf, case, scale = state.estimator, state.case, state.scales[BLOCK]
    information, n = kf.block_information, params.sensors.n
    first = second = -1
    for i in range(n):
        if named >> i & 1:
            first, second = (i, -1) if first < 0 else (first, i)
    if not information[first, first] > 0.0 or (
        second >= 0 and not information[second, second] > 0.0
    ):
        return False
    both = correlation(information, first, second) if second >= 0 else 0.0
    free = max(1.0 - both * both, 1e-3)
    for j in range(n):
        if named >> j & 1 or not kf.judged >> j & 1 or not information[j, j] > 0.0:
            continue
        # Regression on the one or two that are named.
        on_first = correlation(information, j, first)
        on_second = correlation(information, j, second) if second >= 0 else 0.0
        a, b = (
            (on_first - both * on_second) / free,
            (on_second - both * on_first) / free,
        )
        variance = 1.0 - a * on_first - b * on_second
        for back in range(scale.kept):
            if (
                scale.first[(scale.newest - back + KEPT) % KEPT]
                < case.onset - params.length
            ):
                break
            x = value_at(scale, back, first)
            y = value_at(scale, back, second) if second >= 0 else 0.0
            other = abs(value_at(scale, back, j) - a * x - b * y)
            if variance > 1e-3 and other > OTHERS * math.sqrt(variance) + TURNED * max(
                abs(x), abs(y)
            ):
                return True
    return False


@compiled
def correlation(information: NDArray[Any], i: int, j: int) -> float:
    """Of what is left over of two channels."""
    return information[i, j] / math.sqrt(information[i, i] * information[j, j])


@compiled
def name_channels(params: Constants, state: State) -> None:
    """Name the channels that explain the mean since the onset, or of its last half if that is long ago."""
    kf, case, n = state.estimator, state.case, params.sensors.n
    inference = case.inference
    size = kf.samples - case.onset + 1
    if size * params.period > LONG_TIME:
        # A drift is largest at last.
        size = size // 2 + 1
    set_mean(params, kf, inference, size)
    explain(params, inference)
    # By so much of the error found the model may be wrong.
    misfit = MISFIT * inference.largest
    for i in range(n):
        inference.covariance[i, i] += misfit * misfit
    explain(params, inference)
    std = 0.0 if case.isolated else moved_by(inference, n)
    if std > 0.0 and let_biases_move(params, state, std):
        return
    case.next = kf.samples + max(size // RENAME, 1)
    if inference.common and shows_others(params, state, inference.common):
        inference.common, inference.union, inference.fitted = 0, inference.judged, False
    case.suspects = inference.union
    if inference.common != case.candidate:
        case.candidate, case.since = inference.common, kf.samples
    settled = SETTLED if checks(inference.mask, n) > FEW_CHECKS else SETTLED_AMONG_FEW
    if inference.common & (inference.common - 1):
        settled = SETTLED_TOGETHER
    elif inference.log_odds >= CLEAR:
        settled = 0.0
    if inference.common and (kf.samples - case.since) * params.period >= settled:
        case.isolated = inference.common
    elif not inference.common & case.isolated:
        case.isolated = 0
    leave_aside(params, state)


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
