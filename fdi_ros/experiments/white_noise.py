# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Trials in white noise of equal channels: single samples, and streams to the alarm."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from fdi_ros.errors import StudyError
from fdi_ros.experiments.contenders import (
    BOUND,
    Cell,
    CommonRate,
    Contender,
    Evaluation,
    factors_of,
    moustakides_delay,
)
from fdi_ros.experiments.montecarlo import Counts, Field, Figures, Preparation, Schema
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.samples import Array, Mask
from fdi_ros.replay.outcomes import Z95, Estimate, mean_of, quantiles, share

# One sample ---------------------------------------------------------------------------

FOUND, DERIVED = "found", "derived"
"""Thresholds: found on healthy channels, or derived by each method from the rate."""


class Snapshot(CommonRate):
    """Detection, right isolation and suspects, by the size of no, one or two faults."""

    schema: ClassVar[Schema] = {
        **CommonRate.schema,
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
        self._derived = self.settings["thresholds"] == DERIVED
        if self._derived and len(self.settings["false_alarms"]) > 1:
            raise StudyError(
                "snapshot.thresholds is 'derived', expected one of snapshot.false_alarms"
            )
        self._ready: dict[int, dict[str, list[tuple[Contender, float]]]] = {}

    def preparation_cells(self) -> list[Cell]:
        """List the geometries, with healthy channels."""
        return [] if self._derived else super().preparation_cells()

    def trial_cells(self) -> list[Cell]:
        """List each geometry, with healthy channels and with faults of each size."""
        return [
            Cell(g, size)
            for g in range(len(self.specs))
            for size in [0.0, *self.settings["sizes"]]
        ]

    def conclude(self, found: Sequence[Sequence[Counts]]) -> Preparation:
        """Find the multiples of the loose thresholds by geometry, method and false-alarm rate."""
        if self._derived:
            return {
                "factors": [
                    {name: [1.0] for name in loose.running} for loose in self.contenders
                ]
            }
        return super().conclude(found)

    def run(
        self, cell: Cell, count: int, rng: np.random.Generator, preparation: Preparation
    ) -> Counts:
        """Draw samples and evaluate every method on them."""
        z, struck = self.draw(cell, count, rng)
        methods = {}
        for name, contenders in self._at_rates(
            cell.geometry, preparation["factors"][cell.geometry]
        ).items():
            evaluations = {one: one.evaluate(z) for one in dict(contenders)}
            methods[name] = [
                counted(evaluations[one], factor, struck) for one, factor in contenders
            ]
        return {"trials": count, "methods": methods}

    def summary(self, cell: Cell, counts: Counts, preparation: Preparation) -> Figures:
        """Return shares declared, rightly named, isolated and covered, at each rate."""
        alarms = self.settings["false_alarms"]
        return {
            "geometry": self.specs[cell.geometry],
            "size": cell.size,
            "trials": counts["trials"],
            "methods": {
                name: [_shares(*at) for at in zip(alarms, own, strict=True)]
                for name, own in counts["methods"].items()
            },
        }

    def loose(self) -> tuple[NoiseModel, float]:
        """White noise, and more false alarms than asked for."""
        margin = 1.0 if self._derived else 4.0
        return _noise(self.settings["noise_std"]), min(
            margin * max(self.settings["false_alarms"]), 0.9
        )

    def _at_rates(
        self, g: int, factors: Mapping[str, Sequence[float]]
    ) -> dict[str, list[tuple[Contender, float]]]:
        """Return each method with the factor of each rate, built anew where it must be."""
        if g not in self._ready:
            self._ready[g] = {}
            for name, loose in self.contenders[g].running.items():
                options = loose.detector.options
                if "threshold" in options:
                    own = self.settings["options"].get(name, {})
                    at = (
                        {name: {**own, "threshold": options["threshold"] * factor}}
                        for factor in factors[name]
                    )
                    self._ready[g][name] = [
                        (self.build(g, [name], one).running[name], 1.0) for one in at
                    ]
                else:
                    self._ready[g][name] = [(loose, factor) for factor in factors[name]]
        return self._ready[g]

    def draw(
        self, cell: Cell, count: int, rng: np.random.Generator
    ) -> tuple[Array, Mask]:
        """Draw samples z (N, n) rad/s, and which channels are struck (N, n)."""
        geometry = self.geometries[cell.geometry]
        sigma = self.settings["noise_std"]
        rate = rng.uniform(-1, 1, (count, 3)) * self.settings["max_rate"]
        z = rate @ geometry.axes.T + sigma * rng.standard_normal((count, geometry.n))
        struck = np.zeros(z.shape, dtype=bool)
        if cell.size:
            order = rng.random(z.shape).argsort(axis=1, kind="stable")[
                :, : self.settings["faults"]
            ]
            rows = np.arange(count)[:, None]
            struck[rows, order] = True
            sign = rng.choice([-1.0, 1.0], order.shape)
            z[rows, order] += cell.size * sigma * sign
        return z, struck


def _noise(noise_std: float) -> NoiseModel:
    return NoiseModel(noise_std, bound=BOUND * noise_std)


def counted(evaluation: Evaluation, factor: float, struck: Mask) -> Counts:
    """Count the outcomes of samples with faults in the channels struck (N, n).

    Without faults, count false alarms.

    ``identified``: the largest normalised residual is a faulty channel's, or None
    without residuals. ``right``: declared, and the channel named first is faulty.
    ``covered``: declared, and every faulty channel is a suspect. ``set_sizes``: samples
    by number of suspects, 0 to n.
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
        "identified": None
        if evaluation.best is None
        else int(struck[rows, evaluation.best].sum()),
        "declared": int(declared.sum()),
        "right": int(right.sum()),
        "isolated": int(isolated.sum()),
        "isolated_right": int((isolated & exact).sum()),
        "covered": int(covered.sum()),
        "set_sizes": np.bincount(sizes, minlength=struck.shape[1] + 1).tolist(),
    }


def _shares(false_alarm: float, counts: Counts) -> Figures:
    """Return shares of the samples at one rate, without those the method has not."""
    trials = counts["trials"]
    identified = counts["identified"]
    wrong = counts["isolated"] - counts["isolated_right"]
    return {
        "false_alarm": false_alarm,
        **({} if identified is None else {"identified": share(identified, trials)}),
        **{
            name: share(counts[name], trials)
            for name in ("declared", "right", "isolated_right")
        },
        "isolated_wrong": share(wrong, trials),
        "covered_when_declared": share(counts["covered"], counts["declared"]),
        "set_sizes": counts["set_sizes"],
    }


# A stream -----------------------------------------------------------------------------


class Delay(CommonRate):
    """Delay by size of fault at one mean run length, beside the least possible delay.

    The first stage finds the threshold at which a method gives no alarm over a window
    of W healthy samples with the probability exp(-W / run length). In the second, each
    stream begins with `lead` healthy samples, so that memories are filled. Streams with
    an alarm among them are counted and left out.
    """

    streams = True
    schema: ClassVar[Schema] = {
        **CommonRate.schema,
        "sizes": Field("numbers", [1.0, 2.0, 3.0, 4.0, 6.0], 0.01, 1e4),
        "run_length": Field("float", 10_000.0, 100.0, 1e7),
        "noise_std": Field("float", 0.0025, 1e-9, 10.0),
        "lead": Field("int", 200, 0, 1e6),
        "longest": Field("int", 1000, 1, 1e6),
        "trials": Field("int", 400, 1, 1e7),
        "sound_trials": Field("int", 1500, 100, 1e7),
        "block": Field("int", 100, 1, 1e5),
    }

    def __init__(self, settings: Mapping[str, Any]) -> None:
        super().__init__(settings)
        # Healthy samples of a tenth of the run length.
        self._window = max(round(self.settings["run_length"] / 10), 1)

    def trial_cells(self) -> list[Cell]:
        """List each size of fault on each geometry."""
        return [
            Cell(g, size)
            for g in range(len(self.specs))
            for size in self.settings["sizes"]
        ]

    def prepare(self, cell: Cell, count: int, rng: np.random.Generator) -> Counts:
        """Find the largest ratio of every window of healthy samples."""
        z = self.draw(cell, count, rng)[0]
        running = self.contenders[cell.geometry].running
        return {
            "trials": count,
            "largest": {
                name: _ratios(one, z).max(axis=1).tolist()
                for name, one in running.items()
            },
        }

    def conclude(self, found: Sequence[Sequence[Counts]]) -> Preparation:
        """Find the multiples of the loose thresholds for the common run length."""
        with_alarm = -math.expm1(-self._window / self.settings["run_length"])
        factors = [factors_of(blocks, [with_alarm]) for blocks in found]
        return {
            "window": self._window,
            "factors": [
                {name: factor for name, (factor,) in one.items()} for one in factors
            ],
        }

    def run(
        self, cell: Cell, count: int, rng: np.random.Generator, preparation: Preparation
    ) -> Counts:
        """Draw streams and run every method on them."""
        z, _ = self.draw(cell, count, rng)
        lead = self.settings["lead"]
        factors = preparation["factors"][cell.geometry]
        running = self.contenders[cell.geometry].running
        methods = {
            name: _delays(_ratios(one, z) >= factors[name], lead)
            for name, one in running.items()
        }
        return {"trials": count, "methods": methods}

    def summary(self, cell: Cell, counts: Counts, preparation: Preparation) -> Figures:
        """Return mean and quantiles of the delay beside the least possible, in samples."""
        running = self.contenders[cell.geometry].running
        # The channel most in view bounds them all.
        shift = cell.size * float(self.geometries[cell.geometry].sensitivity.max())
        run_length = self.settings["run_length"]
        return {
            "geometry": self.specs[cell.geometry],
            "size": cell.size,
            "trials": counts["trials"],
            "methods": {
                name: _waited(own, running[name].has_memory)
                for name, own in counts["methods"].items()
            },
            # To nine digits: what linear algebra gives alike on all machines.
            "limit": {
                "moustakides": float(f"{moustakides_delay(shift, run_length):.9g}")
            },
        }

    def draw(
        self, cell: Cell, count: int, rng: np.random.Generator
    ) -> tuple[Array, None]:
        """Draw streams (count, length, n), rad/s, healthy or with a fault after the lead."""
        n = self.geometries[cell.geometry].n
        lead = self.settings["lead"]
        sigma = self.settings["noise_std"]
        length = self._window if cell.healthy else lead + self.settings["longest"]
        z = sigma * rng.standard_normal((count, length, n))
        if not cell.healthy:
            channel = rng.integers(n, size=count)
            sign = rng.choice([-1.0, 1.0], count)
            error = cell.size * sigma * sign
            z[np.arange(count), lead:, channel] += error[:, None]
        return z, None

    def loose(self) -> tuple[NoiseModel, float]:
        """White noise, and a run length somewhat shorter than the one asked for."""
        return _noise(self.settings["noise_std"]), 3.0 / self.settings["run_length"]


def _ratios(contender: Contender, z: Array) -> Array:
    """Ratio of every sample of every stream, (trials, length), from z (trials, length, n)."""
    if not contender.has_memory:
        samples = z.reshape(-1, z.shape[2])
        return contender.ratios(samples).reshape(z.shape[:2])
    ratios = np.empty(z.shape[:2])
    for stream, ratio in zip(z, ratios, strict=True):
        contender.detector.reset()
        ratio[:] = contender.ratios(stream)
    return ratios


def _delays(alarm: NDArray[np.bool_], lead: int) -> Counts:
    """Count delays of streams whose fault begins at `lead`, whose first sample counts 1.

    Streams with an alarm before the fault, which are left out of all else, with one
    after it, and without. ``waited``: samples until the alarm, or the end, of all
    streams. ``squares``: sum of the squared delays. ``histogram``: streams by delay.
    """
    early = alarm[:, :lead].any(axis=1)
    after = alarm[~early, lead:]
    heard = after.any(axis=1)
    delay = after.argmax(axis=1)[heard] + 1
    values, counts = np.unique(delay, return_counts=True)
    return {
        "alarm_before": int(early.sum()),
        "heard": int(heard.sum()),
        "unheard": int((~heard).sum()),
        "waited": int(delay.sum()) + int((~heard).sum()) * after.shape[1],
        "squares": int((delay**2).sum()),
        "histogram": dict(zip(map(str, values), counts.tolist(), strict=True)),
    }


def _waited(counts: Counts, memory: bool) -> Figures:
    """Return the mean delay, which is geometric for a method without memory.

    None: not known, as some streams ended before the alarm.
    """
    heard = counts["heard"]
    unheard = counts["unheard"]
    delay = None
    if not memory and heard:
        half = Z95 / math.sqrt(heard)
        mean = counts["waited"] / heard
        low = mean * math.exp(-half)
        delay = Estimate(mean, low, mean * math.exp(half))
    elif memory and not unheard:
        delay = mean_of(float(counts["waited"]), float(counts["squares"]), heard)
    return {
        "mean_delay": delay,
        "quantiles": None if unheard else quantiles(counts["histogram"]),
        **{name: counts[name] for name in ("alarm_before", "heard", "unheard")},
    }
