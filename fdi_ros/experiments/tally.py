"""Counts of trials: added up the same whoever counted which block, and their confidence intervals."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

Z95 = 1.959963984540054
"""Normal quantile of a two-sided 95 % interval."""

Tally = dict[str, Any]
"""Whole numbers, sums, lists of them, and tallies; whatever JSON can hold. Lists named ``largest`` are pooled."""


def merged(parts: Sequence[Mapping[str, Any]]) -> Tally:
    """Sum of the tallies of consecutive blocks, added in their order."""
    total: Tally = {}
    for part in parts:
        for name, value in part.items():
            total[name] = _added(name, total.get(name), value)
    return total


def _added(name: str, old: Any, new: Any) -> Any:
    if isinstance(new, Mapping):
        return merged([old or {}, new])
    if old is None:
        return list(new) if isinstance(new, list) else new
    if isinstance(new, list):
        return old + new if name == "largest" else [_added(name, a, b) for a, b in zip(old, new, strict=True)]
    return old + new


def settled(value: float) -> float:
    """Value to nine digits: what linear algebra of other sizes of machines leaves the same."""
    return float(f"{value:.9g}")


def share(count: int, trials: int) -> dict[str, float]:
    """Share of trials with its 95 % interval (Wilson 1927)."""
    if trials == 0:
        return {"value": math.nan, "low": 0.0, "high": 1.0}
    p = count / trials
    spread = Z95**2 / trials
    centre = (p + spread / 2) / (1 + spread)
    half = Z95 / (1 + spread) * math.sqrt(p * (1 - p) / trials + spread / (4 * trials))
    low = 0.0 if count == 0 else max(centre - half, 0.0)
    high = 1.0 if count == trials else min(centre + half, 1.0)
    return {"value": p, "low": low, "high": high}


def mean_of(total: float, squares: float, count: int) -> dict[str, float] | None:
    """Mean with its 95 % interval from a sum and a sum of squares; None of nothing."""
    if count == 0:
        return None
    mean = total / count
    error = math.sqrt(max(squares / count - mean**2, 0.0) / count)
    return {"value": mean, "low": mean - Z95 * error, "high": mean + Z95 * error}


def quantiles(histogram: Mapping[str, int], levels: Sequence[float] = (0.5, 0.9, 0.99)) -> dict[str, int | None]:
    """Quantiles of whole numbers counted as ``{number: count}``; None of nothing."""
    counts = sorted((int(value), count) for value, count in histogram.items())
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
