# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Axes and sampling delays of all channels relative to three reference channels: errors in all variables, robust.

With x_t the bias-free reference channels, y_t the others, a_t the derivative of x_t:

    y_i = g_i . (x + delay_i a) + error,    G = H_other inv(H_reference)

The body rate of every sample is free (errors in all variables), so the likelihood of G depends on the parity
residual ``p = y - G x - ...`` alone, with covariance ``C = R_other + G R_reference G'``. Its errors are taken as
multivariate t, which bounds what an outlier can do. See docs/calibration.md for the formulas.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fdi_ros.calibration.data import Array, Data, Mask

DEGREES = 6.0
"""Degrees of freedom of the t distribution: normal errors lose 5 % of efficiency, an outlier its weight."""
ITERATIONS = 60
CONVERGED = 1e-4
"""Steps smaller than this share of the standard errors end the iteration."""
BATCH = 8192
"""Rows computed at once."""
LEAST_LEFT = 0.02
"""Share of the information on a parameter that must come from other blocks, for the factor to stay finite."""
CORRELATED = 1.0
"""Errors farther apart than this are taken as independent, s."""


@dataclass(frozen=True)
class AxisSamples:
    """K complete samples in motion that the axes are fitted to.

    Attributes
    ----------
    x, a
        (K, 3) bias-free reference channels rad/s, and their derivative rad/s^2.
    y
        (K, m) the other channels, bias-free, rad/s.
    variance_x, variance_y
        Error variances, (K, 3) and (K, m), (rad/s)^2.
    block
        (K,) number of the span that a sample is in; errors within one may be correlated.
    """

    x: Array
    a: Array
    y: Array
    variance_x: Array
    variance_y: Array
    block: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.x)

    def batch(self, rows: slice) -> AxisSamples:
        """Return some of the rows."""
        return AxisSamples(
            self.x[rows], self.a[rows], self.y[rows], self.variance_x[rows], self.variance_y[rows], self.block[rows]
        )


@dataclass(frozen=True)
class Fit:
    """Estimate from `AxisSamples`.

    Attributes
    ----------
    gain
        G (m, 3): the other channels from the reference channels.
    delay
        (u,) of each group of channels that are sampled together, against the reference, s.
    covariance
        (3 m + u, 3 m + u) of gain by rows and delay, robust against correlated errors and a wrong noise model.
    """

    gain: Array
    delay: Array
    covariance: Array


def make_samples(data: Data, z: Array, rows: Mask, reference: list[int], variance: Array, rate: Array) -> AxisSamples:
    """Prepare the samples that the axes are fitted to.

    Parameters
    ----------
    data
        The recording.
    z
        (N, n) bias-free channels, rad/s.
    rows
        (N,) samples to use; those without neighbours on both sides are left out.
    reference
        The three reference channels.
    variance
        (N, n) error variances, (rad/s)^2.
    rate
        (N, 3) best estimate of what the reference channels should read, rad/s: for the derivative.
    """
    others = [i for i in range(z.shape[1]) if i not in reference]
    turning = derivative(data.seconds, rate, data.step)
    rows = rows & np.isfinite(z).all(axis=1) & np.isfinite(turning).all(axis=1)
    block = (data.seconds[rows] / CORRELATED).astype(np.int64)
    return AxisSamples(
        z[rows][:, reference],
        turning[rows],
        z[rows][:, others],
        variance[rows][:, reference],
        variance[rows][:, others],
        np.unique(block, return_inverse=True)[1].astype(np.int64),
    )


def derivative(seconds: Array, rate: Array, step: float) -> Array:
    """Differentiate (N, 3) by five points, NaN near gaps; three points would bias the delays by some percent."""
    near, far = np.full_like(rate, np.nan), np.full_like(rate, np.nan)
    for difference, k in ((near, 1), (far, 2)):
        span = (seconds[2 * k :] - seconds[: -2 * k])[:, None]
        slope = (rate[2 * k :] - rate[: -2 * k]) / span
        difference[k:-k] = np.where(span < (2 * k + 1) * step, slope, np.nan)
    return (4 * near - far) / 3


