# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Noise of channels with known axes, from windows of the estimator.

The noise of the moment is the monitor's fixed point, on windows instead of single samples: with S the covariance of the
values in a window and A the information of the redundancy once the rate is eliminated, ``v_i *= (A S A)_ii / A_ii``
until it stays (restricted maximum likelihood of independent channels). Vibration is noise of the moment. The noise of a
channel by itself is the lower envelope: windows about as quiet as the quietest.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from fdi_ros.config.settings import LEAST_NOISE
from fdi_ros.errors import CalibrationError
from fdi_ros.estimator.noise import QUIETEST
from fdi_ros.inspection.segments import AS_QUIET, ROUNDS
from fdi_ros.model.samples import Array, Int, Mask

#: variance of a channel without noise, (rad/s)^2
LEAST_VARIANCE = LEAST_NOISE**2
#: windows on both sides that the noise of the moment is averaged over: 5 s, in which
#: vibration stays
NEIGHBOURS = 2


@dataclass(frozen=True)
class Floor:
    """Noise of single channels, as far as a recording shows the floor."""

    #: (n,) of one sample, rad/s
    std: Array
    #: (n,) its standard error, rad/s
    error: Array
    #: (W,) windows in use
    windows: Mask

    @property
    def share(self) -> float:
        """Share of the recording in use."""
        return float(self.windows.mean())


def information(variance: Array, axes: Array) -> Array:
    """Return A (..., n, n), s^2/rad^2, for independent errors of variance (..., n), (rad/s)^2.

    The rate is unknown.
    """
    weight = 1.0 / variance
    weighted = weight[..., :, None] * axes
    values, vectors = np.linalg.eigh(np.swapaxes(axes, -1, -2) @ weighted)
    # Absent channels may leave no rate, and then no information.
    known = values > 1e-15 * values[..., -1:]
    inverse = np.divide(1.0, values, out=np.zeros_like(values), where=known)
    of_rate = weighted @ vectors
    explained = (of_rate * inverse[..., None, :]) @ np.swapaxes(of_rate, -1, -2)
    return np.asarray(weight[..., :, None] * np.eye(len(axes)) - explained)


def gains(variance: Array, axes: Array) -> Array:
    """G (..., 3, n): the weighted least squares rate."""
    weighted = axes / variance[..., :, None]
    return np.asarray(
        np.linalg.solve(
            np.swapaxes(axes, -1, -2) @ weighted, np.swapaxes(weighted, -1, -2)
        )
    )


def variances(covariance: Array, axes: Array) -> Array:
    """Return variances (W, n) of channels from covariances (W, n, n) of windows, (rad/s)^2."""
    start = np.einsum("wab,ab->w", covariance, projector(axes)) / (len(axes) - 3)
    of_all = np.maximum(start, LEAST_VARIANCE)
    v = np.repeat(of_all[:, None], len(axes), axis=1)
    for _ in range(25):
        a = information(v, axes)
        # The diagonal of A S A, and A is symmetric.
        t = ((a @ covariance) * a).sum(axis=2)
        checked = np.einsum("wii->wi", a) * v
        ratio = np.where(checked > 1e-6, t * v / np.maximum(checked, 1e-6), 1.0)
        v = v * np.clip(ratio, 0.1, 10.0)
        # Less than the monitor believes of one channel is a split that nothing decides.
        geometric_mean = np.exp(np.log(v).mean(axis=1))
        least = np.maximum(QUIETEST * geometric_mean[:, None], LEAST_VARIANCE)
        v = np.maximum(v, least)
    return v


def projector(axes: Array) -> Array:
    """Work out S = I - H pinv(H)."""
    return np.eye(len(axes)) - axes @ np.linalg.pinv(axes)


def of_the_moment(covariance: Array, there: Mask, axes: Array) -> Array:
    """Return variances (W, n) of present channels (W, n), from covariances (W, n, n).

    Neighbouring windows are averaged.
    """
    filled = np.where(there[:, :, None] & there[:, None, :], covariance, 0.0)
    near = np.pad(filled, ((NEIGHBOURS, NEIGHBOURS), (0, 0), (0, 0)))
    beside = np.pad(there, ((NEIGHBOURS, NEIGHBOURS), (0, 0)))
    total = np.zeros_like(filled)
    weight = np.zeros(len(filled))
    for shift in reversed(range(2 * NEIGHBOURS + 1)):
        # The mean of covariances of other channels would be none.
        rows = slice(shift, shift + len(there))
        same = (there == beside[rows]).all(axis=1)
        total += np.where(same[:, None, None], near[rows], 0.0)
        weight += same
    found = _by_pattern(
        variances, total / np.maximum(weight, 1)[:, None, None], there, axes
    )
    known = np.isfinite(found)
    if not known.any():
        raise CalibrationError(
            "more than three channels never give values at the same time: none checks another"
        )
    some = known.any(axis=0)
    medians = np.nanmedian(found[:, some], axis=0)
    usual = np.full(found.shape[1], np.median(medians))
    usual[some] = medians
    return np.where(known, found, usual)


