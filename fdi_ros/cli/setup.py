"""``fdi setup``: a recording in, a config that the node takes and a page of what was found out."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from fdi_ros.cli.calibrate import _require_scipy
from fdi_ros.cli.console import say, write_json, wrote
from fdi_ros.cli.outputs import Kind, check_targets, whole_file
from fdi_ros.cli.progress import Progress
from fdi_ros.config.config import Config
from fdi_ros.errors import ConfigError
from fdi_ros.limits import LINE
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.text import shown


def run(arguments: argparse.Namespace) -> int:
    """Find out what the recording shows, write config and page, say both."""
    _require_scipy()
    from fdi_ros.inspection.setup import find
    from fdi_ros.inspection.setup_page import setup_page
    from fdi_ros.inspection.setup_text import setup_figures, setup_text

    if not 0 <= arguments.start < arguments.end:
        raise ConfigError(f"--start {arguments.start:g} s and --end {arguments.end:g} s: expected 0 <= start < end")
    report: Path = arguments.report or arguments.output.with_suffix(".html")
    targets = [arguments.output, report, arguments.json]
    kinds = (Kind.PARAMETERS, Kind.PAGE, Kind.JSON)
    check_targets(list(zip(targets, kinds, strict=True)), arguments.force, [arguments.bag])
    with Progress(sys.stderr, arguments.quiet) as progress, progress.during("looking into the recording"):
        found = find(arguments.bag, arguments.start, arguments.end, arguments.reference)
    with whole_file(report) as page, whole_file(arguments.output) as path:
        origin = shown(f"made by fdi setup from {arguments.bag.name}; {report.name} says how.", LINE)
        path.write_text(f"# {origin}\n{found.text}", encoding="utf-8")
        # What the node would refuse is not written.
        Pipeline.from_config(Config.from_file(path))
        write_json(arguments.json, setup_figures(found, str(arguments.bag)))
        page.write_text(setup_page(found, str(arguments.bag), str(arguments.output)), encoding="utf-8")
    say(arguments, setup_text(found, str(arguments.bag), str(arguments.output)))
    wrote(arguments, targets)
    return 0
