"""Sequential evidence: Shiryaev-Roberts sums over channels, signs and sizes of a fault, at three time scales.

A sample goes through five steps: how far each channel may be off for other reasons than noise (`take_motion`); means
over blocks (`fill`); the noise of the moment (`measure`, `find_levels`); the sums (`add_evidence`); and once their mean
reaches the run length asked for, whether the evidence stands against the scatter of that same time (`find_case`). If it
does, a case is open, and its channels are named from the mean since the onset (`fdi_ros.detectors.naming`) until the
evidence has gone.
"""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from fdi_ros.core.bank import SampleInput, SampleVerdict, Sensors, suspicion_of
from fdi_ros.core.compiled import callback, compiled
from fdi_ros.core.record import MAX_CHANNELS, Channels, Flag, Mask, Real, Square, Vector, Whole, mask_of, record
from fdi_ros.detectors.base import Detector
from fdi_ros.detectors.explanation import whitened_residuals
from fdi_ros.detectors.naming import Question, allow_misfit, explain_mean, fits
from fdi_ros.detectors.run_length import run_length_of
from fdi_ros.errors import ConfigError
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel

TESTED, SCALES = 3, 4
"""Time scales at which evidence is summed; and at which noise is measured, one longer."""
SIZES = 6
SMALLEST = 0.2
"""Smallest size of a fault, in standard deviations at its time scale; each next one is twice as large, up to 6.4."""
WILD, TAME = 5.0, 3.0
"""A value beyond so many standard deviations followed by one below so many is a wild one, and no fault."""
PLAIN = 10.0
"""A step between neighbours counts as so many standard deviations at most in the noise of all channels."""
WILD_EVENTS, WILD_SAMPLES = 0.02, 4000.0
"""What is known of their frequency before any was seen: so many in so many."""
STEP_LIMIT = 7.0
"""A value counts as this many standard deviations at most (Huber 1965)."""
BIAS_COVERAGE, MOTION_COVERAGE = 2.5, 4.0
"""Standard deviations of the followed bias, and of scale factor and sampling instant, that are no fault, however long
they last. The bias changes sign with time; of a vehicle with a large scale error every flight is one with it."""
KEPT = 64
"""Blocks of each time scale that are remembered."""
MEMORY = 80
"""Blocks that the level of the noise is averaged over."""
QUICK_TIME = 0.5
"""Over which the noise of the moment is averaged, s; at least `QUICK_BLOCKS` blocks."""
QUICK_BLOCKS = 8
QUICK_SHARE = 0.75
"""The short average counts where it exceeds the expected level by more than it scatters in white noise."""
NORMAL, CLEARLY = 1.25, 1.5
"""Below the first an average of squares is what chance makes of the noise expected; it is less noise only if so many
times the average is."""
QUIETEST = 0.2
"""Of the variance expected: after a long rest the noise is back at once."""
LEAST_SEEN = 8.0
"""Differences at the longest time scale that motion did not hide, before it counts."""
UNKNOWN = 16.0
"""By how much the variance over long may exceed that of a sample, before anything was measured."""
RISE = 9.0
"""One difference raises an average of squares by so many times its share at most: a step is not noise."""
LONGEST_BLOCK = 0.25
"""s; of the tested time scales."""
PEAK_TIME = 0.05
"""s; motion is as fast as it was lately."""
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
RENAME = 16
"""Channels are named again when the case has grown by this part."""
TURNING_NOISE = 4.0
"""Standard deviations of an acceleration that noise makes of nothing."""

Sums = Annotated[NDArray[np.float64], "f8", (2, MAX_CHANNELS, SIZES)]


@record
class Constants:
    """What `judge` needs."""

    sensors: Sensors
    direction: Square  # row i: from values to the statistic of a fault of channel i, variance one in noise_std, s/rad
    squares: Square  # of its elements
    units: Annotated[NDArray[np.int64], "i8", (4,)]  # bits of the channels of each unit
    length: Annotated[NDArray[np.int64], "i8", (SCALES,)]  # samples of a block at each time scale
    quick: Annotated[NDArray[np.float64], "f8", (SCALES,)]  # blocks of the short average of the noise
    turning_noise: Channels  # what noise makes of the acceleration along each channel at most, rad/s^2
    decay: Real  # of a peak of motion, per sample
    trust: Real  # degrees of freedom earned per sample
    least: Whole  # samples that a fault lasts
    limit: Real  # of the mean of all sums: the mean run length, samples
    shares: Real  # 1 / number of sums
    confidence: Real


