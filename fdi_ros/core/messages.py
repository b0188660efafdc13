# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Reading and writing of CDR messages: common elements, and the published messages.

Reading extracts only the required fields. Details of one kind of message are in its
source (`fdi_ros.core.sources`). Writing fills a template. Messages may come from any
sender: each length in a message is checked against the bytes present.

Layout (CDR, OMG formal/02-06-51, as sent by ROS 2): 4 bytes of encapsulation, the second
of which is 1 for little and 0 for big endian. Then follow the fields. Each is aligned to
its own size, counted from the end of the encapsulation.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import MAX_CHANNELS, compiled
from fdi_ros.core.records import OutputRow
from fdi_ros.errors import FdiError
from fdi_ros.model.samples import Array, Bytes, Int
from fdi_ros.system.files import RECORDING

GOOD, NO_CDR, NO_HEADER, CUT_VALUES, BAD_STAMP, FIRST_OWN = range(6)
"""Results of reading a message. From `FIRST_OWN` on each source has its own codes."""
ENCAPSULATION = 4  #: Bytes before the first field.
IMU_DOUBLES, IMU_BEFORE_RATE, IMU_BEFORE_FORCE = 4 + 9 + 3 + 9 + 3 + 9, 4 + 9, 3 + 9
"""Number of doubles of an Imu: all, those before the angular velocity (orientation and
its covariance), and those from there to the linear acceleration."""
NS = 1_000_000_000  #: One second, ns.
#: seconds of a stamp are 32 bits with a sign
_SIGN = 1 << 31
#: Latest whole second that the header of a message can hold, ns.
LAST_STAMP = (_SIGN - 1) * NS
# Index in the upper triangle of each element of a symmetric (3, 3) matrix, by rows.
FROM_TRIANGLE = np.array([0, 1, 2, 1, 3, 4, 2, 4, 5])
_IN_ORDER = np.arange(MAX_CHANNELS)


class MessageError(FdiError):
    """The bytes are not a message of the expected type or length."""


# Bytes
# --------------------------------------------------------------------------------------------------------------


@compiled
def read_bits(data: Bytes, at: int, size: int, little: bool) -> int:
    """Return size bytes as an integer. The compiler makes this a single load."""
    bits = np.int64(0)
    if little:
        for k in range(size):
            bits |= np.int64(data[at + k]) << 8 * k
    else:
        for k in range(size):
            bits |= np.int64(data[at + size - 1 - k]) << 8 * k
    return int(bits)


@compiled
def read_doubles(data: Bytes, at: int, count: int, little: bool, values: Array) -> None:
    """Read count doubles into values, (count,) or longer."""
    for i in range(count):
        bits = read_bits(data, at + 8 * i, 8, little)
        values[i] = np.int64(bits).view(np.float64)


@compiled
def _write_double(out: Bytes, at: int, value: float) -> None:
    """Write a double, little endian. The compiler makes this a single store."""
    bits = np.float64(value).view(np.int64)
    for k in range(8):
        out[at + k] = bits >> 8 * k & 255


@compiled
def _write_doubles(
    out: Bytes, at: int, values: NDArray[Any], places: Int, count: int
) -> None:
    """Write the values at the first ``count`` places as doubles."""
    for i in range(count):
        _write_double(out, at + 8 * i, values[places[i]])


# Reading
# ------------------------------------------------------------------------------------------------------------


@compiled
def is_cdr(data: Bytes, offset: int, length: int) -> bool:
    """Return whether the bytes from offset on begin like plain CDR."""
    return length >= ENCAPSULATION and data[offset] == 0 and data[offset + 1] <= 1


@compiled
def place_after_header(
    data: Bytes, offset: int, length: int, before: int, total: int
) -> int:
    """Return the index of values among the doubles after a std_msgs/Header.

    Parameters
    ----------
    data, offset, length
        The message is data[offset:offset + length].
    before, total
        Number of doubles before the values, and of all doubles that must be present.

    Returns
    -------
    int
        Index in ``data``, or the negative code of an error.
    """
    if not is_cdr(data, offset, length):
        return -NO_CDR
    if length < ENCAPSULATION + 12:
        return -NO_HEADER
    # Stamp, frame_id, then doubles.
    name = read_bits(data, offset + ENCAPSULATION + 8, 4, data[offset + 1] == 1)
    start = ENCAPSULATION + (12 + name + 7) // 8 * 8
    if start + 8 * total > length:
        return -CUT_VALUES
    return offset + start + 8 * before


