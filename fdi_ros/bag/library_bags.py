# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Bags whose messages a library hands out one by one: sqlite3 files of rosbag2, and bags of ROS 1.

A database may hold more than values: views, virtual tables and computed columns run whatever their maker wrote. Only
plain tables are read, within a number of steps that follows from the size of the file. SQLite writes beside what it
reads, and a rollback journal may have it delete any file: so a file is read as one that never changes, without looking
beside it. Only what lies in a write-ahead log would be missing then: where there is one, a copy of both is read.

A bag of ROS 1 that was not closed has no index, and is refused. rosbags keeps an object for each message of a bag,
whatever its topic: so the index may have a size, and what is read and unpacked at once has another. Its messages become
those of ROS 2.
"""

from __future__ import annotations

import bz2
import contextlib
import io
import shutil
import sqlite3
import struct
import tempfile
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import lz4.frame
import numpy as np
import zstandard
from rosbags.rosbag1 import Reader, ReaderError
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

from fdi_ros.bag.raw import NO_HORIZON, BagFile, Batch, Damage, Topic
from fdi_ros.core.sources import source_of_type
from fdi_ros.errors import BagError
from fdi_ros.system.files import (
    CHANNELS,
    CHUNK_BYTES,
    NAME,
    PORTION_BYTES,
    ROS1_INDEX_BYTES,
    STEPS,
    STEPS_PER_BYTE,
)

_TOGETHER = 4096  # messages handed on at once, at most
_TICK = 10_000  # steps of SQLite from one look at the clock of signals and steps to the next
_WRONG = (
    *(ReaderError, SerdeError, struct.error, AssertionError, LookupError, ValueError),
    *(EOFError, OSError, RuntimeError, MemoryError, RecursionError),
)
"""What rosbags and the unpacking libraries raise of a damaged bag."""
_UNPACKERS = {
    bz2.decompress: bz2.BZ2Decompressor,
    lz4.frame.decompress: lz4.frame.LZ4FrameDecompressor,
}
"""By the functions that rosbags takes, which have no bound."""
Message = tuple[
    int, int, bytes
]  # number of its topic in the file, time of recording, ns, and content


class LibraryBag(BagFile):
    """An open bag that a library reads."""

    _numbered: dict[int, Topic]  # by their numbers in the file

    @abstractmethod
    def _messages(self, numbers: Sequence[int]) -> Iterator[Message]:
        """Yield the messages of one topic or more, in the order of recording, up to the first that cannot be read."""

    def batches(self, topics: Sequence[str]) -> Iterator[Batch]:
        """Read the messages of the topics."""
        chosen = {
            number: topics.index(one.name)
            for number, one in self._numbered.items()
            if one.name in topics
        }
        whole, read = sum(self._numbered[number].count for number in chosen), 0
        found = self._messages(list(chosen)) if chosen else iter(())
        while messages := list(_together(found)):
            read += len(messages)
            numbers, times, data = zip(*messages, strict=True)
            length = np.array([len(one) for one in data])
            yield Batch(
                buffer=np.frombuffer(b"".join(data), dtype=np.uint8),
                topic=np.array([chosen[number] for number in numbers]),
                log_time=np.array(times, dtype=np.int64),
                offset=np.cumsum(length) - length,
                length=length,
                horizon=times[-1],
                progress=min(1.0, read / max(1, whole)),
            )


def _together(messages: Iterator[Message]) -> Iterator[Message]:
    """Take as many messages as are handed on at once."""
    held = 0
    for k, message in enumerate(messages, 1):
        yield message
        held += len(message[2])
        if k == _TOGETHER or held >= PORTION_BYTES:
            return


class SqliteFile(LibraryBag):
    """An open sqlite3 file."""

    magic = b"SQLite format 3\0"
    refusal = "is not a readable rosbag2 database"

    def __init__(self, path: Path, damage: Damage, most: int) -> None:
        super().__init__(path, damage, most)
        # SQLite opens the file itself.
        self.file.close()
        self._open = (
            contextlib.ExitStack()
        )  # what is to be closed: the database, then the folder of its copy
        self._steps = STEPS + STEPS_PER_BYTE * self.size
        try:
            self._base = self._opened()
            self._check_tables()
            self._numbered = self._topics()
            start = next(self._query("SELECT MIN(timestamp) FROM messages"))[0]
        except BaseException as error:
            self.close()
            if isinstance(error, (sqlite3.Error, OSError)):
                raise BagError(f"{path} {self.refusal}: {error}") from error
            raise
        self.start_time = start if isinstance(start, int) else NO_HORIZON
        try:
            counts = dict(
                self._query("SELECT topic_id, COUNT(*) FROM messages GROUP BY topic_id")
            )
        except sqlite3.Error as error:
            self.note(f"it is damaged ({error}): its messages could not be counted")
        else:
            self._numbered = {
                k: replace(one, count=counts.get(k, 0))
                for k, one in self._numbered.items()
            }
        self.topics = tuple(self._numbered.values())

    def close(self) -> None:
        """Close the file."""
        self._open.close()

    def _opened(self) -> sqlite3.Connection:
        log, journal = (Path(f"{self.path}{end}") for end in ("-wal", "-journal"))
        if journal.is_file() and journal.stat().st_size:
            self.note(
                "its last transaction was not finished, and was read as far as it goes"
            )
        waits = log.is_file() and log.stat().st_size > 0
        place, how = (
            (self._copied(log), "rw") if waits else (self.path, "ro&immutable=1")
        )
        base = self._open.enter_context(
            contextlib.closing(
                sqlite3.connect(f"{place.absolute().as_uri()}?mode={how}", uri=True)
            )
        )
        base.text_factory = lambda data: data.decode("utf-8", "replace")
        base.set_progress_handler(self._tick, _TICK)
        base.execute("PRAGMA trusted_schema = OFF")
        base.execute("PRAGMA cell_size_check = ON")
        if hasattr(base, "setlimit"):
            base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, 2 * CHUNK_BYTES)
        return base

    def _copied(self, log: Path) -> Path:
        """Copy the file and its write-ahead log into a temporary folder, where SQLite may write as it likes."""
        folder = Path(
            self._open.enter_context(tempfile.TemporaryDirectory(prefix="fdi_bag_"))
        )
        room, size = (
            shutil.disk_usage(folder).free // 2,
            self.path.stat().st_size + log.stat().st_size,
        )
        if size > room:
            raise BagError(
                f"{self.path} has a write-ahead log and must be copied to be read: {size >> 20} MB, expected at most"
                f" {room >> 20} MB, half of the free space of {tempfile.gettempdir()}"
            )
        for one in (self.path, log):
            shutil.copyfile(one, folder / one.name)
        return folder / self.path.name

    def _tick(self) -> bool:
        """Count the steps of SQLite; a signal that arrives while it works is dealt with before this returns."""
        self._steps -= _TICK
        return self._steps < 0

    def _query(
        self, text: str, values: Sequence[Any] = ()
    ) -> Iterator[tuple[Any, ...]]:
        """Rows of a query; whatever goes wrong is an error of SQLite, or the user's wish to stop."""
        try:
            yield from self._base.execute(text, values)
        except sqlite3.OperationalError as error:
            if self._steps < 0:
                raise sqlite3.OperationalError(
                    "reading takes more steps than a file of its size needs"
                ) from error
            if "interrupt" in str(error):
                # What the signal raised inside the handler ends the query and goes no further.
                raise KeyboardInterrupt from error
            raise
        except (MemoryError, UnicodeError, OverflowError) as error:
            raise sqlite3.DatabaseError(str(error) or "out of memory") from error

    def _check_tables(self) -> None:
        """Refuse whatever is no plain table."""
        for table in ("topics", "messages"):
            found = list(
                self._query(
                    "SELECT type, sql FROM sqlite_master WHERE name = ? LIMIT 2",
                    (table,),
                )
            )
            if not found:
                raise sqlite3.DatabaseError(f"no such table: {table}")
            if (
                len(found) > 1
                or found[0][0] != "table"
                or not str(found[0][1]).upper().startswith("CREATE TABLE")
            ):
                raise sqlite3.DatabaseError(f"{table} is no plain table")
            columns = list(self._query(f"PRAGMA table_xinfo({table})"))
            if any(column[6] for column in columns):
                raise sqlite3.DatabaseError(f"{table} has computed columns")

    def _topics(self) -> dict[int, Topic]:
        found: dict[int, Topic] = {}
        for number, *about in self._query(
            "SELECT id, name, type, serialization_format FROM topics"
        ):
            name, kind, encoding = map(str, about)
            if (
                not isinstance(number, int)
                or max(map(len, (name, kind, encoding))) > NAME
            ):
                self.note("a topic description is damaged and was left out")
            elif len(found) == CHANNELS:
                self.note(
                    f"it has more than {CHANNELS} topics: the others were left out"
                )
                break
            else:
                found[number] = Topic(name, kind, encoding)
        return found

    def _messages(self, numbers: Sequence[int]) -> Iterator[Message]:
        last = -1
        # A damaged database may not be sorted by time any more and still be read in the order in which it was written.
        for order in ("timestamp", "id"):
            # What is sorted is in memory, and so comes without the messages themselves.
            which = f"topic_id IN ({','.join('?' * len(numbers))}) AND timestamp > ? ORDER BY {order}"
            asked = f"SELECT rowid, topic_id, timestamp FROM messages WHERE {which}"
            try:
                for row, number, time in self._query(asked, (*numbers, last)):
                    data = self._message(row)
                    # Only a damaged database holds anything else.
                    if not isinstance(time, int) or not isinstance(data, bytes):
                        continue
                    self._left -= len(data)
                    if self._left < 0:
                        self.note(
                            "it comes to more bytes than it should: read up to there"
                        )
                        return
                    yield number, time, data
                    last = max(last, time)
            except sqlite3.Error as error:
                self.note(
                    f"it is damaged ({error}): not all messages could be read in order of {order}"
                )
                if self._steps >= 0:
                    continue
            return

    def _message(self, row: int) -> Any:
        """Return a message as it was sent; a damaged one comes out empty, and is counted as malformed later."""
        one = "SELECT data FROM messages WHERE rowid = ? AND length(data) <= ?"
        (content,) = next(self._query(one, (row, CHUNK_BYTES)), (None,))
        if content is None:
            self.note(
                f"messages of none or more than {CHUNK_BYTES} bytes were left out"
            )
        # Each may be compressed by itself: no message begins like that.
        if not isinstance(content, bytes) or not content.startswith(
            zstandard.FRAME_HEADER
        ):
            return content
        try:
            return zstandard.ZstdDecompressor().stream_reader(content).read(CHUNK_BYTES)
        except (zstandard.ZstdError, MemoryError):
            return b""


