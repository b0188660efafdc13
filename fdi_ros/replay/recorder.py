# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Makes episodes from the output of a monitor: states, residuals, statistic and fused rate of each sample.

An episode begins with a new declaration. The set of its channels may grow, shrink and become one
channel. The episode ends when all declarations are withdrawn, or with the stretch. Silence and
values out of range do not end an episode, and a return from them is no new declaration.

The size of an error follows from the residuals, whatever was fused. The least-squares rate of the
residuals of all undeclared channels is subtracted from the residual of the channel. The rest is the
error of the channel, provided that the others are healthy.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.core.states import ChannelState
from fdi_ros.model.geometry import (
    Geometry,
    all_of_words,
    axis_words,
    lone_pairs,
    one_of_words,
    spans_space,
)
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.quantity import RATE, Quantity
from fdi_ros.model.samples import Array
from fdi_ros.monitor.output import Output
from fdi_ros.monitor.status import CERTAIN_SIGMAS
from fdi_ros.replay.episodes import (
    EPISODE_TIMES,
    ROOM,
    Apart,
    Candidate,
    Course,
    Episode,
    Evidence,
    RateMeanwhile,
    Size,
    Step,
    Story,
    Stretch,
    episode_words,
)
from fdi_ros.replay.outcomes import SQUARED, finite

ReducedStates = NDArray[np.uint8]
"""States of channels, where states without a declaration count as OK."""
S = ChannelState
_DECLARED, _EPISODE_STATES, _HIDING = (
    (S.AMBIGUOUS, S.FAULTY),
    (S.AMBIGUOUS, S.FAULTY, S.STALE),
    (S.STALE, S.SUSPECT),
)
"""States with a declaration, states of an episode, and states that hide a declaration."""

#: Episodes with details. Further ones are only counted.
MOST_EPISODES = 1000


class _Holes(NamedTuple):
    """Holes in a stream, and the silence of units beside them."""

    #: smallest hole, s
    least: float = 0.1
    #: smallest hole, as a multiple of the interval before
    intervals: float = 5.0
    #: channels of a unit that fall silent within this time, s, belong to one
    #: episode
    of_unit: float = 0.5
    #: silence shorter than `EPISODE_TIMES.longest_hole` that begins within this
    #: time after a hole, s, belongs to the hole
    after: float = 0.5


_HOLES = _Holes()

RATE_BEFORE = 0.5
"""The rate before an episode is the one at this time before its start, s."""
_DIAGONAL = [0, 3, 5]
"""Indices of the diagonal in the upper triangle of a symmetric 3 x 3 matrix."""


@dataclass
class _Open:
    """An episode with a standing declaration."""

    #: declared state
    kind: ChannelState
    #: numbers of the channels in its last step
    members: set[int]
    #: time of the first step, s
    start: float
    #: time of the last step, s
    since: float
    #: of the first step, in words
    reason: str
    #: standard deviation of the fused rate before the episode, rad/s. NaN: no rate
    std_before: float
    #: whether it began just after a hole in the samples
    after_hole: bool
    #: declarations that followed each other
    steps: list[Step] = field(default_factory=list)
    batches: dict[tuple[int, ...], Batches] = field(default_factory=dict)
    """Errors of single channels, and differences of pairs that measure one axis."""
    #: largest statistic over threshold. NaN: none
    ratio: float = float("nan")
    #: number of samples with an alarm
    alarms: int = 0
    #: time of the last alarm, s. None: none
    last_alarm: float | None = None
    #: number of samples
    samples: int = 0
    #: number of samples with a fused rate
    with_rate: int = 0
    #: sum of the traces of the covariance of these, (rad/s)^2
    variance: float = 0.0
    #: largest protection level, rad/s
    level: float = 0.0


