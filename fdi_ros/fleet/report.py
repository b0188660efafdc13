# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A fleet told: sentences and figures on the whole; the page: gyros under suspicion, flights, units, channels."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from fdi_ros.fleet.findings import (
    WRONG,
    Fleet,
    Line,
    Look,
    NotJudged,
    Row,
    clustered_share,
    counted,
    median,
    reasons,
)
from fdi_ros.fleet.over_time import course_figures, over_flights
from fdi_ros.replay.outcomes import OutcomeKind
from fdi_ros.report.layout import Columns, Rows, Section, first_of, head_and_rows, html_table, number, page
from fdi_ros.text import shown

MOST_PLOTS = 12
"""Flights to look at that have a plot."""
MOST_DRIFTS = 5
"""Drifting channels that are named at the top."""
MOST_ROWS = 2000
"""Flights in the table of all; the dataset has the rest."""
MOST_NAMES = 3
"""Recordings that are named of those with one reason."""
_TOLD = ("path", "date", "state", "who", "channels", "axes", "start", "end", "size", "size_std", "course", "words")
"""Columns of an episode that are told of the whole."""


def fleet_figures(fleet: Fleet, unread: Sequence[str]) -> dict[str, Any]:
    """Figures of the whole by name, for JSON; rows of flights are in the dataset.

    Parameters
    ----------
    fleet
        What was found.
    unread
        What could not be searched for recordings.
    """
    rate = fleet.declarations
    return {
        "flights": len(fleet.flights),
        "failed": fleet.failed,
        "vehicles": len(fleet.names),
        "hours": fleet.hours,
        "flights_with_declarations": fleet.declaring,
        "unmeasured": fleet.unmeasured,
        "declarations": {"count": rate.count, "per_hour": rate.value, "interval": list(rate.interval)},
        "not_searched": list(unread),
        "not_judged": [one._asdict() for one in fleet.not_judged],
        "reasons": {kind: len(rows) for kind, rows in reasons(fleet.looks)},
        "to_look_at": [
            {"path": look.row["path"], "date": look.row["date"], "why": list(look.why)} for look in fleet.looks
        ],
        "episodes": [{name: one[name] for name in _TOLD} for one in fleet.episodes],
    }


def summary_lines(fleet: Fleet) -> list[str]:
    """Sentences that say it all."""
    causes = f", for {_count(len(fleet.not_judged), 'reason')}" if fleet.not_judged else ""
    without = f", {fleet.failed} of them could not be judged{causes}" if fleet.failed else ""
    size = f"{_count(len(fleet.flights), 'flight')} of {_count(len(fleet.names), 'vehicle')}"
    lines = [
        f"{size}, {fleet.hours:.2f} hours judged{without}.",
        f"Something was declared in {fleet.declaring} of them: {fleet.declarations}."
        " Where all gyros were healthy these are the false declarations; a set and then its name are one."
        if fleet.hours > 0
        else "Nothing was judged.",
        *_suspected_gyros(fleet),
        _looks_words(fleet.looks),
    ]
    drifting = sorted((line for line in fleet.channels if math.isfinite(line.drift)), key=lambda one: -abs(one.drift))
    if drifting:
        words = [f"{line.name} of {fleet.names[line.vehicle]} by {line.drift:+.2g} rad/s" for line in drifting]
        lines.append(f"From flight to flight drift: {first_of(words, MOST_DRIFTS, '; ', ', and')}.")
    if fleet.unmeasured:
        lines.append(
            f"Of {_count(fleet.unmeasured, 'flight')} the mounts and axes are what fdi inspect assumes, not measured:"
            " what is declared there may be wrong (--config, --calibrate)."
        )
    if fleet.faults:
        count = len(fleet.faults)
        struck = _count(len({fault["flight"] for fault in fleet.faults}), "flight")
        named, wrong = counted(fleet.faults, OutcomeKind.ISOLATED), counted(fleet.faults, *WRONG)
        shares = f"{named / count:.1%} isolated, {wrong} wrong names or sets"
        lines.append(f"{count} faults injected, into {struck}: {shares}.")
    return lines


