# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Units and channels of a fleet over their flights: noise, bias and its drift, delays."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Row = Mapping[str, Any]
"""Columns of `fdi_ros.fleet.rows` by name."""

LATE = 1e-3
"""Stamps that late, s, are said where that is certain."""
FEW, UNLIKELY = 5, 0.02
"""A drift is told where so many flights show it, and chance would give one in a whole fleet with less probability."""
TO_STD = 1.4826
"""From the median deviation to the standard deviation, of a normal distribution."""
_GIVEN = "fixed"
_NOT_LEARNED = (_GIVEN, "zero", "refused", "learning")
"""How the state of biases begins that say nothing of the gyros."""


@dataclass(frozen=True)
class UnitLine:
    """One unit of one vehicle over its flights; medians over flights, of a flight the worst channel."""

    vehicle: str
    unit: str
    flights: int
    noise_rest: float
    """rad/s."""
    noise_motion: float
    vibration: float
    bias: float
    """Largest, rad/s."""
    bias_spread: float
    """Largest difference of one channel's bias between two flights, rad/s."""
    late: float
    """Certain delay of largest size, s; NaN: none is."""
    suspected: int
    declared: int
    """Times that a channel of it was declared, or was in a set that was."""


@dataclass(frozen=True)
class ChannelLine:
    """One channel of one vehicle over its flights; medians over flights."""

    vehicle: str
    channel: str
    flights: int
    noise_rest: float
    """rad/s."""
    noise_motion: float
    bias: float
    bias_spread: float
    """Largest difference of its bias between two flights, rad/s."""
    known: int
    """Flights of which the bias is known."""
    bias_mean: float
    bias_std: float
    """Mean and standard deviation of these, rad/s."""
    drift: float
    """What its bias has changed by from the first flight to the last, steadily, rad/s; NaN: it has not."""
    suspected: int
    declared: int


def in_order(flights: Sequence[Row]) -> list[Row]:
    """Sort flights by vehicle and date; one without a date follows the one before it in the order of file names."""
    keys: dict[str, tuple[str, int, int]] = {}
    last: dict[str, int] = {}
    for number, row in enumerate(sorted(flights, key=lambda row: _natural(row["path"]))):
        if row["date"]:
            last[row["vehicle"]] = row["start"]
        # Among those of one date, the dated one is the first.
        keys[row["flight"]] = row["vehicle"], last.get(row["vehicle"], -1), number if not row["date"] else -1
    return sorted(flights, key=lambda row: (keys[row["flight"]], row["path"]))


