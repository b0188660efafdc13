# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Monte-Carlo studies: the same trials for every method, the same figures for the same seed on any worker."""

from __future__ import annotations

import hashlib
import json
import math
import os
import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any

from tqdm import tqdm

from fdi_ros.errors import StudyError
from fdi_ros.experiments.json_form import from_json, to_json
from fdi_ros.experiments.protocol import Block, PreparationTally, Refusals, Stage
from fdi_ros.experiments.registry import PROTOCOLS, SCHEMAS, AnyProtocol, run_block
from fdi_ros.experiments.study_file import Study, read_study
from fdi_ros.jobs import Cluster, run_jobs
from fdi_ros.result_file import write_json
from fdi_ros.scoring import Tally, merged


class Checkpoint:
    """Blocks done, kept in ``<result>.partial`` line by line; without a path, in memory alone.

    Parameters
    ----------
    path
        Of the result.
    identity
        All that the result depends on but the number of trials; blocks of another study are not taken over.
    decode
        Makes the tally of a block from its JSON.
    """

    def __init__(self, path: Path | None, identity: str, decode: Callable[[Block, Any], Tally]) -> None:
        self.blocks: dict[Block, Tally] = {}
        self._path = None if path is None else path.with_name(path.name + ".partial")
        self._file: IO[str] | None = None
        if self._path is None:
            return
        try:
            kept = _read(self._path, identity, decode)
            # Written anew, whole lines only: a study that was killed may have left half a one.
            self._file = self._path.open("w", encoding="utf-8")
            self._write({"study": identity})
            for block, tally in kept:
                self.add(block, tally)
        except OSError as error:
            raise StudyError(f"cannot keep the blocks done in {self._path}: {error.strerror}") from error

    def add(self, block: Block, tally: Tally) -> None:
        """Keep one block."""
        self.blocks[block] = tally
        self._write({"block": list(block), "tally": tally})

    def close(self, finished: bool) -> None:
        """End; what is finished is no longer needed."""
        if self._file is not None and self._path is not None:
            self._file.close()
            if finished:
                self._path.unlink(missing_ok=True)

    def _write(self, entry: dict[str, object]) -> None:
        if self._file is not None:
            # A number that is not finite stays what it is: Python reads back what it writes.
            self._file.write(json.dumps(entry, default=asdict) + "\n")
            self._file.flush()


def _read(path: Path, identity: str, decode: Callable[[Block, Any], Tally]) -> list[tuple[Block, Tally]]:
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
    blocks = [(Block(*entry["block"]), entry["tally"]) for entry in entries[1:]]
    return [(block, decode(block, tally)) for block, tally in blocks]


FORMAT = 1
"""Of the JSON."""
CHECKPOINT_FORMAT = 2
"""Of the blocks kept: those of another one are not taken over."""


@dataclass(frozen=True)
class SectionResult:
    """Figures of one section."""

    kind: str
    settings: Mapping[str, Any]
    found: Any
    """What the first stage gave: the preparation of the protocol."""
    not_run: Refusals
    cells: list[Any]
    """One result of the protocol per cell of the second stage."""


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
    if workers is not None and workers < 1:
        raise StudyError(f"workers is {workers}, expected 1 or more")
    run = _Run(study, workers or os.cpu_count() or 1, cluster, quiet)
    path = None if json_path is None else Path(json_path)
    checkpoint, finished = Checkpoint(path, _identity(study), run.decode), False
    try:
        result = run.result(checkpoint)
        if path is not None:
            write_json(path, to_json(result))
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

    def decode(self, block: Block, tally: Any) -> Tally:
        """Make the tally of a block from its JSON."""
        kind = PreparationTally if block.stage == Stage.PREPARING else self.protocols[block.section].tally_type
        decoded: Tally = from_json(kind, tally)
        return decoded

    def result(self, checkpoint: Checkpoint) -> StudyResult:
        """Run both stages, but for the blocks that are done."""
        first = self._stage(Stage.PREPARING, [None for _ in self.protocols], checkpoint)
        prepared = [p.conclude(p.preparation_cells(), own) for p, own in zip(self.protocols, first, strict=True)]
        second = self._stage(Stage.TRIALS, prepared, checkpoint)
        sections = [_section(*one) for one in zip(self.protocols, prepared, second, strict=True)]
        return StudyResult(FORMAT, _version(), self.study.name, self.study.title, self.study.seed, sections)

    def _stage(self, stage: Stage, preparations: Sequence[Any], checkpoint: Checkpoint) -> list[list[Any]]:
        """Tallies of every cell of every section."""
        blocks = [block for s, protocol in enumerate(self.protocols) for block in _blocks(s, protocol, stage)]
        left = mixed([block for block in blocks if block not in checkpoint.blocks])
        texts = [
            (p.kind, json.dumps(p.settings), json.dumps(preparation, default=asdict))
            for p, preparation in zip(self.protocols, preparations, strict=True)
        ]
        jobs = [(*texts[block.section], self.study.seed, block) for block in left]
        with self._bar(stage, len(blocks), len(blocks) - len(left)) as bar:
            for k, tally in run_jobs(run_block, jobs, self.workers, self.cluster):
                checkpoint.add(left[k], tally)
                bar.update()
        return [
            [
                merged([checkpoint.blocks[block] for block in blocks if block[:3] == (s, stage, c)])
                for c in range(len(protocol.cells(stage)))
            ]
            for s, protocol in enumerate(self.protocols)
        ]

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


def _section(protocol: AnyProtocol, prepared: Any, tallies: Sequence[Tally]) -> SectionResult:
    cells = zip(protocol.trial_cells(), tallies, strict=True)
    results = [protocol.summary(cell, tally, prepared) for cell, tally in cells]
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
    text = json.dumps([CHECKPOINT_FORMAT, _version(), study.seed, sections], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _version() -> str:
    from fdi_ros import __version__

    return __version__