class Recorder:
    """Records the episodes of one monitor on one stream, block by block, in bounded memory."""

    def __init__(
        self, geometry: Geometry, noise: NoiseModel, quantity: Quantity = RATE
    ) -> None:
        """``noise``: noise model in units of the natural size of the quantity."""
        self._geometry = geometry
        self._quantity = quantity
        noise = noise.for_channels(geometry.n)
        norm = np.linalg.norm(geometry.axes, axis=1)
        self._stds: Array = np.array(
            [
                quantity.natural * noise.noise_std,
                noise.scale_std * norm,
                quantity.natural * noise.bias_std * np.ones(geometry.n),
            ]
        )
        """(3, n) standard deviations of noise, rad/s, scale factor, 1, and bias, rad/s."""
        self._pairs = lone_pairs(geometry)
        self._before: ReducedStates = np.zeros(geometry.n, dtype=np.uint8)
        self._tail = np.empty((0, 2))
        """Times, s, and standard deviations of the fused rate, rad/s, of the latest samples."""
        self._interval = np.inf
        """Last interval between two samples, s."""
        self._open: list[_Open] = []
        self._episodes: list[Episode] = []
        self._more = 0
        self._stretches: list[Stretch] = []
        self._part: Stretch | None = None
        self._resumed = np.nan
        """Time of the first sample of the stretch, or after its last hole, s. NaN: no sample yet."""
        self._gains: dict[tuple[bytes, int], Array | None] = {}

    def begin_stretch(self) -> None:
        """End the stretch and its open episodes."""
        self._episodes_ended([*self._open], None)
        self._open = []
        self._before = np.zeros_like(self._before)
        self._tail = np.empty((0, 2))
        self._interval = np.inf
        self._resumed = np.nan
        if self._part is not None:
            self._stretches.append(self._part)
        self._part = None

    def add(self, time: Array, output: Output) -> None:
        """Add the next samples at times (N,), s from the first message."""
        if not len(output):
            return
        if np.isnan(self._resumed):
            # Units start one after the other, as after a hole.
            self._resumed = float(time[0])
        resumed = self._holes(time)
        told = self._told(output.state)
        before = np.vstack([self._before, told[:-1]])
        self._add_to_stretch(time, output, before)
        changes = np.flatnonzero((told != before).any(axis=1)).tolist()
        rows = np.column_stack([time, _stds(output)])
        self._tail = np.vstack([self._tail, rows])
        changed = set(changes)
        edges = [*dict.fromkeys([0, *changes]), len(time)]
        reasons = (
            {
                (event.stamp, event.channel): event.reason.value
                for event in output.events
            }
            if changes
            else {}
        )
        for begin, end in pairwise(edges):
            if begin in changed:
                self._resumed = max(
                    resumed[resumed <= time[begin]], default=self._resumed
                )
                stamp = int(output.stamp[begin])
                named = {
                    i: why for i in range(output.n) if (why := reasons.get((stamp, i)))
                }
                self._change(float(time[begin]), before[begin], told[begin], named)
            if self._open:
                self._take(slice(begin, end), time, output, told[begin])
        self._before = told[-1].copy()
        self._resumed = max(resumed, default=self._resumed)
        self._tail = self._tail[self._row_before(time[-1]) :]

    def story(self, end: float = np.inf) -> Story:
        """Return the story so far. Open episodes last to the last sample.

        ``end``: time of the last sample of all channels, s. Silence that begins later is the end of
        the recording, and no episode.
        """
        standing = [self._ended(one, None) for one in self._open]
        kept = [
            *self._episodes,
            *(
                one
                for one in standing
                if one is not None and (one.declares or one.start_s <= end)
            ),
        ]
        parts = list(self._stretches)
        if self._part is not None:
            parts.append(self._part)
        stretches = [
            Stretch(
                round(one.start_s, 9),
                round(one.end_s, 9),
                one.samples,
                one.judged,
                round(one.watched_s, 9),
            )
            for one in parts
        ]
        return Story(
            tuple(stretches),
            tuple(sorted(kept, key=lambda one: (one.start_s, one.since_s))),
            self._more,
        )

    def _told(self, state: NDArray[np.uint8]) -> ReducedStates:
        """Reduce states (N, n) to declarations. A hidden declaration is kept."""
        if not state.any():
            return state
        told = state.copy()
        in_sets = (state == S.AMBIGUOUS).any(axis=0)
        for one in self._open:
            if one.kind == S.AMBIGUOUS:
                in_sets[list(one.members)] = True
        is_suspect = (state == S.SUSPECT) & ~in_sets
        told[(state == S.UNCHECKED) | is_suspect] = S.OK
        return told

    def _add_to_stretch(
        self, time: Array, output: Output, before: ReducedStates
    ) -> None:
        """Count samples. ``before``: reduced states before each sample."""
        part = self._part or Stretch(float(time[0]), float(time[0]), 0, 0, 0.0)
        judged = np.isfinite(output.threshold)
        steps = np.diff(np.concatenate([[part.end_s], time]))
        watched = (
            judged
            & (steps <= EPISODE_TIMES.longest_hole)
            & ~np.isin(before, _DECLARED).any(axis=1)
        )
        self._part = Stretch(
            part.start_s,
            float(time[-1]),
            part.samples + len(time),
            part.judged + int(judged.sum()),
            part.watched_s + float(steps[watched].sum()),
        )

    def _change(
        self,
        at: float,
        before: ReducedStates,
        now: ReducedStates,
        reasons: Mapping[int, str],
    ) -> None:
        """Apply the changes of one sample. ``reasons``: reason by channel."""
        new = {
            kind: set(np.flatnonzero((now == kind) & (before != kind)).tolist())
            for kind in _EPISODE_STATES
        }

        def reason_of(members: set[int]) -> str:
            return next((reasons[i] for i in sorted(members) if i in reasons), "")

        std = float(self._tail[self._row_before(at), 1])
        # A set grows, shrinks, or becomes one channel.
        ambiguous = set(np.flatnonzero(now == S.AMBIGUOUS).tolist())
        for one in [one for one in self._open if one.kind == S.AMBIGUOUS]:
            named = new[S.FAULTY] & one.members
            hiding = {i for i in one.members if now[i] in _HIDING}
            members = named or hiding | ambiguous
            if named:
                one.kind = S.FAULTY
                one.reason = reason_of(named) or one.reason
            if named or (members and members != one.members):
                self._step(one, members, at)
        taken = set().union(
            *(
                one.members
                for one in self._open
                if one.kind == S.FAULTY and one.since == at
            )
        )
        for group in self._by_unit(new[S.FAULTY] - taken):
            self._begin(S.FAULTY, group, at, reason_of(group), std)
        has_set = any(one.kind == S.AMBIGUOUS for one in self._open)
        if new[S.AMBIGUOUS] and not has_set:
            self._begin(
                S.AMBIGUOUS, new[S.AMBIGUOUS], at, reason_of(new[S.AMBIGUOUS]), std
            )
        hidden = set().union(
            *(one.members for one in self._open if one.kind != S.STALE)
        )
        for group in self._by_unit(new[S.STALE] - hidden):
            # Channels of one unit that fall silent one after the other are one episode.
            unit = next(
                (set(unit) for unit in self._geometry.units if group <= set(unit)),
                group,
            )
            silent = [
                one for one in self._open if one.kind == S.STALE and one.members <= unit
            ]
            if lately := [one for one in silent if at - one.start <= _HOLES.of_unit]:
                self._step(lately[0], lately[0].members | group, lately[0].since)
            else:
                self._begin(S.STALE, group, at, reason_of(group), std)
        self._episodes_ended([one for one in self._open if self._is_over(one, now)], at)
        self._open = [one for one in self._open if not self._is_over(one, now)]

    def _holes(self, time: Array) -> Array:
        """Return the times, s, of the first samples after holes, among samples at times (N,), s."""
        before = self._part.end_s if self._part is not None else time[0]
        steps = np.diff(np.concatenate([[before], time]))
        usual = np.concatenate([[self._interval], steps[:-1]])
        if self._part is None:
            # The first sample of a stretch has no interval.
            usual[:2] = np.inf
        goes_on = len(time) > 1 or self._part is not None
        self._interval = float(steps[-1]) if goes_on else np.inf
        return time[(steps > _HOLES.least) & (steps > _HOLES.intervals * usual)]

    def _row_before(self, at: float) -> int:
        """Return the row of the tail shortly before a time, s, or the first row."""
        return max(
            0,
            int(np.searchsorted(self._tail[:, 0], at - RATE_BEFORE, side="right")) - 1,
        )

    def _begin(
        self, kind: ChannelState, members: set[int], at: float, reason: str, std: float
    ) -> None:
        """Open an episode."""
        self._open.append(
            _Open(
                kind,
                set(),
                at,
                at,
                reason,
                std,
                at - self._resumed <= _HOLES.after,
            )
        )
        self._step(self._open[-1], members, at)

    def _step(self, one: _Open, members: set[int], at: float) -> None:
        """Add a step with its channels."""
        one.members = members
        one.since = at
        channels = sorted(members)
        names = tuple(self._geometry.channel_names[i] for i in channels)
        if one.kind == S.AMBIGUOUS:
            who = one_of_words(self._geometry, channels, self._quantity.name)
        else:
            who = all_of_words(self._geometry, channels)
        step = Step(round(at, 9), one.kind.name, names, who)
        if one.steps and (
            one.steps[-1].at_s == step.at_s or len(one.steps) >= ROOM.steps
        ):
            one.steps.pop()
        one.steps.append(step)
        one.batches = {
            key: batches
            for key, batches in one.batches.items()
            if members.issuperset(key)
        }

    def _by_unit(self, channels: set[int]) -> list[set[int]]:
        """Group channels by unit. A channel without a unit is a group of its own."""
        groups = [set(unit) & channels for unit in self._geometry.units]
        left = channels - set().union(*groups)
        alone = [{i} for i in sorted(left)]
        return [*filter(None, groups), *alone]

    def _is_over(self, one: _Open, now: ReducedStates) -> bool:
        if one.kind == S.AMBIGUOUS:
            lasting = (S.AMBIGUOUS, *_HIDING)
            return all(now[i] not in lasting for i in one.members)
        return all(now[i] != one.kind for i in one.members)

    def _take(
        self, rows: slice, time: Array, output: Output, told: ReducedStates
    ) -> None:
        """Add samples with equal states to the open episodes."""
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = output.statistic[rows] / output.threshold[rows]
        ratio = ratio[np.isfinite(ratio)]
        alarms = np.flatnonzero(output.alarm[rows])
        valid = output.valid[rows]
        variance = np.trace(output.covariance[rows], axis1=1, axis2=2)[valid]
        level = float(output.level[rows].max())
        for one in self._open:
            if len(ratio):
                one.ratio = float(np.fmax(one.ratio, ratio.max()))
            if len(alarms):
                one.alarms += len(alarms)
                one.last_alarm = float(time[rows][alarms[-1]])
            one.samples += len(valid)
            one.with_rate += int(valid.sum())
            one.variance += float(variance.sum())
            one.level = max(one.level, level)
            if one.kind != S.STALE:
                self._measure(one, rows, time[rows], output, told)

    def _measure(
        self, one: _Open, rows: slice, time: Array, output: Output, told: ReducedStates
    ) -> None:
        """Add the errors of the channels of an episode, measured by the other channels."""
        axes = self._geometry.axes
        residual = output.residual[rows]

        def add(key: tuple[int, ...], gain: Array, error: Array) -> None:
            if key not in one.batches:
                noise, scale, bias = np.sqrt(
                    (gain**2 * self._stds**2).sum(axis=1)
                ).tolist()
                one.batches[key] = Batches(float(time[0]), noise, scale, bias)
            one.batches[key].add(time, error, output.rate[rows] @ axes[key[0]])

        trusted = ~np.isin(told, (S.FAULTY, S.STALE, S.EXCLUDED))
        for i in sorted(one.members):
            if (gain := self._gain(trusted, i)) is not None:
                used = np.flatnonzero(gain)
                add((i,), gain, residual[:, used] @ gain[used])
        for a, b in self._pairs if one.kind == S.AMBIGUOUS else ():
            if {a, b} <= one.members:
                channels = np.arange(len(axes))
                both = np.isin(channels, (a, b)).astype(np.float64)
                scale = float(axes[a] @ axes[b]) / float(axes[b] @ axes[b])
                difference = residual[:, a] - scale * residual[:, b]
                add((a, b), both, difference)

    def _apart(self, one: _Open) -> Apart | None:
        """Return the pair on one axis whose difference is most significant. None: no pair differs."""
        pairs = {
            key: batches.size(one.since)
            for key, batches in one.batches.items()
            if len(key) > 1
        }
        sizes = {pair: size for pair, size in pairs.items() if size is not None}
        if one.kind != S.AMBIGUOUS or not sizes:
            return None
        pair, size = max(
            sizes.items(),
            key=lambda item: abs(item[1].rad_s) / (item[1].std_rad_s or np.inf),
        )
        if (
            set(pair) != one.members
            and abs(size.rad_s) < CERTAIN_SIGMAS * size.std_rad_s
        ):
            return None
        names = tuple(self._geometry.channel_names[i] for i in pair)
        return Apart(names, one_of_words(self._geometry, pair), size)

    def _gain(self, trusted: NDArray[np.bool_], i: int) -> Array | None:
        """Return the row (n,) that gives the error of a channel from all residuals.

        None: the other channels do not determine the error.
        """
        key = trusted.tobytes(), i
        if key not in self._gains:
            axes = self._geometry.axes
            others = [k for k in np.flatnonzero(trusted).tolist() if k != i]
            gain = None
            if spans_space(axes[others]):
                gain = np.zeros(len(axes))
                gain[others] = -axes[i] @ np.linalg.pinv(axes[others])
                gain[np.abs(gain) < 1e-9] = 0.0
                gain[i] = 1.0
            self._gains[key] = gain
        return self._gains[key]

    def _episodes_ended(self, ended: list[_Open], at: float | None) -> None:
        found = [
            episode
            for episode in (self._ended(one, at) for one in ended)
            if episode is not None
        ]
        room = MOST_EPISODES - len(self._episodes)
        self._episodes += found[:room]
        self._more += len(found[room:])

    def _ended(self, one: _Open, at: float | None) -> Episode | None:
        """Make an episode from one that ended or is open. None: only a hole."""
        assert self._part is not None
        end = self._part.end_s if at is None else at
        if (
            one.kind == S.STALE
            and one.after_hole
            and end - one.start < EPISODE_TIMES.longest_hole
        ):
            return None
        geometry = self._geometry
        names = self._geometry.channel_names
        sizes = {
            key[0]: batches.size(one.since)
            for key, batches in one.batches.items()
            if len(key) == 1
        }
        candidates = [
            Candidate(names[i], axis_words(geometry, i), sizes.get(i))
            for i in sorted(one.members)
        ]
        episode = Episode(
            stretch=len(self._stretches) + 1,
            state=one.kind.name,
            channels=one.steps[-1].channels,
            who=one.steps[-1].who,
            start_s=round(one.start, 9),
            since_s=round(one.since, 9),
            end_s=round(end, 9),
            stands=at is None,
            steps=tuple(one.steps),
            candidates=tuple(candidates),
            apart=self._apart(one),
            measured_in=self._quantity.unit,
            evidence=Evidence(
                one.reason, finite(one.ratio), one.alarms, one.last_alarm
            ),
            rate=RateMeanwhile(
                published=one.with_rate / max(1, one.samples),
                std_before_rad_s=finite(one.std_before),
                std_rad_s=float(np.sqrt(one.variance / one.with_rate))
                if one.with_rate
                else None,
                level_rad_s=finite(one.level),
            ),
        )
        return replace(episode, words=episode_words(episode))


