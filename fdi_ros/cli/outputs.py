"""What is written: files and folders appear whole or not at all, and take the place of nothing but a former result.

``-`` is standard output. What is no file (a device, a pipe) is written through, once all that goes there is known.
"""

from __future__ import annotations

import os
import re
import secrets
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from enum import Enum
from pathlib import Path
from typing import TextIO

from fdi_ros.bag.metadata import find_files
from fdi_ros.bag.raw import Damage
from fdi_ros.errors import BagError
from fdi_ros.limits import LINE
from fdi_ros.text import shown

STANDARD_OUTPUT = Path("-")
_PASSED_ON = re.compile(r"/dev/std(in|out|err)|(/dev|/proc/(self|thread-self|[0-9]+))/fd/[0-9]+")
"""Names of what is open already, by whatever name it lies on the disk."""
_LOOKED_AT = 1 << 16


class Kind(Enum):
    """What is written, and the pattern by which a former result of the kind is known: nothing else has this mark."""

    JSON = rb'\s*\{\s*"generator":\s*"fdi_ros"'
    CSV = rb"stamp,rate_x,rate_y,rate_z,std_x,|monitor,channel,kind,size,fault,at_s,"
    PAGE = rb'\s*(?i:<!doctype html>)[^\0]*?<meta name="generator" content="fdi_ros">'
    PARAMETERS = rb"(?:(?:[ \t]*#[^\n]*|---[^\n]*|[ \t]*)\n)*?[ \t]*#[^\n]*\bmade by fdi (?:inspect|setup|calibrate)\b"
    FOLDER = rb""
    """An output bag: known by its metadata."""


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
        if _real(target) in [_real(other) for other, _ in wanted[:k]] and not _swallows(target):
            raise BagError(f"cannot write {target}: two outputs have this name")
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
        if any(_within(_real(path), part) for part in _parts(source)):
            raise BagError(f"cannot write {path}: it belongs to {source}, which is read")
    if not (path.exists() or path.is_symlink()):
        return
    if not force:
        raise BagError(f"{path} exists already; --force overwrites it")
    if kind is Kind.FOLDER:
        _check_folder(path)
    else:
        _check_file(path, kind)


def is_stream(path: Path) -> bool:
    """Whether what is written there goes through: standard output, a pipe, a terminal or another device."""
    if _passed_on(path):
        return True
    try:
        mode = path.stat().st_mode
    except OSError:
        return False
    return stat.S_ISCHR(mode) or stat.S_ISFIFO(mode)


def _passed_on(path: Path) -> bool:
    return path == STANDARD_OUTPUT or _PASSED_ON.fullmatch(str(path)) is not None


def words(targets: Sequence[Path | None]) -> TextIO:
    """Return where to print for people: standard output, unless data goes there."""
    taken = any(target is not None and _passed_on(target) for target in targets)
    return sys.stderr if taken else sys.stdout


def say_written(targets: Sequence[Path | None]) -> None:
    """Confirm what was written; None stands for a target not asked for."""
    out = words(targets)
    for target in targets:
        if target is not None and target != STANDARD_OUTPUT:
            out.write(f"wrote {shown(target, LINE)}\n")


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Give a path to write a file to; it takes its place when all is written, and is gone if something fails.

    Raises
    ------
    BagError
        If it cannot be written.
    """
    if is_stream(path):
        with _scratch(path, None) as folder:
            yield folder / "output"
            _pass_on(folder / "output", path)
        return
    path = _real(path)
    with _scratch(path, path.parent) as folder:
        yield folder / path.name
        os.replace(folder / path.name, path)


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """Give a path to make a folder at; it takes its place when all is written, and is gone if something fails.

    Raises
    ------
    BagError
        If it cannot be written.
    """
    path = _real(path)
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


def _real(path: Path) -> Path:
    """Where a path leads; a circle of links leads to itself."""
    return Path(os.path.realpath(path))


def _swallows(path: Path) -> bool:
    """Whether several outputs may go there: a device keeps none of them apart, a file and standard output do."""
    return path != STANDARD_OUTPUT and is_stream(path)


def _parts(source: Path) -> list[Path]:
    """Where all that belongs to a source lies: metadata.yaml and links may lead out of the folder of a recording."""
    found = [_real(source)]
    if source.is_dir():
        found.append(_real(source / "metadata.yaml"))
        # What is no recording is refused when it is read.
        with suppress(BagError):
            found += map(_real, find_files(source, Damage()).paths)
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
        begin = file.read(_LOOKED_AT)
    if begin and not re.match(kind.value, begin):
        raise BagError(f"{path} is no result of fdi of this kind; it is not overwritten even by --force")


def _pass_on(source: Path, path: Path) -> None:
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
    # Named before it is made: a signal at any moment leaves nothing behind.
    folder = (parent or Path(tempfile.gettempdir())) / f".{path.name}.{secrets.token_hex(4)}"
    try:
        folder.mkdir(mode=0o700)
        yield folder
    except OSError as error:
        if isinstance(error, BrokenPipeError) and path == STANDARD_OUTPUT:
            raise
        raise BagError(f"cannot write {path}: {error.strerror or error}") from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)
