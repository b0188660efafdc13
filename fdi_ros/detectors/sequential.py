# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Sequential evidence: Shiryaev-Roberts sums over channels, signs and sizes of a fault, at four time scales.

The sums are of innovations of the estimator (`fdi_ros.detectors.estimator`): white and of variance one, if what is
known of the sensors holds. Once the mean of the sums reaches the run length asked for, it is tested whether the
evidence stands against the scatter of that same time (`find_case`). If it does, the states go back to what they were
before the onset, and the mean since then is to be explained (`fdi_ros.detectors.naming`): only if a hypothesis stands
against all that is not known of the sensors is there a case. It lasts until the evidence has gone, or until its
channels are left out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from fdi_ros.core.bank import SampleInput, SampleVerdict
from fdi_ros.core.channel_set import all_sets, mask_of
from fdi_ros.core.compiled import callback, compiled
from fdi_ros.core.error_states import (
    ErrorStates,
    begin_states,
    copy_states,
    correct,
    find_signals,
    predict,
    prepare_layout,
    project,
)
from fdi_ros.core.parity import UNKNOWN_RATE, eliminate_rate, weigh_together
from fdi_ros.core.record import MAX_CHANNELS, Channels, Flag, Mask, Real, Whole, record
from fdi_ros.core.rest import REST_STD
from fdi_ros.detectors.base import Detector
from fdi_ros.detectors.estimator import (
    BLOCK_TIME,
    HOLD,
    SNAPSHOT_TIME,
    Constants,
    Estimator,
    Total,
    add_sample,
    correct_sample,
    drop_block,
    find_motion,
    find_rest,
    find_statistics,
    foresee,
    go_back,
    judge_block,
    keep_snapshot,
    learn,
    take_delays_off,
    take_sample,
    total_before,
    watch_for_motion,
    weigh,
)
from fdi_ros.detectors.naming import MISFIT, Inference, explain
from fdi_ros.detectors.noise import (
    BLOCK,
    BURST,
    LONG,
    MOTION,
    REST,
    SAMPLE,
    SCALES,
    begin_noise,
    cap_of,
    change_regime,
    find_unknown,
    longest,
    take_block_of_samples,
    take_block_step,
    take_long_step,
    take_sample_step,
)
from fdi_ros.errors import ConfigError
from fdi_ros.model.false_alarm_rate import FalseAlarmRate
from fdi_ros.model.geometry import MIN_CHANNELS, MIN_SINGULAR_RATIO, Geometry
from fdi_ros.model.noise import NoiseModel

SIZES = 6
SMALLEST = 0.2
"""Smallest size of a fault, in standard deviations at its time scale; each next one is twice as large, up to 6.4."""
FIRST_LONG = 2
"""Sizes left out at the longest time scale: less than 0.8 there is a walk of the bias."""
PER_BLOCK = (0, 1, 6, 48)
"""Blocks in a value of each time scale; 0: samples."""
STEP_LIMIT = 7.0
"""A value counts as this many standard deviations at most (Huber 1965)."""
KEPT = 64
"""Values of each time scale that are looked back at."""
LEAST_TIME = 0.02
"""s; that a fault lasts before it is declared."""
CEILING = 1e6
"""Sums stay below so many times the threshold: what has passed is forgotten."""
PLAIN = 100.0
"""A half squared difference counts as so much at most in the noise of all channels."""
STANDS = 0.6
"""Share of the logarithm of the run length that a hypothesis has, against all that is not known, to open a case."""
ENDS = 2.0
"""Log odds of the likeliest hypothesis below which a case ends, once it is old enough to tell."""
RENAME = 16
"""Channels are named again when the time since the onset has grown by this part."""
RECENT = 2.0
"""s; of a longer time since the onset the last half is explained: a drift is largest at last."""
SETTLED, SETTLED_TOGETHER = 0.2, 1.0
"""s that a name must stand, of one channel and of two: several faults look like one at first."""
CLEAR = 500.0
"""Log odds of a single fault from which it is named at once: a second error a seventh as large would show by five
standard deviations, (0.15^2) 2 CLEAR = 22."""
OUTLIER, ALIKE = 5.5, 0.95
"""A value so many standard deviations off is left out of the fused rate, and others nearly as far off."""
PAUSE = 5.0
"""s; after a longer hole in the stream the vehicle may be in another kind of motion: its slow noise is unknown anew."""
LEAST_SCALE, LEAST_TIMING, BENT = 1e-3, 3e-4, 3e-4
"""Scale error, sampling instant of a channel in s, and what is not linear in the rate: less is not believed of any."""
LARGEST = 1e3
"""rad/s; a value beyond it counts as this: no gyro measures as much, and no vehicle survives it."""
SHORT = 1.0 - 1e-9
"""What is shown of the threshold where the sums have reached it, and there is no alarm."""

