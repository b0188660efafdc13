# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The flights of a fleet: which recordings are judged, and the rows that are kept of each; the fields are the columns.

What a column holds and its unit stand at the field, and go into the schema of the Parquet files.
"""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fdi_ros import __version__
from fdi_ros.bag.raw import LOG_SUFFIXES, SUFFIXES, files_of_bag
from fdi_ros.bag.reader import LOGS
from fdi_ros.errors import BagError

if TYPE_CHECKING:
    import pyarrow

LISTS = (".txt", ".list")
"""Suffixes of files that list recordings."""
MOST = 1_000_000
"""Recordings of one run."""


@dataclass(frozen=True)
class Recordings:
    """What was found."""

    paths: tuple[Path, ...]
    """In order, each recording once."""
    unread: tuple[str, ...] = ()
    """Folders below those given that could not be searched, and why."""


def find_recordings(given: Sequence[str]) -> Recordings:
    """Find all recordings.

    Parameters
    ----------
    given
        Each a recording; a folder, of which all recordings below count, those behind links too; a pattern with ``*``,
        ``?`` or ``**``; or a file that ends in .txt or .list and has one of these per line, relative to itself; lines
        that begin with ``#``, and what follows `` #``, are comments. A file of a rosbag2 folder stands for the folder.

    Raises
    ------
    BagError
        If something given is not there, or nothing is found at all.
    """
    found: dict[tuple[int, int] | str, Path] = {}
    search = _Search()
    for text in given:
        for path in search.expanded(text):
            path = Path(os.path.abspath(path))
            found.setdefault(_identity(path), path)
            if len(found) > MOST:
                raise BagError(f"more than {MOST} recordings: judge them in several runs")
    if not found:
        expected = f"expected names that end in {', '.join((*SUFFIXES, *LOG_SUFFIXES))}"
        raise BagError("; ".join([f"no recording in {', '.join(given)}: {expected}", *search.unread]))
    return Recordings(tuple(sorted(found.values())), tuple(search.unread))


def vehicle_of(path: Path) -> str:
    """Name of the vehicle: the whole path of the folder in which the recording lies.

    The last name alone may be shared: ``drone_1/logs`` and ``drone_2/logs`` are not one vehicle.
    """
    return str(path.absolute().parent)


def _identity(path: Path) -> tuple[int, int] | str:
    """Tell one and the same recording under several names: links, hard ones too."""
    try:
        about = path.stat()
    except OSError:
        return str(path)
    return about.st_dev, about.st_ino


def _may_be_log(path: Path) -> bool:
    """Whether a file begins as a flight log does: firmware and much else is called .bin, too."""
    magic = LOGS[path.suffix.lower()].magic
    try:
        with path.open("rb") as file:
            begin = file.read(len(magic))
    except OSError:
        # Reading it will say what is wrong.
        return True
    # An empty log is a log that was lost.
    return not begin or begin == magic


class _Search:
    """Walks folders, each once: links may lead in circles."""

    def __init__(self) -> None:
        self.unread: list[str] = []
        self._walked: set[str] = set()
        self._links: list[Path] = []

    def expanded(self, text: str) -> Iterator[Path]:
        """All recordings that something given on the command line stands for."""
        path = Path(text)
        if path.suffix in LISTS and path.is_file():
            for number, line in enumerate(path.read_text(encoding="utf-8-sig", errors="replace").splitlines(), 1):
                if entry := re.split(r"(?:^|\s)#", line)[0].strip():
                    if entry.endswith(LISTS):
                        raise BagError(f"{path}, line {number}: {entry} is a list itself")
                    try:
                        yield from self._there(str(path.parent / entry))
                    except BagError as error:
                        raise BagError(f"{path}, line {number}: {error}") from error
        else:
            yield from self._there(text)

    def _there(self, text: str) -> Iterator[Path]:
        path = Path(text)
        if path.exists():
            yield from self._at(path)
            return
        matches = sorted(glob.glob(text, recursive=True)) if glob.has_magic(text) else []
        if not matches:
            raise BagError(f"there is no {text}")
        for match in map(Path, matches):
            if match.is_dir() or match.name.lower().endswith(SUFFIXES) or self._is_log(match):
                yield from self._at(match)

    def _at(self, path: Path) -> Iterator[Path]:
        """All recordings at a place that is there."""
        if path.is_dir():
            yield from self._below(path)
            # Behind a link lies what may be found by its own name, too: that one counts.
            while self._links:
                yield from self._below(self._links.pop(0))
        else:
            yield path.parent if path in (files_of_bag(path.parent) or ()) else path

    def _below(self, folder: Path) -> Iterator[Path]:
        """All recordings in a folder; the files of a rosbag2 folder are one."""
        place = os.path.realpath(folder)
        if place in self._walked:
            return
        self._walked.add(place)
        try:
            children = sorted(folder.iterdir())
            kinds = [(child, child.is_dir(), child.is_file()) for child in children]
            bag = files_of_bag(folder)
        except OSError as error:
            self.unread.append(f"cannot read {folder}: {error.strerror}")
            return
        if bag is not None:
            yield folder
        for child, is_folder, is_file in kinds:
            if is_folder:
                if child.is_symlink():
                    self._links.append(child)
                else:
                    yield from self._below(child)
            elif is_file and (self._is_log(child) or (bag is None and child.name.lower().endswith(SUFFIXES))):
                yield child

    def _is_log(self, path: Path) -> bool:
        """Whether a file found is a flight log; what is only called so is noted."""
        # Autopilots write .BIN, too.
        if not path.name.lower().endswith(LOG_SUFFIXES):
            return False
        if not _may_be_log(path):
            self.unread.append(f"{path} is no flight log")
            return False
        return True


# Their rows -----------------------------------------------------------------------------------------------------------


VERSION = 2
"""Of the columns: raised when one changes its name, type or meaning."""


def _column(meaning: str, unit: str = "", default: Any = None) -> Any:
    return field(default=default, metadata={"meaning": meaning, "unit": unit})


def _text(meaning: str) -> Any:
    return _column(meaning, default="")


def _list(meaning: str, unit: str = "") -> Any:
    return _column(meaning, unit, ())


Coarse = float
"""Kept in four bytes."""


@dataclass(frozen=True)
class Flight:
    """One recording as it was judged; None where nothing can be said."""

    flight: str = _text("what tells it from all others: path, size, time of change and settings, hashed")
    path: str = _text("where the recording lies, whole path")
    vehicle: str = _text("folder in which it lies, whole path")
    error: str = _text("why it could not be judged; empty if it was")
    damage: str = _text("what of it could not be read")
    config: str = _text("parameter file it was judged with")
    calibration: str = _text("what it was calibrated on, or why it could not be; empty: not asked")
    measured: bool | None = _column("false: mounts and axes are what fdi inspect assumes, not measured")
    start: int | None = _column("stamp of the first sample", "ns")
    date: str = _text("of that sample, UTC; empty: its stamps count from a start, as of a log without GPS")
    duration: float | None = _column("from the first sample to the last", "s")
    stretches: int | None = _column("parts between gaps of more than 10 s, each judged for itself")
    samples: int | None = _column("aligned samples")
    messages: int | None = _column("messages used")
    malformed: int | None = _column("messages that could not be read")
    rate: float | None = _column("usual number of samples per second", "Hz")
    gaps: int | None = _column("intervals longer than three usual ones")
    longest_gap: float | None = _column("longest interval", "s")
    judged: float | None = _column("share of the samples after start-up that were judged")
    judged_time: float | None = _column("time that was judged, without gaps", "s")
    note: str = _text("why checking was limited at the end")
    degraded: str = _text("what became worse than it should be without being declared")
    doubts: str = _text("what of the settings does not fit the recording")
    watched: float | None = _column("time that was judged while nothing stood declared", "s")
    episodes: int | None = _column("faults told of that began while nothing else stood declared")
    happened: tuple[str, ...] = _list("what happened, a sentence for each episode")
    declared: int | None = _column("declarations: a channel faulty, or a set one of which is")
    sets: int | None = _column("of these, sets of several channels")
    suspected: int | None = _column("times a channel was suspected")
    events_left_out: int | None = _column("changes of state beyond those in the table of events")
    largest: float | None = _column("largest statistic, as a share of its threshold")
    largest_at: float | None = _column("when that was, from the first sample", "s")
    course: tuple[Coarse, ...] = _list("the same, largest in each of equal parts of the time")
    not_injected: str = _text("why faults could not be injected, at all or at some times; empty: they were")
    channels: tuple[str, ...] = _list("names of the channels; the lists below are in their order")
    axes: tuple[str, ...] = _list("axis of the body that each measures, or its direction")
    state: tuple[str, ...] = _list("state of each channel at the end")
    reason: tuple[str, ...] = _list("why it is in that state")
    noise_rest: tuple[float, ...] = _list("noise per sample at the quietest", "rad/s")
    noise_motion: tuple[float, ...] = _list("noise per sample in motion, vibration included", "rad/s")
    vibration: tuple[float, ...] = _list("what motion adds to the noise", "rad/s")
    mean_rest: tuple[float, ...] = _list("mean at the quietest: the bias where nothing turns", "rad/s")
    bias: tuple[float, ...] = _list("taken off at the end: given, learned and followed", "rad/s")
    bias_state: str = _text("where that comes from, or why it could not be learned")
    difference: tuple[float, ...] = _list(
        "mean of each channel less what the other units say of its axis, no bias taken off", "rad/s"
    )
    difference_std: tuple[float, ...] = _list("standard deviation of that within the flight", "rad/s")
    difference_course: tuple[Coarse, ...] = _list(
        "its mean in each of equal parts of the time, channel after channel", "rad/s"
    )
    units: tuple[str, ...] = _list("names of the units; the lists below are in their order")
    delay: tuple[float, ...] = _list("by how much the stamps are late against the first unit's", "s")
    delay_std: tuple[float, ...] = _list("standard deviation of that", "s")


@dataclass(frozen=True)
class _OfFlight:
    flight: str = _text("as in the flights")
    path: str = _text("where the recording lies, whole path")
    vehicle: str = _text("folder in which it lies, whole path")


@dataclass(frozen=True)
class FlightEpisode(_OfFlight):
    """One episode of one flight: a fault as the monitor told of it, or channels that gave nothing."""

    date: str = _text("of its start, UTC; empty: the flight has no date")
    stretch: int = _column("number of the part between long gaps that it lies in, from 1")
    state: str = _text("what it came to: FAULTY, AMBIGUOUS or STALE")
    declares: bool = _column("whether a fault was declared; otherwise channels only gave nothing")
    who: str = _text("the channels in words")
    channels: tuple[str, ...] = _list("which are, or of which one is where it is AMBIGUOUS")
    axes: tuple[str, ...] = _list("axes of the body that these measure")
    start: float = _column("first declaration, from the first sample", "s")
    since: float = _column("since when it was these channels in this state", "s")
    end: float = _column("when nothing of it stood any more, or its stretch ended", "s")
    stands: bool = _column("whether it stood at the end of its stretch")
    size: float | None = _column("error by the others; between channels of one axis, how far apart", "rad/s")
    size_std: float | None = _column("standard error of that", "rad/s")
    course: str = _text("steady, growing, shrinking, varying, noisy, proportional to the rate, or gone")
    ratio: float | None = _column("largest statistic, as a share of its threshold")
    reason: str = _text("why")
    published: float = _column("share of its samples with a fused rate")
    words: str = _text("all in one sentence")


@dataclass(frozen=True)
class FlightEvent(_OfFlight):
    """One change of state of one channel in one flight."""

    at: float = _column("from the first sample", "s")
    stamp: int = _column("stamp of the sample that brought it", "ns")
    channel: str = _text("name of the channel")
    before: str = _text("state before")
    after: str = _text("state after")
    declares: bool = _column("whether it declares a fault")
    group: tuple[str, ...] = _list("channels one of which is faulty; otherwise the channel alone")
    reason: str = _text("why")
    error: float = _column("estimated error of the channel", "rad/s")


@dataclass(frozen=True)
class InjectedFault(_OfFlight):
    """One fault injected into one flight, and what came of it."""

    channel: str = _text("name of the faulty channel")
    fault: str = _text("kind, size and other numbers")
    kind: str = _text("kind of fault")
    size: float | None = _column("its size; in the unit of the kind")
    at: float = _column("when it began, from the first sample", "s")
    outcome: str = _text("named, in a set, silent, false set, or wrong: a healthy channel was declared")
    named_after: float | None = _column("until the channel was declared by itself", "s")
    found_after: float | None = _column("until the channel was declared by itself or in a set", "s")


@dataclass(frozen=True)
class Judged:
    """What came of one recording."""

    flight: Flight
    episodes: tuple[FlightEpisode, ...] = ()
    events: tuple[FlightEvent, ...] = ()
    faults: tuple[InjectedFault, ...] = ()
    parameters: str = ""
    """Text of the calibrated parameter file; empty if it was not calibrated for itself."""

    def rows(self, table: str) -> tuple[Any, ...]:
        """Return its rows of a table."""
        rows: tuple[Any, ...] = (self.flight,) if table == "flights" else getattr(self, table)
        return rows


TABLES = {"flights": Flight, "episodes": FlightEpisode, "events": FlightEvent, "faults": InjectedFault}


def schema_of(table: str) -> pyarrow.Schema:
    """Return the schema of a table: types, and meaning and unit of every column."""
    import pyarrow as arrow

    types = {
        "str": arrow.string(),
        "int": arrow.int64(),
        "float": arrow.float64(),
        "bool": arrow.bool_(),
        "tuple[str, ...]": arrow.list_(arrow.string()),
        "tuple[float, ...]": arrow.list_(arrow.float64()),
        "tuple[Coarse, ...]": arrow.list_(arrow.float32()),
    }
    # As annotated: of what may be unknown, None too.
    columns = ((one.name, types[str(one.type).removesuffix(" | None")], one.metadata) for one in fields(TABLES[table]))
    return arrow.schema(
        [arrow.field(name, kind, metadata=dict(about)) for name, kind, about in columns],
        metadata={"fdi_ros": __version__, "columns": str(VERSION)},
    )