@compiled
def read_rate(
    data: Bytes, offset: int, length: int, before: int, total: int, rate: Array
) -> int:
    """Read three of the doubles after a std_msgs/Header into rate (3,).

    Return the stamp, ns, or the negative code of an error, which leaves the rate
    unchanged. Other parameters as for `place_after_header`.
    """
    at = place_after_header(data, offset, length, before, total)
    if at < 0:
        return at
    little = data[offset + 1] == 1
    both = read_bits(data, offset + ENCAPSULATION, 8, little)
    first = both >> 32 & 0xFFFFFFFF
    second = both & 0xFFFFFFFF
    sec, nanosec = (second, first) if little else (first, second)
    if sec >= _SIGN or nanosec >= NS:
        return -BAD_STAMP
    read_doubles(data, at, 3, little, rate)
    return sec * NS + nanosec


@compiled
def read_force(data: Bytes, at: int, little: bool, force: Array) -> None:
    """Read the specific force of an Imu, m/s^2, into force (3,), or NaN if absent.

    ``at`` is the index of the angular velocity from `place_after_header`. An Imu without
    an accelerometer has -1 as the first element of the covariance (REP-145), or zeros.
    """
    start = at + 8 * IMU_BEFORE_FORCE
    read_doubles(data, start, 3, little, force)
    first = np.int64(read_bits(data, start + 24, 8, little)).view(np.float64)
    is_zero = force[0] == 0.0 and force[1] == 0.0 and force[2] == 0.0
    if first == -1.0 or is_zero:
        for a in range(3):
            force[a] = math.nan


def frame_of(data: bytes) -> str:
    """Return the frame_id of a serialised message that begins with a std_msgs/Header.

    Empty if the message has none.
    """
    begin = ENCAPSULATION + 12
    if len(data) < begin:
        return ""
    (length,) = struct.unpack_from(f"{byte_order(data)}I", data, begin - 4)
    return (
        data[begin : begin + min(length, RECORDING.name_length)]
        .rstrip(b"\0")
        .decode(errors="replace")
    )


def byte_order(data: bytes) -> str:
    """Return the byte order of a message as a character of `struct`."""
    return "<" if data[1:2] == b"\1" else ">"


class Decoded(NamedTuple):
    """Contents of k messages. Zero for malformed ones."""

    code: Bytes  #: `GOOD` or the code of an error, (k,).
    stamp: Int  #: Stamps, ns, (k,). 0 for messages without a stamp.
    values: Array  #: Values, rad/s, (k, c). From the fourth column of an Imu on, m/s^2.

    @property
    def good(self) -> NDArray[np.bool_]:
        """Whether each message is well formed, (k,)."""
        return self.code == GOOD


def read_only(data: Bytes) -> Bytes:
    """Return the bytes as a read-only array, the only type for which reading is compiled."""
    view = np.ascontiguousarray(data).view()
    view.flags.writeable = False
    return view


def as_batch(data: bytes) -> tuple[Bytes, Int, Int]:
    """Return one message as a batch: bytes, offset (1,), length (1,)."""
    return (
        np.frombuffer(data, dtype=np.uint8),
        np.zeros(1, dtype=np.int64),
        np.array([len(data)]),
    )


# Writing
# ------------------------------------------------------------------------------------------------------------


@compiled
def fill_imu(out: Bytes, at: int, stamp: int, rate: Array, covariance: Array) -> None:
    """Write a rate into a serialised Imu made from an `ImuTemplate`, little endian.

    The specific force is marked absent. `fill_force` may follow.

    Parameters
    ----------
    out, at
        Message, and index of the rate in the message.
    stamp
        Stamp, ns.
    rate
        Rate, rad/s, (3,).
    covariance
        Upper triangle of the covariance, (rad/s)^2, (6,).
    """
    seconds = stamp // NS
    rest = stamp % NS
    for k in range(4):
        out[ENCAPSULATION + k] = seconds >> 8 * k & 255
        out[ENCAPSULATION + 4 + k] = rest >> 8 * k & 255
    _write_doubles(out, at, rate, _IN_ORDER, 3)
    _write_doubles(out, at + 24, covariance, FROM_TRIANGLE, 9)
    for k in range(3):
        _write_double(out, at + 8 * (IMU_BEFORE_FORCE + k), 0.0)
    for k in range(9):
        _write_double(out, at + 8 * (IMU_BEFORE_FORCE + 3 + k), -1.0 if k == 0 else 0.0)


@compiled
def fill_force(
    out: Bytes, at: int, natural: float, force: Array, covariance: Array
) -> None:
    """Write specific force (3,) and covariance (6,) into an Imu after `fill_imu`.

    Their units are ``natural`` m/s^2 and its square.
    """
    start = at + 8 * IMU_BEFORE_FORCE
    for k in range(3):
        _write_double(out, start + 8 * k, natural * force[k])
    for k in range(9):
        value = natural * natural * covariance[FROM_TRIANGLE[k]]
        _write_double(out, start + 24 + 8 * k, value)


