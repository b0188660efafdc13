# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Plots of a fleet: one flight over its time, and the flights of a vehicle over their dates."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from datetime import datetime
from typing import Any

import numpy as np

from fdi_ros.fleet.findings import Fleet, Row, bias_of, unit_of
from fdi_ros.fleet.watch import PARTS
from fdi_ros.model.samples import Array
from fdi_ros.report.layout import PALETTE, Figure, Section, drawn
from fdi_ros.setup.blocks import MEDIAN_TO_RMS

MOST_VEHICLES = 8
"""Vehicles that have plots over their flights."""
BAND = 0.95
"""Share of the flights that are expected in a band."""
FEW = 3
"""Flights by which a band can be told."""
LEFT = 1e-3
"""Room beside the first and the last flight, as a share of the time between them, at least a day."""
_DAY = 86_400_000.0
"""ms."""
Series = list[float | None]
"""A value at each flight, where there is one."""


def course_figures(row: Row, episodes: Sequence[Row]) -> list[Figure]:
    """Draw the statistic of a flight, and of each axis the differences between the units, with what was declared."""
    length = len(row["course"])
    times = [round((k + 0.5) * row["duration"] / length, 3) for k in range(length)]
    shapes = [{"type": "rect", "kind": "fault", "x0": one["start"], "x1": one["end"]} for one in episodes]
    silent = [{"x": one["start"], "kind": "declared", "text": one["words"]} for one in episodes]
    marks = [{**mark, "label": f"{one['who']} {one['state']}"} for mark, one in zip(silent, episodes, strict=True)]
    link = f"flight {row['flight']}"
    values = [drawn(value) for value in row["course"]]
    largest = max([1.0, *(value for value in values if value is not None)])
    figures: list[Figure] = [
        {
            "data": [_line("statistic", times, values, 0, legend=False)],
            "layout": {
                "height": 150,
                "link": link,
                "xaxis": {"hidden": True},
                "yaxis": {"title": {"text": "statistic, as a share of its threshold"}, "range": [0.0, 1.06 * largest]},
                "shapes": [*shapes, {"type": "line", "y0": 1.0, "line": {"dash": "dash"}}],
                "needed": [one["start"] for one in episodes],
                "marks": marks,
            },
        }
    ]
    for axis, channels in _axes(row, row["difference"], differences=True).items():
        data = [
            _line(
                unit_of(row["channels"][k]),
                times,
                [
                    drawn(None if value is None else sign * value)
                    for value in row["difference_course"][k * PARTS : (k + 1) * PARTS]
                ],
                _unit_number(row, k),
            )
            for k, sign in channels
        ]
        layout = {
            "height": 110,
            "link": link,
            "scale": link,
            "xaxis": {"hidden": True},
            "yaxis": {"title": {"text": f"{axis}, to the other units, rad/s"}},
            "shapes": shapes,
            "marks": silent,
        }
        figures.append({"data": data, "layout": layout})
    figures[-1]["layout"]["xaxis"] = {"title": {"text": "s from the first sample"}}
    figures[-1]["layout"]["height"] += 30
    return figures


def over_flights(fleet: Fleet) -> list[Section]:
    """Draw the flights of each vehicle over their dates: biases, differences between units, noise.

    Vehicles with flights to look at come first, then those with most flights, as far as there is room.
    """
    of_vehicle: dict[str, list[Row]] = {}
    for row in fleet.judged:
        of_vehicle.setdefault(row["vehicle"], []).append(row)
    several = {vehicle: rows for vehicle, rows in of_vehicle.items() if len(rows) > 1}
    first = [look.row["vehicle"] for look in fleet.looks if look.row["vehicle"] in several]
    shown = list(dict.fromkeys([*first, *sorted(several, key=lambda one: -len(several[one]))]))[:MOST_VEHICLES]
    drifts = {(one.vehicle, one.name) for one in fleet.channels if math.isfinite(one.drift)}
    sections = [
        _vehicle(several[vehicle], fleet.names[vehicle], [name for own, name in drifts if own == vehicle])
        for vehicle in shown
    ]
    if len(several) > len(shown):
        left = f"{len(several) - len(shown)} more vehicles have no plots here; the tables have them."
        sections.append(Section("Further vehicles", left))
    return sections


