# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Orders that the policy of failover would have given in a recorded flight, if armed."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from fdi_ros.core.states import ChannelState
from fdi_ros.mavlink.failover import PARAMETERS
from fdi_ros.mavlink.failover_evidence import LASTING
from fdi_ros.mavlink.failover_policy import (
    Imu,
    PolicySettings,
    PolicyState,
    View,
    decide,
)
from fdi_ros.mavlink.failover_words import imu_name
from fdi_ros.mavlink.protocol import MS, NS

_STEP = 20 * MS  # the policy is asked so often, ns
_AFTER = 40 * NS  # and for this time after a change, ns: longer than every pause
_BEGIN = 10 * NS  # time of the policy at the start of the recording, ns


class Change(NamedTuple):
    """One change of state of a channel in a recording."""

    at: float  #: Time since the start, s.
    channel: str  #: Name.
    state: str  #: Name of the new `ChannelState`.
    error: float  #: Estimated error, rad/s. 0: not estimated.


class _Channel(NamedTuple):
    state: ChannelState = ChannelState.UNCHECKED
    error: float = 0.0


def failover_text(changes: Sequence[Change], channels: Sequence[str]) -> str:
    """Return the orders that failover would have given in an armed flight.

    The raw samples are not looked at: an IMU counts as apart by the estimated error of
    its channels while the monitor declares one of them.

    Parameters
    ----------
    changes
        Changes of state, in order.
    channels
        Names of all channels, three for each IMU. Empty text: not two or three IMUs.
    """
    count = len(channels) // 3
    if not 2 <= count <= len(PARAMETERS) or len(channels) % 3:
        return ""
    now = dict.fromkeys(channels, _Channel())
    waiting = deque(changes)
    state, settings = PolicyState.begin(count), PolicySettings()
    use = [True] * count
    done: list[str] = []
    set_since = [0] * count
    agreed: list[int | None] = [_BEGIN - 20 * NS] * count
    for time in _times(changes):
        while waiting and _BEGIN + round(waiting[0].at * NS) <= time:
            change = waiting.popleft()
            found = _Channel(ChannelState[change.state], abs(change.error))
            now[change.channel] = found
        units = [
            [now[name] for name in channels[3 * k : 3 * k + 3]] for k in range(count)
        ]
        in_doubt = [_has_set(unit) for unit in units]
        imus = []
        for k, own in enumerate(units):
            size = _size(own)
            agreed[k] = (agreed[k] or time) if size < settings.min_size else None
            set_since[k] = set_since[k] if in_doubt[k] else time
            stands = sum(in_doubt) == 1 and time - set_since[k] >= LASTING
            faulty = any(one.state == ChannelState.FAULTY for one in own)
            imus.append(
                Imu(
                    use=use[k],
                    heard=time,
                    named=faulty or stands,
                    ok=all(one.state == ChannelState.OK for one in own),
                    delivers=all(one.state != ChannelState.STALE for one in own),
                    size=size,
                    agreed=agreed[k],
                )
            )
        view = View(tuple(imus), linked=True, armed=True, monitored=True)
        decision = decide(state, view, time, settings)
        state = decision.state
        for k, in_use in decision.orders:
            if use[k] != in_use:
                words = "in use again" if in_use else "out of use"
                at = (time - _BEGIN) / NS
                done.append(f"{imu_name(k, channels)} {words} at {at:.1f} s")
            use[k] = in_use
    nothing = (
        f"no IMU would be taken out (failover_min_size {settings.min_size:g} rad/s)"
    )
    return f"failover, if armed: {'; '.join(done) or nothing}"


def _times(changes: Sequence[Change]) -> Iterator[int]:
    """Yield the times at which the policy is asked, ns: those near a declaration."""
    names = {ChannelState.FAULTY.name, ChannelState.AMBIGUOUS.name}
    declared: set[str] = set()
    next_time = 0
    for change in changes:
        matters = change.state in names or change.channel in declared
        if change.state in names:
            declared.add(change.channel)
        begin = _BEGIN + round(change.at * NS)
        for time in range(max(next_time, begin), begin + _AFTER * matters, _STEP):
            yield time
            next_time = time + _STEP


def _has_set(channels: Sequence[_Channel]) -> bool:
    return any(one.state == ChannelState.AMBIGUOUS for one in channels)


def _size(channels: Sequence[_Channel]) -> float:
    """Return the largest error of declared channels, rad/s. Infinite: not estimated."""
    declared = (ChannelState.FAULTY, ChannelState.AMBIGUOUS)
    errors = [one.error or float("inf") for one in channels if one.state in declared]
    return max(errors, default=0.0)
