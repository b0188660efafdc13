# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Common parts of all recordings: files, topics, and batches of raw messages."""

from __future__ import annotations

import difflib
import os
import re
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import lz4.frame
import numpy as np
import zstandard
from numpy.typing import NDArray

from fdi_ros.bag.flight_context import FlightContext
from fdi_ros.bag.recorder_clock import RecorderClock
from fdi_ros.errors import BagError
from fdi_ros.model.samples import Bytes, Int
from fdi_ros.system.files import RECORDING, open_regular
from fdi_ros.system.text import first_of, shown
from fdi_ros.system.yaml_file import read_yaml

#: characters shown about one place
MOST_SHOWN = 400
_COLUMNS = ("topic", "log_time", "offset", "length")
#: horizon of the last batch, after which nothing follows
NO_HORIZON = 2**63 - 1


@dataclass(frozen=True)
class Topic:
    """One topic of a recording."""

    #: full name, such as ``/imu_1/data_raw``
    name: str
    #: of the messages, such as ``sensor_msgs/msg/Imu``
    type: str
    #: of the messages, such as ``cdr`` or ``ros1``
    encoding: str = "cdr"
    #: number of messages
    count: int = 0


@dataclass(frozen=True)
class Batch:
    """k messages of the topics asked for, in the order in which they lie in the file."""

    #: the bytes that the messages lie in, (B,)
    buffer: Bytes
    #: (k,) index into the topics asked for
    topic: Int
    #: (k,) time of recording, ns
    log_time: Int
    #: (k,) first byte of the message in the buffer
    offset: Int
    #: (k,) bytes
    length: Int
    #: no later batch brings a message recorded before this, ns
    horizon: int
    #: share of the recording read up to here, 0 to 1
    progress: float

    def __len__(self) -> int:
        return len(self.topic)

    def at(self, rows: NDArray[np.bool_]) -> Batch:
        """Return the messages selected by rows (k,)."""
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
        begins = np.cumsum([0, *sizes[:-1]])
        columns["offset"] += np.repeat(begins, [len(part) for part in parts])
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


#: first bytes of a message that was compressed by itself, as zstd or LZ4; no plain message
#: begins like that
PACKED = (zstandard.FRAME_HEADER, b"\x04\x22\x4d\x18")


def unpack_message(data: bytes, most: int) -> bytes:
    """Unpack a message that is a zstd or LZ4 frame, to at most this many bytes.

    A damaged frame gives no bytes, which decoding counts as malformed.
    """
    most = max(most, 0)
    try:
        if data.startswith(zstandard.FRAME_HEADER):
            return zstandard.ZstdDecompressor().stream_reader(data).read(most)
        unpacked: bytes = lz4.frame.LZ4FrameDecompressor().decompress(
            data, max_length=most
        )
    except (zstandard.ZstdError, RuntimeError, MemoryError):
        return b""
    return unpacked


MUCH_LOST = 0.01
"""Share of a flight log that is more than records cut off at its end."""


@dataclass
class Damage:
    """Unreadable parts of a recording, one line per place, and facts beside them."""

    #: what readers must know, and is no damage
    facts: list[str] = field(default_factory=list)
    #: one sentence for each place, at most `MOST`
    lines: list[str] = field(default_factory=list)
    #: number of further places
    more: int = 0

    #: gyros that cannot be read as such, and why
    left_out: list[tuple[str, str]] = field(default_factory=list)

    #: whether messages of the recording are missing
    lost: bool = False
    #: whether a file ends before the recorder closed it, as where the power goes
    cut_off: bool = False
    #: whether the recorder wrote the metadata, which it does last: then no file ends early
    closed: bool = False

    #: lines kept, while further ones are only counted
    MOST = 20

    def add(self, line: str) -> None:
        """Note one place, escaped for display. Repeated lines are dropped."""
        line = shown(line, MOST_SHOWN)
        if line in self.lines:
            return
        if len(self.lines) < self.MOST:
            self.lines.append(line)
        else:
            self.more += 1

    def lose(self, line: str) -> None:
        """Note a place where messages are missing."""
        self.lost = True
        self.add(line)

    def __bool__(self) -> bool:
        return bool(self.lines)

    def state(self, fact: str) -> None:
        """Note a fact, escaped for display, once."""
        line = shown(fact, MOST_SHOWN)
        if line not in self.facts and len(self.facts) < self.MOST:
            self.facts.append(line)

    def losses(self) -> tuple[str, ...]:
        """Return the lines, and the number of dropped ones."""
        return (*self.lines, *([f"{self.more} more places"] if self.more else []))

    def report(self) -> tuple[str, ...]:
        """Return the facts, the lines, and the number of dropped ones."""
        return (*self.facts, *self.losses())


