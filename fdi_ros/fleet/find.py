# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The recordings of a fleet, in folders."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from fdi_ros.bag.csv_file import has_gyros
from fdi_ros.bag.raw import LFS, LOG_SUFFIXES, SUFFIXES, files_of_bag
from fdi_ros.bag.reader import LOGS
from fdi_ros.bag.ros1_file import MAGIC
from fdi_ros.errors import BagError
from fdi_ros.system.trusted_file import open_regular


def find_recordings(given: Sequence[str]) -> tuple[list[Path], list[str]]:
    """Find all recordings in what is given: each a recording, or a folder, of which all below count, behind links too.

    A file of a rosbag2 folder stands for the folder. Returned are the recordings in order, each once; and what could
    not be searched, or is called like a recording and is none. `BagError` if something given is not there, or nothing
    is found at all.
    """
    found: dict[str, Path] = {}
    unread: list[str] = []
    for path in map(Path, given):
        if not path.exists():
            raise BagError(f"there is no {path}")
        whole = path.parent if path in (files_of_bag(path.parent) or ()) else path
        for recording in _below(path, unread) if path.is_dir() else [whole]:
            found.setdefault(os.path.realpath(recording), Path(os.path.abspath(recording)))
    if not found:
        expected = f"expected names that end in {', '.join((*SUFFIXES, *LOG_SUFFIXES))}"
        raise BagError("; ".join([f"no recording in {', '.join(given)}: {expected}", *unread]))
    return sorted(found.values()), unread


def _below(folder: Path, unread: list[str]) -> Iterator[Path]:
    """Yield the recordings in a folder and below, each folder once: links may lead in circles."""
    walked = set[str]()

    def note(error: OSError) -> None:
        unread.append(f"cannot read {error.filename}: {error.strerror}")

    for place, folders, files in os.walk(folder, onerror=note, followlinks=True):
        here, real = Path(place), os.path.realpath(place)
        if real in walked:
            folders.clear()
            continue
        walked.add(real)
        folders.sort()
        bag = files_of_bag(here)
        if bag is not None:
            yield here
        for path in (here / name for name in sorted(files)):
            # What else lies in the folder of a bag is a part of it, but for logs.
            if (bag is None or path.name.lower().endswith(LOG_SUFFIXES)) and _is_recording(path, unread):
                yield path


def _is_recording(path: Path, unread: list[str]) -> bool:
    """Whether a file is a recording; what is only called so is noted."""
    name = path.name.lower()
    if not name.endswith((*SUFFIXES, *LOG_SUFFIXES)) or not path.is_file():
        return False
    if not name.endswith(LOG_SUFFIXES):
        return True
    # Firmware and much else is called .bin, too, and any table .csv.
    magic = MAGIC if path.suffix.lower() == ".bag" else LOGS[path.suffix.lower()].magic
    try:
        with open_regular(path) as file:
            begin = file.read(len(LFS))
            table = path.suffix.lower() == ".csv" and has_gyros(file)
    except OSError:
        # Reading it says what is wrong.
        return True
    if path.suffix.lower() == ".csv":
        return table
    # An empty log is a log that was lost; so is one that git has put elsewhere.
    if begin and not begin.startswith((magic, LFS)):
        unread.append(f"{path} is no flight log")
    return not begin or begin.startswith((magic, LFS))
