# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Monte-Carlo studies: the same trials for every method, the same figures for the same seed on any worker."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, reduce
from pathlib import Path
from typing import Any

import numpy as np

from fdi_ros import __version__
from fdi_ros.experiments.protocols.delay import Delay
from fdi_ros.experiments.protocols.flight import Flight
from fdi_ros.experiments.protocols.residual_search import ResidualSearch
from fdi_ros.experiments.protocols.snapshot import Snapshot
from fdi_ros.experiments.study import (
    Block,
    Counts,
    Figures,
    Preparation,
    Refusals,
    Stage,
    Study,
    TrialProtocol,
    read_study,
)
from fdi_ros.replay.outcomes import added
from fdi_ros.system.jobs import run_jobs, worker_count

AnyProtocol = TrialProtocol[Any]

PROTOCOLS: dict[str, type[AnyProtocol]] = {
    protocol.kind: protocol for protocol in (ResidualSearch, Snapshot, Delay, Flight)
}
SCHEMAS = {name: protocol.schema for name, protocol in PROTOCOLS.items()}


def run_block(kind: str, settings: str, preparation: str, seed: int, block: Block) -> Counts:
    """Run one block of trials, wherever: the result depends on the arguments alone.

    Settings and preparation come as JSON: detectors are built once per process for each. The block's own generator is
    spawned from the seed of the study.
    """
    protocol, prepared = _built(kind, settings, preparation)
    rng = np.random.default_rng(
        np.random.SeedSequence(seed, spawn_key=(block.section, block.stage, block.cell, block.block))
    )
    cell = protocol.cells(block.stage)[block.cell]
    if block.stage == Stage.PREPARING:
        return protocol.prepare(cell, block.trials, rng)
    return protocol.run(cell, block.trials, rng, prepared)


@lru_cache(maxsize=16)
def _built(kind: str, settings: str, preparation: str) -> tuple[AnyProtocol, Preparation]:
    """Build a protocol; its preparation is empty in the first stage."""
    return PROTOCOLS[kind](json.loads(settings)), json.loads(preparation)


FORMAT = 1  # of the JSON


@dataclass(frozen=True)
class SectionResult:
    """Figures of one section."""

    kind: str
    settings: Mapping[str, Any]
    found: Preparation  # what the first stage gave
    not_run: Refusals
    cells: list[Figures]  # of each cell of the second stage


@dataclass(frozen=True)
class StudyResult:
    """All figures and settings of a study."""

    format: int
    fdi_ros: str  # version of the package
    study: str
    title: str
    seed: int
    sections: list[SectionResult]


def load_study(path: str | Path, trials: int | None = None, seed: int | None = None) -> Study:
    """Read a study file; trials per cell and seed win over it. `StudyError` if it is missing or does not fit."""
    return read_study(path, SCHEMAS).changed(trials, seed)


def run_study(
    study: Study,
    workers: int | None = None,
    cluster: str | None = None,
    progress: Callable[[float], None] | None = None,
) -> StudyResult:
    """Run a study and return all figures and settings.

    ``workers``: local processes; None: as many as there are cores. The figures do not depend on it. ``cluster``:
    address of the scheduler of a Dask cluster that works instead. ``progress`` is called with the share done.
    `StudyError` if the study cannot be run.
    """
    protocols = [PROTOCOLS[one.kind](one.settings) for one in study.sections]

    def run(stage: Stage, preparations: Sequence[Preparation]) -> list[list[list[Counts]]]:
        """Run all blocks of a stage, and return them for every cell of every section."""
        blocks = [block for s, protocol in enumerate(protocols) for block in _blocks(s, protocol, stage)]
        texts = [
            (protocol.kind, json.dumps(protocol.settings), json.dumps(preparation))
            for protocol, preparation in zip(protocols, preparations, strict=True)
        ]
        jobs = [(*texts[block.section], study.seed, block) for block in blocks]
        counts: dict[int, Counts] = {}
        for job, done in run_jobs(run_block, jobs, worker_count(workers), cluster):
            counts[job] = done
            if progress is not None:
                # Thresholds are found first.
                progress((stage is not Stage.PREPARING) / 2 + len(counts) / len(jobs) / 2)
        found: list[list[list[Counts]]] = [[[] for _ in protocol.cells(stage)] for protocol in protocols]
        for k, block in enumerate(blocks):
            found[block.section][block.cell].append(counts[k])
        return found

    found = run(Stage.PREPARING, [{} for _ in protocols])
    prepared = [protocol.conclude(own) for protocol, own in zip(protocols, found, strict=True)]
    counts = run(Stage.TRIALS, prepared)
    sections = [_section(*one) for one in zip(protocols, prepared, counts, strict=True)]
    return StudyResult(FORMAT, __version__, study.name, study.title, study.seed, sections)


def _section(protocol: AnyProtocol, prepared: Preparation, counts: Sequence[Sequence[Counts]]) -> SectionResult:
    cells = zip(protocol.trial_cells(), counts, strict=True)
    results = [protocol.summary(cell, reduce(added, blocks), prepared) for cell, blocks in cells]
    return SectionResult(protocol.kind, protocol.settings, prepared, protocol.refusals(), results)


def _blocks(section: int, protocol: AnyProtocol, stage: Stage) -> list[Block]:
    blocks = []
    for c, cell in enumerate(protocol.cells(stage)):
        trials, size = protocol.trials(cell)
        count = math.ceil(trials / size)
        blocks += [Block(section, int(stage), c, b, min(size, trials - b * size)) for b in range(count)]
    return blocks
