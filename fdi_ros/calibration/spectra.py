"""Noise by time scale: overlapping Allan deviation and spectral density of series with breaks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.signal import welch

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

PER_DECADE = 8
"""Averaging times per decade."""
LEAST_PAIRS = 3
"""A series tells of averaging times up to its length over this."""
SHORTEST_SEGMENT, LONGEST_SEGMENT = 32, 1024
"""Samples that one spectrum is taken of."""
SEGMENTS = 4
"""Of the longest run: fewer give a spectrum that is mostly chance."""


def runs_of(rows: Mask, seconds: Array, step: float) -> list[slice]:
    """Find the runs of rows (N,) that follow each other without a break.

    Parameters
    ----------
    rows
        (N,) samples that count.
    seconds
        (N,) s.
    step
        Usual time from sample to sample, s.
    """
    broken = np.diff(seconds) > 1.5 * step
    edges = np.flatnonzero(np.concatenate([[True], broken | (np.diff(rows) != 0), [True]]))
    return [slice(a, b) for a, b in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True) if rows[a]]


def allan_deviation(runs: Sequence[Array], step: float) -> tuple[Array, Array]:
    """Overlapping Allan deviation over all runs together.

    Parameters
    ----------
    runs
        Each (k, n) samples of n channels, rad/s, `step` seconds apart.
    step
        s.

    Returns
    -------
    Averaging times (T,) s, and deviations (T, n) rad/s.
    """
    longest = max((len(run) for run in runs), default=0) // LEAST_PAIRS
    if not longest:
        return np.empty(0), np.empty((0, runs[0].shape[1] if runs else 0))
    count = max(1, round(PER_DECADE * np.log10(longest)) + 1)
    lengths = np.unique(np.round(np.geomspace(1, longest, count)).astype(np.int64))
    # Sums from the start of each run: a mean over m samples is a difference of two.
    sums = [np.vstack([np.zeros(run.shape[1]), np.cumsum(run - run.mean(axis=0), axis=0)]) for run in runs]
    deviations = []
    for m in lengths.tolist():
        apart = [(s[2 * m :] - 2 * s[m:-m] + s[: -2 * m]) / m for s in sums if len(s) > 2 * m]
        square = sum((d**2).sum(axis=0) for d in apart) / sum(map(len, apart))
        deviations.append(np.sqrt(square / 2))
    return np.asarray(lengths * step, dtype=np.float64), np.array(deviations)


def spectral_density(runs: Sequence[Array], step: float) -> tuple[Array, Array]:
    """Root of the one-sided power spectral density by Welch's method, over all runs long enough.

    Parameters
    ----------
    runs
        Each (k, n) samples of n channels, rad/s, `step` seconds apart.
    step
        s.

    Returns
    -------
    Frequencies (F,) Hz without 0, and densities (F, n) rad/s per square root of Hz.
    """
    longest = max((len(run) for run in runs), default=0)
    if longest < SHORTEST_SEGMENT:
        return np.empty(0), np.empty((0, runs[0].shape[1] if runs else 0))
    segment = 2 ** int(np.log2(np.clip(longest // SEGMENTS, SHORTEST_SEGMENT, LONGEST_SEGMENT)))
    long = [run for run in runs if len(run) >= segment]
    found = [welch(run, 1 / step, nperseg=segment, axis=0) for run in long]
    weights = [len(run) // (segment // 2) - 1 for run in long]
    density = sum(w * power for w, (_, power) in zip(weights, found, strict=True)) / sum(weights)
    return found[0][0][1:], np.sqrt(density[1:])
