# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A recording for the estimator: usable samples at common instants, blocks and windows.

Values that stay exactly equal for long are repeated by a driver and not usable, since a
gyro always shows noise. Units with late stamps, missing values or a lower rate are
interpolated (Lagrange, six of their own samples). A block of 40 ms is the mean of its
samples, for channels that have all. A window has 25 blocks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.estimator.estimator import BLOCK_TIME, REST_BLOCKS
from fdi_ros.inspection.repeats import repeated
from fdi_ros.inspection.turns import TURNS
from fdi_ros.model.samples import Array, Block, Int, Mask
from fdi_ros.setup.noise import projector


class _Portions(NamedTuple):
    """Samples that are worked on at once, about."""

    #: samples in which spikes are looked for
    spikes: int = 256
    #: samples that are interpolated
    samples: int = 100_000


_PORTIONS = _Portions()

#: windows are joined down to this number of groups
MOST_GROUPS = 400


@dataclass
class Data:
    """A recording made ready."""

    #: (N,) ns
    stamp: NDArray[np.int64]
    #: (N, n) rad/s, NaN where not usable
    z: Array
    #: (n,) samples not usable, by the reason: missing, not_finite, out_of_range,
    #: repeated
    unusable: dict[str, Int]

    def __post_init__(self) -> None:
        self.seconds: Array = np.asarray(
            (self.stamp - self.stamp[:1]) * 1e-9, dtype=np.float64
        )  # (N,) since the first sample
        self.duration = float(self.seconds[-1]) if len(self.stamp) else 0.0  # s
        # Usual time from sample to sample, s.
        self.step = 0.0
        if len(self.stamp) > 1:
            self.step = float(np.median(np.diff(self.stamp))) * 1e-9

    def slow_rates(self) -> Array:
        """Return rates (W, n) averaged over complete windows, less their medians."""
        window = (self.stamp - self.stamp[0]) // round(TURNS.window * 1e9)
        starts = np.flatnonzero(np.diff(window, prepend=-1))
        counts = np.diff(starts, append=len(window))
        # A window at the end, or beside a gap, may hold few samples.
        complete = np.logical_and.reduceat(np.isfinite(self.z).all(axis=1), starts)
        good = complete & (counts >= 0.5 * np.median(counts))
        finite = np.where(np.isfinite(self.z), self.z, 0.0)
        means = np.add.reduceat(finite, starts, axis=0)[good] / counts[good, None]
        return np.asarray(means - np.median(means, axis=0)) if len(means) else means


def prepare(block: Block, max_rate: Array) -> Data:
    """Mark unusable values: missing, not finite, beyond max_rate (n,), rad/s, or repeated."""
    received = block.delivered
    finite = np.isfinite(block.z)
    with np.errstate(invalid="ignore"):
        inside = np.abs(block.z) < max_rate
    data = Data(block.stamp, np.where(received & inside, block.z, np.nan), {})
    # Constant values are old and show neither rest nor motion.
    old = repeated(data.z, data.step)
    data.z[old] = np.nan
    reasons = {
        "missing": ~received,
        "not_finite": received & ~finite,
        "out_of_range": received & finite & ~inside,
        "repeated": old,
    }
    data.unusable.update(
        {why: np.asarray(lost.sum(axis=0)) for why, lost in reasons.items()}
    )
    return data


def spikes(z: Array, axes: Array) -> Mask:
    """Find single values of z (N, n), rad/s, far from their neighbours and other channels.

    ``axes``: (n, 3).
    """
    found = np.zeros(z.shape, dtype=bool)
    apart = projector(axes)
    # Vibration changes the usual size.
    for first in range(0, max(len(z) - 2, 0), _PORTIONS.spikes):
        part = z[first : first + _PORTIONS.spikes + 2]
        neighbours = 0.5 * (part[2:] + part[:-2])
        size = np.abs((part[1:-1] - neighbours) @ apart)
        whole = size[np.isfinite(size).all(axis=1)]
        if len(whole) < _PORTIONS.spikes // 4:
            continue
        # 1.4826: deviation of normal errors over their median absolute value.
        level = 1.4826 * np.median(whole, axis=0)
        ratio = np.nan_to_num(size / np.maximum(level, 1e-9))
        # Vibration has tails, too: up to 25 times the usual size.
        far = ratio.max(axis=1) > 25.0
        # Frequent outliers are not spikes.
        if far.mean() < 0.1:
            found[first + 1 + np.flatnonzero(far), ratio[far].argmax(axis=1)] = True
    return found


#: of the interpolation
POINTS = 6
#: share of a window that a channel must deliver
PRESENT = 0.8
#: smallest delay to correct, s: at 100 rad/s^2 an error of 1e-4 rad/s
NOT_SHIFTED = 1e-6


