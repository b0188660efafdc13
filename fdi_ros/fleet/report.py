# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The page of a fleet: gyros under suspicion, flights to look at, what was not judged, units and channels over time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from fdi_ros.fleet.lines import ChannelLine, Row, UnitLine, channel_lines, in_order, unit_lines
from fdi_ros.fleet.looks import Look, NotJudged, not_judged, reasons, replay_command, to_look_at
from fdi_ros.fleet.over_time import course_figures, over_flights
from fdi_ros.fleet.summary import FAULT_HEAD, WRONG, Totals, fault_rows, totals
from fdi_ros.report.page import Section, html_pairs, html_table, page
from fdi_ros.scoring.outcome import Outcome
from fdi_ros.text import shown

MOST_PLOTS = 12
"""Flights to look at that have a plot."""
MOST_DRIFTS = 5
"""Drifting channels that are named at the top."""
MOST_ROWS = 2000
"""Flights in the table of all; the dataset has the rest."""
MOST_NAMES = 3
"""Recordings that are named of those with one reason."""
EPISODE_HEAD = ("date", "flight", "what", "axis", "size", "from", "lasted", "vehicle", "to see it")
REASON_HEAD = ("why to look", "flights", "which")
LOOK_HEAD = ("date", "flight", "why", "vehicle", "duration", "to see it")
NOT_JUDGED_HEAD = ("recordings", "why", "which")
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
FLIGHT_HEAD = (
    *("date", "flight", "vehicle", "duration", "rate", "gaps", "judged"),
    *("declared", "sets", "statistic", "else"),
)


def fleet_page(
    flights: Sequence[Row],
    episodes: Sequence[Row],
    events: Sequence[Row],
    faults: Sequence[Row],
    about: Mapping[str, str],
) -> str:
    """Lay out everything."""
    flights, names = in_order(flights), short_names([row["vehicle"] for row in flights])
    lines = unit_lines(flights, events)
    channels = channel_lines(flights, events)
    looks, failed = to_look_at(flights, channels), not_judged(flights)
    told: dict[str, list[Row]] = {}
    for one in episodes:
        told.setdefault(one["flight"], []).append(one)
    suspicious = [look for look in looks if told.get(look.row["flight"])]
    first = list(dict.fromkeys(look.row["vehicle"] for look in looks))
    sections = [
        _suspicious(suspicious, told, names),
        _reasons(looks),
        _looks(looks, names),
        *([_not_judged(failed)] if failed else []),
        *(_course(look, told.get(look.row["flight"], ()), names) for look in looks[:MOST_PLOTS]),
        *over_flights(flights, channels, first, names),
        _units(lines, names),
        _channels(channels, names),
        *([_faults(faults)] if faults else []),
        _flights(flights, looks, names),
        Section("What was run", "", html_pairs({**about, "vehicles": _vehicle_words(names)}.items())),
    ]
    return page("fdi_ros: fleet", summary_lines(totals(flights), looks, failed, channels, episodes, faults), sections)


def short_names(vehicles: Sequence[str]) -> dict[str, str]:
    """Return the shortest end of the path of each vehicle that no other has."""
    paths, found = list(dict.fromkeys(vehicles)), {}
    for path in paths:
        parts = path.strip("/").split("/")
        ends = ("/".join(parts[-k:]) for k in range(1, len(parts) + 1))
        others = [f"/{other.strip('/')}" for other in paths if other != path]
        found[path] = next((end for end in ends if not any(one.endswith(f"/{end}") for one in others)), path)
    return found


def not_judged_lines(failed: Sequence[NotJudged]) -> list[str]:
    """Say which recordings could not be judged, and why."""
    return [f"Not judged, {_recordings(len(one.paths))}: {one.why}: {_which(one.paths)}." for one in failed]


