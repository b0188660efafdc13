# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The rows of the datasets: one per flight, per episode, per event, and per injected fault; the fields are the columns.

What a column holds and its unit stand at the field, and go into the schema of the Parquet files.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

VERSION = 2
"""Of the columns: raised when one changes its name, type or meaning."""


def _column(kind: str, meaning: str, unit: str = "") -> Any:
    default: dict[str, Any] = {"string": "", "list<string>": (), "list<double>": (), "list<float>": ()}
    return field(default=default.get(kind), metadata={"type": kind, "meaning": meaning, "unit": unit})


@dataclass(frozen=True)
class Flight:
    """One recording as it was judged; None where nothing can be said."""

    flight: str = _column("string", "what tells it from all others: path, size, time of change and settings, hashed")
    path: str = _column("string", "where the recording lies, whole path")
    vehicle: str = _column("string", "folder in which it lies, whole path")
    error: str = _column("string", "why it could not be judged; empty if it was")
    damage: str = _column("string", "what of it could not be read")
    config: str = _column("string", "parameter file it was judged with")
    calibration: str = _column("string", "what it was calibrated on, or why it could not be; empty: not asked")
    measured: bool | None = _column("bool", "false: mounts and axes are what fdi inspect assumes, not measured")
    start: int | None = _column("int64", "stamp of the first sample", "ns")
    date: str = _column("string", "of that sample, UTC; empty: its stamps count from a start, as of a log without GPS")
    duration: float | None = _column("double", "from the first sample to the last", "s")
    stretches: int | None = _column("int64", "parts between gaps of more than 10 s, each judged for itself")
    samples: int | None = _column("int64", "aligned samples")
    messages: int | None = _column("int64", "messages used")
    malformed: int | None = _column("int64", "messages that could not be read")
    rate: float | None = _column("double", "usual number of samples per second", "Hz")
    gaps: int | None = _column("int64", "intervals longer than three usual ones")
    longest_gap: float | None = _column("double", "longest interval", "s")
    judged: float | None = _column("double", "share of the samples after start-up that were judged")
    judged_time: float | None = _column("double", "time that was judged, without gaps", "s")
    note: str = _column("string", "why checking was limited at the end")
    degraded: str = _column("string", "what became worse than it should be without being declared")
    doubts: str = _column("string", "what of the settings does not fit the recording")
    watched: float | None = _column("double", "time that was judged while nothing stood declared", "s")
    episodes: int | None = _column("int64", "faults told of that began while nothing else stood declared")
    happened: tuple[str, ...] = _column("list<string>", "what happened, a sentence for each episode")
    declared: int | None = _column("int64", "declarations: a channel faulty, or a set one of which is")
    sets: int | None = _column("int64", "of these, sets of several channels")
    suspected: int | None = _column("int64", "times a channel was suspected")
    events_left_out: int | None = _column("int64", "changes of state beyond those in the table of events")
    largest: float | None = _column("double", "largest statistic, as a share of its threshold")
    largest_at: float | None = _column("double", "when that was, from the first sample", "s")
    course: tuple[float, ...] = _column("list<float>", "the same, largest in each of equal parts of the time")
    not_injected: str = _column("string", "why faults could not be injected, at all or at some times; empty: they were")
    channels: tuple[str, ...] = _column("list<string>", "names of the channels; the lists below are in their order")
    axes: tuple[str, ...] = _column("list<string>", "axis of the body that each measures, or its direction")
    state: tuple[str, ...] = _column("list<string>", "state of each channel at the end")
    reason: tuple[str, ...] = _column("list<string>", "why it is in that state")
    noise_rest: tuple[float, ...] = _column("list<double>", "noise per sample at the quietest", "rad/s")
    noise_motion: tuple[float, ...] = _column("list<double>", "noise per sample in motion, vibration included", "rad/s")
    vibration: tuple[float, ...] = _column("list<double>", "what motion adds to the noise", "rad/s")
    mean_rest: tuple[float, ...] = _column(
        "list<double>", "mean at the quietest: the bias where nothing turns", "rad/s"
    )
    bias: tuple[float, ...] = _column("list<double>", "taken off at the end: given, learned and followed", "rad/s")
    bias_state: str = _column("string", "where that comes from, or why it could not be learned")
    difference: tuple[float, ...] = _column(
        "list<double>", "mean of each channel less what the other units say of its axis, no bias taken off", "rad/s"
    )
    difference_std: tuple[float, ...] = _column("list<double>", "standard deviation of that within the flight", "rad/s")
    difference_course: tuple[float, ...] = _column(
        "list<float>", "its mean in each of equal parts of the time, channel after channel", "rad/s"
    )
    units: tuple[str, ...] = _column("list<string>", "names of the units; the lists below are in their order")
    delay: tuple[float, ...] = _column("list<double>", "by how much the stamps are late against the first unit's", "s")
    delay_std: tuple[float, ...] = _column("list<double>", "standard deviation of that", "s")


