# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A sweep in words: rows of its tables, sentences on each monitor, and the whole for a terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence

from fdi_ros.episodes.words import episode_words
from fdi_ros.report.text_table import table
from fdi_ros.scoring.outcome import Outcome
from fdi_ros.scoring.tally import share
from fdi_ros.sweep.plan import Plan
from fdi_ros.sweep.result import WANTED, Line, lines_of, smallest
from fdi_ros.sweep.sweep import MonitorResult

MOVES = 0.1
"""Rate that a vehicle which is not at rest reaches while a fault is watched, rad/s."""


def smallest_hint(plan: Plan) -> str:
    """Say what the smallest sizes are, and the figures in brackets."""
    return (
        f"from which size on {WANTED:.0%} of the faults tried were detected within {plan.within:g} s; in brackets how"
        " many of that size were, and the 95 % interval of that share"
    )


HEAD = ("fault", "faults", "isolated", "95 % interval", "detected", "false", "missed", "median delay", "95 %")


def rows_of(lines: Sequence[Line]) -> list[tuple[str, ...]]:
    """One row per kind and size."""
    rows: list[tuple[str, ...]] = []
    for line in lines:
        if not line.trials:
            rows.append((line.swept.words, "0", *("-",) * 7))
            continue
        named = share(line.counts[Outcome.ISOLATED], line.trials)
        rows.append(
            (
                line.swept.words,
                str(line.trials),
                f"{named.value:.0%}",
                f"{named.low:.0%} to {named.high:.0%}",
                f"{line.found / line.trials:.0%}",
                str(line.false),
                f"{line.counts[Outcome.MISSED] / line.trials:.0%}",
                *(seconds(value) for value in line.found_after),
            )
        )
    return rows


def seconds(value: float) -> str:
    """Write a delay; a dash where there is none."""
    return f"{value:.2f} s" if math.isfinite(value) else "-"


def sound_lines(tried: MonitorResult) -> list[str]:
    """Say what the monitor makes of the recording as it is, and what follows for the rest."""
    sound = tried.sound
    if sound is None or tried.refused:
        return [f"not tried: {tried.refused}"]
    lines = []
    if not sound.declared:
        words = f"nothing was declared in {sound.duration:.1f} s, {sound.judged:.0%} of the samples judged"
        lines.append(f"{words}, from {sound.begins:.1f} s on")
    else:
        told = sound.story.declared
        more = f", and {len(told) - 1} more episode{'s' if len(told) > 2 else ''}" if len(told) > 1 else ""
        lines.append(
            f"declared, with nothing injected: {episode_words(told[0])}{more}."
            " Either the recording holds a fault, or the config does not fit it: what follows is in doubt"
        )
    if tried.skipped:
        at = ", ".join(f"{time:.1f} s" for time in tried.skipped)
        lines.append(
            f"no fault was injected at {at}: something stands declared then without one, or a channel gives nothing"
        )
    if not tried.times:
        lines.append("so no fault could be tried at all: mend the config, or name the channel in excluded_channels")
    lines += [f"as it is, {line}" for line in sound.degraded]
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
            f"{family}: detected {_from(seen, found[family], seen.found)};"
            f" isolated {_from(known, named[family], known.counts['named'])}"
        )
    words += [
        f"{line.swept.words}: detected in {line.found / line.trials:.0%};"
        f" isolated in {line.counts[Outcome.ISOLATED] / line.trials:.0%}"
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
        return f"from a larger size on than {f'{swept.size:g} {swept.unit}'.rstrip()} ({of})"
    return f"{f'from {size:g} {swept.unit}'.rstrip()} ({of})"


def side_by_side(results: Sequence[MonitorResult], plan: Plan) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Head and rows of a table of all monitors: share isolated, share detected, median delay until detected."""
    tried = [one for one in results if one.trials]
    columns = [lines_of(one, plan) for one in tried]
    rows = [(swept.words, *(_in_short(lines[k]) for lines in columns)) for k, swept in enumerate(plan.faults)]
    return ("fault", *(one.name for one in tried)), rows


SHORT_HINT = "isolated / detected, median delay until detected; ! and a number: faults with a false name or set"


def _in_short(line: Line) -> str:
    isolated, found = line.counts[Outcome.ISOLATED] / line.trials, line.found / line.trials
    words = f"{isolated:.0%} / {found:.0%}, {seconds(line.found_after[0])}"
    return f"{words} !{line.false}" if line.false else words


def sweep_text(results: Sequence[MonitorResult], plan: Plan, bag: str) -> str:
    """Everything, for a terminal."""
    count = sum(len(tried.trials) for tried in results)
    parts = [f"{bag}: {count} faults, one at a time, each watched for {plan.within:g} s"]
    for tried in results:
        parts += ["", f"{tried.name}, nothing injected:", *(f"  {line}" for line in sound_lines(tried))]
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
    "isolated: the faulty channel was declared by itself; detected: that, or one of a set with others",
    "delays are until it was detected, of all faults: a dash where fewer than half, or than 95 %, were detected",
    "a stuck value or a scale factor shows only while the vehicle turns, noise mostly as a warning",
    "this is of one recording: another flight, with other vibration, may need larger faults",
)
