# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Files: how large what is read may be, which are believed, and results that appear whole or not at all.

What is kept between two starts is taken over as it is found: compiled code is run, a state decides what is monitored.
So such a file must belong to this user or to root, nobody else may be able to write it, and no link is followed,
neither on reading nor on writing.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import glob
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
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, BinaryIO

from fdi_ros.errors import BagError

# Limits ---------------------------------------------------------------------------------------------------------------
# Far above what gyros need, and such that nothing read takes 1 GB of memory or runs on without end; docs/security.md
# says what happens beyond each.

CHUNK_BYTES = 1 << 26  # of one chunk or message of a recording, decompressed
PORTION_BYTES = 1 << 24  # messages of a database are handed on when they hold so much
FREE_BYTES, FREE_RATIO = (
    1 << 28,
    50,
)  # a recording may unpack to so many bytes, and so many times its own size more
RECORDS, RECORD_BYTES = 300_000, 4096
"""An MCAP file may hold so many records outside chunks, and one for each so many of its bytes more."""
CHANNELS = (
    4096  # topics of one recording, and descriptions of topics and of types in one file
)
DESCRIPTIONS = 4 * CHANNELS  # read from one chunk at most
DESCRIPTION_BYTES = 1 << 20  # of the description of a topic or a type
NAME = 255  # characters of the name of a topic or a type, as in DDS
FILES = 800  # files of one recording; they are open together
LATEST = (
    2**31 * 10**9 - 1
)  # ns: times of recording lie between 0 and this, in 2038: what a stamp of ROS 2 can say
EARLIEST = 946_684_800 * 10**9
"""ns: a time before this, the year 2000, is no date: it counts from a start (of an autopilot, of a simulation)."""
LOG_SPAN = 10**13
"""us: times of a flight log lie between 0, the start of the autopilot, and this, 115 days; or they are dates."""
ULOG_BYTES, TLOG_BYTES = 1 << 28, 1 << 27
"""Of a log that a library reads whole: PX4's, hours of it, and that of a ground station, a day of it."""
ULOG_FIELDS, ULOG_OTHER_BYTES, ULOG_MESSAGE_COST, ULOG_TOPIC_COST = (
    1000,
    1 << 26,
    1 << 8,
    1 << 16,
)
"""Of PX4's: fields of a message; bytes of messages that are no samples, each counted as so many more, for a library
makes an object of each, and of a topic one for each field."""
ROS1_INDEX_BYTES = 48 << 20
"""Of the index of a bag of ROS 1, 12 for each message of any topic: an hour at 1100 messages a second."""
CSV_LINE_BYTES = 1 << 20  # of the line of names of a table of text
CSV_COLUMNS = 4096
STEPS, STEPS_PER_BYTE = 10_000_000, 20
"""A query of a database may take so many steps of SQLite, and so many for each byte of the file more."""

YAML_BYTES = 1 << 20
YAML_NODES = 50_000  # values of a YAML file, those behind aliases counted each time
YAML_DEPTH = 50
YAML_DIGITS = 64  # characters of a number


def max_unpacked_bytes(size: int) -> int:
    """Bytes that a recording of so many bytes may unpack to."""
    return FREE_BYTES + FREE_RATIO * size


# What is believed -----------------------------------------------------------------------------------------------------

OTHERS = stat.S_IWGRP | stat.S_IWOTH  # bits of the mode by which others can write


class DistrustError(OSError):
    """A file or folder that somebody else may have written; `strerror` says why."""

    def __init__(self, path: Path | str, why: str) -> None:
        super().__init__(0, why, str(path))


def check_trusted(path: Path | str, about: os.stat_result | None = None) -> None:
    """Check that a file or folder can have been written by this user and root alone; links are not followed.

    ``about``: what is known of it already. `DistrustError` if that is not so, `OSError` if there is no such file.
    """
    about = about or os.lstat(path)
    if stat.S_ISLNK(about.st_mode):
        raise DistrustError(path, "it is a link")
    if about.st_uid not in (0, os.geteuid()):
        raise DistrustError(path, f"it belongs to another user ({about.st_uid})")
    if about.st_mode & OTHERS:
        raise DistrustError(
            path, f"others can write it (mode {stat.S_IMODE(about.st_mode):o})"
        )


