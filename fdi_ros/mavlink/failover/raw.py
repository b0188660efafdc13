# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Raw samples of the IMUs of a vehicle, compared pair by pair.

A difference counts as an error only if it is steady. Vibration that aliases, holes of the
link and a delay between two IMUs look like errors for a while.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations, starmap
from typing import NamedTuple

import numpy as np

from fdi_ros.mavlink.protocol import MS, NS, Vector

AVERAGED = 120 * MS  #: Differences are averaged over the samples of this time, ns.
CURRENT = 500 * MS  #: Oldest pair of samples that still counts, ns.
#: Difference from which any doubt of the monitor names the odd IMU, rad/s.
LARGE_DIFFERENCE = 0.3
#: A difference is steady if it is a smooth curve: its mean is this multiple of its step
#: from sample to sample, over the root of 2. ArduPilot sends what is due each 9 ms at the
#: turns of its loop, so vibration reaches more only within 1 Hz of 111 Hz.
SMOOTHNESS = 5.0
#: Or if it lasts: in this number of times `AVERAGED` in turn all means have one sign and
#: are at least as large as the standard deviation.
WINDOWS = 4
#: An oscillation had the other sign, and half the size, within this time, ns.
TURNED = 300 * MS
#: Where messages are missing, holes may hide the same half of each period of a vibration.
#: A difference is one if a sine of one frequency, Hz, leaves less than a `BETTER`-th of the
#: squares that a straight line leaves. A vehicle itself swings more slowly.
FREQUENCIES = np.arange(4.0, 50.0, 0.25)
BETTER = 4.0
JUDGED = 12  #: Fewest differences of which this is asked: fewer suit any frequency.
SKEW = 20 * MS  #: Two IMUs may measure this far apart in time, ns.
#: Allowed for in a mean difference, ns: more would hide errors while the vehicle shakes.
USUAL_SKEW = 5 * MS
#: The last samples must all differ by `LARGE_DIFFERENCE` or `CLEAR_DIFFERENCE`: those of
#: at least this time, ns, and at least `FEWEST`.
QUICK = 50 * MS
FEWEST = 3  #: Smallest number of samples in `QUICK`.
#: A gyro is stuck if it repeats one value for this time, ns, while the rates of two others
#: change by `PROVEN_MOTION`, or the rate of one by this and `NOISE` standard deviations: a
#: bad gyro scatters also at rest.
REPEATING = 100 * MS
PROVEN_MOTION = 0.02  #: Change of rate that proves a motion, rad/s.
NOISE = 4.0
END_SAMPLES = 4  #: Samples averaged at the begin and at the end of that time.
KEPT = 64  #: Samples kept of each IMU.
PAIRS_KEPT = 256  #: Differences kept of each pair of IMUs.

UNKNOWN_RATES: Vector = (math.nan, math.nan, math.nan)


class Difference(NamedTuple):
    """Rate of one IMU less the rate of another, averaged."""

    mean: Vector  #: rad/s
    spread: Vector  #: Standard deviation of one difference, rad/s.
    std: Vector  #: Standard deviation of the mean, rad/s.
    steady: tuple[bool, ...]  #: Whether each axis differs steadily.

    @property
    def size(self) -> float:
        """Largest component, rad/s."""
        return max(map(abs, self.mean))


class Motion(NamedTuple):
    """How an IMU has turned within `AVERAGED`, rad/s. NaN: no rates are known."""

    largest: float  #: Largest rate.
    gain: Vector  #: By how much the rate has grown, by axis.
    mean: Vector  #: Mean rate, as of a turn.
    std: Vector  #: Standard deviation of the rate, as of a shake.


