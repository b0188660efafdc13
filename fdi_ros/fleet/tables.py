# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The tables of a fleet as Parquet files, one row per recording and one per episode, and its page.

The fields are the columns. Their meaning and unit go into the schema of the files.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import shlex
import time
from collections import Counter
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
from fdi_ros.system.text import LINE, first_of, percent, shown, storable

Row = Mapping[str, Any]
"""Values of a row by the names of the columns. None: unknown."""
VERSION = 5
"""Version of the columns, raised if one changes its name, type or meaning."""
WRITE_AFTER, WRITE_SHARE = 5.0, 0.05
"""Time between writes of the tables, s, and largest share of the time for writing. A killed run
loses the rows since the last write."""


def _column(meaning: str, unit: str = "", default: Any = None) -> Any:
    return field(default=default, metadata={"meaning": meaning, "unit": unit})


@dataclass(frozen=True)
class Flight:
    """One judged recording."""

    path: str = _column("path of the recording")
    vehicle: str = _column(
        "serial number of the autopilot's board if the log has one; else the path of the"
        " folder, with the MAVLink system unless that is 1"
    )
    digest: str = _column(
        "hash of names, sizes and times of the files; after a change it is judged again"
    )
    error: str = _column("why it could not be judged; empty: it was judged", default="")
    why: tuple[str, ...] = _column(
        "why the flight needs attention; empty: it does not", default=()
    )
    config: str = _column("parameter file of the replay", default="")
    report: str = _column(
        "page of its replay, below the folder of the tables; empty: not written",
        default="",
    )
    calibration: str = _column(
        "'on itself', or why it could not be calibrated; empty: not wanted", default=""
    )
    measured: bool | None = _column(
        "whether mounts and axes were measured; false: assumed as by fdi inspect"
    )
    date: str | None = _column(
        "date of the first sample, UTC; null: stamps count from a start, as in a log without GPS"
    )
    duration: float | None = _column("from the first sample to the last", "s")
    damage: tuple[str, ...] | None = _column("parts that could not be read")
    watched: float | None = _column("judged time without a standing declaration", "s")
    episodes: int | None = _column(
        "faults declared, each from its first declaration to its end"
    )
    declared: int | None = _column(
        "declarations of a faulty channel, or of a set that contains one"
    )
    sets: int | None = _column("declarations of sets of several channels")
    degraded: tuple[str, ...] | None = _column("degradations without a declaration")
    channels: tuple[str, ...] | None = _column(
        "names of the channels; the next three are in their order"
    )
    unchecked: tuple[float, ...] | None = _column(
        "share of the values of the channel whose fault no other channel could have shown"
    )
    noise: tuple[float, ...] | None = _column(
        "lowest noise of each gyro in one sample; gyros come first", "rad/s"
    )
    bias: tuple[float, ...] | None = _column(
        "bias of each channel at the end, the configured bias included",
        "rad/s; m/s^2 of accelerometers",
    )


@dataclass(frozen=True)
class FlightEpisode:
    """One episode of a flight: a declared fault, or channels without data."""

    path: str = _column("path of the recording")
    vehicle: str = _column("vehicle of the flight")
    date: str | None = _column("date of its start, UTC; null: the flight has no date")
    state: str = _column("last state: FAULTY, AMBIGUOUS or STALE")
    declares: bool = _column(
        "whether a fault was declared; false: channels without data only"
    )
    channels: tuple[str, ...] = _column(
        "channels in that state; if AMBIGUOUS, one of them is faulty"
    )
    start: float = _column("time of the first declaration, from the first message", "s")
    end: float = _column("time of the last withdrawal, or end of the stretch", "s")
    size: float | None = _column(
        "error measured by the other channels; for two channels on one axis, their difference",
        "as in measured_in",
    )
    size_std: float | None = _column("standard error of the size", "as in measured_in")
    measured_in: str = _column("unit of the error: rad/s, or m/s^2 of accelerometers")
    words: str = _column("the episode in one sentence")


