"""Whole batches of serialised messages to stamps and rates, without a loop over messages.

Of each message only what the monitor needs is read. The layout is that of CDR (OMG formal/02-06-51) with the
encapsulation header of DDS; alignment counts from the byte after it. Both byte orders may be mixed in a batch.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.bag.chunk import take
from fdi_ros.bag.raw import Bytes, Int
from fdi_ros.cdr import MAX_DIMENSIONS

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

HEADER = 4
"""Bytes of the encapsulation header."""
_IMU_BEFORE_RATE = 8 * (4 + 9)
"""Orientation and its covariance stand before the angular velocity."""
_IMU_NUMBERS = 8 * (4 + 9 + 3 + 9 + 3 + 9)


class Decoded(NamedTuple):
    """What k messages hold; of one that is malformed: zeros."""

    good: Mask
    """(k,) whether the message is as long as what it says it holds."""
    stamp: Int
    """(k,) ns; 0 for messages that carry none."""
    values: Array
    """(k, c) rad/s."""

    @classmethod
    def nothing(cls, k: int, columns: int) -> Decoded:
        """Nothing decoded yet."""
        return cls(np.zeros(k, dtype=bool), np.zeros(k, dtype=np.int64), np.zeros((k, columns)))


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
    for order, rows in _by_order(buffer, offset, length, HEADER + 12):
        body = offset[rows] + HEADER
        head = take(buffer, body, 12).view(f"{order}u4").astype(np.int64)
        numbers = _aligned(12 + head[:, 2], 8)
        fits = HEADER + numbers + _IMU_NUMBERS <= length[rows]
        if not fits.all():
            rows, body, head, numbers = rows[fits], body[fits], head[fits], numbers[fits]
        decoded.good[rows] = True
        seconds = head[:, 0].astype(np.int32).astype(np.int64)
        decoded.stamp[rows] = seconds * 1_000_000_000 + head[:, 1]
        decoded.values[rows] = take(buffer, body + numbers + _IMU_BEFORE_RATE, 24).view(f"{order}f8")
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
    for order, rows in _by_order(buffer, offset, length, HEADER + 12):
        at, rows = _after_layout(buffer, offset, length, rows, order)
        count = take(buffer, offset[rows] + at, 4).view(f"{order}u4")[:, 0]
        # The first byte of the data is aligned even where there is none.
        start = HEADER + _aligned(at + 4 - HEADER, 8)
        fits = (count == channels) & (start + 8 * channels <= length[rows])
        rows, start = rows[fits], start[fits]
        decoded.good[rows] = True
        decoded.values[rows] = take(buffer, offset[rows] + start, 8 * channels).view(f"{order}f8")
    return decoded


def array_count(buffer: Bytes, offset: Int, length: Int) -> int:
    """Return the number of values that the first readable std_msgs/Float64MultiArray announces; 0 if there is none."""
    for order, rows in _by_order(buffer, offset, length, HEADER + 12):
        at, rows = _after_layout(buffer, offset, length, rows, order)
        if len(rows):
            return int(take(buffer, offset[rows[:1]] + at[:1], 4).view(f"{order}u4")[0, 0])
    return 0


def _after_layout(buffer: Bytes, offset: Int, length: Int, rows: Int, order: str) -> tuple[Int, Int]:
    """Return where the data sequence begins, relative to the message, and the rows for which this is within it."""
    at = np.full(len(rows), HEADER + 4)
    left = take(buffer, offset[rows] + HEADER, 4).view(f"{order}u4")[:, 0].astype(np.int64)
    fits = left <= MAX_DIMENSIONS
    while (open_rows := np.flatnonzero(fits & (left > 0))).size:
        # A dimension: label, size, stride.
        fits[open_rows] = at[open_rows] + 4 <= length[rows[open_rows]]
        open_rows = open_rows[fits[open_rows]]
        label = take(buffer, offset[rows[open_rows]] + at[open_rows], 4).view(f"{order}u4")[:, 0]
        at[open_rows] = _aligned(at[open_rows] + 4 + label, 4) + 8
        left[open_rows] -= 1
    # data_offset, then the number of values.
    at += 4
    fits &= at + 4 <= length[rows]
    return at[fits], rows[fits]


def _by_order(buffer: Bytes, offset: Int, length: Int, least: int) -> list[tuple[str, Int]]:
    """Return the messages of at least so many bytes, those of each byte order together."""
    rows = np.flatnonzero(length >= least)
    head = take(buffer, offset[rows], 2)
    plain = head[:, 0] == 0
    groups = [("<", rows[plain & (head[:, 1] == 1)]), (">", rows[plain & (head[:, 1] == 0)])]
    return [(order, group) for order, group in groups if len(group)]


def _aligned(position: Int, to: int) -> Int:
    return (position + to - 1) // to * to