Sums = Annotated[NDArray[np.float64], "f8", (2, MAX_CHANNELS, SIZES)]
Series = Annotated[NDArray[np.float64], "f8", (KEPT, MAX_CHANNELS)]
Firsts = Annotated[NDArray[np.int64], "i8", (KEPT,)]


@record
class Scale:
    """Evidence of one time scale."""

    filled: Whole  # blocks in the value being filled
    values: Channels  # sum of their A y
    information: Channels  # sum of their A_ii
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
    opened: Whole  # sample at which it was opened
    next: Whole  # sample at which channels are named again
    candidate: Mask  # channels that could be named
    since: Whole  # sample since which they could
    named: Mask  # faulty for certain
    suspects: Mask  # at least one of them is faulty
    several: Flag  # no hypothesis fits: several faults, or something else
    retry: Whole  # no case is opened before this sample
    before: ErrorStates  # the states as they were when it was opened
    inference: Inference
    total: Total


@record
class State:
    """Memory of the method."""

    begun: Flag
    restored: Flag  # the states are those of a former run
    cleared: Flag  # all suspicion is to be forgotten
    stamp: Whole  # of the last sample, ns
    estimator: Estimator
    scales: Annotated[list[Scale], SCALES]
    shares: Whole  # number of sums
    case: Case


# Evidence -------------------------------------------------------------------------------------------------------------


@compiled
def grow(sums: NDArray[np.float64], y: float, cap: float, ceiling: float, first: int) -> float:
    """Take a value of y standard deviations into the sums of all sizes: R <- (1 + R) exp(s y - s^2 / 2)."""
    total = 0.0
    factor, size = math.exp(SMALLEST * min(y, STEP_LIMIT)), SMALLEST
    for k in range(SIZES):
        if k >= first:
            sums[k] = min((1.0 + sums[k]) * min(factor * math.exp(-0.5 * size * size), cap), ceiling)
            total += sums[k]
        factor *= factor
        size *= 2.0
    return total


@compiled
def add_evidence(own: Constants, est: Estimator, scale: Scale, at: int, first_sample: int) -> None:
    """Take the last values of a time scale, in its series, into its sums."""
    n, first = own.sensors.n, FIRST_LONG if at == LONG else 0
    scale.first[scale.newest] = first_sample
    scale.kept = min(scale.kept + 1, KEPT)
    scale.total = 0.0
    for i in range(n):
        if est.judged >> i & 1:
            y, cap, ceiling = scale.series[scale.newest, i], cap_of(est.noise, at, i), CEILING * own.limit
            scale.total += grow(scale.sums[0, i], y, cap, ceiling, first)
            scale.total += grow(scale.sums[1, i], -y, cap, ceiling, first)


