# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What all recordings have in common: their files, topics, and batches of messages as they were sent."""

from __future__ import annotations

import os
import re
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import zstandard
from numpy.typing import NDArray

from fdi_ros.errors import BagError
from fdi_ros.model.samples import Bytes, Int
from fdi_ros.system.files import FILES, open_regular
from fdi_ros.system.text import shown
from fdi_ros.system.yaml_file import read_yaml

MOST_SHOWN = 400  # characters of what is said of one place
_COLUMNS = ("topic", "log_time", "offset", "length")
NO_HORIZON = 2**63 - 1  # horizon of the last batch: nothing comes after it


@dataclass(frozen=True)
class Topic:
    """One topic of a recording."""

    name: str
    type: str
    encoding: str = "cdr"
    count: int = 0  # number of messages


@dataclass(frozen=True)
class Batch:
    """k messages of the topics asked for, in the order in which they lie in the file."""

    buffer: Bytes  # the bytes that the messages lie in, (B,)
    topic: Int  # (k,) index into the topics asked for
    log_time: Int  # (k,) time of recording, ns
    offset: Int  # (k,) first byte of the message in the buffer
    length: Int  # (k,) bytes
    horizon: int  # no later batch brings a message recorded before this, ns
    progress: float  # share of the recording read up to here, 0 to 1

    def __len__(self) -> int:
        return len(self.topic)

    def at(self, rows: NDArray[np.bool_]) -> Batch:
        """Return some of the messages; rows (k,) says which."""
        columns: dict[str, Any] = {name: getattr(self, name)[rows] for name in _COLUMNS}
        return replace(self, **columns)

    @classmethod
    def joined(cls, parts: Sequence[Batch]) -> Batch:
        """Return the messages of several batches, with horizon and progress of the last."""
        if len(parts) == 1:
            return parts[0]
        columns: dict[str, Any] = {
            name: np.concatenate([getattr(part, name) for part in parts])
            for name in ("buffer", *_COLUMNS)
        }
        sizes = [len(part.buffer) for part in parts]
        columns["offset"] += np.repeat(
            np.cumsum([0, *sizes[:-1]]), [len(part) for part in parts]
        )
        return replace(parts[-1], **columns)

    def message(self, k: int) -> bytes:
        """Return the bytes of message k."""
        start = int(self.offset[k])
        return self.buffer[start : start + int(self.length[k])].tobytes()


def starts_with(batch: Batch, head: bytes) -> NDArray[np.bool_]:
    """Return which of the k messages of a batch begin with some bytes, (k,)."""
    size = len(head)
    found = batch.length >= size
    rows = np.flatnonzero(found)
    first = batch.buffer[batch.offset[rows, None] + np.arange(size)]
    found[rows] = (first == np.frombuffer(head, np.uint8)).all(axis=1)
    return found


def unpack_message(data: bytes, most: int) -> bytes:
    """Unpack a message that is a zstd frame, to at most so many bytes.

    A damaged one comes out empty, and is counted as malformed when it is decoded.
    """
    try:
        return zstandard.ZstdDecompressor().stream_reader(data).read(max(most, 0))
    except (zstandard.ZstdError, MemoryError):
        return b""


@dataclass
class Damage:
    """What of a recording could not be read, one line per place."""

    lines: list[str] = field(default_factory=list)
    more: int = 0

    MOST = 20  # lines kept; the rest is counted

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


class LogText(NamedTuple):
    """What the autopilot of a flight log said of itself."""

    stamp: int  # time of recording, ns; while the log is read, us as of its samples
    kind: str  # message it was logged in: MSG, ERR, or the severity
    text: str


class BagFile(ABC):
    """One open file of a recording, which may unpack to ``most`` bytes; ``damage`` takes what cannot be read of it.

    `BagError` if it cannot be opened, is empty, or does not begin with `magic`.
    """

    magic: ClassVar[bytes]  # first bytes of a file
    refusal: ClassVar[str]  # what is said of a file that begins with others
    topics: tuple[
        Topic, ...
    ]  # one that several publishers wrote may come several times
    start_time: (
        int  # time of recording of the first message, ns; without messages `NO_HORIZON`
    )
    texts: tuple[LogText, ...] = ()

    def __init__(self, path: Path, damage: Damage, most: int) -> None:
        self.path, self._damage, self._left = path, damage, most
        try:
            self.file = open_regular(path)
        except OSError as error:
            raise BagError(f"cannot open {path}: {error.strerror}") from error
        self.size = os.fstat(self.file.fileno()).st_size
        begin = self.file.read(max(len(LFS), len(self.magic)))
        if begin == LFS:
            refusal = "is a git-lfs pointer, not the recording: run git lfs pull"
        elif not begin:
            refusal = "is empty"
        elif begin.startswith(self.magic):
            return
        else:
            refusal = f"{self.refusal}: it starts with {begin[: len(self.magic)]!r}"
        self.file.close()
        raise BagError(f"{path} {refusal}")

    @abstractmethod
    def batches(self, topics: Sequence[str]) -> Iterator[Batch]:
        """Read the messages of the topics."""

    def note(self, line: str) -> None:
        """Note what cannot be read, or what a reader must know."""
        self._damage.add(f"{self.path.name}: {line}")

    def close(self) -> None:
        """Close the file."""
        self.file.close()


