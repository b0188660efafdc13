# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The size of an error in a text of failover.

docs/failover.md, "Texts": the text ``out of use`` has the size of the error. The size is left out
if several axes are off, or if it is not known.
"""

from __future__ import annotations

from collections.abc import Sequence

from fdi_ros.mavlink.failover.policy import Imu
from fdi_ros.mavlink.failover.raw import RawComparison
from fdi_ros.mavlink.failover.records import AXES
from fdi_ros.mavlink.protocol import MS

AVERAGED_NS = 80 * MS  #: The size is averaged over the samples of this time, ns.

#: Several axes are off if a second one is off by this share of the first. Then a whole unit is
#: wrong, and its error shows no more than the motion of the vehicle.
SECOND_AXIS = 0.5

KNOWN_SIGMAS = 5.0  #: Multiple of its standard deviation from which a size is known.


def error_of(
    raw: RawComparison, imus: Sequence[Imu], unit: int, interval: int, now: int
) -> tuple[str, float] | None:
    """Return the axis on which an IMU is off most, and by how much, rad/s.

    Measured against the IMU that the monitor finds OK, or else against the nearest.
    interval: time between two samples, ns. None: no size, as above.
    """
    count = max(2, AVERAGED_NS // interval)
    found = [
        (not imu.ok, difference.size, difference)
        for k, imu in enumerate(imus)
        if k != unit and (difference := raw.between(unit, k, now, count))
    ]
    if not found:
        return None
    mean, _, std, _ = min(found)[2]
    axis = max(range(3), key=lambda k: abs(mean[k]))
    second = max(abs(mean[k]) for k in range(3) if k != axis)
    if second > SECOND_AXIS * abs(mean[axis]):
        return None
    if not abs(mean[axis]) > KNOWN_SIGMAS * std[axis]:
        return None
    return AXES[axis], mean[axis]
