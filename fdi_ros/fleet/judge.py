# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The recordings of a fleet, found in folders, and judged as in a replay, in one process or many.

Of each there is a row, and rows of its episodes.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from fdi_ros.bag.csv_file import has_gyros
from fdi_ros.bag.raw import (
    LFS,
    LOG_SUFFIXES,
    SUFFIXES,
    Damage,
    files_of_bag,
    find_files,
)
from fdi_ros.bag.reader import FORMATS
from fdi_ros.bag.samples import Samples, read_block
from fdi_ros.config.config import Config, parameter_file, parameters_of
from fdi_ros.errors import BagError, FdiError
from fdi_ros.fleet.tables import Flight, FlightEpisode, Row, Tables
from fdi_ros.inspection.segments import NoiseSegments
from fdi_ros.inspection.starting_config import starting_config_of
from fdi_ros.model.samples import Block
from fdi_ros.monitor.building import build_geometry
from fdi_ros.monitor.output import Output
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.replay.episodes import Episode
from fdi_ros.replay.page import Report
from fdi_ros.replay.run import Sink, replay, with_unused
from fdi_ros.replay.summary import Summary
from fdi_ros.replay.words import sample_rate_notes
from fdi_ros.report.layout import Severity
from fdi_ros.setup.calibrate import REPLACED, calibrate
from fdi_ros.system.files import open_regular, write_text
from fdi_ros.system.jobs import run_jobs
from fdi_ros.system.text import date_of, shown, storable


def find_recordings(given: Sequence[str]) -> tuple[list[Path], list[str]]:
    """Find all recordings in what is given: each a recording, or a folder, of which all below count, behind links too.

    A file of a rosbag2 folder stands for the folder. Returned are the recordings in order, each once; and what could
    not be searched, or is called like a recording and is none. `BagError` if something given is not there, or nothing
    is found at all.
    """
    found: dict[str, Path] = {}
    unread: list[str] = []
    for path in map(Path, given):
        if not path.exists():
            raise BagError(f"there is no {path}")
        whole = path.parent if path in (files_of_bag(path.parent) or ()) else path
        for recording in _below(path, unread) if path.is_dir() else [whole]:
            found.setdefault(
                os.path.realpath(recording), Path(os.path.abspath(recording))
            )
    if not found:
        expected = f"expected names that end in {', '.join((*SUFFIXES, *LOG_SUFFIXES))}"
        raise BagError(
            "; ".join([f"no recording in {', '.join(given)}: {expected}", *unread])
        )
    return sorted(found.values()), unread


def _below(folder: Path, unread: list[str]) -> Iterator[Path]:
    """Yield the recordings in a folder and below, each folder once: links may lead in circles."""
    walked = set[str]()

    def note(error: OSError) -> None:
        unread.append(f"cannot read {error.filename}: {error.strerror}")

    for place, folders, files in os.walk(folder, onerror=note, followlinks=True):
        here, real = Path(place), os.path.realpath(place)
        if real in walked:
            folders.clear()
            continue
        walked.add(real)
        folders.sort()
        bag = files_of_bag(here)
        if bag is not None:
            yield here
        for path in (here / name for name in sorted(files)):
            # What else lies in the folder of a bag is a part of it, but for logs.
            if (
                bag is None or path.name.lower().endswith(LOG_SUFFIXES)
            ) and _is_recording(path, unread):
                yield path


def _is_recording(path: Path, unread: list[str]) -> bool:
    """Whether a file is a recording; what is only called so is noted."""
    name, suffix = path.name.lower(), path.suffix.lower()
    if not name.endswith((*SUFFIXES, *LOG_SUFFIXES)) or not path.is_file():
        return False
    if not name.endswith(LOG_SUFFIXES):
        return True
    # Firmware and much else is called .bin, too, and any table .csv.
    magic = FORMATS[suffix].magic
    try:
        with open_regular(path) as file:
            if suffix == ".csv":
                return has_gyros(file)
            begin = file.read(len(LFS))
    except OSError:
        # Reading it says what is wrong.
        return True
    # An empty log is a log that was lost; so is one that git has put elsewhere.
    known = not begin or begin.startswith((magic, LFS))
    unread += [] if known else [f"{path} is no flight log"]
    return known


# Judged ---------------------------------------------------------------------------------------------------------------


DEFAULT_SYSTEM = 1  # MAVLink system of an autopilot that nobody gave another number
CALIBRATED = 1_000_000  # samples that a calibration takes at most: the first ones of a long flight


