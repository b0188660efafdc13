# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What is in a recording, which topics could be gyros, and a config to start from."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fdi_ros.bag.raw import Batch, Bytes, Int, Topic
from fdi_ros.bag.reader import Recording
from fdi_ros.bag.samples import Array
from fdi_ros.calibration.data import Repeats
from fdi_ros.config.config import is_topic
from fdi_ros.model.geometry import MAX_CHANNELS, MIN_CHANNELS
from fdi_ros.sources import SOURCES, Source, source_of_type
from fdi_ros.text import shown

_GAP = 3.0
"""Intervals longer than this many usual ones are gaps."""
_INTERVALS = 1_000_000
"""Intervals of a topic that are kept at most."""
_USUAL = 0.999
"""Share of the intervals that a timeout must bear."""
_WINDOW = 1.0
"""Length of the stretches that noise is taken from, s."""
_LEAST = 16
"""Samples of a stretch at least."""
_SMOOTH = np.array([-2.0, 3.0, 6.0, 7.0, 6.0, 3.0, -2.0]) / 21.0
"""Local parabola through seven samples (Savitzky and Golay 1964): what it leaves is noise, not motion."""
_QUIET = 2.0
"""At rest a stretch spreads by no more than this many times its own noise, and that than the quietest stretches'."""
_ALIKE = 1.5
"""Noise this many times that of the quietest stretches is as quiet."""
MOST_STRETCHES = 4096
"""That are kept; of a longer recording every second one, and so on: memory does not grow with its length."""
_REST_RATE = 0.1
"""No bias is larger than this, rad/s."""
BELIEVED = 1e6
"""Values beyond are no rates but damage, rad/s; their squares must not overflow."""


