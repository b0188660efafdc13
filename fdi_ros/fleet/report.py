# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The page of a fleet: what to look at first, then units, distributions, injected faults, and every flight."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from fdi_ros.fleet.audit import FAULT_HEAD, fault_rows
from fdi_ros.fleet.lines import ChannelLine, Row, UnitLine, bias_of, channel_lines, good, unit_lines, unit_of
from fdi_ros.fleet.looks import Look, replay_command, to_look_at
from fdi_ros.fleet.summary import Totals, totals
from fdi_ros.report.page import PALETTE, Section, html_pairs, html_table, page

MOST_PLOTS = 12
"""Flights to look at that have a plot."""
MOST_DRIFTS = 5
"""Drifting channels that are named at the top."""
MOST_ROWS = 2000
"""Flights in the table of all; the dataset has the rest."""
LOOK_HEAD = ("flight", "why", "vehicle", "duration", "to see it")
UNIT_HEAD = (
    "vehicle",
    "unit",
    "flights",
    "noise at rest",
    "in motion",
    "vibration",
    "largest bias",
    "its change between flights",
    "stamps late by",
    "suspected",
    "declared",
)
CHANNEL_HEAD = (
    "vehicle",
    "channel",
    "flights",
    "noise at rest",
    "in motion",
    "bias",
    "its change between flights",
    "steady drift",
    "suspected",
    "declared",
)
FLIGHT_HEAD = ("flight", "vehicle", "duration", "rate", "gaps", "judged", "declared", "sets", "statistic", "error")


def fleet_page(flights: Sequence[Row], events: Sequence[Row], faults: Sequence[Row], about: Mapping[str, str]) -> str:
    """Lay out everything."""
    lines = unit_lines(flights, events)
    channels = channel_lines(flights, events)
    looks = to_look_at(flights, channels)
    sections = [
        _looks(looks),
        *_courses([look for look in looks if not look.row["error"]][:MOST_PLOTS], events),
        _units(lines),
        _channels(channels),
        *_distributions(flights),
        *([_faults(faults)] if faults else []),
        _flights(flights, looks),
        Section("What was run", "", html_pairs(about.items())),
    ]
    return page("fdi_ros: fleet", summary_lines(totals(flights), looks, channels, faults), sections)


def summary_lines(
    all_of_it: Totals, looks: Sequence[Look], channels: Sequence[ChannelLine], faults: Sequence[Row]
) -> list[str]:
    """Sentences that say it all."""
    failed = f", {all_of_it.failed} of them could not be judged" if all_of_it.failed else ""
    vehicles = f"{all_of_it.vehicles} vehicle{'s' * (all_of_it.vehicles != 1)}"
    lines = [
        f"{_flights_of(all_of_it.flights)} of {vehicles}, {all_of_it.hours:.2f} hours judged{failed}.",
        f"Something was declared in {all_of_it.declaring} of them: {all_of_it.declarations}."
        " Where all gyros were sound these are the false declarations; a set and then its name are one."
        if all_of_it.hours > 0
        else "Nothing was judged.",
        f"{len(looks)} should be looked at." if looks else "No flight needs to be looked at.",
    ]
    drifting = [line for line in channels if math.isfinite(line.drift)]
    if drifting:
        worst = sorted(drifting, key=lambda line: -abs(line.drift))[:MOST_DRIFTS]
        words = [f"{line.channel} of {line.vehicle} by {line.drift:+.2g} rad/s" for line in worst]
        more = f", and {len(drifting) - len(worst)} more" if len(drifting) > len(worst) else ""
        lines.append(f"From flight to flight drift: {'; '.join(words)}{more}.")
    if all_of_it.unmeasured:
        lines.append(
            f"Of {_flights_of(all_of_it.unmeasured)} the mounts and axes are what fdi inspect assumes, not measured:"
            " what is declared there may be wrong (--config, --calibrate)."
        )
    if faults:
        named = sum(fault["outcome"] == "named" for fault in faults)
        wrong = sum(fault["outcome"] in ("wrong", "false set") for fault in faults)
        struck = _flights_of(len({fault["flight"] for fault in faults}))
        shares = f"{named / len(faults):.1%} named, {wrong} wrong names"
        lines.append(f"{len(faults)} faults injected, into {struck}: {shares}.")
    return lines


def _flights_of(count: int) -> str:
    return f"{count} flight{'s' * (count != 1)}"


def _looks(looks: Sequence[Look]) -> Section:
    rows = [
        (_name(look.row), "; ".join(look.why), look.row["vehicle"], _minutes(look.row), replay_command(look.row))
        for look in looks
    ]
    hint = "The most worrying first."
    return Section("What to look at", hint, html_table(LOOK_HEAD, rows, sort=True))


def _courses(looks: Sequence[Look], events: Sequence[Row]) -> list[Section]:
    """Draw the course of the statistic of each flight, with what was declared."""
    sections = []
    for look in looks:
        row = look.row
        own = [event for event in events if event["flight"] == row["flight"] and event["declares"]]
        step = row["duration"] / len(row["course"])
        values = [value if value is not None and math.isfinite(value) else None for value in row["course"]]
        trace = {
            "type": "scatter",
            "mode": "lines",
            "name": "statistic / threshold",
            "x": [round((k + 0.5) * step, 3) for k in range(len(values))],
            "y": [None if value is None else round(value, 4) for value in values],
            "line": {"color": PALETTE[0]},
        }
        marks = [{"x": event["at"], "kind": "isolated", "text": event["channel"]} for event in own]
        layout = {
            "height": 150,
            "xaxis": {"title": {"text": "s from the first sample"}},
            "yaxis": {
                "title": {"text": "share of threshold"},
                "range": [0.0, 1.06 * max([1.0, *(value for value in values if value is not None)])],
            },
            "shapes": [{"type": "line", "y0": 1.0, "line": {"dash": "dash"}}],
            "needed": [event["at"] for event in own],
            "marks": marks,
        }
        hint = f"{row['vehicle']}: {'; '.join(look.why)}."
        sections.append(Section(_name(row), hint, "", [{"data": [trace], "layout": layout}]))
    return sections


