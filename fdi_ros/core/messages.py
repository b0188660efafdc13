"""Bytes of the messages that pass at full rate: sensor_msgs/Imu and std_msgs/Float64MultiArray.

Reading takes only what is needed out of the bytes, whatever else they hold; writing fills a template. Bytes may come
from anywhere: every length in them is checked against the bytes that are there before it is believed.

Layout (CDR, OMG formal/02-06-51, as ROS 2 sends it): 4 bytes of encapsulation, the second of which is 1 for little and
0 for big endian; then the fields, each aligned to its own size counted from after the encapsulation.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.core.compiled import allocate, compiled
from fdi_ros.core.record import Vector, Whole, record
from fdi_ros.errors import FdiError

Bytes = NDArray[np.uint8]
Int = NDArray[np.int64]
Array = NDArray[np.float64]
Rate = tuple[float, float, float]

MAX_DIMENSIONS = 16
"""An array whose layout has more dimensions is no message of ours."""
GOOD, NO_CDR, NO_IMU, CUT_IMU, BAD_STAMP, DIMENSIONS, CUT_ARRAY, WRONG_COUNT, CUT_VALUES = range(9)
"""What reading says of a message; `explain` has the words."""

_ENCAPSULATION = 4
_DOUBLES = 4 + 9 + 3 + 9 + 3 + 9
_BEFORE_RATE = 4 + 9
"""Doubles of an Imu: all, and those before the angular velocity: orientation and its covariance."""
_NS = 1_000_000_000
_SIGN = 1 << 31
_WORD = (1 << 32) - 1
_FULL = (0, 1, 2, 1, 3, 4, 2, 4, 5)
"""Elements of a symmetric (3, 3) matrix by rows, in its upper triangle."""
_UPPER = [0, 1, 2, 4, 5, 8]


class MessageError(FdiError):
    """The bytes are no such message, or not of the length that is expected."""


@record
class Message:
    """What the monitor needs of an Imu."""

    stamp: Whole  # ns
    rate: Vector  # rad/s


# Bytes --------------------------------------------------------------------------------------------------------------


@compiled
def read_bits(data: Bytes, at: int, size: int, little: bool) -> int:
    """Put size bytes together; the compiler makes one load of it, aligned or not."""
    bits = np.int64(0)
    if little:
        for k in range(size):
            bits |= np.int64(data[at + k]) << 8 * k
    else:
        for k in range(size):
            bits |= np.int64(data[at + size - 1 - k]) << 8 * k
    return int(bits)


@compiled
def _read_doubles(data: Bytes, at: int, count: int, little: bool, values: Array) -> None:
    for i in range(count):
        values[i] = np.int64(read_bits(data, at + 8 * i, 8, little)).view(np.float64)


@compiled
def _write_bits(out: Bytes, at: int, bits: int) -> None:
    """Write 8 bytes, little endian."""
    for k in range(8):
        out[at + k] = bits >> 8 * k & 255


@compiled
def _write_double(out: Bytes, at: int, value: float) -> None:
    _write_bits(out, at, int(np.float64(value).view(np.int64)))


# Reading ------------------------------------------------------------------------------------------------------------


@compiled
def read_imu(data: Bytes, offset: int, length: int, message: Message) -> int:
    """Read stamp and angular velocity of a sensor_msgs/Imu, length bytes from offset on.

    Returns
    -------
    `GOOD`, or what is wrong; then the message is left as it was.
    """
    at = _rate_at(data, offset, length)
    if at < 0:
        return -at
    little = data[offset + 1] == 1
    sec, nanosec = (
        read_bits(data, offset + _ENCAPSULATION, 4, little),
        read_bits(data, offset + _ENCAPSULATION + 4, 4, little),
    )
    if sec >= _SIGN or nanosec >= _NS:
        return BAD_STAMP
    message.stamp = sec * _NS + nanosec
    _read_doubles(data, at, 3, little, message.rate)
    return GOOD


@compiled
def read_channels(data: Bytes, offset: int, length: int, expected: int, values: Array) -> int:
    """Read the values of a std_msgs/Float64MultiArray, whatever its layout says.

    Parameters
    ----------
    data, offset, length
        As for `read_imu`.
    expected
        Number of values; another number is refused.
    values
        Takes them, (expected,) or longer.

    Returns
    -------
    `GOOD`, or what is wrong; then the values are left as they were.
    """
    at = _values_at(data, offset, length, expected)
    if at < 0:
        return -at
    _read_doubles(data, at, expected, data[offset + 1] == 1, values)
    return GOOD


@compiled
def _rate_at(data: Bytes, offset: int, length: int) -> int:
    """Return where the angular velocity of an Imu begins; what is wrong, negative, if it is none."""
    if length < _ENCAPSULATION or data[offset] != 0 or data[offset + 1] > 1:
        return -NO_CDR
    if length < _ENCAPSULATION + 12:
        return -NO_IMU
    # Stamp, frame_id, then doubles.
    name = read_bits(data, offset + _ENCAPSULATION + 8, 4, data[offset + 1] == 1)
    start = _ENCAPSULATION + (12 + name + 7) // 8 * 8
    if start + 8 * _DOUBLES > length:
        return -CUT_IMU
    return offset + start + 8 * _BEFORE_RATE


@compiled
def _values_at(data: Bytes, offset: int, length: int, expected: int) -> int:
    """Return where the values of an array begin; what is wrong, negative, if they are not as many as expected."""
    at = _count_at(data, offset, length)
    if at < 0:
        return at
    if read_bits(data, at, 4, data[offset + 1] == 1) != expected:
        return -WRONG_COUNT
    # The first byte of the values is aligned even where there is none.
    start = _ENCAPSULATION + (at + 4 - offset - _ENCAPSULATION + 7) // 8 * 8
    if start + 8 * expected > length:
        return -CUT_VALUES
    return offset + start


@compiled
def _count_at(data: Bytes, offset: int, length: int) -> int:
    """Return where the number of values of an array stands; what is wrong, negative, if that cannot be known."""
    if length < _ENCAPSULATION or data[offset] != 0 or data[offset + 1] > 1:
        return -NO_CDR
    little = data[offset + 1] == 1
    at = _ENCAPSULATION + 4
    if at > length:
        return -CUT_ARRAY
    dimensions = read_bits(data, offset + _ENCAPSULATION, 4, little)
    if dimensions > MAX_DIMENSIONS:
        return -DIMENSIONS
    for _ in range(dimensions):
        if at + 4 > length:
            return -CUT_ARRAY
        # Label, aligned to 4, then size and stride.
        at += 4 + (read_bits(data, offset + at, 4, little) + 3) // 4 * 4 + 8
    # The offset of the data, then the number of values.
    at += 4
    return offset + at if at + 4 <= length else -CUT_ARRAY


def explain(code: int, data: bytes, expected: int = 0) -> str:
    """Tell in one line what is wrong with a message.

    Parameters
    ----------
    code
        Of `read_imu` or `read_channels`.
    data
        Bytes of the message.
    expected
        Number of values that were expected in an array.
    """
    size, order = len(data), "<" if data[1:2] == b"\1" else ">"
    if code == NO_CDR:
        return f"{size} bytes with encapsulation {data[:2].hex() or 'none'} are no plain CDR"
    if code == NO_IMU:
        return f"{size} bytes are too few for an Imu"
    if code == CUT_IMU:
        (name,) = struct.unpack_from(f"{order}I", data, _ENCAPSULATION + 8)
        return f"{size} bytes are too few for an Imu whose frame_id has {name}"
    if code == BAD_STAMP:
        sec, nanosec = struct.unpack_from(f"{order}iI", data, _ENCAPSULATION)
        return f"stamp has {sec} s and {nanosec} ns, expected at least 0 s and less than {_NS} ns"
    if code == DIMENSIONS:
        (dimensions,) = struct.unpack_from(f"{order}I", data, _ENCAPSULATION)
        return f"array has {dimensions} dimensions, expected at most {MAX_DIMENSIONS}"
    if code == CUT_ARRAY:
        return f"{size} bytes are too few for the array they announce"
    if code == WRONG_COUNT:
        return f"array has {array_count(*_alone(data))} values, expected {expected}"
    return f"{size} bytes are too few for {expected} values ({'little' if order == '<' else 'big'} endian)"


# Reading many -------------------------------------------------------------------------------------------------------


class Decoded(NamedTuple):
    """What k messages hold; of one that is malformed: zeros."""

    code: Bytes
    """(k,) `GOOD`, or what is wrong."""
    stamp: Int
    """(k,) ns; 0 for messages that carry none."""
    values: Array
    """(k, c) rad/s."""

    @classmethod
    def nothing(cls, k: int, columns: int) -> Decoded:
        """Nothing decoded yet."""
        return cls(np.zeros(k, dtype=np.uint8), np.zeros(k, dtype=np.int64), np.zeros((k, columns)))

    @property
    def good(self) -> NDArray[np.bool_]:
        """(k,) whether the message is what it should be."""
        return self.code == GOOD


def decode_imu(buffer: Bytes, offset: Int, length: Int) -> Decoded:
    """Read stamp and angular velocity of sensor_msgs/Imu messages.

    Parameters
    ----------
    buffer
        Bytes in which the messages lie.
    offset, length
        (k,) of each message; each must lie within the buffer.
    """
    decoded = Decoded.nothing(len(offset), 3)
    decode_imus(_read_only(buffer), offset, length, allocate(Message), *decoded)
    return decoded


def decode_array(buffer: Bytes, offset: Int, length: Int, channels: int) -> Decoded:
    """Read the values of std_msgs/Float64MultiArray messages, whatever their layout says.

    Parameters
    ----------
    buffer, offset, length
        As for `decode_imu`.
    channels
        Number of values expected; a message with another number is malformed.
    """
    decoded = Decoded.nothing(len(offset), channels)
    decode_channels(_read_only(buffer), offset, length, channels, decoded.code, decoded.values)
    return decoded


def array_count(buffer: Bytes, offset: Int, length: Int) -> int:
    """Return the number of values that the first readable std_msgs/Float64MultiArray announces; 0 if there is none."""
    data = _read_only(buffer)
    for start, size in zip(offset.tolist(), length.tolist(), strict=True):
        at = _count_at(data, start, size)
        if at >= 0:
            return int.from_bytes(data[at : at + 4].tobytes(), "little" if data[start + 1] else "big")
    return 0


@compiled
def decode_imus(
    data: Bytes, offset: Int, length: Int, message: NDArray[Any], code: Bytes, stamp: Int, values: Array
) -> None:
    """Read k Imus; message (1,) is scratch, code (k,), stamp (k,) and values (k, 3) take what `read_imu` says."""
    one = message[0]
    for k in range(len(offset)):
        code[k] = read_imu(data, offset[k], length[k], one)
        if code[k] == GOOD:
            stamp[k] = one.stamp
            for a in range(3):
                values[k, a] = one.rate[a]


@compiled
def decode_channels(data: Bytes, offset: Int, length: Int, expected: int, code: Bytes, values: Array) -> None:
    """Read k arrays; code (k,) and values (k, expected) take what `read_channels` says."""
    for k in range(len(offset)):
        code[k] = read_channels(data, offset[k], length[k], expected, values[k])


def _read_only(data: Bytes) -> Bytes:
    """Return the bytes in the one form for which the functions above are compiled, that of received bytes."""
    view = np.ascontiguousarray(data).view()
    view.flags.writeable = False
    return view


# One message from Python --------------------------------------------------------------------------------------------


def parse_imu(data: bytes) -> tuple[int, Rate]:
    """Read stamp (ns) and angular velocity (3,) rad/s of a serialised sensor_msgs/Imu.

    Raises
    ------
    MessageError
        If the bytes are no Imu.
    """
    (code,), (stamp,), ((x, y, z),) = decode_imu(*_alone(data))
    if code != GOOD:
        raise MessageError(explain(int(code), data))
    return int(stamp), (float(x), float(y), float(z))


def patch_imu(data: bytes, rate: Sequence[float]) -> bytes:
    """Return a serialised sensor_msgs/Imu with another angular velocity (3,) rad/s and all else as it was."""
    return _patched(data, _rate_at(_alone(data)[0], 0, len(data)), rate)


def parse_channels(data: bytes, expected: int) -> tuple[float, ...]:
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
    (code,), _, (values,) = decode_array(*_alone(data), expected)
    if code != GOOD:
        raise MessageError(explain(int(code), data, expected))
    return tuple(values.tolist())


def patch_channels(data: bytes, values: Sequence[float]) -> bytes:
    """Return a serialised std_msgs/Float64MultiArray with other values, as many, and the layout as it was."""
    return _patched(data, _values_at(_alone(data)[0], 0, len(data), len(values)), values)


def _alone(data: bytes) -> tuple[Bytes, Int, Int]:
    """Return one message as a batch: bytes, offset (1,), length (1,)."""
    return np.frombuffer(data, dtype=np.uint8), np.zeros(1, dtype=np.int64), np.array([len(data)])


def _patched(data: bytes, at: int, values: Sequence[float]) -> bytes:
    if at < 0:
        raise MessageError(explain(-at, data, len(values)))
    packed = struct.pack(f"{'<' if data[1] else '>'}{len(values)}d", *values)
    return b"".join((data[:at], packed, data[at + len(packed) :]))


# Writing ------------------------------------------------------------------------------------------------------------


@compiled
def fill_imu(out: Bytes, at: int, stamp: int, rate: Array, covariance: Array) -> None:
    """Write into one serialised Imu, little endian.

    Parameters
    ----------
    out
        Bytes of the message, made from an `ImuTemplate`.
    at
        Where the rate begins, as the template says.
    stamp
        ns.
    rate
        (3,) rad/s.
    covariance
        Upper triangle of the covariance of the rate, (6,) (rad/s)^2.
    """
    # Seconds, then nanoseconds, 4 bytes each.
    _write_bits(out, _ENCAPSULATION, stamp // _NS & _WORD | stamp % _NS << 32)
    for a in range(3):
        _write_double(out, at + 8 * a, rate[a])
    for i in range(9):
        _write_double(out, at + 24 + 8 * i, covariance[_FULL[i]])


@compiled
def fill_channels(out: Bytes, at: int, values: Array, count: int) -> None:
    """Write values into one serialised Float64MultiArray, little endian; out and at as for `fill_imu`."""
    for i in range(count):
        _write_double(out, at + 8 * i, values[i])


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
        self.bytes = np.frombuffer(bytearray(head + struct.pack(f"<{_DOUBLES}d", *body)), dtype=np.uint8)
        """The message, to be copied or filled in place."""
        self.at = len(head) + 8 * _BEFORE_RATE
        """Where the rate begins."""

    def fill(self, stamp: int, rate: Sequence[float], covariance: Sequence[float]) -> bytes:
        """Return the message: stamp ns, rate (3,) rad/s, covariance (9,) by rows, symmetric, (rad/s)^2."""
        upper = np.array([covariance[i] for i in _UPPER], dtype=np.float64)
        fill_imu(self.bytes, self.at, stamp, np.array(rate, dtype=np.float64).reshape(3), upper)
        return self.bytes.tobytes()


class ChannelsTemplate:
    """Serialised std_msgs/Float64MultiArray of a fixed number of values, without dimensions.

    Parameters
    ----------
    count
        Number of values, at least 1.
    """

    def __init__(self, count: int) -> None:
        head = struct.pack("<4B4I", 0, 1, 0, 0, 0, 0, count, 0)
        self.count = count
        self.bytes = np.frombuffer(bytearray(head + bytes(8 * count)), dtype=np.uint8)
        """The message, to be copied or filled in place."""
        self.at = len(head)
        """Where the values begin."""

    def fill(self, values: Iterable[float]) -> bytes:
        """Return the message with these values."""
        fill_channels(self.bytes, self.at, np.array([*values], dtype=np.float64).reshape(self.count), self.count)
        return self.bytes.tobytes()
