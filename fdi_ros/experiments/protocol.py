# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The contract of a trial protocol: cells of equal settings, cut into blocks that any worker can run."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import numpy as np

from fdi_ros.arrays import Array
from fdi_ros.experiments.limit import Limit
from fdi_ros.experiments.study_file import Schema
from fdi_ros.scoring import Largest, Tally, settled


@dataclass(frozen=True)
class SoundTally(Tally):
    """Trials of healthy channels, and the largest ratios of statistic to threshold by method."""

    trials: int
    methods: dict[str, Largest]

    def factors(self, false_alarms: Sequence[float]) -> dict[str, list[float]]:
        """Multiple of its loose threshold by method, for each false-alarm rate."""
        return {
            name: [threshold_factor(pooled.largest, alarm, self.trials) for alarm in false_alarms]
            for name, pooled in self.methods.items()
        }


@dataclass(frozen=True)
class LimitPoint:
    """Best possible shares at one false-alarm rate."""

    false_alarm: float
    declared: float
    right: float


@dataclass(frozen=True)
class LimitTally(Tally):
    """Best possible shares declared, and declared with the right channel named, at each false-alarm rate."""

    declared: list[float]
    right: list[float]

    @classmethod
    def of(cls, limit: Limit, false_alarms: Sequence[float]) -> LimitTally:
        """Read a limit at some false-alarm rates."""
        best = [limit.at(alarm) for alarm in false_alarms]
        return cls([settled(declared) for declared, _ in best], [settled(right) for _, right in best])

    def points(self, false_alarms: Sequence[float]) -> list[LimitPoint]:
        """One point per false-alarm rate."""
        return [LimitPoint(*one) for one in zip(false_alarms, self.declared, self.right, strict=True)]


PreparationTally = SoundTally | LimitTally


def largest_ratios(ratio: Array, false_alarms: Sequence[float]) -> Largest:
    """Keep the ratios (N,) of one block that can decide a threshold: twice the share of alarms, and some more."""
    kept = int(2 * max(false_alarms) * len(ratio)) + 50
    return Largest(np.sort(ratio)[::-1][:kept].tolist())


def threshold_factor(largest: Sequence[float], alarm_probability: float, trials: int) -> float:
    """Ratio that the given share of trials reaches, from their largest ratios; at least the loose threshold, 1."""
    rank = round(alarm_probability * trials)
    ordered = np.sort(np.asarray(largest, dtype=np.float64))[::-1]
    if rank < 1 or rank > len(ordered):
        return 1.0 if rank >= 1 else float(ordered[0])
    return max(float(ordered[rank - 1]), 1.0)


Cell = TypeVar("Cell")
"""What distinguishes one cell of a section from the others."""
Preparation = TypeVar("Preparation")
"""What the first stage gives; a dataclass, in the result under ``found``."""
TrialTally = TypeVar("TrialTally", bound=Tally)
"""Counts of one block of the second stage."""
CellResult = TypeVar("CellResult")
"""Figures of one cell of the second stage; a dataclass."""

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


class TrialProtocol(ABC, Generic[Cell, Preparation, TrialTally, CellResult]):
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
    preparation_type: ClassVar[type[Any]]
    tally_type: ClassVar[type[Tally]]

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

    def prepare(self, cell: Cell, count: int, rng: np.random.Generator) -> PreparationTally:
        """Run one block of the first stage, where there is one."""
        raise NotImplementedError(f"{self.kind} has no cells to prepare")

    @abstractmethod
    def conclude(self, cells: Sequence[Cell], tallies: Sequence[PreparationTally]) -> Preparation:
        """Work out from the first stage what the second needs."""

    @abstractmethod
    def run(self, cell: Cell, count: int, rng: np.random.Generator, preparation: Preparation) -> TrialTally:
        """Run one block of the second stage."""

    @abstractmethod
    def summary(self, cell: Cell, tally: TrialTally, preparation: Preparation) -> CellResult:
        """Figures of one cell of the second stage."""

    @abstractmethod
    def refusals(self) -> Refusals:
        """Return which methods do not run on a geometry, and why."""

    def cells(self, stage: int) -> list[Cell]:
        """Cells of a stage."""
        return self.preparation_cells() if stage == Stage.PREPARING else self.trial_cells()
