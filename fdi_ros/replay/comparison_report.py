# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The page of a comparison: all detectors on one recording, side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from fdi_ros.arrays import Array
from fdi_ros.bag.samples import Samples
from fdi_ros.episodes.story import Shared, shared_episodes
from fdi_ros.episodes.words import MOST_TOLD, episode_words
from fdi_ros.model.block import Block
from fdi_ros.monitor.output import Output
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.replay.report import EFFECTS, seconds_since, state_names
from fdi_ros.replay.run import Sink
from fdi_ros.replay.summary import FaultResult, Refusal, StateChange, Summary
from fdi_ros.replay.text import unchecked_by_detector
from fdi_ros.replay.timeline import gaps, marks, marks_hint, shades, span_of, timeline
from fdi_ros.report.page import CHANNEL_COLOURS, Figure, Section, html_pairs, html_table, page, time_layout
from fdi_ros.report.store import SMALL, PageStore
from fdi_ros.report.text_table import milliseconds, number

MOST_ROWS = 100
"""Episodes of the table; the first ones."""
_WORST_FIRST = ("FAULTY", "AMBIGUOUS", "STALE", "SUSPECT", "UNCHECKED", "EXCLUDED", "OK")


class ComparisonReport:
    """Collects the outputs of monitors with different detectors on the same samples, and lays them out."""

    def __init__(self) -> None:
        self._names: list[str] = []
        """Detectors that run, in their order."""
        self._store: PageStore | None = None
        self._waiting: dict[str, Array] = {}
        """Statistic over threshold (N,) of the detectors that have had the next samples already."""
        self._first: dict[str, list[str]] = {}
        """State of each channel with the first sample, by detector."""

    def sinks(self, detector: str) -> list[Sink]:
        """Return what collects the outputs of one more detector."""
        self._names.append(detector)
        return [_DetectorSink(self, detector)]

    def add(self, detector: str, time: Array, output: Output) -> None:
        """Take in the next samples from one detector; time (N,) s; every detector gets the same samples in turn."""
        if not len(output):
            return
        if detector not in self._first:
            self._first[detector] = state_names(output)
        with np.errstate(invalid="ignore", divide="ignore"):
            self._waiting[detector] = output.statistic / output.threshold
        if len(self._waiting) == len(self._names):
            if self._store is None:
                self._store = PageStore(dict.fromkeys(self._names, SMALL))
            self._store.add(time, [self._waiting[name] for name in self._names])
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
        ran = [result for result in results if isinstance(result, Summary)]
        refused = [(result.detector, result.refused) for result in results if isinstance(result, Refusal)]
        sections = [
            Section("What each says of the same episodes", "", _shared_table(ran)),
            Section("Figures", "", _figure_table(ran)),
            *([Section("Faults, by detector", "", _fault_table(ran))] if ran[0].scores.faults else []),
            Section(
                "Declared, by detector",
                f"Worst state of all channels. {marks_hint(ran[0])}",
                "",
                [self._states(ran)],
            ),
            Section("Statistic over threshold, by detector", "Alarm above 1.", "", self._ratios(ran)),
            *([Section("Cannot run here", "", html_table(("detector", "why"), refused))] if refused else []),
            Section("What was run", "", html_pairs(about.items())),
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
            line = {"color": CHANNEL_COLOURS[k % len(CHANNEL_COLOURS)], "width": 1.2}
            curve = {"type": "scatter", "packed": name, "name": name, "line": line, "showlegend": False}
            shapes = [*shades(summary.scores.faults), *gaps(summary.story), one]
            layout = time_layout(
                112, k == len(ran) - 1, yaxis={"type": "log"}, title=name, shapes=shapes, marks=_marks(summary)
            )
            figures.append({"data": [curve], "layout": layout | {"yaxis": axis}})
        return figures


class _DetectorSink(Sink):
    """Collects the outputs of one detector.

    Parameters
    ----------
    report
        Of all detectors.
    detector
        Its name.
    """

    def __init__(self, report: ComparisonReport, detector: str) -> None:
        self._report, self._detector = report, detector
        self._origin = 0

    def begin(self, samples: Samples) -> None:
        """Note when the recording began: times count from there."""
        self._origin = samples.origin or 0

    def add(self, block: Block, output: Output, pipeline: Pipeline) -> None:
        """Take the next samples."""
        self._report.add(self._detector, seconds_since(self._origin, output), output)


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
    lines, count = unchecked_by_detector(ran), len(ran[0].scores.faults) if ran else 0
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


def _figure_table(ran: Sequence[Summary]) -> str:
    """Lay out what each detector made of the recording."""
    effects = [f"rms effect {words}, rad/s" for words in EFFECTS.values()]
    scores = ("detected", "isolated", "mean delay", "false declarations", *effects)
    head = ("detector", *(scores if ran[0].scores.faults else ()), "episodes", "us per sample")
    return html_table(head, map(_figure_row, ran))


def _figure_row(summary: Summary) -> tuple[str, ...]:
    scores = summary.scores
    count, false, cost = len(scores.faults), str(len(scores.declared)), f"{summary.monitor.us_per_sample:.1f}"
    told = str(len(summary.story.declared) + summary.story.more)
    if not count:
        return summary.detector, told, cost
    return (
        summary.detector,
        f"{len(scores.detected)} of {count}",
        f"{scores.isolated} of {count}",
        milliseconds(scores.mean_delay),
        false,
        *(number(getattr(scores.fault_effect_rad_s, name), 6) for name in EFFECTS),
        told,
        cost,
    )


def _fault_table(ran: Sequence[Summary]) -> str:
    """Lay out what each detector made of each injected fault."""
    head = ("detector", *(f"{f.kind} on {f.channel} at {f.start_s:g} s" for f in ran[0].scores.faults))
    return html_table(head, [(one.detector, *map(_fault_words, one.scores.faults)) for one in ran])


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
            rows.append((summary.detector, str(place), number(after, 3, " s"), words))
    return html_table(("detector", "episode", "after the first", "says"), rows)
