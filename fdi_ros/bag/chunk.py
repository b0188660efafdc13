# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Chunks of an MCAP file: decompressed within bounds, and walked record by record."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import lz4.frame
import numpy as np
import zstandard

from fdi_ros.bag.raw import Bytes, Int
from fdi_ros.core.compiled import compiled
from fdi_ros.core.messages import read_bits
from fdi_ros.limits import CHUNK_BYTES

FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, STATISTICS = 0x02, 0x03, 0x04, 0x05, 0x06, 0x0B
_RECORD = 9
"""Bytes of a record before its content: opcode, length of the content."""
_HEAD = 22
"""Bytes of a message record before the message: channel, sequence, log time, publish time."""


@dataclass(frozen=True)
class Records:
    """The records found in a run of bytes: k messages, and where topics are described."""

    buffer: Bytes
    channel: Int
    """(k,) channel number of each message."""
    log_time: Int
    """(k,) ns."""
    offset: Int
    """(k,) first byte of each message in the buffer."""
    length: Int
    """(k,) bytes of each message."""
    topics: list[tuple[int, bytes]]
    """Schema and channel records: opcode and content."""
    end: int
    """Where the walk ended: the length of the buffer unless it is damaged, or another record stopped it."""

    @classmethod
    def joined(cls, parts: Sequence[Records]) -> Records:
        """Return the records of several runs of bytes, laid one behind the other."""
        if len(parts) == 1:
            return parts[0]
        ends = np.cumsum([len(part.buffer) for part in parts])
        starts = (ends - [len(part.buffer) for part in parts]).tolist()
        return cls(
            np.concatenate([part.buffer for part in parts]),
            np.concatenate([part.channel for part in parts]),
            np.concatenate([part.log_time for part in parts]),
            np.concatenate([part.offset + start for part, start in zip(parts, starts, strict=True)]),
            np.concatenate([part.length for part in parts]),
            [topic for part in parts for topic in part.topics],
            int(ends[-1]),
        )


def decompress(data: bytes, compression: str, size: int, crc: int, cut: bool) -> tuple[bytes, str]:
    """Decompress a chunk.

    Parameters
    ----------
    data
        Compressed bytes.
    compression
        ``zstd``, ``lz4`` or empty.
    size, crc
        Of the decompressed bytes; a crc of 0 is not checked.
    cut
        The chunk is known to be incomplete: what comes out of it is returned.

    Returns
    -------
    The bytes, and what is wrong with them: empty if nothing.
    """
    if max(size, len(data) if not compression else 0) > CHUNK_BYTES:
        return b"", f"claims {size} bytes, expected at most {CHUNK_BYTES}, and was left out"
    try:
        if compression == "zstd":
            data = zstandard.ZstdDecompressor().stream_reader(data).read(size)
        elif compression == "lz4":
            data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size)
        elif compression:
            return b"", f"has the unknown compression {compression!r} and was left out"
    except (zstandard.ZstdError, RuntimeError, ValueError, EOFError, MemoryError) as error:
        return b"", f"cannot be decompressed ({error}) and was left out"
    if cut:
        return data, f"is cut off after {len(data)} of {size} bytes"
    if len(data) != size:
        return b"", f"has {len(data)} bytes instead of {size} and was left out"
    if crc and zlib.crc32(data) != crc:
        return b"", "fails its checksum and was left out"
    return data, ""


def walk(data: bytes, outside: bool = False) -> Records:
    """Find the records in a run of bytes.

    Parameters
    ----------
    data
        The bytes; a record that is incomplete ends the walk.
    outside
        The records lie outside chunks: a chunk, the statistics and the footer end the walk, too.
    """
    buffer = np.frombuffer(data, dtype=np.uint8)
    # How many there are is counted first.
    k, described, _ = find_records(buffer, outside, np.empty((4, 0), np.int64), np.empty((0, 3), np.int64))
    messages, topics = np.empty((4, k), np.int64), np.empty((described, 3), np.int64)
    _, _, end = find_records(buffer, outside, messages, topics)
    channel, log_time, offset, length = messages
    contents = [(opcode, data[start:stop]) for opcode, start, stop in topics.tolist()]
    return Records(buffer, channel, log_time, offset, length, contents, int(end))


@compiled
def find_records(data: Bytes, outside: bool, messages: Int, topics: Int) -> tuple[int, int, int]:
    """Find the records in a run of bytes; those beyond the room that is there are only counted.

    Parameters
    ----------
    data, outside
        As for `walk`.
    messages
        (4, room): channel, log time, offset and length of each message, as in `Records`.
    topics
        (room, 3): opcode, first byte and end of the content of each schema and channel record.

    Returns
    -------
    The numbers of messages and of topics, and where the walk ended.
    """
    found = described = position = 0
    while position + _RECORD <= len(data):
        opcode, length = data[position], read_bits(data, position + 1, 8, True)
        start = position + _RECORD
        # A length beyond all integers comes out negative.
        if not 0 <= length <= len(data) - start:
            break
        if outside and opcode in (CHUNK, STATISTICS, FOOTER):
            break
        if opcode == MESSAGE and length >= _HEAD:
            if found < messages.shape[1]:
                messages[0, found] = read_bits(data, start, 2, True)
                messages[1, found] = read_bits(data, start + 6, 8, True)
                messages[2, found] = start + _HEAD
                messages[3, found] = length - _HEAD
            found += 1
        elif opcode in (SCHEMA, CHANNEL):
            if described < len(topics):
                topics[described, 0], topics[described, 1], topics[described, 2] = opcode, start, start + length
            described += 1
        position = start + length
    return found, described, position
