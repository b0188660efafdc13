# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The Monte-Carlo protocol of Gorelov, Zbrutskyi, Shcholieva, Yankelevych 2019, with every method beside its four.

``z_i = (H omega)_i (1 + k_i) + b_i``, omega uniform in a cube; k and b of healthy channels normal and clipped at
3 standard deviations; one channel, any, with ``k = sign(X1) ((D - 3) |X1| + 3) sigma_k`` and b alike, X uniform on
-1 to 1. A trial is kept by the error ``dZ = |z - H omega|`` of the failed channel against the mean M and standard
deviation s of those of the healthy ones: inside ``M - 3 s < dZ < M + 3 s`` as printed, or outside, a fault that stands
out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.detectors import create_detector, detector_class
from fdi_ros.detectors.base import Detector, accepted_options
from fdi_ros.experiments.contenders import (
    BOUND,
    Contenders,
    Limit,
    Rule,
    best_decisions,
    build_contenders,
    factors_of,
    grid,
    largest_ratios,
    limit_points,
    log_faulty,
    log_normal,
)
from fdi_ros.experiments.study import Counts, Field, Figures, Preparation, Refusals, Schema, TrialProtocol, geometry_of
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.samples import Array
from fdi_ros.replay.outcomes import share

Index = NDArray[np.intp]

HEALTHY, STANDS_OUT, PRINTED, ALL = "sound", "stands_out", "printed", "all"
CLIP = 3.0
LOOSE_FALSE_ALARM = 0.98
"""False-alarm probability of the loose thresholds: every method names a channel nearly always, as the protocol counts
names within the tolerance too."""
RATES, SIZES, DRAWS = 96, 16, 4000
"""Of the limit: body rates averaged over, sizes of fault at each, trials that these come from."""


class Cell(NamedTuple):
    """Trials of one selection, or of healthy channels. Or the best possible decision on one selection."""

    selection: str
    limit: bool = False


class Trials(NamedTuple):
    """Samples of the protocol."""

    z: Array
    """(N, n) rad/s."""
    error: Array
    """(N, n) z - H omega, rad/s."""
    failed: Index | None
    """(N,) the failed channel; None: all are healthy."""


