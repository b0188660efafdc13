# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Changes of state in the log: channels that change alike in one line, and of each channel seldom more than a few."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from fdi_ros.monitor.diagnostics import format_apart
from fdi_ros.monitor.output import ChannelState, Event, format_reason
from fdi_ros.monitor.status import ApartStatus
from fdi_ros.ros.messages import BoundedLog

QUIET = 5.0
"""After a line about a channel the next one comes not before so long, s, unless the channel's state becomes worse."""
SEVERITY = {
    ChannelState.OK: 0,
    ChannelState.EXCLUDED: 1,
    ChannelState.UNCHECKED: 1,
    ChannelState.SUSPECT: 2,
    ChannelState.STALE: 3,
    ChannelState.AMBIGUOUS: 4,
    ChannelState.FAULTY: 5,
}


@dataclass
class _Reported:
    """What the log says of a channel."""

    until: float = 0.0
    """When the next line may come, s."""
    worst: int = 0
    """Severity of the worst state since the line before that."""
    state: ChannelState = ChannelState.UNCHECKED
    """The present one, logged or not."""
    left_out: int = 0
    """Changes that were not logged."""


class ChangeLog:
    """Logs changes of state."""

    def __init__(self, log: BoundedLog, names: Sequence[str], clock: Callable[[], float] = time.monotonic) -> None:
        self._log, self._names, self._clock = log, names, clock
        self._reported = [_Reported() for _ in names]

    def add(self, events: Sequence[Event], shift: int, pair: ApartStatus | None) -> None:
        """Log the changes that one sample has brought.

        Parameters
        ----------
        events
            The changes.
        shift
            To be subtracted from their stamps to have those of the messages, ns.
        pair
            Where a set is declared, the pair in it that differs for certain.
        """
        now = self._clock()
        lines: dict[tuple[ChannelState, str], list[int]] = {}
        for event in events:
            if self._is_due(event, now):
                words = format_reason(event, self._names)
                words += f"; {format_apart(pair)}" if pair is not None and len(event.group) > 1 else ""
                line = f"{event.before.name} -> {event.after.name} at {(event.stamp - shift) / 1e9:.3f} s"
                lines.setdefault((event.after, f"{line}{words and ': '}{words}"), []).append(event.channel)
        for (state, words), channels in lines.items():
            self._write(state, channels, words)

    def check(self) -> None:
        """Log where the channels are now that have changed since their last line."""
        now = self._clock()
        lines: dict[ChannelState, list[int]] = {}
        for channel, one in enumerate(self._reported):
            if one.left_out and now >= one.until:
                lines.setdefault(one.state, []).append(channel)
        for state, channels in lines.items():
            most = max(self._reported[channel].left_out for channel in channels)
            self._write(state, channels, f"{state.name} now, after {most} more change{'s' if most > 1 else ''}")
            for channel in channels:
                self._reported[channel] = _Reported(now + QUIET, SEVERITY[state], state)

    def _is_due(self, event: Event, now: float) -> bool:
        one, severity = self._reported[event.channel], SEVERITY[event.after]
        one.state = event.after
        if now < one.until and severity <= one.worst:
            one.left_out += 1
            return False
        worst = severity if now >= one.until else max(one.worst, severity)
        self._reported[event.channel] = _Reported(now + QUIET, worst, event.after)
        return True

    def _write(self, state: ChannelState, channels: Sequence[int], words: str) -> None:
        line = f"{', '.join(self._names[channel] for channel in channels)}: {words}"
        if SEVERITY[state] >= SEVERITY[ChannelState.STALE]:
            self._log.error(line)
        elif state is ChannelState.OK:
            self._log.info(line)
        else:
            self._log.warning(line)
