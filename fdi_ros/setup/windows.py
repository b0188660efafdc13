# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The noise of the moment of every channel, from windows of a recording, and what a channel has by itself.

The monitor's fixed point, on windows instead of single samples; with S the covariance of the values in a window and A
what the redundancy knows once the rate is eliminated, ``v_i *= (A S A)_ii / A_ii`` until it stays (restricted maximum
likelihood of independent channels). Vibration is noise of the moment. What a channel has by itself is the lower
envelope: the windows that are about as quiet as the quietest.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from fdi_ros.errors import CalibrationError
from fdi_ros.model.samples import Array, Int, Mask
from fdi_ros.setup.noise_segments import AS_QUIET, ROUNDS

STEPS = 25
LEAST_VARIANCE = 1e-18
"""(rad/s)^2; of what shows no noise at all."""
LEAST_SHARE = 0.1
"""Of the usual variance of the channels of a window: less for one of them is a split that nothing decides."""
QUIETEST = 0.05
"""Quantile of the windows that is about the quietest."""
LEAST_WINDOWS = 4
MEMORY = 2
"""Windows on both sides that the noise of the moment is averaged over."""


@dataclass(frozen=True)
class Floor:
    """Noise that channels have by themselves, as far as the recording shows it."""

    std: Array
    """(n,) of one sample, rad/s."""
    error: Array
    """(n,) its standard error, rad/s."""
    windows: Mask
    """(W,) that it is from."""

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
    start = np.einsum("wab,ab->w", covariance, _projector(axes)) / (len(axes) - 3)
    v = np.repeat(np.maximum(start, LEAST_VARIANCE)[:, None], len(axes), axis=1)
    for _ in range(STEPS):
        a = information(v, axes)
        t = np.einsum("wij,wjk,wki->wi", a, covariance, a, optimize=True)
        checked = np.einsum("wii->wi", a) * v
        ratio = np.where(checked > 1e-6, t * v / np.maximum(checked, 1e-6), 1.0)
        v = v * np.clip(ratio, 0.1, 10.0)
        v = np.maximum(v, np.maximum(LEAST_SHARE * np.exp(np.log(v).mean(axis=1))[:, None], LEAST_VARIANCE))
    return v


def _projector(axes: Array) -> Array:
    return np.eye(len(axes)) - axes @ np.linalg.pinv(axes)


def of_the_moment(covariance: Array, there: Mask, axes: Array) -> Array:
    """Variance (W, n) of every channel that is there (W, n), averaged over neighbouring windows.

    Of covariances (W, n, n) of the values in each window, (rad/s)^2; of channels that are not there it says nothing.
    """
    filled = np.where(there[:, :, None] & there[:, None, :], covariance, 0.0)
    total, weight = np.zeros_like(filled), np.zeros(len(filled))
    for shift in range(-MEMORY, MEMORY + 1):
        rows_here = slice(max(shift, 0), len(filled) + min(shift, 0))
        rows_there = slice(max(-shift, 0), len(filled) + min(-shift, 0))
        # The mean of covariances of other channels would be none.
        same = (there[rows_here] == there[rows_there]).all(axis=1)
        total[rows_here] += np.where(same[:, None, None], filled[rows_there], 0.0)
        weight[rows_here] += same
    averaged = total / np.maximum(weight, 1)[:, None, None]
    found = np.full(there.shape, np.nan)
    for rows, columns in patterns_of(there):
        part = averaged[np.ix_(rows, columns, columns)]
        found[np.ix_(rows, columns)] = variances(part, axes[columns])
    known = np.isfinite(found)
    if not known.any():
        raise CalibrationError("more than three channels never give values at the same time: none checks another")
    usual, some = np.full(there.shape[1], np.nan), known.any(axis=0)
    usual[some] = np.nanmedian(found[:, some], axis=0)
    return np.where(known, found, np.where(np.isfinite(usual), usual, np.nanmedian(usual)))


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
        projector = _projector(axes[columns])
        part = covariance[np.ix_(rows, columns, columns)]
        residual[np.ix_(rows, columns)] = np.einsum("ia,wab,bi->wi", projector, part, projector, optimize=True)
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
