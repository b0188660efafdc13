# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The tables of a fleet, a row per recording and a row per episode, as Parquet files, and its page.

The fields are the columns. What a column holds and its unit stand at the field, and go into the schema of the files.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import shlex
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import pyarrow as arrow
import pyarrow.parquet as parquet

from fdi_ros import __version__
from fdi_ros.errors import BagError
from fdi_ros.report.layout import (
    Column,
    Link,
    Section,
    Severity,
    Verdict,
    figures_of,
    html_table,
    number,
    page,
    told,
)
from fdi_ros.system.files import open_regular, plain, whole, write_text
from fdi_ros.system.text import LINE, shown, storable

Row = Mapping[
    str, Any
]  # values of a row by the names of the columns; None where nothing can be said.
VERSION = 5  # of the columns: raised when one changes its name, type or meaning
WRITE_AFTER, WRITE_SHARE = 5.0, 0.05
"""The tables are written after so many seconds, and in that share of the time: a run that is killed loses no more."""


def _column(meaning: str, unit: str = "", default: Any = None) -> Any:
    return field(default=default, metadata={"meaning": meaning, "unit": unit})


@dataclass(frozen=True)
class Flight:
    """One recording as it was judged."""

    path: str = _column("where the recording lies, whole path")
    vehicle: str = _column(
        "serial number of the autopilot's board where the log has one; else the folder in"
        " which it lies, whole path, with the MAVLink system unless that is 1"
    )
    digest: str = _column(
        "names, sizes and times of its files, hashed: with another one it is judged again"
    )
    error: str = _column("why it could not be judged; empty if it was", default="")
    why: tuple[str, ...] = _column(
        "why a person should look at it; empty: there is no need", default=()
    )
    config: str = _column("parameter file it was judged with", default="")
    report: str = _column(
        "page of its replay, below the folder of the tables; empty: not written",
        default="",
    )
    calibration: str = _column(
        "'on itself', or why it could not be calibrated; empty: not asked", default=""
    )
    measured: bool | None = _column(
        "false: mounts and axes are what fdi inspect assumes, not measured"
    )
    date: str | None = _column(
        "of the first sample, UTC; null: its stamps count from a start, as of a log without GPS"
    )
    duration: float | None = _column("from the first sample to the last", "s")
    damage: tuple[str, ...] | None = _column("what of it could not be read")
    watched: float | None = _column(
        "time that was judged while nothing stood declared", "s"
    )
    episodes: int | None = _column(
        "faults declared, each from its first declaration to its end"
    )
    declared: int | None = _column(
        "declarations: a channel faulty, or a set one of which is"
    )
    sets: int | None = _column("of these, sets of several channels")
    degraded: tuple[str, ...] | None = _column(
        "what became worse than it should be without being declared"
    )
    channels: tuple[str, ...] | None = _column(
        "names of the channels; the next three are in their order"
    )
    unchecked: tuple[float, ...] | None = _column(
        "share of the samples in which nothing checked the channel, or it gave none"
    )
    noise: tuple[float, ...] | None = _column(
        "noise of each gyro per sample, at the quietest; gyros come first", "rad/s"
    )
    bias: tuple[float, ...] | None = _column(
        "bias of each at the end: given, learned and followed",
        "rad/s; m/s^2 of accelerometers",
    )


@dataclass(frozen=True)
class FlightEpisode:
    """One episode of one flight: a fault as the monitor declared it, or channels that gave nothing."""

    path: str = _column("where the recording lies, whole path")
    vehicle: str = _column("as of its flight")
    date: str | None = _column("of its start, UTC; null: the flight has no date")
    state: str = _column("what it came to: FAULTY, AMBIGUOUS or STALE")
    declares: bool = _column(
        "whether a fault was declared; otherwise channels only gave nothing"
    )
    channels: tuple[str, ...] = _column(
        "which are, or of which one is where it is AMBIGUOUS"
    )
    start: float = _column("first declaration, from the first message", "s")
    end: float = _column("when nothing of it stood any more, or its stretch ended", "s")
    size: float | None = _column(
        "error by the others; between channels of one axis, how far apart",
        "as in measured_in",
    )
    size_std: float | None = _column("standard error of that", "as in measured_in")
    measured_in: str = _column("unit of the error: rad/s, or m/s^2 of accelerometers")
    words: str = _column("all in one sentence")


