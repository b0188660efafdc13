# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Trials of one sample each: none, one or two channels off by some standard deviations; every method, same samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from fdi_ros.errors import StudyError
from fdi_ros.experiments.contenders import (
    Cell,
    Contender,
    Contenders,
    Evaluation,
    OnGeometries,
    build_contenders,
    factors_of,
    largest_ratios,
    white_noise,
)
from fdi_ros.experiments.study import Counts, Field, Figures, Preparation, Schema
from fdi_ros.model.samples import Array, Mask
from fdi_ros.replay.outcomes import share

FOUND, DERIVED = "found", "derived"
"""Thresholds: found by the first stage on healthy channels, or as each method derives it from the false-alarm rate."""
FALSE_ALARM_MARGIN = 4.0  # the loose thresholds have this many times the false-alarm rate asked for


class Snapshot(OnGeometries):
    """Detection, right isolation and suspects by size of fault, at one false-alarm rate for all methods.

    The first stage finds, on healthy channels, the threshold at which each method gives the false-alarm rate. The
    second runs healthy channels and faults through the detectors at those thresholds.
    """

    kind = "snapshot"
    schema: ClassVar[Schema] = {
        **OnGeometries.schema,
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
        """List the geometries, without faults."""
        return [Cell(g, 0.0) for g in self._indices if not self._derived]

    def trial_cells(self) -> list[Cell]:
        """List each geometry, without faults and with those of each size."""
        return [Cell(g, size) for g in self._indices for size in [0.0, *self.settings["sizes"]]]

    def prepare(self, cell: Cell, count: int, rng: np.random.Generator) -> Counts:
        """Find the largest ratios of healthy samples."""
        z, running = self._draw(cell, count, rng)[0], self.contenders[cell.geometry].running
        return {"trials": count, "largest": largest_ratios(running, z, self.settings["false_alarms"])}

    def conclude(self, found: Sequence[Sequence[Counts]]) -> Preparation:
        """Find the multiples of the loose thresholds by geometry, method and false-alarm rate."""
        if self._derived:
            return {"factors": [{name: [1.0] for name in loose.running} for loose in self.contenders]}
        return {"factors": [factors_of(blocks, self.settings["false_alarms"]) for blocks in found]}

    def run(self, cell: Cell, count: int, rng: np.random.Generator, preparation: Preparation) -> Counts:
        """Draw samples and evaluate every method on them."""
        z, struck = self._draw(cell, count, rng)
        methods = {}
        for name, contenders in self._at_rates(cell.geometry, preparation["factors"][cell.geometry]).items():
            evaluations: dict[Contender, Evaluation] = {}
            for contender, _ in contenders:
                if contender not in evaluations:
                    evaluations[contender] = contender.evaluate(z)
            methods[name] = [counted(evaluations[one], factor, struck) for one, factor in contenders]
        return {"trials": count, "methods": methods}

    def summary(self, cell: Cell, counts: Counts, preparation: Preparation) -> Figures:
        """Return shares of samples declared, rightly named, isolated and covered, at each false-alarm rate."""
        alarms = self.settings["false_alarms"]
        return {
            "geometry": self.settings["geometries"][cell.geometry],
            "size": cell.size,
            "trials": counts["trials"],
            "methods": {
                name: [_figures(*at) for at in zip(alarms, own, strict=True)] for name, own in counts["methods"].items()
            },
        }

    @property
    def _derived(self) -> bool:
        return bool(self.settings["thresholds"] == DERIVED)

    @property
    def _indices(self) -> range:
        return range(len(self.settings["geometries"]))

    def build(self, g: int, names: Sequence[str], factors: Mapping[str, float] | None = None) -> Contenders:
        """Build methods with more false alarms than asked for; factors: multiples of that threshold."""
        margin = 1.0 if self._derived else FALSE_ALARM_MARGIN
        probability = min(margin * max(self.settings["false_alarms"]), 0.9)
        noise, own = white_noise(self.settings["noise_std"]), self.settings["options"]
        return build_contenders(names, self.geometries[g], noise, probability, own, factors).for_single_samples()

    def _at_rates(self, g: int, factors: Mapping[str, Sequence[float]]) -> dict[str, list[tuple[Contender, float]]]:
        """Each method with the factor of each false-alarm rate; those that depend on their threshold built anew."""
        if g not in self._ready:
            self._ready[g] = {}
            for name, loose in self.contenders[g].running.items():
                self._ready[g][name] = [(loose, factor) for factor in factors[name]]
                if "threshold" in loose.detector.options:
                    built = [self.build(g, [name], {name: factor}).running[name] for factor in factors[name]]
                    self._ready[g][name] = [(one, 1.0) for one in built]
        return self._ready[g]

    def _draw(self, cell: Cell, count: int, rng: np.random.Generator) -> tuple[Array, Mask]:
        """Draw samples z (N, n) rad/s, and which channels are struck (N, n)."""
        geometry, sigma = self.geometries[cell.geometry], self.settings["noise_std"]
        rate = rng.uniform(-1, 1, (count, 3)) * self.settings["max_rate"]
        z = rate @ geometry.axes.T + sigma * rng.standard_normal((count, geometry.n))
        struck = np.zeros(z.shape, dtype=bool)
        if cell.size:
            order = rng.random(z.shape).argsort(axis=1, kind="stable")[:, : self.settings["faults"]]
            rows = np.arange(count)[:, None]
            struck[rows, order] = True
            z[rows, order] += cell.size * sigma * rng.choice([-1.0, 1.0], order.shape)
        return z, struck


def counted(evaluation: Evaluation, factor: float, struck: Mask) -> Counts:
    """Count what came of samples with faults in the channels struck (N, n); none struck: false alarms.

    ``identified``: the largest normalised residual is a faulty channel's; None: the method does not give it. ``right``:
    declared, and the channel named first is faulty. ``covered``: declared, and every faulty channel is a suspect.
    ``set_sizes``: samples by number of suspects, 0 to n.
    """
    declared = evaluation.ratio >= factor
    rows = np.arange(len(struck))
    right = declared & struck[rows, evaluation.named] & (evaluation.named >= 0)
    suspects = evaluation.suspects & declared[:, None]
    exact = (suspects == struck).all(axis=1) & declared
    isolated = declared & evaluation.isolated
    covered = declared & ~(struck & ~suspects).any(axis=1)
    sizes = suspects.sum(axis=1)[declared]
    return {
        "trials": len(struck),
        "identified": None if evaluation.best is None else int(struck[rows, evaluation.best].sum()),
        "declared": int(declared.sum()),
        "right": int(right.sum()),
        "isolated": int(isolated.sum()),
        "isolated_right": int((isolated & exact).sum()),
        "covered": int(covered.sum()),
        "set_sizes": np.bincount(sizes, minlength=struck.shape[1] + 1).tolist(),
    }


def _figures(false_alarm: float, counts: Counts) -> Figures:
    """Shares of the samples at one false-alarm rate, without those that the method does not give."""
    trials, identified = counts["trials"], counts["identified"]
    wrong = counts["isolated"] - counts["isolated_right"]
    return {
        "false_alarm": false_alarm,
        **({} if identified is None else {"identified": share(identified, trials)}),
        **{name: share(counts[name], trials) for name in ("declared", "right", "isolated_right")},
        "isolated_wrong": share(wrong, trials),
        "covered_when_declared": share(counts["covered"], counts["declared"]),
        "set_sizes": counts["set_sizes"],
    }
