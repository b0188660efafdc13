"""What a verb prints: tables unless ``--quiet``, figures as JSON where asked for, ``-`` being standard output."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fdi_ros.bag import outputs

OUTPUTS = ("output", "json", "csv", "report", "write")
"""Arguments that name what is written."""


def targets_of(arguments: argparse.Namespace) -> list[Path]:
    """Return what is to be written."""
    named = [getattr(arguments, name, None) for name in OUTPUTS]
    return [target for target in named if target is not None]


def say(arguments: argparse.Namespace, text: str) -> None:
    """Print for people, unless they asked for quiet; to standard error where data goes to standard output."""
    if not arguments.quiet:
        outputs.words(targets_of(arguments)).write(text)


def say_written(arguments: argparse.Namespace) -> None:
    """Confirm what was written, unless asked for quiet."""
    if not arguments.quiet:
        outputs.say_written(targets_of(arguments))


def write_json(target: Path | None, figures: Any) -> None:
    """Write figures as JSON; None: not asked for."""
    if target is not None:
        with outputs.whole_file(target) as path:
            path.write_text(json.dumps(plain(figures), indent=2, allow_nan=False) + "\n", encoding="utf-8")


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
