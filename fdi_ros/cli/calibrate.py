"""``fdi calibrate``: a recording in, a parameter file that the node takes as it is out."""

from __future__ import annotations

import argparse
import sys
import warnings
from typing import TYPE_CHECKING

import numpy as np

from fdi_ros.bag.samples import read_block
from fdi_ros.calibration.settings import REPLACED
from fdi_ros.cli.outputs import Kind, check_targets, whole_file
from fdi_ros.cli.progress import Progress
from fdi_ros.cli.said import say, write_json, wrote
from fdi_ros.config.config import Config
from fdi_ros.config.edit import with_parameters
from fdi_ros.errors import CalibrationError, ConfigError
from fdi_ros.model.block import Block
from fdi_ros.monitor.build import build_geometry
from fdi_ros.report.unit import unit_of
from fdi_ros.text import shown

if TYPE_CHECKING:
    from fdi_ros.calibration.result import Calibration


def run(arguments: argparse.Namespace) -> int:
    """Calibrate, print the tables, write the files."""
    _require_scipy()
    from fdi_ros.calibration.calibrate import calibrate
    from fdi_ros.calibration.course import follow
    from fdi_ros.calibration.report import calibration_page
    from fdi_ros.calibration.text import calibration_figures, calibration_text, set_lines

    config = Config.from_file(arguments.config)
    if not 0 <= arguments.start < arguments.end:
        raise ConfigError(f"--start {arguments.start:g} s and --end {arguments.end:g} s: expected 0 <= start < end")
    targets = [arguments.output, arguments.report, arguments.json]
    kinds = (Kind.PARAMETERS, Kind.PAGE, Kind.JSON)
    check_targets(list(zip(targets, kinds, strict=True)), arguments.force, [arguments.bag, arguments.config])
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
        with whole_file(arguments.report) as path:
            path.write_text(calibration_page(result, title, follow(block, config, result)), encoding="utf-8")
    with whole_file(arguments.output) as path:
        path.write_text(text, encoding="utf-8")
        Config.from_file(path)
    write_json(arguments.json, calibration_figures(result))
    say(arguments, calibration_text(result, unit_of(arguments.degrees)))
    say(arguments, "".join(f"{line}\n" for line in set_lines(result, config.parameters())))
    wrote(arguments, targets)
    return 0


def _check_silent(block: Block, config: Config) -> None:
    """Refuse a recording that has no value of a channel."""
    names = build_geometry(config).channel_names
    silent = [name for name, values in zip(names, block.z.T, strict=True) if not np.isfinite(values).any()]
    if silent:
        raise CalibrationError(f"the recording has no value of {', '.join(silent)}")


def _require_scipy() -> None:
    """Ask for what this verb alone needs only when it runs: the others do without."""
    try:
        import scipy  # noqa: F401
    except ImportError as error:
        raise CalibrationError("fdi calibrate needs scipy: pip install 'fdi_ros[calibrate]'") from error


def _note(arguments: argparse.Namespace, result: Calibration) -> str:
    end = min(arguments.end, arguments.start + result.seconds["all"])
    return (
        "geometry.axes (mounts included), noise.*_std and bias.fixed made by fdi calibrate from"
        f" {shown(arguments.bag.name)},\n"
        f"{arguments.start:g} s to {end:.1f} s; reference {', '.join(result.names[i] for i in result.reference)};\n"
        "biases are fixed, none is learned at the start: bias.startup_bias_duration 0"
    )
