"""The figures of a sweep: shares with their intervals, delays, the smallest faults found; for tables, JSON and CSV."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import IO, NamedTuple

import numpy as np

from fdi_ros.experiments.tally import share
from fdi_ros.report.text_table import table
from fdi_ros.sweep.plan import Plan, Swept
from fdi_ros.sweep.sweep import MonitorResult
from fdi_ros.sweep.trial import Trial

WANTED = 0.95
"""Share of the faults of a size that is to be found for the size to count as found."""
WORDS = ("named", "in a set", "silent", "false set", "wrong")
MOVES = 0.1
"""Rate that a vehicle which is not at rest reaches while a fault is watched, rad/s."""
NOT_ORDERED = ("saturation",)
"""Kinds of which a larger size is no larger fault."""


class Delays(NamedTuple):
    """Quantiles of a delay over all trials, s; inf: fewer had it."""

    median: float
    p95: float

    def as_json(self) -> dict[str, float]:
        """Return them by name."""
        return self._asdict()


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
        return self.counts["named"] + self.counts["in a set"]

    @property
    def false(self) -> int:
        """Trials in which a channel without a fault was declared, or a set without the faulty one."""
        return self.counts["wrong"] + self.counts["false set"]

    def as_json(self) -> dict[str, object]:
        """Return the figures beside kind and numbers of the fault."""
        return {
            **self.swept.as_json(),
            "faults": self.trials,
            "named": share(self.counts["named"], self.trials) if self.trials else None,
            "found": share(self.found, self.trials) if self.trials else None,
            "outcomes": self.counts,
            "named_after_s": self.named_after,
            "found_after_s": self.found_after,
        }


def lines_of(tried: MonitorResult, plan: Plan, channel: int | None = None) -> list[Line]:
    """Sum up by kind and size, over all channels or of one."""
    own = [trial for trial in tried.trials if channel in (None, trial.channel)]
    return [_line(swept, [trial for trial in own if trial.swept == swept], plan.within) for swept in plan.faults]


def _line(swept: Swept, trials: Sequence[Trial], within: float) -> Line:
    counts = {words: sum(trial.outcome.words == words for trial in trials) for words in WORDS}
    # A fault that went with a false name was not found in any useful way.
    good = [trial.outcome for trial in trials if trial.outcome.words in ("named", "in a set")]
    named = [one.named_after for one in good if one.named_after <= within]
    found = [one.found_after for one in good if one.found_after <= within]
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
            if (line.counts["named"] if named else line.found) < WANTED * line.trials:
                break
            found[family] = line.swept.size
    return found


def smallest_hint(plan: Plan) -> str:
    """Say what the smallest sizes are, and the figures in brackets."""
    return (
        f"smallest size of which, and of all larger ones, {WANTED:.0%} of the faults tried were found within"
        f" {plan.within:g} s; in brackets how many of that size, and the 95 % interval of their share"
    )


HEAD = ("fault", "faults", "named", "95 % interval", "found", "false", "nothing said", "median delay", "95 %")


def rows_of(lines: Sequence[Line]) -> list[tuple[str, ...]]:
    """One row per kind and size."""
    rows: list[tuple[str, ...]] = []
    for line in lines:
        if not line.trials:
            rows.append((line.swept.words, "0", *("-",) * 7))
            continue
        named = share(line.counts["named"], line.trials)
        rows.append(
            (
                line.swept.words,
                str(line.trials),
                f"{named.value:.0%}",
                f"{named.low:.0%} to {named.high:.0%}",
                f"{line.found / line.trials:.0%}",
                str(line.false),
                f"{line.counts['silent'] / line.trials:.0%}",
                *(seconds(value) for value in line.found_after),
            )
        )
    return rows


def seconds(value: float) -> str:
    """Write a delay; a dash where there is none."""
    return f"{value:.2f} s" if math.isfinite(value) else "-"


def sound_lines(tried: MonitorResult) -> list[str]:
    """Say what the monitor makes of the recording without a fault, and what follows for the rest."""
    sound = tried.sound
    if sound is None or tried.refused:
        return [f"not tried: {tried.refused}"]
    lines = []
    if not sound.declared:
        words = f"nothing was declared in {sound.duration:.1f} s, {sound.judged:.0%} of the samples judged"
        lines.append(f"{words}, from {sound.begins:.1f} s on")
    else:
        names = [tried.channels[i] for i in sorted({event.channel for _, event in sound.declared})]
        lines.append(
            f"declared, though no fault was injected: {', '.join(names)}, first at {sound.declared[0][0]:.1f} s."
            " Either the recording holds a fault, or the config does not fit it: what follows is in doubt"
        )
    if tried.skipped:
        at = ", ".join(f"{time:.1f} s" for time in tried.skipped)
        lines.append(
            f"no fault was injected at {at}: something stands declared then without one, or a channel gives nothing"
        )
    if not tried.times:
        lines.append("so no fault could be tried at all: mend the config, or name the channel in excluded_channels")
    lines += [f"without a fault, {line}" for line in sound.degraded]
    if tried.config.excluded_channels:
        lines.append(f"not tried, as excluded: {', '.join(tried.config.excluded_channels)}")
    return lines


def verdict_lines(tried: MonitorResult, plan: Plan) -> list[str]:
    """Give the smallest size of each kind that is found."""
    lines = lines_of(tried, plan)
    if not tried.trials:
        return []
    named, found = smallest(lines, True), smallest(lines, False)
    words = []
    for family in named:
        largest = [line for line in lines if line.swept.family == family][-1]
        by_size = {line.swept.size: line for line in lines if line.swept.family == family}
        seen, known = by_size.get(found[family], largest), by_size.get(named[family], largest)
        words.append(
            f"{family}: named or in a set {_from(seen, found[family], seen.found)};"
            f" named {_from(known, named[family], known.counts['named'])}"
        )
    words += [
        f"{line.swept.words}: named or in a set in {line.found / line.trials:.0%};"
        f" named in {line.counts['named'] / line.trials:.0%}"
        for line in lines
        if line.swept.size is None
    ]
    false = sum(line.false for line in lines)
    words.append(f"false name, or a set without the faulty channel: {false} of {len(tried.trials)} faults")
    return [*words, _motion(tried)]


def _motion(tried: MonitorResult) -> str:
    """Say how much of it is of a vehicle that turns: at rest small faults are found that are lost in flight."""
    moving, times = sum(largest > MOVES for _, largest in tried.speeds), len(tried.times)
    words = f"the vehicle turned faster than {MOVES:g} rad/s at {moving} of {times} times"
    if 2 * moving >= times:
        return words
    return f"{words}: these figures are mostly of a vehicle AT REST, in flight they will be worse (--start, --end)"


def _from(line: Line, size: float | None, count: int) -> str:
    """Say from what size on, and of how many faults that is known: of a few, the share is far from certain."""
    swept, interval = line.swept, share(count, line.trials)
    of = f"{count} of {line.trials}, {interval.low:.0%} to {interval.high:.0%}"
    if size is None:
        return f"from no size tried ({of}, at {f'{swept.size:g} {swept.unit}'.rstrip()})"
    return f"{f'from {size:g} {swept.unit}'.rstrip()} ({of})"


def side_by_side(results: Sequence[MonitorResult], plan: Plan) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Head and rows of a table of all monitors: share named, share found, median delay until found."""
    tried = [one for one in results if one.trials]
    columns = [lines_of(one, plan) for one in tried]
    rows = [(swept.words, *(_in_short(lines[k]) for lines in columns)) for k, swept in enumerate(plan.faults)]
    return ("fault", *(one.name for one in tried)), rows


