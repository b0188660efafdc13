# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The noise model of calibrated channels: additive noise, and scale and timing terms that grow with the motion.

The parity vector ``p = V (z - bias)`` does not depend on the body rate, so its likelihood given the variances is one of
restricted maximum likelihood: ``log |V R V'| + p' (V R V')^-1 p`` per sample, with R the variances of `NoiseModel` at
the rate and the causal acceleration that the sample path computes. With rest, R is the noise at rest plus the two
terms (`rest_noise`, `fit_noise`).

In flight the noise of each channel is found by the same likelihood from the second moments S of p: minimise
``log |C| + tr(inv(C) S)``, ``C = V R V'``, R diagonal (`channel_noise`). Where pairs of channels cannot be told apart
it is flat; there a weak prior decides: noise is in proportion to what each channel shows by itself above the motion.
Three parallel units come out as from the variances of their differences, ``2 r_1 = d_12 + d_13 - d_23``, kept positive.
Scale and timing errors are then not taken from a variance that grows with the motion: vibration grows with it, too.
They are taken from what is coherent with the motion (`coherent_term`): a wrong scale has the same sign wherever the
rate has.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from fdi_ros.calibration.data import Array, Data, Index, Mask
from fdi_ros.calibration.motion import Motion
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel

DEGREES = 6.0
"""Degrees of freedom of the t distribution, where outliers have not been taken out yet."""
MAX_ROWS = 8000
"""Samples that the motion terms are fitted to at most, evenly picked."""
START = (0.003, 0.0003)
"""Scale and timing terms that the search begins with."""
ALIKE = 0.5
"""Standard deviation of the logarithm of a channel's variance about its guide, before disagreement is measured."""
REACH = 14.0
"""Logarithm of the ratio of variances that is searched to either side."""
CORRELATED = 20
"""Samples of vibration that count as one against the prior."""
LEAST_BLOCKS = 8
"""Spans of motion among which a coherent error can be told from chance."""


@dataclass(frozen=True)
class NoiseFit:
    """Noise terms with standard errors; scale and timing hold for every channel."""

    std: Array
    """(n,) rad/s."""
    std_error: Array
    """(n,) rad/s."""
    scale: float
    scale_error: float
    timing: float
    """s."""
    timing_error: float
    """s."""

    def model(self) -> NoiseModel:
        """Return it as a noise model."""
        return NoiseModel(self.std, self.scale, self.timing)


def rest_noise(z: Array, rows: Mask, geometry: Geometry, level: Array) -> tuple[Array, Array]:
    """Noise (n,) of the channels at rest and its standard errors, rad/s.

    The channels' own standard deviations give the proportions. Their disagreement gives the size: a table that
    trembles moves all of them, a bias that walks during the recording moves each of them.

    Parameters
    ----------
    z
        (N, n) bias-free channels, rad/s.
    rows
        (N,) samples at rest, complete.
    geometry
        Calibrated axes.
    level
        (n,) standard deviation of each channel at rest, rad/s.
    """
    p = z[rows] @ geometry.parity.T
    covariance = (geometry.parity * level**2) @ geometry.parity.T
    mean_square = float(np.mean(np.sum(p @ np.linalg.inv(covariance) * p, axis=1))) / p.shape[1]
    std = level * np.sqrt(mean_square)
    return std, std / np.sqrt(2 * len(p))


@dataclass(frozen=True)
class _Terms:
    """Parity vectors (K, m), and the covariance (K, m, m) that each term adds: ``base + s^2 scale + t^2 timing``."""

    p: Array
    base: Array
    scale: Array
    timing: Array
    block: Array

    def rows(self, values: Array, degrees: float) -> Array:
        """-2 log-likelihood (K,) at the squares (2,) of the two terms; degrees inf: normal."""
        covariance = self.base + values[0] * self.scale + values[1] * self.timing
        m = self.p.shape[1]
        square = np.einsum("ki,ki->k", self.p, np.linalg.solve(covariance, self.p[:, :, None])[:, :, 0])
        if np.isfinite(degrees):
            square = (degrees + m) * np.log1p(square / degrees)
        return np.asarray(np.linalg.slogdet(covariance)[1] + square)


def fit_noise(
    data: Data,
    motion: Motion,
    rows: Mask,
    geometry: Geometry,
    at_rest: tuple[Array, Array],
    degrees: float = np.inf,
) -> NoiseFit:
    """Fit scale and timing terms to samples in motion.

    Parameters
    ----------
    data, motion
        The recording, and its motion as the sample path computes it.
    rows
        (N,) samples in motion to use, complete.
    geometry
        Calibrated axes.
    at_rest
        Noise at rest and its standard errors, (n,) each, rad/s.
    degrees
        Of the t distribution taken for the parity vectors; inf: normal, the second moments decide.
    """
    std, std_error = at_rest
    terms = _terms(data, motion, rows, geometry, std)

    def loss(log_terms: Array) -> float:
        return float(terms.rows(np.exp(2 * log_terms), degrees).mean())

    start = np.log(START)
    found = minimize(loss, start, method="Nelder-Mead", options={"xatol": 5e-3, "fatol": 1e-7, "maxiter": 200})
    squares = np.exp(2 * np.clip(found.x, np.log(1e-6), 0.0))
    scale_error, timing_error = _errors(terms, squares, degrees)
    scale, timing = np.sqrt(squares)
    # Below a tenth of a standard error a term is as good as zero, and the search stopped where it happened to be.
    scale = float(scale) if scale > 0.1 * scale_error else 0.0
    timing = float(timing) if timing > 0.1 * timing_error else 0.0
    return NoiseFit(std, std_error, scale, scale_error, timing, timing_error)


def _terms(data: Data, motion: Motion, rows: Mask, geometry: Geometry, std: Array) -> _Terms:
    chosen = np.flatnonzero(rows)
    chosen = chosen[:: len(chosen) // MAX_ROWS + 1]
    V = geometry.parity
    along, turning = motion.rate[chosen] @ geometry.axes.T, motion.acceleration[chosen] @ geometry.axes.T
    return _Terms(
        motion.residual[chosen] @ V.T,
        (V * std**2) @ V.T,
        np.einsum("ai,ki,bi->kab", V, along**2, V, optimize=True),
        np.einsum("ai,ki,bi->kab", V, turning**2, V, optimize=True),
        data.seconds[chosen].astype(np.int64).astype(np.float64),
    )


def _errors(terms: _Terms, squares: Array, degrees: float) -> tuple[float, float]:
    """Return standard errors of the two terms: sandwich over seconds, from differences of the likelihood."""
    h = np.maximum(1e-2 * squares, [1e-10, 1e-14])
    up = [terms.rows(squares + h * unit, degrees) for unit in np.eye(2)]
    down = [terms.rows(np.maximum(squares - h * unit, 0), degrees) for unit in np.eye(2)]
    middle, both = terms.rows(squares, degrees), terms.rows(squares + h, degrees)
    width = np.array([h[i] + min(h[i], squares[i]) for i in range(2)])
    score = np.column_stack([(up[i] - down[i]) / width[i] for i in range(2)])
    hessian = np.empty((2, 2))
    for i in range(2):
        hessian[i, i] = (up[i] - 2 * middle + down[i]).sum() / h[i] ** 2
    hessian[0, 1] = hessian[1, 0] = (both - up[0] - up[1] + middle).sum() / h.prod()
    _, block = np.unique(terms.block, return_inverse=True)
    sums = np.zeros((block.max() + 1, 2))
    np.add.at(sums, block, score)
    inverse = np.linalg.pinv(hessian)
    variance = np.diag(inverse @ (sums.T @ sums) @ inverse)
    errors = np.sqrt(np.maximum(variance, 0)) / (2 * np.sqrt(np.maximum(squares, np.sqrt(np.maximum(variance, 1e-30)))))
    return float(errors[0]), float(errors[1])


def channel_noise(p: Array, geometry: Geometry, own: Array | None = None) -> Array:
    """Find the standard deviation (n,) of each channel, rad/s, from their disagreement.

    Parameters
    ----------
    p
        (K, n - 3) parity vectors, rad/s.
    geometry
        Calibrated axes.
    own
        (n,) what each channel shows by itself above the motion, rad/s: a guide where the disagreement leaves a channel
        undetermined; None: channels are alike.
    """
    V = geometry.parity
    guide = np.zeros(geometry.n) if own is None else 2 * np.log(np.maximum(own, 1e-9))
    S = p.T @ p / len(p)
    weight = len(p) / CORRELATED
    # v_i' v_i of each channel's variance shows; the mean over all is the start.
    middle = float(np.log(max(np.trace(S) / len(S), 1e-18)))

    def loss(theta: Array) -> tuple[float, Array]:
        R = np.exp(theta)
        C = (V * R) @ V.T
        inverse = np.linalg.inv(C)
        pulled = inverse @ S @ inverse
        off = theta - guide - (theta - guide).mean()
        value = (
            0.5 * weight * (np.linalg.slogdet(C)[1] + float(np.sum(inverse * S))) + 0.5 * float(off @ off) / ALIKE**2
        )
        slope = R * np.einsum("ai,ab,bi->i", V, inverse - pulled, V)
        return value / weight, (0.5 * weight * slope + off / ALIKE**2) / weight

    bounds = [(middle - REACH, middle + REACH)] * geometry.n
    found = minimize(loss, np.full(geometry.n, middle), jac=True, method="L-BFGS-B", bounds=bounds)
    return np.asarray(np.exp(0.5 * found.x))


def shared_noise(std: Array, high: Array, axes: Array) -> Array:
    """Noise (n,) of the channels where vibration that some units see alike may not cancel on another day, rad/s.

    Near half the sampling rate a shift of half a sample turns what cancels into what adds. Whether two units agree
    there is a matter of when each happens to sample, and of the next start. So a channel counts with what such a shift
    would make of its own vibration, ``var(v(t) - v(t + T/2)) / 2``, though with no more than channels along its axis
    have on average: where all units agree, they are sampled together. Independent noise stays as it is.

    Parameters
    ----------
    std
        (n,) from the disagreement, rad/s.
    high
        (K, n) channels above the motion that they share, in samples that follow each other, rad/s.
    axes
        (n, 3) calibrated axes.
    """
    power = np.abs(np.fft.rfft(high * np.hanning(len(high))[:, None], axis=0)) ** 2
    change = 1 - np.cos(np.pi * np.fft.rfftfreq(len(high)))
    after_shift = (change @ power) / np.maximum(power.sum(axis=0), 1e-300) * high.var(axis=0)
    unit = axes / np.linalg.norm(axes, axis=1)[:, None]
    along = (unit @ unit.T) ** 2
    average = along @ std**2 / along.sum(axis=1)
    return np.asarray(np.sqrt(np.maximum(std**2, np.minimum(after_shift, average))))


def coherent_term(error: Array, motion: Array, block: Index) -> tuple[float, float]:
    """Share k of the motion that the errors follow, other than by chance, and its standard error.

    In each block the correlation of a channel's error with its own motion is compared with that between the errors of
    this block and the motion of others: what matches no better in time than out of time is no scale (or timing) error,
    however much it grows with the motion.

    Parameters
    ----------
    error
        (K, n) of each channel, rad/s.
    motion
        (K, n) what it may follow: rate or angular acceleration along the channel.
    block
        (K,) number of the block of each row, increasing, blocks of the same length.
    """
    edges = np.searchsorted(block, np.unique(block))
    parts = list(zip(np.split(error, edges[1:]), np.split(motion, edges[1:]), strict=True))
    rows = int(np.median([len(e) for e, _ in parts]))
    parts = [(e[:rows], w[:rows]) for e, w in parts if len(e) >= rows]
    if len(parts) < LEAST_BLOCKS:
        return 0.0, 0.0
    e, w = (np.array(side) for side in zip(*parts, strict=True))
    power_e, power_w = (e**2).sum(axis=1), np.maximum((w**2).sum(axis=1), 1e-30)
    products = np.einsum("bkn,ckn->bcn", e, w) ** 2 / np.maximum(power_e[:, None] * power_w[None], 1e-30)
    own = np.einsum("bbn->bn", products)
    others = (products.sum(axis=1) - own) / (len(e) - 1)
    # k^2 = E(excess coherent power) / E(power of the motion), over blocks and channels.
    excess = ((own - others) * power_e).sum(axis=1)
    total = float(power_w.sum())
    square = float(excess.sum()) / total
    error_of_square = float(np.std(excess) * np.sqrt(len(excess))) / total
    value = float(np.sqrt(max(square, 0.0)))
    return value, error_of_square / (2 * max(value, np.sqrt(error_of_square), 1e-12))
