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

import struct
from typing import NamedTuple

Vector = tuple[float, float, float]

STANDARD_GRAVITY = 9.80665  # m/s^2
GYRO_UPDATED = 0b111000  # bits of ``fields_updated`` of HIGHRES_IMU: x, y, z of the gyro are new
ARDUPILOT, PX4 = 3, 12  # MAV_AUTOPILOT of a HEARTBEAT
NO_AUTOPILOT = 8  # the same of a component that is none
MOST_UNITS = 4


class ImuMessage(NamedTuple):
    """One kind of message."""

    name: str
    number: int
    kind: str  # messages of one kind tell several units of one sort apart
    size: int  # bytes of the payload, extensions included; MAVLink 2 leaves zeros at its end away.
    head: struct.Struct  # time, acceleration and rate, three each, with which it begins
    microseconds: int  # in one unit of the time
    gyro: float  # rad/s in one unit of the rate
    acceleration: float  # m/s^2 in one unit of the acceleration
    unit: int = -1  # of which IMU, from 0; -1: it says itself
    unit_at: int = -1  # where it does, bytes
    updated_at: int = -1  # where it says which fields are new, bytes; -1: nowhere


_MILLI = (1e-3, 1e-3 * STANDARD_GRAVITY)
_SCALED = ("SCALED_IMU", 24, struct.Struct("<I6h"), 1000, *_MILLI)
MESSAGES: dict[int, ImuMessage] = {
    message.number: message
    for message in (
        ImuMessage("SCALED_IMU", 26, *_SCALED, unit=0),
        ImuMessage("SCALED_IMU2", 116, *_SCALED, unit=1),
        ImuMessage("SCALED_IMU3", 129, *_SCALED, unit=2),
        ImuMessage("RAW_IMU", 27, "RAW_IMU", 29, struct.Struct("<Q6h"), 1, *_MILLI, unit_at=26),
        ImuMessage(
            "HIGHRES_IMU", 105, "HIGHRES_IMU", 63, struct.Struct("<Q6f"), 1, 1.0, 1.0, unit_at=62, updated_at=60
        ),
    )
}
"""By message id."""
IMU_MESSAGES = ("HIGHRES_IMU", "RAW_IMU", "SCALED_IMU")  # kinds of messages, the finest first
RESOLUTION = {
    "SCALED_IMU": "1 mrad/s, 1 ms",
    "RAW_IMU": "1 mrad/s, 1 us",
    "HIGHRES_IMU": "single precision, 1 us",
}
"""Of rate and time, by kind."""


def numbers(kind: str) -> tuple[int, ...]:
    """Return the ids of the messages of a kind, in the order of the units."""
    return tuple(message.number for message in MESSAGES.values() if message.kind == kind)


class ImuSample(NamedTuple):
    """One sample of one IMU, in the body frame of REP-103: x to the front, y to the left, z up."""

    unit: int  # from 0
    stamp: int  # ns, as read on the clock of the autopilot
    rate: Vector  # rad/s
    acceleration: Vector  # m/s^2


def read(number: int, payload: bytes) -> ImuSample | None:
    """Read the payload, as it came, of one of `MESSAGES`; None: it holds no new sample of a gyro."""
    message = MESSAGES[number]
    data = payload.ljust(message.size, b"\0")
    time, *values = message.head.unpack_from(data)
    if not any(values):
        return None
    if message.updated_at >= 0:
        updated = int.from_bytes(data[message.updated_at : message.updated_at + 2], "little")
        if updated & GYRO_UPDATED != GYRO_UPDATED:
            return None
    ax, ay, az, gx, gy, gz = values
    a, g = message.acceleration, message.gyro
    unit = message.unit if message.unit_at < 0 else data[message.unit_at]
    stamp = 1000 * message.microseconds * time
    return ImuSample(unit, stamp, (g * gx, -g * gy, -g * gz), (a * ax, -a * ay, -a * az))


SCALED, RAW = 26, 27  # messages of IMU 1: SCALED_IMU, and RAW_IMU, which may stand in for it


def stands_in(number: int, autopilot: int) -> bool:
    """Whether a message of such an autopilot (MAV_AUTOPILOT) may stand in for SCALED_IMU of IMU 1."""
    return number == RAW and autopilot == ARDUPILOT


def understood(kind: str, autopilot: int) -> bool:
    """Whether the messages of a kind are in known units, coming from such an autopilot (MAV_AUTOPILOT)."""
    return kind != "RAW_IMU" or autopilot == ARDUPILOT
