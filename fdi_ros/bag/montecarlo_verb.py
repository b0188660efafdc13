"""``fdi montecarlo``: arguments, a run, and the files it leaves."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from fdi_ros.bag.outputs import check_targets
from fdi_ros.errors import StudyError
from fdi_ros.study.montecarlo import load_study, run_study
from fdi_ros.study.montecarlo_table import headline


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the verb."""
    parser.add_argument("study", type=Path, metavar="STUDY.yaml", help="what to run; see config/studies")
    parser.add_argument("--trials", type=int, metavar="N", help="trials a cell, instead of the file's")
    parser.add_argument("--seed", type=int, metavar="S", help="seed, instead of the file's")
    parser.add_argument("--workers", type=int, metavar="N", help="processes; default: as many as there are cores")
    parser.add_argument("--scheduler", metavar="ADDRESS", help="Dask scheduler to work instead, tcp://host:port")
    parser.add_argument("--report", type=Path, metavar="FILE.html", help="write curves and tables as one page")
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="write all figures; a stopped study goes on from what is beside it"
    )
    parser.add_argument("--force", action="store_true", help="overwrite files that exist")


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
