"""What is in a recording, which topics could be gyros, and a config to start from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fdi_ros.bag.raw import Batch, Bytes, Int, Topic
from fdi_ros.bag.reader import Recording
from fdi_ros.bag.samples import ARRAY, IMU, Array
from fdi_ros.core.messages import array_count, decode_array, decode_imu
from fdi_ros.model.geometry import MAX_CHANNELS, MIN_CHANNELS

_FIRST = 20_000
"""Messages of a topic that its usual interval and its noise are taken from."""
_GAP = 3.0
"""Intervals longer than this many usual ones are gaps."""
_NORMAL = 0.6745
"""Median of the absolute value of a normal variable of standard deviation 1."""


@dataclass
class TopicReport:
    """What was seen of one topic."""

    topic: Topic
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
    """Values in a message, of what could be gyros."""
    stamps: list[Int] = field(default_factory=list)
    values: list[Array] = field(default_factory=list)
    kept: int = 0

    @property
    def rate(self) -> float:
        """Messages a second, usually."""
        return 1.0 / self.interval if self.interval else 0.0

    @property
    def could_be_gyros(self) -> bool:
        """Whether it carries angular rates, or as many numbers as there may be channels."""
        return self.kept > 0

    def noise(self) -> Array:
        """White noise of each value, (c,) rad/s: from the second differences, which no smooth motion reaches."""
        values = np.vstack(self.values)
        with np.errstate(invalid="ignore"):
            # What is infinite twice in a row has no difference, and is left out.
            steps = np.diff(values, n=2, axis=0)
        steps = steps[np.isfinite(steps).all(axis=1)]
        if len(steps) < 10:
            return np.full(values.shape[1], np.nan)
        return np.asarray(np.median(np.abs(steps), axis=0) / (_NORMAL * np.sqrt(6.0)))

    def largest(self) -> float:
        """Largest finite value, rad/s."""
        values = np.abs(np.vstack(self.values))
        return float(np.max(values, initial=0.0, where=np.isfinite(values)))


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
        reports = [TopicReport(topic) for topic in recording.topics]
        for batch in recording.batches([report.topic.name for report in reports]):
            for k, report in enumerate(reports):
                rows = np.flatnonzero(batch.topic == k)
                if len(rows):
                    _take(report, batch, rows)
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
    if report.topic.encoding == "cdr":
        _take_values(report, batch.buffer, batch.offset[rows], batch.length[rows])


def _take_values(report: TopicReport, buffer: Bytes, offset: Int, length: Int) -> None:
    """Decode what could be angular rates."""
    if report.topic.type == IMU:
        report.channels = 3
        decoded = decode_imu(buffer, offset, length)
    elif report.topic.type == ARRAY:
        report.channels = report.channels or array_count(buffer, offset, length)
        if not MIN_CHANNELS <= report.channels <= MAX_CHANNELS:
            return
        decoded = decode_array(buffer, offset, length, report.channels)
    else:
        return
    good = decoded.good
    report.malformed += int((~good).sum())
    stamp, values = decoded.stamp[good], decoded.values[good]
    if report.topic.type == IMU:
        report.backward += int((np.diff(stamp) <= 0).sum())
    room = max(0, _FIRST - report.kept)
    report.stamps.append(stamp[:room])
    report.values.append(values[:room])
    report.kept += len(stamp[:room])


_OF_A_MONITOR = ("fused", "integrity")


def candidates(reports: Sequence[TopicReport]) -> list[TopicReport]:
    """Return the topics a config is made for: up to four Imu topics, else the first array that fits.

    What a monitor itself has published is no sensor: the fused rate must not be its own witness.
    """
    possible = [r for r in reports if r.could_be_gyros and r.topic.name.rpartition("/")[2] not in _OF_A_MONITOR]
    imus = [report for report in possible if report.topic.type == IMU]
    arrays = [report for report in possible if report.topic.type == ARRAY]
    return imus[:4] if len(imus) >= 2 else arrays[:1]
