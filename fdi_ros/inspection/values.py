# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Finite and saturated values of channels, counted as they are recorded."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.model.quantity import RATE, Quantity
from fdi_ros.model.samples import Array, flag_runs


class _RangeSigns(NamedTuple):
    """What shows the end of the range of a sensor."""

    #: smallest end of a range, rad/s. Gyros of 250 deg/s end at 4.36 rad/s
    least_rate: float = 4.0
    #: smallest end of a range, m/s^2. Accelerometers of 2 g end at 19.6 m/s^2
    least_force: float = 19.0
    #: consecutive samples at the largest value
    run: int = 5


_RANGE = _RangeSigns()


class Values:
    """Counts finite values and saturated samples of channels, block after block."""

    def __init__(self, n: int, quantity: Quantity = RATE) -> None:
        least = _RANGE.least_rate if quantity == RATE else _RANGE.least_force
        self._largest = np.full(n, least)
        self._run = np.zeros(n, dtype=np.int64)
        """(n,) consecutive samples at the largest value."""
        self.samples = 0
        """Samples so far."""
        self.finite: NDArray[np.int64] = np.zeros(n, dtype=np.int64)
        """(n,) samples with a finite value."""
        self.saturated: NDArray[np.int64] = np.zeros(n, dtype=np.int64)
        """(n,) samples in runs at the largest value of the channel."""

    def add(self, values: Array) -> None:
        """Add the next samples (k, n), rad/s or m/s^2."""
        if not len(values):
            return
        known = np.isfinite(values)
        self.samples += len(values)
        self.finite += known.sum(axis=0)
        size = np.where(known, np.abs(values), 0.0)
        for i in np.flatnonzero(size.max(axis=0) >= self._largest).tolist():
            self._add_saturated(i, size[:, i])
        self._run[size[-1] < self._largest] = 0

    def _add_saturated(self, i: int, size: Array) -> None:
        """Count the samples of a channel at the end of its range."""
        largest = float(size.max())
        if largest > self._largest[i]:
            self._largest[i] = largest
            self._run[i] = 0
            self.saturated[i] = 0
        at_end = size == largest
        for first, last in flag_runs(at_end).tolist():
            before = int(self._run[i]) if first == 0 else 0
            run = last - first + before
            if run >= _RANGE.run:
                counted = before if before >= _RANGE.run else 0
                self.saturated[i] += run - counted
            self._run[i] = run if last == len(size) else 0
