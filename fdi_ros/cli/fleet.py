# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""``fdi fleet``: many recordings, one dataset and one page."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from tqdm import tqdm

from fdi_ros.cli.compile import compile_for_workers
from fdi_ros.cli.outputs import Outputs, versions
from fdi_ros.config.config import Config
from fdi_ros.errors import BagError, ConfigError
from fdi_ros.fleet.dataset import PAGE, Dataset
from fdi_ros.fleet.findings import Fleet
from fdi_ros.fleet.flights import Recordings, find_recordings
from fdi_ros.fleet.judging import Settings, load_injection, run_fleet
from fdi_ros.fleet.report import fault_table, fleet_figures, fleet_page, not_judged_lines, summary_lines
from fdi_ros.jobs import Cluster, cluster_of, worker_count
from fdi_ros.report.layout import table
from fdi_ros.text import shown

WHY = 400
"""Characters of why a flight should be looked at that are printed."""
LOOKS = 10
"""Flights to look at that are printed; the page has all."""


def run(arguments: argparse.Namespace) -> int:
    """Judge them, write the dataset and the page, print what to look at."""
    workers = worker_count(arguments.workers)
    cluster = cluster_of(arguments.scheduler, arguments.tls_ca_file, arguments.tls_cert, arguments.tls_key)
    parameters = ""
    if arguments.config is not None:
        Config.from_file(arguments.config)
        parameters = arguments.config.read_text(encoding="utf-8")
    plan = load_injection(arguments.inject) if arguments.inject is not None else None
    found = find_recordings(arguments.paths)
    if arguments.json is not None and arguments.output.resolve() in arguments.json.resolve().parents:
        raise ConfigError(f"cannot write {arguments.json}: it lies in {arguments.output}, which is the dataset's")
    for given in (arguments.config, arguments.inject) if arguments.force else ():
        if given is not None and arguments.output.resolve() in given.resolve().parents:
            raise ConfigError(f"{given} lies in {arguments.output}, which --force begins anew: copy it elsewhere")
    sources = [*found.paths, arguments.config, arguments.inject]
    outputs = Outputs(arguments, ("output", "json"), sources, output=None)
    settings = Settings(parameters, arguments.calibrate, plan)
    # What decides the results: the texts, wherever the files lie.
    faults = "" if plan is None else arguments.inject.read_text(encoding="utf-8")
    decides = {"config": parameters, "calibrate": arguments.calibrate, "inject": faults}
    try:
        with closing(Dataset(arguments.output.absolute(), decides, arguments.force)) as dataset:
            keys, others = _judge(arguments, found.paths, settings, workers, cluster, dataset)
            fleet = Fleet(*(dataset.read(name, keys) for name in ("flights", "episodes", "events", "faults")))
            dataset.write(PAGE, fleet_page(fleet, _about(arguments, found)))
            text = "".join(f"{line}\n" for line in _lines(fleet, found, others))
            outputs.finish(text, fleet_figures(fleet, found.unread))
    except KeyboardInterrupt:
        print("fdi: stopped; what was judged is kept, the same command goes on from there", file=sys.stderr)
        raise
    if not fleet.judged:
        raise BagError(f"none of the {len(found.paths)} recordings could be judged: {arguments.output / PAGE} says why")
    return 0


def _judge(
    arguments: argparse.Namespace,
    paths: Sequence[Path],
    settings: Settings,
    workers: int,
    cluster: Cluster | None,
    dataset: Dataset,
) -> tuple[set[str], int]:
    """Judge what is not there yet; return what `run_fleet` does."""
    compile_for_workers(arguments)
    config = "" if arguments.config is None else str(arguments.config.absolute())
    with tqdm(total=len(paths), unit="flight", file=sys.stderr, disable=arguments.quiet or None, leave=False) as bar:
        return run_fleet(paths, settings, config, dataset, workers, cluster, lambda done: bar.update(done - bar.n))


def _lines(fleet: Fleet, found: Recordings, others: int) -> list[str]:
    """Say what to look at; `others`: flights of other runs in the tables."""
    lines = [shown(line, WHY) for line in summary_lines(fleet)]
    if others:
        lines.append(f"The tables have {others} more, of other runs: not among these recordings, not counted here.")
    lines += [f"Not searched: {shown(line)}." for line in found.unread]
    without = sum(bool(row["not_injected"]) for row in fleet.flights)
    if without:
        lines.append(f"Faults could not be injected, or not at all times, into {without} flights.")
    lines += [shown(line, WHY) for line in not_judged_lines(fleet.not_judged)[:LOOKS]]
    lines += [""] * bool(fleet.looks)
    lines += [f"{shown(look.row['path'])}: {shown('; '.join(look.why), WHY)}" for look in fleet.looks[:LOOKS]]
    lines += [f"and {len(fleet.looks) - LOOKS} more in {PAGE}"] if len(fleet.looks) > LOOKS else []
    return [*lines, "", *table(*fault_table(fleet.faults))] if fleet.faults else lines


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
