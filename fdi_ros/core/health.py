# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Checks beside the detector: of each value by itself, of values that repeat while others move, of units that are one.

A value that repeats is no defect by itself: a quantised sensor at rest repeats for minutes. It counts after a much
longer time, or against motion that the others see along this channel's axis: then the channel is stuck, or the values
of a whole unit are old. The others are evidence of motion only if they agree: in a sample with an alarm that does not
isolate the channel that repeats, it is not called stuck, and so neither of two parallel ones because of the other.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import MAX_CHANNELS, allocate, compiled
from fdi_ros.core.records import (
    RESTAMP_SAMPLES,
    Condition,
    Copies,
    Core,
    Current,
    DelayBuffer,
    Health,
    PathSettings,
    Sample,
    Subset,
)
from fdi_ros.core.subsets import fill_rate
from fdi_ros.model.geometry import MIN_SENSITIVITY, ROUNDING
from fdi_ros.model.samples import MAX_RATE, Array

FINE, MISSING, NON_FINITE, OUT_OF_RANGE, FROZEN, SILENT, NON_FINITE_LASTING = map(
    int, Condition
)
NOT_BAD = -(1 << 62)  # instead of the stamp at which a run of non-finite values began


@compiled
def check(settings: PathSettings, health: Health, sample: Sample) -> None:
    """Check the values of one sample; results in ``health.condition``."""
    n, stamp, received = settings.n, sample.stamp, sample.received
    if health.begun == 0:
        for i in range(n):
            health.value[i] = math.nan
            health.run_stamp[i] = health.received_stamp[i] = stamp
            health.bad_stamp[i] = NOT_BAD
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
        health.counts[condition, i] += 1
        if condition != MISSING and condition != SILENT:
            health.samples[i] += 1


@compiled
def receive(
    settings: PathSettings, health: Health, i: int, stamp: int, z: float
) -> int:
    """Remember a value that was received of channel i; return what is wrong with it by itself."""
    # Across a hole it is unknown what the value was: a run begins anew.
    step = stamp - health.received_stamp[i]
    hole = step > settings.stale_time
    health.received_stamp[i] = stamp
    follow_share(health, i, math.isfinite(z), step)
    if math.isfinite(z):
        change = abs(z - health.value[i])
        if z != health.value[i] or hole:
            health.run_stamp[i] = stamp
        if change > 0.0 and (change < health.step[i] or health.step[i] == 0.0):
            health.step[i] = change
        health.value[i], health.bad_stamp[i] = z, NOT_BAD
        return OUT_OF_RANGE if abs(z) >= settings.max_rate[i] else FINE
    if health.bad_stamp[i] == NOT_BAD or hole:
        health.bad_stamp[i] = stamp
    return (
        NON_FINITE_LASTING
        if stamp - health.bad_stamp[i] >= settings.non_finite_time
        else NON_FINITE
    )


# Values that come and go ----------------------------------------------------------------------------------------------

SHARE_TIME, SHARE_SAMPLES = 500_000_000, 50.0
"""ns and values over which the share that is not finite is averaged, the longer: 50 tell 15 % from 25 %."""
DOUBTED_SHARE = 0.15  # from which a channel is left out of the rate: drivers drop up to 10 % of single values
INTERMITTENT_SHARE = (
    0.25  # from which it is faulty: 2.5 standard deviations of the average above that
)
RETURNING = 3  # a value that is not finite, and the next two, are left out of the rate: they are no better
LEAST_LEAVES = 4.0  # times that a channel went away lately where it comes and goes: a hole or two are none of it


@compiled
def follow_share(health: Health, i: int, finite: bool, step: int) -> None:
    """Follow the share of the values of a channel that are not finite; step: since the value before, ns."""
    adaptation_gain = min(step / SHARE_TIME, 1.0 / SHARE_SAMPLES)
    health.gone[i] += adaptation_gain * ((0.0 if finite else 1.0) - health.gone[i])
    health.leaves[i] *= 1.0 - adaptation_gain
    health.returning[i] = max(health.returning[i] - 1, 0) if finite else RETURNING
    if not finite and health.bad_stamp[i] == NOT_BAD:
        health.leaves[i] += 1.0


COMPLETE_SHARE, COMPLETE_TIME = 0.02, 4 * SHARE_TIME
"""A unit that lacked so few samples, one of a whole average, for so long is no slow one, and may come to flicker."""


@compiled
def follow_presence(
    health: Health, n: int, stamp: int, received: NDArray[np.uint8]
) -> None:
    """Follow the share of samples that nothing was received for: no fault, as a link loses messages."""
    adaptation_gain = min((stamp - health.stamp) / SHARE_TIME, 1.0 / SHARE_SAMPLES)
    for i in range(n):
        if health.begun == 1:
            # Nothing is known of it.
            health.absent[i], health.complete_stamp[i] = 1.0, stamp
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


