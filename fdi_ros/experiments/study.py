# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a study is: its file, read and validated once, here; and the contract of a trial protocol, which runs a section.

A file holds ``title``, ``seed`` and one or more sections; the name of a section says what kind of trial it runs
(`fdi_ros.experiments.montecarlo.PROTOCOLS`), its keys are that kind's settings. A protocol has cells of equal settings,
which are cut into blocks that any worker can run. What blocks give, what the first stage finds and the figures of a
cell are mappings by name, as the JSON has them: they go between processes and into the result as they are.
"""

from __future__ import annotations

import difflib
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from pathlib import Path
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import numpy as np

from fdi_ros.config.settings import Field as Field
from fdi_ros.config.settings import check
from fdi_ros.detectors import DETECTORS
from fdi_ros.errors import FdiError, StudyError
from fdi_ros.model.geometry import Geometry
from fdi_ros.system.yaml_file import read_yaml

NAMED_GEOMETRIES: dict[str, Callable[[], Geometry]] = {
    "two_triad_cone": Geometry.two_triad_cone,
    "dodecahedron": Geometry.dodecahedron,
    "parallel_triads": lambda: Geometry.from_triads([np.eye(3), np.eye(3)]),
}
GEOMETRIES = (*NAMED_GEOMETRIES, "cone_4 to cone_12", "[[x, y, z], ...]")


Schema = Mapping[str, Field]
"""Settings of a section by name. Besides the kinds of `Field`: detectors, geometry, geometries, mapping."""


@dataclass(frozen=True)
class Section:
    """One set of trials of a study."""

    kind: str
    settings: Mapping[str, Any]  # every setting of the kind, defaults filled in; plain values that JSON can hold


@dataclass(frozen=True)
class Study:
    """A whole study."""

    name: str
    title: str
    seed: int
    sections: tuple[Section, ...]

    def changed(self, trials: int | None, seed: int | None) -> Study:
        """Return the same study with another number of trials a cell, another seed."""
        if seed is not None and seed < 0:
            raise StudyError(f"seed is {seed}, expected 0 or more")
        if trials is not None and trials < 1:
            raise StudyError(f"trials is {trials}, expected 1 or more")
        sections = self.sections
        if trials is not None:
            sections = tuple(Section(s.kind, {**s.settings, "trials": trials}) for s in sections)
        return Study(self.name, self.title, self.seed if seed is None else seed, sections)


def read_study(path: str | Path, schemas: Mapping[str, Schema]) -> Study:
    """Read a study file; schemas: settings of every kind of section.

    `StudyError` if the file is missing, is no study, or a setting does not fit.
    """
    raw = read_yaml(path, "study", StudyError)
    if not isinstance(raw, dict):
        raise StudyError(f"study {path} is empty or no mapping, expected title, seed and sections")
    title = checked("study", "title", Field("text", ""), raw.pop("title", ""))
    if not title.isprintable():
        raise StudyError(f"study.title is {title!r}, expected printable text")
    seed = checked("study", "seed", Field("int", 0, 0, 2**63), raw.pop("seed", 0))
    for kind in raw:
        if kind not in schemas:
            raise StudyError(f"study {path} has unknown section {kind!r}, expected some of: {', '.join(schemas)}")
    sections = tuple(Section(str(kind), section_settings(str(kind), raw[kind], schemas[kind])) for kind in raw)
    if not sections:
        raise StudyError(f"study {path} has no section, expected some of: {', '.join(schemas)}")
    return Study(Path(path).stem, title, seed, sections)


def section_settings(kind: str, raw: Any, schema: Schema) -> dict[str, Any]:
    """Check the settings of one section and fill in defaults."""
    if raw is None:
        raw = {}
    if not isinstance(raw, dict):
        raise StudyError(f"section {kind} is {raw!r}, expected settings")
    for name in raw:
        if name not in schema:
            close = difflib.get_close_matches(str(name), schema, n=1)
            hint = f"did you mean {close[0]!r}?" if close else f"expected some of: {', '.join(schema)}"
            raise StudyError(f"section {kind} has unknown setting {name!r}, {hint}")
    settings = {}
    for name, field in schema.items():
        value = raw.get(name, field.default)
        if value is None:
            raise StudyError(f"section {kind} needs {name}")
        settings[name] = checked(kind, name, field, value)
    return settings


def checked(section: str, name: str, field: Field, value: Any) -> Any:
    """Value of one setting, of its type and within its range (else `StudyError`); plain values that JSON can hold."""
    where = f"{section}.{name}"
    if field.kind == "detectors":
        named = replace(field, kind="texts", choices=field.choices or tuple(DETECTORS))
        return list(named.choices) if value == "all" else list(check(named, value, where, StudyError))
    if field.kind == "geometry":
        return _geometry(where, value)
    if field.kind == "geometries":
        many = isinstance(value, list) and not (value and isinstance(value[0], list) and _is_axis(value[0]))
        return [_geometry(where, item) for item in (value if many else [value])]
    if field.kind == "mapping":
        if not isinstance(value, dict):
            raise StudyError(f"{where} is {value!r}, expected names and values")
        return dict(value)
    fitting = check(field, value, where, StudyError)
    return list(fitting) if isinstance(fitting, tuple) else fitting


def geometry_of(spec: Any) -> Geometry:
    """Geometry of a name or of axes, as a study file gives them."""
    if not isinstance(spec, str):
        return Geometry(np.array(spec, dtype=np.float64))
    if spec in NAMED_GEOMETRIES:
        return NAMED_GEOMETRIES[spec]()
    return Geometry.cone(int(spec.removeprefix("cone_")))


def geometry_words(spec: Any) -> str:
    """Name of a geometry for tables."""
    return spec if isinstance(spec, str) else f"{len(spec)} given axes"


def _geometry(where: str, value: Any) -> Any:
    try:
        geometry_of(value)
    except (FdiError, ValueError, TypeError) as error:
        known = f"expected one of: {', '.join(GEOMETRIES)}"
        detail = f": {error}" if isinstance(error, FdiError) else ""
        raise StudyError(f"{where} is {value!r}, {known}{detail}") from error
    return value


def _is_axis(value: Any) -> bool:
    return len(value) == 3 and all(isinstance(x, (int, float)) for x in value)


Cell = TypeVar("Cell")  # what distinguishes one cell of a section from the others
Counts = dict[str, Any]  # what trials gave: numbers, None, and lists or mappings by text of these
Preparation = dict[str, Any]  # what the first stage gives; in the result under ``found``
Figures = dict[str, Any]  # of one cell of the second stage, in the order of the result; shares are an `Estimate`
Refusals = Mapping[str, Mapping[str, str]]  # by geometry and method: why the method does not run


class Stage(IntEnum):
    """The first stage prepares what the trials of the second need: thresholds, limits."""

    PREPARING = 0
    TRIALS = 1


class Block(NamedTuple):
    """Some trials of one cell: the unit of work and of seeding."""

    section: int
    stage: int
    cell: int
    block: int
    trials: int


class TrialProtocol(ABC, Generic[Cell]):
    """One section of a study, with settings checked against `schema`.

    The first stage finds thresholds on healthy channels and whatever else trials need; the second runs the trials. A
    block's result depends on its settings, its seed and the first stage alone.
    """

    kind: ClassVar[str]
    schema: ClassVar[Schema]

    def __init__(self, settings: Mapping[str, Any]) -> None:
        self.settings = dict(settings)

    def preparation_cells(self) -> list[Cell]:
        """Cells of the first stage; none unless a protocol has them."""
        return []

    @abstractmethod
    def trial_cells(self) -> list[Cell]:
        """Cells of the second stage."""

    @abstractmethod
    def trials(self, cell: Cell) -> tuple[int, int]:
        """Trials of a cell, and of one block of it: the block size never depends on the workers."""

    def prepare(self, cell: Cell, count: int, rng: np.random.Generator) -> Counts:
        """Run one block of the first stage, where there is one."""
        raise NotImplementedError(f"{self.kind} has no cells to prepare")

    def conclude(self, found: Sequence[Sequence[Counts]]) -> Preparation:
        """Work out from the blocks of each cell of the first stage what the second needs."""
        return {}

    @abstractmethod
    def run(self, cell: Cell, count: int, rng: np.random.Generator, preparation: Preparation) -> Counts:
        """Run one block of the second stage."""

    @abstractmethod
    def summary(self, cell: Cell, counts: Counts, preparation: Preparation) -> Figures:
        """Figures of one cell of the second stage, from the sum of its blocks."""

    @abstractmethod
    def refusals(self) -> Refusals:
        """Return which methods do not run on a geometry, and why."""

    def cells(self, stage: int) -> list[Cell]:
        """Cells of a stage."""
        return self.preparation_cells() if stage == Stage.PREPARING else self.trial_cells()
