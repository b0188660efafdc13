# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Evidence for failover: raw samples of the IMUs compared, beside the monitor's states.

The monitor removes learned errors from the samples and remembers declarations. The raw
comparison does neither and shows the present difference of the autopilot's own gyros.

Two of three IMUs can be wrong alike: both stand still, or both are remembered as faulty. So
they outvote the third only if they are trusted (`TRUSTED`), if their values change, and if
the monitor has no doubt about them that it does not have about the third as well.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from itertools import combinations, pairwise
from typing import NamedTuple

import numpy as np

from fdi_ros.core.states import ChannelState
from fdi_ros.mavlink.failover_policy import Imu
from fdi_ros.mavlink.protocol import MS, NS, Vector

AVERAGED = 120 * MS  #: Differences are averaged over the samples of this time, ns.
CURRENT = 500 * MS  #: Oldest pair of samples that still counts, ns.
#: Time constant with which the recent largest size decays, s. Once the IMU has agreed
#: for `HEALED`, only the present size counts.
DECAY = 0.5
REFUTING = 300 * MS  #: Agreement refutes a doubt that has stood for this time, ns.
BREAK = 100 * MS  #: A shorter break ends no agreement, and no difference, ns.
HEALED = NS // 2  #: Time of agreement after which an earlier size is forgotten, ns.
SET_STANDS = 300 * MS  #: A set must stand for this time to name an IMU, ns,
LONGEST_BREAK = 200 * MS  #: without a break longer than this, ns.
#: Least error of the odd one in a set of several IMUs, or suspected, in ``min_size``.
VOTE = 2.0
SUSPECT_STANDS = NS  #: An IMU must be suspected, and the odd one, for this time, ns.
#: Difference from which any doubt of the monitor names the odd IMU, rad/s.
LARGE_DIFFERENCE = 0.3
#: Difference from which the odd IMU needs no doubt of the monitor, rad/s. The monitor takes
#: 0.2 s to exclude a spike. An autopilot whose primary gyro reads zero is at 50 deg then.
CLEAR_DIFFERENCE = 0.5
#: Share of the rate by which two healthy gyros may differ: scales of one type differ by up
#: to 3 %, which is more than `CLEAR_DIFFERENCE` in a turn of 17 rad/s.
SCALE = 0.05
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
#: A difference is one if a frequency of these, Hz, explains it this many times as well as
#: a straight line does. A vehicle itself swings more slowly.
FREQUENCIES = np.arange(4.0, 50.0, 0.25)
BETTER = 4.0
JUDGED = 12  #: Fewest differences of which this is asked: fewer suit any frequency.
#: An IMU that the monitor doubts agrees only while the difference scatters by less, rad/s.
CALM = 0.1
#: It agrees, and is trusted, only once another one has turned by this on average, rad/s: a
#: dead gyro agrees with one at rest.
TURN_RATE = 0.1
#: One that was bad agrees only after a turn in which its error, if in proportion to the
#: rate, would be this multiple of ``min_size``.
SHOWN = 2.0
#: Or a turn at this part of the rate at which it was seen to be bad: enough for small rates.
SAME_TURN = 0.8
TINY = 1e-3  #: Resolution of the messages, rad/s.
#: An oscillation with this standard deviation is an error, rad/s.
WILD_OSCILLATION = 1.0
SKEW = 20 * MS  #: Two IMUs may measure this far apart in time, ns.
#: Allowed for in a mean difference, ns: more would hide errors while the vehicle shakes.
USUAL_SKEW = 5 * MS
#: The last samples must all differ by `LARGE_DIFFERENCE` or `CLEAR_DIFFERENCE`: those of
#: at least this time, ns, and at least `FEWEST` of them.
QUICK = 50 * MS
FEWEST = 3  #: Smallest number of samples in `QUICK`.
SIZED = 80 * MS  #: The size in a text is averaged over this time, ns.
SECOND_AXIS = 0.5  #: Share of the largest axis from which a second one is off as well.
ALIKE = 0.05  #: Two IMUs agree within this share of the odd one's difference, too.
TRUSTED = 2 * NS  #: IMUs are trusted after all have agreed for this time, ns.
#: A gyro is stuck if it repeats one value for this time, ns, while the rates of two others
#: change by `PROVEN_MOTION`, or the rate of one by this and `NOISE` standard deviations: a
#: bad gyro scatters also at rest.
REPEATING = 100 * MS
PROVEN_MOTION = 0.02  #: Change of rate that proves a motion, rad/s.
NOISE = 4.0
END_SAMPLES = 4  #: Samples averaged at the begin and at the end of that time.
#: States of channels that are a doubt.
DOUBTS = {
    ChannelState.SUSPECT,
    ChannelState.AMBIGUOUS,
    ChannelState.FAULTY,
    ChannelState.STALE,
}
#: States of channels of which a fault would not be seen.
UNJUDGED = {ChannelState.UNCHECKED, ChannelState.EXCLUDED, ChannelState.STALE}
KNOWN_SIGMAS = 5.0  #: Standard deviations from which a size is known.
SILENCE = NS // 2  #: An IMU without samples for this time does not deliver, ns.
STATES_KNOWN_FOR = 5 * NS  #: Older states of the monitor are unknown, ns.
KEPT = 64  #: Samples kept of each IMU.

