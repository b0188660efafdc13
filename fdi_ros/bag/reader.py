# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A recording of any format, and its conversion to a bag.

Damaged recordings are read as far as possible.
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import zstandard

from fdi_ros import __version__
from fdi_ros.bag.csv_file import CsvLog, CsvUnit, is_table_of_gyros, unit_numbers
from fdi_ros.bag.dataflash import DataflashLog
from fdi_ros.bag.flight_context import FlightContext
from fdi_ros.bag.mcap_file import McapFile
from fdi_ros.bag.raw import (
    MADE_BY_FDI,
    NO_HORIZON,
    BagFile,
    Batch,
    Damage,
    LogText,
    Topic,
    find_files,
    name_of_recording,
    natural_order,
    tables_of,
)
from fdi_ros.bag.recorder_clock import RecorderClock
from fdi_ros.bag.ros1_file import Ros1File
from fdi_ros.bag.sqlite_file import SqliteFile
from fdi_ros.bag.tlog import Tlog
from fdi_ros.bag.ulog import Ulog
from fdi_ros.config.config import is_topic
from fdi_ros.core.sources import SOURCES, source_of_type
from fdi_ros.errors import BagError
from fdi_ros.monitor.inputs import other_input
from fdi_ros.system.files import (
    RECORDING,
    TIMES,
    max_unpacked_bytes,
    open_regular,
    scratch_folder,
)
from fdi_ros.system.text import did_you_mean, figures, shown

FORMATS: dict[str, type[BagFile]] = {
    ".mcap": McapFile,
    ".db3": SqliteFile,
    ".bag": Ros1File,
    ".bin": DataflashLog,
} | {
    ".csv": CsvLog,
    ".tsv": CsvLog,
    ".tlog": Tlog,
    ".ulg": Ulog,
    ".ulog": Ulog,
}
"""By the suffix of a file, in small letters."""


def _number_in_recording(file: BagFile) -> list[int | str]:
    """Return a key by which the files of one recorder sort in the order of writing."""
    return natural_order(file.path.name)


def _hint(name: str, type_name: str, topics: Sequence[tuple[str, str]]) -> str:
    """Return which topic of a recording was meant instead of one that is not there.

    ``topics``: name and type of each topic of the recording.
    """
    each = [f"{shown(one)} ({shown(kind)})" for one, kind in topics]
    listed = ", ".join(each)
    alike = [one for one, kind in topics if kind == type_name]
    is_near = alike and did_you_mean(name, alike).startswith("did")
    if not is_near and (other := other_input(type_name, topics)):
        return f", but {other}"
    choices = alike if is_near else [one for one, _ in topics]
    meant, found, _ = did_you_mean(name, choices).partition("?")
    return f"{f', {meant}? It has' if found else ', it has'}: {listed or 'none at all'}"


class _FileWalk:
    """The batches of one file, and how far they have come."""

    def __init__(
        self, file: BagFile, topics: Sequence[str], clock: RecorderClock
    ) -> None:
        self._batches = file.batches(topics, clock)
        self.clock = clock
        self.horizon = file.start_time  #: no later batch has an earlier message, ns
        self.progress = 0.0  #: share of the file read so far
        self.done = False

    def take(self) -> Batch | None:
        """Return the next batch, or None at the end of the file."""
        batch = next(self._batches, None)
        self.done = batch is None
        self.horizon = NO_HORIZON if batch is None else batch.horizon
        self.progress = 1.0 if batch is None else batch.progress
        return batch


