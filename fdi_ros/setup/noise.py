# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Noise of channels: of those of which nothing is known yet, by segments of a second; of others, by windows.

The noise of the moment is the monitor's fixed point, on windows instead of single samples: with S the covariance of the
values in a window and A what the redundancy knows once the rate is eliminated, ``v_i *= (A S A)_ii / A_ii`` until it
stays (restricted maximum likelihood of independent channels). Vibration is noise of the moment. What a channel has by
itself is the lower envelope: the segments or windows that are about as quiet as the quietest.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fdi_ros.config.settings import LEAST_NOISE
from fdi_ros.errors import CalibrationError
from fdi_ros.estimator.blocks import REST_STD, rests
from fdi_ros.estimator.estimator import REST_BLOCKS
from fdi_ros.estimator.noise import THREE_SIGMA
from fdi_ros.model.samples import Array, Int, Mask

LENGTH = 1.0  # of a segment, s; longer where so few samples are in it that it could not be cut into blocks
SMOOTH = np.array([-2.0, 3.0, 6.0, 7.0, 6.0, 3.0, -2.0]) / 21.0
"""Local parabola through seven values (Savitzky and Golay 1964): what it leaves is noise, not motion."""
FEWEST, PART = 3, 100  # of the quietest segments so many, or one in so many, tell the noise at rest
AS_QUIET, ROUNDS = 1.5, 10  # noise this many times that of the quietest is as quiet; rounds in which these are found
QUIET = SLOWER = 2.0  # more noise is vibration; what is slower than a block may be so many times the other
LARGEST_BIAS = 0.1  # rad/s, that a gyro at rest has
MOST = 4096  # segments kept; of a longer recording every second one, and so on: memory does not grow with its length


class NoiseSegment(NamedTuple):
    """Values of a segment."""

    first: int  # time of its first sample, ns
    means: Array  # (`REST_BLOCKS`, c) of blocks, rad/s
    std: Array  # (c,) of the samples about their mean, rad/s: at rest their noise, also where a filter has smoothed it
    noise: Array  # (c,) of a sample, rad/s: what no smooth motion reaches; 0: the values never change
    block_noise: Array  # (c,) of the blocks, with slower noise that is no more than `SLOWER` times as large


class NoiseSegments:
    """Segments of a recording, as its values of so many channels come."""

    def __init__(self, channels: int) -> None:
        self.channels = channels
        self.every = 1  # of so many segments one is kept
        self._kept: list[NoiseSegment] = []
        self._passed = 0
        # Values (K, c) that do not make a segment yet, and their times, ns.
        self._waiting, self._times = np.empty((0, channels)), np.empty(0, dtype=np.int64)

    def add(self, values: Array, times: Int, rate: float) -> None:
        """Take in values (K, c) rad/s of a rate, Hz (0: not known yet), all finite, at times (K,) ns."""
        values, times = np.vstack([self._waiting, values]), np.concatenate([self._times, times])
        size = REST_BLOCKS * max(round(LENGTH * rate / REST_BLOCKS), 1) if rate else len(values) + 1
        full = len(values) // size * size
        for k in range(0, full, size):
            if self._passed % self.every == 0:
                self._kept.append(_segment(values[k : k + size], int(times[k])))
            self._passed += 1
            if len(self._kept) > MOST:
                self._kept, self.every = self._kept[::2], 2 * self.every
        self._waiting, self._times = values[full:], times[full:]

    @property
    def empty(self) -> bool:
        """Whether there is not a single value."""
        return not self._kept and not len(self._waiting)

    def all_segments(self) -> list[NoiseSegment]:
        """Segments, with the values at the end if there is no other."""
        whole = len(self._waiting) // REST_BLOCKS * REST_BLOCKS
        return self._kept or ([_segment(self._waiting[:whole], int(self._times[0]))] if whole else [])

    @property
    def means(self) -> Array:
        """Means of blocks (B, c), rad/s."""
        return np.concatenate([one.means for one in self.all_segments()] or [np.zeros((1, self.channels))])

    def noise(self, largest_bias: float = LARGEST_BIAS) -> Noise:
        """Work out the noise of all so far, of gyros with biases of so much, rad/s."""
        segments, unknown = self.all_segments(), np.full(self.channels, np.nan)
        if not segments:
            return Noise(unknown, unknown, [])
        least, block = _least_noise(segments)
        known = np.full(self.channels, largest_bias**2 / THREE_SIGMA)
        rest = [
            bool((one.noise <= QUIET * least).all())
            and rests(np.ascontiguousarray(one.means), REST_BLOCKS - 1, block**2, known, REST_STD**2)
            for one in segments
        ]
        still = [one.std for one, lies in zip(segments, rest, strict=True) if lies]
        quiet = np.maximum(least, np.median(still, axis=0)) if still else least
        moving = np.array([one.noise for one, lies in zip(segments, rest, strict=True) if not lies])
        usual = [np.median(column[column > 0.0]) if column.any() else 0.0 for column in moving.T]
        return Noise(quiet, np.array(usual) if len(moving) else unknown, rest)