@dataclass
class Blocks:
    """Means of blocks, and windows of blocks."""

    #: (B,) middle of each block, s from the first sample
    seconds: Array
    #: (B, n) rad/s, NaN if a sample is missing
    mean: Array
    #: (W,) first block of each window
    start: Int
    #: (W, n, n) covariance of samples in each window, (rad/s)^2, NaN for absent
    #: channels
    samples: Array
    #: (n,) share of the variance of white noise that interpolation leaves
    white: Array
    #: (W,) number of samples
    count: Int

    def __post_init__(self) -> None:
        self.windows = len(self.start)
        #: (W,) number of blocks in each window
        self.size = np.diff(self.start, append=len(self.mean))
        #: (B,) window of each block
        self.window = np.repeat(np.arange(self.windows), self.size)
        #: usual time from block to block, s
        self.length = float(np.median(np.diff(self.seconds)))
        #: (W,) middle of each window, s
        self.time = np.add.reduceat(self.seconds, self.start) / self.size

    def slopes(self, values: Array) -> Array:
        """Return central differences (B, c) of values (B, c) of blocks, per second.

        NaN at both ends and beside gaps.
        """
        found = np.full_like(values, np.nan)
        span = self.seconds[2:] - self.seconds[:-2]
        # Of neighbours, or with one block between them missing.
        near = span < 2.5 * self.length
        change = (values[2:] - values[:-2]) / span[:, None]
        found[1:-1] = np.where(near[:, None], change, np.nan)
        return found

    @property
    def group_size(self) -> int:
        """Number of windows that share one bias: at most `MOST_GROUPS` groups remain."""
        return -(-self.windows // MOST_GROUPS)


def make_blocks(data: Data, delay: Array) -> Blocks:
    """Cut a recording into blocks, delays (n,) s taken off."""
    span = max(round(BLOCK_TIME / data.step), 1) * data.step
    # A sample on the edge must not fall to either side as its stamp jitters.
    number = np.floor(data.seconds / span + 0.25 * data.step / span).astype(np.int64)
    first = np.flatnonzero(np.diff(number, prepend=-1))
    start = np.flatnonzero(np.diff(number[first] // REST_BLOCKS, prepend=-1))
    z, white = resampled(data, delay)
    samples = np.full((len(start), *z.shape[1:] * 2), np.nan)
    used = np.zeros(len(start), dtype=np.int64)
    for w, part in enumerate(np.split(z, first[start[1:]])):
        there = np.isfinite(part)
        columns = np.flatnonzero(there.mean(axis=0) >= PRESENT)
        part = part[there[:, columns].all(axis=1)][:, columns]
        used[w] = len(part)
        if len(part) > 3 and len(columns):
            part = part - part.mean(axis=0)
            samples[w][np.ix_(columns, columns)] = part.T @ part / (len(part) - 1)
    count = np.diff(first, append=len(z))
    mean = np.add.reduceat(z, first, axis=0) / count[:, None]
    seconds = np.add.reduceat(data.seconds, first) / count
    return Blocks(seconds, mean, start, samples, white, used)


def resampled(data: Data, delay: Array) -> tuple[Array, Array]:
    """Interpolate a recording at the instants of its samples, less delays (n,), s.

    Returns values (N, n), rad/s, NaN if unknown, and the remaining share (n,) of white noise variance.
    """
    seconds = data.seconds
    there = np.isfinite(data.z)
    z = data.z.copy()
    white = np.ones(len(delay))
    left = [
        i
        for i in range(len(delay))
        if not there[:, i].all() or abs(delay[i]) >= NOT_SHIFTED
    ]
    while left:
        i = left[0]
        # Channels alike in delay and in samples that they have.
        alike = [
            j
            for j in left
            if delay[j] == delay[i] and np.array_equal(there[:, j], there[:, i])
        ]
        left = [j for j in left if j not in alike]
        rows = np.flatnonzero(there[:, i])
        knots = seconds[rows]
        squares = 0.0
        count = 0
        usual = float(np.median(np.diff(knots))) if len(rows) > 1 else 0.0
        z[:, alike] = np.nan
        for begin in range(0, len(z), _PORTIONS.samples):
            first, weight = lagrange_weights(
                knots, seconds[begin : begin + _PORTIONS.samples] + delay[i], usual
            )
            known = np.flatnonzero(first >= 0)
            around = rows[first[known, None] + np.arange(POINTS)]
            values = np.einsum(
                "mp,mpc->mc", weight[known], data.z[around[..., None], alike]
            )
            z[np.ix_(begin + known, np.array(alike))] = values
            squares = squares + (weight[known] ** 2).sum()
            count = count + len(known)
        white[alike] = squares / count if count else 1.0
    return z, white


def lagrange_weights(knots: Array, x: Array, usual: float) -> tuple[Int, Array]:
    """Return the polynomials through six knots (K,) around instants x (N,), s.

    ``usual``: usual distance of knots, s. Returns the first knot (N,) of each, -1
    beside holes and outside, and the weights (N, `POINTS`).
    """
    if len(knots) < POINTS:
        return np.full(len(x), -1), np.zeros((len(x), POINTS))
    before = np.searchsorted(knots, x) - POINTS // 2
    first = np.clip(before, 0, len(knots) - POINTS)
    around = knots[first[:, None] + np.arange(POINTS)]
    # With a sample missing they span one interval more.
    there = (
        (np.ptp(around, axis=1) < (POINTS - 0.5) * usual)
        & (around[:, 0] <= x)
        & (x <= around[:, -1])
    )
    # Each with itself gives the factor 1.
    apart = around[:, :, None] - around[:, None, :] + np.eye(POINTS)
    own = np.eye(POINTS, dtype=bool)
    from_x = np.where(own, 1.0, (x[:, None] - around)[:, None, :])
    weights = np.asarray((from_x / apart).prod(axis=2))
    return np.where(there, first, -1), weights
