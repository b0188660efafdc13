# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""ArduPilot's dataflash logs (.bin).

A record is A3 95, the number of its message, and values of fixed size. FMT records give
name, size, types and columns of each message (README of AP_Logger; "Onboard Message Log
Messages" in ArduPilot's documentation). Records have no checksum, so one counts only if
another record follows directly.

Rates are in IMU (filtered, all units at one time, at most at the loop rate), in IMT
(angles and the time that each took, input of the estimator), and with raw logging in
GYR (all samples of each sensor with their own times). All are in the body frame. Before
version 4.1 each instance is a message: IMU, IMU2, IMU3. Since then column I holds the
instance. With INS_RAW_LOG_OPT, GYR may hold each sensor twice, before and after the
filters: at the same SampleUS, as instance I and as I plus the number of gyros.

Times are in TimeUS, before version 3.3 in TimeMS. In such old logs GPS holds the
autopilot's time in T and the time of the week in TimeMS, and GYR the time of each
sample in a TimeUS of 32 bits, which wraps every 72 minutes.

FMTU, UNIT and MULT give unit and multiplier of each column, usually rad/s and 1. Other
units are converted.

An hour of three IMUs at 400 Hz takes 2.5 s here. pymavlink's DFReader, with one Python
object per message, takes 72 s.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.bag.flight_log import (
    FLU,
    GPS_FIX_3D,
    FlightLog,
    ImuSamples,
    Portion,
    Source,
    imu_samples,
    per_time,
    possible_start,
)
from fdi_ros.bag.modes import ardupilot_mode
from fdi_ros.compiling.compiled import compiled
from fdi_ros.model.samples import Array, Bytes, Int

#: records of a log, by field
Rows = NDArray[np.void]
#: bytes that are read at once, much more than the longest record
_PORTION_BYTES = 1 << 22
#: bytes of a record before its values
_RECORD_HEAD = 3
#: number of the message that describes the others, its content, and bytes of the record
_FMT = 128
_DESCRIPTION = struct.Struct("<BB4s16s64s")
_FMT_SIZE = _RECORD_HEAD + _DESCRIPTION.size
_FIELD_TYPES = (
    {"b": "i1", "B": "u1", "M": "u1", "h": "<i2", "H": "<u2", "c": "<i2", "C": "<u2"}
    | {
        "i": "<i4",
        "I": "<u4",
        "e": "<i4",
        "E": "<u4",
        "L": "<i4",
        "q": "<i8",
        "Q": "<u8",
    }
    | {
        "g": "<f2",
        "f": "<f4",
        "d": "<f8",
        "n": "S4",
        "N": "S16",
        "Z": "S64",
        "a": "S64",
    }
)
"""NumPy types of the letters of a FMT record."""
#: types that are the number itself
_NUMBERS = "bBdfghHiIqQ"
#: columns that are read and may not be any number, and their types
_TYPES_OF = {
    "Message": "Z",
    "Label": "Z",
    "Name": "N",
    "ModeNum": "B",
    "UnitIds": "N",
    "MultIds": "N",
    "I": "B",
}
_SENSORS = re.compile(r"(IMU|GYR|IMT)([1-3]?)")
_GPS = re.compile(r"GPS[2B]?")
_VALUES = {
    "IMU": (("GyrX", "GyrY", "GyrZ"), ("AccX", "AccY", "AccZ")),
    "GYR": (("GyrX", "GyrY", "GyrZ"), ("AccX", "AccY", "AccZ")),
    "IMT": (("DelAX", "DelAY", "DelAZ"), ("DelVX", "DelVY", "DelVZ")),
}
"""Columns of rate and acceleration; IMT holds angles and velocities over `DelaT`,
`DelvT`.
"""
#: columns with texts of the autopilot
_TEXTS = {
    "MSG": ("Message",),
    "ERR": ("Subsys", "ECode"),
}
#: columns of the flight: number of the mode, output of the throttle, parameters
_FLIGHT = {
    "MODE": ("ModeNum",),
    "CTUN": (),
    "PARM": ("Name", "Value"),
}
_THROTTLE_FIELDS = ("ThO", "ThrOut")
_TEMPERATURE = ("T", "Temp")
_VEHICLE = re.compile(r"(?:Ardu|APM:)(Copter|Plane|Rover|Sub)\b")
_UNITS = {
    "FMTU": ("FmtType", "UnitIds", "MultIds"),
    "UNIT": ("Id", "Label"),
    "MULT": ("Id", "Mult"),
}
"""Columns of messages about units and multipliers, keyed by their first column."""
_OPTIONAL = (
    "TimeUS",
    "TimeMS",
    "SampleUS",
    "I",
    "Status",
    "T",
    "GMS",
    "GWk",
    "Week",
    "DelvT",
    "Temp",
    "ThO",
    "ThrOut",
)
#: subsystem of an ERR record: the EKF changed its primary lane
_EKF_PRIMARY = 24
_SUBSYSTEMS: dict[Any, str] = (
    {
        2: "radio",
        3: "compass",
        5: "radio failsafe",
        6: "battery failsafe",
        8: "ground station failsafe",
    }
    | {
        9: "fence failsafe",
        10: "flight mode",
        11: "GPS",
        12: "crash check",
        16: "EKF check",
        17: "EKF failsafe",
    }
    | {
        18: "barometer",
        25: "thrust loss",
        29: "vibration failsafe",
        30: "internal error",
    }
)
"""Of ERR records (LogErrorSubsystem of AP_Logger) that may have to do with IMUs."""
_GPS_EPOCH, _WEEK, _LEAP = 315_964_800, 604_800, 18
"""Start of GPS time since 1970, a week, and GPS ahead of UTC since 2017, s."""


@compiled
def record_end(data: Bytes, position: int, sizes: Int, final: bool) -> int:
    """Return the end of the record at a position, 0 if none, -1 if the portion ends first."""
    if data[position] != 0xA3 or data[position + 1] != 0x95:
        return 0
    number = data[position + 2]
    size = _FMT_SIZE if number == _FMT else int(sizes[number])
    if size < _RECORD_HEAD:
        return 0
    end = position + size
    is_last = end + 2 > len(data)
    if end > len(data) or (is_last and not final):
        return -1
    if is_last:
        return end
    begins_next = data[end] == 0xA3 and data[end + 1] == 0x95
    return end if begins_next else 0


@compiled
def find_records(
    data: Bytes, sizes: Int, final: bool, found: Int
) -> tuple[int, int, int]:
    """Find the records in a portion of a log, which is the last one if ``final``.

    ``sizes`` (256,): bytes of a record of each message, 0 if unknown, updated from the
    first FMT record of each. ``found`` (2, room) receives the message number and the
    first byte of each record. Returns the number of records, the end of the walk, and
    the number of bytes before that which belong to no record.
    """
    count = lost = position = 0
    while position + _RECORD_HEAD <= len(data):
        end = record_end(data, position, sizes, final)
        if end < 0:
            break
        if end == 0:
            begin = position
            position += 1
            # A hole of gigabytes is passed at the speed of memory.
            while position + _RECORD_HEAD <= len(data) and (
                data[position] != 0xA3 or data[position + 1] != 0x95
            ):
                position += 1
            lost += position - begin
            continue
        described = data[position + 3]
        if data[position + 2] == _FMT and sizes[described] == 0:
            sizes[described] = data[position + 4]
        found[0, count] = data[position + 2]
        found[1, count] = position
        count += 1
        position = end
    return count, position, lost


class DataflashLog(FlightLog):
    """An open log, read in portions, in bounded memory."""

    magic = b"\xa3\x95"
    refusal = "is no log of ArduPilot"
    kinds = tuple(_VALUES)
    settings = (
        "on ArduPilot, set LOG_BITMASK bit 18 (Fast IMU, ArduCopter) or 19 (Raw IMU),"
        " or INS_RAW_LOG_OPT bit 1 (all gyros)"
    )
    one_imu = (
        "one IMU cannot be checked: this autopilot logged no other ({})."
        " If the board has more, check INS_ENABLE_MASK"
    )
    counted_by = "IMU"
    first_imu = 1

    def portions(self) -> Iterator[Portion]:
        """Read the log from its start up to `end`."""
        self._sizes = np.zeros(256, dtype=np.int64)
        self._names: dict[int, str] = {}
        self._layouts: dict[
            int, np.dtype[np.void]
        ] = {}  # columns that are read of records of each message
        self._lacking: dict[int, str] = {}  # of messages that cannot be read: why
        self._columns: dict[
            int, list[str]
        ] = {}  # all columns of each message that is read
        self._told: dict[str, dict[int, list[Any]]] = {name: {} for name in _UNITS}
        self._vehicle = ""
        offset = lost = 0
        while True:
            self.file.seek(offset)
            data = np.frombuffer(
                self.file.read(min(_PORTION_BYTES, self.end - offset)), dtype=np.uint8
            )
            final = offset + _PORTION_BYTES >= self.end
            # Numbers of a damaged log may be anything.
            with np.errstate(all="ignore"):
                samples, size, beside = self._read(data, offset, final)
            lost += beside
            offset += size
            yield samples, offset / self.end
            if final or not size:
                break
        left = lost + self.end - offset - self._erased()
        if left > 0:
            self.leave_bytes(left)

    def _erased(self) -> int:
        """Return the number of bytes of erased flash at the end, at most a portion."""
        self.file.seek(max(0, self.end - _PORTION_BYTES))
        end = self.file.read(_PORTION_BYTES)
        return len(end) - len(end.rstrip(b"\xff"))

    def _read(
        self, data: Bytes, begin: int, final: bool
    ) -> tuple[list[tuple[Source, ImuSamples]], int, int]:
        """Read the portion that begins at this byte of the file.

        Returns its samples, the end of its last record, and the bytes that belong to no record.
        """
        most = len(data) // _RECORD_HEAD + 1
        found = np.empty((2, most), dtype=np.int64)
        count, end, lost = find_records(data, self._sizes, final, found)
        number, offset = found[:, :count]
        for start in offset[number == _FMT].tolist():
            self._describe(data[start + _RECORD_HEAD : start + _FMT_SIZE].tobytes())
        order = np.argsort(number.astype(np.uint8), kind="stable")
        there, begins = np.unique(number[order], return_index=True)
        starts = dict(
            zip(there.tolist(), np.split(offset[order], begins[1:]), strict=False)
        )
        for k, of_message in starts.items():
            self.counts[self._names.get(k, "unknown")] += len(of_message)
            if k in self._lacking:
                self.unread[self._names[k]] = self._lacking[k]
        samples: list[tuple[Source, ImuSamples]] = []
        # Units before the samples: in a short log both are in one portion.
        for k in sorted(
            starts.keys() & self._layouts.keys(),
            key=lambda k: self._names[k] not in _UNITS,
        ):
            name = self._names[k]
            layout = self._layouts[k]
            rows = np.lib.stride_tricks.sliding_window_view(data, layout.itemsize)[
                starts[k]
            ].view(layout)[:, 0]
            if (sensor := _SENSORS.fullmatch(name)) is not None:
                source = Source(sensor[1], int(sensor[2] or 1) - 1)
                samples += _samples(
                    source, rows, begin + starts[k], *self._factors(k, source)
                )
                self._take_temperatures(source, rows)
            else:
                self._take(name, rows)
        return samples, int(end), int(lost)

    def _take(self, name: str, rows: Rows) -> None:
        """Take records (k,) of a message without rates."""
        if name in _UNITS:
            number, *columns = (rows[column] for column in _UNITS[name])
            for at, *told in zip(
                number.astype(np.int64).tolist(), *map(list, columns), strict=True
            ):
                self._told[name].setdefault(at, told)
        elif name in _TEXTS:
            self._take_texts(name, rows)
        elif name in _FLIGHT:
            self._take_flight(name, rows)
        elif self.start_utc is None:
            self.start_utc = _start_utc(rows)

    def _describe(self, content: bytes) -> None:
        """Take a FMT record, unless an earlier one defined the same message."""
        number, size, *texts = _DESCRIPTION.unpack(content)
        name, types, columns = (
            text.partition(b"\0")[0].decode("ascii", "replace") for text in texts
        )
        if number in self._names:
            return
        self._names[number] = name
        sensor = _SENSORS.fullmatch(name)
        if sensor or _GPS.fullmatch(name) or name in {**_TEXTS, **_UNITS, **_FLIGHT}:
            self._columns[number] = columns.split(",")
            try:
                self._layouts[number] = _layout(
                    name, size, types, self._columns[number]
                )
            except ValueError as error:
                if sensor:
                    self._lacking[number] = str(error)

    def _take_texts(self, name: str, rows: Rows) -> None:
        """Take texts and times from records (k,)."""
        if name == "MSG":
            texts = [
                text.decode("ascii", "replace") for text in rows["Message"].tolist()
            ]
            self._vehicle = self._vehicle or next(
                (found[1] for found in map(_VEHICLE.match, texts) if found), ""
            )
        else:
            texts = list(
                map(_error_text, rows["Subsys"].tolist(), rows["ECode"].tolist())
            )
        if {"TimeUS", "TimeMS"} & set(rows.dtype.names or ()):
            for stamp, text in zip(_stamp(rows).tolist(), texts, strict=True):
                self.add_text(stamp, name, text)

    def origin(self, source: Source) -> str:
        """Return the message of a source: IMU[1], or IMU2 where each has its own."""
        if source.instance and f"{source.kind}{source.instance + 1}" in self.counts:
            return f"{source.kind}{source.instance + 1}"
        numbered = any(
            "I" in (layout.names or ())
            for k, layout in self._layouts.items()
            if self._names[k] == source.kind
        )
        return f"{source.kind}[{source.instance}]" if numbered else source.kind

    def mode_name(self, mode: str) -> str:
        """Return the name of a mode, for this vehicle."""
        return ardupilot_mode(self._vehicle, int(mode))

    def _take_temperatures(self, source: Source, rows: Rows) -> None:
        """Take the temperatures in records (k,) of IMUs."""
        columns = set(rows.dtype.names or ())
        name = next((one for one in _TEMPERATURE if one in columns), "")
        if source.kind != "IMU" or not name:
            return
        stamp = _stamp(rows)
        instance = rows["I"] if "I" in columns else np.full(len(rows), source.instance)
        for k in np.unique(instance).tolist():
            own = instance == k
            self.add_temperature(k, stamp[own], rows[name][own])

    def _take_flight(self, name: str, rows: Rows) -> None:
        """Take modes, throttle and ids of gyros from records (k,)."""
        columns = set(rows.dtype.names or ())
        if name == "PARM":
            for text, value in zip(
                rows["Name"].tolist(), rows["Value"].tolist(), strict=True
            ):
                self.take_parameter(text.decode("ascii", "replace"), value)
        elif not {"TimeUS", "TimeMS"} & columns:
            return
        elif name == "MODE":
            for stamp, number in zip(
                _stamp(rows).tolist(), rows["ModeNum"].tolist(), strict=True
            ):
                self.add_mode(stamp, str(number))
        elif column := next((one for one in _THROTTLE_FIELDS if one in columns), ""):
            self.throttle.add(_stamp(rows), rows[column])

    def _factors(self, number: int, source: Source) -> Iterator[Array]:
        """Return the factors of rate and acceleration, (3,) each, to rad, m and s."""
        units, multipliers = self._told["FMTU"].get(number, (b"", b""))
        for columns in _VALUES[source.kind]:
            factors = np.ones(3)
            for i, k in enumerate(
                self._columns[number].index(one)
                for one in columns
                if one in self._columns[number]
            ):
                (said,) = (
                    self._told["MULT"].get(multipliers[k], (1.0,))
                    if k < len(multipliers)
                    else (1.0,)
                )
                # 0 stands for none.
                factors[i] = said if math.isfinite(said) and said > 0 else 1.0
                (unit,) = (
                    self._told["UNIT"].get(units[k], (b"",))
                    if k < len(units)
                    else (b"",)
                )
                if unit.startswith(b"deg"):
                    factors[i] *= math.pi / 180.0
            yield factors


def _error_text(subsystem: float, code: float) -> str:
    """Return the text of an ERR record."""
    if subsystem == _EKF_PRIMARY:
        return f"EKF lane switched to {code:g}"
    name = _SUBSYSTEMS.get(subsystem, f"subsystem {subsystem:g}")
    return f"{name}: error {code:g}" if code else f"{name}: resolved"


def _layout(
    name: str, size: int, types: str, columns: Sequence[str]
) -> np.dtype[np.void]:
    """Return the layout of a message. `ValueError` names the missing part."""
    if len(columns) != len(types) or set(types) - _FIELD_TYPES.keys():
        raise ValueError("its FMT record is damaged")
    sensor = _SENSORS.fullmatch(name)
    rate, acceleration = _VALUES[sensor[1]] if sensor else ((), ())
    needed = {
        *{**_TEXTS, **_UNITS, **_FLIGHT}.get(name, rate),
        *(["DelaT"] if sensor and sensor[1] == "IMT" else []),
    }
    fields: dict[str, tuple[str, int]] = {}
    at = _RECORD_HEAD
    wanted = (*needed, *acceleration, *_OPTIONAL)
    for column, kind in zip(columns, types, strict=True):
        if column in wanted and kind in _TYPES_OF.get(column, _NUMBERS):
            fields.setdefault(column, (_FIELD_TYPES[kind], at))
        at += np.dtype(_FIELD_TYPES[kind]).itemsize
    if at != size:
        raise ValueError(f"its records have {size} bytes, its columns {at}")
    if lacking := sorted(needed - fields.keys()):
        raise ValueError(f"it has no column {lacking[0]}")
    if sensor and not {"TimeUS", "TimeMS"} & fields.keys():
        raise ValueError("it has no column of times")
    formats = [kind for kind, _ in fields.values()]
    offsets = [offset for _, offset in fields.values()]
    layout: Any = {
        "names": list(fields),
        "formats": formats,
        "offsets": offsets,
        "itemsize": size,
    }
    return np.dtype(layout)


def _samples(
    source: Source, rows: Rows, start: Int, of_rate: Array, of_acceleration: Array
) -> list[tuple[Source, ImuSamples]]:
    """Return the samples of each instance in records (k,) of one message.

    ``start`` (k,): their first bytes. ``of_rate``, ``of_acceleration`` (3,): factors.
    """
    columns = rows.dtype.names or ()
    rate, acceleration = (_vectors(rows, names) for names in _VALUES[source.kind])
    if source.kind == "IMT":
        rate = per_time(rate, rows["DelaT"])
        acceleration = (
            per_time(acceleration, rows["DelvT"])
            if "DelvT" in columns
            else acceleration * np.nan
        )
    samples = imu_samples(
        _stamp(rows),
        rate * of_rate * FLU,
        acceleration * of_acceleration * FLU,
        start + rows.itemsize,
    )
    if "I" not in columns:
        return [(source, samples)]
    return [
        (Source(source.kind, k), samples[rows["I"] == k])
        for k in np.unique(rows["I"]).tolist()
    ]


def _vectors(rows: Rows, columns: Sequence[str]) -> Array:
    """Return three columns of k rows as vectors, (k, 3), NaN where columns are missing."""
    if not set(columns) <= set(rows.dtype.names or ()):
        return np.full((len(rows), 3), np.nan)
    return np.column_stack([rows[column].astype(np.float64) for column in columns])


def _stamp(rows: Rows) -> Int:
    """Return the times of records (k,), us since the start, those of samples if logged."""
    columns = rows.dtype.names or ()
    if "TimeMS" not in columns:
        stamp = rows["TimeUS"].astype(np.int64)
    else:
        stamp = rows["TimeMS"].astype(np.int64) * 1000
        if "TimeUS" in columns:
            # A time of 32 bits is completed by the time of its record.
            stamp += (rows["TimeUS"].astype(np.int64) - stamp + 2**31) % 2**32 - 2**31
    if "SampleUS" in columns:
        sampled = rows["SampleUS"].astype(np.int64)
        stamp = np.where(sampled > 0, sampled, stamp)
    return stamp


def _start_utc(rows: Rows) -> int | None:
    """Return the UTC of the start of the autopilot by GPS records (k,), us since 1970."""
    columns = rows.dtype.names or ()
    new = {"GMS", "GWk", "TimeUS"} <= set(columns)
    if not new and not {"TimeMS", "Week", "T"} <= set(columns):
        return None
    rows = rows[rows["Status"] >= GPS_FIX_3D] if "Status" in columns else rows
    week, ms = (
        rows[name].astype(np.int64)
        for name in (("GWk", "GMS") if new else ("Week", "TimeMS"))
    )
    stamp = (
        rows["TimeUS"].astype(np.int64) if new else rows["T"].astype(np.int64) * 1000
    )
    utc = (_GPS_EPOCH - _LEAP + _WEEK * week) * 1_000_000 + ms * 1000
    return possible_start(utc, stamp)
