# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The page of a replay: outputs of the monitor, states of the channels and marks of faults over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fdi_ros.bag.flight_context import Course
from fdi_ros.bag.samples import Samples
from fdi_ros.config.config import Config
from fdi_ros.core.states import ChannelState
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.quantity import FORCE, RATE, Quantity
from fdi_ros.model.samples import Array, Block
from fdi_ros.monitor.building import GUARD, build_geometry, build_noise
from fdi_ros.monitor.output import Output
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.replay.episodes import (
    EPISODE_TIMES,
    Episode,
    Story,
    detail_words,
    episode_words,
    stretch_words,
    unit_for,
)
from fdi_ros.replay.outcomes import Outcome, StateChange
from fdi_ros.replay.own_evidence import OwnEvidence
from fdi_ros.replay.run import Sink
from fdi_ros.replay.summary import AutopilotText, ChannelResult, Summary
from fdi_ros.replay.verdict import verdict_of
from fdi_ros.replay.words import fault_sections, health_section, notes, sentences
from fdi_ros.report.layout import (
    FINE,
    FORCES,
    RADIANS,
    SMALL,
    Columns,
    Figure,
    PageStore,
    Pair,
    Section,
    Unit,
    Verdict,
    colour_of,
    head_and_rows,
    number,
    page,
    prose,
    time_layout,
)
from fdi_ros.report.spectrum import Spectrum
from fdi_ros.system import there
from fdi_ros.system.text import date_of, figures, percent

SEES_AXIS = 0.3
"""Smallest component of a channel's axis along a body axis for its curve to be drawn there."""
LOG_FROM = 10.0
"""Ratio of statistic to threshold from which on the scale is logarithmic."""
_AXES = "xyz"
_INK = "var(--text)"


class _PageRoom(NamedTuple):
    """What a page of a replay has room for."""

    #: largest number of rows in a table
    rows: int = 1000
    #: largest number of episodes. The JSON file has all
    cards: int = 200
    #: largest number of changes of state in the plot
    changes: int = 2000
    #: largest number of marked declarations
    marks: int = 200
    #: least time that the link of an episode shows before and after the episode, s
    around: float = 2.0
    #: time after the begin and the detection of a fault that the scale of residuals
    #: covers, s
    in_view: float = 1.0


PAGE = _PageRoom()


class Words(NamedTuple):
    """Titles of the plots of gyros or accelerometers."""

    #: short name of the fused vector
    vector: str
    #: title of the plot of the statistic
    statistic: str
    #: title of the plot of the fused vector
    fused: str
    #: title of the plot of the residuals
    residuals: str
    #: title of the plot of the spectrum
    spectrum: str
    #: title of the plot of the protection level
    level: str


QUANTITY_WORDS = {
    RATE: Words(
        "fused rate",
        "statistic, and threshold",
        "Fused rate, and each channel's reading of it",
        "Residuals",
        "Spectrum of the differences",
        "Protection level",
    ),
    FORCE: Words(
        "fused specific force",
        "statistic of accelerometers, and threshold",
        "Fused specific force, and each accelerometer's reading of it",
        "Residuals of the accelerometers",
        "Spectrum of the differences of the accelerometers",
        "Protection level of the specific force",
    ),
}