def _stds(output: Output) -> Array:
    """Return the root of the trace of the covariance, (N,), rad/s. NaN: no rate."""
    with np.errstate(invalid="ignore"):
        stds = np.sqrt(output.rows["covariance"][:, _DIAGONAL].sum(axis=1))
    return np.where(output.valid, stds, np.nan)


# Size and course of an error, in bounded memory


class _BatchRoom(NamedTuple):
    """Batches of time over which an error is averaged."""

    #: largest number of batches. If exceeded, neighbours are merged
    batches: int = 512
    #: width of a batch at first, s
    first: float = 0.1
    #: number of merged batches for the standard error. An error is correlated for a
    #: shorter time
    merged: int = 12
    #: smallest number of batches with a meaningful scatter
    fewest: int = 4


_BATCHES = _BatchRoom()


class _Courses(NamedTuple):
    """What decides how an error is described."""

    #: smallest change of a trend, as a share of the size
    trend: float = 0.3
    #: share of its former size below which an error is over
    passed: float = 0.25
    #: time over which the size at the declaration is averaged, s. Also the time for
    #: which an error must stay below `passed` to be over
    time: float = 1.0
    #: share of a mean square that is rounding error
    rounding: float = 1e-12
    #: ratio of mean to scatter below which the error is not described by its mean
    small_mean: float = 0.5
    #: ratio of scatter to expected noise from which on an error is noise
    loud: float = 3.0


