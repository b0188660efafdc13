# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""On which axes the two other IMUs outvote an IMU.

docs/failover.md, "When an IMU is bad", rule a, *Outvoted*: the two other IMUs agree on that axis,
and both move on that axis. Both have trust (`failover.trust`), and no doubt.

*No doubt*: the monitor does not doubt the IMU. Some doubts do not count, see `vouched_axes`.

*Voters*: an IMU that was out in this flight is no voter, until it is back and has agreed in
turns about all three axes. Two IMUs that are both no voters do not outvote a voter.

*Frozen*: if the accused IMU repeats one value while another IMU moves, rule a asks less. The
values of the two other IMUs must change, and these two must agree on all axes.
"""

from __future__ import annotations

from fdi_ros.mavlink.failover.records import Present, Track

#: Two IMUs also agree within this share of their difference to the accused IMU.
ALIKE = 0.05


def voters(present: Present, unit: int) -> list[int]:
    """Return the two other IMUs, if they may outvote one, or none."""
    others = present.others(unit)
    no_voters = present.no_voters
    if unit not in no_voters and all(k in no_voters for k in others):
        return []
    return others if len(others) == 2 and unit in present.units else []


def outvoted_axes(present: Present, unit: int) -> set[int]:
    """Return the axes on which the two other IMUs outvote one."""
    others = voters(present, unit)
    if not others:
        return set()
    raw = present.raw
    if any(raw.repeats(k, raw.fewest) for k in others):
        return set()
    axes = _agreed_axes(present, unit, others)
    if raw.is_stuck(unit):
        return axes if len(axes) == 3 else set()
    for k in others:
        axes &= vouched_axes(present.tracks[k], present.tracks[unit])
    return axes


def _agreed_axes(present: Present, unit: int, others: list[int]) -> set[int]:
    """Return the axes on which the two other IMUs agree."""
    size = min(max(present.pairs[unit, k].apart) for k in others)
    limit = max(present.min_size, ALIKE * size)
    one, other = others
    between = present.pairs[one, other].mean
    return {axis for axis, mean in enumerate(between) if mean < limit}


def vouched_axes(voter: Track, accused: Track) -> set[int]:
    """Return the axes on which an IMU moves, has trust and no doubt that counts.

    With trust on all axes a doubt does not count if the monitor has the same doubt about
    the accused IMU, or if agreement has refuted it.
    """
    refuted = voter.refuted
    if refuted is not None and voter.doubts <= refuted | accused.doubts:
        return voter.moves
    return (voter.proven & voter.moves) - _against_one_axis(voter, accused)


def _against_one_axis(voter: Track, accused: Track) -> set[int]:
    """Return the axes with a doubt that counts against an IMU with trust on these axes only.

    A doubt does not count if it is FAULTY: the axis has moved since then. Nor if the monitor
    has the same doubt about this axis of the accused IMU, or has newly found that axis FAULTY.
    """
    doubted = voter.doubted_axes - voter.faulty_axes
    return {
        axis
        for axis in doubted
        if voter.states[axis] is not accused.states[axis]
        and not (axis in accused.faulty_axes and accused.is_newly_accused(axis))
    }
