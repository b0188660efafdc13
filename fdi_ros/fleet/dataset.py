# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The folder of a fleet: Parquet files of flights, episodes, events and injected faults, complete at any moment.

While recordings are judged, parts are written to ``parts/``, each a folder of tables, whole or not at all. At the end
the parts become one file per table, sorted, which does not depend on the workers. A run that was stopped, at whatever
moment, goes on from what is there: where a flight stands in two places, its events and faults are those beside the one
of its rows that counts.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import math
import os
import secrets
import shutil
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

from fdi_ros import __version__
from fdi_ros.bag.raw import Damage, find_files
from fdi_ros.errors import BagError
from fdi_ros.fleet.flights import TABLES, VERSION, Judged, schema_of
from fdi_ros.result_file import MADE_BY, is_scratch, whole_file, whole_folder, write_text
from fdi_ros.text import storable

ABOUT, LOCK, PAGE = "fleet.json", ".lock", "fleet.html"
PARTS, CONFIGS = "parts", "configs"
"""Folders of what is not put together yet, and of the parameter files that were calibrated."""
VEHICLES = "vehicles.json"
"""Says which of these is whose."""
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
        self.folder = folder
        decides = json.dumps([VERSION, __version__, settings], sort_keys=True)
        self.digest = hashlib.sha256(decides.encode("utf-8", "surrogateescape")).hexdigest()[:16]
        self._waiting: list[Judged] = []
        self._written = time.monotonic()
        self._number = 0
        self._texts: dict[Path, str] = {}
        """What waits to be written until the run before is replaced."""
        self._about = {
            **MADE_BY,
            "version": __version__,
            "columns": VERSION,
            "digest": self.digest,
            "settings": settings,
        }
        try:
            _refuse_others(folder)
            folder.mkdir(parents=True, exist_ok=True)
            self._lock = _locked(folder)
            there = _refuse_others(folder)
            self._outdated = there and self._holds_other_settings(force)
            """Whether what is there is of other settings: it goes when the first result is there to take its place."""
            if not self._outdated:
                self._begin()
                # What a stopped run has left half-written.
                for place in (folder, folder / CONFIGS, folder / PARTS):
                    for path in filter(is_scratch, place.glob(".*")):
                        shutil.rmtree(path)
        except OSError as error:
            raise BagError(f"cannot write to {folder}: {error.strerror or error}") from error

    def __enter__(self) -> Dataset:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        try:
            self.flush()
        except BagError:
            # What stopped the run is what matters; what waits is judged again.
            if kind is None:
                raise

    def close(self) -> None:
        """Let other runs write to the folder."""
        self._lock.close()

    def key_of(self, path: Path) -> str:
        """Tell a recording as it is now from all others, and from itself with other settings.

        Raises
        ------
        OSError
            If its files cannot be looked at.
        """
        files: Sequence[Path] = (path,)
        if path.is_dir():
            with suppress(BagError):
                files = (*find_files(path, Damage()).paths, *path.glob("metadata.yaml"))
        stats = [(file.name, file.stat().st_size, file.stat().st_mtime_ns) for file in files]
        return hashlib.sha256(repr((self.digest, str(path), stats)).encode("utf-8", "backslashreplace")).hexdigest()[
            :32
        ]

    def done(self) -> dict[str, str]:
        """Keys of the flights that are there and could be judged, and what each says of its calibration.

        What went wrong may be mended, and is tried again; so is what has lost one of the tables.
        """
        whole = all(self._file(table).exists() for table in TABLES)
        return {
            key: row["calibration"]
            for key, (part, row) in self._that_count().items()
            if not row["error"] and (part or whole)
        }

    def add(self, judged: Judged) -> None:
        """Take the rows of one more recording."""
        self._waiting.append(judged)
        if len(self._waiting) >= TOGETHER or time.monotonic() - self._written >= SECONDS:
            self.flush()

    def flush(self) -> None:
        """Write what waits."""
        import pyarrow as arrow

        if not self._waiting:
            return
        self._replace_outdated()
        self._number += 1
        (self.folder / PARTS).mkdir(exist_ok=True)
        # In the order of their names later parts come later.
        name = f"{time.time_ns():020d}-{os.getpid()}-{self._number}"
        with _resumable(), whole_folder(self.folder / PARTS / name) as part:
            part.mkdir()
            for table in TABLES:
                rows = [_plain(asdict(row)) for one in self._waiting for row in one.rows(table)]
                if rows:
                    _save(arrow.Table.from_pylist(rows, schema=schema_of(table)), part / f"{table}.parquet")
        self._waiting = []
        self._written = time.monotonic()

    def finish(self, keys: Collection[str]) -> int:
        """Put the parts together, sorted.

        Parameters
        ----------
        keys
            Of the recordings of this run: of these that have changed the former rows go, all others stay.

        Returns
        -------
        Flights in the tables that are not among the keys.
        """
        import pyarrow as arrow
        import pyarrow.compute as compute

        self.flush()
        self._replace_outdated()
        rows = self._that_count()
        now = {row["path"] for key, (_, row) in rows.items() if key in keys}
        # Of those not given now each path has its latest row.
        in_time = sorted(rows.items(), key=lambda counted: counted[1][0])
        others = {row["path"]: key for key, (_, row) in in_time if row["path"] not in now}
        chosen = {key: rows[key][0] for key in (*(rows.keys() & set(keys)), *others.values())}
        own: dict[str, list[str]] = {}
        for key, place in chosen.items():
            own.setdefault(place, []).append(key)
        # The flights last: until they are there, all is taken from where it was before.
        for name in reversed(TABLES):
            schema, tables = schema_of(name), []
            for place, wanted in own.items():
                if (path := self._file(name, place)).exists():
                    table = _read(path, schema.names).cast(schema)
                    tables.append(table.filter(compute.is_in(table["flight"], value_set=arrow.array(wanted))))
            whole = arrow.concat_tables(tables) if tables else schema.empty_table()
            order = [("path", "ascending"), ("flight", "ascending")] + [(key, "ascending") for key in _ORDER[name]]
            whole = whole.sort_by(order).replace_schema_metadata(schema.metadata)
            with _resumable(), whole_file(self.folder / f"{name}.parquet") as scratch:
                _save(whole, scratch)
        self._take_parts_away()
        return len(chosen.keys() - set(keys))

    def read(self, name: str, keys: Collection[str]) -> list[dict[str, Any]]:
        """Rows of a table of a finished run, of the flights of these keys."""
        rows: list[dict[str, Any]] = _read(self.folder / f"{name}.parquet", schema_of(name).names).to_pylist()
        return [row for row in rows if row["flight"] in keys]

    def write(self, name: str, text: str) -> Path:
        """Write a text file beside the tables."""
        path = self.folder / name
        if self._outdated:
            self._texts[path] = text
            return path
        with _resumable():
            path.parent.mkdir(exist_ok=True)
            write_text(path, text)
        return path

    def text(self, name: str) -> str:
        """Return what a text file beside the tables holds.

        Raises
        ------
        OSError
            If it is not there, or of other settings.
        """
        if self._outdated:
            raise FileNotFoundError(name)
        return (self.folder / name).read_text(encoding="utf-8")

    def _holds_other_settings(self, force: bool) -> bool:
        """Whether a run with other settings is there, which is to be replaced."""
        try:
            about = json.loads((self.folder / ABOUT).read_text(encoding="utf-8"))
            digest = about["digest"] if about["generator"] == MADE_BY["generator"] else None
        except (OSError, ValueError, KeyError, TypeError):
            digest = None
        if digest is None:
            raise BagError(f"{self.folder} holds no run of fdi fleet; it is not written to even with --force")
        if digest != self.digest and not force:
            raise BagError(f"{self.folder} holds a run with other settings or of another version; --force begins anew")
        return bool(digest != self.digest)

    def _begin(self) -> None:
        """Make the folder one of ours: first of all by the file that says so."""
        write_text(self.folder / ABOUT, json.dumps(self._about, indent=2) + "\n")
        (self.folder / PARTS).mkdir(exist_ok=True)

    def _replace_outdated(self) -> None:
        """Take away what is of other settings; no page and no parameter file of before stands beside new tables."""
        if not self._outdated:
            return
        with _resumable():
            self._take_parts_away()
            # The flights first: events without their flights are nothing, whenever this is stopped.
            for table in TABLES:
                self._file(table).unlink(missing_ok=True)
            (self.folder / PAGE).unlink(missing_ok=True)
            for path in (*(self.folder / CONFIGS).glob("*.yaml"), self.folder / CONFIGS / VEHICLES):
                path.unlink(missing_ok=True)
            self._begin()
        self._outdated = False
        for path, text in self._texts.items():
            self.write(str(path.relative_to(self.folder)), text)

    def _take_parts_away(self) -> None:
        """At once: no flight stays without its events, whenever this is stopped."""
        gone = self.folder / f".{PARTS}.{secrets.token_hex(4)}"
        with suppress(FileNotFoundError):
            (self.folder / PARTS).rename(gone)
            shutil.rmtree(gone, ignore_errors=True)

    def _file(self, table: str, part: str = "") -> Path:
        """Return where the rows of a table lie: in a part, or in the one file of all."""
        return (self.folder / PARTS / part if part else self.folder) / f"{table}.parquet"

    def _that_count(self) -> dict[str, tuple[str, dict[str, Any]]]:
        """Of every flight that is there: the part with the row that counts, and the columns that matter here.

        That is the last one without an error, or else the last one.
        """
        found: dict[str, tuple[str, dict[str, Any]]] = {}
        if self._outdated:
            return found
        parts = sorted(path.parent.name for path in (self.folder / PARTS).glob("[0-9]*/flights.parquet"))
        if self._file("flights").exists():
            parts.insert(0, "")
        for part in parts:
            for row in _read(self._file("flights", part), ["flight", "path", "error", "calibration"]).to_pylist():
                if row["flight"] not in found or not row["error"] or found[row["flight"]][1]["error"]:
                    found[row["flight"]] = part, row
        return found