@record
class Block:
    """Means over a block of samples."""

    z: Channels  # rad/s
    bias: Channels  # largest error of the bias that is no fault, rad/s
    motion: Channels  # largest error of scale factor and sampling instant that is no fault, rad/s
    rate: Vector  # rad/s
    acceleration: Vector  # rad/s^2


@record
class Scale:
    """One time scale."""

    count: Whole  # samples in the block being filled
    filling: Block  # their totals
    blocks: Whole  # completed so far
    kept: Whole  # of the last ones, that may be looked back at
    history: Annotated[list[Block], KEPT]  # by their number, modulo `KEPT`
    x: Channels  # statistics of the last block
    margin: Channels  # and by how much they may be off in no white noise
    differences: Whole  # of successive blocks, so far
    seen: Channels  # of them, those in which motion would not have hidden noise
    wild: Channels  # values that were wild, and back at once
    quick: Channels  # mean square of those, halved; of the moment
    slow: Channels  # over long
    level: Channels  # standard deviation that the statistics are judged by
    evidence: Sums
    total: Real  # mean of all sums of this time scale


@record
class Case:
    """An alarm that stands, and the totals since its onset that channels are named by."""

    open: Flag
    samples: Whole
    next: Whole  # samples at which channels are named again
    total: Block
    marked: Whole  # samples at the last power of two
    mark: Block  # totals then
    earlier: Whole  # samples at the power of two before that
    early: Block  # totals then: a quarter to a half of all
    part: Block
    variance: Channels  # of the noise over long, in that of noise_std
    suspects: Mask  # named last
    asked: Question


@record
class State:
    """Memory of the method."""

    samples: Whole
    scales: Annotated[list[Scale], SCALES]
    turning: Channels  # lately largest acceleration along each channel, rad/s^2
    moving: Real  # lately largest rate, rad/s
    rate: Vector  # rad/s
    bias: Channels  # rad/s
    motion: Channels  # rad/s
    timing: Channels  # standard deviation of the sampling instant, s
    change: Channels  # of the errors by motion, from one block to the next, rad/s
    longer: Channels  # variance of the noise at the longer time scales
    variance: Real  # of the noise since the onset last looked for, in that of noise_std
    series: Annotated[NDArray[np.float64], "f8", (KEPT,)]  # statistics of one channel, the latest first
    case: Case


@compiled
def take_motion(own: Constants, state: State, sample: SampleInput) -> None:
    """Work out how far each channel may be off for other reasons than noise."""
    sensors = own.sensors
    n, square = sensors.n, 0.0
    for a in range(3):
        total = 0.0
        for i in range(n):
            total += sensors.gain[i, a] * sample.z[i]
        state.rate[a] = total
        square += total * total
    # scale_std is the misalignment as well: a rate across the axis shows by it.
    state.moving = max(math.sqrt(square), state.moving * own.decay)
    for i in range(n):
        h, turning = sensors.axes[i], sample.acceleration
        against = abs(h[0] * turning[0] + h[1] * turning[1] + h[2] * turning[2])
        # A difference of rates is noise as well: what noise makes of it is no motion.
        state.turning[i] = max(against - own.turning_noise[i], 0.0, state.turning[i] * own.decay)
        scale = sensors.scale_std[i] * state.moving
        delay = sample.delay_std[i]
        state.timing[i] = math.sqrt(sensors.timing_std[i] * sensors.timing_std[i] + delay * delay)
        timing = state.timing[i] * state.turning[i]
        state.motion[i] = MOTION_COVERAGE * math.sqrt(scale * scale + timing * timing)
        state.bias[i] = BIAS_COVERAGE * sample.bias_std[i]


