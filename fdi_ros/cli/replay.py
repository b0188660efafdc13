# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Through the monitor: ``fdi replay``, a recording; ``fdi sweep``, many faults; ``fdi fleet``, many recordings."""

from __future__ import annotations

import math
import sys
from argparse import Namespace
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from fdi_ros.cli.outputs import (
    Kind,
    Outputs,
    about,
    check_part,
    check_target,
    config_words,
    progress,
    versions,
)
from fdi_ros.cli.settings import compile_for_workers
from fdi_ros.config.config import Config, with_parameters
from fdi_ros.detectors import DETECTORS, detector_class
from fdi_ros.errors import BagError, ConfigError, FdiError
from fdi_ros.faults.fault import Fault, load_scenario, parse_fault
from fdi_ros.inspection.fitness import not_configured, refuse_unfit
from fdi_ros.inspection.starting_config import assumed_config
from fdi_ros.model.samples import Block
from fdi_ros.monitor.accelerometers import possible_names
from fdi_ros.monitor.building import build_geometry
from fdi_ros.replay.conditions import failures, parse_check
from fdi_ros.replay.failover import FailoverReplay, is_possible
from fdi_ros.replay.outputs import CsvFile, OutputBag
from fdi_ros.replay.page import Report
from fdi_ros.replay.run import Sink, replay, with_unused
from fdi_ros.replay.summary import Summary, as_json
from fdi_ros.replay.words import AUTOPILOT_LOGS, sample_rate_notes, summary_text
from fdi_ros.report.layout import unit_of
from fdi_ros.system import resolve
from fdi_ros.system.files import whole, write_json, write_text
from fdi_ros.system.text import shown, storable

if TYPE_CHECKING:
    from fdi_ros.replay.sweep import Plan, Subject


def run_replay(arguments: Namespace) -> int:
    """Replay, print a table, write what was asked for."""
    # Arguments that are wrong by themselves are refused before the recording is read.
    faults = [parse_fault(text) for text in arguments.fault]
    faults += [] if arguments.scenario is None else load_scenario(arguments.scenario)
    check_part(arguments)
    if arguments.detector:
        detector_class(arguments.detector)
    assumed = None if arguments.config else assumed_config(arguments.bag)
    config = assumed.config if assumed else Config.from_file(arguments.config)
    if arguments.detector:
        config = config.replaced({"detector.name": arguments.detector})
    geometry = build_geometry(config)
    required = (
        []
        if arguments.check is None
        else parse_check(
            arguments.check, len(faults), possible_names(config, geometry.channel_names)
        )
    )
    sources = [arguments.bag, *arguments.config, arguments.scenario]
    outputs = Outputs(
        arguments, ("json", "csv", "report", "output"), sources, output=Kind.FOLDER
    )
    refuse_unfit(arguments.bag, config)
    unit = unit_of(arguments.degrees)
    report = (
        Report(geometry, config.sample_rate, unit)
        if arguments.report is not None
        else None
    )
    is_log = arguments.bag.suffix.lower() in AUTOPILOT_LOGS
    failover = (
        FailoverReplay(geometry.channel_names)
        if is_log and is_possible(geometry.channel_names)
        else None
    )
    with progress(sys.stderr, arguments.quiet) as show, ExitStack() as stack:
        sinks = [
            *_sinks(arguments, config, stack),
            *([report] if report else []),
            *([failover] if failover else []),
        ]
        part = (arguments.start, arguments.end)
        summary = replay(
            arguments.bag, config, faults, *part, sinks=sinks, progress=show
        )
        if assumed:
            summary = with_unused(summary, assumed.unused)
        figures = as_json(summary)
        unmet = failures(required, summary)
        if arguments.check is not None:
            figures["check"] = {
                "required": [one.text for one in required],
                "unmet": unmet,
            }
        if report:
            page = report.html(
                summary,
                _about_replay(
                    arguments, config, faults, assumed.words if assumed else ""
                ),
            )
            stack.enter_context(whole(arguments.report)).write_text(
                page, encoding="utf-8"
            )
        write_json(arguments.json, figures)
    words = summary_text(summary, unit)
    if failover is not None:
        words += f"{failover.text}\n"
    if assumed:
        words += f"note: no --config: assumed {assumed.words}\n"
    else:
        unused = not_configured(arguments.bag, config)
        words += "".join(f"note: {line}\n" for line in unused)
    code = outputs.finish(words, severity=summary.verdict.severity)
    if arguments.check is not None:
        return _say_check(arguments, outputs, summary, unmet)
    # Who injects faults tries the monitor: what it then finds is no news of the gyros.
    return 0 if faults else code


