# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Checks of single values: missing, not finite, out of range, frozen, intermittent."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import compiled
from fdi_ros.core.records import Condition, Core, Health, PathSettings, Sample
from fdi_ros.model.samples import LARGEST_GYRO_RANGE, Array

FINE, MISSING, NON_FINITE, OUT_OF_RANGE, FROZEN, SILENT, NON_FINITE_LASTING = map(
    int, Condition
)
NOT_BAD = -(1 << 62)  #: In place of the start of a run of non-finite values.


@compiled
def check(settings: PathSettings, health: Health, sample: Sample) -> None:
    """Check the values of one sample. The results are in ``health.condition``."""
    n = settings.n
    stamp = sample.stamp
    received = sample.received
    if health.begun == 0:
        for i in range(n):
            health.value[i] = math.nan
            health.run_stamp[i] = health.received_stamp[i] = stamp
            health.bad_stamp[i] = NOT_BAD
            health.limit[i] = usual_limit(settings, i)
    health.begun += 1
    follow_presence(health, n, stamp, received)
    for i in range(n):
        condition = (
            receive(settings, health, i, stamp, sample.z[i]) if received[i] else MISSING
        )
        if (
            condition == FINE
            and settings.frozen_time
            and stamp - health.run_stamp[i] >= settings.frozen_time
        ):
            condition = FROZEN
        if stamp - health.received_stamp[i] > settings.stale_time:
            condition = SILENT
        health.condition[i] = condition
    follow_run_lengths(settings, health, received)
    silence_units(settings, health)
    for i in range(n):
        health.counts[health.condition[i], i] += 1
        if health.condition[i] != MISSING and health.condition[i] != SILENT:
            health.samples[i] += 1


@compiled
def has_value(health: Health, i: int) -> bool:
    """Whether channel i has a finite value in this sample."""
    condition = health.condition[i]
    return condition in (FINE, OUT_OF_RANGE, FROZEN)


@compiled
def silence_units(settings: PathSettings, health: Health) -> None:
    """Treat a unit with only non-finite values as silent.

    Drivers send NaN while their device is absent, which is no lasting fault of a channel.
    """
    for u in range(settings.units):
        gone = members = 0
        for i in range(settings.n):
            if settings.members[u] >> i & 1:
                members += 1
                gone += health.condition[i] == NON_FINITE_LASTING
        for i in range(settings.n if gone == members > 1 else 0):
            if settings.members[u] >> i & 1:
                health.condition[i] = SILENT


@compiled
def receive(
    settings: PathSettings, health: Health, i: int, stamp: int, z: float
) -> int:
    """Store a received value of channel i, and return its `Condition`."""
    # During a hole the value is unknown, so a new run begins.
    step = stamp - health.received_stamp[i]
    hole = step > settings.stale_time
    health.received_stamp[i] = stamp
    follow_share(health, i, math.isfinite(z), step)
    if math.isfinite(z):
        change = abs(z - health.value[i])
        if z != health.value[i] or hole:
            health.run_stamp[i] = stamp
            health.ended[i] = health.repeats[i]
        is_smaller = change < health.step[i] or health.step[i] == 0.0
        if change > 0.0 and is_smaller:
            health.step[i] = change
        follow_rail(settings, health, i, z)
        health.value[i] = z
        health.bad_stamp[i] = NOT_BAD
        return OUT_OF_RANGE if abs(z) >= health.limit[i] else FINE
    if health.bad_stamp[i] == NOT_BAD or hole:
        health.bad_stamp[i] = stamp
    return (
        NON_FINITE_LASTING
        if stamp - health.bad_stamp[i] >= settings.non_finite_time
        else NON_FINITE
    )


RUN_GAIN, RUN_MEMORY = 1.0 / 16.0, 1.0 / 512.0
"""Shares of the length of a run in the usual length, where it is longer and shorter."""
#: Longest run that counts in the usual length: one defect is no habit.
LONGEST_RUN = 16.0


@compiled
def follow_run_lengths(
    settings: PathSettings, health: Health, received: NDArray[np.uint8]
) -> None:
    """Update the usual length of a run of equal values of each channel whose value has changed.

    Where all channels of a unit change at once, the source has repeated old values, and
    the run is no habit of the channel.
    """
    changed = present = 0
    for i in range(settings.n):
        if received[i]:
            present |= 1 << i
            if health.run_stamp[i] == health.stamp:
                changed |= 1 << i
    for i in range(settings.n):
        if changed >> i & 1:
            beside = present
            for u in range(settings.units):
                if settings.members[u] >> i & 1:
                    beside = present & settings.members[u]
            length = 1.0
            if beside & ~changed:
                length = max(min(float(health.ended[i]), LONGEST_RUN), 1.0)
            usual = max(health.run_length[i], 1.0)
            gain = RUN_GAIN if length > usual else RUN_MEMORY
            health.run_length[i] = usual + gain * (length - usual)


