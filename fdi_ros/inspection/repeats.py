# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Values that repeat for so long that they are old: working gyros always show noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fdi_ros.model.samples import Array, Mask


def least_run(step: float) -> int:
    """Return the run of one value, in samples every `step` s, that chance cannot explain.

    A step of 0 means that the rate is not known.
    """
    return max(50, round(1.0 / step)) if step > 0 else 50


def run_lengths(values: Array) -> NDArray[np.int64]:
    """Lengths of the runs of one value in values (N,), N > 0, in order."""
    return np.diff(
        np.flatnonzero(np.concatenate([[True], values[1:] != values[:-1], [True]]))
    )


def repeated(z: Array, step: float) -> Mask:
    """Mark samples of z (N, n), every `step` s, in a long run of one value of a channel."""
    found = np.zeros(z.shape, dtype=bool)
    least = least_run(step)
    for k, values in enumerate(z.T):
        lengths = run_lengths(values)
        long = np.repeat(lengths >= least, lengths)
        if long.any():
            others = values[np.isfinite(values) & ~long]
            spans = np.sort(
                others[: len(others) // least * least].reshape(-1, least), axis=1
            )
            different = (np.diff(spans, axis=1) > 0).sum(axis=1) + 1
            # In a coarse channel at rest a constant value is normal.
            coarse = len(spans) > 0 and np.percentile(different, 10.0) <= 3.0
            found[:, k] = long & (not coarse)
    return found


class Repeats:
    """Counts values in long runs of one value, of messages that come bit by bit."""

    def __init__(self, channels: int) -> None:
        self.count = np.zeros(channels, dtype=np.int64)  # (c,) values in long runs
        self._last = np.full(channels, np.nan)
        self._run = np.zeros(channels, dtype=np.int64)

    def add(self, values: Array, step: float) -> None:
        """Take the next values (N, c), every `step` s, 0 if the rate is not known yet."""
        least = least_run(step)
        for k, column in enumerate(values.T if len(values) else ()):
            lengths = run_lengths(column)
            before = 0
            if column[0] == self._last[k]:
                before = int(self._run[k])
                lengths[0] += before
            self.count[k] += lengths[lengths >= least].sum() - (
                before if before >= least else 0
            )
            self._last[k] = column[-1]
            self._run[k] = lengths[-1]
