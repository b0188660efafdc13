# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""``fdi calibrate``: a recording and a config in, the config with what the recording shows out."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from fdi_ros.cli.arguments import check_part
from fdi_ros.cli.console import Progress, say, wrote
from fdi_ros.cli.outputs import Kind, check_targets
from fdi_ros.config.config import Config
from fdi_ros.config.edit import with_parameters
from fdi_ros.report.text_table import unit_of
from fdi_ros.result_file import whole_file, write_json, write_text
from fdi_ros.text import shown

if TYPE_CHECKING:
    from fdi_ros.calibration.result import Calibration


def run(arguments: argparse.Namespace) -> int:
    """Calibrate, say what was found, write the files."""
    from fdi_ros.calibration.calibrate import REPLACED
    from fdi_ros.inspection.setup import recalibrate
    from fdi_ros.inspection.setup_report import setup_figures, setup_page, setup_text

    config = Config.from_file(arguments.config)
    check_part(arguments)
    outputs = [(arguments.output, Kind.PARAMETERS), (arguments.report, Kind.PAGE), (arguments.json, Kind.JSON)]
    check_targets(outputs, arguments.force, [arguments.bag, arguments.config])
    with Progress(sys.stderr, arguments.quiet) as progress, progress.during("fitting axes, biases and noise"):
        found = recalibrate(arguments.bag, config, arguments.start, arguments.end, arguments.reference, arguments.proof)
    result = found.calibration
    assert result is not None
    text = with_parameters(arguments.config, result.settings, _note(arguments, result), REPLACED)
    with whole_file(arguments.output) as path:
        path.write_text(text, encoding="utf-8")
        Config.from_file(path)
    if arguments.report is not None:
        write_text(arguments.report, setup_page(found, str(arguments.bag), str(arguments.output)))
    write_json(arguments.json, setup_figures(found, str(arguments.bag)))
    say(arguments, setup_text(found, str(arguments.bag), str(arguments.output), unit_of(arguments.degrees)))
    say(arguments, f"set: {', '.join(result.settings)}\n")
    wrote(arguments, outputs)
    return 0


def _note(arguments: argparse.Namespace, result: Calibration) -> str:
    end = min(arguments.end, arguments.start + result.seconds.all)
    return (
        "geometry.axes (mounts included), noise.*_std and bias.fixed made by fdi calibrate from"
        f" {shown(arguments.bag.name)},\n"
        f"{arguments.start:g} s to {end:.1f} s;\n"
        "biases are fixed, none is learned at the start: bias.startup_bias_duration 0"
    )
