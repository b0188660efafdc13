"""The contract of a kind of trial: cells of equal settings, cut into blocks that any worker can run."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np

from fdi_ros.experiments.study_file import Schema
from fdi_ros.experiments.tally import Tally

Cell = dict[str, Any]
"""What distinguishes one cell of a section from the others; plain values."""
Found = Mapping[str, Any]
"""What the first stage found: the factors that give every method the common false-alarm rate, by cell."""

FIRST, SECOND = 0, 1


class Block(NamedTuple):
    """Some trials of one cell: the unit of work, of seeding and of resuming."""

    section: int
    stage: int
    cell: int
    block: int
    trials: int


class Experiment(ABC):
    """One section of a study.

    The first stage finds thresholds on sound channels and whatever else the trials need; the second runs the trials. A
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

    @abstractmethod
    def cells(self, stage: int) -> list[Cell]:
        """Cells of a stage."""

    @abstractmethod
    def trials(self, stage: int, cell: Cell) -> tuple[int, int]:
        """Trials of a cell, and of one block of it: the block size never depends on the workers."""

    @abstractmethod
    def run(self, stage: int, cell: Cell, count: int, rng: np.random.Generator, found: Found) -> Tally:
        """Run one block."""

    @abstractmethod
    def conclude(self, cells: Sequence[Cell], tallies: Sequence[Tally]) -> Found:
        """Work out from the first stage what the second needs."""

    @abstractmethod
    def summary(self, cell: Cell, tally: Tally, found: Found) -> dict[str, Any]:
        """Figures of one cell of the second stage, ready for JSON."""

    def refusals(self) -> dict[str, Any]:
        """Say which methods do not run, on what and why."""
        return {}