class Tables:
    """The folder of a fleet, made if it is not there: its rows as they are there, and as they come.

    Rows of recordings that are not given again stay. ``settings``: what decides the results, ready for JSON; rows of
    other settings are of no use, and with ``force`` it is begun anew where they are there. `BagError` if the tables
    there are not of a fleet, or of other settings, or another run writes to the folder.
    """

    def __init__(self, folder: Path, settings: Row, force: bool = False) -> None:
        decides = json.dumps([VERSION, __version__, settings], sort_keys=True)
        self._settings = hashlib.sha256(
            decides.encode("utf-8", "surrogateescape")
        ).hexdigest()
        self._folder = folder
        try:
            (folder / "configs").mkdir(parents=True, exist_ok=True)
            flags = os.O_RDWR | os.O_CREAT | os.O_NONBLOCK | os.O_CLOEXEC
            # Held as long as this.
            self._lock = os.fdopen(os.open(folder / ".lock", flags, 0o666), "rb")
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise BagError(f"another fdi fleet writes to {folder}") from error
        except OSError as error:
            raise BagError(
                f"cannot write to {folder}: {error.strerror or error}"
            ) from error
        try:
            flights, episodes = (
                self._read("flights", force),
                self._read("episodes", force),
            )
        except (BagError, OSError):
            self.give_up()
            raise
        self.flights: dict[str, Row] = {
            row["path"]: row for row in flights
        }  # rows by path
        self._episodes: dict[str, list[Row]] = {path: [] for path in self.flights}
        for row in episodes:
            # Those whose flight was not written any more are of no use: it is judged again.
            self._episodes.get(row["path"], []).append(row)
        self._written, self._took = time.monotonic(), 0.0

    def give_up(self) -> None:
        """Remove what was made for a run that is refused; a folder that holds anything stays."""
        with suppress(OSError):
            (self._folder / ".lock").unlink()
            (self._folder / "configs").rmdir()
            self._folder.rmdir()

    def add(self, flight: Flight, episodes: Sequence[FlightEpisode]) -> None:
        """Take the rows of one more recording, with texts in Unicode, in place of its former ones."""
        self.flights[flight.path], self._episodes[flight.path] = (
            plain(flight),
            list(map(plain, episodes)),
        )
        if time.monotonic() - self._written > max(
            WRITE_AFTER, self._took / WRITE_SHARE
        ):
            self.write()

    def write(self) -> None:
        """Write the tables, sorted by path: episodes first, so that every flight that is there has its own."""
        begun, paths = time.monotonic(), sorted(self.flights)
        self._save(
            "episodes",
            FlightEpisode,
            [row for path in paths for row in self._episodes[path]],
        )
        self._save("flights", Flight, [self.flights[path] for path in paths])
        self._written = time.monotonic()
        self._took = self._written - begun

    def keep_config(self, text: str) -> str:
        """Keep a parameter file; return where it lies."""
        path = (
            self._folder
            / "configs"
            / f"{hashlib.sha256(text.encode()).hexdigest()[:16]}.yaml"
        )
        if not path.exists():
            write_text(path, text)
        return storable(str(path))

    def _read(self, name: str, force: bool) -> list[Row]:
        path = self._folder / f"{name}.parquet"
        if not path.exists():
            return []
        try:
            # Opened here: the name may be no Unicode.
            with open_regular(path) as file:
                table = parquet.read_table(file)
        except arrow.ArrowException as error:
            raise BagError(
                f"{path} is damaged: take it away, or give another --output"
            ) from error
        about = table.schema.metadata or {}
        if b"fdi_ros" not in about:
            raise BagError(
                f"{path} is no table of fdi fleet; it is not overwritten even with --force"
            )
        same = about.get(b"settings") == self._settings.encode()
        if not same and not force:
            raise BagError(
                f"{path} is of other settings or of another version; --force begins anew"
            )
        rows: list[Row] = table.to_pylist() if same else []
        return rows

    def _save(
        self, name: str, columns: type[Flight | FlightEpisode], rows: list[Row]
    ) -> None:
        types = {
            "str": arrow.string(),
            "int": arrow.int64(),
            "float": arrow.float64(),
            "bool": arrow.bool_(),
        }
        types |= {
            f"tuple[{name}, ...]": arrow.list_(kind) for name, kind in types.items()
        }
        # As annotated: of what may be unknown, None too.
        kinds = [
            (one, types[str(one.type).replace(" | None", "")])
            for one in fields(columns)
        ]
        described = [
            arrow.field(one.name, kind, metadata=dict(one.metadata))
            for one, kind in kinds
        ]
        about = {
            "fdi_ros": __version__,
            "columns": str(VERSION),
            "settings": self._settings,
        }
        schema = arrow.schema(described, metadata=about)
        with (
            whole(self._folder / f"{name}.parquet") as scratch,
            scratch.open("wb") as file,
        ):
            parquet.write_table(arrow.Table.from_pylist(rows, schema=schema), file)


# The page: first the flights that need a look, and why ----------------------------------------------------------------


MOST_ROWS = 2000  # flights in a table of the page; flights.parquet has all
LOOKS = 10  # flights that need a person that a terminal shows


