# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The page of a replay: the outputs of the monitor over time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from fdi_ros.arrays import Array
from fdi_ros.bag.samples import Samples
from fdi_ros.core.states import ChannelState
from fdi_ros.episodes.story import Story
from fdi_ros.episodes.words import CELLS, cells, episode_words, stretch_words
from fdi_ros.model.block import Block
from fdi_ros.model.geometry import Geometry
from fdi_ros.monitor.output import Output
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.replay.run import Sink
from fdi_ros.replay.summary import FaultResult, Scores, StateChange, Summary
from fdi_ros.replay.text import notes, size_of, verdict
from fdi_ros.replay.timeline import faults_in_view, gaps, marks, marks_hint, shades, span_of, timeline
from fdi_ros.report.page import CHANNEL_COLOURS, Figure, Section, html_list, html_pairs, html_table, page, time_layout
from fdi_ros.report.store import FINE, SMALL, PageStore
from fdi_ros.report.text_table import milliseconds, number

SEES_AXIS = 0.3
"""Share of a body axis in a channel's own axis from which on the channel's reading of it is shown."""
LOG_FROM = 10.0
"""A statistic that exceeds its threshold by more is shown on a logarithmic scale."""
_AXES = "xyz"
_INK = "var(--text)"
MOST_ROWS = 1000
"""Of the table of events; the first ones."""
EPISODES_HINT = (
    "From the first declaration on. Size: how far the channel is from what the others give, +- its standard error."
)
"""What the table of episodes holds."""
EFFECTS = {
    "before_detection": "before detection",
    "after_detection": "after detection",
    "without_monitor": "without a monitor, least squares of all channels",
}
"""Root mean squares of a `FaultEffect`, in words."""
CHANNEL_HEAD = ("channel", "rms residual while OK, rad/s", "rms in all, rad/s", "largest, rad/s", "at", "last state")