def not_judged_lines(failed: Sequence[NotJudged]) -> list[str]:
    """Say which recordings could not be judged, and why."""
    return [f"Not judged, {_count(len(one.paths), 'recording')}: {one.why}: {_which(one.paths)}." for one in failed]


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"


def _suspected_gyros(fleet: Fleet) -> list[str]:
    """Say which channels were declared faulty by themselves, in how many flights."""
    found: dict[tuple[str, str], set[str]] = {}
    for one in fleet.episodes:
        for channel in one["channels"] if one["state"] == "FAULTY" else ():
            found.setdefault((one["vehicle"], channel), set()).add(one["flight"])
    worst = sorted(found.items(), key=lambda item: -len(item[1]))
    words = [
        f"{channel} of {fleet.names[vehicle]} in {_count(len(own), 'flight')}" for (vehicle, channel), own in worst
    ]
    return [f"Declared faulty by themselves: {first_of(words, MOST_DRIFTS, '; ', ', and')}."] if words else []


def _looks_words(looks: Sequence[Look]) -> str:
    if not looks:
        return "No flight needs to be looked at."
    why = "; ".join(f"{kind} ({len(rows)})" for kind, rows in reasons(looks))
    return f"{_count(len(looks), 'flight')} should be looked at: {why}."


# The page ------------------------------------------------------------------------------------------------------------


def fleet_page(fleet: Fleet, about: Mapping[str, str]) -> str:
    """Lay out everything; `about` says what was run."""
    told: dict[str, list[Row]] = {}
    for one in fleet.episodes:
        told.setdefault(one["flight"], []).append(one)
    plotted = fleet.looks[:MOST_PLOTS]
    vehicles = [path if name == path else f"{name}: {path}" for path, name in fleet.names.items()]
    sections = [
        _suspicious(fleet, told),
        _reasons(fleet.looks),
        _looks(fleet),
        *([_not_judged(fleet.not_judged)] if fleet.not_judged else []),
        *(_course(look, told.get(look.row["flight"], ()), fleet.names) for look in plotted),
        *over_flights(fleet),
        _units(fleet),
        _channels(fleet),
        *([_faults(fleet.faults)] if fleet.faults else []),
        _flights(fleet),
        Section("What was run", "", {**about, "vehicles": "; ".join(vehicles)}),
    ]
    return page("fdi_ros: fleet", summary_lines(fleet), sections)


def _section(title: str, hint: str, columns: Columns, items: Sequence[Any], most: int | None = None) -> Section:
    """Lay out a table that a reader may sort; of very many rows the first."""
    more = f" The first {most} of {len(items)}." if most is not None and len(items) > most else ""
    table = html_table(*head_and_rows(columns, items[:most]), sort=True)
    return Section(title, f"{hint}{more}", table if items else "<p>None.</p>")


def _suspicious(fleet: Fleet, told: Mapping[str, Sequence[Row]]) -> Section:
    commands = {look.row["flight"]: replay_command(look.row) for look in fleet.looks}
    columns: Columns = {
        "date": _date,
        "flight": _name,
        "what": lambda one: f"{one['who']} {one['state']}",
        "axis": _axis_words,
        "size": _size_words,
        "from": lambda one: f"{one['start']:.1f} s",
        "lasted": lambda one: f"{one['end'] - one['start']:.1f} s{', to the end' if one['stands'] else ''}",
        "vehicle": lambda one: fleet.names[one["vehicle"]],
        "to see it": lambda one: commands[one["flight"]],
    }
    hint = (
        "What the monitor told of, the most worrying flights first. AMBIGUOUS: one of these is faulty. Size: the error"
        " by the other channels, and its standard error; of a set the largest that would explain it."
    )
    return _section("Suspicious gyros", hint, columns, [one for flight in commands for one in told.get(flight, ())])


def _reasons(looks: Sequence[Look]) -> Section:
    columns: Columns = {
        "why to look": lambda reason: reason[0],
        "flights": lambda reason: str(len(reason[1])),
        "which": lambda reason: _which([row["path"] for row in reason[1]]),
    }
    return _section("Why flights should be looked at", "", columns, reasons(looks))


