# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Bags of ROS 1 (.bag), read by rosbags.

A bag that was not closed has no index and is refused. rosbags keeps one object per
message of a bag, whatever its topic, so both the index and the amount unpacked at once
are bounded. Messages are converted to those of ROS 2.
"""

from __future__ import annotations

import bz2
import io
import struct
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import lz4.frame
import numpy as np
from rosbags.rosbag1 import Reader, ReaderError
from rosbags.rosbag1.reader import IndexData
from rosbags.serde import SerdeError

from fdi_ros.bag.library_bag import LibraryBag, Message
from fdi_ros.bag.raw import Damage, Topic
from fdi_ros.bag.recorder_clock import RecorderClock
from fdi_ros.bag.ros1_message import converted_from_ros1
from fdi_ros.errors import BagError
from fdi_ros.system.files import LOGS, RECORDING

_ROS1_ERRORS = (
    *(ReaderError, SerdeError, struct.error, AssertionError, LookupError, ValueError),
    *(EOFError, OSError, RuntimeError, MemoryError, RecursionError),
)
"""Exceptions of rosbags and of the unpacking libraries for a damaged bag."""
_UNPACKERS = {
    bz2.decompress: bz2.BZ2Decompressor,
    lz4.frame.decompress: lz4.frame.LZ4FrameDecompressor,
}
"""By the functions that rosbags takes, which have no bound."""


class _Bounded(io.BufferedReader):
    """A file that limits the bytes read in total and at once."""

    left = LOGS.ros1_index_bytes

    def read(self, size: int | None = -1, /) -> bytes:
        """Read at most this many bytes."""
        self.left -= size or 0
        if self.left < 0 or (size or 0) > RECORDING.portion_bytes:
            raise ReaderError(
                "its index, or a part of it, is larger than that of any recorder"
            )
        return super().read(size)


class _Written(IndexData):
    """An entry of an index, in the order in which messages were written."""

    def __lt__(self, other: tuple[int, ...]) -> bool:
        """Compare by place in the file."""
        return self[1:] < other[1:]


class Ros1File(LibraryBag):
    """An open ROS 1 bag with an index of bounded size."""

    magic = b"#ROSBAG V2.0\n"
    refusal = "is not a bag of ROS 1"

    def __init__(self, path: Path, damage: Damage, most: int) -> None:
        super().__init__(path, damage, most)
        bounded = _Bounded(io.FileIO(self.file.fileno(), closefd=False))
        bounded.seek(0)
        # Stands for the path of a file that is open already.
        place: Any = SimpleNamespace(exists=lambda: True, open=lambda _: bounded)
        self._reader = Reader(place)
        try:
            self._reader.open()
            self._numbered = {
                one.id: Topic(one.topic, one.msgtype, "cdr", one.msgcount)
                for one in self._reader.connections
            }
            self.start_time = self._reader.start_time
        except _ROS1_ERRORS as error:
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
            self._take_in_order_of_writing(numbers)
            connections = [one for one in self._reader.connections if one.id in numbers]
            for connection, time, data in self._reader.messages(connections):
                message = converted_from_ros1(data, connection.msgtype)
                yield connection.id, time, message
        except _ROS1_ERRORS as error:
            self.lose(f"it is damaged ({error}): read up to there")

    def _take_in_order_of_writing(self, numbers: Sequence[int]) -> None:
        """Order the messages of topics by their places if the clock of the recorder was set back."""
        indexes = self._reader.indexes
        by_place = {
            number: sorted(map(_Written._make, indexes[number])) for number in numbers
        }
        clock = RecorderClock()
        for number, entries in by_place.items():
            times = np.array([one.time for one in entries], dtype=np.int64)
            clock.follow(np.full(len(times), number), times)
        if clock.set_back:
            for number, entries in by_place.items():
                indexes[number] = list(entries)

    def _unpacked(self, unpacker: Callable[[], Any] | None, data: bytes) -> bytes:
        """Unpack a chunk."""
        if unpacker is not None:
            data = unpacker().decompress(data, RECORDING.chunk_bytes)
        self._left -= len(data)
        if self._left < 0:
            raise ReaderError("it comes to more bytes than it should")
        return data