def integrity_labels(names: Sequence[str], n: int) -> list[str]:
    """Return the label of each value of the integrity message.

    The first n names are those of gyros, the others of accelerometers.
    """

    def half(own: Sequence[str], of: str, unit: str) -> list[str]:
        return [
            f"{of}statistic",
            f"{of}threshold",
            *(f"state {name}" for name in own),
            *(f"{of}protection level {axis} [{unit}]" for axis in "xyz"),
        ]

    gyros = [*half(names[:n], "", "rad/s"), "stamp [s]", "stamp [ns]"]
    other = half(names[n:], "accelerometers ", "m/s^2") if names[n:] else []
    return gyros + other


@compiled
def fill_integrity(out: Bytes, at: int, row: OutputRow, n: int, shift: int) -> None:
    """Write the values of the gyros and the stamp into the integrity message.

    ``out`` and ``at`` are as for `fill_imu`. The stamp is the stamp of the sample less
    ``shift``, ns.
    """
    end = fill_half(out, at, row, n, 1.0)
    stamp = row.stamp - shift
    _write_double(out, end, stamp // NS)
    _write_double(out, end + 8, stamp % NS)


@compiled
def fill_half(out: Bytes, at: int, row: OutputRow, n: int, natural: float) -> int:
    """Write statistic, threshold, states and level of n channels from index ``at`` on.

    ``natural`` is the unit of the level in rad/s or m/s^2. Return the next index.
    """
    _write_double(out, at, row.statistic)
    _write_double(out, at + 8, row.threshold)
    _write_doubles(out, at + 16, row.state, _IN_ORDER, n)
    for k in range(3):
        _write_double(out, at + 16 + 8 * (n + k), natural * row.level[k])
    return at + 16 + 8 * (n + 3)


class ImuTemplate:
    """Serialised sensor_msgs/Imu with a rate and its covariance.

    Orientation and acceleration are marked absent by -1 as the first element of their
    covariance (REP-145).
    """

    def __init__(self, frame_id: str) -> None:
        name = frame_id.encode() + b"\0"
        head = struct.pack("<BBBBiII", 0, 1, 0, 0, 0, 0, len(name)) + name
        head += bytes(-(len(head) - ENCAPSULATION) % 8)
        absent = (-1.0, *(0.0,) * 8)
        body = (0.0, 0.0, 0.0, 1.0, *absent, *(0.0,) * 12, *(0.0,) * 3, *absent)
        self.bytes = np.frombuffer(
            bytearray(head + struct.pack(f"<{IMU_DOUBLES}d", *body)), dtype=np.uint8
        )
        """The message, to be copied or filled in place."""
        self.at = len(head) + 8 * IMU_BEFORE_RATE  #: Index of the rate.

    def fill(
        self, stamp: int, rate: Sequence[float], covariance: Sequence[float]
    ) -> bytes:
        """Return the message with stamp, ns, rate (3,), rad/s, and covariance (9,), (rad/s)^2."""
        triangle = [covariance[i] for i in (0, 1, 2, 4, 5, 8)]
        upper = np.array(triangle, dtype=np.float64)
        fill_imu(
            self.bytes,
            self.at,
            stamp,
            np.array(rate, dtype=np.float64).reshape(3),
            upper,
        )
        return self.bytes.tobytes()


class ChannelsTemplate:
    """Serialised std_msgs/Float64MultiArray of a fixed number of values, at least 1.

    With labels, one for each value, the array has one dimension, whose label contains
    all labels separated by commas.
    """

    def __init__(self, count: int, labels: Sequence[str] = ()) -> None:
        head = struct.pack("<4BI", 0, 1, 0, 0, 1 if labels else 0)
        if labels:
            label = ",".join(one.replace(",", " ") for one in labels).encode() + b"\0"
            head += struct.pack("<I", len(label)) + label + bytes(-len(label) % 4)
            head += struct.pack("<II", count, count)  # size and stride
        head += struct.pack("<II", 0, count)  # offset of the data
        head += bytes(-(len(head) - ENCAPSULATION) % 8)
        self.count = count
        message = bytearray(head + bytes(8 * count))
        self.bytes = np.frombuffer(message, dtype=np.uint8)
        """The message, to be copied or filled in place."""
        self.at = len(head)  #: Index of the values.

    def fill(self, values: Iterable[float]) -> bytes:
        """Return the message with these values."""
        self.bytes[self.at :] = (
            np.array([*values], dtype="<f8").reshape(self.count).view(np.uint8)
        )
        return self.bytes.tobytes()
