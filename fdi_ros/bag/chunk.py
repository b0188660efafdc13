"""Chunks of an MCAP file: decompressed within bounds, and walked record by record."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

import lz4.frame
import numpy as np
import zstandard

from fdi_ros.bag.raw import Bytes, Int

SCHEMA, CHANNEL, MESSAGE = 0x03, 0x04, 0x05
LARGEST = 1 << 28
"""Bytes of a chunk at most; what claims to be longer is damaged or not meant for a streaming reader."""
_RECORD = struct.Struct("<BQ")
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
    if max(size, len(data) if not compression else 0) > LARGEST:
        return b"", f"claims {size} bytes, expected at most {LARGEST}, and was left out"
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


def walk(data: bytes, messages_only: bool = False) -> Records:
    """Find the records in a run of bytes.

    Parameters
    ----------
    data
        The bytes; a record that is incomplete ends the walk.
    messages_only
        Any record other than a message ends the walk, too.
    """
    starts: list[int] = []
    ends: list[int] = []
    topics: list[tuple[int, bytes]] = []
    position, size, unpack = 0, len(data), _RECORD.unpack_from
    while position + 9 <= size:
        opcode, length = unpack(data, position)
        end = position + 9 + length
        if end > size or (messages_only and opcode != MESSAGE):
            break
        if opcode == MESSAGE and length >= _HEAD:
            starts.append(position + 9)
            ends.append(end)
        elif opcode in (SCHEMA, CHANNEL):
            topics.append((opcode, data[position + 9 : end]))
        position = end
    buffer = np.frombuffer(data, dtype=np.uint8)
    start = np.array(starts, dtype=np.int64)
    head = take(buffer, start, 14)
    offset = start + _HEAD
    return Records(
        buffer,
        head[:, :2].copy().view("<u2")[:, 0].astype(np.int64),
        head[:, 6:].copy().view("<i8")[:, 0],
        offset,
        np.array(ends, dtype=np.int64) - offset,
        topics,
        position,
    )


def take(buffer: Bytes, start: Int, width: int) -> Bytes:
    """Copy `width` bytes from each of k places: (k, width). Every place must lie within the buffer."""
    if len(start) > 1:
        stride = int(start[1] - start[0])
        if stride > 0 and (np.diff(start) == stride).all():
            # Messages of one length, one after the other: one strided copy instead of a gather of single bytes.
            shape, strides = (len(start), width), (stride, 1)
            return np.lib.stride_tricks.as_strided(buffer[start[0] :], shape, strides, writeable=False).copy()
    return buffer[start[:, None] + np.arange(width)]
