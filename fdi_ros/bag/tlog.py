# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Telemetry logs of ground stations (.tlog): MAVLink as it came over a link, each message with the time it came.

A record is 8 bytes of time (us since 1970, the first byte first) and a message of MAVLink 1 or 2. A record counts only
where another one begins behind it, and one that is used only with its checksum. What the messages of IMUs say is told
by the same description as live (`fdi_ros.mavlink.imu`), of one autopilot: the first with a HEARTBEAT.

Stamps are the autopilot's own; UTC is that of the message that came with the least delay.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fdi_ros.bag.log_parts import ImuSamples, LogFormat, LogReader, Portion, Rows, by_instance, possible_start
from fdi_ros.compiling.compiled import compiled
from fdi_ros.mavlink.imu import (
    GYRO_UPDATED,
    MESSAGES,
    MOST_UNITS,
    NO_AUTOPILOT,
    RAW,
    SCALED,
    ImuMessage,
    stands_in,
    understood,
)
from fdi_ros.model.samples import Bytes, Int

_HEARTBEAT, _HEARTBEAT_CRC = 0, 50
_AUTOPILOT_AT = 5
"""Byte of a HEARTBEAT with the MAV_AUTOPILOT."""
_AUTOPILOT_COMPONENT = 1
_TIME = 8
_LEAST = _TIME + 8
"""Bytes of the shortest record."""
_IDS = 256
"""Messages that are used have smaller ids."""
_COLUMNS = 5
"""Of what is found: id of the message, system, first byte and length of the payload, end."""
_NO_CRC = -1
SLOWEST = 5.0
"""Samples a second from which on it can be judged; many ground stations ask for no more than 10."""


@compiled
def checksum(data: Bytes, start: int, end: int, extra: int) -> int:
    """CRC-16/MCRF4XX of bytes, and of one more that stands for the layout of the message."""
    crc = 0xFFFF
    for k in range(start, end + 1):
        byte = extra if k == end else int(data[k])
        byte ^= crc & 0xFF
        byte ^= byte << 4 & 0xFF
        crc = (crc >> 8 ^ byte << 8 ^ byte << 3 ^ byte >> 4) & 0xFFFF
    return int(crc)


@compiled
def record_end(data: Bytes, position: int, final: bool) -> int:
    """Return where the record at a position ends; 0: there is none; -1: that cannot be known yet."""
    if position + _LEAST > len(data):
        return -1
    magic = data[position + _TIME]
    if data[position] != 0 or (magic != 0xFD and magic != 0xFE):
        return 0
    length = int(data[position + _TIME + 1])
    end = position + _TIME + length + 8
    if magic == 0xFD:
        end += 4 + 13 * (int(data[position + _TIME + 2]) & 1)
    if end > len(data):
        return -1
    if end + _TIME + 1 > len(data):
        return end if final else -1
    follows = data[end] == 0 and (data[end + _TIME] == 0xFD or data[end + _TIME] == 0xFE)
    return end if follows else 0


@compiled
def find_records(data: Bytes, crcs: Int, final: bool, found: Int) -> tuple[int, int, int]:
    """Find the records of a portion that are used.

    Parameters
    ----------
    data
        The bytes.
    crcs
        (`_IDS`,) byte that stands for the layout of each message that is used, else -1.
    final
        The log ends with the portion.
    found
        (`_COLUMNS`, room): of each record id of the message, system, first byte and length of the payload, end.

    Returns
    -------
    The number of records, where the walk ended, and how many bytes before that are in no record.
    """
    count = lost = position = 0
    while position < len(data):
        end = record_end(data, position, final)
        if end < 0:
            break
        if end == 0:
            lost += 1
            position += 1
            continue
        start = position + _TIME
        second = data[start] == 0xFD
        length = int(data[start + 1])
        if second:
            number = int(data[start + 7]) | int(data[start + 8]) << 8 | int(data[start + 9]) << 16
            system, component, payload = data[start + 5], data[start + 6], start + 10
        else:
            number = int(data[start + 5])
            system, component, payload = data[start + 3], data[start + 4], start + 6
        if number < len(crcs) and crcs[number] >= 0 and component == _AUTOPILOT_COMPONENT:
            said = int(data[payload + length]) | int(data[payload + length + 1]) << 8
            if checksum(data, start + 1, payload + length, int(crcs[number])) == said:
                found[0, count], found[1, count] = number, system
                found[2, count], found[3, count], found[4, count] = payload, length, end
                count += 1
        position = end
    return count, position, lost


class _Found(NamedTuple):
    """k records."""

    number: Int
    system: Int
    payload: Int
    length: Int
    end: Int

    def of(self, number: int, system: int) -> _Found:
        """Return those of one message and system."""
        rows = (self.number == number) & (self.system == system)
        return _Found(*(column[rows] for column in self))


