# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Whether samples and messages keep coming, and whether they come at the configured rate."""

from __future__ import annotations

from collections import deque

TOLERANCE = 0.1
"""Relative difference to the configured rate that is reported."""
WINDOWS = 4
"""So many measurements in a row must agree with each other: a pause or a loss is no rate."""


class Watchdog:
    """Whether a counter has stood still for longer than a timeout, ns, by the clock."""

    def __init__(self, timeout: int) -> None:
        self.timeout = timeout
        self.silent = False
        self.at = 0
        """Clock time at which the counter last moved, to the precision of the checks, ns."""
        self._count = -1

    def check(self, count: int, now: int) -> bool:
        """Check the count at the clock time now, ns; True if silence began or ended."""
        # Where the clock went back, or was not running at the last check, the time between is unknown.
        if count != self._count or now < self.at or not self.at:
            self._count, self.at = count, now
        before, self.silent = self.silent, now - self.at > self.timeout
        return self.silent != before

    def seconds(self, now: int) -> float:
        """How long the counter has stood still, s."""
        return max(0, now - self.at) / 1e9


class SampleRateCheck:
    """Compares the rate of the samples, by their stamps, with the one that thresholds and times are made for.

    Parameters
    ----------
    configured
        Sample rate, Hz.
    """

    def __init__(self, configured: float) -> None:
        self.words = ""
        """What is wrong, for people; empty: nothing is known to be."""
        self._configured = configured
        self._before: tuple[int, int] | None = None
        self._rates: deque[float] = deque(maxlen=WINDOWS)

    def check(self, count: int, stamp: int) -> None:
        """Take the number of samples so far and the stamp of the last one, ns."""
        before, self._before = self._before, (count, stamp)
        if before is None or count <= before[0] or stamp <= before[1]:
            self._rates.clear()
            return
        self._rates.append(1e9 * (count - before[0]) / (stamp - before[1]))
        low, high = min(self._rates), max(self._rates)
        if len(self._rates) < WINDOWS or high > (1 + TOLERANCE) * low:
            return
        rate = sum(self._rates) / WINDOWS
        wrong = abs(rate / self._configured - 1) > TOLERANCE
        self.words = (
            (
                f"samples come at {rate:.3g} Hz, sample_rate is {self._configured:g} Hz:"
                " the false-alarm rate and all times are wrong by as much"
            )
            if wrong
            else ""
        )