@compiled
def intermittent_channels(gone: Array, leaves: Array, n: int, share: float) -> int:
    """Bits of the channels of which at least a share comes and goes: shares gone (n,), and how often they went."""
    found = 0
    for i in range(n):
        if gone[i] >= share and leaves[i] >= LEAST_LEAVES:
            found |= 1 << i
    return found


# Values that repeat --------------------------------------------------------------------------------------------------

LEAST_MOTION = 6.0  # standard deviations, beyond one step, that the others move by while a stuck value repeats
STEPS = 3.0  # of a quantised sensor: it repeats its value by chance until the body has moved by so many
RESTS, AT_REST = 3.0, 1e-3
"""At rest the rate is within three standard deviations of a channel, and a step of MAVLink in rad/s, of zero."""
COARSE_STEP = 0.5  # standard deviations: noise takes a value over smaller steps with nearly every sample
ALL_REPEAT = 100_000_000
"""ns that all channels repeat their values before none of them is believed: what a link may hold up. In coarse steps
``stuck_time``, if that is longer: gyros without noise repeat for longer in a steady turn."""


@compiled
def leave_one_out(settings: PathSettings, now: Current, subset: Subset) -> None:
    """Predict each channel from the others of a subset, into ``now.prediction``, rad/s; NaN: they say nothing."""
    axes, rate = settings.sensors.axes, now.others_rate
    for i in range(settings.n):
        along = axes[i, 0] * rate[0] + axes[i, 1] * rate[1] + axes[i, 2] * rate[2]
        share = subset.sensitivity[i]
        if share > MIN_SENSITIVITY**2:
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
            spread = math.sqrt(
                (noise * noise + step * step / 12.0) / (share if share > 0 else 0.5)
            )
            moved = (
                abs(now.prediction[i] - core.reference[i])
                > LEAST_MOTION * spread + step
            )
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
    now, health, n = core.now, core.health, core.settings.n
    # And those that were complete, and now lack samples again and again.
    sparse = health.complete & intermittent_channels(
        health.absent, health.lapses, n, INTERMITTENT_SHARE
    )
    now.evidence.flickers = sparse | intermittent_channels(
        health.gone, health.leaves, n, DOUBTED_SHARE
    )
    for i in range(n):
        rest = now.usable & ~(now.evidence.flickers & 1 << i)
        if subsets[rest].spare:
            now.usable = rest


@compiled
def update_repeated(core: Core) -> int:
    """Channels of the units that give old values: all of theirs again, while the others have measured motion."""
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
    """Whether the rate of the channels in use is that of a vehicle at rest."""
    square = (
        now.rate[0] * now.rate[0]
        + now.rate[1] * now.rate[1]
        + now.rate[2] * now.rate[2]
    )
    least = RESTS * settings.largest_noise + AT_REST
    return square < least * least


