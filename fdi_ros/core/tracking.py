# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The biases that wander: what the channels can see of each other's, followed in flight.

The common part of the biases passes for rate, and no redundancy shows it. The rest is followed channel by channel by a
Kalman filter whose measurement is the mean residual over half a second. A block waits some seconds before it is taken,
and is thrown away if meanwhile the detector has come to suspect a fault: so a fault is not taken for bias.
"""

from __future__ import annotations

import math
from typing import Annotated, Any

from numpy.typing import NDArray

from fdi_ros.core.bank import Circumstances, Sensors
from fdi_ros.core.compiled import compiled
from fdi_ros.core.record import Channels, Flag, Mask, Real, Vector, Whole, record
from fdi_ros.core.subsets import find_rate

BLOCK = 500_000_000
"""ns."""
DELAYED = 6
"""Blocks that wait."""
LEAST_SAMPLES = 5
"""In a block."""
LONGEST_HOLD = 15_000_000_000
"""ns; a suspicion that lasts longer without a fault being found is noise."""
MEMORY = 20.0
"""Blocks that the scatter of the means is averaged over."""
RISE = 9.0
"""One difference raises that average by so many times its share at most."""


@record
class TrackingSettings:
    """How biases may wander."""

    on: Flag
    walk: Channels  # rad/s/sqrt(s)
    learned: Channels  # standard deviation of a bias averaged at the start, rad/s
    turn_on: Real  # standard deviation of a bias that was not learned, rad/s
    limit: Real  # a bias is followed so far, rad/s


@record
class Mean:
    """Means over a block."""

    z: Channels  # values less the bias at the start, rad/s
    moving: Channels  # absolute rate along each channel, rad/s
    mask: Mask  # channels that delivered in every sample
    samples: Whole


@record
class Tracking:
    """What is followed of the biases, and the blocks that wait."""

    value: Channels  # rad/s
    variance: Channels  # of what is not known of it, (rad/s)^2
    scatter: Channels  # of the mean over a block, (rad/s)^2
    last: Channels  # residual of the last block, rad/s
    last_mask: Mask  # channels that it is of
    filling: Mean  # totals of the block being filled
    begun: Flag  # a block has begun
    start: Whole  # of it, ns
    skipped: Whole  # samples with other channels
    unseen: Channels  # variance of each bias by what is known without the others, (rad/s)^2
    queue: Annotated[list[Mean], DELAYED]
    first: Whole  # place of the oldest block
    waiting: Whole  # blocks
    suspected: Whole  # stamp since which the biases are held, ns; 0: they are not
    room: Channels
    rate: Vector


@compiled
def begin_tracking(own: Tracking, limits: TrackingSettings, n: int, variance: NDArray[Any]) -> None:
    """Begin anew with biases known to a variance, (n,) (rad/s)^2."""
    own.waiting = own.suspected = own.last_mask = 0
    own.begun = False
    clear_block(own, n)
    for i in range(n):
        own.value[i], own.variance[i] = 0.0, variance[i]
        own.unseen[i] = variance[i]


@compiled
def clear_block(own: Tracking, n: int) -> None:
    """Begin a new block."""
    own.filling.samples = own.skipped = 0
    for i in range(n):
        own.filling.z[i] = own.filling.moving[i] = 0.0


@compiled
def find_residual(own: Tracking, n: int, subset: Any, block: Mean) -> None:
    """Work out how far each channel of a block is off what is followed, into ``own.room``, rad/s."""
    for i in range(n):
        own.room[i] = block.z[i] - own.value[i]
    find_rate(subset, n, block.mask, own.room, own.rate)


@compiled
def follow(
    own: Tracking,
    limits: TrackingSettings,
    sensors: Sensors,
    subsets: NDArray[Any],
    stamp: int,
    mask: int,
    z: NDArray[Any],
    along: NDArray[Any],
    suspicious: bool,
    alarm: bool,
    known: Circumstances,
) -> None:
    """Take one sample.

    Parameters
    ----------
    own
        What is followed.
    limits
        How biases may wander.
    sensors
        All channels.
    subsets
        (2^n,) `Subset`.
    stamp
        ns.
    mask
        Channels that delivered, and are trusted.
    z
        (n,) values less the bias, and less what is followed, rad/s.
    along
        (n,) rate along each channel, rad/s.
    suspicious, alarm
        The detector suspects a fault; it has found one.
    known
        Where the standard deviation of each bias is kept.
    """
    n, block = sensors.n, own.filling
    if not own.begun:
        if own.start and stamp - own.start > LONGEST_HOLD:
            # After a long hole in the stream.
            spread(own, limits, n, (stamp - own.start) * 1e-9, alarm, known)
            own.waiting = 0
        own.begun, own.start = True, stamp
        clear_block(own, n)
    if held(own, stamp, suspicious, alarm):
        own.waiting = 0
        clear_block(own, n)
    if block.mask != mask and own.skipped >= block.samples:
        clear_block(own, n)
        block.mask = mask
    if block.mask == mask:
        add_sample(own, n, z, along)
    else:
        # A lost message now and then does not undo the block.
        own.skipped += 1
    if stamp - own.start < BLOCK:
        return
    if block.samples >= LEAST_SAMPLES:
        put(own, limits, sensors, subsets)
    if stamp - own.start > LONGEST_HOLD:
        own.waiting = 0
    spread(own, limits, n, (stamp - own.start) * 1e-9, alarm, known)
    clear_block(own, n)
    own.begun, own.start = False, stamp


@compiled
def add_sample(own: Tracking, n: int, z: NDArray[Any], along: NDArray[Any]) -> None:
    """Add a sample to the block."""
    own.filling.samples += 1
    for i in range(n):
        own.filling.z[i] += z[i] + own.value[i]
        own.filling.moving[i] += abs(along[i])


@compiled
def held(own: Tracking, stamp: int, suspicious: bool, alarm: bool) -> bool:
    """Whether the biases are held still."""
    if not suspicious:
        own.suspected = 0
        return False
    if own.suspected == 0:
        own.suspected = stamp
    return alarm or stamp - own.suspected <= LONGEST_HOLD


@compiled
def put(own: Tracking, limits: TrackingSettings, sensors: Sensors, subsets: NDArray[Any]) -> None:
    """Let the block wait; take the one that has waited long enough."""
    n = sensors.n
    if own.waiting == DELAYED:
        take(own, limits, sensors, subsets, own.queue[own.first])
        own.first = (own.first + 1) % DELAYED
        own.waiting -= 1
    kept, block = own.queue[(own.first + own.waiting) % DELAYED], own.filling
    kept.mask, kept.samples = block.mask, block.samples
    for i in range(n):
        kept.z[i], kept.moving[i] = block.z[i] / block.samples, block.moving[i] / block.samples
    own.waiting += 1


@compiled
def take(own: Tracking, limits: TrackingSettings, sensors: Sensors, subsets: NDArray[Any], block: Mean) -> None:
    """Correct what is followed by a block."""
    n, subset = sensors.n, subsets[block.mask]
    if not subset.spans:
        return
    find_residual(own, n, subset, block)
    largest = 0.0
    for i in range(n):
        if not block.mask >> i & 1 or subset.sensitivity[i] <= 0.0:
            continue
        h = sensors.axes[i]
        off = own.room[i] - (h[0] * own.rate[0] + h[1] * own.rate[1] + h[2] * own.rate[2])
        white = sensors.noise_std[i] * sensors.noise_std[i] / block.samples
        step = off + own.value[i] - own.last[i]
        if own.last_mask == block.mask:
            square = min(0.5 * step * step, RISE * max(own.scatter[i], white))
            own.scatter[i] += (square - own.scatter[i]) / MEMORY
        own.last[i] = off + own.value[i]
        systematic = sensors.scale_std[i] * block.moving[i]
        if systematic * systematic > own.variance[i]:
            # In a turn a scale error looks like bias, and is the same in every block: it does not average out.
            continue
        noise = max(white, own.scatter[i]) + systematic * systematic
        gain = own.variance[i] / (own.variance[i] + noise)
        own.value[i] += gain * off
        own.variance[i] *= 1.0 - gain
        largest = max(largest, abs(own.value[i]))
    if largest > limits.limit:
        # All by the same share: what is left shows the channel that has drifted, and is not taken for bias of others.
        for i in range(n):
            own.value[i] *= limits.limit / largest
    own.last_mask = block.mask


@compiled
def give_back(own: Tracking, sensors: Sensors, subsets: NDArray[Any], culprit: int) -> None:
    """Take out of the biases followed what is a channel's that has drifted: its own, and its shadow on the others."""
    subset, h = subsets[own.last_mask | 1 << culprit], sensors.axes
    if subset.sensitivity[culprit] <= 0.0:
        return
    drift = own.value[culprit] / subset.sensitivity[culprit]
    for j in range(sensors.n):
        if j != culprit and own.last_mask >> j & 1:
            x, y, z = subset.gain[culprit, 0], subset.gain[culprit, 1], subset.gain[culprit, 2]
            own.value[j] += (h[j, 0] * x + h[j, 1] * y + h[j, 2] * z) * drift


@compiled
def spread(own: Tracking, limits: TrackingSettings, n: int, seconds: float, alarm: bool, known: Circumstances) -> None:
    """Let the biases wander for a time; while an alarm stands it goes on from what was known at its onset."""
    wait = DELAYED * BLOCK * 1e-9
    for i in range(n):
        square = limits.walk[i] * limits.walk[i]
        if not alarm:
            own.variance[i] += square * seconds
        own.unseen[i] += square * seconds
        known.bias_std[i] = math.sqrt(own.variance[i] + square * wait)
