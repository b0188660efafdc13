# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Files that are opened without waiting, and those that are believed: nobody but this user or root has written them.

What is kept between two starts is taken over as it is found: compiled code is run, a state decides what is monitored.
So the file must belong to this user or to root, nobody else may be able to write it, and no link is followed, neither
on reading nor on writing.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import secrets
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

OTHERS = stat.S_IWGRP | stat.S_IWOTH  # bits of the mode by which others can write


class DistrustError(OSError):
    """A file or folder that somebody else may have written; `strerror` says why."""

    def __init__(self, path: Path | str, why: str) -> None:
        super().__init__(0, why, str(path))


def check(path: Path | str, about: os.stat_result | None = None) -> None:
    """Check that a file or folder can have been written by this user and root alone; links are not followed.

    ``about``: what is known of it already. `DistrustError` if that is not so, `OSError` if there is no such file.
    """
    about = about or os.lstat(path)
    if stat.S_ISLNK(about.st_mode):
        raise DistrustError(path, "it is a link")
    if about.st_uid not in (0, os.geteuid()):
        raise DistrustError(path, f"it belongs to another user ({about.st_uid})")
    if about.st_mode & OTHERS:
        raise DistrustError(path, f"others can write it (mode {stat.S_IMODE(about.st_mode):o})")


def close_to_others(folder: Path | str) -> None:
    """Take from others the right to write a folder of this user, and check it; what lies in it must be checked still.

    `DistrustError` if it belongs to another user, or is a link; `OSError` if there is none, or it cannot be changed.
    """
    about = os.lstat(folder)
    if about.st_mode & OTHERS and about.st_uid == os.geteuid() and stat.S_ISDIR(about.st_mode):
        os.chmod(folder, stat.S_IMODE(about.st_mode) & ~OTHERS, follow_symlinks=False)
        about = os.lstat(folder)
    check(folder, about)


def check_ancestor(folder: Path | str) -> None:
    """Check that in a folder above ours nobody else can put another in place of ours.

    `DistrustError` if others can write it, and it is not sticky; `OSError` if there is none.
    """
    mode = os.stat(folder).st_mode
    # That a group can is usual where every user has one of their own.
    if mode & stat.S_IWOTH and not mode & stat.S_ISVTX:
        raise DistrustError(folder, f"everybody can write it (mode {stat.S_IMODE(mode):o})")


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


def read(path: Path, most: int) -> bytes:
    """Read a regular file that only this user or root can have written, so many bytes of it at most.

    `DistrustError` if somebody else may have, or it is no regular file; `OSError` if it cannot be read.
    """
    with open_regular(path, links=False) as file:
        check(path, os.fstat(file.fileno()))
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
    part = path.with_name(f".{path.name}.{secrets.token_hex(8)}")
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
    with open(os.open(part, flags, 0o644), "wb") as file:
        try:
            os.fchmod(file.fileno(), stat.S_IMODE(os.fstat(file.fileno()).st_mode) & ~OTHERS)
            yield file
            file.flush()
            os.fsync(file.fileno())
            os.replace(part, path)
        except BaseException:
            with contextlib.suppress(OSError):
                os.unlink(part)
            raise
