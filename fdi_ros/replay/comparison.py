# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A comparison told: all detectors on one recording, side by side, for a terminal and as a page."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from fdi_ros.bag.samples import Samples
from fdi_ros.episodes.story import MOST_TOLD, Shared, brief, episode_words, shared_episodes
from fdi_ros.model.samples import Array, Block
from fdi_ros.monitor.output import Output
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.replay.report import (
    EFFECTS,
    gaps,
    marks,
    marks_hint,
    seconds_since,
    shades,
    span_of,
    state_names,
    timeline,
)
from fdi_ros.replay.run import Sink
from fdi_ros.replay.summary import FaultResult, Refusal, StateChange, Summary, sample_rate_notes, unchecked_lines
from fdi_ros.report.layout import (
    RADIANS,
    SMALL,
    Columns,
    Figure,
    PageStore,
    Section,
    Unit,
    colour_of,
    head_and_rows,
    html_table,
    indented,
    milliseconds,
    number,
    page,
    table,
    time_layout,
)

MOST_ROWS = 100
"""Episodes of the table of the page; the first ones."""
_MOST_SHARED = 5
"""Of that for a terminal."""
_WORST_FIRST = ("FAULTY", "AMBIGUOUS", "STALE", "SUSPECT", "UNCHECKED", "EXCLUDED", "OK")


def comparison_text(results: Sequence[Summary | Refusal], unit: Unit = RADIANS) -> str:
    """Say what each detector makes of one recording; of injected faults, where there are any, the scores."""
    ran = [result for result in results if isinstance(result, Summary)]
    refused = [result for result in results if isinstance(result, Refusal)]
    noted = [*_unchecked_lines(ran), *(sample_rate_notes(ran[0].stream.sample_rate) if ran else [])]
    effect: Columns = {
        "rms effect after detection": lambda one: unit.words(one.scores.fault_effect_rad_s.after_detection)
    }
    return "".join(
        [
            indented(table(*head_and_rows(_columns(ran, "false", effect), ran), figures=False)),
            _shared(ran),
            *(f"{one.detector} cannot run here: {one.refused}\n" for one in refused),
            *(f"note: {line}\n" for line in noted),
        ]
    )


def _columns(ran: Sequence[Summary], false: str, effects: Columns) -> Columns:
    """Columns of what each detector made of the recording; the head of false declarations, and effects of faults."""
    scores: Columns = {
        "detected": lambda one: f"{len(one.scores.detected)} of {len(one.scores.faults)}",
        "isolated": lambda one: f"{one.scores.isolated} of {len(one.scores.faults)}",
        "mean delay": lambda one: milliseconds(one.scores.mean_delay),
        false: lambda one: str(len(one.scores.declared)),
        **effects,
    }
    return {
        "detector": lambda one: one.detector,
        **(scores if ran and ran[0].scores.faults else {}),
        "episodes": lambda one: str(len(one.story.declared) + one.story.more),
        "us per sample": lambda one: f"{one.monitor.us_per_sample:.1f}",
    }


def _shared(ran: Sequence[Summary]) -> str:
    """Lay out what each detector says of the same episodes."""
    found, parts = _told(ran), []
    for place, shared in enumerate(found[:_MOST_SHARED], 1):
        rows = [(summary.detector, brief(shared.told.get(summary.detector))) for summary in ran]
        parts.append(f"\nepisode {place}, from {shared.start_s:.3f} s\n")
        parts.append(indented(table(("detector", "says"), rows, figures=False)))
    more = len(found) - _MOST_SHARED
    return "".join([*parts, f"  and {more} more\n"] if more > 0 else parts)


def _unchecked_lines(summaries: Sequence[Summary]) -> list[str]:
    """Return what was not checked with several detectors on one recording, and by which of them."""
    detectors: dict[str, list[str]] = {}
    for summary in summaries:
        for line in unchecked_lines(summary):
            detectors.setdefault(line, []).append(summary.detector)
    every = [summary.detector for summary in summaries]
    return [f"{_which(names, every)}: {line}" for line, names in detectors.items()]


