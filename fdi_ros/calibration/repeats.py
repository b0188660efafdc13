"""Values that stay exactly the same for long: noise lets no gyro at work do so, a driver that gives old ones does."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LEAST_SECONDS = 1.0
"""Shorter runs of one value are chance, s."""
LEAST_SAMPLES = 50
"""So are those of fewer samples."""
COARSE = 3.0
"""Gyros that show no more values than this in a quiet while are quantised so coarsely that one value is rest."""
QUIETEST = 10.0
"""Percentile of the spans that are a quiet while."""


def least_run(step: float) -> int:
    """Return the samples from which a run of one value is long, at a time from sample to sample, s; 0: not known."""
    return max(LEAST_SAMPLES, round(LEAST_SECONDS / step)) if step > 0 else LEAST_SAMPLES


def run_lengths(values: Array) -> NDArray[np.int64]:
    """Lengths of the runs of one value in values (N,), N > 0, in order."""
    return np.diff(np.flatnonzero(np.concatenate([[True], values[1:] != values[:-1], [True]])))


def repeated(z: Array, step: float) -> Mask:
    """Find samples (N, n) of each channel that are part of a long run of one value.

    Parameters
    ----------
    z
        (N, n) channels, NaN where there is none.
    step
        Time from sample to sample, s.
    """
    found, least = np.zeros(z.shape, dtype=bool), least_run(step)
    for k, values in enumerate(z.T):
        lengths = run_lengths(values)
        long = lengths >= least
        if long.any() and not _coarse(values, np.repeat(long, lengths), least):
            found[:, k] = np.repeat(long, lengths)
    return found


def _coarse(values: Array, long: Mask, size: int) -> bool:
    """Whether values (N,) outside the long runs (N,), too, hardly change when it is quiet, in spans of a size."""
    left = values[np.isfinite(values) & ~long]
    spans = left[: len(left) // size * size].reshape(-1, size)
    if not len(spans):
        return False
    different = (np.diff(np.sort(spans, axis=1), axis=1) > 0).sum(axis=1) + 1
    return bool(np.percentile(different, QUIETEST) <= COARSE)


class Repeats:
    """Counts values in long runs of one value, of messages that come bit by bit."""

    def __init__(self, channels: int) -> None:
        self.count = np.zeros(channels, dtype=np.int64)
        """(c,) values in long runs."""
        self._last = np.full(channels, np.nan)
        self._run = np.zeros(channels, dtype=np.int64)

    def add(self, values: Array, step: float) -> None:
        """Take in the next values (N, c), which come every `step` s; 0: not known yet."""
        least = least_run(step)
        for k, column in enumerate(values.T if len(values) else ()):
            lengths, before = run_lengths(column), 0
            if column[0] == self._last[k]:
                before = int(self._run[k])
                lengths[0] += before
            self.count[k] += lengths[lengths >= least].sum() - (before if before >= least else 0)
            self._last[k], self._run[k] = column[-1], lengths[-1]
