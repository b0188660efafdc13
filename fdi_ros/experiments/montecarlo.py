# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Monte-Carlo studies: the same trials for every method, reproducible on any worker.

A study file holds ``title``, ``seed`` and one or more sections. The name of a section
says what kind of trial it runs (`fdi_ros.experiments.PROTOCOLS`), its keys are that
kind's settings. A protocol has cells of equal settings, which are cut into blocks that
any worker can run. What blocks give, what the first stage finds and the figures of a
cell are mappings by name, as the JSON has them: they go between processes and into the
result as they are.
"""

from __future__ import annotations

import difflib
import json
import math
import pkgutil
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, reduce
from pathlib import Path
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import numpy as np

from fdi_ros import __version__
from fdi_ros.config.settings import Field as Field
from fdi_ros.config.settings import check
from fdi_ros.detectors import DETECTORS
from fdi_ros.errors import FdiError, StudyError
from fdi_ros.experiments import PROTOCOLS
from fdi_ros.model.geometry import Geometry
from fdi_ros.replay.outcomes import added
from fdi_ros.system.jobs import run_jobs, worker_count
from fdi_ros.system.yaml_file import read_yaml

# What a trial protocol is -------------------------------------------------------------

Schema = Mapping[str, Field]
"""Settings of a section by name, also of detectors, geometries and mappings."""
Cell = TypeVar("Cell")  # what distinguishes one cell of a section from the others
Counts = dict[
    str, Any
]  # results of trials: numbers, None, and lists or mappings of numbers
Preparation = dict[
    str, Any
]  # results of the first stage, under ``found`` in the result
Figures = dict[
    str, Any
]  # figures of one cell of the second stage, in the order of the result. Shares are an `Estimate`
Refusals = Mapping[
    str, Mapping[str, str]
]  # by geometry and method: why the method does not run


class TrialProtocol(ABC, Generic[Cell]):
    """One section of a study, with settings checked against `schema`.

    The first stage finds thresholds on healthy channels and whatever else trials need.
    The second runs the trials. A block's result depends on its settings, its seed and
    the first stage alone.
    """

    schema: ClassVar[Schema]

    def __init__(self, settings: Mapping[str, Any]) -> None:
        self.settings = dict(settings)

    def preparation_cells(self) -> list[Cell]:
        """Cells of the first stage, which most protocols lack."""
        return []

    @abstractmethod
    def trial_cells(self) -> list[Cell]:
        """Cells of the second stage."""

    def trials(self, cell: Cell) -> tuple[int, int]:
        """Return the trials of a cell and of a block, whatever the number of workers."""
        return self.settings["trials"], self.settings["block"]

    def prepare(self, cell: Cell, count: int, rng: np.random.Generator) -> Counts:
        """Run one block of the first stage, if the protocol has one."""
        return {}

    def conclude(self, found: Sequence[Sequence[Counts]]) -> Preparation:
        """Work out from the blocks of each cell of the first stage what the second needs."""
        return {}

    @abstractmethod
    def run(
        self, cell: Cell, count: int, rng: np.random.Generator, preparation: Preparation
    ) -> Counts:
        """Run one block of the second stage."""

    @abstractmethod
    def summary(self, cell: Cell, counts: Counts, preparation: Preparation) -> Figures:
        """Figures of one cell of the second stage, from the sum of its blocks."""

    @abstractmethod
    def refusals(self) -> Refusals:
        """Return which methods do not run on a geometry, and why."""


AnyProtocol = TrialProtocol[Any]


def protocol_class(kind: str) -> type[AnyProtocol]:
    """Class of a key of `PROTOCOLS`."""
    found: type[AnyProtocol] = pkgutil.resolve_name(
        f"fdi_ros.experiments.{PROTOCOLS[kind]}"
    )
    return found


# Study files --------------------------------------------------------------------------

NAMED_GEOMETRIES: dict[str, Callable[[], Geometry]] = {
    "two_triad_cone": Geometry.two_triad_cone,
    "dodecahedron": Geometry.dodecahedron,
    "parallel_triads": lambda: Geometry.from_triads([np.eye(3), np.eye(3)]),
}


@dataclass(frozen=True)
class Section:
    """One set of trials of a study."""

    #: name of the protocol, such as ``flight``
    kind: str
    #: every setting of the kind with defaults, as plain values for JSON
    settings: Mapping[str, Any]


@dataclass(frozen=True)
class Study:
    """A whole study."""

    #: of the study file, without its ending
    name: str
    #: in words
    title: str
    #: of all random numbers
    seed: int
    #: in the order of the study file
    sections: tuple[Section, ...]


def load_study(
    path: str | Path, trials: int | None = None, seed: int | None = None
) -> Study:
    """Read a study file. Trials and seed given take precedence. Raise `StudyError`."""
    raw = read_yaml(path, "study", StudyError)
    if not isinstance(raw, dict):
        raise StudyError(
            f"study {path} is empty or no mapping, expected title, seed and sections"
        )
    title = checked("study", "title", Field("text", ""), raw.pop("title", ""))
    if not title.isprintable():
        raise StudyError(f"study.title is {title!r}, expected printable text")
    stated = checked("study", "seed", Field("int", 0, 0, 2**63), raw.pop("seed", 0))
    for kind in raw:
        if kind not in PROTOCOLS:
            raise StudyError(
                f"study {path} has unknown section {kind!r}, expected some of: {', '.join(PROTOCOLS)}"
            )
    sections = {
        kind: section_settings(kind, raw[kind], protocol_class(kind).schema)
        for kind in raw
    }
    if not sections:
        raise StudyError(
            f"study {path} has no section, expected some of: {', '.join(PROTOCOLS)}"
        )
    if seed is not None and seed < 0:
        raise StudyError(f"seed is {seed}, expected 0 or more")
    if trials is not None and trials < 1:
        raise StudyError(f"trials is {trials}, expected 1 or more")
    instead = {} if trials is None else {"trials": trials}
    made = tuple(
        Section(kind, settings | instead) for kind, settings in sections.items()
    )
    return Study(Path(path).stem, title, stated if seed is None else seed, made)


def section_settings(kind: str, raw: Any, schema: Schema) -> dict[str, Any]:
    """Check the settings of one section and fill in defaults."""
    if raw is None:
        raw = {}
    if not isinstance(raw, dict):
        raise StudyError(f"section {kind} is {raw!r}, expected settings")
    for name in raw:
        if name not in schema:
            close = difflib.get_close_matches(str(name), schema, n=1)
            hint = (
                f"did you mean {close[0]!r}?"
                if close
                else f"expected some of: {', '.join(schema)}"
            )
            raise StudyError(f"section {kind} has unknown setting {name!r}, {hint}")
    settings = {}
    for name, field in schema.items():
        value = raw.get(name, field.default)
        if value is None:
            raise StudyError(f"section {kind} needs {name}")
        settings[name] = checked(kind, name, field, value)
    return settings


def checked(section: str, name: str, field: Field, value: Any) -> Any:
    """Return one setting as JSON values. Raise `StudyError` for a wrong type or range."""
    where = f"{section}.{name}"
    if field.kind == "detectors":
        named = replace(field, kind="texts", choices=field.choices or tuple(DETECTORS))
        return (
            list(named.choices)
            if value == "all"
            else list(check(named, value, where, StudyError))
        )
    if field.kind == "geometry":
        try:
            geometry_of(value)
        except (FdiError, ValueError, TypeError) as error:
            known = ", ".join(
                (*NAMED_GEOMETRIES, "cone_4 to cone_12", "[[x, y, z], ...]")
            )
            detail = f": {error}" if isinstance(error, FdiError) else ""
            raise StudyError(
                f"{where} is {value!r}, expected one of: {known}{detail}"
            ) from error
        return value
    if field.kind == "geometries":
        many = isinstance(value, list) and not (
            value and isinstance(value[0], list) and _is_axis(value[0])
        )
        return [
            checked(section, name, replace(field, kind="geometry"), one)
            for one in (value if many else [value])
        ]
    if field.kind == "mapping":
        if not isinstance(value, dict):
            raise StudyError(f"{where} is {value!r}, expected names and values")
        return dict(value)
    fitting = check(field, value, where, StudyError)
    return list(fitting) if isinstance(fitting, tuple) else fitting


def _is_axis(value: Any) -> bool:
    return len(value) == 3 and all(isinstance(x, (int, float)) for x in value)


def geometry_of(spec: Any) -> Geometry:
    """Geometry of a name or of axes, as a study file gives them."""
    if not isinstance(spec, str):
        return Geometry(np.array(spec, dtype=np.float64))
    if spec in NAMED_GEOMETRIES:
        return NAMED_GEOMETRIES[spec]()
    return Geometry.cone(int(spec.removeprefix("cone_")))


# Running one --------------------------------------------------------------------------

PREPARING, TRIALS = (
    0,
    1,
)  # the first stage prepares what the trials of the second need: thresholds, limits
STUDY_FORMAT = 1  # of the JSON


class Block(NamedTuple):
    """Some trials of one cell: the unit of work and of seeding."""

    #: number of the section, from 0
    section: int
    #: `PREPARING` or `TRIALS`
    stage: int
    #: number of the cell in its stage, from 0
    cell: int
    #: number of the block in its cell, from 0
    block: int
    #: number of trials
    trials: int


@dataclass(frozen=True)
class SectionResult(Section):
    """Figures of one section."""

    #: results of the first stage
    found: Preparation
    #: methods that did not run, with the reasons
    not_run: Refusals
    #: figures of each cell of the second stage
    cells: list[Figures]


@dataclass(frozen=True)
class StudyResult:
    """All figures and settings of a study."""

    #: `STUDY_FORMAT`
    format: int
    #: version of the package
    fdi_ros: str
    #: name of the study
    study: str
    #: in words
    title: str
    #: of all random numbers
    seed: int
    #: in the order of the study file
    sections: list[SectionResult]


def run_block(
    kind: str, settings: str, preparation: str, seed: int, block: Block
) -> Counts:
    """Run one block of trials, wherever: the result depends on the arguments alone.

    Settings and preparation come as JSON: detectors are built once per process for
    each. The block's own generator is spawned from the seed of the study.
    """
    protocol, prepared = _built(kind, settings, preparation)
    rng = np.random.default_rng(
        np.random.SeedSequence(
            seed, spawn_key=(block.section, block.stage, block.cell, block.block)
        )
    )
    cell = _cells(protocol, block.stage)[block.cell]
    if block.stage == PREPARING:
        return protocol.prepare(cell, block.trials, rng)
    return protocol.run(cell, block.trials, rng, prepared)


@lru_cache(maxsize=16)
def _built(
    kind: str, settings: str, preparation: str
) -> tuple[AnyProtocol, Preparation]:
    """Build a protocol. Its preparation is empty in the first stage."""
    return protocol_class(kind)(json.loads(settings)), json.loads(preparation)


def _cells(protocol: AnyProtocol, stage: int) -> list[Any]:
    return (
        protocol.preparation_cells() if stage == PREPARING else protocol.trial_cells()
    )


def run_study(
    study: Study,
    workers: int | None = None,
    cluster: str | None = None,
    progress: Callable[[float], None] | None = None,
) -> StudyResult:
    """Run a study and return all figures and settings.

    ``workers``: local processes, by default one per core. The figures do not depend on
    their number. ``cluster``: address of the scheduler of a Dask cluster that works
    instead. ``progress`` is called with the share done. `StudyError` if the study
    cannot be run.
    """
    protocols = [protocol_class(one.kind)(one.settings) for one in study.sections]

    def run(
        stage: int, preparations: Sequence[Preparation]
    ) -> list[list[list[Counts]]]:
        """Run all blocks of a stage, and return them for every cell of every section."""
        blocks = [
            block
            for s, protocol in enumerate(protocols)
            for block in _blocks(s, protocol, stage)
        ]
        texts = [
            (one.kind, json.dumps(one.settings), json.dumps(preparation))
            for one, preparation in zip(study.sections, preparations, strict=True)
        ]
        jobs = [(*texts[block.section], study.seed, block) for block in blocks]
        counts: dict[int, Counts] = {}
        for job, done in run_jobs(run_block, jobs, worker_count(workers), cluster):
            counts[job] = done
            if progress is not None:
                progress((stage + len(counts) / len(jobs)) / 2)
        found: list[list[list[Counts]]] = [
            [[] for _ in _cells(protocol, stage)] for protocol in protocols
        ]
        for k, block in enumerate(blocks):
            found[block.section][block.cell].append(counts[k])
        return found

    found = run(PREPARING, [{} for _ in protocols])
    prepared = [
        protocol.conclude(own) for protocol, own in zip(protocols, found, strict=True)
    ]
    sections = []
    trials = run(TRIALS, prepared)
    parts = zip(study.sections, protocols, prepared, trials, strict=True)
    for section, protocol, preparation, counts in parts:
        cells = zip(protocol.trial_cells(), counts, strict=True)
        figures = [
            protocol.summary(cell, reduce(added, blocks), preparation)
            for cell, blocks in cells
        ]
        kind, settings, refusals = section.kind, section.settings, protocol.refusals()
        sections.append(SectionResult(kind, settings, preparation, refusals, figures))
    return StudyResult(
        STUDY_FORMAT, __version__, study.name, study.title, study.seed, sections
    )


def _blocks(section: int, protocol: AnyProtocol, stage: int) -> list[Block]:
    blocks = []
    for c, cell in enumerate(_cells(protocol, stage)):
        trials, size = protocol.trials(cell)
        count = math.ceil(trials / size)
        blocks += [
            Block(section, stage, c, b, min(size, trials - b * size))
            for b in range(count)
        ]
    return blocks