def _say_check(
    arguments: Namespace, outputs: Outputs, summary: Summary, unmet: Sequence[str]
) -> int:
    """Say what came of the check; return the exit code."""
    # A check against thresholds that are not what they seem: not even who asked for quiet may miss it.
    for line in (
        sample_rate_notes(summary.stream.sample_rate) if arguments.quiet else ()
    ):
        print(f"fdi: warning: {line}", file=sys.stderr)
    for line in unmet:
        print(f"fdi: check not met: {line}", file=sys.stderr)
    if not unmet:
        outputs.say(f"check met: {arguments.check}\n")
    return 1 if unmet else 0


def _sinks(arguments: Namespace, config: Config, stack: ExitStack) -> list[Sink]:
    """Open the outputs that grow with the stream."""
    sinks: list[Sink] = []
    if arguments.csv is not None:
        path = stack.enter_context(whole(arguments.csv))
        sinks.append(
            CsvFile(stack.enter_context(path.open("w", newline="", encoding="utf-8")))
        )
    if arguments.output is not None:
        path = stack.enter_context(whole(arguments.output))
        sinks.append(stack.enter_context(OutputBag(path, config)))
    return sinks


def _written(value: object) -> str:
    """Write a setting as in a file, to the figures that matter."""
    if isinstance(value, (tuple, list)):
        return f"[{', '.join(map(_written, value))}]"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _about_replay(
    arguments: Namespace, config: Config, faults: Sequence[Fault], assumed: str
) -> dict[str, str]:
    """Say what was run, for the report."""
    changed = "; ".join(
        f"{name}: {_written(value)}" for name, value in config.changed.items()
    )
    more = {
        "detector": config.detector.name,
        "faults": "; ".join(map(str, faults)) or "none",
        "seeds": ", ".join(str(fault.seed) for fault in faults) or "none needed",
        "settings other than the default": changed,
    }
    return about(
        arguments, config_words(arguments) or f"none; assumed: {assumed}", more
    )


# Faults of many sizes -------------------------------------------------------------------------------------------------

MOST_TIMES = 1000


def run_sweep(arguments: Namespace) -> int:
    """Sweep, print the tables, write what was asked for."""
    from fdi_ros.replay.sweep import sweep
    from fdi_ros.replay.sweep_report import (
        sweep_figures,
        sweep_page,
        sweep_text,
        write_csv,
    )

    plan = _plan(arguments)
    check_part(arguments)
    configs = _configs(arguments)
    compared = filter(Path.exists, map(resolve, arguments.compare))
    outputs = Outputs(
        arguments,
        ("json", "csv", "report"),
        [arguments.bag, *arguments.config, *compared],
    )
    subjects = _subjects(arguments, configs)
    with progress(sys.stderr, arguments.quiet, "faults") as show:
        results = sweep(subjects, plan, arguments.workers, show)
    text, figures = (
        sweep_text(results, plan, arguments.bag.name),
        sweep_figures(results, plan, str(arguments.bag)),
    )
    tried = {
        "compared with": ", ".join(arguments.compare) or "nothing",
        "faults": "; ".join(swept.words for swept in plan.faults),
        "times, watched for, seed": f"{plan.times}, {plan.within:g} s, {plan.seed}",
    }
    head = about(arguments, config_words(arguments), tried)

    def write(path: Path) -> None:
        with path.open("w", newline="", encoding="utf-8") as file:
            write_csv(file, results, plan)

    return outputs.finish(
        text,
        figures,
        lambda: sweep_page(results, plan, arguments.bag.name, head),
        csv=write,
    )


def _plan(arguments: Namespace) -> Plan:
    from fdi_ros.replay.sweep import DEFAULT_FAULTS, Plan, parse_swept
    from fdi_ros.system.jobs import worker_count

    swept = tuple(
        one for text in arguments.fault or DEFAULT_FAULTS for one in parse_swept(text)
    )
    if not 1 <= arguments.times <= MOST_TIMES:
        raise ConfigError(f"--times is {arguments.times}, expected 1 to {MOST_TIMES}")
    if not (math.isfinite(arguments.within) and arguments.within > 0):
        raise ConfigError(f"--within is {arguments.within:g} s, expected more than 0")
    worker_count(arguments.workers)
    if arguments.seed < 0:
        raise ConfigError(f"--seed is {arguments.seed}, expected 0 or more")
    return Plan(
        tuple(dict.fromkeys(swept)), arguments.times, arguments.within, arguments.seed
    )


