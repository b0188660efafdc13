# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""``fdi montecarlo``: arguments, a run, and the files it leaves."""

from __future__ import annotations

import sys
from argparse import ArgumentParser, Namespace

from fdi_ros.cli.arguments import Verb, add_report, add_results, add_workers, shipped
from fdi_ros.errors import StudyError
from fdi_ros.system.installation import WORKERS, resolve


def _add_arguments(parser: ArgumentParser) -> None:
    parser.add_argument("study", type=resolve, metavar="STUDY.yaml", help=f"what to run; shipped: {shipped('studies')}")
    parser.add_argument("--trials", type=int, metavar="N", help="trials per cell, instead of the file's")
    parser.add_argument("--seed", type=int, metavar="S", help="seed, instead of the file's")
    add_workers(parser)
    add_report(parser, "write curves and tables as one page")
    add_results(parser)


def _run(arguments: Namespace) -> int:
    """Run the study; print its headline table."""
    from fdi_ros.cli.ahead import compile_for_workers
    from fdi_ros.cli.outputs import Outputs, Progress
    from fdi_ros.experiments.montecarlo import load_study, run_study
    from fdi_ros.experiments.report import headline, report
    from fdi_ros.system.jobs import cluster_of
    from fdi_ros.system.result_file import plain, write_json, write_text

    if arguments.scheduler is not None and arguments.workers is not None:
        raise StudyError("--workers is for local processes, --scheduler for a cluster: give one")
    cluster = cluster_of(arguments.scheduler, arguments.tls_ca_file, arguments.tls_cert, arguments.tls_key)
    outputs = Outputs(arguments, ("report", "json"), [arguments.study])
    study = load_study(arguments.study, arguments.trials, arguments.seed)
    compile_for_workers(arguments)
    with Progress(sys.stderr, arguments.quiet, f"{study.name}: ") as progress:
        result = run_study(study, arguments.workers, cluster, progress.show)
    if arguments.json is not None:
        write_json(arguments.json, plain(result))
    if arguments.report is not None:
        write_text(arguments.report, report(result))
    return outputs.finish(f"{headline(result)}\n")


MONTECARLO = Verb(
    "compare detectors over many simulated trials",
    ("fdi montecarlo power.yaml --trials 200 --report power.html",),
    _add_arguments,
    _run,
    WORKERS,
)
