# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Results of a sweep: JSON, CSV, tables for a terminal, and a page."""

from __future__ import annotations

import csv
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import IO, Any, NamedTuple

import numpy as np

from fdi_ros.replay.episodes import episode_words
from fdi_ros.replay.outcomes import Estimate, OutcomeKind, share
from fdi_ros.replay.sweep import Baseline, Plan, Subject, Swept
from fdi_ros.report.layout import (
    PALETTE,
    Columns,
    Figure,
    Section,
    head_and_rows,
    number,
    page,
    section_text,
)
from fdi_ros.system.text import percent

WANTED = 0.95
"""Share of the faults of a size that must be found for the size to count as found."""
NOT_ORDERED = ("saturation",)
"""Kinds whose faults do not grow with their size."""


class Delays(NamedTuple):
    """Quantiles of a delay over all trials, s. Infinite: fewer trials have a delay."""

    #: half of all trials have at most this delay, s
    median: float
    #: 95 % of all trials have at most this delay, s
    p95: float


@dataclass(frozen=True)
class Line:
    """Results for one kind and size, over channels and times."""

    #: kind and size of the fault
    swept: Swept
    #: number of trials
    trials: int
    counts: dict[str, int]
    """Number of trials by outcome."""
    named_after: Delays
    """Delay to the isolation."""
    found_after: Delays
    """Delay to the detection."""

    def count(self, named: bool) -> int:
        """Return the number of isolations, or of detections if not ``named``."""
        return self.counts[OutcomeKind.ISOLATED] + (
            0 if named else self.counts[OutcomeKind.AMBIGUOUS]
        )

    @property
    def isolated(self) -> Estimate:
        """Share of the trials with an isolation."""
        return share(self.count(named=True), self.trials)

    @property
    def detected(self) -> Estimate:
        """Share of the trials with a detection."""
        return share(self.count(named=False), self.trials)

    @property
    def false(self) -> int:
        """Number of trials with a wrong declaration."""
        return (
            self.counts[OutcomeKind.FALSE_ISOLATION]
            + self.counts[OutcomeKind.FALSE_GROUP]
        )


def lines_of(tried: Subject, plan: Plan, channel: int | None = None) -> list[Line]:
    """Sum up by kind and size, over all channels or for one."""
    lines = []
    for swept in plan.faults:
        struck = tried.struck(swept)
        if not struck or (channel is not None and channel not in struck):
            continue
        scored = [
            one.scored
            for one in tried.trials
            if one.swept == swept and channel in (None, one.channel)
        ]
        counts = {
            str(kind.value): sum(one.outcome is kind for one in scored)
            for kind in OutcomeKind
        }
        # A fault with a wrong isolation does not count as found.
        good = [
            one
            for one in scored
            if one.outcome in (OutcomeKind.ISOLATED, OutcomeKind.AMBIGUOUS)
        ]
        named = [one.isolated_after for one in good]
        found = [one.detected_after for one in good]
        delays = (
            _quantiles(after, len(scored), plan.within) for after in (named, found)
        )
        lines.append(Line(swept, len(scored), counts, *delays))
    return lines


def _quantiles(delays: Sequence[float], trials: int, within: float) -> Delays:
    """Return quantiles of the delays. Trials without a delay in time count as infinite."""
    if not trials:
        return Delays(math.nan, math.nan)
    known = sorted(delay for delay in delays if delay <= within)
    every = [*known, *[math.inf] * (trials - len(known))]
    ranks = [math.ceil(level * trials) for level in (0.5, WANTED)]
    return Delays(*(every[rank - 1] for rank in ranks))


def smallest(lines: Sequence[Line], named: bool) -> dict[str, float | None]:
    """Return for each kind the smallest size from which on all sizes are found, or isolated."""
    families = _families(lines)
    found = {family: _smallest(own, named) for family, own in families.items()}
    return {
        family: None if line is None else line.swept.size
        for family, line in found.items()
    }