class _Bounded(io.BufferedReader):
    """A file of which a reader reads so much in all, and so much at once."""

    left = ROS1_INDEX_BYTES

    def read(self, size: int | None = -1, /) -> bytes:
        """Read so many bytes."""
        self.left -= size or 0
        if self.left < 0 or (size or 0) > PORTION_BYTES:
            raise ReaderError(
                "its index, or a part of it, is larger than that of any recorder"
            )
        return super().read(size)


class Ros1File(LibraryBag):
    """An open bag of ROS 1; it must have an index, of bounded size."""

    magic = b"#ROSBAG V2.0\n"
    refusal = "is not a bag of ROS 1"

    def __init__(self, path: Path, damage: Damage, most: int) -> None:
        super().__init__(path, damage, most)
        bounded = _Bounded(io.FileIO(self.file.fileno(), closefd=False))
        bounded.seek(0)
        # Stands for the path of a file that is open already.
        place: Any = SimpleNamespace(exists=lambda: True, open=lambda _: bounded)
        self._reader = Reader(place)
        self._store = get_typestore(Stores.ROS2_JAZZY)
        try:
            self._reader.open()
            self._numbered = {
                one.id: Topic(one.topic, one.msgtype, "cdr", one.msgcount)
                for one in self._reader.connections
            }
            self.start_time = self._reader.start_time
        except _WRONG as error:
            self.file.close()
            if "not indexed" in str(error):
                raise BagError(
                    f"{path} has no index, its recording was cut off: run rosbag reindex"
                ) from error
            raise BagError(f"{path} is not a readable bag of ROS 1: {error}") from error
        self.topics = tuple(self._numbered.values())
        bounded.left = most + self.size
        for number, chunk in self._reader.chunks.items():
            unpack = partial(self._unpacked, _UNPACKERS.get(chunk.decompressor))
            self._reader.chunks[number] = chunk._replace(decompressor=unpack)

    def close(self) -> None:
        """Close the file."""
        if self._reader.bio is not None:
            self._reader.close()
        self.file.close()

    def _messages(self, numbers: Sequence[int]) -> Iterator[Message]:
        try:
            connections = [one for one in self._reader.connections if one.id in numbers]
            for connection, time, data in self._reader.messages(connections):
                yield connection.id, time, self._converted(data, connection.msgtype)
        except _WRONG as error:
            self.note(f"it is damaged ({error}): read up to there")

    def _converted(self, data: bytes, kind: str) -> bytes:
        """Return a message as ROS 2 has it; a damaged one comes out empty, and is counted as malformed later."""
        if source_of_type(kind) is None:
            return b""
        try:
            return bytes(self._store.ros1_to_cdr(data, kind))
        except _WRONG:
            return b""

    def _unpacked(self, unpacker: Callable[[], Any] | None, data: bytes) -> bytes:
        """Unpack a chunk."""
        if unpacker is not None:
            data = unpacker().decompress(data, CHUNK_BYTES)
        self._left -= len(data)
        if self._left < 0:
            raise ReaderError("it comes to more bytes than it should")
        return data
