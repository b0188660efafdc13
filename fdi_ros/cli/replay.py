# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Verbs that run the monitor: ``fdi replay``, ``fdi sweep`` and ``fdi fleet``."""

from __future__ import annotations

import math
import sys
from argparse import Namespace
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from fdi_ros.cli import ExitCode
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
from fdi_ros.inspection.starting_config import AssumedConfig, assumed_config
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.samples import Block
from fdi_ros.monitor.accelerometers import possible_names
from fdi_ros.monitor.building import build_geometry
from fdi_ros.replay.conditions import Condition, failures, parse_check
from fdi_ros.replay.failover import FailoverReplay, is_possible
from fdi_ros.replay.outputs import CsvFile, OutputBag
from fdi_ros.replay.page import Replayed, Report, page_of, report_of
from fdi_ros.replay.run import Sink, replay, with_unused
from fdi_ros.replay.summary import Summary, as_json
from fdi_ros.replay.words import AUTOPILOT_LOGS, sample_rate_notes, summary_text
from fdi_ros.report.layout import Severity, unit_of
from fdi_ros.system import resolve
from fdi_ros.system.files import whole, write_json, write_text
from fdi_ros.system.text import shown, storable

if TYPE_CHECKING:
    from fdi_ros.fleet.tables import Tables
    from fdi_ros.replay.sweep import Plan, Subject


class _Task(NamedTuple):
    """What a replay is asked for, checked before the recording is replayed."""

    arguments: Namespace
    """Arguments of the verb, with the recording to replay."""
    config: Config
    """The settings."""
    assumed: AssumedConfig | None
    """Their origin if no config was given."""
    faults: list[Fault]
    """Faults to inject."""
    required: list[Condition]
    """Conditions of ``--check``."""
    geometry: Geometry
    """Axes of the gyros."""


def run_replay(arguments: Namespace) -> int:
    """Replay a recording, print the result, write the files. Return the exit code."""
    task = _replay_task(arguments)
    other = _task_beside(arguments) if arguments.beside else None
    tasks = [task, other] if other else [task]
    sources = [arguments.bag, arguments.beside, *arguments.config, arguments.scenario]
    options = ("json", "csv", "report", "output")
    outputs = Outputs(arguments, options, sources, output=Kind.FOLDER)
    for one in tasks:
        refuse_unfit(one.arguments.bag, one.config)
    replayed, unmet = _replay_to_files(arguments, tasks)
    summary = replayed[0].summary
    text = _replay_text(replayed[0])
    for beside in replayed[1:]:
        text += f"\nthe other recording: {_replay_text(beside)}"
    severities = [one.summary.verdict.severity for one in replayed]
    worst = max(severities, key=list(Severity).index)
    outputs.finish(text, severity=severities[0])
    if arguments.check is not None:
        return _report_check(arguments, outputs, summary, unmet)
    # With injected faults the verdict is on the monitor, not on the gyros.
    return ExitCode.DONE if task.faults else worst.exit_code


def _replay_task(arguments: Namespace) -> _Task:
    """Read arguments and settings. Arguments that are wrong by themselves are refused first."""
    faults = [parse_fault(text) for text in arguments.fault]
    if arguments.scenario is not None:
        faults += load_scenario(arguments.scenario)
    check_part(arguments)
    if arguments.detector:
        detector_class(arguments.detector)
    assumed = None if arguments.config else assumed_config(arguments.bag)
    config = assumed.config if assumed else Config.from_file(arguments.config)
    if arguments.detector:
        config = config.replaced({"detector.name": arguments.detector})
    geometry = build_geometry(config)
    required: list[Condition] = []
    if arguments.check is not None:
        channels = possible_names(config, geometry.channel_names)
        required = parse_check(arguments.check, len(faults), channels)
    return _Task(arguments, config, assumed, faults, required, geometry)


def _task_beside(arguments: Namespace) -> _Task:
    """Return the replay of the other recording: as recorded, and without a check or files."""
    own = {"bag": arguments.beside, "fault": [], "scenario": None, "check": None}
    files = dict.fromkeys(("csv", "output"))
    return _replay_task(Namespace(**{**vars(arguments), **own, **files}))


class _Replayed(NamedTuple):
    """A replay that is done."""

    task: _Task
    """What was asked for."""
    summary: Summary
    """The result."""
    report: Report | None
    """Curves for the page, if one is asked for."""
    failover: FailoverReplay | None
    """What failover would have done, if this is the log of an autopilot."""

    @property
    def for_page(self) -> Replayed:
        """The replay as a page needs it."""
        assert self.report is not None
        return Replayed(self.report, self.summary, _about_replay(self.task))


