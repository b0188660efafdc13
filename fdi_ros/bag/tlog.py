# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Telemetry logs of ground stations (.tlog), decoded by pymavlink.

A record is 8 bytes of time (us since 1970, big endian), when the message came over the
link, and a message of MAVLink 1 or 2. A record counts only if another one follows
directly. Messages in use also need a valid checksum. One autopilot is read, by the
description that also serves a live link (`fdi_ros.mavlink.protocol`). Stamps are the
autopilot's own. UTC comes from the message with the least delay. Texts, modes and
throttle have no stamp: their stamps come from the samples around them.
"""

from __future__ import annotations

import contextlib
import copy
import hashlib
import math
import struct
from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.bag.flight_log import (
    ImuSamples,
    Portion,
    Source,
    imu_samples,
    possible_start,
)
from fdi_ros.bag.library_log import Columns, LibraryLog
from fdi_ros.bag.modes import VEHICLES, ardupilot_mode, px4_heartbeat_mode
from fdi_ros.mavlink.protocol import (
    ARDUPILOT,
    IMU_MESSAGES,
    MOST_UNITS,
    NO_AUTOPILOT,
    RAW,
    SCALED,
    numbers,
    read,
    understood,
)
from fdi_ros.mavlink.vehicle import dialect
from fdi_ros.model.samples import Int
from fdi_ros.system.files import LOGS

_IMUS = tuple(message.name for message in IMU_MESSAGES.values())
_OTHER_MESSAGES = (
    "HEARTBEAT",
    "PARAM_VALUE",
    "VFR_HUD",
    "STATUSTEXT",
    "AUTOPILOT_VERSION",
)
"""Messages that are read beside the rates."""
#: first bytes of messages of MAVLink 1 and 2
_MARKS = (0xFE, 0xFD)
#: bytes of the time before each message
_TIME = 8
#: bytes of the shortest record
_LEAST = _TIME + 8
#: messages beside the rates that are kept: the first ones
_MOST_BESIDE = 100_000
#: samples around a message that show the present difference of the two clocks. The
#: median of nine is right with four damaged times
_AROUND = 9
#: largest time, us
_LATEST = 1 << 53
_ROW = struct.Struct("=3q7d")
_SAMPLE_COLUMNS = np.dtype(
    [
        ("stamp", "i8"),
        ("came", "i8"),
        ("end", "i8"),
        ("rate", "f8", 3),
        ("acceleration", "f8", 3),
        ("temperature", "f8"),
    ]
)
"""Of each sample, with the time at which its message came, us since 1970."""


class _Beside(NamedTuple):
    """A message beside the samples."""

    #: first byte of its record in the file
    begin: int
    #: time at which it came, us since 1970
    came: int
    message: Any


_FOUND = (
    "system",
    "start_utc",
    "hardware_id",
    "counts",
    "said",
    "modes",
    "throttle",
    "temperatures",
    "devices",
    "_lost",
    "_guessed",
)
"""Attributes that decoding sets, beside the samples."""
_Read = tuple[bytes, dict[str, Any], dict[Source, Columns]]
"""Digest of a log, what was found in it by attribute, and its samples."""


class Tlog(LibraryLog):
    """An open log of a ground station."""

    magic = b"\0"
    refusal = "is no log of a ground station (.tlog)"
    kinds = tuple(dict.fromkeys(message.kind for message in IMU_MESSAGES.values()))
    settings = "on ArduPilot, raise SRn_RAW_SENS (from 4.7 on MAVn_RAW_SENS)"
    one_imu = (
        "one IMU cannot be checked: this autopilot sent no other ({}). If the board has more, it should send"
        " SCALED_IMU2 and SCALED_IMU3; for ArduPilot, check INS_ENABLE_MASK"
    )
    first_imu = 1
    #: many ground stations ask for no more than 10 Hz
    slowest = 5.0
    most = LOGS.tlog_bytes
    together = 1 << 16

    _read_last: ClassVar[_Read] = (b"", {}, {})

    def load(self, data: bytes) -> dict[Source, Columns]:
        """Read the messages of IMUs that one autopilot sent.

        The first autopilot with a HEARTBEAT is chosen, or else the first with an IMU. A replay
        opens its log four times, and decoding takes most of an opening: what was found in
        the last log is kept.
        """
        digest = hashlib.blake2b(data).digest()
        read_before, found, columns = Tlog._read_last
        if digest != read_before:
            columns = self._decode(data)
            found = copy.deepcopy({name: getattr(self, name) for name in _FOUND})
            Tlog._read_last = digest, found, columns
        else:
            vars(self).update(copy.deepcopy(found))
        if self._guessed:
            self.note(self._guessed)
        return columns

    def _decode(self, data: bytes) -> dict[Source, Columns]:
        """Decode the messages of one autopilot."""
        if (chosen := self._autopilot(data)) is None:
            return {}
        self.system, autopilot = chosen
        found: defaultdict[Source, bytearray] = defaultdict(bytearray)
        beside: list[_Beside] = []
        for at, end, message in self._messages(data, (*_IMUS, *_OTHER_MESSAGES)):
            if message.get_srcSystem() != self.system:
                continue
            came = int.from_bytes(data[at : at + _TIME], "big")
            if (number := message.get_msgId()) not in IMU_MESSAGES:
                beside.append(_Beside(at, came, message))
                del beside[_MOST_BESIDE:]
            elif understood(IMU_MESSAGES[number].kind, autopilot):
                self._take_sample(found, message, data[at:end], came, end)
        raw = Source(IMU_MESSAGES[RAW].kind, 0)
        scaled = Source(IMU_MESSAGES[SCALED].kind, 0)
        if raw in found and scaled not in found:
            found[scaled] = found.pop(raw)
        tables = {
            source: np.frombuffer(rows, _SAMPLE_COLUMNS)
            for source, rows in found.items()
        }
        self.start_utc = _start_utc_by(
            [table["came"] - table["stamp"] for table in tables.values()]
        )
        for source, table in tables.items():
            table.flags.writeable = False  # several openings may share it
            self.add_temperature(source.instance, table["stamp"], table["temperature"])
        stamps = _stamps_of(beside, list(tables.values()))
        for one, stamp in zip(beside, stamps, strict=True):
            self._take_beside(one.message, stamp, autopilot)
        return {
            source: {name: table[name] for name in _SAMPLE_COLUMNS.names or ()}
            for source, table in tables.items()
        }

    def _take_sample(
        self,
        found: defaultdict[Source, bytearray],
        message: Any,
        record: bytes,
        came: int,
        end: int,
    ) -> None:
        """Take a message of an IMU. ``came``: us since 1970. ``end``: of its record."""
        number = message.get_msgId()
        kind = IMU_MESSAGES[number].kind
        self.counts[kind] += 1
        payload = _TIME + (10 if record[_TIME] == 0xFD else 6)
        reading = read(number, record[payload : payload + record[_TIME + 1]])
        if reading is not None and reading.unit < MOST_UNITS:
            times = min(reading.stamp // 1000, _LATEST), min(came, _LATEST)
            values = *reading.rate, *reading.acceleration, _degrees(message)
            found[Source(kind, reading.unit)] += _ROW.pack(*times, end, *values)

    def _take_beside(self, message: Any, stamp: int, autopilot: int) -> None:
        """Take a text, a mode, the throttle or an id. ``stamp``: us, as of the samples."""
        name = message.get_type()
        if name == "AUTOPILOT_VERSION":
            serial = bytes(message.uid2).hex()
            self.hardware_id = serial.strip("0") and serial
        if self.start_utc is None:
            return
        if name == "STATUSTEXT":
            self.add_text(stamp, "STATUSTEXT", str(message.text))
        elif name == "HEARTBEAT" and message.autopilot == autopilot:
            if autopilot == ARDUPILOT:
                vehicle = VEHICLES.get(message.type, "")
                self.add_mode(stamp, ardupilot_mode(vehicle, message.custom_mode))
            else:
                self.add_mode(stamp, px4_heartbeat_mode(message.custom_mode))
        elif name == "VFR_HUD":
            self.throttle.add(np.array([stamp]), np.array([message.throttle]))
        elif name == "PARAM_VALUE":
            self.take_parameter(str(message.param_id), message.param_value)

    def origin(self, source: Source) -> str:
        """Return the message of a source: SCALED_IMU2."""
        own = numbers(source.kind)
        if len(own) > source.instance:
            return IMU_MESSAGES[own[source.instance]].name
        return f"{source.kind} id {source.instance}"

    def _autopilot(self, data: bytes) -> tuple[int, int] | None:
        """Return system and MAV_AUTOPILOT of the autopilot to read, or None."""
        self._guessed = ""
        for _, _, beat in self._messages(data, ("HEARTBEAT",)):
            if beat.autopilot != NO_AUTOPILOT:
                return beat.get_srcSystem(), beat.autopilot
        for _, _, message in self._messages(data, _IMUS):
            system = message.get_srcSystem()
            self._guessed = (
                f"it has no HEARTBEAT of an autopilot: system {system} is read, which"
                " sent the first message of an IMU"
            )
            return system, NO_AUTOPILOT
        return None

    def samples(self, kind: str, columns: Columns) -> ImuSamples:
        """Return the samples in messages of a kind."""
        return imu_samples(
            columns["stamp"], columns["rate"], columns["acceleration"], columns["end"]
        )

    def portions(self) -> Iterator[Portion]:
        """Return the samples, and note the bytes left out."""
        yield from super().portions()
        if self._lost:
            self.leave_bytes(self._lost)

    def _messages(
        self, data: bytes, names: Sequence[str]
    ) -> Iterator[tuple[int, int, Any]]:
        """Yield the valid messages of autopilots with these names, and count the lost bytes.

        Yields begin and end of the record in the file, bytes, and the decoded message.
        """
        codec = dialect()
        parser = codec.MAVLink(None)
        wanted = {getattr(codec, f"MAVLINK_MSG_ID_{name}") for name in names}
        at = lost = 0
        while at + _LEAST <= len(data):
            end = record_end(data, at)
            if end > len(data):
                break
            if not end:
                at = at + 1
                lost = lost + 1
                continue
            start = at + _TIME
            second = data[start] == 0xFD
            number = (
                int.from_bytes(data[start + 7 : start + 10], "little")
                if second
                else data[start + 5]
            )
            if (
                number in wanted
                and data[start + (6 if second else 4)] == codec.MAV_COMP_ID_AUTOPILOT1
            ):
                with contextlib.suppress(codec.MAVError):
                    yield at, end, parser.decode(bytearray(data[start:end]))
            at = end
        self._lost = lost + len(data) - at


def _degrees(message: Any) -> float:
    """Return the temperature of an IMU, degC. NaN: it has no thermometer."""
    unit = 1.0 if message.get_msgId() in numbers("HIGHRES_IMU") else 0.01
    return unit * message.temperature if message.temperature else math.nan


def record_end(data: bytes, at: int) -> int:
    """Return the end of the record at a byte, 0 if none, or if no record follows."""
    mark = data[at + _TIME]
    if data[at] != 0 or mark not in _MARKS:
        return 0
    end = at + _TIME + data[at + _TIME + 1] + 8
    if mark == 0xFD:
        end += 4 + 13 * (data[at + _TIME + 2] & 1)
    if end + _TIME >= len(data):
        return end
    goes_on = data[end] == 0 and data[end + _TIME] in _MARKS
    return end if goes_on else 0


def _stamps_of(beside: Sequence[_Beside], tables: Sequence[NDArray[Any]]) -> list[int]:
    """Return the stamps of messages, us, by the samples around each in the file.

    The times of coming alone do not show them: the clocks of autopilot and ground station may
    drift apart. A simulation on a busy computer loses seconds.
    """
    samples = np.concatenate([np.empty(0, _SAMPLE_COLUMNS), *tables])
    if not len(samples):
        return [0] * len(beside)
    samples = samples[np.argsort(samples["end"], kind="stable")]
    place = np.searchsorted(samples["end"], [one.begin for one in beside], "right")
    around = place[:, None] + np.arange(_AROUND) - _AROUND // 2
    around = np.clip(around, 0, len(samples) - 1)
    starts = samples["came"][around] - samples["stamp"][around]
    start = np.sort(starts, axis=1)[:, _AROUND // 2]
    came = np.array([min(one.came, _LATEST) for one in beside], dtype=np.int64)
    stamps: list[int] = (came - start).tolist()
    return stamps


def _start_utc_by(starts: Sequence[Int]) -> int | None:
    """Return the UTC of the start of the autopilot by the message with the least delay."""
    none = np.empty(0, np.int64)
    ordered = np.sort(np.concatenate([none, *starts]))
    # A time that is an hour off is damaged.
    near = (
        ordered[ordered >= np.median(ordered) - 3_600_000_000]
        if len(ordered)
        else ordered
    )
    return possible_start(near[:1], np.zeros_like(near[:1]))
