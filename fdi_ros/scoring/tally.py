# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Counts of trials, which add up whatever blocks they come from, and the estimates made of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

Z95 = 1.959963984540054
"""Normal quantile of a two-sided 95 % interval."""


def added(a: Any, b: Any) -> Any:
    """Sum of what two blocks of trials give: numbers, None, and lists or mappings of these, added item by item."""
    if a is None:
        return b
    if isinstance(a, Mapping):
        return {**a, **{name: added(a.get(name), value) for name, value in b.items()}}
    if isinstance(a, list):
        return [added(x, y) for x, y in zip(a, b, strict=True)]
    return a + b


@dataclass(frozen=True)
class Estimate:
    """A figure with its 95 % interval; a value of NaN: no trials."""

    value: float
    low: float
    high: float


def share(count: float, trials: float, z: float = Z95) -> Estimate:
    """Share of trials with its 95 % interval (Wilson 1927); effective numbers need not be whole; z: the quantile."""
    if trials == 0:
        return Estimate(math.nan, 0.0, 1.0)
    p = count / trials
    spread = z**2 / trials
    centre = (p + spread / 2) / (1 + spread)
    half = z / (1 + spread) * math.sqrt(p * (1 - p) / trials + spread / (4 * trials))
    low = 0.0 if count == 0 else max(centre - half, 0.0)
    high = 1.0 if count == trials else min(centre + half, 1.0)
    return Estimate(p, low, high)


def mean_of(total: float, squares: float, count: int) -> Estimate | None:
    """Mean with its 95 % interval from a sum and a sum of squares; None if there is nothing to average."""
    if count == 0:
        return None
    mean = total / count
    error = math.sqrt(max(squares / count - mean**2, 0.0) / count)
    return Estimate(mean, mean - Z95 * error, mean + Z95 * error)


def quantiles(histogram: Mapping[str, int], levels: Sequence[float] = (0.5, 0.9, 0.99)) -> dict[str, int | None]:
    """Quantiles of whole numbers counted as ``{"number": count}``; None if there are none."""
    counts = sorted((int(number), count) for number, count in histogram.items())
    total, found = sum(count for _, count in counts), {}
    for level in levels:
        reached, answer = 0, None
        for value, count in counts:
            reached += count
            if reached >= level * total:
                answer = value
                break
        found[f"p{100 * level:g}"] = answer
    return found


def settled(value: float) -> float:
    """Value to nine digits: what linear algebra gives alike on all machines."""
    return float(f"{value:.9g}")
