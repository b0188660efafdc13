# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A flight over time in equal parts, of whose length nothing is known before its end; memory does not grow."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fdi_ros.arrays import Array
from fdi_ros.model.geometry import Geometry, spans_space

PARTS = 120
"""Of what is kept of a flight."""
_SPANS = 4096
"""Of time while it is read; neighbours are put together when there would be more."""
_FIRST = 0.01
"""Of such a span at first, s."""


def difference_gains(geometry: Geometry, excluded: tuple[str, ...] = ()) -> Array:
    """Return the matrix (n, n) that makes of the values of a sample how far each is from what the other units say.

    That is the value less the rate by the channels of all other units (least squares) along its axis; where the other
    units do not tell, as of channels that are no units, by all other channels; a row of zeros: nothing tells.
    """
    n, names = geometry.n, geometry.channel_names
    gains = np.zeros((n, n))
    for i in range(n):
        own = next((set(unit) for unit in geometry.units if i in unit), {i})
        for left_out in (own, {i}):
            others = [k for k in range(n) if k not in left_out and names[k] not in excluded]
            if spans_space(geometry.axes[others]):
                gains[i, others] = -geometry.axes[i] @ np.linalg.pinv(geometry.axes[others])
                gains[i, i] = 1.0
                break
    gains[np.abs(gains) < 1e-12] = 0.0
    return gains


class Course:
    """Statistic and differences of n channels over the time of a flight.

    Parameters
    ----------
    gains
        (n, n) of `difference_gains`.
    """

    def __init__(self, gains: Array) -> None:
        n = len(gains)
        self._gains = gains
        self._width = _FIRST
        self._largest = np.full(_SPANS, -np.inf)
        self._sums = np.zeros((2, n, _SPANS))
        """Number of differences, and their sum, rad/s."""
        self._squares = np.zeros(n)

    def add(self, seconds: Array, ratio: Array, z: Array) -> None:
        """Take in samples (N,): s from the first, statistic over threshold, values (N, n), rad/s."""
        while seconds[-1] >= _SPANS * self._width:
            self._largest = np.concatenate([self._largest.reshape(-1, 2).max(axis=1), np.full(_SPANS // 2, -np.inf)])
            together = self._sums.reshape(*self._sums.shape[:2], -1, 2).sum(axis=3)
            self._sums = np.concatenate([together, np.zeros_like(together)], axis=2)
            self._width *= 2
        span = np.minimum((seconds / self._width).astype(np.intp), _SPANS - 1)
        known = np.isfinite(ratio)
        np.maximum.at(self._largest, span[known], ratio[known])
        finite = np.isfinite(z) & (np.abs(z) < 1e6)
        difference = np.where(finite, z, 0.0) @ self._gains.T
        for i, gain in enumerate(self._gains):
            rows = finite[:, gain != 0].all(axis=1) if gain.any() else np.zeros(len(z), dtype=bool)
            for values, sums in zip((None, difference[rows, i]), self._sums[:, i], strict=True):
                sums += np.bincount(span[rows], values, _SPANS)
            self._squares[i] += float(difference[rows, i] @ difference[rows, i])

    def largest(self, duration: float) -> tuple[float, ...]:
        """Largest ratio in each of `PARTS` equal parts of the time; NaN where nothing was judged."""
        parts = np.full(PARTS, -np.inf)
        np.maximum.at(parts, self._part(duration), self._largest)
        return tuple(np.where(np.isfinite(parts), parts, np.nan).tolist())

    def differences(self, duration: float) -> tuple[float, ...]:
        """Mean difference (n * PARTS,) of each channel in each part, channel after channel, rad/s; NaN: not known."""
        part = self._part(duration)
        count, total = (np.array([np.bincount(part, row, PARTS) for row in sums]) for sums in self._sums)
        return tuple(_divided(total, count).ravel().tolist())

    def mean_and_std(self) -> tuple[Array, Array]:
        """Mean difference of each channel over the flight, and its standard deviation in it, (n,), rad/s."""
        count, total = self._sums.sum(axis=2)
        mean = _divided(total, count)
        return mean, np.sqrt(np.maximum(0.0, _divided(self._squares, count) - mean**2))

    def _part(self, duration: float) -> NDArray[np.intp]:
        """Part (_SPANS,) that each span lies in by its middle."""
        middle = (np.arange(_SPANS) + 0.5) * self._width
        return np.minimum(PARTS * middle / max(duration, 1e-9), PARTS - 1).astype(np.intp)


def _divided(total: Array, count: Array) -> Array:
    """Divide sums by counts; NaN of nothing."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(count > 0, total / count, np.nan))