class Curves:
    """Curves of the gyros or of the accelerometers, drawn over the time of the page.

    A channel's reading of a body axis is the fused vector, moved along the channel's own
    axis until the channel agrees.

    Parameters
    ----------
    geometry
        Channels, n.
    noise_std
        (n,) standard deviation of the noise of each channel.
    rate
        Samples per second, Hz.
    unit
        Of the figures on the page.
    quantity
        What the channels measure.
    own
        Begin of the names of its series, unlike those of other curves on the page.
    """

    def __init__(
        self,
        geometry: Geometry,
        noise_std: Array,
        rate: float,
        unit: Unit,
        quantity: Quantity = RATE,
        own: str = "",
    ) -> None:
        self.names = geometry.channel_names
        self.unit = unit
        self._words = QUANTITY_WORDS[quantity]
        self._own = own
        norm = np.linalg.norm(geometry.axes, axis=1)
        self._sees = np.abs(geometry.axes) >= SEES_AXIS * norm[:, None]
        self._gain = geometry.axes / norm[:, None] ** 2
        fine = ["statistic", "threshold", *(f"rate.{axis}" for axis in _AXES)]
        small = [f"{what}.{axis}" for what in ("deviation", "level") for axis in _AXES]
        small += [f"residual.{i}" for i in range(geometry.n)]
        kinds = {**dict.fromkeys(fine, FINE), **dict.fromkeys(small, SMALL)}
        #: names and kinds of its series
        self.kinds = {f"{self._own}{name}": kind for name, kind in kinds.items()}
        self.spectrum = Spectrum(self.names, rate) if there("scipy") else None
        alone = [f"{own}alone.{i}" for i in range(geometry.n)]
        #: evidence against channels that are left out
        self.alone = OwnEvidence(geometry, noise_std, alone)
        #: largest statistic and threshold
        self._peaks = np.zeros(2)

    def columns(self, output: Output) -> Array:
        """Return the values of the series, (N, c), and store the largest statistic."""
        deviation = np.sqrt(np.diagonal(output.covariance, axis1=1, axis2=2))
        vectors = [output.rate, deviation, output.level, output.residual]
        judged = np.column_stack([output.statistic, output.threshold])
        largest = judged.max(axis=0, initial=0.0, where=np.isfinite(judged))
        self._peaks = np.maximum(self._peaks, largest)
        return np.column_stack([judged, np.column_stack(vectors) * self.unit.factor])

    def statistic(self, layout: Mapping[str, Any], alone: bool) -> Figure:
        """Draw the statistic and its threshold, and the evidence against channels left out."""
        lines = [
            self._line("statistic", "statistic", _INK, 1.2),
            self._line("threshold", "threshold", "#e0662f", 1.8, dash="dash"),
        ]
        largest = self._peaks[0]
        if alone:
            largest = max(largest, self.alone.peak)
            lines += [
                self._line(f"alone.{i}", f"{name} alone", colour_of(i), 1.6, dash="dot")
                for i, name in enumerate(self.names)
                if self.alone.store.shows(f"{self._own}alone.{i}")
            ]
        log = largest > LOG_FROM * self._peaks[1] > 0
        figure = _plot(lines, 240, self._words.statistic, True, layout)
        figure["layout"]["yaxis"]["type"] = "log" if log else "linear"
        return figure

    def sections(
        self, common: Mapping[str, Any], scale: Mapping[str, Any]
    ) -> list[Section]:
        """Lay out the fused vector, the residuals, their spectrum and the level.

        ``common``: layout of every plot. ``scale``: how a plot chooses its scale.
        """
        words = self._words
        last = len(self.names) - 1
        of_residuals = {**scale, "scale": self._words.residuals, **common}
        levels = [
            self._line(f"level.{axis}", axis, colour_of(k))
            for k, axis in enumerate(_AXES)
        ]
        title = f"protection level, {self.unit.name}"
        level = _plot(levels, 220, title, True, {**scale, **common})
        spectrum = self.spectrum and self.spectrum.section(self.unit)
        if spectrum:
            hint = spectrum.hint.replace("fused rate", words.vector)
            spectrum = replace(spectrum, title=words.spectrum, hint=hint)
        return [
            Section(
                words.fused,
                f"Band: two standard deviations. The line of a channel is the {words.vector},"
                " moved along the axis of that channel to what the channel measures.",
                "",
                [self._rate(k, {**scale, **common}) for k in range(len(_AXES))],
            ),
            Section(
                words.residuals,
                f"Channel minus {words.vector} along its axis; all on one scale.",
                "",
                [
                    self._residual(i, i == last, of_residuals)
                    for i in range(len(self.names))
                ],
            ),
            *([spectrum] if spectrum else []),
            Section(
                words.level,
                f"Bound on the error of the {words.vector} with one undetected fault; gaps: none can be given.",
                "",
                [level],
            ),
        ]

    def _rate(self, k: int, layout: Mapping[str, Any]) -> Figure:
        """Draw the fused vector along an axis, with the readings of the channels that measure it."""
        rate = f"rate.{_AXES[k]}"
        axis = _AXES[k]
        band = {
            "type": "band",
            "packed": f"{self._own}{rate}",
            "spread": [f"{self._own}deviation.{axis}", 2],
            "name": "",
            "showlegend": False,
        }
        data = [{**band, "line": {"color": "#808080"}}]
        for i in np.flatnonzero(self._sees[:, k]).tolist():
            plus = [f"{self._own}residual.{i}", float(self._gain[i, k])]
            line = self._line(rate, self.names[i], colour_of(i), 1.1)
            group = f"channel {i} {self.names[i]}"
            data.append({**line, "plus": plus, "legendgroup": group, "rank": i})
        data.append({**self._line(rate, "fused", _INK, 1.3), "rank": -1})
        title = f"{axis}, {self.unit.name}"
        return _plot(data, 210, title, k == len(_AXES) - 1, layout)

    def _residual(self, i: int, last: bool, layout: Mapping[str, Any]) -> Figure:
        line = self._line(f"residual.{i}", self.names[i], colour_of(i), 1.1)
        title = f"{self.names[i]}, {self.unit.name}"
        return _plot([{**line, "showlegend": False}], 112, title, last, layout)

    def _line(
        self,
        series: str,
        name: str,
        colour: str,
        width: float | None = None,
        **more: Any,
    ) -> dict[str, Any]:
        """Draw one series."""
        look = {"color": colour, **({} if width is None else {"width": width}), **more}
        packed = f"{self._own}{series}"
        return {"type": "scatter", "packed": packed, "name": name, "line": look}


