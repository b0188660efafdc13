# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Trials of one sample each: none, one or two channels off by some standard deviations; every method, same samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np

from fdi_ros.arrays import Array, Mask
from fdi_ros.errors import StudyError
from fdi_ros.experiments.contenders import (
    METHODS,
    Contender,
    Contenders,
    Evaluation,
    build_contenders,
    whitened_noise,
)
from fdi_ros.experiments.limit import MAX_DIMENSIONS, fault_of_size
from fdi_ros.experiments.protocol import (
    LimitPoint,
    LimitTally,
    PreparationTally,
    Refusals,
    SoundTally,
    TrialProtocol,
    largest_ratios,
)
from fdi_ros.experiments.study_file import Field, Schema, geometry_of
from fdi_ros.model.geometry import Geometry
from fdi_ros.scoring import Estimate, Tally, share

FOUND, DERIVED = "found", "derived"
"""Thresholds: found by the first stage on healthy channels, or as each method derives it from the false-alarm rate."""
FALSE_ALARM_MARGIN = 4.0
"""The loose thresholds have this many times the false-alarm rate asked for."""


@dataclass(frozen=True)
class SampleCell:
    """Samples on one geometry with faults of one size; 0: none."""

    geometry: int
    size: float


@dataclass(frozen=True)
class LimitCell:
    """The best possible decision on one geometry for faults of one size."""

    geometry: int
    size: float


Cell = SampleCell | LimitCell


@dataclass(frozen=True)
class Preparation:
    """Multiples of the loose thresholds by geometry, method and false-alarm rate; limits by geometry and size."""

    factors: list[dict[str, list[float]]]
    limits: dict[str, LimitTally]


@dataclass(frozen=True)
class SampleCounts(Tally):
    """What one method made of samples at one false-alarm rate."""

    trials: int
    identified: int | None
    """The largest normalised residual is a faulty channel's; None: the method does not give it."""
    declared: int
    right: int
    """Declared, and the channel named first is faulty."""
    isolated: int
    isolated_right: int
    covered: int
    """Declared, and every faulty channel is a suspect."""
    set_sizes: list[int]
    """Samples by number of suspects, 0 to n."""


@dataclass(frozen=True)
class SnapshotTally(Tally):
    """Counts by method and false-alarm rate."""

    trials: int
    methods: dict[str, list[SampleCounts]]


@dataclass(frozen=True)
class SnapshotFigures:
    """Shares of the samples at one false-alarm rate."""

    false_alarm: float
    identified: Estimate | None
    declared: Estimate
    right: Estimate
    isolated_right: Estimate
    isolated_wrong: Estimate
    covered_when_declared: Estimate
    set_sizes: list[int]

    @classmethod
    def of(cls, false_alarm: float, counts: SampleCounts) -> SnapshotFigures:
        """Make shares of counts."""
        trials = counts.trials
        return cls(
            false_alarm,
            None if counts.identified is None else share(counts.identified, trials),
            share(counts.declared, trials),
            share(counts.right, trials),
            share(counts.isolated_right, trials),
            share(counts.isolated - counts.isolated_right, trials),
            share(counts.covered, counts.declared),
            counts.set_sizes,
        )

    def as_json(self) -> dict[str, object]:
        """Leave out what the method does not give."""
        return {name: value for name, value in vars(self).items() if value is not None}


@dataclass(frozen=True)
class SnapshotResult:
    """Figures of one cell."""

    geometry: Any
    """As the study gives it."""
    size: float
    trials: int
    methods: dict[str, list[SnapshotFigures]]
    """One per false-alarm rate."""
    limit: list[LimitPoint] | None


class Truth(NamedTuple):
    """Samples and what is wrong in them."""

    z: Array
    """(N, n) rad/s."""
    struck: Mask
    """(N, n)"""


