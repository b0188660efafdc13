"""Files and folders that are written: nothing is overwritten unasked, and they appear whole or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from fdi_ros.errors import BagError

_OF_A_BAG = (".mcap", ".db3", ".zstd", ".yaml", ".db3-wal", ".db3-shm")


def check_targets(targets: Sequence[Path | None], force: bool, sources: Sequence[Path | None]) -> None:
    """Refuse targets that are one another, or that `check_target` refuses; None stands for one not asked for.

    Raises
    ------
    BagError
        If one may not be written; before any work is done.
    """
    wanted = [target for target in targets if target is not None]
    for k, target in enumerate(wanted):
        if target.resolve() in [other.resolve() for other in wanted[:k]]:
            raise BagError(f"cannot write {target}: two outputs have this name")
        check_target(target, force, [source for source in sources if source is not None])


def check_target(path: Path, force: bool, sources: Sequence[Path] = ()) -> None:
    """Refuse to write where something is that should stay.

    Parameters
    ----------
    path
        Where a file or a folder is to be written.
    force
        What is there may be overwritten.
    sources
        What is read, recording, config and so on: never overwritten.

    Raises
    ------
    BagError
        If it may not be written; before any work is done.
    """
    if not path.absolute().parent.is_dir():
        raise BagError(f"cannot write {path}: there is no folder {path.absolute().parent}")
    for source in sources:
        if _within(path.resolve(), source.resolve()):
            raise BagError(f"cannot write {path}: it belongs to {source}, which is read")
    if not (path.exists() or path.is_symlink()):
        return
    if not force:
        raise BagError(f"{path} exists already; --force overwrites it")
    if path.is_dir() and not all(child.is_file() and child.name.endswith(_OF_A_BAG) for child in path.iterdir()):
        raise BagError(f"{path} is a folder that holds more than a recording; it is not overwritten even by --force")


def _within(path: Path, folder: Path) -> bool:
    return path == folder or folder in path.parents or path in folder.parents


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Give a path to write a file to; it takes its place when all is written, and is gone if something fails.

    Raises
    ------
    BagError
        If it cannot be written.
    """
    with _beside(path) as folder:
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
    with _beside(path) as folder:
        yield folder / path.name
        if path.exists():
            os.replace(path, folder / "before")
        os.replace(folder / path.name, path)


@contextmanager
def _beside(path: Path) -> Iterator[Path]:
    # In the same folder, hence on the same file system: only there is putting it in place one step.
    try:
        folder = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.absolute().parent))
    except OSError as error:
        raise BagError(f"cannot write {path}: {error.strerror}") from error
    try:
        yield folder
    except OSError as error:
        raise BagError(f"cannot write {path}: {error.strerror or error}") from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)
