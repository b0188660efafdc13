# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Verbs without a recording: ``fdi geometry``, ``montecarlo``, ``shipped``, ``compile``."""

from __future__ import annotations

import gc
import json
import logging
import multiprocessing
import os
import re
import sys
import time
from argparse import Namespace
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from functools import partial
from itertools import compress
from typing import Any

import numpy as np

from fdi_ros.cli.outputs import Outputs, config_words, progress
from fdi_ros.compiling.cache import folder
from fdi_ros.compiling.compiled import (
    INTERPRETED,
    LOG,
    allocate,
    compilations,
    missing,
)
from fdi_ros.compiling.notice import call_for_each, progress_logged
from fdi_ros.config.config import Config
from fdi_ros.detectors import DETECTORS, detector_class
from fdi_ros.detectors.papers.guaranteed import Guaranteed
from fdi_ros.errors import ConfigError, FdiError, StudyError
from fdi_ros.estimator.error_states import SIGNALS, Layout, fill_signals
from fdi_ros.estimator.estimator import REST_BLOCKS
from fdi_ros.estimator.rest import rests
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel
from fdi_ros.monitor.building import GUARD
from fdi_ros.monitor.receiver import warm_detector, warm_path
from fdi_ros.report.layout import unit_of
from fdi_ros.setup.mounting import (
    assess,
    mounting_figures,
    mounting_page,
    mounting_text,
)
from fdi_ros.system import BAGS, shipped_files, there
from fdi_ros.system.files import plain
from fdi_ros.system.text import did_you_mean

MADE = "diagnostics.yaml"
"""Shipped file of which `made_for` makes copies for certain nodes."""
_NODE_NAME = re.compile(r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)
"""Full name of a node."""
_ANY_NODE = re.compile(r'\["\(\.\*/\)\?fdi_node: (.*)"\]')
"""Regular expression in that file which matches the statuses of any monitor."""


def run_geometry(arguments: Namespace) -> int:
    """Assess the mounting, print the tables, write the page."""
    outputs = Outputs(arguments, ("report", "json"), arguments.config)
    result = assess(Config.from_file(arguments.config))
    unit = unit_of(arguments.degrees)
    page = partial(mounting_page, result, config_words(arguments), unit)
    return outputs.finish(mounting_text(result, unit), mounting_figures(result), page)


def run_montecarlo(arguments: Namespace) -> int:
    """Run a study and print its headline table."""
    from fdi_ros.experiments.montecarlo import load_study, run_study
    from fdi_ros.experiments.report import headline, report

    if arguments.scheduler is not None and arguments.workers is not None:
        raise StudyError(
            "--workers is for local processes, --scheduler for a cluster: give one"
        )
    outputs = Outputs(arguments, ("report", "json"), [arguments.study])
    study = load_study(arguments.study, arguments.trials, arguments.seed)
    compile_for_workers(arguments)
    with progress(sys.stderr, arguments.quiet, study.name) as show:
        result = run_study(study, arguments.workers, arguments.scheduler, show)
    return outputs.finish(
        f"{headline(result)}\n", plain(result), lambda: report(result)
    )


def run_shipped(arguments: Namespace) -> int:
    """Print the paths of the shipped files, or the text of one that is made for certain nodes.

    `ConfigError` if no shipped file has the given name, or the file cannot be made for nodes.
    """
    if arguments.node and arguments.name != MADE:
        raise ConfigError(
            f"--node makes {MADE} for the node, not {arguments.name or 'a list of files'}"
        )
    files = shipped_files()
    if not files:
        raise ConfigError("fdi_ros was installed without its config folder")
    if arguments.name:
        names = [path.name for path in files]
        files = [path for path in files if path.name == arguments.name]
        if not files:
            hint = did_you_mean(arguments.name, names)
            raise ConfigError(f"no shipped file {arguments.name!r}, {hint}")
    outputs = Outputs(arguments, ("json",), files)
    if not arguments.node:
        return outputs.finish(
            "".join(f"{path}\n" for path in files), {"files": list(map(str, files))}
        )
    text = made_for(arguments.node, files[0].read_text())
    return outputs.finish(text, {"text": text})


