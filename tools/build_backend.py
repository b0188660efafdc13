# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Build backend of pip: setuptools, with the libraries of the package at hand where a wheel is compiled (PEP 517)."""

from pathlib import Path

from setuptools import build_meta
from setuptools.build_meta import (
    build_editable,
    build_sdist,
    build_wheel,
    get_requires_for_build_editable,
    get_requires_for_build_sdist,
    prepare_metadata_for_build_editable,
    prepare_metadata_for_build_wheel,
)

__all__ = [
    "build_editable",
    "build_sdist",
    "build_wheel",
    "get_requires_for_build_editable",
    "get_requires_for_build_sdist",
    "get_requires_for_build_wheel",
    "prepare_metadata_for_build_editable",
    "prepare_metadata_for_build_wheel",
]


def get_requires_for_build_wheel(config_settings=None):
    """Return what setuptools needs, and what the package needs to run: it compiles itself."""
    build = build_meta.get_requires_for_build_wheel(config_settings)
    # Setuptools has just written the requirements; those of extras follow the first blank line.
    required = Path("fdi_ros.egg-info/requires.txt").read_text(encoding="utf-8")
    return [*build, *required.partition("\n\n")[0].split()]