UNKNOWN_RATES: Vector = (math.nan, math.nan, math.nan)
NOBODY: tuple[int, set[int], int] = (-1, set(), 0)


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


class Compared(NamedTuple):
    """How far two IMUs are apart now, by axis, rad/s. NaN: unknown."""

    #: If steady, or a wild oscillation. 0: what a mean leaves of another.
    apart: Vector
    bound: Vector  #: A bound that two that agree keep: mean, or scatter from `CALM` on.
    mean: Vector  #: Steady or not.


class Wrong(NamedTuple):
    """How an IMU was bad."""

    axis: int  #: The axis that was off most.
    size: float  #: By how much, rad/s.
    rate: float  #: Largest rate of the others about it then, rad/s.
    share: float  #: Largest ratio of error and rate: 1 for a gyro without scale.


UNCOMPARED = Compared(UNKNOWN_RATES, UNKNOWN_RATES, UNKNOWN_RATES)


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
        #: Fewest samples that are averaged, and the number of those within `QUICK`.
        self.fewest = max(FEWEST, QUICK // interval + 1)
        self._last: list[tuple[int, Vector]] = [(-NS, UNKNOWN_RATES)] * count
        self._recent: list[deque[Vector]] = [deque(maxlen=KEPT) for _ in range(count)]
        self._pairs: dict[tuple[int, int], deque[tuple[int, Vector]]] = {
            (j, k): deque(maxlen=256) for k in range(count) for j in range(k)
        }
        # Samples since the value of an IMU changed, and the rates of all IMUs at first.
        self._same = [0] * count
        self._repeating = max(FEWEST, REPEATING // interval)
        self._beside = [[UNKNOWN_RATES] * count] * count
        self._stuck = [False] * count
        self._out: tuple[int, ...] = ()  # IMUs out of use, which may scatter

    def leave_out(self, out: Sequence[int]) -> None:
        """Take the IMUs out of use: one of them alone proves no motion."""
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
        self._recent[unit].append(rate)
        for other, same in enumerate(self._same):
            if other != unit and same >= self._repeating and not self._stuck[other]:
                self._stuck[other] = self._is_left_behind(other)
        for pair, rows in self._pairs.items():
            if unit not in pair:
                continue
            (first_stamp, first), (second_stamp, second) = (self._last[k] for k in pair)
            if abs(first_stamp - second_stamp) < self._reach:
                x, y, z = (a - b for a, b in zip(first, second, strict=True))
                rows.append((stamp, (x, y, z)))
            while rows and rows[0][0] <= stamp - WINDOWS * AVERAGED:
                rows.popleft()

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
        rates = np.array(list(self._recent[unit])[2 - count :])
        if len(rates) < 2 * END_SAMPLES:
            return 0.0, 0.0, 0.0
        noise = np.std(np.diff(rates, axis=0)) / math.sqrt(END_SAMPLES)
        change = rates[-END_SAMPLES:].mean(axis=0) - rates[:END_SAMPLES].mean(axis=0)
        if np.linalg.norm(change) <= PROVEN_MOTION + NOISE * noise:
            return 0.0, 0.0, 0.0
        x, y, z = change.tolist()
        return x, y, z

    def _rates(self, unit: int) -> list[Vector]:
        """Return the rates of an IMU within `AVERAGED`, rad/s."""
        return list(self._recent[unit])[-self._averaged :]

    def rate(self, unit: int) -> float:
        """Return the largest rate of an IMU within `AVERAGED`, rad/s."""
        rates = self._rates(unit)
        return max(math.hypot(*rate) for rate in rates) if rates else math.nan

    def shift(self, unit: int, other: int) -> Vector:
        """Return the mean difference of two healthy IMUs that measure `USUAL_SKEW` apart.

        By axis, rad/s: of the rate that both gain, or both lose, within `AVERAGED`.
        """
        gains = []
        for k in (unit, other):
            rates = self._rates(k)
            ends = zip(rates[0], rates[-1], strict=True)
            gains.append([last - first for first, last in ends])
        share = USUAL_SKEW / AVERAGED
        x, y, z = (share * abs(_steady(pair)) for pair in zip(*gains, strict=True))
        return x, y, z

    def turn(self, unit: int) -> Vector:
        """Return the mean rate of an IMU within `AVERAGED`, rad/s: that of a turn."""
        x, y, z = _mean(np.array(self._rates(unit) or [UNKNOWN_RATES])).tolist()
        return x, y, z

    def shake(self, unit: int) -> Vector:
        """Return the standard deviation of the rate of an IMU within `AVERAGED`, rad/s."""
        x, y, z = np.std(self._rates(unit) or [UNKNOWN_RATES], axis=0).tolist()
        return x, y, z

    def peaks(self, unit: int) -> Vector:
        """Return the largest rate of an IMU within twice `AVERAGED`, by axis, rad/s."""
        rates = list(self._recent[unit])[-2 * self._averaged :] or [UNKNOWN_RATES]
        x, y, z = np.abs(rates).max(axis=0).tolist()
        return x, y, z

    def is_stuck(self, unit: int) -> bool:
        """Return whether an IMU has repeated one value while another one moved."""
        return self._stuck[unit]

    def repeats(self, unit: int, count: int) -> bool:
        """Return whether the last count samples of an IMU are all the same."""
        return len(set(list(self._recent[unit])[-count:])) < 2

    def steps(self, unit: int, count: int) -> Vector:
        """Return how far each axis of an IMU changed within `SKEW`, rad/s.

        The largest change among the last count samples. A healthy IMU that measures this
        much earlier or later differs by as much.
        """
        rates = list(self._recent[unit])[-count - self._lag :]
        largest = [0.0, 0.0, 0.0]
        for before, after in zip(rates, rates[self._lag :], strict=False):
            for axis in range(3):
                change = abs(after[axis] - before[axis])
                largest[axis] = max(largest[axis], change)
        return largest[0], largest[1], largest[2]

    def steady(self, unit: int, other: int, now: int) -> Vector:
        """Return the smallest difference of two IMUs within `QUICK`, by axis, rad/s.

        0 where the differences oscillate: they do not all have the same sign, are no
        smooth curve, or had the other sign within `TURNED`. NaN: too few are known at
        time now, ns.
        """
        rows = self._rows(unit, other, now)
        if len(rows) < self.fewest:
            return UNKNOWN_RATES
        newest, difference = rows[-1]
        if max(map(abs, difference)) < LARGE_DIFFERENCE:
            return 0.0, 0.0, 0.0
        sign = 1.0 if unit < other else -1.0
        before = sign * np.array([row for at, row in rows if at > newest - TURNED])
        values = before[-self.fewest :]
        least = np.array(list(map(_steady, values.T.tolist())))
        smooth = np.abs(_mean(values)) >= SMOOTHNESS * _roughness(values)
        smooth &= ~self._vibrates(rows)
        turned = (2.0 * before * np.sign(least) < -np.abs(least)).any(axis=0)
        x, y, z = np.where(smooth & ~turned, least, 0.0).tolist()
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
        ages = [rows[-1][0] - at for at, _ in rows]
        count = last or max(self.fewest, sum(age < AVERAGED for age in ages))
        if len(rows) < max(2, count) or now - rows[-count][0] > CURRENT:
            return None
        if min(before - after for before, after in pairwise(ages)) > self._longest:
            return None
        sign = 1.0 if unit < other else -1.0
        values = sign * np.array([difference for _, difference in rows])
        late = values[-count:]
        mean = _mean(late)
        spread = _spread(late, mean)
        std = spread / math.sqrt(count)
        # A hole may hide half of an oscillation, so the time before it counts as well.
        ahead = max(before - after for before, after in pairwise(ages[-count:]))
        span = 2 * AVERAGED if ahead > QUICK else AVERAGED
        seen = values[-max(count, sum(age < span for age in ages)) :]
        steady = np.abs(_mean(seen)) >= SMOOTHNESS * _roughness(seen)
        if (~steady & (np.abs(mean) >= spread)).any():
            steady |= _lasts(values, np.array(ages) // AVERAGED)
        if steady.any():
            steady &= ~self._vibrates(rows)
        x, y, z = (tuple(row.tolist()) for row in (mean, spread, std))
        return Difference(x, y, z, tuple(steady.tolist()))

    def _rows(self, unit: int, other: int, now: int) -> list[tuple[int, Vector]]:
        """Return times and differences of late of two IMUs. Empty: none is recent.

        Differences are those of the IMU with the smaller number less the other one.
        """
        rows = self._pairs[min(unit, other), max(unit, other)]
        return list(rows) if rows and now - rows[-1][0] <= CURRENT else []

    def _vibrates(self, rows: Sequence[tuple[int, Vector]]) -> np.ndarray:
        """Return which axes vibrate rather than differ. None do where no message is missing."""
        times = np.array([at for at, _ in rows])
        values = np.array([difference for _, difference in rows])
        if len(rows) < JUDGED or np.diff(times).max() <= self._longest:
            return np.zeros(3, dtype=bool)
        age = (times[-1] - times) / NS
        phase = 2.0 * np.pi * FREQUENCIES[:, None] * age
        line = _unexplained(np.ones((1, len(age))), age[None], values)
        wave = _unexplained(np.cos(phase), np.sin(phase), values)
        vibrates: np.ndarray = line[0] > BETTER * wave.min(axis=0)
        return vibrates


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


def _roughness(values: np.ndarray) -> np.ndarray:
    """Return the standard deviation of white noise that steps as much, by column."""
    step = values[1:] - values[:-1]
    rough: np.ndarray = np.sqrt(_mean(step * step) / 2.0)
    return rough


def _lasts(values: np.ndarray, window: np.ndarray) -> np.ndarray:
    """Return which columns have one sign in all windows, and means beyond their spread."""
    parts = [values[window == k] for k in range(WINDOWS)]
    if min(map(len, parts)) < FEWEST:
        return np.zeros(values.shape[1], dtype=bool)
    means = np.array([part.mean(axis=0) for part in parts])
    stds = np.array([part.std(axis=0, ddof=1) for part in parts])
    one_sign = np.abs(np.sign(means).sum(axis=0)) == WINDOWS
    lasting: np.ndarray = one_sign & (np.abs(means) >= stds).all(axis=0)
    return lasting


def _nearest(found: Sequence[Vector]) -> Vector:
    """Return the smallest of the differences of an IMU to its partners."""
    # One difference that is unknown may be the one in which the IMU agrees.
    if not found or any(map(math.isnan, map(max, found))):
        return UNKNOWN_RATES
    return min(found, key=max)


def _steady(values: Sequence[float]) -> float:
    """Return the value nearest to zero, or 0 if the values differ in sign."""
    low = min(values)
    high = max(values)
    return max(low, 0.0) + min(high, 0.0)


class Evidence:
    """Joins the monitor's states and the raw comparison to an `Imu` for each IMU.

    Parameters
    ----------
    count
        Number of IMUs. The monitor has three channels for each.
    interval
        Time between two samples of an IMU, ns.
    min_size
        Smallest difference at which an IMU is apart, rad/s. `SCALE` of the smaller of the
        two rates adds to it.
    """

    def __init__(self, count: int, interval: int, min_size: float) -> None:
        self.heard = 0  #: Time of the monitor's last states, ns. 0: none.
        self.begun = 0  #: Time from which states have come without a break, ns.
        self.raw = RawComparison(count, interval)
        self.imus: tuple[Imu, ...] = (Imu(),) * count
        # Each pair of IMUs, in either order, and when it was last known, ns.
        self._pairs: dict[tuple[int, int], Compared] = {}
        self._known_at: dict[tuple[int, int], int] = {}
        # Difference of each IMU and the nearest other one, and its bound, rad/s.
        self._nearby = [math.nan] * count
        self._bounded = [math.nan] * count
        self._min_size = min_size
        self._sized = SIZED // interval
        # States of the three channels of each IMU. Empty: unknown.
        self._states: list[tuple[ChannelState, ...]] = [()] * count
        self._sizes = [UNKNOWN_RATES] * count  # largest of late, by axis, rad/s
        # Doubts of the monitor that agreement has refuted. None: the IMU is not trusted.
        self._refuted: list[set[ChannelState] | None] = [None] * count
        # Doubts of the monitor about each IMU, and since when, ns.
        self._doubted: list[set[ChannelState]] = [set()] * count
        self._doubted_at = [0] * count
        # Axes of each IMU that are FAULTY or in a set; since when the IMU agrees
        # although they are, ns; and the axes for which this has lasted for `TRUSTED`.
        self._named: list[set[int]] = [set()] * count
        self._named_at = [0] * count
        self._outdated: list[set[int]] = [set()] * count
        self._together: int | None = None  # since when all IMUs agree, ns
        # Since when each IMU agrees with another, ns, and has agreed in a turn that shows
        # an error in proportion to the rate.
        self._agreed: list[int | None] = [None] * count
        self._turned: list[int | None] = [None] * count
        # How each IMU was bad when it last was.
        self._wrong: list[Wrong | None] = [None] * count
        # Whether each IMU has agreed in a turn since it was apart from all others.
        self._has_shown = [False] * count
        self._agreed_at = [0] * count  # when each IMU last agreed, ns
        self._odd = -1  # the IMU that is bad without a name, or -1
        self._odd_since = 0
        self._odd_seen = 0
        self._looked = 0

    def hear(self, states: Sequence[float], now: int) -> None:
        """Take the states of all channels, numbers of `ChannelState`, at time now, ns."""
        if now - self.heard >= SILENCE:
            self.begun = now
        self.heard = now
        found = [ChannelState(int(state)) for state in states]
        self._states = [tuple(found[k : k + 3]) for k in range(0, len(found), 3)]

    def look(
        self, delivers: Sequence[bool], out: Sequence[int], now: int
    ) -> tuple[Imu, ...]:
        """Return the IMUs at time now, ns.

        Parameters
        ----------
        delivers
            Whether each IMU delivers samples.
        out
            IMUs, from 0, out of use by our orders. Two bad IMUs may agree with each
            other, so agreement with these counts only while they are trusted.
        """
        if now - self.heard >= STATES_KNOWN_FOR:
            self._states = [()] * len(delivers)
        units = [k for k, does in enumerate(delivers) if does]
        self.raw.leave_out(out)
        self._compare(units, now)
        self._note_trust(units, now)
        odd, axes, lasting = self._odd_one(units, now)
        if odd == self._odd:
            self._odd_seen = now
        elif odd >= 0 or now - self._odd_seen > LONGEST_BREAK:
            self._odd = odd
            self._odd_since = self._odd_seen = now
        if now - self._odd_since < lasting:
            odd = -1
        partners = [
            self._partners(k, units, out) if k in units else []
            for k in range(len(delivers))
        ]
        pairs = [[self._pairs[k, j] for j in js] for k, js in enumerate(partners)]
        nearest = [_nearest([pair.apart for pair in row]) for row in pairs]
        self._nearby = [max(vector) for vector in nearest]
        self._bounded = [max(_nearest([pair.bound for pair in row])) for row in pairs]
        held = math.exp(-(now - self._looked) / NS / DECAY)
        self._looked = now
        imus = []
        for k, vector in enumerate(nearest):
            agreed = self._note_agreement(k, partners[k], k in out, now)
            if agreed is None or now - agreed < HEALED:
                before = [held * size for size in self._sizes[k]]
                x, y, z = map(max, vector, before)
                vector = x, y, z
            self._sizes[k] = vector
            faulty = self._axes(k, ChannelState.FAULTY)
            accused = faulty | axes if k == odd else faulty
            self._note_names(k, agreed, now)
            if not self._is_odd(k, units):
                accused = accused - self._outdated[k]
            blamed = any(vector[axis] >= self._min_size for axis in accused)
            if k in out or blamed:
                self._note_wrong(k, partners[k], nearest[k])
            elif agreed is not None and now - agreed >= HEALED:
                self._wrong[k] = None
            is_unknown = not self._states[k] and k != odd
            stuck = self.raw.is_stuck(k)
            imus.append(
                Imu(
                    named=None if is_unknown else bool(faulty or k == odd),
                    blamed=blamed,
                    ok=set(self._states[k]) == {ChannelState.OK} and not stuck,
                    delivers=delivers[k],
                    stuck=stuck,
                    size=max(vector),
                    least=self._least(k, units),
                    agreed=agreed,
                    judged=any(state not in UNJUDGED for state in self._states[k]),
                )
            )
        self.imus = tuple(imus)
        return self.imus

    def bound(self, unit: int) -> float:
        """Return a bound on the difference of an IMU to the nearest other one now, rad/s."""
        return self._bounded[unit]

    def _compare(self, units: Sequence[int], now: int) -> None:
        """Compare each pair of IMUs."""
        for j, k in combinations(units, 2):
            difference = self.raw.between(j, k, now)
            if difference is not None:
                self._known_at[j, k] = now
                found = self._compared(j, k, difference, now)
            elif now - self._known_at.get((j, k), 0) > BREAK:
                found = UNCOMPARED
            else:
                # Of a lossy link: the last values hold.
                continue
            self._pairs[j, k] = self._pairs[k, j] = found

    def _compared(self, j: int, k: int, difference: Difference, now: int) -> Compared:
        """Return how far two IMUs are apart, less what scales and delays explain."""
        quick = self.raw.steady(j, k, now)
        scale = SCALE * min(self.raw.rate(j), self.raw.rate(k))
        shifts = self.raw.shift(j, k)
        axes = []
        for axis, mean in enumerate(difference.mean):
            spread = difference.spread[axis]
            size = max(0.0, abs(mean) - scale - shifts[axis])
            is_wild = math.hypot(mean, spread) >= WILD_OSCILLATION + scale
            is_steady = difference.steady[axis] or abs(quick[axis]) >= LARGE_DIFFERENCE
            apart = size if is_steady else WILD_OSCILLATION if is_wild else 0.0
            axes.append((apart, max(size, spread if spread >= CALM else 0.0), size))
        return Compared(*zip(*axes, strict=True))

    def _note_trust(self, units: Sequence[int], now: int) -> None:
        """Note whether all IMUs agree, and which are apart from all others."""
        pairs = list(combinations(units, 2))
        stuck = any(map(self.raw.is_stuck, units))
        agree = pairs and all(
            max(self._pairs[pair].apart) < self._min_size for pair in pairs
        )
        self._together = (self._together or now) if agree and not stuck else None
        for k in units:
            doubts = self._doubts(k)
            if doubts != self._doubted[k]:
                self._doubted[k] = doubts
                self._doubted_at[k] = now
            own = [max(self._pairs[k, j].apart) for j in units if j != k]
            is_turning = (
                not self._wrong[k] and math.hypot(*self.raw.turn(k)) >= TURN_RATE
            )
            if self._turned[k] is not None or (self._together and is_turning):
                self._has_shown[k] = True
            if self._together is not None and now - self._together >= TRUSTED:
                is_old = now - self._doubted_at[k] >= REFUTING
                if self._has_shown[k]:
                    self._refuted[k] = doubts if is_old else self._refuted[k] or set()
            elif all(size >= self._min_size for size in own):
                self._refuted[k] = None
                self._has_shown[k] = False

    def _note_agreement(
        self, unit: int, partners: Sequence[int], is_out: bool, now: int
    ) -> int | None:
        """Return since when an IMU agrees with another, ns, or None."""
        doubted = bool(self._doubts(unit))
        agreeing = [k for k in partners if self._agree(unit, k, doubted)]
        is_contradicted = is_out and self._is_contradicted(unit, partners)
        if agreeing:
            self._agreed_at[unit] = now
        if is_contradicted or now - self._agreed_at[unit] > BREAK:
            self._agreed[unit] = self._turned[unit] = None
        elif agreeing:
            self._agreed[unit] = self._agreed[unit] or now
            # A mean that is no steady error yet may be the begin or end of a turn.
            alike = [k for k in agreeing if self._agree(unit, k, doubted=True)]
            if any(self._shows(unit, k) for k in alike):
                self._turned[unit] = self._turned[unit] or now
        must_turn = doubted or is_out
        return self._turned[unit] if must_turn else self._agreed[unit]

    def _least(self, unit: int, units: Sequence[int]) -> float:
        """Return the difference of an IMU to the nearest of all others, rad/s."""
        pairs = [(unit, k) for k in units if k != unit and unit in units]
        sizes = [max(self._pairs[pair].apart) for pair in pairs]
        return min((size for size in sizes if size >= 0.0), default=math.nan)

    def _note_wrong(self, unit: int, partners: Sequence[int], apart: Vector) -> None:
        """Note the axis on which a bad IMU is off most, and its error as a share."""
        size, axis = max((size, axis) for axis, size in enumerate(apart))
        if not size >= self._min_size:
            return
        # Of a gyro without scale the error is this rate at most.
        rate = max(self.raw.peaks(k)[axis] for k in partners)
        found = Wrong(axis, size, rate, size / max(rate, TINY))
        before = self._wrong[unit]
        if before is not None and axis == before.axis:
            share = max(found.share, before.share)
            rate = max(rate, before.rate)
            self._wrong[unit] = Wrong(axis, max(size, before.size), rate, share)
        elif before is None or size > before.size:
            self._wrong[unit] = found

    def _shows(self, unit: int, other: int) -> bool:
        """Return whether a turn shows the error of an IMU that agrees with another.

        A bias was apart at rest too. A gyro that has lost its scale on one axis shows that
        only in turns about this axis.
        """
        turn = self.raw.turn(other)
        wrong = self._wrong[unit]
        if wrong is None:
            return math.hypot(*turn) >= TURN_RATE
        # What scatters does not agree from `CALM` on: twice that is shown by a shake.
        shake = self.raw.shake(other)[wrong.axis] / (2.0 * CALM)
        shown = max(abs(turn[wrong.axis]), SHOWN * self._min_size * shake)
        needed = SHOWN * self._min_size / wrong.share
        return shown >= min(SAME_TURN * wrong.rate, needed)

    def _note_names(self, unit: int, agreed: int | None, now: int) -> None:
        """Note which axes were named before the IMU has agreed for long."""
        named = self._axes(unit, ChannelState.FAULTY)
        named |= self._axes(unit, ChannelState.AMBIGUOUS)
        if agreed is None or named != self._named[unit]:
            self._named[unit] = named
            self._named_at[unit] = now
        elif now - self._named_at[unit] >= TRUSTED:
            self._outdated[unit] = named
        self._outdated[unit] &= named

    def _doubts(self, unit: int) -> set[ChannelState]:
        return DOUBTS.intersection(self._states[unit])

    def _axes(self, unit: int, wanted: ChannelState) -> set[int]:
        """Return the axes of an IMU to which the monitor gives a state."""
        states = enumerate(self._states[unit])
        return {axis for axis, state in states if state == wanted}

    def _partners(
        self, unit: int, units: Sequence[int], out: Sequence[int]
    ) -> list[int]:
        """Return the IMUs with which one is compared: in use or trusted, or else all.

        One that is stuck is no measure.
        """
        others = [k for k in units if k != unit and not self.raw.is_stuck(k)]
        fit = [k for k in others if k not in out or self._refuted[k] is not None]
        return fit or others

    def _agree(self, unit: int, other: int, doubted: bool) -> bool:
        """Return whether an IMU agrees with a partner that is sound.

        doubted: by the monitor. Then an oscillation counts against it.
        """
        is_ok = set(self._states[other]) == {ChannelState.OK}
        is_sound = is_ok or self._nearby[other] < self._min_size
        is_stuck = self.raw.is_stuck(unit) or self.raw.is_stuck(other)
        pair = self._pairs[unit, other]
        sizes = pair.bound if doubted else pair.apart
        return is_sound and not is_stuck and max(sizes) < self._min_size

    def _is_contradicted(self, unit: int, partners: Sequence[int]) -> bool:
        """Return whether an IMU differs from a partner that the monitor does not name.

        Two IMUs that fail alike agree with each other, but not with the third.
        """
        return any(
            max(self._pairs[unit, k].apart) >= self._min_size
            and not self._axes(k, ChannelState.FAULTY)
            for k in partners
        )

    def _is_odd(self, unit: int, units: Sequence[int]) -> bool:
        """Return whether the two other IMUs agree, and nothing is against these two.

        They are trusted, their values change, and every doubt that the monitor has of
        them was refuted before, or is one that it has of this IMU too.
        """
        others = [k for k in units if k != unit]
        if len(others) != 2 or unit not in units:
            return False
        size = min(max(self._pairs[unit, k].apart) for k in others)
        between = max(self._pairs[others[0], others[1]].mean)
        if not between < max(self._min_size, ALIKE * size):
            return False
        for k in others:
            refuted = self._refuted[k]
            if refuted is None or self.raw.repeats(k, self.raw.fewest):
                return False
            if not self._doubts(k) <= refuted | self._doubts(unit):
                return False
        return True

    def _odd_one(self, units: Sequence[int], now: int) -> tuple[int, set[int], int]:
        """Return an IMU that is bad although the monitor does not name it.

        Also return its axes, and for how long this must last before it counts, ns.
        `NOBODY` if there is none.

        Of three IMUs it is the one that is off by `CLEAR_DIFFERENCE` while the two others
        agree, or by less if the monitor doubts it or it is stuck. Otherwise it is the
        only IMU with a set. If one of two others is not trusted, a set proves nothing:
        two IMUs that fail alike put the healthy third one into a set.
        """
        for k in units:
            if not self._is_odd(k, units):
                continue
            if axes := self._clear_axes(k, units, now):
                return k, axes, 0
            others = [j for j in units if j != k]
            sizes = [self._pairs[k, j].apart for j in others]
            least = [min(one, other) for one, other in zip(*sizes, strict=True)]
            steps = [self.raw.steps(j, self.raw.fewest) for j in others]
            vote = VOTE * self._min_size
            checks = (
                (range(3) if self.raw.is_stuck(k) else (), self._min_size, SET_STANDS),
                (self._axes(k, ChannelState.AMBIGUOUS), vote, SET_STANDS),
            )
            for doubted, size, stands in checks:
                if axes := {axis for axis in doubted if least[axis] >= size}:
                    return k, axes, stands
            axes = {
                axis
                for axis in self._axes(k, ChannelState.SUSPECT)
                if least[axis] >= vote + max(step[axis] for step in steps)
            }
            if axes:
                return k, axes, SUSPECT_STANDS
        sets = {k: self._axes(k, ChannelState.AMBIGUOUS) for k in units}
        found = [(k, axes, SET_STANDS) for k, axes in sets.items() if axes]
        if len(found) != 1:
            return NOBODY
        others = [k for k in units if k != found[0][0]]
        trusted = all(self._refuted[k] is not None for k in others)
        return found[0] if trusted or len(others) < 2 else NOBODY

    def _clear_axes(self, unit: int, units: Sequence[int], now: int) -> set[int]:
        """Return the axes on which an IMU is far off from both others, in one direction.

        Farther than scales explain, and than the others turn within `SKEW`.
        """
        first, second = (k for k in units if k != unit)
        count = self.raw.fewest
        turning = max(self.raw.rate(first), self.raw.rate(second))
        least = LARGE_DIFFERENCE if self._doubts(unit) else CLEAR_DIFFERENCE
        limit = least + SCALE * turning
        rows = zip(
            self.raw.steady(unit, first, now),
            self.raw.steady(unit, second, now),
            self.raw.steps(first, count),
            self.raw.steps(second, count),
            strict=True,
        )
        return {
            axis
            for axis, (one, other, *steps) in enumerate(rows)
            if abs(_steady((one, other))) >= limit + max(steps)
        }

    def error(self, unit: int, now: int) -> tuple[str, float] | None:
        """Return the axis on which an IMU is off most, and by how much, rad/s.

        Measured against the IMU that the monitor finds OK, or else against the nearest.
        None: not known to `KNOWN_SIGMAS` standard deviations, or not of one axis.
        """
        found = [
            (not imu.ok, difference.size, difference)
            for k, imu in enumerate(self.imus)
            if k != unit and (difference := self.raw.between(unit, k, now, self._sized))
        ]
        if not found:
            return None
        mean, _, std, _ = min(found)[2]
        axis = max(range(3), key=lambda k: abs(mean[k]))
        others = [abs(mean[k]) for k in range(3) if k != axis]
        if max(others) > SECOND_AXIS * abs(mean[axis]):
            # A whole unit is off: its error is no more than the motion of the vehicle.
            return None
        if not abs(mean[axis]) > KNOWN_SIGMAS * std[axis]:
            return None
        return "xyz"[axis], mean[axis]
