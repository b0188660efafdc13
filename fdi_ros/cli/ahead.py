# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""All that is compiled when it is first used, compiled ahead of that."""

from __future__ import annotations

import logging
import multiprocessing
import os
from argparse import Namespace
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, wait
from typing import Any

import numpy as np

from fdi_ros.cli.outputs import bar_of
from fdi_ros.compiling.compiled import LOG, allocate, compilations, missing
from fdi_ros.compiling.notice import TICK, View
from fdi_ros.detectors import DETECTORS
from fdi_ros.detectors.papers.guaranteed import Guaranteed
from fdi_ros.estimator.blocks import rests
from fdi_ros.estimator.error_states import SIGNALS, Layout, fill_signals
from fdi_ros.estimator.estimator import REST_BLOCKS
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel
from fdi_ros.monitor.receiver import warm_detector, warm_path
from fdi_ros.system.installation import BAGS, there


def compile_for_workers(arguments: Namespace) -> None:
    """Compile once, and say so, what each worker process of a verb on this machine would else compile for itself."""
    if arguments.scheduler is None and missing():
        compile_now(view=bar_of(arguments))


def compile_now(names: Sequence[str] = tuple(DETECTORS), view: View | None = None) -> int:
    """Compile what the offline verbs, the node and these detectors need, on two cores where there are two.

    Return how many functions had to be compiled.
    """
    # What takes longest first; single messages go through what blocks do, which is not compiled twice at once.
    parts: list[tuple[Any, ...]] = [(warm_path,), *((warm_detector, name) for name in reversed(names)), (warm_verbs,)]
    # Spawned: forking a process that has threads can hang.
    with ProcessPoolExecutor(min(2, os.cpu_count() or 1), mp_context=multiprocessing.get_context("spawn")) as pool:
        running = [pool.submit(_quietly, part) for part in parts]
        first = missing()
        if first:
            view = view or View()
            view.begin()
            while wait(running, TICK).not_done:
                view.draw(1 - missing() / first)
            view.wipe()
        return sum(part.result() for part in running)


def _quietly(part: tuple[Any, ...]) -> int:
    """Compile one part without a line in the log for each monitor built; return how many functions it had to."""
    level, before = LOG.level, compilations()
    LOG.setLevel(logging.ERROR)
    try:
        part[0](*part[1:])
    finally:
        LOG.setLevel(level)
    return compilations() - before


def warm_verbs() -> None:
    """Compile what the offline verbs need besides, whatever the detector."""
    if all(map(there, BAGS)):
        from fdi_ros.bag.dataflash import find_records
        from fdi_ros.bag.mcap_file import walk

        walk(b"")
        sizes, found = np.zeros(256, dtype=np.int64), np.empty((2, 1), dtype=np.int64)
        find_records(np.frombuffer(b"\0", dtype=np.uint8), sizes, True, found)
    rests(np.zeros((REST_BLOCKS, 3)), 0, np.ones(3), np.ones(3), 0.0)
    fill_signals(allocate(Layout)[0], np.zeros(3), np.zeros(3), np.zeros((3, SIGNALS)))
    Guaranteed(Geometry.cone(4), NoiseModel(0.01, bound=0.04)).error_bounds(np.zeros((1, 4)))
