"""The Monte-Carlo protocol of Gorelov, Zbrutskyi, Shcholieva, Yankelevych 2019, with every method beside its four.

``z_i = (H omega)_i (1 + k_i) + b_i``, omega uniform in a cube; k and b of sound channels normal and clipped at
3 standard deviations; one channel, any, with ``k = sign(X1) ((D - 3) |X1| + 3) sigma_k`` and b alike, X uniform on
-1 to 1. A trial is kept by the error ``dZ = |z - H omega|`` of the failed channel against the mean M and standard
deviation s of those of the sound ones: inside ``M - 3 s < dZ < M + 3 s`` as printed, or outside, a fault that stands
out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.detectors import DETECTORS, create_detector
from fdi_ros.detectors.base import Detector, accepted_options
from fdi_ros.experiments.experiment import FIRST, Cell, Experiment, Found
from fdi_ros.experiments.judges import BOUND, Judge, build_judges, threshold_of
from fdi_ros.experiments.limit import Limit, Rule, best_decisions, grid, log_faulty, log_normal, parity_directions
from fdi_ros.experiments.study_file import Field, Schema, geometry_of
from fdi_ros.experiments.tally import Tally, settled, share
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel

Array = NDArray[np.float64]
Index = NDArray[np.intp]

SOUND, STANDS_OUT, PRINTED, ALL = "sound", "stands_out", "printed", "all"
CLIP = 3.0
MILD = 0.98
"""False-alarm probability of the thresholds above which methods are listened to: every method names a channel nearly
always, as the protocol counts names within the tolerance too."""
RATES, SIZES, DRAWS = 96, 16, 4000
"""Of the limit: body rates averaged over, sizes of fault at each, trials that these come from."""


class Trials(NamedTuple):
    """Samples of the protocol."""

    z: Array
    """(N, n) rad/s."""
    error: Array
    """(N, n) z - H omega, rad/s."""
    failed: Index | None
    """(N,) the failed channel; None: all are sound."""


class ResidualSearch(Experiment):
    """Outcomes of the protocol: right or wrong channel, declared or within the tolerance; and false alarms.

    The four searches with the paper's tolerance; then all methods at common false-alarm rates found on sound channels.
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

    def cells(self, stage: int) -> list[Cell]:
        """List the cells: sound channels, and each selection of trials."""
        chosen: list[Cell] = [{"selection": name} for name in self.settings["selections"]]
        if stage == FIRST:
            return [{"selection": SOUND}, *({**cell, "what": "limit"} for cell in chosen)]
        return [{"selection": SOUND}, *chosen]

    def trials(self, stage: int, cell: Cell) -> tuple[int, int]:
        """Return the trials of a cell and of a block: as set, before the selection."""
        if "what" in cell:
            return 1, 1
        return self.settings["sound_trials" if cell["selection"] == SOUND else "trials"], self.settings["block"]

    def run(self, stage: int, cell: Cell, count: int, rng: np.random.Generator, found: Found) -> Tally:
        """Draw trials of the protocol and let every method judge them."""
        if "what" in cell:
            limit = self._limit(cell["selection"], rng)
            best = [limit.at(alarm) for alarm in self.settings["false_alarms"]]
            return {"declared": [settled(b[0]) for b in best], "right": [settled(b[1]) for b in best]}
        trials = self._draw(rng, count, cell["selection"])
        if stage == FIRST:
            keep = int(2 * max(self.settings["false_alarms"]) * count) + 50
            ratios = {name: judge.ratios(trials.z) for name, judge in self._judges[0].items()}
            methods = {name: {"largest": np.sort(r)[::-1][:keep].tolist()} for name, r in ratios.items()}
            return {"trials": count, "methods": methods}
        tally: Tally = {"drawn": count, "kept": len(trials.z), "methods": {}, "paper": {}}
        for name, judge in self._judges[0].items():
            opinion = judge.opinion(trials.z)
            factors = found["factors"][name]
            counts = [_outcomes(opinion.ratio >= factor, opinion.named, trials.failed) for factor in factors]
            tally["methods"][name] = counts
            if name in self._paper:
                declared = self._paper[name].detect(trials.z).alarm
                tally["paper"][name] = _outcomes(declared, opinion.named, trials.failed)
        return tally

    def conclude(self, cells: Sequence[Cell], tallies: Sequence[Tally]) -> Found:
        """Find the factors of the common false-alarm rates, and the limits."""
        sound, limits = tallies[0], tallies[1:]
        alarms = self.settings["false_alarms"]
        factors = {
            name: [threshold_of(pooled["largest"], alarm, sound["trials"]) for alarm in alarms]
            for name, pooled in sound["methods"].items()
        }
        return {"factors": factors, "limits": dict(zip(self.settings["selections"], limits, strict=True))}

    def summary(self, cell: Cell, tally: Tally, found: Found) -> dict[str, Any]:
        """Return shares of the trials kept by outcome."""
        alarms, selection = self.settings["false_alarms"], cell["selection"]
        methods = {
            name: [{"false_alarm": a, **_shares(c)} for a, c in zip(alarms, counts, strict=True)]
            for name, counts in tally["methods"].items()
        }
        best = found["limits"].get(selection)
        limit = None
        if best is not None:
            figures = zip(alarms, best["declared"], best["right"], strict=True)
            limit = [{"false_alarm": a, "declared": d, "right": r} for a, d, r in figures]
        paper = {name: _shares(counts) for name, counts in tally["paper"].items()}
        about = {"selection": selection, "drawn": tally["drawn"], "trials": tally["kept"]}
        return {**about, "paper_tolerance": paper, "methods": methods, "limit": limit}

    def refusals(self) -> dict[str, Any]:
        """Say which methods do not judge a single sample, or do not run on the geometry."""
        return {str(self.settings["geometry"]): self._judges[1]}

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
    def _judges(self) -> tuple[dict[str, Judge], dict[str, str]]:
        settings = self.settings
        judges, refused = build_judges(settings["detectors"], self._geometry, self._noise, MILD, settings["options"])
        for name in [name for name, judge in judges.items() if judge.has_memory]:
            del judges[name]
            refused[name] = "judges a stream, not one sample"
        return judges, refused

    @cached_property
    def _paper(self) -> dict[str, Detector]:
        return {
            name: create_detector(name, self._geometry, self._noise, tolerance="paper")
            for name in self._judges[0]
            if "tolerance" in accepted_options(DETECTORS[name])
        }

    def _draw(self, rng: np.random.Generator, count: int, selection: str, rate: Array | None = None) -> Trials:
        """Draw trials and keep those of a selection; `rate` (3,) fixes the body rate."""
        n = self._geometry.n
        omega = (
            rng.uniform(-1, 1, (count, 3)) * self.settings["max_rate"] if rate is None else np.tile(rate, (count, 1))
        )
        scale, zero = np.clip(rng.standard_normal((2, count, n)), -CLIP, CLIP)
        failed = None
        if selection != SOUND:
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
        directions = parity_directions(geometry)
        # Evenly spread in each component: a mean over few rates that is as good as one over many drawn at random.
        strata = np.array([rng.permutation(RATES) for _ in range(3)]).T
        rates = (2 * (strata + rng.random(strata.shape)) / RATES - 1) * self.settings["max_rate"]
        parts = [self._at_rate(selection, rate, rng, directions) for rate in rates]
        rule = Rule(np.vstack([p[0].points for p in parts]), np.concatenate([p[0].log_weight for p in parts]))
        sound, faulty = np.concatenate([p[1] for p in parts]), np.hstack([p[2] for p in parts])
        kept = float(np.mean([p[3] for p in parts]))
        return best_decisions(rule, sound - math.log(RATES), faulty - math.log(RATES * kept))

    def _at_rate(
        self, selection: str, rate: Array, rng: np.random.Generator, directions: Array
    ) -> tuple[Rule, Array, Array, float]:
        """Rule, log density of sound channels (Q,), of each failed one with its prior (n, Q), and the share kept."""
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
                density = log_faulty(rule.points, direction, typical, np.full(SIZES, 1 / SIZES), rest)
                faulty[i] = density + math.log(len(own) / DRAWS)
        return rule, log_normal(rule.points, covariance), faulty, len(size) / DRAWS