class Report(Sink):
    """Collects the outputs of the monitor, in bounded memory, and lays them out.

    Accelerometers have curves of their own from the first output that has any.

    Parameters
    ----------
    geometry
        Gyros, n.
    noise_std
        (n,) standard deviation of the noise of each gyro, rad/s.
    rate
        Samples per second, Hz.
    unit
        Of rates on the page.
    own
        Begin of the names of its series, for a page with two replays.
    """

    def __init__(
        self,
        geometry: Geometry,
        noise_std: Array,
        rate: float,
        unit: Unit = RADIANS,
        own: str = "",
    ) -> None:
        self._unit = unit
        self._sample_rate = rate
        self._own = own
        self._curves = [Curves(geometry, noise_std, rate, unit, own=own)]
        self._store = PageStore(self._curves[0].kinds)
        self._first_states: list[str] = []
        self._origin: int | None = None
        """Stamp of time zero, ns. None: no sample yet."""
        self._last = 0.0

    def begin(self, samples: Samples) -> None:
        """Store the stamp of the first message, from which times count."""
        self._origin = samples.origin

    def begin_stretch(self) -> None:
        """Break the curves at a gap in the recording."""
        for curves in self._curves:
            if curves.spectrum:
                curves.spectrum.begin_stretch()
        nothing = np.full((1, len(self._store.kinds)), np.nan)
        self._store.add(np.array([self._last]), nothing)

    def add(self, block: Block, output: Output, pipeline: Pipeline) -> None:
        """Add the next samples."""
        if not len(output):
            return
        if not self._first_states:
            self._first_states = [
                ChannelState(state).name for state in output.state[0].tolist()
            ]
            self._find_accelerometers(output, pipeline)
        halves = list(zip(self._curves, output.halves, strict=True))
        time = np.asarray((output.stamp - (self._origin or 0)) * 1e-9)
        columns = np.column_stack([curves.columns(half) for curves, half in halves])
        for curves, half in halves:
            curves.alone.add(time, half)
        # Curves also break at holes within a stretch.
        holes = np.flatnonzero(
            np.diff(time, prepend=self._last or time[0]) > EPISODE_TIMES.longest_hole
        )
        for k, part in enumerate(np.split(np.arange(len(time)), holes)):
            if k:
                self.begin_stretch()
            if len(part):
                self._store.add(time[part], columns[part])
                self._last = float(time[part[-1]])
            for curves, half in halves:
                if curves.spectrum:
                    curves.spectrum.add(half.residual[part])

    def _find_accelerometers(self, output: Output, pipeline: Pipeline) -> None:
        """Make the curves of the accelerometers, if the first output has any."""
        if output.acceleration is None:
            return
        _, accelerometers = pipeline.halves
        rate = self._sample_rate
        geometry = accelerometers.geometry
        noise_std = accelerometers.noise.noise_std
        own = f"{self._own}{FORCE.name}."
        self._curves.append(Curves(geometry, noise_std, rate, FORCES, FORCE, own))
        self._store = PageStore(self._curves[0].kinds | self._curves[1].kinds)

    def html(self, summary: Summary, about: Mapping[str, str]) -> str:
        """Lay out the page: verdict, episodes, plots and tables. ``about``: head of the page."""
        return page(
            f"fdi_ros: {summary.bag}",
            self.lines(summary),
            self.sections(summary, about),
            self.stores,
            self._origin,
        )

    @property
    def stores(self) -> list[PageStore]:
        """All series of the curves."""
        return [self._store, *(curves.alone.store for curves in self._curves)]

    def lines(self, summary: Summary, letter: str = "") -> list[str | Verdict]:
        """Return the sentences at the top, the verdict first, behind the letter of the replay."""
        found = verdict_of(summary, self._unit)
        name = f"{letter}, {Path(summary.bag).name}: " if letter else ""
        verdict = Verdict(found.severity, f"{name}{found.sentence}")
        return [verdict, *sentences(summary, self._unit)]

    def sections(self, summary: Summary, about: Mapping[str, str]) -> list[Section]:
        """Lay out episodes, plots and tables."""
        scores = summary.scores
        story = summary.story
        unit = self._unit
        shapes = _shaded(summary)
        common = {"shapes": shapes, "marks": _marks(scores.faults, story.episodes)}
        scale = {"robust": True, "needed": _in_view(scores.faults, story.episodes)}
        said = _autopilot_marks(summary)
        # The first section has few plots, so that its text is read.
        quiet = {
            **common,
            "marks": [*common["marks"], *({**mark, "label": ""} for mark in said)],
        }
        names = [one.name for one in summary.monitor.channels]
        states = _timeline(names, self._first_states, summary, quiet)
        spoken = {
            **common,
            "shapes": [*_mode_shapes(summary), *shapes],
            "marks": [*common["marks"], *said],
            "backdrop": _throttle(summary),
        }
        # The statistics of other methods have another meaning than the evidence.
        alone = summary.detector == GUARD
        for curves in self._curves:
            curves.alone.finish()
        statistics = [curves.statistic(spoken, alone) for curves in self._curves]
        return [
            Section(
                "The recording",
                f"{self._zoom_hint()} {_marks_hint(summary)}{self._alone_hint(alone)}",
                "",
                [states, *statistics],
            ),
            _episode_section(story, bool(scores.faults), unit, self._origin),
            *_temperature_section(summary, spoken),
            *_stretch_section(story),
            *(
                section
                for curves in self._curves
                for section in curves.sections(common, scale)
            ),
            *fault_sections(scores, unit),
            health_section(summary, unit),
            _channel_section(summary, unit),
            *_autopilot_section(summary.autopilot),
            _event_section(scores.events, unit),
            Section("Notes", "", [*summary.monitor.degraded, *notes(summary)]),
            Section("What was run", "", {**about, **_protection_levels(summary, unit)}),
        ]

    def _alone_hint(self, alone: bool) -> str:
        """Explain the evidence against channels that are left out."""
        if not alone or all(curves.alone.peak == 0.0 for curves in self._curves):
            return ""
        return (
            " The evidence falls when a channel is named, because the others agree. Dotted:"
            " the evidence against that channel alone, from its residual in each second."
        )

    def _zoom_hint(self) -> str:
        words = (
            "Drag across a plot to zoom all plots in time, double-click to see "
            "everything; arrow keys move the cursor. PNG and CSV at the corner of a plot save it."
        )
        if self._store.width == 1:
            return words
        return (
            f"{words} A long recording: of every {self._store.width} samples the smallest and the largest value are"
            " drawn; close up, the lines between them are no course of time."
        )


