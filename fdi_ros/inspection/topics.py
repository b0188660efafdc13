# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The topics of a recording: possible gyros, and their noise at rest and in motion."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.bag.raw import Batch, Topic
from fdi_ros.bag.reader import Recording
from fdi_ros.config.settings import LEAST_NOISE
from fdi_ros.core.copies import copies_among
from fdi_ros.core.messages import ENCAPSULATION, frame_of
from fdi_ros.core.sources import Source, source_of_type
from fdi_ros.inspection.repeats import Repeats
from fdi_ros.inspection.segments import Noise, NoiseSegments
from fdi_ros.inspection.values import Values
from fdi_ros.model.quantity import FORCE
from fdi_ros.model.samples import Array, Int
from fdi_ros.monitor.soundness import WHOLE
from fdi_ros.report.layout import (
    RADIANS,
    Column,
    Unit,
    figures_of,
    indented,
    table,
    told,
)
from fdi_ros.system.files import RECORDING
from fdi_ros.system.text import date_of, figures, listed, percent, shown


class _Intervals(NamedTuple):
    """How the intervals between messages of a topic are judged."""

    #: intervals longer than this many usual ones are gaps
    gap: float = 3.0
    #: intervals by which the usual one is known
    settled: int = 100
    #: usual interval over the most frequent one: beyond, messages come in bursts
    burst_ratio: float = 2.0
    #: messages of a topic whose intervals are kept
    most: int = 1_000_000


INTERVALS = _Intervals()

#: messages in a row in which copies are looked for
RECENT_MESSAGES = 256
#: larger values are damage, rad/s; their squares must not overflow
BELIEVED = 1e6


@dataclass
class TopicReport:
    """Observations on one topic."""

    #: name, type and number of messages
    topic: Topic
    #: reader of gyros for its type, or None
    kind: type[Source] | None
    #: number of messages read
    received: int = 0
    #: number of messages that could not be decoded
    malformed: int = 0
    #: time of recording of the first message, ns
    first: int = 0
    #: the same of the last one
    last: int = 0
    #: usual interval, s, 0 while unknown
    interval: float = 0.0
    #: number of intervals that are too long
    gaps: int = 0
    #: longest interval, s
    longest: float = 0.0
    #: stamps that do not increase
    backward: int = 0
    #: messages that repeat stamp and values of the one before
    again: int = 0
    #: longest step back of the stamps, s
    set_back: float = 0.0
    #: messages with an earlier time of recording than the message ahead
    disordered: int = 0
    #: lead of the first stamps over their times of recording, s, NaN if not stamped
    ahead: float = math.nan
    #: values in a message of possible gyros, else 0
    channels: int = 0
    #: values that a message announces, whatever its length
    announced: int = 0
    #: largest possible rate, rad/s, or NaN
    largest: float = math.nan
    #: largest rate in two messages in a row, rad/s, or NaN: a spike is in one
    lasting: float = math.nan
    #: s, of the first million messages
    intervals: list[Array] = field(default_factory=list)
    #: s, from stamp to stamp, of the first million messages
    stamp_steps: list[Array] = field(default_factory=list)
    #: first and last stamp, ns, or None
    stamps: tuple[int, int] | None = None
    #: frame_id of the first well-formed message with a stamp, None before
    frame: str | None = None
    #: whether a later message has another one
    frame_changes: bool = False
    #: topic of the same sensor: the same values to rounding, turned, scaled or some
    #: messages apart
    copy_of: str = ""
    #: message of the flight log and device, empty: no flight log
    origin: str = ""

    def __post_init__(self) -> None:
        self.expect(0)

    def expect(self, channels: int) -> None:
        """Expect messages with this number of values."""
        self.channels, self.repeats = channels, Repeats(channels)
        self.values = Values(channels)
        self.segments = NoiseSegments(
            channels
        )  # of messages in which every value can be a rate
        self.not_finite, self.beyond = np.zeros(
            (2, channels), dtype=np.int64
        )  # (c,) values that are not finite, and values beyond all rates
        self.recent = np.zeros(
            (0, channels)
        )  # (K, c) values of the last messages, at most `RECENT_MESSAGES`
        # Specific forces over the natural size of `FORCE`: then the same test finds rest.
        self.forces = NoiseSegments(channels)

    @property
    def rate(self) -> float:
        """Messages a second, usually, each counted once."""
        if self.again >= WHOLE.stamps * max(1, self.received) and self.stamp_interval:
            return 1.0 / self.stamp_interval
        return 1.0 / self.interval if self.interval > 0 else 0.0

    @property
    def stamp_interval(self) -> float:
        """Usual interval of the stamps, s. 0: too few, or they do not increase."""
        steps = np.concatenate([np.empty(0), *self.stamp_steps])
        return usual_interval(steps) if len(steps) >= INTERVALS.settled else 0.0

    @property
    def burst(self) -> int:
        """Usual number of stamps in a burst, 1 for single stamps."""
        steps = np.concatenate([np.empty(0), *self.stamp_steps])
        if len(steps) < INTERVALS.settled:
            return 1
        usual = usual_interval(steps)
        if usual <= INTERVALS.burst_ratio * float(np.median(steps)):
            return 1
        breaks = max(1, int((steps > usual).sum()))
        return max(2, round(len(steps) / breaks))

    @property
    def places(self) -> list[str]:
        """Names of the values in a message."""
        return (
            list(self.kind.value_names(self.channels)) if self.kind is not None else []
        )

    @property
    def copied(self) -> str:
        """Words for a topic that repeats the values of another."""
        return f"gives the values of {shown(self.copy_of)}"

    @property
    def could_be_gyros(self) -> bool:
        """Whether the topic carries rates, or as many numbers as channels are possible."""
        return self.channels > 0 and (
            self.complete or bool((self.not_finite + self.beyond).any())
        )

    @property
    def force_noise(self) -> Noise | None:
        """Noise of the accelerometers, m/s^2. None if no message has a specific force."""
        if self.forces.empty:
            return None
        quiet, moving, rest = self.forces.noise()
        return Noise(FORCE.natural * quiet, FORCE.natural * moving, rest)

    @property
    def complete(self) -> bool:
        """Whether some message holds possible rates only."""
        return not self.segments.empty


