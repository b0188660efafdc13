# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Verbs that make settings (``fdi inspect``, ``setup``, ``calibrate``) or a bag (``convert``) of a recording."""

from __future__ import annotations

import shlex
import sys
from argparse import Namespace
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from fdi_ros.bag.reader import Recording, convert
from fdi_ros.cli.outputs import Kind, Outputs, check_part, progress
from fdi_ros.config.config import Config, with_parameters
from fdi_ros.errors import ConfigError
from fdi_ros.inspection.findings import Finding, Role, findings_figures, verdict_of
from fdi_ros.inspection.fitness import (
    candidates,
    incomplete_findings,
    needs,
    one_clock,
    recording_findings,
    short_findings,
)
from fdi_ros.inspection.starting_config import (
    StartingConfig,
    starting_config,
    turned_units,
)
from fdi_ros.inspection.topics import (
    TopicReport,
    inspect,
    recording_figures,
    recording_text,
    topics_text,
)
from fdi_ros.inspection.urdf import Urdf, read_urdf
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.report.layout import unit_of
from fdi_ros.system.files import whole
from fdi_ros.system.text import LINE, shown

if TYPE_CHECKING:
    from fdi_ros.setup.run import SetupResult


def run_inspect(arguments: Namespace) -> int:
    """Print the fitness of a recording and its topics and write a config to start from."""
    inputs = [path for path in (arguments.bag, arguments.urdf) if path is not None]
    outputs = Outputs(arguments, ("json", "output"), inputs)
    unit = unit_of(arguments.degrees)
    urdf = None if arguments.urdf is None else read_urdf(arguments.urdf, arguments.bag)
    reports, damage, unread, incomplete = inspect(arguments.bag)
    start, refused = _starting_config(reports, arguments.bag, urdf)
    config = None if start is None else start.text
    looks = [*_mount_findings(start, arguments.bag, reports)]
    looks += incomplete_findings(reports, incomplete)
    learned = {} if start is None else start.parameters
    looks += short_findings(reports, learned.get("bias.startup_bias_duration", 0.0))
    found = verdict_of([*recording_findings(reports, refused, unit, unread), *looks])
    text = f"{found.words}\n{recording_text(reports, arguments.bag)}"
    text += topics_text(reports, damage, unit)
    if start is not None and start.mounted:
        text += f"\nmounts of the config: {start.mounted}\n"
    if config is not None and arguments.output is None:
        words = shlex.quote(shown(arguments.bag))
        if urdf is not None:
            words += f" --urdf {shlex.quote(shown(arguments.urdf))}"
        text += (
            f"\na config to start from: fdi inspect {words} --output my_gyros.yaml\n"
        )
    figures = recording_figures(reports, arguments.bag, damage)
    figures |= {
        **findings_figures(
            [*recording_findings(reports, refused, unread=unread), *looks]
        ),
        "config": config,
    }
    if config is None:
        outputs.targets.pop("output", None)

    def write(path: Path) -> None:
        path.write_text(str(config), encoding="utf-8", errors="replace")

    code = outputs.finish(text, figures, None, found.severity, output=write)
    if config is None and arguments.output is not None:
        raise ConfigError(
            f"{arguments.output} is not written: {shown(arguments.bag.name)} {found.words}"
        )
    return code


def _mount_findings(
    start: StartingConfig | None, bag: Path, reports: Sequence[TopicReport]
) -> Iterator[Finding]:
    """Yield a finding if the config of a fit recording has parallel units that are not."""
    if start is None or start.mounted or one_clock(candidates(reports)):
        return
    if turned := turned_units(bag, Config.from_parameters(start.parameters)):
        yield Finding(
            Role.WARNING,
            "mounts",
            turned,
            headline="READY, BUT LOOK",
            advice="use `fdi setup`, because `fdi inspect` does not measure mounts",
        )


def _starting_config(
    reports: Sequence[TopicReport], bag: Path, urdf: Urdf | None
) -> tuple[StartingConfig | None, str]:
    """Return a config to start from, and why the node would refuse it.

    The config is None if the recording is unfit or the node would refuse it.
    """
    if needs(reports):
        return None, ""
    start = starting_config(candidates(reports), bag, urdf)
    try:
        Config.from_parameters(start.parameters)
    except ConfigError as error:
        # A recording may contain any values. A config that the node refuses is no use.
        return None, f"other values: {shown(error, LINE)}"
    return start, ""


