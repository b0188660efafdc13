# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What sequential evidence is taken from: means at several time scales, and what they are without a fault.

A sample is taken in three steps: how far each channel may be off for other reasons than noise (`take_motion`); means
over blocks of each time scale (`fill`); and the noise of the moment (`measure`, `find_levels`).
"""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from fdi_ros.core.bank import SampleInput, Sensors
from fdi_ros.core.compiled import compiled
from fdi_ros.core.record import MAX_CHANNELS, Channels, Real, Square, Vector, Whole, record

TESTED, SCALES = 3, 4
"""Time scales at which evidence is summed; and at which noise is measured, one longer."""
SIZES = 6
WILD, TAME = 5.0, 3.0
"""A value beyond so many standard deviations followed by one below so many is a wild one, and no fault."""
WILD_EVENTS, WILD_SAMPLES = 0.02, 4000.0
"""What is known of their frequency before any was seen: so many in so many."""
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
class Moment:
    """What is remembered of the samples, and how things stand at the last one."""

    scales: Annotated[list[Scale], SCALES]
    turning: Channels  # lately largest acceleration along each channel, rad/s^2
    moving: Real  # lately largest rate, rad/s
    rate: Vector  # rad/s
    bias: Channels  # largest error of the bias that is no fault, rad/s
    motion: Channels  # largest error of scale factor and sampling instant that is no fault, rad/s
    timing: Channels  # standard deviation of the sampling instant, s
    change: Channels  # of the errors by motion, from one block to the next, rad/s
    longer: Channels  # variance of the noise at the longer time scales


@compiled
def take_motion(own: Constants, now: Moment, sample: SampleInput) -> None:
    """Work out how far each channel may be off for other reasons than noise."""
    sensors = own.sensors
    n, square = sensors.n, 0.0
    for a in range(3):
        total = 0.0
        for i in range(n):
            total += sensors.gain[i, a] * sample.z[i]
        now.rate[a] = total
        square += total * total
    # scale_std is the misalignment as well: a rate across the axis shows by it.
    now.moving = max(math.sqrt(square), now.moving * own.decay)
    for i in range(n):
        h, turning = sensors.axes[i], sample.acceleration
        against = abs(h[0] * turning[0] + h[1] * turning[1] + h[2] * turning[2])
        # A difference of rates is noise as well: what noise makes of it is no motion.
        now.turning[i] = max(against - own.turning_noise[i], 0.0, now.turning[i] * own.decay)
        scale = sensors.scale_std[i] * now.moving
        delay = sample.delay_std[i]
        now.timing[i] = math.sqrt(sensors.timing_std[i] * sensors.timing_std[i] + delay * delay)
        timing = now.timing[i] * now.turning[i]
        now.motion[i] = MOTION_COVERAGE * math.sqrt(scale * scale + timing * timing)
        now.bias[i] = BIAS_COVERAGE * sample.bias_std[i]


@compiled
def average_motion(own: Constants, now: Moment, block: Block, before: Block, length: int) -> None:
    """Work out how far the means of a block may be off by motion: what swings to and fro takes itself away.

    The acceleration, a difference, lags: that of the block before counts as well.
    """
    sensors, later, earlier = own.sensors, block.acceleration, before.acceleration
    x, y, z = block.rate[0], block.rate[1], block.rate[2]
    speed = math.sqrt(x * x + y * y + z * z)
    for i in range(sensors.n):
        h = sensors.axes[i]
        turning = abs(h[0] * later[0] + h[1] * later[1] + h[2] * later[2])
        lately = abs(h[0] * earlier[0] + h[1] * earlier[1] + h[2] * earlier[2])
        timing = now.timing[i] * max(max(turning, lately) - own.turning_noise[i] / length, 0.0)
        scale = sensors.scale_std[i] * speed
        block.motion[i] = MOTION_COVERAGE * math.sqrt(scale * scale + timing * timing)


@compiled
def fill(own: Constants, now: Moment, sample: SampleInput, scale: Scale, length: int) -> bool:
    """Add a sample to the block being filled; return whether it is complete, and then in the history."""
    n, total = own.sensors.n, scale.filling
    scale.count += 1
    for i in range(n):
        total.z[i] += sample.z[i]
        total.bias[i] += now.bias[i]
        total.motion[i] += now.motion[i]
    for a in range(3):
        total.rate[a] += now.rate[a]
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
        average_motion(own, now, block, scale.history[(scale.blocks + KEPT - 1) % KEPT], length)
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
def find_change(own: Constants, now: Moment, before: Block, after: Block) -> None:
    """Work out how much the errors that come with motion may have changed from one block to the next."""
    sensors, square = own.sensors, 0.0
    for a in range(3):
        square += (after.rate[a] - before.rate[a]) * (after.rate[a] - before.rate[a])
    for i in range(sensors.n):
        h, turn = sensors.axes[i], 0.0
        for a in range(3):
            turn += h[a] * (after.acceleration[a] - before.acceleration[a])
        scale, timing = sensors.scale_std[i], now.timing[i] * turn
        now.change[i] = MOTION_COVERAGE * math.sqrt(scale * scale * square + timing * timing)


@compiled
def measure(own: Constants, now: Moment, scale: Scale, length: int, quick: float) -> None:
    """Take a complete block into the level of the noise at its time scale, by the difference to the one before.

    Differences of neighbours do not see a lasting error (von Neumann 1941).
    """
    block, root = scale.history[(scale.blocks - 1) % KEPT], math.sqrt(length)
    fresh = scale.kept < 2
    if not fresh:
        scale.differences += 1
        find_change(own, now, scale.history[(scale.blocks - 2) % KEPT], block)
    slow = 1.0 / min(scale.differences + 2.0, MEMORY)
    fast = 1.0 / min(scale.differences + 2.0, quick)
    for i in range(own.sensors.n):
        x, margin = statistic_of(own, block, i, root)
        if not fresh:
            take_wild(scale, i, x)
            motion = 0.0
            for j in range(own.sensors.n):
                motion += own.squares[i, j] * now.change[j] * now.change[j]
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
def find_levels(own: Constants, now: Moment) -> None:
    """Find the level of the noise at each time scale: what it was there lately, and at all longer ones for long.

    A sum over many blocks scatters by the noise at the longer time scales, not by that of one block. An average of
    squares over `MEMORY` blocks is known to a fifth: what is above the noise expected counts half as much again, and
    what is below it counts only where it is so clearly. Before anything was measured at the longest time scale,
    nothing is known of it.
    """
    n = own.sensors.n
    seconds = now.scales[SCALES - 1].differences
    unknown = 1.0 + UNKNOWN / (1.0 + 0.25 * seconds * seconds)
    for i in range(n):
        now.longer[i] = 0.0
    for k in range(SCALES - 1, -1, -1):
        scale, pooled = now.scales[k], 0.0
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
            now.longer[i] = max(now.longer[i], level)
            if k < TESTED:
                scale.level[i] = math.sqrt(max(now.longer[i] * unknown, QUICK_SHARE * scale.quick[i]))