def _by_pattern(
    of: Callable[[Array, Array], Array], covariance: Array, there: Mask, axes: Array
) -> Array:
    """Apply a function to windows with the same channels, (W, n), NaN if too few are present."""
    found = np.full(there.shape, np.nan)
    for rows, columns in patterns_of(there):
        found[np.ix_(rows, columns)] = of(
            covariance[np.ix_(rows, columns, columns)], axes[columns]
        )
    return found


def _residual_variances(covariance: Array, axes: Array) -> Array:
    """Return variances (W, n) of the part of each channel that no rate explains."""
    apart = projector(axes)
    return np.asarray(
        np.einsum("ia,wab,bi->wi", apart, covariance, apart, optimize=True)
    )


def patterns_of(there: Mask) -> Iterator[tuple[Int, Int]]:
    """Yield windows and channels of each set of more than three channels, from (W, n)."""
    patterns, which = np.unique(there, axis=0, return_inverse=True)
    for k, pattern in enumerate(patterns):
        if pattern.sum() > 3:
            yield np.flatnonzero(which.ravel() == k), np.flatnonzero(pattern)


def levels(covariance: Array, there: Mask, axes: Array) -> Array:
    """Return the noise of windows (W,) relative to the usual one, infinite if unknown."""
    residual = _by_pattern(_residual_variances, covariance, there, axes)
    known = np.isfinite(residual).any(axis=1)
    found = np.full(len(there), np.inf)
    if known.any():
        logs = np.log(
            np.maximum(
                residual[known][:, np.isfinite(residual).any(axis=0)], LEAST_VARIANCE
            )
        )
        # The geometric mean of the channels: one that is always noisy hides nothing.
        relative = logs - np.nanmedian(logs, axis=0)
        found[known] = np.exp(np.nanmean(relative, axis=1))
    return found


def _quietest(level: Array, count: Int) -> Mask:
    """Return the windows (W,) about as quiet as the quietest, by levels (W,)."""
    known = int(np.isfinite(level).sum())
    in_order = np.argsort(level)[:known]
    least = in_order[: max(4, round(0.05 * known))]
    quiet = np.zeros(len(level), dtype=bool)
    quiet[least] = True
    # The quietest of many are quiet by chance, too: the mean of all that are as quiet is not.
    for _ in range(ROUNDS if known else 0):
        more = level < AS_QUIET * np.average(level[quiet], weights=count[quiet])
        if (more == quiet).all():
            break
        quiet = more
        quiet[least] = True
    return quiet


def find_floor(covariance: Array, count: Int, there: Mask, axes: Array) -> Floor:
    """Find the floor of the noise.

    ``covariance`` (W, n, n): of ``count`` (W,) samples, of channels ``there`` (W, n).
    """
    level, (sums, precision, weight) = (
        levels(covariance, there, axes),
        np.zeros((3, len(axes))),
    )
    windows = np.zeros(len(level), dtype=bool)
    # A unit that comes late has quiet windows of its own.
    for pattern in np.unique(there, axis=1).T:
        quiet = _quietest(np.where(pattern, level, np.inf), count)
        windows |= quiet
        alike = (there == pattern[:, None]).all(axis=0)
        for rows, columns in patterns_of(there & quiet[:, None]):
            samples = count[rows].sum()
            part = covariance[np.ix_(rows, columns, columns)]
            (v,) = variances(
                np.average(part, axis=0, weights=count[rows])[None], axes[columns]
            )
            # Redundancy shows A_ii v_i of the variance. The rest follows from other
            # channels.
            own = np.diag(information(v, axes[columns]))
            shown = np.maximum(own * v, 0.1)
            chosen = alike[columns]
            which = columns[chosen]
            sums[which] += samples * v[chosen]
            precision[which] += samples * shown[chosen] ** 2
            weight[which] += samples
    known = weight > 0
    variance = sums / np.maximum(weight, 1)
    variance[~known] = np.median(variance[known]) if known.any() else LEAST_VARIANCE
    return Floor(
        np.sqrt(variance),
        np.sqrt(variance / (2.0 * np.maximum(precision, 1.0))),
        windows,
    )
