"""What a verb prints: tables unless ``--quiet``, figures as JSON where asked for, ``-`` being standard output."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fdi_ros.bag.outputs import whole_file

STANDARD_OUTPUT = Path("-")


def say(arguments: argparse.Namespace, text: str) -> None:
    """Print for people, unless they asked for quiet; to standard error where standard output is taken by a file."""
    if not arguments.quiet:
        (sys.stderr if STANDARD_OUTPUT in vars(arguments).values() else sys.stdout).write(text)


def files(targets: Sequence[Path | None]) -> list[Path | None]:
    """Targets that are files: all but standard output."""
    return [target for target in targets if target != STANDARD_OUTPUT]


def write_json(target: Path | None, figures: Any) -> None:
    """Write figures as JSON; None: not asked for."""
    if target is None:
        return
    text = json.dumps(plain(figures), indent=2, allow_nan=False) + "\n"
    if target == STANDARD_OUTPUT:
        sys.stdout.write(text)
        return
    with whole_file(target) as path:
        path.write_text(text, encoding="utf-8")


def plain(value: Any) -> Any:
    """Return a value in the types of JSON: arrays as lists, what is not finite as null."""
    if isinstance(value, Mapping):
        return {str(name): plain(one) for name, one in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [plain(one) for one in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