@compiled
def average_motion(own: Constants, state: State, block: Block, before: Block, length: int) -> None:
    """Work out how far the means of a block may be off by motion: what swings to and fro takes itself away.

    The acceleration, a difference, lags: that of the block before counts as well.
    """
    sensors, later, earlier = own.sensors, block.acceleration, before.acceleration
    x, y, z = block.rate[0], block.rate[1], block.rate[2]
    speed = math.sqrt(x * x + y * y + z * z)
    for i in range(sensors.n):
        h = sensors.axes[i]
        now = abs(h[0] * later[0] + h[1] * later[1] + h[2] * later[2])
        lately = abs(h[0] * earlier[0] + h[1] * earlier[1] + h[2] * earlier[2])
        timing = state.timing[i] * max(max(now, lately) - own.turning_noise[i] / length, 0.0)
        scale = sensors.scale_std[i] * speed
        block.motion[i] = MOTION_COVERAGE * math.sqrt(scale * scale + timing * timing)


@compiled
def fill(own: Constants, state: State, sample: SampleInput, scale: Scale, length: int) -> bool:
    """Add a sample to the block being filled; return whether it is complete, and then in the history."""
    n, total = own.sensors.n, scale.filling
    scale.count += 1
    for i in range(n):
        total.z[i] += sample.z[i]
        total.bias[i] += state.bias[i]
        total.motion[i] += state.motion[i]
    for a in range(3):
        total.rate[a] += state.rate[a]
        total.acceleration[a] += sample.acceleration[a]
    if scale.count < length:
        return False
    block = scale.history[scale.blocks % KEPT]
    for i in range(n):
        block.z[i], block.bias[i] = total.z[i] / length, total.bias[i] / length
        block.motion[i] = total.motion[i]
        total.z[i] = total.bias[i] = total.motion[i] = 0.0
    for a in range(3):
        block.rate[a], block.acceleration[a] = total.rate[a] / length, total.acceleration[a] / length
        total.rate[a] = total.acceleration[a] = 0.0
    if length > 1:
        average_motion(own, state, block, scale.history[(scale.blocks + KEPT - 1) % KEPT], length)
    scale.count = 0
    scale.blocks += 1
    scale.kept = min(scale.kept + 1, KEPT)
    return True


@compiled
def statistic_of(own: Constants, block: Block, i: int, root: float) -> tuple[float, float]:
    """Statistic of a fault of channel i in a block, and how far it may be off without one."""
    total = square = 0.0
    for j in range(own.sensors.n):
        total += own.direction[i, j] * block.z[j]
        square += own.squares[i, j] * (block.bias[j] * block.bias[j] + block.motion[j] * block.motion[j])
    return total * root, math.sqrt(square) * root


@compiled
def take_wild(scale: Scale, i: int, x: float) -> None:
    """Count a wild value that has come and gone: a lasting error does not."""
    level = scale.level[i]
    if abs(scale.x[i]) > WILD * level and abs(x) < TAME * level:
        scale.wild[i] += 1.0


@compiled
def cap_of(scale: Scale, i: int) -> float:
    """Likelihood ratio of one value at most: the inverse of how often a value is wild without a fault."""
    return (scale.differences + WILD_SAMPLES) / (scale.wild[i] + WILD_EVENTS)


@compiled
def find_change(own: Constants, state: State, before: Block, after: Block) -> None:
    """Work out how much the errors that come with motion may have changed from one block to the next."""
    sensors, square = own.sensors, 0.0
    for a in range(3):
        square += (after.rate[a] - before.rate[a]) * (after.rate[a] - before.rate[a])
    for i in range(sensors.n):
        h, turn = sensors.axes[i], 0.0
        for a in range(3):
            turn += h[a] * (after.acceleration[a] - before.acceleration[a])
        scale, timing = sensors.scale_std[i], state.timing[i] * turn
        state.change[i] = MOTION_COVERAGE * math.sqrt(scale * scale * square + timing * timing)


