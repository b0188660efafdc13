# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""``fdi calibrate``: a recording in, a parameter file that the node takes as it is out."""

from __future__ import annotations

import argparse
import sys
import warnings
from typing import TYPE_CHECKING

import numpy as np

from fdi_ros.bag.samples import read_block
from fdi_ros.calibration.settings import REPLACED
from fdi_ros.cli.arguments import check_part
from fdi_ros.cli.console import say, wrote
from fdi_ros.cli.outputs import Kind, check_targets
from fdi_ros.cli.progress import Progress
from fdi_ros.config.config import Config
from fdi_ros.config.edit import with_parameters
from fdi_ros.errors import CalibrationError
from fdi_ros.model.block import Block
from fdi_ros.monitor.build import build_geometry
from fdi_ros.report.unit import unit_of
from fdi_ros.result_file import whole_file, write_json, write_text
from fdi_ros.text import shown

if TYPE_CHECKING:
    from fdi_ros.calibration.result import Calibration


def run(arguments: argparse.Namespace) -> int:
    """Calibrate, print the tables, write the files."""
    from fdi_ros.calibration.calibrate import calibrate
    from fdi_ros.calibration.report import calibration_page, calibration_text, set_lines
    from fdi_ros.calibration.result import calibration_figures
    from fdi_ros.calibration.time_series import time_series

    config = Config.from_file(arguments.config)
    check_part(arguments)
    outputs = [(arguments.output, Kind.PARAMETERS), (arguments.report, Kind.PAGE), (arguments.json, Kind.JSON)]
    check_targets(outputs, arguments.force, [arguments.bag, arguments.config])
    with Progress(sys.stderr, arguments.quiet) as progress:
        block = read_block(arguments.bag, config, arguments.start, arguments.end, progress.show)
        _check_silent(block, config)
        with progress.during(f"fitting axes, biases and noise to {len(block)} samples"), warnings.catch_warnings():
            # Channels that are nowhere whole over a window are refused by what follows.
            warnings.filterwarnings("ignore", "All-NaN slice", RuntimeWarning)
            result = calibrate(block, config, arguments.reference)
    text = with_parameters(arguments.config, result.settings, _note(arguments, result), REPLACED)
    if arguments.report is not None:
        title = f"{arguments.bag.name}, {arguments.config.name}"
        write_text(arguments.report, calibration_page(result, title, time_series(block, config, result)))
    with whole_file(arguments.output) as path:
        path.write_text(text, encoding="utf-8")
        Config.from_file(path)
    write_json(arguments.json, calibration_figures(result))
    say(arguments, calibration_text(result, unit_of(arguments.degrees)))
    say(arguments, "".join(f"{line}\n" for line in set_lines(result, config.parameters())))
    wrote(arguments, outputs)
    return 0


def _check_silent(block: Block, config: Config) -> None:
    """Refuse a recording that has no value of a channel."""
    names = build_geometry(config).channel_names
    silent = [name for name, values in zip(names, block.z.T, strict=True) if not np.isfinite(values).any()]
    if silent:
        raise CalibrationError(f"the recording has no value of {', '.join(silent)}")


def _note(arguments: argparse.Namespace, result: Calibration) -> str:
    end = min(arguments.end, arguments.start + result.seconds.all)
    return (
        "geometry.axes (mounts included), noise.*_std and bias.fixed made by fdi calibrate from"
        f" {shown(arguments.bag.name)},\n"
        f"{arguments.start:g} s to {end:.1f} s; reference {', '.join(result.names[i] for i in result.reference)};\n"
        "biases are fixed, none is learned at the start: bias.startup_bias_duration 0"
    )