def summary_lines(
    all_of_it: Totals,
    looks: Sequence[Look],
    failed: Sequence[NotJudged],
    channels: Sequence[ChannelLine],
    episodes: Sequence[Row],
    faults: Sequence[Row],
) -> list[str]:
    """Sentences that say it all."""
    causes = f", for {len(failed)} reason{'s' * (len(failed) != 1)}" if failed else ""
    without = f", {all_of_it.failed} of them could not be judged{causes}" if all_of_it.failed else ""
    vehicles = f"{all_of_it.vehicles} vehicle{'s' * (all_of_it.vehicles != 1)}"
    names = short_names([line.vehicle for line in channels])
    lines = [
        f"{_flights_of(all_of_it.flights)} of {vehicles}, {all_of_it.hours:.2f} hours judged{without}.",
        f"Something was declared in {all_of_it.declaring} of them: {all_of_it.declarations}."
        " Where all gyros were healthy these are the false declarations; a set and then its name are one."
        if all_of_it.hours > 0
        else "Nothing was judged.",
        *_suspected_gyros(episodes, names),
        _looks_words(looks),
    ]
    drifting = [line for line in channels if math.isfinite(line.drift)]
    if drifting:
        worst = sorted(drifting, key=lambda line: -abs(line.drift))[:MOST_DRIFTS]
        words = [f"{line.channel} of {names[line.vehicle]} by {line.drift:+.2g} rad/s" for line in worst]
        more = f", and {len(drifting) - len(worst)} more" if len(drifting) > len(worst) else ""
        lines.append(f"From flight to flight drift: {'; '.join(words)}{more}.")
    if all_of_it.unmeasured:
        lines.append(
            f"Of {_flights_of(all_of_it.unmeasured)} the mounts and axes are what fdi inspect assumes, not measured:"
            " what is declared there may be wrong (--config, --calibrate)."
        )
    if faults:
        named = sum(fault["outcome"] == Outcome.ISOLATED for fault in faults)
        wrong = sum(fault["outcome"] in WRONG for fault in faults)
        struck = _flights_of(len({fault["flight"] for fault in faults}))
        shares = f"{named / len(faults):.1%} isolated, {wrong} wrong names or sets"
        lines.append(f"{len(faults)} faults injected, into {struck}: {shares}.")
    return lines


def _flights_of(count: int) -> str:
    return f"{count} flight{'s' * (count != 1)}"


def _suspected_gyros(episodes: Sequence[Row], names: Mapping[str, str]) -> list[str]:
    """Say which channels were declared faulty by themselves, in how many flights."""
    found: dict[tuple[str, str], set[str]] = {}
    for one in episodes:
        for channel in one["channels"] if one["state"] == "FAULTY" else ():
            found.setdefault((one["vehicle"], channel), set()).add(one["flight"])
    worst = sorted(found.items(), key=lambda item: -len(item[1]))
    words = [f"{channel} of {names[vehicle]} in {_flights_of(len(own))}" for (vehicle, channel), own in worst]
    more = f", and {len(words) - MOST_DRIFTS} more" if len(words) > MOST_DRIFTS else ""
    return [f"Declared faulty by themselves: {'; '.join(words[:MOST_DRIFTS])}{more}."] if words else []


def _looks_words(looks: Sequence[Look]) -> str:
    if not looks:
        return "No flight needs to be looked at."
    why = "; ".join(f"{kind} ({len(rows)})" for kind, rows in reasons(looks))
    return f"{_flights_of(len(looks))} should be looked at: {why}."


def _suspicious(looks: Sequence[Look], told: Mapping[str, Sequence[Row]], names: Mapping[str, str]) -> Section:
    rows = [
        (
            _date(one),
            _name(one),
            f"{one['who']} {one['state']}",
            _axis_words(one),
            _size_words(one),
            f"{one['start']:.1f} s",
            f"{one['end'] - one['start']:.1f} s{', to the end' if one['stands'] else ''}",
            names[one["vehicle"]],
            replay_command(look.row),
        )
        for look in looks
        for one in told[look.row["flight"]]
    ]
    hint = (
        "What the monitor told of, the most worrying flights first. AMBIGUOUS: one of these is faulty. Size: the error"
        " by the other channels, and its standard error; of a set the largest that would explain it."
    )
    return Section("Suspicious gyros", hint, html_table(EPISODE_HEAD, rows, sort=True) if rows else "<p>None.</p>")


