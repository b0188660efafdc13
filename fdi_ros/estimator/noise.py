# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The noise of the moment, of every channel by itself, from the innovations of samples and of longer times.

The statistic of channel i is ``t_i = (A y)_i / sqrt(A_ii)``, of variance one if the
noise is as supposed. Half the squared difference of successive ones (von Neumann 1941),
which a lasting error does not move, steers the variance of the channel, ``v_i *= 1 + g
(r_i - 1)``. The fixed point is restricted maximum likelihood, so a noisy channel does
not leak into the others. Samples and blocks have a variance each, longer times a level
above the block variance. Rest and motion are remembered separately, and excluded
channels keep their noise.
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
    Small,
    Square,
    Vector,
    Whole,
    compiled,
    record,
)
from fdi_ros.core.records import Parity
from fdi_ros.model.samples import Array

SAMPLE, BLOCK, QUARTER, LONG, SCALES = range(5)
"""Time scales (samples, blocks, 0.25 s, 2 s), and their number."""
REST, MOTION = range(2)
LAGS = 3  # shorter lags of 0.25 s means, beside one second: a 1 Hz beat repeats after a second
THREE_SIGMA, FAR = 9.0, 100.0
"""Squares of three standard deviations, which one of 370 normal values exceeds, and of
ten, which none does."""
# The half-second variance counts with this factor if that exceeds the learned variance.
# The factor allows for its scatter.
BURST_FACTOR = 0.75
# Smallest ratio of a variance to the expected one: noise may return to normal at any
# time.
QUIETEST = 0.1
# The same for blocks. At rest, means of quantised values scatter less.
QUIETEST_BLOCK = 0.03
# Largest ratio of a block variance to the expected one: such noise hides any fault.
LOUDEST = 1e4
ENDED = 0.35
"""Ratio of the recent variance to the learned one below which loud noise has ended: with 64
to 100 values in the average, white noise is rarely below 0.5. The learned variance then
falls to the expected one as fast as the average, or a later fault would wait for it."""
# Assumed ratio of the long-time variance to the block variance before it is measured.
UNKNOWN_RATIO = 16.0
# Slow noise is unknown again from this ratio of the squared rate to the largest so far.
FASTER = 16.0
# Standard deviations of a wild value. A wild value before a normal one is no fault.
WILD_STD = 5.0
# Prior: one wild value in 200 000, with the weight of 4000 samples.
WILD_EVENTS, WILD_SAMPLES = 0.02, 4000.0
# Factor on a long-time level. It allows for the scatter of an estimate from 80 values.
SURELY = 0.8
TRUST = 50.0  # largest degrees of freedom: more counts as normal
TAIL_MEMORY = 6000.0
TAIL_FIRST = TAIL_MEMORY / 3.0
"""Samples over which the weight of the tails is averaged (a minute), and the weight of
the first guess."""
# standard deviation of products of squares two samples apart in white noise, cut at `FAR`
TAIL_SCATTER = 2.8
# samples per degree of freedom: `TRUST` is reached in half a minute at 100 Hz
LEARNED_IN = 64.0
RECENT_BLOCKS = 4
"""Number of last blocks of which at least three show a burst of noise. An onset, even one
that a filter spreads, or a spike is in two of them at most."""
RECENT_GAIN = 0.04  # share of a block in the average of the last second of blocks
SELECTED = 2.5
"""Variance of white noise over the second smallest of these, each without its largest
step: 1.5 at 400 Hz, 3.0 at 100 Hz, 6.7 at 50 Hz."""

ByScale = Annotated[NDArray[np.float64], "f8", (SCALES, MAX_CHANNELS)]
ByLevel = Annotated[NDArray[np.float64], "f8", (SCALES + LAGS, MAX_CHANNELS)]
Pair = Annotated[NDArray[np.float64], "f8", (2, MAX_CHANNELS)]
Apart = Annotated[NDArray[np.float64], "f8", (4, MAX_CHANNELS)]
Rates = Annotated[NDArray[np.float64], "f8", (3, 3)]
ByAxis = Annotated[NDArray[np.float64], "f8", (3, MAX_CHANNELS)]
Two = Annotated[NDArray[np.float64], "f8", (2,)]
Four = Annotated[NDArray[np.float64], "f8", (SCALES,)]
Recent = Annotated[NDArray[np.float64], "f8", (RECENT_BLOCKS, MAX_CHANNELS)]


