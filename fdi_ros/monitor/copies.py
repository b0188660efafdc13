# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Units that are one sensor: their values are the same to the bit, turned, scaled or some samples later.

Two gyros differ by their noise. What a linear map of three channels explains to rounding, while it changes from sample
to sample, is a copy of these: a topic that was mapped twice, or a driver that publishes one device under two names.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from fdi_ros.core.bank import LARGEST_RATE
from fdi_ros.core.records import RESTAMP_SAMPLES
from fdi_ros.core.subsets import members
from fdi_ros.model.samples import Array

MOST_LAG = 10
"""Samples by which a copy may come later."""
LEAST_ROWS = 100
"""Samples that are compared at least."""
SCREENED_ROWS = 32
"""Of these so many first: mostly that is enough to tell that there is no copy."""
EXPLAINED = 1e-9
"""A copy leaves less than this share of the square of what changes from sample to sample."""


def find_copies(core: Any) -> list[tuple[int, int]]:
    """Find pairs of units, by their numbers, of which the second gives what the first gives, in the last samples."""
    units = [members(int(bits)) for bits in core["settings"]["members"][: core["settings"]["units"]]]
    line = core["line"]
    count = min(int(line["count"]), RESTAMP_SAMPLES)
    order = np.arange(int(line["count"]) - count, int(line["count"])) % RESTAMP_SAMPLES
    whole = [u for u, unit in enumerate(units) if len(unit) > 2]
    pairs = copies_among([line["rows"]["values"][order][:, units[u]] for u in whole])
    return [(whole[a], whole[b]) for a, b in pairs]


def copies_among(series: Sequence[Array]) -> list[tuple[int, int]]:
    """Find pairs of series (N, 3) of one rate, rad/s, of which one gives what the other gives, by their numbers.

    Of series of different lengths the last values are compared.
    """
    found = []
    for a, b in itertools.combinations(range(len(series)), 2):
        size = min(len(series[a]), len(series[b]))
        if size >= LEAST_ROWS and _is_copy(series[a][-size:], series[b][-size:]):
            found.append((a, b))
    return found


def _is_copy(first: Array, second: Array) -> bool:
    """Whether one of two series (N, 3) is the other, some samples later."""
    for lag in range(MOST_LAG + 1):
        size = len(first) - lag
        for source, target in ((first[:size], second[lag:]), (second[:size], first[lag:])):
            if _explains(source[-SCREENED_ROWS:], target[-SCREENED_ROWS:]) and _explains(source, target):
                return True
    return False


def _explains(source: Array, target: Array) -> bool:
    """Whether a linear map of one series gives the other, which is not smooth."""
    # Whatever else arrives, NaN too, is no evidence.
    there = (np.abs(source) < LARGEST_RATE).all(axis=1) & (np.abs(target) < LARGEST_RATE).all(axis=1)
    source, target = source[there], target[there]
    if len(source) < SCREENED_ROWS // 2:
        return False
    changes = np.diff(target, 2, axis=0)
    if np.count_nonzero(changes.any(axis=1)) < len(changes) // 2:
        return False
    known = np.column_stack([source, np.ones(len(source))])
    left = target - known @ np.linalg.lstsq(known, target, rcond=None)[0]
    return bool((np.square(left).mean(axis=0) < EXPLAINED * np.square(changes).mean(axis=0)).all())
