# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Telemetry logs of ground stations (.tlog): MAVLink as it came over a link, each message with the time it came.

A record is 8 bytes of time (us since 1970, the first byte first) and a message of MAVLink 1 or 2. A record counts only
where another one begins behind it, and one that is used only if pymavlink accepts it, by its checksum. What the
messages of IMUs say is told by the same description as live (`fdi_ros.mavlink.protocol`), of one autopilot: the first
with a HEARTBEAT.

Stamps are the autopilot's own; UTC is that of the message that came with the least delay.
"""

from __future__ import annotations

import contextlib
from array import array
from collections.abc import Iterator
from typing import Any, ClassVar

import numpy as np

from fdi_ros.bag.flight_log import FlightLog
from fdi_ros.bag.log_parts import ImuSamples, Portion, Source, parts, possible_start
from fdi_ros.mavlink.protocol import MESSAGES, MOST_UNITS, NO_AUTOPILOT, RAW, SCALED, read, understood
from fdi_ros.mavlink.vehicle import dialect
from fdi_ros.model.samples import Int
from fdi_ros.system.files import TLOG_BYTES

_HEARTBEAT, _STATUSTEXT = 0, 253
_AUTOPILOT_COMPONENT = 1
_MARKS = (0xFE, 0xFD)  # first bytes of messages of MAVLink 1 and 2
_TIME = 8
_LEAST = _TIME + 8  # bytes of the shortest record
_TOGETHER = 1 << 16  # samples of a source handed on at once, about
_MAX_DELAY_SPREAD = 3_600_000_000
"""us; a message that came by so much more or less late than half of the others has a damaged time."""
_LATEST = 2.0**53  # us; up to there a time is exact in the memory of samples


class Tlog(FlightLog):
    """An open log, read whole."""

    stack = "a ground station (.tlog)"
    magic = b"\0"
    kinds = tuple(dict.fromkeys(message.kind for message in MESSAGES.values()))
    settings: ClassVar = {"": "ArduPilot: SRn_RAW_SENS, from 4.7 on MAVn_RAW_SENS"}
    one_imu = (
        "this autopilot sent one IMU ({}): nothing to compare it with; a board with more sends SCALED_IMU2 and"
        " SCALED_IMU3, ArduPilot's starts those that INS_ENABLE_MASK names"
    )
    slowest = 5.0  # many ground stations ask for no more than 10 Hz
    most = TLOG_BYTES
    _series: dict[Source, array[float]] | None = None
    """Of each sample: its time, us on the autopilot's clock, when it came, us since 1970, where its record ends, bytes,
    rate and acceleration, rad/s and m/s^2."""

    def portions(self) -> Iterator[Portion]:
        """Return the samples up to `end`."""
        if self._series is None:
            self._came: list[tuple[int, str]] = []
            """What the autopilot said, with the time at which it came, us since 1970."""
            self.file.seek(0)
            self._series = self._load(self.file.read(self.end))
        rows = {source: np.frombuffer(one).reshape(-1, 9) for source, one in self._series.items()}
        rows = {source: values[values[:, 2] <= self.end] for source, values in rows.items()}
        times = {source: values[:, :3].astype(np.int64) for source, values in rows.items()}
        self.start_utc = min(filter(None, map(_start_utc, times.values())), default=None)
        self.said.clear()
        if self.start_utc is not None:
            for came, text in self._came:
                self.add_text(came - self.start_utc, "STATUSTEXT", text)
        found = [
            ImuSamples(source, times[source][:, 0], values[:, 3:6], values[:, 6:], times[source][:, 2])
            for source, values in rows.items()
        ]
        for chosen, share in parts([len(one.stamp) for one in found], _TOGETHER):
            yield [one.at(k) for one, k in zip(found, chosen, strict=True)], share

    def _load(self, data: bytes) -> dict[Source, array[float]]:
        """Read the messages of IMUs of the first autopilot that says that it is one."""
        series: dict[Source, array[float]] = {}
        beats = (beat for _, _, beat in self._messages(data, (_HEARTBEAT,)) if beat.autopilot != NO_AUTOPILOT)
        if (beat := next(beats, None)) is None:
            return series
        for at, end, message in self._messages(data, (*MESSAGES, _STATUSTEXT)):
            if message.get_srcSystem() != beat.get_srcSystem():
                continue
            came, number = int.from_bytes(data[at : at + _TIME], "big"), message.get_msgId()
            if number == _STATUSTEXT:
                self._came.append((came, str(message.text)))
                continue
            kind = MESSAGES[number].kind
            if not understood(kind, beat.autopilot):
                continue
            self.counts[kind] += 1
            start = at + _TIME
            payload = start + (10 if data[start] == 0xFD else 6)
            reading = read(number, data[payload : payload + data[start + 1]])
            if reading is None or reading.unit >= MOST_UNITS:
                continue
            time = min(reading.stamp // 1000, _LATEST)
            row = (time, min(came, _LATEST), end, *reading.rate, *reading.acceleration)
            series.setdefault(Source(kind, reading.unit), array("d")).extend(row)
        raw, scaled = (Source(MESSAGES[number].kind, 0) for number in (RAW, SCALED))
        if raw in series and scaled not in series:
            series[scaled] = series.pop(raw)
        return series

    def _messages(self, data: bytes, numbers: tuple[int, ...]) -> Iterator[tuple[int, int, Any]]:
        """Yield the messages with these ids that an autopilot has sent, and that pymavlink accepts.

        Of each: where its record begins and ends in the file, bytes, and the message as pymavlink decodes it.
        """
        codec = dialect()
        parser = codec.MAVLink(None)
        at = lost = 0
        while at + _LEAST <= len(data):
            end = record_end(data, at)
            if end > len(data):
                break
            if not end:
                at, lost = at + 1, lost + 1
                continue
            start = at + _TIME
            second = data[start] == 0xFD
            number = int.from_bytes(data[start + 7 : start + 10], "little") if second else data[start + 5]
            if number in numbers and data[start + (6 if second else 4)] == _AUTOPILOT_COMPONENT:
                with contextlib.suppress(codec.MAVError):
                    yield at, end, parser.decode(bytearray(data[start:end]))
            at = end
        if lost + len(data) - at:
            self.note(f"{lost + len(data) - at} bytes belong to no whole record and were left out")


def record_end(data: bytes, at: int) -> int:
    """Return where the record at a place ends; 0: there is none, or none behind it that proves it."""
    mark = data[at + _TIME]
    if data[at] != 0 or mark not in _MARKS:
        return 0
    end = at + _TIME + data[at + _TIME + 1] + 8
    if mark == 0xFD:
        end += 4 + 13 * (data[at + _TIME + 2] & 1)
    if end + _TIME >= len(data):
        return end
    return end if data[end] == 0 and data[end + _TIME] in _MARKS else 0


def _start_utc(times: Int) -> int | None:
    """Return the UTC of the start of the autopilot by the message with the least delay, if that can be true.

    ``times`` (k, 3) of each sample: its time, us, and when it came, us since 1970; another.
    """
    if not len(times):
        return None
    start = times[:, 1] - times[:, 0]
    earliest = start[np.abs(start - np.median(start)) <= _MAX_DELAY_SPREAD].min(keepdims=True)
    return possible_start(earliest, np.zeros_like(earliest))