def _temperature_section(summary: Summary, layout: Mapping[str, Any]) -> list[Section]:
    """Draw the temperature of each IMU. Empty: the log has none."""
    lines = []
    for i, one in enumerate(summary.monitor.units):
        course = summary.context.temperatures.get(one.topic)
        if course is not None:
            x, y = _within(summary, course)
            look = {"color": colour_of(i)}
            line = {"type": "scatter", "name": one.name, "line": look}
            lines.append({**line, "x": x, "y": y})
    if not lines:
        return []
    figure = _plot(lines, 210, "temperature, °C", True, layout)
    hint = "A gyro that warms up changes its bias."
    return [Section("Temperature of each IMU", hint, "", [figure])]


def _within(summary: Summary, course: Course) -> tuple[list[float], list[float]]:
    """Return times, s, and values of a course from the first sample to the last."""
    time = (course.stamp - (summary.stream.origin_ns or 0)) * 1e-9
    inside = (time >= summary.scores.start_s) & (time <= summary.scores.end_s)
    return (
        np.round(time[inside], 3).tolist(),
        np.round(course.value[inside], 3).tolist(),
    )


def _throttle(summary: Summary) -> dict[str, list[float]] | None:
    """Return the throttle for the background of a plot. None: not logged."""
    course = summary.context.throttle
    if course is None:
        return None
    x, y = _within(summary, course)
    return {"x": x, "y": y}


