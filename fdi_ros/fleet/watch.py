# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the pipeline says of one recording, block by block; memory does not grow with the length of the flight."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fdi_ros.errors import BagError
from fdi_ros.fleet.flights import Flight, FlightEpisode, FlightEvent
from fdi_ros.model.geometry import Geometry, axis_words
from fdi_ros.model.samples import Array, Block
from fdi_ros.monitor.diagnostics import degraded
from fdi_ros.monitor.output import ChannelState, Event, Output
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.replay.episodes import Episode, Story, Stretches
from fdi_ros.replay.outcomes import finite
from fdi_ros.replay.recorder import Recorder, error_gain
from fdi_ros.setup.inspect import GAP
from fdi_ros.setup.inspect import Stretches as Seconds
from fdi_ros.text import date_of

PARTS = 120
"""Of what is kept of a flight."""
_SPANS = 4096
"""Of time while it is read; neighbours are put together when there would be more."""
_FIRST = 0.01
"""Of such a span at first, s."""


def difference_gains(geometry: Geometry, excluded: tuple[str, ...] = ()) -> Array:
    """Return the matrix (n, n) that makes of the values of a sample how far each is from what the other units say.

    That is the value less the rate by the channels of all other units (least squares) along its axis; where the other
    units do not tell, as of channels that are no units, by all other channels; a row of zeros: nothing tells.
    """
    n, names = geometry.n, geometry.channel_names
    gains = np.zeros((n, n))
    for i in range(n):
        own = next((set(unit) for unit in geometry.units if i in unit), {i})
        for left_out in (own, {i}):
            others = [k for k in range(n) if k not in left_out and names[k] not in excluded]
            if (gain := error_gain(geometry.axes, i, others)) is not None:
                gains[i] = gain
                break
    return gains


