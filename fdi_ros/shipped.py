# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The files that come with the package, wherever it is installed: parameters, scenarios, studies, layouts, policy."""

from __future__ import annotations

import sys
from pathlib import Path

_PACKAGE = Path(__file__).parent


def folder() -> Path | None:
    """Return the folder ``config`` of the clone or of the installation; None if there is none.

    pip and colcon put it into ``share/fdi_ros`` below the prefix that the package lies in.
    """
    clone = _PACKAGE.parent
    places = [clone / "config"] if (clone / "package.xml").is_file() else []
    places += [parent / "share" / "fdi_ros" / "config" for parent in _PACKAGE.parents]
    return next((place for place in places if place.is_dir()), None)


def files() -> list[Path]:
    """Return all shipped files."""
    place = folder()
    return sorted(path for path in place.rglob("*.*") if path.is_file()) if place is not None else []


def resolve(path: str) -> Path:
    """Return a path as given; if nothing is there, the shipped file that it names, and say so.

    Parameters
    ----------
    path
        Given by a user. ``config/...`` names a shipped file, as it does in a clone.
    """
    given, place = Path(path), folder()
    if place is None or given.exists() or given.parts[:1] != ("config",):
        return given
    meant = place.joinpath(*given.parts[1:])
    if meant not in files():
        return given
    print(f"fdi: no {given} here, taking {meant}", file=sys.stderr)
    return meant
