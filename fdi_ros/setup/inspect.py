# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What is in a recording, which topics could be gyros, and how noisy they are at rest and in motion."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fdi_ros.bag.raw import Batch, Topic
from fdi_ros.bag.reader import Recording
from fdi_ros.compiling.record import MAX_CHANNELS
from fdi_ros.config.config import is_plain_name
from fdi_ros.config.settings import LEAST_NOISE
from fdi_ros.estimator.blocks import REST_MEAN, REST_STD, rests
from fdi_ros.estimator.estimator import REST_BLOCKS
from fdi_ros.model.geometry import MIN_CHANNELS
from fdi_ros.model.samples import Array, Bytes, Int
from fdi_ros.monitor.encoder import OUTPUTS
from fdi_ros.report.layout import RADIANS, Column, Unit, figures_of, indented, table, told
from fdi_ros.setup.blocks import Repeats
from fdi_ros.sources import SOURCES, Source, source_of_type
from fdi_ros.system.text import date_of, shown

LENGTH = 1.0
"""Of a stretch, s; longer where so few samples are in it that it could not be cut into blocks."""
SMOOTH = np.array([-2.0, 3.0, 6.0, 7.0, 6.0, 3.0, -2.0]) / 21.0
"""Local parabola through seven values (Savitzky and Golay 1964): what it leaves is noise, not motion."""
FEWEST, PART = 3, 100
"""So many of the quietest stretches, or one in so many, tell the noise at rest: of a long flight few are."""
ALIKE = 1.5
"""Noise this many times that of the quietest stretches is as quiet."""
ROUNDS = 10
"""In which the quiet ones are found."""
QUIET = 2.0
"""More is that of motion: vibration."""
SLOWER = 2.0
"""Noise that is slower than a block may be so many times the other, and is no motion."""
LARGEST_BIAS = 0.1
"""rad/s."""
MOST = 4096
"""Stretches that are kept; of a longer recording every second one, and so on: memory does not grow with its length."""


@dataclass(frozen=True)
class Stretch:
    """Values of a stretch."""

    first: int
    """Time of its first sample, ns."""
    means: Array
    """(`REST_BLOCKS`, c) of blocks, rad/s."""
    std: Array
    """(c,) of the samples about their mean, rad/s: at rest that is their noise, also where a filter has smoothed it."""
    noise: Array
    """(c,) of a sample, rad/s: what no smooth motion reaches, vibration included; 0: the values never change."""
    block_noise: Array
    """(c,) the same of the blocks, that which is slower included where it is no more than `SLOWER` times as large."""


