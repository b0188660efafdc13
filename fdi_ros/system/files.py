# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Files: limits for reading, files that are trusted, results written whole or not at all.

Files kept between two starts are trusted: compiled code is executed, a state decides
which channels are monitored. Such a file must belong to this user or to root, and
nobody else may have write access. Links are followed neither on reading nor on writing.
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
from typing import Any, BinaryIO, NamedTuple

from fdi_ros.errors import BagError

# Limits ---------------------------------------------------------------------------------------------------------------
# All limits are far above the needs of gyros. No input takes 1 GB of memory or runs
# without end. docs/security.md describes the effect of each limit.


class RecordingLimits(NamedTuple):
    """Limits of reading any recording."""

    #: largest chunk or message of a recording, decompressed
    chunk_bytes: int = 1 << 26
    #: messages of a database are handed on when they hold so much
    portion_bytes: int = 1 << 24
    #: bytes that any recording may unpack to, beside `free_ratio` times its size
    free_bytes: int = 1 << 28
    #: multiple of its size that a recording may unpack to
    free_ratio: int = 50
    #: topics of one recording, and descriptions of topics and of types in one file
    topics: int = 4096
    #: longest description of a topic or a type
    description_bytes: int = 1 << 20
    #: characters of the name of a topic or a type, as in DDS
    name_length: int = 255
    #: files of one recording, all open together
    files: int = 800


RECORDING = RecordingLimits()


class McapLimits(NamedTuple):
    """Limits of reading an MCAP file."""

    #: records outside chunks
    records: int = 300_000
    #: bytes of the file for each further record
    record_bytes: int = 4096
    #: descriptions read from one chunk: four times the topics
    descriptions: int = 4 * RECORDING.topics


MCAP = McapLimits()


class Times(NamedTuple):
    """Times that a recording may have."""

    #: latest time of recording, ns: the largest stamp of ROS 2, in 2038
    latest: int = 2**31 * 10**9 - 1
    #: Earliest date, the year 2000, ns. Earlier times count from the start of a
    #: system.
    earliest: int = 946_684_800 * 10**9
    #: Longest time of a flight log, us: 115 days since the start of the autopilot.
    log_span: int = 10**13


TIMES = Times()


class LogLimits(NamedTuple):
    """Limits of logs and recordings that a library reads."""

    #: largest ULog, bytes: hours of PX4
    ulog_bytes: int = 1 << 28
    #: largest tlog, bytes: a day of telemetry
    tlog_bytes: int = 1 << 27
    #: fields of a message
    ulog_fields: int = 1000
    #: bytes of messages without samples
    ulog_other_bytes: int = 1 << 26
    #: bytes of the objects that pyulog makes of each message
    ulog_message_cost: int = 1 << 8
    #: bytes of the objects that pyulog makes of each topic
    ulog_topic_cost: int = 1 << 16
    #: index of a ROS 1 bag, 12 bytes per message: an hour at 1100 messages per
    #: second
    ros1_index_bytes: int = 48 << 20


LOGS = LogLimits()


class TableLimits(NamedTuple):
    """Limits of reading a table of text."""

    #: longest line of names, bytes
    line_bytes: int = 1 << 20
    #: columns of a table, as many as topics
    columns: int = 4096


TABLE = TableLimits()


class SqliteLimits(NamedTuple):
    """SQLite steps that any query may take."""

    #: steps for a file of any size
    steps: int = 10_000_000
    #: further steps for each byte of the file
    steps_per_byte: int = 20


SQLITE = SqliteLimits()


#: of the description of a robot
URDF_BYTES = 1 << 22


class YamlLimits(NamedTuple):
    """Limits of reading a YAML file."""

    #: longest file, bytes
    length: int = 1 << 20
    #: values of a file, those behind aliases counted each time
    nodes: int = 50_000
    #: deepest nesting
    depth: int = 50
    #: characters of a number
    digits: int = 64


YAML = YamlLimits()


def max_unpacked_bytes(size: int) -> int:
    """Return the bytes that a recording of this size may unpack to."""
    return RECORDING.free_bytes + RECORDING.free_ratio * size


# What is believed -----------------------------------------------------------------------------------------------------

#: bits of the mode by which others can write
WRITABLE_BY_OTHERS = stat.S_IWGRP | stat.S_IWOTH