class Rows:
    """The last rates or differences with their times, oldest first, in arrays.

    Parameters
    ----------
    kept
        Largest number of rows.
    """

    def __init__(self, kept: int) -> None:
        self._kept = kept
        self._times = np.zeros(4 * kept, dtype=np.int64)
        self._values = np.zeros((4 * kept, 3))
        self._arrays = [self._times, self._values]
        self._begin = self._end = 0

    def __len__(self) -> int:
        return self._end - self._begin

    def append(self, time: int, values: Vector) -> None:
        """Add a row: time in ns, values in rad/s."""
        if self._end == len(self._times):
            for array in self._arrays:
                array[: len(self)] = array[self._begin :]
            self._begin, self._end = 0, len(self)
        self._times[self._end] = time
        self._values[self._end] = values
        self._end += 1
        self._begin = max(self._begin, self._end - self._kept)

    def drop(self, until: int) -> None:
        """Drop the oldest rows up to a time, ns."""
        while self._begin < self._end and self._times[self._begin] <= until:
            self._begin += 1

    @property
    def times(self) -> np.ndarray:
        """Times, ns."""
        return self._times[self._begin : self._end]

    @property
    def values(self) -> np.ndarray:
        """Rates or differences, one row each, rad/s."""
        return self._values[self._begin : self._end]

    def last(self, count: int) -> np.ndarray:
        """Return the last count values, or as many as there are, rad/s."""
        return self._values[max(self._begin, self._end - count) : self._end]


class Differences(Rows):
    """The last differences of two IMUs, with the step and the time from each to the next.

    Parameters
    ----------
    kept
        Largest number of rows.
    """

    def __init__(self, kept: int) -> None:
        super().__init__(kept)
        self._pauses = np.zeros(len(self._times), dtype=np.int64)
        self._squares = np.zeros_like(self._values)
        self._arrays += [self._pauses, self._squares]
        self._newest: tuple[int, Vector] = (-NS, UNKNOWN_RATES)

    def append(self, time: int, values: Vector) -> None:
        """Add a row: time in ns, values in rad/s."""
        super().append(time, values)
        before, (x, y, z) = self._newest
        dx, dy, dz = values[0] - x, values[1] - y, values[2] - z
        self._pauses[self._end - 1] = time - before
        self._squares[self._end - 1] = dx * dx, dy * dy, dz * dz
        self._newest = time, values

    @property
    def newest(self) -> tuple[int, Vector]:
        """Time, ns, and values of the last row, rad/s, also if it was dropped."""
        return self._newest

    @property
    def pauses(self) -> np.ndarray:
        """Times between the rows, ns."""
        return self._pauses[self._begin + 1 : self._end]

    def younger(self, age: int) -> int:
        """Return the number of rows that are younger than the last one by less than age, ns."""
        return int(np.count_nonzero(self.times > self._newest[0] - age))

    def roughness(self, count: int) -> list[float]:
        """Return the standard deviation of white noise that steps as the last count rows do.

        By axis, rad/s. NaN: there is no step.
        """
        first = max(self._begin, self._end - count) + 1
        steps = self._end - first or math.nan
        squares = np.add.reduce(self._squares[first : self._end]).tolist()
        return [math.sqrt(square / steps / 2.0) for square in squares]