class TlogReader(LogReader):
    """Reads a log from its start."""

    def __init__(self) -> None:
        super().__init__()
        self._crcs = np.full(_IDS, _NO_CRC, dtype=np.int64)
        self._crcs[_HEARTBEAT] = _HEARTBEAT_CRC
        for number, message in MESSAGES.items():
            self._crcs[number] = message.crc_extra
        self._system: int | None = None
        self._autopilot = NO_AUTOPILOT
        self._raw_stands_in: bool | None = None
        """Whether RAW_IMU is read as SCALED_IMU, which is not there; None: no message of IMUs was met yet."""

    def read(self, data: Bytes, final: bool) -> Portion:
        """Read the next portion of the file; final: nothing comes after it."""
        room = np.empty((_COLUMNS, len(data) // _LEAST + 1), dtype=np.int64)
        count, end, lost = find_records(data, self._crcs, final, room)
        found = _Found(*room[:, :count])
        if self._system is None:
            self._find_autopilot(data, found)
        if self._raw_stands_in is None and np.isin(found.number, list(MESSAGES)).any():
            self._raw_stands_in = stands_in(RAW, self._autopilot) and not (found.number == SCALED).any()
        samples: list[ImuSamples] = []
        starts: list[int] = []
        for number, message in MESSAGES.items():
            if self._system is None or not understood(message.kind, self._autopilot):
                continue
            of = found.of(number, self._system)
            self.counts[message.kind] += len(of.end)
            if len(of.end):
                rows = _rows(data, of.payload, of.length, message)
                kind = MESSAGES[SCALED].kind if number == RAW and self._raw_stands_in else message.kind
                samples += _samples(message, kind, rows, of.end)
                starts += _starts(data, of.payload, message, rows)
        return Portion(samples, min(starts, default=None), int(end), int(lost))

    def _find_autopilot(self, data: Bytes, found: _Found) -> None:
        """Take the first autopilot that says that it is one."""
        beats = (found.number == _HEARTBEAT) & (found.length > _AUTOPILOT_AT)
        for payload, system in zip(found.payload[beats].tolist(), found.system[beats].tolist(), strict=True):
            autopilot = int(data[payload + _AUTOPILOT_AT])
            if autopilot != NO_AUTOPILOT:
                self._system, self._autopilot = system, autopilot
                return


def _rows(data: Bytes, payload: Int, length: Int, message: ImuMessage) -> Rows:
    """Return the payloads (k,) of one message by field; zeros at their ends may be left out."""
    size = message.size
    padded = np.append(data, np.zeros(size, dtype=np.uint8))
    rows = np.lib.stride_tricks.sliding_window_view(padded, size)[payload].copy()
    rows[np.arange(size) >= length[:, None]] = 0
    return rows.view(message.row)[:, 0]


def _samples(message: ImuMessage, kind: str, rows: Rows, end: Int) -> list[ImuSamples]:
    """Return the samples in the rows (k,) of one message, as those of a kind, of each unit by itself, in FRD."""
    names = rows.dtype.names or ()
    good = (rows["rate"] != 0).any(axis=1) | (rows["acceleration"] != 0).any(axis=1)
    if "updated" in names:
        good &= rows["updated"] & GYRO_UPDATED == GYRO_UPDATED
    unit = rows["unit"].astype(np.int64) if "unit" in names else np.full(len(rows), message.unit)
    good &= unit < MOST_UNITS
    stamp = (rows["time"] * np.uint64(message.microseconds)).astype(np.int64)
    rate = rows["rate"].astype(np.float64) * message.gyro
    acceleration = rows["acceleration"].astype(np.float64) * message.acceleration
    return by_instance(kind, np.where(good, unit, -1), stamp, rate, acceleration, end)


def _starts(data: Bytes, payload: Int, message: ImuMessage, rows: Rows) -> list[int]:
    """Return the UTC of the start of the autopilot by the message with the least delay, if that can be true."""
    first = np.where(data[payload - 10] == 0xFD, payload - 10, payload - 6) - _TIME
    times = np.lib.stride_tricks.sliding_window_view(data, _TIME)[first].copy().view(">i8")[:, 0].astype(np.int64)
    stamp = (rows["time"] * np.uint64(message.microseconds)).astype(np.int64)
    start = times - stamp
    earliest = np.argsort(start, kind="stable")[:1]
    found = possible_start(times[earliest], stamp[earliest])
    return [] if found is None else [found]


TLOG = LogFormat(
    stack="a ground station (.tlog)",
    kinds=tuple(dict.fromkeys(message.kind for message in MESSAGES.values())),
    settings={"": "ArduPilot: SRn_RAW_SENS, from 4.7 on MAVn_RAW_SENS"},
    magic=b"\0",
    head=0,
    reader=TlogReader,
    slowest=SLOWEST,
)
