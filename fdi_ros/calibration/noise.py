# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The noise of the moment of every channel over a recording, and what of it the channel has by itself.

The monitor's fixed point, on windows instead of single samples: with S the covariance of the values in a window and A
what the redundancy knows once the rate is eliminated, ``v_i *= (A S A)_ii / A_ii`` until it stays (restricted maximum
likelihood of independent channels). Vibration is noise of the moment. What a channel has by itself is the lower
envelope: the windows that are about as quiet as the quietest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fdi_ros.calibration.data import Array, Index, Mask

STEPS = 25
LEAST_VARIANCE = 1e-18
"""(rad/s)^2; of what shows no noise at all."""
LEAST_SHARE = 0.1
"""Of the usual variance of the channels of a window: less for one of them is a split that nothing decides."""
QUIETEST = 0.05
"""Quantile of the windows that is about the quietest."""
AS_QUIET = 1.5
"""Windows of at most so many times the variance of the quietest are as quiet."""
LEAST_WINDOWS = 4
MEMORY = 2
"""Windows on both sides that the noise of the moment is averaged over."""


@dataclass(frozen=True)
class Floor:
    """Noise that channels have by themselves, as far as the recording shows it.

    Attributes
    ----------
    std
        (n,) of one sample, rad/s.
    error
        (n,) its standard error, rad/s.
    windows
        (W,) that it is from.
    """

    std: Array
    error: Array
    windows: Mask

    @property
    def share(self) -> float:
        """Part of the recording that it is from."""
        return float(self.windows.mean())


def information(variance: Array, axes: Array) -> Array:
    """Work out A (..., n, n), s^2/rad^2, of independent errors of variance (..., n), (rad/s)^2, the rate unknown."""
    weight = 1.0 / variance
    weighted = weight[..., :, None] * axes
    normal = np.swapaxes(axes, -1, -2) @ weighted
    solved = np.linalg.solve(normal, np.swapaxes(weighted, -1, -2))
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
    """Variance (W, n) of every channel, averaged over neighbouring windows.

    Parameters
    ----------
    covariance
        (W, n, n) of the values in each window, (rad/s)^2.
    there
        (W, n) channels that are there; of others the variance says nothing.
    axes
        (n, 3).
    """
    filled = np.where(there[:, :, None] & there[:, None, :], covariance, 0.0)
    total, weight = np.zeros_like(filled), np.zeros(len(filled))
    for shift in range(-MEMORY, MEMORY + 1):
        own = slice(max(shift, 0), len(filled) + min(shift, 0))
        other = slice(max(-shift, 0), len(filled) + min(-shift, 0))
        # The mean of covariances of other channels would be none.
        same = (there[own] == there[other]).all(axis=1)
        total[own] += np.where(same[:, None, None], filled[other], 0.0)
        weight[own] += same
    averaged = total / np.maximum(weight, 1)[:, None, None]
    found = np.full(there.shape, np.nan)
    patterns, which = np.unique(there, axis=0, return_inverse=True)
    for k, pattern in enumerate(patterns):
        rows, columns = np.flatnonzero(which.ravel() == k), np.flatnonzero(pattern)
        if len(columns) > 3:
            part = averaged[np.ix_(rows, columns, columns)]
            found[np.ix_(rows, columns)] = variances(part, axes[columns])
    usual = np.nanmedian(found, axis=0)
    return np.where(np.isfinite(found), found, np.where(np.isfinite(usual), usual, np.nanmedian(usual)))


def find_floor(covariance: Array, count: Index, known: Mask, axes: Array) -> Floor:
    """Find the lower envelope of the noise of single samples.

    Parameters
    ----------
    covariance
        (W, n, n) of single samples in every window, (rad/s)^2.
    count
        (W,) samples of each.
    known
        (W,) windows that count.
    axes
        (n, 3).
    """
    projector = _projector(axes)
    level = np.where(known, np.einsum("wab,ab->w", covariance, projector), np.inf)
    order = np.argsort(level)[: int(known.sum())]
    least = max(LEAST_WINDOWS, round(QUIETEST * len(order)))
    quiet = np.zeros(len(level), dtype=bool)
    quiet[order[:least]] = True
    # The quietest of many are quiet by chance, too: the mean of all that are as quiet is not.
    for _ in range(10):
        pooled = np.average(level[quiet], weights=count[quiet])
        more = level < AS_QUIET * pooled
        if (more == quiet).all():
            break
        quiet = more | (quiet & (level < AS_QUIET * pooled))
        quiet[order[:least]] = True
    mean = np.average(covariance[quiet], axis=0, weights=count[quiet])
    v = variances(mean[None], axes)[0]
    a = information(v, axes)
    # Of A_ii v_i of the variance the redundancy shows; the rest is as the others have it.
    shown = np.maximum(np.diag(a) * v, 0.1)
    return Floor(np.sqrt(v), np.sqrt(v / (2.0 * count[quiet].sum())) / shown, quiet)