class ResidualSearch(TrialProtocol[Cell]):
    """Outcomes of the protocol: right or wrong channel, declared or within the tolerance; and false alarms.

    The four searches with the paper's tolerance; then all methods at common false-alarm rates of healthy channels.
    """

    kind = "residual_search"
    schema: ClassVar[Schema] = {
        "geometry": Field("geometry", "two_triad_cone"),
        "detectors": Field("detectors", "all"),
        "options": Field("mapping", {}),
        "selections": Field("texts", [STANDS_OUT, PRINTED, ALL], choices=(STANDS_OUT, PRINTED, ALL)),
        "false_alarms": Field("numbers", [0.15, 0.01], 1e-5, 0.5),
        "max_rate": Field("float", math.radians(2.0), 1e-6, 100.0),
        "sigma_ratio": Field("float", 0.2, 1e-3, 1e3),
        "scale_std": Field("float", 0.001, 1e-9, 0.3),
        "worst": Field("float", 9.0, 3.0, 1e3),
        "trials": Field("int", 40_000, 1, 1e9),
        "sound_trials": Field("int", 100_000, 1000, 1e9),
        "block": Field("int", 10_000, 1, 1e6),
    }

    def preparation_cells(self) -> list[Cell]:
        """List the healthy channels, and the limit of each selection of trials."""
        return [Cell(HEALTHY), *(Cell(name, limit=True) for name in self.settings["selections"])]

    def trial_cells(self) -> list[Cell]:
        """List the healthy channels, and each selection of trials."""
        return [Cell(name) for name in (HEALTHY, *self.settings["selections"])]

    def trials(self, cell: Cell) -> tuple[int, int]:
        """Return the trials of a cell and of a block: as set, before the selection."""
        if cell.limit:
            return 1, 1
        return self.settings["sound_trials" if cell.selection == HEALTHY else "trials"], self.settings["block"]

    def prepare(self, cell: Cell, count: int, rng: np.random.Generator) -> Counts:
        """Find the largest ratios of healthy samples, or a limit."""
        alarms = self.settings["false_alarms"]
        if cell.limit:
            return self._limit(cell.selection, rng).shares(alarms)
        z = self._draw(rng, count, cell.selection).z
        return {"trials": count, "largest": largest_ratios(self._contenders.running, z, alarms)}

    def conclude(self, found: Sequence[Sequence[Counts]]) -> Preparation:
        """Find the multiples of the loose thresholds by method and false-alarm rate, and the limits by selection."""
        healthy, *limits = found
        return {
            "factors": factors_of(healthy, self.settings["false_alarms"]),
            "limits": {name: one for name, (one,) in zip(self.settings["selections"], limits, strict=True)},
        }

    def run(self, cell: Cell, count: int, rng: np.random.Generator, preparation: Preparation) -> Counts:
        """Draw trials of the protocol and evaluate every method on them."""
        trials = self._draw(rng, count, cell.selection)
        methods, paper = {}, {}
        for name, contender in self._contenders.running.items():
            evaluation = contender.evaluate(trials.z)
            factors = preparation["factors"][name]
            methods[name] = [_counted(evaluation.ratio >= one, evaluation.named, trials.failed) for one in factors]
            if name in self._paper:
                declared = self._paper[name].detect(trials.z).alarm
                paper[name] = _counted(declared, evaluation.named, trials.failed)
        return {"drawn": count, "kept": len(trials.z), "methods": methods, "paper": paper}

    def summary(self, cell: Cell, counts: Counts, preparation: Preparation) -> Figures:
        """Return shares of the trials that the selection keeps by outcome."""
        alarms, kept = self.settings["false_alarms"], counts["kept"]

        def shares(outcomes: Counts) -> Figures:
            return {name: share(count, kept) for name, count in outcomes.items()}

        limit = preparation["limits"].get(cell.selection)
        return {
            "selection": cell.selection,
            "drawn": counts["drawn"],
            "trials": kept,
            "paper_tolerance": {name: shares(outcomes) for name, outcomes in counts["paper"].items()},
            "methods": {
                name: [{"false_alarm": alarm, **shares(one)} for alarm, one in zip(alarms, own, strict=True)]
                for name, own in counts["methods"].items()
            },
            "limit": None if limit is None else limit_points(limit, alarms),
        }

    def refusals(self) -> Refusals:
        """Return the methods that do not judge a single sample, or do not run on the geometry."""
        return {str(self.settings["geometry"]): self._contenders.refused}

    @cached_property
    def _geometry(self) -> Geometry:
        return geometry_of(self.settings["geometry"])

    @property
    def _zero_std(self) -> float:
        settings = self.settings
        return settings["sigma_ratio"] * settings["scale_std"] * settings["max_rate"]

    @property
    def _noise(self) -> NoiseModel:
        scale = self.settings["scale_std"]
        return NoiseModel(self._zero_std, scale, bound=BOUND * (self._zero_std + scale * self.settings["max_rate"]))

    @cached_property
    def _contenders(self) -> Contenders:
        names, own = self.settings["detectors"], self.settings["options"]
        built = build_contenders(names, self._geometry, self._noise, LOOSE_FALSE_ALARM, own)
        return built.for_single_samples()

    @cached_property
    def _paper(self) -> dict[str, Detector]:
        return {
            name: create_detector(name, self._geometry, self._noise, tolerance="paper")
            for name in self._contenders.running
            if "tolerance" in accepted_options(detector_class(name))
        }

    def _draw(self, rng: np.random.Generator, count: int, selection: str, rate: Array | None = None) -> Trials:
        """Draw trials and keep those of a selection; `rate` (3,) fixes the body rate."""
        n = self._geometry.n
        omega = (
            rng.uniform(-1, 1, (count, 3)) * self.settings["max_rate"] if rate is None else np.tile(rate, (count, 1))
        )
        scale, zero = np.clip(rng.standard_normal((2, count, n)), -CLIP, CLIP)
        failed = None
        if selection != HEALTHY:
            failed = rng.integers(n, size=count)
            strength = rng.uniform(-1, 1, (2, count))
            off = np.sign(strength) * ((self.settings["worst"] - CLIP) * np.abs(strength) + CLIP)
            scale[np.arange(count), failed], zero[np.arange(count), failed] = off
        along = omega @ self._geometry.axes.T
        error = along * scale * self.settings["scale_std"] + zero * self._zero_std
        kept = np.ones(count, dtype=bool) if failed is None else _selected(np.abs(error), failed, selection)
        return Trials((along + error)[kept], error[kept], None if failed is None else failed[kept])

    def _limit(self, selection: str, rng: np.random.Generator) -> Limit:
        """Best decisions that know the rate: errors normal with the clipped variance, sizes those of kept trials."""
        geometry = self._geometry
        directions = geometry.parity.T
        # Evenly spread in each component: a mean over few rates that is as good as one over many drawn at random.
        strata = np.array([rng.permutation(RATES) for _ in range(3)]).T
        rates = (2 * (strata + rng.random(strata.shape)) / RATES - 1) * self.settings["max_rate"]
        parts = [self._at_rate(selection, rate, rng, directions) for rate in rates]
        rule = Rule(np.vstack([p[0].points for p in parts]), np.concatenate([p[0].log_weight for p in parts]))
        healthy, faulty = np.concatenate([p[1] for p in parts]), np.hstack([p[2] for p in parts])
        kept = float(np.mean([p[3] for p in parts]))
        return best_decisions(rule, healthy - math.log(RATES), faulty - math.log(RATES * kept))

    def _at_rate(
        self, selection: str, rate: Array, rng: np.random.Generator, directions: Array
    ) -> tuple[Rule, Array, Array, float]:
        """Rule, log density of healthy channels (Q,), of each failed one with its prior (n, Q), and the share kept."""
        n, m = directions.shape
        along = self._geometry.axes @ rate
        variance = _clipped_variance() * ((along * self.settings["scale_std"]) ** 2 + self._zero_std**2)
        covariance = (directions.T * variance) @ directions
        trials = self._draw(rng, DRAWS, selection, rate)
        assert trials.failed is not None
        size = np.abs(trials.error[np.arange(len(trials.z)), trials.failed])
        factor = np.linalg.cholesky(covariance)
        reach = float(np.linalg.norm(np.linalg.solve(factor, directions.T), axis=0).max() * size.max()) + 6.0
        unit = grid(m, reach, radii=64, around=30)
        rule = Rule(unit.points @ factor.T, unit.log_weight + float(np.log(np.diag(factor)).sum()))
        faulty = np.full((n, len(rule.points)), -np.inf)
        for i, direction in enumerate(directions):
            own = size[trials.failed == i]
            if len(own):
                typical = np.quantile(own, (np.arange(SIZES) + 0.5) / SIZES)
                rest = covariance - variance[i] * np.outer(direction, direction)
                density = log_faulty(rule.points, direction, typical, rest)
                faulty[i] = density + math.log(len(own) / DRAWS)
        return rule, log_normal(rule.points, covariance), faulty, len(size) / DRAWS


