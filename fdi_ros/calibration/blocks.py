# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A recording as the estimator sees it: all units at the same instants, in blocks of 40 ms, windows of 25 blocks.

Units whose stamps are late, that miss values or that are slower than others are interpolated (Lagrange, six points of
their own) at the instants of the samples. A block is the mean of its samples, of channels that have all of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fdi_ros.calibration.data import Array, Data, Index, Mask
from fdi_ros.core.rest import REST_BLOCKS
from fdi_ros.detectors.estimator import BLOCK_TIME

BLOCKS_IN_WINDOW = REST_BLOCKS
"""The test of rest is of as many."""
POINTS = 6
"""Of the interpolation."""
HOLE = 1.5
"""Neighbours farther apart than so many of their usual intervals are not interpolated between."""
PORTION = 100_000
"""Samples interpolated at once."""
NOT_SHIFTED = 1e-6
"""s; smaller delays are none."""
SUBS = 5
"""Blocks in the longer means that show whether noise is coloured."""


@dataclass(frozen=True)
class Blocks:
    """Means of blocks, and windows of blocks.

    Attributes
    ----------
    seconds
        (B,) middle of each block, s from the first sample.
    mean
        (B, n) rad/s; NaN where a channel lacks a sample.
    window
        (B,) number of the window of each block.
    start
        (W,) first block of each window.
    samples
        (W, n, n) covariance of single samples about their mean in each window, (rad/s)^2; NaN: a channel is missing.
    count
        (W,) samples that it is of.
    """

    seconds: Array
    mean: Array
    window: Index
    start: Index
    samples: Array
    count: Index

    @property
    def windows(self) -> int:
        """Number of windows."""
        return len(self.start)

    @property
    def length(self) -> float:
        """Usual time from block to block, s."""
        return float(np.median(np.diff(self.seconds)))

    @property
    def time(self) -> Array:
        """(W,) middle of each window, s."""
        return np.asarray(np.add.reduceat(self.seconds, self.start) / np.diff([*self.start, len(self.seconds)]))


def make_blocks(data: Data, late: Array) -> Blocks:
    """Cut a recording into blocks, delays (n,) s taken off."""
    z, white = resampled(data, late)
    span = max(round(BLOCK_TIME / data.step), 1) * data.step
    # A sample on the edge must not fall to either side as its stamp jitters.
    number = np.floor(data.seconds / span + 0.25 * data.step / span).astype(np.int64)
    first = np.flatnonzero(np.diff(number, prepend=-1))
    count = np.diff([*first, len(number)])
    mean = np.add.reduceat(z, first, axis=0) / count[:, None]
    seconds = np.add.reduceat(data.seconds, first) / count
    window = number[first] // BLOCKS_IN_WINDOW
    window = np.cumsum(np.diff(window, prepend=window[0]) > 0)
    start = np.flatnonzero(np.diff(window, prepend=-1))
    begin = first[start]
    samples, used = _sample_covariances(z, begin)
    return Blocks(seconds, mean, window, start, samples / np.sqrt(np.outer(white, white)), used)


def _sample_covariances(z: Array, begin: Index) -> tuple[Array, Index]:
    ends = np.append(begin[1:], len(z))
    found, used = np.full((len(begin), z.shape[1], z.shape[1]), np.nan), np.zeros(len(begin), dtype=np.int64)
    for k, (a, b) in enumerate(zip(begin.tolist(), ends.tolist(), strict=True)):
        part = z[a:b]
        part = part[np.isfinite(part).all(axis=1)]
        used[k] = len(part)
        if len(part) > 3:
            part = part - part.mean(axis=0)
            found[k] = part.T @ part / (len(part) - 1)
    return found, used


def resampled(data: Data, late: Array) -> tuple[Array, Array]:
    """Values (N, n) at the instants of the samples, rad/s, NaN: not known; and what is left of white noise (n,)."""
    z, white, seconds = data.z, np.ones(data.z.shape[1]), data.seconds
    there = np.isfinite(z)
    done: list[int] = []
    for i in range(z.shape[1]):
        whole = bool(there[:, i].all())
        if i in done or (whole and abs(late[i]) < NOT_SHIFTED):
            continue
        alike = [
            j for j in range(i, z.shape[1]) if late[j] == late[i] and (whole == there[:, j].all()) and j not in done
        ]
        alike = [j for j in alike if whole or (there[:, j] == there[:, i]).all()]
        done += alike
        if z is data.z:
            z = z.copy()
        z[:, alike], white[alike] = _interpolated(seconds, data.z[:, alike], there[:, i], seconds + late[i])
    return z, white


def _interpolated(seconds: Array, z: Array, there: Mask, at: Array) -> tuple[Array, float]:
    out = np.full(z.shape, np.nan)
    t, own = seconds[there], z[there]
    if len(t) < POINTS:
        return out, 1.0
    usual, squares, count = float(np.median(np.diff(t))), 0.0, 0
    for first in range(0, len(at), PORTION):
        x = at[first : first + PORTION]
        k = np.clip(np.searchsorted(t, x) - POINTS // 2, 0, len(t) - POINTS)
        near = t[k[:, None] + np.arange(POINTS)]
        usable = (near[:, -1] - near[:, 0] < (POINTS - 2 + HOLE) * usual) & (x >= near[:, 0]) & (x <= near[:, -1])
        weight = np.ones((len(x), POINTS))
        for j in range(POINTS):
            for m in range(POINTS):
                if m != j:
                    weight[:, j] *= (x - near[:, m]) / (near[:, j] - near[:, m])
        values = np.einsum("kj,kjc->kc", weight, own[k[:, None] + np.arange(POINTS)])
        out[first : first + PORTION][usable] = values[usable]
        squares += float((weight[usable] ** 2).sum())
        count += int(usable.sum())
    return out, squares / max(count, 1)
