# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Health of channels and units in a recording: messages, finite values, saturation.

All figures but the noise are measured on the recorded values, independent of the monitor.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fdi_ros.bag.flight_context import FlightContext
from fdi_ros.bag.raw import Batch
from fdi_ros.bag.samples import steps_of
from fdi_ros.core.states import ChannelState
from fdi_ros.model.samples import Array, Int, flag_runs
from fdi_ros.monitor.output import Output
from fdi_ros.monitor.recent import USUAL_QUANTILE
from fdi_ros.monitor.soundness import (
    REPORTED,
    WHOLE,
    UnitHealth,
    own_noise,
)
from fdi_ros.monitor.status import CERTAIN_SIGMAS


class _Windows(NamedTuple):
    """Windows in which messages are counted, and the rates that they show."""

    #: number of windows. For longer recordings their length doubles
    most: int = 4096
    #: length of a window at first, s
    first: float = 1.0
    #: smallest mean number of messages in a window for a rate
    messages: float = 20.0
    #: share of the usual count from which on a window counts for the usual rate
    usual: float = 0.9
    #: share of the usual count below which a unit is slow
    slow: float = 0.6
    #: windows in a row that a unit is slow at least
    least_slow: int = 3
    #: messages that a window has more by jitter of their times at its edges
    edge: float = 1.5


WINDOWS = _Windows()


class _Bins(NamedTuple):
    """Bins for the intervals between messages: 10 us to 1.3 hours."""

    #: number of bins
    number: int = 400
    #: lower edge of the first bin, s
    shortest: float = 1e-5
    #: upper over lower edge of a bin. Three bins together are 15 % wide
    ratio: float = 1.05
    #: share of the intervals in the bin of their median and beside it, from which
    #: on messages have a usual interval. With losses at random it is the share of
    #: the messages that arrive; arrival times without order have a tenth there, and
    #: no usual interval
    steady: float = 0.5


BINS = _Bins()


MOST_HOLES = 1000
"""Largest number of holes that are kept."""

STEADY_TIME = 0.1
"""Share of the time that these intervals are at least."""
NOISE_WINDOW = 3.0
"""Duration of a window in which noise is measured, s: some swings of a loose mount."""
LEAST_USUAL_WINDOWS = 3
"""Smallest number of windows for a noise: fewer are dominated by the start-up."""

LEAST_TURN = 3.0
"""Size of the rate over that of the residual, from which on a share of the rate can be seen in it."""
LEAST_LEFT = 0.2
"""Largest share of the variance of the residual that a scale error leaves, where it is its main part."""


class Delivery(NamedTuple):
    """How one topic delivered its messages."""

    share: float
    """Share of the messages that arrived, by its usual rate and that of the other topics."""
    rate: float | None
    """Usual messages per second, Hz. None: too few messages."""
    slow_from: float | None = None
    """Start of the longest time at less than `WINDOWS.slow` of its rate, s. None: no such time."""
    slow_to: float | None = None
    """End of that time, s. None: it lasts to the end, or there is no such time."""
    slow_rate: float | None = None
    """Messages per second in that time, Hz."""