def run_setup(arguments: Namespace) -> int:
    """Set up from a recording: write config and page, print the result."""
    from fdi_ros.setup.run import set_up

    check_part(arguments)
    arguments.report = arguments.report or arguments.output.with_suffix(".html")
    outputs = Outputs(arguments, ("output", "report", "json"), [arguments.bag])
    with progress(sys.stderr, arguments.quiet, "reading the recording", timed=True):
        found = set_up(
            arguments.bag,
            arguments.start,
            arguments.end,
            arguments.reference,
            arguments.proof,
        )
    origin = shown(
        f"made by fdi setup from {arguments.bag.name}; {arguments.report.name} says how.",
        LINE,
    )
    return _finish(arguments, outputs, found, f"# {origin}\n{found.text}")


def run_calibrate(arguments: Namespace) -> int:
    """Calibrate, write the files, print the result."""
    from fdi_ros.setup.calibrate import REPLACED
    from fdi_ros.setup.run import recalibrate

    config = Config.from_file(arguments.config)
    check_part(arguments)
    outputs = Outputs(
        arguments, ("output", "report", "json"), [arguments.bag, *arguments.config]
    )
    with progress(
        sys.stderr, arguments.quiet, "fitting axes, biases and noise", timed=True
    ):
        found = recalibrate(
            arguments.bag,
            config,
            arguments.start,
            arguments.end,
            arguments.reference,
            arguments.proof,
        )
    settings, origin = _calibrated(arguments, found)
    text = with_parameters(
        arguments.config, settings, origin, found.remarks, REPLACED if settings else ()
    )
    return _finish(
        arguments, outputs, found, text, f"set: {', '.join(settings) or 'nothing'}\n"
    )


def _calibrated(
    arguments: Namespace, found: SetupResult
) -> tuple[dict[str, object], str]:
    """Return the settings that a calibration changes, and the comment on their origin."""
    bag = shown(arguments.bag.name)
    configs = ", ".join(shown(file.name) for file in arguments.config)
    if found.kept:
        return (
            {},
            f"made by fdi calibrate: as in {configs}, because the result from {bag} is no better",
        )
    result = found.calibration
    assert result is not None
    end = min(arguments.end, arguments.start + result.duration)
    return dict(result.settings), (
        f"made by fdi calibrate from {bag}, {arguments.start:g} s to {end:.1f} s:\n"
        f"{', '.join(result.settings)}; all else is as in {configs}.\n"
        "Biases are fixed, none is learned at the start: bias.startup_bias_duration 0."
    )


def _finish(
    arguments: Namespace,
    outputs: Outputs,
    found: SetupResult,
    config: str,
    more: str = "",
) -> int:
    """Write config, page and figures, and print the result."""
    from fdi_ros.setup.report import (
        setup_figures,
        setup_findings,
        setup_page,
        setup_text,
    )

    def write(path: Path) -> None:
        path.write_text(config, encoding="utf-8")
        # Raises if the node would refuse the config: then no file is written.
        Pipeline(Config.from_file(path))

    said = str(arguments.bag), str(arguments.output), unit_of(arguments.degrees)
    text = setup_text(found, *said) + more
    figures = setup_figures(found, str(arguments.bag))
    severity = verdict_of(setup_findings(found)).severity
    return outputs.finish(
        text, figures, lambda: setup_page(found, *said), severity, output=write
    )


def run_convert(arguments: Namespace) -> int:
    """Convert the gyro topics to an MCAP bag, and print the number of messages."""
    outputs = Outputs(
        arguments, ("output", "json"), [arguments.bag], output=Kind.FOLDER
    )
    with Recording(arguments.bag) as recording:
        with (
            progress(sys.stderr, arguments.quiet) as show,
            whole(arguments.output) as path,
        ):
            counts = convert(recording, path, show)
        damage = recording.damage.report()
    lines = [f"{shown(topic)}: {count} messages\n" for topic, count in counts.items()]
    lines += [f"note: {line}\n" for line in damage]
    return outputs.finish(
        "".join(lines),
        {"bag": str(arguments.output), "messages": counts, "damage": list(damage)},
    )