def _families(lines: Sequence[Line]) -> dict[str, list[Line]]:
    """Return the lines of each kind whose faults grow with their size, in the order of size."""
    families: dict[str, list[Line]] = {}
    for line in lines:
        if (
            line.swept.size is not None
            and line.swept.kind not in NOT_ORDERED
            and line.trials
        ):
            families.setdefault(line.swept.family, []).append(line)
    return families


def _smallest(lines: Sequence[Line], named: bool) -> Line | None:
    found = None
    for line in reversed(lines):
        if line.count(named) < WANTED * line.trials:
            break
        found = line
    return found


def sweep_figures(results: Sequence[Subject], plan: Plan, bag: str) -> dict[str, Any]:
    """Return all figures of a sweep, for the JSON file."""
    monitors = [_monitor_figures(tried, plan) for tried in results]
    return {
        "bag": bag,
        "within_s": plan.within,
        "times": plan.times,
        "seed": plan.seed,
        "monitors": monitors,
    }


def _monitor_figures(tried: Subject, plan: Plan) -> dict[str, Any]:
    lines = lines_of(tried, plan)
    baseline = tried.baseline
    return {
        "name": tried.name,
        "detector": tried.config.detector.name,
        "refused": tried.refused,
        "without_fault": None
        if baseline is None
        else {
            "duration_s": baseline.duration,
            "judged": baseline.judged,
            "declared": declared_figures(baseline),
            "episodes": [one.words for one in baseline.judgement.story.episodes],
        },
        "times_s": tried.times,
        "times_left_out_s": tried.skipped,
        "smallest": {
            "named": smallest(lines, named=True),
            "found": smallest(lines, named=False),
        },
        "faults": list(map(_line_figures, lines)),
        "channels": {
            tried.channels[i]: list(map(_line_figures, lines_of(tried, plan, i)))
            for i in tried.used
        },
    }


def declared_figures(baseline: Baseline | None) -> list[dict[str, object]]:
    """Return the declarations without injected faults."""
    declared = [] if baseline is None else baseline.declared
    return [
        {"at_s": one.at_s, "channel": one.channel, "state": one.state}
        for one in declared
    ]


def _line_figures(line: Line) -> dict[str, Any]:
    """Return the results for a fault."""
    return {
        "kind": line.swept.kind,
        "channels": line.swept.channels,
        **{name: float(value) for name, value in line.swept.items},
        "faults": line.trials,
        "named": asdict(line.isolated) if line.trials else None,
        "found": asdict(line.detected) if line.trials else None,
        "outcomes": line.counts,
        "named_after_s": line.named_after._asdict(),
        "found_after_s": line.found_after._asdict(),
    }


def write_csv(file: IO[str], results: Iterable[Subject], plan: Plan) -> None:
    """Write one line for every fault."""
    writer = csv.writer(file)
    head = (
        "monitor",
        "channel",
        "kind",
        "size",
        "fault",
        "at_s",
        "outcome",
        "named_after_s",
        "found_after_s",
    )
    writer.writerow(head)
    for tried in results:
        for trial in tried.trials:
            size = "" if trial.fault.size is None else f"{trial.fault.size:g}"
            what = (
                tried.name,
                tried.channels[trial.channel],
                trial.swept.kind,
                size,
                trial.swept.words,
            )
            after = [
                "" if math.isinf(value) else f"{value:.6f}"
                for value in trial.scored[1:]
            ]
            writer.writerow(
                (*what, f"{trial.fault.start:.6f}", trial.scored.outcome.value, *after)
            )


# Words and tables


MOVING_RAD_S = 0.1
"""Largest rate during a fault from which on the vehicle counts as moving, rad/s."""


def smallest_hint(plan: Plan) -> str:
    """Explain the smallest sizes and the figures in brackets."""
    return (
        f"From this size on, at least {percent(WANTED)} of the faults were detected (or isolated) within"
        f" {plan.within:g} s. In brackets: how many of those tried, and the 95 % interval of the share."
    )