SHORT_HINT = "named / named or in a set, median delay until then; ! and a number: faults with a false name or set"


def _in_short(line: Line) -> str:
    words = f"{line.counts['named'] / line.trials:.0%} / {line.found / line.trials:.0%}, {seconds(line.found_after[0])}"
    return f"{words} !{line.false}" if line.false else words


def sweep_text(results: Sequence[MonitorResult], plan: Plan, bag: str) -> str:
    """Everything, for a terminal."""
    count = sum(len(tried.trials) for tried in results)
    parts = [f"{bag}: {count} faults, one at a time, each watched for {plan.within:g} s"]
    for tried in results:
        parts += ["", f"{tried.name}, without a fault:", *(f"  {line}" for line in sound_lines(tried))]
    if sum(bool(tried.trials) for tried in results) > 1:
        parts += ["", f"side by side: {SHORT_HINT}", *(f"  {line}" for line in table(*side_by_side(results, plan)))]
    for tried in results:
        if not tried.trials:
            continue
        at = ", ".join(f"{time:.1f}" for time in tried.times)
        parts += ["", f"{tried.name}, faults from {at} s on each of {len(tried.used)} channels:"]
        if len(results) == 1:
            parts += [f"  {line}" for line in table(HEAD, rows_of(lines_of(tried, plan)))]
        parts += [f"{smallest_hint(plan)}:"]
        parts += [f"  {line}" for line in verdict_lines(tried, plan)]
    parts += ["", *(f"note: {line}" for line in HINTS)]
    return "\n".join(line.rstrip() for line in parts) + "\n"