class Snapshot(TrialProtocol[Cell, Preparation, SnapshotTally, SnapshotResult]):
    """Detection, right isolation and suspects by size of fault, at one false-alarm rate for all methods.

    The first stage finds, on healthy channels, the threshold at which each method gives the false-alarm rate; and the
    limit. The second runs healthy channels and faults through the detectors at those thresholds.
    """

    kind = "snapshot"
    preparation_type = Preparation
    tally_type = SnapshotTally
    schema: ClassVar[Schema] = {
        "geometries": Field("geometries", ["two_triad_cone"]),
        "detectors": Field("detectors", "all", choices=tuple(METHODS)),
        "options": Field("mapping", {}),
        "faults": Field("int", 1, 1, 2),
        "sizes": Field("numbers", [2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0], 0.01, 1e4),
        "false_alarms": Field("numbers", [1e-3], 1e-6, 0.2),
        "thresholds": Field("text", FOUND, choices=(FOUND, DERIVED)),
        "noise_std": Field("float", 0.0025, 1e-9, 10.0),
        "max_rate": Field("float", 0.035, 0.0, 100.0),
        "trials": Field("int", 100_000, 1, 1e9),
        "sound_trials": Field("int", 1_000_000, 1000, 1e9),
        "block": Field("int", 25_000, 1, 1e6),
    }

    def __init__(self, settings: Mapping[str, Any]) -> None:
        super().__init__(settings)
        if self._derived and len(self.settings["false_alarms"]) > 1:
            raise StudyError("snapshot.thresholds is 'derived', expected one of snapshot.false_alarms")
        self._ready: dict[int, dict[str, list[tuple[Contender, float]]]] = {}

    def preparation_cells(self) -> list[Cell]:
        """List the healthy samples of each geometry, and the limits."""
        sound: list[Cell] = [SampleCell(g, 0.0) for g in self._indices if not self._derived]
        limits = [g for g in self._indices if self._geometries[g].n - 3 <= MAX_DIMENSIONS]
        if self.settings["faults"] != 1:
            limits = []
        return sound + [LimitCell(g, size) for g in limits for size in self.settings["sizes"]]

    def trial_cells(self) -> list[Cell]:
        """List each geometry, without faults and with those of each size."""
        return [SampleCell(g, size) for g in self._indices for size in [0.0, *self.settings["sizes"]]]

    def trials(self, cell: Cell) -> tuple[int, int]:
        """Return the trials of a cell and of a block: as set; healthy channels need more than faulty ones."""
        if isinstance(cell, LimitCell):
            return 1, 1
        return self.settings["trials" if cell.size else "sound_trials"], self.settings["block"]

    def prepare(self, cell: Cell, count: int, rng: np.random.Generator) -> PreparationTally:
        """Find the largest ratios of healthy samples, or a limit."""
        alarms = self.settings["false_alarms"]
        if isinstance(cell, LimitCell):
            return LimitTally.of(fault_of_size(self._geometries[cell.geometry], np.array([cell.size])), alarms)
        truth = self._draw(cell, count, rng)
        running = self._loose[cell.geometry].running
        return SoundTally(count, {name: largest_ratios(c.ratios(truth.z), alarms) for name, c in running.items()})

    def conclude(self, cells: Sequence[Cell], tallies: Sequence[PreparationTally]) -> Preparation:
        """Find the factors of the common false-alarm rates, and the limits."""
        limits = {
            _limit_key(cell): tally for cell, tally in zip(cells, tallies, strict=True) if isinstance(tally, LimitTally)
        }
        if self._derived:
            return Preparation([{name: [1.0] for name in loose.running} for loose in self._loose], limits)
        sound = [tally for tally in tallies if isinstance(tally, SoundTally)]
        return Preparation([tally.factors(self.settings["false_alarms"]) for tally in sound], limits)

    def run(self, cell: Cell, count: int, rng: np.random.Generator, preparation: Preparation) -> SnapshotTally:
        """Draw samples and evaluate every method on them."""
        truth = self._draw(cell, count, rng)
        methods = {}
        for name, contenders in self._at_rates(cell.geometry, preparation.factors[cell.geometry]).items():
            evaluations: dict[Contender, Evaluation] = {}
            for contender, _ in contenders:
                if contender not in evaluations:
                    evaluations[contender] = contender.evaluate(truth.z)
            methods[name] = [counted(evaluations[one], factor, truth.struck) for one, factor in contenders]
        return SnapshotTally(count, methods)

    def summary(self, cell: Cell, tally: SnapshotTally, preparation: Preparation) -> SnapshotResult:
        """Return shares of samples declared, rightly named, isolated and covered, with their intervals."""
        alarms = self.settings["false_alarms"]
        methods = {
            name: [SnapshotFigures.of(*at) for at in zip(alarms, counts, strict=True)]
            for name, counts in tally.methods.items()
        }
        limit = preparation.limits.get(_limit_key(cell))
        geometry = self.settings["geometries"][cell.geometry]
        points = None if limit is None else limit.points(alarms)
        return SnapshotResult(geometry, cell.size, tally.trials, methods, points)

    def refusals(self) -> Refusals:
        """Return the methods that do not judge a single sample, or do not run on a geometry."""
        return {str(spec): loose.refused for spec, loose in zip(self.settings["geometries"], self._loose, strict=True)}

    @property
    def _derived(self) -> bool:
        return bool(self.settings["thresholds"] == DERIVED)

    @property
    def _indices(self) -> range:
        return range(len(self.settings["geometries"]))

    @cached_property
    def _geometries(self) -> list[Geometry]:
        return [geometry_of(spec) for spec in self.settings["geometries"]]

    @cached_property
    def _loose(self) -> list[Contenders]:
        """Methods at their loose thresholds for each geometry."""
        return [self._build(g, self.settings["detectors"]) for g in self._indices]

    def _build(self, g: int, names: Sequence[str], factors: Mapping[str, float] | None = None) -> Contenders:
        margin = 1.0 if self._derived else FALSE_ALARM_MARGIN
        probability = min(margin * max(self.settings["false_alarms"]), 0.9)
        noise, own = whitened_noise(self.settings["noise_std"]), self.settings["options"]
        return build_contenders(names, self._geometries[g], noise, probability, own, factors).for_single_samples()

    def _at_rates(self, g: int, factors: Mapping[str, Sequence[float]]) -> dict[str, list[tuple[Contender, float]]]:
        """Each method with the factor of each false-alarm rate; those that depend on their threshold built anew."""
        if g not in self._ready:
            self._ready[g] = {}
            for name, loose in self._loose[g].running.items():
                self._ready[g][name] = [(loose, factor) for factor in factors[name]]
                if "threshold" in loose.detector.options:
                    built = [self._build(g, [name], {name: factor}).running[name] for factor in factors[name]]
                    self._ready[g][name] = [(one, 1.0) for one in built]
        return self._ready[g]

    def _draw(self, cell: Cell, count: int, rng: np.random.Generator) -> Truth:
        geometry, sigma = self._geometries[cell.geometry], self.settings["noise_std"]
        rate = rng.uniform(-1, 1, (count, 3)) * self.settings["max_rate"]
        z = rate @ geometry.axes.T + sigma * rng.standard_normal((count, geometry.n))
        struck = np.zeros(z.shape, dtype=bool)
        if cell.size:
            order = rng.random(z.shape).argsort(axis=1, kind="stable")[:, : self.settings["faults"]]
            rows = np.arange(count)[:, None]
            struck[rows, order] = True
            z[rows, order] += cell.size * sigma * rng.choice([-1.0, 1.0], order.shape)
        return Truth(z, struck)


def _limit_key(cell: Cell) -> str:
    return f"{cell.geometry} {cell.size}"


def counted(evaluation: Evaluation, factor: float, struck: Mask) -> SampleCounts:
    """Count what came of samples with faults in the channels struck (N, n); none struck: false alarms."""
    declared = evaluation.ratio >= factor
    rows = np.arange(len(struck))
    right = declared & struck[rows, evaluation.named] & (evaluation.named >= 0)
    suspects = evaluation.suspects & declared[:, None]
    exact = (suspects == struck).all(axis=1) & declared
    isolated = declared & evaluation.isolated
    covered = declared & ~(struck & ~suspects).any(axis=1)
    sizes = suspects.sum(axis=1)[declared]
    return SampleCounts(
        trials=len(struck),
        identified=None if evaluation.best is None else int(struck[rows, evaluation.best].sum()),
        declared=int(declared.sum()),
        right=int(right.sum()),
        isolated=int(isolated.sum()),
        isolated_right=int((isolated & exact).sum()),
        covered=int(covered.sum()),
        set_sizes=np.bincount(sizes, minlength=struck.shape[1] + 1).tolist(),
    )
