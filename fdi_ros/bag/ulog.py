# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""PX4's ULog files (.ulg, .ulog), read whole by pyulog.

Rates are in sensor_gyro (board frame), vehicle_imu (body frame, calibrated: angles, and the time they were taken in)
and sensor_gyro_fifo (board frame, all samples of the sensor; the time is that of the last), as the uORB messages of
these names say. By default they are logged at 1 to 2 Hz, and so is vehicle_imu_status (body frame, calibrated: the mean
of the last 0.1 s): of such a log the means are read, for a coarse check. No bit of SDLOG_PROFILE changes that for all
IMUs: "Sensor comparison" logs sensor_gyro at 10 Hz, "Raw FIFO" one instance of sensor_gyro_fifo. A list of topics on
the SD card does ("Logging", SD Card Configuration, of the PX4 Guide), and takes the place of the default one.
sensor_combined has the one IMU that PX4 has selected: nothing to compare.

Times count from the start of the autopilot; in a simulation with the clock of the computer they are dates. How long the
logger dropped out is told; what was lost then is a gap in the samples.

pyulog keeps each message that is no sample as an object, makes one for each field that a format announces, tries again
byte by byte where a file is damaged, and prints. So it is given a file that ends early if it has more of that than
any logger writes.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.bag.log_parts import (
    FLU,
    SETTINGS,
    ImuSamples,
    LogFormat,
    LogReader,
    Portion,
    Source,
    per_time,
    possible_start,
)
from fdi_ros.errors import BagError
from fdi_ros.model.samples import Array, Int
from fdi_ros.system.installation import require
from fdi_ros.system.limits import ULOG_BYTES, ULOG_FIELDS, ULOG_MESSAGE_COST, ULOG_OTHER_BYTES, ULOG_TOPIC_COST

MAGIC = b"ULog\x01\x12\x35"
_HEAD = 3
"""Bytes of a message before its content: two of its size, one of its kind."""
_SUBSCRIPTION, _DATA = b"AD"
_DEEPEST = 16
"""Formats within formats."""
_TOGETHER = 1 << 14
"""Messages handed on at once, about."""
_LACKS = "its format lacks a field, or is not that of its samples"
_MEAN_TIME = 100_000
"""us over which PX4 takes the means of vehicle_imu_status."""
_FIX = 3
"""fix_type from which on the time is known: a fix in three dimensions."""


Columns = Mapping[str, NDArray[Any]]
"""(k,) values of each field of k messages; pyulog has those of an array as fields ``name[0]``, ``name[1]``, ..."""


class _Bounded(io.BytesIO):
    """A file that ends where its messages that are no samples come to more than any logger writes."""

    def __init__(self, data: bytes) -> None:
        super().__init__(data)
        self.reached = 0
        """Up to there the file was read, bytes."""
        self.cut = False
        """It ends within a message."""
        self._left = ULOG_OTHER_BYTES

    def read(self, size: int | None = -1, /) -> bytes:
        """Read so many bytes; a message begins with three."""
        data = super().read(size) if self._left > 0 else b""
        if size == _HEAD and len(data) == _HEAD and data[2] != _DATA:
            self._left -= (data[0] | data[1] << 8) + (
                ULOG_TOPIC_COST if data[2] == _SUBSCRIPTION else ULOG_MESSAGE_COST
            )
        self.cut = len(data) < (size or 0) and not (size == _HEAD and not data)
        self.reached = max(self.reached, self.tell())
        return data