def figures_section(tried: Subject, plan: Plan) -> Section:
    """Lay out one row per kind and size."""
    columns: Columns = {
        "fault": lambda line: line.swept.words,
        "faults": lambda line: str(line.trials),
        "isolated": lambda line: percent(line.isolated.value),
        "95 % interval": lambda line: (
            f"{percent(line.isolated.low)} to {percent(line.isolated.high)}"
            if line.trials
            else "-"
        ),
        "detected": lambda line: percent(line.detected.value),
        "false": lambda line: str(line.false) if line.trials else "-",
        "missed": lambda line: percent(
            share(line.counts[OutcomeKind.MISSED], line.trials).value
        ),
        "median delay": lambda line: number(line.found_after.median, ".2f", " s"),
        "95 %": lambda line: number(line.found_after.p95, ".2f", " s"),
    }
    at = ", ".join(f"{time:.1f}" for time in tried.times)
    title = f"{tried.name}, faults from {at} s on each of {len(tried.used)} channels"
    return Section(title, "", head_and_rows(columns, lines_of(tried, plan)))


def sound_lines(tried: Subject) -> list[str]:
    """Describe the result without injected faults, and its consequences."""
    baseline = tried.baseline
    if baseline is None or tried.refused:
        return [f"not tried: {tried.refused}"]
    words = f"nothing was declared in {baseline.duration:.1f} s"
    lines = [
        f"{words} ({percent(baseline.judged)} of the samples judged, from {baseline.begins:.1f} s on)"
    ]
    if told := baseline.judgement.story.declared:
        more = (
            f", and {len(told) - 1} more episode{'s' if len(told) > 2 else ''}"
            if len(told) > 1
            else ""
        )
        doubt = "The recording contains a fault, or the config does not fit: the figures below are unreliable"
        lines = [f"declared: {episode_words(told[0])}{more}. {doubt}"]
    if tried.skipped:
        at = ", ".join(f"{time:.1f} s" for time in tried.skipped)
        why = "a channel is already declared there, or gives no data"
        lines.append(f"no fault was injected at {at}: {why}")
    if not tried.times:
        lines.append(
            "no fault could be injected at all: correct the config, or name the channel in excluded_channels"
        )
    lines += [
        f"without injected faults, {line}"
        for line in baseline.judgement.monitor.degraded
    ]
    if tried.config.excluded_channels:
        lines.append(
            f"not tried, because excluded: {', '.join(tried.config.excluded_channels)}"
        )
    return lines


def verdict_lines(tried: Subject, plan: Plan) -> list[str]:
    """Return the smallest size of each kind that is found, in words."""
    if not tried.trials:
        return []
    lines = lines_of(tried, plan)
    words = []
    for family, own in _families(lines).items():
        words.append(
            f"{family}: detected {_from(own, named=False)}; isolated {_from(own, named=True)}"
        )
    for line in [line for line in lines if line.swept.size is None]:
        shares = f"detected in {percent(line.detected.value)}; isolated in {percent(line.isolated.value)}"
        words.append(f"{line.swept.words}: {shares}")
    false = sum(line.false for line in lines)
    words.append(
        "wrong declaration (a healthy channel, or a set without the faulty one):"
        f" {false} of {len(tried.trials)} faults"
    )
    # At rest smaller faults are found than in flight.
    moving = sum(speed > MOVING_RAD_S for speed in tried.speeds)
    times = len(tried.times)
    motion = f"the vehicle turned faster than {MOVING_RAD_S:g} rad/s at {moving} of the {times} start times"
    rest = ": the vehicle was mostly AT REST; in flight the figures are worse (choose a part with --start, --end)"
    return [*words, motion if 2 * moving >= times else motion + rest]