@dataclass(frozen=True)
class FlightEpisode:
    """One episode of one flight: a fault as the monitor told of it, or channels that gave nothing."""

    flight: str = _column("string", "as in the flights")
    path: str = _column("string", "where the recording lies, whole path")
    vehicle: str = _column("string", "folder in which it lies, whole path")
    date: str = _column("string", "of its start, UTC; empty: the flight has no date")
    stretch: int = _column("int64", "number of the part between long gaps that it lies in, from 1")
    state: str = _column("string", "what it came to: FAULTY, AMBIGUOUS or STALE")
    declares: bool = _column("bool", "whether a fault was declared; otherwise channels only gave nothing")
    who: str = _column("string", "the channels in words")
    channels: tuple[str, ...] = _column("list<string>", "which are, or of which one is where it is AMBIGUOUS")
    axes: tuple[str, ...] = _column("list<string>", "axes of the body that these measure")
    start: float = _column("double", "first declaration, from the first sample", "s")
    since: float = _column("double", "since when it was these channels in this state", "s")
    end: float = _column("double", "when nothing of it stood any more, or its stretch ended", "s")
    stands: bool = _column("bool", "whether it stood at the end of its stretch")
    size: float | None = _column("double", "error by the others; between channels of one axis, how far apart", "rad/s")
    size_std: float | None = _column("double", "standard error of that", "rad/s")
    course: str = _column("string", "steady, growing, shrinking, varying, noisy, proportional to the rate, or gone")
    ratio: float | None = _column("double", "largest statistic, as a share of its threshold")
    reason: str = _column("string", "why")
    published: float = _column("double", "share of its samples with a fused rate")
    words: str = _column("string", "all in one sentence")


@dataclass(frozen=True)
class FlightEvent:
    """One change of state of one channel in one flight."""

    flight: str = _column("string", "as in the flights")
    path: str = _column("string", "where the recording lies, whole path")
    vehicle: str = _column("string", "folder in which it lies, whole path")
    at: float = _column("double", "from the first sample", "s")
    stamp: int = _column("int64", "stamp of the sample that brought it", "ns")
    channel: str = _column("string", "name of the channel")
    before: str = _column("string", "state before")
    after: str = _column("string", "state after")
    declares: bool = _column("bool", "whether it declares a fault")
    group: tuple[str, ...] = _column("list<string>", "channels one of which is faulty; otherwise the channel alone")
    reason: str = _column("string", "why")
    error: float = _column("double", "estimated error of the channel", "rad/s")


@dataclass(frozen=True)
class InjectedFault:
    """One fault injected into one flight, and what came of it."""

    flight: str = _column("string", "as in the flights")
    path: str = _column("string", "where the recording lies, whole path")
    vehicle: str = _column("string", "folder in which it lies, whole path")
    channel: str = _column("string", "name of the faulty channel")
    fault: str = _column("string", "kind, size and other numbers")
    kind: str = _column("string", "kind of fault")
    size: float | None = _column("double", "its size; in the unit of the kind")
    at: float = _column("double", "when it began, from the first sample", "s")
    outcome: str = _column("string", "named, in a set, silent, false set, or wrong: a healthy channel was declared")
    named_after: float | None = _column("double", "until the channel was declared by itself", "s")
    found_after: float | None = _column("double", "until the channel was declared by itself or in a set", "s")


@dataclass(frozen=True)
class Judged:
    """What came of one recording."""

    flight: Flight
    events: tuple[FlightEvent, ...] = ()
    episodes: tuple[FlightEpisode, ...] = ()
    faults: tuple[InjectedFault, ...] = ()
    parameters: str = ""
    """Text of the calibrated parameter file; empty if it was not calibrated for itself."""


TABLES: dict[str, type] = {
    "flights": Flight,
    "episodes": FlightEpisode,
    "events": FlightEvent,
    "faults": InjectedFault,
}


def columns(table: type) -> list[tuple[str, str, str, str]]:
    """Name, type, meaning and unit of the columns of a table."""
    return [(one.name, one.metadata["type"], one.metadata["meaning"], one.metadata["unit"]) for one in fields(table)]
