# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Which recordings are judged: folders, patterns and list files, as given on the command line."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from fdi_ros.bag.raw import LOG_SUFFIXES, SUFFIXES, files_of_bag
from fdi_ros.bag.reader import LOGS
from fdi_ros.errors import BagError

LISTS = (".txt", ".list")
"""Suffixes of files that list recordings."""
MOST = 1_000_000
"""Recordings of one run."""


@dataclass(frozen=True)
class Recordings:
    """What was found."""

    paths: tuple[Path, ...]
    """In order, each recording once."""
    unread: tuple[str, ...] = ()
    """Folders below those given that could not be searched, and why."""


def find_recordings(given: Sequence[str]) -> Recordings:
    """Find all recordings.

    Parameters
    ----------
    given
        Each a recording; a folder, of which all recordings below count, those behind links too; a pattern with ``*``,
        ``?`` or ``**``; or a file that ends in .txt or .list and has one of these per line, relative to itself; lines
        that begin with ``#``, and what follows `` #``, are comments. A file of a rosbag2 folder stands for the folder.

    Raises
    ------
    BagError
        If something given is not there, or nothing is found at all.
    """
    found: dict[tuple[int, int] | str, Path] = {}
    search = _Search()
    for text in given:
        for path in search.expanded(text):
            path = Path(os.path.abspath(path))
            found.setdefault(_identity(path), path)
            if len(found) > MOST:
                raise BagError(f"more than {MOST} recordings: judge them in several runs")
    if not found:
        expected = f"expected names that end in {', '.join((*SUFFIXES, *LOG_SUFFIXES))}"
        raise BagError("; ".join([f"no recording in {', '.join(given)}: {expected}", *search.unread]))
    return Recordings(tuple(sorted(found.values())), tuple(search.unread))


def vehicle_of(path: Path) -> str:
    """Name of the vehicle: the whole path of the folder in which the recording lies.

    The last name alone may be shared: ``drone_1/logs`` and ``drone_2/logs`` are not one vehicle.
    """
    return str(path.absolute().parent)


def _identity(path: Path) -> tuple[int, int] | str:
    """Tell one and the same recording under several names: links, hard ones too."""
    try:
        about = path.stat()
    except OSError:
        return str(path)
    return about.st_dev, about.st_ino


def _may_be_log(path: Path) -> bool:
    """Whether a file begins as a flight log does: firmware and much else is called .bin, too."""
    magic = LOGS[path.suffix.lower()].magic
    try:
        with path.open("rb") as file:
            begin = file.read(len(magic))
    except OSError:
        # Reading it will say what is wrong.
        return True
    # An empty log is a log that was lost.
    return not begin or begin == magic


class _Search:
    """Walks folders, each once: links may lead in circles."""

    def __init__(self) -> None:
        self.unread: list[str] = []
        self._walked: set[str] = set()
        self._links: list[Path] = []

    def expanded(self, text: str) -> Iterator[Path]:
        """All recordings that something given on the command line stands for."""
        path = Path(text)
        if path.suffix in LISTS and path.is_file():
            for number, line in enumerate(path.read_text(encoding="utf-8-sig", errors="replace").splitlines(), 1):
                if entry := re.split(r"(?:^|\s)#", line)[0].strip():
                    if entry.endswith(LISTS):
                        raise BagError(f"{path}, line {number}: {entry} is a list itself")
                    try:
                        yield from self._there(str(path.parent / entry))
                    except BagError as error:
                        raise BagError(f"{path}, line {number}: {error}") from error
        else:
            yield from self._there(text)

    def _there(self, text: str) -> Iterator[Path]:
        path = Path(text)
        if path.exists():
            yield from self._at(path)
            return
        matches = sorted(glob.glob(text, recursive=True)) if glob.has_magic(text) else []
        if not matches:
            raise BagError(f"there is no {text}")
        for match in map(Path, matches):
            if match.is_dir() or match.name.lower().endswith(SUFFIXES) or self._is_log(match):
                yield from self._at(match)

    def _at(self, path: Path) -> Iterator[Path]:
        """All recordings at a place that is there."""
        if path.is_dir():
            yield from self._below(path)
            # Behind a link lies what may be found by its own name, too: that one counts.
            while self._links:
                yield from self._below(self._links.pop(0))
        else:
            yield path.parent if path in (files_of_bag(path.parent) or ()) else path

    def _below(self, folder: Path) -> Iterator[Path]:
        """All recordings in a folder; the files of a rosbag2 folder are one."""
        place = os.path.realpath(folder)
        if place in self._walked:
            return
        self._walked.add(place)
        try:
            children = sorted(folder.iterdir())
            kinds = [(child, child.is_dir(), child.is_file()) for child in children]
            bag = files_of_bag(folder)
        except OSError as error:
            self.unread.append(f"cannot read {folder}: {error.strerror}")
            return
        if bag is not None:
            yield folder
        for child, is_folder, is_file in kinds:
            if is_folder:
                if child.is_symlink():
                    self._links.append(child)
                else:
                    yield from self._below(child)
            elif is_file and (self._is_log(child) or (bag is None and child.name.lower().endswith(SUFFIXES))):
                yield child

    def _is_log(self, path: Path) -> bool:
        """Whether a file found is a flight log; what is only called so is noted."""
        # Autopilots write .BIN, too.
        if not path.name.lower().endswith(LOG_SUFFIXES):
            return False
        if not _may_be_log(path):
            self.unread.append(f"{path} is no flight log")
            return False
        return True
