"""Trials of a stream each: a constant error from some sample on, and how many samples each method takes to alarm."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from fdi_ros.experiments.experiment import FIRST, Cell, Experiment, Found
from fdi_ros.experiments.judges import METHODS, Judge, build_judges, threshold_of, whitened_noise
from fdi_ros.experiments.limit import lorden_delay, moustakides_delay
from fdi_ros.experiments.study_file import Field, Schema, geometry_of
from fdi_ros.experiments.tally import Z95, Tally, mean_of, quantiles, settled
from fdi_ros.model.geometry import Geometry

Array = NDArray[np.float64]

MILDER = 3.0
"""Methods are listened to at a run length this many times shorter than the one asked for."""
WINDOW_SHARE = 10
"""A window of sound samples is the run length over this."""


class Delay(Experiment):
    """Delay against size of fault at one mean run length to a false alarm, beside the least possible delay.

    The first stage finds the threshold at which a method stays silent over a window of W sound samples with the
    probability exp(-W / run length). In the second, each stream begins with `lead` sound samples, so that memories
    are filled; streams with an alarm among them are counted and left out.
    """

    kind = "delay"
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

    def cells(self, stage: int) -> list[Cell]:
        """List the cells: a geometry each, and each size of fault on it."""
        geometries = range(len(self.settings["geometries"]))
        if stage == FIRST:
            return [{"geometry": g} for g in geometries]
        return [{"geometry": g, "size": s} for g in geometries for s in self.settings["sizes"]]

    def trials(self, stage: int, cell: Cell) -> tuple[int, int]:
        """Return the trials of a cell and of a block: as set."""
        return self.settings["sound_trials" if stage == FIRST else "trials"], self.settings["block"]

    def run(self, stage: int, cell: Cell, count: int, rng: np.random.Generator, found: Found) -> Tally:
        """Draw streams and let every method listen."""
        g, settings = cell["geometry"], self.settings
        lead = settings["lead"]
        length = self._window if stage == FIRST else lead + settings["longest"]
        n, sigma = self._geometries[g].n, settings["noise_std"]
        z = sigma * rng.standard_normal((count, length, n))
        if stage == FIRST:
            largest = {name: _each(judge, z).max(axis=1).tolist() for name, judge in self._judges[g][0].items()}
            return {"trials": count, "methods": {name: {"largest": values} for name, values in largest.items()}}
        channel, sign = rng.integers(n, size=count), rng.choice([-1.0, 1.0], count)
        z[np.arange(count), lead:, channel] += (cell["size"] * sigma * sign)[:, None]
        factors = found["factors"][g]
        methods = {name: _delays(_each(judge, z) >= factors[name], lead) for name, judge in self._judges[g][0].items()}
        return {"trials": count, "methods": methods}

    def conclude(self, cells: Sequence[Cell], tallies: Sequence[Tally]) -> Found:
        """Find the factors of the common run length."""
        heard = -math.expm1(-self._window / self.settings["run_length"])
        return {
            "window": self._window,
            "factors": [
                {name: threshold_of(m["largest"], heard, tally["trials"]) for name, m in tally["methods"].items()}
                for tally in tallies
            ],
        }

    def summary(self, cell: Cell, tally: Tally, found: Found) -> dict[str, Any]:
        """Return mean and quantiles of the delay beside the least possible."""
        g, size = cell["geometry"], cell["size"]
        memory = {name: judge.has_memory for name, judge in self._judges[g][0].items()}
        methods = {name: _figures(counts, memory[name]) for name, counts in tally["methods"].items()}
        # The channel most in view bounds them all.
        shift = size * float(self._geometries[g].sensitivity.max())
        run_length = self.settings["run_length"]
        least = {"moustakides": moustakides_delay(shift, run_length), "lorden": lorden_delay(shift, run_length)}
        limit = {name: settled(value) for name, value in least.items()}
        geometry = self.settings["geometries"][g]
        return {"geometry": geometry, "size": size, "trials": tally["trials"], "methods": methods, "limit": limit}

    def refusals(self) -> dict[str, Any]:
        """Say which methods do not run on a geometry."""
        return {
            str(spec): refused for spec, (_, refused) in zip(self.settings["geometries"], self._judges, strict=True)
        }

    @property
    def _window(self) -> int:
        return max(round(self.settings["run_length"] / WINDOW_SHARE), 1)

    @cached_property
    def _geometries(self) -> list[Geometry]:
        return [geometry_of(spec) for spec in self.settings["geometries"]]

    @cached_property
    def _judges(self) -> list[tuple[dict[str, Judge], dict[str, str]]]:
        settings = self.settings
        alarm, noise = MILDER / settings["run_length"], whitened_noise(settings["noise_std"])
        return [build_judges(settings["detectors"], g, noise, alarm, settings["options"]) for g in self._geometries]


def _each(judge: Judge, z: Array) -> Array:
    """Ratio of every sample of every stream, (trials, length), from z (trials, length, n)."""
    if not judge.has_memory:
        return judge.ratios(z.reshape(-1, z.shape[2])).reshape(z.shape[:2])
    ratios = np.empty(z.shape[:2])
    for stream, ratio in zip(z, ratios, strict=True):
        judge.detector.reset()
        ratio[:] = judge.ratios(stream)
    return ratios


def _delays(alarm: NDArray[np.bool_], lead: int) -> Tally:
    """Count delays, in samples with the first faulty one as 1, of streams whose fault begins at `lead`."""
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
        "histogram": {str(value): int(count) for value, count in zip(values.tolist(), counts.tolist(), strict=True)},
    }


def _figures(counts: Mapping[str, Any], memory: bool) -> dict[str, Any]:
    """Mean delay: of a method without memory from all the samples waited, alarm or not, for it is geometric there."""
    heard, unheard, waited = counts["heard"], counts["unheard"], counts["waited"]
    if not memory:
        half = Z95 / math.sqrt(heard) if heard else math.inf
        mean = waited / heard if heard else math.inf
        delay = {"value": mean, "low": mean * math.exp(-half), "high": mean * math.exp(half)} if heard else None
    else:
        delay = mean_of(float(waited), float(counts["squares"]), heard) if not unheard else None
    spread = quantiles(counts["histogram"]) if not unheard else None
    kept = ("alarm_before", "heard", "unheard")
    return {"mean_delay": delay, "quantiles": spread, **{name: counts[name] for name in kept}}
