# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What came of injected faults, in one vocabulary for replay, sweep, fleet and studies; and counts of many trials."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np

from fdi_ros.core.decision import ChannelState
from fdi_ros.model.samples import Array, Mask
from fdi_ros.monitor.output import Output

ALONE = (ChannelState.FAULTY, ChannelState.STALE)  # states by which a channel is declared by itself


class OutcomeKind(str, Enum):
    """What came of one injected fault; the values are the words of the files that hold outcomes."""

    ISOLATED = "named"  # the faulty channel was declared by itself
    AMBIGUOUS = "in a set"  # it was one of an ambiguity group, and not declared by itself
    MISSED = "silent"  # nothing was declared
    FALSE_GROUP = "false set"  # only groups without it were declared
    FALSE_ISOLATION = "wrong"  # a healthy channel was declared by itself


def outcome_of(false_isolation: bool, isolated: bool, in_set: bool, false_group: bool) -> OutcomeKind:
    """Return what came of a fault: a healthy channel that was declared counts more than that it was found."""
    if false_isolation:
        return OutcomeKind.FALSE_ISOLATION
    if isolated:
        return OutcomeKind.ISOLATED
    if in_set:
        return OutcomeKind.AMBIGUOUS
    return OutcomeKind.FALSE_GROUP if false_group else OutcomeKind.MISSED


class Scored(NamedTuple):
    """What came of one fault, and when."""

    outcome: OutcomeKind
    isolated_after: float  # until the channel was declared by itself, s; inf: it was not
    detected_after: float  # until it was declared by itself or in a group, s; inf: it was not


def standing(output: Output) -> tuple[Mask, Mask]:
    """(N, n) whether a channel stands declared by itself, or silent; and whether it stands in an ambiguity group."""
    return np.isin(output.state, ALONE), np.asarray(output.state == ChannelState.AMBIGUOUS)


def score(alone: Mask, among: Mask, channel: int | None, since: Array, within: float = np.inf) -> Scored:
    """Say what came of a fault of a channel (None: none is faulty); ``alone`` and ``among`` (N, n) as of `standing`.

    ``since`` (N,) s from the start of the fault. It is isolated, or in a group, if it is so ``within`` so many s; a
    false isolation counts at any time.
    """
    if channel is None:
        isolated = detected = np.inf
        own = np.zeros(len(since), dtype=bool)
    else:
        own = among[:, channel]
        isolated, detected = _first(alone[:, channel], since), _first(alone[:, channel] | own, since)
    soon = since <= within
    others = alone if channel is None else np.delete(alone, channel, axis=1)
    found = isolated <= within and isolated < np.inf
    outcome = outcome_of(bool(others.any()), found, bool(own[soon].any()), bool(among[soon].any()))
    return Scored(outcome, isolated, detected)


def _first(declared: Mask, since: Array) -> float:
    return float(since[declared.argmax()]) if declared.any() else np.inf


# Counts of trials, which add up whatever blocks they come from, and the estimates made of them ------------------------


Z95 = 1.959963984540054  # normal quantile of a two-sided 95 % interval


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


def quantiles(histogram: Mapping[str, int]) -> dict[str, int | None]:
    """Median and more of whole numbers counted as ``{"number": count}``; None if there are none."""
    counts = sorted((int(number), count) for number, count in histogram.items())
    reached = list(accumulate(count for _, count in counts))
    found: dict[str, int | None] = {}
    for level in (0.5, 0.9, 0.99):
        at_least = (n for (n, _), k in zip(counts, reached, strict=True) if k >= level * reached[-1])
        found[f"p{100 * level:g}"] = next(at_least, None)
    return found


def finite(value: float) -> float | None:
    """Return a value, or None where it is not finite."""
    return value if math.isfinite(value) else None


def settled(value: float) -> float:
    """Value to nine digits: what linear algebra gives alike on all machines."""
    return float(f"{value:.9g}")
