# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""One MCAP file, read in bounded memory, whole or damaged.

Records are walked from the start. Footer, summary and indexes are not trusted: a
recording that a crash cut off has none. The first walk reads only the headers of chunks
and finds their order in time; without statistics, or if times step back, it reads all.
The second one reads the chunks in that order. Layout of
the records: https://mcap.dev/spec.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, TypeVar

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Schema, Statistics

from fdi_ros.bag.raw import (
    NO_HORIZON,
    PACKED,
    BagFile,
    Batch,
    Damage,
    Topic,
    starts_with,
    unpack_message,
)
from fdi_ros.bag.recorder_clock import LEAST_SET_BACK, RecorderClock
from fdi_ros.bag.ros1_message import converted_from_ros1
from fdi_ros.compiling.compiled import compiled
from fdi_ros.core.messages import read_bits
from fdi_ros.core.sources import source_of_type
from fdi_ros.model.samples import Bytes, Int
from fdi_ros.system.files import MCAP, RECORDING

# As whole numbers, which compiled code compares with bytes.
FOOTER = int(Opcode.FOOTER)
_LAST_OPCODE = int(Opcode.DATA_END)
SCHEMA = int(Opcode.SCHEMA)
CHANNEL = int(Opcode.CHANNEL)
MESSAGE = int(Opcode.MESSAGE)
CHUNK = int(Opcode.CHUNK)
STATISTICS = int(Opcode.STATISTICS)
#: encoding of messages of ROS 1, as in a converted .bag
ROS1 = "ros1"
#: opcode of a record, and the length of its content
_RECORD = struct.Struct("<BQ")
_PREFIX = _RECORD.size
#: channel, sequence, log time and publish time of a message record
_MESSAGE_HEAD = struct.calcsize("<HIQQ")


def decompress(
    data: bytes, compression: str, size: int, crc: int, cut: bool
) -> tuple[bytes, str]:
    """Decompress a chunk (``zstd``, ``lz4`` or empty) to ``size`` bytes.

    A ``crc`` of 0 is not checked. A chunk known to be cut off gives all that
    decompresses. Returns the bytes and a description of the damage, which may be empty.
    """
    if max(size, len(data) if not compression else 0) > RECORDING.chunk_bytes:
        return (
            b"",
            f"claims {size} bytes, expected at most {RECORDING.chunk_bytes}, and was left out",
        )
    try:
        if compression == "zstd":
            data = zstandard.ZstdDecompressor().stream_reader(data).read(size)
        elif compression == "lz4":
            data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size)
        elif compression:
            return b"", f"has the unknown compression {compression!r} and was left out"
    except (
        zstandard.ZstdError,
        RuntimeError,
        ValueError,
        EOFError,
        MemoryError,
    ) as error:
        return b"", f"cannot be decompressed ({error}) and was left out"
    if cut:
        return data, f"is cut off after {len(data)} of {size} bytes"
    if len(data) != size:
        return b"", f"has {len(data)} bytes instead of {size} and was left out"
    if crc and zlib.crc32(data) != crc:
        return b"", "fails its checksum and was left out"
    return data, ""


def walk(
    data: bytes, outside: bool = False
) -> tuple[Batch, list[tuple[int, bytes]], int]:
    """Find the records in a run of bytes, up to the first incomplete one.

    Outside chunks, a chunk, the statistics or the footer also end the walk. Returns the
    messages with channel numbers as topics, opcode and content of schemas and channels,
    and the end of the walk: the length of the data unless damage or another record
    ended it.
    """
    buffer = np.frombuffer(data, dtype=np.uint8)
    # The first walk only counts.
    count, _ = find_records(buffer, outside, np.empty((5, 0), np.int64))
    found = np.empty((5, count), np.int64)
    _, end = find_records(buffer, outside, found)
    sent = found[0] == MESSAGE
    contents = [
        (kind, data[at : at + size])
        for kind, _, _, at, size in found[:, ~sent].T.tolist()
    ]
    messages = found if sent.all() else found[:, sent]
    _, channel, log_time, offset, length = messages
    return (
        Batch(buffer, channel, log_time, offset, length, NO_HORIZON, 1.0),
        contents,
        int(end),
    )


