# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Means of all channels over spans of time, which show how slow errors went.

They are of the values as recorded, with injected faults: the monitor subtracts errors that it
has learned, and with them a part of a slow drift. An episode begins late in such a drift, so
that the means cover the whole stretch of the recording.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.core.states import ChannelState
from fdi_ros.model.geometry import Geometry, spans_space
from fdi_ros.model.quantity import RATE, Quantity
from fdi_ros.model.samples import Array
from fdi_ros.replay.episodes import Episode, Story, Stretch, warming_words
from fdi_ros.replay.outcomes import SQUARED
from fdi_ros.replay.warming import LARGEST_SLOPE, Warming, fit_warming


class _Spans(NamedTuple):
    """Spans of time over which values are averaged."""

    #: largest number of spans. If exceeded, neighbours are merged
    most: int = 512
    #: width of a span at first, s. Temperatures of chips change more slowly
    first: float = 1.0
    #: share of the samples of a span that a channel must have for a mean. In
    #: motion, means of other samples are means of other rates
    filled: float = 0.9
    #: share of the spans of a stretch in which a channel must have a mean to
    #: measure others
    covered: float = 0.5


SPANS = _Spans()

_UNUSED = (ChannelState.STALE, ChannelState.EXCLUDED)
"""States in which a value says nothing of the vehicle: it is old, or another unit's."""


class Temperature(NamedTuple):
    """Temperature of a unit."""

    time: Array
    """(k,) times, s from the first message, ascending."""
    value: Array
    """(k,) temperatures, degC."""


class SpanMeans:
    """Means of the n channels of one monitor, taken block by block in bounded memory."""

    def __init__(self, geometry: Geometry, quantity: Quantity = RATE) -> None:
        self._geometry = geometry
        self._quantity = quantity
        self._begin = np.nan
        """Begin of the first span, s from the first message."""
        self._width = SPANS.first
        self._counts = np.zeros((geometry.n, SPANS.most))
        self._totals = np.zeros((geometry.n, SPANS.most))

    def add(self, time: Array, values: Array, state: NDArray[np.uint8]) -> None:
        """Add the next samples.

        Times (N,), s from the first message, values (N, n), rad/s or m/s^2, and
        states (N, n).
        """
        if not len(time):
            return
        if np.isnan(self._begin):
            self._begin = float(time[0])
        while time[-1] - self._begin >= SPANS.most * self._width:
            self._counts = _merged(self._counts)
            self._totals = _merged(self._totals)
            self._width *= 2
        known = np.isfinite(values) & (np.abs(values) < SQUARED)
        known &= ~np.isin(state, _UNUSED)
        passed = (time - self._begin) / self._width
        span = np.maximum(passed, 0.0).astype(np.intp)
        for i in range(self._geometry.n):
            own = known[:, i]
            self._counts[i] += np.bincount(span[own], minlength=SPANS.most)
            self._totals[i] += np.bincount(span[own], values[own, i], SPANS.most)

    def warming(
        self,
        one: Episode,
        story: Story,
        temperatures: Mapping[str, Temperature],
    ) -> Iterator[Warming]:
        """Yield the channels of an episode whose errors follow the temperature of their unit.

        ``temperatures``: of units by their names.
        """
        geometry = self._geometry
        time, means = self._means(story.stretches[one.stretch - 1])
        doubted = {
            name
            for each in story.declared
            if each.stretch == one.stretch
            for name in each.ever
        }
        faulty = one.channels if one.state == "FAULTY" else ()
        for i, (name, unit) in enumerate(
            zip(geometry.channel_names, geometry.unit_of, strict=True)
        ):
            if name not in one.channels or unit not in temperatures:
                continue
            # With many faults, those of other times are better than no reference.
            for left_out in (doubted, one.ever, faulty):
                vector = self._vector(means, {*left_out, name})
                if vector is not None:
                    break
            else:
                continue
            course = temperatures[unit]
            fit = fit_warming(
                time,
                means[:, i] - vector @ geometry.axes[i],
                np.interp(time, *course, left=np.nan, right=np.nan),
                vector,
                LARGEST_SLOPE[self._quantity.unit],
            )
            if fit is not None:
                yield Warming(name, unit, *fit)

    def _means(self, part: Stretch) -> tuple[Array, Array]:
        """Return the times (k,), s, and the means (k, n) of the spans of a stretch.

        NaN: the channel has too few samples.
        """
        most = self._counts.max(axis=0)
        spans = np.flatnonzero(most)
        middle = self._begin + (spans + 0.5) * self._width
        inside = (middle >= part.start_s) & (middle <= part.end_s)
        spans = spans[inside]
        counts = self._counts[:, spans]
        enough = counts >= SPANS.filled * most[spans]
        means = np.full(counts.shape, np.nan)
        means[enough] = self._totals[:, spans][enough] / counts[enough]
        return np.asarray(middle[inside], dtype=np.float64), means.T

    def _vector(self, means: Array, left_out: Collection[str]) -> Array | None:
        """Return what the other channels measure, (k, 3). None: they do not determine it.

        ``means`` (k, n). ``left_out``: names of channels.
        """
        covered = np.isfinite(means).mean(axis=0) if len(means) else np.zeros(0)
        others = [
            k
            for k, (name, share) in enumerate(
                zip(self._geometry.channel_names, covered, strict=False)
            )
            if name not in left_out and share >= SPANS.covered
        ]
        axes = self._geometry.axes[others]
        if not spans_space(axes):
            return None
        vector: Array = means[:, others] @ np.linalg.pinv(axes).T
        return vector


def _merged(values: Array) -> Array:
    """Merge each two neighbours of sums (n, SPANS.most)."""
    pairs = values.reshape(len(values), -1, 2).sum(axis=2)
    return np.hstack([pairs, np.zeros_like(pairs)])


def with_warming(
    story: Story,
    means: Mapping[str, SpanMeans],
    temperatures: Mapping[str, Temperature],
) -> Story:
    """Return a story whose declared episodes have the errors that follow a temperature.

    ``means``: of gyros and accelerometers by the names of their units of measurement.
    ``temperatures``: of units by their names.
    """

    def explained(one: Episode) -> Episode:
        if one.halves:
            one = replace(one, halves=tuple(map(explained, one.halves)))
        elif one.declares and one.measured_in in means:
            found = means[one.measured_in].warming(one, story, temperatures)
            one = replace(one, warming=tuple(found))
        return replace(one, warming_words=warming_words(one))

    if not temperatures:
        return story
    return replace(story, episodes=tuple(map(explained, story.episodes)))
