"""Monte-Carlo studies: the same trials for every method, the same figures for the same seed, whoever works."""

from __future__ import annotations

import hashlib
import json
import math
import os
import random
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fdi_ros.errors import StudyError
from fdi_ros.experiments.experiment import FIRST, SECOND, Block, Experiment, Found
from fdi_ros.experiments.progress import Bar, Done
from fdi_ros.experiments.registry import EXPERIMENTS, SCHEMAS, run_block
from fdi_ros.experiments.study_file import Study, read_study
from fdi_ros.experiments.tally import Tally, merged
from fdi_ros.experiments.workers import run_jobs
from fdi_ros.result_file import write_json

FORMAT = 1
"""Of the JSON and of what a block holds: blocks of another one are not taken over."""


def load_study(path: str | Path, trials: int | None = None, seed: int | None = None) -> Study:
    """Read a study file; trials a cell and seed win over it.

    Raises
    ------
    StudyError
        If it is missing or does not fit.
    """
    return read_study(path, SCHEMAS).changed(trials, seed)


def run_study(
    study: Study,
    workers: int | None = None,
    scheduler: str | None = None,
    json_path: str | Path | None = None,
    quiet: bool = False,
) -> dict[str, Any]:
    """Run a study and return all figures and settings, ready for JSON.

    Parameters
    ----------
    study
        What to run.
    workers
        Local processes; None: as many as there are cores. The figures do not depend on it.
    scheduler
        Address of a Dask scheduler that works instead.
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
    count = workers if workers is not None else (os.cpu_count() or 1)
    experiments = [EXPERIMENTS[section.kind](section.settings) for section in study.sections]
    path = None if json_path is None else Path(json_path)
    done, finished = Done(path, _identity(study)), False
    try:
        none: list[Found] = [{} for _ in experiments]
        first = _stage(study, experiments, FIRST, none, done, count, scheduler, quiet)
        found = [e.conclude(e.cells(FIRST), tallies) for e, tallies in zip(experiments, first, strict=True)]
        second = _stage(study, experiments, SECOND, found, done, count, scheduler, quiet)
        result = _result(study, experiments, found, second)
        if path is not None:
            write_json(path, result)
        finished = True
    finally:
        done.close(finished)
    return result


def _stage(
    study: Study,
    experiments: list[Experiment],
    stage: int,
    found: list[Found],
    done: Done,
    workers: int,
    scheduler: str | None,
    quiet: bool,
) -> list[list[Tally]]:
    """Tallies of every cell of every section, from the blocks done and those still to be run."""
    blocks = [block for s, experiment in enumerate(experiments) for block in _blocks(s, experiment, stage)]
    left = mixed([block for block in blocks if block not in done.blocks])
    texts = [(json.dumps(dict(e.settings)), json.dumps(f)) for e, f in zip(experiments, found, strict=True)]
    kinds = [experiment.kind for experiment in experiments]
    jobs = [(kinds[b.section], *texts[b.section], study.seed, b) for b in left]
    bar = Bar(len(blocks), len(blocks) - len(left), f"{study.name}: {('preparing', 'trials')[stage]}", quiet)
    try:
        for k, tally in run_jobs(run_block, jobs, workers, scheduler):
            done.add(left[k], tally)
            bar.step()
    finally:
        bar.close()
    return [
        [merged([done.blocks[b] for b in blocks if b[:3] == (s, stage, c)]) for c in range(len(e.cells(stage)))]
        for s, e in enumerate(experiments)
    ]


def mixed(blocks: Sequence[Block]) -> list[Block]:
    """Put blocks into an order in which those done tell the time of those left: cells differ in cost."""
    order = list(blocks)
    random.Random(0).shuffle(order)
    return order


def _blocks(section: int, experiment: Experiment, stage: int) -> list[Block]:
    blocks = []
    for c, cell in enumerate(experiment.cells(stage)):
        trials, size = experiment.trials(stage, cell)
        count = math.ceil(trials / size)
        blocks += [Block(section, stage, c, b, min(size, trials - b * size)) for b in range(count)]
    return blocks


def _identity(study: Study) -> str:
    """All that a block depends on; the number of trials is part of each block, not of this."""
    sections = []
    for section in study.sections:
        settings = {name: value for name, value in section.settings.items() if name != "trials"}
        sections.append([section.kind, settings])
    text = json.dumps([FORMAT, _version(), study.seed, sections], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _result(
    study: Study, experiments: list[Experiment], found: list[Found], tallies: list[list[Tally]]
) -> dict[str, Any]:
    sections = []
    for experiment, known, parts in zip(experiments, found, tallies, strict=True):
        cells = zip(experiment.cells(SECOND), parts, strict=True)
        sections.append(
            {
                "kind": experiment.kind,
                "settings": experiment.settings,
                "found": known,
                "not_run": experiment.refusals(),
                "cells": [experiment.summary(cell, tally, known) for cell, tally in cells],
            }
        )
    about = {"format": FORMAT, "fdi_ros": _version(), "study": study.name, "title": study.title, "seed": study.seed}
    return {**about, "sections": _plain(sections)}


def _version() -> str:
    from fdi_ros import __version__

    return __version__


def _plain(value: Any) -> Any:
    """Value with None for what is no number: JSON knows no NaN."""
    if isinstance(value, Mapping):
        return {str(name): _plain(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