def made_for(nodes: Sequence[str], text: str) -> str:
    """Return the parameters of diagnostic_aggregator for certain monitors.

    Parameters
    ----------
    nodes
        Full names of the monitors. `ConfigError` if one is invalid or given twice.
    text
        The shipped file, which covers all monitors with the default name.
    """
    for name in nodes:
        if not _NODE_NAME.fullmatch(name):
            raise ConfigError(
                f"--node {name!r} is no full name of a node, such as /drone/fdi_node"
            )
    names = [name.lstrip("/") for name in nodes]
    if len(set(names)) < len(names):
        raise ConfigError(f"--node names a node twice: {', '.join(nodes)}")
    text = _ANY_NODE.sub(
        lambda what: json.dumps([f"{name}: {what[1]}" for name in names]), text
    )
    text = text.replace(
        "all monitors called fdi_node, in any namespaces", " and ".join(nodes), 1
    )
    text = text.replace(
        f"shipped {MADE}",
        " ".join([f"shipped {MADE}", *(f"--node {name}" for name in nodes)]),
        1,
    )
    # The first timeout belongs to the monitors: each has one status, and now their number is known.
    timeout = "          timeout: 3.0\n"
    return text.replace(timeout, f"{timeout}          num_items: {len(names)}\n", 1)


# Compiling ahead


def run_compile(arguments: Namespace) -> int:
    """Compile and print the time and the folder of the results."""
    if INTERPRETED:
        raise FdiError("NUMBA_DISABLE_JIT is set: there is nothing to compile")
    names = arguments.detector or list(DETECTORS)
    for name in names:
        detector_class(name)
    outputs = Outputs(arguments, ("json",))
    begun = time.perf_counter()
    new = compile_now(names)
    took = time.perf_counter() - begun
    what = (
        f"compiled in {took:.1f} s, results in"
        if new
        else "nothing to compile: all results are in"
    )
    figures = {
        "detectors": names,
        "compiled": new,
        "seconds": took,
        "folder": str(folder()),
    }
    return outputs.finish(f"{what} {folder()}\n", figures)


def compile_for_workers(arguments: Namespace) -> None:
    """Compile before local worker processes start, so that each finds the results."""
    if arguments.scheduler is None and missing():
        compile_now()


def compile_now(names: Sequence[str] = tuple(DETECTORS)) -> int:
    """Compile the code of the verbs, the node and some detectors, on up to two cores.

    Return the number of functions that were compiled.
    """
    # The longest part comes first. Blocks and messages share code, so they are one part. Every monitor has the
    # guard: another process would compile it once more at the same time.
    others = [name for name in reversed(names) if name != GUARD]
    parts: list[tuple[Any, ...]] = [
        (warm_path,),
        *((warm_detector, name) for name in others),
        (warm_verbs,),
    ]
    # Forking a process with threads can hang.
    spawned = multiprocessing.get_context("spawn")
    functions = sorted(missing())
    compiled = spawned.Array("b", max(1, len(functions)), lock=False)

    def done() -> set[str]:
        return set(compress(functions, compiled))

    logged = progress_logged(set(functions), done) if functions else nullcontext()
    # Where nothing is missing, all is only loaded: a second process would take longer to start.
    workers = min(2, os.cpu_count() or 1) if functions else 1
    with (
        ProcessPoolExecutor(
            workers, spawned, _count_into, (functions, compiled)
        ) as pool,
        logged,
    ):
        return sum(pool.map(_quietly, parts))


def _count_into(functions: Sequence[str], compiled: Any) -> None:
    """Set a flag for each function that this worker process compiles."""
    places = {name: k for k, name in enumerate(functions)}

    def count(name: str) -> None:
        if name in places:
            compiled[places[name]] = 1

    call_for_each(count)
    # Types and code that the compiler makes are kept: to look through them for circles again
    # and again takes 4 of 61 s of CPU.
    gc.freeze()
    gc.set_threshold(100_000, 50, 100)


def _quietly(part: tuple[Any, ...]) -> int:
    """Compile one part with a quiet log and return the number of functions that were compiled."""
    LOG.setLevel(logging.ERROR)
    before = compilations()
    part[0](*part[1:])
    return compilations() - before


def warm_verbs() -> None:
    """Compile the code of the verbs that belongs to no detector."""
    if all(map(there, BAGS)):
        from fdi_ros.bag.dataflash import find_records
        from fdi_ros.bag.mcap_file import walk

        walk(b"")
        sizes = np.zeros(256, dtype=np.int64)
        found = np.empty((2, 1), dtype=np.int64)
        find_records(np.frombuffer(b"\0", dtype=np.uint8), sizes, True, found)
    rests(np.zeros((REST_BLOCKS, 3)), 0, np.ones(3), np.ones(3), 0.0)
    signals = np.zeros((3, SIGNALS))
    fill_signals(allocate(Layout)[0], np.zeros(3), np.zeros(3), signals)
    Guaranteed(Geometry.cone(4), NoiseModel(0.01, bound=0.04)).error_bounds(
        np.zeros((1, 4))
    )