class UlogReader(LogReader):
    """Reads a file whole."""

    _parts: list[dict[Source, Columns]] | None = None
    """Of each part of the file, of which appended ones begin with the topics anew: the messages of each topic."""

    def portions(self, end: int) -> Iterator[Portion]:
        """Return the samples, some of each topic together; where they end in the file is not known."""
        if self._parts is None:
            self._parts = self._load(end)
        sizes = [max((_size(columns) for columns in part.values()), default=0) // _TOGETHER + 1 for part in self._parts]
        done = 0
        for part, count in zip(self._parts, sizes, strict=True):
            for k in range(count):
                # Numbers of a damaged log may be anything.
                with np.errstate(all="ignore"):
                    samples = [one for topic in part.items() if (one := self._samples(*topic, k, count)) is not None]
                done += 1
                yield Portion(samples, done / sum(sizes))

    def _load(self, end: int) -> list[dict[Source, Columns]]:
        """Read the file with pyulog, and tell what of it could not be read."""
        require("reading PX4's logs (.ulg)", ("pyulog",))
        self.file.seek(0)
        data = self.file.read(end)
        if (second := data.find(MAGIC, 1)) > 0:
            self.note(f"a second log begins at byte {second}: the {end - second} bytes from there on were left out")
            data = data[:second]
        bounded = _Bounded(data)
        log = _parsed(bounded, self.file.name)
        if bounded.cut or bounded.reached < len(data):
            self.note(f"it is cut off or damaged: read up to byte {bounded.reached}")
        self._note_gaps(log)
        for text in log.logged_messages:
            self.add_text(int(text.timestamp), text.log_level_str(), text.message)
        parts: list[dict[Source, Columns]] = []
        for one in log.data_list:
            source = Source(one.name, one.multi_id)
            part = next((part for part in parts if source not in part), None)
            if part is None:
                parts.append(part := {})
            part[source] = one.data
            self._describe(source, one.data)
        for part in parts:
            part.update(_simultaneous({one: columns for one, columns in part.items() if one.kind == _STATUS}))
        for name in _READERS.keys() & log.message_formats.keys() - self.counts.keys():
            if log.file_corruption:
                self.unread[name] = _LACKS
        return parts

    def _note_gaps(self, log: Any) -> None:
        """Tell what of a file, as pyulog reads it, is damaged or was never written."""
        if log.file_corruption:
            self.note("it is damaged: what pyulog could not read was left out")
        if dropouts := [1e-3 * one.duration for one in log.dropouts]:
            count = f"{len(dropouts)} time{'s' * (len(dropouts) > 1)}"
            seconds = f"for {sum(dropouts):.3g} s in all and {max(dropouts):.3g} s at most"
            self.note(f"the logger dropped out {count}, {seconds}")

    def _describe(self, source: Source, columns: Columns) -> None:
        """Count the messages of a topic, take its time of day, or note why it cannot be read."""
        self.counts[source.kind] += _size(columns)
        if source.kind not in _NEEDED:
            return
        rows = _rows(source.kind, columns)
        if source.kind in _GPS:
            self.start_utc = _start_utc(rows) if rows and self.start_utc is None else self.start_utc
        elif rows is None and source.kind != _STATUS:
            self.unread[source.kind] = _LACKS

    def _samples(self, source: Source, columns: Columns, k: int, count: int) -> ImuSamples | None:
        """Return part k of so many equal ones of the samples of a topic; None: it has none."""
        if source.kind not in _READERS:
            return None
        size = _size(columns)
        part = slice(size * k // count, size * (k + 1) // count)
        rows = _rows(source.kind, {name: column[part] for name, column in columns.items()})
        if rows is None:
            return None
        stamp, rate, acceleration = _READERS[source.kind](rows)
        return ImuSamples(source, stamp, rate * FLU, acceleration * FLU, np.zeros(len(stamp), dtype=np.int64))


def _parsed(file: _Bounded, path: str) -> Any:
    """Return a file as pyulog reads it.

    Raises
    ------
    BagError
        If it does not.
    """
    from pyulog import ULog
    from pyulog.exceptions import ULogException, ULogIncompatibleFlagException

    try:
        # pyulog prints what it thinks of a file.
        with contextlib.redirect_stdout(io.StringIO()):
            formats = ULog(_Bounded(file.getvalue()), parse_header_only=True).message_formats
            known: dict[str, int] = {}
            if any(count_fields(formats, name, known) > ULOG_FIELDS for name in formats):
                raise BagError(f"{path} defines a message of more than {ULOG_FIELDS} fields")
            return ULog(file)
    except ULogIncompatibleFlagException as error:
        raise BagError(f"{path} is a ULog of a later version, whose flags say that it must not be read") from error
    except (
        ArithmeticError,
        AttributeError,
        LookupError,
        MemoryError,
        RuntimeError,
        TypeError,
        ULogException,
        ValueError,
    ) as error:
        raise BagError(f"{path} cannot be read by pyulog: {error}") from error


def count_fields(formats: Mapping[str, Any], name: str, known: dict[str, int], depth: int = 0) -> int:
    """Return the number of fields of a message with all that its formats nest, at most one more than is allowed."""
    if name not in known:
        if depth > _DEEPEST:
            return ULOG_FIELDS + 1
        # A format within itself has no end.
        known[name] = ULOG_FIELDS + 1
        total = sum(
            max(1, length) * (count_fields(formats, kind, known, depth + 1) if kind in formats else 1)
            for kind, length, _ in formats[name].fields
        )
        known[name] = min(total, ULOG_FIELDS + 1)
    return known[name]


def _simultaneous(topics: Mapping[Source, Columns]) -> dict[Source, Columns]:
    """Return the means of several IMUs at common stamps: those that were taken over mostly the same time.

    What is interpolated over a second of flight differs by more than any fault.
    """
    rows = {one: rows for one, columns in topics.items() if (rows := _rows(_STATUS, columns)) and _size(rows)}
    if len(rows) < 2:
        return {}
    times = np.sort(min(map(_stamp, rows.values()), key=len))
    nearest = [_nearest(_stamp(columns), times) for columns in rows.values()]
    late = [_stamp(columns)[k] - times for columns, k in zip(rows.values(), nearest, strict=True)]
    kept = np.max(np.abs(late), axis=0) <= _MEAN_TIME // 2
    return {
        one: {"timestamp": times[kept], **{f"mean_gyro[{a}]": columns["mean_gyro"][k[kept], a] for a in range(3)}}
        for (one, columns), k in zip(rows.items(), nearest, strict=True)
    }


def _nearest(stamp: Int, times: Int) -> Int:
    """Return which of k stamps are next to m times, (m,)."""
    order = np.argsort(stamp, kind="stable")
    ordered = stamp[order]
    after = np.searchsorted(ordered, times).clip(0, len(stamp) - 1)
    before = (after - 1).clip(0)
    return order[np.where(times - ordered[before] < ordered[after] - times, before, after)]


def _size(columns: Columns) -> int:
    """Return the number of messages."""
    return len(next(iter(columns.values())))


def _rows(name: str, columns: Columns) -> Columns | None:
    """Return the fields of a topic that are read, arrays as (k, length); None: it lacks what is needed."""
    rows = {field: columns[field] for field in _OPTIONAL if field in columns}
    lengths: set[int] = set()
    for field, length in _NEEDED[name].items():
        parts = [columns[field]] if field in columns and not length else []
        while length and (one := f"{field}[{len(parts)}]") in columns:
            parts.append(columns[one])
        if not parts or length not in (0, _ANY, len(parts)):
            return None
        rows[field] = np.stack(parts, axis=1) if length else parts[0]
        lengths |= {len(parts)} if length == _ANY else set()
    return rows if len(lengths) <= 1 else None


def _stamp(rows: Columns) -> Int:
    """Time of samples (k,), us since the start of the autopilot; before version 1.11 that of publication."""
    stamp = rows["timestamp"].astype(np.int64)
    if "timestamp_sample" not in rows:
        return stamp
    sampled = rows["timestamp_sample"].astype(np.int64)
    return np.where(sampled > 0, sampled, stamp)


Read = tuple[Int, Array, Array]
"""Stamps (k,), us, rates and accelerations (k, 3) in FRD, NaN where they are not logged."""


def _absent(stamp: Int) -> Array:
    return np.full((len(stamp), 3), np.nan)


def _sensor_gyro(rows: Columns) -> Read:
    stamp = _stamp(rows)
    return stamp, np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float64), _absent(stamp)


def _vehicle_imu(rows: Columns) -> Read:
    """Mean rates over the time of each sample, and accelerations likewise."""
    rate = per_time(rows["delta_angle"].astype(np.float64), rows["delta_angle_dt"] * 1e-6)
    acceleration = per_time(rows["delta_velocity"].astype(np.float64), rows["delta_velocity_dt"] * 1e-6)
    return _stamp(rows), rate, acceleration


def _sensor_combined(rows: Columns) -> Read:
    stamp = _stamp(rows)
    return stamp, rows["gyro_rad"].astype(np.float64), _absent(stamp)


def _sensor_gyro_fifo(rows: Columns) -> Read:
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
    return stamp[filled], rate[filled], _absent(stamp[filled])


def _vehicle_imu_status(rows: Columns) -> Read:
    """Mean rates of the last 0.1 s before each message, at the middle of these."""
    stamp = _stamp(rows) - _MEAN_TIME // 2
    return stamp, rows["mean_gyro"].astype(np.float64), _absent(stamp)


def _start_utc(rows: Columns) -> int | None:
    """Return the UTC of the start of the autopilot by messages (k,) of GPS, us since 1970."""
    fixed = rows["fix_type"] >= _FIX if "fix_type" in rows else np.ones(len(rows["timestamp"]), dtype=bool)
    return possible_start(rows["time_utc_usec"].astype(np.int64)[fixed], rows["timestamp"].astype(np.int64)[fixed])


_READERS: dict[str, Callable[[Columns], Read]] = {
    "vehicle_imu": _vehicle_imu,
    "sensor_gyro": _sensor_gyro,
    "sensor_gyro_fifo": _sensor_gyro_fifo,
    "sensor_combined": _sensor_combined,
    "vehicle_imu_status": _vehicle_imu_status,
}
_SELECTED, _STATUS = "sensor_combined", "vehicle_imu_status"
_GPS = ("sensor_gps", "vehicle_gps_position")
_ANY = -1
_NEEDED = {
    "sensor_gyro": {"timestamp": 0, "x": 0, "y": 0, "z": 0},
    "vehicle_imu": {"timestamp": 0, "delta_angle": 3, "delta_angle_dt": 0, "delta_velocity": 3, "delta_velocity_dt": 0},
    "sensor_gyro_fifo": {"timestamp": 0, "dt": 0, "scale": 0, "samples": 0, "x": _ANY, "y": _ANY, "z": _ANY},
    _SELECTED: {"timestamp": 0, "gyro_rad": 3},
    _STATUS: {"timestamp": 0, "mean_gyro": 3},
    **{name: {"timestamp": 0, "time_utc_usec": 0} for name in _GPS},
}
"""Fields without which a topic is not read, and how long an array each is: 0, a single value; `_ANY`, all alike."""
_OPTIONAL = ("timestamp_sample", "fix_type")

ULOG = LogFormat(
    stack="PX4",
    kinds=tuple(name for name in _READERS if name not in (_SELECTED, _STATUS)),
    settings={"": "PX4: file etc/logging/logger_topics.txt on the SD card with the line vehicle_imu"},
    magic=MAGIC,
    reader=UlogReader,
    one_imu="this autopilot logged one IMU ({}): nothing to compare it with; a board with more logs each with the line"
    f" vehicle_imu in etc/logging/logger_topics.txt on the SD card ({SETTINGS}), CAL_GYROn_PRIO 0 disables IMU n",
    coarse=_STATUS,
    selected=_SELECTED,
    most=ULOG_BYTES,
)
