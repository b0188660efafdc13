# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The contract of a trial protocol: cells of equal settings, cut into blocks that any worker can run.

What blocks give, what the first stage finds and the figures of a cell are mappings by name, as the JSON has them: they
go between processes, into the file of blocks done, and into the result as they are.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from enum import IntEnum
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import numpy as np

from fdi_ros.experiments.study_file import Schema

Cell = TypeVar("Cell")
"""What distinguishes one cell of a section from the others."""
Counts = dict[str, Any]
"""What trials gave: numbers, None, and lists or mappings by text of these."""
Preparation = dict[str, Any]
"""What the first stage gives; in the result under ``found``."""
Figures = dict[str, Any]
"""Of one cell of the second stage, in the order of the result; shares are an `Estimate`."""
Refusals = Mapping[str, Mapping[str, str]]
"""By geometry and method: why the method does not run."""


class Stage(IntEnum):
    """The first stage prepares what the trials of the second need: thresholds, limits."""

    PREPARING = 0
    TRIALS = 1


class Block(NamedTuple):
    """Some trials of one cell: the unit of work, of seeding and of resuming."""

    section: int
    stage: int
    cell: int
    block: int
    trials: int


class TrialProtocol(ABC, Generic[Cell]):
    """One section of a study.

    The first stage finds thresholds on healthy channels and whatever else trials need; the second runs the trials. A
    block's result depends on its settings, its seed and the first stage alone.

    Parameters
    ----------
    settings
        Checked against `schema`.
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
