# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""PX4's ULog files (.ulg).

A message is its size, its kind and its content: F says the fields of a topic, A that an instance of one is logged under
a number, D is a sample of it ("ULog File Format" of the PX4 Guide). There is no checksum: a message counts only where
another one begins behind it, and after damage only where several follow one another.

Rates are in sensor_gyro (board frame), vehicle_imu (body frame, calibrated: angles, and the time they were taken in)
and sensor_gyro_fifo (board frame, all samples of the sensor; the time is that of the last), as the uORB messages of
these names say. By default they are logged at 1 to 2 Hz. No bit of SDLOG_PROFILE changes that for all IMUs: "Sensor
comparison" logs sensor_gyro at 10 Hz, "Raw FIFO" one instance of sensor_gyro_fifo. A list of topics on the SD card does
("Logging", SD Card Configuration, of the PX4 Guide), and takes the place of the default one.

An hour of three IMUs at 400 Hz takes 1.1 s and bounded memory here. pyulog takes 7 s and holds all samples; it also
believes whatever arrays and nested types a file announces, and prints to standard output.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.bag.log_parts import (
    Array,
    Field,
    ImuSamples,
    LogFormat,
    Portion,
    Rows,
    Source,
    possible_start,
    row_type,
    rows_at,
    vectors,
)
from fdi_ros.bag.raw import Bytes, Int
from fdi_ros.core.compiled import compiled
from fdi_ros.core.messages import read_bits
from fdi_ros.limits import CHANNELS, DESCRIPTION_BYTES

MAGIC = b"ULog\x01\x12\x35"
_FILE_HEAD = 16
_HEAD = 3
"""Bytes of a message before its content."""
_IN_A_ROW = 4
"""Messages that must follow one another where reading begins again after damage."""
_FORMAT, _SUBSCRIPTION, _DATA = b"FAD"
_TYPES = {
    "int8_t": "i1",
    "uint8_t": "u1",
    "int16_t": "<i2",
    "uint16_t": "<u2",
    "int32_t": "<i4",
    "uint32_t": "<u4",
    "int64_t": "<i8",
    "uint64_t": "<u8",
    "float": "<f4",
    "double": "<f8",
    "bool": "u1",
    "char": "u1",
}
"""NumPy types of those of a field."""
_FIELD = re.compile(r"(\w+)(?:\[([0-9]{1,5})\])? (\w+)")
_LARGEST = 1 << 16
"""No message is larger, bytes."""
_DEEPEST = 16
"""Formats within formats."""
_FIX = 3
"""fix_type from which on the time is known: a fix in three dimensions."""


@compiled
def message_end(data: Bytes, position: int, row: int, final: bool) -> int:
    """Return where the message at a position ends, if so many messages follow one another from there on.

    Returns
    -------
    The end; 0: there is no message; -1: the portion is too short to know.
    """
    at, end = position, 0
    for k in range(row):
        if at + _HEAD > len(data):
            if not final:
                return -1
            return end if end <= len(data) else 0
        size, kind = read_bits(data, at, 2, True), data[at + 2]
        # Kinds are capital letters.
        if size == 0 or kind < 65 or kind > 90:
            return 0
        at += _HEAD + size
        end = at if k == 0 else end
    return end


@compiled
def find_messages(data: Bytes, final: bool, found: Int) -> tuple[int, int, int]:
    """Find the messages in a portion of a file.

    Parameters
    ----------
    data
        The bytes.
    final
        The file ends with the portion.
    found
        (3, room): kind of each message, first byte and size of its content.

    Returns
    -------
    The number of messages, where the walk ended, and how many bytes before that are in no message.
    """
    count = lost = position = 0
    row = 2
    while position + _HEAD <= len(data):
        end = message_end(data, position, row, final)
        if end < 0:
            break
        if end == 0:
            lost += 1
            position += 1
            row = _IN_A_ROW
            continue
        start = position + _HEAD
        found[0, count], found[1, count], found[2, count] = data[position + 2], start, end - start
        count += 1
        position = end
        row = 2
    return count, position, lost


class _Topic(NamedTuple):
    """A topic that is read."""

    fields: np.dtype[np.void]
    """Fields that are read, within a sample without what pads its end."""
    most: int
    """Bytes of a sample with that."""