HINTS = (
    "named: the faulty channel was declared by itself; found: that, or one of a set with others",
    "delays are until it was found, of all faults: a dash where fewer than half, or than 95 %, were found",
    "a stuck value or a scale factor shows only while the vehicle turns, noise mostly as a warning",
    "this is of one recording: another flight, with other vibration, may need larger faults",
)


@dataclass(frozen=True)
class Declared:
    """A declaration without a fault."""

    at_s: float
    channel: str
    state: str


@dataclass(frozen=True)
class WithoutFault:
    """What the monitor makes of the recording as it is."""

    duration_s: float
    judged: float
    """Share of the samples."""
    declared: list[Declared]


@dataclass(frozen=True)
class Smallest:
    """For each kind with sizes: the smallest that is named, and found."""

    named: dict[str, float | None]
    found: dict[str, float | None]


@dataclass(frozen=True)
class MonitorFigures:
    """All figures of one monitor."""

    name: str
    detector: str
    refused: str
    without_fault: WithoutFault | None
    times_s: Sequence[float]
    times_left_out_s: Sequence[float]
    smallest: Smallest
    faults: list[Line]
    channels: dict[str, list[Line]]

    @classmethod
    def of(cls, tried: MonitorResult, plan: Plan) -> MonitorFigures:
        """Sum up what came of all faults."""
        lines = lines_of(tried, plan)
        return cls(
            tried.name,
            tried.config.detector.name,
            tried.refused,
            _without_fault(tried),
            tried.times,
            tried.skipped,
            Smallest(smallest(lines, True), smallest(lines, False)),
            lines,
            {tried.channels[i]: lines_of(tried, plan, i) for i in tried.used},
        )


@dataclass(frozen=True)
class SweepFigures:
    """All figures of a sweep: what its JSON file holds."""

    bag: str
    within_s: float
    times: int
    seed: int
    monitors: list[MonitorFigures]

    @classmethod
    def of(cls, results: Sequence[MonitorResult], plan: Plan, bag: str) -> SweepFigures:
        """Sum up every monitor."""
        return cls(bag, plan.within, plan.times, plan.seed, [MonitorFigures.of(tried, plan) for tried in results])


def _without_fault(tried: MonitorResult) -> WithoutFault | None:
    if tried.sound is None:
        return None
    declared = [
        Declared(round(at, 9), tried.channels[event.channel], event.after.name) for at, event in tried.sound.declared
    ]
    return WithoutFault(tried.sound.duration, tried.sound.judged, declared)


def write_csv(file: IO[str], results: Iterable[MonitorResult], plan: Plan) -> None:
    """Write one line for every fault."""
    writer = csv.writer(file)
    head = ("monitor", "channel", "kind", "size", "fault", "at_s", "outcome", "named_after_s", "found_after_s")
    writer.writerow(head)
    for tried in results:
        for trial in tried.trials:
            size = "" if trial.fault.size is None else f"{trial.fault.size:g}"
            after = ["" if math.isinf(value) else f"{value:.6f}" for value in trial.outcome[1:]]
            writer.writerow(
                (
                    *(tried.name, tried.channels[trial.channel], trial.swept.kind, size, trial.swept.words),
                    *(f"{trial.fault.start:.6f}", trial.outcome.words, *after),
                )
            )
