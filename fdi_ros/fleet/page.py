# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The page of a fleet, and its words and figures: first the flights that need a look, and why."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from fdi_ros.fleet.tables import Row
from fdi_ros.report.layout import Column, Section, figures_of, html_table, number, page, told
from fdi_ros.report.verdict import Severity, Verdict
from fdi_ros.system.text import shown

MOST_ROWS = 2000
"""Flights in a table of the page; flights.parquet has all."""
LOOKS, WHY = 10, 400
"""Flights that need a person in a terminal, and characters of what is said of each."""


class Fleet:
    """The flights of some rows, the most worrying first."""

    def __init__(self, flights: Sequence[Row]) -> None:
        def rank(row: Row) -> tuple[int, int, bool, str]:
            declared, sets = row["declared"] or 0, row["sets"] or 0
            return sets - declared, -declared, not row["error"], row["path"]

        self.flights = sorted(flights, key=rank)
        self.looks = [row for row in self.flights if row["why"]]
        """Those that need a person."""
        self.calm = [row for row in self.flights if not row["why"]]
        self.judged = [row for row in flights if not row["error"]]

    def figures(self) -> dict[str, Any]:
        """Return the figures of the whole by name, and those of the flights that need a person."""
        return {
            "flights": len(self.flights),
            "not_judged": len(self.flights) - len(self.judged),
            "vehicles": len({row["vehicle"] for row in self.flights}),
            "watched": sum(row["watched"] for row in self.judged),
            "episodes": sum(row["episodes"] for row in self.judged),
            "not_measured": sum(not row["measured"] for row in self.judged),
            "need_a_person": figures_of(columns_of(self.looks)),
        }

    @property
    def verdict(self) -> Verdict:
        """How many flights need a look."""
        count, faulty = (
            _count(len(self.flights), "flight"),
            sum(any(why.startswith("FAULTY") for why in row["why"]) for row in self.looks),
        )
        if not self.looks:
            return Verdict(Severity.GOOD, f"HEALTHY: {count}, none needs a look.")
        failed = sum(bool(row["error"]) for row in self.looks)
        reasons = {"faulty": faulty, "not judged": failed, "cannot be told": len(self.looks) - faulty - failed}
        words = ", ".join(f"{number} {reason}" for reason, number in reasons.items() if number)
        severity = Severity.BAD if faulty else Severity.UNKNOWN
        return Verdict(severity, f"LOOK AT {len(self.looks)} of {count}: {words}.")

    def lines(self) -> list[str]:
        """Say it all in sentences, the verdict first."""
        own = self.figures()
        declaring = sum(row["declared"] > 0 for row in self.judged)
        lines = [
            self.verdict.words,
            f"{_count(own['vehicles'], 'vehicle')}; {_count(own['not_judged'], 'flight')} could not be judged;"
            f" {_count(own['episodes'], 'fault')} declared, in {_count(declaring, 'flight')};"
            f" {own['watched'] / 3600:.2f} hours judged while nothing stood declared.",
        ]
        assumed = (
            f"Of {_count(own['not_measured'], 'flight')} the mounts and axes are what fdi inspect assumes, not"
            " measured: what is declared there may be wrong (--config, --calibrate)."
        )
        return [*lines, assumed] if own["not_measured"] else lines

    def text(self) -> str:
        """Return the sentences, and the first flights that need a person, for a terminal."""
        looks = [f"{shown(row['path'])}: {shown('; '.join(row['why']), WHY)}" for row in self.looks[:LOOKS]]
        more = [f"and {len(self.looks) - LOOKS} more"] if len(self.looks) > LOOKS else []
        return "".join(f"{line}\n" for line in [*self.lines(), *looks, *more])

    def html(self, about: Mapping[str, str]) -> str:
        """Lay out the page; `about` says what was run."""
        hint = "Gyros declared faulty first, then sets, then what was not judged, and what was hardly checked."
        sections = [
            _section("Flights that need a look", hint, self.looks),
            _section("All other flights", "Nothing was declared, and the channels were checked.", self.calm, "why"),
            Section("What was run", "", about),
        ]
        return page("fdi_ros: fleet", self.lines(), sections, severity=self.verdict.severity)


def columns_of(flights: Sequence[Row]) -> list[Column]:
    """Return what is told of each flight: on the page and, by name, in JSON."""

    def column(name: str, head: str, say: Any) -> Column:
        return Column(name, [row[name] for row in flights], (head,), say)

    to_see = "fdi replay {} --config {} --report flight.html"
    quoted = [(shlex.quote(row["path"]), shlex.quote(row["config"])) for row in flights]
    commands = ["" if row["error"] else to_see.format(*own) for row, own in zip(flights, quoted, strict=True)]
    return [
        column("path", "flight", lambda path: shown(path.rpartition("/")[2])),
        column("why", "why", lambda why: shown("; ".join(why), WHY) or "-"),
        column("date", "date, UTC", lambda date: date[:16].replace("T", " ") if date else "-"),
        column("vehicle", "vehicle", lambda path: shown(path.rpartition("/")[2])),
        column("duration", "minutes", lambda seconds: number(seconds and seconds / 60, ".1f")),
        column("unchecked", "not checked", lambda shares: number(max(shares or (), default=None), ".0%")),
        column("declared", "declared", lambda count: number(count, "d")),
        column("damage", "damage", lambda damage: shown("; ".join(damage or ()), WHY) or "-"),
        Column("command", commands, ("to see it",), str),
    ]


def _section(title: str, hint: str, flights: Sequence[Row], without: str = "") -> Section:
    more = f" The first {MOST_ROWS} of {len(flights)}." if len(flights) > MOST_ROWS else ""
    columns = (column for column in columns_of(flights[:MOST_ROWS]) if column.name != without)
    table = html_table(*told(columns), sort=True)
    return Section(f"{title} ({len(flights)})", f"{hint}{more}", table if flights else "<p>None.</p>")


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"
