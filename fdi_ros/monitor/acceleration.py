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

        Rows whose rate is NaN, and the first one of all, have zero acceleration.
        """
        stamps = np.concatenate([self._stamp, stamp])
        rates = np.concatenate([self._rate, rate])
        carried = len(self._stamp)
        here = np.arange(carried, len(stamps))
        older = np.searchsorted(stamps, stamp - self._window, side="right") - 1
        older = np.clip(np.minimum(older, here - 1), 0, None)
        span = (stamps[here] - stamps[older]) * 1e-9
        change = rates[here] - rates[older]
        acceleration = np.divide(change, span[:, None], out=np.zeros_like(change), where=span[:, None] > 0)
        acceleration[~np.isfinite(acceleration)] = 0.0
        return acceleration, (stamps, rates)

    def commit(self, history: History, rows: int) -> None:
        """Remember a history up to the first `rows` samples inspected, and no more of it than is needed."""
        stamps, rates = history
        end = len(self._stamp) + rows
        first = int(np.searchsorted(stamps[:end], stamps[end - 1] - self._window, side="right")) - 1
        self._stamp = stamps[max(first, 0) : end].copy()
        self._rate = rates[max(first, 0) : end].copy()
