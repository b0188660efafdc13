# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Whether an autopilot obeys: a pure function finds this out before an order is needed.

Each INS_USE that is 1 is set to 1, once after each start of the autopilot. ArduPilot reports
a parameter that is set, also to the value that it has. The answer to a read is the same
message, so the parameter is not read for a while before and after.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from fdi_ros.mavlink.protocol import MS, NS

#: After this time no answer to a read is under way, ns: longer than the longest round
#: trip at which failover is ready, and the 100 ms by which ArduPilot answers late.
PROBE_QUIET = 500 * MS
ANSWERED = NS  #: The answer to a probe is awaited for this time, ns.
PROBE_AGAIN = 5 * NS  #: Time between two probes of an IMU that brought no answer, ns.


class Probe(NamedTuple):
    """Memory between two ticks. Times in ns."""

    #: Whether the autopilot sets the parameter of each IMU. None: unknown.
    obeys: tuple[bool | None, ...]
    imu: int = -1  #: IMU that is probed now: its parameter is not to be read. -1: none.
    begun: int = 0  #: When the parameter was last read.
    sent: int = 0  #: When it was set. 0: not yet.
    after: tuple[int, ...] = ()  #: Times before which each IMU is not probed.

    @classmethod
    def begin(cls, count: int) -> Probe:
        """Return the state after a start of the autopilot, of count IMUs."""
        return cls((None,) * count, after=(0,) * count)


def probe(
    state: Probe,
    may: Sequence[bool],
    heard: Sequence[int],
    outcomes: Sequence[bool | None],
    now: int,
) -> tuple[Probe, int]:
    """Return the next state, and the IMU whose INS_USE is to be set to 1 now, or -1.

    Parameters
    ----------
    may
        Whether each IMU is in use, and no order depends on its reports.
    heard
        When each INS_USE was last reported, ns.
    outcomes
        What else shows of each IMU that its parameter is set, or is refused.
    now
        Time, ns.
    """
    found = zip(outcomes, state.obeys, strict=True)
    obeys = [known if seen is None else seen for seen, known in found]
    after = list(state.after)
    imu = state.imu
    if imu >= 0:
        if state.sent and heard[imu] > state.sent and may[imu] and obeys[imu] is None:
            obeys[imu] = True
        is_over = state.sent and now - state.sent >= ANSWERED
        if is_over or not may[imu] or obeys[imu] is not None:
            after[imu] = now + PROBE_AGAIN
            imu = -1
        elif not state.sent and now - state.begun >= PROBE_QUIET:
            return state._replace(obeys=tuple(obeys), sent=now), imu
    if imu >= 0:
        return state._replace(obeys=tuple(obeys)), -1
    due = [k for k, known in enumerate(obeys) if known is None and may[k]]
    due = [k for k in due if now >= after[k]]
    return Probe(tuple(obeys), due[0] if due else -1, now, 0, tuple(after)), -1
