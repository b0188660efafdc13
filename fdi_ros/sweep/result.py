# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The figures of a sweep: shares with their intervals, delays, the smallest faults found; as JSON and CSV."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import IO, Any, NamedTuple

import numpy as np

from fdi_ros.scoring import Outcome, share
from fdi_ros.sweep.plan import Plan, Swept
from fdi_ros.sweep.sweep import MonitorResult, Trial

WANTED = 0.95
"""Share of the faults of a size that is to be found for the size to count as found."""
NOT_ORDERED = ("saturation",)
"""Kinds of which a larger size is no larger fault."""


class Delays(NamedTuple):
    """Quantiles of a delay over all trials, s; inf: fewer had it."""

    median: float
    p95: float


@dataclass(frozen=True)
class Line:
    """What came of one kind in one size, over channels and times."""

    swept: Swept
    counts: dict[str, int]
    """Trials by outcome."""
    named_after: Delays
    """Until the channel was declared by itself."""
    found_after: Delays
    """Until it was, or was one of a set."""

    @property
    def trials(self) -> int:
        """How many."""
        return sum(self.counts.values())

    @property
    def found(self) -> int:
        """Trials in which the channel was named, or in a set."""
        return self.counts[Outcome.ISOLATED] + self.counts[Outcome.AMBIGUOUS]

    @property
    def false(self) -> int:
        """Trials in which a channel without a fault was declared, or a set without the faulty one."""
        return self.counts[Outcome.FALSE_ISOLATION] + self.counts[Outcome.FALSE_GROUP]


def lines_of(tried: MonitorResult, plan: Plan, channel: int | None = None) -> list[Line]:
    """Sum up by kind and size, over all channels or of one."""
    own = [trial for trial in tried.trials if channel in (None, trial.channel)]
    return [_line(swept, [trial for trial in own if trial.swept == swept], plan.within) for swept in plan.faults]


def _line(swept: Swept, trials: Sequence[Trial], within: float) -> Line:
    counts = {str(outcome.value): sum(trial.scored.outcome is outcome for trial in trials) for outcome in Outcome}
    # A fault that went with a false isolation was not found in any useful way.
    good = [trial.scored for trial in trials if trial.scored.outcome in (Outcome.ISOLATED, Outcome.AMBIGUOUS)]
    named = [one.isolated_after for one in good if one.isolated_after <= within]
    found = [one.detected_after for one in good if one.detected_after <= within]
    return Line(swept, counts, _delays(named, len(trials)), _delays(found, len(trials)))


def _delays(delays: Sequence[float], trials: int) -> Delays:
    """Quantiles of the delays of all trials; those without a delay are beyond all others."""
    every = np.sort([*delays, *[math.inf] * (trials - len(delays))])
    if not trials:
        return Delays(math.nan, math.nan)
    return Delays(*(float(every[math.ceil(level * trials) - 1]) for level in (0.5, WANTED)))


def smallest(lines: Sequence[Line], named: bool) -> dict[str, float | None]:
    """For each kind with sizes: the smallest from which on this size and all larger ones are found, or named."""
    found: dict[str, float | None] = {}
    for family in dict.fromkeys(line.swept.family for line in lines):
        own = [line for line in lines if line.swept.family == family and line.swept.size is not None]
        if not own or own[0].swept.kind in NOT_ORDERED or not own[0].trials:
            continue
        found[family] = None
        for line in reversed(own):
            if (line.counts[Outcome.ISOLATED] if named else line.found) < WANTED * line.trials:
                break
            found[family] = line.swept.size
    return found


def sweep_figures(results: Sequence[MonitorResult], plan: Plan, bag: str) -> dict[str, Any]:
    """Return all figures of a sweep: what its JSON file holds."""
    monitors = [_monitor_figures(tried, plan) for tried in results]
    return {"bag": bag, "within_s": plan.within, "times": plan.times, "seed": plan.seed, "monitors": monitors}


def _monitor_figures(tried: MonitorResult, plan: Plan) -> dict[str, Any]:
    lines, sound = lines_of(tried, plan), tried.sound
    return {
        "name": tried.name,
        "detector": tried.config.detector.name,
        "refused": tried.refused,
        "without_fault": None
        if sound is None
        else {
            "duration_s": sound.duration,
            "judged": sound.judged,
            "declared": [
                {"at_s": round(at, 9), "channel": tried.channels[event.channel], "state": event.after.name}
                for at, event in sound.declared
            ],
            "episodes": [one.words for one in sound.story.episodes],
        },
        "times_s": tried.times,
        "times_left_out_s": tried.skipped,
        "smallest": {"named": smallest(lines, named=True), "found": smallest(lines, named=False)},
        "faults": list(map(_line_figures, lines)),
        "channels": {tried.channels[i]: list(map(_line_figures, lines_of(tried, plan, i))) for i in tried.used},
    }


def _line_figures(line: Line) -> dict[str, Any]:
    """Return what came of a fault beside its kind and numbers."""
    return {
        "kind": line.swept.kind,
        **{name: float(value) for name, value in line.swept.items},
        "faults": line.trials,
        "named": asdict(share(line.counts[Outcome.ISOLATED], line.trials)) if line.trials else None,
        "found": asdict(share(line.found, line.trials)) if line.trials else None,
        "outcomes": line.counts,
        "named_after_s": line.named_after._asdict(),
        "found_after_s": line.found_after._asdict(),
    }


def write_csv(file: IO[str], results: Iterable[MonitorResult], plan: Plan) -> None:
    """Write one line for every fault."""
    writer = csv.writer(file)
    head = ("monitor", "channel", "kind", "size", "fault", "at_s", "outcome", "named_after_s", "found_after_s")
    writer.writerow(head)
    for tried in results:
        for trial in tried.trials:
            size = "" if trial.fault.size is None else f"{trial.fault.size:g}"
            after = ["" if math.isinf(value) else f"{value:.6f}" for value in trial.scored[1:]]
            writer.writerow(
                (
                    *(tried.name, tried.channels[trial.channel], trial.swept.kind, size, trial.swept.words),
                    *(f"{trial.fault.start:.6f}", trial.scored.outcome.value, *after),
                )
            )
