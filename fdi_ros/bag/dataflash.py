# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""ArduPilot's dataflash logs (.bin).

A record is A3 95, the number of its message, and values of a fixed size; FMT records say name, size, types and columns
of each message (AP_Logger's README in ArduPilot's sources; columns and units: "Onboard Message Log Messages" of its
documentation). There is no checksum: a record counts only where another one begins behind it.

Rates are in IMU (what the autopilot uses: filtered, all units at one time, at the rate of its loop at most) and, where
raw logging is on, in GYR (all samples of each sensor with their own times); both are in the body frame. Before version
4.1 there were IMU, IMU2, IMU3 and GYR1 to GYR3; now the column I has the instance. By INS_RAW_LOG_OPT, GYR may have a
sensor twice, before and after the filters: at the same SampleUS, as instance I and as I plus the number of gyros.
Which are logged, and how fast: LOG_BITMASK and INS_RAW_LOG_OPT in the "Complete Parameter List". Batches
(INS_LOG_BAT_MASK) are bursts for spectra, and are not read.

An hour of three IMUs at 400 Hz takes 2.5 s here; pymavlink's DFReader, one Python object per message, takes 72 s.
"""

from __future__ import annotations

import re
import struct
from typing import NamedTuple

import numpy as np

from fdi_ros.bag.log_parts import (
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

MAGIC = b"\xa3\x95"
_FMT = 128
_FMT_SIZE = 89
_HEAD = 3
"""Bytes of a record before its values."""
_TYPES = {
    "a": "S64",
    "b": "i1",
    "B": "u1",
    "c": "<i2",
    "C": "<u2",
    "d": "<f8",
    "e": "<i4",
    "E": "<u4",
    "f": "<f4",
    "g": "<f2",
    "h": "<i2",
    "H": "<u2",
    "i": "<i4",
    "I": "<u4",
    "L": "<i4",
    "M": "u1",
    "n": "S4",
    "N": "S16",
    "q": "<i8",
    "Q": "<u8",
    "Z": "S64",
}
"""NumPy types of the letters of a FMT record."""
_PLAIN = "bBdfhHiIqQ"
"""Types that are the number itself, without a factor."""
_RATE, _ACCELERATION = ("GyrX", "GyrY", "GyrZ"), ("AccX", "AccY", "AccZ")
_COLUMNS = dict.fromkeys(["TimeUS", "SampleUS", *_RATE, *_ACCELERATION, "Status", "GMS", "GWk"], _PLAIN) | {"I": "B"}
"""Columns that are read, and the types they may have."""
_OF_IMUS = re.compile(r"(IMU|GYR)([1-3]?)")
_GPS_EPOCH, _WEEK, _LEAP = 315_964_800, 604_800, 18
"""s: start of GPS time since 1970, a week, and what GPS is ahead of UTC since 2017; in earlier logs one or two less."""
_FIX = 3
"""GPS status from which on the time is known: a fix in three dimensions."""


@compiled
def record_end(data: Bytes, position: int, sizes: Int, final: bool) -> int:
    """Return where the record at a position ends; other parameters as for `find_records`.

    Returns
    -------
    The end; 0: there is no record; -1: the portion ends within it, or before it can be known.
    """
    if data[position] != 0xA3 or data[position + 1] != 0x95:
        return 0
    number = data[position + 2]
    size = _FMT_SIZE if number == _FMT else int(sizes[number])
    if size < _HEAD:
        return 0
    end = position + size
    if end > len(data) or (end + 2 > len(data) and not final):
        return -1
    return end if end + 2 > len(data) or (data[end] == 0xA3 and data[end + 1] == 0x95) else 0


@compiled
def find_records(data: Bytes, sizes: Int, final: bool, found: Int) -> tuple[int, int, int]:
    """Find the records in a portion of a log.

    Parameters
    ----------
    data
        The bytes.
    sizes
        (256,) bytes of a record of each message, 0: not known; filled in from FMT records, the first of each counts.
    final
        The log ends with the portion.
    found
        (2, room): number of the message and first byte of each record.

    Returns
    -------
    The number of records, where the walk ended, and how many bytes before that are in no record.
    """
    count = lost = position = 0
    while position + _HEAD <= len(data):
        end = record_end(data, position, sizes, final)
        if end < 0:
            break
        if end == 0:
            begin = position
            position += 1
            # A hole of gigabytes is passed at the speed of memory.
            while position + _HEAD <= len(data) and (data[position] != 0xA3 or data[position + 1] != 0x95):
                position += 1
            lost += position - begin
            continue
        if data[position + 2] == _FMT and sizes[data[position + 3]] == 0:
            sizes[data[position + 3]] = data[position + 4]
        found[0, count], found[1, count] = data[position + 2], position
        count += 1
        position = end
    return count, position, lost


class _Message(NamedTuple):
    """A kind of message that is read."""

    name: str
    fields: np.dtype[np.void]
    """Columns that are read, within a whole record."""


class DataflashReader:
    """Reads a log from its start."""

    def __init__(self) -> None:
        self._sizes = np.zeros(256, dtype=np.int64)
        self._described: set[int] = set()
        self._messages: dict[int, _Message] = {}
        self._unknown: dict[int, str] = {}
        """Names of messages of IMUs in a format that is not known."""
        self.unread: set[str] = set()

    def read(self, data: Bytes, final: bool) -> Portion:
        """Read the next portion of the file; final: nothing comes after it."""
        found = np.empty((2, len(data) // _HEAD + 1), dtype=np.int64)
        count, end, lost = find_records(data, self._sizes, final, found)
        number, offset = found[:, :count]
        for start in offset[number == _FMT].tolist():
            self._describe(data[start + _HEAD : start + _FMT_SIZE].tobytes())
        self.unread |= {name for k, name in self._unknown.items() if (number == k).any()}
        samples: list[ImuSamples] = []
        start_utc = None
        for k, message in self._messages.items():
            starts = offset[number == k]
            if not len(starts):
                continue
            rows = rows_at(data, starts, message.fields)
            if message.name == "GPS":
                start_utc = _start_utc(rows) if start_utc is None else start_utc
            else:
                samples += _samples(message.name, rows, starts + message.fields.itemsize)
        return Portion(samples, start_utc, int(end), int(lost))

    def _describe(self, content: bytes) -> None:
        """Take in a FMT record, if it is the first of its message and that is one to be read."""
        number, size, name_, types_, columns_ = struct.unpack("<BB4s16s64s", content)
        name, types, columns = (
            text.partition(b"\0")[0].decode("ascii", "replace") for text in (name_, types_, columns_)
        )
        if number in self._described:
            return
        self._described.add(number)
        if not _OF_IMUS.fullmatch(name) and name != "GPS":
            return
        row = _row(name, size, types, columns)
        if row is not None:
            self._messages[number] = _Message(name, row)
        elif name != "GPS":
            self._unknown[number] = name


def _row(name: str, size: int, types: str, columns: str) -> np.dtype[np.void] | None:
    """Return where the columns that are read lie in the records of a message; None: it lacks what is needed."""
    fields: dict[str, Field] = {}
    at = _HEAD
    for column, kind in zip(columns.split(","), types, strict=False):
        if kind not in _TYPES:
            return None
        if kind in _COLUMNS.get(column, ""):
            fields.setdefault(column, Field(_TYPES[kind], at))
        at += np.dtype(_TYPES[kind]).itemsize
    needed = {"TimeUS", "GMS", "GWk"} if name == "GPS" else {"TimeUS", *_RATE}
    whole = at == size and len(columns.split(",")) == len(types) and needed <= fields.keys()
    return row_type(fields, size) if whole else None


def _samples(name: str, rows: Rows, end: Int) -> list[ImuSamples]:
    """Return the samples in the records (k,) of one message, of each instance by itself; end (k,) is where they end."""
    columns = rows.dtype.names or ()
    kind, number = name[:3], int(name[3:] or 1) - 1
    instance = rows["I"].astype(np.int64) if "I" in columns else np.full(len(rows), number)
    stamp = rows["TimeUS"].astype(np.int64)
    if "SampleUS" in columns:
        sampled = rows["SampleUS"].astype(np.int64)
        stamp = np.where(sampled > 0, sampled, stamp)
    rate, acceleration = vectors(rows, _RATE), vectors(rows, _ACCELERATION)
    samples = [ImuSamples(Source(kind, k), stamp, rate, acceleration, end) for k in np.unique(instance).tolist()]
    return [one.at(instance == one.source.instance) for one in samples]


def _start_utc(rows: Rows) -> int | None:
    """Return the UTC of the start of the autopilot by GPS records (k,), us since 1970."""
    rows = rows[rows["Status"] >= _FIX] if "Status" in (rows.dtype.names or ()) else rows
    rows = rows[rows["GWk"] > 0]
    seconds = _GPS_EPOCH - _LEAP + _WEEK * rows["GWk"].astype(np.int64)
    utc = seconds * 1_000_000 + rows["GMS"].astype(np.int64) * 1000
    return possible_start(utc, rows["TimeUS"].astype(np.int64))


DATAFLASH = LogFormat(
    stack="ArduPilot",
    messages="IMU, GYR",
    advice="set bit 18 (Fast IMU, Copter only) or 19 (Raw IMU) of LOG_BITMASK, or bit 1 of INS_RAW_LOG_OPT",
    magic=MAGIC,
    head=0,
    reader=DataflashReader,
    counted_by="IMU",
)
