# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Which recordings are judged: folders, patterns and list files, as given on the command line."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from fdi_ros.bag.metadata import LOG_SUFFIXES, SUFFIXES
from fdi_ros.errors import BagError

_SUFFIXES = (*SUFFIXES, *LOG_SUFFIXES)
LISTS = (".txt", ".list")
"""Suffixes of files that list recordings."""
MOST = 1_000_000
"""Recordings of one run."""


def find_recordings(given: Sequence[str]) -> tuple[Path, ...]:
    """Find all recordings.

    Parameters
    ----------
    given
        Each a recording; a folder, of which all recordings below count; a pattern with ``*``, ``?`` or ``**``; or a
        file that ends in .txt or .list and has one of these per line, relative to itself, with ``#`` for comments.

    Returns
    -------
    The paths in order, each once.

    Raises
    ------
    BagError
        If something given is not there, or nothing is found at all.
    """
    found: dict[str, Path] = {}
    for text in given:
        for path in _expanded(text):
            found.setdefault(os.path.realpath(path), path)
            if len(found) > MOST:
                raise BagError(f"more than {MOST} recordings: judge them in several runs")
    if not found:
        raise BagError(f"no recording in {', '.join(given)}: expected names that end in {', '.join(_SUFFIXES)}")
    return tuple(sorted(found.values()))


def vehicle_of(path: Path) -> str:
    """Name of the vehicle: the whole path of the folder in which the recording lies.

    The last name alone may be shared: ``drone_1/logs`` and ``drone_2/logs`` are not one vehicle.
    """
    return str(path.absolute().parent).encode("utf-8", "replace").decode()


def _expanded(text: str, listed: bool = False) -> Iterator[Path]:
    path = Path(text)
    if path.is_dir():
        yield from _below(path)
    elif path.suffix in LISTS and path.is_file() and not listed:
        for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
            if entry := line.partition("#")[0].strip():
                yield from _expanded(str(path.parent / entry), listed=True)
    elif path.exists():
        yield path
    elif matches := sorted(glob.glob(text, recursive=True)) if glob.has_magic(text) else []:
        for match in matches:
            yield from _below(Path(match)) if os.path.isdir(match) else [Path(match)]
    else:
        raise BagError(f"there is no {text}")


def _below(folder: Path) -> Iterator[Path]:
    """All recordings in a folder; the files of a rosbag2 folder are one."""
    if (folder / "metadata.yaml").is_file():
        yield folder
        return
    try:
        children = sorted(folder.iterdir())
    except OSError as error:
        raise BagError(f"cannot read {folder}: {error.strerror}") from error
    # Autopilots write .BIN, too.
    yield from (child for child in children if child.name.lower().endswith(_SUFFIXES) and child.is_file())
    for child in children:
        if child.is_dir() and not child.is_symlink():
            yield from _below(child)
