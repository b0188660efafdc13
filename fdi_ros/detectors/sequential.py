# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Sequential evidence: Shiryaev-Roberts sums over channels, signs and sizes of a fault, at three time scales.

A sample goes into means at several time scales (`fdi_ros.detectors.scales`), and they into the sums (`add_evidence`).
Once the mean of the sums reaches the run length asked for, it is tested whether the evidence stands against the scatter
of that same time (`find_case`). If it does, a case is open (`fdi_ros.detectors.case`), and its channels are named from
the mean since the onset (`fdi_ros.detectors.naming`) until the evidence has gone.
"""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from fdi_ros.core.bank import SampleInput, SampleVerdict, suspicion_of
from fdi_ros.core.channel_set import mask_of
from fdi_ros.core.compiled import callback, compiled
from fdi_ros.core.record import Real, Whole, record
from fdi_ros.detectors.base import Detector
from fdi_ros.detectors.case import Case, add_sample, name, open_case
from fdi_ros.detectors.explanation import whitened_residuals
from fdi_ros.detectors.scales import (
    KEPT,
    LONGEST_BLOCK,
    PEAK_TIME,
    QUICK_BLOCKS,
    QUICK_TIME,
    SCALES,
    SIZES,
    TESTED,
    TURNING_NOISE,
    Constants,
    Moment,
    Scale,
    cap_of,
    fill,
    find_levels,
    measure,
    statistic_of,
    take_motion,
)
from fdi_ros.errors import ConfigError
from fdi_ros.model.false_alarm_rate import FalseAlarmRate
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel

SMALLEST = 0.2
"""Smallest size of a fault, in standard deviations at its time scale; each next one is twice as large, up to 6.4."""
PLAIN = 10.0
"""A step between neighbours counts as so many standard deviations at most in the noise of all channels."""
SUDDEN = 4.0
"""Times the noise known beforehand that the other channels scatter by where it has plainly risen: in 3 % of white noise
at the second value, and then less and less."""
STEP_LIMIT = 7.0
"""A value counts as this many standard deviations at most (Huber 1965)."""
TRUST, FIRST_TRUST = 28.0, 4.0
"""Degrees of freedom that the noise known beforehand counts for in a test against the noise of the same time."""
TRUST_TIME = 1.0
"""s; in which they are earned."""
LEAST_TIME = 0.02
"""s; that a fault lasts before it is declared."""
CEILING = 1e6
"""Sums stay below so many times the threshold: what has passed is forgotten."""
OUTLIER, ALIKE = 5.5, 0.95
"""A value so many standard deviations off is left out of the fused rate, and others nearly as far off."""
SHORT = 1.0 - 1e-9
"""What is shown of the threshold where the sums have reached it, and there is no alarm."""


@record
class State:
    """Memory of the method."""

    samples: Whole
    now: Moment
    case: Case
    variance: Real  # of the noise since the onset last looked for, in that of noise_std
    series: Annotated[NDArray[np.float64], "f8", (KEPT,)]  # statistics of one channel, the latest first


@compiled
def grow(sums: NDArray[np.float64], y: float, cap: float, ceiling: float) -> float:
    """Take a value of y standard deviations into the sums of all sizes: R <- (1 + R) exp(s y - s^2 / 2)."""
    total = 0.0
    factor, size = math.exp(SMALLEST * min(y, STEP_LIMIT)), SMALLEST
    for k in range(SIZES):
        sums[k] = min((1.0 + sums[k]) * min(factor * math.exp(-0.5 * size * size), cap), ceiling)
        total += sums[k]
        factor *= factor
        size *= 2.0
    return total


@compiled
def add_evidence(own: Constants, scale: Scale) -> None:
    """Take the last block into the sums of its time scale."""
    sensors, total = own.sensors, 0.0
    for i in range(sensors.n):
        if sensors.detectable[i]:
            x, margin, level = scale.x[i], scale.margin[i], scale.level[i]
            cap, ceiling = cap_of(scale, i), CEILING * own.limit
            total += grow(scale.evidence[0, i], (x - margin) / level, cap, ceiling)
            total += grow(scale.evidence[1, i], (-x - margin) / level, cap, ceiling)
    scale.total = total * own.shares


@compiled
def look_back(own: Constants, state: State, scale: Scale, length: int, i: int, sign: float) -> tuple[int, float]:
    """Find since when channel i is off, and the evidence for it against the noise of that same time.

    Returns
    -------
    Blocks since the onset, and the logarithm of the likelihood ratio: Student's, with the degrees of freedom that
    the noise known beforehand counts for and those of the blocks themselves; the variance of the noise is then in
    ``state.variance``.
    """
    root, total, off, best, since = math.sqrt(length), 0.0, 0.0, 0.0, 0
    for k in range(scale.kept):
        x, margin = statistic_of(own, scale.history[(scale.blocks - 1 - k) % KEPT], i, root)
        state.series[k] = min(sign * x, own.limit)
        total += state.series[k]
        off += margin
        t = (total - off) / math.sqrt(k + 1.0)
        if t > best:
            best, since = t, k + 1
    if since == 0:
        return 0, 0.0
    total = off = 0.0
    for k in range(since):
        _, margin = statistic_of(own, scale.history[(scale.blocks - 1 - k) % KEPT], i, root)
        total += state.series[k]
        off += margin
    mean = total / since
    scatter, trust = scatter_of(state, since, mean), min(FIRST_TRUST + own.trust * state.samples, TRUST)
    degrees = trust + since - 1.0
    level = scale.level[i] * scale.level[i]
    pooled, freedom = pooled_scatter(own, scale, root, since, trust, i)
    variance = max((trust * level + (since - 1.0) * scatter) / degrees, level * pooled)
    if freedom > 0.0:
        degrees = freedom
    state.variance = variance
    excess = mean - off / since
    square = excess * excess * since / variance
    evidence = 0.5 * (degrees + 1.0) * math.log(1.0 + square / degrees)
    return since, min(evidence, since * math.log(cap_of(scale, i)))


@compiled
def pooled_scatter(
    own: Constants, scale: Scale, root: float, since: int, trust: float, suspect: int
) -> tuple[float, float]:
    """Variance of the noise of all channels since an onset, in the one that they are judged by; at least 1.

    Noise that rises on all of them shows in all of them, long before it would in one. Where it is plainly more than
    was known beforehand, what was known counts for nothing.

    Returns
    -------
    The variance, and the degrees of freedom that it is known with: 0 if those of what was known beforehand count.
    """
    sensors, squares, own_squares, count = own.sensors, 0.0, 0.0, 0
    for i in range(sensors.n):
        if sensors.detectable[i]:
            count += 1
            last = 0.0
            for k in range(since):
                x, _ = statistic_of(own, scale.history[(scale.blocks - 1 - k) % KEPT], i, root)
                step = (x - last) / scale.level[i]
                if k > 0:
                    square = min(0.5 * step * step, PLAIN * PLAIN)
                    squares += square
                    if i == suspect:
                        own_squares += square
                last = x
    # Of so many channels n - 3 differ from what a rate explains, one of them by what the suspect does.
    total, degrees = squares / max(count, 1) * (sensors.n - 3), (since - 1.0) * (sensors.n - 3)
    others, freedom = max(total - own_squares, 0.0), (since - 1.0) * (sensors.n - 4)
    if freedom > 0.0 and others > SUDDEN * freedom:
        return others / freedom, freedom
    return max((trust + total) / (trust + degrees), 1.0), 0.0


@compiled
def scatter_of(state: State, count: int, mean: float) -> float:
    """Variance of a mean of the series times its length: of single values, or of batches of them if that is more."""
    if count < 2:
        return 0.0
    worst = 0.0
    size = 1
    while count // size >= 4 or size == 1:
        batches = count // size
        squares = 0.0
        for b in range(batches):
            total = 0.0
            for k in range(b * size, (b + 1) * size):
                total += state.series[k] - mean
            squares += total * total
        worst = max(worst, squares / size / max(batches - 1.0, 1.0))
        size *= 2
    return worst


@compiled
def forget_evidence(own: Constants, state: State) -> None:
    """Begin all sums anew; the level of the noise stays."""
    state.case.open = False
    for k in range(SCALES):
        scale = state.now.scales[k]
        scale.count = scale.kept = 0
        scale.total = 0.0
        for i in range(own.sensors.n):
            scale.filling.z[i] = scale.filling.bias[i] = scale.filling.motion[i] = 0.0
            for s in range(SIZES):
                scale.evidence[0, i, s] = scale.evidence[1, i, s] = 0.0
        for a in range(3):
            scale.filling.rate[a] = scale.filling.acceleration[a] = 0.0


@compiled
def find_case(own: Constants, state: State) -> None:
    """Look for a time scale whose evidence stands against the noise of that same time; open the case there."""
    best, at, since_best, excess = math.log(own.limit), -1, 0, 1.0
    for k in range(TESTED):
        scale, length = state.now.scales[k], own.length[k]
        largest, i_best, sign = 0.0, -1, 1.0
        for i in range(own.sensors.n):
            for side in range(2):
                for s in range(SIZES):
                    if scale.evidence[side, i, s] > largest:
                        largest, i_best, sign = scale.evidence[side, i, s], i, 1.0 - 2.0 * side
        if i_best < 0 or largest < own.limit:
            continue
        since, evidence = look_back(own, state, scale, length, i_best, sign)
        if since * length >= own.least and since >= 2 and evidence >= best:
            best, at, since_best = evidence, k, since
            excess = state.variance / (scale.level[i_best] * scale.level[i_best])
    if at >= 0:
        scale = state.now.scales[at]
        for i in range(own.sensors.n):
            state.case.variance[i] = excess * scale.level[i] * scale.level[i]
        open_case(own, state.case, scale, own.length[at], since_best)


@compiled
def follow_case(own: Constants, state: State, verdict: SampleVerdict) -> None:
    """Give the channels that the case names; name them anew when it has grown."""
    case = state.case
    if case.samples >= case.next:
        name(own, case, state.now)
    verdict.alarm, verdict.isolated = True, case.inference.isolated
    for j in range(own.sensors.n):
        if case.suspects >> j & 1:
            verdict.suspects[j], verdict.error[j] = True, case.inference.error[j]


@compiled
def mean_of(state: State) -> float:
    """Mean of all sums."""
    total = 0.0
    for k in range(TESTED):
        total += state.now.scales[k].total
    return total


@compiled
def largest_of(state: State, i: int) -> float:
    """Largest sum of one channel."""
    largest = 0.0
    for k in range(TESTED):
        evidence = state.now.scales[k].evidence
        for s in range(SIZES):
            largest = max(largest, evidence[0, i, s], evidence[1, i, s])
    return largest


@compiled
def take_evidence(own: Constants, state: State, sample: SampleInput) -> None:
    """Take one sample into the blocks, and the blocks that it completes into the noise and the sums."""
    complete = 0
    for k in range(SCALES):
        if fill(own, state.now, sample, state.now.scales[k], own.length[k]):
            measure(own, state.now, state.now.scales[k], own.length[k], own.quick[k])
            complete |= 1 << k
    find_levels(own, state.now)
    for k in range(TESTED):
        if complete >> k & 1:
            add_evidence(own, state.now.scales[k])


@compiled
def find_outliers(own: Constants, state: State, verdict: SampleVerdict) -> None:
    """Find what the sample should be used without: what is far beyond the noise, or most likely to be at fault."""
    scale, sensors, case = state.now.scales[0], own.sensors, state.case
    largest = 0.0
    for i in range(sensors.n):
        if sensors.detectable[i]:
            largest = max(largest, (abs(scale.x[i]) - scale.margin[i]) / scale.level[i])
    if largest > OUTLIER:
        for i in range(sensors.n):
            off = (abs(scale.x[i]) - scale.margin[i]) / scale.level[i]
            verdict.outliers[i] = sensors.detectable[i] and off > ALIKE * largest
    elif case.open:
        verdict.outliers[case.inference.likeliest] = True


@callback(Constants, State, SampleInput, SampleVerdict)
def judge(own: Constants, state: State, sample: SampleInput, verdict: SampleVerdict) -> None:
    """Take one sample into all sums; where their mean reaches the limit, test whether it is noise, and name."""
    verdict.threshold = math.log(1.0 + own.limit)
    take_motion(own, state.now, sample)
    if sample.held:
        forget_evidence(own, state)
        verdict.statistic = 0.0
        return
    if sample.repeated:
        verdict.statistic = math.log(1.0 + mean_of(state))
        return
    state.samples += 1
    take_evidence(own, state, sample)
    mean = mean_of(state)
    verdict.statistic = math.log(1.0 + mean)
    for i in range(own.sensors.n):
        verdict.scores[i] = math.log(1.0 + largest_of(state, i)) if own.sensors.detectable[i] else math.nan
        verdict.noise[i] = math.sqrt(state.now.scales[0].quick[i])
    find_outliers(own, state, verdict)
    if state.case.open:
        add_sample(own, state.case, state.now, sample)
        state.case.open = verdict.statistic >= suspicion_of(verdict.threshold)
    elif mean >= own.limit:
        find_case(own, state)
    if state.case.open:
        follow_case(own, state, verdict)
        verdict.statistic = max(verdict.statistic, verdict.threshold)
    else:
        # Evidence that does not stand against the noise of the same time is none.
        verdict.statistic = min(verdict.statistic, SHORT * verdict.threshold)


class Sequential(Detector):
    r"""Shiryaev-Roberts sums over channel, sign and size of a fault; channels named by the odds since its onset.

    With x_i the normalised residual of channel i (`likelihood_ratio`), s one of six sizes from 0.2 to 6.4 standard
    deviations, d the margin for what is no noise and l the standard deviation of the noise of the moment:

        R <- (1 + R) exp(s y - s^2 / 2),    y = (x_i - d) / l,    and the same for -x_i.

    While no channel is faulty, R less the number of samples does not drift upward (Shiryaev 1963, Roberts 1966, Pollak
    1987), and so neither does the mean of all R. Alarm where that mean reaches `run_length`: by optional stopping the
    mean time to a false alarm is at least that, whatever the correlation of the channels, without tables. Sums run
    over samples and over the means of blocks of about sqrt(0.25 s rate) samples and of 0.25 s. For an alarm, the
    largest sum has to hold against the scatter within the time since its onset too, as a Student ratio.

    y is at most 7 (Huber 1965), and the ratio of one value at most the inverse of how often values were wild and back
    at once: no single value alarms, and it takes two where such spikes are known.

    l^2 is an average of half the squared differences of neighbouring values (von Neumann 1941), which a lasting error
    does not move: at its own time scale lately, and at this and all longer ones over 80 blocks. d is 2.5 standard
    deviations of the bias that is not known and 4 of scale factor and sampling instant in the motion of the moment:
    what lasts and is smaller is never found.

    While the alarm stands, all samples since the onset are averaged. Channels, pairs, units as a whole, their gain and
    their delay explain the average with certain odds, and the smallest set of these that holds the truth with
    `confidence` is named; `isolated` if all of it have a channel in common. `Verdict.statistic` is the logarithm of
    one plus the mean of all sums; it stays an alarm until it has fallen to 0.3 of the threshold.

    Good at: steps, drift and small lasting errors, with noise that is coloured, unequal or changes; several faults;
    units that are wrong as a whole. Bad at: errors below d; changes of the noise, which are measured (`noise` of the
    sample's verdict) but no alarm; two parallel gyros of three with equal errors, which look like the third's.
    docs/methods.md has the reasons.

    Parameters
    ----------
    geometry
        Sensitivity axes.
    noise
        Error model of a sound channel.
    run_length
        Mean samples to a false alarm of the whole detector, 2 to 1e15; default 3.6e8 (1e-3 an hour at 100 Hz).
    false_alarms_per_hour
        The other way to give it, with `sample_rate`.
    sample_rate
        Hz; it sets the lengths of the blocks. Default 100.
    confidence
        With which the truth is in the set named, above 0.5 and below 1.

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

    def __init__(
        self,
        geometry: Geometry,
        noise: NoiseModel,
        *,
        run_length: float | None = None,
        false_alarms_per_hour: float | None = None,
        sample_rate: float | None = None,
        confidence: float = 0.999,
    ) -> None:
        if not 0.5 < confidence < 1:
            raise ConfigError(f"confidence is {confidence:g}, expected above 0.5 and below 1")
        self.run_length = FalseAlarmRate(
            per_hour=false_alarms_per_hour, run_length=run_length, sample_rate=sample_rate
        ).mean_run_length()
        rate = 100.0 if sample_rate is None else sample_rate
        options = {"run_length": self.run_length, "sample_rate": rate, "confidence": confidence}
        super().__init__(geometry, noise, options)
        own, n, std = self.constants[0], geometry.n, self.noise.noise_std
        residual = whitened_residuals(geometry, self.noise)
        share = np.where(geometry.detectable, np.diag(residual), np.inf)
        direction = residual / np.sqrt(share)[:, None] / std
        own["direction"][:n, :n], own["squares"][:n, :n] = direction, direction**2
        units = [mask_of(unit) for unit in geometry.units]
        own["units"][: len(units)] = units
        longest = max(round(LONGEST_BLOCK * rate), 2)
        own["length"] = [1, max(round(math.sqrt(longest)), 1), longest, 4 * longest]
        own["quick"] = np.maximum(QUICK_TIME * rate / own["length"], QUICK_BLOCKS)
        along = (self.geometry.axes @ own["sensors"]["gain"][:n].T) * std
        own["turning_noise"][:n] = TURNING_NOISE * np.sqrt(2 * (along**2).sum(axis=1)) * min(rate, 100.0)
        own["decay"] = math.exp(-1 / (PEAK_TIME * rate))
        own["trust"] = (TRUST - FIRST_TRUST) / (TRUST_TIME * rate)
        own["least"] = math.ceil(LEAST_TIME * rate)
        own["limit"], own["confidence"] = self.run_length, confidence
        own["shares"] = 1 / max(2 * SIZES * TESTED * int(geometry.detectable.sum()), 1)
