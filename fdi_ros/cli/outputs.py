# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Where a command may write: results replace nothing but a former result of their kind, and never what is read."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from enum import Enum
from pathlib import Path

from fdi_ros.bag.metadata import find_files
from fdi_ros.bag.raw import Damage
from fdi_ros.errors import BagError
from fdi_ros.result_file import STANDARD_OUTPUT, is_stream, real_path

_HEAD = 1 << 16
"""Bytes at the begin of a file in which the mark of a result is looked for."""


class Kind(Enum):
    """What is written, and the pattern by which a former result of the kind is recognised; nothing else matches it."""

    JSON = rb'\s*\{\s*"generator":\s*"fdi_ros"'
    CSV = rb"stamp,rate_x,rate_y,rate_z,std_x,|monitor,channel,kind,size,fault,at_s,"
    PAGE = rb'\s*(?i:<!doctype html>)[^\0]*?<meta name="generator" content="fdi_ros">'
    PARAMETERS = rb"(?:(?:[ \t]*#[^\n]*|---[^\n]*|[ \t]*)\n)*?[ \t]*#[^\n]*\bmade by fdi (?:inspect|setup|calibrate)\b"
    FOLDER = rb""
    """An output bag: recognised by its metadata."""


def check_targets(targets: Sequence[tuple[Path | None, Kind]], force: bool, sources: Sequence[Path | None]) -> None:
    """Refuse targets that are one another, or that `check_target` refuses; None stands for one not asked for.

    Raises
    ------
    BagError
        If one may not be written; before any work is done.
    """
    read = [source for source in sources if source is not None]
    wanted = [(target, kind) for target, kind in targets if target]
    for k, (target, kind) in enumerate(wanted):
        if real_path(target) in [real_path(other) for other, _ in wanted[:k]] and not _takes_several(target):
            raise BagError(f"cannot write {target}: two outputs have this name")
        within = [other for other, kind in wanted if kind is Kind.FOLDER and other != target and not is_stream(target)]
        for folder in within:
            if real_path(folder) in real_path(target).parents:
                raise BagError(f"cannot write {target}: it lies in {folder}, which is written as a whole")
        check_target(target, kind, force, read)


def check_target(path: Path, kind: Kind, force: bool, sources: Sequence[Path] = ()) -> None:
    """Refuse to write where something is that should stay.

    Parameters
    ----------
    path
        Where it is to be written.
    kind
        What is to be written.
    force
        A former result of this kind there may be overwritten.
    sources
        What is read, recording, config and so on: never overwritten, wherever its files lie.

    Raises
    ------
    BagError
        If it may not be written; before any work is done.
    """
    if is_stream(path):
        if kind is Kind.FOLDER:
            raise BagError(f"cannot write {path}: a recording is a folder")
        return
    if not path.absolute().parent.is_dir():
        raise BagError(f"cannot write {path}: there is no folder {path.absolute().parent}")
    for source in sources:
        if any(_within(real_path(path), part) for part in _parts(source)):
            raise BagError(f"cannot write {path}: it belongs to {source}, which is read")
    if not (path.exists() or path.is_symlink()):
        return
    if not force:
        raise BagError(f"{path} exists already; --force overwrites it")
    if kind is Kind.FOLDER:
        _check_folder(path)
    else:
        _check_file(path, kind)


def _takes_several(path: Path) -> bool:
    """Whether several outputs may go there: a device keeps none of them apart, a file and standard output do."""
    return path != STANDARD_OUTPUT and is_stream(path)


def _parts(source: Path) -> list[Path]:
    """Where all that belongs to a source lies: metadata.yaml and links may lead out of the folder of a recording."""
    found = [real_path(source)]
    if source.is_dir():
        found.append(real_path(source / "metadata.yaml"))
        # What is no recording is refused when it is read.
        with suppress(BagError):
            found += map(real_path, find_files(source, Damage()).paths)
    return found


def _within(path: Path, folder: Path) -> bool:
    return path == folder or folder in path.parents or path in folder.parents


def _check_folder(path: Path) -> None:
    """Refuse a folder that is neither empty nor an output bag of before."""
    if not path.is_dir():
        raise BagError(f"{path} is no folder; it is not overwritten even by --force")
    there = {child.name for child in path.iterdir()}
    if not there:
        return
    try:
        found = find_files(path, Damage())
    except BagError:
        found = None
    own = found is not None and found.own and there == {"metadata.yaml", *(file.name for file in found.paths)}
    if not own or not all(child.is_file() for child in path.iterdir()):
        raise BagError(
            f"{path} is a folder that holds more than a recording made by fdi; it is not overwritten even by --force"
        )


def _check_file(path: Path, kind: Kind) -> None:
    """Refuse a file that is no former result of a kind."""
    if path.is_dir():
        raise BagError(f"{path} is a folder; it is not overwritten even by --force")
    if not path.exists():
        return
    if not path.is_file():
        raise BagError(f"{path} is no file; it is not overwritten even by --force")
    with path.open("rb") as file:
        begin = file.read(_HEAD)
    if begin and not re.match(kind.value, begin):
        raise BagError(f"{path} is no result of fdi of this kind; it is not overwritten even by --force")