@record
class Levels:
    """Noise learned at rest, or in motion."""

    sample: Channels  # variance of a sample, (rad/s)^2
    block: Channels  # of a block, times its samples, (rad/s)^2
    # variance of longer times over blocks, of blocks over samples, and of shorter lags
    level: ByLevel


@record
class Noise:
    """The noise of the moment."""

    now: Levels
    longest: Channels  # largest variance of longer times over blocks
    kept: Annotated[list[Levels], 2]  # last levels at rest, in motion
    regime: Small  # `REST` or `MOTION`
    regime_seconds: Two  # time at rest, in motion, s
    # (rad/s)^2, square of the fastest rate since which the noise in motion is known
    largest_speed_squared: Real
    seen: Four  # values of each time scale so far
    recent_ratio: Channels  # variance over the last half second, over the learned one
    recent_block: Channels  # the same of blocks, over the last second
    unknown: Channels  # by how much the variance of long times may still be larger
    loudest: Channels  # largest variance of a sample so far, (rad/s)^2
    since: Channels  # time since it became much larger than any before, s
    last: ByScale  # statistics before
    apart: Apart  # of quarters, of the last second
    wild: ByScale  # values that were wild, and back at once
    cap: ByScale  # likelihood ratio of one value at most
    sets: Annotated[NDArray[np.int64], "i8", (2,)]  # the last two sets of channels
    newest: Small  # place of the last set
    repeats: Flag  # statistics of the same set exist
    before: Pair  # last statistics of samples of each
    block_set: Mask  # of the last block
    steps: Channels  # half squared differences of the samples of the block, limited
    energy: Channels  # the same without a limit, and without the largest one
    largest: Channels  # the largest one
    counted: Channels  # how many
    energies: Recent  # mean half squared difference of each of the last blocks
    cross: Channels  # relative correction of the variance by the common motion
    square: Channels  # mean of half squared differences
    neighbours: Channels  # mean product of two that are two samples apart
    squares: Pair  # the last two
    degrees: Channels  # degrees of freedom of the noise, as of a Student's
    share: Channels  # of the variance of a block's statistic that is noise


# Earlier corrected values in a fourth difference, 20 ms apart, beside the present one.
PAST = 4


@record
class SharedNoise:
    """Noise that channels have together (`fdi_ros.estimator.shared_noise`)."""

    kept: Mask  # channels that it describes
    regime: Small  # `REST` or `MOTION` when `outer` began
    fresh: Whole  # samples in a row of the same channels
    ones: Channels
    alone: Parity  # of the noise of samples alone
    even: Parity  # of channels alike: E
    local: Channels  # mean of the innovations over half a second, rad/s
    outer: Square  # R, (rad/s)^2
    count: Real  # samples in `outer`
    # part of R that lines explained while nothing was suspicious, (rad/s)^2
    line_covariance: Square
    product: Square  # A R
    excess: Real  # level of R over independent channels, at least 1
    # share of the noise that lines explain, and independent channels do not
    coherent: Real
    level: Channels  # variance of each channel now, (rad/s)^2
    checked: Pair  # mean of `level` at rest, in motion, while checked, (rad/s)^2
    checked_blocks: Two  # blocks that these are means of
    past: Annotated[NDArray[np.float64], "f8", (PAST, MAX_CHANNELS)]  # rad/s
    taken: Whole  # fourth differences of this block
    difference: Channels  # the last one, rad/s
    common: Vector  # rate of the last fourth difference, rad/s
    common_sum: Rates
    mixed_sum: ByAxis
    apart_sum: Channels
    square: Rates  # Q: mean products of the common rate, (rad/s)^2
    inverse: Rates  # of Q, s^2/rad^2
    factor: Rates
    mixed: ByAxis  # c: mean products of that and A d
    apart: Channels  # d: mean squares of A d, s^2/rad^2
    rate_count: Whole  # samples of the block in the next two sums
    rate_sum: Vector  # rad/s
    rate_squares: Vector  # (rad/s)^2
    within: Vector  # variance of the rate within a block, about a line, (rad/s)^2
    present: (
        Vector  # vibration of the last block about each axis, mean square, (rad/s)^2
    )
    vibration: Vector  # of the body about each axis, mean square, (rad/s)^2