class Inspection(NamedTuple):
    """What reading a recording once shows."""

    #: one per topic
    reports: list[TopicReport]
    #: lines about damage
    damage: tuple[str, ...]
    #: gyros that cannot be read as such, and why
    unread: tuple[tuple[str, str], ...]
    #: what makes the recording incomplete, as it continues ``the recording``, may be empty
    incomplete: str = ""


def inspect(path: Path, topics: Sequence[str] = ()) -> Inspection:
    """Read a recording once, all topics or those with these names (first slash optional).

    `BagError` if reading fails.
    """
    with Recording(path) as recording:
        wanted = {name.lstrip("/") for name in topics}
        reports = [
            TopicReport(
                topic,
                source_of_type(topic.type),
                origin=recording.context.origins.get(topic.name, ""),
            )
            for topic in recording.topics
            if not wanted or topic.name.lstrip("/") in wanted
        ]
        for batch in recording.batches([report.topic.name for report in reports]):
            for k in np.unique(batch.topic).tolist():
                _update(reports[k], batch, np.flatnonzero(batch.topic == k))
            possible = [
                one
                for one in reports
                if not one.copy_of and one.kind is not None and one.kind.stamped
            ]
            for first, second in copies_among([one.recent for one in possible]):
                possible[second].copy_of = (
                    possible[second].copy_of or possible[first].topic.name
                )
        for report in reports:
            _settle(report)
        damage = recording.damage
        words = "is damaged" if damage.lost else ""
        return Inspection(reports, damage.report(), tuple(damage.left_out), words)


