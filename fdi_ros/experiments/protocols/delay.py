# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Trials of a stream each: a constant error from some sample on, and how many samples each method takes to alarm."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.arrays import Array
from fdi_ros.experiments.contenders import METHODS, Contender, Contenders, build_contenders, whitened_noise
from fdi_ros.experiments.limit import lorden_delay, moustakides_delay
from fdi_ros.experiments.protocol import PreparationTally, Refusals, SoundTally, TrialProtocol
from fdi_ros.experiments.study_file import Field, Schema, geometry_of
from fdi_ros.model.geometry import Geometry
from fdi_ros.scoring import Z95, Estimate, Largest, Tally, mean_of, quantiles, settled

RUN_LENGTH_MARGIN = 3.0
"""The loose thresholds have a run length this many times shorter than the one asked for."""
WINDOW_SHARE = 10
"""A window of healthy samples is the run length over this."""


class Cell(NamedTuple):
    """Streams on one geometry with a fault of one size; 0: windows of healthy samples."""

    geometry: int
    size: float


@dataclass(frozen=True)
class Preparation:
    """Samples of a window, and multiples of the loose thresholds by geometry and method."""

    window: int
    factors: list[dict[str, float]]


@dataclass(frozen=True)
class DelayCounts(Tally):
    """What one method made of streams."""

    alarm_before: int
    """Streams with an alarm before the fault, which are left out of all else."""
    heard: int
    """Streams with an alarm after it."""
    unheard: int
    waited: int
    """Samples until the alarm, or the end, of all streams."""
    squares: int
    """Sum of the squared delays of the streams with an alarm."""
    histogram: dict[int, int]
    """Streams by delay, in samples."""


@dataclass(frozen=True)
class DelayTally(Tally):
    """Counts by method."""

    trials: int
    methods: dict[str, DelayCounts]


@dataclass(frozen=True)
class DelayFigures:
    """Delay of one method, in samples."""

    mean_delay: Estimate | None
    """None: not known, as some streams ended before the alarm."""
    quantiles: dict[str, int | None] | None
    alarm_before: int
    heard: int
    unheard: int


@dataclass(frozen=True)
class LeastDelay:
    """Lower bounds of the worst-case mean delay, samples."""

    moustakides: float
    lorden: float


@dataclass(frozen=True)
class DelayResult:
    """Figures of one cell."""

    geometry: Any
    """As the study gives it."""
    size: float
    trials: int
    methods: dict[str, DelayFigures]
    limit: LeastDelay