@compiled
def begin_noise(noise: Noise, n: int, expected: Array) -> None:
    """Begin with the variances expected (n,), (rad/s)^2. ``noise`` is all zero."""
    noise.regime = MOTION
    for i in range(n):
        for levels in (noise.now, noise.kept[0], noise.kept[1]):
            levels.sample[i] = levels.block[i] = expected[i]
            for k in range(SCALES + LAGS):
                levels.level[k, i] = 1.0
        noise.recent_ratio[i] = noise.recent_block[i] = 1.0
        noise.square[i] = noise.share[i] = 1.0
        noise.squares[0, i] = noise.squares[1, i] = 1.0
        noise.unknown[i] = 1.0 + UNKNOWN_RATIO
        noise.loudest[i] = expected[i]
        noise.degrees[i] = TRUST
        noise.neighbours[i] = 1.0 + 0.5 / (TRUST - 3.0)
    update_longest(noise, n)


@compiled
def update_longest(noise: Noise, n: int) -> None:
    """Update the largest ratio of long-time noise to block noise, at least 1."""
    for i in range(n):
        noise.longest[i] = 1.0
        for k in range(QUARTER, SCALES + LAGS):
            noise.longest[i] = max(noise.longest[i], SURELY * noise.now.level[k, i])


@compiled
def change_regime(noise: Noise, n: int, regime: int, at_least: bool) -> None:
    """Switch to the noise learned at rest or in motion. ``at_least``: keep the larger of both, as motion begins."""
    before = noise.kept[noise.regime]
    after = noise.kept[regime]
    for i in range(n):
        before.sample[i] = noise.now.sample[i]
        before.block[i] = noise.now.block[i]
        noise.now.sample[i] = max(
            after.sample[i], noise.now.sample[i] if at_least else 0.0
        )
        noise.now.block[i] = max(
            after.block[i], noise.now.block[i] if at_least else 0.0
        )
        for k in range(SCALES + LAGS):
            before.level[k, i] = noise.now.level[k, i]
            least = noise.now.level[k, i] if at_least else 0.0
            noise.now.level[k, i] = max(after.level[k, i], least)
    noise.regime = regime
    update_longest(noise, n)


@compiled
def place_of(noise: Noise, mask: int) -> int:
    """Find the place of the last statistics of the same channel set. ``noise.repeats``: the set is known."""
    noise.repeats = True
    for k in range(2):
        if noise.sets[k] == mask:
            noise.newest = k
            return k
    noise.newest = 1 - noise.newest
    noise.repeats = False
    noise.sets[noise.newest] = mask
    return noise.newest


@compiled
def update_sample_noise(
    noise: Noise, n: int, mask: int, t: Array, inflation: Array, learn: bool, slot: int
) -> None:
    """Take the statistics t (n,) of a sample. Inflation: total variance over the noise alone."""
    gain = 1.0 / min(noise.seen[SAMPLE] + TAIL_FIRST, TAIL_MEMORY)
    # With another channel set the rate estimate changes, and the difference would show
    # sensor errors, not noise.
    place = place_of(noise, mask)
    for i in range(n):
        if mask >> i & 1:
            step = t[i] - noise.before[place, i]
            noise.before[place, i] = t[i]
            if not noise.repeats:
                continue
            # State uncertainty is slow: differences of neighbours do not show it.
            square = 0.5 * step * step
            # In a turn, small steps may be errors of the states.
            energy = square * (inflation[i] if square > THREE_SIGMA else 1.0)
            noise.energy[i] += min(energy, noise.largest[i])
            noise.largest[i] = max(energy, noise.largest[i])
            noise.steps[i] += min(square * inflation[i], THREE_SIGMA)
            noise.counted[i] += 1.0
            # Or turns, in which that uncertainty comes and goes, would look like volatile noise.
            step = (
                square * inflation[i] / max(1.0, BURST_FACTOR * noise.recent_ratio[i])
            )
            if learn:
                noise.neighbours[i] += gain * (
                    min(step * noise.squares[slot, i], FAR) - noise.neighbours[i]
                )
                noise.square[i] += gain * (step - noise.square[i])
            noise.squares[slot, i] = step
    count_wild(noise, SAMPLE, n, mask, t)