def _update(report: TopicReport, batch: Batch, rows: Int) -> None:
    times = batch.log_time[rows]
    _take_times(report, times)
    kind = report.kind
    messages = (batch.buffer, batch.offset[rows], batch.length[rows])
    if kind is None or report.topic.encoding != "cdr":
        return
    if not report.channels:
        report.announced = kind.announced(*messages)
        if report.announced not in kind.value_counts:
            return
        report.expect(report.announced)
    # A unit's messages may also have a specific force, behind the rate.
    width = 2 * report.channels if kind.stamped else report.channels
    decoded = kind.decode(*messages, width)
    good = decoded.good
    report.malformed += int((~good).sum())
    stamp = decoded.stamp[good]
    values = decoded.values[good, : report.channels]
    force = decoded.values[good, report.channels :]
    times = times[good]
    again = np.zeros(len(stamp), dtype=bool)
    if kind.stamped:
        _take_frames(report, batch, rows[good])
        again = _take_stamps(report, stamp, values)
        if math.isnan(report.ahead) and len(stamp):
            report.ahead = float(np.median((stamp - times) * 1e-9))
    with np.errstate(invalid="ignore"):
        finite = np.isfinite(values)
        believed = np.abs(values) < BELIEVED
    report.repeats.add(values, report.interval)
    report.values.add(np.where(believed, values, np.nan))
    report.not_finite += (~finite).sum(axis=0)
    report.beyond += (finite & ~believed).sum(axis=0)
    if believed.any():
        largest = np.abs(values[believed]).max()
        report.largest = float(np.fmax(report.largest, largest))
    sizes = np.abs(np.vstack([report.recent[-1:], values]))
    pairs = np.maximum(sizes[1:], sizes[:-1]) < BELIEVED
    if pairs.any():
        lasting = np.minimum(sizes[1:], sizes[:-1])[pairs].max()
        report.lasting = float(np.fmax(report.lasting, lasting))
    report.recent = np.vstack([report.recent, values])[-RECENT_MESSAGES:]
    # A message that comes again is no sample of its own, and has no noise.
    whole = believed.all(axis=1) & ~again
    report.segments.add(values[whole], times[whole], report.rate)
    if kind.stamped:
        felt = np.isfinite(force).all(axis=1) & ~again
        report.forces.add(force[felt] / FORCE.natural, times[felt], report.rate)


