# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The whole of a fleet: flights, hours, the rate of declarations, and what came of injected faults."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from fdi_ros.fleet.lines import Row, good
from fdi_ros.fleet.looks import Look, NotJudged, reasons
from fdi_ros.scoring.outcome import Outcome
from fdi_ros.scoring.tally import Estimate, share

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


FAULT_HEAD = ("fault", "injected", "isolated", "95 % interval", "in a set", "missed", "wrong", "median delay")
WRONG = (Outcome.FALSE_ISOLATION, Outcome.FALSE_GROUP)


def clustered_share(counts: Sequence[tuple[int, int]]) -> Estimate | None:
    """Share over flights with its 95 % interval; None: one flight says nothing of others.

    Faults in one flight are alike. As many independent ones as give the scatter between the flights take the place of
    all (Rao and Scott 1992) in Wilson's interval, with Student's quantile for that many flights. Where there is no
    scatter, as all or none of the faults are meant, each flight counts as one.

    Parameters
    ----------
    counts
        Of each flight: how many of how many.
    """
    from scipy.stats import t as student

    hits, trials, flights = sum(one[0] for one in counts), sum(one[1] for one in counts), len(counts)
    if flights < 2:
        return None
    p = hits / trials
    scatter = sum((count - p * number) ** 2 for count, number in counts) * flights / (flights - 1) / trials**2
    effect = max(1.0, scatter / (p * (1 - p) / trials)) if 0 < p < 1 else trials / flights
    return share(hits / effect, trials / effect, float(student.isf(0.025, flights - 1)))


def fault_rows(faults: Sequence[Row]) -> list[tuple[str, ...]]:
    """One row per fault: what came of it over the whole fleet."""
    kinds: dict[tuple[str, float, str], list[Row]] = {}
    for fault in faults:
        kinds.setdefault((fault["kind"], fault["size"] or 0.0, fault["fault"]), []).append(fault)
    rows: list[tuple[str, ...]] = []
    for (_, _, words), own in sorted(kinds.items()):
        flights: dict[str, list[Row]] = {}
        for fault in own:
            flights.setdefault(fault["flight"], []).append(fault)
        isolated = clustered_share([(_count(faults, Outcome.ISOLATED), len(faults)) for faults in flights.values()])
        delays = sorted(fault["named_after"] for fault in own if fault["outcome"] == Outcome.ISOLATED)
        wrong = sum(_count(faults, *WRONG) > 0 for faults in flights.values())
        rows.append(
            (
                words,
                str(len(own)),
                f"{_count(own, Outcome.ISOLATED) / len(own):.1%}",
                "one flight" if isolated is None else f"{isolated.low:.1%} to {isolated.high:.1%}",
                f"{_count(own, Outcome.AMBIGUOUS) / len(own):.1%}",
                f"{_count(own, Outcome.MISSED) / len(own):.1%}",
                f"{_count(own, *WRONG)}, in {wrong} of {len(flights)} flights",
                f"{delays[len(delays) // 2]:.2f} s" if delays else "-",
            )
        )
    return rows


def _count(faults: Sequence[Row], *outcomes: str) -> int:
    return sum(fault["outcome"] in outcomes for fault in faults)
