# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Units that deliver the values of one sensor twice.

Two gyros differ by their noise. If a linear map of three channels explains the changes of
three others from sample to sample, except for rounding, these are a copy, possibly rotated,
scaled or delayed by some samples. An example is a topic that was mapped twice. A copy
agrees with its original whatever the fault, so the later one is left out, or the one that
loses more values.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from fdi_ros.compiling.compiled import MAX_CHANNELS, allocate, compiled
from fdi_ros.core.records import (
    RESTAMP_SAMPLES,
    Copies,
    DelayBuffer,
    Health,
    PathSettings,
)
from fdi_ros.model.geometry import ROUNDING
from fdi_ros.model.samples import MAX_RATE, Array

#: Time between comparisons, ns. Copies are found on the ground.
COMPARISON_PERIOD = 1_000_000_000
#: Changes compared. Fewer quantised values of two gyros at rest may agree by chance.
ROWS = 24
#: Changes compared first, which usually exclude a copy.
FIRST_CHANGES = ROWS // 3
#: Largest delay of a copy, samples.
MAX_LAG = 20
#: Comparisons that show a copy. A single one may be of values that hardly change.
HITS = 2
#: Smallest changes, as a share of the noise. Smaller changes are smooth, and motion may
#: explain them.
SMALLEST_CHANGE = 0.02
NONE, BOTH = -1, -2  #: In place of the number of a unit.


@compiled
def update_copies(
    copies: Copies,
    settings: PathSettings,
    health: Health,
    buffer: DelayBuffer,
    stamp: int,
) -> None:
    """Compare all pairs of units once in `COMPARISON_PERIOD`. ``copies.found`` is set for a new copy."""
    if stamp - copies.stamp < COMPARISON_PERIOD or buffer.count < ROWS + 3:
        return
    copies.stamp = stamp
    for a in range(settings.units):
        for b in range(a + 1, settings.units):
            if copies.original[a] or copies.original[b]:
                continue
            later = later_unit(copies, settings, buffer, a, b)
            if later == NONE:
                # Unless too few values came to tell, they have agreed by chance before.
                if is_comparable(copies, settings, buffer, a, b):
                    copies.hits[a, b] = 0
                continue
            copies.hits[a, b] += 1
            if copies.hits[a, b] < HITS:
                continue
            copy = later
            if later == BOTH:
                copy = (
                    a
                    if losses(settings, health, a) > losses(settings, health, b)
                    else b
                )
            copies.original[copy] = (a if copy == b else b) + 1
            copies.channels |= settings.members[copy]
            copies.found = True


@compiled
def losses(settings: PathSettings, health: Health, unit: int) -> float:
    """Return the share of values that a unit loses, added over its channels."""
    total = 0.0
    for i in range(settings.n):
        if settings.members[unit] >> i & 1:
            total += health.gone[i] + health.absent[i]
    return total


@compiled
def is_comparable(
    copies: Copies, settings: PathSettings, buffer: DelayBuffer, a: int, b: int
) -> bool:
    """Return whether both units gave enough values together for a comparison."""
    first = first_of_three(settings.members[a])
    second = first_of_three(settings.members[b])
    return (
        first >= 0
        and second >= 0
        and sum_changes(copies, buffer, first, second, 0, ROWS)
    )


@compiled
def later_unit(
    copies: Copies, settings: PathSettings, buffer: DelayBuffer, a: int, b: int
) -> int:
    """Return which of two units delivers earlier values of the other.

    `BOTH` means that they deliver the same values in the same samples, and `NONE` that
    they are different sensors.
    """
    first = first_of_three(settings.members[a])
    second = first_of_three(settings.members[b])
    if first < 0 or second < 0:
        return NONE
    for lag in range(min(MAX_LAG, min(buffer.count, RESTAMP_SAMPLES) - ROWS - 2) + 1):
        for turned in range(2):
            source, target = (second, first) if turned else (first, second)
            agrees = True
            for wanted in (FIRST_CHANGES, ROWS):
                agrees = agrees and sum_changes(
                    copies, buffer, source, target, lag, wanted
                )
                agrees = agrees and is_explained(copies, settings, target, wanted)
            if agrees:
                if lag == 0:
                    return BOTH
                return a if turned else b
    return NONE


