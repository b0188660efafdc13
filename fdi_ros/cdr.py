"""CDR bytes of the few messages that pass at full rate: sensor_msgs/Imu and std_msgs/Float64MultiArray.

Reading takes only what is needed out of the bytes, whatever else they hold; writing patches a template. Bytes come
from anybody: every length in them is checked against the bytes that are there before it is believed.

Layout (OMG CDR, as ROS 2 sends it): 4 bytes of encapsulation, the second of which is 1 for little and 0 for big
endian; then the fields, each aligned to its own size counted from after the encapsulation.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence

from fdi_ros.errors import FdiError

Rate = tuple[float, float, float]

MAX_DIMENSIONS = 16
"""More dimensions than this in the layout of an array are nobody's."""
_ENCAPSULATION = 4
_IMU_DOUBLES = 4 + 9 + 3 + 9 + 3 + 9
_RATE = 4 + 9
"""Doubles before the angular velocity: orientation and its covariance."""
_NS = 1_000_000_000

# Index 1: little endian, as in the encapsulation.
_HEADER = (struct.Struct(">iII"), struct.Struct("<iII"))
_VECTOR = (struct.Struct(">3d"), struct.Struct("<3d"))
_WORD = (struct.Struct(">I"), struct.Struct("<I"))


class MessageError(FdiError):
    """The bytes are no such message, or not of the length that is expected."""


def read_imu(data: bytes) -> tuple[int, Rate]:
    """Read stamp (ns) and angular velocity (3,) rad/s of a serialised sensor_msgs/Imu.

    Raises
    ------
    MessageError
        If the bytes are no Imu.
    """
    at = _imu_rate_at(data)
    little = data[1]
    sec, nanosec, _ = _HEADER[little].unpack_from(data, _ENCAPSULATION)
    return sec * _NS + nanosec, _VECTOR[little].unpack_from(data, at)


def patch_imu(data: bytes, rate: Sequence[float]) -> bytes:
    """Return a serialised sensor_msgs/Imu with another angular velocity (3,) rad/s and all else as it was."""
    at = _imu_rate_at(data)
    return b"".join((data[:at], _VECTOR[data[1]].pack(*rate), data[at + 24 :]))


def read_channels(data: bytes, expected: int) -> tuple[float, ...]:
    """Read the values of a serialised std_msgs/Float64MultiArray.

    Parameters
    ----------
    data
        Bytes of the message.
    expected
        Number of values; another number is refused before anything is read.

    Raises
    ------
    MessageError
        If the bytes are no Float64MultiArray, or hold another number of values.
    """
    at = _channels_at(data, expected)
    return struct.unpack_from(f"{_order(data)}{expected}d", data, at)


def patch_channels(data: bytes, values: Sequence[float]) -> bytes:
    """Return a serialised std_msgs/Float64MultiArray with other values, as many, and the layout as it was."""
    at = _channels_at(data, len(values))
    packed = struct.pack(f"{_order(data)}{len(values)}d", *values)
    return b"".join((data[:at], packed, data[at + len(packed) :]))


class ImuTemplate:
    """Serialised sensor_msgs/Imu with a rate and its covariance; orientation and acceleration marked absent.

    Absent is told by -1 as the first element of the covariance (REP-145).

    Parameters
    ----------
    frame_id
        Of the header.
    """

    def __init__(self, frame_id: str) -> None:
        name = frame_id.encode() + b"\0"
        head = struct.pack("<BBBBiII", 0, 1, 0, 0, 0, 0, len(name)) + name
        head += bytes(-(len(head) - _ENCAPSULATION) % 8)
        absent = (-1.0, *(0.0,) * 8)
        body = (0.0, 0.0, 0.0, 1.0, *absent, *(0.0,) * 12, *(0.0,) * 3, *absent)
        self._buffer = bytearray(head + struct.pack(f"<{_IMU_DOUBLES}d", *body))
        self._stamp = struct.Struct("<iI")
        self._body = struct.Struct("<12d")
        self._at = len(head) + 8 * _RATE

    def fill(self, stamp: int, rate: Sequence[float], covariance: Sequence[float]) -> bytes:
        """Return the message: stamp ns, rate (3,) rad/s, covariance (9,) by rows, (rad/s)^2."""
        self._stamp.pack_into(self._buffer, _ENCAPSULATION, *divmod(stamp, _NS))
        self._body.pack_into(self._buffer, self._at, *rate, *covariance)
        return bytes(self._buffer)


class ChannelsTemplate:
    """Serialised std_msgs/Float64MultiArray of a fixed number of values, without dimensions.

    Parameters
    ----------
    count
        Number of values, at least 1.
    """

    def __init__(self, count: int) -> None:
        self._message = struct.Struct(f"<4B4I{count}d")
        self._head = (0, 1, 0, 0, 0, 0, count, 0)

    def fill(self, values: Iterable[float]) -> bytes:
        """Return the message with these values."""
        return self._message.pack(*self._head, *values)


def _order(data: bytes) -> str:
    return "<" if data[1] else ">"


def _little(data: bytes) -> int:
    if len(data) < _ENCAPSULATION or data[0] != 0 or data[1] > 1:
        raise MessageError(f"{len(data)} bytes with encapsulation {data[:2].hex() or 'none'} are no plain CDR")
    return data[1]


def _imu_rate_at(data: bytes) -> int:
    little = _little(data)
    if len(data) < _ENCAPSULATION + 12:
        raise MessageError(f"{len(data)} bytes are too few for an Imu")
    name = _WORD[little].unpack_from(data, _ENCAPSULATION + 8)[0]
    start = _ENCAPSULATION + ((12 + name + 7) & ~7)
    if start + 8 * _IMU_DOUBLES > len(data):
        raise MessageError(f"{len(data)} bytes are too few for an Imu whose frame_id has {name}")
    return start + 8 * _RATE


def _channels_at(data: bytes, expected: int) -> int:
    """Return where the values begin."""
    little, word = _little(data), _WORD[data[1]].unpack_from
    try:
        at = _ENCAPSULATION + 4
        dimensions = word(data, at - 4)[0]
        if dimensions > MAX_DIMENSIONS:
            raise MessageError(f"array has {dimensions} dimensions, expected at most {MAX_DIMENSIONS}")
        for _ in range(dimensions):
            # Label, aligned to 4, then size and stride.
            at += 4 + ((word(data, at)[0] + 3) & ~3) + 8
        count = word(data, at + 4)[0]
    except struct.error as error:
        raise MessageError(f"{len(data)} bytes are too few for the array they announce") from error
    if count != expected:
        raise MessageError(f"array has {count} values, expected {expected}")
    start = _ENCAPSULATION + ((at + 8 - _ENCAPSULATION + 7) & ~7)
    if start + 8 * count > len(data):
        raise MessageError(f"{len(data)} bytes are too few for {count} values ({'little' if little else 'big'} endian)")
    return start