@compiled
def find_records(data: Bytes, outside: bool, found: Int) -> tuple[int, int]:
    """Find messages, schemas and channels in a run of bytes, as `walk` does.

    Schemas and channels beyond the first `MCAP.descriptions` are skipped: an empty record
    takes 9 bytes, and a list of millions of messages would take 40 bytes each. ``found`` (5,
    room) receives per record: opcode, channel and log time (messages only), offset,
    length. Returns the number of records, those beyond the room included, and the end
    of the walk.
    """
    count = position = descriptions = 0
    while position + _PREFIX <= len(data):
        opcode = data[position]
        length = read_bits(data, position + 1, 8, True)
        start = position + _PREFIX
        # A length beyond all integers comes out negative.
        if not 0 <= length <= len(data) - start:
            break
        if outside and opcode in (CHUNK, STATISTICS, FOOTER):
            break
        head = _MESSAGE_HEAD if opcode == MESSAGE else 0
        described = opcode in (SCHEMA, CHANNEL)
        descriptions += described
        wanted = described and descriptions <= MCAP.descriptions
        if wanted or (opcode == MESSAGE and length >= head):
            if count < found.shape[1]:
                found[0, count] = opcode
                found[3, count] = start + head
                found[4, count] = length - head
                if head:
                    found[1, count] = read_bits(data, start, 2, True)
                    found[2, count] = read_bits(data, start + 6, 8, True)
            count += 1
        position = start + length
    return count, position


def ros_type(name: str) -> str:
    """Return the type of a message as ROS 2 writes it, from the names of other producers.

    ROS 1 has ``sensor_msgs/Imu``, IDL ``sensor_msgs::msg::Imu``, and DDS
    ``sensor_msgs::msg::dds_::Imu_``.
    """
    parts = name.replace("::", "/").split("/")
    if len(parts) == 4 and parts[2] == "dds_":
        parts = [*parts[:2], parts[3].removesuffix("_")]
    if len(parts) == 2:
        parts.insert(1, "msg")
    return "/".join(parts)


T = TypeVar("T")
_CHUNK = struct.Struct("<QQQII")
#: messages outside chunks are read in runs of at most this many bytes
_RUN = 1 << 18
#: bytes of pieces that form one batch, since each batch has a cost
_BATCH_BYTES = 1 << 16


class Piece(NamedTuple):
    """A unit of reading: a chunk, or a run of messages outside chunks."""

    #: ns
    start_time: int
    #: ns
    end_time: int
    #: begin in the file, bytes
    offset: int
    #: bytes in the file
    size: int
    #: bytes when decompressed
    raw_size: int
    #: checksum of the decompressed bytes, 0 if none is given
    crc: int = 0
    #: name of the method, empty if not compressed
    compression: str = ""
    #: whether the file ends inside
    cut: bool = False