class Noise(NamedTuple):
    """Noise of a sample of each channel (c,), rad/s; NaN: not known."""

    quiet: Array  # at rest, or else when quietest
    moving: Array  # in motion, vibration included
    rest: list[bool]  # whether nothing moves in a segment: by the monitor's own test, and as quiet as the quietest

    @property
    def share(self) -> float:
        """Share of the recording in motion."""
        return 1.0 - sum(self.rest) / len(self.rest) if self.rest else 0.0


def _least_noise(segments: list[NoiseSegment]) -> tuple[Array, Array]:
    """Noise (c,) of a sample and of a block when quietest, rad/s.

    The quietest few are so by chance, too: all that are about as quiet tell it without that bias.
    """
    noise, block = np.array([one.noise for one in segments]), np.array([one.block_noise for one in segments])
    # Where a unit repeats its values it says nothing of its noise, which is then what it usually is.
    for column in (*noise.T, *block.T):
        if column.any():
            column[column == 0.0] = np.median(column[column > 0.0])
    quiet = np.argsort((noise**2).sum(axis=1))[: max(FEWEST, len(noise) // PART)]
    for _ in range(ROUNDS):
        alike = np.flatnonzero((noise <= AS_QUIET * np.median(noise[quiet], axis=0)).all(axis=1))
        if len(alike) <= len(quiet):
            break
        quiet = alike
    return np.median(noise[quiet], axis=0), np.median(block[quiet], axis=0)


def _segment(values: Array, first: int) -> NoiseSegment:
    means = values.reshape(REST_BLOCKS, -1, values.shape[1]).mean(axis=1)
    least, std = _noise(means), values.std(axis=0)
    return NoiseSegment(first, means, std, _noise(values), np.clip(means.std(axis=0), least, SLOWER * least))


def _noise(values: Array) -> Array:
    inside = len(SMOOTH) // 2
    smooth = np.column_stack([np.convolve(column, SMOOTH, mode="valid") for column in values.T])
    # Of white noise the parabola takes its share with it.
    noise = np.sqrt(np.mean((values[inside:-inside] - smooth) ** 2, axis=0) / (1.0 - SMOOTH[inside]))
    return np.where(noise > LEAST_NOISE, noise, 0.0)


# Of windows -----------------------------------------------------------------------------------------------------------


STEPS = 25
LEAST_VARIANCE = 1e-18  # (rad/s)^2; of what shows no noise at all
LEAST_SHARE = 0.1  # of the usual variance in a window: less for one channel is a split that nothing decides
QUIETEST = 0.05  # quantile of the windows that is about the quietest
LEAST_WINDOWS = 4
MEMORY = 2  # windows on both sides that the noise of the moment is averaged over


@dataclass(frozen=True)
class Floor:
    """Noise that channels have by themselves, as far as the recording shows it."""

    std: Array  # (n,) of one sample, rad/s
    error: Array  # (n,) its standard error, rad/s
    windows: Mask  # (W,) that it is from

    @property
    def share(self) -> float:
        """Part of the recording that it is from."""
        return float(self.windows.mean())


def information(variance: Array, axes: Array) -> Array:
    """Work out A (..., n, n), s^2/rad^2, of independent errors of variance (..., n), (rad/s)^2, the rate unknown."""
    weight = 1.0 / variance
    weighted = weight[..., :, None] * axes
    normal = np.swapaxes(axes, -1, -2) @ weighted
    # A channel that is not there may leave too few for a rate: then nothing is known of it.
    solved = np.linalg.pinv(normal, hermitian=True) @ np.swapaxes(weighted, -1, -2)
    return np.asarray(weight[..., :, None] * np.eye(len(axes)) - weighted @ solved)


def gains(variance: Array, axes: Array) -> Array:
    """G (..., 3, n): the weighted least squares rate."""
    weighted = axes / variance[..., :, None]
    return np.asarray(np.linalg.solve(np.swapaxes(axes, -1, -2) @ weighted, np.swapaxes(weighted, -1, -2)))


def variances(covariance: Array, axes: Array) -> Array:
    """Variance (W, n) of every channel in every window, from covariances (W, n, n) of its values, (rad/s)^2."""
    start = np.einsum("wab,ab->w", covariance, projector(axes)) / (len(axes) - 3)
    v = np.repeat(np.maximum(start, LEAST_VARIANCE)[:, None], len(axes), axis=1)
    for _ in range(STEPS):
        a = information(v, axes)
        t = np.einsum("wij,wjk,wki->wi", a, covariance, a, optimize=True)
        checked = np.einsum("wii->wi", a) * v
        ratio = np.where(checked > 1e-6, t * v / np.maximum(checked, 1e-6), 1.0)
        v = v * np.clip(ratio, 0.1, 10.0)
        v = np.maximum(v, np.maximum(LEAST_SHARE * np.exp(np.log(v).mean(axis=1))[:, None], LEAST_VARIANCE))
    return v


def projector(axes: Array) -> Array:
    """Work out S = I - H pinv(H)."""
    return np.eye(len(axes)) - axes @ np.linalg.pinv(axes)


def of_the_moment(covariance: Array, there: Mask, axes: Array) -> Array:
    """Variance (W, n) of every channel that is there (W, n), averaged over neighbouring windows.

    Of covariances (W, n, n) of the values in each window, (rad/s)^2; of channels that are not there it says nothing.
    """
    filled = np.where(there[:, :, None] & there[:, None, :], covariance, 0.0)
    near, beside = np.pad(filled, ((MEMORY, MEMORY), (0, 0), (0, 0))), np.pad(there, ((MEMORY, MEMORY), (0, 0)))
    total, weight = np.zeros_like(filled), np.zeros(len(filled))
    for shift in reversed(range(2 * MEMORY + 1)):
        # The mean of covariances of other channels would be none.
        same = (there == beside[shift : shift + len(there)]).all(axis=1)
        total += np.where(same[:, None, None], near[shift : shift + len(there)], 0.0)
        weight += same
    averaged = total / np.maximum(weight, 1)[:, None, None]
    found = np.full(there.shape, np.nan)
    for rows, columns in patterns_of(there):
        part = averaged[np.ix_(rows, columns, columns)]
        found[np.ix_(rows, columns)] = variances(part, axes[columns])
    known = np.isfinite(found)
    if not known.any():
        raise CalibrationError("more than three channels never give values at the same time: none checks another")
    some = known.any(axis=0)
    usual = np.full(len(some), np.median(np.nanmedian(found[:, some], axis=0)))
    usual[some] = np.nanmedian(found[:, some], axis=0)
    return np.where(known, found, usual)


def patterns_of(there: Mask) -> Iterator[tuple[Int, Int]]:
    """Windows and channels, of every set of more than three channels that are there (W, n) together."""
    patterns, which = np.unique(there, axis=0, return_inverse=True)
    for k, pattern in enumerate(patterns):
        if pattern.sum() > 3:
            yield np.flatnonzero(which.ravel() == k), np.flatnonzero(pattern)


def levels(covariance: Array, there: Mask, axes: Array) -> Array:
    """How noisy every window is (W,), against the usual one; infinite where nothing tells.

    The geometric mean of the channels: one that is always noisy hides nothing.
    """
    residual = np.full(there.shape, np.nan)
    for rows, columns in patterns_of(there):
        part, apart = covariance[np.ix_(rows, columns, columns)], projector(axes[columns])
        residual[np.ix_(rows, columns)] = np.einsum("ia,wab,bi->wi", apart, part, apart, optimize=True)
    known = np.isfinite(residual).any(axis=1)
    found = np.full(len(there), np.inf)
    if known.any():
        logs = np.log(np.maximum(residual[known][:, np.isfinite(residual).any(axis=0)], LEAST_VARIANCE))
        found[known] = np.exp(np.nanmean(logs - np.nanmedian(logs, axis=0), axis=1))
    return found


def _quietest(level: Array, count: Int) -> Mask:
    """Windows (W,) of finite level that are about as quiet as the quietest; all the same where there are few."""
    known = int(np.isfinite(level).sum())
    order = np.argsort(level)[:known]
    least = order[: max(LEAST_WINDOWS, round(QUIETEST * known))]
    quiet = np.zeros(len(level), dtype=bool)
    quiet[least] = True
    # The quietest of many are quiet by chance, too: the mean of all that are as quiet is not.
    for _ in range(ROUNDS if known else 0):
        pooled = np.average(level[quiet], weights=count[quiet])
        more = level < AS_QUIET * pooled
        if (more == quiet).all():
            break
        quiet = more | (quiet & (level < AS_QUIET * pooled))
        quiet[least] = True
    return quiet


def find_floor(covariance: Array, count: Int, there: Mask, axes: Array) -> Floor:
    """Find the lower envelope of the noise of single samples, of the channels (W, n) that are there.

    Of covariances (W, n, n) of so many (W,) samples in every window, (rad/s)^2.
    """
    level, n = levels(covariance, there, axes), len(axes)
    sums, precision, weight = np.zeros(n), np.zeros(n), np.zeros(n)
    windows = np.zeros(len(level), dtype=bool)
    # A unit that comes late has quiet windows of its own.
    for pattern in np.unique(there, axis=1).T:
        quiet = _quietest(np.where(pattern, level, np.inf), count)
        windows |= quiet
        alike = (there == pattern[:, None]).all(axis=0)
        for rows, columns in patterns_of(there & quiet[:, None]):
            samples = count[rows].sum()
            v = variances(
                np.average(covariance[np.ix_(rows, columns, columns)], axis=0, weights=count[rows])[None], axes[columns]
            )[0]
            # Of A_ii v_i of the variance the redundancy shows; the rest is as the others have it.
            shown = np.maximum(np.diag(information(v, axes[columns])) * v, 0.1)
            chosen = alike[columns]
            sums[columns[chosen]] += samples * v[chosen]
            precision[columns[chosen]] += samples * shown[chosen] ** 2
            weight[columns[chosen]] += samples
    known = weight > 0
    variance = sums / np.maximum(weight, 1)
    variance[~known] = np.median(variance[known]) if known.any() else LEAST_VARIANCE
    return Floor(np.sqrt(variance), np.sqrt(variance / (2.0 * np.maximum(precision, 1.0))), windows)
