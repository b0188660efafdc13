# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""PX4's ULog files (.ulg, .ulog).

A message is its size, its kind and its content: F says the fields of a topic, A that an instance of one is logged under
a number, D is a sample of it ("ULog File Format" of the PX4 Guide). There is no checksum: a message counts only where
another one begins behind it, and after damage only where several follow one another. What the first message (B) says
was appended, as after a crash, begins at an offset of its own: the message before it may be cut off. O says for how
long the logger dropped out; what was lost then is a gap in the samples.

Rates are in sensor_gyro (board frame), vehicle_imu (body frame, calibrated: angles, and the time they were taken in)
and sensor_gyro_fifo (board frame, all samples of the sensor; the time is that of the last), as the uORB messages of
these names say. By default they are logged at 1 to 2 Hz. No bit of SDLOG_PROFILE changes that for all IMUs: "Sensor
comparison" logs sensor_gyro at 10 Hz, "Raw FIFO" one instance of sensor_gyro_fifo. A list of topics on the SD card does
("Logging", SD Card Configuration, of the PX4 Guide), and takes the place of the default one. sensor_combined has the
one IMU that PX4 has selected: nothing to compare.

Times count from the start of the autopilot; in a simulation with the clock of the computer they are dates.

An hour of three IMUs at 400 Hz takes 1.1 s and bounded memory here. pyulog takes 7 s and holds all samples; it also
believes whatever arrays and nested types a file announces, and prints to standard output.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.bag.log_parts import (
    Field,
    ImuSamples,
    LogFormat,
    LogReader,
    Portion,
    Rows,
    Source,
    per_time,
    possible_start,
    row_type,
    rows_at,
    vectors,
)
from fdi_ros.compiling.compiled import compiled
from fdi_ros.core.messages import read_bits
from fdi_ros.errors import BagError
from fdi_ros.limits import CHANNELS, DESCRIPTION_BYTES
from fdi_ros.model.samples import Bytes, Int

MAGIC = b"ULog\x01\x12\x35"
_FILE_HEAD = 16
_HEAD = 3
"""Bytes of a message before its content."""
_IN_A_ROW = 4
"""Messages that must follow one another where reading begins again after damage."""
_FORMAT, _SUBSCRIPTION, _DATA, _DROPOUT = b"FADO"
_FLAGS = struct.Struct("<HB8s8s3Q")
"""The first message of a file, if it is B: size, kind, compatible and other flags, offsets of what was appended."""
_APPENDED = bytes([1, *bytes(7)])
"""Flags of a file with such; a reader that does not know others must not read on."""
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


