"""One MCAP file, read in bounded memory, whole or damaged.

The records are walked from the start, without trust in footer, summary or indexes: a recording cut off by a crash has
none of them. The first walk reads the headers of the chunks and skips their contents: that gives their order in time.
The second reads the chunks in that order. The layout of the records: https://mcap.dev/spec.
"""

from __future__ import annotations

import io
import os
import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.records import Channel, Schema, Statistics

from fdi_ros.bag.chunk import CHANNEL, LARGEST, MESSAGE, SCHEMA, Records, decompress, walk
from fdi_ros.bag.raw import NO_HORIZON, Batch, Damage, Int, Topic
from fdi_ros.errors import BagError

MAGIC = b"\x89MCAP0\r\n"
CHUNK, STATISTICS, FOOTER = 0x06, 0x0B, 0x02
_RECORD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQII")
_RUN = 1 << 22
"""Messages outside chunks are read in runs of at most this many bytes."""


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
    """An open MCAP file.

    Parameters
    ----------
    path
        The file.
    damage
        Takes what cannot be read.

    Raises
    ------
    BagError
        If the file cannot be opened, is empty, or is no MCAP file.
    """

    def __init__(self, path: Path, damage: Damage) -> None:
        self.path = path
        self.damage = damage
        self._channels: dict[int, Channel] = {}
        self._schemas: dict[int, Schema] = {}
        self._counts: dict[int, int] = {}
        self._pieces: list[Piece] = []
        try:
            self._file: BinaryIO = path.open("rb")
        except OSError as error:
            raise BagError(f"cannot open {path}: {error.strerror}") from error
        self.size = os.fstat(self._file.fileno()).st_size
        start = self._file.read(len(MAGIC))
        if start != MAGIC:
            self._file.close()
            raise BagError(f"{path} is not an MCAP file: it starts with {start!r}" if start else f"{path} is empty")
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
            schema = self._schemas.get(channel.schema_id)
            kind = schema.name if schema else ""
            topics.append(Topic(channel.topic, kind, channel.message_encoding, self._counts.get(number, 0)))
        return tuple(topics)

    @property
    def start_time(self) -> int:
        """Time of recording of the first message, ns; of a file without messages the latest there is."""
        return self._pieces[0].start_time if self._pieces else NO_HORIZON

    def batches(self, topics: Sequence[str]) -> Iterator[Batch]:
        """Read the messages of the topics."""
        read, whole, known = 0, sum(piece.size for piece in self._pieces), -1
        for k, piece in enumerate(self._pieces):
            read += piece.size
            horizon = self._pieces[k + 1].start_time if k + 1 < len(self._pieces) else NO_HORIZON
            records = self._records(piece)
            if len(self._channels) != known:
                # Reading describes channels as it goes on.
                known, number = len(self._channels), self._numbers(topics)
            topic = number[records.channel]
            wanted = topic >= 0
            rows = slice(None) if wanted.all() else wanted
            yield Batch(
                records.buffer,
                topic[rows],
                records.log_time[rows],
                records.offset[rows],
                records.length[rows],
                horizon,
                read / whole,
            )

    def _numbers(self, topics: Sequence[str]) -> Int:
        """Index into topics of every channel number there can be, (2^16,); -1: none of them."""
        number = np.full(1 << 16, -1)
        for channel in self._channels.values():
            if channel.topic in topics:
                number[channel.id] = topics.index(channel.topic)
        return number

    def _count(self) -> None:
        """Read everything once: without a summary, the topics stand inside the chunks alone."""
        counts: Counter[int] = Counter()
        for piece in self._pieces:
            counts.update(dict(enumerate(np.bincount(self._records(piece).channel).tolist())))
        self._counts = dict(counts)

    def _scan(self) -> None:
        position = len(MAGIC)
        while position < self.size:
            head = self._read(position, _RECORD.size)
            opcode, length = _RECORD.unpack(head) if len(head) == _RECORD.size else (0, self.size)
            end = position + _RECORD.size + length
            if opcode == FOOTER:
                return
            if opcode == CHUNK:
                self._scan_chunk(position + _RECORD.size, end)
            elif opcode == MESSAGE and end <= self.size:
                end = max(end, self._scan_run(position))
            elif opcode in (SCHEMA, CHANNEL, STATISTICS) and end <= self.size and length <= LARGEST:
                self._note(opcode, self._read(position + _RECORD.size, length))
            if end > self.size:
                self.damage.add(
                    f"{self.path.name} breaks off in the record at byte {position} of {self.size}: read up to there"
                )
                return
            position = end
        self.damage.add(f"{self.path.name} has no footer: the recording was cut off, all there is was read")

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

    def _scan_run(self, position: int) -> int:
        """Note the run of messages outside chunks that starts here; return where it ends."""
        records = walk(self._read(position, _RUN), messages_only=True)
        if len(records.log_time):
            start_time = max(0, int(records.log_time.min()))
            self._pieces.append(Piece(start_time, position, records.end, records.end, 0, "", False))
        return position + records.end

    def _read(self, position: int, size: int) -> bytes:
        self._file.seek(position)
        return self._file.read(size)

    def _records(self, piece: Piece) -> Records:
        """Read a piece; what is wrong with it is noted, and what cannot be read left out."""
        stored = self._read(piece.offset, min(piece.size, LARGEST))
        data, wrong = decompress(stored, piece.compression, piece.raw_size, piece.crc, piece.cut)
        records = walk(data)
        if wrong:
            self.damage.add(f"{self.path.name}: the chunk at byte {piece.offset} {wrong}")
        elif records.end < len(data):
            self.damage.add(
                f"{self.path.name}: the chunk at byte {piece.offset} is damaged after byte {records.end} of {len(data)}"
            )
        for opcode, content in records.topics:
            self._note(opcode, content)
        return records

    def _note(self, opcode: int, content: bytes) -> None:
        """Take in a description of a topic; the first of each number counts."""
        stream = ReadDataStream(io.BytesIO(content))
        try:
            if opcode == SCHEMA:
                schema = Schema.read(stream)
                self._schemas.setdefault(schema.id, schema)
            elif opcode == CHANNEL:
                channel = Channel.read(stream)
                self._channels.setdefault(channel.id, channel)
            else:
                self._counts = dict(Statistics.read(stream).channel_message_counts)
        except (McapError, struct.error, UnicodeDecodeError, ValueError, OverflowError):
            what = {SCHEMA: "message definition", CHANNEL: "topic description"}.get(opcode, "summary")
            self.damage.add(f"{self.path.name}: a {what} is damaged and was left out")
