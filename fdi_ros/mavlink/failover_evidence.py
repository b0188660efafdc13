# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Evidence for failover: raw samples of the IMUs compared, beside the monitor's states.

The monitor removes learned errors from the samples and remembers declarations. The raw
comparison does neither and shows the present difference of the autopilot's own gyros.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

from fdi_ros.core.states import ChannelState
from fdi_ros.mavlink.failover_policy import Imu
from fdi_ros.mavlink.protocol import MS, NS, Vector

AVERAGED = 120 * MS  #: Differences are averaged over the samples of this time, ns.
CURRENT = 500 * MS  #: Oldest pair of samples that still counts, ns.
DECAY = 0.5  #: Time constant with which the largest size of late decays, s,
HEALED = NS // 2  #: until the IMU has agreed for this time, ns.
LASTING = 300 * MS  #: A set must stand for this time to name an IMU, ns.
VOTE = 2.0  #: Least error of the odd one in a set of several IMUs, in ``min_size``.
LARGE = 0.3  #: Difference from which any doubt of the monitor names the odd IMU, rad/s.
#: Difference from which the odd IMU needs no doubt of the monitor, rad/s. The monitor takes
#: 0.2 s to exclude a spike. An autopilot whose primary gyro reads zero is at 50 deg then.
CLEAR = 0.5
#: Share of the rate added to `CLEAR`: gyros of one type differ in scale by up to 3 %, and
#: healthy ones then by more than `CLEAR` in a turn of 17 rad/s.
SCALE = 0.05
QUICK = 50 * MS  #: All samples of this time must differ by `LARGE` or `CLEAR`, ns,
FEWEST = 3  #: and this number of samples.
SIZED = 4  #: Samples over which the size in a text is averaged: all after the onset.
WHOLE = 0.5  #: Share of the largest axis from which a second one is off as well.
ALIKE = 0.05  #: Two IMUs agree within this share of the odd one's difference, too.
#: States of channels that are a doubt.
DOUBTS = {
    ChannelState.SUSPECT,
    ChannelState.AMBIGUOUS,
    ChannelState.FAULTY,
    ChannelState.STALE,
}
CERTAIN = 5.0  #: Standard deviations from which a size is known.
SILENT = NS // 2  #: An IMU without samples for this time does not deliver, ns.


class Difference(NamedTuple):
    """Rate of one IMU less the rate of another, averaged over `AVERAGED`."""

    mean: Vector  #: rad/s
    std: Vector  #: Standard deviation of the mean, rad/s.

    @property
    def size(self) -> float:
        """Largest component, rad/s."""
        return max(map(abs, self.mean))


class RawComparison:
    """Differences between the raw rates of count IMUs.

    Parameters
    ----------
    count
        Number of IMUs.
    interval
        Time between two samples of an IMU, ns. Samples of two IMUs form a pair if
        their stamps differ by less than 0.4 intervals.
    """

    def __init__(self, count: int, interval: int) -> None:
        self._reach = 2 * interval // 5
        self._last: list[tuple[int, Vector]] = [(-NS, (0.0, 0.0, 0.0))] * count
        self._pairs: dict[tuple[int, int], deque[tuple[int, Vector]]] = {
            (j, k): deque(maxlen=256) for k in range(count) for j in range(k)
        }

    def feed(self, unit: int, stamp: int, rate: Vector) -> None:
        """Take a sample of an IMU, from 0: stamp in ns, rate in rad/s."""
        if unit >= len(self._last):
            return
        self._last[unit] = stamp, rate
        for pair, rows in self._pairs.items():
            if unit not in pair:
                continue
            (first_stamp, first), (second_stamp, second) = (self._last[k] for k in pair)
            if abs(first_stamp - second_stamp) < self._reach:
                x, y, z = (a - b for a, b in zip(first, second, strict=True))
                rows.append((stamp, (x, y, z)))
            while rows and rows[0][0] <= stamp - AVERAGED:
                rows.popleft()

    def rate(self, unit: int) -> float:
        """Return the size of the last rate of an IMU, rad/s."""
        return math.hypot(*self._last[unit][1])

    def least(self, unit: int, other: int, count: int, now: int) -> float:
        """Return the smallest of the last count differences of two IMUs at time now, ns.

        The size of a difference is its largest component, rad/s. NaN: fewer are known.
        """
        rows = list(self._pairs[min(unit, other), max(unit, other)])[-count:]
        if len(rows) < count or now - rows[-1][0] > CURRENT:
            return math.nan
        return min(max(map(abs, difference)) for _, difference in rows)

    def between(
        self, unit: int, other: int, now: int, last: int = 0
    ) -> Difference | None:
        """Return the difference of two IMUs at time now, ns, or None without recent pairs.

        last: number of samples averaged. 0: all within `AVERAGED`.
        """
        rows = list(self._pairs[min(unit, other), max(unit, other)])[-last:]
        if len(rows) < last or not rows or now - rows[-1][0] > CURRENT:
            return None
        sign = 1.0 if unit < other else -1.0
        count = len(rows)
        columns = list(zip(*(row for _, row in rows), strict=True))
        mean = [sign * sum(column) / count for column in columns]
        # With one pair nothing is known of the noise.
        scale = math.sqrt(count * (count - 1)) if count > 1 else 0.0
        std = [
            math.dist(column, [sign * centre] * count) / scale if scale else math.inf
            for column, centre in zip(columns, mean, strict=True)
        ]
        return Difference((mean[0], mean[1], mean[2]), (std[0], std[1], std[2]))


