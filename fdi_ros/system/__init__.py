# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The computer around the package: installation, files and their limits, text, jobs.

This module finds the files of ``config/`` and checks for libraries that live nodes do
without. pip installs everything that setup.py requires. ROS packages depend on rosdep
keys only, and the libraries that read recordings have none.
"""

from __future__ import annotations

import importlib
import shutil
import sys
import sysconfig
from collections.abc import Sequence
from pathlib import Path

from fdi_ros.errors import FdiError
from fdi_ros.system.text import visible

_PACKAGE = Path(__file__).parents[1]


def shipped_folder() -> Path | None:
    """Return the folder ``config`` of the clone or of the installation, or None.

    pip and colcon install the folder as ``share/fdi_ros`` below the prefix of the
    package.
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
    """Return an existing path unchanged, or else the shipped file with this name.

    Shipped files are named alone, or as ``config/...`` in a clone. The choice is
    printed.
    """
    given = Path(path)
    found = find_shipped(given)
    if found != given:
        print(
            visible(f"fdi: there is no {given} here: taking the shipped {found}"),
            file=sys.stderr,
        )
    return found


def find_shipped(given: Path) -> Path:
    """Return an existing path unchanged, or else the shipped file with this name.

    Parameter files need no ending: ``px4`` is ``px4.yaml``. A path that is no shipped file
    is returned unchanged too.
    """
    place = shipped_folder()
    if given.exists() or place is None:
        return given
    for shipped in shipped_files():
        names = {Path(shipped.name), Path("config") / shipped.relative_to(place)}
        if shipped.parent == place and shipped.suffix == ".yaml":
            names.add(Path(shipped.stem))
        if given in names:
            return shipped
    return given


#: libraries that read and write recordings
BAGS = ("mcap", "rosbags", "lz4", "zstandard")
PROGRESS = ("tqdm",)
#: libraries that share work among processes
POOL = (*PROGRESS, "joblib")
#: of setup.py, for every installation by pip
REQUIREMENTS = (*BAGS, *POOL)
#: names on PyPI, where they differ from the names to import
PACKAGES = {"serial": "pyserial"}


def require(who: str, libraries: Sequence[str]) -> None:
    """Check that libraries can be imported, which ``who`` needs, in words for people.

    `FdiError` if some are missing: one line with the command that brings them.
    """
    missing = [library for library in libraries if not there(library)]
    if not missing:
        return
    # By their names: fdi_ros itself is in no index, so its extras can be asked for in a clone alone.
    names = [PACKAGES.get(library, library) for library in missing]
    from fdi_ros.system.text import listed

    raise FdiError(f"{who} needs {listed(names)}: {_pip()} {' '.join(names)}")


def there(library: str) -> bool:
    """Whether a library can be imported."""
    try:
        importlib.import_module(library)
    except ImportError:
        return False
    return True


def _pip() -> str:
    """Return the pip command for this Python, which a distribution may manage (PEP 668)."""
    managed = Path(sysconfig.get_path("stdlib")) / "EXTERNALLY-MANAGED"
    own = sys.prefix != sys.base_prefix
    if not own and managed.is_file():
        return "pip install --user --break-system-packages"
    found = shutil.which("pip")
    is_own = found is not None and Path(found).parent == Path(sys.executable).parent
    if own and not is_own:
        return f"{sys.executable} -m pip install"
    return "pip install"