@compiled
def take_values(own: Constants, state: State, learns: bool) -> None:
    """Take the statistics of a sample into the noise and the sums."""
    est, scale = state.estimator, state.scales[SAMPLE]
    noise = est.noise
    noise.seen[SAMPLE] += 1.0
    scale.newest = (scale.newest + 1) % KEPT
    for i in range(own.sensors.n):
        scale.series[scale.newest, i] = 0.0
        if est.judged >> i & 1:
            t = est.statistic[i]
            slow = noise.now.level[BLOCK, i] * noise.unknown[i] * longest(noise.now, i)
            scale.series[scale.newest, i] = t / math.sqrt(max(1.0, BURST * noise.quick[i], slow))
            take_sample_step(noise, i, t, est.inflation[i], learns, est.samples % 2)
    add_evidence(own, est, scale, SAMPLE, est.samples)


@compiled
def take_block_values(own: Constants, state: State, learns: bool) -> None:
    """Take the innovations of a block into the noise and the sums of the longer time scales."""
    est, noise, n = state.estimator, state.estimator.noise, own.sensors.n
    mask, information = est.masks[1] & est.judged, est.block_parity.information
    for k in range(1, SCALES):
        scale = state.scales[k]
        for i in range(n):
            if mask >> i & 1:
                scale.values[i] += est.block_values[i]
                scale.information[i] += information[i, i]
        scale.filled += 1
        if scale.filled < PER_BLOCK[k]:
            continue
        noise.seen[k] += 1.0
        scale.newest = (scale.newest + 1) % KEPT
        for i in range(n):
            scale.series[scale.newest, i] = 0.0
            if scale.information[i] > 0.0:
                t = scale.values[i] / math.sqrt(scale.information[i])
                if k == BLOCK:
                    take_block_step(noise, i, t, own.expected[i], learns)
                else:
                    take_long_step(noise, k, i, t, learns)
                scale.series[scale.newest, i] = t / math.sqrt(noise.unknown[i])
            scale.values[i] = scale.information[i] = 0.0
        scale.filled = 0
        add_evidence(own, est, scale, k, est.samples - (PER_BLOCK[k] + 1) * own.length + 1)


@compiled
def mean_of(own: Constants, state: State) -> float:
    """Mean of all sums."""
    total, channels = 0.0, 0
    for k in range(SCALES):
        total += state.scales[k].total
    for i in range(own.sensors.n):
        channels += state.estimator.judged >> i & 1
    return total / max(2 * (SCALES * SIZES - FIRST_LONG) * channels, 1)


@compiled
def largest_of(state: State, i: int) -> float:
    """Largest sum of one channel."""
    largest = 0.0
    for k in range(SCALES):
        sums = state.scales[k].sums
        for s in range(SIZES):
            largest = max(largest, sums[0, i, s], sums[1, i, s])
    return largest


@compiled
def forget_evidence(own: Constants, state: State) -> None:
    """Begin all sums anew, and end the case; the states and the noise stay."""
    state.case.open = False
    state.case.named = state.case.suspects = state.estimator.aside = state.estimator.doubted = 0
    for k in range(SCALES):
        scale = state.scales[k]
        scale.kept = scale.filled = 0
        scale.total = 0.0
        for i in range(own.sensors.n):
            scale.values[i] = scale.information[i] = 0.0
            for s in range(SIZES):
                scale.sums[0, i, s] = scale.sums[1, i, s] = 0.0


# Does it stand against the noise of the same time? --------------------------------------------------------------------


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
def look_back(own: Constants, est: Estimator, scale: Scale, i: int, sign: float) -> tuple[int, float]:
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
    mean, trust = best / math.sqrt(since), est.noise.degrees[i]
    squares, count = 0.0, 0
    for j in range(own.sensors.n):
        if est.judged >> j & 1:
            count += 1
            for k in range(since - 1):
                step = value_at(scale, k, j) - value_at(scale, k + 1, j)
                squares += min(0.5 * step * step, PLAIN)
    # Of so many channels three fewer differ from what a rate explains.
    checks = max(count - 3.0, 1.0)
    pooled = (trust + squares / max(count, 1) * checks) / (trust + checks * (since - 1.0))
    degrees = trust + since - 1.0
    scatter = scatter_of(scale, i, sign, since, mean)
    variance = max((trust + (since - 1.0) * scatter) / degrees, pooled)
    return since, 0.5 * (degrees + 1.0) * math.log(1.0 + mean * mean * since / variance / degrees)


