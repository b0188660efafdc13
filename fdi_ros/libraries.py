# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Libraries that the live nodes do without: whether they are there, and the command that brings them.

pip installs all that setup.py requires. ROS packages of a distribution bring no more than has a rosdep key; what reads
recordings has none.
"""

from __future__ import annotations

import importlib
import sys
import sysconfig
from collections.abc import Sequence
from pathlib import Path

from fdi_ros.errors import FdiError

BAGS = ("mcap", "rosbags", "lz4", "zstandard")
"""What reads and writes recordings."""
PROGRESS = ("tqdm",)
WORKERS = (*PROGRESS, "joblib")
"""What shares work among processes."""
REQUIRED = (*BAGS, *WORKERS)
"""Of setup.py, for every installation by pip."""


def require(who: str, libraries: Sequence[str], extra: str = "") -> None:
    """Check that libraries can be imported.

    Parameters
    ----------
    who
        Needs them, for people.
    libraries
        Names to import; those of the packages are the same.
    extra
        Of setup.py, that brings those that are not required.

    Raises
    ------
    FdiError
        If some are missing: one line with the command that brings them.
    """
    missing = [library for library in libraries if not there(library)]
    if not missing:
        return
    # The extra alone does where pip has installed the package; where a distribution has, pip may not know it.
    what = f"'fdi_ros[{extra}]'" if not set(missing) & set(REQUIRED) else " ".join(missing)
    listed = " and ".join(filter(None, (", ".join(missing[:-1]), missing[-1])))
    raise FdiError(f"{who} needs {listed}: {_pip()} {what}")


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
    return "pip install" if own or not managed.is_file() else "pip install --user --break-system-packages"
