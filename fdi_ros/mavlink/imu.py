# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The MAVLink messages that carry gyros: where values lie in them, in which units; one description for live and logs.

By the common dialect, and by what the senders do (PX4 ``src/modules/mavlink/streams``, ArduPilot ``GCS_Common.cpp``):

- SCALED_IMU, SCALED_IMU2, SCALED_IMU3: IMU 1, 2, 3 of either autopilot, each under its own name. Whole mrad/s and mG,
  cut off towards zero, with the autopilot's milliseconds. Beyond 32.767 rad/s the number runs over.
- RAW_IMU: "raw counts" by the standard; ArduPilot sends IMU 1 in mrad/s, with microseconds: its streams for ground
  stations have it in place of SCALED_IMU (RAW_SENS: RAW_IMU, SCALED_IMU2, SCALED_IMU3). PX4 does not send it.
- HIGHRES_IMU: floating point and microseconds, of the IMU that the autopilot has chosen for itself, which may change in
  flight; PX4 subtracts the bias that its estimator has found. So one of it beside SCALED_IMU is no further sensor.

A message that carries only a magnetometer has zeros for gyro and accelerometer: it is of no IMU.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.arrays import Array, Int, Mask

Vector = tuple[float, float, float]

STANDARD_GRAVITY = 9.80665
"""m/s^2."""
GYRO_UPDATED = 0b111000
"""Bits of ``fields_updated`` of HIGHRES_IMU: x, y, z of the gyro are new."""
ARDUPILOT, PX4 = 3, 12
"""MAV_AUTOPILOT of a HEARTBEAT."""
NO_AUTOPILOT = 8
"""The same of a component that is none."""
MOST_UNITS = 4


@dataclass(frozen=True)
class ImuMessage:
    """One kind of message."""

    name: str
    number: int
    crc_extra: int
    """By which the checksum also covers the layout."""
    kind: str
    """Messages of one kind tell several units of one sort apart."""
    row: np.dtype[np.void]
    """Of the whole payload: ``time``, ``acceleration``, ``rate``; some have ``unit`` and ``updated``."""
    microseconds: int
    """In one unit of the time."""
    gyro: float
    """rad/s in one unit of the rate."""
    acceleration: float
    """m/s^2 in one unit of the acceleration."""
    unit: int = -1
    """Of which IMU, from 0; -1: it says itself."""


def _row(time: str, value: str, size: int, **further: tuple[str, int]) -> np.dtype[np.void]:
    """Type of a payload of so many bytes, extensions included; further fields each with type and place."""
    first, width = np.dtype(time).itemsize, np.dtype(value).itemsize
    fields = {"time": (time, 0), "acceleration": (f"3{value}", first), "rate": (f"3{value}", first + 3 * width)}
    formats, offsets = zip(*(fields | further).values(), strict=True)
    layout: Any = {"names": [*fields, *further], "formats": formats, "offsets": offsets, "itemsize": size}
    return np.dtype(layout)


_MILLI, _MILLI_G = 1e-3, 1e-3 * STANDARD_GRAVITY
_SCALED = _row("<u4", "<i2", 24)
MESSAGES: dict[int, ImuMessage] = {
    message.number: message
    for message in (
        ImuMessage("SCALED_IMU", 26, 170, "SCALED_IMU", _SCALED, 1000, _MILLI, _MILLI_G, 0),
        ImuMessage("SCALED_IMU2", 116, 76, "SCALED_IMU", _SCALED, 1000, _MILLI, _MILLI_G, 1),
        ImuMessage("SCALED_IMU3", 129, 46, "SCALED_IMU", _SCALED, 1000, _MILLI, _MILLI_G, 2),
        ImuMessage("RAW_IMU", 27, 144, "RAW_IMU", _row("<u8", "<i2", 29, unit=("u1", 26)), 1, _MILLI, _MILLI_G),
        ImuMessage(
            *("HIGHRES_IMU", 105, 93, "HIGHRES_IMU"),
            *(_row("<u8", "<f4", 63, unit=("u1", 62), updated=("<u2", 60)), 1, 1.0, 1.0),
        ),
    )
}
"""By message id."""
KINDS = ("HIGHRES_IMU", "RAW_IMU", "SCALED_IMU")
"""Kinds of messages, the finest first."""
RESOLUTION = {
    "SCALED_IMU": "1 mrad/s, 1 ms",
    "RAW_IMU": "1 mrad/s, 1 us",
    "HIGHRES_IMU": "single precision, 1 us",
}
"""Of rate and time, by kind."""


def numbers(kind: str) -> tuple[int, ...]:
    """Return the ids of the messages of a kind, in the order of the units."""
    return tuple(message.number for message in MESSAGES.values() if message.kind == kind)


class Readings(NamedTuple):
    """What k messages of one kind say, in the axes of the autopilot, FRD."""

    good: Mask
    """(k,) whether there is a new sample of a gyro."""
    unit: Int
    """(k,) from 0."""
    time: Int
    """(k,) us on the clock of the autopilot."""
    rate: Array
    """(k, 3) rad/s."""
    acceleration: Array
    """(k, 3) m/s^2."""


def read_rows(message: ImuMessage, rows: NDArray[np.void]) -> Readings:
    """Read payloads (k,) of one message, of the type of its rows."""
    names = rows.dtype.names or ()
    good = (rows["rate"] != 0).any(axis=1) | (rows["acceleration"] != 0).any(axis=1)
    if "updated" in names:
        good &= rows["updated"] & GYRO_UPDATED == GYRO_UPDATED
    return Readings(
        good,
        rows["unit"].astype(np.int64) if "unit" in names else np.full(len(rows), message.unit),
        (rows["time"] * np.uint64(message.microseconds)).astype(np.int64),
        rows["rate"].astype(np.float64) * message.gyro,
        rows["acceleration"].astype(np.float64) * message.acceleration,
    )


class Reading(NamedTuple):
    """What one message says, in the body frame of REP-103: x to the front, y to the left, z up."""

    message: ImuMessage
    unit: int
    """From 0."""
    time: int
    """us on the clock of the autopilot."""
    rate: Vector
    """rad/s."""
    acceleration: Vector
    """m/s^2."""


def read(number: int, payload: bytes) -> Reading | None:
    """Read the payload of a message; None: it holds no new sample of a gyro.

    Parameters
    ----------
    number
        Of the message, one of `MESSAGES`.
    payload
        As it came; what is missing at its end is zero.
    """
    message = MESSAGES[number]
    row = np.frombuffer(payload.ljust(message.row.itemsize, b"\0"), message.row, count=1)
    (good,), (unit,), (time,), ((x, y, z),), ((ax, ay, az),) = (part.tolist() for part in read_rows(message, row))
    return Reading(message, unit, time, (x, -y, -z), (ax, -ay, -az)) if good else None


SCALED, RAW = 26, 27
"""Messages of IMU 1: SCALED_IMU, and RAW_IMU, which may stand in for it."""


def stands_in(number: int, autopilot: int) -> bool:
    """Whether a message of such an autopilot (MAV_AUTOPILOT) may stand in for SCALED_IMU of IMU 1."""
    return number == RAW and autopilot == ARDUPILOT


def understood(kind: str, autopilot: int) -> bool:
    """Whether the messages of a kind are in known units, coming from such an autopilot (MAV_AUTOPILOT)."""
    return kind != "RAW_IMU" or autopilot == ARDUPILOT