class Report(Sink):
    """Collects the outputs of the monitor, in bounded memory, and lays them out.

    A channel's reading of a body axis is the fused rate, moved along the channel's own axis until the channel agrees.

    Parameters
    ----------
    geometry
        Of the monitor.
    """

    def __init__(self, geometry: Geometry) -> None:
        self.names = geometry.channel_names
        norm = np.linalg.norm(geometry.axes, axis=1)
        self._sees = np.abs(geometry.axes) >= SEES_AXIS * norm[:, None]
        self._gain = geometry.axes / norm[:, None] ** 2
        fine = ["statistic", "threshold", *(f"rate.{axis}" for axis in _AXES)]
        small = [f"{what}.{axis}" for what in ("deviation", "level") for axis in _AXES]
        small += [f"residual.{i}" for i in range(geometry.n)]
        self._store = PageStore({**dict.fromkeys(fine, FINE), **dict.fromkeys(small, SMALL)})
        self._first_states: list[str] = []
        self._residuals = ResidualStatistics(geometry.n)
        self._peak = {"statistic": 0.0, "threshold": 0.0}
        self._origin, self._last = 0, 0.0

    def begin(self, samples: Samples) -> None:
        """Note when the recording began: times count from there."""
        self._origin = samples.origin or 0

    def begin_stretch(self) -> None:
        """Break the curves: nothing is recorded between the last sample and the next."""
        self._store.add(np.array([self._last]), [np.full((1, len(self._store.kinds)), np.nan)])

    def add(self, block: Block, output: Output, pipeline: Pipeline) -> None:
        """Take the next samples."""
        self.add_output(seconds_since(self._origin, output), output)

    def add_output(self, time: Array, output: Output) -> None:
        """Take in the next samples; time (N,) s from the first message."""
        if not len(output):
            return
        if not self._first_states:
            self._first_states = state_names(output)
        deviation = np.sqrt(np.diagonal(output.covariance, axis1=1, axis2=2))
        columns = [output.statistic, output.threshold, output.rate, deviation, output.level, output.residual]
        self._store.add(time, columns)
        self._last = float(time[-1])
        self._residuals.add(time, output)
        for name, values in (("statistic", output.statistic), ("threshold", output.threshold)):
            self._peak[name] = max(self._peak[name], float(values.max(initial=0.0, where=np.isfinite(values))))

    def html(self, summary: Summary, about: Mapping[str, str]) -> str:
        """Lay out the page.

        Parameters
        ----------
        summary
            Of the replay.
        about
            What was run: shown as a table.
        """
        scores = summary.scores
        story = summary.story
        shapes = [*shades(scores.faults), *gaps(story)]
        common = {"shapes": shapes, "marks": marks(scores.faults, story.episodes)}
        needed = faults_in_view(scores.faults, story.episodes)
        states = timeline(self.names, self._first_states, scores.events, span_of(scores), story.gaps)
        states["layout"] |= common
        injected = _fault_table(scores.faults) + _effect_table(scores)
        levels = "Bound on the error of the fused rate with one undetected fault; gaps: none can be given."
        axis = "What each channel makes of an axis: the fused rate moved along the channel's own axis until it agrees."
        last_states = {channel.name: channel.state for channel in summary.monitor.channels}
        hint = f"{self._zoom_hint()} {marks_hint(summary)}"
        sections = [
            Section("What happened", EPISODES_HINT, _episode_table(story, bool(scores.faults)) + _stretch_table(story)),
            Section("States of the channels", hint, "", [states]),
            Section("Statistic against threshold", "", "", [self._statistic(common)]),
            Section("Fused rate, and each channel's reading of it", f"Band: two standard deviations. {axis}", "",
                    self._rates(common, needed)),
            Section("Residuals", "Channel minus fused rate along its axis; all on one scale.",
                    html_table(CHANNEL_HEAD, self._residuals.rows(self.names, last_states)),
                    self._residual_plots(common, needed)),
            Section("Protection level", levels, "", [self._levels(common, needed)]),
            *([Section("Injected faults", "", injected)] if scores.faults else []),
            Section("Changes of state", "The history: what it came to stands above.", _event_table(scores.events)),
            Section("Notes", "", html_list(notes(summary))),
            Section("What was run", "", html_pairs([*about.items(), *_protection_levels(summary)])),
        ]  # fmt: skip
        return page(f"fdi_ros: {summary.bag}", verdict(summary), sections, self._store)

    def _zoom_hint(self) -> str:
        words = (
            "Drag across a plot to zoom all plots in time, double-click to see everything; arrow keys move the cursor."
        )
        if self._store.width > 1:
            words += (
                f" A long recording: of every {self._store.width} samples the smallest and the largest value are drawn;"
                " close up, the lines between them are no course of time."
            )
        return words

    def _statistic(self, common: Mapping[str, Any]) -> Figure:
        log = self._peak["statistic"] > LOG_FROM * self._peak["threshold"] > 0
        lines = [
            _line("statistic", "statistic", {"color": _INK, "width": 1.2}),
            _line("threshold", "threshold", {"color": "#e0662f", "width": 1.8, "dash": "dash"}),
        ]
        axis = {"type": "log" if log else "linear", "title": {"text": "statistic, and threshold"}}
        return {"data": lines, "layout": time_layout(240, yaxis=axis, **common)}

    def _rates(self, common: Mapping[str, Any], needed: Sequence[Sequence[float]]) -> list[Figure]:
        figures = []
        for k, axis in enumerate(_AXES):
            rate, spread = f"rate.{axis}", [f"deviation.{axis}", 2]
            grey = {"color": "#808080"}
            data = [{"type": "band", "packed": rate, "spread": spread, "name": "", "showlegend": False, "line": grey}]
            for i in np.flatnonzero(self._sees[:, k]).tolist():
                plus = [f"residual.{i}", float(self._gain[i, k])]
                line = _line(rate, self.names[i], {"color": _colour(i), "width": 1.1})
                data.append({**line, "plus": plus, "legendgroup": f"channel {i}", "rank": i})
            data.append({**_line(rate, "fused", {"color": _INK, "width": 1.3}), "rank": -1})
            title = {"title": {"text": f"{axis}, rad/s"}}
            layout = time_layout(210, k == len(_AXES) - 1, yaxis=title, robust=True, needed=needed, **common)
            figures.append({"data": data, "layout": layout})
        return figures

    def _residual_plots(self, common: Mapping[str, Any], needed: Sequence[Sequence[float]]) -> list[Figure]:
        figures = []
        for i, name in enumerate(self.names):
            line = _line(f"residual.{i}", name, {"color": _colour(i), "width": 1.1})
            layout = time_layout(
                112,
                i == len(self.names) - 1,
                yaxis={"title": {"text": f"{name}, rad/s"}},
                robust=True,
                needed=needed,
                scale="residuals",
                **common,
            )
            figures.append({"data": [{**line, "showlegend": False}], "layout": layout})
        return figures

    def _levels(self, common: Mapping[str, Any], needed: Sequence[Sequence[float]]) -> Figure:
        lines = [_line(f"level.{axis}", axis, {"color": CHANNEL_COLOURS[k]}) for k, axis in enumerate(_AXES)]
        title = {"title": {"text": "protection level, rad/s"}}
        return {"data": lines, "layout": time_layout(220, yaxis=title, robust=True, needed=needed, **common)}


class ResidualStatistics:
    """Root mean squares and extremes of the residuals of n channels.

    Parameters
    ----------
    n
        Number of channels.
    """

    def __init__(self, n: int) -> None:
        self._square, self._count = np.zeros((2, n)), np.zeros((2, n))
        self._largest, self._at = np.zeros(n), np.zeros(n)

    def add(self, time: Array, output: Output) -> None:
        """Take in the next samples; time (N,) s."""
        size = np.abs(np.nan_to_num(output.residual, nan=0.0, posinf=0.0, neginf=0.0))
        finite = np.isfinite(output.residual)
        for k, rows in enumerate((finite, finite & (output.state == ChannelState.OK))):
            self._square[k] += (size**2 * rows).sum(axis=0)
            self._count[k] += rows.sum(axis=0)
        row = size.argmax(axis=0)
        peak = size.max(axis=0)
        larger = peak > self._largest
        self._at[larger], self._largest[larger] = time[row[larger]], peak[larger]

    def rows(self, names: Sequence[str], last_states: Mapping[str, str]) -> list[tuple[str, ...]]:
        """Return a row per channel: rms of its residual while OK and in all, the largest and when, its last state."""
        with np.errstate(invalid="ignore", divide="ignore"):
            everything, sound = np.sqrt(self._square / self._count)
        figures = zip(names, sound, everything, self._largest, self._at, strict=True)
        return [
            (name, *map(_figure, values), f"{at:.3f} s", last_states.get(name, "-")) for name, *values, at in figures
        ]


