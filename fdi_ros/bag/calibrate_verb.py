"""``fdi calibrate``: a recording in, a parameter file that the node takes as it is out."""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fdi_ros.bag.outputs import check_targets, whole_file
from fdi_ros.bag.reader import Recording
from fdi_ros.bag.samples import Samples
from fdi_ros.config import Config
from fdi_ros.errors import CalibrationError, ConfigError
from fdi_ros.model.block import Block
from fdi_ros.monitor.build import build_geometry
from fdi_ros.study.parameter_file import with_parameters

if TYPE_CHECKING:
    from fdi_ros.study.calibration_result import Calibration


def run(arguments: argparse.Namespace) -> int:
    """Calibrate, print the tables, write the files."""
    _require_scipy()
    from fdi_ros.study.calibrate import calibrate
    from fdi_ros.study.calibration_course import follow
    from fdi_ros.study.calibration_report import calibration_page
    from fdi_ros.study.calibration_text import calibration_text

    config = Config.from_file(arguments.config)
    if not 0 <= arguments.start < arguments.end:
        raise ConfigError(f"--start {arguments.start:g} s and --end {arguments.end:g} s: expected 0 <= start < end")
    check_targets([arguments.output, arguments.report], arguments.force, [arguments.bag, arguments.config])
    block = read_block(arguments.bag, config, arguments.start, arguments.end)
    result = calibrate(block, config, arguments.reference)
    text = with_parameters(arguments.config, result.settings, _note(arguments, result))
    if arguments.report is not None:
        title = f"{arguments.bag.name}, {arguments.config.name}"
        with whole_file(arguments.report) as path:
            path.write_text(calibration_page(result, title, follow(block, config, result)), encoding="utf-8")
    with whole_file(arguments.output) as path:
        path.write_text(text, encoding="utf-8")
        Config.from_file(path)
    sys.stdout.write(calibration_text(result) + f"wrote {arguments.output}\n")
    return 0


def _require_scipy() -> None:
    """Ask for what this verb alone needs only when it runs: the others do without."""
    try:
        import scipy  # noqa: F401
    except ImportError as error:
        raise CalibrationError("fdi calibrate needs scipy: pip install 'fdi_ros[calibrate]'") from error


def read_block(bag: Path, config: Config, start: float = 0.0, end: float = math.inf) -> Block:
    """Read all samples of a part of a recording, aligned as in a replay.

    Raises
    ------
    FdiError
        If there is no such recording, or it lacks a topic of the configuration.
    """
    channels = build_geometry(config).n
    with Recording(bag) as recording:
        blocks = list(Samples(recording, config, channels, start, end).blocks())
    received = [np.ones(b.z.shape, dtype=bool) if b.received is None else b.received for b in blocks]
    return Block(
        np.concatenate([b.stamp for b in blocks]), np.concatenate([b.z for b in blocks]), np.concatenate(received)
    )


def _note(arguments: argparse.Namespace, result: Calibration) -> str:
    end = min(arguments.end, arguments.start + result.seconds["all"])
    return (
        f"geometry.axes, noise.*_std and bias.fixed by fdi calibrate from {arguments.bag.name},\n"
        f"{arguments.start:g} s to {end:.1f} s; reference {', '.join(result.names[i] for i in result.reference)}"
    )
