# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""How far two IMUs are apart.

docs/failover.md, "Words": the difference of two raw rates counts as far as it exceeds 5 % of the
rate. These are for the scales of healthy gyros, which differ by some per cent. "When an IMU goes
back", rule 4: delays of 5 ms are allowed for, too.

"Vibration and the rate of the messages": a difference is an error only if it is steady
(`failover.raw`). An oscillation is an error if its standard deviation is 1 rad/s or more.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

from fdi_ros.mavlink.failover.raw import (
    LARGE_DIFFERENCE,
    Difference,
    RawComparison,
    shift,
)
from fdi_ros.mavlink.failover.records import UNCOMPARED, Compared, Pair
from fdi_ros.mavlink.failover.wrong import HEALTHY_SCALE
from fdi_ros.mavlink.protocol import MS, Vector

#: A shorter break of a lossy link ends no difference and no agreement, ns.
BREAK_NS = 100 * MS

#: An oscillation with this standard deviation is an error, rad/s.
WILD = 1.0

#: A difference that scatters by less is calm, rad/s. An IMU that the monitor doubts agrees
#: only while the difference is calm.
CALM = 0.1


class PairMemory:
    """The last comparison of each pair of IMUs."""

    def __init__(self) -> None:
        #: Of both orders of a pair.
        self.compared: dict[Pair, Compared] = {}
        self._known_at: dict[Pair, int] = {}

    def update(
        self,
        raw: RawComparison,
        units: Sequence[int],
        steady: dict[Pair, Vector],
        now: int,
    ) -> None:
        """Compare the IMUs that deliver samples, given their steady differences."""
        for pair in combinations(units, 2):
            found = compare(raw, pair, steady[pair], now)
            if found is not None:
                self._known_at[pair] = now
            elif now - self._known_at.get(pair, 0) > BREAK_NS:
                found = UNCOMPARED
            else:
                # The last values hold.
                continue
            one, other = pair
            self.compared[one, other] = self.compared[other, one] = found


def steady_differences(
    raw: RawComparison, units: Sequence[int], now: int
) -> dict[Pair, Vector]:
    """Return the smallest steady difference of each pair, in both orders, by axis, rad/s."""
    found: dict[Pair, Vector] = {}
    for one, other in combinations(units, 2):
        x, y, z = found[one, other] = raw.steady(one, other, now)
        found[other, one] = -x, -y, -z
    return found


def compare(
    raw: RawComparison, pair: Pair, steady: Vector, now: int
) -> Compared | None:
    """Return how far two IMUs are apart, or None if their difference is not known.

    steady: their smallest steady difference, by axis, rad/s.
    """
    difference = raw.between(*pair, now)
    if difference is None:
        return None
    one, other = map(raw.motion, pair)
    scale = HEALTHY_SCALE * min(one.largest, other.largest)
    shifts = shift(one.gain, other.gain)
    axes = [
        _compare_axis(difference, axis, steady[axis], scale, shifts[axis])
        for axis in range(3)
    ]
    return Compared(*zip(*axes, strict=True))


def _compare_axis(
    difference: Difference, axis: int, steady: float, scale: float, delay: float
) -> tuple[float, float, float, float]:
    """Return the fields of `Compared` for one axis, rad/s.

    scale, delay: what scales and delays explain, rad/s.
    """
    mean = difference.mean[axis]
    spread = difference.spread[axis]
    full = max(0.0, abs(mean) - delay)
    size = max(0.0, full - scale)
    apart = 0.0
    if difference.steady[axis] or abs(steady) >= LARGE_DIFFERENCE:
        apart = size
    elif math.hypot(mean, spread) >= WILD + scale:
        apart = WILD
    scatter = spread if spread >= CALM else 0.0
    return apart, max(size, scatter), size, full
