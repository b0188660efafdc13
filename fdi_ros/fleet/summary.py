# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The whole of a fleet: flights, hours, and the rate of declarations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from fdi_ros.fleet.lines import Row, good
from fdi_ros.fleet.looks import Look, NotJudged, reasons

_TOLD = ("path", "date", "state", "who", "channels", "axes", "start", "end", "size", "size_std", "course", "words")
"""Columns of an episode that are told of the whole."""


@dataclass(frozen=True)
class Rate:
    """Events per hour, with the exact 95 % interval of a Poisson process (Garwood 1936)."""

    count: int
    hours: float

    @property
    def value(self) -> float:
        """Per hour; NaN of no time."""
        return self.count / self.hours if self.hours > 0 else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """Per hour."""
        from scipy.stats import chi2

        if not self.hours > 0:
            return 0.0, math.inf
        low = float(chi2.ppf(0.025, 2 * self.count)) / 2 if self.count else 0.0
        return low / self.hours, float(chi2.ppf(0.975, 2 * self.count + 2)) / 2 / self.hours

    def __str__(self) -> str:
        if not self.hours > 0:
            return "nothing was judged"
        low, high = self.interval
        return f"{self.value:.3g} per hour (95 %: {low:.2g} to {high:.2g})"


@dataclass(frozen=True)
class Totals:
    """The whole fleet."""

    flights: int
    failed: int
    vehicles: int
    hours: float
    """Judged."""
    declaring: int
    """Flights in which something was declared."""
    declarations: Rate
    """Episodes (a set, and then the name of the channel, are one), in the time that nothing stood declared."""
    unmeasured: int
    """Flights of which mounts and axes are what `fdi inspect` assumes."""


def totals(flights: Sequence[Row]) -> Totals:
    """Sum up."""
    judged = good(flights)
    hours = sum(row["judged_time"] for row in judged) / 3600.0
    return Totals(
        len(flights),
        len(flights) - len(judged),
        len({row["vehicle"] for row in flights}),
        hours,
        sum(row["declared"] > 0 for row in judged),
        Rate(sum(row["episodes"] for row in judged), sum(row["watched"] for row in judged) / 3600.0),
        sum(not row["measured"] for row in judged),
    )


def fleet_figures(
    whole: Totals, looks: Sequence[Look], failed: Sequence[NotJudged], episodes: Sequence[Row], unread: Sequence[str]
) -> dict[str, Any]:
    """Figures of the whole by name, for JSON; rows of flights are in the dataset."""
    rate = whole.declarations
    return {
        "flights": whole.flights,
        "failed": whole.failed,
        "vehicles": whole.vehicles,
        "hours": whole.hours,
        "flights_with_declarations": whole.declaring,
        "unmeasured": whole.unmeasured,
        "declarations": {"count": rate.count, "per_hour": rate.value, "interval": list(rate.interval)},
        "not_searched": list(unread),
        "not_judged": [{"why": one.why, "paths": list(one.paths)} for one in failed],
        "reasons": {kind: len(rows) for kind, rows in reasons(looks)},
        "to_look_at": [{"path": look.row["path"], "date": look.row["date"], "why": list(look.why)} for look in looks],
        "episodes": [{name: one[name] for name in _TOLD} for one in episodes],
    }
