# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""``fdi sweep``: which faults the monitor finds on one's own recording, and how soon."""

from __future__ import annotations

import argparse
import math
import sys
from contextlib import ExitStack
from pathlib import Path

from fdi_ros.bag.samples import read_block
from fdi_ros.cli.outputs import Outputs, Progress, check_part, part_words, versions
from fdi_ros.config.config import Config
from fdi_ros.detectors import DETECTORS
from fdi_ros.errors import ConfigError
from fdi_ros.jobs import worker_count
from fdi_ros.model.samples import Block
from fdi_ros.monitor.build import build_geometry
from fdi_ros.replay.sweep import DEFAULT_FAULTS, Plan, Subject, SweepResult, parse_swept, sweep
from fdi_ros.replay.sweep_report import sweep_figures, sweep_page, sweep_text, write_csv
from fdi_ros.result_file import whole_file, write_json

MOST_TIMES = 1000


def run(arguments: argparse.Namespace) -> int:
    """Sweep, print the tables, write what was asked for."""
    plan = _plan(arguments)
    check_part(arguments)
    configs = _configs(arguments)
    compared = filter(Path.exists, map(Path, arguments.compare))
    outputs = Outputs(arguments, ("json", "csv", "report"), [arguments.bag, arguments.config, *compared])
    subjects = _subjects(arguments, configs)
    with Progress(sys.stderr, arguments.quiet) as progress:
        results = sweep(subjects, plan, arguments.workers, progress.show)
    _write(arguments, plan, results)
    return outputs.finish(sweep_text(results, plan, arguments.bag.name))


def _plan(arguments: argparse.Namespace) -> Plan:
    swept = tuple(one for text in arguments.fault or DEFAULT_FAULTS for one in parse_swept(text))
    if not 1 <= arguments.times <= MOST_TIMES:
        raise ConfigError(f"--times is {arguments.times}, expected 1 to {MOST_TIMES}")
    if not (math.isfinite(arguments.within) and arguments.within > 0):
        raise ConfigError(f"--within is {arguments.within:g} s, expected more than 0")
    worker_count(arguments.workers)
    if arguments.seed < 0:
        raise ConfigError(f"--seed is {arguments.seed}, expected 0 or more")
    return Plan(tuple(dict.fromkeys(swept)), arguments.times, arguments.within, arguments.seed)


def _configs(arguments: argparse.Namespace) -> dict[str, Config]:
    """Return the configs to be tried by name: the one given, and those to compare it with."""
    own = Config.from_file(arguments.config)
    own = own.replaced({"detector.name": arguments.detector}) if arguments.detector else own
    by_detector = arguments.compare and all(other in DETECTORS for other in arguments.compare)
    found = {own.detector.name if by_detector else arguments.config.name: own}
    names = build_geometry(own).channel_names
    for other in arguments.compare:
        if other in DETECTORS:
            found[other] = own.replaced({"detector.name": other})
            continue
        if not Path(other).exists():
            raise ConfigError(f"--compare {other}: no such file, and no detector; there are: {', '.join(DETECTORS)}")
        found[other] = Config.from_file(other)
        if build_geometry(found[other]).channel_names != names:
            raise ConfigError(
                f"--compare {other}: its channels are not those of {arguments.config}: {', '.join(names)}"
            )
    return found


def _subjects(arguments: argparse.Namespace, configs: dict[str, Config]) -> list[Subject]:
    """Read the recording as each config aligns it; what aligns alike is read once."""
    read: dict[object, Block] = {}
    subjects = []
    for name, config in configs.items():
        key = (config.input, config.topics, config.imus.delays, config.imus.max_skew, config.imus.timeout)
        if key not in read:
            read[key] = read_block(arguments.bag, config, arguments.start, arguments.end)
        subjects.append(Subject(name, config, read[key]))
    return subjects


def _write(arguments: argparse.Namespace, plan: Plan, results: tuple[SweepResult, ...]) -> None:
    """Write what was asked for: all of it, or nothing."""
    with ExitStack() as stack:
        if arguments.report is not None:
            text = sweep_page(results, plan, arguments.bag.name, _about(arguments, plan))
            stack.enter_context(whole_file(arguments.report)).write_text(text, encoding="utf-8")
        if arguments.csv is not None:
            path = stack.enter_context(whole_file(arguments.csv))
            with path.open("w", newline="", encoding="utf-8") as file:
                write_csv(file, results, plan)
        write_json(arguments.json, sweep_figures(results, plan, str(arguments.bag)))


def _about(arguments: argparse.Namespace, plan: Plan) -> dict[str, str]:
    """Say what was run, for the page."""
    return {
        "recording": str(arguments.bag),
        "part": part_words(arguments),
        "config": str(arguments.config),
        "compared with": ", ".join(arguments.compare) or "nothing",
        "faults": "; ".join(swept.words for swept in plan.faults),
        "times, watched for, seed": f"{plan.times}, {plan.within:g} s, {plan.seed}",
        "versions": versions(),
    }