def close_to_others(folder: Path | str) -> None:
    """Take from others the right to write a folder of this user, and check it; what lies in it must be checked still.

    `DistrustError` if it belongs to another user, or is a link; `OSError` if there is none, or it cannot be changed.
    """
    about = os.lstat(folder)
    if (
        about.st_mode & OTHERS
        and about.st_uid == os.geteuid()
        and stat.S_ISDIR(about.st_mode)
    ):
        os.chmod(folder, stat.S_IMODE(about.st_mode) & ~OTHERS, follow_symlinks=False)
        about = os.lstat(folder)
    check_trusted(folder, about)


def check_ancestor(folder: Path | str) -> None:
    """Check that in a folder above ours nobody else can put another in place of ours.

    `DistrustError` if others can write it, and it is not sticky; `OSError` if there is none.
    """
    mode = os.stat(folder).st_mode
    # That a group can is usual where every user has one of their own.
    if mode & stat.S_IWOTH and not mode & stat.S_ISVTX:
        raise DistrustError(
            folder, f"everybody can write it (mode {stat.S_IMODE(mode):o})"
        )


@contextlib.contextmanager
def lock(path: str) -> Iterator[None]:
    """Hold a lock file alone; where the file system has no locks there is nothing better.

    `OSError` if it cannot be opened, or is a link; nothing is ever written to it.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    with open(os.open(path, flags, 0o600), "rb", buffering=0) as file:
        with contextlib.suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def read_trusted(path: Path, most: int) -> bytes:
    """Read a regular file that only this user or root can have written, so many bytes of it at most.

    `DistrustError` if somebody else may have, or it is no regular file; `OSError` if it cannot be read.
    """
    with open_regular(path, links=False) as file:
        check_trusted(path, os.fstat(file.fileno()))
        return file.read(most)


def open_regular(path: Path | str, links: bool = True) -> BinaryIO:
    """Open a regular file for reading, whoever has written it: no pipe, device or socket is opened or waited for.

    `DistrustError` if it is another thing, or a link and these are not followed; `OSError` if it cannot be opened.
    """
    _check_regular(path, os.stat(path) if links else os.lstat(path))
    flags = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | (0 if links else os.O_NOFOLLOW)
    file = open(path, "rb", opener=lambda name, _: os.open(name, flags))  # noqa: SIM115, it is given to the caller
    try:
        # What was there may have become another thing since.
        _check_regular(path, os.fstat(file.fileno()))
    except OSError:
        file.close()
        raise
    return file


def _check_regular(path: Path | str, about: os.stat_result) -> None:
    if stat.S_ISLNK(about.st_mode):
        raise DistrustError(path, "it is a link")
    if stat.S_ISDIR(about.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(about.st_mode):
        raise DistrustError(path, "it is no regular file")


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Write a file that takes its place when all is written and on the disk, or is gone if something fails: `OSError`.

    It is written under a name that nobody can foresee, and created there: what lies at a name is never written to.
    """
    _remove_abandoned(path, path.parent, 16)
    part = path.with_name(f".{path.name}.{secrets.token_hex(8)}")
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
    with open(os.open(part, flags, 0o644), "wb") as file:
        try:
            with contextlib.suppress(OSError):
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            os.fchmod(
                file.fileno(), stat.S_IMODE(os.fstat(file.fileno()).st_mode) & ~OTHERS
            )
            yield file
            file.flush()
            os.fsync(file.fileno())
            os.replace(part, path)
        except BaseException:
            with contextlib.suppress(OSError):
                os.unlink(part)
            raise


# Results --------------------------------------------------------------------------------------------------------------
# The one writer of results, for every command. `-` is standard output. What is no file (a device, a pipe) is written
# through, once all that goes there is known.

STANDARD_OUTPUT = Path("-")
MADE_BY = {
    "generator": "fdi_ros"
}  # first in every file of figures: a mark by which a former result is recognised
_OPEN_DESCRIPTOR = re.compile(
    r"/dev/std(in|out|err)|(/dev|/proc/(self|thread-self|[0-9]+))/fd/[0-9]+"
)
"""Names of what is open already, by whatever name it lies on the disk."""
JUST_MADE = 1.0  # s; so young a folder may not be locked yet by who has made it


def is_open_already(path: Path) -> bool:
    """Whether a path names standard output or another open descriptor."""
    return path == STANDARD_OUTPUT or _OPEN_DESCRIPTOR.fullmatch(str(path)) is not None