def _from(lines: Sequence[Line], named: bool) -> str:
    """Return the smallest size that is found, with the interval of its share."""
    found = _smallest(lines, named)
    line = found or lines[-1]
    count = line.count(named)
    size = f"{line.swept.size:g} {line.swept.unit}".rstrip()
    interval = share(count, line.trials)
    span = f"{percent(interval.low)} to {percent(interval.high)}"
    of = f"({count} of {line.trials}, {span})"
    return (
        f"from {size} {of}"
        if found
        else f"less often, even at {size}, the largest size tried {of}"
    )


SHORT_HINT = "isolated / detected, median delay until detected; ! and a number: faults with a wrong declaration"


def _in_short(line: Line) -> str:
    shares = f"{percent(line.isolated.value)} / {percent(line.detected.value)}"
    words = f"{shares}, {number(line.found_after[0], '.2f', ' s')}"
    return f"{words} !{line.false}" if line.false else words


HINTS = [
    "isolated: only the faulty channel was declared; detected: isolated, or declared in a set with others",
    "delay: from the start of a fault to its detection; a dash: fewer than half (last column: 95 %) were detected",
    "a stuck value or a scale error shows only while the vehicle turns; noise is reported, but mostly not declared",
    "these figures hold for this recording: a flight with more vibration may need larger faults",
]


def sweep_text(results: Sequence[Subject], plan: Plan, bag: str) -> str:
    """Return all results for a terminal."""
    tried = [one for one in results if one.trials]
    count = sum(len(one.trials) for one in tried)
    sections = _as_they_are(results, plan)
    sections += [figures_section(one, plan) for one in tried if len(results) == 1]
    hint = smallest_hint(plan)
    sections += [
        Section(f"{one.name}, smallest faults", hint, verdict_lines(one, plan))
        for one in tried
    ]
    sections.append(Section("Notes", "", HINTS))
    head = f"{bag}: {count} faults, one at a time, each watched for {plan.within:g} s\n"
    return "\n".join([head, *map(section_text, sections)])


def _as_they_are(results: Sequence[Subject], plan: Plan) -> list[Section]:
    """Lay out each monitor without faults, and all side by side with faults."""
    sections = [
        Section(f"{one.name}, without injected faults", "", sound_lines(one))
        for one in results
    ]
    lines = {
        one.name: {line.swept: line for line in lines_of(one, plan)}
        for one in results
        if one.trials
    }
    if len(lines) > 1:
        rows = [
            (
                swept.words,
                *(
                    _in_short(own[swept]) if swept in own else "-"
                    for own in lines.values()
                ),
            )
            for swept in plan.faults
            if any(swept in own for own in lines.values())
        ]
        sections.append(Section("Side by side", SHORT_HINT, (("fault", *lines), rows)))
    return sections


# The page


LEAST_SIZES = 3
"""Smallest number of sizes of a kind for a curve."""
Curve = tuple[
    str, str, Callable[[Line], float]
]  # name, dash and values of a line of a plot


def sweep_page(
    results: Sequence[Subject], plan: Plan, bag: str, about: Mapping[str, str]
) -> str:
    """Lay out the page of a sweep."""
    tried = [one for one in results if one.trials]
    sections = [*_as_they_are(results, plan), *_curves(tried, plan)]
    for one in tried:
        sections += [*_maps(one, plan), figures_section(one, plan)]
    sections += [Section("Notes", "", HINTS), Section("What was run", "", about)]
    return page(f"fdi_ros: faults detected in {bag}", _summary(results, plan), sections)


def _summary(results: Sequence[Subject], plan: Plan) -> list[str]:
    lines = []
    for one in results:
        before = f"{one.name}: " if len(results) > 1 else ""
        lines += [
            f"{before}without injected faults, {line}." for line in sound_lines(one)[:1]
        ]
        verdict = verdict_lines(one, plan)
        # With several monitors the table side by side has these figures.
        shown_ones = verdict if len(results) == 1 else [*verdict[:1], *verdict[-2:]]
        lines += [f"{before}{line}." for line in shown_ones]
    return [*lines[:1], smallest_hint(plan), *lines[1:]]