def _looks(fleet: Fleet) -> Section:
    columns: Columns = {
        "date": lambda look: _date(look.row),
        "flight": lambda look: _name(look.row),
        "why": lambda look: "; ".join(look.why),
        "vehicle": lambda look: fleet.names[look.row["vehicle"]],
        "duration": lambda look: _minutes(look.row),
        "to see it": lambda look: replay_command(look.row),
    }
    return _section("Flights to look at", "The most worrying first.", columns, fleet.looks)


def _not_judged(failed: Sequence[NotJudged]) -> Section:
    columns: Columns = {
        "recordings": lambda one: str(len(one.paths)),
        "why": lambda one: one.why,
        "which": lambda one: _which(one.paths),
    }
    hint = "Alike reasons together; of each the words of the first. flights.parquet has them one by one."
    return _section("Not judged", hint, columns, failed)


def _course(look: Look, episodes: Sequence[Row], names: Mapping[str, str]) -> Section:
    row = look.row
    hint = (
        f"{names[row['vehicle']]}, {_date(row)}: {'; '.join(look.why)}. Below the statistic the differences of each"
        " unit to what the others say of the axis, no bias taken off; shaded: what was declared."
    )
    return Section(_name(row), hint, "", course_figures(row, episodes))


def _lines(
    title: str, hint: str, fleet: Fleet, lines: Sequence[Line], own: Columns, most: int | None = None
) -> Section:
    """Lay out units or channels, with what is said of these alone."""
    columns: Columns = {
        "vehicle": lambda line: fleet.names[line.vehicle],
        title.lower().removesuffix("s"): lambda line: line.name,
        "flights": lambda line: str(line.flights),
        "noise at rest": lambda line: number(line.noise_rest, ".2g"),
        "in motion": lambda line: number(line.noise_motion, ".2g"),
        **own,
        "suspected": lambda line: str(line.suspected),
        "declared": lambda line: str(line.declared),
    }
    return _section(title, hint, columns, lines, most)


def _units(fleet: Fleet) -> Section:
    own: Columns = {
        "vibration": lambda line: number(line.vibration, ".2g"),
        "largest bias": lambda line: number(line.largest_bias, ".2g"),
        "its change between flights": lambda line: number(line.bias_spread, ".2g"),
        "stamps late by": lambda line: number(1e3 * line.late, "+.1f", " ms"),
    }
    hint = (
        "rad/s; medians over the flights of a vehicle, of each flight the worst channel of the unit; stamps: + late,"
        " - early against the first unit's."
    )
    return _lines("Units", hint, fleet, fleet.units, own)


def _channels(fleet: Fleet) -> Section:
    own: Columns = {
        "bias": lambda line: number(median(line.biases), ".2g"),
        "its change between flights": lambda line: number(line.bias_spread, ".2g"),
        "steady drift": lambda line: number(line.drift, ".2g"),
    }
    hint = (
        "rad/s; medians over the flights of a vehicle; drift: from the first flight to the last, where it is plain"
        " (Theil and Sen's slope, Kendall's test)."
    )
    return _lines("Channels", hint, fleet, fleet.channels, own, MOST_ROWS)


def _faults(faults: Sequence[Row]) -> Section:
    hint = "The same faults in every flight; intervals of 95 % count in that faults in one flight are alike"
    hint += " (Rao and Scott 1992); wrong: a healthy channel was declared, or a set without the faulty one."
    return Section("Injected faults", hint, html_table(*fault_table(faults), sort=True))


def _flights(fleet: Fleet) -> Section:
    worrying = {look.row["flight"]: k for k, look in enumerate(fleet.looks)}
    columns: Columns = {
        "date": _date,
        "flight": _name,
        "vehicle": lambda row: fleet.names[row["vehicle"]],
        "duration": _minutes,
        "rate": lambda row: number(row["rate"], ".1f", " Hz"),
        "gaps": lambda row: number(row["gaps"], "d"),
        "judged": lambda row: number(row["judged"], ".0%"),
        "declared": lambda row: number(row["declared"], "d"),
        "sets": lambda row: number(row["sets"], "d"),
        "statistic": lambda row: number(row["largest"], ".2f"),
        "else": lambda row: "not judged" if row["error"] else "-",
    }
    ranked = sorted(fleet.flights, key=lambda row: (bool(row["error"]), worrying.get(row["flight"], len(fleet.looks))))
    return _section("All flights", "Click a head to sort.", columns, ranked, MOST_ROWS)


