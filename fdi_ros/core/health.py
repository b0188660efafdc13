# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Checks of channels: finite, in range, delivering at all, frozen; and values that repeat while others move.

A value that repeats is no defect by itself: a quantised sensor at rest repeats for minutes. It counts after a much
longer time, or against motion that the other channels see along this channel's axis: then the channel is stuck, or the
values of a whole unit are old.

The other channels are evidence of motion only if they agree among themselves: in a sample with an alarm that does not
isolate the channel that repeats, it is not called stuck. So a fault of another channel never makes a quantised sensor
at rest look stuck, and of two parallel channels neither is called stuck because of the other.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import compiled
from fdi_ros.core.records import Core, Current, Health, HealthSettings, PathSettings, Subset
from fdi_ros.core.states import FINE, FROZEN, MISSING, NON_FINITE, NON_FINITE_LASTING, OUT_OF_RANGE, SILENT
from fdi_ros.core.subsets import fill_rate

NOT_BAD = -(1 << 62)  # instead of the stamp at which a run of non-finite values began


@compiled
def check(
    limits: HealthSettings, health: Health, n: int, stamp: int, z: NDArray[np.float64], received: NDArray[np.uint8]
) -> None:
    """Check the values z (n,) of one sample; results in ``health.condition``."""
    if health.begun == 0:
        for i in range(n):
            health.value[i] = math.nan
            health.run_stamp[i] = health.received_stamp[i] = stamp
            health.bad_stamp[i] = NOT_BAD
    health.begun += 1
    follow_presence(health, n, stamp, received)
    for i in range(n):
        condition = receive(limits, health, i, stamp, z[i]) if received[i] else MISSING
        if condition == FINE and limits.frozen_time and stamp - health.run_stamp[i] >= limits.frozen_time:
            condition = FROZEN
        if stamp - health.received_stamp[i] > limits.stale_time:
            condition = SILENT
        health.condition[i] = condition
        health.counts[condition, i] += 1
        if condition != MISSING and condition != SILENT:
            health.samples[i] += 1


@compiled
def receive(limits: HealthSettings, health: Health, i: int, stamp: int, z: float) -> int:
    """Remember a value that was received of channel i; return what is wrong with it by itself."""
    # Across a hole it is unknown what the value was: a run begins anew.
    step = stamp - health.received_stamp[i]
    hole = step > limits.stale_time
    health.received_stamp[i] = stamp
    follow_share(health, i, math.isfinite(z), step)
    if math.isfinite(z):
        change = abs(z - health.value[i])
        if z != health.value[i] or hole:
            health.run_stamp[i] = stamp
        if change > 0.0 and (change < health.step[i] or health.step[i] == 0.0):
            health.step[i] = change
        health.value[i], health.bad_stamp[i] = z, NOT_BAD
        return OUT_OF_RANGE if abs(z) >= limits.max_rate[i] else FINE
    if health.bad_stamp[i] == NOT_BAD or hole:
        health.bad_stamp[i] = stamp
    return NON_FINITE_LASTING if stamp - health.bad_stamp[i] >= limits.non_finite_time else NON_FINITE


# Values that come and go ----------------------------------------------------------------------------------------------

SHARE_TIME, SHARE_SAMPLES = 500_000_000, 50.0
"""Time and values over which the share that is not finite is averaged, ns; the longer one counts."""
DOUBTED_SHARE, INTERMITTENT_SHARE = 0.15, 0.25
"""A channel is left out of the rate from the first share on, and faulty from the second: of single values that a driver
drops, up to 10 %, neither is reached."""
RETURNING = 3
"""After a value that is not finite the next ones are left out of the rate, where enough are left: all but the third."""
LEAST_LEAVES = 4.0  # and if so many went away lately at least: one hole is none that comes and goes


@compiled
def follow_share(health: Health, i: int, finite: bool, step: int) -> None:
    """Follow the share of the values of a channel that are not finite; step: since the value before, ns.

    What is not received has other reasons: a link that loses messages, a unit that is slower than the others.
    """
    adaptation_gain = min(step / SHARE_TIME, 1.0 / SHARE_SAMPLES)
    health.gone[i] += adaptation_gain * ((0.0 if finite else 1.0) - health.gone[i])
    health.leaves[i] *= 1.0 - adaptation_gain
    health.returning[i] = max(health.returning[i] - 1, 0) if finite else RETURNING
    if not finite and health.bad_stamp[i] == NOT_BAD:
        health.leaves[i] += 1.0


