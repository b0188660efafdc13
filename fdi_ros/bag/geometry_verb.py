"""``fdi geometry``: what a mounting can do, before it flies."""

from __future__ import annotations

import argparse
import math

from fdi_ros.bag.outputs import check_target, say_written, whole_file, words
from fdi_ros.config import Config
from fdi_ros.errors import ConfigError
from fdi_ros.study.mounting import assess
from fdi_ros.study.mounting_report import mounting_page
from fdi_ros.study.mounting_text import mounting_text


def run(arguments: argparse.Namespace) -> int:
    """Assess the mounting, print the tables, write the page."""
    if not 0 <= arguments.freedom <= 180:
        raise ConfigError(f"--freedom is {arguments.freedom:g} deg, expected 0 to 180")
    result = assess(Config.from_file(arguments.config), math.radians(arguments.freedom))
    if arguments.report is not None:
        check_target(arguments.report, arguments.force, [arguments.config])
        with whole_file(arguments.report) as path:
            path.write_text(mounting_page(result, arguments.config.name), encoding="utf-8")
    words([arguments.report]).write(mounting_text(result))
    say_written([arguments.report])
    return 0