@compiled
def find_case(own: Constants, state: State) -> None:
    """Look for a time scale whose evidence stands against the noise of that same time; open the case there."""
    est, case, best, found = state.estimator, state.case, math.log(own.limit), False
    for at in range(SCALES):
        scale, largest, channel, sign = state.scales[at], 0.0, -1, 1.0
        for i in range(own.sensors.n):
            for side in range(2):
                for s in range(SIZES):
                    if scale.sums[side, i, s] > largest:
                        largest, channel, sign = scale.sums[side, i, s], i, 1.0 - 2.0 * side
        if channel < 0 or largest < own.limit:
            continue
        since, evidence = look_back(own, est, scale, channel, sign)
        evidence = min(evidence, since * math.log(cap_of(est.noise, at, channel)))
        samples = max(PER_BLOCK[at] * own.length, 1)
        if since >= 2 and since * samples >= own.least and evidence >= best:
            best, found = evidence, True
            case.onset = scale.first[(scale.newest - since + 1 + KEPT) % KEPT]
    if found:
        open_case(own, state)


@compiled
def open_case(own: Constants, state: State) -> None:
    """Go back to before the onset, and see whether a hypothesis stands against all that is not known of the sensors."""
    est, case = state.estimator, state.case
    case.onset = max(case.onset, 1)
    case.open, case.opened, case.candidate, case.named = True, est.samples, 0, 0
    copy_states(own.layout, est.states, case.before)
    since = (est.samples - case.onset) * own.period
    go_back(own, est, est.seconds - since - max(SNAPSHOT_TIME, 0.3 * since))
    name(own, state)
    if case.inference.log_odds < STANDS * math.log(own.limit):
        copy_states(own.layout, case.before, est.states)
        case.open = False
        case.retry = est.samples + 1 + (est.samples - case.onset) // 4


# Naming ---------------------------------------------------------------------------------------------------------------


@compiled
def set_mean(own: Constants, state: State, size: int) -> None:
    """Set the mean of the last so many samples to be explained, and its covariance."""
    est, case, n, layout = state.estimator, state.case, own.sensors.n, own.layout
    total, inference, noise = case.total, case.inference, est.noise
    total_before(est, est.samples - size + 1, total, n)
    size = est.samples - total.sample
    inference.mask = 0
    for i in range(n):
        count = est.total.count[i] - total.count[i]
        if est.mask >> i & 1 and count > 0.9 * size:
            inference.mask |= 1 << i
            inference.y[i] = (est.total.values[i] - total.values[i]) / count
    inference.judged = inference.mask & est.judged
    speed = 0.0
    # At rest what passes for a rate is the fault itself, and no motion.
    moves = 1.0 if noise.regime == MOTION else 0.0
    for a in range(3):
        inference.rate[a] = moves * (est.total.rate[a] - total.rate[a]) / size
        speed += inference.rate[a] * inference.rate[a]
    # A turn that ends as it began leaves no trace of a delay in the mean.
    part = min(1.0, 3.0 * own.length / size)
    for i in range(n):
        turn = 0.0
        for a in range(3):
            turn += own.sensors.axes[i, a] * (est.rate[a] - total.instant[a])
        inference.turn[i] = moves * turn / (size * own.period)
    signals = est.block_at.signals
    find_signals(layout, own.sensors.axes, inference.rate, inference.turn, signals)
    correct(layout, est.states, signals, inference.y, inference.y)
    project(layout, est.states, est.block_at)
    for i in range(n):
        for j in range(n):
            inference.covariance[i, j] = est.block_at.covariance[i, j]
        v, over = noise.now.sample[i], longest(noise.now, i)
        if size >= own.length:
            v *= noise.unknown[i] * max(1.0, noise.now.level[BLOCK, i] * over)
        else:
            v = max(v * max(1.0, BURST * noise.quick[i]), noise.now.block[i] * over * size / own.length)
        inference.covariance[i, i] += v / size + est.peak_extra[i] * part + own.bent * own.bent * speed
        place = layout.delays[own.unit[i]]
        if place >= 0:
            swing = moves * est.peak_turn[i] * part
            inference.covariance[i, i] += est.states.p[place, place] * swing * swing