class _Formats:
    """The formats that a file defines; the first of a name counts."""

    def __init__(self) -> None:
        self._texts: dict[str, str] = {}
        self._sizes: dict[str, int | None] = {}
        self._room = DESCRIPTION_BYTES

    def add(self, content: Bytes) -> None:
        """Take in a format, as long as there is room."""
        self._room -= len(content)
        name, _, fields = content.tobytes().decode("ascii", "replace").partition(":")
        if self._room >= 0 and name:
            self._texts.setdefault(name, fields)

    def topic(self, name: str) -> _Topic | None:
        """Return where the fields that are read lie in a topic; None: it lacks what is needed."""
        fields: dict[str, Field] = {}
        at = end = 0
        for kind, length, field in self._fields(name):
            size = self._size(kind, 0)
            if size is None:
                return None
            if kind in _TYPES and length != 0:
                fields.setdefault(field, Field(_TYPES[kind], at, length or 0))
            at += size * (1 if length is None else length)
            end = end if field.startswith("_padding") else at
        if at > _LARGEST or not _suffices(name, fields):
            return None
        chosen = {one: fields[one] for one in (*_NEEDED[name], *_OPTIONAL) if one in fields}
        return _Topic(row_type(chosen, end), at)

    def _fields(self, name: str) -> Iterator[tuple[str, int | None, str]]:
        """Read a format: type, length of an array or None, and name of each field; the type is empty if it is none."""
        for part in filter(None, self._texts.get(name, "").split(";")):
            match = _FIELD.fullmatch(part)
            yield (match[1], int(match[2]) if match[2] else None, match[3]) if match else ("", None, "")

    def _size(self, kind: str, depth: int) -> int | None:
        """Return the bytes of a type, which may be another format with all that pads it; None: it is not known."""
        if kind in _TYPES:
            return np.dtype(_TYPES[kind]).itemsize
        if kind not in self._sizes:
            # A format within itself has no size.
            self._sizes[kind] = None
            if kind in self._texts and depth < _DEEPEST:
                self._sizes[kind] = self._sum(kind, depth + 1)
        return self._sizes[kind]

    def _sum(self, name: str, depth: int) -> int | None:
        """Return the bytes of all fields of a format."""
        total = 0
        for kind, length, _ in self._fields(name):
            size = self._size(kind, depth)
            if size is None or total > _LARGEST:
                return None
            total += size * (1 if length is None else length)
        return total


