"""Trials of one sample each: none, one or two channels off by some standard deviations; every method, same samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.errors import StudyError
from fdi_ros.experiments.experiment import FIRST, Cell, Experiment, Found
from fdi_ros.experiments.judges import METHODS, Judge, Opinion, build_judges, threshold_of, whitened_noise
from fdi_ros.experiments.limit import MAX_DIMENSIONS, fault_of_size
from fdi_ros.experiments.study_file import Field, Schema, geometry_of
from fdi_ros.experiments.tally import Tally, settled, share
from fdi_ros.model.geometry import Geometry

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

FOUND, DERIVED = "found", "derived"
"""Thresholds: found by the first stage on sound channels, or as each method derives it from the false-alarm rate."""
MILDER = 4.0
"""Methods are listened to at a threshold of this many times the false-alarm rate asked for."""


class Truth(NamedTuple):
    """Samples and what is wrong in them."""

    z: Array
    """(N, n) rad/s."""
    struck: Mask
    """(N, n)"""


class Snapshot(Experiment):
    """Detection, right isolation and suspects by size of fault, at one false-alarm rate for all methods.

    The first stage finds, on sound channels, the threshold at which each method gives the false-alarm rate; and the
    limit. The second runs sound channels and faults through the detectors at those thresholds.
    """

    kind = "snapshot"
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
        self._ready: dict[int, dict[str, list[tuple[Judge, float]]]] = {}

    def cells(self, stage: int) -> list[Cell]:
        """List the cells: each geometry, and each size of fault on it."""
        geometries = range(len(self.settings["geometries"]))
        if stage == FIRST:
            sound: list[Cell] = [{"geometry": g, "what": "sound"} for g in geometries if not self._derived]
            limits = self._limits if self.settings["faults"] == 1 else []
            return sound + [{"geometry": g, "what": "limit", "size": s} for g in limits for s in self.settings["sizes"]]
        return [{"geometry": g, "size": s} for g in geometries for s in [0.0, *self.settings["sizes"]]]

    @property
    def _limits(self) -> list[int]:
        return [g for g, geometry in enumerate(self._geometries) if geometry.n - 3 <= MAX_DIMENSIONS]

    def trials(self, stage: int, cell: Cell) -> tuple[int, int]:
        """Return the trials of a cell and of a block: as set; sound channels need more than faulty ones."""
        if stage == FIRST and cell["what"] == "limit":
            return 1, 1
        sound = stage == FIRST or cell["size"] == 0
        return self.settings["sound_trials" if sound else "trials"], self.settings["block"]

    def run(self, stage: int, cell: Cell, count: int, rng: np.random.Generator, found: Found) -> Tally:
        """Draw samples and let every method judge them."""
        if stage == FIRST and cell["what"] == "limit":
            limit = fault_of_size(self._geometries[cell["geometry"]], np.array([cell["size"]]))
            best = [limit.at(alarm) for alarm in self.settings["false_alarms"]]
            return {"declared": [settled(b[0]) for b in best], "right": [settled(b[1]) for b in best]}
        truth = self._draw(cell, count, rng)
        if stage == FIRST:
            return self._sound(cell, truth)
        factors = found["factors"][cell["geometry"]]
        tally: Tally = {"trials": count, "methods": {}}
        for name, judges in self._judges_at(cell["geometry"], factors).items():
            opinions: dict[Judge, Opinion] = {}
            for judge, _ in judges:
                if judge not in opinions:
                    opinions[judge] = judge.opinion(truth.z)
            tally["methods"][name] = [score(opinions[judge], factor, truth.struck) for judge, factor in judges]
        return tally

    def conclude(self, cells: Sequence[Cell], tallies: Sequence[Tally]) -> Found:
        """Find the factors of the common false-alarm rates, and the limits."""
        factors: list[dict[str, list[float]]] = []
        limits = {}
        if self._derived:
            factors = [{name: [1.0] for name in judges} for judges, _ in self._mild]
        for cell, tally in zip(cells, tallies, strict=True):
            if cell["what"] == "limit":
                limits[f"{cell['geometry']} {cell['size']}"] = tally
                continue
            alarms = self.settings["false_alarms"]
            factors.append(
                {
                    name: [threshold_of(pooled["largest"], alarm, tally["trials"]) for alarm in alarms]
                    for name, pooled in tally["methods"].items()
                }
            )
        return {"factors": factors, "limits": limits}

    def summary(self, cell: Cell, tally: Tally, found: Found) -> dict[str, Any]:
        """Return shares of samples declared, rightly named, isolated and covered, with their intervals."""
        alarms = self.settings["false_alarms"]
        methods = {
            name: [_shares(alarm, counts) for alarm, counts in zip(alarms, at, strict=True)]
            for name, at in tally["methods"].items()
        }
        limit = found["limits"].get(f"{cell['geometry']} {cell['size']}")
        best = None
        if limit is not None:
            figures = zip(alarms, limit["declared"], limit["right"], strict=True)
            best = [{"false_alarm": a, "declared": d, "right": r} for a, d, r in figures]
        geometry = self.settings["geometries"][cell["geometry"]]
        return {
            "geometry": geometry,
            "size": cell["size"],
            "trials": tally["trials"],
            "methods": methods,
            "limit": best,
        }

    def refusals(self) -> dict[str, Any]:
        """Say which methods do not judge a single sample, or do not run on a geometry."""
        return {str(spec): refused for spec, (_, refused) in zip(self.settings["geometries"], self._mild, strict=True)}

    @property
    def _derived(self) -> bool:
        return bool(self.settings["thresholds"] == DERIVED)

    @cached_property
    def _geometries(self) -> list[Geometry]:
        return [geometry_of(spec) for spec in self.settings["geometries"]]

    @cached_property
    def _mild(self) -> list[tuple[dict[str, Judge], dict[str, str]]]:
        """Methods at their mild thresholds for each geometry, and why the others do not run."""
        return [self._build(g, self.settings["detectors"]) for g in range(len(self._geometries))]

    def _build(
        self, g: int, names: Sequence[str], factors: Mapping[str, float] | None = None
    ) -> tuple[dict[str, Judge], dict[str, str]]:
        milder = 1.0 if self._derived else MILDER
        probability = min(milder * max(self.settings["false_alarms"]), 0.9)
        noise = whitened_noise(self.settings["noise_std"])
        judges, refused = build_judges(
            names, self._geometries[g], noise, probability, self.settings["options"], factors
        )
        for name in [name for name, judge in judges.items() if judge.has_memory]:
            del judges[name]
            refused[name] = "judges a stream, not one sample"
        return judges, refused

    def _judges_at(self, g: int, factors: Mapping[str, Sequence[float]]) -> dict[str, list[tuple[Judge, float]]]:
        """Each method with the factor of each false-alarm rate; those that depend on their threshold built anew."""
        if g not in self._ready:
            self._ready[g] = {}
            for name, judge in self._mild[g][0].items():
                self._ready[g][name] = [(judge, factor) for factor in factors[name]]
                if "threshold" in judge.detector.options:
                    self._ready[g][name] = [(self._build(g, [name], {name: f})[0][name], 1.0) for f in factors[name]]
        return self._ready[g]

    def _draw(self, cell: Cell, count: int, rng: np.random.Generator) -> Truth:
        geometry, sigma = self._geometries[cell["geometry"]], self.settings["noise_std"]
        rate = rng.uniform(-1, 1, (count, 3)) * self.settings["max_rate"]
        z = rate @ geometry.axes.T + sigma * rng.standard_normal((count, geometry.n))
        struck = np.zeros(z.shape, dtype=bool)
        size = cell.get("size", 0.0)
        if size:
            order = rng.random(z.shape).argsort(axis=1, kind="stable")[:, : self.settings["faults"]]
            rows = np.arange(count)[:, None]
            struck[rows, order] = True
            z[rows, order] += size * sigma * rng.choice([-1.0, 1.0], order.shape)
        return Truth(z, struck)

    def _sound(self, cell: Cell, truth: Truth) -> Tally:
        alarm = max(self.settings["false_alarms"])
        keep = min(len(truth.z), int(2 * alarm * len(truth.z)) + 50)
        methods = {}
        for name, judge in self._mild[cell["geometry"]][0].items():
            ratio = judge.ratios(truth.z)
            methods[name] = {"largest": np.sort(ratio)[::-1][:keep].tolist()}
        return {"trials": len(truth.z), "methods": methods}


def score(opinion: Opinion, factor: float, struck: Mask) -> Tally:
    """Count what came of samples with faults in the channels struck (N, n); none struck: false alarms."""
    declared = opinion.ratio >= factor
    right = declared & struck[np.arange(len(struck)), opinion.named] & (opinion.named >= 0)
    suspects = opinion.suspects & declared[:, None]
    exact = (suspects == struck).all(axis=1) & declared
    isolated = declared & opinion.isolated
    covered = declared & ~(struck & ~suspects).any(axis=1)
    sizes = suspects.sum(axis=1)[declared]
    identified = {} if opinion.best is None else {"identified": int(struck[np.arange(len(struck)), opinion.best].sum())}
    return {
        "trials": len(struck),
        **identified,
        "declared": int(declared.sum()),
        "right": int(right.sum()),
        "isolated": int(isolated.sum()),
        "isolated_right": int((isolated & exact).sum()),
        "covered": int(covered.sum()),
        "set_sizes": np.bincount(sizes, minlength=struck.shape[1] + 1).tolist(),
    }


def _shares(alarm: float, counts: Tally) -> dict[str, Any]:
    trials, declared = counts["trials"], counts["declared"]
    return {
        "false_alarm": alarm,
        **({"identified": share(counts["identified"], trials)} if "identified" in counts else {}),
        "declared": share(declared, trials),
        "right": share(counts["right"], trials),
        "isolated_right": share(counts["isolated_right"], trials),
        "isolated_wrong": share(counts["isolated"] - counts["isolated_right"], trials),
        "covered_when_declared": share(counts["covered"], declared),
        "set_sizes": counts["set_sizes"],
    }