def _shaded(summary: Summary) -> list[dict[str, Any]]:
    """Return what shades the times of the injected faults and of the gaps in the recording."""
    times = [("fault", fault.start_s, fault.stop_s) for fault in summary.scores.faults]
    times += [("gap", begin, end) for begin, end in summary.story.gaps]
    return [
        {"type": "rect", "kind": kind, "x0": begin, "x1": end}
        for kind, begin, end in times
    ]


def _stretch_section(story: Story) -> list[Section]:
    """Return the section about the stretches, none if there is one stretch."""
    stretches = stretch_words(story)
    if not stretches:
        return []
    return [Section("Stretches", "Each is judged for itself.", stretches)]


def _mode_shapes(summary: Summary) -> list[dict[str, Any]]:
    """Return the flight modes as labelled shades."""
    origin = summary.stream.origin_ns or 0
    scores = summary.scores
    modes = summary.context.modes
    begins = [(one.stamp - origin) * 1e-9 for one in modes]
    ends = [*begins, scores.end_s][1:]
    return [
        {
            "type": "rect",
            "kind": f"mode {'even' if k % 2 else 'odd'}",
            "x0": max(begin, scores.start_s),
            "x1": min(end, scores.end_s),
            "label": one.name,
        }
        for k, (one, begin, end) in enumerate(zip(modes, begins, ends, strict=True))
        if end > scores.start_s and begin < scores.end_s
    ]


def _channel_section(summary: Summary, unit: Unit) -> Section:
    """Lay out the channels at the end."""

    def figure(one: ChannelResult, value: float | None, form: str) -> str:
        if one.measured_in == RADIANS.name:
            return number(value and value * unit.factor, form)
        return number(value, form, f" {one.measured_in}")

    columns: Columns = {
        "channel": lambda one: one.name,
        "state": lambda one: one.state,
        "since": lambda one: (
            "the start" if one.since_s is None else f"{one.since_s:.3f} s"
        ),
        "reason": lambda one: one.reason or "-",
        "not checked": lambda one: percent(one.unchecked),
        f"residual, {unit.name} rms": lambda one: figure(
            one, one.residual_rms_rad_s, ".2g"
        ),
        "noise, noise_std": lambda one: number(one.noise, ".2g"),
        "spikes": lambda one: str(one.spikes),
        f"bias moved, {unit.name}": lambda one: figure(one, one.drift, "+.2g"),
    }
    return Section(
        "Channels",
        "At the end; the residual while OK.",
        head_and_rows(columns, summary.monitor.channels),
    )


