# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""How an IMU is bad, and which turns show that it measures again.

docs/failover.md, "When an IMU goes back", rule 3: before the pause, the IMU has agreed in turns
about every axis that was off or named. A turn of 0.06 rad/s or more shows a dead gyro. A scale
error needs a faster turn (`Wrong.shown_by`). Agreement with an IMU that may have failed alike
does not count (`failover.alike`).
"""

from __future__ import annotations

import math
from collections.abc import Set

from fdi_ros.mavlink.failover.alike import is_witness
from fdi_ros.mavlink.failover.apart import CALM
from fdi_ros.mavlink.failover.off import off_axes
from fdi_ros.mavlink.failover.records import Present
from fdi_ros.mavlink.failover.trust import TURN_RATE
from fdi_ros.mavlink.failover.wrong import WITHOUT_SCALE

#: A turn shows an error in proportion to the rate if that error would be this multiple of
#: ``min_size`` now. Of a dead gyro: 0.06 rad/s.
SHOWN = 2.0

ALL_AXES = frozenset(range(3))


def note_wrong(present: Present, unit: int, named: Set[int]) -> None:
    """Note the axes on which a bad IMU is off or named, and its errors as shares of the rate.

    In a hover an axis that is named may be dead without being off. Of an IMU that is
    out, and of which no axis is known, each axis may be bad.
    """
    track = present.tracks[unit]
    off = off_axes(present, unit)
    for axis in off:
        # The error of a gyro without scale is this rate at most.
        partners = track.partners.on[axis]
        rate = max(present.raw.peaks(k)[axis] for k in partners)
        before = track.wrong.get(axis, WITHOUT_SCALE)
        track.wrong[axis] = before.with_error(track.nearest[axis], rate)
    new: Set[int] = named - track.wrong.keys()
    if not new and not track.wrong:
        new = ALL_AXES
    track.wrong |= dict.fromkeys(new, WITHOUT_SCALE)
    if off or new:
        # A turn from before the error shows nothing.
        track.turned_since = None
        track.shown.clear()


def note_shown(present: Present, unit: int, other: int) -> bool:
    """Note which errors an IMU that agrees with another one has shown to be gone.

    Return whether these are all. A bias was off at rest, too. A gyro that has lost its
    scale on one axis shows that only in turns about this axis, and after any error a
    gyro may be dead.
    """
    track = present.tracks[unit]
    turn = present.raw.motion(other).mean
    for axis in range(3):
        if _turns_too_little(present, unit, other, axis):
            continue
        if axis in track.wrong and not is_witness(present, other, unit, axis):
            continue
        track.shown.add(axis)
    faulty = track.faulty_axes
    if track.wrong or faulty:
        return not track.waits and faulty <= track.shown
    return math.hypot(*turn) >= TURN_RATE


def _turns_too_little(present: Present, unit: int, other: int, axis: int) -> bool:
    """Return whether another IMU turns, and shakes, too little to show an error of this one."""
    motion = present.raw.motion(other)
    dead = SHOWN * present.min_size
    # A difference that scatters by `CALM` is no agreement: a shake of twice that shows a dead
    # gyro.
    shake = dead * motion.std[axis] / (2.0 * CALM)
    needed = present.tracks[unit].wrong.get(axis, WITHOUT_SCALE).shown_by(dead)
    return max(abs(motion.mean[axis]), shake) < needed
