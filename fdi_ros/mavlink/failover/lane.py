# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""When to ask an ArduCopter for another EKF lane: a pure function, called at every tick.

ArduPilot flies with the gyro of its primary lane. Lane k runs on IMU k, or on the first
IMU in use while IMU k is out. A bad IMU misleads its lane until the IMU is out. The lane
then runs on with a wrong attitude, and ArduPilot often stays on it, as the error is below
its own limits.

The auxiliary function `vehicle.LANE_SWITCH` makes ArduPilot change to the healthy lane with
the lowest error score, if that is lower than the one of the primary lane. ArduCopter calls
the same function before its EKF failsafe. Beside a healthy primary lane it can do harm: a
lane that was misled just now still has a low score. So failover asks for it only if all of
this holds:

1. The IMU that the primary lane ran on has gone out by our order, reported by the autopilot.
2. The primary lane is known, and has not changed since then.
3. Another lane has its own IMU in use.
4. Each IMU on which another lane runs, or ran within `SCORED`, is alive and does not differ.
5. The vehicle is armed, heard, and monitored.

The asks are due at the times `ASK_AFTER` from the report. An ask that is not allowed when
due is left out. ArduPilot answers this function at most once in 5 s, which begin with any
change of its lane.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from fdi_ros.mavlink.failover.policy import (
    LONG_AGO,
    Imu,
    Memory,
    PolicySettings,
    View,
    is_alive,
)
from fdi_ros.mavlink.protocol import MS, NS

#: Times from the report that the IMU is out, ns. The scores of the lanes need some 0.3 s to
#: differ. The last time is after the 5 s of ArduPilot.
ASK_AFTER = (300 * MS, 600 * MS, NS, 2 * NS, 3 * NS, 4 * NS, 5500 * MS)
TOO_LATE = 6 * NS  #: After this time from the report nothing is asked, ns.
SCORED = NS  #: A lane that was misled has a high score after this time, ns.
#: For this time, ns, a text may be newer than the last heartbeat.
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
    named_at: int = LONG_AGO  #: When a text last named a lane while disarmed.
    source: int | None = None  #: IMU, from 0, that this lane runs on. None: unknown.
    #: When the IMU that this lane ran on was reported out by our order. None: it was not.
    out_at: int | None = None
    asks: int = 0  #: Number of times `ASK_AFTER` that have passed since then.
    #: When the IMU that each lane runs on was last bad.
    misled_at: tuple[int, ...] = ()
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
    is_same = primary is not None and primary == state.primary and view.armed
    out_at = state.out_at if is_same else None
    if is_same and _is_out(state.source, memories):
        out_at = now
    elapsed = -1 if out_at is None else now - out_at
    passed = sum(elapsed >= after for after in ASK_AFTER)
    is_due = passed > state.asks
    state = state._replace(
        primary=primary,
        source=_source(primary, memories),
        out_at=out_at,
        asks=passed,
        misled_at=_misled_at(state, memories, view, now, settings),
    )
    is_in_time = is_due and elapsed < TOO_LATE
    return state, is_in_time and _may_ask(state, report, memories, view, now, settings)


def _primary(state: LaneState, report: LaneReport, view: View, now: int) -> int | None:
    """Return the lane that the autopilot flies with. None: unknown.

    While disarmed ArduPilot returns to the lane of EK3_PRIMARY. A text that comes then is of the
    landing, or of an arming whose heartbeat is still to come.
    """
    if report.named is not None and view.armed:
        return report.named if report.named < report.lanes else None
    if not report.is_complete:
        return None
    if view.armed:
        return state.primary
    if report.configured is None or now - state.named_at < HEARTBEAT_AGE:
        return None
    return report.configured if report.configured < report.lanes else 0


def _source(lane: int | None, memories: Sequence[Memory]) -> int | None:
    """Return the IMU that a lane runs on. None: unknown, as after a start of the autopilot.

    An IMU that was out before that start has misled nothing.
    """
    if lane is None or memories[lane].seen is None:
        return None
    if memories[lane].seen:
        return lane
    return next((k for k, memory in enumerate(memories) if memory.seen), None)


def _is_out(imu: int | None, memories: Sequence[Memory]) -> bool:
    """Return whether an IMU is reported out of use after our order."""
    return imu is not None and memories[imu].ours and memories[imu].seen is False


def _is_fine(imu: Imu, settings: PolicySettings) -> bool:
    """Return whether an IMU measures, as far as can be known. Of unknown size: no."""
    return is_alive(imu) and imu.size < settings.min_size


def _misled_at(
    state: LaneState,
    memories: Sequence[Memory],
    view: View,
    now: int,
    settings: PolicySettings,
) -> tuple[int, ...]:
    """Return when the IMU that each lane runs on was last not known to be fine, ns."""
    known = state.misled_at or (LONG_AGO,) * len(memories)
    sources = [_source(lane, memories) for lane in range(len(memories))]
    return tuple(
        at if source is not None and _is_fine(view.imus[source], settings) else now
        for source, at in zip(sources, known, strict=True)
    )


def _may_ask(
    state: LaneState,
    report: LaneReport,
    memories: Sequence[Memory],
    view: View,
    now: int,
    settings: PolicySettings,
) -> bool:
    """Return whether the autopilot can only change to a better lane, as far as can be known."""
    others = [lane for lane in range(report.lanes) if lane != state.primary]
    checks = (
        view.linked,
        view.monitored,
        report.has_texts,
        any(memories[lane].seen for lane in others),
        all(now - state.misled_at[lane] >= SCORED for lane in others),
    )
    return all(checks)
