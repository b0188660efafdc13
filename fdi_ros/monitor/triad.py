"""Messages of one triad on their way into samples."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from fdi_ros.monitor.stamps import Counters

Rate = tuple[float, float, float]

MAX_BRIDGE = 0.25
"""Longest span between two messages that is interpolated, as a share of the timeout."""
MAX_STEPS = 2.5
"""And in usual message intervals: one lost message is bridged, two are not."""
UNKNOWN = 1 << 70
"""Step before the first message, ns."""
NEVER = -2 * UNKNOWN
"""Before all stamps."""


class Message(NamedTuple):
    """One message that was accepted."""

    stamp: int
    rate: Rate
    step: int
    """Since the message before, ns."""
    bridges: bool
    """Whether the span since the message before may be interpolated."""


class Triad:
    """Messages of one stream: the last one that samples have passed, and those that wait."""

    __slots__ = ("_bridge", "counters", "past", "pending", "used", "usual")

    def __init__(self, timeout: int) -> None:
        self.counters = Counters()
        self._bridge = int(MAX_BRIDGE * timeout)
        self.forget()

    def forget(self) -> None:
        """Drop all messages."""
        self.past: Message | None = None
        self.pending: deque[Message] = deque()
        self.used = NEVER
        """Stamp of the last message that entered a sample as it is."""
        self.usual = (0, 0)
        """The last two steps, ns."""

    def message(self, stamp: int, rate: Rate, step: int) -> Message:
        """Return the next message."""
        bridges = step <= self._bridge and step <= MAX_STEPS * max(self.usual)
        self.usual = (self.usual[1], step)
        return Message(stamp, rate, step, bridges)

    def head(self, last: int) -> Message | None:
        """Return the first message without a sample between it and the one before; `last`: the last sample."""
        for message in self.pending:
            if message.stamp - message.step >= last:
                return message
        return None

    def around(self, stamp: int) -> tuple[Message | None, Message | None]:
        """Return the last message up to a stamp (or the last that samples have passed) and the first beyond it."""
        before = self.past
        for message in self.pending:
            if message.stamp > stamp:
                return before, message
            before = message
        return before, None

    def match(self, anchor: Message, max_skew: int) -> Message | None:
        """Return the message that counts as of the anchor's instant."""
        before, after = self.around(anchor.stamp)
        for message in (after, before):
            if message is None or message.stamp <= self.used:
                continue
            apart = abs(message.stamp - anchor.stamp)
            # Nearer than half a step, or the message after a lost one would be taken for it.
            if apart <= max_skew and 2 * apart < min(message.step, anchor.step):
                return message
        return None

    def line(self, stamp: int) -> Rate | None:
        """Return the rate on the line between the messages around a stamp; None if they are too far apart."""
        before, after = self.around(stamp)
        if before is None or after is None or not after.bridges or before.stamp > stamp:
            return None
        share = (stamp - before.stamp) / after.step
        (a, b, c), (p, q, r) = before.rate, after.rate
        return a + share * (p - a), b + share * (q - b), c + share * (r - c)

    def pass_by(self, stamp: int) -> None:
        """Leave the messages up to a stamp behind."""
        while self.pending and self.pending[0].stamp <= stamp:
            self.past = self.pending.popleft()