COMPLETE_SHARE, COMPLETE_TIME = 0.02, 2_000_000_000
"""A unit that has given a value in all but so few samples for so long, ns, is no slow one: if it goes away again and
again later, it is left out of the rate."""


@compiled
def follow_presence(health: Health, n: int, stamp: int, received: NDArray[np.uint8]) -> None:
    """Follow the share of the samples of each channel that nothing was received for.

    That is no fault of the channel: a link loses messages, a unit gives fewer of them.
    """
    adaptation_gain = min((stamp - health.stamp) / SHARE_TIME, 1.0 / SHARE_SAMPLES)
    for i in range(n):
        if health.begun == 1:
            # Nothing is known of it.
            health.absent[i], health.complete_stamp[i] = 1.0, stamp
        health.absent[i] += adaptation_gain * ((0.0 if received[i] else 1.0) - health.absent[i])
        health.lapses[i] *= 1.0 - adaptation_gain
        if not received[i] and health.received_stamp[i] == health.stamp:
            health.lapses[i] += 1.0
        if health.absent[i] > COMPLETE_SHARE:
            health.complete_stamp[i] = stamp
        elif stamp - health.complete_stamp[i] >= COMPLETE_TIME:
            health.complete |= 1 << i
    health.stamp = stamp


@compiled
def sparse_channels(health: Health, n: int) -> int:
    """Bits of the channels that were complete, and now go away again and again."""
    found = 0
    for i in range(n):
        if health.absent[i] >= INTERMITTENT_SHARE and health.lapses[i] >= LEAST_LEAVES:
            found |= 1 << i
    return found & health.complete


@compiled
def intermittent_channels(health: Health, n: int, share: float) -> int:
    """Bits of the channels of whose values at least a share comes and goes."""
    found = 0
    for i in range(n):
        if health.gone[i] >= share and health.leaves[i] >= LEAST_LEAVES:
            found |= 1 << i
    return found


# Values that repeat --------------------------------------------------------------------------------------------------

LEAST_MOTION = 6.0
"""Motion that counts against a repeated value, in standard deviations of the difference between channel and others,
beyond one step of a quantised sensor: so far it may turn without a new value."""
STEPS = 3.0  # of a quantised sensor: it repeats its value by chance until the body has moved by so many
RESTS, AT_REST = 3.0, 1e-3
"""At rest the rate is within so many standard deviations of a channel, and so many rad/s, of zero."""
COARSE_STEP = 0.5  # steps of so many standard deviations are coarse
ALL_REPEAT = 100_000_000
"""ns that all channels repeat their values before none of them is believed; in coarse steps ``stuck_time``, if that is
longer: gyros without noise repeat for longer in a steady turn."""
LEAST_SENSITIVITY = 1e-3  # below it a channel's own error does not show in its residual


@compiled
def leave_one_out(settings: PathSettings, now: Current, subset: Subset) -> None:
    """Predict each channel from the others of a subset: leave-one-out where it took part, else the estimate itself.

    In ``now.prediction``, rad/s, from the rate in ``now.others_rate``; NaN where there is none.
    """
    axes, rate = settings.sensors.axes, now.others_rate
    for i in range(settings.n):
        along = axes[i, 0] * rate[0] + axes[i, 1] * rate[1] + axes[i, 2] * rate[2]
        share = subset.sensitivity[i]
        if share > LEAST_SENSITIVITY:
            residual = now.input[i] - along
            now.prediction[i] = along + residual - residual / share
        else:
            now.prediction[i] = along if share == 0 else math.nan


@compiled
def largest_step(settings: PathSettings, health: Health, now: Current) -> float:
    """Largest step of the quantised channels, rad/s: that of a channel that never changed is not known."""
    step = 0.0
    for i in range(settings.n):
        if now.usable >> i & 1:
            step = max(step, health.step[i])
    return step