RANGES = tuple(
    math.radians(32767 / sensitivity) for sensitivity in (131, 65.5, 32.8, 16.4)
)
"""Largest output of chips with ranges of 250, 500, 1000 and 2000 deg/s, rad/s."""
RAIL_SHARE, RAIL_OFFSET = 1e-3, 0.02
"""Distance from the end of a range, as a share and in rad/s, within which a value is at
the end: sensitivities of makes differ, and a bias may have been subtracted."""
#: Equal largest values in a row that show the end of a range. Noise repeats no extreme.
RAIL_REPEATS = 3


@compiled
def rail_of(size: float) -> float:
    """Return the smallest value at the end of the range that a size reaches, rad/s, or 0."""
    for largest in RANGES:
        width = RAIL_SHARE * largest + RAIL_OFFSET
        if abs(size - largest) <= width:
            return largest - width
    return 0.0


@compiled
def usual_limit(settings: PathSettings, i: int) -> float:
    """Return the size from which on values are out of range by the settings, rad/s."""
    stated = settings.max_rate[i]
    return min(stated, rail_of(RANGES[3])) if stated < LARGEST_GYRO_RANGE else stated


@compiled
def follow_rail(settings: PathSettings, health: Health, i: int, z: float) -> None:
    """Learn the range of a chip from a repeated extreme value.

    Two larger values in a row show that the extreme was no end of range. A single one
    may be a spike.
    """
    size = abs(z)
    before = abs(health.value[i])
    repeats = z == health.value[i]
    health.repeats[i] = health.repeats[i] + 1 if repeats else 1
    if size > health.extreme[i] and before > health.extreme[i]:
        reached = size if size < before else before
        if reached > health.extreme[i] + RAIL_SHARE * reached + 2.0 * RAIL_OFFSET:
            health.limit[i] = usual_limit(settings, i)
        health.extreme[i] = reached
    if size == health.extreme[i] and health.repeats[i] >= RAIL_REPEATS:
        rail = rail_of(size)
        if rail > 0.0:
            health.limit[i] = min(health.limit[i], rail)


SHARE_TIME, SHARE_SAMPLES = 500_000_000, 50.0
"""Averaging time, ns, and number of values of the share of non-finite values. The longer
one counts: 50 values distinguish 15 % from 25 %."""
#: Share of non-finite values from which on a channel is left out of the rate. Drivers
#: drop up to 10 % of single values.
DOUBTED_SHARE = 0.15
#: Share from which on a channel is faulty: 2.5 standard deviations above `DOUBTED_SHARE`.
INTERMITTENT_SHARE = 0.25
#: Losses in a row that count in the share. A longer run is silence: beside scattered losses
#: of 20 % it would bring the share of a healthy channel beyond `INTERMITTENT_SHARE`.
LONGEST_COUNTED = 10
#: A non-finite value and the next two values are left out of the rate.
RETURNING = 3
#: Least number of recent losses of an intermittent channel. Single holes do not count.
LEAST_LEAVES = 4.0


@compiled
def follow_share(health: Health, i: int, finite: bool, step: int) -> None:
    """Update the share of non-finite values of a channel.

    ``step`` is the time since the previous value, ns.
    """
    health.returning[i] = max(health.returning[i] - 1, 0) if finite else RETURNING
    gone_for = health.received_stamp[i] - health.bad_stamp[i]
    if (
        not finite
        and health.bad_stamp[i] != NOT_BAD
        and gone_for >= LONGEST_COUNTED * step
    ):
        return
    adaptation_gain = min(step / SHARE_TIME, 1.0 / SHARE_SAMPLES)
    gone = 0.0 if finite else 1.0
    health.gone[i] += adaptation_gain * (gone - health.gone[i])
    health.leaves[i] *= 1.0 - adaptation_gain
    if not finite and health.bad_stamp[i] == NOT_BAD:
        health.leaves[i] += 1.0


COMPLETE_SHARE, COMPLETE_TIME = 0.02, 4 * SHARE_TIME
"""A unit with at most this share of lost samples over this time, ns, is not slow. Later
losses are flicker."""