@dataclass
class Stretches:
    """Stretches of a recording, as they come."""

    channels: int
    """c."""
    kept: list[Stretch] = field(default_factory=list)
    every: int = 1
    """Of so many stretches one is kept."""
    passed: int = 0
    """Stretches so far."""
    waiting: Array = field(default_factory=lambda: np.empty((0, 0)))
    """(K, c) values that do not make a stretch yet."""
    since: int = 0
    """Time of the first of them, ns."""

    def add(self, values: Array, times: Int, rate: float) -> None:
        """Take in values (K, c) rad/s of a rate, Hz (0: not known yet), all finite, at times (K,) ns."""
        if not len(values):
            return
        if len(self.waiting):
            values = np.vstack([self.waiting, values])
            times = np.concatenate([np.full(len(self.waiting), self.since), times])
        size = REST_BLOCKS * max(round(LENGTH * rate / REST_BLOCKS), 1) if rate else len(values) + 1
        full = len(values) // size * size
        for k in range(0, full, size):
            if self.passed % self.every == 0:
                self.kept.append(_stretch(values[k : k + size], int(times[k])))
            self.passed += 1
            if len(self.kept) > MOST:
                self.kept, self.every = self.kept[::2], 2 * self.every
        self.waiting = values[full:]
        self.since = int(times[full]) if full < len(times) else 0

    @property
    def empty(self) -> bool:
        """Whether there is not a single value."""
        return not self.kept and not len(self.waiting)

    def all_of_them(self) -> list[Stretch]:
        """Stretches, with the values at the end if there is no other."""
        whole = len(self.waiting) // REST_BLOCKS * REST_BLOCKS
        return self.kept or ([_stretch(self.waiting[:whole], self.since)] if whole else [])

    def _quietest(self) -> tuple[Array, Array]:
        """Noise (c,) of a sample and of a block when quietest, rad/s.

        The quietest few are so by chance, too: all that are about as quiet tell it without that bias.
        """
        noise, block = (
            np.array([getattr(one, name) for one in self.all_of_them()]) for name in ("noise", "block_noise")
        )
        # Where a unit repeats its values it says nothing of its noise, which is then what it usually is.
        for values in (noise, block):
            for own in values.T:
                if own.any():
                    own[own == 0.0] = np.median(own[own > 0.0])
        quiet = np.argsort((noise**2).sum(axis=1))[: max(FEWEST, len(noise) // PART)]
        for _ in range(ROUNDS):
            alike = np.flatnonzero((noise <= ALIKE * np.median(noise[quiet], axis=0)).all(axis=1))
            if len(alike) <= len(quiet):
                break
            quiet = alike
        return np.median(noise[quiet], axis=0), np.median(block[quiet], axis=0)

    def quiet_noise(self) -> Array:
        """Noise (c,) at rest, or else when quietest, rad/s; NaN: too little was recorded."""
        if not (stretches := self.all_of_them()):
            return np.full(self.channels, np.nan)
        rests = [one.std for one, rest in zip(stretches, self.at_rest(), strict=True) if rest]
        return np.maximum(self._quietest()[0], np.median(rests, axis=0) if rests else 0.0)

    def at_rest(self, largest_bias: float = LARGEST_BIAS) -> list[bool]:
        """For each stretch, whether nothing in it moves: by the monitor's own test, and as quiet as the quietest."""
        if not (stretches := self.all_of_them()):
            return []
        noise, block = self._quietest()
        known = np.full(self.channels, largest_bias**2 / REST_MEAN)
        return [
            bool((one.noise <= QUIET * noise).all())
            and rests(np.ascontiguousarray(one.means), REST_BLOCKS - 1, block**2, known, REST_STD**2)
            for one in stretches
        ]

    def moving_noise(self) -> Array:
        """Noise (c,) in motion, vibration included, rad/s; NaN: it does not move."""
        noise = [one.noise for one, rest in zip(self.all_of_them(), self.at_rest(), strict=True) if not rest]
        if not noise:
            return np.full(self.channels, np.nan)
        return np.array([np.median(own[own > 0.0]) if own.any() else 0.0 for own in np.array(noise).T])

    def moving_share(self) -> float:
        """Share of the recording in motion."""
        rest = self.at_rest()
        return 1.0 - sum(rest) / len(rest) if rest else 0.0


def _stretch(values: Array, first: int) -> Stretch:
    means = values.reshape(REST_BLOCKS, -1, values.shape[1]).mean(axis=1)
    least = _noise(means)
    return Stretch(first, means, values.std(axis=0), _noise(values), np.clip(means.std(axis=0), least, SLOWER * least))


def _noise(values: Array) -> Array:
    inside = len(SMOOTH) // 2
    smooth = np.column_stack([np.convolve(column, SMOOTH, mode="valid") for column in values.T])
    left = values[inside:-inside] - smooth
    # Of white noise the parabola takes its share with it.
    noise = np.sqrt(np.mean(left**2, axis=0) / (1.0 - SMOOTH[inside]))
    return np.where(noise > LEAST_NOISE, noise, 0.0)


GAP = 3.0
"""Intervals longer than this many usual ones are gaps."""
_INTERVALS = 1_000_000
"""Intervals of a topic that are kept at most."""
_USUAL = 0.999
"""Share of the intervals that a timeout must bear."""
FASTEST = 36.0
"""rad/s; the range of the gyros of vehicles is 2000 deg/s, 34.9 rad/s."""
STILL, NOISIEST = 0.3, 0.02
"""Share of a recording that lies still, and noise of a sample there beyond which nothing is in rad/s."""
DEGREES_WORDS = "is it in deg/s? Messages are to be in rad/s: mend the driver, or all settings are 57 times too large"
_CLOCKS = 1.0
"""s by which clocks differ: less may be the time that messages take."""
BELIEVED = 1e6
"""Values beyond are no rates but damage, rad/s; their squares must not overflow."""


@dataclass
class TopicReport:
    """What was seen of one topic."""

    topic: Topic
    kind: type[Source] | None
    """How gyros are read from messages of its type; None: they are not."""
    received: int = 0
    malformed: int = 0
    first: int = 0
    last: int = 0
    """Time of recording of the first and last message, ns."""
    interval: float = 0.0
    """Usual interval, s; 0 before it is known."""
    gaps: int = 0
    longest: float = 0.0
    """Longest interval, s."""
    backward: int = 0
    """Stamps that do not increase."""
    ahead: float = math.nan
    """How far the first stamps are ahead of their times of recording, s; NaN: there are none."""
    channels: int = 0
    """Values in a message, of what could be gyros; else 0."""
    announced: int = 0
    """Values that a message says it has: whatever its bytes claim."""
    not_finite: Int = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """(c,) values that are NaN or infinite."""
    beyond: Int = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """(c,) finite values beyond all rates."""
    repeats: Repeats = field(default_factory=lambda: Repeats(0))
    """Of what could be gyros: values that stay exactly the same for long."""
    largest: float = math.nan
    """Largest value that can be a rate, rad/s; NaN: there is none."""
    intervals: list[Array] = field(default_factory=list)
    stretches: Stretches = field(default_factory=lambda: Stretches(0))
    """Of messages in which every value can be a rate."""

    @property
    def rate(self) -> float:
        """Messages a second, usually."""
        return 1.0 / self.interval if self.interval > 0 else 0.0

    @property
    def repeated(self) -> Int:
        """Values (c,) in long runs of exactly one value."""
        return self.repeats.count

    @property
    def could_be_gyros(self) -> bool:
        """Whether it carries angular rates, or as many numbers as there may be channels."""
        return self.channels > 0 and (self.complete or bool((self.not_finite + self.beyond).any()))

    @property
    def complete(self) -> bool:
        """Whether there is a message in which every value can be a rate."""
        return not self.stretches.empty

    @property
    def looks_like_degrees(self) -> bool:
        """Whether it turns faster, or lies still more noisily, than gyros in rad/s do."""
        if self.largest > FASTEST:
            return True
        still = self.stretches.at_rest(largest_bias=FASTEST)
        return sum(still) > STILL * len(still) and bool((self.stretches.quiet_noise() > NOISIEST).all())

    @property
    def usual_longest(self) -> float:
        """Interval that 999 of 1000 do not exceed, s."""
        return float(np.quantile(np.concatenate(self.intervals), _USUAL)) if self.intervals else 0.0


def inspect(path: Path) -> tuple[list[TopicReport], tuple[str, ...]]:
    """Read a recording through.

    Returns
    -------
    What was seen of each topic, and what of the recording is damaged.

    Raises
    ------
    BagError
        If it cannot be read.
    """
    with Recording(path) as recording:
        reports = [TopicReport(topic, source_of_type(topic.type)) for topic in recording.topics]
        for batch in recording.batches([report.topic.name for report in reports]):
            for k in np.unique(batch.topic).tolist():
                _take(reports[k], batch, np.flatnonzero(batch.topic == k))
        return reports, recording.damage.report()


def _take(report: TopicReport, batch: Batch, rows: Int) -> None:
    times = batch.log_time[rows]
    before = [report.last] if report.received else []
    steps = np.diff(np.concatenate([before, times])) * 1e-9
    report.first = report.first if report.received else int(times[0])
    report.last = int(times[-1])
    report.received += len(rows)
    if len(steps):
        report.interval = report.interval or float(np.median(steps))
        report.gaps += int((steps > GAP * report.interval).sum()) if report.interval > 0 else 0
        report.longest = max(report.longest, float(steps.max()))
        if report.received - len(rows) < _INTERVALS:
            report.intervals.append(steps)
    if report.kind is not None and report.topic.encoding == "cdr":
        _take_values(report, report.kind, batch.buffer, batch.offset[rows], batch.length[rows], times)


def _take_values(report: TopicReport, kind: type[Source], buffer: Bytes, offset: Int, length: Int, times: Int) -> None:
    """Decode what could be angular rates."""
    if not report.channels:
        report.announced = kind.announced(buffer, offset, length)
        report.channels = report.announced if kind.fits(report.announced) else 0
        report.stretches, report.repeats = Stretches(report.channels), Repeats(report.channels)
        report.not_finite, report.beyond = np.zeros((2, report.channels), dtype=np.int64)
    if not report.channels:
        return
    decoded = kind.decode(buffer, offset, length, report.channels)
    good = decoded.good
    report.malformed += int((~good).sum())
    stamp, values = decoded.stamp[good], decoded.values[good]
    if kind.stamped:
        report.backward += int((np.diff(stamp) <= 0).sum())
        if math.isnan(report.ahead) and len(stamp):
            report.ahead = float(np.median((stamp - times[good]) * 1e-9))
    with np.errstate(invalid="ignore"):
        finite, believed = np.isfinite(values), np.abs(values) < BELIEVED
    report.repeats.add(values, report.interval)
    report.not_finite += (~finite).sum(axis=0)
    report.beyond += (finite & ~believed).sum(axis=0)
    if believed.any():
        report.largest = float(np.fmax(report.largest, np.abs(values[believed]).max()))
    whole = believed.all(axis=1)
    report.stretches.add(values[whole], times[good][whole], report.rate)


_OF_A_MONITOR = {output.name.rpartition("/")[2] for output in OUTPUTS}
_PREFERRED = sorted(SOURCES.values(), key=lambda kind: not kind.stamped)
"""Kinds of input, first those with stamps."""
NEEDED = f"{', or '.join(kind.needed() for kind in _PREFERRED)}, are needed"
_NAMED = 8
"""Topics that are named with what is wrong with them."""


def candidates(reports: Sequence[TopicReport]) -> list[TopicReport]:
    """Return the topics a config is made for: up to four units, else the first array that fits.

    What a monitor itself has published is no sensor: the fused rate must not be its own witness.
    """
    possible = [report for report in reports if _is_usable(report)]
    for kind in _PREFERRED:
        alike = [report for report in possible if report.kind is kind]
        if len(alike) >= kind.fewest:
            return alike[: kind.most]
    return []


def clocks_apart(reports: Sequence[TopicReport], beyond: float = _CLOCKS) -> str:
    """Say which units are stamped by clocks so many s and more from the first one's; empty: none is."""
    first = next((report for report in reports if math.isfinite(report.ahead)), None)
    if first is None:
        return ""
    off = [(report.topic.name, report.ahead - first.ahead) for report in reports]
    words = [f"{shown(name)} {abs(v):.6g} s {'ahead' if v > 0 else 'behind'}" for name, v in off if abs(v) > beyond]
    if not words:
        return ""
    return (
        f"stamps are of other clocks than those of {shown(first.topic.name)}: {', '.join(words)}; no instants can be"
        " compared: let the clocks be one (PTP, chrony), or stamp on arrival"
    )


def missing(reports: Sequence[TopicReport]) -> str:
    """Say what a recording lacks of which no config can be made, and what is wrong with each topic that could do."""
    why = [
        f"{shown(report.topic.name)}: {words}"
        for report in reports
        if report.kind is not None and (words := _unusable(report, report.kind))
    ]
    more = [f"and {len(why) - _NAMED} more"] if len(why) > _NAMED else []
    good = [shown(report.topic.name) for report in reports if _is_usable(report)]
    usable = [f"usable: only {', '.join(good)}"] if good else []
    return "; ".join([NEEDED, *usable, *why[:_NAMED], *more])


def _is_usable(report: TopicReport) -> bool:
    return report.kind is not None and report.channels > 0 and not _unusable(report, report.kind)


def _unusable(report: TopicReport, kind: type[Source]) -> str:
    """Say why a topic that could carry gyros cannot be used; empty: it can."""
    # The first that holds is the reason.
    reasons = {
        "no messages": not report.received,
        "a monitor has published it": report.topic.name.rpartition("/")[2] in _OF_A_MONITOR,
        "no name that ROS allows": not is_plain_name(report.topic.name),
        f"{report.announced} values, not {MIN_CHANNELS} to {MAX_CHANNELS}": not kind.stamped and not report.channels,
        f"all {report.received} messages are malformed, or have stamps before 1970": report.malformed
        == report.received,
        f"no message in which all values are finite and below {BELIEVED:g} rad/s": not report.complete,
        "a single message": report.received == 1,
        "its times of recording do not increase": not report.rate,
    }
    return next((words for words, holds in reasons.items() if holds), "")


def recording_text(reports: Sequence[TopicReport], bag: Path) -> str:
    """Describe when it was recorded, how long it is and how large."""
    size = _size(bag) / 1e6
    if (span := _span(reports)) is None:
        return f"{shown(bag.name)}: no messages, {size:.1f} MB\n\n"
    first, last = span
    date = date_of(first)
    begun = f"{date:%Y-%m-%d %H:%M:%S} UTC" if date is not None else f"{first * 1e-9:.1f} s after a start, date unknown"
    return f"{shown(bag.name)}: {(last - first) * 1e-9:.1f} s from {begun}, {size:.1f} MB\n\n"


def recording_figures(reports: Sequence[TopicReport], bag: Path, damage: Sequence[str]) -> dict[str, object]:
    """All figures by name, SI units: for programs."""
    span = _span(reports)
    date = None if span is None else date_of(span[0])
    return {
        "bag": str(bag),
        "start_ns": None if span is None else span[0],
        "start": None if date is None else date.isoformat(),
        "duration_s": None if span is None else (span[1] - span[0]) * 1e-9,
        "size_bytes": _size(bag),
        "damage": list(damage),
        "topics": [
            {name: value for name, value in row.items() if value is not None}
            for row in figures_of(topic_columns(reports))
        ],
    }


def _span(reports: Sequence[TopicReport]) -> tuple[int, int] | None:
    """Return the times of recording of the first and the last message, ns."""
    recorded = [report for report in reports if report.received]
    return (min(report.first for report in recorded), max(report.last for report in recorded)) if recorded else None


def _size(bag: Path) -> int:
    """Bytes of all files."""
    paths = [path for path in bag.rglob("*") if path.is_file()] if bag.is_dir() else [bag]
    return sum(path.stat().st_size for path in paths)


def topic_columns(reports: Sequence[TopicReport], unit: Unit = RADIANS) -> list[Column]:
    """Figures of every topic; those of values only where they could be of gyros."""

    def of_values(figure: Callable[[TopicReport], object]) -> list[object]:
        return [figure(report) if report.could_be_gyros else None for report in reports]

    def noise(values: Array | None) -> str:
        if values is None or not np.isfinite(values).any():
            return "-"
        values = values * unit.factor
        if len(values) > 3:
            return f"{np.nanmin(values):.2g} to {np.nanmax(values):.2g}"
        return " ".join(f"{value:.2g}" for value in values)

    return [
        Column("name", [report.topic.name for report in reports], ("topic",), shown),
        Column("type", [report.topic.type for report in reports], ("type",), lambda kind: shown(kind or "unknown")),
        Column("messages", [report.received for report in reports], ("messages",)),
        Column("rate_hz", [report.rate for report in reports], ("rate",), ".1f"),
        Column("gaps", [report.gaps for report in reports], ("gaps",)),
        Column("longest_gap_s", [report.longest for report in reports], ("longest gap",), ".3f"),
        Column("malformed", [report.malformed for report in reports]),
        Column("could_be_gyros", [report.could_be_gyros for report in reports]),
        Column("values", of_values(lambda report: report.channels)),
        Column("not_finite", of_values(lambda report: report.not_finite)),
        Column("beyond_all_rates", of_values(lambda report: report.beyond)),
        Column("repeated", of_values(lambda report: report.repeated)),
        Column("stamps_not_increasing", of_values(lambda report: report.backward)),
        Column("stamps_ahead_s", of_values(lambda report: report.ahead)),
        Column("largest", of_values(lambda report: report.largest)),
        Column("quiet_noise", of_values(lambda report: report.stretches.quiet_noise()), ("noise, quietest",), noise),
        Column("moving_noise", of_values(lambda report: report.stretches.moving_noise()), ("in motion",), noise),
        Column("moving_share", of_values(lambda report: report.stretches.moving_share())),
        Column("", [_gyros(report, unit) for report in reports], ("gyros?",)),
    ]


def topics_text(reports: Sequence[TopicReport], damage: Sequence[str], unit: Unit = RADIANS) -> str:
    """Lay out the topics."""
    notes = [f"note: damaged recording: {line}\n" for line in damage]
    if apart := clocks_apart([report for report in reports if report.could_be_gyros]):
        notes.append(f"note: {apart}\n")
    units = "rate: Hz; longest gap: s"
    if any(report.could_be_gyros for report in reports):
        units += f"; noise: {unit.name} a sample of each value, vibration included; motion slower than it is left out"
    return indented(table(*told(topic_columns(reports, unit)), figures=False)) + f"{units}\n" + "".join(notes)


def _gyros(report: TopicReport, unit: Unit) -> str:
    """Say whether gyros could be in a topic, and what is wrong with its values."""
    if not report.could_be_gyros:
        return "no"
    largest = f"up to {report.largest * unit.factor:.3g} {unit.name}"
    words = [f"{report.channels} values", largest if math.isfinite(report.largest) else "none of them a rate"]
    words += ["never all of them usable"] if math.isfinite(report.largest) and not report.complete else []
    words += [DEGREES_WORDS.partition("?")[0] + "?"] if report.looks_like_degrees else []
    words += [f"in motion for {report.stretches.moving_share():.0%}"] if report.complete else []
    return ", ".join([*words, *troubles(report, unit)])


def troubles(report: TopicReport, unit: Unit = RADIANS) -> list[str]:
    """Say what is wrong with the values of a topic, by their places in the message."""
    places = report.kind.value_names(report.channels) if report.kind is not None else []
    beyond = f"beyond {BELIEVED * unit.factor:.3g} {unit.name}"
    words = []
    for why, counts in (("not finite", report.not_finite), (beyond, report.beyond), ("frozen", report.repeated)):
        counted = zip(places, counts.tolist(), strict=True)
        words += [f"{why}: {' and '.join(f'{n} of {place}' for place, n in counted if n)}"] if counts.any() else []
    words += [f"{report.malformed} malformed"] if report.malformed else []
    words += [f"{report.backward} stamps do not increase"] if report.backward else []
    return words