_ORDER = {
    "flights": (),
    "episodes": ("start", "since", "words"),
    "events": ("stamp", "channel"),
    "faults": ("at", "channel", "fault"),
}
"""Columns besides the path that sort the rows."""


def _plain(value: Any) -> Any:
    """Return a value as it is stored: what is not finite as null, texts as Unicode."""
    if isinstance(value, Mapping):
        return {name: _plain(one) for name, one in value.items()}
    if isinstance(value, tuple):
        return [_plain(one) for one in value]
    if isinstance(value, str):
        return storable(value)
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _read(file: Path, names: Sequence[str]) -> Any:
    """Read columns of a file of ours."""
    import pyarrow as arrow
    import pyarrow.parquet as parquet

    try:
        # Opened here: the name may be no Unicode.
        with file.open("rb") as opened:
            return parquet.read_table(opened, columns=list(names))
    except arrow.ArrowException as error:
        raise BagError(f"{file} is damaged: take it away, or give another --output") from error


def _save(table: Any, path: Path) -> None:
    """Write a Parquet file."""
    import pyarrow.parquet as parquet

    with path.open("wb") as opened:
        parquet.write_table(table, opened)


def _refuse_others(folder: Path) -> bool:
    """Whether a folder holds a run; one that holds something else is refused."""
    if not folder.exists():
        return False
    there = any(path.name != LOCK and not is_scratch(path) for path in folder.iterdir())
    if there and not (folder / ABOUT).exists():
        raise BagError(f"{folder} holds no run of fdi fleet; it is not written to even with --force")
    return there


def _locked(folder: Path) -> IO[str]:
    """Hold a folder against other runs for as long as this one lives."""
    lock = (folder / LOCK).open("w")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        lock.close()
        raise BagError(f"another fdi fleet writes to {folder}") from error
    return lock


@contextmanager
def _resumable() -> Iterator[None]:
    """Say in one line why something could not be written, and that nothing of before is lost."""
    try:
        yield
    except (OSError, BagError) as error:
        why = str(error) if isinstance(error, BagError) else f"cannot write: {error.strerror or error}"
        raise BagError(f"{why}; what was judged before is kept, the same command goes on from there") from error