class Fleet:
    """The flights of some rows, the most worrying first."""

    def __init__(self, flights: Sequence[Row]) -> None:
        def rank(row: Row) -> tuple[int, int, bool, str]:
            declared, sets = row["declared"] or 0, row["sets"] or 0
            return sets - declared, -declared, not row["error"], row["path"]

        self.flights = sorted(flights, key=rank)
        self.looks = [
            row for row in self.flights if row["why"]
        ]  # those that need a person
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
            "damaged": sum(bool(row["damage"]) for row in self.judged),
            "not_measured": sum(not row["measured"] for row in self.judged),
            "need_a_person": figures_of(columns_of(self.looks)),
        }

    @property
    def verdict(self) -> Verdict:
        """How many flights need a look."""
        count = _count(len(self.flights), "flight")
        if not self.looks:
            return Verdict(Severity.GOOD, f"HEALTHY: {count}, none needs a look.")
        faulty = sum(
            any(why.startswith("FAULTY") for why in row["why"]) for row in self.looks
        )
        failed = sum(bool(row["error"]) for row in self.looks)
        reasons = {
            "faulty": faulty,
            "not judged": failed,
            "cannot be told": len(self.looks) - faulty - failed,
        }
        words = ", ".join(
            f"{number} {reason}" for reason, number in reasons.items() if number
        )
        return Verdict(
            Severity.BAD if faulty else Severity.UNKNOWN,
            f"LOOK AT {len(self.looks)} of {count}: {words}.",
        )

    def lines(self) -> list[str]:
        """Say it all in sentences, the verdict first."""
        own, declaring = self.figures(), sum(row["declared"] > 0 for row in self.judged)
        counts = (
            f"{_count(own['vehicles'], 'vehicle')}; {_count(own['not_judged'], 'flight')} could not be judged;"
            f" {_count(own['episodes'], 'fault')} declared, in {_count(declaring, 'flight')};"
            f" {own['watched'] / 3600:.2f} hours judged while nothing stood declared."
        )
        damaged = f"{_count(own['damaged'], 'recording')} could not be read whole."
        assumed = (
            f"Of {_count(own['not_measured'], 'flight')} the mounts and axes are what fdi inspect assumes, not"
            " measured: what is declared there may be wrong (--config, --calibrate)."
        )
        more = [damaged] if own["damaged"] else []
        more += [assumed] if own["not_measured"] else []
        return [self.verdict.words, counts, *more]

    def text(self) -> str:
        """Return the sentences, and the first flights that need a person, for a terminal."""
        looks = [
            f"{shown(row['path'])}: {shown(' '.join(row['why']), LINE)}"
            for row in self.looks[:LOOKS]
        ]
        more = (
            [f"and {len(self.looks) - LOOKS} more"] if len(self.looks) > LOOKS else []
        )
        return "".join(f"{line}\n" for line in [*self.lines(), *looks, *more])

    def html(self, about: Mapping[str, str]) -> str:
        """Lay out the page; `about` says what was run."""
        hint = "Gyros declared faulty first, then sets, then what was not judged, and what was hardly checked."
        sections = [
            _section("Flights that need a look", hint, self.looks),
            _section(
                "All other flights",
                "Nothing was declared, and the channels were checked.",
                self.calm,
                "why",
            ),
            Section("What was run", "", about),
        ]
        return page(
            "fdi_ros: fleet", self.lines(), sections, severity=self.verdict.severity
        )


def columns_of(flights: Sequence[Row]) -> list[Column]:
    """Return what is told of each flight: on the page and, by name, in JSON."""

    def column(name: str, head: str, say: Any) -> Column:
        return Column(name, [row[name] for row in flights], (head,), say)

    words = [
        (
            "fdi",
            "replay",
            row["path"],
            "--config",
            row["config"],
            "--report",
            "flight.html",
        )
        for row in flights
    ]
    commands = [
        "" if row["error"] else shlex.join(command)
        for row, command in zip(flights, words, strict=True)
    ]
    reports = {row["path"]: row["report"] for row in flights}
    return [
        column(
            "path",
            "flight",
            lambda path: Link(shown(path.rpartition("/")[2]), reports[path]),
        ),
        column("why", "why", lambda why: shown(" ".join(why), LINE) or "-"),
        column(
            "date",
            "date, UTC",
            lambda date: date[:16].replace("T", " ") if date else "-",
        ),
        column("vehicle", "vehicle", lambda path: shown(path.rpartition("/")[2])),
        column(
            "duration",
            "minutes",
            lambda seconds: number(seconds and seconds / 60, ".1f"),
        ),
        column(
            "unchecked",
            "not checked",
            lambda shares: number(max(shares or (), default=None), ".0%"),
        ),
        column("declared", "declared", lambda count: number(count, "d")),
        column(
            "damage",
            "damage",
            lambda damage: shown("; ".join(damage or ()), LINE) or "-",
        ),
        Column("command", commands, ("to see it",), str),
    ]


def _section(
    title: str, hint: str, flights: Sequence[Row], without: str = ""
) -> Section:
    more = (
        f" The first {MOST_ROWS} of {len(flights)}." if len(flights) > MOST_ROWS else ""
    )
    columns = (
        column for column in columns_of(flights[:MOST_ROWS]) if column.name != without
    )
    table = html_table(*told(columns), sort=True)
    return Section(
        f"{title} ({len(flights)})",
        f"{hint}{more}",
        table if flights else "<p>None.</p>",
    )


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"
