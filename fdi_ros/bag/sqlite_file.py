# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""rosbag2 databases (.db3), read by SQLite.

A database may hold code: views, virtual tables and computed columns run expressions of
their author. Only plain tables are read, within a number of steps that follows from the
size of the file. SQLite also writes beside a file, and a rollback journal may delete
any file. The file is therefore opened as immutable. With a write-ahead log beside the
file, a copy of both is read.
"""

from __future__ import annotations

import contextlib
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fdi_ros.bag.library_bag import LibraryBag, Message
from fdi_ros.bag.raw import NO_HORIZON, PACKED, Damage, Topic, unpack_message
from fdi_ros.bag.recorder_clock import RecorderClock
from fdi_ros.errors import BagError
from fdi_ros.system.files import RECORDING, SQLITE, scratch_folder

#: steps of SQLite from one look at the clock of signals and steps to the next
_TICK = 10_000


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
        )  # to be closed: the database, then the folder of its copy
        self._steps = SQLITE.steps + SQLITE.steps_per_byte * self.size
        try:
            self._base = self._opened()
            self._check_tables()
            self._numbered = self._topics()
            start, end = next(
                self._query("SELECT MIN(timestamp), MAX(timestamp) FROM messages")
            )
        except BaseException as error:  # Close the file whatever ends the opening.
            self.close()
            if isinstance(error, (sqlite3.Error, OSError)):
                raise BagError(f"{path} {self.refusal}: {error}") from error
            raise
        self.start_time = start if isinstance(start, int) else NO_HORIZON
        self.end_time = end if isinstance(end, int) else 0
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
            base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, 2 * RECORDING.chunk_bytes)
        return base

    def _copied(self, log: Path) -> Path:
        """Copy the file and its write-ahead log to a temporary folder for SQLite."""
        folder = self._open.enter_context(scratch_folder("fdi_bag"))
        room = shutil.disk_usage(folder).free // 2
        size = self.path.stat().st_size + log.stat().st_size
        if size > room:
            raise BagError(
                f"{self.path} has a write-ahead log and must be copied to be read: {size >> 20} MB, expected at most"
                f" {room >> 20} MB, half of the free space of {tempfile.gettempdir()}"
            )
        for one in (self.path, log):
            shutil.copyfile(one, folder / one.name)
        return folder / self.path.name

    def _tick(self) -> bool:
        """Count the steps of SQLite. A pending signal is handled before this returns."""
        self._steps -= _TICK
        return self._steps < 0

    def _query(
        self, text: str, values: Sequence[Any] = ()
    ) -> Iterator[tuple[Any, ...]]:
        """Yield the rows of a query. All failures become SQLite errors or KeyboardInterrupt."""
        try:
            yield from self._base.execute(text, values)
        except sqlite3.OperationalError as error:
            if self._steps < 0:
                raise sqlite3.OperationalError(
                    "reading takes more steps than a file of its size needs"
                ) from error
            if "interrupt" in str(error):
                # The exception of a signal handler only interrupts the query.
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
                or max(map(len, (name, kind, encoding))) > RECORDING.name_length
            ):
                self.note("a topic description is damaged and was left out")
            elif len(found) == RECORDING.topics:
                self.note(
                    f"it has more than {RECORDING.topics} topics: the others were left out"
                )
                break
            else:
                found[number] = Topic(name, kind, encoding)
        return found

    def _messages(self, numbers: Sequence[int]) -> Iterator[Message]:
        last = -1
        # A damaged database may have lost its index by time and keep the order of
        # writing.
        orders = ("id",) if self._clock_was_set(numbers) else ("timestamp", "id")
        for order in orders:
            # Sorting happens in memory, so the query leaves out the messages
            # themselves.
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
                self.lose(
                    f"it is damaged ({error}): not all messages could be read in order of {order}"
                )
                if self._steps >= 0:
                    continue
            return

    def _clock_was_set(self, numbers: Sequence[int]) -> bool:
        """Whether times step back in the order of writing because the clock of the recorder was set."""
        which = f"topic_id IN ({','.join('?' * len(numbers))}) ORDER BY id"
        asked = f"SELECT topic_id, timestamp FROM messages WHERE {which}"
        clock = RecorderClock()
        try:
            found = np.array(list(self._query(asked, numbers)))
            if found.size and found.dtype == np.int64:
                clock.follow(*np.ascontiguousarray(found.T))
        except sqlite3.Error:
            # Reading the messages tells what is damaged.
            return False
        return clock.set_back > 0

    def _message(self, row: int) -> Any:
        """Return a message as sent. A damaged one is empty, which counts as malformed."""
        one = "SELECT data FROM messages WHERE rowid = ? AND length(data) <= ?"
        (content,) = next(self._query(one, (row, RECORDING.chunk_bytes)), (None,))
        if content is None:
            self.note(
                f"messages of none or more than {RECORDING.chunk_bytes} bytes were left out"
            )
        # Each may be compressed by itself: no message begins like that.
        if not isinstance(content, bytes) or not content.startswith(PACKED):
            return content
        return unpack_message(content, RECORDING.chunk_bytes)