class McapFile(BagFile):
    """An open MCAP file."""

    magic = b"\x89MCAP0\r\n"
    refusal = "is not an MCAP file"

    def __init__(self, path: Path, damage: Damage, most: int) -> None:
        super().__init__(path, damage, most)
        self._channels: dict[int, Channel] = {}
        self._schemas: dict[int, str] = {}
        self._counts: dict[int, int] = {}
        self._of_ros1: set[str] = set()
        """Topics of gyros with messages of ROS 1."""
        self._found: list[Piece] = []
        self._scan()
        steps_back = self._steps_back()
        self._found.sort(key=lambda piece: piece.start_time)
        self.start_time = self._found[0].start_time if self._found else NO_HORIZON
        self.end_time = max((piece.end_time for piece in self._found), default=0)
        ends = np.cumsum(
            [min(piece.raw_size, RECORDING.chunk_bytes) for piece in self._found]
        )
        self._pieces = self._found[: np.searchsorted(ends, most, side="right")]
        """In the order of time, those that unpack to no more than they may."""
        if len(self._pieces) < len(self._found):
            self.note(f"it unpacks to more than {most} bytes: read up to there")
        self._follows_clock = not steps_back or self._clock_was_set()
        """Whether pieces are read in the order of writing, in which a set clock shows."""
        if steps_back and self._follows_clock:
            self._pieces.sort(key=lambda piece: piece.offset)
        if not self._counts or not self._counts.keys() <= self._channels.keys():
            # Without a summary everything is read once: the topics stand inside the chunks alone.
            counts: Counter[int] = Counter()
            for piece in self._pieces:
                numbers, found = np.unique(
                    self._messages(piece).topic, return_counts=True
                )
                counts.update(dict(zip(numbers.tolist(), found.tolist(), strict=True)))
            self._counts = dict(counts)

        self.topics = tuple(
            self._topic(number, one) for number, one in self._channels.items()
        )

    def _steps_back(self) -> bool:
        """Whether pieces that are written later begin before the end of earlier ones."""
        latest = 0
        for piece in self._found:
            if piece.start_time <= latest - LEAST_SET_BACK:
                return True
            latest = max(latest, piece.end_time)
        return False

    def _clock_was_set(self) -> bool:
        """Whether times step back in the file because the clock of the recorder was set."""
        written = sorted(self._pieces, key=lambda piece: piece.offset)
        found = [(one.topic, one.log_time) for one in map(self._messages, written)]
        clock = RecorderClock()
        if found:
            clock.follow(*map(np.concatenate, zip(*found, strict=True)))
        return clock.set_back > 0

    def _topic(self, number: int, channel: Channel) -> Topic:
        kind = ros_type(self._schemas.get(channel.schema_id, ""))
        encoding = channel.message_encoding.lower()
        if encoding == ROS1 and source_of_type(kind) is not None:
            # Its messages are converted as they are read.
            self._of_ros1.add(channel.topic)
            encoding = "cdr"
        return Topic(channel.topic, kind, encoding, self._counts.get(number, 0))

    def batches(self, topics: Sequence[str], clock: RecorderClock) -> Iterator[Batch]:
        """Read the messages of the topics."""
        read = 0
        # A file that breaks off in the header of a chunk may hold no bytes of pieces.
        whole = max(1, sum(piece.size for piece in self._pieces))
        held = 0
        known = -1
        waiting: list[Batch] = []
        starts = [*(piece.start_time for piece in self._pieces[1:]), NO_HORIZON]
        following = np.minimum.accumulate(starts[::-1])[::-1].tolist()
        for k, (piece, horizon) in enumerate(
            zip(self._pieces, following, strict=False), 1
        ):
            read += piece.size
            waiting.append(self._messages(piece))
            held += len(waiting[-1].buffer)
            if held < _BATCH_BYTES and k < len(self._pieces):
                continue
            found = Batch.joined(waiting)
            waiting = []
            held = 0
            if len(self._channels) != known:
                # Reading may describe further channels.
                known = len(self._channels)
                number = np.full(1 << 16, -1)
                for channel in self._channels.values():
                    number[channel.id] = (
                        topics.index(channel.topic) if channel.topic in topics else -1
                    )
            batch = replace(found, topic=number[found.topic], progress=read / whole)
            if not (batch.topic >= 0).all():
                batch = batch.at(batch.topic >= 0)
            log_time = batch.log_time
            if self._follows_clock:
                log_time = clock.follow(batch.topic, log_time)
            if horizon != NO_HORIZON:
                horizon += clock.least_shift
            batch = replace(batch, log_time=log_time, horizon=horizon)
            yield from self._unpacked(batch, topics)

    def _unpacked(self, batch: Batch, topics: Sequence[str]) -> Iterator[Batch]:
        """Unpack messages compressed one by one (``--compression-mode message``).

        Messages of ROS 1 are converted to those of ROS 2. Only types that may carry gyros
        are unpacked or converted. Other messages are merely counted.
        """
        types = {one.name: one.type for one in self.topics}
        gyros = [source_of_type(types.get(name, "")) is not None for name in topics]
        packed = np.any([starts_with(batch, head) for head in PACKED], axis=0)
        packed &= np.array(gyros, dtype=bool)[batch.topic]
        of_ros1 = np.array([name in self._of_ros1 for name in topics], dtype=bool)
        converted = of_ros1[batch.topic]
        if not (packed | converted).any():
            yield batch
            return
        first = 0
        while first < len(batch):
            messages: list[bytes] = []
            held = 0
            for k in range(first, len(batch)):
                message = batch.message(k)
                if packed[k]:
                    message = unpack_message(
                        message, min(RECORDING.chunk_bytes, self._left)
                    )
                    self._left -= len(message)
                if converted[k]:
                    message = converted_from_ros1(
                        message, types[topics[batch.topic[k]]]
                    )
                messages.append(message)
                held += len(message)
                if held > RECORDING.portion_bytes:
                    break
            end = first + len(messages)
            later = batch.log_time[end:].min(initial=batch.horizon)
            length = np.array([len(one) for one in messages])
            yield replace(
                batch,
                buffer=np.frombuffer(b"".join(messages), dtype=np.uint8),
                topic=batch.topic[first:end],
                log_time=batch.log_time[first:end],
                offset=np.cumsum(length) - length,
                length=length,
                horizon=int(later),
            )
            first = end
        if self._left <= 0:
            self.note("it unpacks to more bytes than it should: read up to there")

    def _scan(self) -> None:
        position = len(self.magic)
        left = MCAP.records + self.size // MCAP.record_bytes
        while position < self.size:
            head = self._read(position, _RECORD.size)
            opcode, length = (
                _RECORD.unpack(head) if len(head) == _RECORD.size else (0, self.size)
            )
            end = position + _RECORD.size + length
            left -= 1
            if opcode == FOOTER:
                # Damaged bytes may look like a footer, so any rest behind one is noted.
                if end + len(self.magic) != self.size:
                    self.lose(
                        f"it has a footer at byte {position} of {self.size}: read up to there"
                    )
                return
            if left < 0:
                self.lose(
                    f"it has more records than its size explains: read up to byte {position}"
                )
                return
            if end > self.size:
                # Behind damaged bytes in place of a record, there may be others.
                is_record = opcode <= _LAST_OPCODE
                (self.break_off if is_record else self.lose)(
                    f"it breaks off in the record at byte {position} of {self.size}: read up to there"
                )
            start = position + _RECORD.size
            if opcode == CHUNK:
                self._scan_chunk(start, end)
            elif opcode == MESSAGE and end <= self.size:
                end = self._scan_run(position, end)
            elif opcode in (SCHEMA, CHANNEL, STATISTICS) and end <= self.size:
                # One that is too long is noted as damaged by its length.
                self._describe(
                    opcode,
                    self._read(start, min(length, RECORDING.description_bytes + 1)),
                )
            if end > self.size:
                return
            position = end
        self.break_off(
            "it has no footer: the recording was cut off, all there is was read"
        )

    def _scan_chunk(self, offset: int, end: int) -> None:
        head = self._read(offset, _CHUNK.size + 16)
        if len(head) >= _CHUNK.size:
            start_time, end_time, raw_size, crc, length = _CHUNK.unpack_from(head)
            compression = head[_CHUNK.size :][:length].decode("ascii", "replace")
            data = offset + _CHUNK.size + length + 8
            if length <= 16 and data <= min(end, self.size) and start_time < NO_HORIZON:
                size = min(end, self.size) - data
                self._found.append(
                    Piece(
                        start_time,
                        end_time,
                        data,
                        size,
                        raw_size,
                        crc,
                        compression,
                        end > self.size,
                    )
                )
                return
        self.lose(f"the chunk at byte {offset} has a damaged header and was left out")

    def _scan_run(self, position: int, end: int) -> int:
        """Note the run of messages outside chunks that begins here, and return its end."""
        if end - position > RECORDING.chunk_bytes:
            self.note(f"the message at byte {position} is too long and was left out")
            return end
        found, topics, stop = walk(
            self._read(position, max(_RUN, end - position)), outside=True
        )
        if len(found):
            first = max(0, int(found.log_time.min()))
            last = int(found.log_time.max())
            self._found.append(Piece(first, last, position, stop, stop))
        for opcode, content in topics:
            self._describe(opcode, content)
        return position + max(stop, 1)

    def _read(self, position: int, size: int) -> bytes:
        self.file.seek(position)
        return self.file.read(size)

    def _messages(self, piece: Piece) -> Batch:
        """Read a piece, with channel numbers as topics. Damage is noted and left out."""
        stored = self._read(piece.offset, min(piece.size, RECORDING.chunk_bytes + 1))
        data, wrong = decompress(
            stored, piece.compression, piece.raw_size, piece.crc, piece.cut
        )
        found, topics, end = walk(data)
        if wrong or end < len(data):
            note = self.break_off if piece.cut else self.lose
            note(
                f"the chunk at byte {piece.offset} {wrong or f'is damaged after byte {end} of {len(data)}'}"
            )
        for opcode, content in topics:
            self._describe(opcode, content)
        return found

    def _describe(self, opcode: int, content: bytes) -> None:
        """Take a description of a topic. The first one with each number counts."""
        what = {SCHEMA: "message definition", CHANNEL: "topic description"}.get(
            opcode, "summary"
        )
        if len(content) > RECORDING.description_bytes:
            self.note(
                f"a {what} is longer than {RECORDING.description_bytes} bytes and was left out"
            )
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
            self.note(f"a {what} is damaged and was left out")

    def _keep(self, known: dict[int, T], number: int, what: T, name: str) -> None:
        """Keep the first description with each number, within the limits."""
        if number in known:
            return
        if len(name) > RECORDING.name_length:
            self.note(
                f"the name {name[: RECORDING.name_length]!r} is longer than {RECORDING.name_length} and was left out"
            )
        elif len(known) == RECORDING.topics:
            self.note(
                f"it describes more than {RECORDING.topics} topics: the others were left out"
            )
        else:
            known[number] = what
