# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the first stage of a study measures: thresholds at a common false-alarm rate, and best possible decisions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fdi_ros.experiments.limit import Limit
from fdi_ros.experiments.tally import Largest, Tally, settled

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SoundTally(Tally):
    """Trials of healthy channels, and the largest ratios of statistic to threshold by method."""

    trials: int
    methods: dict[str, Largest]

    def factors(self, false_alarms: Sequence[float]) -> dict[str, list[float]]:
        """Multiple of its loose threshold by method, for each false-alarm rate."""
        return {
            name: [threshold_factor(pooled.largest, alarm, self.trials) for alarm in false_alarms]
            for name, pooled in self.methods.items()
        }


@dataclass(frozen=True)
class LimitPoint:
    """Best possible shares at one false-alarm rate."""

    false_alarm: float
    declared: float
    right: float


@dataclass(frozen=True)
class LimitTally(Tally):
    """Best possible shares declared, and declared with the right channel named, at each false-alarm rate."""

    declared: list[float]
    right: list[float]

    @classmethod
    def of(cls, limit: Limit, false_alarms: Sequence[float]) -> LimitTally:
        """Read a limit at some false-alarm rates."""
        best = [limit.at(alarm) for alarm in false_alarms]
        return cls([settled(declared) for declared, _ in best], [settled(right) for _, right in best])

    def points(self, false_alarms: Sequence[float]) -> list[LimitPoint]:
        """One point per false-alarm rate."""
        return [LimitPoint(*one) for one in zip(false_alarms, self.declared, self.right, strict=True)]


PreparationTally = SoundTally | LimitTally


def largest_ratios(ratio: Array, false_alarms: Sequence[float]) -> Largest:
    """Keep the ratios (N,) of one block that can decide a threshold: twice the share of alarms, and some more."""
    kept = int(2 * max(false_alarms) * len(ratio)) + 50
    return Largest(np.sort(ratio)[::-1][:kept].tolist())


def threshold_factor(largest: Sequence[float], alarm_probability: float, trials: int) -> float:
    """Ratio that the given share of trials reaches, from their largest ratios; at least the loose threshold, 1."""
    rank = round(alarm_probability * trials)
    ordered = np.sort(np.asarray(largest, dtype=np.float64))[::-1]
    if rank < 1 or rank > len(ordered):
        return 1.0 if rank >= 1 else float(ordered[0])
    return max(float(ordered[rank - 1]), 1.0)