SUFFIXES = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")
LOG_SUFFIXES = (".bin", ".ulg", ".ulog", ".tlog", ".csv", ".bag")
"""Of flight logs, tables and bags of ROS 1, in capitals too: each is a recording of its own, never part of a folder."""
EXPECTED = (
    "a rosbag2 folder, a .mcap, .db3, .bag, .csv, .bin, .ulg, .ulog or .tlog file"
)
LFS = b"version https://git-lfs."  # what a file begins with that git has put in the place of a large one
MADE_BY_FDI = "fdi_ros"  # key in the custom data of the metadata.yaml of an output bag


def find_files(path: Path, damage: Damage) -> tuple[Path, ...]:
    """Find the files of a recording, a folder or a file; ``damage`` takes what is wrong with metadata.yaml.

    `BagError` if there is no recording.
    """
    if path.is_file():
        if not path.name.endswith(SUFFIXES) and not path.name.lower().endswith(
            LOG_SUFFIXES
        ):
            raise BagError(f"{path} is not a recording: expected {EXPECTED}")
        return (path,)
    if not path.is_dir():
        raise BagError(f"no recording at {path}")
    if tables := tables_of(path):
        return tables[:FILES]
    about = _metadata(path, damage)
    # One that is named twice is read once.
    names = dict.fromkeys(str(name) for name in about.get("relative_file_paths") or [])
    there = [name for name in names if os.path.isfile(path / name)]
    for name in names.keys() - set(there):
        damage.add(f"{Path(name).name} is named in metadata.yaml and not there")
    # Without metadata.yaml (it is written at the end of a recording) the numbers in the names give the order.
    paths = [path / name for name in there] or sorted(
        (
            child
            for child in path.iterdir()
            if child.is_file() and child.name.endswith(SUFFIXES)
        ),
        key=lambda child: natural_order(child.name),
    )
    if not paths:
        raise BagError(f"{path} is a folder without .mcap, .db3 or .csv files")
    if len(paths) > FILES:
        damage.add(
            f"{len(paths)} files, expected at most {FILES}: the others were left out"
        )
    return tuple(paths[:FILES])


def tables_of(folder: Path) -> tuple[Path, ...]:
    """Return the tables (.csv) of a folder that holds no bag, by name; empty: it has none."""
    names = sorted(os.listdir(folder), key=natural_order)
    if any(name == "metadata.yaml" or name.endswith(SUFFIXES) for name in names):
        return ()
    tables = [folder / name for name in names if name.lower().endswith(".csv")]
    return tuple(one for one in tables if one.is_file())


def natural_order(name: str) -> list[int | str]:
    """Return a key by which names sort, their numbers by value."""
    return [
        int(part) if part.isdecimal() else part for part in re.split(r"([0-9]+)", name)
    ]


def is_made_by_fdi(folder: Path) -> bool:
    """Whether a rosbag2 folder is one that fdi has written."""
    custom = _metadata(folder, Damage()).get("custom_data")
    return isinstance(custom, dict) and MADE_BY_FDI in custom


def files_of_bag(folder: Path) -> tuple[Path, ...] | None:
    """Return the files of a rosbag2 folder, none if they are lost; None: it is another folder.

    Other programs call their files metadata.yaml, too: without recordings such a folder is another one.
    """
    if not (folder / "metadata.yaml").is_file():
        return None
    try:
        return find_files(folder, Damage())
    except BagError:
        return () if _metadata(folder, Damage()) else None


def _metadata(folder: Path, damage: Damage) -> dict[str, Any]:
    path = folder / "metadata.yaml"
    if not path.exists():
        damage.add(
            "there is no metadata.yaml: the recording was cut off, the files were read without it"
        )
        return {}
    try:
        document = read_yaml(path, "file", BagError)
    except BagError as error:
        damage.add(
            f"metadata.yaml is damaged: the files were taken in the order of their names ({shown(error)})"
        )
        return {}
    about = (
        document.get("rosbag2_bagfile_information")
        if isinstance(document, dict)
        else None
    )
    if isinstance(about, dict) and isinstance(
        about.get("relative_file_paths") or [], list
    ):
        return about
    damage.add(
        "metadata.yaml is damaged: the files were taken in the order of their names"
    )
    return {}