Judged = tuple[Flight, Sequence[FlightEpisode], str]
"""What came of one recording: its rows, and the text of the parameter file that it was judged with, empty if none."""


def judge_all(
    paths: Sequence[Path],
    parameters: str,
    calibrated: bool,
    tables: Tables,
    workers: int,
    cluster: str | None,
    show: Callable[[float], object],
    reports: Path | None = None,
) -> None:
    """Judge the recordings that are not in the tables as they are now, and write the tables.

    Parameters
    ----------
    paths
        The recordings.
    parameters
        Text of a parameter file; empty: what ``fdi inspect`` writes for each recording.
    calibrated
        Whether each recording is calibrated on itself.
    tables
        The tables, which take the rows.
    workers, cluster
        As of `run_jobs`.
    show
        Called with the share done.
    reports
        Folder for a page of each recording; None: no pages.

    Raises
    ------
    FdiError
        If nothing can be written, or the cluster is lost.
    """
    jobs = []
    for path in paths:
        # The last name of a folder alone may be shared: drone_1/logs and drone_2/logs are not one vehicle.
        flight = Flight(
            storable(str(path)), storable(str(path.parent)), digest_of(path)
        )
        row = tables.flights.get(flight.path)
        # What could not be judged is tried again: it may be mended.
        if row is not None and _is_done(row, flight.digest, reports):
            continue
        jobs.append((path, flight, parameters, calibrated, reports))
    there = len(paths) - len(jobs)
    try:
        done = run_jobs(
            judge, jobs, workers, cluster, lambda k, words: _failed(jobs[k][1], words)
        )
        for count, (_, judged) in enumerate(done, 1):
            flight, episodes, text = judged
            tables.add(
                replace(flight, config=tables.keep_config(text) if text else ""),
                episodes,
            )
            show((there + count) / len(paths))
    finally:
        tables.write()


def _is_done(row: Row, digest: str, reports: Path | None) -> bool:
    """Whether a recording was judged as it is now, and its page is there if pages are asked for."""
    if row["digest"] != digest or row["error"]:
        return False
    return reports is None or (reports.parent / row["report"]).is_file()


def digest_of(path: Path) -> str:
    """Tell a recording as it is now from itself after a change, without reading it."""
    stats: list[tuple[str, int, int]] = []
    # Reading it says what is wrong.
    with suppress(BagError, OSError):
        for file in (*find_files(path, Damage()), *path.glob("metadata.yaml")):
            about = file.stat()
            stats.append((file.name, about.st_size, about.st_mtime_ns))
    return hashlib.sha256(repr(stats).encode("utf-8", "backslashreplace")).hexdigest()[
        :32
    ]


def judge(
    path: Path,
    flight: Flight,
    parameters: str,
    calibrated: bool,
    reports: Path | None = None,
) -> Judged:
    """Judge one recording, and write its page into a folder of reports.

    ``flight``: what of its row is known before. An error goes into the row.
    """
    try:
        return _judged(path, flight, parameters, calibrated, reports)
    except FdiError as error:
        return _failed(flight, str(error))
    except (
        Exception
    ) as error:  # A defect met in one recording must not cost the others.
        return _failed(flight, f"defect of fdi_ros: {type(error).__name__}: {error}")


def _failed(flight: Flight, error: str) -> Judged:
    words = storable(" ".join(error.split()))
    return replace(flight, error=words, why=(f"could not be judged: {words}",)), (), ""


def _judged(
    path: Path,
    flight: Flight,
    parameters: str,
    calibrated: bool,
    reports: Path | None,
) -> Judged:
    text, flight = parameters, replace(flight, measured=bool(parameters))
    unused: tuple[tuple[str, str], ...] = ()
    if not parameters:
        start = starting_config_of(path, "no config")
        text, unused = start.text, start.unused
    if calibrated:
        try:
            text, flight = (
                _calibrated(path, text),
                replace(flight, calibration="on itself", measured=True),
            )
        except FdiError as error:
            flight = replace(flight, calibration=storable(f"refused: {error}"))
    config = Config.from_parameters(parameters_of(text))
    seen = _Seen(config)
    page = Report(build_geometry(config), config.sample_rate) if reports else None
    sinks = [seen, page] if page else [seen]
    summary = with_unused(replay(path, config, sinks=sinks), unused)
    if seen.hardware_id:
        flight = replace(flight, vehicle=seen.hardware_id)
    elif seen.system is not None and seen.system != DEFAULT_SYSTEM:
        flight = replace(
            flight, vehicle=f"{flight.vehicle}, MAVLink system {seen.system}"
        )
    if reports and page:
        name = f"{storable(path.stem)}-{hashlib.sha256(flight.path.encode()).hexdigest()[:8]}.html"
        about = {"recording": flight.path, "vehicle": flight.vehicle}
        write_text(reports / name, page.html(summary, about))
        flight = replace(flight, report=storable(f"{reports.name}/{name}"))
    origin = summary.stream.origin_ns
    if not summary.scores.samples or origin is None:
        raise BagError(
            "its topics have no time in common: there is no sample of all channels"
        )
    noise = tuple(seen.segments.noise().quiet.tolist())
    date = _date(origin + round(summary.scores.start_s * 1e9))
    row = _row(replace(flight, date=date, noise=noise), summary)
    return row, [_episode_row(row, one, origin) for one in summary.story.episodes], text


