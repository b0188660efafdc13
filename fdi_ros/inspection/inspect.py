# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What is in a recording, which topics could be gyros, and a config to start from."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fdi_ros.arrays import Array, Bytes, Int
from fdi_ros.bag.raw import Batch, Topic
from fdi_ros.bag.reader import Recording
from fdi_ros.calibration.data import Repeats
from fdi_ros.config.config import is_plain_name
from fdi_ros.inspection.stretches import Stretches
from fdi_ros.model.geometry import MAX_CHANNELS, MIN_CHANNELS
from fdi_ros.sources import SOURCES, Source, source_of_type
from fdi_ros.text import shown

_GAP = 3.0
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
    repeats: Repeats | None = None
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
        return np.zeros(self.channels, dtype=np.int64) if self.repeats is None else self.repeats.count

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
        report.stretches = Stretches(report.channels)
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
    if not len(report.not_finite):
        report.not_finite, report.beyond = np.zeros((2, report.channels), dtype=np.int64)
    report.repeats = report.repeats or Repeats(report.channels)
    report.repeats.add(values, report.interval)
    report.not_finite += (~finite).sum(axis=0)
    report.beyond += (finite & ~believed).sum(axis=0)
    if believed.any():
        report.largest = float(np.fmax(report.largest, np.abs(values[believed]).max()))
    whole = believed.all(axis=1)
    report.stretches.add(values[whole], times[good][whole], report.rate)


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
