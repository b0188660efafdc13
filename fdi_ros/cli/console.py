"""What a verb prints: tables unless ``--quiet``, and its figures as JSON where asked for."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fdi_ros.cli.outputs import say_written, whole_file, words
from fdi_ros.text import MADE_BY


def say(arguments: argparse.Namespace, text: str) -> None:
    """Print for people, unless they asked for quiet; to standard error where standard output is taken by a file."""
    if not arguments.quiet:
        words([value for value in vars(arguments).values() if isinstance(value, Path)]).write(text)


def wrote(arguments: argparse.Namespace, targets: Sequence[Path | None]) -> None:
    """Confirm what was written, unless they asked for quiet."""
    if not arguments.quiet:
        say_written(targets)


def write_json(target: Path | None, figures: Mapping[str, Any]) -> None:
    """Write figures as JSON, marked as of this package; None: not asked for."""
    if target is not None:
        with whole_file(target) as path:
            text = json.dumps(plain({**MADE_BY, **figures}), indent=2, allow_nan=False)
            path.write_text(f"{text}\n", encoding="utf-8")


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
