# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""``fdi geometry``: what a mounting can do, before it flies."""

from __future__ import annotations

import argparse
import math

from fdi_ros.cli.console import say, wrote
from fdi_ros.cli.outputs import Kind, check_targets
from fdi_ros.config.config import Config
from fdi_ros.errors import ConfigError
from fdi_ros.mounting import assess, mounting_figures, mounting_page, mounting_text
from fdi_ros.report.text_table import unit_of
from fdi_ros.result_file import write_json, write_text


def run(arguments: argparse.Namespace) -> int:
    """Assess the mounting, print the tables, write the page."""
    if not 0 <= arguments.freedom <= 180:
        raise ConfigError(f"--freedom is {arguments.freedom:g} deg, expected 0 to 180")
    outputs = [(arguments.report, Kind.PAGE), (arguments.json, Kind.JSON)]
    check_targets(outputs, arguments.force, [arguments.config])
    result = assess(Config.from_file(arguments.config), math.radians(arguments.freedom))
    if arguments.report is not None:
        write_text(arguments.report, mounting_page(result, arguments.config.name))
    write_json(arguments.json, mounting_figures(result))
    say(arguments, mounting_text(result, unit_of(arguments.degrees)))
    wrote(arguments, outputs)
    return 0