def _course(look: Look, episodes: Sequence[Row], names: Mapping[str, str]) -> Section:
    row = look.row
    hint = (
        f"{names[row['vehicle']]}, {_date(row)}: {'; '.join(look.why)}. Below the statistic the differences of each"
        " unit to what the others say of the axis, no bias taken off; shaded: what was declared."
    )
    return Section(_name(row), hint, "", course_figures(row, episodes))


def _reasons(looks: Sequence[Look]) -> Section:
    rows = [(kind, str(len(own)), _which([row["path"] for row in own])) for kind, own in reasons(looks)]
    return Section(
        "Why flights should be looked at", "", html_table(REASON_HEAD, rows, sort=True) if rows else "<p>None.</p>"
    )


def _looks(looks: Sequence[Look], names: Mapping[str, str]) -> Section:
    rows = [
        (
            _date(look.row),
            _name(look.row),
            "; ".join(look.why),
            names[look.row["vehicle"]],
            _minutes(look.row),
            replay_command(look.row),
        )
        for look in looks
    ]
    table = html_table(LOOK_HEAD, rows, sort=True) if rows else "<p>None.</p>"
    return Section("Flights to look at", "The most worrying first.", table)


def _not_judged(failed: Sequence[NotJudged]) -> Section:
    rows = [(str(len(one.paths)), one.why, _which(one.paths)) for one in failed]
    hint = "Alike reasons together; of each the words of the first. flights.parquet has them one by one."
    return Section("Not judged", hint, html_table(NOT_JUDGED_HEAD, rows, sort=True))


def _units(lines: Sequence[UnitLine], names: Mapping[str, str]) -> Section:
    rows = [
        (
            names[line.vehicle],
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


def _channels(lines: Sequence[ChannelLine], names: Mapping[str, str]) -> Section:
    rows = [
        (
            names[line.vehicle],
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


def _faults(faults: Sequence[Row]) -> Section:
    hint = "The same faults in every flight; intervals of 95 % count in that faults in one flight are alike"
    hint += " (Rao and Scott 1992); wrong: a healthy channel was declared, or a set without the faulty one."
    return Section("Injected faults", hint, html_table(FAULT_HEAD, fault_rows(faults), sort=True))


def _flights(flights: Sequence[Row], looks: Sequence[Look], names: Mapping[str, str]) -> Section:
    worrying = {look.row["flight"]: k for k, look in enumerate(looks)}
    ranked = sorted(flights, key=lambda row: (bool(row["error"]), worrying.get(row["flight"], len(looks))))
    rows = [
        (
            _date(row),
            _name(row),
            names[row["vehicle"]],
            _minutes(row),
            "-" if row["rate"] is None else f"{row['rate']:.1f} Hz",
            "-" if row["gaps"] is None else str(row["gaps"]),
            "-" if row["judged"] is None else f"{row['judged']:.0%}",
            "-" if row["declared"] is None else str(row["declared"]),
            "-" if row["sets"] is None else str(row["sets"]),
            "-" if row["largest"] is None else f"{row['largest']:.2f}",
            "not judged" if row["error"] else "-",
        )
        for row in ranked[:MOST_ROWS]
    ]
    more = f" The first {MOST_ROWS} of {len(flights)}." if len(flights) > MOST_ROWS else ""
    return Section("All flights", f"Click a head to sort.{more}", html_table(FLIGHT_HEAD, rows, sort=True))


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
    names = [shown(path.rpartition("/")[2]) for path in paths[:MOST_NAMES]]
    more = f" and {len(paths) - len(names)} more" if len(paths) > len(names) else ""
    return f"{', '.join(names)}{more}"


def _recordings(count: int) -> str:
    return f"{count} recording{'s' * (count != 1)}"


def _vehicle_words(names: Mapping[str, str]) -> str:
    return "; ".join(path if name == path else f"{name}: {path}" for path, name in names.items())


def _minutes(row: Row) -> str:
    return "-" if row["duration"] is None else f"{row['duration'] / 60:.1f} min"


def _figure(value: float) -> str:
    return f"{value:.2g}" if math.isfinite(value) else "-"
