# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The folder of a fleet: Parquet files of flights, episodes, events and injected faults, complete at any moment.

While recordings are judged, parts are written to ``parts/``, each whole or not at all, the flights of a part last: a
flight that is there is there with all its events. At the end the parts become one file per table, sorted, which does
not depend on the workers. A run that was stopped, at whatever moment, goes on from what is there: where a flight stands
in two files, its events and faults are those beside the one of its rows that counts.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import math
import os
import shutil
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from fdi_ros import __version__
from fdi_ros.bag.metadata import find_files
from fdi_ros.bag.raw import Damage
from fdi_ros.errors import BagError, FdiError
from fdi_ros.fleet.judging import Vehicle, config_of
from fdi_ros.fleet.rows import TABLES, VERSION, Judged, columns
from fdi_ros.result_file import MADE_BY, is_scratch, whole_file, write_text
from fdi_ros.text import storable

if TYPE_CHECKING:
    import pyarrow

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
        self.digest = _digest(json.dumps([VERSION, __version__, settings], sort_keys=True))[:16]
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
                self._clean()
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
        whole = all(self._file(table, "").exists() for table in TABLES)
        return {
            key: row["calibration"]
            for key, (file, row) in self._that_count().items()
            if not row["error"] and (file or whole)
        }

    def add(self, judged: Judged) -> None:
        """Take the rows of one more recording."""
        self._waiting.append(judged)
        if len(self._waiting) >= TOGETHER or time.monotonic() - self._written >= SECONDS:
            self.flush()

    def flush(self) -> None:
        """Write what waits."""
        if not self._waiting:
            return
        rows: dict[str, list[Any]] = {
            "faults": [fault for one in self._waiting for fault in one.faults],
            "events": [event for one in self._waiting for event in one.events],
            "episodes": [episode for one in self._waiting for episode in one.episodes],
            "flights": [one.flight for one in self._waiting],
        }
        self._replace_outdated()
        self._number += 1
        # In the order of their names later parts come later.
        name = f"{time.time_ns():020d}-{os.getpid()}-{self._number}.parquet"
        for table, found in rows.items():
            if found or table == "flights":
                self._write(self.folder / PARTS / table / name, table, map(asdict, found))
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
        others = {row["path"]: key for key, (_, row) in sorted(rows.items(), key=_file_of) if row["path"] not in now}
        chosen = {key: rows[key][0] for key in (*(rows.keys() & set(keys)), *others.values())}
        own: dict[str, list[str]] = {}
        for key, file in chosen.items():
            own.setdefault(file, []).append(key)
        # The flights last: until they are there, all is taken from where it was before.
        for name in reversed(TABLES):
            schema, tables = schema_of(name), []
            for file, wanted in own.items():
                if (path := self._file(name, file)).exists():
                    table = _read(path, schema.names).cast(schema)
                    tables.append(table.filter(compute.is_in(table["flight"], value_set=arrow.array(wanted))))
            whole = arrow.concat_tables(tables) if tables else schema.empty_table()
            order = [("path", "ascending"), ("flight", "ascending")] + [(key, "ascending") for key in _ORDER[name]]
            whole = whole.sort_by(order).replace_schema_metadata(schema.metadata)
            with _resumable(), whole_file(self.folder / f"{name}.parquet") as scratch:
                _save(whole, scratch)
        # Here too the flights are what counts: events without their flights are nothing.
        for table in TABLES:
            shutil.rmtree(self.folder / PARTS / table, ignore_errors=True)
        shutil.rmtree(self.folder / PARTS, ignore_errors=True)
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

    def vehicles(self) -> dict[str, Vehicle]:
        """Return the vehicles that were calibrated, by name, as far as their parameter files are there."""
        if self._outdated:
            return {}
        try:
            kept = json.loads((self.folder / CONFIGS / VEHICLES).read_text(encoding="utf-8"))
            entries = {name: self._vehicle(entry) for name, entry in kept.items()}
        except (OSError, ValueError, AttributeError, RecursionError):
            return {}
        return {name: vehicle for name, vehicle in entries.items() if vehicle is not None}

    def _vehicle(self, entry: Any) -> Vehicle | None:
        """Return what was kept of a vehicle; None if it is damaged: it is calibrated again."""
        try:
            file, words, rate = entry
            path = self.folder / CONFIGS / Path(file).name
            text = path.read_text(encoding="utf-8")
            config_of(text)
            return Vehicle(text, str(path), str(words), float(rate)) if words and text else None
        except (OSError, ValueError, TypeError, FdiError):
            return None

    def keep_vehicles(self, vehicles: Mapping[str, Vehicle]) -> None:
        """Keep which parameter file is whose: recordings that are added are judged as those before."""
        kept = {name: (Path(one.config).name, one.calibration, one.rate) for name, one in vehicles.items()}
        self.write(f"{CONFIGS}/{VEHICLES}", json.dumps(kept, indent=2) + "\n")

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
            # The flights first: events without their flights are nothing, whenever this is stopped.
            for table in TABLES:
                shutil.rmtree(self.folder / PARTS / table, ignore_errors=True)
                self._file(table, "").unlink(missing_ok=True)
            (self.folder / PAGE).unlink(missing_ok=True)
            for path in (*(self.folder / CONFIGS).glob("*.yaml"), self.folder / CONFIGS / VEHICLES):
                path.unlink(missing_ok=True)
            self._begin()
        self._outdated = False
        for path, text in self._texts.items():
            self.write(str(path.relative_to(self.folder)), text)

    def _file(self, table: str, name: str) -> Path:
        """Return where the rows of a table lie that belong to a file of flights; empty: the one of all."""
        return self.folder / PARTS / table / name if name else self.folder / f"{table}.parquet"

    def _that_count(self) -> dict[str, tuple[str, dict[str, Any]]]:
        """Of every flight that is there: the file with the row that counts, and the columns that matter here.

        That is the last one without an error, or else the last one.
        """
        found: dict[str, tuple[str, dict[str, Any]]] = {}
        if self._outdated:
            return found
        names = sorted(path.name for path in (self.folder / PARTS / "flights").glob("*.parquet"))
        if self._file("flights", "").exists():
            names.insert(0, "")
        for name in names:
            for row in _read(self._file("flights", name), ["flight", "path", "error", "calibration"]).to_pylist():
                if row["flight"] not in found or not row["error"] or found[row["flight"]][1]["error"]:
                    found[row["flight"]] = name, row
        return found

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

        made = arrow.Table.from_pylist([_plain(row) for row in rows], schema=schema_of(table))
        with _resumable():
            path.parent.mkdir(parents=True, exist_ok=True)
            with whole_file(path) as scratch:
                _save(made, scratch)


_ORDER = {
    "flights": (),
    "episodes": ("start", "since", "words"),
    "events": ("stamp", "channel"),
    "faults": ("at", "channel", "fault"),
}
"""Columns besides the path that sort the rows."""


def _file_of(counted: tuple[str, tuple[str, dict[str, Any]]]) -> str:
    """Name of the file of a flight; later ones come later."""
    return counted[1][0]


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()


def _plain(value: Any) -> Any:
    """Return a value as it is stored: what is not finite as null, texts as Unicode."""
    if isinstance(value, Mapping):
        return {name: _plain(one) for name, one in value.items()}
    if isinstance(value, tuple):
        return [_plain(one) for one in value]
    if isinstance(value, str):
        return storable(value)
    return None if isinstance(value, float) and not math.isfinite(value) else value


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