@compiled
def measure(own: Constants, state: State, scale: Scale, length: int, quick: float) -> None:
    """Take a complete block into the level of the noise at its time scale, by the difference to the one before.

    Differences of neighbours do not see a lasting error (von Neumann 1941).
    """
    block, root = scale.history[(scale.blocks - 1) % KEPT], math.sqrt(length)
    fresh = scale.kept < 2
    if not fresh:
        scale.differences += 1
        find_change(own, state, scale.history[(scale.blocks - 2) % KEPT], block)
    slow = 1.0 / min(scale.differences + 2.0, MEMORY)
    fast = 1.0 / min(scale.differences + 2.0, quick)
    for i in range(own.sensors.n):
        x, margin = statistic_of(own, block, i, root)
        if not fresh:
            take_wild(scale, i, x)
            motion = 0.0
            for j in range(own.sensors.n):
                motion += own.squares[i, j] * state.change[j] * state.change[j]
            motion = math.sqrt(motion) * root
            # What a change of motion explains is no noise; and where it may hide noise, that is not known to be less.
            excess = max(abs(x - scale.x[i]) - motion, 0.0)
            square = 0.5 * excess * excess
            if scale.differences == 1:
                scale.quick[i] = scale.slow[i] = 1.0
            if square > scale.quick[i] or motion * motion < scale.quick[i]:
                scale.quick[i] += fast * (min(square, RISE * max(scale.quick[i], 1.0)) - scale.quick[i])
            if square > scale.slow[i] or motion * motion < scale.slow[i]:
                scale.seen[i] += 1.0
                scale.slow[i] += slow * (min(square, RISE * max(scale.slow[i], 1.0)) - scale.slow[i])
        scale.x[i], scale.margin[i] = x, margin


@compiled
def find_levels(own: Constants, state: State) -> None:
    """Find the level of the noise at each time scale: what it was there lately, and at all longer ones for long.

    A sum over many blocks scatters by the noise at the longer time scales, not by that of one block. An average of
    squares over `MEMORY` blocks is known to a fifth: what is above the noise expected counts half as much again, and
    what is below it counts only where it is so clearly. Before anything was measured at the longest time scale,
    nothing is known of it.
    """
    n = own.sensors.n
    seconds = state.scales[SCALES - 1].differences
    unknown = 1.0 + UNKNOWN / (1.0 + 0.25 * seconds * seconds)
    for i in range(n):
        state.longer[i] = 0.0
    for k in range(SCALES - 1, -1, -1):
        scale, pooled = state.scales[k], 0.0
        for i in range(n):
            pooled += scale.slow[i] / n
        for i in range(n):
            if k == SCALES - 1 and scale.seen[i] < LEAST_SEEN:
                continue
            # Before there was a difference, it is the noise expected.
            measured = max(scale.slow[i], pooled) if scale.differences > 0 else 1.0
            level = (
                min(max(CLEARLY * measured, QUIETEST), 1.0)
                if measured < NORMAL
                else measured + 0.5 * (measured - NORMAL)
            )
            state.longer[i] = max(state.longer[i], level)
            if k < TESTED:
                scale.level[i] = math.sqrt(max(state.longer[i] * unknown, QUICK_SHARE * scale.quick[i]))


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
    variance = max(
        (trust * level + (since - 1.0) * scatter) / degrees, level * pooled_scatter(own, scale, root, since, trust)
    )
    state.variance = variance
    excess = mean - off / since
    square = excess * excess * since / variance
    evidence = 0.5 * (degrees + 1.0) * math.log(1.0 + square / degrees)
    return since, min(evidence, since * math.log(cap_of(scale, i)))


@compiled
def pooled_scatter(own: Constants, scale: Scale, root: float, since: int, trust: float) -> float:
    """Variance of the noise of all channels since an onset, in the one that they are judged by; at least 1.

    Noise that rises on all of them shows in all of them, long before it would in one.
    """
    sensors, squares, count = own.sensors, 0.0, 0
    for i in range(sensors.n):
        if sensors.detectable[i]:
            count += 1
            last = 0.0
            for k in range(since):
                x, _ = statistic_of(own, scale.history[(scale.blocks - 1 - k) % KEPT], i, root)
                step = (x - last) / scale.level[i]
                if k > 0:
                    squares += min(0.5 * step * step, PLAIN * PLAIN)
                last = x
    degrees = (since - 1.0) * (sensors.n - 3)
    return max((trust + squares / max(count, 1) * (sensors.n - 3)) / (trust + degrees), 1.0)


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
def add_block(own: Constants, case: Case, block: Block, samples: int, share: float) -> None:
    """Add a block to the totals: its values, so many times."""
    total = case.total
    for i in range(own.sensors.n):
        total.z[i] += share * block.z[i]
        total.bias[i] += share * block.bias[i]
        total.motion[i] += share * block.motion[i]
    for a in range(3):
        total.rate[a] += share * block.rate[a]
        total.acceleration[a] += share * block.acceleration[a]
    case.samples += samples