def _episode_section(
    story: Story, scored: bool, unit: Unit, origin: int | None
) -> Section:
    """Lay out the episodes as cards with a sentence, a link to the plots, and details."""
    if not story.episodes:
        return Section(
            "What happened", "", ["Nothing was declared, and no channel fell silent."]
        )
    more = max(0, len(story.episodes) - PAGE.cards) + story.more
    hint = (
        "From the first declaration on. Size: how far the channel is from what the others give, +- its standard"
        f" error.{f' {more} more are left out.' if more else ''}"
    )
    first = story.episodes[: PAGE.cards]
    cards = (_card(one, scored, unit, origin) for one in first)
    return Section("What happened", hint, f'<div class="cards">{"".join(cards)}</div>')


def _card(one: Episode, scored: bool, unit: Unit, origin: int | None) -> str:
    room = max(PAGE.around, 0.2 * one.duration_s)
    low = max(0.0, one.start_s - room)
    high = one.end_s + room
    link = f'<a href="#t={low:.3f},{high:.3f}">show it</a>'
    date = date_of(origin + round(one.start_s * 1e9)) if origin is not None else None
    begin = [("begins", f"{date:%Y-%m-%d %H:%M:%S} UTC")] if date is not None else []
    told = (*begin, *detail_words(one, unit, scored))
    rows = "".join(
        f"<dt>{prose(title)}</dt><dd>{prose(words)}</dd>" for title, words in told
    )
    head = f"<h3>{prose(episode_words(one, unit))}.</h3>"
    return f'<article class="{one.state.lower()}">{head}{link}<dl>{rows}</dl></article>'


def _event_section(events: Sequence[StateChange], unit: Unit) -> Section:
    """Lay out the changes of state."""
    columns: Columns = {
        "time": lambda event: number(event.at_s, unit=" s"),
        "channel": lambda event: event.channel,
        "from": lambda event: event.before,
        "to": lambda event: event.state,
        "reason": lambda event: event.reason,
        "one of": lambda event: (
            ", ".join(event.group) if event.state == "AMBIGUOUS" else ""
        ),
        "error": lambda event: (
            unit_for(event, unit).words(event.error, 4) if event.error else ""
        ),
    }
    more = (
        f" {len(events) - PAGE.rows} more are left out."
        if len(events) > PAGE.rows
        else ""
    )
    hint = f"The history: what it came to stands above.{more}"
    return Section(
        "Changes of state",
        hint,
        head_and_rows(columns, events[: PAGE.rows]) if events else [],
    )


def _protection_levels(summary: Summary, unit: Unit) -> dict[str, str]:
    levels = summary.monitor.protection_level
    found = {}
    for when, values in {
        "at end": levels.at_end,
        "after one more loss": levels.after_one_more_loss,
    }.items():
        words = (
            "none" if value is None else figures(value * unit.factor, 4)
            for value in values
        )
        axes = " ".join(
            f"{axis} {value}" for axis, value in zip(_AXES, words, strict=True)
        )
        found[f"protection level {when}"] = f"{axes} {unit.name}"
    return found


def _plot(
    data: Sequence[Mapping[str, Any]],
    height: int,
    title: str,
    last: bool,
    layout: Mapping[str, Any],
) -> Figure:
    return {
        "data": data,
        "layout": time_layout(height, last, yaxis={"title": {"text": title}}, **layout),
    }


def report_of(config: Config, unit: Unit = RADIANS, own: str = "") -> Report:
    """Return the empty page of a replay with these settings; unit and own as of `Report`."""
    geometry = build_geometry(config)
    noise_std = build_noise(config, geometry.n).noise_std
    return Report(geometry, noise_std, config.sample_rate, unit, own)


# Two replays side by side