def _which(names: Sequence[str], every: Sequence[str]) -> str:
    """Name some of the detectors, or those that are none of them where these are fewer."""
    others = [name for name in every if name not in names]
    if len(others) >= len(names):
        return ", ".join(names)
    return f"all detectors{' but ' if others else ''}{', '.join(others)}"


# The page ------------------------------------------------------------------------------------------------------------


class ComparisonReport(Sink):
    """Collects the outputs of monitors with different detectors, each in turn on the same samples; lays them out."""

    def __init__(self) -> None:
        self._store: PageStore | None = None
        self._origin = 0
        self._time = np.empty(0)
        self._waiting: dict[str, Array] = {}
        """Statistic over threshold (N,) of these times, of the detectors that have had the samples already."""
        self._first: dict[str, list[str]] = {}
        """State of each channel with the first sample, by detector."""

    def begin(self, samples: Samples) -> None:
        """Note when the recording began: times count from there."""
        self._origin = samples.origin or 0

    def add(self, block: Block, output: Output, pipeline: Pipeline) -> None:
        """Take the next samples from one detector."""
        detector = pipeline.config.detector.name
        if not len(output):
            return
        if detector not in self._first:
            self._first[detector] = state_names(output)
        if detector in self._waiting:
            self._keep()
        self._time = seconds_since(self._origin, output)
        with np.errstate(invalid="ignore", divide="ignore"):
            self._waiting[detector] = output.statistic / output.threshold

    def _keep(self) -> None:
        """Every detector has had the samples."""
        if self._store is None:
            self._store = PageStore(dict.fromkeys(self._waiting, SMALL))
        self._store.add(self._time, list(self._waiting.values()))
        self._waiting = {}

    def html(self, bag: str, results: Sequence[Summary | Refusal], about: Mapping[str, str]) -> str:
        """Lay out the page.

        Parameters
        ----------
        bag
            What was replayed.
        results
            Of each detector.
        about
            What was run: shown as a table.
        """
        if self._waiting:
            self._keep()
        ran = [result for result in results if isinstance(result, Summary)]
        refused = [(result.detector, result.refused) for result in results if isinstance(result, Refusal)]
        head = (
            "detector",
            *(f"{fault.kind} on {fault.channel} at {fault.start_s:g} s" for fault in ran[0].scores.faults),
        )
        faults = (head, [(one.detector, *map(_fault_words, one.scores.faults)) for one in ran])
        effects = {f"rms effect {words}, rad/s": _effect(name) for name, words in EFFECTS.items()}
        sections = [
            Section("What each says of the same episodes", "", _shared_table(ran)),
            Section("Figures", "", head_and_rows(_columns(ran, "false declarations", effects), ran)),
            *([Section("Faults, by detector", "", faults)] if ran[0].scores.faults else []),
            Section(
                "Declared, by detector",
                f"Worst state of all channels. {marks_hint(ran[0])}",
                "",
                [self._states(ran)],
            ),
            Section("Statistic over threshold, by detector", "Alarm above 1.", "", self._ratios(ran)),
            *([Section("Cannot run here", "", (("detector", "why"), refused))] if refused else []),
            Section("What was run", "", about),
        ]
        return page(f"fdi_ros: detectors on {bag}", _summary_lines(ran), sections, self._store)

    def _states(self, ran: Sequence[Summary]) -> Figure:
        """Draw the worst state of all channels over time, a row per detector."""
        events = [event for summary in ran for event in _worst_states(summary, self._first.get(summary.detector, []))]
        first = [_worst_of(self._first[summary.detector]) for summary in ran] if self._first else []
        holes = ran[0].story.gaps
        drawn = timeline([summary.detector for summary in ran], first, events, span_of(ran[0].scores), holes)
        rows = [{**mark, "row": row} for row, summary in enumerate(ran) for mark in _marks(summary)]
        drawn["layout"] |= {"shapes": [*shades(ran[0].scores.faults), *gaps(ran[0].story)], "marks": rows}
        return drawn

    def _ratios(self, ran: Sequence[Summary]) -> list[Figure]:
        one = {"type": "line", "y0": 1.0, "line": {"dash": "dash"}}
        figures = []
        axis = {"type": "log", "title": {"text": "statistic over threshold"}}
        for k, summary in enumerate(ran if self._store else []):
            name = summary.detector
            line = {"color": colour_of(k), "width": 1.2}
            curve = {"type": "scatter", "packed": name, "name": name, "line": line, "showlegend": False}
            shapes = [*shades(summary.scores.faults), *gaps(summary.story), one]
            layout = time_layout(
                112, k == len(ran) - 1, yaxis={"type": "log"}, title=name, shapes=shapes, marks=_marks(summary)
            )
            figures.append({"data": [curve], "layout": layout | {"yaxis": axis}})
        return figures


