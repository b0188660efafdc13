# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Whether an IMU is off.

docs/failover.md, "Words": an IMU is *off* on an axis if its raw rate differs there from that of
every IMU that counts on this axis. The difference must reach ``failover_min_size`` plus 5 % of
the rate, which `failover.apart` has taken off already.
"""

from __future__ import annotations

import math

from fdi_ros.mavlink.failover.records import Present
from fdi_ros.mavlink.protocol import NS

#: Time constant with which the largest size of late decays, s: the size of an error that
#: comes and goes holds for this long.
DECAY_S = 0.5

#: Once the IMU has agreed for this time, ns, only the present size counts, and how the IMU was
#: bad is forgotten.
FORGOTTEN_NS = NS // 2


def note_nearest(present: Present, unit: int) -> None:
    """Note the difference of an IMU to the nearest IMU that counts, and a bound on it."""
    track = present.tracks[unit]
    x, y, z = (
        min((present.pairs[unit, k].apart[axis] for k in found), default=math.nan)
        for axis, found in enumerate(track.partners.on)
    )
    track.nearest = x, y, z
    bounds = [max(present.pairs[unit, k].bound) for k in track.partners.common]
    track.bound = min(bounds, default=math.nan)


def note_sizes(present: Present, unit: int, agreed: int | None) -> None:
    """Note the largest differences of late, and what follows for each axis.

    agreed: since when the agreement of the IMU counts, ns, or None.
    """
    track = present.tracks[unit]
    share = math.exp(-present.elapsed / NS / DECAY_S)
    kept = 0.0 if is_forgotten(present, agreed) else share
    x, y, z = (
        max(new, kept * old)
        for new, old in zip(track.nearest, track.sizes, strict=True)
    )
    track.sizes = x, y, z
    near = set()
    for axis, size in enumerate(track.sizes):
        if size < present.both_errors:
            track.near_at[axis] = present.now
        if size < present.min_size:
            near.add(axis)
    track.questioned = (track.questioned | track.doubted_axes) - near


def is_forgotten(present: Present, agreed: int | None) -> bool:
    """Return whether an IMU has agreed for so long that former errors are forgotten."""
    return agreed is not None and present.now - agreed >= FORGOTTEN_NS


def off_axes(present: Present, unit: int) -> set[int]:
    """Return the axes on which an IMU is off now from the IMUs that count."""
    nearest = present.tracks[unit].nearest
    return {axis for axis, size in enumerate(nearest) if size >= present.min_size}


def off_from_all(present: Present, unit: int) -> set[int]:
    """Return the axes on which an IMU is apart from every other IMU, in use or not."""
    pairs = [present.pairs[unit, k] for k in present.others(unit)]
    return {
        axis
        for axis in range(3)
        if pairs and all(pair.apart[axis] >= present.min_size for pair in pairs)
    }


def least_difference(present: Present, unit: int) -> float:
    """Return the difference of an IMU to the nearest of all others, rad/s. NaN: unknown."""
    if unit not in present.units:
        return math.nan
    sizes = [max(present.pairs[unit, k].apart) for k in present.others(unit)]
    return min((size for size in sizes if size >= 0.0), default=math.nan)