def _vehicle(rows: Sequence[Row], name: str, drifting: Collection[str]) -> Section:
    dated = all(row["date"] for row in rows)
    if dated:
        x = [datetime.fromisoformat(row["date"].replace("Z", "+00:00")).timestamp() * 1000.0 for row in rows]
        room = max(LEFT * (x[-1] - x[0]), _DAY)
        axis: dict[str, Any] = {"type": "date", "title": {"text": "date, UTC"}, "range": [x[0] - room, x[-1] + room]}
    else:
        x = [float(k + 1) for k in range(len(rows))]
        axis = {
            "title": {"text": "flight, in the order of file names"},
            "names": [str(row["path"]).rpartition("/")[2] for row in rows],
            "range": [0.5, len(rows) + 0.5],
        }
    layout = {"height": 210, "link": f"vehicle {rows[0]['vehicle']}"}
    figures = _by_axis(rows, x, "bias, rad/s", [bias_of(row) for row in rows], None, drifting)
    difference, spread = (
        [np.array(row[name], dtype=float) for row in rows] for name in ("difference", "difference_std")
    )
    figures += _by_axis(rows, x, "difference to the other units, rad/s", difference, spread)
    for kind, title in (("noise_rest", "noise at rest"), ("noise_motion", "noise in motion, vibration included")):
        figure = _noise(rows, x, kind, f"{title}, rad/s per sample")
        figures += [figure] if figure["data"] else []
    for k, figure in enumerate(figures):
        last = k == len(figures) - 1
        figure["layout"] = {**layout, **figure["layout"], "xaxis": axis if last else {**axis, "hidden": True}}
        figure["layout"]["height"] += 30 * last
    without = "" if dated else " Not all flights have a date: they stand in the order of their file names."
    hint = (
        f"{len(rows)} flights. Bias of each channel, with the band that {BAND:.0%} of flights are expected in (median"
        f" and median deviation, about a line where it drifts, from {FEW} flights on); mean difference to what other"
        " units say of the axis, with its standard deviation within the flight; noise of each unit's noisiest channel."
        f"{without}"
    )
    return Section(f"{name} over its flights", hint, "", figures)


def _by_axis(
    rows: Sequence[Row],
    x: Sequence[float],
    title: str,
    values: Sequence[Array],
    spreads: Sequence[Array] | None,
    drifting: Collection[str] = (),
) -> list[Figure]:
    """Draw a value of every channel, one plot for the channels of each axis of the body.

    Parameters
    ----------
    rows, x
        Flights, and where each stands.
    title
        What is drawn.
    values
        (n,) of each flight.
    spreads
        Their standard deviations (n,), which are drawn; None: the band that the values are expected in is.
    drifting
        Channels that are expected to go on drifting.
    """
    series: dict[str, dict[str, tuple[int, Series, Series]]] = {}
    for k, row in enumerate(rows):
        for axis, channels in _axes(row, values[k], differences=spreads is not None).items():
            for i, sign in channels:
                new: tuple[int, Series, Series] = _unit_number(row, i), [None] * len(rows), [None] * len(rows)
                own = series.setdefault(axis, {}).setdefault(row["channels"][i], new)
                own[1][k] = drawn((1.0 if spreads is None else sign) * values[k][i])
                own[2][k] = None if spreads is None else drawn(spreads[k][i])
    figures = []
    for axis, of_axis in sorted(series.items()):
        data: list[dict[str, Any]] = []
        for channel, (number, at, around) in of_axis.items():
            look = _look(unit_of(channel), number)
            limits = (
                _band(at, channel in drifting)
                if spreads is None
                else [
                    (None, None) if value is None or std is None else (drawn(value - std), drawn(value + std))
                    for value, std in zip(at, around, strict=True)
                ]
            )
            low, high = zip(*limits, strict=True)
            if any(value is not None for value in low):
                data.append({"type": "band", "x": list(x), "low": low, "high": high, **look, "showlegend": False})
            data.append({"type": "scatter", "mode": "markers", "x": list(x), "y": at, **look})
        figures.append({"data": data, "layout": {"yaxis": {"title": {"text": f"{axis} axis: {title}"}}}})
    return figures


