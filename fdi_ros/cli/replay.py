# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""``fdi replay``: arguments, files, and the words for a terminal."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import Any, NamedTuple

from fdi_ros.cli.outputs import Kind, Outputs, Progress, check_part, part_words, versions
from fdi_ros.config.config import Config
from fdi_ros.errors import ConfigError
from fdi_ros.faults.fault import load_scenario, parse_fault
from fdi_ros.monitor.build import build_geometry
from fdi_ros.replay.comparison import ComparisonReport, comparison_text
from fdi_ros.replay.evaluate import Condition, failures, parse_check
from fdi_ros.replay.outputs import DIAGNOSTICS_PERIOD, CsvFile, OutputBag
from fdi_ros.replay.report import Report
from fdi_ros.replay.run import Request, Sink, compare, replay
from fdi_ros.replay.summary import as_json, comparison_as_json, sample_rate_notes, summary_text
from fdi_ros.report.layout import unit_of
from fdi_ros.result_file import whole_file, whole_folder, write_json


class _Done(NamedTuple):
    """What came of a replay, or of a comparison, which has no check."""

    text: str
    figures: dict[str, Any]
    html: str
    """Of the page; empty: not asked for."""
    warnings: Sequence[str] = ()
    """Said with a check even where quiet was asked for."""
    unmet: Sequence[str] = ()
    """What of the check does not hold."""


def run(arguments: argparse.Namespace) -> int:
    """Replay, print a table, write what was asked for."""
    request = _request(arguments)
    required = _required(arguments, request)
    sources = [arguments.bag, arguments.config, arguments.scenario]
    outputs = Outputs(arguments, ("json", "csv", "report", "output"), sources, output=Kind.FOLDER)
    with Progress(sys.stderr, arguments.quiet) as progress, ExitStack() as stack:
        if arguments.compare:
            done = _compare(arguments, request, progress)
        else:
            done = _replay(arguments, request, required, progress, _sinks(arguments, request, stack))
        if done.html:
            stack.enter_context(whole_file(arguments.report)).write_text(done.html, encoding="utf-8")
        write_json(arguments.json, done.figures)
    outputs.finish(done.text)
    return 0 if arguments.check is None else _say_check(arguments, outputs, done)


def _required(arguments: argparse.Namespace, request: Request) -> list[Condition]:
    """Read what the replay must show: before any work is done."""
    if arguments.check is None:
        return []
    if arguments.compare:
        raise ConfigError("--compare gives one table of all detectors; --check is of one")
    return parse_check(arguments.check, len(request.faults), build_geometry(request.config))


def _replay(
    arguments: argparse.Namespace,
    request: Request,
    required: Sequence[Condition],
    progress: Progress,
    sinks: Sequence[Sink],
) -> _Done:
    """Replay with one detector."""
    report = Report(build_geometry(request.config)) if arguments.report is not None else None
    summary = replay(request, [*sinks, report] if report else sinks, progress.show)
    unmet, figures = failures(required, summary), as_json(summary)
    if arguments.check is not None:
        figures["check"] = {"required": [one.text for one in required], "unmet": unmet}
    html = report.html(summary, _about(arguments, request)) if report else ""
    text = summary_text(summary, unit_of(arguments.degrees))
    return _Done(text, figures, html, sample_rate_notes(summary.stream.sample_rate), unmet)


def _compare(arguments: argparse.Namespace, request: Request, progress: Progress) -> _Done:
    """Replay with all detectors."""
    report = ComparisonReport() if arguments.report is not None else None
    results = compare(request, [report] if report else [], progress.show)
    html = report.html(str(request.bag), results, _about(arguments, request)) if report else ""
    text = comparison_text(results, unit_of(arguments.degrees))
    return _Done(text, comparison_as_json(str(request.bag), results), html)


def _say_check(arguments: argparse.Namespace, outputs: Outputs, done: _Done) -> int:
    """Say what came of the check; return the exit code."""
    # A check against thresholds that are not what they seem: not even who asked for quiet may miss it.
    for line in done.warnings if arguments.quiet else ():
        print(f"fdi: warning: {line}", file=sys.stderr)
    for line in done.unmet:
        print(f"fdi: check not met: {line}", file=sys.stderr)
    if not done.unmet:
        outputs.say(f"check met: {arguments.check}\n")
    return 1 if done.unmet else 0


def _request(arguments: argparse.Namespace) -> Request:
    changes = {"detector.name": arguments.detector} if arguments.detector else {}
    config = Config.from_file(arguments.config, changes)
    faults = tuple(parse_fault(text) for text in arguments.fault)
    if arguments.scenario is not None:
        faults += load_scenario(arguments.scenario)
    check_part(arguments)
    if arguments.compare and (arguments.csv or arguments.output):
        raise ConfigError("--compare gives one table of all detectors; --csv and --output are of one")
    request = Request(arguments.bag, config, faults, arguments.start, arguments.end)
    return replace(request, period=DIAGNOSTICS_PERIOD) if arguments.output else request


def _sinks(arguments: argparse.Namespace, request: Request, stack: ExitStack) -> list[Sink]:
    """Open the outputs that grow with the stream."""
    geometry = build_geometry(request.config)
    sinks: list[Sink] = []
    if arguments.csv is not None:
        path = stack.enter_context(whole_file(arguments.csv))
        sinks.append(CsvFile(stack.enter_context(path.open("w", newline="", encoding="utf-8")), geometry.channel_names))
    if arguments.output is not None:
        path = stack.enter_context(whole_folder(arguments.output))
        sinks.append(stack.enter_context(OutputBag(path, request.config, geometry.n)))
    return sinks


def _written(value: object) -> str:
    """Write a setting as in a file, to the figures that matter."""
    if isinstance(value, (tuple, list)):
        return f"[{', '.join(map(_written, value))}]"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _about(arguments: argparse.Namespace, request: Request) -> dict[str, str]:
    """Say what was run, for the report."""
    default = Config().parameters()
    changed = {name: value for name, value in request.config.parameters().items() if value != default[name]}
    return {
        "recording": str(request.bag),
        "part": part_words(arguments),
        "config": str(arguments.config),
        "detector": "all" if arguments.compare else request.config.detector.name,
        "faults": "; ".join(map(str, request.faults)) or "none",
        "seeds": ", ".join(str(fault.seed) for fault in request.faults) or "none needed",
        "versions": versions(),
        "settings other than the default": "; ".join(f"{name}: {_written(value)}" for name, value in changed.items()),
    }
