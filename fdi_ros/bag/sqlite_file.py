"""One sqlite3 file of a rosbag2 recording, read in bounded memory, whole or damaged."""

from __future__ import annotations

import itertools
import sqlite3
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import zstandard

from fdi_ros.bag.chunk import LARGEST
from fdi_ros.bag.raw import NO_HORIZON, Batch, Damage, Topic
from fdi_ros.errors import BagError

_ROWS = 4096
"""Messages read at once."""
_LONGEST = 1 << 24
"""Bytes of a message at most: no message of a gyro comes near."""
Row = tuple[int, int, bytes]
"""Number of the topic, time of recording, message."""


class SqliteFile:
    """An open sqlite3 file.

    Parameters
    ----------
    path
        The file.
    damage
        Takes what cannot be read.
    compressed
        Each message is compressed by zstd by itself.

    Raises
    ------
    BagError
        If the file cannot be opened or is no rosbag2 database.
    """

    def __init__(self, path: Path, damage: Damage, compressed: bool = False) -> None:
        self.path = path
        self.damage = damage
        self.compressed = compressed
        if not path.is_file():
            raise BagError(f"cannot open {path}: no such file")
        if path.stat().st_size == 0:
            raise BagError(f"{path} is empty")
        try:
            self._base = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)
            self._base.text_factory = lambda data: data.decode("utf-8", "replace")
            rows = self._base.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
            start = self._base.execute("SELECT MIN(timestamp) FROM messages").fetchone()[0]
        except sqlite3.Error as error:
            raise BagError(f"{path} is not a readable rosbag2 database: {error}") from error
        self.start_time = start if isinstance(start, int) else NO_HORIZON
        counts = self._count()
        self._broken = False
        self._total = sum(counts.values())
        self._ids = {row[0]: str(row[1]) for row in rows}
        self.topics = tuple(Topic(str(row[1]), str(row[2]), str(row[3]), counts.get(row[0], 0)) for row in rows)

    def close(self) -> None:
        """Close the file."""
        self._base.close()

    def batches(self, topics: Sequence[str]) -> Iterator[Batch]:
        """Read the messages of the topics."""
        chosen = {number: topics.index(name) for number, name in self._ids.items() if name in topics}
        read, last = 0, -1
        # A damaged database may not be sorted by time any more and still be read in the order in which it was written.
        for order in ("timestamp", "id"):
            self._broken = False
            for rows in self._rows(tuple(chosen), last, order):
                read += len(rows)
                batch = self._batch(rows, chosen, min(1.0, read / max(1, self._total)))
                last = max(last, batch.horizon)
                yield batch
            if not self._broken:
                return

    def _rows(self, topics: tuple[int, ...], after: int, order: str) -> Iterator[list[Row]]:
        """Read messages in portions, up to the first that cannot be read."""
        which = f"topic_id IN ({','.join('?' * len(topics))}) AND timestamp > ? ORDER BY {order}"
        try:
            found = self._base.execute(
                f"SELECT topic_id, timestamp, data FROM messages WHERE {which}", (*topics, after)
            )
        except sqlite3.Error as error:
            self._note(error, order)
            return
        rows: list[Row] = []
        while not self._broken:
            try:
                # What was read before an error stays in the list.
                rows.extend(itertools.islice(found, _ROWS))
            except sqlite3.Error as error:
                self._note(error, order)
            if not rows:
                return
            yield rows
            rows = []

    def _note(self, error: sqlite3.Error, order: str) -> None:
        self._broken = True
        self.damage.add(f"{self.path.name} is damaged ({error}): not all messages could be read in order of {order}")

    def _count(self) -> dict[int, int]:
        """Return the number of messages of each topic; a damaged database may not say it and still be readable."""
        try:
            return dict(self._base.execute("SELECT topic_id, COUNT(*) FROM messages GROUP BY topic_id").fetchall())
        except sqlite3.Error as error:
            self.damage.add(f"{self.path.name} is damaged ({error}): its messages could not be counted")
            return {}

    def _batch(self, rows: list[Row], chosen: dict[int, int], progress: float) -> Batch:
        topics, times, data = zip(*rows, strict=True)
        if set(map(type, times)) != {int} or set(map(type, data)) != {bytes}:
            # Only a damaged database holds anything else.
            rows = [row for row in rows if isinstance(row[1], int) and isinstance(row[2], bytes)]
            topics, times, data = zip(*rows, strict=True) if rows else ((), (), ())
        if self.compressed:
            data = tuple(map(_unpacked, data))
        length = np.fromiter(map(len, data), dtype=np.int64, count=len(data))
        return Batch(
            buffer=np.frombuffer(b"".join(data), dtype=np.uint8),
            topic=np.fromiter(map(chosen.__getitem__, topics), dtype=np.int64, count=len(data)),
            log_time=np.array(times, dtype=np.int64),
            offset=np.cumsum(length) - length,
            length=length,
            horizon=times[-1] if times else 0,
            progress=progress,
        )


def _unpacked(data: bytes) -> bytes:
    """Decompress a message; a damaged one comes out empty, and is counted as malformed later."""
    try:
        return zstandard.ZstdDecompressor().stream_reader(data).read(min(_LONGEST, LARGEST))
    except zstandard.ZstdError:
        return b""