@compiled
def follow_presence(
    health: Health, n: int, stamp: int, received: NDArray[np.uint8]
) -> None:
    """Update the share of samples without a value. This is no fault: links lose messages."""
    adaptation_gain = min((stamp - health.stamp) / SHARE_TIME, 1.0 / SHARE_SAMPLES)
    for i in range(n):
        if health.begun == 1:
            # The channel is still unknown.
            health.absent[i] = 1.0
            health.complete_stamp[i] = stamp
        health.absent[i] += adaptation_gain * (
            (0.0 if received[i] else 1.0) - health.absent[i]
        )
        health.lapses[i] *= 1.0 - adaptation_gain
        if not received[i] and health.received_stamp[i] == health.stamp:
            health.lapses[i] += 1.0
        if health.absent[i] > COMPLETE_SHARE:
            health.complete_stamp[i] = stamp
        elif stamp - health.complete_stamp[i] >= COMPLETE_TIME:
            health.complete |= 1 << i
    health.stamp = stamp


DOUBTED_BEYOND, CERTAIN_BEYOND = 4.0, 5.5
"""Standard deviations of chance by which the share of a channel exceeds that of the unit
that loses least. Of six units that lose 20 % of all values alike, one reaches the second
limit in 40 hours at 100 Hz (simulated), and 5.0 in 7 hours."""
#: Largest probability of a run of losses by chance: at 100 Hz less than one of twelve
#: channels in 200 hours.
CHANCE_RUN = 1e-9


@compiled
def unit_of(settings: PathSettings, i: int) -> int:
    """Return the mask of the unit of a channel, or of the channel if it has no unit."""
    for unit in range(settings.units):
        if settings.members[unit] >> i & 1:
            return int(settings.members[unit])
    return 1 << i


@compiled
def loss_of_others(
    settings: PathSettings, health: Health, shares: Array, i: int
) -> float:
    """Return the share of losses of the other unit that loses least, or 1 if none delivers.

    ``shares`` (n,) are the losses of all channels. What every unit loses, the bus or the
    link loses.
    """
    own = unit_of(settings, i)
    least = 1.0
    for j in range(settings.n):
        if own >> j & 1 or health.condition[j] == SILENT:
            continue
        beside = unit_of(settings, j)
        total = count = 0.0
        for k in range(settings.n):
            if beside >> k & 1:
                total += shares[k]
                count += 1.0
        least = min(least, total / count)
    return least


@compiled
def broken_channels(settings: PathSettings, health: Health, stamp: int) -> int:
    """Return the mask of channels that have given no number for long, beyond all chance.

    Where all units lose values at random, a run of losses may be as long by chance.
    """
    found = 0
    for i in range(settings.n):
        if health.condition[i] == NON_FINITE_LASTING:
            usual = loss_of_others(settings, health, health.gone, i)
            run = 1.0 + 1e-9 * (stamp - health.bad_stamp[i]) / settings.period
            if usual == 1.0 or usual**run < CHANCE_RUN:
                found |= 1 << i
    return found


@compiled
def intermittent_channels(
    settings: PathSettings,
    health: Health,
    shares: Array,
    leaves: Array,
    least: tuple[float, float],
) -> int:
    """Return the mask of channels whose values come and go, and not those of all units.

    ``shares`` (n,) are shares of missing values, and ``leaves`` (n,) recent numbers of
    losses. ``least`` is the least share of such a channel, and the least number of
    standard deviations beyond the other units.
    """
    found = 0
    for i in range(settings.n):
        if shares[i] >= least[0] and leaves[i] >= LEAST_LEAVES:
            usual = loss_of_others(settings, health, shares, i)
            middle = 0.5 * (shares[i] + usual)
            # Of the difference of two averages that forget with `SHARE_SAMPLES`.
            variance = middle * (1.0 - middle) / SHARE_SAMPLES
            if shares[i] - usual > least[1] * math.sqrt(variance):
                found |= 1 << i
    return found


@compiled
def leave_flickering(core: Core, subsets: NDArray[Any]) -> None:
    """Leave channels whose values come and go out of the sample, if enough remain."""
    now = core.now
    health = core.health
    settings = core.settings
    # Also channels that were complete, and now lack samples repeatedly.
    sparse = health.complete & intermittent_channels(
        settings,
        health,
        health.absent,
        health.lapses,
        (INTERMITTENT_SHARE, CERTAIN_BEYOND),
    )
    now.evidence.flickers = sparse | intermittent_channels(
        settings, health, health.gone, health.leaves, (DOUBTED_SHARE, DOUBTED_BEYOND)
    )
    for i in range(settings.n):
        rest = now.usable & ~(now.evidence.flickers & 1 << i)
        if subsets[rest].spare:
            now.usable = rest