class Evidence:
    """Joins the monitor's states and the raw comparison to an `Imu` for each IMU.

    Parameters
    ----------
    count
        Number of IMUs. The monitor has three channels for each.
    interval
        Time between two samples of an IMU, ns.
    min_size
        Smallest difference at which an IMU is apart, rad/s.
    """

    def __init__(self, count: int, interval: int, min_size: float) -> None:
        self.heard = 0  #: Time of the monitor's last states, ns. 0: none.
        self.begun = 0  #: Time from which states have come without a break, ns.
        self.raw = RawComparison(count, interval)
        self.imus: tuple[Imu, ...] = (Imu(),) * count
        #: Raw difference of each IMU to the nearest other one now, rad/s. NaN: unknown.
        self.apart = [math.nan] * count
        self._min_size = min_size
        self._fewest = max(FEWEST, QUICK // interval + 1)
        self._states: list[set[float]] = [set()] * count
        self._odd = -1  # the IMU that is bad without a name, or -1
        self._odd_since = 0
        self._looked = 0

    def hear(self, states: Sequence[float], now: int) -> None:
        """Take the states of all channels, numbers of `ChannelState`, at time now, ns."""
        if now - self.heard >= SILENT:
            self.begun = now
        self.heard = now
        self._states = [set(states[k : k + 3]) for k in range(0, len(states), 3)]

    def look(self, delivers: Sequence[bool], now: int) -> tuple[Imu, ...]:
        """Return the IMUs at time now, ns, given which IMUs deliver samples."""
        apart: dict[tuple[int, int], float] = {}  # rad/s, by pair
        for pair in combinations(range(len(delivers)), 2):
            if delivers[pair[0]] and delivers[pair[1]]:
                difference = self.raw.between(*pair, now)
                apart[pair] = difference.size if difference else math.nan
        odd, lasting = self._odd_one(apart, now)
        if odd != self._odd:
            self._odd = odd
            self._odd_since = now
        held = math.exp(-(now - self._looked) / NS / DECAY)
        self._looked = now
        imus = []
        for k, before in enumerate(self.imus):
            own = [size for pair, size in apart.items() if k in pair]
            # One difference that is unknown may be the one in which the IMU agrees.
            known = own and not any(map(math.isnan, own))
            size = min(own) if known else math.nan
            self.apart[k] = size
            agreed = (before.agreed or now) if size < self._min_size else None
            if before.size > size and (agreed is None or now - agreed < HEALED):
                size = max(size, before.size * held)
            faulty = ChannelState.FAULTY in self._states[k]
            voted = k == odd and now - self._odd_since >= lasting
            imus.append(
                Imu(
                    named=faulty or voted,
                    ok=self._states[k] == {ChannelState.OK},
                    delivers=delivers[k],
                    size=size,
                    agreed=agreed,
                )
            )
        self.imus = tuple(imus)
        return self.imus

    def _odd_one(
        self, apart: Mapping[tuple[int, int], float], now: int
    ) -> tuple[int, int]:
        """Return the IMU that is bad without a name, and for how long that must stand, ns.

        Of three IMUs that is the one that is off while the two others agree: by `CLEAR`
        and `SCALE`, or by less if the monitor has a doubt too. Else the only IMU with a set. -1: none.

        Parameters
        ----------
        apart
            Difference of each pair of IMUs that deliver samples, rad/s. NaN: unknown.
        """
        for pair, alike in apart.items() if len(apart) == 3 else ():
            (k,) = {0, 1, 2}.difference(pair)
            size = min(size for other, size in apart.items() if other != pair)
            if not alike < max(self._min_size, ALIKE * size):
                continue
            states = self._states[k]
            turning = max(map(self.raw.rate, pair))
            limit = LARGE if states & DOUBTS else CLEAR + SCALE * turning
            if all(self.raw.least(k, j, self._fewest, now) >= limit for j in pair):
                return k, 0
            if ChannelState.AMBIGUOUS in states and size >= VOTE * self._min_size:
                return k, LASTING
        sets = [
            k for k, one in enumerate(self._states) if ChannelState.AMBIGUOUS in one
        ]
        return (sets[0] if len(sets) == 1 else -1), LASTING

    def error(self, unit: int, now: int) -> tuple[str, float] | None:
        """Return the axis on which an IMU is off most, and by how much, rad/s.

        Measured against the IMU that the monitor finds OK, or else against the nearest.
        None: not known to `CERTAIN` standard deviations, or not of one axis.
        """
        found = [
            (not imu.ok, difference.size, difference)
            for k, imu in enumerate(self.imus)
            if k != unit and (difference := self.raw.between(unit, k, now, SIZED))
        ]
        if not found:
            return None
        mean, std = min(found)[2]
        axis = max(range(3), key=lambda k: abs(mean[k]))
        others = [abs(mean[k]) for k in range(3) if k != axis]
        if max(others) > WHOLE * abs(mean[axis]):
            # A whole unit is off: its error is no more than the motion of the vehicle.
            return None
        if not abs(mean[axis]) > CERTAIN * std[axis]:
            return None
        return "xyz"[axis], mean[axis]