def _replay_to_files(
    arguments: Namespace, tasks: Sequence[_Task]
) -> tuple[list[_Replayed], list[str]]:
    """Replay and write all files or none. Return the results, and the unmet conditions."""
    with progress(sys.stderr, arguments.quiet) as show, ExitStack() as stack:
        replayed = []
        for number, one in enumerate(tasks):

            def show_part(share: float, before: int = number) -> None:
                show((before + share) / len(tasks))

            replayed.append(_replay_one(one, "AB"[number], stack, show_part))
        first = replayed[0]
        figures = as_json(first.summary)
        unmet = failures(tasks[0].required, first.summary)
        if arguments.check is not None:
            conditions = [one.text for one in tasks[0].required]
            figures["check"] = {"required": conditions, "unmet": unmet}
        for beside in replayed[1:]:
            figures["beside"] = as_json(beside.summary)
        if arguments.report is not None:
            page = page_of([one.for_page for one in replayed])
            target = stack.enter_context(whole(arguments.report))
            target.write_text(page, encoding="utf-8")
        write_json(arguments.json, figures)
    return replayed, unmet


def _replay_one(
    task: _Task, letter: str, stack: ExitStack, show: Callable[[float], None]
) -> _Replayed:
    """Replay one recording. ``letter``: begin of the names of the series on the page."""
    arguments = task.arguments
    sinks = _sinks(arguments, task.config, stack)
    names = task.geometry.channel_names
    failover: FailoverReplay | None = None
    if arguments.bag.suffix.lower() in AUTOPILOT_LOGS and is_possible(names):
        failover = FailoverReplay(names, task.config.sample_rate)
        sinks.append(failover)
    report: Report | None = None
    if arguments.report is not None:
        report = report_of(task.config, unit_of(arguments.degrees), f"{letter}.")
        sinks.append(report)
    summary = replay(
        arguments.bag,
        task.config,
        task.faults,
        arguments.start,
        arguments.end,
        sinks=sinks,
        progress=show,
    )
    if task.assumed:
        summary = with_unused(summary, task.assumed.unused)
    return _Replayed(task, summary, report, failover)


def _replay_text(replayed: _Replayed) -> str:
    """Return the result of one replay for a terminal, the verdict first."""
    text = summary_text(replayed.summary, unit_of(replayed.task.arguments.degrees))
    if replayed.failover is not None:
        text += f"{replayed.failover.text(replayed.summary.stream.origin_ns)}\n"
    return text + _config_notes(replayed.task)


def _config_notes(task: _Task) -> str:
    """Return notes on an assumed config, or on topics that the given one does not name."""
    if task.assumed:
        return f"note: no --config: assumed {task.assumed.words}\n"
    unused = not_configured(task.arguments.bag, task.config)
    return "".join(f"note: {line}\n" for line in unused)


def _report_check(
    arguments: Namespace, outputs: Outputs, summary: Summary, unmet: Sequence[str]
) -> int:
    """Print the result of ``--check`` and return the exit code."""
    # A wrong sample rate makes the check worthless, so --quiet must not hide the warning.
    for line in (
        sample_rate_notes(summary.stream.sample_rate) if arguments.quiet else ()
    ):
        print(f"fdi: warning: {line}", file=sys.stderr)
    for line in unmet:
        print(f"fdi: check not met: {line}", file=sys.stderr)
    if not unmet:
        outputs.say(f"check met: {arguments.check}\n")
    return ExitCode.UNMET if unmet else ExitCode.DONE


def _sinks(arguments: Namespace, config: Config, stack: ExitStack) -> list[Sink]:
    """Open the files that grow during the replay."""
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
    """Return a setting as a parameter file has it, with six digits."""
    if isinstance(value, (tuple, list)):
        return f"[{', '.join(map(_written, value))}]"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _about_replay(task: _Task) -> dict[str, str]:
    """Return the head of the report: what was replayed, and with which settings."""
    changed = [
        f"{name}: {_written(value)}" for name, value in task.config.changed.items()
    ]
    more = {
        "detector": task.config.detector.name,
        "faults": "; ".join(map(str, task.faults)) or "none",
        "seeds": ", ".join(str(fault.seed) for fault in task.faults) or "none needed",
        "settings other than the default": "; ".join(changed),
    }
    config = config_words(task.arguments)
    if task.assumed and not config:
        config = f"none; assumed: {task.assumed.words}"
    return about(task.arguments, config, more)


# Many faults

MOST_TIMES = 1000
"""Largest number of start times of a sweep."""