@compiled
def add_sample(own: Constants, state: State, sample: SampleInput) -> None:
    """Add a sample to the totals."""
    case = state.case
    total = case.total
    for i in range(own.sensors.n):
        total.z[i] += sample.z[i]
        total.bias[i] += state.bias[i]
        total.motion[i] += state.motion[i]
    for a in range(3):
        total.rate[a] += state.rate[a]
        total.acceleration[a] += sample.acceleration[a]
    case.samples += 1
    mark(own, case)


@compiled
def open_case(own: Constants, state: State, scale: Scale, length: int, since: int) -> None:
    """Begin the totals with the blocks since the onset."""
    case = state.case
    total = case.total
    case.open, case.samples, case.marked, case.earlier = True, 0, 0, 0
    for i in range(own.sensors.n):
        total.z[i] = total.bias[i] = total.motion[i] = 0.0
    for a in range(3):
        total.rate[a] = total.acceleration[a] = 0.0
    for k in range(since):
        add_block(own, case, scale.history[(scale.blocks - since + k) % KEPT], length, length)
        mark(own, case)
    if scale.count:
        add_block(own, case, scale.filling, scale.count, 1.0)
    case.next, case.suspects = case.samples, 0


@compiled
def copy_block(n: int, source: Block, target: Block) -> None:
    """Copy the totals of n channels."""
    for i in range(n):
        target.z[i], target.bias[i] = source.z[i], source.bias[i]
    for a in range(3):
        target.rate[a], target.acceleration[a] = source.rate[a], source.acceleration[a]


@compiled
def mark(own: Constants, case: Case) -> None:
    """Keep the totals at the last powers of two of the samples."""
    n = own.sensors.n
    if case.marked == 0 or case.samples >= 2 * case.marked:
        case.earlier = case.marked
        copy_block(n, case.mark, case.early)
        case.marked = case.samples
        copy_block(n, case.total, case.mark)


@compiled
def ask(own: Constants, state: State, total: Block, count: int) -> None:
    """Set the question for totals of so many samples."""
    sensors, asked, speed = own.sensors, state.case.asked, 0.0
    asked.turning = 0.0
    for a in range(3):
        asked.rate[a], asked.acceleration[a] = total.rate[a] / count, total.acceleration[a] / count
        speed += asked.rate[a] * asked.rate[a]
    for j in range(sensors.n):
        noise = sensors.noise_std[j] * sensors.noise_std[j] * state.case.variance[j]
        h, turning = sensors.axes[j], asked.acceleration
        timing = state.timing[j] * (h[0] * turning[0] + h[1] * turning[1] + h[2] * turning[2])
        bias, scale = total.bias[j] / count / BIAS_COVERAGE, sensors.scale_std[j]
        asked.turning = max(asked.turning, state.turning[j])
        asked.y[j] = total.z[j] / count
        asked.variance[j] = noise / count + bias * bias + scale * scale * speed + timing * timing


@compiled
def fits_parts(own: Constants, state: State, channels: int) -> bool:
    """Whether errors of these channels explain the earlier time and the later time each by itself.

    While one error after the other begins, the mean of the whole time passes through many a direction.
    """
    sensors, case = own.sensors, state.case
    part, n = case.part, own.sensors.n
    if case.earlier < 1:
        return True
    for late in range(2):
        sign = 1.0 if late else 0.0
        for i in range(n):
            part.z[i] = sign * case.total.z[i] + (1.0 - 2.0 * late) * case.early.z[i]
            part.bias[i] = sign * case.total.bias[i] + (1.0 - 2.0 * late) * case.early.bias[i]
        for a in range(3):
            part.rate[a] = sign * case.total.rate[a] + (1.0 - 2.0 * late) * case.early.rate[a]
            part.acceleration[a] = sign * case.total.acceleration[a] + (1.0 - 2.0 * late) * case.early.acceleration[a]
        ask(own, state, part, case.samples - case.earlier if late else case.earlier)
        allow_misfit(sensors, case.asked)
        if not fits(sensors, case.asked, channels):
            return False
    return True


