# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""``fdi setup``: a recording in, a config that the node takes and a page of what was found out."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from fdi_ros.cli.arguments import check_part
from fdi_ros.cli.console import Progress, say, wrote
from fdi_ros.cli.outputs import Kind, check_targets
from fdi_ros.config.config import Config
from fdi_ros.limits import LINE
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.result_file import whole_file, write_json
from fdi_ros.text import shown


def run(arguments: argparse.Namespace) -> int:
    """Find out what the recording shows, write config and page, say both."""
    from fdi_ros.inspection.setup import set_up
    from fdi_ros.inspection.setup_report import setup_figures, setup_page, setup_text

    check_part(arguments)
    report: Path = arguments.report or arguments.output.with_suffix(".html")
    outputs = [(arguments.output, Kind.PARAMETERS), (report, Kind.PAGE), (arguments.json, Kind.JSON)]
    check_targets(outputs, arguments.force, [arguments.bag])
    with Progress(sys.stderr, arguments.quiet) as progress, progress.during("looking into the recording"):
        found = set_up(arguments.bag, arguments.start, arguments.end, arguments.reference, arguments.proof)
    with whole_file(report) as page, whole_file(arguments.output) as path:
        origin = shown(f"made by fdi setup from {arguments.bag.name}; {report.name} says how.", LINE)
        path.write_text(f"# {origin}\n{found.text}", encoding="utf-8")
        # What the node would refuse is not written.
        Pipeline.from_config(Config.from_file(path))
        write_json(arguments.json, setup_figures(found, str(arguments.bag)))
        page.write_text(setup_page(found, str(arguments.bag), str(arguments.output)), encoding="utf-8")
    say(arguments, setup_text(found, str(arguments.bag), str(arguments.output)))
    wrote(arguments, outputs)
    return 0