@dataclass(frozen=True)
class Stretch:
    """Values of about a second."""

    first: int
    """Time of recording of its first message, ns."""
    mean: Array
    """(c,) rad/s."""
    spread: Array
    """(c,) standard deviation, rad/s."""
    noise: Array
    """(c,) what no smooth motion reaches, vibration included, rad/s."""


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
    channels: int = 0
    """Values in a message, of what could be gyros; else 0."""
    announced: int = 0
    """Values that a message says it has: whatever its bytes claim."""
    not_finite: Int = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """(c,) values that are NaN or infinite."""
    beyond: Int = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """(c,) finite values beyond all rates."""
    repeats: Repeats | None = None
    """Of what could be gyros: values that stay exactly the same for long."""
    largest: float = math.nan
    """Largest value that can be a rate, rad/s; NaN: there is none."""
    intervals: list[Array] = field(default_factory=list)
    stretches: list[Stretch] = field(default_factory=list)
    every: int = 1
    """Of so many stretches one is kept."""
    passed: int = 0
    """Stretches so far."""
    waiting: Array = field(default_factory=lambda: np.empty((0, 0)))
    """(K, c) values that do not make a stretch yet."""
    waiting_since: int = 0
    """Time of recording of the first of them, ns."""

    @property
    def rate(self) -> float:
        """Messages a second, usually."""
        return 1.0 / self.interval if self.interval > 0 else 0.0

    @property
    def repeated(self) -> Int:
        """Values (c,) in long runs of exactly one value."""
        return np.zeros(self.channels, dtype=np.int64) if self.repeats is None else self.repeats.count

    @property
    def could_be_gyros(self) -> bool:
        """Whether it carries angular rates, or as many numbers as there may be channels."""
        return self.channels > 0 and (self.complete or bool((self.not_finite + self.beyond).any()))

    @property
    def complete(self) -> bool:
        """Whether there is a message in which every value can be a rate."""
        return bool(self.stretches) or len(self.waiting) > 0

    @property
    def usual_longest(self) -> float:
        """Interval that 999 of 1000 do not exceed, s."""
        return float(np.quantile(np.concatenate(self.intervals), _USUAL)) if self.intervals else 0.0

    def all_stretches(self) -> list[Stretch]:
        """Stretches, with the rest at the end if there is no other."""
        if self.stretches or len(self.waiting) < _LEAST:
            return self.stretches
        return [_stretch(self.waiting, self.waiting_since)]

    def at_rest(self) -> list[bool]:
        """For each stretch, whether nothing in it moves."""
        stretches = self.all_stretches()
        if not stretches:
            return []
        quietest = self.quiet_noise()
        return [
            bool(
                (stretch.spread <= _QUIET * stretch.noise).all()
                and (stretch.noise <= _QUIET * quietest).all()
                and (np.abs(stretch.mean) <= _REST_RATE).all()
            )
            for stretch in stretches
        ]

    def quiet_noise(self) -> Array:
        """Noise (c,) at the quietest stretch, rad/s; NaN: too little was recorded."""
        stretches = self.all_stretches()
        if not stretches:
            return np.full(self.channels, np.nan)
        noise = np.array([stretch.noise for stretch in stretches])
        few = np.argsort((noise**2).sum(axis=1))[: max(1, len(noise) // 10)]
        # The quietest few are so by chance, too: all that are about as quiet tell it without that bias.
        alike = (noise <= _ALIKE * np.median(noise[few], axis=0)).all(axis=1)
        return np.asarray(np.median(noise[alike], axis=0) if alike.any() else np.median(noise[few], axis=0))

    def moving_noise(self) -> Array:
        """Noise (c,) of the stretches in motion, vibration included, rad/s; NaN: it does not move."""
        moving = [stretch.noise for stretch, rest in zip(self.all_stretches(), self.at_rest(), strict=True) if not rest]
        return np.asarray(np.median(moving, axis=0)) if moving else np.full(self.channels, np.nan)

    def moving_share(self) -> float:
        """Share of the recording in motion."""
        rest = self.at_rest()
        return 1.0 - sum(rest) / len(rest) if rest else 0.0


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
        report.gaps += int((steps > _GAP * report.interval).sum()) if report.interval > 0 else 0
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
    if not report.channels:
        return
    decoded = kind.decode(buffer, offset, length, report.channels)
    good = decoded.good
    report.malformed += int((~good).sum())
    stamp, values = decoded.stamp[good], decoded.values[good]
    if kind.stamped:
        report.backward += int((np.diff(stamp) <= 0).sum())
    with np.errstate(invalid="ignore"):
        finite, believed = np.isfinite(values), np.abs(values) < BELIEVED
    if not len(report.not_finite):
        report.not_finite, report.beyond = np.zeros((2, report.channels), dtype=np.int64)
    report.repeats = report.repeats or Repeats(report.channels)
    report.repeats.add(values, report.interval)
    report.not_finite += (~finite).sum(axis=0)
    report.beyond += (finite & ~believed).sum(axis=0)
    if believed.any():
        report.largest = float(np.fmax(report.largest, np.abs(values[believed]).max()))
    whole = believed.all(axis=1)
    take_stretches(report, values[whole], times[good][whole])


def take_stretches(report: TopicReport, values: Array, times: Int) -> None:
    """Cut the values (K, c) into stretches; what is left waits for more."""
    if not len(values):
        return
    if len(report.waiting):
        values = np.vstack([report.waiting, values])
        times = np.concatenate([np.full(len(report.waiting), report.waiting_since), times])
    size = max(_LEAST, round(_WINDOW * report.rate)) if report.rate else len(values) + 1
    full = len(values) // size * size
    for k in range(0, full, size):
        if report.passed % report.every == 0:
            report.stretches.append(_stretch(values[k : k + size], int(times[k])))
        report.passed += 1
        if len(report.stretches) > MOST_STRETCHES:
            report.stretches, report.every = report.stretches[::2], 2 * report.every
    report.waiting = values[full:]
    report.waiting_since = int(times[full]) if full < len(times) else 0


def _stretch(values: Array, first: int) -> Stretch:
    inside = len(_SMOOTH) // 2
    smooth = np.column_stack([np.convolve(column, _SMOOTH, mode="valid") for column in values.T])
    left = values[inside:-inside] - smooth
    # Of white noise the parabola takes its share with it.
    share = 1.0 - _SMOOTH[inside]
    return Stretch(first, values.mean(axis=0), values.std(axis=0), np.sqrt(np.mean(left**2, axis=0) / share))


_OF_A_MONITOR = ("fused", "integrity")
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
        "no name that ROS allows": not _ros_name(report.topic.name),
        f"{report.announced} values, not {MIN_CHANNELS} to {MAX_CHANNELS}": not kind.stamped and not report.channels,
        f"all {report.received} messages are malformed, or have stamps before 1970": report.malformed
        == report.received,
        f"no message in which all values are finite and below {BELIEVED:g} rad/s": not report.complete,
        "a single message": report.received == 1,
        "its times of recording do not increase": not report.rate,
    }
    return next((words for words, holds in reasons.items() if holds), "")


def _ros_name(name: str) -> bool:
    """Whether a name can be written into a config as it is: a file may claim any."""
    return is_topic(name) and not set(name) & set("~{}")
