# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""From a recording to settings: ``fdi inspect``, ``fdi setup``, ``fdi calibrate``; and to a bag: ``fdi convert``."""

from __future__ import annotations

import sys
from argparse import Namespace
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from fdi_ros.cli.arguments import FILE, PART, RESULTS, Options, Verb, config_files, shared
from fdi_ros.errors import ConfigError
from fdi_ros.system.installation import BAGS, POOL, PROGRESS, resolve
from fdi_ros.system.text import LINE, shown

if TYPE_CHECKING:
    from fdi_ros.cli.outputs import Outputs
    from fdi_ros.setup.inspect import TopicReport
    from fdi_ros.setup.result import Calibration
    from fdi_ros.setup.run import SetupResult


_MADE: Mapping[str, Options] = {
    "--output": {**FILE, "help": "parameter file to write", "required": True},
    **PART,
    "--reference": {
        "default": "",
        "metavar": "NAME",
        "help": "triad that is taken for as configured, or three channels 'a,b,c'; default: all are alike",
    },
    "--proof": {
        "type": resolve,
        "metavar": "RECORDING",
        "help": "prove the settings on this one; default: on the last quarter of the recording, which is kept aside",
    },
}
"""What is made settings of, and where they are written."""


def _inspect(arguments: Namespace) -> int:
    """Print what it is fit for, a table of the topics, and a config to start from."""
    from fdi_ros.cli.outputs import Outputs
    from fdi_ros.report.layout import unit_of
    from fdi_ros.setup.findings import findings_figures, recording_findings, verdict_of
    from fdi_ros.setup.inspect import inspect, recording_figures, recording_text, topics_text
    from fdi_ros.system.files import write_json, write_text

    outputs, unit = Outputs(arguments, ("json", "output"), [arguments.bag]), unit_of(arguments.degrees)
    reports, damage = inspect(arguments.bag)
    # All of it first: what is compiled for it is announced before the result, not within.
    topics = topics_text(reports, damage, unit)
    config, refused = _starting_config(reports, arguments.bag)
    found = verdict_of(recording_findings(reports, refused, unit))
    figures = {**findings_figures(list(recording_findings(reports, refused))), "config": config}
    write_json(arguments.json, {**recording_figures(reports, arguments.bag, damage), **figures})
    outputs.say(f"{found.words}\n", found.severity)
    outputs.say(f"{recording_text(reports, arguments.bag)}{topics}")
    if config is None:
        outputs.confirm("json")
        if arguments.output is not None:
            raise ConfigError(f"{arguments.output} is not written: {shown(arguments.bag.name)} {found.words}")
        return found.severity.exit_code
    outputs.say(f"\n{config}")
    if arguments.output is not None:
        write_text(arguments.output, config)
    outputs.confirm()
    return found.severity.exit_code


def _starting_config(reports: Sequence[TopicReport], bag: Path) -> tuple[str | None, str]:
    """Return a config to start from, or none, and why the node would refuse it."""
    from fdi_ros.config.config import Config
    from fdi_ros.setup.findings import candidates, needs
    from fdi_ros.setup.starting_config import starting_config

    if needs(reports):
        return None, ""
    start = starting_config(candidates(reports), bag)
    try:
        Config.from_parameters(start.parameters)
    except ConfigError as error:
        # A recording may say anything: what the node would refuse is not offered.
        return None, f"other values: {shown(error, LINE)}"
    return start.text, ""


INSPECT = Verb(
    "say what is in a recording and print a starting config for it",
    ("fdi inspect my_flight", "fdi inspect flight.ulg --output my_gyros.yaml"),
    {
        **shared("bag"),
        "--output --write": {**FILE, "help": "write the config to a file, too"},
        **RESULTS,
        **shared("--degrees"),
    },
    _inspect,
    (*BAGS, *PROGRESS),
)


def _setup(arguments: Namespace) -> int:
    """Find out what the recording shows, write config and page, say both."""
    from fdi_ros.cli.outputs import Outputs, Progress, check_part
    from fdi_ros.setup.run import set_up

    check_part(arguments)
    arguments.report = arguments.report or arguments.output.with_suffix(".html")
    outputs = Outputs(arguments, ("output", "report", "json"), [arguments.bag])
    with Progress(sys.stderr, arguments.quiet, "looking into the recording", timed=True):
        found = set_up(arguments.bag, arguments.start, arguments.end, arguments.reference, arguments.proof)
    origin = shown(f"made by fdi setup from {arguments.bag.name}; {arguments.report.name} says how.", LINE)
    return _write_found(arguments, outputs, found, f"# {origin}\n{found.text}")


