# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What an autopilot is asked for: messages at an interval, one request at a time, repeated within bounds.

The acknowledgement of MAV_CMD_SET_MESSAGE_INTERVAL does not say which message it is about, so the next request waits
for it. Autopilots forget intervals when they start anew, and other programs on the link may set them: what comes too
slowly is asked for again now and then.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from fdi_ros.mavlink.clock import NS

SET_MESSAGE_INTERVAL = 511
DEFAULT_INTERVAL = 0
PATIENCE = NS  # so long an acknowledgement is waited for, ns
TRIES = 3
AGAIN, AGAIN_REFUSED = 10 * NS, 60 * NS
"""What comes too slowly is asked for again after so long, and what was refused, ns."""
ENOUGH = 0.8  # of the rate asked for
RESULTS = ("accepted", "refused for now", "denied", "unsupported", "failed", "in progress", "cancelled")  # MAV_RESULT
_HOPEFUL = ("not asked yet", RESULTS[5])


@dataclass
class _Wanted:
    interval: int  # us; `DEFAULT_INTERVAL`: the autopilot's own
    answer: str = _HOPEFUL[0]  # what the autopilot says to it
    asked: int = 0  # when it was last asked for, ns
    tries: int = 0


class Streams:
    """What is asked of one autopilot."""

    def __init__(self) -> None:
        self._wanted: dict[int, _Wanted] = {}
        self._queue: dict[int, None] = {}  # messages to be asked for, in this order
        self._current: int | None = None

    def want(self, messages: Iterable[int], interval: int) -> None:
        """Ask for messages, by id, at an interval in us, unless they are wanted so."""
        for number in messages:
            if number not in self._wanted or self._wanted[number].interval != interval:
                self._wanted[number] = _Wanted(interval)
                self._enqueue(number)

    def refused(self, number: int) -> bool:
        """Whether a message was asked for in vain."""
        return number in self._wanted and self._wanted[number].answer not in (*_HOPEFUL, RESULTS[0])

    def ask_again(self) -> None:
        """Ask for all anew: the autopilot has."""
        self._current = None
        for number, wanted in self._wanted.items():
            if wanted.interval != DEFAULT_INTERVAL:
                self._enqueue(number)

    def _enqueue(self, number: int) -> None:
        self._wanted[number].tries = 0
        self._queue[number] = None

    def due(self, now: int) -> tuple[int, int] | None:
        """Return message id and interval, us, of a request to be sent now; None: there is none."""
        if self._current is not None:
            current = self._wanted[self._current]
            if now < current.asked + PATIENCE:
                return None
            if current.tries >= TRIES:
                current.answer, self._current = "no answer", None
        if self._current is None:
            if not self._queue:
                return None
            self._current = next(iter(self._queue))
            del self._queue[self._current]
        wanted = self._wanted[self._current]
        wanted.asked, wanted.tries = now, wanted.tries + 1
        return self._current, wanted.interval

    def acknowledged(self, result: int) -> None:
        """Take an acknowledgement (MAV_RESULT) of the request under way."""
        if self._current is None:
            return
        wanted = self._wanted[self._current]
        wanted.answer = RESULTS[result] if 0 <= result < len(RESULTS) else f"result {result}"
        if wanted.answer not in _HOPEFUL:
            self._current = None

    def check(self, rates: Sequence[tuple[int, float]], now: int) -> None:
        """Ask again for what comes too slowly; rates are message ids with the messages a second of each."""
        for number, rate in rates:
            wanted = self._wanted.get(number)
            if wanted is None or wanted.interval <= 0 or number == self._current:
                continue
            after = AGAIN_REFUSED if self.refused(number) else AGAIN
            if rate < ENOUGH * 1e6 / wanted.interval and now >= wanted.asked + after:
                self._enqueue(number)

    def answer_to(self, number: int | None) -> str:
        """Return what the autopilot says to the request of a message."""
        return self._wanted[number].answer if number in self._wanted else "not asked for"