class Delay(TrialProtocol[Cell, Preparation, DelayTally, DelayResult]):
    """Delay against size of fault at one mean run length to a false alarm, beside the least possible delay.

    The first stage finds the threshold at which a method gives no alarm over a window of W healthy samples with the
    probability exp(-W / run length). In the second, each stream begins with `lead` healthy samples, so that memories
    are filled; streams with an alarm among them are counted and left out.
    """

    kind = "delay"
    preparation_type = Preparation
    tally_type = DelayTally
    schema: ClassVar[Schema] = {
        "geometries": Field("geometries", ["two_triad_cone"]),
        "detectors": Field("detectors", "all", choices=tuple(METHODS)),
        "options": Field("mapping", {}),
        "sizes": Field("numbers", [1.0, 2.0, 3.0, 4.0, 6.0], 0.01, 1e4),
        "run_length": Field("float", 10_000.0, 100.0, 1e7),
        "noise_std": Field("float", 0.0025, 1e-9, 10.0),
        "lead": Field("int", 200, 0, 1e6),
        "longest": Field("int", 1000, 1, 1e6),
        "trials": Field("int", 400, 1, 1e7),
        "sound_trials": Field("int", 1500, 100, 1e7),
        "block": Field("int", 100, 1, 1e5),
    }

    def preparation_cells(self) -> list[Cell]:
        """List the geometries, without faults."""
        return [Cell(g, 0.0) for g in range(len(self.settings["geometries"]))]

    def trial_cells(self) -> list[Cell]:
        """List each size of fault on each geometry."""
        return [Cell(g, size) for g in range(len(self.settings["geometries"])) for size in self.settings["sizes"]]

    def trials(self, cell: Cell) -> tuple[int, int]:
        """Return the trials of a cell and of a block: as set."""
        return self.settings["trials" if cell.size else "sound_trials"], self.settings["block"]

    def prepare(self, cell: Cell, count: int, rng: np.random.Generator) -> SoundTally:
        """Find the largest ratio of every window of healthy samples."""
        z = self._noise(cell, count, self._window, rng)
        running = self._contenders[cell.geometry].running
        largest = {name: Largest(_ratios(one, z).max(axis=1).tolist()) for name, one in running.items()}
        return SoundTally(count, largest)

    def conclude(self, cells: Sequence[Cell], tallies: Sequence[PreparationTally]) -> Preparation:
        """Find the factors of the common run length."""
        with_alarm = -math.expm1(-self._window / self.settings["run_length"])
        found = [tally.factors([with_alarm]) for tally in tallies if isinstance(tally, SoundTally)]
        return Preparation(self._window, [{name: factor for name, (factor,) in one.items()} for one in found])

    def run(self, cell: Cell, count: int, rng: np.random.Generator, preparation: Preparation) -> DelayTally:
        """Draw streams and run every method on them."""
        lead, n = self.settings["lead"], self._geometries[cell.geometry].n
        z = self._noise(cell, count, lead + self.settings["longest"], rng)
        channel, sign = rng.integers(n, size=count), rng.choice([-1.0, 1.0], count)
        z[np.arange(count), lead:, channel] += (cell.size * self.settings["noise_std"] * sign)[:, None]
        factors, running = preparation.factors[cell.geometry], self._contenders[cell.geometry].running
        return DelayTally(
            count, {name: _delays(_ratios(one, z) >= factors[name], lead) for name, one in running.items()}
        )

    def summary(self, cell: Cell, tally: DelayTally, preparation: Preparation) -> DelayResult:
        """Return mean and quantiles of the delay beside the least possible."""
        running = self._contenders[cell.geometry].running
        methods = {name: _figures(counts, running[name].has_memory) for name, counts in tally.methods.items()}
        # The channel most in view bounds them all.
        shift = cell.size * float(self._geometries[cell.geometry].sensitivity.max())
        run_length = self.settings["run_length"]
        limit = LeastDelay(settled(moustakides_delay(shift, run_length)), settled(lorden_delay(shift, run_length)))
        return DelayResult(self.settings["geometries"][cell.geometry], cell.size, tally.trials, methods, limit)

    def refusals(self) -> Refusals:
        """Return the methods that do not run on a geometry."""
        return {str(spec): one.refused for spec, one in zip(self.settings["geometries"], self._contenders, strict=True)}

    def _noise(self, cell: Cell, count: int, length: int, rng: np.random.Generator) -> Array:
        """Streams of healthy samples, (count, length, n) rad/s."""
        n = self._geometries[cell.geometry].n
        return self.settings["noise_std"] * rng.standard_normal((count, length, n))

    @property
    def _window(self) -> int:
        return max(round(self.settings["run_length"] / WINDOW_SHARE), 1)

    @cached_property
    def _geometries(self) -> list[Geometry]:
        return [geometry_of(spec) for spec in self.settings["geometries"]]

    @cached_property
    def _contenders(self) -> list[Contenders]:
        settings = self.settings
        alarm, noise = RUN_LENGTH_MARGIN / settings["run_length"], whitened_noise(settings["noise_std"])
        return [build_contenders(settings["detectors"], g, noise, alarm, settings["options"]) for g in self._geometries]


def _ratios(contender: Contender, z: Array) -> Array:
    """Ratio of every sample of every stream, (trials, length), from z (trials, length, n)."""
    if not contender.has_memory:
        return contender.ratios(z.reshape(-1, z.shape[2])).reshape(z.shape[:2])
    ratios = np.empty(z.shape[:2])
    for stream, ratio in zip(z, ratios, strict=True):
        contender.detector.reset()
        ratio[:] = contender.ratios(stream)
    return ratios


def _delays(alarm: NDArray[np.bool_], lead: int) -> DelayCounts:
    """Count delays, in samples with the first faulty one as 1, of streams whose fault begins at `lead`."""
    early = alarm[:, :lead].any(axis=1)
    after = alarm[~early, lead:]
    heard = after.any(axis=1)
    delay = after.argmax(axis=1)[heard] + 1
    values, counts = np.unique(delay, return_counts=True)
    return DelayCounts(
        alarm_before=int(early.sum()),
        heard=int(heard.sum()),
        unheard=int((~heard).sum()),
        waited=int(delay.sum()) + int((~heard).sum()) * after.shape[1],
        squares=int((delay**2).sum()),
        histogram=dict(zip(values.tolist(), counts.tolist(), strict=True)),
    )


def _figures(counts: DelayCounts, memory: bool) -> DelayFigures:
    """Mean delay: of a method without memory from all the samples waited, alarm or not, for it is geometric there."""
    heard, unheard = counts.heard, counts.unheard
    delay = None
    if not memory:
        if heard:
            half, mean = Z95 / math.sqrt(heard), counts.waited / heard
            delay = Estimate(mean, mean * math.exp(-half), mean * math.exp(half))
    elif not unheard:
        delay = mean_of(float(counts.waited), float(counts.squares), heard)
    spread = quantiles(counts.histogram) if not unheard else None
    return DelayFigures(delay, spread, counts.alarm_before, heard, unheard)