class Tables:
    """The folder of a fleet with its rows. The folder is made if it does not exist.

    Rows of recordings that are not given again stay.

    Parameters
    ----------
    folder
        Path of the folder.
    settings
        Settings that decide the results, ready for JSON.
    force
        Discard rows of other settings.

    Raises
    ------
    BagError
        If the tables belong to something else or to other settings, or another run writes there.
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
            # The lock is held as long as this object exists.
            self._lock = os.fdopen(os.open(folder / ".lock", flags, 0o666), "rb")
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise BagError(f"another fdi fleet writes to {folder}") from error
        except OSError as error:
            raise BagError(
                f"cannot write to {folder}: {error.strerror or error}"
            ) from error
        try:
            flights = self._read("flights", force)
            episodes = self._read("episodes", force)
        except (BagError, OSError):
            self.give_up()
            raise
        self.flights: dict[str, Row] = {row["path"]: row for row in flights}
        self._episodes: dict[str, list[Row]] = {path: [] for path in self.flights}
        for row in episodes:
            # Episodes without a flight are dropped, because the flight is judged again.
            self._episodes.get(row["path"], []).append(row)
        self._written = time.monotonic()
        self._took = 0.0

    def give_up(self) -> None:
        """Remove the files of a refused run. A folder with other content stays."""
        with suppress(OSError):
            (self._folder / ".lock").unlink()
            (self._folder / "configs").rmdir()
            self._folder.rmdir()

    def add(self, flight: Flight, episodes: Sequence[FlightEpisode]) -> None:
        """Add the rows of a recording in place of its earlier ones, with texts in Unicode."""
        self.flights[flight.path], self._episodes[flight.path] = (
            plain(flight),
            list(map(plain, episodes)),
        )
        if time.monotonic() - self._written > max(
            WRITE_AFTER, self._took / WRITE_SHARE
        ):
            self.write()

    def write(self) -> None:
        """Write the tables, sorted by path. Episodes come first, so that no flight lacks its own."""
        begun = time.monotonic()
        paths = sorted(self.flights)
        self._save(
            "episodes",
            FlightEpisode,
            [row for path in paths for row in self._episodes[path]],
        )
        self._save("flights", Flight, [self.flights[path] for path in paths])
        self._written = time.monotonic()
        self._took = self._written - begun

    def keep_config(self, text: str) -> str:
        """Store a parameter file and return its path."""
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
            # Python opens the file, because its name may be no Unicode.
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
        # Annotations with None become nullable columns.
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


# The page: flights that need attention come first


MOST_TABLE_ROWS = 2000
"""Largest number of flights in a table of the page. flights.parquet has all."""
LOOKS = 10
"""Largest number of flights with reasons that a terminal shows."""


class Fleet:
    """The flights of some rows, the most worrying first."""

    def __init__(self, flights: Sequence[Row]) -> None:
        def rank(row: Row) -> tuple[int, int, bool, str]:
            declared = row["declared"] or 0
            sets = row["sets"] or 0
            return sets - declared, -declared, not row["error"], row["path"]

        self.flights = sorted(flights, key=rank)
        self.looks = [row for row in self.flights if row["why"]]
        self.calm = [row for row in self.flights if not row["why"]]
        self.judged = [row for row in flights if not row["error"]]

    def figures(self) -> dict[str, Any]:
        """Return all figures by name, and the flights that need attention."""
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
        """Verdict on the fleet: the number of flights that need attention."""
        count = _count(len(self.flights), "flight")
        if not self.looks:
            return Verdict(Severity.GOOD, f"HEALTHY: {count}, none needs a look.")
        counts = Counter(map(_class_of, self.looks))
        met = [word for word in _CLASSES if counts[word]]
        words = ", ".join(f"{counts[word]} {word}" for word in met)
        sentence = f"LOOK AT {len(self.looks)} of {count}: {words}."
        if self.calm:
            are = "is" if len(self.calm) == 1 else "are"
            sentence += f" The other {len(self.calm)} {are} HEALTHY."
        severity = Severity.BAD if counts["FAULTY"] else Severity.UNKNOWN
        return Verdict(severity, sentence)

    def lines(self) -> list[str]:
        """Return the result in sentences, the verdict first."""
        own = self.figures()
        declaring = sum(row["episodes"] > 0 for row in self.judged)
        faults = f"{_count(own['episodes'], 'fault')} declared"
        if declaring:
            faults += f", in {_count(declaring, 'flight')}"
        faulty = [row for row in self.looks if _class_of(row) == "FAULTY"]
        if silent := sum(not row["episodes"] for row in faulty):
            faults += f"; in {_count(silent, 'flight')} a unit fell silent for good"
        counts = (
            f"{_count(own['vehicles'], 'vehicle')}; {faults};"
            f" {own['watched'] / 3600:.2f} hours judged without a declared fault."
        )
        paths = [row["path"] for row in self.judged if row["damage"]]
        names = [path.rpartition("/")[2] for path in paths]
        damaged = (
            f"{_count(own['damaged'], 'recording')} could not be read whole:"
            f" {shown(first_of(names, most=3), LINE)}."
        )
        assumed = (
            f"For {_count(own['not_measured'], 'flight')} the mounts and axes are assumed, not measured, so"
            " declarations may be wrong: give --config or --calibrate."
        )
        more = [damaged] if own["damaged"] else []
        more += [assumed] if own["not_measured"] else []
        return [self.verdict.words, counts, *more]

    def text(self) -> str:
        """Return the sentences and the first flights that need attention, for a terminal."""
        looks = [
            f"{shown(row['path'])}: {shown(' '.join(row['why']), LINE)}"
            for row in self.looks[:LOOKS]
        ]
        hidden = len(self.looks) - LOOKS
        more = [f"and {hidden} more, in the page and tables"] if hidden > 0 else []
        lines = [*self.lines(), *looks, *more]
        return "".join(f"{line}\n" for line in lines)

    def html(self, about: Mapping[str, str], notes: Sequence[str] = ()) -> str:
        """Lay out the page.

        ``about``: how the flights were judged. ``notes``: more sentences below the verdict.
        """
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
        _, *others = self.lines()
        return page("fdi_ros: fleet", [self.verdict, *others, *notes], sections)


_CLASSES = ("FAULTY", "CANNOT TELL", "LOOK", "not judged")
"""Classes of flights that need attention, the worst first."""


def _class_of(row: Row) -> str:
    """Return the class of a flight that needs attention: the word of its replay."""
    if row["error"]:
        return "not judged"
    word = row["why"][0].partition(":")[0]
    # The settings of a healthy flight may still need a look.
    return word if word in _CLASSES else "LOOK"


def columns_of(flights: Sequence[Row]) -> list[Column]:
    """Return the columns of the flights, for the page and for JSON."""

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
            lambda shares: percent(max(shares or (), default=None)),
        ),
        column("episodes", "faults", lambda count: number(count, "d")),
        Column("declared", [row["declared"] for row in flights]),
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
        f" The first {MOST_TABLE_ROWS} of {len(flights)}."
        if len(flights) > MOST_TABLE_ROWS
        else ""
    )
    columns = (
        column
        for column in columns_of(flights[:MOST_TABLE_ROWS])
        if column.name != without
    )
    table = html_table(*told(columns), sort=True)
    return Section(
        f"{title} ({len(flights)})",
        f"{hint}{more}",
        table if flights else "<p>None.</p>",
    )


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"