class Recording:
    """An open recording, to be closed or used in a with statement.

    ``path``: rosbag2 folder, folder of tables, or a file: .mcap, .db3, .bag (ROS 1),
    .csv, .tsv, .bin (ArduPilot), .ulg (PX4) or .tlog (ground stations). `BagError` if nothing
    readable is found.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.damage = Damage()
        self._left = 0  # bytes that may still be unpacked
        self._scratch = contextlib.ExitStack()
        self._unpacked: Path | None = None  #: folder of files that were unpacked
        self._files: list[BagFile] = []
        paths = find_files(self.path, self.damage)
        try:
            self._left = max_unpacked_bytes(sum(path.stat().st_size for path in paths))
            self._open_all(paths)
        except BaseException:  # Close the files whatever ends the opening.
            self.close()
            raise
        #: whether one recorder wrote the files one after the other
        self._is_split = self._is_one_recording()
        if self._is_split:
            self._files.sort(key=_number_in_recording)
        else:
            self._files.sort(key=lambda file: file.start_time)

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the files and remove unpacked ones."""
        for file in self._files:
            file.close()
        self._scratch.close()

    @property
    def topics(self) -> tuple[Topic, ...]:
        """The topics of all files, each once, with the sum of their messages, by name."""
        merged: dict[str, Topic] = {}
        for file in self._files:
            for topic in file.topics:
                if len(merged) == RECORDING.topics and topic.name not in merged:
                    self.damage.add(
                        f"more than {RECORDING.topics} topics: the others were left out"
                    )
                    break
                before = merged.get(topic.name)
                count = topic.count + (before.count if before else 0)
                merged[topic.name] = replace(before or topic, count=count)
        return tuple(merged[name] for name in sorted(merged, key=natural_order))

    @property
    def texts(self) -> tuple[LogText, ...]:
        """Texts of the autopilot in a flight log, in order, with times of recording, ns."""
        return tuple(sorted(text for file in self._files for text in file.texts))

    @property
    def context(self) -> FlightContext:
        """Temperatures, throttle and flight modes of a flight log."""
        found = [file.context for file in self._files if file.context.origins]
        if not found:
            return FlightContext()
        # Of a folder of tables each names one IMU.
        origins = {
            name: one for context in found for name, one in context.origins.items()
        }
        return replace(found[0], origins=origins)

    @property
    def hardware_id(self) -> str:
        """Serial number of the board of the autopilot, empty if no file has one."""
        return next((file.hardware_id for file in self._files if file.hardware_id), "")

    @property
    def system(self) -> int | None:
        """MAVLink system of the autopilot, None if no file has one."""
        return next((file.system for file in self._files if file.system), None)

    def require(self, names: Sequence[str], type_name: str) -> None:
        """Check that topics exist with this type and CDR encoding (`BagError`)."""
        there = {topic.name: topic for topic in self.topics}
        kinds = [(one.name, one.type) for one in there.values()]
        for name in names:
            topic = there.get(name) or there.get(f"/{name}")
            if topic is None:
                raise BagError(
                    f"{self.path} has no topic {name!r}{_hint(name, type_name, kinds)}"
                )
            called = f"topic {name!r} in {self.path}"
            if topic.type != type_name:
                other = other_input(type_name, kinds)
                raise BagError(
                    f"{called} is {shown(topic.type) or 'untyped'}, expected {type_name}"
                    f"{other and f'; the recording has {other}'}"
                )
            if topic.encoding != "cdr":
                raise BagError(
                    f"{called} is serialised as {shown(topic.encoding)!r}, expected 'cdr'"
                )

    def batches(self, names: Sequence[str]) -> Iterator[Batch]:
        """Read the messages of topics, all files in the order of time."""
        there = {topic.name for topic in self.topics}
        topics = [name if name in there else f"/{name}" for name in names]
        of_recorder = RecorderClock()
        walks = [
            _FileWalk(file, topics, of_recorder if self._is_split else RecorderClock())
            for file in self._files
        ]
        while going := [walk for walk in walks if not walk.done]:
            # Files of one time are read together: the one that is farthest behind goes on.
            walk = (
                going[0] if self._is_split else min(going, key=lambda one: one.horizon)
            )
            batch = walk.take()
            if batch is None:
                walk.clock.begin_file()
                continue
            if back := walk.clock.set_back:
                self.damage.state(
                    f"the clock of the recorder was set back by {figures(back * 1e-9)} s:"
                    " the messages were taken in the order in which they were written"
                )
            batch = replace(
                batch,
                progress=sum(walk.progress for walk in walks) / len(walks),
                horizon=min(walk.horizon for walk in walks),
            )
            possible = (batch.log_time >= 0) & (batch.log_time <= TIMES.latest)
            if not possible.all():
                self.damage.add(
                    "messages recorded before 1970 or after 2038, by their times, were left out"
                )
                batch = batch.at(possible)
            yield batch

    def _is_one_recording(self) -> bool:
        """Whether one recorder of ROS 2 wrote the files one after the other.

        They have one name and numbers, and some gyros are in all that are not empty. Files of
        several recorders at the same time have other topics each.
        """
        of_ros2 = all(isinstance(one, (McapFile, SqliteFile)) for one in self._files)
        names = {name_of_recording(one.path) for one in self._files}
        gyros = [
            {one.name for one in file.topics if source_of_type(one.type) is not None}
            for file in self._files
            if file.end_time
        ]
        shared = set.intersection(*gyros) if gyros else set()
        return of_ros2 and len(names) == 1 and bool(shared)

    def _open_all(self, paths: Sequence[Path]) -> None:
        """Open the files. A folder of tables holds one IMU in each.

        `BagError` if none can be opened.
        """
        if self.path.is_dir() and paths == tables_of(self.path):
            tables = [path for path in paths if is_table_of_gyros(path)]
            for path in sorted(set(paths) - set(tables)) if tables else ():
                self.damage.add(f"{path.name}: no columns of gyros, left out")
            tables = tables or list(paths)
            for path, number in zip(tables, unit_numbers(tables), strict=True):
                self._files.append(CsvUnit(path, self.damage, self._left, number))
            return
        refused = [error for path in paths if (error := self._open(path)) is not None]
        if not self._files:
            raise refused[0]

    def _open(self, path: Path) -> BagError | None:
        """Open a file. An error is noted and returned, and the other files are still read."""
        try:
            plain = self._unpack(path) if path.suffix == ".zstd" else path
            # metadata.yaml may name files of any suffix.
            kind = FORMATS.get(plain.suffix.lower(), SqliteFile)
            self._files.append(kind(plain, self.damage, self._left))
        except BagError as error:
            self.damage.lose(str(error))
            return error
        return None

    def _unpack(self, path: Path) -> Path:
        """Unpack a file compressed as a whole into a temporary folder."""
        if self._unpacked is None:
            self._unpacked = self._scratch.enter_context(scratch_folder("fdi_bag"))
        # Files of the same name may lie in different folders.
        plain = self._unpacked / str(len(self._files)) / path.stem
        plain.parent.mkdir(exist_ok=True)
        most = min(self._left, shutil.disk_usage(plain.parent).free // 2)
        try:
            with open_regular(path) as packed, plain.open("wb") as out:
                for data in zstandard.ZstdDecompressor().read_to_iter(packed):
                    most -= out.write(data)
                    if most < 0:
                        self.damage.add(
                            f"{path.name} unpacks to more than it should: read as far as it may"
                        )
                        break
        except (OSError, zstandard.ZstdError) as error:
            if not plain.exists() or plain.stat().st_size == 0:
                raise BagError(f"{path} cannot be unpacked: {error}") from error
            self.damage.lose(
                f"{path.name} cannot be unpacked to its end ({error}): read as far as it goes"
            )
        self._left = max(0, self._left - plain.stat().st_size)
        return plain


def convert(
    recording: Recording, path: Path, progress: Callable[[float], None]
) -> dict[str, int]:
    """Copy the messages of possible gyros into a new bag, byte for byte.

    ``path``: folder to create. ``progress`` receives the share done, 0 to 1. Returns
    the number of messages of each topic. `BagError` if no topic may hold gyros.
    """
    # Only conversion needs the writer.
    from rosbags.rosbag2 import (
        CompressionFormat,
        CompressionMode,
        StoragePlugin,
        Writer,
    )
    from rosbags.typesys import Stores, get_typestore

    topics = [
        topic
        for topic in recording.topics
        if source_of_type(topic.type) is not None
        and topic.encoding == "cdr"
        and is_topic(topic.name)
    ]
    if not topics:
        types = " or ".join(kind.type for kind in SOURCES.values())
        raise BagError(f"{recording.path} has no topic of {types}")
    store = get_typestore(Stores.ROS2_JAZZY)
    writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    # This mark allows a later run to replace the bag.
    writer.set_custom_data(MADE_BY_FDI, __version__)
    with writer:
        connections = [
            writer.add_connection(topic.name, topic.type, typestore=store)
            for topic in topics
        ]
        counts = [0] * len(topics)
        for batch in recording.batches([topic.name for topic in topics]):
            for k, (topic, log_time) in enumerate(
                zip(batch.topic.tolist(), batch.log_time.tolist(), strict=True)
            ):
                writer.write(connections[topic], log_time, batch.message(k))
                counts[topic] += 1
            progress(batch.progress)
    return {topic.name: count for topic, count in zip(topics, counts, strict=True)}