class Course:
    """Statistic and differences of n channels over the time of a flight.

    Parameters
    ----------
    gains
        (n, n) of `difference_gains`.
    """

    def __init__(self, gains: Array) -> None:
        n = len(gains)
        self._gains = gains
        self._width = _FIRST
        self._largest = np.full(_SPANS, -np.inf)
        self._sums = np.zeros((2, n, _SPANS))
        """Number of differences, and their sum, rad/s."""
        self._squares = np.zeros(n)

    def add(self, seconds: Array, ratio: Array, z: Array) -> None:
        """Take in samples (N,): s from the first, statistic over threshold, values (N, n), rad/s."""
        while seconds[-1] >= _SPANS * self._width:
            self._largest = np.concatenate([self._largest.reshape(-1, 2).max(axis=1), np.full(_SPANS // 2, -np.inf)])
            together = self._sums.reshape(*self._sums.shape[:2], -1, 2).sum(axis=3)
            self._sums = np.concatenate([together, np.zeros_like(together)], axis=2)
            self._width *= 2
        span = np.minimum((seconds / self._width).astype(np.intp), _SPANS - 1)
        known = np.isfinite(ratio)
        np.maximum.at(self._largest, span[known], ratio[known])
        finite = np.isfinite(z) & (np.abs(z) < 1e6)
        difference = np.where(finite, z, 0.0) @ self._gains.T
        for i, gain in enumerate(self._gains):
            rows = finite[:, gain != 0].all(axis=1) if gain.any() else np.zeros(len(z), dtype=bool)
            for values, sums in zip((None, difference[rows, i]), self._sums[:, i], strict=True):
                sums += np.bincount(span[rows], values, _SPANS)
            self._squares[i] += float(difference[rows, i] @ difference[rows, i])

    def largest(self, duration: float) -> tuple[float, ...]:
        """Largest ratio in each of `PARTS` equal parts of the time; NaN where nothing was judged."""
        parts = np.full(PARTS, -np.inf)
        np.maximum.at(parts, self._part(duration), self._largest)
        return tuple(np.where(np.isfinite(parts), parts, np.nan).tolist())

    def differences(self, duration: float) -> tuple[float, ...]:
        """Mean difference (n * PARTS,) of each channel in each part, channel after channel, rad/s; NaN: not known."""
        part = self._part(duration)
        count, total = (np.array([np.bincount(part, row, PARTS) for row in sums]) for sums in self._sums)
        return tuple(_divided(total, count).ravel().tolist())

    def mean_and_std(self) -> tuple[Array, Array]:
        """Mean difference of each channel over the flight, and its standard deviation in it, (n,), rad/s."""
        count, total = self._sums.sum(axis=2)
        mean = _divided(total, count)
        return mean, np.sqrt(np.maximum(0.0, _divided(self._squares, count) - mean**2))

    def _part(self, duration: float) -> NDArray[np.intp]:
        """Part (_SPANS,) that each span lies in by its middle."""
        middle = (np.arange(_SPANS) + 0.5) * self._width
        return np.minimum(PARTS * middle / max(duration, 1e-9), PARTS - 1).astype(np.intp)


def _divided(total: Array, count: Array) -> Array:
    """Divide sums by counts; NaN of nothing."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(count > 0, total / count, np.nan))


# One recording -------------------------------------------------------------------------------------------------------


FEW = 5
"""Samples after start-up before the first has to be judged."""
INTERVALS = 200_000
"""Between samples, which tell the usual one."""
MOST_EVENTS = 10_000
"""Of a flight that are kept; more are counted."""
_DECLARED = (ChannelState.FAULTY, ChannelState.AMBIGUOUS)


class Watch:
    """Follows one pipeline through one recording.

    Parameters
    ----------
    pipeline
        As it starts.
    row
        What is known of the flight before.
    """

    def __init__(self, pipeline: Pipeline, row: Flight) -> None:
        self._pipeline, self._row = pipeline, row
        self._startup = pipeline.config.bias.startup_bias_duration
        self._recorder = Recorder(pipeline.geometry, pipeline.noise)
        self._stretches = Stretches()
        self._course = Course(difference_gains(pipeline.geometry, pipeline.config.excluded_channels))
        self._seconds = Seconds(pipeline.geometry.n)
        self._degraded: dict[str, str] = {}
        self._origin = self._last = 0
        """First and last stamp, ns."""
        self._samples = 0
        self._usual = math.nan
        """Interval by the first samples, s."""
        self._intervals = np.empty(0)
        """The first ones, s."""
        self._gaps, self._longest = 0, math.nan
        self._judged = np.zeros(2, dtype=np.int64)
        """Samples that were judged: all, and those after start-up."""
        self._after = 0
        """Samples after start-up."""
        self._judged_time = self._watched = 0.0
        self._standing = False
        """Something stood declared after the last sample."""
        self._largest, self._largest_at = math.nan, math.nan
        self._suspected = self._more_events = 0
        self._events: list[FlightEvent] = []

    def take(self, block: Block) -> None:
        """Judge the next block, stretch by stretch."""
        for anew, part in self._stretches.cut(block):
            if anew:
                self._pipeline.reset()
                self._recorder.begin_stretch()
                self._standing = False
            if len(part):
                self._take(part)

    def _take(self, block: Block) -> None:
        output = self._pipeline.process(block)
        self._degraded |= degraded(self._pipeline.status())
        if not self._samples:
            self._origin = self._last = int(block.stamp[0])
        seconds = np.round((block.stamp - self._origin) * 1e-9, 9)
        self._recorder.add(seconds, output)
        for event in output.events:
            self._add_event(event)
        self._add_times(block.stamp, seconds, output)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where(output.threshold > 0, output.statistic / output.threshold, np.nan)
        if np.isfinite(ratio).any() and not np.nanmax(ratio) <= self._largest:
            self._largest, self._largest_at = float(np.nanmax(ratio)), float(seconds[np.nanargmax(ratio)])
        self._course.add(seconds, ratio, block.z)
        whole = np.isfinite(block.z).all(axis=1)
        self._seconds.add(block.z[whole], block.stamp[whole], 1.0 / self._usual if self._usual > 0 else 0.0)
        self._samples += len(block)
        self._last = int(block.stamp[-1])

    def _add_times(self, stamp: NDArray[np.int64], seconds: Array, output: Output) -> None:
        """Take in when the samples were, which were judged, and while nothing stood declared."""
        steps = np.diff(stamp, prepend=self._last) * 1e-9
        judged = np.isfinite(output.threshold)
        standing = np.asarray(np.isin(output.state, _DECLARED).any(axis=1))
        before = np.concatenate([[self._standing], standing[:-1]])
        if not self._samples:
            # Before the first sample there is no interval.
            steps, judged_then, before = steps[1:], judged[1:], before[1:]
        else:
            judged_then = judged
        if len(steps) and math.isnan(self._usual):
            self._usual = float(np.median(steps))
        known = judged_then & (steps <= GAP * self._usual)
        self._judged_time += float(steps[known].sum())
        self._watched += float(steps[known & ~before].sum())
        self._gaps += int((steps > GAP * self._usual).sum()) if self._usual > 0 else 0
        self._longest = float(np.fmax(self._longest, steps.max())) if len(steps) else self._longest
        if len(self._intervals) < INTERVALS:
            self._intervals = np.concatenate([self._intervals, steps])[:INTERVALS]
        after = seconds > self._startup + FEW * self._usual
        self._after += int(after.sum())
        self._judged += int(judged.sum()), int(judged[after].sum())
        self._standing = bool(standing[-1])

    def _add_event(self, event: Event) -> None:
        """Take in a change of state."""
        self._suspected += event.after is ChannelState.SUSPECT
        if len(self._events) >= MOST_EVENTS:
            self._more_events += 1
            return
        names = self._pipeline.channel_names
        self._events.append(
            FlightEvent(
                flight=self._row.flight,
                path=self._row.path,
                vehicle=self._row.vehicle,
                at=(event.stamp - self._origin) * 1e-9,
                stamp=event.stamp,
                channel=names[event.channel],
                before=event.before.name,
                after=event.after.name,
                declares=event.declares,
                group=tuple(names[i] for i in event.group),
                reason=event.reason.value,
                error=event.error,
            )
        )

    def row(self) -> Flight:
        """Return what is known of the flight now.

        Raises
        ------
        BagError
            If there was not a single sample.
        """
        if not self._samples:
            raise BagError("its topics have no time in common: there is no sample of all channels")
        status, story = self._pipeline.status(), self._recorder.story()
        duration = (self._last - self._origin) * 1e-9
        usual = float(np.median(self._intervals)) if len(self._intervals) else math.nan
        rest, motion, mean = self._seconds.quiet_noise(), self._seconds.moving_noise(), self._seconds.rest_mean()
        difference, scatter = self._course.mean_and_std()
        date = date_of(self._origin)
        # What hides for a while, and comes back as it was, is declared once.
        told = [step for one in story.declared for step in one.steps]
        alone = sum(len(step.channels) for step in told if step.state == "FAULTY")
        sets = sum(step.state == "AMBIGUOUS" for step in told)
        return replace(
            self._row,
            start=self._origin,
            date="" if date is None else f"{date:%Y-%m-%dT%H:%M:%SZ}",
            duration=duration,
            stretches=len(story.stretches),
            samples=self._samples,
            rate=1.0 / usual if usual > 0 else None,
            gaps=self._gaps,
            longest_gap=finite(self._longest),
            judged=float(self._judged[1] / self._after if self._after else self._judged[0] / self._samples),
            judged_time=self._judged_time,
            watched=self._watched,
            note=status.note,
            degraded="; ".join(self._degraded.values()),
            episodes=_apart(story),
            happened=tuple(one.words for one in story.episodes),
            declared=alone + sets,
            sets=sets,
            suspected=self._suspected,
            events_left_out=self._more_events,
            largest=finite(self._largest),
            largest_at=finite(self._largest_at),
            course=self._course.largest(duration),
            channels=self._pipeline.channel_names,
            axes=tuple(axis_words(self._pipeline.geometry, i) for i in range(self._pipeline.geometry.n)),
            state=tuple(channel.state.name for channel in status.channels),
            reason=tuple(channel.reason.value for channel in status.channels),
            noise_rest=tuple(rest.tolist()),
            noise_motion=tuple(motion.tolist()),
            vibration=tuple(np.sqrt(np.maximum(0.0, motion**2 - rest**2)).tolist()),
            mean_rest=tuple(mean.tolist()),
            bias=tuple(
                math.nan if channel.state is ChannelState.UNCHECKED else bias
                for channel, bias in zip(status.channels, status.bias, strict=True)
            ),
            bias_state=status.bias_state,
            difference=tuple(difference.tolist()),
            difference_std=tuple(scatter.tolist()),
            difference_course=self._course.differences(duration),
            units=tuple(unit.name for unit in status.units),
            delay=tuple(status.delays),
            delay_std=tuple(status.delay_std),
        )

    def events(self) -> tuple[FlightEvent, ...]:
        """Return the changes of state."""
        return tuple(self._events)

    def episodes(self) -> tuple[FlightEpisode, ...]:
        """Return what happened."""
        return tuple(self._episode(one) for one in self._recorder.story().episodes)

    def _episode(self, one: Episode) -> FlightEpisode:
        row, at = self._row, date_of(self._origin + round(one.start_s * 1e9))
        sizes = [candidate.size for candidate in one.candidates]
        apart = [one.apart.size] if one.apart is not None else sizes
        largest = max((size for size in apart if size is not None), key=lambda size: abs(size.rad_s), default=None)
        return FlightEpisode(
            flight=row.flight,
            path=row.path,
            vehicle=row.vehicle,
            date="" if at is None else f"{at:%Y-%m-%dT%H:%M:%SZ}",
            stretch=one.stretch,
            state=one.state,
            declares=one.declares,
            who=one.who,
            channels=one.channels,
            axes=tuple(candidate.axis for candidate in one.candidates),
            start=one.start_s,
            since=one.since_s,
            end=one.end_s,
            stands=one.stands,
            size=None if largest is None else largest.rad_s,
            size_std=None if largest is None else largest.std_rad_s,
            course="" if largest is None else largest.course,
            ratio=one.evidence.ratio,
            reason=one.evidence.reason,
            published=one.rate.published,
            words=one.words,
        )


def _apart(story: Story) -> int:
    """Count the episodes that began while no other stood."""
    count, stretch, until = 0, 0, -math.inf
    for one in story.declared:
        count += one.stretch != stretch or one.start_s > until
        until = one.end_s if one.stretch != stretch else max(until, one.end_s)
        stretch = one.stretch
    return count