@compiled
def count_wild(noise: Noise, scale: int, n: int, mask: int, t: Array) -> None:
    """Store the statistics (n,), and count wild values that a normal one follows.

    A lasting error is not counted. The share of wild values without a fault limits the
    likelihood ratio of a single value to its inverse, ``noise.cap``.
    """
    for i in range(n):
        if mask >> i & 1:
            was_wild = abs(noise.last[scale, i]) > WILD_STD
            if was_wild and t[i] * t[i] < THREE_SIGMA:
                noise.wild[scale, i] += 1.0
            noise.last[scale, i] = t[i]
        noise.cap[scale, i] = (noise.seen[scale] + WILD_SAMPLES) / (
            noise.wild[scale, i] + WILD_EVENTS
        )


@compiled
def update_sample_variance(
    noise: Noise,
    n: int,
    mask: int,
    length: int,
    blocks: int,
    adaptation_gain: float,
    expected: Array,
    learn: bool,
) -> None:
    """Learn the variance of samples, beside the one expected (n,) (rad/s)^2, from those of a block.

    ``mask``: channels that delivered throughout; ``length``, ``blocks``: samples of a
    block, blocks so far; ``learn``: the learned variance follows.
    """
    gain = 1.0 / min(blocks + 25.0, 100.0)
    for i in range(n):
        if mask >> i & 1:
            part = noise.counted[i] / length
            step = noise.steps[i] / length - part
            noise.recent_ratio[i] += adaptation_gain * (
                step + part * (1.0 - noise.recent_ratio[i])
            )
            if part > 0.0:
                # The states change once in a block, and values with them.
                steps = max(noise.counted[i] - 1.0, 1.0)
                noise.energies[blocks % RECENT_BLOCKS, i] = noise.energy[i] / steps
            lasting = SELECTED * lasting_energy(noise, i)
            if lasting > FAR:
                noise.recent_ratio[i] = max(noise.recent_ratio[i], lasting)
            if learn:
                factor = 1.0 + gain * (step + part * noise.cross[i])
                noise.now.sample[i] = max(
                    noise.now.sample[i] * factor, QUIETEST * expected[i]
                )
                if noise.recent_ratio[i] < ENDED:
                    noise.now.sample[i] = fallen(
                        noise.now.sample[i], adaptation_gain, expected[i]
                    )
        noise.steps[i] = noise.energy[i] = noise.largest[i] = noise.counted[i] = 0.0
    update_degrees(noise, n, mask)


@compiled
def fallen(variance: float, share: float, expected: float) -> float:
    """Return a learned variance that falls by a share, but not below the expected one."""
    return max((1.0 - share) * variance, min(variance, expected))


@compiled
def lasting_energy(noise: Noise, i: int) -> float:
    """Return the second smallest mean half squared difference of the last blocks of channel i."""
    least = second = math.inf
    for k in range(RECENT_BLOCKS):
        energy = noise.energies[k, i]
        if energy < least:
            second = least
            least = energy
        else:
            second = min(second, energy)
    return second


@compiled
def update_degrees(noise: Noise, n: int, mask: int) -> None:
    """Update the degrees of freedom, as of a Student's: ``3 + 0.5 / x``.

    ``x = E[d d'] / E[d]^2 - 1``, where d and d' are half squared differences two
    samples apart, which have no value in common. Gyros of one kind have tails of one
    kind: x is the mean over all channels, or a channel's own x if that is certainly
    larger.
    """
    total = 0.0
    count = 0
    for i in range(n):
        if mask >> i & 1:
            total += noise.neighbours[i] / (noise.square[i] * noise.square[i]) - 1.0
            count += 1
    scatter = TAIL_SCATTER / math.sqrt(
        min(noise.seen[SAMPLE] + TAIL_FIRST, TAIL_MEMORY)
    )
    for i in range(n):
        own_excess = noise.neighbours[i] / (noise.square[i] * noise.square[i]) - 1.0
        excess = max(total / max(count, 1), own_excess - 2.0 * scatter, 1e-3)
        noise.degrees[i] = min(
            3.0 + 0.5 / excess, TRUST, 2.0 + noise.seen[SAMPLE] / LEARNED_IN
        )


