"""``fdi geometry``: what a mounting can do, before it flies."""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

from fdi_ros.bag.outputs import check_target, whole_file
from fdi_ros.config import Config
from fdi_ros.errors import ConfigError
from fdi_ros.study.mounting import assess
from fdi_ros.study.mounting_report import mounting_page
from fdi_ros.study.mounting_text import mounting_text


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Say what the verb takes."""
    parser.add_argument("config", type=Path, metavar="CONFIG", help="ROS 2 parameter file")
    parser.add_argument(
        "--freedom",
        type=float,
        default=10.0,
        metavar="DEG",
        help="angle by which the second of two triads may be turned, deg; default 10",
    )
    parser.add_argument("--report", type=Path, metavar="FILE.html", help="write a page with tables and a picture")
    parser.add_argument("--force", action="store_true", help="overwrite files that exist")


def run(arguments: argparse.Namespace) -> int:
    """Assess the mounting, print the tables, write the page."""
    if not 0 <= arguments.freedom <= 180:
        raise ConfigError(f"--freedom is {arguments.freedom:g} deg, expected 0 to 180")
    result = assess(Config.from_file(arguments.config), math.radians(arguments.freedom))
    if arguments.report is not None:
        check_target(arguments.report, arguments.force, [arguments.config])
        with whole_file(arguments.report) as path:
            path.write_text(mounting_page(result, arguments.config.name), encoding="utf-8")
    sys.stdout.write(mounting_text(result))
    return 0