def _curves(tried: Sequence[Subject], plan: Plan) -> list[Section]:
    """Draw shares and delays of each kind with several sizes."""
    shares: list[Curve] = [
        ("isolated", "solid", lambda line: 100 * line.isolated.value),
        ("detected", "dash", lambda line: 100 * line.detected.value),
    ]
    if len(tried) == 1:
        shares.append(("95 %, low", "dot", lambda line: 100 * line.isolated.low))
        shares.append(("95 %, high", "dot", lambda line: 100 * line.isolated.high))
    delays: list[Curve] = [
        ("median", "solid", lambda line: line.found_after.median),
        ("95 %", "dash", lambda line: line.found_after.p95),
    ]
    families = Counter(swept.family for swept in plan.faults)
    sections = []
    for family in [
        name for name, sizes in families.items() if sizes >= LEAST_SIZES and tried
    ]:
        every = {
            one.name: [
                line for line in lines_of(one, plan) if line.swept.family == family
            ]
            for one in tried
        }
        # A recording without accelerometers has no trial of their faults.
        own = {name: lines for name, lines in every.items() if lines}
        if not own:
            continue
        hint = "Solid: isolated; dashed: detected; dotted: 95 % interval of the share isolated (Wilson 1927)."
        axis = {"title": {"text": "share of the faults, %"}, "range": [-3, 103]}
        sections.append(
            Section(f"{family}: share detected", hint, "", [_figure(own, shares, axis)])
        )
        if any(
            np.isfinite(line.found_after.median)
            for lines in own.values()
            for line in lines
        ):
            hint = "Until it was detected; solid: half of all faults were, dashed: 95 %. No point: fewer were."
            figure = _figure(
                own, delays, {"title": {"text": "delay, s"}, "type": "log"}
            )
            sections.append(Section(f"{family}: delay", hint, "", [figure]))
    return sections


def _figure(
    monitors: Mapping[str, Sequence[Line]],
    curves: Sequence[Curve],
    yaxis: dict[str, Any],
) -> Figure:
    """Draw the curves of each monitor over the size of the faults."""
    alone = len(monitors) == 1
    unit = next(iter(monitors.values()))[0].swept.unit
    data = [
        {
            "type": "scatter",
            "mode": "lines" if dash == "dot" else "lines+markers",
            "name": words if alone else name,
            "x": [line.swept.size for line in lines],
            "y": [round(y, 4) if np.isfinite(y) else None for y in map(value, lines)],
            "line": {"color": PALETTE[k % len(PALETTE)], "dash": dash},
            "showlegend": alone or dash == "solid",
        }
        for k, (name, lines) in enumerate(monitors.items())
        for words, dash, value in curves
    ]
    xaxis = {"type": "log", "title": {"text": f"size, {unit}" if unit else "size"}}
    return {"data": data, "layout": {"xaxis": xaxis, "yaxis": yaxis, "height": 360}}


def _maps(one: Subject, plan: Plan) -> list[Section]:
    """Draw the share detected by channel and fault, for gyros and for accelerometers."""
    hint = "Share of the faults that were detected, by channel and fault: isolated, or one of a set."
    halves = {
        "every channel": [i for i in one.used if i < one.gyros],
        "every accelerometer": [i for i in one.used if i >= one.gyros],
    }
    sections = []
    for title, channels in halves.items():
        rows = [lines_of(one, plan, channel) for channel in channels]
        if not rows or not rows[0]:
            continue
        heat = {
            "type": "heatmap",
            "z": [[round(line.detected.value, 2) for line in lines] for lines in rows],
            "x": [line.swept.words for line in rows[0]],
            "y": [one.channels[channel] for channel in channels],
        }
        figure = {"data": [heat], "layout": {}}
        sections.append(Section(f"{one.name}, {title}", hint, "", [figure]))
    return sections
