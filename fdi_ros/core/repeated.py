# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Values that repeat while others move.

A value that repeats is no defect by itself: a quantised sensor at rest repeats for
minutes. It counts after a much longer time, or against motion that the others see along
this channel's axis: then the channel is stuck, or the values of a whole unit are old.

A fault at rest looks like motion to every quiet channel beside it. The others are
therefore evidence of motion only if they agree. The same channels must have seen the
whole motion, their disagreement must be small beside the motion, and in coarse steps
each of them must be checked by the rest. An alarm that does not isolate the channel
that repeats forbids the conclusion too.
"""

from __future__ import annotations

import math
from typing import Any

from numpy.typing import NDArray

from fdi_ros.compiling.compiled import compiled
from fdi_ros.core.algebra import along, square
from fdi_ros.core.records import Core, Current, Health, PathSettings, Subset
from fdi_ros.core.subsets import fill_rate
from fdi_ros.model.geometry import MIN_SENSITIVITY

# standard deviations, beyond one step, that the others move by while a stuck value
# repeats
LEAST_MOTION = 6.0
AGREED = 0.5
"""Largest disagreement of the others, root sum of squares, as a share of the motion they
see. A fault of one of three parallel channels moves their mean by a third of itself and
leaves 0.8 of itself as disagreement; real motion leaves noise."""
# of a quantised sensor, which repeats its value by chance until the body has moved this
# far
STEPS = 3.0
RESTS, AT_REST = 3.0, 1e-3
"""At rest the rate is within three standard deviations of a channel, and a step of
MAVLink in rad/s, of zero."""
# standard deviations: noise takes a value over smaller steps with nearly every sample
COARSE_STEP = 0.5
ALL_REPEAT = 100_000_000
"""ns that all channels repeat their values before none of them is believed: what a link
may hold up. In coarse steps ``stuck_time``, if that is longer: gyros without noise
repeat for longer in a steady turn."""


@compiled
def leave_one_out(settings: PathSettings, now: Current, subset: Subset) -> None:
    """Predict each channel from the others of a subset, into ``now.prediction``, rad/s; NaN: not predicted."""
    axes, rate = settings.sensors.axes, now.others_rate
    for i in range(settings.n):
        expected = along(axes[i], rate)
        share = subset.sensitivity[i]
        if share > MIN_SENSITIVITY**2:
            residual = now.input[i] - expected
            now.prediction[i] = expected + residual - residual / share
        else:
            now.prediction[i] = expected if share == 0 else math.nan


@compiled
def largest_step(settings: PathSettings, health: Health, now: Current) -> float:
    """Largest step of the quantised channels, rad/s. The step of a channel that never changed is unknown."""
    step = 0.0
    for i in range(settings.n):
        if now.usable >> i & 1:
            step = max(step, health.step[i])
    return step


@compiled
def fill_disagreement(
    settings: PathSettings, now: Current, subset: Subset, mask: int
) -> None:
    """Sum the squares by which the channels of a mask other than each disagree, into ``now.disagreement``."""
    axes, rate, total = settings.sensors.axes, now.others_rate, 0.0
    fill_rate(subset, settings.n, mask, now.corrected, rate)
    for i in range(settings.n):
        now.disagreement[i] = 0.0
        if mask >> i & 1:
            residual = now.corrected[i] - along(axes[i], rate)
            total += residual * residual
            share = subset.sensitivity[i]
            if share > MIN_SENSITIVITY**2:
                now.disagreement[i] = residual * residual / share
    for i in range(settings.n):
        now.disagreement[i] = max(total - now.disagreement[i], 0.0)


@compiled
def is_confirmed(settings: PathSettings, subset: Subset, mask: int, i: int) -> bool:
    """Whether the rest checks each channel of a mask that measures along channel i; ``subset`` is of the mask."""
    axes = settings.sensors.axes
    for j in range(settings.n):
        unchecked = mask & ~subset.detectable & (1 << j)
        if unchecked and abs(along(axes[i], axes[j])) > MIN_SENSITIVITY:
            return False
    return True


@compiled
def has_moved(
    core: Core, subset: Subset, others: int, i: int, least: float, step: float
) -> bool:
    """Whether the others (their ``subset``) have measured motion along channel i while its value repeats."""
    now, noise = core.now, core.settings.sensors.noise_std[i]
    change = abs(now.prediction[i] - core.reference[i])
    if not (change > least + step and now.disagreement[i] < (AGREED * change) ** 2):
        return False
    # The noise of a fine sensor never repeats: its repeated values need no second witness.
    coarse = step > COARSE_STEP * noise
    return not coarse or is_confirmed(core.settings, subset, others, i)


@compiled
def update_stuck(core: Core, subsets: NDArray[Any], mask: int, stamp: int) -> int:
    """Bits of the channels that are stuck, judged by those in mask, the usable ones not under alarm themselves."""
    n, now, stuck, subset = core.settings.n, core.now, 0, subsets[mask]
    # Use uncorrected values: a change of the estimated errors is not motion.
    fill_rate(subset, n, mask, now.input, now.others_rate)
    leave_one_out(core.settings, now, subset)
    if now.evidence.repeats & now.usable:
        fill_disagreement(core.settings, now, subset, mask)
    step = largest_step(core.settings, core.health, now)
    for i in range(n):
        others = mask & ~(1 << i)
        if core.health.run_stamp[i] == stamp or others != core.witnesses[i]:
            core.reference[i] = now.prediction[i]
            core.witnesses[i] = others
        elif now.evidence.repeats & now.usable & (1 << i):
            isolated = now.verdict.suspects[i] and now.verdict.isolated
            if now.verdict.alarm and not isolated:
                continue
            share = subset.sensitivity[i]
            noise = core.settings.sensors.noise_std[i]
            spread = math.sqrt(
                (noise * noise + step * step / 12.0) / (share if share > 0 else 0.5)
            )
            if has_moved(core, subsets[others], others, i, LEAST_MOTION * spread, step):
                stuck |= 1 << i
                core.health.stuck[i] += 1
    return stuck


@compiled
def add_stuck(settings: PathSettings, now: Current, evidence: int) -> None:
    """Add stuck channels to the suspects of the verdict. Statistic and alarm stay unchanged."""
    verdict = now.verdict
    if evidence and not verdict.alarm:
        verdict.isolated = True
    for i in range(settings.n):
        if evidence >> i & 1:
            verdict.suspects[i] = True
            if verdict.error[i] == 0:
                verdict.error[i] = now.corrected[i] - now.along[i]


@compiled
def update_repeated(core: Core) -> int:
    """Channels of the units that give old values: all of theirs again, while the others have measured motion."""
    members, sensors, found = core.settings.members, core.settings.sensors, 0
    for u in range(core.settings.units):
        # A unit with a channel that gives nothing, or nothing in range, is none of
        # these: what it gives is new, or the
        # sample is without it. One of which a channel was declared may well be one.
        fresh, moved = members[u] & ~core.now.plain != 0, False
        for i in range(core.settings.n):
            if members[u] >> i & 1:
                h, change = sensors.axes[i], 0.0
                for a in range(3):
                    change += h[a] * (core.now.rate[a] - core.unit_rate[u, a])
                fresh = fresh or core.health.run_stamp[i] == core.now.evidence.stamp
                moved = (
                    moved
                    or abs(change) > sensors.noise_std[i] + STEPS * core.health.step[i]
                )
        if fresh:
            for a in range(3):
                core.unit_rate[u, a] = core.now.rate[a]
        elif moved:
            found |= members[u]
    return found


@compiled
def is_at_rest(settings: PathSettings, now: Current) -> bool:
    """Whether the channels in use show a vehicle at rest."""
    least = RESTS * settings.largest_noise + AT_REST
    return square(now.rate) < least * least


@compiled
def all_repeat(
    settings: PathSettings, health: Health, now: Current, stamp: int
) -> bool:
    """Whether all channels have repeated their values, bit for bit, so long that the data source must have stalled.

    A real gyro toggles its last bits even at rest, unless they are coarse. All gyros at
    once do not stand still.
    """
    step, noise = largest_step(settings, health, now), settings.largest_noise
    # Noise of which nothing is left in steps of a link, 1 mrad/s, is less than the one expected.
    coarse = step == 0.0 or step > COARSE_STEP * noise or step > COARSE_STEP * AT_REST
    if not now.usable or (coarse and is_at_rest(settings, now)):
        return False
    fresh, least = 0, max(ALL_REPEAT, settings.stuck_time) if coarse else ALL_REPEAT
    for i in range(settings.n):
        if stamp - health.run_stamp[i] < least:
            fresh |= 1 << i
    return not now.usable & fresh
