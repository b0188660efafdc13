# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a format of flight logs is made of: where samples come from, what a portion of a log gives, records by field."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.limits import EARLIEST, LATEST, LOG_SPAN
from fdi_ros.model.samples import Array, Bytes, Int

Rows = NDArray[np.void]
"""Records of a log, by field."""
_FLU = np.array([1.0, -1.0, -1.0])
"""From FRD."""


class Source(NamedTuple):
    """Where samples come from: one instance of one kind of logged message."""

    kind: str
    instance: int


class ImuSamples(NamedTuple):
    """k samples of one IMU; formats give them in the axes of the log, FRD."""

    source: Source
    stamp: Int
    """(k,) us since the start of the autopilot, or since 1970."""
    rate: Array
    """(k, 3) rad/s."""
    acceleration: Array
    """(k, 3) m/s^2; NaN: not logged with the rate."""
    end: Int
    """(k,) bytes from the start of the portion to the end of the record of each."""
    together: int = 1
    """Samples that one record holds at most; where its time is damaged, so are all of theirs."""

    def at(self, rows: NDArray[np.bool_]) -> ImuSamples:
        """Return some of the samples; rows (k,) says which."""
        return self._replace(
            stamp=self.stamp[rows], rate=self.rate[rows], acceleration=self.acceleration[rows], end=self.end[rows]
        )

    def in_flu(self) -> ImuSamples:
        """Return samples in FRD in FLU."""
        return self._replace(rate=self.rate * _FLU, acceleration=self.acceleration * _FLU)


def by_instance(kind: str, instance: Int, stamp: Int, rate: Array, acceleration: Array, end: Int) -> list[ImuSamples]:
    """Return k samples of one kind of message, of each instance by itself; those of instance -1 are none."""
    return [
        ImuSamples(Source(kind, k), stamp, rate, acceleration, end).at(instance == k)
        for k in np.unique(instance).tolist()
        if k >= 0
    ]


class Portion(NamedTuple):
    """What one portion of a log holds."""

    samples: list[ImuSamples]
    start_utc: int | None
    """UTC of the start of the autopilot by the first GPS fix, us since 1970; None: there is no fix."""
    end: int
    """Bytes of the portion that were read: up to the first incomplete record."""
    lost: int
    """Bytes of these that belong to no whole record."""


class LogReader(ABC):
    """Reads a log from its start; remembers what the log says of its own records."""

    def __init__(self) -> None:
        self.unread: dict[str, str] = {}
        """Messages of IMUs that are there and cannot be read, by name, and why."""
        self.counts: Counter[str] = Counter()
        """Records so far of every message, by name."""
        self.vehicle = ""
        """Kind of vehicle by the name of its firmware; empty: not known."""

    @abstractmethod
    def read(self, data: Bytes, final: bool) -> Portion:
        """Read the next portion of the file; final: nothing comes after it, or what comes is no continuation."""

    def notes(self) -> list[str]:
        """Return what the log says of itself, as far as it was read, that a reader must know."""
        return []


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
    head: int
    """Bytes before the first record."""
    reader: Callable[[], LogReader]
    slowest: float = 20.0
    """Samples per second that an IMU must be logged at: fewer say too little of the motion to judge gyros by."""
    counted_by: str = ""
    """Kind of message with one instance per sensor; another kind may have instances that are no further sensors."""
    selected: str = ""
    """Message with samples of the one IMU that the autopilot has selected, which leave nothing to compare."""
    parts: Callable[[bytes], tuple[int, ...]] = lambda head: ()
    """From the first bytes of a file: where parts begin that were appended, whole records each."""


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


def rows_at(data: Bytes, start: Int, kind: np.dtype[np.void]) -> Rows:
    """Return the records (k,) of a type that begin at k places in a portion."""
    return np.lib.stride_tricks.sliding_window_view(data, kind.itemsize)[start].view(kind)[:, 0]


def vectors(rows: Rows, columns: Sequence[str]) -> Array:
    """Return three columns of k rows as vectors, (k, 3); NaN where the rows do not have them."""
    if not set(columns) <= set(rows.dtype.names or ()):
        return np.full((len(rows), 3), np.nan)
    return np.column_stack([rows[column] for column in columns]).astype(np.float64)


def per_time(change: Array, seconds: NDArray[Any]) -> Array:
    """Divide changes (k, 3) by the times (k,) that they took, s; NaN: the log does not say how long."""
    seconds = seconds.astype(np.float64)
    return change / np.where(seconds > 0, seconds, np.nan)[:, None]
