"""Whether samples come at the configured rate: thresholds and times are made for it."""

from __future__ import annotations

from collections import deque

TOLERANCE = 0.1
"""Relative difference to the configured rate that is told."""
WINDOWS = 4
"""So many measurements in a row must agree with each other: a pause or a loss is no rate."""


class Sampling:
    """Measures the rate of samples by their stamps.

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

    def look(self, count: int, stamp: int) -> None:
        """Look at the number of samples so far and the stamp of the last one, ns."""
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