def run_sweep(arguments: Namespace) -> int:
    """Sweep, print the tables, write the files. Return the exit code."""
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
    text = sweep_text(results, plan, arguments.bag.name)
    figures = sweep_figures(results, plan, str(arguments.bag))
    tried = {
        "compared with": ", ".join(arguments.compare) or "nothing",
        "faults": "; ".join(
            swept.words
            for swept in plan.faults
            if any(one.struck(swept) for one in results)
        ),
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
    from fdi_ros.replay.sweep import (
        DEFAULT_FAULTS,
        FORCE_FAULTS,
        Plan,
        parse_swept,
    )
    from fdi_ros.system.jobs import worker_count

    swept = tuple(
        one
        for text in arguments.fault or (*DEFAULT_FAULTS, *FORCE_FAULTS)
        for one in parse_swept(text)
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
    """Return the configs to try, by name: the given one, and those to compare with."""
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
                f"--compare {other}: neither a file nor a detector, expected one of: {', '.join(DETECTORS)}"
            )
        found[other] = Config.from_file(file)
        if build_geometry(found[other]).channel_names != names:
            raise ConfigError(
                f"--compare {other}: its channels differ from those of --config: {', '.join(names)}"
            )
    return found


def _subjects(arguments: Namespace, configs: dict[str, Config]) -> list[Subject]:
    """Read the recording with the alignment of each config, once for equal alignments."""
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
        config.accelerometers.enabled == "off",
    )


# Many recordings

PAGE = "fleet.html"


def run_fleet(arguments: Namespace) -> int:
    """Replay many recordings, write tables and a page, print the result. Return the exit code."""
    from fdi_ros.fleet.judge import find_recordings
    from fdi_ros.fleet.tables import Fleet
    from fdi_ros.system.jobs import worker_count

    workers = worker_count(arguments.workers)
    paths, unread = find_recordings(arguments.paths)
    sources = [*paths, *arguments.config]
    outputs = Outputs(arguments, ("output", "json"), sources, output=None)
    folder = arguments.output.absolute()
    if folder.exists():
        check_target(folder / PAGE, Kind.PAGE, force=True)
    tables = _judged(arguments, paths, workers)
    fleet = Fleet([tables.flights[storable(str(path))] for path in paths])
    notes = [f"Not searched: {shown(line)}." for line in unread]
    if others := len(tables.flights) - len(paths):
        notes.insert(0, f"The tables also hold {others} flights of earlier runs.")
    about = _about_fleet(arguments, len(paths))
    write_text(folder / PAGE, fleet.html(about, notes))
    text = fleet.text() + "".join(f"{line}\n" for line in notes)
    figures = fleet.figures() | {"not_searched": unread}
    code = outputs.finish(text, figures, severity=fleet.verdict.severity)
    if not fleet.judged:
        raise BagError(
            f"no recording could be judged: {arguments.output / PAGE} has the reasons"
        )
    return code


def _judged(arguments: Namespace, paths: Sequence[Path], workers: int) -> Tables:
    """Replay recordings that are not in the tables yet. An interrupted run can be continued."""
    from fdi_ros.fleet.judge import judge_all
    from fdi_ros.fleet.tables import Tables

    parameters = ""
    if arguments.config:
        names = ", ".join(shown(file.name) for file in arguments.config)
        parameters = with_parameters(arguments.config, {}, f"as in {names}", {})
    folder = arguments.output.absolute()
    settings = {"config": parameters, "calibrate": arguments.calibrate}
    tables = Tables(folder, settings, arguments.force)
    reports = folder / "reports" if arguments.reports else None
    if reports:
        reports.mkdir(exist_ok=True)
    compile_for_workers(arguments)
    calibrates = arguments.calibrate == "each"
    try:
        with progress(sys.stderr, arguments.quiet, "flights") as show:
            judge_all(
                paths,
                parameters,
                calibrates,
                tables,
                workers,
                arguments.scheduler,
                show,
                reports,
            )
    except KeyboardInterrupt:
        words = (
            "fdi: stopped; finished flights are kept, and the same command continues"
        )
        print(words, file=sys.stderr)
        raise
    except (FdiError, OSError):
        tables.give_up()
        raise
    return tables


def _about_fleet(arguments: Namespace, count: int) -> dict[str, str]:
    """Return the head of the page."""
    config = config_words(arguments)
    return {
        "recordings": f"{count}, from {', '.join(map(str, arguments.paths))}",
        "config": config or "the one that fdi inspect writes for each recording",
        "calibrated": arguments.calibrate,
        "versions": versions(),
    }
