# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Which IMU is accused, or bad without an accusation, beside channels that are FAULTY.

docs/failover.md, "Words": an IMU is *accused* on an axis if that channel is FAULTY, or if a set
within this IMU has contained that channel for 0.3 s.

"When an IMU is bad", *Sets among three IMUs*: a set within one IMU accuses this IMU only if no
other IMU is in a set. In addition both other IMUs must have trust on all axes, or this IMU must
repeat one value.

*Without an accusation*: an outvoted IMU may be bad without being accused, if the difference keeps
its sign. The larger the difference, the less the monitor must find:

- `CLEAR_DIFFERENCE` for 50 ms: nothing. `LARGE_DIFFERENCE` for 50 ms: any doubt.
- twice ``failover_min_size``: for 0.3 s a set, also of several IMUs, or for 1 s a suspicion.
- ``failover_min_size`` for 0.3 s, if this IMU repeats one value: nothing.
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from typing import NamedTuple

from fdi_ros.core.states import ChannelState
from fdi_ros.mavlink.failover.outvoted import outvoted_axes, voters
from fdi_ros.mavlink.failover.raw import LARGE_DIFFERENCE, nearest_zero
from fdi_ros.mavlink.failover.records import Present
from fdi_ros.mavlink.failover.wrong import HEALTHY_SCALE
from fdi_ros.mavlink.protocol import MS, NS

#: Difference from which the outvoted IMU needs no doubt of the monitor, rad/s. The monitor takes
#: 0.2 s to exclude a spike. An autopilot whose primary gyro reads zero is at 50 deg then.
CLEAR_DIFFERENCE = 0.5

#: A set, or an IMU that repeats one value, counts once it has stood for this time, ns.
SET_STANDS_NS = 300 * MS

#: A suspicion counts once it has stood for this time, ns: after a fault the monitor may take
#: seconds to name the next one.
SUSPICION_STANDS_NS = NS


class Accusation(NamedTuple):
    """An IMU that is accused by a set, or outvoted without an accusation."""

    unit: int  #: From 0, or -1 for none.
    axes: Set[int]  #: Axes of the set, or those on which it is outvoted.
    stands: int  #: How long this must last before it counts, ns.


NOBODY = Accusation(-1, frozenset(), 0)


def accusation(present: Present) -> Accusation:
    """Return the accusation of now. Of several the first: IMUs in use before those taken out."""
    # An IMU that is out is outvoted as before: another one may be so on another axis.
    for unit in sorted(present.units, key=present.taken.__contains__):
        outvoted = outvoted_axes(present, unit)
        if not outvoted:
            continue
        found = _without_accusation(present, unit, outvoted)
        if found.axes:
            return found
    return _accused_by_set(present)


def _without_accusation(present: Present, unit: int, outvoted: set[int]) -> Accusation:
    """Return on which axes an outvoted IMU is bad without being accused. May be none.

    The clearest case counts, with the time that it must last.
    """
    if axes := outvoted & _clear_axes(present, unit):
        return Accusation(unit, axes, 0)
    track = present.tracks[unit]
    one, other = (present.pairs[unit, k].apart for k in present.others(unit))
    sizes = [min(pair) for pair in zip(one, other, strict=True)]
    if present.raw.is_stuck(unit):
        axes = {axis for axis in outvoted if sizes[axis] >= present.min_size}
        if axes:
            return Accusation(unit, axes, SET_STANDS_NS)
    large = {axis for axis in outvoted if sizes[axis] >= present.both_errors}
    if axes := large & track.axes(ChannelState.AMBIGUOUS):
        return Accusation(unit, axes, SET_STANDS_NS)
    suspected = large & track.axes(ChannelState.SUSPECT)
    axes = _beyond_steps(present, unit, suspected, sizes, present.both_errors)
    return Accusation(unit, axes, SUSPICION_STANDS_NS)


def _clear_axes(present: Present, unit: int) -> set[int]:
    """Return the axes on which an IMU is far off from both others, in one direction.

    Farther than scales explain, and than the others turn between two times of sampling.
    """
    others = present.others(unit)
    is_doubted = bool(present.tracks[unit].doubts)
    least = LARGE_DIFFERENCE if is_doubted else CLEAR_DIFFERENCE
    rows = zip(*(present.steady[unit, k] for k in others), strict=True)
    sizes = [abs(nearest_zero(row)) for row in rows]
    axes = {axis for axis, size in enumerate(sizes) if size >= least}
    if not axes:
        return axes
    turn = max(present.raw.motion(k).largest for k in others)
    return _beyond_steps(present, unit, axes, sizes, least + HEALTHY_SCALE * turn)


def _beyond_steps(
    present: Present, unit: int, axes: set[int], sizes: Sequence[float], limit: float
) -> set[int]:
    """Return the axes with a size, rad/s, beyond a limit and what the others turn within 20 ms.

    IMUs are not sampled at the same instant.
    """
    if not axes:
        return axes
    raw = present.raw
    steps = [raw.steps(k, raw.fewest) for k in present.others(unit)]
    bounds = [limit + max(step) for step in zip(*steps, strict=True)]
    return {axis for axis in axes if sizes[axis] >= bounds[axis]}


def _accused_by_set(present: Present) -> Accusation:
    """Return the only IMU with a set, if the set proves something, or `NOBODY`.

    Two IMUs that fail alike put the healthy third one into a set.
    """
    sets = {k: present.tracks[k].axes(ChannelState.AMBIGUOUS) for k in present.units}
    found = [(k, axes) for k, axes in sets.items() if axes]
    if len(found) != 1:
        return NOBODY
    ((unit, axes),) = found
    others = voters(present, unit)
    are_trusted = others and all(present.tracks[k].is_trusted for k in others)
    are_two = len(present.units) < 3
    if are_two or are_trusted or present.raw.is_stuck(unit):
        return Accusation(unit, axes, SET_STANDS_NS)
    return NOBODY


LONGEST_BREAK_NS = 200 * MS  #: An accusation stands over a break of this length, ns.


class Standing:
    """Since when one IMU has been accused."""

    def __init__(self) -> None:
        self._unit = NOBODY.unit
        self._since = 0
        self._seen_at = 0

    def lasting(self, found: Accusation, now: int) -> Accusation:
        """Return the accusation of now if it has stood for long enough, or `NOBODY`."""
        if found.unit == self._unit:
            self._seen_at = now
        elif found.unit >= 0 or now - self._seen_at > LONGEST_BREAK_NS:
            self._unit = found.unit
            self._since = self._seen_at = now
        return found if now - self._since >= found.stands else NOBODY
