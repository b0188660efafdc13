# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Monte-Carlo studies: the same trials for every method, the same figures for the same seed on any worker."""

from __future__ import annotations

import hashlib
import json
import math
import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, reduce
from pathlib import Path
from typing import IO, Any

import numpy as np
from tqdm import tqdm

from fdi_ros import __version__
from fdi_ros.errors import StudyError
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
from fdi_ros.jobs import Cluster, run_jobs, worker_count
from fdi_ros.replay.outcomes import added
from fdi_ros.result_file import plain, write_json

AnyProtocol = TrialProtocol[Any]

PROTOCOLS: dict[str, type[AnyProtocol]] = {
    protocol.kind: protocol for protocol in (ResidualSearch, Snapshot, Delay, Flight)
}
SCHEMAS = {name: protocol.schema for name, protocol in PROTOCOLS.items()}


def run_block(kind: str, settings: str, preparation: str, seed: int, block: Block) -> Counts:
    """Run one block of trials, wherever: the result depends on the arguments alone.

    Parameters
    ----------
    kind
        Key of `PROTOCOLS`.
    settings, preparation
        As JSON: detectors are built once per process for each.
    seed
        Of the study; the block's own generator is spawned from it.
    block
        Which one.
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


class Checkpoint:
    """Blocks done, kept in ``<result>.partial`` line by line; without a path, in memory alone.

    Parameters
    ----------
    path
        Of the result.
    identity
        All that the result depends on but the number of trials; blocks of another study are not taken over.
    """

    def __init__(self, path: Path | None, identity: str) -> None:
        self.blocks: dict[Block, Counts] = {}
        self._path = None if path is None else path.with_name(path.name + ".partial")
        self._file: IO[str] | None = None
        if self._path is None:
            return
        try:
            kept = _read(self._path, identity)
            # Written anew, whole lines only: a study that was killed may have left half a one.
            self._file = self._path.open("w", encoding="utf-8")
            self._write({"study": identity})
            for block, counts in kept:
                self.add(block, counts)
        except OSError as error:
            raise StudyError(f"cannot keep the blocks done in {self._path}: {error.strerror}") from error

    def add(self, block: Block, counts: Counts) -> None:
        """Keep one block."""
        self.blocks[block] = counts
        self._write({"block": list(block), "counts": counts})

    def close(self, finished: bool) -> None:
        """End; what is finished is no longer needed."""
        if self._file is not None and self._path is not None:
            self._file.close()
            if finished:
                self._path.unlink(missing_ok=True)

    def _write(self, entry: dict[str, object]) -> None:
        if self._file is not None:
            # A number that is not finite stays what it is: Python reads back what it writes.
            self._file.write(json.dumps(entry) + "\n")
            self._file.flush()


def _read(path: Path, identity: str) -> list[tuple[Block, Counts]]:
    """Blocks of the same study in a file; none if there is no such file, or it is of another study."""
    if not path.exists():
        return []
    # The last line, if it was not finished, has no end.
    whole = path.read_text(encoding="utf-8").rpartition("\n")[0]
    try:
        entries = [json.loads(line) for line in whole.splitlines()]
    except ValueError:
        return []
    if not entries or entries[0] != {"study": identity}:
        return []
    return [(Block(*entry["block"]), entry["counts"]) for entry in entries[1:]]


FORMAT = 1
"""Of the JSON."""
CHECKPOINT_FORMAT = 3
"""Of the blocks kept: those of another one are not taken over."""


@dataclass(frozen=True)
class SectionResult:
    """Figures of one section."""

    kind: str
    settings: Mapping[str, Any]
    found: Preparation
    """What the first stage gave."""
    not_run: Refusals
    cells: list[Figures]
    """Of each cell of the second stage."""


@dataclass(frozen=True)
class StudyResult:
    """All figures and settings of a study."""

    format: int
    fdi_ros: str
    """Version of the package."""
    study: str
    title: str
    seed: int
    sections: list[SectionResult]


def load_study(path: str | Path, trials: int | None = None, seed: int | None = None) -> Study:
    """Read a study file; trials per cell and seed win over it.

    Raises
    ------
    StudyError
        If it is missing or does not fit.
    """
    return read_study(path, SCHEMAS).changed(trials, seed)


def run_study(
    study: Study,
    workers: int | None = None,
    cluster: Cluster | None = None,
    json_path: str | Path | None = None,
    quiet: bool = False,
) -> StudyResult:
    """Run a study and return all figures and settings.

    Parameters
    ----------
    study
        What to run.
    workers
        Local processes; None: as many as there are cores. The figures do not depend on it.
    cluster
        Dask cluster that works instead.
    json_path
        Where the result is written; blocks done are kept beside it until then, and taken over by the next run.
    quiet
        Show no progress.

    Raises
    ------
    StudyError
        If the study cannot be run.
    """
    run = _Run(study, worker_count(workers), cluster, quiet)
    path = None if json_path is None else Path(json_path)
    checkpoint, finished = Checkpoint(path, _identity(study)), False
    try:
        result = run.result(checkpoint)
        if path is not None:
            write_json(path, plain(result))
        finished = True
    finally:
        checkpoint.close(finished)
    return result


class _Run:
    """One run of a study.

    Parameters
    ----------
    study, workers, cluster, quiet
        As of `run_study`.
    """

    def __init__(self, study: Study, workers: int, cluster: Cluster | None, quiet: bool) -> None:
        self.study, self.workers, self.cluster, self.quiet = study, workers, cluster, quiet
        self.protocols: list[AnyProtocol] = [PROTOCOLS[one.kind](one.settings) for one in study.sections]

    def result(self, checkpoint: Checkpoint) -> StudyResult:
        """Run both stages, but for the blocks that are done."""
        found = self._stage(Stage.PREPARING, [{} for _ in self.protocols], checkpoint)
        prepared = [protocol.conclude(own) for protocol, own in zip(self.protocols, found, strict=True)]
        counts = self._stage(Stage.TRIALS, prepared, checkpoint)
        sections = [_section(*one) for one in zip(self.protocols, prepared, counts, strict=True)]
        return StudyResult(FORMAT, __version__, self.study.name, self.study.title, self.study.seed, sections)

    def _stage(
        self, stage: Stage, preparations: Sequence[Preparation], checkpoint: Checkpoint
    ) -> list[list[list[Counts]]]:
        """Run the blocks of a stage, and return them for every cell of every section."""
        blocks = [block for s, protocol in enumerate(self.protocols) for block in _blocks(s, protocol, stage)]
        left = mixed([block for block in blocks if block not in checkpoint.blocks])
        texts = [
            (protocol.kind, json.dumps(protocol.settings), json.dumps(preparation))
            for protocol, preparation in zip(self.protocols, preparations, strict=True)
        ]
        jobs = [(*texts[block.section], self.study.seed, block) for block in left]
        with self._bar(stage, len(blocks), len(blocks) - len(left)) as bar:
            for k, counts in run_jobs(run_block, jobs, self.workers, self.cluster):
                checkpoint.add(left[k], counts)
                bar.update()
        found: list[list[list[Counts]]] = [[[] for _ in protocol.cells(stage)] for protocol in self.protocols]
        for block in blocks:
            found[block.section][block.cell].append(checkpoint.blocks[block])
        return found

    def _bar(self, stage: Stage, total: int, done: int) -> tqdm[Any]:
        # None: tqdm asks whether standard error is a terminal. Without smoothing: blocks take unequal times, and what
        # is left takes as long as all that is done, not as the last few.
        return tqdm(
            total=total,
            initial=done,
            desc=f"{self.study.name}: {stage.name.lower()}",
            smoothing=0,
            disable=True if self.quiet else None,
            bar_format="{desc} |{bar:30}| {n_fmt}/{total_fmt} blocks, {elapsed}, {remaining} left",
        )


def _section(protocol: AnyProtocol, prepared: Preparation, counts: Sequence[Sequence[Counts]]) -> SectionResult:
    cells = zip(protocol.trial_cells(), counts, strict=True)
    results = [protocol.summary(cell, reduce(added, blocks), prepared) for cell, blocks in cells]
    return SectionResult(protocol.kind, protocol.settings, prepared, protocol.refusals(), results)


def mixed(blocks: Sequence[Block]) -> list[Block]:
    """Shuffle blocks, so that the time per block so far holds for those left: cells differ in cost."""
    order = list(blocks)
    random.Random(0).shuffle(order)
    return order


def _blocks(section: int, protocol: AnyProtocol, stage: Stage) -> list[Block]:
    blocks = []
    for c, cell in enumerate(protocol.cells(stage)):
        trials, size = protocol.trials(cell)
        count = math.ceil(trials / size)
        blocks += [Block(section, int(stage), c, b, min(size, trials - b * size)) for b in range(count)]
    return blocks


def _identity(study: Study) -> str:
    """All that a block depends on; the number of trials is part of each block, not of this."""
    sections = []
    for section in study.sections:
        settings = {name: value for name, value in section.settings.items() if name != "trials"}
        sections.append([section.kind, settings])
    text = json.dumps([CHECKPOINT_FORMAT, __version__, study.seed, sections], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
