# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the monitor's estimator is worth: the same measurements on this version and, beside it, on another one.

    python benchmark/estimator.py PART [--against COMMIT] [--trials N] [--data DIR] [--only TEXT] [--json FILE]
        [--detector NAME] [--set KEY=VALUE ...] [--seed N]

PART: {parts}; each prints what it measures above its table.

--against: the same program measures that commit of the repository too, in a process of its own, from a git worktree in
the user's cache folder. It is kept for the next run, with its compiled code (`git worktree remove` takes it away). Same
seeds, same streams. Without --trials each part takes a minute or so (flights, units: some); --only takes the rows whose
label holds the text. `sigma` is the standard deviation of the noise of a channel; six: the cone of two units of
config/two_imus.yaml; nine: three parallel units.
"""

from __future__ import annotations

import argparse
import importlib
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[1]
PARTS = {
    "drift": ("faults", "measure_drifts", "DRIFT_FIGURES"),
    "delay": ("faults", "measure_delays", "DELAY_FIGURES"),
    "next": ("faults", "measure_next", "NEXT_FIGURES"),
    "several": ("several", "measure", "FIGURES"),
    "units": ("unit_faults", "measure", "FIGURES"),
    "false": ("healthy", "measure_false", "FALSE_FIGURES"),
    "conditions": ("healthy", "measure_conditions", "CONDITION_FIGURES"),
    "nees": ("covariance", "measure", "FIGURES"),
    "recovery": ("covariance", "measure_level", "LEVEL_FIGURES"),
    "flights": ("flights", "measure", "FIGURES"),
    "cost": ("cost", "measure", "FIGURES"),
    "vibration": ("vibration", "measure", "FIGURES"),
}
"""Module, function and formats of its figures."""
WIDTH = 58
"""Of labels."""


def arguments_of() -> argparse.Namespace:
    about = (__doc__ or "").format(parts=", ".join(PARTS))
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("--against", metavar="COMMIT", help="version to be measured beside")
    parser.add_argument("--trials", type=int, help="of each row; what they are is the part's")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), help="folder of the recordings")
    parser.add_argument("--only", default="", metavar="TEXT", help="rows with this in their label")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    parser.add_argument("--detector", help="detector.name; as in the config unless given")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="parameter that wins")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    return parser.parse_args()


def worktree(commit: str) -> tuple[str, Path]:
    """Check a commit out into the cache folder, once; return its short name and the folder."""

    def git(*words: str) -> str:
        return subprocess.run(["git", "-C", str(ROOT), *words], check=True, capture_output=True, text=True).stdout

    name = git("rev-parse", "--short", f"{commit}^{{commit}}").strip()
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "fdi_ros" / f"against_{name}"
    if not (folder / ".git").exists():
        git("worktree", "prune")
        git("worktree", "add", "--detach", str(folder), name)
    return name, folder


def worker(arguments: argparse.Namespace) -> None:
    """Measure the version that is imported; write a line of JSON for each row."""
    from trials import Asked

    module, function, _ = PARTS[arguments.part]
    settings = {name: yaml.safe_load(value) for name, _, value in (text.partition("=") for text in arguments.set)}
    settings |= {"detector.name": arguments.detector} if arguments.detector else {}
    asked = Asked(arguments.trials, arguments.seed, arguments.data, arguments.only, settings)
    begun = time.perf_counter()
    for label, figures in getattr(importlib.import_module(module), function)(asked):
        took, begun = time.perf_counter() - begun, time.perf_counter()
        print(json.dumps([label, {**figures, "took_s": took}], default=float), flush=True)


def started(folder: Path) -> subprocess.Popen[str]:
    """Start a process that measures the version in a folder."""
    before = os.environ.get("PYTHONPATH")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), *([before] if before else [])])}
    command = [sys.executable, __file__, *sys.argv[1:], "--worker"]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)


def rows_of(process: subprocess.Popen[str]) -> Iterator[tuple[str, dict[str, Any]]]:
    assert process.stdout is not None
    for line in process.stdout:
        label, figures = json.loads(line)
        yield label, figures
    if process.wait():
        raise SystemExit(f"the process that measures ended with {process.returncode}")


def cell(value: Any, form: str) -> str:
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "-"
    return value if isinstance(value, str) else format(value, form)


def main() -> None:
    arguments = arguments_of()
    if arguments.worker:
        worker(arguments)
        return
    versions = {"here": ROOT}
    if arguments.against:
        commit, folder = worktree(arguments.against)
        versions = {commit: folder, **versions}
    name, _, formats = PARTS[arguments.part]
    module = importlib.import_module(name)
    print(f"{(module.__doc__ or '').rstrip()}\n")
    columns = {**getattr(module, formats), "took_s": ".1f"}
    widths = {name: max(len(name), 7) for name in columns}
    print(f"{'':{WIDTH}} {'version':9}" + " ".join(f"{name.replace('_', ' '):>{widths[name]}}" for name in columns))
    kept: list[dict[str, Any]] = []
    processes: list[subprocess.Popen[str]] = []
    try:
        measured = []
        for folder in versions.values():
            processes.append(started(folder))
            rows = rows_of(processes[-1])
            # Times are taken one version after the other.
            measured.append(iter(list(rows)) if arguments.part == "cost" else rows)
        # Both measure the same rows in the same order.
        for together in zip(*measured, strict=True):
            label = together[0][0]
            assert all(other == label for other, _ in together), together
            for version, (_, figures) in zip(versions, together, strict=True):
                cells = " ".join(f"{cell(figures.get(c), form):>{widths[c]}}" for c, form in columns.items())
                print(f"{label:{WIDTH}} {version:9}{cells} {figures.get('words', '')}".rstrip(), flush=True)
                kept.append({"label": label, "version": version, **figures})
                label = ""
    finally:
        for process in processes:
            process.terminate()
    if arguments.json:
        arguments.json.write_text(json.dumps({"command": sys.argv, "rows": kept}, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