class DistrustError(OSError):
    """Raised for a path that another user may have written; `strerror` gives the reason."""

    def __init__(self, path: Path | str, why: str) -> None:
        super().__init__(0, why, str(path))


def check_trusted(path: Path | str, about: os.stat_result | None = None) -> None:
    """Check that only this user and root can have written a path. Links are not followed.

    ``about``: the result of `os.lstat`, if known. `DistrustError` if others can have
    written the path, `OSError` if nothing exists there.
    """
    about = about or os.lstat(path)
    if stat.S_ISLNK(about.st_mode):
        raise DistrustError(path, "it is a link")
    if about.st_uid not in (0, os.geteuid()):
        raise DistrustError(path, f"it belongs to another user ({about.st_uid})")
    if about.st_mode & WRITABLE_BY_OTHERS:
        raise DistrustError(
            path, f"others can write it (mode {stat.S_IMODE(about.st_mode):o})"
        )


def close_to_others(folder: Path | str) -> None:
    """Remove the write permission of others from a folder of this user, and check the folder.

    Its contents are not checked. `DistrustError` if the folder belongs to another user
    or is a link, `OSError` if the folder is missing or cannot be changed.
    """
    about = os.lstat(folder)
    if (
        about.st_mode & WRITABLE_BY_OTHERS
        and about.st_uid == os.geteuid()
        and stat.S_ISDIR(about.st_mode)
    ):
        os.chmod(
            folder,
            stat.S_IMODE(about.st_mode) & ~WRITABLE_BY_OTHERS,
            follow_symlinks=False,
        )
        about = os.lstat(folder)
    check_trusted(folder, about)


def check_ancestor(folder: Path | str) -> None:
    """Check that nobody else can replace our folder inside this one.

    `DistrustError` if others can write here and the sticky bit is not set, `OSError` if
    the folder is missing.
    """
    mode = os.stat(folder).st_mode
    # That a group can is usual where every user has one of their own.
    if mode & stat.S_IWOTH and not mode & stat.S_ISVTX:
        raise DistrustError(
            folder, f"everybody can write it (mode {stat.S_IMODE(mode):o})"
        )