def fit_axes(
    samples: AxisSamples, group: NDArray[np.int64], held: Mask | None = None, nominal: Array | None = None
) -> Fit:
    """Fit gain and delays by iterated Newton steps (scoring).

    Parameters
    ----------
    samples
        What to fit to.
    group
        (m,) for each other channel the number of its delay, -1: sampled with the reference.
    held, nominal
        (m, 3) parts of the gain that are not fitted, and what they are.
    """
    m = samples.y.shape[1]
    gain: Array = np.asarray(np.linalg.lstsq(samples.x, samples.y, rcond=None)[0].T, dtype=np.float64)
    delay = np.zeros(int(group.max(initial=-1)) + 1)
    free = np.ones(3 * m + len(delay), dtype=bool)
    if held is not None and nominal is not None:
        gain = np.where(held, nominal, gain)
        free[: 3 * m] = ~held.ravel()
    spread = np.inf
    for _ in range(ITERATIONS):
        sums = _sums(samples, gain, delay, group, spread)
        step = np.zeros(len(free))
        step[free] = np.linalg.solve(sums.scoring[np.ix_(free, free)], sums.score.sum(axis=0)[free])
        gain, delay = gain + step[: 3 * m].reshape(m, 3), delay + step[3 * m :]
        settled = abs(sums.spread - spread) < 1e-3 * sums.spread if np.isfinite(spread) else False
        spread = sums.spread
        errors = np.sqrt(np.diag(sums.scoring)[free])
        if settled and np.abs(step[free] * errors).max() < CONVERGED:
            break
    sums = _sums(samples, gain, delay, group, spread)
    return Fit(gain, delay, _covariance(sums, free))


@dataclass(frozen=True)
class _Sums:
    """Score (B, P) and information (B, P, P) per block; observed information (P, P); ratio of errors to variances."""

    score: Array
    by_block: Array
    observed: Array
    spread: float

    @property
    def scoring(self) -> Array:
        """(P, P) information of all blocks."""
        return np.asarray(self.by_block.sum(axis=0))


def _sums(samples: AxisSamples, gain: Array, delay: Array, group: NDArray[np.int64], spread: float) -> _Sums:
    m, p = samples.y.shape[1], samples.y.shape[1] * 3 + len(delay)
    score = np.zeros((int(samples.block.max()) + 1, p))
    by_block, observed = np.zeros((len(score), p, p)), np.zeros((p, p))
    distances = []
    for start in range(0, len(samples), BATCH):
        part = samples.batch(slice(start, start + BATCH))
        residual, inverse, design = _linearised(part, gain, delay, group)
        distance = np.einsum("ki,kij,kj->k", residual, inverse, residual)
        distances.append(distance)
        scaled = distance / spread
        weight = (DEGREES + m) / (DEGREES + scaled) / (spread if np.isfinite(spread) else 1.0)
        pull = np.einsum("kij,kj->ki", inverse, residual)
        along = np.einsum("kip,ki->kp", design, pull)
        np.add.at(score, part.block, weight[:, None] * along)
        weighted = np.einsum("kij,kjp->kip", inverse * weight[:, None, None], design)
        first = np.flatnonzero(np.diff(part.block, prepend=-1))
        products = np.matmul(design.transpose(0, 2, 1), weighted)
        by_block[part.block[first]] += np.add.reduceat(products, first, axis=0)
        # The weight falls with the distance: the curvature of the log-likelihood is less than the scoring matrix.
        bend = 2 * weight**2 / (DEGREES + m)
        observed -= (along * bend[:, None]).T @ along
    middle = float(np.median(np.concatenate(distances)))
    return _Sums(score, by_block, observed + by_block.sum(axis=0), max(middle / _chi2_median(m), 1.0))


def _chi2_median(m: int) -> float:
    return float(m * (1 - 2 / (9 * m)) ** 3)


