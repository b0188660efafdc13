# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a verb prints: words for people, unless ``--quiet``, and on standard error where standard output holds data."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TextIO

from fdi_ros.cli.outputs import Kind
from fdi_ros.limits import LINE
from fdi_ros.result_file import STANDARD_OUTPUT, is_open_already
from fdi_ros.text import shown


def say(arguments: argparse.Namespace, text: str) -> None:
    """Print for people, unless they asked for quiet."""
    if not arguments.quiet:
        _stream(value for value in vars(arguments).values() if isinstance(value, Path)).write(text)


def wrote(arguments: argparse.Namespace, outputs: Iterable[tuple[Path | None, Kind]]) -> None:
    """Confirm what was written, unless they asked for quiet; None stands for an output not asked for."""
    if arguments.quiet:
        return
    targets = [target for target, _ in outputs if target is not None]
    out = _stream(targets)
    for target in targets:
        if target != STANDARD_OUTPUT:
            out.write(f"wrote {shown(target, LINE)}\n")


def _stream(targets: Iterable[Path]) -> TextIO:
    """Return where to print for people: standard output, unless data goes there."""
    return sys.stderr if any(map(is_open_already, targets)) else sys.stdout
