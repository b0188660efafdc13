# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a format of flight logs is made of: where samples come from, what a portion of a log gives, records by field."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.model.samples import Array, Int
from fdi_ros.system.limits import EARLIEST, LATEST, LOG_SPAN

SETTINGS = 'docs/flight_logs.md, "Settings of the logger"'
COARSE_RATE = 0.5
"""Hz."""
FLU = np.array([1.0, -1.0, -1.0])
"""From FRD."""


class Source(NamedTuple):
    """Where samples come from: one instance of one kind of logged message."""

    kind: str
    instance: int


class ImuSamples(NamedTuple):
    """k samples of one IMU, in FLU."""

    source: Source
    stamp: Int
    """(k,) us since the start of the autopilot, or since 1970."""
    rate: Array
    """(k, 3) rad/s."""
    acceleration: Array
    """(k, 3) m/s^2; NaN: not logged with the rate."""
    end: Int
    """(k,) where the record of each ends in the file, bytes; 0: not known."""

    def at(self, rows: NDArray[np.bool_] | slice) -> ImuSamples:
        """Return some of the samples; rows (k,) says which."""
        return self._replace(
            stamp=self.stamp[rows], rate=self.rate[rows], acceleration=self.acceleration[rows], end=self.end[rows]
        )


class LogText(NamedTuple):
    """What the autopilot said of itself."""

    stamp: int
    """us as of samples; of a recording ns."""
    kind: str
    """Message it was logged in: MSG, ERR, or the severity."""
    text: str


MOST_TEXTS = 1000
"""Texts of a log that are kept: the first ones."""


class Portion(NamedTuple):
    """What one portion of a log holds."""

    samples: list[ImuSamples]
    progress: float
    """Share of the log read up to its end, 0 to 1."""


class LogReader(ABC):
    """Reads an open log; remembers what the log says of itself.

    Parameters
    ----------
    file
        The log.
    note
        Takes one line on each thing in it that cannot be read, or that a reader must know.
    """

    def __init__(self, file: BinaryIO, note: Callable[[str], None]) -> None:
        self.file, self.note = file, note
        self.unread: dict[str, str] = {}
        """Messages of IMUs that are there and cannot be read, by name, and why."""
        self.counts: Counter[str] = Counter()
        """Records of every message, by name."""
        self.vehicle = ""
        """Kind of vehicle by the name of its firmware; empty: not known."""
        self.start_utc: int | None = None
        """UTC of the start of the autopilot, us since 1970; None: not known."""
        self.texts: list[LogText] = []
        """What the autopilot said up to the place that was read."""

    def add_text(self, stamp: int, kind: str, text: str) -> None:
        """Take in what the autopilot said at a time, us."""
        if len(self.texts) < MOST_TEXTS and (line := " ".join(text.split())):
            self.texts.append(LogText(stamp, kind, line))

    @abstractmethod
    def portions(self, end: int) -> Iterator[Portion]:
        """Read the log from its start up to a place in the file, bytes, in the order of the file."""


@dataclass(frozen=True)
class LogFormat:
    """What logs of a flight stack look like."""

    stack: str
    kinds: tuple[str, ...]
    """Messages that samples of every IMU are logged in."""
    settings: Mapping[str, str]
    """Line of the documentation by which all IMUs are logged fast enough, by the kind of vehicle; empty: of others."""
    magic: bytes
    """First bytes of a file."""
    reader: Callable[[BinaryIO, Callable[[str], None]], LogReader]
    one_imu: str
    """Sentence for a log of a single IMU, with a place for what of it is logged."""
    slowest: float = 20.0
    """Samples per second that an IMU must be logged at: fewer say too little of the motion to judge gyros by."""
    coarse: str = ""
    """Kind of message with means of the rate at `COARSE_RATE` or faster, read where nothing better is there."""
    counted_by: str = ""
    """Kind of message with one instance per sensor; another kind may have instances that are no further sensors."""
    selected: str = ""
    """Message with samples of the one IMU that the autopilot has selected, which leave nothing to compare."""
    most: int = 0
    """Bytes of a log that is read whole; 0: it is read in portions, and may have any size."""


def possible_start(utc: Int, stamp: Int) -> int | None:
    """Return the UTC of the start of the autopilot, us since 1970, by the first of k GPS fixes that can be true.

    Parameters
    ----------
    utc
        (k,) of each fix, us since 1970.
    stamp
        (k,) us since the start of the autopilot.
    """
    good = (stamp >= 0) & (stamp <= LOG_SPAN) & (utc >= EARLIEST // 1000) & (utc <= LATEST // 1000 - LOG_SPAN)
    return int((utc - stamp)[np.argmax(good)]) if good.any() else None


class Field(NamedTuple):
    """Where a value lies in a record."""

    kind: str
    """Name of its NumPy type."""
    offset: int
    """Bytes."""
    length: int = 0
    """Of an array of such values; 0: a single one."""


def row_type(fields: Mapping[str, Field], size: int) -> np.dtype[np.void]:
    """Return the NumPy type of a record of so many bytes, of which these fields are read."""
    layout: Any = {
        "names": list(fields),
        "formats": [(field.kind, (field.length,) if field.length else ()) for field in fields.values()],
        "offsets": [field.offset for field in fields.values()],
        "itemsize": size,
    }
    return np.dtype(layout)


def per_time(change: Array, seconds: NDArray[Any]) -> Array:
    """Divide changes (k, 3) by the times (k,) that they took, s; NaN: the log does not say how long."""
    seconds = seconds.astype(np.float64)
    return change / np.where(seconds > 0, seconds, np.nan)[:, None]
