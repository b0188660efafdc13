# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""``fdi montecarlo``: arguments, a run, and the files it leaves."""

from __future__ import annotations

import argparse

from fdi_ros.cli.compile import compile_for_workers
from fdi_ros.cli.outputs import Outputs
from fdi_ros.errors import StudyError
from fdi_ros.experiments.montecarlo import load_study, run_study
from fdi_ros.experiments.report import headline, report
from fdi_ros.jobs import cluster_of
from fdi_ros.result_file import plain, write_json, write_text


def run(arguments: argparse.Namespace) -> int:
    """Run the study; print its headline table."""
    if arguments.scheduler is not None and arguments.workers is not None:
        raise StudyError("--workers is for local processes, --scheduler for a cluster: give one")
    cluster = cluster_of(arguments.scheduler, arguments.tls_ca_file, arguments.tls_cert, arguments.tls_key)
    outputs = Outputs(arguments, ("report", "json"), [arguments.study])
    study = load_study(arguments.study, arguments.trials, arguments.seed)
    compile_for_workers(arguments)
    result = run_study(study, arguments.workers, cluster, arguments.quiet)
    if arguments.json is not None:
        write_json(arguments.json, plain(result))
    if arguments.report is not None:
        write_text(arguments.report, report(result))
    return outputs.finish(f"{headline(result)}\n")
