# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Which axes move.

docs/failover.md, "Words" and "Limits of moves and off": an axis of an IMU *moves* if its mean
rate changes within 1 s, and the mean rate of another IMU changes alike. After that the axis
counts as moving for 5 s. An axis that does not move may be dead.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations

from fdi_ros.mavlink.failover.raw import nearest_zero
from fdi_ros.mavlink.failover.records import Present
from fdi_ros.mavlink.protocol import NS, Vector

#: An axis moves if its mean rate, and the one of another IMU, change by this or more, rad/s. A
#: steady rate is no motion: both axes may be stuck at it.
MOVED_BY_RAD_S = 0.005

#: The change must also reach this multiple of the noise of the mean. At 3, two axes that died
#: 10 s apart in noise of 6 mrad/s outvote the third IMU in 2 of 12 flights, at 4 in none.
MOVES_SIGMAS = 4.0

MOVES_WITHIN_NS = NS  #: Longest time of that change, ns.

#: An axis counts as moving for this time after the change began, ns. In the logs of two hovering
#: quadcopters every axis moved all the time; without wind, in simulation, yaw for 87 %. A
#: fault that is flown with turns the vehicle, so that the healthy axes move.
MOVED_FOR_NS = 5 * NS


@dataclass
class LastTurns:
    """Mean rates at some time, from which changes count."""

    rates: dict[int, Vector] = field(default_factory=dict)  #: By IMU, rad/s.
    at: int = 0  #: ns


def note_moves(present: Present, last: LastTurns) -> None:
    """Note which axes move. last: brought up to date."""
    turns = {k: present.raw.motion(k).mean for k in present.units}
    if present.now - last.at >= MOVES_WITHIN_NS:
        last.at = present.now
        last.rates = turns
    for pair in combinations(turns.keys() & last.rates.keys(), 2):
        noise = present.raw.noise(*pair)
        for axis in range(3):
            one, other = (turns[k][axis] - last.rates[k][axis] for k in pair)
            if _change_alike(one, other, noise[axis]):
                for k in pair:
                    present.tracks[k].moved_at[axis] = last.at
    for track in present.tracks:
        track.moves = {
            axis
            for axis, at in enumerate(track.moved_at)
            if present.now - at < MOVED_FOR_NS
        }


def _change_alike(one: float, other: float, noise: float) -> bool:
    """Return whether two mean rates change alike, beyond noise, rad/s.

    The two changes may differ by no more than the smaller one.
    """
    needed = max(MOVED_BY_RAD_S, MOVES_SIGMAS * noise)
    least = abs(nearest_zero((one, other)))
    return least >= needed and abs(one - other) <= least