@compiled
def all_repeat(
    settings: PathSettings, health: Health, now: Current, stamp: int
) -> bool:
    """Whether all channels have repeated their values, bit for bit, for so long that what feeds them must stand.

    A real gyro toggles its last bits even at rest, unless these are coarse; all of them at once do not stand still.
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


# Units that are one sensor --------------------------------------------------------------------------------------------
#
# Two gyros differ by their noise. Where a linear map of three channels explains to rounding what three others change
# by, from sample to sample, these are a copy, perhaps turned, scaled or some samples later: a topic that was mapped
# twice. A copy agrees with its original whatever is wrong with it, so it is left out.


PERIOD = 1_000_000_000  # from one comparison to the next, ns: a copy is found on the ground, and in no hurry
ROWS = 24  # changes that are compared; quantised values of two gyros at rest may agree by chance in fewer
FEW = ROWS // 3  # of these so many first: mostly they tell that there is no copy
MAX_LAG = 20  # samples by which a copy may come later: a second topic of one driver is not held up for longer
HITS = 2  # comparisons that make a copy: one alone may be of values that hardly change
LEAST_NOISE = 0.02  # of what the noise makes: smaller changes are smooth, and what explains them may be the motion


@compiled
def update_copies(
    copies: Copies, settings: PathSettings, line: DelayBuffer, stamp: int
) -> None:
    """Compare all pairs of units, once in `PERIOD`; ``copies.found`` is set where one is a copy and was none before."""
    if stamp - copies.stamp < PERIOD or line.count < ROWS + 3:
        return
    copies.stamp = stamp
    for a in range(settings.units):
        for b in range(a + 1, settings.units):
            if (
                copies.original[a]
                or copies.original[b]
                or not is_copy(copies, settings, line, a, b)
            ):
                continue
            copies.hits[a, b] += 1
            if copies.hits[a, b] >= HITS:
                copies.original[b] = a + 1
                copies.channels |= settings.members[b]
                copies.found = True


@compiled
def is_copy(
    copies: Copies, settings: PathSettings, line: DelayBuffer, a: int, b: int
) -> bool:
    """Whether one of two units gives what the other gives, or gave some samples ago."""
    first, second = (
        first_of_three(settings.members[a]),
        first_of_three(settings.members[b]),
    )
    if first < 0 or second < 0:
        return False
    for lag in range(min(MAX_LAG, min(line.count, RESTAMP_SAMPLES) - ROWS - 2) + 1):
        for turned in range(2):
            source, target = (second, first) if turned else (first, second)
            agrees = True
            for wanted in (FEW, ROWS):
                agrees = agrees and sum_changes(
                    copies, line, source, target, lag, wanted
                )
                agrees = agrees and is_explained(copies, settings, target, wanted)
            if agrees:
                return True
    return False


@compiled
def first_of_three(members: int) -> int:
    """Return the first of three successive channels; -1 if these are others."""
    for i in range(MAX_CHANNELS):
        if members == 7 << i:
            return i
    return -1


@compiled
def sum_changes(
    copies: Copies, line: DelayBuffer, source: int, target: int, lag: int, wanted: int
) -> bool:
    """Sum the products of what the values of two units change by, from sample to sample, in ``copies.products``.

    Of the newest samples, until so many as wanted have changed. ``source``, ``target``: first channel of the unit that
    may be the original, and of the one that may be the copy, later by ``lag`` samples. Return whether there are so
    many, in no more than twice so many samples.
    """
    change, products, count = copies.change, copies.products, 0
    for i in range(6):
        for j in range(6):
            products[i, j] = 0.0
    newest, oldest = line.count - 1, max(line.count - RESTAMP_SAMPLES, 0)
    for k in range(newest, max(newest - 2 * wanted, oldest + lag + 1), -1):
        if not (
            fill_change(line, source, k - lag, change, 0)
            and fill_change(line, target, k, change, 3)
        ):
            continue
        count += change[3] != 0.0 or change[4] != 0.0 or change[5] != 0.0
        for i in range(6):
            for j in range(6):
                products[i, j] += change[i] * change[j]
        if count == wanted:
            return True
    return False


@compiled
def fill_change(line: DelayBuffer, first: int, k: int, out: Array, place: int) -> bool:
    """Second differences of three channels up to sample k, into ``out``; return whether all are finite and in range."""
    new, middle = line.rows[k % RESTAMP_SAMPLES], line.rows[(k - 1) % RESTAMP_SAMPLES]
    old = line.rows[(k - 2) % RESTAMP_SAMPLES]
    for i in range(3):
        out[place + i] = (
            new.values[first + i]
            - 2.0 * middle.values[first + i]
            + old.values[first + i]
        )
    return new.plain & middle.plain & old.plain & 7 << first == 7 << first


@compiled
def is_explained(
    copies: Copies, settings: PathSettings, target: int, count: int
) -> bool:
    """Whether a linear map of the changes of one unit gives those of the other, ``count`` of them, and these are noise.

    The products of both are reduced by those of the first, one channel after the other: what is left is unexplained.
    """
    products, noise, size, trace = copies.products, 0.0, 0.0, 0.0
    for i in range(3):
        copies.change[i] = products[3 + i, 3 + i]
        size += products[3 + i, 3 + i]
        trace += products[i, i]
        noise += settings.sensors.noise_std[target + i] ** 2
    for p in range(3):
        pivot = products[p, p]
        # A channel of which no more is its own adds nothing to what the others explain.
        if pivot > 1e-12 * trace:
            for i in range(p + 1, 6):
                share = products[i, p] / pivot
                for j in range(p + 1, 6):
                    products[i, j] -= share * products[p, j]
    for i in range(3):
        if products[3 + i, 3 + i] > ROUNDING * copies.change[i]:
            return False
    return size > count * 6.0 * LEAST_NOISE**2 * noise


def copies_among(series: Sequence[Array]) -> list[tuple[int, int]]:
    """Find pairs of series (N, 3) of one rate, rad/s, of which one is a copy of the other: their numbers."""
    found = []
    line, copies, settings = (
        allocate(DelayBuffer),
        allocate(Copies),
        allocate(PathSettings),
    )
    settings["members"][0, :2] = 0b111, 0b111000
    rows = line["rows"][0]
    for a, b in itertools.combinations(range(len(series)), 2):
        size = min(len(series[a]), len(series[b]), RESTAMP_SAMPLES)
        if size < ROWS + 3:
            continue
        values = np.hstack([series[a][-size:], series[b][-size:]])
        rows["values"][:size, :6] = values
        rows["plain"][:size] = (np.abs(values) < MAX_RATE) @ (1 << np.arange(6))
        hits = 0
        for count in (size, size * 3 // 4, size // 2):
            line["count"] = max(count, ROWS + 3)
            hits += is_copy(copies[0], settings[0], line[0], 0, 1)
        if hits >= HITS:
            found.append((a, b))
    return found