def _calibrated(path: Path, parameters: str) -> str:
    """Return the text of a parameter file, calibrated on a recording."""
    given = parameters_of(parameters)
    config = Config.from_parameters(given)
    result = calibrate(
        read_block(path, config, end=CALIBRATED / config.sample_rate), config
    )
    kept = {name: value for name, value in given.items() if name not in REPLACED}
    return parameter_file(
        {**kept, **result.settings}, f"made by fdi calibrate from {shown(path.name)}"
    )


class _Seen(Sink):
    """Collects what a summary does not have: noise of the channels, and identity of the vehicle."""

    def __init__(self, config: Config) -> None:
        self._rate, self.segments = (
            config.sample_rate,
            NoiseSegments(build_geometry(config).n),
        )
        self.hardware_id = ""
        """Serial number of the board of the autopilot, empty if the log has none."""
        self.system: int | None = None
        """MAVLink system of the autopilot, None if the log has none."""

    def begin(self, samples: Samples) -> None:
        """Note which vehicle recorded it."""
        self.hardware_id = storable(shown(samples.recording.hardware_id))
        self.system = samples.recording.system

    def add(self, block: Block, output: Output, pipeline: Pipeline) -> None:
        whole = np.isfinite(block.z).all(axis=1)
        self.segments.add(block.z[whole], block.stamp[whole], self._rate)


def _row(known: Flight, summary: Summary) -> Flight:
    """Return the row of a recording that was judged."""
    monitor, stream, declared = summary.monitor, summary.stream, summary.story.declared
    # What hides for a while, and comes back as it was, is declared once.
    steps = [step for one in declared for step in one.steps]
    found = summary.verdict
    why: list[str] = []
    if found.severity is not Severity.GOOD:
        # A verdict lists the first concerns only, and none beside a fault.
        rest = [str(one) for one in summary.concerns if str(one) not in found.sentence]
        why = [found.sentence, *(f"{words}." for words in rest)]
    return replace(
        known,
        why=(*known.why, *why, *sample_rate_notes(stream.sample_rate)),
        duration=summary.scores.duration_s,
        damage=stream.damage,
        watched=math.fsum(one.watched_s for one in summary.story.stretches),
        episodes=len(declared),
        declared=sum(
            len(step.channels) if step.state == "FAULTY" else step.state == "AMBIGUOUS"
            for step in steps
        ),
        sets=sum(step.state == "AMBIGUOUS" for step in steps),
        degraded=monitor.degraded,
        channels=tuple(one.name for one in monitor.channels),
        unchecked=tuple(one.unchecked for one in monitor.channels),
        bias=monitor.bias.value,
    )


def _episode_row(flight: Flight, one: Episode, origin: int) -> FlightEpisode:
    """Return the row of an episode; `origin`: what its times count from, ns."""
    sizes = [
        each.size
        for each in ([one.apart] if one.apart is not None else one.candidates)
        if each.size is not None
    ]
    largest = max(sizes, key=lambda size: abs(size.rad_s), default=None)
    return FlightEpisode(
        path=flight.path,
        vehicle=flight.vehicle,
        date=_date(origin + round(one.start_s * 1e9)),
        state=one.state,
        declares=one.declares,
        channels=one.channels,
        start=one.start_s,
        end=one.end_s,
        size=None if largest is None else largest.rad_s,
        size_std=None if largest is None else largest.std_rad_s,
        measured_in=one.measured_in,
        words=one.words,
    )


def _date(stamp: int) -> str | None:
    """Return the date of a stamp, ns, UTC; None: it counts from a start."""
    date = date_of(stamp)
    return None if date is None else f"{date:%Y-%m-%dT%H:%M:%SZ}"