class LogText(NamedTuple):
    """A text of the autopilot in a flight log."""

    #: time of recording, ns; us of the samples while the log is being read
    stamp: int
    #: logged message (MSG, ERR) or severity
    kind: str
    #: as the autopilot wrote it
    text: str


class BagFile(ABC):
    """One open file of a recording, which may unpack to ``most`` bytes.

    Damage is noted in ``damage``. `BagError` if the file cannot be opened, is empty, or
    does not begin with `magic`.
    """

    #: first bytes of a file
    magic: ClassVar[bytes]
    #: refusal of a file that begins otherwise
    refusal: ClassVar[str]
    #: one that several publishers wrote may come several times
    topics: tuple[Topic, ...]
    #: time of the first message, ns, or `NO_HORIZON`
    start_time: int
    #: time of the last message of a file that may be a part of a recording, ns
    end_time: int = 0
    texts: tuple[LogText, ...] = ()
    #: temperatures, throttle, flight modes
    context: FlightContext = FlightContext()
    #: serial number of the board of the autopilot, empty if the file has none
    hardware_id: str = ""
    #: MAVLink system of the autopilot, None if the file has none
    system: int | None = None

    def __init__(self, path: Path, damage: Damage, most: int) -> None:
        self.path = path
        self._damage = damage
        self._left = most
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
            head = begin[: len(self.magic)]
            text = " ".join(head.decode("utf-8", "replace").split())
            is_text = head.isascii() and text.isprintable()
            what = f"the text {text!r}" if is_text else f"the bytes {head.hex(' ')}"
            refusal = f"{self.refusal}: it starts with {what}"
        self.file.close()
        raise BagError(f"{path} {refusal}")

    @abstractmethod
    def batches(self, topics: Sequence[str], clock: RecorderClock) -> Iterator[Batch]:
        """Read the messages of the topics. The clock follows their times of recording."""

    def note(self, line: str) -> None:
        """Note damage."""
        self._damage.add(f"{self.path.name}: {line}")

    def lose(self, line: str) -> None:
        """Note damage in which messages are missing."""
        self._damage.lose(f"{self.path.name}: {line}")

    def break_off(self, line: str) -> None:
        """Note that the file ends before it was closed, or was cut off later."""
        if self._damage.closed:
            self._damage.lost = True
        else:
            self._damage.cut_off = True
        self.note(line)

    def leave_bytes(self, count: int) -> None:
        """Note bytes that belong to no record. The last record of a log is seldom whole."""
        much = count > MUCH_LOST * self.size
        note = self.lose if much else self.note
        note(f"{count} bytes belong to no whole record and were left out")

    def state(self, fact: str) -> None:
        """Note a fact that readers must know."""
        self._damage.state(f"{self.path.name}: {fact}")

    def leave_out(self, names: str, why: str) -> None:
        """Note gyros that cannot be read as such."""
        one = (shown(names), why)
        if (
            one not in self._damage.left_out
            and len(self._damage.left_out) < Damage.MOST
        ):
            self._damage.left_out.append(one)

    def close(self) -> None:
        """Close the file."""
        self.file.close()


SUFFIXES = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")
TABLE_SUFFIXES = (".csv", ".tsv")
LOG_SUFFIXES = (".bin", ".ulg", ".ulog", ".tlog", ".bag", *TABLE_SUFFIXES)
"""Suffixes, in any case, of flight logs, tables and ROS 1 bags: single-file recordings."""
EXPECTED = (
    "a rosbag2 folder, a .mcap, .db3, .bag, .csv, .tsv, .bin, .ulg, .ulog or .tlog file"
)
#: first bytes of the placeholder that git-lfs leaves for a large file
LFS = b"version https://git-lfs."
#: key in the custom data of the metadata.yaml of an output bag
MADE_BY_FDI = "fdi_ros"
MOST_BESIDE = 4096
"""Files and folders beside a missing recording that are looked at for a similar name."""


