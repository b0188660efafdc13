# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Finds the recordings of a fleet and judges them as a replay does, in one process or many.

Each recording has a row of its own, and one row per episode.
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
    TABLE_SUFFIXES,
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
from fdi_ros.inspection.starting_config import starting_config_of, turned_units
from fdi_ros.model.samples import Block
from fdi_ros.monitor.building import build_geometry
from fdi_ros.monitor.output import Output
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.replay.episodes import Episode
from fdi_ros.replay.page import report_of
from fdi_ros.replay.run import Sink, replay, with_unused
from fdi_ros.replay.summary import Summary
from fdi_ros.replay.words import sample_rate_notes
from fdi_ros.report.layout import Severity
from fdi_ros.setup.calibrate import REPLACED, calibrate
from fdi_ros.system.files import open_regular, write_text
from fdi_ros.system.jobs import run_jobs
from fdi_ros.system.text import date_of, shown, storable


def find_recordings(given: Sequence[str]) -> tuple[list[Path], list[str]]:
    """Find all recordings in some paths.

    A folder counts with all recordings below, links included. A file of a rosbag2 folder stands for
    its folder.

    Returns
    -------
    The recordings in order, each once. The places that could not be searched, and files that are
    named like a recording but are none.

    Raises
    ------
    BagError
        If a path does not exist, or no recording is found.
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
    """Yield the recordings in a folder and below. Links may form circles, so each folder counts once."""
    walked = set[str]()

    def note(error: OSError) -> None:
        unread.append(f"cannot read {error.filename}: {error.strerror}")

    for place, folders, files in os.walk(folder, onerror=note, followlinks=True):
        here = Path(place)
        real = os.path.realpath(place)
        if real in walked:
            folders.clear()
            continue
        walked.add(real)
        folders.sort()
        bag = files_of_bag(here)
        if bag is not None:
            yield here
        for path in (here / name for name in sorted(files)):
            # Other files in the folder of a bag belong to the bag, except logs.
            if (
                bag is None or path.name.lower().endswith(LOG_SUFFIXES)
            ) and _is_recording(path, unread):
                yield path


def _is_recording(path: Path, unread: list[str]) -> bool:
    """Whether a file is a recording. A file that is only named like one is added to ``unread``."""
    name = path.name.lower()
    suffix = path.suffix.lower()
    if not name.endswith((*SUFFIXES, *LOG_SUFFIXES)) or not path.is_file():
        return False
    if not name.endswith(LOG_SUFFIXES):
        return True
    # Firmware is called .bin, too, and any table .csv or .tsv.
    magic = FORMATS[suffix].magic
    try:
        with open_regular(path) as file:
            if suffix in TABLE_SUFFIXES:
                return has_gyros(file)
            begin = file.read(len(LFS))
    except OSError:
        # Reading the file will report the error.
        return True
    # An empty log was lost, and a pointer of git-lfs is no log.
    known = not begin or begin.startswith((magic, LFS))
    unread += [] if known else [f"{path} is no flight log"]
    return known


# Judging


DEFAULT_SYSTEM = 1
"""Default MAVLink system of an autopilot."""
MOST_CALIBRATION_SAMPLES = 1_000_000
"""Largest number of samples of a calibration, the first ones of a long flight."""


Judged = tuple[Flight, Sequence[FlightEpisode], str]
"""Result for one recording: its rows, and the text of its parameter file. Empty: no file."""


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
    """Judge the recordings that are new or have changed, and write the tables.

    Parameters
    ----------
    paths
        The recordings.
    parameters
        Text of a parameter file. Empty: the config that ``fdi inspect`` writes for each recording.
    calibrated
        Whether each recording is calibrated on itself.
    tables
        The tables for the rows.
    workers, cluster
        As for `run_jobs`.
    show
        Called with the share done.
    reports
        Folder for a page of each recording. None: no pages.

    Raises
    ------
    FdiError
        If the tables cannot be written, or the cluster is lost.
    """
    jobs = []
    for path in paths:
        # The whole path identifies a vehicle: drone_1/logs and drone_2/logs are two.
        flight = Flight(
            storable(str(path)), storable(str(path.parent)), digest_of(path)
        )
        row = tables.flights.get(flight.path)
        # A recording with an error is tried again, because it may be repaired.
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
    """Whether a recording was judged in its present form, with its page if pages are wanted."""
    if row["digest"] != digest or row["error"]:
        return False
    return reports is None or (reports.parent / row["report"]).is_file()


def digest_of(path: Path) -> str:
    """Return a digest of names, sizes and times, which shows a change without reading the files."""
    stats: list[tuple[str, int, int]] = []
    # Reading the recording will report the error.
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

    ``flight``: known part of its row. An error becomes part of the row.
    """
    try:
        return _judged(path, flight, parameters, calibrated, reports)
    except FdiError as error:
        # The line begins with the path already.
        words = str(error).removeprefix(str(path)).removeprefix(":").strip()
        return _failed(flight, words)
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
    text = parameters
    flight = replace(flight, measured=bool(parameters))
    unused: tuple[tuple[str, str], ...] = ()
    if not parameters:
        start = starting_config_of(path, "no config")
        text = start.text
        unused = start.unused
        config = Config.from_parameters(start.parameters)
        if not calibrated and (turned := turned_units(path, config)):
            raise BagError(
                f"{turned}: give --config with the mounts that fdi setup finds"
            )
    if calibrated:
        try:
            text = _calibrated(path, text)
            flight = replace(flight, calibration="on itself", measured=True)
        except FdiError as error:
            flight = replace(flight, calibration=storable(f"refused: {error}"))
    config = Config.from_parameters(parameters_of(text))
    seen = _Seen(config)
    page = report_of(config) if reports else None
    sinks = [seen, page] if page else [seen]
    summary = with_unused(replay(path, config, sinks=sinks), unused)
    if seen.hardware_id:
        flight = replace(flight, vehicle=seen.hardware_id)
    elif seen.system is not None and seen.system != DEFAULT_SYSTEM:
        flight = replace(
            flight, vehicle=f"{flight.vehicle}, MAVLink system {seen.system}"
        )
    if reports and page:
        digest = hashlib.sha256(flight.path.encode()).hexdigest()
        name = f"{storable(path.stem)}-{digest[:8]}.html"
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
        read_block(path, config, end=MOST_CALIBRATION_SAMPLES / config.sample_rate),
        config,
    )
    kept = {name: value for name, value in given.items() if name not in REPLACED}
    return parameter_file(
        {**kept, **result.settings}, f"made by fdi calibrate from {shown(path.name)}"
    )


