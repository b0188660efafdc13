# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""When an IMU is bad: the rule that takes an IMU out of use.

docs/failover.md, "When an IMU is bad": an IMU is bad if it is off and accused on the same axis,
and if a or b holds.

a. *Outvoted.* The two other IMUs agree on that axis, and both move on that axis. Both have trust,
   and no doubt (`failover.outvoted`).
b. *Named for this difference.* The difference is twice ``failover_min_size``. The accusation came
   at most 0.3 s before the difference reached this size. The monitor does not doubt this axis of
   any IMU that counts there, and one of these moves on this axis. None may have failed like an
   IMU that waits to agree in a turn about this axis (`failover.alike`).

The last IMU in use is bad if it is off and accused, without a or b.
"""

from __future__ import annotations

from collections.abc import Set

from fdi_ros.mavlink.failover.alike import others_fail_alike
from fdi_ros.mavlink.failover.outvoted import outvoted_axes
from fdi_ros.mavlink.failover.records import Present


def bad_axes(present: Present, unit: int, accused: Set[int]) -> set[int]:
    """Return the axes on which an IMU that is accused on some axes is bad."""
    if not accused:
        return set()
    track = present.tracks[unit]
    is_last = not track.partners.are_fit
    outvoted = outvoted_axes(present, unit)
    found = set()
    for axis in accused:
        if is_last or axis in outvoted:
            least = present.min_size
        elif _is_named_for_this_difference(present, unit, axis):
            least = present.both_errors
        else:
            continue
        if track.nearest[axis] >= least:
            found.add(axis)
    return found


def _is_named_for_this_difference(present: Present, unit: int, axis: int) -> bool:
    """Return whether rule b holds for an axis, apart from the size of the difference."""
    track = present.tracks[unit]
    others = [present.tracks[k] for k in track.partners.on[axis]]
    is_doubted = any(axis in other.doubted_axes for other in others)
    moves = any(axis in other.moves for other in others)
    if is_doubted or not moves or not track.is_newly_accused(axis):
        return False
    return not others_fail_alike(present, unit, axis)