@compiled
def name(own: Constants, state: State) -> None:
    """Name the channels that explain the mean since the onset."""
    case = state.case
    asked, count = case.asked, case.samples
    ask(own, state, case.total, count)
    explain_mean(own.sensors, asked, own.units, own.confidence)
    if not (fits_parts(own, state, asked.named) if asked.isolated else fits(own.sensors, asked, asked.best)):
        # More is wrong than any hypothesis says: it may be anything.
        asked.isolated = False
        for i in range(own.sensors.n):
            if own.sensors.detectable[i]:
                asked.named |= 1 << i
    case.suspects = asked.named
    case.next = count + 1 + count // RENAME


@compiled
def forget_evidence(own: Constants, state: State) -> None:
    """Begin all sums anew; the level of the noise stays."""
    state.case.open = False
    for k in range(SCALES):
        scale = state.scales[k]
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
        scale, length = state.scales[k], own.length[k]
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
        scale = state.scales[at]
        for i in range(own.sensors.n):
            state.case.variance[i] = excess * scale.level[i] * scale.level[i]
        open_case(own, state, scale, own.length[at], since_best)


@compiled
def follow_case(own: Constants, state: State, verdict: SampleVerdict) -> None:
    """Say which channels the case names; look again when it has grown."""
    case = state.case
    if case.samples >= case.next:
        name(own, state)
    verdict.alarm, verdict.isolated = True, case.asked.isolated
    for j in range(own.sensors.n):
        if case.suspects >> j & 1:
            verdict.suspects[j], verdict.error[j] = True, case.asked.error[j]


@compiled
def mean_of(state: State) -> float:
    """Mean of all sums."""
    total = 0.0
    for k in range(TESTED):
        total += state.scales[k].total
    return total


@compiled
def largest_of(state: State, i: int) -> float:
    """Largest sum of one channel."""
    largest = 0.0
    for k in range(TESTED):
        evidence = state.scales[k].evidence
        for s in range(SIZES):
            largest = max(largest, evidence[0, i, s], evidence[1, i, s])
    return largest


@compiled
def take_evidence(own: Constants, state: State, sample: SampleInput) -> None:
    """Take one sample into the blocks, and the blocks that it completes into the noise and the sums."""
    complete = 0
    for k in range(SCALES):
        if fill(own, state, sample, state.scales[k], own.length[k]):
            measure(own, state, state.scales[k], own.length[k], own.quick[k])
            complete |= 1 << k
    find_levels(own, state)
    for k in range(TESTED):
        if complete >> k & 1:
            add_evidence(own, state.scales[k])


@compiled
def find_outliers(own: Constants, state: State, verdict: SampleVerdict) -> None:
    """Find what the sample should be used without: what is far beyond the noise, or most likely to be at fault."""
    scale, sensors, case = state.scales[0], own.sensors, state.case
    largest = 0.0
    for i in range(sensors.n):
        if sensors.detectable[i]:
            largest = max(largest, (abs(scale.x[i]) - scale.margin[i]) / scale.level[i])
    if largest > OUTLIER:
        for i in range(sensors.n):
            off = (abs(scale.x[i]) - scale.margin[i]) / scale.level[i]
            verdict.outliers[i] = sensors.detectable[i] and off > ALIKE * largest
    elif case.open:
        verdict.outliers[case.asked.likeliest] = True


@callback(Constants, State, SampleInput, SampleVerdict)
def judge(own: Constants, state: State, sample: SampleInput, verdict: SampleVerdict) -> None:
    """Take one sample into all sums; where their mean reaches the limit, look whether it is noise, and name."""
    verdict.threshold = math.log(1.0 + own.limit)
    take_motion(own, state, sample)
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
        verdict.noise[i] = math.sqrt(state.scales[0].quick[i])
    find_outliers(own, state, verdict)
    if state.case.open:
        add_sample(own, state, sample)
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
        self.run_length = run_length_of(run_length, false_alarms_per_hour, sample_rate)
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
