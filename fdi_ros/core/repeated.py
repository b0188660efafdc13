# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Values that repeat while others move.

A repeated value alone is no defect: a quantised sensor at rest repeats for minutes. It is
a defect after a much longer time, or if the others measure motion along this channel's
axis: then the channel is stuck, or the values of a whole unit are old.

A fault at rest looks like motion to every quiet channel beside it. The others are
therefore evidence of motion only if they agree. The same channels must have seen its
begin and its end, and their disagreement must be small beside the motion. The noise of a fine
sensor never repeats. A channel that repeats values by habit is stuck only if no single
one of the others can be the cause: without each other one, the rest must have measured the
motion too. An alarm that does not isolate the channel that repeats forbids the
conclusion too.
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

#: Motion of the others, beyond one step, that shows a stuck value, standard deviations.
LEAST_MOTION = 6.0
AGREED = 0.5
"""Largest disagreement of the others (root sum of squares) as a share of their motion. A
fault of one of three parallel channels moves their mean by a third of itself and leaves 0.8
of itself as disagreement. Real motion leaves only noise."""
#: Motion, in steps, up to which a quantised sensor repeats its value by chance.
REPEATED_STEPS = 3.0
RESTS, AT_REST = 3.0, 1e-3
"""At rest the rate is at most three standard deviations of a channel plus one step of
MAVLink, rad/s."""
#: A larger step is coarse, standard deviations. Noise crosses smaller steps with nearly
#: every sample.
COARSE_STEP = 0.5
#: Usual length of a run of equal values from which the noise is smaller than the steps.
USUAL_RUN = 1.2
ALL_REPEAT = 100_000_000
"""Time for which all channels may repeat their values, ns: links may delay messages. In
coarse steps ``stuck_time``, if longer: gyros without noise repeat in a steady turn."""


@compiled
def largest_step(settings: PathSettings, health: Health, now: Current) -> float:
    """Return the largest known step of the quantised channels, rad/s."""
    step = 0.0
    for i in range(settings.n):
        if now.usable >> i & 1:
            step = max(step, health.step[i])
    return step


@compiled
def fill_disagreement(
    settings: PathSettings, now: Current, subset: Subset, mask: int
) -> None:
    """Write for each channel the sum of squared residuals of the others in the mask."""
    axes = settings.sensors.axes
    rate = now.others_rate
    total = 0.0
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
def is_confirmed(
    core: Core, subsets: NDArray[Any], others: int, i: int, least: float
) -> bool:
    """Return whether the others have measured motion along channel i, whichever channel is left out.

    Each must have measured more than ``least``, rad/s, as ``now.moved`` shows.
    """
    now = core.now
    axes = core.settings.sensors.axes
    n = core.settings.n
    for j in range(n):
        if others >> j & 1 and abs(along(axes[i], axes[j])) > MIN_SENSITIVITY:
            rest = others & ~(1 << j)
            fill_rate(subsets[rest], n, rest, now.moved, now.others_rate)
            # Without a rate the comparison is false.
            if not abs(along(axes[i], now.others_rate)) > least:
                return False
    return True


@compiled
def has_moved(
    core: Core, subsets: NDArray[Any], others: int, i: int, least: float, step: float
) -> bool:
    """Return whether the others have measured motion along channel i while it repeats.

    ``least`` is the motion beyond one step that noise does not show, rad/s.
    """
    now = core.now
    noise = core.settings.sensors.noise_std[i]
    n = core.settings.n
    for k in range(n):
        now.moved[k] = now.input[k] - core.reference_input[i, k]
    fill_rate(subsets[others], n, others, now.moved, now.others_rate)
    change = abs(along(core.settings.sensors.axes[i], now.others_rate))
    # Without a rate the comparison is false.
    if not (change > least + step and now.disagreement[i] < (AGREED * change) ** 2):
        return False
    by_habit = core.health.run_length[i] > USUAL_RUN or step > COARSE_STEP * noise
    return not by_habit or is_confirmed(core, subsets, others, i, least + step)


@compiled
def without_old_units(core: Core, subsets: NDArray[Any], mask: int) -> int:
    """Return the channels of a mask without those of units whose values are certainly old.

    Old values disagree with the others as soon as the vehicle moves, which would hide
    the motion. They stay where the rest could not disagree without them: a fault of the
    only other unit looks like motion.
    """
    old = without_coarse_steps(core.settings, core.health, core.now.repeated)
    rest = mask & ~old
    checks_itself = rest & ~subsets[rest].detectable == 0
    return rest if rest and checks_itself else mask


