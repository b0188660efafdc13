# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""``fdi fleet``: many recordings, one dataset and one page."""

from __future__ import annotations

import argparse
import os
import sys
from contextlib import closing
from pathlib import Path

from tqdm import tqdm

from fdi_ros.cli.console import say, wrote
from fdi_ros.cli.outputs import Kind, check_targets
from fdi_ros.cli.provenance import versions
from fdi_ros.config.config import Config
from fdi_ros.errors import ConfigError
from fdi_ros.fleet.dataset import PAGE, Dataset
from fdi_ros.fleet.judging import Settings
from fdi_ros.fleet.recordings import Recordings, find_recordings
from fdi_ros.fleet.report import fleet_page, summary_lines
from fdi_ros.fleet.rows import NOT_MEASURED
from fdi_ros.fleet.run import run_fleet
from fdi_ros.fleet.study import load_injection
from fdi_ros.fleet.summary import FAULT_HEAD, channel_lines, fault_rows, fleet_figures, to_look_at, totals, unit_lines
from fdi_ros.report.text_table import table
from fdi_ros.result_file import write_json
from fdi_ros.text import shown

MOST_WORKERS = 256
LOOKS = 10
"""Flights to look at that are printed; the page has all."""


def run(arguments: argparse.Namespace) -> int:
    """Judge them, write the dataset and the page, print what to look at."""
    workers = (os.cpu_count() or 1) if arguments.workers is None else arguments.workers
    if not 1 <= workers <= MOST_WORKERS:
        raise ConfigError(f"--workers is {workers}, expected 1 to {MOST_WORKERS}")
    parameters = ""
    if arguments.config is not None:
        Config.from_file(arguments.config)
        parameters = arguments.config.read_text(encoding="utf-8")
    plan = load_injection(arguments.inject) if arguments.inject is not None else None
    found = find_recordings(arguments.paths)
    if arguments.json is not None and arguments.output.resolve() in arguments.json.resolve().parents:
        raise ConfigError(f"cannot write {arguments.json}: it lies in {arguments.output}, which is the dataset's")
    check_targets([(arguments.json, Kind.JSON)], arguments.force, [*found.paths, arguments.config, arguments.inject])
    settings = Settings(parameters, arguments.calibrate, plan)
    with closing(Dataset(arguments.output, _settings(arguments, parameters), arguments.force)) as dataset:
        try:
            _judge(arguments, found, settings, workers, dataset)
        except KeyboardInterrupt:
            print("fdi: stopped; what was judged is kept, the same command goes on from there", file=sys.stderr)
            raise
    wrote(arguments, [(arguments.output, Kind.FOLDER), (arguments.json, Kind.JSON)])
    return 0


def _judge(
    arguments: argparse.Namespace, found: Recordings, settings: Settings, workers: int, dataset: Dataset
) -> None:
    """Judge what is not there yet, write the page, print what to look at."""
    paths = found.paths
    with tqdm(total=len(paths), unit="flight", file=sys.stderr, disable=arguments.quiet or None, leave=False) as bar:

        def show(done: int, _: int) -> None:
            bar.update(done - bar.n)

        left_out = run_fleet(paths, settings, str(arguments.config or ""), dataset, workers, arguments.scheduler, show)
    flights, events, faults = (dataset.read(name) for name in ("flights", "events", "faults"))
    dataset.write(PAGE, fleet_page(flights, events, faults, _about(arguments, found)))
    looks = to_look_at(flights, unit_lines(flights, events), channel_lines(flights, events))
    whole = totals(flights)
    write_json(arguments.json, fleet_figures(whole, looks, found.unread))
    lines = summary_lines(whole, looks, faults)
    if left_out:
        lines.append(f"{left_out} flights of earlier runs are not among these recordings, and were left out.")
    lines += [f"Not searched: {shown(line)}." for line in found.unread]
    unmeasured = sum(row["calibration"] == NOT_MEASURED for row in flights)
    if unmeasured:
        lines.append(f"Of {unmeasured} {NOT_MEASURED}: what is declared there may be wrong (--config, --calibrate).")
    without = sum(bool(row["not_injected"]) for row in flights)
    if without:
        lines.append(f"Faults could not be injected, or not at all times, into {without} flights.")
    lines += ["", *(f"{shown(look.row['path'])}: {shown('; '.join(look.why))}" for look in looks[:LOOKS])]
    lines += [f"and {len(looks) - LOOKS} more in {PAGE}"] if len(looks) > LOOKS else []
    lines += ["", *table(FAULT_HEAD, fault_rows(faults))] if faults else []
    say(arguments, "".join(f"{line}\n" for line in lines))


def _settings(arguments: argparse.Namespace, parameters: str) -> dict[str, str]:
    """Return what decides the results: the texts, wherever the files lie."""
    return {
        "config": parameters,
        "calibrate": arguments.calibrate,
        "inject": "" if arguments.inject is None else arguments.inject.read_text(encoding="utf-8"),
    }


def _about(arguments: argparse.Namespace, found: Recordings) -> dict[str, str]:
    """Say what was run, for the page."""
    given: list[Path | str] = arguments.paths
    return {
        "recordings": f"{len(found.paths)}, from {', '.join(map(str, given))}",
        **({"not searched": "; ".join(found.unread)} if found.unread else {}),
        "config": str(arguments.config or "what fdi inspect writes for each recording"),
        "calibrated": arguments.calibrate,
        "faults injected": "none" if arguments.inject is None else str(arguments.inject),
        "versions": versions(),
    }
