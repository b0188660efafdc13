# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The Monte-Carlo protocol of Gorelov et al. 2019, with every method beside its four.

``z_i = (H omega)_i (1 + k_i) + b_i``, omega uniform in a cube, k and b of healthy channels normal and clipped at
3 standard deviations. One channel, any, has ``k = sign(X1) ((D - 3) |X1| + 3) sigma_k`` and b alike, X uniform on
-1 to 1. A trial is kept by the error ``dZ = |z - H omega|`` of the failed channel against the mean M and standard
deviation s over the healthy ones: inside ``M - 3 s < dZ < M + 3 s`` as printed, or outside, a fault that stands
out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from fdi_ros.detectors import create_detector, detector_class
from fdi_ros.detectors.base import Detector, accepted_options
from fdi_ros.experiments.contenders import BOUND, Cell, CommonRate
from fdi_ros.experiments.montecarlo import Counts, Field, Figures, Preparation, Schema
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.samples import Array
from fdi_ros.replay.outcomes import share

Index = NDArray[np.intp]

STANDS_OUT, PRINTED, ALL = "stands_out", "printed", "all"
#: The protocol draws normal errors within three standard deviations.
CLIP = 3.0
LOOSE_FALSE_ALARM = 0.98
"""False-alarm probability of the loose thresholds: every method names a channel nearly always, as the protocol counts
names within the tolerance too."""


class ResidualSearch(CommonRate):
    """Outcomes: right or wrong channel, declared or within the tolerance; false alarms.

    The four searches with the paper's tolerance. Then all methods at common false-alarm
    rates of healthy channels. A cell is a selection of trials, or healthy channels.
    """

    schema: ClassVar[Schema] = {
        "geometry": Field("geometry", "two_triad_cone"),
        "detectors": Field("detectors", "all"),
        "options": Field("mapping", {}),
        "selections": Field(
            "texts", [STANDS_OUT, PRINTED, ALL], choices=(STANDS_OUT, PRINTED, ALL)
        ),
        "false_alarms": Field("numbers", [0.15, 0.01], 1e-5, 0.5),
        "max_rate": Field("float", math.radians(2.0), 1e-6, 100.0),
        "sigma_ratio": Field("float", 0.2, 1e-3, 1e3),
        "scale_std": Field("float", 0.001, 1e-9, 0.3),
        "worst": Field("float", 9.0, 3.0, 1e3),
        "trials": Field("int", 40_000, 1, 1e9),
        "sound_trials": Field("int", 100_000, 1000, 1e9),
        "block": Field("int", 10_000, 1, 1e6),
    }

    @property
    def specs(self) -> list[Any]:
        """The one geometry."""
        return [self.settings["geometry"]]

    def trial_cells(self) -> list[Cell]:
        """List the healthy channels, and each selection of trials."""
        return [
            Cell(0),
            *(
                Cell(0, selection=selection)
                for selection in self.settings["selections"]
            ),
        ]

    def conclude(self, found: Sequence[Sequence[Counts]]) -> Preparation:
        """Find the multiples of the loose thresholds by method and false-alarm rate."""
        (factors,) = super().conclude(found)["factors"]
        return {"factors": factors}

    def run(
        self, cell: Cell, count: int, rng: np.random.Generator, preparation: Preparation
    ) -> Counts:
        """Draw trials of the protocol and evaluate every method on them."""
        z, failed = self.draw(cell, count, rng)
        methods = {}
        paper = {}
        for name, contender in self.contenders[0].running.items():
            evaluation = contender.evaluate(z)
            factors = preparation["factors"][name]
            methods[name] = [
                _counted(evaluation.ratio >= one, evaluation.named, failed)
                for one in factors
            ]
            if name in self._paper:
                declared = self._paper[name].detect(z).alarm
                paper[name] = _counted(declared, evaluation.named, failed)
        return {"drawn": count, "kept": len(z), "methods": methods, "paper": paper}

    def summary(self, cell: Cell, counts: Counts, preparation: Preparation) -> Figures:
        """Return shares of the trials that the selection keeps by outcome."""
        alarms = self.settings["false_alarms"]
        kept = counts["kept"]

        def shares(outcomes: Counts) -> Figures:
            return {name: share(count, kept) for name, count in outcomes.items()}

        return {
            "selection": cell.selection or "sound",
            "drawn": counts["drawn"],
            "trials": kept,
            "paper_tolerance": {
                name: shares(outcomes) for name, outcomes in counts["paper"].items()
            },
            "methods": {
                name: [
                    {"false_alarm": alarm, **shares(one)}
                    for alarm, one in zip(alarms, own, strict=True)
                ]
                for name, own in counts["methods"].items()
            },
        }

    def loose(self) -> tuple[NoiseModel, float]:
        """Errors of the protocol, and thresholds at which methods name a channel nearly always."""
        zero = self._zero_std
        scale = self.settings["scale_std"]
        return NoiseModel(
            zero, scale, bound=BOUND * (zero + scale * self.settings["max_rate"])
        ), LOOSE_FALSE_ALARM

    @property
    def _zero_std(self) -> float:
        settings = self.settings
        return settings["sigma_ratio"] * settings["scale_std"] * settings["max_rate"]

    @cached_property
    def _paper(self) -> dict[str, Detector]:
        return {
            name: create_detector(
                name, self.geometries[0], self.loose()[0], tolerance="paper"
            )
            for name in self.contenders[0].running
            if "tolerance" in accepted_options(detector_class(name))
        }

    def draw(
        self, cell: Cell, count: int, rng: np.random.Generator
    ) -> tuple[Array, Index | None]:
        """Draw trials of a selection: z (N, n), rad/s, and the failed channel (N,) or None."""
        n = self.geometries[0].n
        omega = rng.uniform(-1, 1, (count, 3)) * self.settings["max_rate"]
        drawn = rng.standard_normal((2, count, n))
        scale, zero = np.clip(drawn, -CLIP, CLIP)
        failed = None
        if not cell.healthy:
            failed = rng.integers(n, size=count)
            strength = rng.uniform(-1, 1, (2, count))
            off = np.sign(strength) * (
                (self.settings["worst"] - CLIP) * np.abs(strength) + CLIP
            )
            scale[np.arange(count), failed], zero[np.arange(count), failed] = off
        along = omega @ self.geometries[0].axes.T
        error = along * scale * self.settings["scale_std"] + zero * self._zero_std
        if failed is None:
            return along + error, None
        kept = _selected(np.abs(error), failed, cell.selection)
        return (along + error)[kept], failed[kept]


def _selected(size: Array, failed: Index, selection: str) -> NDArray[np.bool_]:
    """Which trials a selection keeps, (N,), from the sizes of all errors (N, n)."""
    rows = np.arange(len(size))
    own = size[rows, failed]
    healthy = np.ones(size.shape, dtype=bool)
    healthy[rows, failed] = False
    others = size[healthy].reshape(len(size), -1)
    middle = others.mean(axis=1)
    spread = others.std(axis=1)
    inside: NDArray[np.bool_] = (middle - 3 * spread < own) & (
        own < middle + 3 * spread
    )
    return (
        inside
        if selection == PRINTED
        else ~inside
        if selection == STANDS_OUT
        else inside | True
    )


def _counted(declared: NDArray[np.bool_], named: Index, failed: Index | None) -> Counts:
    """Count trials by outcome."""
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