@compiled
def update_block_noise(
    noise: Noise, n: int, mask: int, t: Array, expected: Array, learn: bool
) -> None:
    """Take the statistics t (n,) of a block. Expected: (n,) (rad/s)^2."""
    gain = 1.0 / min(noise.seen[BLOCK] + 25.0, 100.0)
    for i in range(n):
        if mask >> i & 1:
            step = t[i] - noise.last[BLOCK, i]
            if noise.seen[BLOCK] > 1 and learn and mask == noise.block_set:
                ratio = min(
                    0.5 * step * step * noise.longest[i] / noise.share[i], THREE_SIGMA
                )
                least = max(
                    QUIETEST * noise.now.sample[i], QUIETEST_BLOCK * expected[i]
                )
                block = max(noise.now.block[i] * (1.0 + gain * (ratio - 1.0)), least)
                noise.recent_block[i] += RECENT_GAIN * (ratio - noise.recent_block[i])
                if noise.recent_block[i] < ENDED:
                    block = fallen(block, RECENT_GAIN, expected[i])
                noise.now.block[i] = min(block, LOUDEST * expected[i])
            noise.now.level[BLOCK, i] = noise.now.block[i] / noise.now.sample[i]
    noise.block_set = mask
    count_wild(noise, BLOCK, n, mask, t)


@compiled
def update_slow_level(
    noise: Noise, k: int, i: int, step: float, gain: float, learn: bool
) -> None:
    """Follow the level of one longer time by the difference of two statistics."""
    if learn:
        level = noise.now.level[k, i]
        square = 0.5 * step * step * noise.longest[i]
        noise.now.level[k, i] += gain * (
            min(square, THREE_SIGMA * max(level, 1.0)) - level
        )


@compiled
def update_long_noise(
    noise: Noise, scale: int, n: int, mask: int, t: Array, learn: bool
) -> None:
    """Take the statistics t (n,) of a longer time into its level over blocks."""
    quarter = int(noise.seen[QUARTER]) % 4
    gain = 1.0 / min(noise.seen[scale] + 3.0, 80.0)
    for i in range(n):
        if mask >> i & 1:
            if scale == QUARTER:
                # Noise with a memory shows at a second's distance, a beat at half its period.
                step = t[i] - noise.apart[quarter, i]
                update_slow_level(
                    noise, QUARTER, i, step, gain, learn and noise.seen[scale] > 4
                )
                for lag in range(1, LAGS + 1):
                    step = t[i] - noise.apart[(quarter - lag) % 4, i]
                    update_slow_level(
                        noise,
                        SCALES + lag - 1,
                        i,
                        step,
                        gain,
                        learn and noise.seen[scale] > lag,
                    )
                noise.apart[quarter, i] = t[i]
            else:
                update_slow_level(
                    noise,
                    scale,
                    i,
                    t[i] - noise.last[scale, i],
                    gain,
                    learn and noise.seen[scale] > 1,
                )
    update_longest(noise, n)
    count_wild(noise, scale, n, mask, t)


@compiled
def update_largest_rate(noise: Noise, square: float) -> None:
    """Begin to learn the slow noise of motion anew where the square of the rate is far beyond any before."""
    if noise.regime == MOTION and square > FASTER * noise.largest_speed_squared:
        noise.largest_speed_squared = square
        noise.regime_seconds[MOTION] = 0.0


@compiled
def follow_loudness(noise: Noise, n: int, louder: float, seconds: float) -> None:
    """Begin to learn the slow noise of a channel anew where it is ``louder`` times as loud as ever before."""
    for i in range(n):
        noise.since[i] += seconds
        variance = noise.now.sample[i] * max(1.0, BURST_FACTOR * noise.recent_ratio[i])
        if variance > louder * noise.loudest[i]:
            noise.loudest[i] = variance
            noise.since[i] = 0.0


@compiled
def update_unknown(noise: Noise, n: int, seconds: float) -> None:
    """Update how much larger slow noise may still be: unknown at first, and for longer where noise is coloured."""
    noise.regime_seconds[noise.regime] += seconds
    seconds_in_regime = noise.regime_seconds[noise.regime]
    for i in range(n):
        known = min(seconds_in_regime, noise.since[i])
        noise.unknown[i] = 1.0 + UNKNOWN_RATIO / (
            1.0 + 0.25 * known * known / noise.longest[i]
        )