def usual_interval(steps: Array) -> float:
    """Return the usual interval of messages, s, from the times (k,) between them, s.

    For single messages this is the median, for bursts the mean over longer runs.
    """
    median = float(np.median(steps))
    run = min(INTERVALS.settled // 2, len(steps))
    ends = np.concatenate([[0.0], np.cumsum(steps)])
    mean = float(np.median(ends[run:] - ends[:-run])) / run
    return mean if mean > INTERVALS.burst_ratio * median else median


def _take_times(report: TopicReport, times: Int) -> None:
    """Take the times of recording (k,) of further messages, ns, k > 0."""
    before = [report.last] if report.received else []
    steps = np.diff(np.concatenate([before, times])) * 1e-9
    report.first = report.first if report.received else int(times[0])
    report.last = int(times[-1])
    report.received += len(times)
    if not len(steps):
        return
    report.disordered += int((steps < 0.0).sum())
    report.longest = max(report.longest, float(steps.max()))
    if report.received - len(times) < INTERVALS.most:
        report.intervals.append(steps)
    if report.interval > 0:
        report.gaps += int((steps > INTERVALS.gap * report.interval).sum())
    elif report.received > INTERVALS.settled:
        _settle(report)


def _settle(report: TopicReport) -> None:
    """Take the usual interval of the messages so far, and count the gaps among them."""
    if report.interval > 0 or not report.intervals:
        return
    steps = np.concatenate(report.intervals)
    report.interval = usual_interval(steps)
    if report.interval > 0:
        report.gaps = int((steps > INTERVALS.gap * report.interval).sum())


def _take_frames(report: TopicReport, batch: Batch, rows: Int) -> None:
    """Take the frame_id of further well-formed messages."""
    if not len(rows):
        return
    frame = frame_of(batch.message(int(rows[0])))
    # A frame is followed by doubles of more than RECORDING.name_length bytes, so each message is this long.
    size = min(len(frame.encode()) + 1, RECORDING.name_length)
    begin = batch.offset[rows] + ENCAPSULATION + 12
    frames = batch.buffer[begin[:, np.newaxis] + np.arange(size)]
    report.frame = frame if report.frame is None else report.frame
    differ = bool((frames != frames[0]).any())
    report.frame_changes |= frame != report.frame or differ


def _take_stamps(report: TopicReport, stamp: Int, values: Array) -> NDArray[np.bool_]:
    """Take the stamps (k,), ns, and values (k, c) of further messages.

    Return which messages (k,) repeat stamp and values of the one before.
    """
    again = np.zeros(len(stamp), dtype=bool)
    if not len(stamp):
        return again
    first, *before = (int(stamp[0]),) if report.stamps is None else report.stamps
    steps = np.diff(np.concatenate([before, stamp])) * 1e-9
    report.backward += int((steps <= 0.0).sum())
    report.set_back = max(report.set_back, -float(steps.min(initial=0.0)))
    if len(steps):
        known = np.vstack([report.recent[-1:], values])[-len(steps) - 1 :]
        alike = (known[1:] == known[:-1]).all(axis=1)
        again[-len(steps) :] = (steps == 0.0) & alike
    report.again += int(again.sum())
    if report.received <= INTERVALS.most:
        # A message that comes again is no second one of a burst.
        report.stamp_steps.append(steps[~again[len(again) - len(steps) :]])
    report.stamps = first, int(stamp[-1])
    return again


def recording_text(reports: Sequence[TopicReport], bag: Path) -> str:
    """Describe date, duration and size."""
    figures = recording_figures(reports, bag, ())
    words = "no messages"
    if (first := figures["start_ns"]) is not None:
        date = date_of(first)
        begun = (
            f", no date, stamps from {first * 1e-9:.1f} s on"
            if date is None
            else f" from {date:%Y-%m-%d %H:%M:%S} UTC"
        )
        words = f"{figures['duration_s']:.1f} s{begun}"
    return f"{shown(bag.name)}: {words}, {figures['size_bytes'] / 1e6:.1f} MB\n\n"


def recording_figures(
    reports: Sequence[TopicReport], bag: Path, damage: Sequence[str]
) -> dict[str, Any]:
    """All figures by name, SI units: for programs."""
    recorded = [report for report in reports if report.received]
    first = min((report.first for report in recorded), default=None)
    last = max((report.last for report in recorded), default=None)
    date = None if first is None else date_of(first)
    files = (
        [path for path in bag.rglob("*") if path.is_file()] if bag.is_dir() else [bag]
    )
    topics = figures_of(topic_columns(reports))
    return {
        "bag": str(bag),
        "start_ns": first,
        "start": None if date is None else date.isoformat(),
        "duration_s": None if first is None or last is None else (last - first) * 1e-9,
        "size_bytes": sum(path.stat().st_size for path in files),
        "damage": list(damage),
        "topics": [
            {name: value for name, value in row.items() if value is not None}
            for row in topics
        ],
    }


def _noise_columns(reports: Sequence[TopicReport], unit: Unit) -> list[Column]:
    """Return columns of noise: of possible gyros, and of accelerometers."""
    gyros = [
        report.segments.noise() if report.could_be_gyros else None for report in reports
    ]
    forces = [report.force_noise for report in reports]

    def noise(values: Array | None) -> str:
        if values is None or not np.isfinite(values).any():
            return "-"
        values = values * unit.factor
        if len(values) > 3:
            return f"{figures(np.nanmin(values), 2)} to {figures(np.nanmax(values), 2)}"
        return " ".join(figures(value, 2) for value in values)

    return [
        Column(
            "quiet_noise",
            [one and one.quiet for one in gyros],
            ("lowest noise",),
            noise,
        ),
        Column(
            "moving_noise",
            [one and one.moving for one in gyros],
            ("noise in motion",),
            noise,
        ),
        Column("moving_share", [one and one.share for one in gyros]),
        Column("accelerometer_quiet_noise", [one and one.quiet for one in forces]),
        Column("accelerometer_moving_noise", [one and one.moving for one in forces]),
    ]


def topic_columns(reports: Sequence[TopicReport], unit: Unit = RADIANS) -> list[Column]:
    """Return columns of figures; those of values only for possible gyros."""

    def of_values(figure: Callable[[TopicReport], object]) -> list[object]:
        return [figure(report) if report.could_be_gyros else None for report in reports]

    return [
        Column("name", [report.topic.name for report in reports], ("topic",), shown),
        Column(
            "type",
            [report.topic.type for report in reports],
            ("type",),
            lambda kind: shown(kind or "unknown"),
        ),
        *(
            [Column("origin", [one.origin or None for one in reports], ("in the log",))]
            if any(one.origin for one in reports)
            else []
        ),
        Column("messages", [report.received for report in reports], ("messages",)),
        Column("rate_hz", [report.rate for report in reports], ("rate",), ".1f"),
        Column("gaps", [report.gaps for report in reports], ("gaps",)),
        Column(
            "longest_gap_s",
            [report.longest for report in reports],
            ("longest gap",),
            ".3f",
        ),
        Column("malformed", [report.malformed for report in reports]),
        Column("could_be_gyros", [report.could_be_gyros for report in reports]),
        Column("values", of_values(lambda report: report.channels)),
        Column("not_finite", of_values(lambda report: report.not_finite)),
        Column("beyond_all_rates", of_values(lambda report: report.beyond)),
        Column("repeated", of_values(lambda report: report.repeats.count)),
        Column("stamps_not_increasing", of_values(lambda report: report.backward)),
        Column("stamps_ahead_s", of_values(lambda report: report.ahead)),
        Column("spikes", of_values(lambda report: report.segments.spikes)),
        Column("accelerometer_spikes", of_values(lambda report: report.forces.spikes)),
        Column("largest", of_values(lambda report: report.largest)),
        *_noise_columns(reports, unit),
        Column("", [_gyros(report, unit) for report in reports], ("content",)),
    ]


def topics_text(
    reports: Sequence[TopicReport], damage: Sequence[str], unit: Unit = RADIANS
) -> str:
    """Lay out the topics."""
    notes = [
        f"note: {shown(report.topic.name)}: {', '.join(words)}\n"
        for report in reports
        if report.could_be_gyros and (words := troubles(report, unit))
    ]
    notes += [f"note: {line}\n" for line in damage]
    units = "rate: Hz, by the median interval; longest gap: s"
    if any(report.could_be_gyros for report in reports):
        units += (
            f"; noise: standard deviation of one sample of each channel, {unit.name};"
        )
        units += " rotation and slow shaking are no noise"
    return (
        indented(table(*told(topic_columns(reports, unit)), figures=False))
        + f"{units}\n"
        + "".join(notes)
    )


def _gyros(report: TopicReport, unit: Unit) -> str:
    """Describe a topic as possible gyros."""
    if not report.could_be_gyros:
        return "no"
    largest = f"up to {figures(report.largest * unit.factor)} {unit.name}"
    words = [
        f"{report.channels} gyros",
        largest if math.isfinite(report.largest) else "none with a rate",
    ]
    words += (
        ["never all usable at once"]
        if math.isfinite(report.largest) and not report.complete
        else []
    )
    words += [report.copied] if report.copy_of else []
    words += (
        [f"moving {percent(report.segments.noise().share)} of the time"]
        if report.complete
        else []
    )
    if (noise := report.force_noise) is not None and np.isfinite(noise.quiet).any():
        low = np.nanmin(noise.quiet)
        high = np.nanmax(noise.quiet)
        size = f"noise {figures(low, 2)} to {figures(high, 2)} {FORCE.unit}"
        constant = "constant values, not judged"
        words.append(
            f"{report.channels} accelerometers, {size if high > LEAST_NOISE else constant}"
        )
    return ", ".join(words)


def burst_words(report: TopicReport) -> str:
    """Words for stamps that come in bursts."""
    return f"its stamps come in bursts of about {report.burst}, and do not show when it measured"


def troubles(report: TopicReport, unit: Unit = RADIANS) -> list[str]:
    """List the troubles with the values of a topic, by their places in the message."""
    beyond = f"beyond {figures(BELIEVED * unit.factor)} {unit.name}"
    words = []
    saturated = report.values.saturated
    for why, counts in (
        ("not finite", report.not_finite),
        (beyond, report.beyond),
        ("at the end of the range", saturated),
        ("one value for 1 s or more", np.maximum(report.repeats.count - saturated, 0)),
        ("spikes", report.segments.spikes),
        ("spikes of the accelerometers", report.forces.spikes),
    ):
        counted = zip(report.places, counts.tolist(), strict=True)
        lines = [f"{place} in {n}" for place, n in counted if n]
        noun = "message" if counts.max() == 1 else "messages"
        words += [f"{why}: {listed(lines)} {noun}"] if lines else []
    words += [f"{report.malformed} malformed"] if report.malformed else []
    if report.backward == 1:
        words.append("1 stamp does not increase")
    elif report.backward:
        words.append(f"{report.backward} stamps do not increase")
    words += [burst_words(report)] if report.burst > 1 else []
    return words
