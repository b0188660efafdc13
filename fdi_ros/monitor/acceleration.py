"""Angular acceleration of the body, causally from the rates so far: what the timing term of the noise model needs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]
History = tuple[Stamps, Array]


class Acceleration:
    """Difference of the rate to the latest sample at least `window` seconds older, at least one sample.

    A difference over one sample at 1 kHz would turn a fault's own step into so much acceleration that the timing
    term hides the fault; over 10 ms it cannot.
    """

    def __init__(self, window: float) -> None:
        self._window = round(window * 1e9)
        self._stamp: Stamps = np.empty(0, dtype=np.int64)
        self._rate: Array = np.empty((0, 3))

    def inspect(self, stamp: Stamps, rate: Array) -> tuple[Array, History]:
        """Angular acceleration (N, 3) rad/s^2 of samples that are not yet remembered, and the history with them.

        Where there was no rate at the older end, the one before it is taken. Rows whose own rate is NaN, and the
        first one of all, have zero acceleration.
        """
        stamps = np.concatenate([self._stamp, stamp])
        rates = np.concatenate([self._rate, rate])
        here = np.arange(len(self._stamp), len(stamps))
        older = np.searchsorted(stamps, stamp - self._window, side="right") - 1
        older = np.clip(np.minimum(older, here - 1), 0, None)
        older = _last_known(rates)[older]
        span = np.where(older >= 0, (stamps[here] - stamps[older]) * 1e-9, 0.0)
        change = rates[here] - rates[older]
        acceleration = np.divide(change, span[:, None], out=np.zeros_like(change), where=span[:, None] > 0)
        acceleration[~np.isfinite(acceleration)] = 0.0
        return acceleration, (stamps, rates)

    def commit(self, history: History, rows: int) -> None:
        """Remember a history up to the first `rows` samples inspected, and no more of it than is needed."""
        end = len(self._stamp) + rows
        stamps, rates = history[0][:end], history[1][:end]
        first = max(int(np.searchsorted(stamps, stamps[-1] - self._window, side="right")) - 1, 0)
        kept = np.arange(first, end)
        known = int(_last_known(rates)[first])
        if 0 <= known < first:
            kept = np.concatenate([[known], kept])
        self._stamp, self._rate = stamps[kept], rates[kept]


def _last_known(rates: Array) -> NDArray[np.intp]:
    """Last row up to each one that has a rate, (K,); -1 if none has."""
    return np.maximum.accumulate(np.where(np.isnan(rates[:, 0]), -1, np.arange(len(rates))))
