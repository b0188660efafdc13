# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Samples of flight logs: where they come from, how often and when they were logged."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.model.samples import Array, Int
from fdi_ros.system.files import EARLIEST, LATEST, LOG_SPAN

FLU = np.array([1.0, -1.0, -1.0])  # from FRD
FEWEST = 20  # samples by which the rate of a source can be judged
_TOLERANCE = 0.95  # of that rate; clocks and loggers are not exact
_MAX_INTERVAL_RATIO = 1.5
"""Times the longest interval between two samples: a longer one is a gap, a shorter one may be jitter."""
_MAX_STEP_BACK = 1_000_000  # us; a log goes on as long as its times step back by no more
_BESIDE = 17  # samples whose median says where a log has come to: no few damaged times move it


class Source(NamedTuple):
    """Where samples come from: one instance of one kind of logged message."""

    kind: str
    instance: int


class ImuSamples(NamedTuple):
    """k samples of one IMU, in FLU."""

    source: Source
    stamp: Int  # (k,) us since the start of the autopilot, or since 1970
    rate: Array  # (k, 3) rad/s
    acceleration: Array  # (k, 3) m/s^2; NaN: not logged with the rate.
    end: Int  # (k,) where the record of each ends in the file, bytes; 0: not known

    def at(self, rows: NDArray[np.bool_] | slice) -> ImuSamples:
        """Return some of the samples; rows (k,) says which."""
        return self._replace(
            stamp=self.stamp[rows], rate=self.rate[rows], acceleration=self.acceleration[rows], end=self.end[rows]
        )


class LogText(NamedTuple):
    """What the autopilot said of itself."""

    stamp: int  # us as of samples; of a recording ns
    kind: str  # message it was logged in: MSG, ERR, or the severity
    text: str


Portion = tuple[list[ImuSamples], float]
"""Samples in one portion of a log, and the share of the log that is read up to its end, 0 to 1."""


def _nothing() -> Int:
    return np.zeros(0, dtype=np.int64)


@dataclass
class Track:
    """What was seen of one source: how fast it is logged, and where its time steps back for good."""

    slowest: float  # samples per second that it must be logged at
    count: int = 0
    fast: int = 0  # samples that follow the one before without a gap
    fast_time: int = 0  # us between these and the ones before
    first: int = 0
    last: int = 0  # stamps of the first and the last, us
    come: int | None = None  # stamp up to which the log has come, us; None: at its start.
    stamp: Int = field(default_factory=_nothing)  # of the last samples, us
    end: Int = field(default_factory=_nothing)  # where the records of these end, bytes

    def add(self, stamp: Int) -> None:
        """Take in the stamps (k,) of further samples."""
        if not len(stamp):
            return
        steps = np.diff(stamp, prepend=self.last) if self.count else np.diff(stamp)
        steps = steps[(steps > 0) & (steps <= 1e6 * _MAX_INTERVAL_RATIO / self.slowest)]
        self.fast += len(steps)
        self.fast_time += int(steps.sum())
        self.first = self.first if self.count else int(stamp[0])
        self.last = int(stamp[-1])
        self.count += len(stamp)

    def first_behind(self, samples: ImuSamples) -> int:
        """Return where the record of the first sample behind a step of time ends, bytes; 0: there is none.

        There a second log begins in the file.
        """
        stamp, end = np.append(self.stamp, samples.stamp), np.append(self.end, samples.end)
        self.stamp, self.end = stamp[1 - _BESIDE :], end[1 - _BESIDE :]
        if not len(stamp):
            return 0
        steady = bool((np.abs(np.diff(stamp)) <= _MAX_STEP_BACK).all())
        come = stamp if steady else medians(stamp, _BESIDE)
        first = int(come[0]) if self.come is None else self.come
        before = np.maximum.accumulate(np.append(first, come[:-1]))
        self.come = max(first, int(come.max()))
        # Nor does a log go on years later: there its times begin to be dates, or no longer are.
        behind = (come < before - _MAX_STEP_BACK) | (come - before > LOG_SPAN)
        return int(end[np.argmax(behind)]) if behind.any() else 0

    @property
    def steady(self) -> bool:
        """Whether most samples follow one another without gaps."""
        return 2 * self.fast > self.count

    @property
    def rate(self) -> float:
        """Samples per second: between gaps, or if there is little else than gaps, on average."""
        if self.steady:
            return self.fast * 1e6 / self.fast_time
        return (self.count - 1) * 1e6 / (self.last - self.first) if self.last > self.first else 0.0

    @property
    def fast_enough(self) -> bool:
        """Whether its rate can be judged and is high enough, in bursts at least."""
        return self.count >= FEWEST and self.rate >= _TOLERANCE * self.slowest

    @property
    def usable(self) -> bool:
        """Whether it is mostly logged fast enough; gaps do not count against it."""
        return self.fast_enough and self.steady

    @property
    def figures(self) -> str:
        """Words for how fast it is logged."""
        if self.count < 2:
            return "once"
        if self.last <= self.first:
            return "at times that do not advance"
        return f"at {self.rate:.3g} Hz{' in bursts' if self.fast_enough and not self.steady else ''}"


def medians(stamp: Int, window: int) -> Int:
    """Return the median of so many stamps (k,) beside each; before the first and after the last they are mirrored."""
    beside = np.lib.stride_tricks.sliding_window_view(np.pad(stamp, window // 2, mode="reflect"), window)
    return np.sort(beside, axis=1)[:, window // 2]


def copies_of(sensors: Mapping[Source, Track], shared: Mapping[tuple[Source, Source], int]) -> dict[Source, Source]:
    """Return which sources are copies of which others: those with the same times, since sensors have their own.

    A copy has the number of the sensor and that of all sensors in the sum. Where more than two have the same times, as
    in a simulation, an even number of sources is taken for sensors and their copies; an odd one cannot be that.
    """
    same = [
        (one, other)
        for (one, other), count in shared.items()
        if one in sensors and other in sensors and 2 * count > min(sensors[one].count, sensors[other].count)
    ]
    ordered = sorted({source for pair in same for source in pair})
    if len(ordered) == 2 * len(same):
        return {other: one for one, other in same}
    half = len(ordered) // 2
    return {} if len(ordered) % 2 else dict(zip(ordered[half:], ordered[:half], strict=True))


def possible_start(utc: Int, stamp: Int) -> int | None:
    """Return the UTC of the start of the autopilot, us since 1970, by the first of k GPS fixes that can be true.

    ``utc`` (k,) us since 1970, ``stamp`` (k,) us since the start.
    """
    good = (stamp >= 0) & (stamp <= LOG_SPAN) & (utc >= EARLIEST // 1000) & (utc <= LATEST // 1000 - LOG_SPAN)
    return int((utc - stamp)[np.argmax(good)]) if good.any() else None


def parts(sizes: Sequence[int], together: int) -> Iterator[tuple[list[slice], float]]:
    """Yield which rows of each of several tables, read whole, come together, and the share that then was read.

    The largest hands on about so many at once.
    """
    count = max(sizes, default=0) // together + 1
    for k in range(count):
        yield [slice(size * k // count, size * (k + 1) // count) for size in sizes], (k + 1) / count


def per_time(change: Array, seconds: NDArray[Any]) -> Array:
    """Divide changes (k, 3) by the times (k,) that they took, s; NaN: the log does not say how long."""
    seconds = seconds.astype(np.float64)
    return change / np.where(seconds > 0, seconds, np.nan)[:, None]