def _configs(arguments: Namespace) -> dict[str, Config]:
    """Return the configs to be tried by name: the one given, and those to compare it with."""
    config = Config.from_file(arguments.config)
    config = (
        config.replaced({"detector.name": arguments.detector})
        if arguments.detector
        else config
    )
    by_detector = arguments.compare and all(
        other in DETECTORS for other in arguments.compare
    )
    found = {
        config.detector.name
        if by_detector
        else ", ".join(file.name for file in arguments.config): config
    }
    names = build_geometry(config).channel_names
    for other in arguments.compare:
        if other in DETECTORS:
            found[other] = config.replaced({"detector.name": other})
            continue
        file = resolve(other)
        if not file.exists():
            raise ConfigError(
                f"--compare {other}: no such file, and no detector; there are: {', '.join(DETECTORS)}"
            )
        found[other] = Config.from_file(file)
        if build_geometry(found[other]).channel_names != names:
            raise ConfigError(
                f"--compare {other}: its channels are not those of --config: {', '.join(names)}"
            )
    return found


def _subjects(arguments: Namespace, configs: dict[str, Config]) -> list[Subject]:
    """Read the recording as each config aligns it; what aligns alike is read once."""
    from fdi_ros.bag.samples import read_block
    from fdi_ros.replay.sweep import Subject

    read: dict[object, Block] = {}
    for config in configs.values():
        if (key := _alignment(config)) not in read:
            read[key] = read_block(
                arguments.bag, config, arguments.start, arguments.end
            )
    return [
        Subject(name, config, read[_alignment(config)])
        for name, config in configs.items()
    ]


def _alignment(config: Config) -> object:
    return (
        config.input,
        config.topics,
        config.imus.delays,
        config.imus.max_skew,
        config.imus.timeout,
    )


# Many recordings ------------------------------------------------------------------------------------------------------

PAGE = "fleet.html"


def run_fleet(arguments: Namespace) -> int:
    """Judge them, write tables and page, print what needs a person."""
    from fdi_ros.fleet.judge import find_recordings, judge_all
    from fdi_ros.fleet.tables import Fleet, Tables
    from fdi_ros.system.jobs import worker_count

    workers = worker_count(arguments.workers)
    names = ", ".join(shown(file.name) for file in arguments.config)
    parameters = (
        with_parameters(arguments.config, {}, f"as in {names}", {}) if names else ""
    )
    paths, unread = find_recordings(arguments.paths)
    outputs = Outputs(
        arguments, ("output", "json"), [*paths, *arguments.config], output=None
    )
    folder = arguments.output.absolute()
    if folder.exists():
        check_target(folder / PAGE, Kind.PAGE, force=True)
    tables = Tables(
        folder,
        {"config": parameters, "calibrate": arguments.calibrate},
        arguments.force,
    )
    reports = folder / "reports" if arguments.reports else None
    if reports:
        reports.mkdir(exist_ok=True)
    compile_for_workers(arguments)
    try:
        with progress(sys.stderr, arguments.quiet, "flights") as show:
            given = parameters, arguments.calibrate == "each", tables
            judge_all(paths, *given, workers, arguments.scheduler, show, reports)
    except KeyboardInterrupt:
        print(
            "fdi: stopped; what was judged is kept, the same command goes on from there",
            file=sys.stderr,
        )
        raise
    except (FdiError, OSError):
        tables.give_up()
        raise
    fleet = Fleet([tables.flights[storable(str(path))] for path in paths])
    head = {
        "recordings": f"{len(paths)}, from {', '.join(map(str, arguments.paths))}",
        "config": config_words(arguments)
        or "what fdi inspect writes for each recording",
        "calibrated": arguments.calibrate,
        "versions": versions(),
    }
    write_text(folder / PAGE, fleet.html(head))
    others = len(tables.flights) - len(paths)
    more = (
        [f"The tables have {others} more, of other runs: not counted here."]
        if others
        else []
    )
    more += [f"Not searched: {shown(line)}." for line in unread]
    text, figures = (
        fleet.text() + "".join(f"{line}\n" for line in more),
        fleet.figures() | {"not_searched": unread},
    )
    code = outputs.finish(text, figures, severity=fleet.verdict.severity)
    if not fleet.judged:
        raise BagError(
            f"none of the {len(paths)} recordings could be judged: {arguments.output / PAGE} says why"
        )
    return code