def _noise(rows: Sequence[Row], x: Sequence[float], name: str, title: str) -> Figure:
    """Draw the noise of the noisiest channel of every unit."""
    series: dict[str, tuple[int, list[float | None]]] = {}
    for k, row in enumerate(rows):
        for i, channel in enumerate(row["channels"]):
            values = series.setdefault(unit_of(channel), (_unit_number(row, i), [None] * len(rows)))[1]
            value = row[name][i]
            if value is not None and math.isfinite(value) and value > (values[k] or 0.0):
                values[k] = drawn(value)
    data = [
        {"type": "scatter", "mode": "markers", "x": list(x), "y": values, **_look(unit, number)}
        for unit, (number, values) in series.items()
        if any(value is not None for value in values)
    ]
    return {"data": data, "layout": {"yaxis": {"title": {"text": title}, "rangemode": "tozero"}}}


def _axis_of(row: Row, channel: int) -> tuple[str, float]:
    """Axis of the body that a channel measures, x, y, z, or its name where it is turned to them, and its sign."""
    axis = row["axes"][channel]
    return (axis[-1], -1.0 if axis.startswith("-") else 1.0) if axis[-1:] in "xyz" and axis else ("turned axes", 1.0)


def _axes(row: Row, values: Sequence[float | None] | Any, differences: bool) -> dict[str, list[tuple[int, float]]]:
    """Channels with a value, and their signs, by the axis of the body that they measure."""
    found: dict[str, list[tuple[int, float]]] = {}
    units = {unit_of(channel) for channel in row["channels"]}
    for k in range(len(row["channels"])):
        if (value := values[k]) is not None and math.isfinite(value):
            axis, sign = _axis_of(row, k)
            found.setdefault(axis, []).append((k, sign))
    if differences and len(units) == 2:
        # Of two units the one differs by what the other does, with the other sign.
        found = {axis: [one for one in own if _unit_number(row, one[0])] or own for axis, own in found.items()}
    return dict(sorted(found.items()))


def _unit_number(row: Row, channel: int) -> int:
    """Place of the unit of a channel, which has a colour."""
    units = list(dict.fromkeys(map(unit_of, row["channels"])))
    return units.index(unit_of(row["channels"][channel]))


def _band(values: Sequence[float | None], drifts: bool) -> list[tuple[float | None, float | None]]:
    """Band that a flight is expected in, at every flight; about a line where the values drift."""
    from scipy.stats import t as student
    from scipy.stats import theilslopes

    at = np.array([k for k, value in enumerate(values) if value is not None])
    known = np.array([value for value in values if value is not None])
    if len(known) < FEW:
        return [(None, None)] * len(values)
    slope, start = theilslopes(known, at)[:2] if drifts else (0.0, float(np.median(known)))
    spread = MEDIAN_TO_RMS * float(np.median(np.abs(known - start - slope * at)))
    half = float(student.isf((1.0 - BAND) / 2, len(known) - 1)) * spread * math.sqrt(1.0 + 1.0 / len(known))
    middle = start + slope * np.arange(len(values))
    return [(drawn(one - half), drawn(one + half)) for one in middle.tolist()]


def _line(name: str, x: Sequence[float], y: Sequence[float | None], number: int, legend: bool = True) -> dict[str, Any]:
    return {"type": "scatter", "mode": "lines", "x": list(x), "y": y, "showlegend": legend, **_look(name, number)}


def _look(unit: str, number: int) -> dict[str, Any]:
    return {"name": unit, "legendgroup": unit, "line": {"color": PALETTE[number % len(PALETTE)]}}
