# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""One MCAP file, read in bounded memory, whole or damaged.

The records are walked from the start, without trust in footer, summary or indexes: a recording cut off by a crash has
none of them. The first walk reads the headers of the chunks and skips their contents: that gives their order in time.
The second reads the chunks in that order. The layout of the records: https://mcap.dev/spec.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.records import Channel, Schema, Statistics

from fdi_ros.bag.raw import NO_HORIZON, Batch, Damage, Topic, open_file
from fdi_ros.compiling.compiled import compiled
from fdi_ros.core.messages import read_bits
from fdi_ros.model.samples import Bytes, Int
from fdi_ros.system.limits import CHANNELS, CHUNK_BYTES, DESCRIPTION_BYTES, NAME, RECORD_BYTES, RECORDS

FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, STATISTICS = 0x02, 0x03, 0x04, 0x05, 0x06, 0x0B
_PREFIX = 9
"""Bytes of a record before its content: opcode, length of the content."""
_HEAD = 22
"""Bytes of a message record before the message: channel, sequence, log time, publish time."""


def decompress(data: bytes, compression: str, size: int, crc: int, cut: bool) -> tuple[bytes, str]:
    """Decompress a chunk (``zstd``, ``lz4`` or empty) to ``size`` bytes; a ``crc`` of 0 is not checked.

    Of one that is known to be cut off, what comes out is returned. With the bytes: what is wrong with them, empty if
    nothing.
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


def walk(data: bytes, outside: bool = False) -> tuple[Batch, list[tuple[int, bytes]], int]:
    """Find the records in a run of bytes; one that is incomplete ends the walk.

    Outside chunks a chunk, the statistics and the footer end it, too. Returned are the messages, with the numbers of
    their channels as topics; opcode and content of schema and channel records; and where the walk ended: the length of
    the data unless it is damaged, or another record stopped it.
    """
    buffer = np.frombuffer(data, dtype=np.uint8)
    # How many there are is counted first.
    k, described, _ = find_records(buffer, outside, np.empty((4, 0), np.int64), np.empty((0, 3), np.int64))
    messages, topics = np.empty((4, k), np.int64), np.empty((described, 3), np.int64)
    _, _, end = find_records(buffer, outside, messages, topics)
    contents = [(opcode, data[start:stop]) for opcode, start, stop in topics.tolist()]
    channel, log_time, offset, length = messages
    return Batch(buffer, channel, log_time, offset, length, NO_HORIZON, 1.0), contents, int(end)


@compiled
def find_records(data: Bytes, outside: bool, messages: Int, topics: Int) -> tuple[int, int, int]:
    """Find the records in a run of bytes as `walk` does; those beyond the room that is there are only counted.

    ``messages`` (4, room) takes channel, log time, offset and length of each message, as in `Batch`; ``topics`` (room,
    3) opcode, first byte and end of the content of each schema and channel record. Returned are their numbers, and
    where the walk ended.
    """
    found = described = position = 0
    while position + _PREFIX <= len(data):
        opcode, length = data[position], read_bits(data, position + 1, 8, True)
        start = position + _PREFIX
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


T = TypeVar("T")
MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQII")
_FIRST, _RUN = 1 << 16, 1 << 22
"""Messages outside chunks are read in runs of at most this many bytes; tried with fewer first."""
_STOPS = tuple(bytes([opcode]) for opcode in (CHUNK, STATISTICS, FOOTER))
_TOGETHER = 1 << 16
"""Pieces are handed on together until they hold so many bytes: each batch has its cost."""


@dataclass(frozen=True)
class Piece:
    """A chunk, or a run of messages outside chunks: what is read at once."""

    start_time: int
    """ns."""
    offset: int
    size: int
    """Bytes in the file."""
    raw_size: int
    """Bytes when decompressed."""
    crc: int
    compression: str
    cut: bool
    """The file ends within it."""


class McapFile:
    """An open MCAP file, whose chunks may unpack to ``most`` bytes; ``damage`` takes what cannot be read.

    `BagError` if the file cannot be opened, is empty, or is no MCAP file.
    """

    def __init__(self, path: Path, damage: Damage, most: int) -> None:
        self.path = path
        self.damage = damage
        self._most = most
        self._channels: dict[int, Channel] = {}
        self._schemas: dict[int, str] = {}
        self._counts: dict[int, int] = {}
        self._pieces: list[Piece] = []
        self._ends: Int | None = None
        self._file, self.size = open_file(path, MAGIC, "is not an MCAP file")
        self._scan()
        self._pieces.sort(key=lambda piece: piece.start_time)
        if not self._counts or not self._counts.keys() <= self._channels.keys():
            self._count()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @property
    def topics(self) -> tuple[Topic, ...]:
        """The topics of the file; one that several publishers wrote comes several times."""
        topics = []
        for number, channel in self._channels.items():
            kind = self._schemas.get(channel.schema_id, "")
            topics.append(Topic(channel.topic, kind, channel.message_encoding, self._counts.get(number, 0)))
        return tuple(topics)

    @property
    def start_time(self) -> int:
        """Time of recording of the first message, ns; of a file without messages the latest there is."""
        return self._pieces[0].start_time if self._pieces else NO_HORIZON

    def batches(self, topics: Sequence[str]) -> Iterator[Batch]:
        """Read the messages of the topics."""
        place = {name: k for k, name in enumerate(topics)}
        read, whole, known = 0, sum(piece.size for piece in self._pieces), -1
        waiting: list[Batch] = []
        held = 0
        for k, piece in enumerate(self._pieces):
            if not self._may_read(k):
                break
            read += piece.size
            waiting.append(self._messages(piece))
            held += len(waiting[-1].buffer)
            last = k + 1 == len(self._pieces) or not self._may_read(k + 1)
            if held < _TOGETHER and not last:
                continue
            found, waiting, held = Batch.joined(waiting), [], 0
            if len(self._channels) != known:
                # Reading describes channels as it goes on.
                known, number = len(self._channels), self._numbers(place)
            horizon = self._pieces[k + 1].start_time if not last else NO_HORIZON
            batch = replace(found, topic=number[found.topic], horizon=horizon, progress=read / whole)
            yield batch if (batch.topic >= 0).all() else batch.at(batch.topic >= 0)

    def _may_read(self, k: int) -> bool:
        """Whether all up to piece k unpacks to no more than it may."""
        if self._ends is None:
            self._ends = np.cumsum([min(piece.raw_size, CHUNK_BYTES) for piece in self._pieces])
        if self._ends[k] <= self._most:
            return True
        self.damage.add(f"{self.path.name} unpacks to more than {self._most} bytes: read up to there")
        return False

    def _numbers(self, place: dict[str, int]) -> Int:
        """Index into topics of every channel number there can be, (2^16,); -1: none of them."""
        number = np.full(1 << 16, -1)
        for channel in self._channels.values():
            number[channel.id] = place.get(channel.topic, -1)
        return number

    def _count(self) -> None:
        """Read everything once: without a summary, the topics stand inside the chunks alone."""
        counts: Counter[int] = Counter()
        for k, piece in enumerate(self._pieces):
            if not self._may_read(k):
                break
            numbers, found = np.unique(self._messages(piece).topic, return_counts=True)
            counts.update(dict(zip(numbers.tolist(), found.tolist(), strict=True)))
        self._counts = dict(counts)

    def _scan(self) -> None:
        position, left = len(MAGIC), RECORDS + self.size // RECORD_BYTES
        while position < self.size:
            head = self._read(position, _RECORD.size)
            opcode, length = _RECORD.unpack(head) if len(head) == _RECORD.size else (0, self.size)
            end = position + _RECORD.size + length
            left -= 1
            if opcode == FOOTER:
                # Bytes of damage may look like a footer: what is behind it is not left out without a word.
                if end + len(MAGIC) != self.size:
                    self.damage.add(
                        f"{self.path.name} has a footer at byte {position} of {self.size}: read up to there"
                    )
                return
            if left < 0:
                self.damage.add(f"{self.path.name} has more records than its size explains: read up to byte {position}")
                return
            if end > self.size:
                self.damage.add(
                    f"{self.path.name} breaks off in the record at byte {position} of {self.size}: read up to there"
                )
            position = self._scan_record(opcode, position, end)
            if end > self.size:
                return
        self.damage.add(f"{self.path.name} has no footer: the recording was cut off, all there is was read")

    def _scan_record(self, opcode: int, position: int, end: int) -> int:
        """Take in one record, or the messages that begin with it; return where they end."""
        start = position + _RECORD.size
        if opcode == CHUNK:
            self._scan_chunk(start, end)
        elif end > self.size:
            return end
        elif opcode == MESSAGE:
            return self._scan_run(position, end)
        elif opcode in (SCHEMA, CHANNEL, STATISTICS):
            # One that is too long is noted as damaged by its length.
            self._note(opcode, self._read(start, min(end - start, DESCRIPTION_BYTES + 1)))
        return end

    def _scan_chunk(self, offset: int, end: int) -> None:
        head = self._read(offset, _CHUNK.size + 16)
        if len(head) >= _CHUNK.size:
            start_time, _, raw_size, crc, length = _CHUNK.unpack_from(head)
            compression = head[_CHUNK.size :][:length].decode("ascii", "replace")
            data = offset + _CHUNK.size + length + 8
            if length <= 16 and data <= min(end, self.size) and start_time < NO_HORIZON:
                size = min(end, self.size) - data
                self._pieces.append(Piece(start_time, data, size, raw_size, crc, compression, end > self.size))
                return
        self.damage.add(f"{self.path.name}: the chunk at byte {offset} has a damaged header and was left out")

    def _scan_run(self, position: int, end: int) -> int:
        """Note the run of messages outside chunks whose first one stands here; return where the run ends."""
        if end - position > CHUNK_BYTES:
            self.damage.add(f"{self.path.name}: the message at byte {position} is too long and was left out")
            return end
        for size in (_FIRST, _RUN):
            data = self._read(position, max(size, end - position))
            found, topics, stop = walk(data, outside=True)
            # The run may go on behind the bytes that were read.
            if position + len(data) == self.size or data[stop : stop + 1] in _STOPS:
                break
        if len(found):
            start_time = max(0, int(found.log_time.min()))
            self._pieces.append(Piece(start_time, position, stop, stop, 0, "", False))
        for opcode, content in topics:
            self._note(opcode, content)
        return position + max(stop, 1)

    def _read(self, position: int, size: int) -> bytes:
        self._file.seek(position)
        return self._file.read(size)

    def _messages(self, piece: Piece) -> Batch:
        """Read a piece, topics as numbers of channels; what is wrong is noted, what cannot be read left out."""
        stored = self._read(piece.offset, min(piece.size, CHUNK_BYTES + 1))
        data, wrong = decompress(stored, piece.compression, piece.raw_size, piece.crc, piece.cut)
        found, topics, end = walk(data)
        if wrong:
            self.damage.add(f"{self.path.name}: the chunk at byte {piece.offset} {wrong}")
        elif end < len(data):
            self.damage.add(
                f"{self.path.name}: the chunk at byte {piece.offset} is damaged after byte {end} of {len(data)}"
            )
        for opcode, content in topics:
            self._note(opcode, content)
        return found

    def _note(self, opcode: int, content: bytes) -> None:
        """Take in a description of a topic; the first of each number counts."""
        what = {SCHEMA: "message definition", CHANNEL: "topic description"}.get(opcode, "summary")
        if len(content) > DESCRIPTION_BYTES:
            self.damage.add(f"{self.path.name}: a {what} is longer than {DESCRIPTION_BYTES} bytes and was left out")
            return
        stream = ReadDataStream(io.BytesIO(content))
        try:
            if opcode == SCHEMA:
                schema = Schema.read(stream)
                self._keep(self._schemas, schema.id, schema.name, schema.name)
            elif opcode == CHANNEL:
                channel = Channel.read(stream)
                self._keep(self._channels, channel.id, channel, channel.topic)
            else:
                self._counts = dict(Statistics.read(stream).channel_message_counts)
        except (McapError, struct.error, UnicodeDecodeError, ValueError, OverflowError):
            self.damage.add(f"{self.path.name}: a {what} is damaged and was left out")

    def _keep(self, known: dict[int, T], number: int, what: T, name: str) -> None:
        """Keep a description, if it is the first of its number and within the limits."""
        if number in known:
            return
        if len(name) > NAME:
            self.damage.add(f"{self.path.name}: the name {name[:NAME]!r} is longer than {NAME} and was left out")
        elif len(known) == CHANNELS:
            self.damage.add(f"{self.path.name} describes more than {CHANNELS} topics: the others were left out")
        else:
            known[number] = what