def _selected(size: Array, failed: Index, selection: str) -> NDArray[np.bool_]:
    """Which trials a selection keeps, (N,), from the sizes of all errors (N, n)."""
    rows = np.arange(len(size))
    own = size[rows, failed]
    sound = np.ones(size.shape, dtype=bool)
    sound[rows, failed] = False
    others = size[sound].reshape(len(size), -1)
    middle, spread = others.mean(axis=1), others.std(axis=1)
    inside: NDArray[np.bool_] = (middle - 3 * spread < own) & (own < middle + 3 * spread)
    if selection == ALL:
        return np.ones(len(size), dtype=bool)
    return inside if selection == PRINTED else ~inside


def _outcomes(declared: NDArray[np.bool_], named: Index, failed: Index | None) -> Tally:
    if failed is None:
        return {"trials": len(declared), "declared": int(declared.sum())}
    right = named == failed
    return {
        "trials": len(declared),
        "right_declared": int((right & declared).sum()),
        "right_within": int((right & ~declared).sum()),
        "wrong_declared": int((~right & declared).sum()),
        "wrong_within": int((~right & ~declared).sum()),
    }


def _shares(counts: Mapping[str, int]) -> dict[str, Any]:
    return {name: share(count, counts["trials"]) for name, count in counts.items() if name != "trials"}


def _clipped_variance() -> float:
    """Variance of a standard normal clipped at `CLIP`."""
    density = math.exp(-0.5 * CLIP**2) / math.sqrt(2 * math.pi)
    return 1 - 2 * CLIP * density + (CLIP**2 - 1) * math.erfc(CLIP / math.sqrt(2))