def fault_table(faults: Sequence[Row]) -> Rows:
    """Head and rows of what came of each fault over the whole fleet."""
    kinds: dict[tuple[str, float, str], list[Row]] = {}
    for fault in faults:
        kinds.setdefault((fault["kind"], fault["size"] or 0.0, fault["fault"]), []).append(fault)
    columns: Columns = {
        "fault": lambda own: own[0]["fault"],
        "injected": lambda own: str(len(own)),
        "isolated": lambda own: _share(own, OutcomeKind.ISOLATED),
        "95 % interval": _interval,
        "in a set": lambda own: _share(own, OutcomeKind.AMBIGUOUS),
        "missed": lambda own: _share(own, OutcomeKind.MISSED),
        "wrong": _wrong,
        "median delay": _delay,
    }
    return head_and_rows(columns, [own for _, own in sorted(kinds.items())])


def _share(faults: Sequence[Row], outcome: OutcomeKind) -> str:
    return f"{counted(faults, outcome) / len(faults):.1%}"


def _interval(faults: Sequence[Row]) -> str:
    isolated = clustered_share([(counted(own, OutcomeKind.ISOLATED), len(own)) for own in _by_flight(faults)])
    return "one flight" if isolated is None else f"{isolated.low:.1%} to {isolated.high:.1%}"


def _wrong(faults: Sequence[Row]) -> str:
    flights = _by_flight(faults)
    return f"{counted(faults, *WRONG)}, in {sum(counted(own, *WRONG) > 0 for own in flights)} of {len(flights)} flights"


def _delay(faults: Sequence[Row]) -> str:
    delays = sorted(fault["named_after"] for fault in faults if fault["outcome"] == OutcomeKind.ISOLATED)
    return f"{delays[len(delays) // 2]:.2f} s" if delays else "-"


def _by_flight(faults: Sequence[Row]) -> list[list[Row]]:
    flights: dict[str, list[Row]] = {}
    for fault in faults:
        flights.setdefault(fault["flight"], []).append(fault)
    return list(flights.values())


def replay_command(row: Row) -> str:
    """Command that shows a flight in detail."""
    return f"fdi replay {_quoted(row['path'])} --config {_quoted(row['config'])} --report flight.html"


def _quoted(path: str) -> str:
    """Quote a path for a shell, on one line and in characters that can be seen."""
    if path.isprintable():
        return shlex.quote(path)
    escaped = "".join(f"\\U{ord(c):08x}" if not c.isprintable() else f"\\{c}" if c in "\\'" else c for c in path)
    # Of bash and zsh.
    return f"$'{escaped}'"


def _name(row: Row) -> str:
    return str(row["path"]).rpartition("/")[2]


def _date(row: Row) -> str:
    """Date of a flight or an episode, UTC."""
    return row["date"][:16].replace("T", " ") if row["date"] else "no date"


def _axis_words(one: Row) -> str:
    axes = list(dict.fromkeys(one["axes"]))
    return ", ".join(axes) if len(axes) <= MOST_NAMES else "any"


def _size_words(one: Row) -> str:
    if one["size"] is None:
        return "-"
    std = f" +- {one['size_std']:.1g}" if one["size_std"] is not None else ""
    course = f", {one['course']}" if one["course"] not in ("", "steady") else ""
    return f"{abs(one['size']):.2g}{std} rad/s{course}"


def _which(paths: Sequence[str]) -> str:
    """Name the first of some recordings."""
    return first_of([shown(path.rpartition("/")[2]) for path in paths], MOST_NAMES)


def _minutes(row: Row) -> str:
    return number(None if row["duration"] is None else row["duration"] / 60, ".1f", " min")