def _nearly(path: Path) -> str:
    """Return a hint if a file or folder beside a missing one has nearly its name."""
    with suppress(OSError, ValueError), os.scandir(path.parent) as found:
        beside = [one.name for one in islice(found, MOST_BESIDE)]
        names = [
            name
            for name in beside
            if name.lower().endswith((*SUFFIXES, *LOG_SUFFIXES)) or "." not in name
        ]
        if close := difflib.get_close_matches(path.name[:255], names, 1, 0.75):
            return f", did you mean {shown(str(path.parent / close[0]))}?"
    return ""


def find_files(path: Path, damage: Damage) -> tuple[Path, ...]:
    """Find the files of a recording, which is a folder or a file.

    ``damage`` receives the defects of metadata.yaml. `BagError` if nothing is found.
    """
    if path.is_file():
        if not path.name.endswith(SUFFIXES) and not path.name.lower().endswith(
            LOG_SUFFIXES
        ):
            raise BagError(f"{path} is not a recording: expected {EXPECTED}")
        return (path,)
    if not path.is_dir():
        raise BagError(f"no recording at {path}{_nearly(path)}")
    if tables := tables_of(path):
        return tables[: RECORDING.files]
    about = _metadata(path, damage)
    damage.closed = bool(about)
    # One that is named twice is read once.
    names = dict.fromkeys(str(name) for name in about.get("relative_file_paths") or [])
    there = [name for name in names if os.path.isfile(path / name)]
    for name in names.keys() - set(there):
        damage.lose(f"{Path(name).name} is named in metadata.yaml and not there")
    # metadata.yaml is written last. Without it, numbers in the names give the order.
    paths = [path / name for name in there]
    if not paths:
        paths = _pieces_of_one(path)
    if not paths:
        logs = any(
            child.is_file() and child.name.lower().endswith(LOG_SUFFIXES)
            for child in path.iterdir()
        )
        more = ": name one of its flight logs, or run fdi fleet on it" if logs else ""
        raise BagError(
            f"{path} is a folder without .mcap, .db3, .csv or .tsv files{more}"
        )
    if len(paths) > RECORDING.files:
        damage.add(
            f"{len(paths)} files, expected at most {RECORDING.files}: the others were left out"
        )
    return tuple(paths[: RECORDING.files])


def _pieces_of_one(folder: Path) -> list[Path]:
    """Return the files of a bag that was cut off, in the order of the numbers in their names.

    `BagError` if the names, without these numbers, are those of several recordings, or if
    there are logs or tables beside them.
    """
    paths = [
        child
        for child in folder.iterdir()
        if child.is_file() and child.name.endswith(SUFFIXES)
    ]
    paths.sort(key=lambda child: natural_order(child.name))
    stems = {name_of_recording(path) for path in paths}
    others = [
        child
        for child in folder.iterdir()
        if paths and child.is_file() and child.name.lower().endswith(LOG_SUFFIXES)
    ]
    several = len(stems) > 1 or others
    if several and not (folder / "metadata.yaml").exists():
        found = [shown(path.name) for path in (*paths, *sorted(others))]
        names = first_of(found, most=4)
        raise BagError(
            f"{folder} holds several recordings ({names}): name one of them, or run fdi fleet"
            " on the folder"
        )
    return paths


def name_of_recording(path: Path) -> str:
    """Return the name of a file without its suffixes and its number in the recording."""
    return re.sub(r"[_-]?[0-9]*$", "", path.name.partition(".")[0])


def tables_of(folder: Path) -> tuple[Path, ...]:
    """Return the tables (.csv, .tsv) of a folder without a bag, by name."""
    names = sorted(os.listdir(folder), key=natural_order)
    if any(name == "metadata.yaml" or name.endswith(SUFFIXES) for name in names):
        return ()
    tables = [folder / name for name in names if name.lower().endswith(TABLE_SUFFIXES)]
    return tuple(one for one in tables if one.is_file())


def natural_order(name: str) -> list[int | str]:
    """Return a key by which names sort, their numbers by value."""
    return [
        int(part) if part.isdecimal() else part for part in re.split(r"([0-9]+)", name)
    ]


def is_made_by_fdi(folder: Path) -> bool:
    """Whether fdi wrote this rosbag2 folder."""
    custom = _metadata(folder, Damage()).get("custom_data")
    return isinstance(custom, dict) and MADE_BY_FDI in custom


def files_of_bag(folder: Path) -> tuple[Path, ...] | None:
    """Return the files of a rosbag2 folder, empty if lost, None for other folders.

    Other programs write metadata.yaml, too, so recordings must be present.
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