def _units(lines: Sequence[UnitLine]) -> Section:
    rows = [
        (
            line.vehicle,
            line.unit,
            str(line.flights),
            *(_figure(value) for value in (line.noise_rest, line.noise_motion, line.vibration)),
            *(_figure(value) for value in (line.bias, line.bias_spread)),
            f"{1e3 * line.late:+.1f} ms" if math.isfinite(line.late) else "-",
            str(line.suspected),
            str(line.declared),
        )
        for line in lines
    ]
    hint = (
        "rad/s; medians over the flights of a vehicle, of each flight the worst channel of the unit; stamps: + late,"
        " - early against the first unit's."
    )
    return Section("Units", hint, html_table(UNIT_HEAD, rows, sort=True))


def _channels(lines: Sequence[ChannelLine]) -> Section:
    rows = [
        (
            line.vehicle,
            line.channel,
            str(line.flights),
            *(
                _figure(value)
                for value in (line.noise_rest, line.noise_motion, line.bias, line.bias_spread, line.drift)
            ),
            str(line.suspected),
            str(line.declared),
        )
        for line in lines[:MOST_ROWS]
    ]
    more = f" The first {MOST_ROWS} of {len(lines)}." if len(lines) > MOST_ROWS else ""
    hint = (
        "rad/s; medians over the flights of a vehicle; drift: from the first flight to the last, where it is plain"
        f" (Theil and Sen's slope, Kendall's test).{more}"
    )
    return Section("Channels", hint, html_table(CHANNEL_HEAD, rows, sort=True))


def _distributions(flights: Sequence[Row]) -> list[Section]:
    """Draw noise and bias of every flight, by unit and channel."""
    judged = sorted(good(flights), key=lambda row: (row["vehicle"], row["start"]))
    if len(judged) < 2:
        return []
    numbers = list(range(1, len(judged) + 1))
    units = list(dict.fromkeys(unit_of(channel) for row in judged for channel in row["channels"]))
    sections = []
    for title, name, hint, kind in (
        ("Noise at rest", "noise_rest", "rad/s per sample; of each unit the noisiest channel.", "log"),
        ("Noise in motion", "noise_motion", "rad/s per sample, vibration included.", "log"),
        ("Bias", "bias", "rad/s; of each unit the channel with the largest.", "linear"),
    ):
        traces = [_points(k, unit, name, judged, numbers) for k, unit in enumerate(units)]
        traces = [trace for trace in traces if any(value is not None for value in trace["y"])]
        if not traces:
            continue
        axis = {"title": {"text": "flight, by vehicle and time"}, "names": [_name(row) for row in judged]}
        layout = {"height": 260, "xaxis": axis, "yaxis": {"title": {"text": "rad/s"}, "type": kind}}
        sections.append(Section(title, hint, "", [{"data": traces, "layout": layout}]))
    return sections


def _points(k: int, unit: str, name: str, judged: Sequence[Row], numbers: Sequence[int]) -> dict[str, Any]:
    values = []
    for row in judged:
        own = [
            value
            for channel, value in zip(row["channels"], bias_of(row) if name == "bias" else row[name], strict=True)
            if unit_of(channel) == unit and value is not None and math.isfinite(value)
        ]
        values.append(float(f"{max(own, key=abs):.4g}") if own else None)
    return {
        "type": "scatter",
        "mode": "markers",
        "name": unit,
        "x": list(numbers),
        "y": values,
        "line": {"color": PALETTE[k % len(PALETTE)]},
    }


def _faults(faults: Sequence[Row]) -> Section:
    hint = "The same faults in every flight; intervals of 95 % count in that faults in one flight are alike"
    hint += " (Rao and Scott 1992); wrong: a sound channel was named, or a set without the faulty one."
    return Section("Injected faults", hint, html_table(FAULT_HEAD, fault_rows(faults), sort=True))


def _flights(flights: Sequence[Row], looks: Sequence[Look]) -> Section:
    worrying = {look.row["flight"]: k for k, look in enumerate(looks)}
    ranked = sorted(flights, key=lambda row: worrying.get(row["flight"], len(looks)))
    rows = [
        (
            _name(row),
            row["vehicle"],
            _minutes(row),
            "-" if row["rate"] is None else f"{row['rate']:.1f} Hz",
            "-" if row["gaps"] is None else str(row["gaps"]),
            "-" if row["judged"] is None else f"{row['judged']:.0%}",
            "-" if row["declared"] is None else str(row["declared"]),
            "-" if row["sets"] is None else str(row["sets"]),
            "-" if row["largest"] is None else f"{row['largest']:.2f}",
            row["error"] or "-",
        )
        for row in ranked[:MOST_ROWS]
    ]
    more = f" The first {MOST_ROWS} of {len(flights)}." if len(flights) > MOST_ROWS else ""
    return Section("All flights", f"Click a head to sort.{more}", html_table(FLIGHT_HEAD, rows, sort=True))


def _name(row: Row) -> str:
    return str(row["path"]).rpartition("/")[2]


def _minutes(row: Row) -> str:
    return "-" if row["duration"] is None else f"{row['duration'] / 60:.1f} min"


def _figure(value: float) -> str:
    return f"{value:.2g}" if math.isfinite(value) else "-"