@compiled
def update_stuck(core: Core, subsets: NDArray[Any], mask: int, stamp: int) -> int:
    """Return the mask of stuck channels.

    ``mask`` has the usable channels without an alarm of their own, which measure motion.
    """
    n = core.settings.n
    now = core.now
    stuck = 0
    mask = without_old_units(core, subsets, mask)
    subset = subsets[mask]
    if now.evidence.repeats & now.usable:
        fill_disagreement(core.settings, now, subset, mask)
    step = largest_step(core.settings, core.health, now)
    for i in range(n):
        others = mask & ~(1 << i)
        # A channel that comes gives no motion since before. One that misses single
        # samples changes nothing.
        is_new = core.health.run_stamp[i] == stamp
        if is_new or others & ~core.witnesses[i]:
            core.witnesses[i] = others
            for j in range(n):
                # Uncorrected values: a change of the estimated errors is not motion.
                core.reference_input[i, j] = now.input[j]
        elif now.evidence.repeats & now.usable & (1 << i):
            isolated = now.verdict.suspects[i] and now.verdict.isolated
            if now.verdict.alarm and not isolated:
                continue
            share = subsets[mask | 1 << i].sensitivity[i]
            noise = core.settings.sensors.noise_std[i]
            spread = math.sqrt(
                (noise * noise + step * step / 12.0) / (share if share > 0 else 0.5)
            )
            if has_moved(core, subsets, others, i, LEAST_MOTION * spread, step):
                stuck |= 1 << i
                core.health.stuck[i] += 1
    return stuck


@compiled
def add_stuck(settings: PathSettings, now: Current, evidence: int) -> None:
    """Add stuck channels to the suspects of the verdict. Statistic and alarm stay unchanged."""
    verdict = now.verdict
    for i in range(settings.n):
        if evidence >> i & 1:
            verdict.suspects[i] = True
            if verdict.error[i] == 0:
                verdict.error[i] = now.corrected[i] - now.along[i]


@compiled
def update_repeated(core: Core) -> int:
    """Return the channels of units that repeat all their values while the others move.

    Where every channel of a unit repeats values by habit, all may do so at once.
    """
    members = core.settings.members
    sensors = core.settings.sensors
    found = 0
    for u in range(core.settings.units):
        # A unit with a missing or out-of-range channel does not count as repeating. A
        # unit with a declared channel may.
        fresh = members[u] & ~core.now.plain != 0
        moved = False
        by_habit = True
        for i in range(core.settings.n):
            if members[u] >> i & 1:
                by_habit = by_habit and core.health.run_length[i] > USUAL_RUN
                h = sensors.axes[i]
                change = 0.0
                for a in range(3):
                    change += h[a] * (core.now.rate[a] - core.unit_rate[u, a])
                fresh = fresh or core.health.run_stamp[i] == core.now.evidence.stamp
                moved = (
                    moved
                    or abs(change)
                    > sensors.noise_std[i] + REPEATED_STEPS * core.health.step[i]
                )
        if fresh:
            for a in range(3):
                core.unit_rate[u, a] = core.now.rate[a]
        elif moved and not by_habit:
            found |= members[u]
    return found


@compiled
def without_coarse_steps(settings: PathSettings, health: Health, found: int) -> int:
    """Return those of the units found to repeat whose values are certainly old.

    At rest values in coarse steps may all repeat while a fault of another unit looks like
    motion.
    """
    old = found
    for u in range(settings.units):
        for i in range(settings.n):
            step = health.step[i]
            noise = settings.sensors.noise_std[i]
            is_coarse = step == 0.0 or step > COARSE_STEP * noise
            if is_coarse and settings.members[u] >> i & 1:
                old &= ~settings.members[u]
    return old


@compiled
def is_at_rest(settings: PathSettings, now: Current) -> bool:
    """Return whether the channels in use show a vehicle at rest."""
    least = RESTS * settings.largest_noise + AT_REST
    return square(now.rate) < least * least


@compiled
def all_repeat(
    settings: PathSettings, health: Health, now: Current, stamp: int
) -> bool:
    """Return whether all channels repeat exactly for so long that the source has stalled.

    The last bits of a real gyro change even at rest, unless the steps are coarse. Not all
    gyros repeat at once.
    """
    step = largest_step(settings, health, now)
    noise = settings.largest_noise
    # A link with steps of 1 mrad/s may hide noise that is less than expected.
    coarse = step == 0.0 or step > COARSE_STEP * noise or step > COARSE_STEP * AT_REST
    if not now.usable or (coarse and is_at_rest(settings, now)):
        return False
    fresh = 0
    least = max(ALL_REPEAT, settings.stuck_time) if coarse else ALL_REPEAT
    for i in range(settings.n):
        if stamp - health.run_stamp[i] < least:
            fresh |= 1 << i
    return not now.usable & fresh
