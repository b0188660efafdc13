# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What was run: the facts that the reports of several verbs state alike."""

from __future__ import annotations

import argparse
import math
import platform

import numpy as np

from fdi_ros import __version__


def part_words(arguments: argparse.Namespace) -> str:
    """Name the part of the recording that was read."""
    return f"{arguments.start:g} s to {'the end' if math.isinf(arguments.end) else f'{arguments.end:g} s'}"


def versions() -> str:
    """Name the versions that figures may depend on."""
    return f"fdi_ros {__version__}, NumPy {np.__version__}, Python {platform.python_version()}"