class UlogReader:
    """Reads a file from its start."""

    def __init__(self) -> None:
        self.unread: set[str] = set()
        self._formats = _Formats()
        self._topics: dict[str, _Topic | None] = {}
        self._subscriptions: dict[int, Source] = {}
        self._described = 0

    def read(self, data: Bytes, final: bool) -> Portion:
        """Read the next portion of the file; final: nothing comes after it."""
        found = np.empty((3, len(data) // (_HEAD + 1) + 1), dtype=np.int64)
        count, end, lost = find_messages(data, final, found)
        kind, start, size = found[:, :count]
        for k in np.flatnonzero((kind == _FORMAT) | (kind == _SUBSCRIPTION)).tolist():
            self._describe(int(kind[k]), data[start[k] : start[k] + size[k]])
        sampled = (kind == _DATA) & (size > 2)
        start, size = start[sampled], size[sampled] - 2
        number = data[start].astype(np.int64) | data[start + 1].astype(np.int64) << 8
        order = np.argsort(number, kind="stable")
        number = number[order]
        samples: list[ImuSamples] = []
        start_utc = None
        for wanted, source in self._subscriptions.items():
            of_source = order[np.searchsorted(number, wanted) : np.searchsorted(number, wanted, side="right")]
            if not len(of_source):
                continue
            if source.kind not in self._topics:
                self._topics[source.kind] = self._formats.topic(source.kind)
            topic = self._topics[source.kind]
            of_source = of_source[_whole(size[of_source], topic)]
            if topic is None or not len(of_source):
                self.unread |= {source.kind} - set(_GPS)
                continue
            rows = rows_at(data, start[of_source] + 2, topic.fields)
            if source.kind in _GPS:
                start_utc = _start_utc(rows) if start_utc is None else start_utc
            else:
                samples.append(_READERS[source.kind](source, rows, start[of_source] + 2 + size[of_source]))
        return Portion(samples, start_utc, int(end), int(lost))

    def _describe(self, kind: int, content: Bytes) -> None:
        """Take in a format, or a subscription if it is of a topic that is read; the first counts."""
        self._described += 1
        if self._described > CHANNELS:
            return
        if kind == _FORMAT:
            self._formats.add(content)
            return
        name = content[3:].tobytes().decode("ascii", "replace")
        if name in _NEEDED and len(content) > 3:
            instance, low, high = content[:3].tolist()
            self._subscriptions.setdefault(low | high << 8, Source(name, instance))


def _whole(size: Int, topic: _Topic | None) -> NDArray[np.bool_]:
    """Which samples, of sizes (k,) in bytes, are of a topic; none if it is not known."""
    if topic is None:
        return np.zeros(len(size), dtype=bool)
    return (size >= topic.fields.itemsize) & (size <= topic.most)


def _suffices(name: str, fields: Mapping[str, Field]) -> bool:
    """Whether a topic with these fields has all that is needed."""
    needed = _NEEDED[name]
    if not needed.keys() <= fields.keys():
        return False
    arrays = {fields[one].length for one, length in needed.items() if length == _ANY}
    if 0 in arrays or len(arrays) > 1:
        return False
    return all(length in (_ANY, fields[one].length) for one, length in needed.items())


def _stamp(rows: Rows) -> Int:
    """Time of samples (k,), us since the start of the autopilot; before version 1.11 that of publication."""
    stamp = rows["timestamp"].astype(np.int64)
    if "timestamp_sample" not in (rows.dtype.names or ()):
        return stamp
    sampled = rows["timestamp_sample"].astype(np.int64)
    return np.where(sampled > 0, sampled, stamp)


def _sensor_gyro(source: Source, rows: Rows, end: Int) -> ImuSamples:
    return ImuSamples(source, _stamp(rows), vectors(rows, ("x", "y", "z")), np.full((len(rows), 3), np.nan), end)


def _vehicle_imu(source: Source, rows: Rows, end: Int) -> ImuSamples:
    """Mean rates over the time of each sample, and accelerations likewise."""
    rate = _per_second(rows["delta_angle"], rows["delta_angle_dt"])
    acceleration = _per_second(rows["delta_velocity"], rows["delta_velocity_dt"])
    return ImuSamples(source, _stamp(rows), rate, acceleration, end)


def _per_second(change: Array, microseconds: Int) -> Array:
    """Divide changes (k, 3) by the times (k,) they took; NaN: the log does not say how long."""
    seconds = microseconds.astype(np.float64) * 1e-6
    return change.astype(np.float64) / np.where(seconds > 0, seconds, np.nan)[:, None]


def _sensor_gyro_fifo(source: Source, rows: Rows, end: Int) -> ImuSamples:
    """All samples of each message: equally spaced, the last at its time."""
    room = rows["x"].shape[1]
    count = np.minimum(rows["samples"].astype(np.int64), room)
    before = count[:, None] - 1 - np.arange(room)
    good = np.isfinite(rows["dt"]) & (rows["dt"] > 0) & (rows["dt"] < 1e6)
    spacing = np.where(good, rows["dt"], 0.0).astype(np.float64)
    stamp = _stamp(rows)[:, None] - np.round(before * spacing[:, None]).astype(np.int64)
    raw = np.stack([rows[axis] for axis in "xyz"], axis=-1).astype(np.float64)
    rate = raw * rows["scale"].astype(np.float64)[:, None, None]
    filled = before >= 0
    absent = np.full((int(filled.sum()), 3), np.nan)
    end = np.broadcast_to(end[:, None], filled.shape)[filled]
    return ImuSamples(source, stamp[filled], rate[filled], absent, end, room)


def _start_utc(rows: Rows) -> int | None:
    """Return the UTC of the start of the autopilot by samples (k,) of GPS, us since 1970."""
    rows = rows[rows["fix_type"] >= _FIX] if "fix_type" in (rows.dtype.names or ()) else rows
    return possible_start(rows["time_utc_usec"].astype(np.int64), rows["timestamp"].astype(np.int64))


_READERS: dict[str, Callable[[Source, Rows, Int], ImuSamples]] = {
    "sensor_gyro": _sensor_gyro,
    "vehicle_imu": _vehicle_imu,
    "sensor_gyro_fifo": _sensor_gyro_fifo,
}
_GPS = ("sensor_gps", "vehicle_gps_position")
_ANY = -1
_NEEDED = {
    "sensor_gyro": {"timestamp": 0, "x": 0, "y": 0, "z": 0},
    "vehicle_imu": {"timestamp": 0, "delta_angle": 3, "delta_angle_dt": 0, "delta_velocity": 3, "delta_velocity_dt": 0},
    "sensor_gyro_fifo": {"timestamp": 0, "dt": 0, "scale": 0, "samples": 0, "x": _ANY, "y": _ANY, "z": _ANY},
    **{name: {"timestamp": 0, "time_utc_usec": 0} for name in _GPS},
}
"""Fields without which a topic is not read, and how long an array each is: 0, a single value; `_ANY`, all alike."""
_OPTIONAL = ("timestamp_sample", "fix_type")

ULOG = LogFormat(
    stack="PX4",
    messages=", ".join(_READERS),
    advice="have etc/logging/logger_topics.txt on the SD card list vehicle_imu (no SDLOG_PROFILE logs it at full rate)",
    magic=MAGIC,
    head=_FILE_HEAD,
    reader=UlogReader,
)