class Replayed(NamedTuple):
    """A replay for a page with two."""

    report: Report
    """Its curves. The begins of the names of the series of two reports differ."""
    summary: Summary
    """Its result."""
    about: Mapping[str, str]
    """Head of its page."""


def page_of(replays: Sequence[Replayed]) -> str:
    """Lay out one replay, or two side by side, A and B, over the same axes."""
    if len(replays) == 1:
        report, summary, about = replays[0]
        return report.html(summary, about)
    first, second = replays
    lines: list[str | Verdict] = []
    lettered = []
    for letter, (report, summary, about) in zip("AB", (first, second), strict=True):
        lines += report.lines(summary, letter)
        lettered.append(_lettered(report.sections(summary, about), letter))
    title = f"fdi_ros: {first.summary.bag} beside {second.summary.bag}"
    stores = [*first.report.stores, *second.report.stores]
    return page(title, lines, _paired(*lettered), stores)


def _lettered(sections: Sequence[Section], letter: str) -> list[Section]:
    """Begin the title of each plot with the letter of its replay."""
    return [
        replace(one, figures=[_titled(figure, letter) for figure in one.figures])
        for one in sections
    ]


def _titled(figure: Mapping[str, Any], letter: str) -> Figure:
    title = f"{letter} {figure['layout'].get('title', '')}".rstrip()
    return {**figure, "layout": {**figure["layout"], "title": title}}


def _paired(firsts: Sequence[Section], seconds: Sequence[Section]) -> list[Pair]:
    """Pair the sections of two replays by their titles, and give their plots the same axes."""
    by_title = {one.title: one for one in seconds}
    pairs = [Pair(one, by_title.pop(one.title, None)) for one in firsts]
    pairs += [Pair(None, one) for one in by_title.values()]
    for pair in pairs:
        for place, row in enumerate(pair.rows):
            layouts = [figure["layout"] for figure in row if figure is not None]
            if len(layouts) == 2:
                _share_axes(layouts, f"{pair.title} {place}")
    return pairs


def _share_axes(layouts: Sequence[dict[str, Any]], name: str) -> None:
    """Give two plots the same range of x, the same cursor, and the same scale of values."""
    kinds = [layout.get("yaxis", {}).get("type") for layout in layouts]
    for layout in layouts:
        layout.setdefault("link", name)
        if "rows" not in layout:
            layout.setdefault("scale", name)
        if "log" in kinds:
            layout["yaxis"]["type"] = "log"


# States and marks over time


STATE_STYLES = {
    "OK": ("#8fbf9f", ""),
    "SUSPECT": ("#e6c84f", "slashes"),
    "AMBIGUOUS": ("#e08a3c", "crosses"),
    "FAULTY": ("#c0392b", "crosses"),
    "STALE": ("#5b6b8c", "dots"),
    "UNCHECKED": ("#b8bec6", ""),
    "EXCLUDED": ("#7a5c99", "lines"),
}
"""Colour and pattern of each state."""


def _timeline(
    names: Sequence[str],
    first: Sequence[str],
    summary: Summary,
    more: Mapping[str, Any],
) -> Figure:
    """Draw the states of the channels, one row each.

    ``first``: states at the first sample. Empty: no sample.
    """
    scores = summary.scores
    holes = summary.story.gaps
    begin = scores.start_s
    end = max(scores.end_s, scores.start_s + 1e-9)
    current = {
        name: (first[i] if first else "UNCHECKED", begin, "")
        for i, name in enumerate(names)
    }
    spans: dict[str, dict[str, list[Any]]] = {}

    def close(name: str, until: float) -> None:
        state, since, reason = current[name]
        into = spans.setdefault(state, {"row": [], "from": [], "to": [], "text": []})
        for low, high in _recorded(since, max(until, since), holes):
            into["row"].append(names.index(name))
            into["from"].append(low)
            into["to"].append(high)
            into["text"].append(
                f"{name} {state} {reason} from {low:.3f} s to {high:.3f} s"
            )

    changes = [event for event in scores.events if event.before != event.state]
    for event in changes[: PAGE.changes]:
        close(event.channel, event.at_s)
        current[event.channel] = (event.state, event.at_s, event.reason)
    for name in names:
        close(name, end)
    data = [
        {
            "type": "spans",
            "name": state,
            "line": {"color": colour},
            "pattern": pattern,
            **spans[state],
        }
        for state, (colour, pattern) in STATE_STYLES.items()
        if state in spans
    ]
    layout = time_layout(36 + 24 * len(names), rows=list(names), title="States")
    layout["xaxis"]["range"] = [begin, end]
    layout |= more
    return {"data": data, "layout": layout}


