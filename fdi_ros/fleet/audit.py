# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What came of the faults that were injected into a fleet: shares with intervals."""

from __future__ import annotations

from collections.abc import Sequence

from fdi_ros.experiments.tally import Estimate, share
from fdi_ros.fleet.lines import Row

FAULT_HEAD = ("fault", "injected", "named", "95 % interval", "in a set", "silent", "wrong", "median delay")
OUTCOMES = ("named", "in a set", "silent", "false set", "wrong")


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
        count = {outcome: sum(fault["outcome"] == outcome for fault in own) for outcome in OUTCOMES}
        flights: dict[str, list[Row]] = {}
        for fault in own:
            flights.setdefault(fault["flight"], []).append(fault)
        named = clustered_share([(_count(faults, "named"), len(faults)) for faults in flights.values()])
        delays = sorted(fault["named_after"] for fault in own if fault["outcome"] == "named")
        wrong = sum(_count(faults, "wrong", "false set") > 0 for faults in flights.values())
        rows.append(
            (
                words,
                str(len(own)),
                f"{count['named'] / len(own):.1%}",
                "one flight" if named is None else f"{named.low:.1%} to {named.high:.1%}",
                f"{count['in a set'] / len(own):.1%}",
                f"{count['silent'] / len(own):.1%}",
                f"{count['wrong'] + count['false set']}, in {wrong} of {len(flights)} flights",
                f"{delays[len(delays) // 2]:.2f} s" if delays else "-",
            )
        )
    return rows


def _count(faults: Sequence[Row], *outcomes: str) -> int:
    return sum(fault["outcome"] in outcomes for fault in faults)
