"""``fdi montecarlo``: arguments, a run, and the files it leaves."""

from __future__ import annotations

import argparse
import sys

from fdi_ros.bag.outputs import check_targets
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
        result = run_study(study, arguments.workers, arguments.scheduler, arguments.json)
    except KeyboardInterrupt:
        if arguments.json is not None:
            print(f"fdi: stopped; the same command goes on from {arguments.json}.partial", file=sys.stderr)
        raise
    print(headline(result))
    if arguments.report is not None:
        write_report(result, arguments.report)
    return 0
