# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""One std_msgs/Float64MultiArray topic of all channels, whatever its layout says."""

from __future__ import annotations

import struct
from typing import Any

from numpy.typing import NDArray

from fdi_ros.compiling.compiled import compiled
from fdi_ros.core.messages import (
    ENCAPSULATION,
    FIRST_OWN,
    GOOD,
    NO_CDR,
    as_batch,
    byte_order,
    is_cdr,
    read_bits,
    read_doubles,
    read_only,
)
from fdi_ros.core.path import receive_arrived
from fdi_ros.model.samples import Array, Bytes, Int
from fdi_ros.sources.source import ArraySource

MAX_DIMENSIONS = 16  # an array whose layout has more dimensions is no message of ours
_DIMENSIONS, _CUT_ARRAY, _WRONG_COUNT, _CUT_VALUES = range(FIRST_OWN, FIRST_OWN + 4)


@compiled
def _count_at(data: Bytes, offset: int, length: int) -> int:
    """Return where the number of values of an array stands; what is wrong, negative, if that cannot be known."""
    if not is_cdr(data, offset, length):
        return -NO_CDR
    little = data[offset + 1] == 1
    at = ENCAPSULATION + 4
    if at > length:
        return -_CUT_ARRAY
    dimensions = read_bits(data, offset + ENCAPSULATION, 4, little)
    if dimensions > MAX_DIMENSIONS:
        return -_DIMENSIONS
    for _ in range(dimensions):
        if at + 4 > length:
            return -_CUT_ARRAY
        # Label, aligned to 4, then size and stride.
        at += 4 + (read_bits(data, offset + at, 4, little) + 3) // 4 * 4 + 8
    # The offset of the data, then the number of values.
    at += 4
    return offset + at if at + 4 <= length else -_CUT_ARRAY


@compiled
def _place(data: Bytes, offset: int, length: int, count: int) -> int:
    at = _count_at(data, offset, length)
    if at < 0:
        return at
    if read_bits(data, at, 4, data[offset + 1] == 1) != count:
        return -_WRONG_COUNT
    # The first byte of the values is aligned even where there is none.
    start = ENCAPSULATION + (at + 4 - offset - ENCAPSULATION + 7) // 8 * 8
    return offset + start if start + 8 * count <= length else -_CUT_VALUES


@compiled
def _read(data: Bytes, offset: int, length: int, count: int, values: Array) -> int:
    at = _place(data, offset, length, count)
    if at < 0:
        return -at
    read_doubles(data, at, count, data[offset + 1] == 1, values)
    return GOOD


@compiled
def _decode_into(data: Bytes, offset: Int, length: Int, code: Bytes, stamp: Int, values: Array) -> None:
    for k in range(len(offset)):
        code[k] = _read(data, offset[k], length[k], values.shape[1], values[k])


@compiled
def _receive(aligner: NDArray[Any], live: NDArray[Any], inlet: int, data: Bytes, stamp: int) -> int:
    monitor = live[0]
    if not 0 <= inlet < aligner[0].n:
        return 0
    return receive_arrived(monitor, _read(data, 0, len(data), monitor.channels, monitor.sample.z), stamp)


class ChannelsSource(ArraySource):
    """The values of std_msgs/Float64MultiArray messages."""

    type = "std_msgs/msg/Float64MultiArray"
    called = "an array"
    place = staticmethod(_place)
    decode_into = staticmethod(_decode_into)
    receive = staticmethod(_receive)

    @classmethod
    def explain(cls, code: int, data: bytes, count: int) -> str:
        """Explain in one line what is wrong with a message in which count values were expected."""
        size, order = len(data), byte_order(data)
        if code < FIRST_OWN:
            return super().explain(code, data, count)
        if code == _DIMENSIONS:
            (dimensions,) = struct.unpack_from(f"{order}I", data, ENCAPSULATION)
            return f"array has {dimensions} dimensions, expected at most {MAX_DIMENSIONS}"
        if code == _CUT_ARRAY:
            return f"{size} bytes are too few for the array they announce"
        if code == _WRONG_COUNT:
            return f"array has {cls.announced(*as_batch(data))} values, expected {count}"
        return f"{size} bytes are too few for {count} values ({'little' if order == '<' else 'big'} endian)"

    @classmethod
    def announced(cls, buffer: Bytes, offset: Int, length: Int) -> int:
        """Return how many values the first readable one of k messages says that it has; 0: none is readable."""
        data = read_only(buffer)
        for start, size in zip(offset.tolist(), length.tolist(), strict=True):
            at = _count_at(data, start, size)
            if at >= 0:
                return int.from_bytes(data[at : at + 4].tobytes(), "little" if data[start + 1] else "big")
        return 0
