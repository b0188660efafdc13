# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""From a recording to settings: ``fdi inspect``, ``fdi setup``, ``fdi calibrate``; and to a bag: ``fdi convert``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from fdi_ros.bag.reader import Recording
from fdi_ros.bag.reader import convert as convert_recording
from fdi_ros.cli.outputs import Kind, Outputs, Progress, check_part
from fdi_ros.config.config import Config
from fdi_ros.config.parameter_file import with_parameters
from fdi_ros.errors import ConfigError
from fdi_ros.limits import LINE
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.report.layout import unit_of
from fdi_ros.result_file import whole_file, whole_folder, write_json, write_text
from fdi_ros.setup.inspect import TopicReport, candidates, missing, recording_figures, recording_text, topics_text
from fdi_ros.setup.inspect import inspect as inspect_recording
from fdi_ros.setup.starting_config import starting_config
from fdi_ros.text import shown

if TYPE_CHECKING:
    from fdi_ros.setup.result import Calibration


def inspect(arguments: argparse.Namespace) -> int:
    """Print what is there: a table of the topics, and a config to start from."""
    outputs = Outputs(arguments, ("json", "output"), [arguments.bag])
    reports, damage = inspect_recording(arguments.bag)
    # All of it first: what is compiled for it is announced before the result, not within.
    topics = topics_text(reports, damage, unit_of(arguments.degrees))
    outputs.say(recording_text(reports, arguments.bag))
    outputs.say(topics)
    config, why = _starting_config(reports, arguments.bag)
    write_json(arguments.json, {**recording_figures(reports, arguments.bag, damage), "config": config})
    if config is None:
        outputs.confirm("json")
        if arguments.output is not None:
            raise ConfigError(f"{arguments.output} is not written: {why}")
        outputs.say(f"\n{why}\n")
        return 0
    outputs.say(f"\n{config}")
    if arguments.output is not None:
        write_text(arguments.output, config)
    outputs.confirm()
    return 0


def _starting_config(reports: Sequence[TopicReport], bag: Path) -> tuple[str | None, str]:
    """Return a config to start from, or none and why."""
    chosen = candidates(reports)
    if not chosen:
        return None, f"no config: {missing(reports)}"
    start = starting_config(chosen, bag)
    try:
        Config.from_parameters(start.parameters)
    except ConfigError as error:
        # A recording may say anything: what the node would refuse is not offered.
        return None, f"no config: {shown(error, LINE)}"
    return start.text, ""


def setup(arguments: argparse.Namespace) -> int:
    """Find out what the recording shows, write config and page, say both."""
    from fdi_ros.setup.report import setup_figures, setup_page, setup_text
    from fdi_ros.setup.run import set_up

    check_part(arguments)
    arguments.report = report = arguments.report or arguments.output.with_suffix(".html")
    outputs = Outputs(arguments, ("output", "report", "json"), [arguments.bag])
    with Progress(sys.stderr, arguments.quiet) as progress, progress.during("looking into the recording"):
        found = set_up(arguments.bag, arguments.start, arguments.end, arguments.reference, arguments.proof)
    names = str(arguments.bag), str(arguments.output)
    with whole_file(report) as page, whole_file(arguments.output) as path:
        origin = shown(f"made by fdi setup from {arguments.bag.name}; {report.name} says how.", LINE)
        path.write_text(f"# {origin}\n{found.text}", encoding="utf-8")
        # What the node would refuse is not written.
        Pipeline.from_config(Config.from_file(path))
        write_json(arguments.json, setup_figures(found, str(arguments.bag)))
        page.write_text(setup_page(found, *names), encoding="utf-8")
    return outputs.finish(setup_text(found, *names))


def calibrate(arguments: argparse.Namespace) -> int:
    """Calibrate, say what was found, write the files."""
    from fdi_ros.setup.calibrate import REPLACED
    from fdi_ros.setup.report import setup_figures, setup_page, setup_text
    from fdi_ros.setup.run import recalibrate

    config = Config.from_file(arguments.config)
    check_part(arguments)
    outputs = Outputs(arguments, ("output", "report", "json"), [arguments.bag, arguments.config])
    with Progress(sys.stderr, arguments.quiet) as progress, progress.during("fitting axes, biases and noise"):
        found = recalibrate(arguments.bag, config, arguments.start, arguments.end, arguments.reference, arguments.proof)
    result = found.calibration
    assert result is not None
    with whole_file(arguments.output) as path:
        origin = _calibration_origin(arguments, result)
        text = with_parameters([arguments.config], result.settings, origin, found.remarks, REPLACED)
        path.write_text(text, encoding="utf-8")
        Config.from_file(path)
    names = str(arguments.bag), str(arguments.output)
    told = f"{setup_text(found, *names, unit_of(arguments.degrees))}set: {', '.join(result.settings)}\n"
    return outputs.finish(told, setup_figures(found, str(arguments.bag)), lambda: setup_page(found, *names))


def _calibration_origin(arguments: argparse.Namespace, result: Calibration) -> str:
    end = min(arguments.end, arguments.start + result.seconds.all)
    bag, config = shown(arguments.bag.name), shown(arguments.config.name)
    return (
        f"made by fdi calibrate from {bag}, {arguments.start:g} s to {end:.1f} s:\n"
        f"{', '.join(result.settings)}; all else is as in {config}.\n"
        "Biases are fixed, none is learned at the start: bias.startup_bias_duration 0."
    )


def convert(arguments: argparse.Namespace) -> int:
    """Convert to an MCAP bag of the gyro topics, and say how much was written."""
    if (arguments.output is None) == (arguments.folder is None):
        raise ConfigError("convert needs one folder to write: --output DIR")
    arguments.output = target = arguments.output or arguments.folder
    outputs = Outputs(arguments, ("output", "json"), [arguments.bag], output=Kind.FOLDER)
    with Recording(arguments.bag) as recording:
        with Progress(sys.stderr, arguments.quiet) as progress, whole_folder(target) as path:
            counts = convert_recording(recording, path, progress.show)
        damage = recording.damage.report()
    told = [f"{shown(topic)}: {count} messages\n" for topic, count in counts.items()]
    told += [f"note: damaged recording: {line}\n" for line in damage]
    return outputs.finish("".join(told), {"bag": str(target), "messages": counts, "damage": list(damage)})
