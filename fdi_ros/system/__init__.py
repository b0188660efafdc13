# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The computer around: files and their limits, text from outside, processes that share the work.

Here: what an installation brings, the files of ``config/``, wherever they lie, and libraries that live nodes do
without. pip installs all that setup.py requires. ROS packages of a distribution bring no more than has a rosdep key;
what reads recordings has none.
"""

from __future__ import annotations

import importlib
import sys
import sysconfig
from collections.abc import Sequence
from pathlib import Path

from fdi_ros.errors import FdiError
from fdi_ros.system.text import visible

_PACKAGE = Path(__file__).parents[1]


def shipped_folder() -> Path | None:
    """Return the folder ``config`` of the clone or of the installation; None if there is none.

    pip and colcon put it into ``share/fdi_ros`` below the prefix that the package lies in.
    """
    clone = _PACKAGE.parent
    places = [clone / "config"] if (clone / "package.xml").is_file() else []
    places += [parent / "share" / "fdi_ros" / "config" for parent in _PACKAGE.parents]
    return next((place for place in places if place.is_dir()), None)


def shipped_files() -> list[Path]:
    """Return all shipped files."""
    place = shipped_folder()
    return (
        sorted(path for path in place.rglob("*.*") if path.is_file())
        if place is not None
        else []
    )


def resolve(path: str) -> Path:
    """Return a path as given; if nothing is there, the shipped file that it names, and say so.

    A name alone, and ``config/...`` as in a clone, names a shipped file.
    """
    given = Path(path)
    if given.exists():
        return given
    place = shipped_folder()
    for shipped in shipped_files():
        if path == shipped.name or (
            place is not None and given == Path("config") / shipped.relative_to(place)
        ):
            print(visible(f"fdi: no {given} here, taking {shipped}"), file=sys.stderr)
            return shipped
    return given


BAGS = ("mcap", "rosbags", "lz4", "zstandard")  # what reads and writes recordings
PROGRESS = ("tqdm",)
POOL = (*PROGRESS, "joblib")  # what shares work among processes
REQUIRED = (*BAGS, *POOL)  # of setup.py, for every installation by pip
PACKAGES = {
    "serial": "pyserial"
}  # what pip calls a library that it calls otherwise than Python does


def require(who: str, libraries: Sequence[str]) -> None:
    """Check that libraries can be imported, which ``who`` needs, in words for people.

    `FdiError` if some are missing: one line with the command that brings them.
    """
    missing = [library for library in libraries if not there(library)]
    if not missing:
        return
    # By their names: fdi_ros itself is in no index, so its extras can be asked for in a clone alone.
    names = [PACKAGES.get(library, library) for library in missing]
    listed = " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))
    raise FdiError(f"{who} needs {listed}: {_pip()} {' '.join(names)}")


def there(library: str) -> bool:
    """Whether a library can be imported."""
    try:
        importlib.import_module(library)
    except ImportError:
        return False
    return True


def _pip() -> str:
    """Return the command by which pip installs here: the Python of a distribution refuses the plain one (PEP 668)."""
    managed = Path(sysconfig.get_path("stdlib")) / "EXTERNALLY-MANAGED"
    own = sys.prefix != sys.base_prefix
    return (
        "pip install"
        if own or not managed.is_file()
        else "pip install --user --break-system-packages"
    )
