# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""``fdi fleet``: many recordings, two tables and one page."""

from __future__ import annotations

import argparse
import sys

from tqdm import tqdm

from fdi_ros.cli.compile import compile_for_workers
from fdi_ros.cli.outputs import Kind, Outputs, check_target, versions
from fdi_ros.config.config import Config
from fdi_ros.errors import BagError
from fdi_ros.fleet.find import find_recordings
from fdi_ros.fleet.judge import judge_all
from fdi_ros.fleet.page import Fleet
from fdi_ros.fleet.tables import Tables
from fdi_ros.jobs import cluster_of, worker_count
from fdi_ros.result_file import write_text
from fdi_ros.text import shown, storable

PAGE = "fleet.html"


def run(arguments: argparse.Namespace) -> int:
    """Judge them, write tables and page, print what needs a person."""
    workers = worker_count(arguments.workers)
    cluster = cluster_of(arguments.scheduler, arguments.tls_ca_file, arguments.tls_cert, arguments.tls_key)
    parameters = ""
    if arguments.config is not None:
        Config.from_file(arguments.config)
        parameters = arguments.config.read_text(encoding="utf-8")
    paths, unread = find_recordings(arguments.paths)
    outputs = Outputs(arguments, ("output", "json"), [*paths, arguments.config], output=None)
    folder = arguments.output.absolute()
    if folder.exists():
        check_target(folder / PAGE, Kind.PAGE, force=True)
    tables = Tables(folder, {"config": parameters, "calibrate": arguments.calibrate}, arguments.force)
    compile_for_workers(arguments)
    try:
        with tqdm(total=len(paths), unit="flight", disable=arguments.quiet or None, leave=False) as bar:
            calibrated = arguments.calibrate == "each"
            judge_all(paths, parameters, calibrated, tables, workers, cluster, bar.update)
    except KeyboardInterrupt:
        print("fdi: stopped; what was judged is kept, the same command goes on from there", file=sys.stderr)
        raise
    fleet = Fleet([tables.flights[storable(str(path))] for path in paths])
    about = {
        "recordings": f"{len(paths)}, from {', '.join(map(str, arguments.paths))}",
        "not searched": "; ".join(unread) or "-",
        "config": str(arguments.config or "what fdi inspect writes for each recording"),
        "calibrated": arguments.calibrate,
        "versions": versions(),
    }
    write_text(folder / PAGE, fleet.html(about))
    others = len(tables.flights) - len(paths)
    more = [f"The tables have {others} more, of other runs: not counted here."] if others else []
    more += [f"Not searched: {shown(line)}." for line in unread]
    outputs.finish(fleet.text() + "".join(f"{line}\n" for line in more), fleet.figures() | {"not_searched": unread})
    if not fleet.judged:
        raise BagError(f"none of the {len(paths)} recordings could be judged: {arguments.output / PAGE} says why")
    return 0
