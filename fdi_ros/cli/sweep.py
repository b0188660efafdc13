# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""``fdi sweep``: which faults the monitor finds on one's own recording, and how soon."""

from __future__ import annotations

import math
import sys
from argparse import ArgumentParser, Namespace
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from fdi_ros.cli.arguments import (
    Verb,
    add_bag,
    add_config,
    add_detector,
    add_fault,
    add_file,
    add_part,
    add_report,
    add_results,
)
from fdi_ros.detectors import DETECTORS
from fdi_ros.errors import ConfigError
from fdi_ros.system.installation import BAGS, WORKERS, resolve

if TYPE_CHECKING:
    from fdi_ros.config.config import Config
    from fdi_ros.model.samples import Block
    from fdi_ros.replay.sweep import Plan, Subject, SweepResult

MOST_TIMES = 1000


def _add_arguments(parser: ArgumentParser) -> None:
    add_bag(parser)
    add_config(parser)
    add_fault(
        parser,
        "kind and sizes to try: 'kind=bias size=0.05,0.1,0.3'; may be repeated; default: biases, drifts, noise,"
        " scale factors, stuck, dropout",
    )
    parser.add_argument("--times", type=int, default=10, metavar="N", help="times per channel and fault; default 10")
    parser.add_argument("--within", type=float, default=5.0, metavar="S", help="watch a fault for so long; default 5")
    add_detector(parser)
    parser.add_argument(
        "--compare",
        nargs="+",
        default=[],
        metavar="NAME",
        help="other detectors (as of --detector) or parameter files beside it",
    )
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="of signs and random faults; default 1")
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="processes; default 1")
    add_part(parser)
    add_file(parser, "--csv", "write a line for every fault")
    add_report(parser)
    add_results(parser)


def _run(arguments: Namespace) -> int:
    """Sweep, print the tables, write what was asked for."""
    from fdi_ros.cli.outputs import Outputs, Progress, check_part
    from fdi_ros.replay.sweep import sweep
    from fdi_ros.replay.sweep_report import sweep_text

    plan = _plan(arguments)
    check_part(arguments)
    configs = _configs(arguments)
    compared = filter(Path.exists, map(resolve, arguments.compare))
    outputs = Outputs(arguments, ("json", "csv", "report"), [arguments.bag, *arguments.config, *compared])
    subjects = _subjects(arguments, configs)
    with Progress(sys.stderr, arguments.quiet, "faults: ") as progress:
        results = sweep(subjects, plan, arguments.workers, progress.show)
    _write(arguments, plan, results)
    return outputs.finish(sweep_text(results, plan, arguments.bag.name))


def _plan(arguments: Namespace) -> Plan:
    from fdi_ros.replay.sweep import DEFAULT_FAULTS, Plan, parse_swept
    from fdi_ros.system.jobs import worker_count

    swept = tuple(one for text in arguments.fault or DEFAULT_FAULTS for one in parse_swept(text))
    if not 1 <= arguments.times <= MOST_TIMES:
        raise ConfigError(f"--times is {arguments.times}, expected 1 to {MOST_TIMES}")
    if not (math.isfinite(arguments.within) and arguments.within > 0):
        raise ConfigError(f"--within is {arguments.within:g} s, expected more than 0")
    worker_count(arguments.workers)
    if arguments.seed < 0:
        raise ConfigError(f"--seed is {arguments.seed}, expected 0 or more")
    return Plan(tuple(dict.fromkeys(swept)), arguments.times, arguments.within, arguments.seed)


def _configs(arguments: Namespace) -> dict[str, Config]:
    """Return the configs to be tried by name: the one given, and those to compare it with."""
    from fdi_ros.config.config import Config
    from fdi_ros.monitor.build import build_geometry

    own = Config.from_file(arguments.config)
    own = own.replaced({"detector.name": arguments.detector}) if arguments.detector else own
    by_detector = arguments.compare and all(other in DETECTORS for other in arguments.compare)
    found = {own.detector.name if by_detector else ", ".join(file.name for file in arguments.config): own}
    names = build_geometry(own).channel_names
    for other in arguments.compare:
        if other in DETECTORS:
            found[other] = own.replaced({"detector.name": other})
            continue
        file = resolve(other)
        if not file.exists():
            raise ConfigError(f"--compare {other}: no such file, and no detector; there are: {', '.join(DETECTORS)}")
        found[other] = Config.from_file(file)
        if build_geometry(found[other]).channel_names != names:
            raise ConfigError(f"--compare {other}: its channels are not those of --config: {', '.join(names)}")
    return found


def _subjects(arguments: Namespace, configs: dict[str, Config]) -> list[Subject]:
    """Read the recording as each config aligns it; what aligns alike is read once."""
    from fdi_ros.bag.samples import read_block
    from fdi_ros.replay.sweep import Subject

    read: dict[object, Block] = {}
    subjects = []
    for name, config in configs.items():
        key = (config.input, config.topics, config.imus.delays, config.imus.max_skew, config.imus.timeout)
        if key not in read:
            read[key] = read_block(arguments.bag, config, arguments.start, arguments.end)
        subjects.append(Subject(name, config, read[key]))
    return subjects


def _write(arguments: Namespace, plan: Plan, results: tuple[SweepResult, ...]) -> None:
    """Write what was asked for: all of it, or nothing."""
    from fdi_ros.replay.sweep_report import sweep_figures, sweep_page, write_csv
    from fdi_ros.system.result_file import whole_file, write_json

    with ExitStack() as stack:
        if arguments.report is not None:
            text = sweep_page(results, plan, arguments.bag.name, _about(arguments, plan))
            stack.enter_context(whole_file(arguments.report)).write_text(text, encoding="utf-8")
        if arguments.csv is not None:
            path = stack.enter_context(whole_file(arguments.csv))
            with path.open("w", newline="", encoding="utf-8") as file:
                write_csv(file, results, plan)
        write_json(arguments.json, sweep_figures(results, plan, str(arguments.bag)))


def _about(arguments: Namespace, plan: Plan) -> dict[str, str]:
    """Say what was run, for the page."""
    from fdi_ros.cli.outputs import config_words, part_words, versions

    return {
        "recording": str(arguments.bag),
        "part": part_words(arguments),
        "config": config_words(arguments),
        "compared with": ", ".join(arguments.compare) or "nothing",
        "faults": "; ".join(swept.words for swept in plan.faults),
        "times, watched for, seed": f"{plan.times}, {plan.within:g} s, {plan.seed}",
        "versions": versions(),
    }


SWEEP = Verb(
    "inject faults of many sizes into every channel of a recording and say which are detected, and how soon",
    (
        "fdi sweep my_flight --config my_gyros.yaml --report sweep.html",
        "fdi sweep my_flight --config my_gyros.yaml --fault 'kind=bias size=0.05,0.1' --compare likelihood_ratio cusum",
    ),
    _add_arguments,
    _run,
    (*BAGS, *WORKERS),
)
