"""``fdi replay``: arguments, files, and the words for a terminal."""

from __future__ import annotations

import argparse
import math
import platform
import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from fdi_ros.bag.samples import Tap
from fdi_ros.cli.outputs import Kind, check_targets, whole_file, whole_folder
from fdi_ros.cli.progress import Progress
from fdi_ros.cli.said import say, write_json, wrote
from fdi_ros.config.config import Config
from fdi_ros.errors import ConfigError
from fdi_ros.faults.fault import load_scenario, parse_fault
from fdi_ros.monitor.build import build_geometry
from fdi_ros.replay.compare_report import Comparison
from fdi_ros.replay.csv_file import CsvFile
from fdi_ros.replay.output_bag import DIAGNOSTICS_PERIOD, OutputBag
from fdi_ros.replay.report_sink import ComparisonSink, ReportSink
from fdi_ros.replay.requirement import Requirement, failures, parse_check
from fdi_ros.replay.run import Request, Sink, compare, replay
from fdi_ros.replay.tables import comparison_text, summary_text
from fdi_ros.replay.verdict import sample_rate_notes
from fdi_ros.report.unit import unit_of


def run(arguments: argparse.Namespace) -> int:
    """Replay, print a table, write what was asked for."""
    request = _request(arguments)
    required = _required(arguments, request)
    targets = [arguments.json, arguments.csv, arguments.report]
    sources = [arguments.bag, arguments.config, arguments.scenario]
    kinds = (Kind.JSON, Kind.CSV, Kind.PAGE, Kind.FOLDER)
    check_targets(list(zip([*targets, arguments.output], kinds, strict=True)), arguments.force, sources)
    unit, unmet = unit_of(arguments.degrees), []
    with Progress(sys.stderr, arguments.quiet) as progress, ExitStack() as stack:
        if arguments.compare:
            comparison = Comparison()
            watch = partial(_watch, comparison) if arguments.report else None
            result: Any = compare(request, progress.show, watch)
            text = comparison_text(result, unit)
            if arguments.report is not None:
                path = stack.enter_context(whole_file(arguments.report))
                html = comparison.html(str(request.bag), result, _about(arguments, request))
                path.write_text(html, encoding="utf-8")
        else:
            sinks, tap = _sinks(arguments, request, stack)
            result = replay(request, sinks, tap, progress.show)
            unmet = failures(required, result)
            if arguments.check is not None:
                result["check"] = {"required": [one.text for one in required], "unmet": unmet}
            text = summary_text(result, unit)
            for sink in sinks:
                if isinstance(sink, ReportSink):
                    path = stack.enter_context(whole_file(arguments.report))
                    about = _about(arguments, request) | _levels_of(result)
                    path.write_text(sink.report.html(result, about), encoding="utf-8")
        write_json(arguments.json, result)
    say(arguments, text)
    wrote(arguments, [*targets, arguments.output])
    return _checked(arguments, result, unmet)


def _required(arguments: argparse.Namespace, request: Request) -> list[Requirement]:
    """Read what the replay must show: before any work is done."""
    if arguments.check is None:
        return []
    if arguments.compare:
        raise ConfigError("--compare gives one table of all detectors; --check is of one")
    return parse_check(arguments.check, len(request.faults))


def _checked(arguments: argparse.Namespace, result: Any, unmet: Sequence[str]) -> int:
    """Say what came of the check; return the exit code."""
    if arguments.check is not None and arguments.quiet:
        # A check against thresholds that are not what they seem: not even who asked for quiet may miss it.
        for line in sample_rate_notes(**result["sample_rate"]):
            print(f"fdi: warning: {line}", file=sys.stderr)
    for line in unmet:
        print(f"fdi: check not met: {line}", file=sys.stderr)
    if arguments.check is not None and not unmet:
        say(arguments, f"check met: {arguments.check}\n")
    return 1 if unmet else 0


def _request(arguments: argparse.Namespace) -> Request:
    changes = {"detector.name": arguments.detector} if arguments.detector else {}
    config = Config.from_file(arguments.config, changes)
    faults = tuple(parse_fault(text) for text in arguments.fault)
    if arguments.scenario is not None:
        faults += load_scenario(arguments.scenario)
    if not 0 <= arguments.start < arguments.end:
        raise ConfigError(f"--start {arguments.start:g} s and --end {arguments.end:g} s: expected 0 <= start < end")
    if arguments.compare and (arguments.csv or arguments.output):
        raise ConfigError("--compare gives one table of all detectors; --csv and --output are of one")
    request = Request(arguments.bag, config, faults, arguments.start, arguments.end)
    return replace(request, period=DIAGNOSTICS_PERIOD) if arguments.output else request


def _sinks(arguments: argparse.Namespace, request: Request, stack: ExitStack) -> tuple[list[Sink], Tap | None]:
    """Open the outputs that grow with the stream."""
    geometry = build_geometry(request.config)
    sinks: list[Sink] = []
    tap = None
    if arguments.csv is not None:
        path = stack.enter_context(whole_file(arguments.csv))
        sinks.append(CsvFile(stack.enter_context(path.open("w", newline="", encoding="utf-8")), geometry.channel_names))
    if arguments.report is not None:
        sinks.append(ReportSink(geometry))
    if arguments.output is not None:
        path = stack.enter_context(whole_folder(arguments.output))
        bag = stack.enter_context(OutputBag(path, request.config, geometry.n))
        sinks.append(bag)
        tap = bag.tap
    return sinks, tap


def _watch(comparison: Comparison, detector: str) -> list[Sink]:
    return [ComparisonSink(comparison, detector)]


def _about(arguments: argparse.Namespace, request: Request) -> dict[str, str]:
    """Say what was run, for the report."""
    default = Config().parameters()
    changed = {name: value for name, value in request.config.parameters().items() if value != default[name]}
    return {
        "recording": str(request.bag),
        "part": f"{request.start:g} s to {'the end' if math.isinf(request.end) else f'{request.end:g} s'}",
        "config": str(arguments.config),
        "detector": "all" if arguments.compare else request.config.detector.name,
        "faults": "; ".join(map(str, request.faults)) or "none",
        "seeds": ", ".join(str(fault.seed) for fault in request.faults) or "none needed",
        "versions": f"fdi_ros {arguments.version}, NumPy {np.__version__}, Python {platform.python_version()}",
        "settings other than the default": "; ".join(f"{name}: {value}" for name, value in changed.items()),
    }


def _levels_of(result: Mapping[str, Any]) -> dict[str, str]:
    levels = result["protection_level"]
    return {f"protection level {when.replace('_', ' ')}": _levels(values) for when, values in levels.items()}


def _levels(values: Sequence[float | None]) -> str:
    shown = ("none" if value is None else f"{value:.4g}" for value in values)
    return " ".join(f"{axis} {value}" for axis, value in zip("xyz", shown, strict=True)) + " rad/s"
