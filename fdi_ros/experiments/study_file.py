# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Study files: what a Monte-Carlo study does, read and validated once, here.

A file holds ``title``, ``seed`` and one or more sections; the name of a section says what kind of trial it runs
(`fdi_ros.experiments.registry`), its keys are that kind's settings.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fdi_ros.config.field import Field as Field
from fdi_ros.config.field import check
from fdi_ros.detectors import DETECTORS
from fdi_ros.errors import FdiError, StudyError
from fdi_ros.model.geometry import Geometry
from fdi_ros.yaml_file import read_yaml

GEOMETRIES = ("two_triad_cone", "dodecahedron", "parallel_triads", "cone_4 to cone_12", "[[x, y, z], ...]")


Schema = Mapping[str, Field]
"""Settings of a section by name. Besides the kinds of `Field`: detectors, geometry, geometries, mapping."""


@dataclass(frozen=True)
class Section:
    """One set of trials of a study."""

    kind: str
    settings: Mapping[str, Any]
    """Every setting of the kind, defaults filled in; plain values that JSON can hold."""


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
    """Read a study file.

    Parameters
    ----------
    path
        Of the file.
    schemas
        Settings of every kind of section.

    Raises
    ------
    StudyError
        If the file is missing, is no study, or a setting does not fit.
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
    """Value of one setting, of its type and within its range; plain values that JSON can hold.

    Raises
    ------
    StudyError
        If it does not fit.
    """
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
    if spec == "two_triad_cone":
        return Geometry.two_triad_cone()
    if spec == "dodecahedron":
        return Geometry.dodecahedron()
    if spec == "parallel_triads":
        return Geometry.from_triads([np.eye(3), np.eye(3)])
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