def _recorded(
    since: float, until: float, holes: Sequence[tuple[float, float]]
) -> list[tuple[float, float]]:
    """Return the recorded parts of a span of time, s."""
    parts = []
    for begin, end in holes:
        if since < end and begin < until:
            if since < begin:
                parts.append((since, begin))
            since = end
    return [*parts, (since, until)] if since <= until else parts


def _in_view(
    faults: Sequence[Outcome], episodes: Sequence[Episode]
) -> list[list[float]]:
    """Return the times, s, that scales must cover: begin and detection of faults, and declarations."""
    times = [
        time
        for fault in faults
        for time in (fault.start_s, fault.detected_at_s)
        if time is not None
    ]
    times += [one.since_s for one in episodes if one.declares]
    return [[time, time + PAGE.in_view] for time in times[: PAGE.marks]]


def _marks(
    faults: Sequence[Outcome], episodes: Sequence[Episode]
) -> list[dict[str, Any]]:
    """Return marks for detections, isolations, and episodes without an injected fault."""
    found: list[tuple[float | None, str, str, str]] = []
    for fault in faults:
        for kind, at in (
            ("detected", fault.detected_at_s),
            ("isolated", fault.isolated_at_s),
        ):
            found.append((at, kind, f"{fault.kind} on {fault.channel}: {kind}", ""))
    why = ", no injected fault explains it" if faults else ""
    for one in [one for one in episodes if one.declares and not one.injected][
        : PAGE.marks
    ]:
        found.append(
            (one.start_s, "declared", f"{one.steps[0].who} {one.steps[0].state}", why)
        )
        if one.state == "FAULTY" and one.since_s > one.start_s:
            found.append((one.since_s, "isolated", f"{one.who} {one.state}", why))
    known = [
        (at, kind, f"{words} at {at:.3f} s{why}")
        for at, kind, words, why in found
        if at is not None
    ]
    return [{"x": at, "kind": kind, "text": text} for at, kind, text in known]


def _autopilot_marks(summary: Summary) -> list[dict[str, Any]]:
    """Return marks for the messages of the autopilot. Errors are marked with their text."""
    return [
        {
            "x": one.at_s,
            "kind": "autopilot",
            "text": f"autopilot at {one.at_s:.3f} s: {one.text}",
        }
        | ({"label": f"autopilot: {one.text}"} if one.kind == "ERR" else {})
        for one in summary.autopilot[: PAGE.marks]
    ]


def _autopilot_section(said: Sequence[AutopilotText]) -> list[Section]:
    columns: Columns = {
        "time": lambda one: f"{one.at_s:.3f} s",
        "kind": lambda one: one.kind,
        "words": lambda one: one.text,
    }
    return (
        [
            Section(
                "What the autopilot said",
                "",
                head_and_rows(columns, said[: PAGE.rows]),
            )
        ]
        if said
        else []
    )


def _marks_hint(summary: Summary) -> str:
    """Explain marks and shades."""
    hint = "✕ an episode begins, ◆ its channel is isolated."
    if summary.scores.faults:
        hint = "Shaded: injected faults; ▼ detected, ◆ isolated, ✕ declared without an injected fault that explains it."
    hint += " □ the autopilot said something." if summary.autopilot else ""
    if summary.context.modes:
        hint += " Background: flight modes, named at the bottom."
    if summary.context.throttle is not None:
        hint += " Blue area: throttle, from zero to full."
    return hint + (
        " Grey: gaps; each stretch between them is judged for itself."
        if summary.story.gaps
        else ""
    )
