# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The one writer of results, for every command: files and folders appear whole or not at all.

``-`` is standard output. What is no file (a device, a pipe) is written through, once all that goes there is known.
"""

from __future__ import annotations

import fcntl
import json
import math
import os
import re
import secrets
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fdi_ros.errors import BagError

STANDARD_OUTPUT = Path("-")
MADE_BY = {"generator": "fdi_ros"}  # first in every file of figures: a mark by which a former result is recognised
_OPEN_DESCRIPTOR = re.compile(r"/dev/std(in|out|err)|(/dev|/proc/(self|thread-self|[0-9]+))/fd/[0-9]+")
"""Names of what is open already, by whatever name it lies on the disk."""

JUST_MADE = 1.0  # s; so young a folder may not be locked yet by who has made it
_SCRATCH = re.compile(r"\..+\.[0-9a-f]{8}")


def is_scratch(path: Path) -> bool:
    """Whether a folder has the name of one that results are written in before they take their place."""
    return _SCRATCH.fullmatch(path.name) is not None and path.is_dir()


def is_stream(path: Path) -> bool:
    """Whether what is written there goes through: standard output, a pipe, a terminal or another device."""
    if is_open_already(path):
        return True
    try:
        mode = path.stat().st_mode
    except OSError:
        return False
    return stat.S_ISCHR(mode) or stat.S_ISFIFO(mode)


def is_open_already(path: Path) -> bool:
    """Whether a path names standard output or another open descriptor."""
    return path == STANDARD_OUTPUT or _OPEN_DESCRIPTOR.fullmatch(str(path)) is not None


def real_path(path: Path) -> Path:
    """Return where a path leads; a circle of links leads to itself."""
    return Path(os.path.realpath(path))


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Give a path to write a file to; it takes its place when all is written, and is gone if something fails.

    `BagError` if it cannot be written.
    """
    if is_stream(path):
        with _scratch(path, None) as folder:
            yield folder / "output"
            _copy_to_stream(folder / "output", path)
        return
    path = real_path(path)
    with _scratch(path, path.parent) as folder:
        yield folder / path.name
        os.replace(folder / path.name, path)


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """Give a path to make a folder at; it takes its place when all is written, and is gone if something fails.

    `BagError` if it cannot be written.
    """
    path = real_path(path)
    with _scratch(path, path.parent) as folder:
        yield folder / path.name
        before = folder / "before"
        if path.exists():
            os.replace(path, before)
        try:
            os.replace(folder / path.name, path)
        except OSError:
            if before.exists():
                os.replace(before, path)
            raise


def write_text(target: Path, text: str) -> None:
    """Write a text file, whole or not at all; `BagError` if it cannot be written."""
    with whole_file(target) as path:
        path.write_text(text, encoding="utf-8", errors="replace")


def write_json(target: Path | None, figures: Mapping[str, Any]) -> None:
    """Write figures as JSON, marked as of this package; None: not asked for. `BagError` if it cannot be written."""
    if target is not None:
        write_text(target, json.dumps(plain({**MADE_BY, **figures}), indent=2, allow_nan=False) + "\n")


def plain(value: Any) -> Any:
    """Return a value in the types of JSON: arrays as lists, what is not finite as null.

    A dataclass becomes an object of its fields, unless it has a method ``as_json`` that gives another form.
    """
    if hasattr(value, "as_json"):
        return plain(value.as_json())
    if is_dataclass(value):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {str(name): plain(one) for name, one in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [plain(one) for one in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _copy_to_stream(source: Path, path: Path) -> None:
    """Write what a file holds to where a path leads."""
    with source.open("rb") as file:
        if path == STANDARD_OUTPUT:
            sys.stdout.flush()
            shutil.copyfileobj(file, sys.stdout.buffer)
            sys.stdout.flush()
        else:
            # What a descriptor has been given before stays.
            with path.open("ab") as out:
                shutil.copyfileobj(file, out)


@contextmanager
def _scratch(path: Path, parent: Path | None) -> Iterator[Path]:
    """Give a folder to write in, beside where it is to go: there putting it in place is one step."""
    parent = parent or Path(tempfile.gettempdir())
    _remove_abandoned(path, parent)
    # Named before it is made: a signal at any moment leaves nothing behind.
    folder = parent / f".{path.name}.{secrets.token_hex(4)}"
    try:
        folder.mkdir(mode=0o700)
        with _opened(folder) as descriptor:
            # Where the file system has no locks, what a killed run leaves stays.
            with suppress(OSError):
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            yield folder
    except OSError as error:
        if isinstance(error, BrokenPipeError) and path == STANDARD_OUTPUT:
            raise
        raise BagError(f"cannot write {path}: {error.strerror or error}") from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _remove_abandoned(path: Path, parent: Path) -> None:
    """Remove folders that runs that were killed have left of this result: nobody holds their lock."""
    with suppress(OSError):
        for folder in parent.iterdir():
            if not is_scratch(folder) or folder.name[: -len(".00000000")] != f".{path.name}":
                continue
            with suppress(OSError), _opened(folder) as descriptor:
                about = os.fstat(descriptor)
                if about.st_uid == os.geteuid() and time.time() - about.st_mtime > JUST_MADE:
                    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _opened(folder: Path) -> Iterator[int]:
    """Open a folder; a lock on it ends with the process."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        yield descriptor
    finally:
        os.close(descriptor)