_COURSES = _Courses()


class Batches:
    """Means of an error over batches of time.

    Parameters
    ----------
    begin
        Begin of the first batch, s.
    noise
        Standard deviation of the error in one sample from noise, rad/s.
    scale
        Standard deviation of unknown scale factors, as a share of the rate.
    bias
        Standard deviation of unknown biases, rad/s.
    """

    def __init__(
        self, begin: float, noise: float, scale: float = 0.0, bias: float = 0.0
    ) -> None:
        self._begin = begin
        self._noise = noise
        self._scale = scale
        self._bias = bias
        self._width = _BATCHES.first
        # Of each batch: number of samples, sum, sum of squares, sum of error times rate, and sum of
        # squares of the rate.
        self._sums = np.zeros((5, _BATCHES.batches))

    def add(self, time: Array, error: Array, rate: Array) -> None:
        """Add finite samples (N,): time, s, error and rate along the axis, rad/s."""
        known = np.isfinite(error) & (np.abs(error) < SQUARED)
        time = time[known]
        error = error[known]
        rate = np.nan_to_num(rate[known])
        if not len(time):
            return
        while time[-1] - self._begin >= _BATCHES.batches * self._width:
            self._sums = np.hstack(
                [
                    self._sums.reshape(5, -1, 2).sum(axis=2),
                    np.zeros((5, _BATCHES.batches // 2)),
                ]
            )
            self._width *= 2
        number = np.maximum(((time - self._begin) / self._width).astype(np.intp), 0)
        number = np.minimum(number, _BATCHES.batches - 1)
        for k, values in enumerate((None, error, error**2, error * rate, rate**2)):
            self._sums[k] += np.bincount(number, values, _BATCHES.batches)

    def size(self, declared: float) -> Size | None:
        """Return size and course. ``declared``: time of the declaration, s. None: no sample."""
        count, total, square, _, squared_rate = self._sums
        rates = float(squared_rate.sum())
        used = np.flatnonzero(count)
        if not len(used):
            return None
        mean: Array = np.asarray(total[used] / count[used], dtype=np.float64)
        middle: Array = np.asarray(
            self._begin + (used + 0.5) * self._width, dtype=np.float64
        )
        samples = float(count.sum())
        whole = float(total.sum() / count.sum())
        mean_square = float(square.sum() / samples)
        scatter = mean_square - whole**2
        scatter = scatter if scatter > _COURSES.rounding * mean_square else 0.0
        lasting = math.hypot(self._scale * math.sqrt(rates / samples), self._bias)
        std = math.hypot(_standard_error(mean, scatter, samples), lasting)
        last = float(mean[-1])
        rms = math.sqrt(mean_square)
        if found := self._proportional(used, mean, last):
            return found
        at = (middle >= declared) & (
            middle < declared + max(_COURSES.time, self._width)
        )
        here = mean[at] if at.any() else mean[-1:]
        then = float(here.mean())
        gone = self._gone(used, mean, then)
        if gone is not None:
            before = middle < gone
            part = mean[before]
            samples_then = float(count[used][before].sum())
            error = math.hypot(_standard_error(part, scatter, samples_then), lasting)
            return Size(float(part.mean()), error, "gone", last, gone_s=round(gone, 3))
        slope = _trend(middle, mean)
        change = 0.0 if slope is None else abs(slope) * (middle[-1] - middle[0])
        if slope is not None and change > _COURSES.trend * abs(whole):
            course: Course = "growing" if slope * (then or whole) > 0 else "shrinking"
            straight = mean - slope * (middle - middle.mean())
            chance = float(straight.std(ddof=2)) / math.sqrt(len(here))
            return Size(then, math.hypot(chance, lasting), course, last, slope)
        if abs(whole) < _COURSES.small_mean * math.sqrt(scatter):
            wander = float(mean.var()) if len(mean) >= _BATCHES.fewest else 0.0
            if wander > max(0.5 * scatter, (CERTAIN_SIGMAS * std) ** 2):
                return Size(rms, std, "varying", last)
            if scatter > (_COURSES.loud * self._noise) ** 2:
                return Size(rms, rms / math.sqrt(2.0 * samples), "noisy", last)
        return Size(whole, std, "steady", last)

    def _proportional(
        self, used: NDArray[np.intp], mean: Array, last: float
    ) -> Size | None:
        """Return the size of an error that a regression on the rate explains. None: it does not.

        Such an error may end before the last sample.
        """
        count, total, square, products, squared_rate = self._sums[:, used]
        loud = np.flatnonzero(square > (_COURSES.loud * self._noise) ** 2 * count)
        for end in dict.fromkeys((len(used), int(loud[-1]) + 1 if len(loud) else 0)):
            part = slice(end)
            samples = float(count[part].sum())
            rates = float(squared_rate[part].sum())
            power = float(square[part].sum())
            product = float(products[part].sum())
            if rates <= 0.0 or power <= 0.0:
                continue
            constant = float(total[part].sum()) ** 2 / samples
            explained = product**2 / rates
            if explained <= 0.5 * power or explained <= 2.0 * constant:
                continue
            share = product / rates
            gone = self._share_gone(used, share)
            if gone is not None:
                during = used[: np.searchsorted(used, gone)]
                _, _, _, products_then, rates_then = self._sums[:, during]
                share = float(products_then.sum() / rates_then.sum())
                samples = float(self._sums[0, during].sum())
                power = float(self._sums[2, during].sum())
            elif end < len(used):
                continue
            rms = math.sqrt(power / samples)
            scatter = max(power - constant, 0.0) / samples
            chance = _standard_error(mean[:end], scatter, samples)
            until = None
            if gone is not None:
                until = round(self._begin + gone * self._width, 3)
            return Size(
                rms, chance, "proportional", last, share_of_rate=share, gone_s=until
            )
        return None

    def _share_gone(self, used: NDArray[np.intp], share: float) -> int | None:
        """Return the number of the batch from which on the error is no such share of the rate.

        None: it is not over. At a small rate the error shows in no batch.
        """
        count, _, square, _, squared_rate = self._sums[:, used]
        expected = abs(share) * np.sqrt(squared_rate / count)
        shows = expected > _COURSES.loud * self._noise
        large = np.flatnonzero(shows & (np.sqrt(square / count) >= 0.5 * expected))
        if not len(large):
            return None
        after = shows[large[-1] + 1 :].sum() * self._width
        if after < max(_COURSES.time, 2 * self._width):
            return None
        return int(used[large[-1]]) + 1

    def _gone(self, used: NDArray[np.intp], mean: Array, then: float) -> float | None:
        """Return the time, s, since which the error is below `_COURSES.passed`. None: it is not over."""
        large = np.flatnonzero(np.abs(mean) >= _COURSES.passed * abs(then))
        if not len(large) or large[-1] == len(mean) - 1:
            return None
        since = self._begin + (used[large[-1]] + 1) * self._width
        lasted = self._begin + (used[-1] + 1) * self._width - since
        return float(since) if lasted >= max(_COURSES.time, 2 * self._width) else None


def _standard_error(means: Array, scatter: float, samples: float) -> float:
    """Return the standard error of the mean, from the scatter of batch means or of samples.

    The larger of the two counts.
    """
    by_sample = scatter / max(samples, 1.0)
    if len(means) >= 2 * _BATCHES.merged:
        means = np.array(
            [part.mean() for part in np.array_split(means, _BATCHES.merged)]
        )
    by_batch = 0.0
    if len(means) >= _BATCHES.fewest:
        by_batch = float(means.var(ddof=1)) / len(means)
    return math.sqrt(max(by_sample, by_batch))


def _trend(time: Array, mean: Array) -> float | None:
    """Return the slope of a straight line through the means (k,). None: not significant."""
    if len(mean) < 2 * _BATCHES.fewest:
        return None
    x = time - time.mean()
    slope = float(x @ mean / (x @ x))
    rest = mean - mean.mean() - slope * x
    std = math.sqrt(float(rest @ rest) / (len(mean) - 2) / float(x @ x))
    return slope if abs(slope) > CERTAIN_SIGMAS * std else None