def _selected(size: Array, failed: Index, selection: str) -> NDArray[np.bool_]:
    """Which trials a selection keeps, (N,), from the sizes of all errors (N, n)."""
    rows = np.arange(len(size))
    own = size[rows, failed]
    healthy = np.ones(size.shape, dtype=bool)
    healthy[rows, failed] = False
    others = size[healthy].reshape(len(size), -1)
    middle, spread = others.mean(axis=1), others.std(axis=1)
    inside: NDArray[np.bool_] = (middle - 3 * spread < own) & (own < middle + 3 * spread)
    if selection == ALL:
        return np.ones(len(size), dtype=bool)
    return inside if selection == PRINTED else ~inside


def _counted(declared: NDArray[np.bool_], named: Index, failed: Index | None) -> Counts:
    """Trials by outcome: declared, of healthy channels; else right or wrong name, declared or within the tolerance."""
    if failed is None:
        return {"declared": int(declared.sum())}
    right = named == failed
    outcomes = {
        "right_declared": right & declared,
        "right_within": right & ~declared,
        "wrong_declared": ~right & declared,
        "wrong_within": ~right & ~declared,
    }
    return {name: int(trials.sum()) for name, trials in outcomes.items()}


def _clipped_variance() -> float:
    """Variance of a standard normal clipped at `CLIP`."""
    density = math.exp(-0.5 * CLIP**2) / math.sqrt(2 * math.pi)
    return 1 - 2 * CLIP * density + (CLIP**2 - 1) * math.erfc(CLIP / math.sqrt(2))