class UlogReader(LogReader):
    """Reads a file from its start."""

    def __init__(self) -> None:
        super().__init__()
        self._formats = _Formats()
        self._topics: dict[str, _Topic | None] = {}
        self._subscriptions: dict[int, Source] = {}
        self._of_part_before: set[int] = set()
        """Numbers that a part of the file that was appended may give anew."""
        self._described = 0
        self._dropouts: list[int] = []
        """How long each was, ms."""

    def read(self, data: Bytes, final: bool) -> Portion:
        """Read the next portion of the file; final: nothing comes after it, or what comes is no continuation."""
        found = np.empty((3, len(data) // (_HEAD + 1) + 1), dtype=np.int64)
        count, end, lost = find_messages(data, final, found)
        kind, start, size = found[:, :count]
        for k in np.flatnonzero((kind == _FORMAT) | (kind == _SUBSCRIPTION)).tolist():
            self._describe(int(kind[k]), data[start[k] : start[k] + size[k]])
        dropped = start[(kind == _DROPOUT) & (size == 2)]
        self._dropouts += (data[dropped].astype(np.int64) | data[dropped + 1].astype(np.int64) << 8).tolist()
        sampled = (kind == _DATA) & (size > 2)
        start, size = start[sampled], size[sampled] - 2
        number = data[start].astype(np.int64) | data[start + 1].astype(np.int64) << 8
        order = np.argsort(number, kind="stable")
        number = number[order]
        samples: list[ImuSamples] = []
        start_utc = None
        for wanted, source in self._subscriptions.items():
            of_source = order[np.searchsorted(number, wanted) : np.searchsorted(number, wanted, side="right")]
            self.counts[source.kind] += len(of_source)
            if not len(of_source) or source.kind not in _NEEDED:
                continue
            if source.kind not in self._topics:
                self._topics[source.kind] = self._formats.topic(source.kind)
            topic = self._topics[source.kind]
            of_source = of_source[_whole(size[of_source], topic)]
            if topic is None or not len(of_source):
                if source.kind not in _GPS:
                    self.unread[source.kind] = "its format lacks a field, or is not that of its samples"
                continue
            rows = rows_at(data, start[of_source] + 2, topic.fields)
            if source.kind in _GPS:
                start_utc = _start_utc(rows) if start_utc is None else start_utc
            else:
                samples.append(_READERS[source.kind](source, rows, start[of_source] + 2 + size[of_source]))
        if final:
            self._of_part_before = set(self._subscriptions)
        return Portion(samples, start_utc, int(end), int(lost))

    def notes(self) -> list[str]:
        """Return for how long the logger dropped out."""
        if not self._dropouts:
            return []
        count = f"{len(self._dropouts)} time{'s' * (len(self._dropouts) > 1)}"
        seconds, longest = 1e-3 * sum(self._dropouts), 1e-3 * max(self._dropouts)
        return [f"the logger dropped out {count}, for {seconds:.3g} s in all and {longest:.3g} s at most"]

    def _describe(self, kind: int, content: Bytes) -> None:
        """Take in a format, or a subscription if it is of a topic that is read; the first counts."""
        self._described += 1
        if self._described > CHANNELS:
            return
        if kind == _FORMAT:
            self._formats.add(content)
            return
        name = content[3:].tobytes().decode("ascii", "replace")
        if len(content) > 3:
            instance, low, high = content[:3].tolist()
            number = low | high << 8
            if number not in self._subscriptions or number in self._of_part_before:
                self._subscriptions[number] = Source(name, instance)
                self._of_part_before.discard(number)


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
    rate = per_time(rows["delta_angle"].astype(np.float64), rows["delta_angle_dt"] * 1e-6)
    acceleration = per_time(rows["delta_velocity"].astype(np.float64), rows["delta_velocity_dt"] * 1e-6)
    return ImuSamples(source, _stamp(rows), rate, acceleration, end)


def _sensor_combined(source: Source, rows: Rows, end: Int) -> ImuSamples:
    return ImuSamples(source, _stamp(rows), rows["gyro_rad"].astype(np.float64), np.full((len(rows), 3), np.nan), end)


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


def _parts(head: bytes) -> tuple[int, ...]:
    """Return where what was appended begins, by the first message of a file.

    Raises
    ------
    BagError
        If the file is of a later version, which does not allow to be read like this.
    """
    if len(head) < _FILE_HEAD + _FLAGS.size:
        return ()
    size, kind, _, other, *offsets = _FLAGS.unpack_from(head, _FILE_HEAD)
    if kind != ord("B") or size < _FLAGS.size - _HEAD:
        return ()
    if other not in (_APPENDED, bytes(8)):
        raise BagError(f"is a ULog of a later version: incompatible flags {other.hex()}")
    return tuple(sorted({offset for offset in offsets if offset > _FILE_HEAD})) if other == _APPENDED else ()


_READERS: dict[str, Callable[[Source, Rows, Int], ImuSamples]] = {
    "vehicle_imu": _vehicle_imu,
    "sensor_gyro": _sensor_gyro,
    "sensor_gyro_fifo": _sensor_gyro_fifo,
    "sensor_combined": _sensor_combined,
}
_SELECTED = "sensor_combined"
_GPS = ("sensor_gps", "vehicle_gps_position")
_ANY = -1
_NEEDED = {
    "sensor_gyro": {"timestamp": 0, "x": 0, "y": 0, "z": 0},
    "vehicle_imu": {"timestamp": 0, "delta_angle": 3, "delta_angle_dt": 0, "delta_velocity": 3, "delta_velocity_dt": 0},
    "sensor_gyro_fifo": {"timestamp": 0, "dt": 0, "scale": 0, "samples": 0, "x": _ANY, "y": _ANY, "z": _ANY},
    _SELECTED: {"timestamp": 0, "gyro_rad": 3},
    **{name: {"timestamp": 0, "time_utc_usec": 0} for name in _GPS},
}
"""Fields without which a topic is not read, and how long an array each is: 0, a single value; `_ANY`, all alike."""
_OPTIONAL = ("timestamp_sample", "fix_type")

ULOG = LogFormat(
    stack="PX4",
    kinds=tuple(name for name in _READERS if name != _SELECTED),
    settings={"": "PX4: file etc/logging/logger_topics.txt on the SD card with the line vehicle_imu"},
    magic=MAGIC,
    head=_FILE_HEAD,
    reader=UlogReader,
    selected=_SELECTED,
    parts=_parts,
)
