# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Which recordings are judged: folders, patterns and list files, as given on the command line."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from fdi_ros.bag.metadata import LOG_SUFFIXES, SUFFIXES, files_of_bag
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
        ``?`` or ``**``; or a file that ends in .txt or .list and has one of these per line, relative to itself, with
        ``#`` for comments.

    Raises
    ------
    BagError
        If something given is not there, or nothing is found at all.
    """
    found: dict[str, Path] = {}
    search = _Search()
    for text in given:
        for path in search.expanded(text):
            found.setdefault(os.path.realpath(path), path)
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
    return str(path.absolute().parent).encode("utf-8", "replace").decode()


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
            for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
                if entry := line.partition("#")[0].strip():
                    try:
                        yield from self._there(str(path.parent / entry))
                    except BagError as error:
                        raise BagError(f"{path}, line {number}: {error}") from error
        else:
            yield from self._there(text)

    def _there(self, text: str) -> Iterator[Path]:
        path = Path(text)
        if path.exists():
            matches = [text]
        else:
            matches = sorted(glob.glob(text, recursive=True)) if glob.has_magic(text) else []
            if not matches:
                raise BagError(f"there is no {text}")
        for match in map(Path, matches):
            if match.is_dir():
                yield from self._below(match)
                # Behind a link lies what may be found by its own name, too: that one counts.
                while self._links:
                    yield from self._below(self._links.pop(0))
            else:
                yield match

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
            # Autopilots write .BIN, too.
            elif is_file and (
                child.name.lower().endswith(LOG_SUFFIXES) or (bag is None and child.name.lower().endswith(SUFFIXES))
            ):
                yield child