class Deliveries:
    """Counts the messages of topics in windows of time, in bounded memory."""

    def __init__(self, topics: int, start: float = 0.0) -> None:
        """``start``: time of the first message that is counted, s."""
        self._counts = np.zeros((topics, WINDOWS.most), dtype=np.int64)
        self._start = start
        self._width = WINDOWS.first
        self._first: int | None = None
        """Time of recording of the first message, ns."""
        self._last = 0
        """Latest time of recording, ns."""
        self._newest = np.full(topics, -1, dtype=np.int64)
        """Time of recording of the last message of each topic, ns. -1: none."""
        self._intervals = np.zeros((topics, BINS.number), dtype=np.int64)
        """Number of intervals between messages by their length."""
        self._lengths = np.zeros((topics, BINS.number))
        """Their sums, s."""

    def tap(self, batch: Batch, rows: Int) -> None:
        """Count some rows of a batch of raw messages."""
        if not len(rows):
            return
        times = batch.log_time[rows]
        if self._first is None:
            self._first = int(times[0])
        self._last = max(self._last, int(times.max()))
        since = np.maximum(times - self._first, 0) * 1e-9
        while since.max() >= WINDOWS.most * self._width:
            halved = self._counts.reshape(len(self._counts), -1, 2).sum(axis=2)
            self._counts = np.hstack([halved, np.zeros_like(halved)])
            self._width *= 2
        windows = (since / self._width).astype(np.intp)
        topics = batch.topic[rows]
        np.add.at(self._counts, (topics, windows), 1)
        for k in np.unique(topics).tolist():
            self._tap_intervals(k, times[topics == k])

    def _tap_intervals(self, k: int, times: Int) -> None:
        """Take the times of recording of further messages of topic k, ns."""
        steps = steps_of(self._newest, k, times) * 1e-9
        steps = steps[steps > 0.0]
        bins = np.log(steps / BINS.shortest) / np.log(BINS.ratio)
        bins = np.clip(bins, 0, BINS.number - 1).astype(np.intp)
        np.add.at(self._intervals[k], bins, 1)
        np.add.at(self._lengths[k], bins, steps)

    def _steady_rate(self, k: int) -> float:
        """Return the rate of topic k by the interval that most of its messages have, Hz.

        0: they have no such interval. Messages that are lost at random shorten no interval,
        but lower every count.
        """
        counts = self._intervals[k]
        middle = int(np.searchsorted(counts.cumsum(), 0.5 * counts.sum()))
        near = slice(max(middle - 1, 0), middle + 2)
        alike = int(counts[near].sum())
        if alike < max(BINS.steady * counts.sum(), WINDOWS.messages):
            return 0.0
        seconds = float(self._lengths[k, near].sum())
        # Messages that come twice, or in pairs, are close together for little of the time.
        if seconds < STEADY_TIME * self._lengths[k].sum():
            return 0.0
        return alike / seconds

    def result(self) -> list[Delivery]:
        """Return how each topic delivered."""
        if self._first is None:
            return [Delivery(0.0, None) for _ in self._counts]
        # The last window is cut off by the end of the recording.
        length = int((self._last - self._first) * 1e-9 / self._width)
        counts = self._counts[:, :length].astype(np.float64)
        # Mean number of messages of each topic, in windows with messages.
        with_messages = (counts > 0).sum(axis=1)
        usual_count = counts.sum(axis=1) / np.maximum(with_messages, 1)
        fewest = usual_count[usual_count > 0].min(initial=WINDOWS.messages)
        together = 1
        while (
            length // together > 2 * WINDOWS.least_slow
            and fewest * together < WINDOWS.messages
        ):
            together *= 2
        width = self._width * together
        counts = counts[:, : length // together * together]
        counts = counts.reshape(len(counts), -1, together).sum(axis=2)
        if counts.shape[1] < 2 * WINDOWS.least_slow:
            return [Delivery(1.0, None) for _ in counts]
        steady_rates = [self._steady_rate(k) for k in range(len(counts))]
        steady: Array = np.array(steady_rates)
        highest = np.quantile(counts, USUAL_QUANTILE, axis=1)
        # Arrival times that jitter about the edge of a window move a message to the next one.
        highest = np.where(highest - width * steady <= WINDOWS.edge, 0.0, highest)
        usual: Array = np.maximum(np.maximum(highest, width * steady), 1.0)
        shares = counts / usual[:, None]
        # Messages that the recorder lost are missing on all topics.
        recorded = np.minimum(shares.max(axis=0), 1.0)
        shares = shares[:, recorded > 0] / np.maximum(recorded[recorded > 0], 1e-9)
        times: Array = np.asarray(self._start + width * np.flatnonzero(recorded > 0))
        # The quantile is a little more than the mean of the windows of a usual rate.
        full = counts >= WINDOWS.usual * usual[:, None]
        windows = np.maximum(full.sum(axis=1), 1)
        rates = (counts * full).sum(axis=1) / windows / width
        rates = np.maximum(rates, steady)
        return [
            _delivery(np.minimum(own, 1.0 + WINDOWS.edge / most), times, width, rate)
            for own, most, rate in zip(
                shares, usual.tolist(), rates.tolist(), strict=True
            )
        ]


def _delivery(shares: Array, times: Array, width: float, rate: float) -> Delivery:
    """Return how a topic delivered from its first message on.

    ``shares`` (k,) of its usual rate in windows that begin at ``times`` (k,) s and last
    ``width`` s. ``rate``: its usual rate, Hz.
    """
    if not shares.any():
        return Delivery(0.0, None)
    # The first window is incomplete.
    begun = int(np.argmax(shares > 0)) + 1
    shares = shares[begun:]
    times = times[begun:]
    if not len(shares):
        return Delivery(1.0, None)
    # What a window lacks by the jitter at its edges, the next one has.
    share = min(float(shares.mean()), 1.0)
    runs = flag_runs(shares < WINDOWS.slow).tolist()
    first, last = max(runs, key=lambda run: run[1] - run[0], default=[0, 0])
    if last - first < WINDOWS.least_slow:
        return Delivery(share, rate)
    is_to_end = last == len(shares)
    slow_to = None if is_to_end else float(times[last - 1] + width)
    slow_rate = rate * float(shares[first:last].mean())
    return Delivery(share, rate, float(times[first]), slow_to, slow_rate)


def with_delivery(unit: UnitHealth, delivery: Delivery) -> UnitHealth:
    """Return the health of a unit with what its topic delivered."""
    return replace(
        unit,
        delivered=delivery.share,
        rate_hz=delivery.rate,
        slow_from_s=delivery.slow_from,
        slow_to_s=delivery.slow_to,
        slow_rate_hz=delivery.slow_rate,
    )


def with_context(unit: UnitHealth, context: FlightContext) -> UnitHealth:
    """Return the health of a unit with its message and temperature in the log."""
    course = context.temperatures.get(unit.topic)
    temperature = None
    if course is not None:
        temperature = float(course.value.min()), float(course.value.max())
    origin = context.origins.get(unit.topic, "")
    return replace(unit, origin=origin, temperature_c=temperature)


class Usual(NamedTuple):
    """Usual errors of a channel."""

    noise: float
    """Standard deviation, without what follows the rate, rad/s. NaN: not measured."""
    followed: float = 0.0
    """Share of the rate along its axis that its errors contain. 0: none is certain."""
    followed_std: float = 0.0
    """Standard error of that share."""
    is_scale_error: bool = False
    """Whether its errors are mainly of that kind."""


class Holes:
    """Finds the times in which no unit delivered, between the first sample and the last."""

    def __init__(self) -> None:
        self._last: int | None = None
        """Stamp of the last sample, ns."""
        self._usual = np.inf
        """Usual interval of the samples, ns."""
        self.found: list[tuple[int, int]] = []
        """Stamps of the samples before and after each of the first holes, ns."""

    def add(self, stamp: Int) -> None:
        """Take the stamps of the next samples, ns."""
        if not len(stamp):
            return
        before = stamp[0] if self._last is None else self._last
        joined = np.concatenate([[before], stamp])
        steps = np.diff(joined)
        if len(stamp) > 1:
            self._usual = float(np.median(steps[1:]))
        elif self._last is not None:
            self._usual = min(self._usual, float(steps[0]))
        longest = max(REPORTED.missing_s * 1e9, WHOLE.intervals * self._usual)
        for k in np.flatnonzero(steps >= longest)[: MOST_HOLES - len(self.found)]:
            self.found.append((int(joined[k]), int(joined[k + 1])))
        self._last = int(stamp[-1])


class UsualNoise:
    """Measures the noise of channels, block after block: the median of windows.

    So a fault that is shorter than half of the recording does not change it.
    """

    def __init__(self, axes: Array) -> None:
        """``axes``: sensitivity axes, (n, 3)."""
        self._axes = axes
        self._noise: list[Array] = []
        """(n,) noise in each window, rad/s."""
        self._moments: list[Array] = []
        """(3, n) in each window: variance of the residual, of the rate along the axis, and their covariance."""
        self._window: list[Array] = []
        """(k, n) residuals of the present window, rad/s. NaN: the channel was not OK."""
        self._rates: list[Array] = []
        """(k, 3) rates of that window, rad/s."""
        self._begin: int | None = None
        """Stamp of its first sample, ns."""

    def add(self, output: Output) -> None:
        """Add the next samples."""
        residual = np.where(output.state == ChannelState.OK, output.residual, np.nan)
        rate = output.rate
        stamp = output.stamp
        while len(stamp):
            if self._begin is None:
                self._begin = int(stamp[0])
            inside = stamp < self._begin + NOISE_WINDOW * 1e9
            count = len(stamp) if inside.all() else int(inside.argmin())
            self._window.append(residual[:count])
            self._rates.append(rate[:count])
            residual = residual[count:]
            rate = rate[count:]
            stamp = stamp[count:]
            if len(stamp):
                window = np.concatenate(self._window)
                self._noise.append(own_noise(window, self._axes))
                along = np.concatenate(self._rates) @ self._axes.T
                self._moments.append(_moments(window, along))
                self._window = []
                self._rates = []
                self._begin = None

    def result(self) -> list[Usual]:
        """Return the usual errors of each channel."""
        if not self._noise:
            return [Usual(math.nan) for _ in self._axes]
        noise = np.array(self._noise)
        moments = np.array(self._moments)
        usual = [_usual(own, moments[:, :, i]) for i, own in enumerate(noise.T)]
        if any(one.is_scale_error for one in usual):
            return usual
        # What the others follow is then of their noise in the rate, not of a scale factor.
        return [Usual(one.noise) for one in usual]


def _moments(residual: Array, along: Array) -> Array:
    """Return variances of residuals (k, n) and of rates (k, n), and their covariances, (3, n).

    They are of the samples with both, and 0 with fewer than two.
    """
    known = np.isfinite(residual) & np.isfinite(along)
    count = np.maximum(known.sum(axis=0), 1)
    pair = np.where(known, np.stack([residual, along]), 0.0)
    pair = np.where(known, pair - pair.sum(axis=1, keepdims=True) / count, 0.0)
    products = np.stack([pair[0] * pair[0], pair[1] * pair[1], pair[0] * pair[1]])
    moments: Array = products.sum(axis=1) / count
    return moments


def _usual(noise: Array, moments: Array) -> Usual:
    """Return the usual errors of a channel with noise (k,) and moments (k, 3) in k windows."""
    measured = np.isfinite(noise)
    if measured.sum() < LEAST_USUAL_WINDOWS:
        return Usual(math.nan)
    usual = float(np.median(noise[measured]))
    residual, rate, both = moments[measured].T
    # Else noise that is in the rate, too, looks like a scale error.
    if residual.sum() * LEAST_TURN**2 >= rate.sum():
        return Usual(usual)
    followed = both.sum() / rate.sum()
    # A swing of its own has the frequency of a rate for a time, but changes in size and sign.
    std = np.linalg.norm(both - followed * rate) / rate.sum()
    if abs(followed) < CERTAIN_SIGMAS * std:
        return Usual(usual)
    left = 1.0 - followed * both.sum() / residual.sum()
    is_scale_error = bool(left <= LEAST_LEFT)
    if is_scale_error:
        usual *= math.sqrt(max(left, 0.0))
    return Usual(usual, float(followed), float(std), is_scale_error)