def seconds_since(origin: int, output: Output) -> Array:
    """Return the times of samples (N,), s from a stamp, ns."""
    return np.asarray((output.stamp - origin) * 1e-9, dtype=np.float64)


def state_names(output: Output) -> list[str]:
    """Return the state of each channel with the first sample."""
    return [ChannelState(state).name for state in output.state[0].tolist()]


def _episode_table(story: Story, scored: bool) -> str:
    """Lay out the episodes, one row each."""
    if not story.episodes:
        return "<p>Nothing was declared, and no channel fell silent.</p>"
    several = len(story.stretches) > 1
    rows = []
    for one in story.episodes[:MOST_ROWS]:
        place = (str(one.stretch),) if several else ()
        injected = (", ".join(one.injected) or "-",) if scored else ()
        rows.append((*place, f"{episode_words(one)}.", *dict(cells(one)).values(), *injected))
    head = (*(("stretch",) if several else ()), "what", *CELLS, *(("injected there",) if scored else ()))
    more = len(story.episodes) - MOST_ROWS + story.more
    return html_table(head, rows) + (f"<p>{more} more.</p>" if more > 0 else "")


def _stretch_table(story: Story) -> str:
    """Lay out the stretches where there are several."""
    lines = stretch_words(story)
    return html_list(lines) if lines else ""


def _fault_table(faults: Sequence[FaultResult]) -> str:
    """Lay out the injected faults with their delays."""
    head = (
        "channel",
        "kind",
        "size",
        "start",
        "stop",
        "detected",
        "delay",
        "as",
        "isolated after",
        "declared, or one of",
    )
    return html_table(head, map(_fault_row, faults))


def _fault_row(fault: FaultResult) -> tuple[str, ...]:
    missed = "declared before" if fault.declared_before else "not detected"
    return (
        fault.channel,
        fault.kind,
        size_of(fault),
        _seconds(fault.start_s),
        _seconds(fault.stop_s),
        missed if fault.detected_at_s is None else _seconds(fault.detected_at_s),
        milliseconds(fault.delay_s),
        fault.detected_as or "-",
        milliseconds(fault.isolation_delay_s) if fault.isolated else "no",
        ", ".join(fault.declared_channels) or "-",
    )


def _effect_table(scores: Scores) -> str:
    """Lay out what the injected faults did to the fused rate."""
    effect = scores.fault_effect_rad_s
    rows = [(words, number(getattr(effect, name), 6, " rad/s")) for name, words in EFFECTS.items()]
    hint = "Difference of the fused rate to that of the same monitor without the faults."
    return f"<p class='hint'>{escape(hint)}</p>" + html_table(("samples", "rms effect of the faults"), rows)


def _event_table(events: Sequence[StateChange]) -> str:
    """Lay out the changes of state."""
    if not events:
        return "<p>No channel changed its state.</p>"
    head = ("time", "channel", "from", "to", "reason", "one of", "error")
    rows = [
        (
            _seconds(event.at_s),
            event.channel,
            event.before,
            event.state,
            event.reason,
            ", ".join(event.group) if event.state == "AMBIGUOUS" else "",
            f"{event.error:.4f} rad/s" if event.error else "",
        )
        for event in events[:MOST_ROWS]
    ]
    more = f"<p>{len(events) - MOST_ROWS} more.</p>" if len(events) > MOST_ROWS else ""
    return html_table(head, rows) + more


def _protection_levels(summary: Summary) -> list[tuple[str, str]]:
    levels = summary.monitor.protection_level
    return [
        ("protection level at end", _per_axis(levels.at_end)),
        ("protection level after one more loss", _per_axis(levels.after_one_more_loss)),
    ]


def _per_axis(values: Sequence[float | None]) -> str:
    words = ("none" if value is None else f"{value:.4g}" for value in values)
    return " ".join(f"{axis} {value}" for axis, value in zip(_AXES, words, strict=True)) + " rad/s"


def _seconds(value: float | None) -> str:
    return number(value, 3, " s")


def _figure(value: float) -> str:
    return f"{value:.4g}" if math.isfinite(value) else "-"


def _colour(channel: int) -> str:
    return CHANNEL_COLOURS[channel % len(CHANNEL_COLOURS)]


def _line(packed: str, name: str, line: Mapping[str, Any]) -> dict[str, Any]:
    return {"type": "scatter", "packed": packed, "name": name, "line": dict(line)}
