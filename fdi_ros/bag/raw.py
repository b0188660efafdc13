# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What all storages have in common: files that are opened, topics, and batches of messages as they were sent."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from fdi_ros.arrays import Bytes, Int
from fdi_ros.errors import BagError
from fdi_ros.text import shown

MOST_SHOWN = 400
"""Characters of what is said of one place."""
NO_HORIZON = 2**63 - 1
"""Horizon of the last batch: nothing comes after it."""


@dataclass(frozen=True)
class Topic:
    """One topic of a recording."""

    name: str
    type: str
    encoding: str = "cdr"
    count: int = 0
    """Number of messages."""


@dataclass(frozen=True)
class Batch:
    """k messages of the topics asked for, in the order in which they lie in the file."""

    buffer: Bytes
    """The bytes that the messages lie in, (B,)."""
    topic: Int
    """(k,) index into the topics asked for."""
    log_time: Int
    """(k,) time of recording, ns."""
    offset: Int
    """(k,) first byte of the message in the buffer."""
    length: Int
    """(k,) bytes."""
    horizon: int
    """No later batch brings a message recorded before this, ns."""
    progress: float
    """Share of the recording read up to here, 0 to 1."""

    def __len__(self) -> int:
        return len(self.topic)

    def at(self, rows: NDArray[np.bool_]) -> Batch:
        """Return some of the messages; rows (k,) says which."""
        return replace(
            self,
            topic=self.topic[rows],
            log_time=self.log_time[rows],
            offset=self.offset[rows],
            length=self.length[rows],
        )

    def message(self, k: int) -> bytes:
        """Return the bytes of message k."""
        start = int(self.offset[k])
        return self.buffer[start : start + int(self.length[k])].tobytes()


def open_file(path: Path, magic: bytes, refusal: str) -> tuple[BinaryIO, int]:
    """Open a file that begins with some bytes, and read these; return it with its size, bytes.

    Raises
    ------
    BagError
        If it cannot be opened, is empty, or begins otherwise, for which the refusal is said.
    """
    try:
        file = path.open("rb")
    except OSError as error:
        raise BagError(f"cannot open {path}: {error.strerror}") from error
    begin = file.read(len(magic))
    if begin != magic:
        file.close()
        raise BagError(f"{path} {refusal}: it starts with {begin!r}" if begin else f"{path} is empty")
    return file, os.fstat(file.fileno()).st_size


@dataclass
class Damage:
    """What of a recording could not be read, one line per place."""

    lines: list[str] = field(default_factory=list)
    more: int = 0

    MOST = 20
    """Lines kept; the rest is counted."""

    def add(self, line: str) -> None:
        """Note one place, in words fit to be shown; a line already there is not repeated."""
        line = shown(line, MOST_SHOWN)
        if line in self.lines:
            return
        if len(self.lines) < self.MOST:
            self.lines.append(line)
        else:
            self.more += 1

    def __bool__(self) -> bool:
        return bool(self.lines)

    def report(self) -> tuple[str, ...]:
        """Return the lines, and the number of those that were too many."""
        return (*self.lines, *([f"{self.more} more places"] if self.more else []))
