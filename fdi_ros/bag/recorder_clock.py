# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Times of recording of a recorder whose clock was set back while it recorded.

Sorted by such times, messages of two times are mixed: 30 s before and after the step are
taken for one time, and messages with equal stamps are lost.
"""

from __future__ import annotations

import numpy as np

from fdi_ros.model.samples import Int

LEAST_SET_BACK = 10**9
"""Smallest step back of the times of a topic that is no disorder, ns. Queues of recorders
disorder messages by less."""
MOST_SET_BACK = 3
"""Steps back of one topic in one look, at most. Messages in no order step back at random."""


class RecorderClock:
    """Times of recording that go on where the clock of the recorder was set back."""

    def __init__(self) -> None:
        self._first: dict[int, int] = {}  # first time of each topic in a file, ns
        self._last: dict[int, int] = {}  # last time of each topic, ns
        self._shift: dict[int, int] = {}  # added to the times of each topic, ns
        #: longest step back so far, ns
        self.set_back = 0

    @property
    def least_shift(self) -> int:
        """Smallest time added to those of a topic, ns."""
        return min(self._shift.values(), default=0)

    def begin_file(self) -> None:
        """Take a step back to any time for a step of the clock: a further file of the recorder begins."""
        self._first.clear()

    def follow(self, topic: Int, time: Int) -> Int:
        """Return times (k,), ns, that go on where those of a topic step back.

        ``topic``, ``time``: (k,) of further messages, in the order in which they were written.
        A step to before the first message of a file is none: its parts may be in any order.
        """
        followed = time.copy()
        # A topic that begins later has the clock of the others.
        of_others = max(self._shift.values(), default=0)
        for number in np.unique(topic).tolist():
            rows = np.flatnonzero(topic == number)
            of_topic = time[rows]
            first = self._first.setdefault(number, int(of_topic[0]))
            steps = np.diff(of_topic, prepend=self._last.get(number, of_topic[0]))
            self._last[number] = int(of_topic[-1])
            is_set = (steps <= -LEAST_SET_BACK) & (of_topic >= first)
            if is_set.sum() > MOST_SET_BACK:
                is_set[:] = False
            added = np.cumsum(np.where(is_set, -steps, 0))
            added += self._shift.get(number, of_others)
            followed[rows] += added
            self._shift[number] = int(added[-1])
            largest = -int(steps[is_set].min(initial=0))
            self.set_back = max(self.set_back, largest)
        return followed