def _linearised(part: AxisSamples, gain: Array, delay: Array, group: NDArray[np.int64]) -> tuple[Array, Array, Array]:
    """Residual (K, m), inverse covariance (K, m, m), and derivative of the prediction (K, m, P)."""
    m, u = len(gain), len(delay)
    lag = of_channels(group, delay)
    turning = part.a @ gain.T
    residual = part.y - part.x @ gain.T - lag * turning
    spread_x = gain[None] * part.variance_x[:, None, :]
    covariance = spread_x @ gain.T
    covariance[:, np.arange(m), np.arange(m)] += part.variance_y
    inverse: Array = np.asarray(np.linalg.inv(covariance), dtype=np.float64)
    # The best estimate of the reference channels given all: by the envelope theorem the score takes it, not x.
    better = part.x + np.einsum("kij,ki->kj", spread_x, np.einsum("kij,kj->ki", inverse, residual))
    design = np.zeros((len(part), m, 3 * m + u))
    for i in range(m):
        design[:, i, 3 * i : 3 * i + 3] = better + lag[i] * part.a
        if group[i] >= 0:
            design[:, i, 3 * m + group[i]] = turning[:, i]
    return residual, inverse, design


def _covariance(sums: _Sums, free: Mask) -> Array:
    """Sandwich covariance, zero for what is not free."""
    full = np.zeros((len(free), len(free)))
    inside = np.ix_(free, free)
    inverse = np.linalg.inv(sums.observed[inside])
    adjusted = _adjusted(sums.score[:, free], sums.by_block[:, inside[0], inside[1]])
    full[inside] = inverse @ (adjusted.T @ adjusted) @ inverse
    return full


def _adjusted(score: Array, by_block: Array) -> Array:
    """Return scores (B, P) as large as they are at the true parameters.

    Fitted residuals are too small, most of all in the few blocks that decide a parameter: the scores are multiplied
    by ``(I - A_b inv(A))^(-1/2)``, A_b a block's information (Bell and McCaffrey 2002).
    """
    root = np.linalg.inv(np.linalg.cholesky(by_block.sum(axis=0)))
    # Of positive semidefinite matrices the singular vectors are the eigenvectors.
    vectors, share, _ = np.linalg.svd(root @ by_block @ root.T)
    factor = 1 / np.sqrt(np.maximum(1 - share, LEAST_LEFT))
    white = np.einsum("bpq,bp->bq", vectors, score @ root.T) * factor
    return np.asarray(np.einsum("bpq,bq->bp", vectors, white) @ np.linalg.inv(root).T)


def of_channels(group: NDArray[np.int64], value: Array) -> Array:
    """Spread values (u,) of groups of channels over the channels, whose groups are (m,); -1: 0, as the reference."""
    return np.where(group >= 0, np.append(value, 0.0)[group], 0.0)


def undelayed(data: Data, z: Array, axes: Array, fit: Fit, group: NDArray[np.int64], reference: list[int]) -> Array:
    """Channels (N, n) as if all were sampled with the reference, rad/s; as they are near gaps.

    Parameters
    ----------
    data
        The recording.
    z
        (N, n) bias-free channels, rad/s.
    axes
        (n, 3) of all channels.
    fit, group, reference
        As in `fit_axes` and `make_samples`.
    """
    lag = np.zeros(z.shape[1])
    others = [i for i in range(z.shape[1]) if i not in reference]
    lag[others] = of_channels(group, fit.delay)
    turning = derivative(data.seconds, z @ np.linalg.pinv(axes).T, data.step)
    return np.asarray(z - np.nan_to_num(lag * (turning @ axes.T)))


def all_axes(fit: Fit, reference_axes: Array, reference: list[int]) -> tuple[Array, Array]:
    """Return axes (n, 3) of all channels and covariance (n, 3, 3) of each, given the reference axes (3, 3)."""
    m = len(fit.gain)
    n = m + 3
    others = [i for i in range(n) if i not in reference]
    axes, covariance = np.empty((n, 3)), np.zeros((n, 3, 3))
    axes[reference], axes[others] = reference_axes, fit.gain @ reference_axes
    for k, i in enumerate(others):
        block = fit.covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
        covariance[i] = reference_axes.T @ block @ reference_axes
    return axes, covariance
