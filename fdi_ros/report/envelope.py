"""Series of any length kept as the smallest and the largest value of so many spans: no spike is lost."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Envelope:
    """Minimum and maximum of c series over spans of samples; memory does not grow.

    When there are too many spans, neighbours are put together and the next spans are twice as long.

    Parameters
    ----------
    columns
        Number of series c.
    most
        Spans kept at most.
    most_merged
        Half of them once samples are put together: a span of several samples is two values, of one it is one.
    """

    def __init__(self, columns: int, most: int, most_merged: bool = False) -> None:
        self.most = most
        self._most_merged = most // 2 if most_merged else most
        self.width = 1
        """Samples in a new span."""
        self._time = np.empty(0)
        self._low = np.empty((0, columns))
        self._high = np.empty((0, columns))
        self._waiting = (np.empty(0), np.empty((0, columns)))

    def add(self, time: Array, values: Array) -> None:
        """Take in the next samples: time (N,) s, values (N, c); NaN is nothing."""
        time, values = np.concatenate([self._waiting[0], time]), np.vstack([self._waiting[1], values])
        whole = len(time) // self.width * self.width
        self._waiting = time[whole:], values[whole:]
        if whole:
            self._store(time[: whole : self.width], values[:whole], values[:whole], self.width)
        while len(self._time) > (self.most if self.width == 1 else self._most_merged):
            time, low, high = self._time, self._low, self._high
            self._time, self._low, self._high = time[:0], low[:0], high[:0]
            even = len(time) // 2 * 2
            self._store(time[:even:2], low[:even], high[:even], 2)
            self._store(time[even:], low[even:], high[even:], 1)
            self.width *= 2

    def spans(self) -> tuple[Array, Array, Array]:
        """Return what there is: time of the first sample (k,), smallest and largest values (k, c)."""
        time, values = self._waiting
        if len(time) == 0:
            return self._time, self._low, self._high
        low, high = _extremes(values, values, len(time))
        return np.append(self._time, time[:1]), np.vstack([self._low, low]), np.vstack([self._high, high])

    def _store(self, time: Array, low: Array, high: Array, together: int) -> None:
        low, high = _extremes(low, high, together)
        self._time = np.concatenate([self._time, time])
        self._low, self._high = np.vstack([self._low, low]), np.vstack([self._high, high])


def _extremes(low: Array, high: Array, together: int) -> tuple[Array, Array]:
    """Smallest and largest of every `together` rows; NaN only where all are."""
    shape = (-1, together, low.shape[1])
    return np.fmin.reduce(low.reshape(shape), axis=1), np.fmax.reduce(high.reshape(shape), axis=1)