@compiled
def infer(own: Constants, inference: Inference) -> None:
    """Explain the mean."""
    n = own.sensors.n
    weigh_together(inference.parity, n, inference.mask, inference.covariance)
    eliminate_rate(inference.parity, n, own.sensors.axes, UNKNOWN_RATE)
    explain(inference, n, own.sensors.axes, own.members, own.units, own.confidence)


@compiled
def name(own: Constants, state: State) -> None:
    """Name the channels that explain the mean since the onset, or of its last half if that is long ago."""
    est, case, n = state.estimator, state.case, own.sensors.n
    inference = case.inference
    size = est.samples - case.onset + 1
    if size * own.period > RECENT:
        size = size // 2 + 1
    set_mean(own, state, size)
    infer(own, inference)
    # By so much of the error found the model may be wrong.
    for i in range(n):
        misfit = MISFIT * inference.largest
        inference.covariance[i, i] += misfit * misfit
    infer(own, inference)
    case.next = est.samples + max(size // RENAME, 1)
    case.suspects, case.several = inference.union, not inference.fitted
    if inference.common != case.candidate:
        case.candidate, case.since = inference.common, est.samples
    single = inference.common & (inference.common - 1) == 0
    settled = SETTLED if single else SETTLED_TOGETHER
    if single and inference.log_odds >= CLEAR:
        settled = 0.0
    if inference.common and (est.samples - case.since) * own.period >= settled:
        case.named = inference.common
    elif not inference.common & case.named:
        case.named = 0
    leave_aside(own, state)


@compiled
def leave_aside(own: Constants, state: State) -> None:
    """Leave channels under doubt out of the rate, as far as the others give one, and out of what is learned."""
    est, case = state.estimator, state.case
    est.doubted = case.suspects | case.named
    est.aside = 0
    for wanted in (est.doubted, case.named, case.inference.likeliest):
        if est.aside == 0 and own.spans[est.mask & ~wanted]:
            est.aside = wanted
    weigh(own, est)


@compiled
def follow_case(own: Constants, state: State) -> None:
    """Name the channels of an open case again when it has grown; end it when its evidence has gone."""
    est, case = state.estimator, state.case
    if est.samples < case.next:
        return
    name(own, state)
    if case.inference.log_odds < ENDS and (est.samples - case.onset) * own.period > 1.0:
        forget_evidence(own, state)
        weigh(own, est)


# The path of a sample -------------------------------------------------------------------------------------------------


@compiled
def begin(own: Constants, state: State, sample: SampleInput) -> None:
    """Begin with what is known beforehand."""
    est, n = state.estimator, own.sensors.n
    state.begun = True
    if not state.restored:
        begin_states(own.layout, est.states, sample.bias_std)
    begin_noise(est.noise, n, own.expected)
    find_signals(own.layout, own.sensors.axes, est.zero, est.turn, est.at.signals)
    project(own.layout, est.states, est.at)


@compiled
def pass_time(own: Constants, state: State, sample: SampleInput) -> float:
    """Let the time since the last sample pass, s; after a hole all evidence begins anew."""
    est = state.estimator
    if not state.begun:
        begin(own, state, sample)
        state.stamp = sample.stamp
    seconds = 1e-9 * (sample.stamp - state.stamp)
    state.stamp = sample.stamp
    est.seconds += seconds
    if sample.interrupted and est.samples > 0:
        drop_block(est, own.sensors.n)
        forget_evidence(own, state)
        if seconds > PAUSE:
            est.noise.lived[REST] = est.noise.lived[MOTION] = 0.0
            find_unknown(est.noise, own.sensors.n, 0.0)
        est.mask = 0
    return seconds


@compiled
def take_mask(own: Constants, state: State, sample: SampleInput) -> None:
    """Take over which channels are present. Once those named are out of use, a new search begins without them."""
    est, case = state.estimator, state.case
    blamed = case.named if case.named else case.suspects
    if case.open and blamed & ~sample.out == 0:
        forget_evidence(own, state)
        est.mask = 0
    if sample.mask != est.mask:
        est.mask = sample.mask
        weigh(own, est)


@compiled
def take_block(own: Constants, state: State) -> None:
    """Take a block that is complete: noise, states, evidence of the longer time scales."""
    est, case, n = state.estimator, state.case, own.sensors.n
    noise, learns = est.noise, not case.open
    find_unknown(noise, n, est.span)
    take_block_of_samples(noise, n, est.masks[0], own.length, est.all_blocks, own.pace, own.expected, learns)
    predict(own.layout, est.states, est.seconds - est.learned_at)
    est.learned_at = est.seconds
    if est.blocks < 3:
        return
    find_motion(own, est)
    weight = judge_block(own, est)
    take_block_values(own, state, learns)
    find_rest(own, est)
    if est.rest and noise.regime == MOTION and learns:
        change_regime(noise, n, REST, False)
    suspicious = mean_of(own, state) > math.sqrt(own.limit)
    est.held = est.held + est.span if suspicious else 0.0
    if case.open or est.held == 0.0 or est.held > HOLD:
        learn(own, est, weight)
    if learns and not suspicious and est.seconds - est.snapshot_at >= SNAPSHOT_TIME:
        est.snapshot_at = est.seconds
        keep_snapshot(own, est)
    if own.units > 1 and learns and est.seconds - est.taken_off_at > 1.0:
        est.taken_off_at = est.seconds
        if take_delays_off(own, est):
            # What was measured before is of other instants.
            forget_evidence(own, state)
    foresee(own, est)


@compiled
def find_outliers(own: Constants, state: State, verdict: SampleVerdict) -> None:
    """Find what the sample should be used without: what is far beyond the noise, or most likely to be at fault."""
    est, largest, far = state.estimator, 0.0, 0.0
    for i in range(own.sensors.n):
        burst = max(1.0, BURST * est.noise.quick[i])
        largest = max(largest, abs(est.statistic[i]) / math.sqrt(burst))
        far = max(far, plain_statistic(est, i))
    for i in range(own.sensors.n):
        if largest > OUTLIER:
            # Of all statistics with equal weights that of the culprit is the largest (Cauchy and Schwarz).
            verdict.outliers[i] = plain_statistic(est, i) > ALIKE * far
        elif state.case.open:
            verdict.outliers[i] = est.aside >> i & 1


@compiled
def plain_statistic(est: Estimator, i: int) -> float:
    """Return how far channel i is off, ``|A y|_i / sqrt(A_ii)``."""
    return abs(est.statistic[i]) * math.sqrt(est.share[i] * est.inflation[i])


@compiled
def describe(own: Constants, state: State, sample: SampleInput, verdict: SampleVerdict) -> None:
    """Put into the verdict what was found, and into the sample what is known of the errors of the sensors."""
    est, case, n = state.estimator, state.case, own.sensors.n
    for i in range(n):
        here = est.judged & est.mask & (1 << i)
        verdict.scores[i] = math.log(1.0 + largest_of(state, i)) if here else math.nan
        variance = est.noise.now.sample[i] * max(1.0, BURST * est.noise.quick[i])
        verdict.noise[i] = math.sqrt(variance / own.expected[i])
        sample.estimate.corrected[i], sample.estimate.variance[i] = est.corrected[i], variance
        sample.estimate.bias[i] = est.states.x[i]
        sample.estimate.bias_std[i] = math.sqrt(est.states.p[i, i])
        for j in range(n):
            # While it is open which channels are faulty, each may be off by what it is if it is one of them.
            doubt = case.inference.spread[i, j] if case.open and not case.named else 0.0
            sample.estimate.covariance[i, j] = est.at.covariance[i, j] + doubt
    sample.estimate.checked = est.checked
    for u in range(own.units):
        sample.estimate.late[u] = est.late[u]
    suspects = (case.named if case.named else case.suspects) & est.mask
    if case.open and suspects:
        verdict.alarm, verdict.isolated = True, case.named != 0
        for i in range(n):
            if suspects >> i & 1:
                verdict.suspects[i], verdict.error[i] = True, case.inference.error[i]
        verdict.statistic = max(verdict.statistic, verdict.threshold)
    else:
        # Evidence that does not stand against the noise of the same time is none.
        verdict.statistic = min(verdict.statistic, SHORT * verdict.threshold)


@callback(Constants, State, SampleInput, SampleVerdict)
def judge(own: Constants, state: State, sample: SampleInput, verdict: SampleVerdict) -> None:
    """Take one sample into estimator and sums; where their mean reaches the limit, test what it is, and name."""
    est, case = state.estimator, state.case
    verdict.threshold = math.log(1.0 + own.limit)
    seconds = pass_time(own, state, sample)
    if state.cleared:
        state.cleared = False
        forget_evidence(own, state)
        est.mask = 0
    take_mask(own, state, sample)
    sample.estimate.known = False
    if not own.spans[est.mask] or est.judged == 0:
        verdict.statistic = verdict.threshold = math.nan
        return
    if sample.held:
        forget_evidence(own, state)
        drop_block(est, own.sensors.n)
        verdict.statistic = 0.0
        return
    if sample.repeated:
        verdict.statistic = min(math.log(1.0 + mean_of(own, state)), SHORT * verdict.threshold)
        return
    for i in range(own.sensors.n):
        sample.z[i] = min(max(sample.z[i], -LARGEST), LARGEST)
    take_sample(own, est, sample.z)
    watch_for_motion(own, est)
    find_statistics(own, est)
    take_values(own, state, not case.open)
    if add_sample(own, est, sample.z, seconds):
        take_block(own, state)
        # Its covariance is that of now.
        correct_sample(own, est, sample.z)
    mean = mean_of(own, state)
    verdict.statistic = math.log(1.0 + mean)
    find_outliers(own, state, verdict)
    if case.open:
        follow_case(own, state)
    elif mean >= own.limit and est.samples >= case.retry:
        find_case(own, state)
    sample.estimate.known = True
    describe(own, state, sample, verdict)


class Sequential(Detector):
    r"""Shiryaev-Roberts sums of the innovations of an error-state estimator; channels named by the odds since onset.

    The estimator knows bias, scale error, misalignment and delay of the channels, each with its uncertainty, and the
    noise of the moment; its innovations y are white and of variance one while the model holds. For each channel, sign
    and size s, six from 0.2 to 6.4 standard deviations, at samples, blocks of 40 ms, 0.25 s and 2 s:

        R <- (1 + R) exp(s y - s^2 / 2),    and the same for -y.

    While no channel is faulty, R less the number of samples does not drift upward (Shiryaev 1963, Roberts 1966, Pollak
    1987), and so neither does the mean of all R. Where that mean reaches `run_length`, the largest sum has to hold
    against the scatter within the time since its onset, as a Student ratio; and then an explanation of the mean since
    the onset against everything that is not known of the sensors, whose states go back to before the onset for it.

    While the alarm stands, channels, pairs, units as a whole, their gain and their delay explain the mean with certain
    odds, and the smallest set of these that holds the truth with `confidence` is named; `isolated` if all of it have a
    channel in common and the best of it leaves no more than noise. `Verdict.statistic` is the logarithm of one plus the
    mean of all sums.

    Good at: steps, drifts, scale faults and small lasting errors, at rest and in motion; noise that is coloured,
    unequal or changes; several faults; units that are wrong as a whole. Bad at: errors that wander no faster than
    `bias_walk` allows, which pass into the states; changes of the noise, which are measured but no alarm; two parallel
    gyros of three with equal errors, which look like the third's. docs/methods.md has the reasons.

    Parameters
    ----------
    geometry
        Sensitivity axes.
    noise
        Error model of a healthy channel: `scale_std` and `bias_std` are what the estimator begins with.
    run_length
        Mean samples to a false alarm of the whole detector, 2 to 1e15; default 3.6e8 (1e-3 an hour at 100 Hz).
    false_alarms_per_hour
        The other way to give it, with `sample_rate`.
    sample_rate
        Hz; it sets the lengths of the blocks. Default 100.
    confidence
        With which the truth is in the set named, above 0.5 and below 1.
    bias_walk
        Random walk of the bias of each channel, scalar or (n,), rad/s/sqrt(s).
    delay_std
        How late the stamps of one unit may be against another's, standard deviation, s.

    Raises
    ------
    ConfigError
        If an option is out of its range, or the run length is given twice.
    """

    name = "sequential"
    Constants = Constants
    State = State
    judge = judge
    accumulates = True
    takes_any = True

    def __init__(
        self,
        geometry: Geometry,
        noise: NoiseModel,
        *,
        run_length: float | None = None,
        false_alarms_per_hour: float | None = None,
        sample_rate: float | None = None,
        confidence: float = 0.999,
        bias_walk: float | Sequence[float] = 5e-5,
        delay_std: float = 0.001,
    ) -> None:
        if not 0.5 < confidence < 1:
            raise ConfigError(f"confidence is {confidence:g}, expected above 0.5 and below 1")
        self.run_length = FalseAlarmRate(
            per_hour=false_alarms_per_hour, run_length=run_length, sample_rate=sample_rate
        ).mean_run_length()
        self.sample_rate = 100.0 if sample_rate is None else sample_rate
        walk = np.broadcast_to(np.asarray(bias_walk, dtype=np.float64), geometry.n)
        super().__init__(
            geometry,
            noise,
            {
                "run_length": self.run_length,
                "sample_rate": self.sample_rate,
                "confidence": confidence,
                "bias_walk": float(walk.max()),
                "delay_std": delay_std,
            },
        )
        own, n, noise = self.constants[0], geometry.n, self.noise
        unit = np.zeros(n, dtype=np.int64)
        for u, channels in enumerate(geometry.units):
            unit[list(channels)] = u
        own["units"], own["unit"][:n] = len(geometry.units), unit
        own["members"][: len(geometry.units)] = [mask_of(channels) for channels in geometry.units]
        prepare_layout(
            own["layout"],
            unit,
            len(geometry.units),
            {
                "bias_std": noise.bias_std,
                "bias_walk": walk,
                "scale_std": np.maximum(noise.scale_std, LEAST_SCALE),
                "scale_walk": np.array(1e-6),
                "delay_std": np.array(delay_std),
                "delay_walk": np.array(1e-4),
                "bias_rate_std": np.array(5e-6),
                "clock_rate_std": np.array(1e-4),
            },
        )
        own["length"] = max(round(BLOCK_TIME * self.sample_rate), 1)
        own["period"] = 1.0 / self.sample_rate
        own["pace"] = 1.0 / max(0.5 * self.sample_rate / own["length"], 8.0)
        own["expected"][:n] = noise.noise_std**2
        own["timing"][:n], own["bent"] = np.maximum(noise.timing_std, LEAST_TIMING), BENT
        own["rest_std"] = REST_STD
        used = all_sets(n)
        singular = np.linalg.svd(used[:, :, None] * geometry.axes, compute_uv=False)
        enough = used.sum(axis=1) >= MIN_CHANNELS
        own["spans"][: 1 << n] = enough & (singular[:, -1] >= MIN_SINGULAR_RATIO * singular[:, 0])
        own["least"] = math.ceil(LEAST_TIME * self.sample_rate)
        own["limit"], own["confidence"] = self.run_length, confidence

    def clear(self) -> None:
        """Forget all suspicion; what is known of the sensors stays."""
        self.states["cleared"] = True