def _natural(path: str) -> list[tuple[int, str]]:
    """Key that sorts names with numbers as a person would: 9 comes before 10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"([0-9]+)", path)]


def axis_of(row: Row, channel: int) -> tuple[str, float]:
    """Axis of the body that a channel measures, x, y, z, or its name where it is turned to them, and its sign."""
    axis = row["axes"][channel]
    return (axis[-1], -1.0 if axis.startswith("-") else 1.0) if axis[-1:] in "xyz" and axis else ("turned axes", 1.0)


def good(flights: Sequence[Row]) -> list[Row]:
    """Those that could be judged."""
    return [row for row in flights if not row["error"]]


def unit_of(channel: str) -> str:
    """Name of the unit of a channel, as its name says."""
    return channel.rpartition(".")[0] or channel


def units_of(row: Row) -> dict[str, list[int]]:
    """Channels of each unit."""
    units: dict[str, list[int]] = {}
    for k, channel in enumerate(row["channels"]):
        units.setdefault(unit_of(channel), []).append(k)
    return units


def unit_lines(flights: Sequence[Row], events: Sequence[Row]) -> list[UnitLine]:
    """One line per vehicle and unit, in their order."""
    groups: dict[tuple[str, str], list[tuple[Row, list[int]]]] = {}
    for row in good(flights):
        units: dict[str, list[int]] = {}
        for k, channel in enumerate(row["channels"]):
            units.setdefault(unit_of(channel), []).append(k)
        for unit, own in units.items():
            groups.setdefault((row["vehicle"], unit), []).append((row, own))
    told: dict[tuple[str, str], list[Row]] = {}
    for event in events:
        told.setdefault((event["vehicle"], unit_of(event["channel"])), []).append(event)
    return [_unit_line(key, rows, told.get(key, ())) for key, rows in sorted(groups.items())]


def _unit_line(key: tuple[str, str], rows: Sequence[tuple[Row, list[int]]], events: Sequence[Row]) -> UnitLine:
    vehicle, unit = key
    bias = [bias_of(row)[own] for row, own in rows]
    same = len({len(one) for one in bias}) == 1
    late = [value for row, _ in rows if (value := delay_of(row, unit)) is not None]
    noise = {
        name: median([worst(row[name], own) for row, own in rows])
        for name in ("noise_rest", "noise_motion", "vibration")
    }
    return UnitLine(
        vehicle,
        unit,
        len(rows),
        noise["noise_rest"],
        noise["noise_motion"],
        noise["vibration"],
        max((worst(np.abs(one), range(len(one))) for one in bias), key=_or_zero),
        max((_spread(one) for one in np.array(bias).T), key=_or_zero) if same else math.nan,
        max(late, key=abs, default=math.nan),
        sum(event["after"] == "SUSPECT" for event in events),
        len({(event["flight"], event["stamp"]) for event in events if event["declares"]}),
    )


def bias_of(row: Row) -> NDArray[np.float64]:
    """Biases (n,) of a flight, rad/s: as learned or followed, else the mean at the quietest, else as given; or NaN."""
    bias, mean = (np.array(row[name], dtype=np.float64) for name in ("bias", "mean_rest"))
    if row["bias_state"].startswith(_NOT_LEARNED):
        given = bias if row["bias_state"].startswith(_GIVEN) else np.full(len(bias), np.nan)
        return np.where(np.isfinite(mean), mean, given)
    return np.where(np.isfinite(bias), bias, mean)


def beside(row: Row, own: Sequence[int], name: str) -> float:
    """Noise of a unit as a share of that of the other units, which fly through the same vibration."""
    others = [value for k, value in enumerate(row[name]) if k not in own and value]
    return worst(row[name], own) / float(np.median(others)) if others else math.nan


def channel_lines(flights: Sequence[Row], events: Sequence[Row]) -> list[ChannelLine]:
    """One line per vehicle and channel, in their order."""
    groups: dict[tuple[str, str], list[tuple[Row, int]]] = {}
    for row in in_order(good(flights)):
        for k, channel in enumerate(row["channels"]):
            groups.setdefault((row["vehicle"], channel), []).append((row, k))
    told: dict[tuple[str, str], list[Row]] = {}
    for event in events:
        told.setdefault((event["vehicle"], event["channel"]), []).append(event)
    # So often over all channels, not for each of them.
    unlikely = UNLIKELY / max(len(groups), 1)
    return [_channel_line(key, rows, told.get(key, ()), unlikely) for key, rows in sorted(groups.items())]


def _channel_line(
    key: tuple[str, str], rows: Sequence[tuple[Row, int]], events: Sequence[Row], unlikely: float
) -> ChannelLine:
    bias = np.array([bias_of(row)[k] for row, k in rows])
    bias = bias[np.isfinite(bias)]
    middle, noise = median(bias.tolist()), median([worst(row["noise_rest"], [k]) for row, k in rows])
    return ChannelLine(
        *key,
        len(rows),
        noise,
        median([worst(row["noise_motion"], [k]) for row, k in rows]),
        middle,
        _spread(bias),
        len(bias),
        float(bias.mean()) if len(bias) else math.nan,
        float(bias.std()) if len(bias) else math.nan,
        _drift(bias, noise, unlikely),
        sum(event["after"] == "SUSPECT" for event in events),
        sum(event["declares"] for event in events),
    )


def _drift(bias: NDArray[np.float64], noise: float, unlikely: float) -> float:
    """Steady change of a bias (k,) from the first of k flights to the last; NaN: there is none that is plain.

    Theil and Sen's slope, where Kendall's test says that there is one, and it is more than the noise of a sample and
    three times what the flights scatter by.
    """
    if len(bias) < FEW:
        return math.nan
    from scipy.stats import kendalltau, theilslopes

    number = np.arange(len(bias))
    if not kendalltau(number, bias).pvalue < unlikely:
        return math.nan
    slope, intercept, _, _ = theilslopes(bias, number)
    change = float(slope) * (len(bias) - 1)
    scatter = TO_STD * float(np.median(np.abs(bias - intercept - slope * number)))
    return change if abs(change) > max(3 * scatter, _or_zero(noise)) else math.nan


def delay_of(row: Row, unit: str) -> float | None:
    """Delay of the stamps of a unit in a flight, s; None: there is none for certain."""
    if unit not in row["units"] or not row["delay"]:
        return None
    k = row["units"].index(unit)
    value, std = row["delay"][k], row["delay_std"][k]
    return value if value is not None and abs(value) > max(LATE, 4 * (std or math.inf)) else None


def worst(values: Sequence[float] | Any, own: Sequence[int] | range) -> float:
    """Return the largest of some of the values, as far as they are known; NaN: none is."""
    known = [values[k] for k in own if values[k] is not None and math.isfinite(values[k])]
    return max(known, default=math.nan)


def median(values: Sequence[float]) -> float:
    """Return the median of the values that are known; NaN: none is."""
    known = [value for value in values if math.isfinite(value)]
    return float(np.median(known)) if known else math.nan


def _spread(values: NDArray[np.float64]) -> float:
    known = values[np.isfinite(values)]
    return float(np.ptp(known)) if len(known) else math.nan


def _or_zero(value: float) -> float:
    return value if math.isfinite(value) else 0.0