class RawComparison:
    """Differences between the raw rates of count IMUs.

    Parameters
    ----------
    count
        Number of IMUs.
    interval
        Time between two samples of an IMU, ns. Samples of two IMUs form a pair if
        their stamps differ by less than 0.4 intervals. Faster samples are left out.
    """

    def __init__(self, count: int, interval: int) -> None:
        self._reach = 2 * interval // 5
        self._shortest = 3 * interval // 4
        self._longest = 7 * interval // 5
        self._lag = max(1, SKEW // interval)
        self._averaged = max(1, AVERAGED // interval)
        #: Fewest samples that are averaged, and how many within `QUICK`.
        self.fewest = max(FEWEST, QUICK // interval + 1)
        self._last: list[tuple[int, Vector]] = [(-NS, UNKNOWN_RATES)] * count
        self._recent = [Rows(KEPT) for _ in range(count)]
        self._motions: list[Motion | None] = [None] * count
        units = range(count)
        self._pairs = {pair: Differences(PAIRS_KEPT) for pair in combinations(units, 2)}
        # Whether the differences of each pair are a wave, and of which first and last this
        # was judged.
        self._judged = dict.fromkeys(self._pairs, (0, 0))
        self._waves: dict[tuple[int, int], np.ndarray] = {}
        # Samples since the value of an IMU changed, and the rates of all IMUs at first.
        self._same = [0] * count
        self._repeating = max(FEWEST, REPEATING // interval)
        self._beside = [[UNKNOWN_RATES] * count] * count
        self._stuck = [False] * count
        self._out: tuple[int, ...] = ()  # IMUs out of use, which may scatter

    def leave_out(self, out: Sequence[int]) -> None:
        """Take the IMUs out of use: one alone proves no motion."""
        if tuple(out) != self._out:
            self._out = tuple(out)
            self._stuck = [False] * len(self._stuck)

    def feed(self, unit: int, stamp: int, rate: Vector) -> None:
        """Take a sample of an IMU, from 0: stamp in ns, rate in rad/s."""
        if unit >= len(self._last) or stamp - self._last[unit][0] < self._shortest:
            return
        if rate != self._last[unit][1]:
            self._same[unit] = 0
            self._stuck[unit] = False
        self._same[unit] += 1
        if self._same[unit] <= 2:
            # At the second, the others have delivered theirs of the first.
            self._beside[unit] = [last for _, last in self._last]
        self._last[unit] = stamp, rate
        self._recent[unit].append(stamp, rate)
        self._motions[unit] = None
        for other, same in enumerate(self._same):
            if other != unit and same >= self._repeating and not self._stuck[other]:
                self._stuck[other] = self._is_left_behind(other)
        for pair, rows in self._pairs.items():
            if unit not in pair:
                continue
            (first_stamp, first), (second_stamp, second) = (self._last[k] for k in pair)
            if abs(first_stamp - second_stamp) < self._reach:
                x, y, z = first
                rows.append(stamp, (x - second[0], y - second[1], z - second[2]))
            rows.drop(stamp - WINDOWS * AVERAGED)

    def _is_left_behind(self, unit: int) -> bool:
        """Return whether other IMUs have moved since an IMU repeats one value.

        Two that are out of use prove a motion only if they show the same one.
        """
        moved = [
            k
            for k, (_, rate) in enumerate(self._last)
            if k != unit and math.dist(rate, self._beside[unit][k]) > PROVEN_MOTION
        ]
        in_use = [k for k in moved if k not in self._out]
        if len(in_use) > 1:
            return True
        count = self._same[unit]
        if in_use and any(self._change(in_use[0], count)):
            return True
        changes = [self._change(k, count) for k in moved]
        return any(
            math.dist(one, other) < math.hypot(*one) / 2.0
            for one, other in combinations(changes, 2)
        )

    def _change(self, unit: int, count: int) -> Vector:
        """Return the change of the rate of an IMU, or 0 if noise explains this, rad/s.

        From the first to the last `END_SAMPLES` of its last count samples.
        """
        # The oldest may be from before: IMUs are fed in turn.
        rates = self._recent[unit].last(count - 2)
        if len(rates) < 2 * END_SAMPLES:
            return 0.0, 0.0, 0.0
        noise = np.std(np.diff(rates, axis=0)) / math.sqrt(END_SAMPLES)
        change = rates[-END_SAMPLES:].mean(axis=0) - rates[:END_SAMPLES].mean(axis=0)
        if np.linalg.norm(change) <= PROVEN_MOTION + NOISE * noise:
            return 0.0, 0.0, 0.0
        x, y, z = change.tolist()
        return x, y, z

    def _rates(self, unit: int, periods: int = 1) -> np.ndarray:
        """Return the rates of an IMU within ``periods`` times `AVERAGED`, rad/s. NaN: none."""
        rates = self._recent[unit].last(periods * self._averaged)
        return rates if len(rates) else np.array([UNKNOWN_RATES])

    def motion(self, unit: int) -> Motion:
        """Return how an IMU has turned within `AVERAGED`."""
        motion = self._motions[unit]
        if motion is None:
            rates = self._rates(unit)
            mean = _mean(rates)
            deviation = rates - mean
            std = np.sqrt(_mean(deviation * deviation))
            vectors = (rates[-1] - rates[0], mean, std)
            gain, turn, shake = (tuple(vector.tolist()) for vector in vectors)
            largest = max(starmap(math.hypot, rates.tolist()))
            motion = self._motions[unit] = Motion(largest, gain, turn, shake)
        return motion

    def peaks(self, unit: int) -> Vector:
        """Return the largest rate of an IMU within twice `AVERAGED`, by axis, rad/s."""
        x, y, z = np.abs(self._rates(unit, periods=2)).max(axis=0).tolist()
        return x, y, z

    def noise(self, unit: int, other: int) -> list[float]:
        """Return the standard deviation of noise in the mean difference of two IMUs, rad/s.

        By axis. Of white noise that explains the steps of the differences. NaN: none are known.
        """
        rows = self._pairs[min(unit, other), max(unit, other)]
        root = math.sqrt(self._averaged)
        return [rough / root for rough in rows.roughness(len(rows))]

    def is_stuck(self, unit: int) -> bool:
        """Return whether an IMU has repeated one value while another one moved."""
        return self._stuck[unit]

    def repeats(self, unit: int, count: int) -> bool:
        """Return whether the last count samples of an IMU are all the same."""
        return self._same[unit] >= min(count, len(self._recent[unit]))

    def steps(self, unit: int, count: int) -> Vector:
        """Return how far each axis of an IMU changed within `SKEW`, rad/s.

        The largest change among the last count samples. A healthy IMU that measures this
        much earlier or later differs by as much.
        """
        rates = self._recent[unit].last(count + self._lag)
        changes = np.abs(rates[self._lag :] - rates[: -self._lag])
        x, y, z = changes.max(axis=0, initial=0.0).tolist()
        return x, y, z

    def steady(self, unit: int, other: int, now: int) -> Vector:
        """Return the smallest difference of two IMUs within `QUICK`, by axis, rad/s.

        0 where the differences oscillate: they do not all have the same sign, are no
        smooth curve, or had the other sign within `TURNED`. NaN: too few are known at
        time now, ns.
        """
        rows = self._rows(unit, other, now)
        if rows is None or len(rows) < self.fewest:
            return UNKNOWN_RATES
        if max(map(abs, rows.newest[1])) < LARGE_DIFFERENCE:
            return 0.0, 0.0, 0.0
        late = rows.younger(TURNED)
        count = min(self.fewest, late)
        values = rows.last(count)
        least = [nearest_zero(column) for column in values.T.tolist()]
        if not any(least):
            return 0.0, 0.0, 0.0
        before = rows.last(late)
        lowest = np.fmin.reduce(before).tolist()
        highest = np.fmax.reduce(before).tolist()
        means = _mean(values).tolist()
        roughness = rows.roughness(count)
        vibrates = self._vibrates(unit, other).tolist()
        sign = 1.0 if unit < other else -1.0
        found = [0.0, 0.0, 0.0]
        for axis, size in enumerate(least):
            has_turned = 2.0 * (lowest[axis] if size > 0.0 else -highest[axis]) < -abs(
                size
            )
            is_smooth = abs(means[axis]) >= SMOOTHNESS * roughness[axis]
            if is_smooth and not vibrates[axis] and not has_turned:
                found[axis] = sign * size
        x, y, z = found
        return x, y, z

    def between(
        self, unit: int, other: int, now: int, last: int = 0
    ) -> Difference | None:
        """Return the difference of two IMUs at time now, ns, or None if not known.

        Not known: no recent pairs, or too few or too far apart in time to show an
        oscillation.

        last: number of samples averaged. 0: all within `AVERAGED`, and at least
        `fewest`.
        """
        rows = self._rows(unit, other, now)
        if rows is None:
            return None
        late = rows.younger(AVERAGED)
        count = last or max(self.fewest, late)
        if len(rows) < max(2, count) or now - rows.times[-count] > CURRENT:
            return None
        pauses = rows.pauses
        if np.minimum.reduce(pauses) > self._longest:
            return None
        values = rows.last(count)
        mean = _mean(values)
        spread = _spread(values, mean)
        # A hole may hide half of an oscillation, so the time before it counts as well.
        has_hole = np.maximum.reduce(pauses[1 - count :]) > QUICK
        seen = max(count, rows.younger(2 * AVERAGED) if has_hole else late)
        of_seen = mean if seen == count else _mean(rows.last(seen))
        means, of_seen, spreads = mean.tolist(), of_seen.tolist(), spread.tolist()
        roughness = rows.roughness(seen)
        steady = [abs(of_seen[k]) >= SMOOTHNESS * roughness[k] for k in range(3)]
        if any(not steady[k] and abs(means[k]) >= spreads[k] for k in range(3)):
            lasts = _lasts(rows).tolist()
            steady = [one or other for one, other in zip(steady, lasts, strict=True)]
        if any(steady):
            vibrates = self._vibrates(unit, other).tolist()
            steady = [
                one and not other for one, other in zip(steady, vibrates, strict=True)
            ]
        sign = 1.0 if unit < other else -1.0
        x, y, z = means
        root = math.sqrt(count)
        std = spreads[0] / root, spreads[1] / root, spreads[2] / root
        return Difference(
            (sign * x, sign * y, sign * z), tuple(spreads), std, tuple(steady)
        )

    def _rows(self, unit: int, other: int, now: int) -> Differences | None:
        """Return times and differences of late of two IMUs, or None if none is recent.

        Differences are those of the IMU with the smaller number less the other one.
        """
        rows = self._pairs[min(unit, other), max(unit, other)]
        is_recent = len(rows) and now - rows.newest[0] <= CURRENT
        return rows if is_recent else None

    def _vibrates(self, unit: int, other: int) -> np.ndarray:
        """Return which axes vibrate rather than differ. None do where no message is missing."""
        pair = min(unit, other), max(unit, other)
        rows = self._pairs[pair]
        ends = int(rows.times[0]), int(rows.times[-1])
        if self._judged[pair] != ends:
            self._judged[pair] = ends
            self._waves[pair] = _is_wave(rows, self._longest)
        return self._waves[pair]


def _is_wave(rows: Differences, longest: int) -> np.ndarray:
    """Return which columns an oscillation explains better than a line, beside holes.

    A hole is longer than longest, ns.
    """
    if len(rows) < JUDGED or np.maximum.reduce(rows.pauses) <= longest:
        return np.zeros(3, dtype=bool)
    times = rows.times
    values = rows.values
    age = (times[-1] - times) / NS
    phase = 2.0 * np.pi * FREQUENCIES[:, None] * age
    line = _unexplained(np.ones((1, len(age))), age[None], values)
    wave = _unexplained(np.cos(phase), np.sin(phase), values)
    is_wave: np.ndarray = line[0] > BETTER * wave.min(axis=0)
    return is_wave


def _unexplained(
    first: np.ndarray, second: np.ndarray, values: np.ndarray
) -> np.ndarray:
    """Return the sum of squares that the best sum of two functions leaves.

    first, second: values of the two, one row each choice. Returned: one row each choice.
    """
    ones = np.sum(first * first, axis=1)[:, None]
    both = np.sum(first * second, axis=1)[:, None]
    twos = np.sum(second * second, axis=1)[:, None]
    one = first @ values
    two = second @ values
    explained = twos * one**2 - 2.0 * both * one * two + ones * two**2
    left: np.ndarray = np.sum(values**2, axis=0) - explained / (ones * twos - both**2)
    return left


# As np.mean and np.std, which for so few values cost five times as much.


def _mean(values: np.ndarray) -> np.ndarray:
    """Return the mean of each column."""
    mean: np.ndarray = np.add.reduce(values) / len(values)
    return mean


def _spread(values: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Return the standard deviation of each column, given its mean."""
    deviation = values - mean
    square = np.add.reduce(deviation * deviation) / (len(values) - 1)
    spread: np.ndarray = np.sqrt(square)
    return spread


def _lasts(rows: Rows) -> np.ndarray:
    """Return which axes have one sign in all windows, and means beyond their spread."""
    values = rows.values
    window = (rows.times[-1] - rows.times) // AVERAGED
    parts = [values[window == k] for k in range(WINDOWS)]
    if min(map(len, parts)) < FEWEST:
        return np.zeros(values.shape[1], dtype=bool)
    means = np.array(list(map(_mean, parts)))
    lasting: np.ndarray = np.abs(np.sign(means).sum(axis=0)) == WINDOWS
    if lasting.any():
        stds = np.array(list(map(_spread, parts, means)))
        lasting &= (np.abs(means) >= stds).all(axis=0)
    return lasting


def shift(one: Vector, other: Vector) -> Vector:
    """Return the mean difference of two healthy IMUs that measure `USUAL_SKEW` apart.

    By axis, rad/s: of the rate that both gain, or both lose, within `AVERAGED`. Given: what
    each gains.
    """
    share = USUAL_SKEW / AVERAGED
    pairs = zip(one, other, strict=True)
    x, y, z = (share * abs(nearest_zero(pair)) for pair in pairs)
    return x, y, z


def nearest_zero(values: Sequence[float]) -> float:
    """Return the value nearest to zero, or 0 if the values differ in sign."""
    low = min(values)
    high = max(values)
    return max(low, 0.0) + min(high, 0.0)
