# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Trials of a stream each: a constant error from some sample on, and how many samples each method takes to alarm."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from fdi_ros.experiments.contenders import (
    Cell,
    Contender,
    Contenders,
    OnGeometries,
    build_contenders,
    factors_of,
    moustakides_delay,
    white_noise,
)
from fdi_ros.experiments.study import Counts, Field, Figures, Preparation, Schema
from fdi_ros.model.samples import Array
from fdi_ros.replay.outcomes import Z95, Estimate, mean_of, quantiles, settled

RUN_LENGTH_MARGIN = 3.0  # the loose thresholds have a run length this many times shorter than the one asked for
WINDOW_SHARE = 10  # a window of healthy samples is the run length over this


class Delay(OnGeometries):
    """Delay against size of fault at one mean run length to a false alarm, beside the least possible delay.

    The first stage finds the threshold at which a method gives no alarm over a window of W healthy samples with the
    probability exp(-W / run length). In the second, each stream begins with `lead` healthy samples, so that memories
    are filled; streams with an alarm among them are counted and left out.
    """

    kind = "delay"
    schema: ClassVar[Schema] = {
        **OnGeometries.schema,
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

    def prepare(self, cell: Cell, count: int, rng: np.random.Generator) -> Counts:
        """Find the largest ratio of every window of healthy samples."""
        z = self._noise(cell, count, self._window, rng)
        running = self.contenders[cell.geometry].running
        return {
            "trials": count,
            "largest": {name: _ratios(one, z).max(axis=1).tolist() for name, one in running.items()},
        }

    def conclude(self, found: Sequence[Sequence[Counts]]) -> Preparation:
        """Find the multiples of the loose thresholds by geometry and method, for the common run length."""
        with_alarm = -math.expm1(-self._window / self.settings["run_length"])
        factors = [factors_of(blocks, [with_alarm]) for blocks in found]
        return {
            "window": self._window,
            "factors": [{name: factor for name, (factor,) in one.items()} for one in factors],
        }

    def run(self, cell: Cell, count: int, rng: np.random.Generator, preparation: Preparation) -> Counts:
        """Draw streams and run every method on them."""
        lead, n = self.settings["lead"], self.geometries[cell.geometry].n
        z = self._noise(cell, count, lead + self.settings["longest"], rng)
        channel, sign = rng.integers(n, size=count), rng.choice([-1.0, 1.0], count)
        z[np.arange(count), lead:, channel] += (cell.size * self.settings["noise_std"] * sign)[:, None]
        factors, running = preparation["factors"][cell.geometry], self.contenders[cell.geometry].running
        methods = {name: _delays(_ratios(one, z) >= factors[name], lead) for name, one in running.items()}
        return {"trials": count, "methods": methods}

    def summary(self, cell: Cell, counts: Counts, preparation: Preparation) -> Figures:
        """Return mean and quantiles of the delay beside the least possible, in samples."""
        running = self.contenders[cell.geometry].running
        # The channel most in view bounds them all.
        shift = cell.size * float(self.geometries[cell.geometry].sensitivity.max())
        run_length = self.settings["run_length"]
        return {
            "geometry": self.settings["geometries"][cell.geometry],
            "size": cell.size,
            "trials": counts["trials"],
            "methods": {name: _figures(own, running[name].has_memory) for name, own in counts["methods"].items()},
            "limit": {"moustakides": settled(moustakides_delay(shift, run_length))},
        }

    def _noise(self, cell: Cell, count: int, length: int, rng: np.random.Generator) -> Array:
        """Streams of healthy samples, (count, length, n) rad/s."""
        n = self.geometries[cell.geometry].n
        return self.settings["noise_std"] * rng.standard_normal((count, length, n))

    @property
    def _window(self) -> int:
        return max(round(self.settings["run_length"] / WINDOW_SHARE), 1)

    def build(self, g: int, names: Sequence[str]) -> Contenders:
        """Build methods with a run length somewhat shorter than the one asked for."""
        alarm, noise = RUN_LENGTH_MARGIN / self.settings["run_length"], white_noise(self.settings["noise_std"])
        return build_contenders(names, self.geometries[g], noise, alarm, self.settings["options"])


def _ratios(contender: Contender, z: Array) -> Array:
    """Ratio of every sample of every stream, (trials, length), from z (trials, length, n)."""
    if not contender.has_memory:
        return contender.ratios(z.reshape(-1, z.shape[2])).reshape(z.shape[:2])
    ratios = np.empty(z.shape[:2])
    for stream, ratio in zip(z, ratios, strict=True):
        contender.detector.reset()
        ratio[:] = contender.ratios(stream)
    return ratios


def _delays(alarm: NDArray[np.bool_], lead: int) -> Counts:
    """Count delays, in samples with the first faulty one as 1, of streams whose fault begins at `lead`.

    Streams with an alarm before the fault, which are left out of all else, with one after it, and without. ``waited``:
    samples until the alarm, or the end, of all streams. ``squares``: sum of the squared delays. ``histogram``: streams
    by delay.
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


def _figures(counts: Counts, memory: bool) -> Figures:
    """Mean delay: of a method without memory from all the samples waited, alarm or not, for it is geometric there.

    None: not known, as some streams ended before the alarm.
    """
    heard, unheard, delay = counts["heard"], counts["unheard"], None
    if not memory and heard:
        half, mean = Z95 / math.sqrt(heard), counts["waited"] / heard
        delay = Estimate(mean, mean * math.exp(-half), mean * math.exp(half))
    elif memory and not unheard:
        delay = mean_of(float(counts["waited"]), float(counts["squares"]), heard)
    return {
        "mean_delay": delay,
        "quantiles": None if unheard else quantiles(counts["histogram"]),
        **{name: counts[name] for name in ("alarm_before", "heard", "unheard")},
    }
