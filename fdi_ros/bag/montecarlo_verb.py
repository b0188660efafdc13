"""``fdi montecarlo``: arguments, a run, and the files it leaves."""

from __future__ import annotations

import argparse
import json
import sys

from fdi_ros.bag.outputs import check_targets, is_stream, say_written, whole_file, words
from fdi_ros.errors import StudyError
from fdi_ros.study.montecarlo import load_study, run_study
from fdi_ros.study.montecarlo_table import headline


def run(arguments: argparse.Namespace) -> int:
    """Run the study; print its headline table."""
    if arguments.scheduler is not None and arguments.workers is not None:
        raise StudyError("--workers is for local processes, --scheduler for a cluster: give one")
    check_targets([arguments.report, arguments.json], arguments.force, [arguments.study])
    study = load_study(arguments.study, arguments.trials, arguments.seed)
    if arguments.report is not None:
        # Told now, not after an hour.
        from fdi_ros.study.montecarlo_report import write_report
    try:
        # Blocks done are kept beside a file; beside a device or a pipe nothing is.
        kept = None if arguments.json is None or is_stream(arguments.json) else arguments.json
        result = run_study(study, arguments.workers, arguments.scheduler, kept)
    except KeyboardInterrupt:
        if kept is not None:
            print(f"fdi: stopped; the same command goes on from {arguments.json}.partial", file=sys.stderr)
        raise
    if arguments.json is not None and kept is None:
        with whole_file(arguments.json) as path:
            path.write_text(json.dumps(result, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    if arguments.report is not None:
        with whole_file(arguments.report) as path:
            write_report(result, path)
    targets = [arguments.report, arguments.json]
    print(headline(result), file=words(targets))
    say_written(targets)
    return 0
