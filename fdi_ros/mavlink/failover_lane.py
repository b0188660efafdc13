# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""When to ask an ArduPilot for another EKF lane: a pure function, called at every tick.

ArduPilot flies with the gyro of its primary lane. Lane k runs on IMU k, or on the first
IMU in use while IMU k is out. A bad IMU misleads its lane until the IMU is out. The lane
then runs on with a wrong attitude, and ArduPilot often stays on it, as the error is below
its own limits.

The auxiliary function `vehicle.LANE_SWITCH` makes ArduPilot change to the lane with the best
score. ArduPilot calls the same function before its EKF failsafe. Beside a healthy primary
lane it can do harm: a lane that was misled just now still has a good score. So it is asked
for only if all of this holds:

1. The IMU that the primary lane ran on has gone out by our order, reported by the autopilot.
2. The primary lane is known, and has not changed since then.
3. Every IMU in use is alive and agrees with the others, and one of them has another lane.
4. The vehicle is armed, heard, and monitored.

It is asked for at the times `ASK_AFTER` from the report. What is not allowed then is left
out. ArduPilot itself changes its lane at most once in 5 s, and not if no lane is better.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from fdi_ros.mavlink.failover_policy import (
    LONG_AGO,
    Memory,
    PolicySettings,
    View,
    is_alive,
)
from fdi_ros.mavlink.protocol import MS, NS

#: Times from the report that the IMU is out, ns. The scores of the lanes need about 0.3 s.
ASK_AFTER = (300 * MS, 600 * MS, NS, 2 * NS)
#: For this time, ns, a lane that a text has named may be newer than the heartbeat "disarmed".
HEARTBEAT_AGE = 2 * NS


class LaneReport(NamedTuple):
    """What the autopilot has reported of its lanes."""

    named: int | None = None  #: Lane that a text has named since the last tick.
    configured: int | None = None  #: EK3_PRIMARY. None: not reported.
    lanes: int = 0  #: Number of lanes. Lane k is that of IMU k, from 0. 0: not known.
    #: No text can have been lost since the last tick.
    is_complete: bool = False
    has_texts: bool = False  #: Texts of the autopilot do arrive over this link.


class LaneState(NamedTuple):
    """Memory between two ticks. Times in ns."""

    #: Lane that the autopilot flies with. None: unknown.
    primary: int | None = None
    named_at: int = LONG_AGO  #: When a text last named it, before a heartbeat "armed".
    source: int | None = None  #: IMU, from 0, that this lane runs on. None: unknown.
    #: When the IMU that this lane ran on was reported out by our order. None: it was not.
    misled_at: int | None = None
    asks: int = 0  #: Number of times `ASK_AFTER` that have passed since then.
    boots: int = 0  #: Number of starts of the autopilot seen at the last tick.


def follow(
    state: LaneState,
    report: LaneReport,
    memories: Sequence[Memory],
    view: View,
    now: int,
    settings: PolicySettings,
) -> tuple[LaneState, bool]:
    """Return the next state, and whether to ask for another lane at time now, ns.

    The memories are those of the policy after its decision at this time.
    """
    if view.boots != state.boots:
        state = LaneState(boots=view.boots)
    if report.named is not None and not view.armed:
        state = state._replace(named_at=now)
    primary = _primary(state, report, view, now)
    source = _source(primary, memories)
    is_same = primary is not None and primary == state.primary and view.armed
    misled_at = state.misled_at if is_same else None
    asks = state.asks
    if is_same and _is_out(state.source, memories):
        misled_at = now
        asks = 0
    passed = 0
    if misled_at is not None:
        passed = sum(now - misled_at >= after for after in ASK_AFTER)
    ask = passed > asks and _may_ask(primary, report, memories, view, settings)
    state = state._replace(
        primary=primary, source=source, misled_at=misled_at, asks=passed
    )
    return state, ask


def _primary(state: LaneState, report: LaneReport, view: View, now: int) -> int | None:
    """Return the lane that the autopilot flies with. None: unknown.

    While disarmed ArduPilot returns to the lane of EK3_PRIMARY.
    """
    count = report.lanes
    if report.named is not None:
        return report.named if report.named < count else None
    if not report.is_complete:
        return None
    if view.armed or now - state.named_at < HEARTBEAT_AGE:
        return state.primary
    if report.configured is None or not count:
        return None
    return report.configured if 0 <= report.configured < count else 0


def _source(primary: int | None, memories: Sequence[Memory]) -> int | None:
    """Return the IMU that the primary lane runs on. None: unknown."""
    if primary is None or memories[primary].seen is not False:
        return primary
    return next((k for k, memory in enumerate(memories) if memory.seen), None)


def _is_out(imu: int | None, memories: Sequence[Memory]) -> bool:
    """Return whether an IMU is reported out of use after our order."""
    return imu is not None and memories[imu].ours and memories[imu].seen is False


def _may_ask(
    primary: int | None,
    report: LaneReport,
    memories: Sequence[Memory],
    view: View,
    settings: PolicySettings,
) -> bool:
    """Return whether another lane is sure to be fine, as far as can be known."""
    in_use = [k for k, memory in enumerate(memories) if memory.seen and not memory.ours]
    is_fine = all(
        is_alive(view.imus[k]) and view.imus[k].size < settings.min_size for k in in_use
    )
    is_watched = view.armed and view.linked and view.monitored and report.has_texts
    return (
        is_watched
        and is_fine
        and any(k != primary and k < report.lanes for k in in_use)
    )