def _write_found(arguments: Namespace, outputs: Outputs, found: SetupResult, config: str, more: str = "") -> int:
    """Write config, page and figures, and say what was found."""
    from fdi_ros.config.config import Config
    from fdi_ros.monitor.pipeline import Pipeline
    from fdi_ros.report.layout import unit_of
    from fdi_ros.setup.findings import verdict_of
    from fdi_ros.setup.report import setup_figures, setup_findings, setup_page, setup_text

    def write(path: Path) -> None:
        path.write_text(config, encoding="utf-8")
        # What the node would refuse is not written.
        Pipeline(Config.from_file(path))

    said = str(arguments.bag), str(arguments.output), unit_of(arguments.degrees)
    text, figures = setup_text(found, *said) + more, setup_figures(found, str(arguments.bag))
    severity = verdict_of(setup_findings(found)).severity
    return outputs.finish(text, figures, lambda: setup_page(found, *said), severity, output=write)


SETUP = Verb(
    "from a recording to a config in one go: topics, mounts, delays, biases, noise, with a page of what was found",
    (
        "fdi setup my_flight --output my_gyros.yaml",
        "fdi setup flight.bin --end 120 --output my_gyros.yaml --report found.html",
    ),
    {
        **shared("bag"),
        **_MADE,
        "--report": {"help": "page of what was found; default: beside the parameter file"},
        **RESULTS,
        **shared("--degrees"),
    },
    _setup,
    (*BAGS, *POOL, "scipy"),
)


def _calibrate(arguments: Namespace) -> int:
    """Calibrate, say what was found, write the files."""
    from fdi_ros.cli.outputs import Outputs, Progress, check_part
    from fdi_ros.config.config import Config, with_parameters
    from fdi_ros.setup.calibrate import REPLACED
    from fdi_ros.setup.run import recalibrate

    config = Config.from_file(arguments.config)
    check_part(arguments)
    outputs = Outputs(arguments, ("output", "report", "json"), [arguments.bag, *arguments.config])
    with Progress(sys.stderr, arguments.quiet, "fitting axes, biases and noise", timed=True):
        found = recalibrate(arguments.bag, config, arguments.start, arguments.end, arguments.reference, arguments.proof)
    result = found.calibration
    assert result is not None
    settings = {} if found.kept else result.settings
    origin = _calibration_origin(arguments, result, found.kept)
    text = with_parameters(arguments.config, settings, origin, found.remarks, REPLACED if settings else ())
    return _write_found(arguments, outputs, found, text, f"set: {', '.join(settings) or 'nothing'}\n")


def _calibration_origin(arguments: Namespace, result: Calibration, kept: str) -> str:
    bag, configs = shown(arguments.bag.name), ", ".join(shown(file.name) for file in arguments.config)
    if kept:
        return f"made by fdi calibrate: all is as in {configs}; what {bag} gives is no better"
    end = min(arguments.end, arguments.start + result.duration)
    return (
        f"made by fdi calibrate from {bag}, {arguments.start:g} s to {end:.1f} s:\n"
        f"{', '.join(result.settings)}; all else is as in {configs}.\n"
        "Biases are fixed, none is learned at the start: bias.startup_bias_duration 0."
    )


CALIBRATE = Verb(
    "fit axes, biases and noise to a recording and write a config",
    ("fdi calibrate my_flight --config my_gyros.yaml --output calibrated.yaml --report calibration.html",),
    {
        **shared("bag"),
        **config_files(" to start from"),
        **_MADE,
        **shared("--report"),
        **RESULTS,
        **shared("--degrees"),
    },
    _calibrate,
    (*BAGS, *POOL, "scipy"),
)


def _convert(arguments: Namespace) -> int:
    """Convert to an MCAP bag of the gyro topics, and say how much was written."""
    from fdi_ros.bag.reader import Recording, convert
    from fdi_ros.cli.outputs import Kind, Outputs, Progress
    from fdi_ros.system.files import whole

    target = arguments.output
    outputs = Outputs(arguments, ("output", "json"), [arguments.bag], output=Kind.FOLDER)
    with Recording(arguments.bag) as recording:
        with Progress(sys.stderr, arguments.quiet) as progress, whole(target) as path:
            counts = convert(recording, path, progress.show)
        damage = recording.damage.report()
    lines = [f"{shown(topic)}: {count} messages\n" for topic, count in counts.items()]
    lines += [f"note: {line}\n" for line in damage]
    return outputs.finish("".join(lines), {"bag": str(target), "messages": counts, "damage": list(damage)})


CONVERT = Verb(
    "write the gyro topics of a flight log, or of any recording, as an MCAP bag",
    ("fdi convert flight.bin --output flight_bag",),
    {
        **shared("bag"),
        "--output": {**FILE, "help": "rosbag2 folder to write, with one MCAP file", "metavar": "DIR", "required": True},
        **RESULTS,
        "--force": {"help": "overwrite a bag made by fdi"},
    },
    _convert,
    (*BAGS, *PROGRESS),
)