class _Seen(Sink):
    """Collects noise of the channels and identity of the vehicle, which a summary lacks."""

    def __init__(self, config: Config) -> None:
        self._rate, self.segments = (
            config.sample_rate,
            NoiseSegments(build_geometry(config).n),
        )
        self.hardware_id = ""
        """Serial number of the autopilot's board. Empty: not in the log."""
        self.system: int | None = None
        """MAVLink system of the autopilot. None: not in the log."""

    def begin(self, samples: Samples) -> None:
        """Store the identity of the vehicle."""
        self.hardware_id = storable(shown(samples.recording.hardware_id))
        self.system = samples.recording.system

    def add(self, block: Block, output: Output, pipeline: Pipeline) -> None:
        whole = np.isfinite(block.z).all(axis=1)
        self.segments.add(block.z[whole], block.stamp[whole], self._rate)


def _row(known: Flight, summary: Summary) -> Flight:
    """Return the row of a judged recording."""
    monitor = summary.monitor
    stream = summary.stream
    declared = summary.story.declared
    # A declared channel that was silent for a while is declared once.
    steps = [step for one in declared for step in one.steps]
    found = summary.verdict
    why: list[str] = []
    if found.severity is not Severity.GOOD:
        # A verdict lists only the first concerns, and none beside a fault.
        rest = [one for one in summary.concerns if str(one) not in found.sentence]
        why = [found.sentence, *(one.sentence for one in rest)]
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
    """Return the row of an episode. ``origin``: stamp of time zero, ns."""
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
    """Return the date of a stamp, ns, UTC. None: stamps count from a start."""
    date = date_of(stamp)
    return None if date is None else f"{date:%Y-%m-%dT%H:%M:%SZ}"