@compiled
def update_stuck(core: Core, subset: Subset, mask: int, stamp: int) -> int:
    """Bits of the channels that are stuck, judged by those in mask, the usable ones not under alarm themselves."""
    n, now, stuck = core.settings.n, core.now, 0
    # Of values as they came: what is newly known of the errors is no motion.
    fill_rate(subset, n, mask, now.input, now.others_rate)
    leave_one_out(core.settings, now, subset)
    step = largest_step(core.settings, core.health, now)
    for i in range(n):
        if core.health.run_stamp[i] == stamp:
            core.reference[i] = now.prediction[i]
        elif now.evidence.repeats & now.usable & (1 << i):
            share = subset.sensitivity[i]
            noise = core.settings.sensors.noise_std[i]
            spread = math.sqrt((noise * noise + step * step / 12.0) / (share if share > 0 else 0.5))
            moved = abs(now.prediction[i] - core.reference[i]) > LEAST_MOTION * spread + step
            isolated = now.verdict.suspects[i] and now.verdict.isolated
            if moved and (isolated or not now.verdict.alarm):
                stuck |= 1 << i
                core.health.stuck[i] += 1
    return stuck


@compiled
def add_stuck(settings: PathSettings, now: Current, evidence: int) -> None:
    """Name stuck channels in the verdict as well; statistic and alarm stay the detector's."""
    verdict = now.verdict
    if evidence and not verdict.alarm:
        verdict.isolated = True
    for i in range(settings.n):
        if evidence >> i & 1:
            verdict.suspects[i] = True
            if verdict.error[i] == 0:
                verdict.error[i] = now.corrected[i] - now.along[i]


@compiled
def leave_flickering(core: Core, subsets: NDArray[Any]) -> None:
    """Leave channels whose values seem to come and go out of the sample, where enough are left."""
    now, n = core.now, core.settings.n
    now.evidence.flickers = intermittent_channels(core.health, n, DOUBTED_SHARE) | sparse_channels(core.health, n)
    for i in range(n):
        rest = now.usable & ~(now.evidence.flickers & 1 << i)
        if subsets[rest].spare:
            now.usable = rest


@compiled
def update_repeated(core: Core) -> int:
    """Channels of the units that give all their values again while the others have measured motion.

    The values are old, and no evidence about any single channel.
    """
    members, sensors, found = core.settings.members, core.settings.sensors, 0
    for u in range(core.settings.units):
        # A unit with a channel that gives nothing, or nothing in range, is none of these: what it gives is new, or the
        # sample is without it. One of which a channel was declared may well be one.
        fresh, moved = members[u] & ~core.now.plain != 0, False
        for i in range(core.settings.n):
            if members[u] >> i & 1:
                h, change = sensors.axes[i], 0.0
                for a in range(3):
                    change += h[a] * (core.now.rate[a] - core.unit_rate[u, a])
                fresh = fresh or core.health.run_stamp[i] == core.now.evidence.stamp
                moved = moved or abs(change) > sensors.noise_std[i] + STEPS * core.health.step[i]
        if fresh:
            for a in range(3):
                core.unit_rate[u, a] = core.now.rate[a]
        elif moved:
            found |= members[u]
    return found


@compiled
def is_at_rest(settings: PathSettings, now: Current) -> bool:
    """Whether the rate of the channels in use is that of a vehicle at rest."""
    square = now.rate[0] * now.rate[0] + now.rate[1] * now.rate[1] + now.rate[2] * now.rate[2]
    least = RESTS * largest_noise(settings) + AT_REST
    return square < least * least


@compiled
def largest_noise(settings: PathSettings) -> float:
    """Largest noise_std of all channels, rad/s."""
    noise = 0.0
    for i in range(settings.n):
        noise = max(noise, settings.sensors.noise_std[i])
    return noise


@compiled
def all_repeat(settings: PathSettings, health: Health, now: Current, stamp: int) -> bool:
    """Whether all channels have repeated their values, bit for bit, for so long that what feeds them must stand.

    A real gyro toggles its last bits even at rest, unless these are coarse; all of them at once do not stand still.
    """
    step, noise = largest_step(settings, health, now), largest_noise(settings)
    # Noise of which nothing is left in steps of a link, 1 mrad/s, is less than the one expected.
    coarse = step == 0.0 or step > COARSE_STEP * noise or step > COARSE_STEP * AT_REST
    if not now.usable or (coarse and is_at_rest(settings, now)):
        return False
    fresh, least = 0, max(ALL_REPEAT, settings.health.stuck_time) if coarse else ALL_REPEAT
    for i in range(settings.n):
        if stamp - health.run_stamp[i] < least:
            fresh |= 1 << i
    return not now.usable & fresh
