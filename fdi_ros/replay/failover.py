# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What failover would have done in a flight, by the policy that `mavlink_node` has: a replay of the declarations."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from fdi_ros.core.states import ChannelState
from fdi_ros.mavlink.clock import MS, NS
from fdi_ros.mavlink.failover import PARAMETERS, TEXTS, Declarations, format_imu
from fdi_ros.mavlink.failover_policy import HEALED, YOUNG, FailoverState, FailoverUnit, Known, decide
from fdi_ros.replay.summary import StateChange

_STEP = 20 * MS
"""The policy is asked so often while a declaration is young, ns."""
_BEFORE = NS + HEALED
"""Time of the policy at the start of a recording, ns."""


def failover_text(events: Sequence[StateChange], channels: Sequence[str]) -> str:
    """Say what failover would have done with all IMUs in use, armed, and parameters that are set at once.

    Parameters
    ----------
    events
        All changes of state of a recording, in order.
    channels
        Names of the channels, three for each IMU.

    Returns
    -------
    One line; empty where failover would not run.
    """
    count = len(channels) // 3
    if not 2 <= count <= len(PARAMETERS) or len(channels) % 3:
        return ""
    declarations, states, state = Declarations(count), [float(ChannelState.UNCHECKED)] * len(channels), FailoverState()
    use, done, waiting = [True] * count, [], deque(events)
    for now in _times(events):
        # Between two changes the monitor was heard all the time.
        declarations.heard = now - 1
        while waiting and _time(waiting[0]) <= now:
            event = waiting.popleft()
            states[channels.index(event.channel)] = float(ChannelState[event.state])
        declarations.hear(states, now)
        stale = [ChannelState.STALE in states[3 * k : 3 * k + 3] for k in range(count)]
        units = tuple(FailoverUnit(use[k], now, *declarations.of(k), delivers=not stale[k]) for k in range(count))
        state, actions = decide(state, Known(units, linked=True, armed=True, monitored=True), now)
        for action in actions:
            if action.kind == "set":
                use[action.unit] = action.use
            else:
                words = TEXTS[action.kind][1] + action.why
                done.append(f"{format_imu(action.unit, channels)} {words} at {(now - _BEFORE) / NS:.1f} s")
    return f"failover, if armed: {'; '.join(done) or 'nothing to do'}"


def _time(event: StateChange) -> int:
    return _BEFORE + round(event.at_s * NS)


def _times(events: Sequence[StateChange]) -> list[int]:
    """Return when the policy is asked: at every change, and while what was declared is young, ns."""
    declared = [_time(event) for event in events if event.state == ChannelState.FAULTY.name]
    young = (at + k * _STEP for at in declared for k in range(YOUNG // _STEP + 3))
    return sorted({*map(_time, events), *young})
