"""A recording: a rosbag2 folder with one or several files, or one bare file; damaged, it is read as far as it goes."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any

import yaml
import zstandard

from fdi_ros.bag.mcap_file import McapFile
from fdi_ros.bag.raw import Batch, Damage, Topic
from fdi_ros.bag.sqlite_file import SqliteFile
from fdi_ros.errors import BagError

_SUFFIXES = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")


class Recording:
    """An open recording; close it, or use it in a with statement.

    Parameters
    ----------
    path
        A rosbag2 folder, or one .mcap or .db3 file.

    Raises
    ------
    BagError
        If there is no such recording or nothing in it can be read.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.damage = Damage()
        self._unpacked: tempfile.TemporaryDirectory[str] | None = None
        self._files: list[McapFile | SqliteFile] = []
        paths, self._compressed = self._find()
        try:
            self._open(paths)
        except BaseException:
            self.close()
            raise
        self._files.sort(key=lambda file: file.start_time)

    def __enter__(self) -> Recording:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the files and remove what was unpacked."""
        for file in self._files:
            file.close()
        if self._unpacked is not None:
            self._unpacked.cleanup()

    @property
    def topics(self) -> tuple[Topic, ...]:
        """The topics of all files, each once, with the sum of their messages, by name."""
        merged: dict[str, Topic] = {}
        for file in self._files:
            for topic in file.topics:
                before = merged.get(topic.name)
                count = topic.count + (before.count if before else 0)
                merged[topic.name] = replace(before or topic, count=count)
        return tuple(merged[name] for name in sorted(merged))

    def require(self, names: Sequence[str], type_name: str) -> None:
        """Check that topics are there, of the type, serialised as CDR and not empty.

        Raises
        ------
        BagError
            If one is not; a missing topic lists those that are there.
        """
        there = {topic.name: topic for topic in self.topics}
        for name in names:
            topic = there.get(name) or there.get(f"/{name}")
            if topic is None:
                listed = ", ".join(f"{t.name} ({t.type})" for t in there.values()) or "none at all"
                raise BagError(f"{self.path} has no topic {name!r}, it has: {listed}")
            if topic.type != type_name:
                raise BagError(f"topic {name!r} in {self.path} is {topic.type or 'untyped'}, expected {type_name}")
            if topic.encoding != "cdr":
                raise BagError(f"topic {name!r} in {self.path} is serialised as {topic.encoding!r}, expected 'cdr'")

    def batches(self, names: Sequence[str]) -> Iterator[Batch]:
        """Read the messages of topics, the files in the order of time."""
        there = {topic.name for topic in self.topics}
        topics = [name if name in there else f"/{name}" for name in names]
        for k, file in enumerate(self._files):
            for batch in file.batches(topics):
                progress = (k + batch.progress) / len(self._files)
                horizon = min([batch.horizon, *(later.start_time for later in self._files[k + 1 :])])
                yield replace(batch, progress=progress, horizon=horizon)

    def _find(self) -> tuple[list[Path], bool]:
        """Return the files, and whether each message is compressed by itself."""
        if self.path.is_file():
            if not self.path.name.endswith(_SUFFIXES):
                raise BagError(f"{self.path} is not a recording: expected a rosbag2 folder, a .mcap or a .db3 file")
            return [self.path], False
        if not self.path.is_dir():
            raise BagError(f"no recording at {self.path}")
        about = self._metadata()
        named = [self.path / str(name) for name in about.get("relative_file_paths") or []]
        missing = [path for path in named if not path.is_file()]
        for path in missing:
            self.damage.add(f"{path.name} is named in metadata.yaml and not there")
        # Without metadata.yaml (it is written at the end of a recording) the numbers in the names give the order.
        paths = [path for path in named if path not in missing] or sorted(
            (path for path in self.path.iterdir() if path.is_file() and path.name.endswith(_SUFFIXES)),
            key=lambda path: [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name)],
        )
        if not paths:
            raise BagError(f"{self.path} is a folder without .mcap or .db3 files")
        return paths, str(about.get("compression_mode", "")).lower() == "message"

    def _metadata(self) -> dict[str, Any]:
        path = self.path / "metadata.yaml"
        try:
            document = yaml.safe_load(path.read_text(encoding="utf-8"))
            about = document["rosbag2_bagfile_information"]
            listed = about.get("relative_file_paths")
            if isinstance(about, dict) and (listed is None or isinstance(listed, list)):
                return about
            self.damage.add("metadata.yaml is damaged: the files were taken in the order of their names")
        except FileNotFoundError:
            self.damage.add("there is no metadata.yaml: the recording was cut off, the files were read without it")
        except (OSError, yaml.YAMLError, ValueError, KeyError, TypeError, AttributeError):
            self.damage.add("metadata.yaml is damaged: the files were taken in the order of their names")
        return {}

    def _open(self, paths: list[Path]) -> None:
        """Open what can be opened; a damaged file among several is noted."""
        refused = [error for path in paths if (error := self._try(path)) is not None]
        if not self._files:
            raise refused[0]

    def _try(self, path: Path) -> BagError | None:
        try:
            plain = self._unpack(path) if path.suffix == ".zstd" else path
            if plain.suffix == ".mcap":
                self._files.append(McapFile(plain, self.damage))
            else:
                self._files.append(SqliteFile(plain, self.damage, self._compressed))
        except BagError as error:
            self.damage.add(str(error))
            return error
        return None

    def _unpack(self, path: Path) -> Path:
        """Unpack a file compressed as a whole into a temporary folder."""
        if self._unpacked is None:
            self._unpacked = tempfile.TemporaryDirectory(prefix="fdi_bag_")
        plain = Path(self._unpacked.name) / path.stem
        try:
            with path.open("rb") as packed, plain.open("wb") as out:
                zstandard.ZstdDecompressor().copy_stream(packed, out)
        except (OSError, zstandard.ZstdError) as error:
            if not plain.exists() or plain.stat().st_size == 0:
                raise BagError(f"{path} cannot be unpacked: {error}") from error
            self.damage.add(f"{path.name} cannot be unpacked to its end ({error}): read as far as it goes")
        return plain
