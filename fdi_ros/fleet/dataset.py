# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The folder of a fleet: Parquet files of flights, events and injected faults, complete at any moment.

While recordings are judged, parts are written to ``parts/``, each whole or not at all, the flights of a part last: a
flight that is there is there with all its events. At the end the parts become one file per table, sorted, which does
not depend on the workers. A run that was stopped, for whatever reason, goes on from what is there.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import shutil
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from fdi_ros import __version__
from fdi_ros.errors import BagError
from fdi_ros.fleet.rows import TABLES, VERSION, Judged, columns
from fdi_ros.result_file import MADE_BY, is_scratch, whole_file, write_text

if TYPE_CHECKING:
    import pyarrow

ABOUT, LOCK, PAGE = "fleet.json", ".lock", "fleet.html"
PARTS, CONFIGS = "parts", "configs"
"""Folders of what is not put together yet, and of the parameter files that were calibrated."""
TOGETHER, SECONDS = 64, 5.0
"""Flights, and time, after which what was judged is written."""


class Dataset:
    """The folder that a run writes to; use it in a with statement: what is left is written at its end.

    Parameters
    ----------
    folder
        Made if it is not there.
    settings
        What decides the results, ready for JSON: with other settings nothing of before is of use.
    force
        Begin anew where the folder holds a run with other settings.

    Raises
    ------
    BagError
        If the folder holds something else, or a run with other settings.
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any], force: bool = False) -> None:
        _require_pyarrow()
        self.folder = folder
        self.digest = hashlib.sha256(json.dumps([VERSION, __version__, settings], sort_keys=True).encode()).hexdigest()[
            :16
        ]
        self._waiting: list[Judged] = []
        self._written = time.monotonic()
        self._number = 0
        about = {**MADE_BY, "version": __version__, "columns": VERSION, "digest": self.digest, "settings": settings}
        try:
            there = folder.exists() and any(child.name != LOCK for child in folder.iterdir())
            folder.mkdir(parents=True, exist_ok=True)
            if there and not (folder / ABOUT).exists():
                raise BagError(f"{folder} holds no run of fdi fleet; it is not written to even with --force")
            self._lock = _locked(folder)
            if there:
                self._check(force)
            (folder / PARTS).mkdir(exist_ok=True)
            write_text(folder / ABOUT, json.dumps(about, indent=2) + "\n")
            self._clean()
        except OSError as error:
            raise BagError(f"cannot write to {folder}: {error.strerror or error}") from error

    def __enter__(self) -> Dataset:
        return self

    def __exit__(self, *_: object) -> None:
        self.flush()

    def close(self) -> None:
        """Let other runs write to the folder."""
        self._lock.close()

    def key_of(self, path: Path) -> str:
        """Tell a recording as it is now from all others, and from itself with other settings."""
        files = sorted(path.rglob("*")) if path.is_dir() else [path]
        stats = [(file.name, file.stat().st_size, file.stat().st_mtime_ns) for file in files if file.is_file()]
        return hashlib.sha256(repr((self.digest, str(path), stats)).encode()).hexdigest()[:32]

    def done(self) -> set[str]:
        """Keys of the flights that are there."""
        found: set[str] = set()
        for file in self._files("flights"):
            table = _read(file, ["flight", "error"])
            # What went wrong may be mended: it is tried again.
            found |= {
                key
                for key, error in zip(table["flight"].to_pylist(), table["error"].to_pylist(), strict=True)
                if not error
            }
        return found

    def add(self, judged: Judged) -> None:
        """Take the rows of one more recording."""
        self._waiting.append(judged)
        if len(self._waiting) >= TOGETHER or time.monotonic() - self._written >= SECONDS:
            self.flush()

    def flush(self) -> None:
        """Write what waits."""
        waiting, self._waiting = self._waiting, []
        self._written = time.monotonic()
        if not waiting:
            return
        rows: dict[str, list[Any]] = {
            "faults": [fault for one in waiting for fault in one.faults],
            "events": [event for one in waiting for event in one.events],
            "flights": [one.flight for one in waiting],
        }
        self._number += 1
        name = f"{os.getpid()}-{time.time_ns()}-{self._number}.parquet"
        for table, found in rows.items():
            if found or table == "flights":
                self._write(self.folder / PARTS / table / name, table, map(asdict, found))

    def finish(self, keys: Sequence[str]) -> int:
        """Put the parts together, sorted; return how many flights that are not among these keys were left out."""
        import pyarrow as arrow
        import pyarrow.compute as compute
        import pyarrow.parquet as parquet

        self.flush()
        left_out = 0
        wanted = arrow.array(sorted(set(keys)))
        for name in TABLES:
            files = self._files(name)
            tables = [_read(file, schema_of(name).names).cast(schema_of(name)) for file in files]
            whole = arrow.concat_tables(tables) if tables else schema_of(name).empty_table()
            kept = whole.filter(compute.is_in(whole["flight"], value_set=wanted))
            if name == "flights":
                left_out = len(set(whole["flight"].to_pylist()) - set(keys))
                # One that was tried again is there twice.
                last = {key: row for row, key in enumerate(kept["flight"].to_pylist())}
                kept = kept.take(sorted(last.values()))
            order = [("path", "ascending")] + [(key, "ascending") for key in _ORDER[name]]
            kept = kept.sort_by(order).replace_schema_metadata(schema_of(name).metadata)
            with _resumable(), whole_file(self.folder / f"{name}.parquet") as path:
                parquet.write_table(kept, path)
        shutil.rmtree(self.folder / PARTS)
        return left_out

    def read(self, name: str) -> list[dict[str, Any]]:
        """Rows of a table of a finished run."""
        import pyarrow.parquet as parquet

        rows: list[dict[str, Any]] = parquet.read_table(self.folder / f"{name}.parquet").to_pylist()
        return rows

    def write(self, name: str, text: str) -> Path:
        """Write a text file beside the tables."""
        path = self.folder / name
        with _resumable():
            path.parent.mkdir(exist_ok=True)
            write_text(path, text)
        return path

    def _check(self, force: bool) -> None:
        try:
            about = json.loads((self.folder / ABOUT).read_text(encoding="utf-8"))
            digest = about["digest"] if about["generator"] == MADE_BY["generator"] else None
        except (OSError, ValueError, KeyError, TypeError):
            digest = None
        if digest is None:
            raise BagError(f"{self.folder} holds no run of fdi fleet; it is not written to even with --force")
        if digest != self.digest:
            if not force:
                raise BagError(
                    f"{self.folder} holds a run with other settings or of another version; --force begins anew"
                )
            for name in TABLES:
                (self.folder / f"{name}.parquet").unlink(missing_ok=True)
            shutil.rmtree(self.folder / PARTS, ignore_errors=True)
            # No page and no parameter file of the run before stands beside the tables of this one.
            (self.folder / PAGE).unlink(missing_ok=True)
            for path in (self.folder / CONFIGS).glob("*.yaml"):
                path.unlink()

    def _files(self, table: str) -> list[Path]:
        whole = self.folder / f"{table}.parquet"
        return [*([whole] if whole.exists() else []), *sorted((self.folder / PARTS / table).glob("*.parquet"))]

    def _clean(self) -> None:
        """Take away what a stopped run has left of flights that are not there."""
        flights = {path.name for path in (self.folder / PARTS / "flights").glob("*.parquet")}
        for table in TABLES:
            for path in (self.folder / PARTS / table).glob("*.parquet"):
                if path.name not in flights:
                    path.unlink()
        for folder in (self.folder, self.folder / CONFIGS, *(self.folder / PARTS / table for table in TABLES)):
            for path in filter(is_scratch, folder.glob(".*")):
                shutil.rmtree(path)

    def _write(self, path: Path, table: str, rows: Iterable[Mapping[str, Any]]) -> None:
        import pyarrow as arrow
        import pyarrow.parquet as parquet

        made = arrow.Table.from_pylist(list(rows), schema=schema_of(table))
        with _resumable():
            path.parent.mkdir(exist_ok=True)
            with whole_file(path) as scratch:
                parquet.write_table(made, scratch)


_ORDER = {"flights": (), "events": ("stamp", "channel"), "faults": ("at", "channel", "fault")}
"""Columns besides the path that sort the rows."""


def schema_of(table: str) -> pyarrow.Schema:
    """Return the schema of a table: types, and meaning and unit of every column."""
    import pyarrow as arrow

    types = {
        "string": arrow.string(),
        "int64": arrow.int64(),
        "double": arrow.float64(),
        "bool": arrow.bool_(),
        "list<string>": arrow.list_(arrow.string()),
        "list<double>": arrow.list_(arrow.float64()),
        "list<float>": arrow.list_(arrow.float32()),
    }
    return arrow.schema(
        [
            arrow.field(name, types[kind], metadata={"meaning": meaning, "unit": unit})
            for name, kind, meaning, unit in columns(TABLES[table])
        ],
        metadata={"fdi_ros": __version__, "columns": str(VERSION)},
    )


def _read(file: Path, names: Sequence[str]) -> Any:
    """Read columns of a file of ours."""
    import pyarrow as arrow
    import pyarrow.parquet as parquet

    try:
        return parquet.read_table(file, columns=list(names))
    except arrow.ArrowException as error:
        raise BagError(f"{file} is damaged: take it away, or give another --output") from error


def _locked(folder: Path) -> IO[str]:
    """Hold a folder against other runs for as long as this one lives."""
    lock = (folder / LOCK).open("w")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        lock.close()
        raise BagError(f"another fdi fleet writes to {folder}") from error
    return lock


def _require_pyarrow() -> None:
    try:
        import pyarrow  # noqa: F401
    except ImportError as error:
        raise BagError("fdi fleet needs pyarrow: pip install 'fdi_ros[fleet]'") from error


@contextmanager
def _resumable() -> Iterator[None]:
    """Say in one line why something could not be written, and that nothing of before is lost."""
    try:
        yield
    except (OSError, BagError) as error:
        why = str(error) if isinstance(error, BagError) else f"cannot write: {error.strerror or error}"
        raise BagError(f"{why}; what was judged before is kept, the same command goes on from there") from error
