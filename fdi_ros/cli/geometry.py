"""``fdi geometry``: what a mounting can do, before it flies."""

from __future__ import annotations

import argparse
import math

from fdi_ros.cli.console import say, write_json, wrote
from fdi_ros.cli.outputs import Kind, check_targets, whole_file
from fdi_ros.config.config import Config
from fdi_ros.errors import ConfigError
from fdi_ros.mounting.analysis import assess
from fdi_ros.mounting.report import mounting_page
from fdi_ros.mounting.text import mounting_figures, mounting_text
from fdi_ros.report.unit import unit_of


def run(arguments: argparse.Namespace) -> int:
    """Assess the mounting, print the tables, write the page."""
    if not 0 <= arguments.freedom <= 180:
        raise ConfigError(f"--freedom is {arguments.freedom:g} deg, expected 0 to 180")
    targets = [arguments.report, arguments.json]
    kinds = (Kind.PAGE, Kind.JSON)
    check_targets(list(zip(targets, kinds, strict=True)), arguments.force, [arguments.config])
    result = assess(Config.from_file(arguments.config), math.radians(arguments.freedom))
    if arguments.report is not None:
        with whole_file(arguments.report) as path:
            path.write_text(mounting_page(result, arguments.config.name), encoding="utf-8")
    write_json(arguments.json, mounting_figures(result))
    say(arguments, mounting_text(result, unit_of(arguments.degrees)))
    wrote(arguments, targets)
    return 0
