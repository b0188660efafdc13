# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Finds two senders with one system id behind one address, by the numbers of their messages.

Each sender numbers its messages from 0 to 255 and begins again. The numbers of one sender
may have gaps, overtake each other, and come again as copies over a second path. Two
different paths of one sender share its numbers: what one path brings, the other one lacks.
So two series that are both nearly complete for some seconds have two senders.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

from fdi_ros.mavlink.protocol import NS

_NEAR = 8
"""Largest step of a number that continues a series, and largest delay of a late one."""
_LASTS = 10 * NS
"""Two series must go on beside each other for this time, ns. A second path of one sender that is late by less
looks like another sender for a shorter time: while it brings what the first path lost."""
_PRESENT = NS
"""A series is over after this time without a message, ns."""
_MOST_IDLE = 128
"""A series is over after this many messages of others, whose numbers come back to its own after 256."""
_LEAST_MESSAGES = 50
"""Smallest number of messages of a series that counts."""
_LEAST_COMPLETE = 0.6
"""Smallest share of the numbers of a series that came. Two paths of one sender have 1 together."""
_MOST_SERIES = 8
_COPIES = 16384
"""Messages among which copies are found."""
REMEMBERED = 10 * NS
"""Two senders are reported for this time after they were last found, ns."""


@dataclass
class _Series:
    """Numbers that continue each other."""

    last: int  # largest number so far, modulo 256
    begun: int  # begin of the present window, ns
    at: int  # arrival of the last message, ns
    came: int = 1  # messages in the present window
    missing: int = 0  # numbers that did not come in it
    was_complete: bool = False  # in the window before
    idle: int = 0  # messages of other series since the last one
    recent: set[int] = field(default_factory=set)  # numbers up to `_NEAR` behind

    def step_to(self, number: int) -> int:
        """Return by how much a number is ahead, 1 to 256."""
        return ((number - self.last - 1) & 255) + 1

    def lacks(self, number: int) -> bool:
        """Whether a number is one of the last, and has not come."""
        return 256 - self.step_to(number) < _NEAR and number not in self.recent

    def take(self, number: int, now: int) -> None:
        """Take a message with a number that is ahead, or that was missing."""
        if now - self.begun >= _LASTS:
            self.was_complete = self.came >= _LEAST_MESSAGES and self._is_dense()
            self.begun = now
            self.came = self.missing = 0
        step = self.step_to(number)
        if step <= _NEAR:
            self.missing += step - 1
            self.last = number
        else:
            self.missing -= 1
        self.recent = {one for one in self.recent if -self.step_to(one) & 255 < _NEAR}
        self.recent.add(number)
        self.came += 1
        self.idle = 0
        self.at = now

    def is_complete(self, now: int) -> bool:
        """Whether the series is present, and nearly complete in the window before and in this one."""
        return now - self.at <= _PRESENT and self.was_complete and self._is_dense()

    def _is_dense(self) -> bool:
        return self.came >= _LEAST_COMPLETE * (self.came + self.missing)


class Senders:
    """Looks at all messages of one system, component and address."""

    def __init__(self) -> None:
        self._series: list[_Series] = []
        self._known: set[int] = set()
        self._order: deque[int] = deque()
        self._found: int | None = None

    def take(self, number: int, data: bytes, now: int) -> bool:
        """Take a message with its number; return whether two senders are found for the first time."""
        if self._is_copy(data):
            return False
        self._continue(number, now)
        complete = sum(one.is_complete(now) for one in self._series)
        if complete < 2:
            return False
        is_first = not self.are_several(now)
        self._found = now
        return is_first

    def are_several(self, now: int) -> bool:
        """Whether two senders were found lately."""
        return self._found is not None and now - self._found <= REMEMBERED

    def _is_copy(self, data: bytes) -> bool:
        mark = hash(data)
        if mark in self._known:
            return True
        self._known.add(mark)
        self._order.append(mark)
        if len(self._order) > _COPIES:
            self._known.discard(self._order.popleft())
        return False

    def _continue(self, number: int, now: int) -> None:
        """Add a number to the series that it continues, or begin one."""
        self._series = [
            one
            for one in self._series
            if now - one.at <= _PRESENT and one.idle < _MOST_IDLE
        ]
        for one in self._series:
            one.idle += 1
        after = [one for one in self._series if one.step_to(number) == 1]
        late = [one for one in self._series if one.lacks(number)]
        ahead = [one for one in self._series if one.step_to(number) <= _NEAR]
        # Of series that are level, the numbers belong to each in turn.
        fitting = after or late or ahead
        if fitting:
            min(fitting, key=lambda one: (one.step_to(number), one.at)).take(
                number, now
            )
            return
        if len(self._series) == _MOST_SERIES:
            self._series.remove(min(self._series, key=lambda one: one.at))
        self._series.append(_Series(number, now, now, recent={number}))
