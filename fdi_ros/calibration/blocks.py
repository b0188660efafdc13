# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A recording as the estimator sees it: all units at the same instants, in blocks of 40 ms, windows of 25 blocks.

Units whose stamps are late, that miss values or that are slower than others are interpolated (Lagrange, six points of
their own) at the instants of the samples. A block is the mean of its samples, of channels that have all of them.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from fdi_ros.arrays import Array, Int
from fdi_ros.calibration.data import Data
from fdi_ros.compiling.compiled import compiled
from fdi_ros.estimator.estimator import BLOCK_TIME
from fdi_ros.estimator.rest import REST_BLOCKS

BLOCKS_IN_WINDOW = REST_BLOCKS
"""The test of rest is of as many."""
POINTS = 6
"""Of the interpolation."""
HOLE = 1.5
"""Neighbours farther apart than so many of their usual intervals are not interpolated between."""
PRESENT = 0.8
"""Share of a window that a channel gives to count in it."""
PORTION = 100_000
"""Samples worked on at once, about."""
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
    white
        (n,) what interpolation has left of the variance of white noise in them.
    count
        (W,) samples that it is of.
    """

    seconds: Array
    mean: Array
    window: Int
    start: Int
    samples: Array
    white: Array
    count: Int

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
    span = max(round(BLOCK_TIME / data.step), 1) * data.step
    source = Resampled(data, late)
    # A sample on the edge must not fall to either side as its stamp jitters.
    number = np.floor(source.seconds / span + 0.25 * data.step / span).astype(np.int64)
    first = np.flatnonzero(np.diff(number, prepend=-1))
    ends = np.append(first[1:], len(number))
    window = number[first] // BLOCKS_IN_WINDOW
    window = np.cumsum(np.diff(window, prepend=window[0]) > 0)
    start = np.flatnonzero(np.diff(window, prepend=-1))
    begin = np.append(first[start], len(number))
    n = data.z.shape[1]
    mean, samples = np.empty((len(first), n)), np.full((len(start), n, n), np.nan)
    used = np.zeros(len(start), dtype=np.int64)
    for a, b in portions(begin):
        z = source.part(int(begin[a]), int(begin[b]))
        blocks = slice(int(start[a]), int(start[b]) if b < len(start) else len(first))
        mean[blocks] = np.add.reduceat(z, first[blocks] - begin[a], axis=0)
        for w in range(a, b):
            part = z[begin[w] - begin[a] : begin[w + 1] - begin[a]]
            there = np.isfinite(part)
            columns = np.flatnonzero(there.mean(axis=0) >= PRESENT)
            part = part[there[:, columns].all(axis=1)][:, columns]
            used[w] = len(part)
            if len(part) > 3 and len(columns):
                part = part - part.mean(axis=0)
                samples[w][np.ix_(columns, columns)] = part.T @ part / (len(part) - 1)
    count = ends - first
    seconds = np.add.reduceat(source.seconds, first) / count
    return Blocks(seconds, mean / count[:, None], window, start, samples, source.white, used)


def portions(begin: Int) -> Iterator[tuple[int, int]]:
    """Spans of windows of about `PORTION` samples together; begin (W + 1,): their first samples, and the end."""
    cuts = np.unique(np.searchsorted(begin, np.arange(0, begin[-1] + PORTION, PORTION)).clip(0, len(begin) - 1))
    return itertools.pairwise(cuts.tolist())


class Resampled:
    """Values at the instants of the samples, delays taken off.

    Parameters
    ----------
    data
        The recording.
    late
        (n,) s.
    """

    def __init__(self, data: Data, late: Array) -> None:
        self.seconds = data.seconds
        self._z, self._late = data.z, late
        self._squares, self._count = np.zeros((2, data.z.shape[1]))
        every, there = np.arange(len(data.z)), np.isfinite(data.z)
        whole = [bool(own.all()) for own in there.T]
        self._groups: list[tuple[Int, Int, float]] = []
        """Channels alike in delay and in samples that they have; these samples, and the usual time between them, s."""
        left = [i for i in range(len(late)) if not whole[i] or abs(late[i]) >= NOT_SHIFTED]
        while left:
            i = left[0]
            alike = [j for j in left if late[j] == late[i] and (there[:, j] == there[:, i]).all()]
            rows = every if whole[i] else np.flatnonzero(there[:, i])
            usual = float(np.median(np.diff(self.seconds[rows]))) if len(rows) > 1 else 0.0
            self._groups.append((np.array(alike), rows, usual))
            left = [j for j in left if j not in alike]

    def part(self, begin: int, end: int) -> Array:
        """Values (N, n) of some samples, rad/s, NaN: not known."""
        z = self._z[begin:end].copy()
        for channels, rows, usual in self._groups:
            squares, count = interpolate(
                self.seconds, self._z, channels, rows, usual, float(self._late[channels[0]]), begin, z
            )
            self._squares[channels] += squares
            self._count[channels] += count
        return z

    @property
    def white(self) -> Array:
        """What is left (n,) of the variance of white noise, in the parts so far."""
        return np.where(self._count > 0, self._squares / np.maximum(self._count, 1), 1.0)


@compiled
def interpolate(
    seconds: Array, z: Array, channels: Int, rows: Int, usual: float, late: float, begin: int, out: Array
) -> tuple[float, int]:
    """Values of some channels late s after samples from one on, into ``out``; sum of squared weights, and their number.

    By the polynomial through the six samples around, of those in ``rows``.
    """
    weight = np.empty(POINTS)
    squares, found = 0.0, 0
    low, high = 0, len(rows)
    while low < high:
        middle = (low + high) // 2
        if seconds[rows[middle]] < seconds[begin] + late:
            low = middle + 1
        else:
            high = middle
    for m in range(len(out)):
        x = seconds[begin + m] + late
        while low < len(rows) and seconds[rows[low]] < x:
            low += 1
        k = max(min(low - POINTS // 2, len(rows) - POINTS), 0)
        near = k + POINTS <= len(rows)
        if near:
            first, last = seconds[rows[k]], seconds[rows[k + POINTS - 1]]
            near = last - first < (POINTS - 2 + HOLE) * usual and first <= x <= last
        if near:
            squares += weigh(seconds, rows[k : k + POINTS], x, weight)
            found += 1
        for c in channels:
            value = 0.0
            for p in range(POINTS if near else 0):
                value += weight[p] * z[rows[k + p], c]
            out[m, c] = value if near else math.nan
    return squares, found


@compiled
def weigh(seconds: Array, rows: Int, x: float, weight: Array) -> float:
    """Find the weights (`POINTS`,) of Lagrange's polynomial at an instant; return their sum of squares."""
    squares = 0.0
    for p in range(POINTS):
        weight[p] = 1.0
        for q in range(POINTS):
            if q != p:
                weight[p] *= (x - seconds[rows[q]]) / (seconds[rows[p]] - seconds[rows[q]])
        squares += weight[p] * weight[p]
    return squares