def is_stream(path: Path) -> bool:
    """Whether what is written there goes through: standard output, a pipe, a terminal or another device."""
    if is_open_already(path):
        return True
    try:
        mode = path.stat().st_mode
    except OSError:
        return False
    return stat.S_ISCHR(mode) or stat.S_ISFIFO(mode)


def real_path(path: Path) -> Path:
    """Return where a path leads; a circle of links leads to itself."""
    return Path(os.path.realpath(path))


@contextlib.contextmanager
def whole(path: Path) -> Iterator[Path]:
    """Give a path to write a file or make a folder at; it takes its place when all is written, or is gone.

    `BagError` if it cannot be written.
    """
    if is_stream(path):
        with _scratch(path, Path(tempfile.gettempdir())) as folder:
            yield folder / "output"
            _copy_to_stream(folder / "output", path)
        return
    path = real_path(path)
    with _scratch(path, path.parent) as folder:
        new, before = folder / path.name, folder / f"{path.name}.before"
        yield new
        # A file takes the place of another in one step, a folder only that of nothing.
        if new.is_dir() and path.exists():
            os.replace(path, before)
        try:
            os.replace(new, path)
        except OSError:
            if before.exists():
                os.replace(before, path)
            raise


def write_text(target: Path, text: str) -> None:
    """Write a text file, whole or not at all; `BagError` if it cannot be written."""
    with whole(target) as path:
        path.write_text(text, encoding="utf-8", errors="replace")


def write_json(target: Path | None, figures: Mapping[str, Any]) -> None:
    """Write figures as JSON, marked as of this package; None: not asked for. `BagError` if it cannot be written."""
    if target is not None:
        write_text(
            target,
            json.dumps(plain({**MADE_BY, **figures}), indent=2, allow_nan=False) + "\n",
        )


def plain(value: Any) -> Any:
    """Return a value in the types of JSON: arrays as lists, what is not finite as null.

    A dataclass becomes an object of its fields, unless it has a method ``as_json`` that gives another form.
    """
    if hasattr(value, "as_json"):
        return plain(value.as_json())
    if is_dataclass(value):
        return {
            field.name: plain(getattr(value, field.name)) for field in fields(value)
        }
    if isinstance(value, Mapping):
        return {str(name): plain(one) for name, one in value.items()}
    if hasattr(value, "tolist"):
        # An array of NumPy, or one number of it.
        value = value.tolist()
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [plain(one) for one in value]
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


@contextlib.contextmanager
def _scratch(path: Path, parent: Path) -> Iterator[Path]:
    """Give a folder to write in, beside where it is to go: there putting it in place is one step."""
    _remove_abandoned(path, parent, 8)
    # Named before it is made: a signal at any moment leaves nothing behind.
    folder = parent / f".{path.name}.{secrets.token_hex(4)}"
    try:
        folder.mkdir(mode=0o700)
        with _opened(folder) as descriptor:
            # Where the file system has no locks, what a killed run leaves stays.
            with contextlib.suppress(OSError):
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            yield folder
    except OSError as error:
        if isinstance(error, BrokenPipeError) and path == STANDARD_OUTPUT:
            raise
        raise BagError(f"cannot write {path}: {error.strerror or error}") from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _remove_abandoned(path: Path, parent: Path, digits: int) -> None:
    """Remove scratch files and folders of a path that killed runs have left.

    Their names end with so many hexadecimal digits; a running process holds a lock on each.
    """
    pattern = f".{glob.escape(path.name)}.{'[0-9a-f]' * digits}"
    with contextlib.suppress(OSError):
        for left in parent.glob(pattern):
            with contextlib.suppress(OSError), _opened(left) as descriptor:
                about = os.fstat(descriptor)
                own = about.st_uid == os.geteuid()
                if not own or time.time() - about.st_mtime <= JUST_MADE:
                    continue
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if stat.S_ISDIR(about.st_mode):
                    shutil.rmtree(left, ignore_errors=True)
                elif stat.S_ISREG(about.st_mode):
                    os.unlink(left)


@contextlib.contextmanager
def scratch_folder(name: str) -> Iterator[Path]:
    """Give a temporary folder; it is removed at the end, or by the next use after a kill."""
    parent = Path(tempfile.gettempdir())
    path = parent / name
    with _scratch(path, parent) as folder:
        yield folder


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[int]:
    """Open a file or folder; a lock on it ends with the process."""
    descriptor = os.open(
        path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC
    )
    try:
        yield descriptor
    finally:
        os.close(descriptor)