@contextlib.contextmanager
def lock(path: str) -> Iterator[None]:
    """Hold an exclusive lock on a file; without effect on file systems that have no locks.

    Nothing is written to the file. `OSError` if it is a link or cannot be opened.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    with open(os.open(path, flags, 0o600), "rb", buffering=0) as file:
        with contextlib.suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def read_trusted(path: Path, most: int) -> bytes:
    """Read at most this many bytes of a regular file that only this user or root can write.

    `DistrustError` if others can write it or the file is not regular, `OSError` if
    reading fails.
    """
    with open_regular(path, links=False) as file:
        check_trusted(path, os.fstat(file.fileno()))
        return file.read(most)


def open_regular(path: Path | str, links: bool = True) -> BinaryIO:
    """Open a regular file for reading. Pipes, devices and sockets are refused without waiting.

    `DistrustError` if the path is not a regular file, or a link and links are not
    allowed. `OSError` if opening fails.
    """
    _check_regular(path, os.stat(path) if links else os.lstat(path))
    flags = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | (0 if links else os.O_NOFOLLOW)
    file = open(path, "rb", opener=lambda name, _: os.open(name, flags))  # noqa: SIM115, it is given to the caller
    try:
        # The path may have been replaced since the first check.
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
    """Write a file that replaces the path once all is on the disk; on failure nothing remains.

    The scratch file has an unpredictable name and is created exclusively, so no
    existing file is written to. `OSError` if writing fails.
    """
    _remove_abandoned(path, path.parent, 16)
    part = path.with_name(f".{path.name}.{secrets.token_hex(8)}")
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
    with open(os.open(part, flags, 0o644), "wb") as file:
        try:
            with contextlib.suppress(OSError):
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            os.fchmod(
                file.fileno(),
                stat.S_IMODE(os.fstat(file.fileno()).st_mode) & ~WRITABLE_BY_OTHERS,
            )
            yield file
            file.flush()
            os.fsync(file.fileno())
            os.replace(part, path)
        except BaseException:  # Leave no part of a file, also if interrupted.
            with contextlib.suppress(OSError):
                os.unlink(part)
            raise


# Results --------------------------------------------------------------------------------------------------------------
# The only writer of results. `-` is standard output. Devices and pipes receive their
# content at the end, in one go.

STANDARD_OUTPUT = Path("-")
#: first in every file of figures: a mark by which a former result is recognised
MADE_BY = {"generator": "fdi_ros"}
_OPEN_DESCRIPTOR = re.compile(
    r"/dev/std(in|out|err)|(/dev|/proc/(self|thread-self|[0-9]+))/fd/[0-9]+"
)
"""Names of descriptors that are already open."""
#: age below which a scratch folder may not be locked yet by its maker, s
JUST_MADE = 1.0


def is_open_already(path: Path) -> bool:
    """Whether a path names standard output or another open descriptor."""
    return path == STANDARD_OUTPUT or _OPEN_DESCRIPTOR.fullmatch(str(path)) is not None


def is_stream(path: Path) -> bool:
    """Whether a path is standard output, a pipe, a terminal or another device."""
    if is_open_already(path):
        return True
    try:
        mode = path.stat().st_mode
    except OSError:
        return False
    return stat.S_ISCHR(mode) or stat.S_ISFIFO(mode)


def real_path(path: Path) -> Path:
    """Resolve all links of a path. A circle of links resolves to itself."""
    return Path(os.path.realpath(path))


@contextlib.contextmanager
def whole(path: Path) -> Iterator[Path]:
    """Give a path for a file or folder that replaces the target once complete.

    On failure nothing remains. `BagError` if writing fails.
    """
    if is_stream(path):
        with _scratch(path, Path(tempfile.gettempdir())) as folder:
            yield folder / "output"
            _copy_to_stream(folder / "output", path)
        return
    path = real_path(path)
    with _scratch(path, path.parent) as folder:
        new = folder / path.name
        before = folder / f"{path.name}.before"
        yield new
        # os.replace exchanges files in one step, but a folder only replaces a missing
        # path.
        if new.is_dir() and path.exists():
            os.replace(path, before)
        try:
            os.replace(new, path)
        except OSError:
            if before.exists():
                os.replace(before, path)
            raise


def write_text(target: Path, text: str) -> None:
    """Write a text file, whole or not at all. `BagError` if writing fails."""
    with whole(target) as path:
        path.write_text(text, encoding="utf-8", errors="replace")


def write_json(target: Path | None, figures: Mapping[str, Any]) -> None:
    """Write figures as JSON with the mark of this package, without a target do nothing.

    `BagError` if writing fails.
    """
    if target is not None:
        write_text(
            target,
            json.dumps(plain({**MADE_BY, **figures}), indent=2, allow_nan=False) + "\n",
        )


def plain(value: Any) -> Any:
    """Convert a value to the types of JSON: arrays to lists, NaN and infinity to null.

    A dataclass becomes an object of its fields, unless its method ``as_json`` returns
    another form.
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
        # An array or a scalar of NumPy.
        value = value.tolist()
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [plain(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _copy_to_stream(source: Path, path: Path) -> None:
    """Copy the content of a file to a stream."""
    with source.open("rb") as file:
        if path == STANDARD_OUTPUT:
            sys.stdout.flush()
            shutil.copyfileobj(file, sys.stdout.buffer)
            sys.stdout.flush()
        else:
            # Append: earlier content of the descriptor stays.
            with path.open("ab") as out:
                shutil.copyfileobj(file, out)


@contextlib.contextmanager
def _scratch(path: Path, parent: Path) -> Iterator[Path]:
    """Give a scratch folder beside the target, so that one rename moves the result in place."""
    _remove_abandoned(path, parent, 8)
    # The name exists before the folder, so that a signal at any moment leaves nothing.
    folder = parent / f".{path.name}.{secrets.token_hex(4)}"
    try:
        folder.mkdir(mode=0o700)
        with _opened(folder) as descriptor:
            # Without file locks, scratch files of killed processes stay.
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
    """Remove scratch files and folders of a path that killed processes have left.

    Their names end with this number of hexadecimal digits. A running process holds a
    lock on each.
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
    """Give a temporary folder. Its end, or the next use after a kill, removes the folder."""
    parent = Path(tempfile.gettempdir())
    path = parent / name
    with _scratch(path, parent) as folder:
        yield folder


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[int]:
    """Open a file or folder to lock it. The lock ends with the process."""
    descriptor = os.open(
        path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC
    )
    try:
        yield descriptor
    finally:
        os.close(descriptor)
