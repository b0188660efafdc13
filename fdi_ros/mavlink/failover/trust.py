# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Which IMUs have trust, on all axes or on some.

docs/failover.md, "When an IMU is bad", *Trust*: all IMUs have agreed for 2 s, with a turn of
0.1 rad/s, and the IMU has not been off or become FAULTY since then. It has also agreed in turns
about every axis that was bad. This is trust on all axes (`Track.is_trusted`).

If not, the IMU has trust on each axis that moves, on which it was never off since all IMUs last
agreed, and that has moved since the IMU was last found bad on any axis (`Track.proven`).
"""

from __future__ import annotations

import math
from itertools import combinations

from fdi_ros.core.states import ChannelState
from fdi_ros.mavlink.failover.off import off_from_all
from fdi_ros.mavlink.failover.records import Present
from fdi_ros.mavlink.protocol import MS, NS

TRUSTED_AFTER_NS = 2 * NS  #: IMUs are trusted after all have agreed for this time, ns.

#: An IMU is trusted once it has turned by this, rad/s, as a mean of 120 ms: a dead gyro agrees
#: with one at rest.
TURN_RATE = 0.1

#: Agreement refutes a doubt that has stood for this time, ns, and a motion this long after an
#: error proves an axis: mean rates hold samples of 120 ms from before.
REFUTING_NS = 300 * MS


def agreement_of_all(present: Present, before: int | None) -> int | None:
    """Return since when all IMUs agree, ns, or None. before: the last result."""
    pairs = list(combinations(present.units, 2))
    agree = pairs and all(
        max(present.pairs[pair].apart) < present.min_size for pair in pairs
    )
    is_stuck = any(map(present.raw.is_stuck, present.units))
    return (before or present.now) if agree and not is_stuck else None


def note_trust(present: Present, unit: int, all_agree_since: int | None) -> None:
    """Note whether an IMU has trust on all axes. all_agree_since: from `agreement_of_all`."""
    track = present.tracks[unit]
    _note_doubts(present, unit)
    # An IMU that was bad needs turns that show how: `turned_since`.
    rate = math.hypot(*present.raw.motion(unit).mean)
    is_turning = not track.wrong and rate >= TURN_RATE
    if track.turned_since is not None or (all_agree_since and is_turning):
        track.has_turned = True
    sizes = [max(present.pairs[unit, k].apart) for k in present.others(unit)]
    agreed_for = 0 if all_agree_since is None else present.now - all_agree_since
    if agreed_for >= TRUSTED_AFTER_NS:
        if track.has_turned and not track.waits:
            is_old = present.now - track.doubts_since >= REFUTING_NS
            track.refuted = track.doubts if is_old else track.refuted or set()
            track.was_off.clear()
    elif all(size >= present.min_size for size in sizes):
        track.refuted = None
        track.has_turned = False


def _note_doubts(present: Present, unit: int) -> None:
    """Note since when the monitor has its present doubts of an IMU."""
    track = present.tracks[unit]
    doubts = track.doubts
    if doubts == track.last_doubts:
        return
    if ChannelState.FAULTY in doubts - track.last_doubts:
        # Agreement from before says nothing of a gyro that died since then.
        track.refuted = track.turned_since = None
        track.has_turned = False
        track.shown.clear()
    track.last_doubts = doubts
    track.doubts_since = present.now


def note_proven(present: Present, unit: int) -> None:
    """Note the axes on which an IMU is known to measure.

    An IMU that is found bad on a further axis may be dead: all axes must move again. An
    unknown difference, such as after a gap, is not bad.
    """
    track = present.tracks[unit]
    off = off_from_all(present, unit)
    by_monitor = {(axis, True) for axis in track.faulty_axes}
    found_bad = by_monitor | {(axis, False) for axis in off}
    if not found_bad <= track.found_bad:
        track.found_bad_at = present.now
    track.found_bad = found_bad
    track.was_off |= off
    since = track.found_bad_at + REFUTING_NS
    moves = track.moves - track.was_off
    track.proven = {axis for axis in moves if track.moved_at[axis] >= since}