@compiled
def first_of_three(members: int) -> int:
    """Return the first of three successive channels, or -1 for other sets."""
    for i in range(MAX_CHANNELS):
        if members == 7 << i:
            return i
    return -1


@compiled
def sum_changes(
    copies: Copies, buffer: DelayBuffer, source: int, target: int, lag: int, wanted: int
) -> bool:
    """Sum the products of the changes of two units to ``copies.products``.

    Parameters
    ----------
    source, target
        First channel of the possible original, and of the possible copy.
    lag
        Delay of the copy, samples.
    wanted
        Number of changes, beginning with the newest.

    Returns
    -------
    bool
        Whether that many changes are within twice as many samples.
    """
    change = copies.change
    products = copies.products
    count = 0
    for i in range(6):
        for j in range(6):
            products[i, j] = 0.0
    newest = buffer.count - 1
    oldest = max(buffer.count - RESTAMP_SAMPLES, 0)
    for k in range(newest, max(newest - 2 * wanted, oldest + lag + 1), -1):
        if not (
            fill_change(buffer, source, k - lag, change, 0)
            and fill_change(buffer, target, k, change, 3)
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
def fill_change(
    buffer: DelayBuffer, first: int, k: int, out: Array, place: int
) -> bool:
    """Write second differences of three channels up to sample k to ``out``.

    Return whether all values are finite and in range.
    """
    new = buffer.rows[k % RESTAMP_SAMPLES]
    middle = buffer.rows[(k - 1) % RESTAMP_SAMPLES]
    old = buffer.rows[(k - 2) % RESTAMP_SAMPLES]
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
    """Return whether a linear map of one unit's changes explains those of the other.

    The changes must also be noise. Elimination of the channels of the first unit leaves
    the unexplained part of the second.
    """
    products = copies.products
    noise = 0.0
    size = 0.0
    trace = 0.0
    for i in range(3):
        copies.change[i] = products[3 + i, 3 + i]
        size += products[3 + i, 3 + i]
        trace += products[i, i]
        noise += settings.sensors.noise_std[target + i] ** 2
    for p in range(3):
        pivot = products[p, p]
        # A channel without a remainder adds no explanation to the others.
        if pivot > 1e-12 * trace:
            for i in range(p + 1, 6):
                share = products[i, p] / pivot
                for j in range(p + 1, 6):
                    products[i, j] -= share * products[p, j]
    for i in range(3):
        if products[3 + i, 3 + i] > ROUNDING * copies.change[i]:
            return False
    return size > count * 6.0 * SMALLEST_CHANGE**2 * noise


def copies_among(series: Sequence[Array]) -> list[tuple[int, int]]:
    """Return pairs of series of which one is a copy of the other.

    Each series has shape (N, 3), in rad/s, and all have the same sample rate.
    """
    found = []
    buffer = allocate(DelayBuffer)
    copies = allocate(Copies)
    settings = allocate(PathSettings)
    settings["members"][0, :2] = 0b111, 0b111000
    rows = buffer["rows"][0]
    # A hostile recording has thousands of topics with few messages each.
    enough = [k for k, values in enumerate(series) if len(values) >= ROWS + 3]
    for a, b in itertools.combinations(enough, 2):
        size = min(len(series[a]), len(series[b]), RESTAMP_SAMPLES)
        values = np.hstack([series[a][-size:], series[b][-size:]])
        rows["values"][:size, :6] = values
        is_plain = np.abs(values) < MAX_RATE
        rows["plain"][:size] = is_plain @ (1 << np.arange(6))
        hits = 0
        for count in (size, size * 3 // 4, size // 2):
            buffer["count"] = max(count, ROWS + 3)
            hits += later_unit(copies[0], settings[0], buffer[0], 0, 1) != NONE
        if hits >= HITS:
            found.append((a, b))
    return found
