# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the monitor's estimator is worth: one harness of many measurements, each a part.

    python benchmark/estimator.py PART [--trials N] [--data DIR] [--only TEXT] [--json FILE] [--detector NAME]
        [--set KEY=VALUE ...] [--seed N]

PART: {parts}; each prints what it measures above its table.

Same seed, same streams: run in two checkouts, the figures of two versions stand beside each other. Without --trials
each part takes a minute or so (flights, units: some); --only takes the rows whose label holds the text. `sigma` is the
standard deviation of the noise of a channel; six: the cone of two units of config/two_imus.yaml; nine: three parallel
units.
"""

from __future__ import annotations

import argparse
import importlib
import json
import math
import sys
import time
from pathlib import Path
from typing import Any

import yaml
from trials import Asked

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
    "physics": ("physics", "measure", "FIGURES"),
    "accelerometers": ("accelerometers", "measure", "FIGURES"),
    "calibration": ("calibration", "measure", "FIGURES"),
}
"""Module, function and formats of its figures."""
WIDTH = 58  # of labels


def arguments_of() -> argparse.Namespace:
    about = (__doc__ or "").format(parts=", ".join(PARTS))
    parser = argparse.ArgumentParser(
        description=about, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("part", choices=PARTS)
    parser.add_argument(
        "--trials", type=int, help="of each row; what they are is the part's"
    )
    parser.add_argument(
        "--data",
        type=Path,
        default=Path("../shared/data"),
        help="folder of the recordings",
    )
    parser.add_argument(
        "--only", default="", metavar="TEXT", help="rows with this in their label"
    )
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    parser.add_argument(
        "--detector", help="detector.name; as in the config unless given"
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="parameter that wins",
    )
    parser.add_argument("--seed", type=int, default=1)
    return parser.parse_args()


def cell(value: Any, form: str) -> str:
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "-"
    return value if isinstance(value, str) else format(value, form)


def main() -> None:
    arguments = arguments_of()
    name, function, formats = PARTS[arguments.part]
    module = importlib.import_module(name)
    settings = {
        key: yaml.safe_load(value)
        for key, _, value in (text.partition("=") for text in arguments.set)
    }
    settings |= {"detector.name": arguments.detector} if arguments.detector else {}
    asked = Asked(
        arguments.trials, arguments.seed, arguments.data, arguments.only, settings
    )
    print(f"{(module.__doc__ or '').rstrip()}\n")
    columns = {**getattr(module, formats), "took_s": ".1f"}
    widths = {column: max(len(column), 7) for column in columns}
    print(
        f"{'':{WIDTH}}"
        + " ".join(
            f"{column.replace('_', ' '):>{widths[column]}}" for column in columns
        )
    )
    rows: list[dict[str, Any]] = []
    begun = time.perf_counter()
    for label, figures in getattr(module, function)(asked):
        figures["took_s"], begun = time.perf_counter() - begun, time.perf_counter()
        cells = " ".join(
            f"{cell(figures.get(column), form):>{widths[column]}}"
            for column, form in columns.items()
        )
        print(f"{label:{WIDTH}}{cells} {figures.get('words', '')}".rstrip(), flush=True)
        rows.append({"label": label, **figures})
    if arguments.json:
        result = json.dumps(
            {"command": sys.argv, "rows": rows}, indent=1, default=float
        )
        arguments.json.write_text(result, encoding="utf-8")


if __name__ == "__main__":
    main()