def _marks(summary: Summary) -> list[dict[str, Any]]:
    return marks(summary.scores.faults, summary.story.episodes)


def _worst_states(summary: Summary, first: Sequence[str]) -> list[StateChange]:
    """Return changes of the worst state of all channels, as events of the detector; the reason is the channel."""
    state = dict(zip([channel.name for channel in summary.monitor.channels], first, strict=False))
    worst, changes = _worst_of(list(state.values())), []
    for event in summary.scores.events:
        state[event.channel] = event.state
        now = _worst_of(list(state.values()))
        if now != worst:
            changes.append(replace(event, channel=summary.detector, before=worst, state=now, reason=event.channel))
            worst = now
    return changes


def _worst_of(states: Sequence[str]) -> str:
    return next((state for state in _WORST_FIRST if state in states), "UNCHECKED")


def _summary_lines(ran: Sequence[Summary]) -> list[str]:
    """Return the sentences at the top of the page."""
    lines, count = _unchecked_lines(ran), len(ran[0].scores.faults) if ran else 0
    if not count:
        lines += [_shared_words(place, shared, ran) for place, shared in enumerate(_told(ran)[:MOST_TOLD], 1)]
        lines += [] if any(summary.story.declared for summary in ran) else ["Nothing was declared by any detector."]
    else:
        quiet = [summary.detector for summary in ran if not summary.scores.declared]
        lines.append(f"No false declaration: {', '.join(quiet) or 'no detector'}.")
        every = [summary.detector for summary in ran if summary.scores.isolated == count]
        what = "The fault" if count == 1 else f"All {count} faults"
        lines.insert(0, f"{what} isolated by: {', '.join(every) or 'no detector'}.")
    return lines


def _effect(name: str) -> Callable[[Summary], str]:
    return lambda one: number(getattr(one.scores.fault_effect_rad_s, name), ".6f")


def _fault_words(fault: FaultResult) -> str:
    if fault.detected_at_s is None:
        return "declared before" if fault.declared_before else "missed"
    names = ", ".join(fault.declared_channels)
    return f"{milliseconds(fault.delay_s)}, " + ("isolated" if fault.isolated else f"one of {names}")


def _told(ran: Sequence[Summary]) -> list[Shared]:
    return shared_episodes({summary.detector: summary.story for summary in ran})


def _shared_words(number: int, shared: Shared, ran: Sequence[Summary]) -> str:
    """Say who declared what of one episode, alike detectors together."""
    alike: dict[str, list[str]] = {}
    for summary in ran:
        one = shared.told.get(summary.detector)
        said = "nothing" if one is None else f"{one.who} {one.state}"
        alike.setdefault(said, []).append(summary.detector)
    words = "; ".join(f"{said}: {', '.join(names)}" for said, names in alike.items())
    return f"Episode {number}, from {shared.start_s:.3f} s: {words}."


def _shared_table(ran: Sequence[Summary]) -> str:
    """Lay out what each detector says of the same episodes, a row per detector and episode."""
    found = _told(ran)
    if not found:
        return "<p>None: nothing was declared by any detector.</p>"
    rows = []
    for place, shared in enumerate(found[:MOST_ROWS], 1):
        for summary in ran:
            one = shared.told.get(summary.detector)
            after = None if one is None else one.start_s - shared.start_s
            words = "nothing" if one is None else episode_words(one)
            rows.append((summary.detector, str(place), number(after, unit=" s"), words))
    return html_table(("detector", "episode", "after the first", "says"), rows)
