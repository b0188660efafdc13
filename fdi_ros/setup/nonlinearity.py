# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Errors that are not linear in the rate, measured from blocks in motion.

The residual of channel i beside the rate, once axes and bias are taken off, is fitted by

    b_i + g_i t + E_i w + a_i |h_i w| + c_i h_i w |h_i w| / m_i

with m_i the largest rate along the channel. a is an asymmetry, as the monitor follows,
and c a nonlinearity of odd order. Bias, drift and scale error are fitted anew, because
they have taken up a part of both. A bias that walks would take up the asymmetry whole.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fdi_ros.model.samples import Array, Int
from fdi_ros.setup.noise import information, projector


class _NonlinearityLimits(NamedTuple):
    """How large a nonlinearity is, and when it counts as measured."""

    #: usual nonlinearity: data sheets state 0.01 to 1 %
    usual: float = 2e-3
    #: largest standard error with which it counts as measured: half of the usual
    #: one
    error: float = 1e-3


_NONLINEARITY = _NonlinearityLimits()

#: signals of a channel: bias, three of scale, drift, asymmetry, odd order
TERMS = 7


class Nonlinearity(NamedTuple):
    """Nonlinearity of the channels against each other, as shares of the largest rate."""

    #: root mean square over the channels
    value: float
    #: its standard error
    error: float

    @property
    def is_measured(self) -> bool:
        """Whether the recording shows how large it is."""
        return self.error < _NONLINEARITY.error


def measure(
    residual: Array,
    rate: Array,
    time: Array,
    variance: Array,
    window: Int,
    axes: Array,
    bias_std: float,
    scale_std: Array,
) -> Nonlinearity:
    """Fit nonlinearities to blocks in motion.

    Parameters
    ----------
    residual
        Of the block means (B, n), less mean biases and the rate along the axes, rad/s.
    rate
        Body rate (B, 3), rad/s.
    time
        Of the blocks (B,), s.
    variance
        Of a block mean in each window (W, n), (rad/s)^2.
    window
        Window of each block (B,).
    axes
        (n, 3).
    bias_std, scale_std
        Of bias and drift, rad/s, and of each component of scale error (n,), before the fit.
    """
    n = len(axes)
    if not len(time):
        return Nonlinearity(0.0, np.inf)
    along = rate @ axes.T
    largest = np.maximum(np.abs(along).max(axis=0), 1e-9)
    signals = np.zeros((len(along), n, TERMS))
    signals[:, :, 0] = 1.0
    signals[:, :, 1:4] = rate[:, None, :]
    relative = (time - time.mean()) / max(np.ptp(time), 1.0)
    signals[:, :, 4] = relative[:, None]
    signals[:, :, 5] = np.abs(along)
    signals[:, :, 6] = along * np.abs(along) / largest
    normal = np.zeros((n, TERMS, n, TERMS))
    right = np.zeros((n, TERMS))
    known = information(variance, axes)
    for w in np.unique(window):
        rows = window == w
        part = signals[rows]
        products = np.tensordot(part, part, (0, 0))  # (n, TERMS, n, TERMS)
        normal += known[w][:, None, :, None] * products
        right += np.einsum("bik,bi->ik", part, residual[rows] @ known[w])
    # Before anything is shown: no gyro is as bad.
    prior = np.full((n, TERMS), 0.3)
    prior[:, [0, 4]] = bias_std
    prior[:, 1:4] = np.maximum(scale_std, 1e-6)[:, None]
    size = n * TERMS
    covariance = np.linalg.inv(
        normal.reshape(size, size) + np.diag(prior.ravel() ** -2.0)
    )
    found = (covariance @ right.ravel()).reshape(n, TERMS)
    each: Array = np.asarray(covariance).reshape(n, TERMS, n, TERMS)
    # Asymmetry and nonlinearity of odd order.
    squares = [_mean_square(found[:, k], each[:, k, :, k], axes) for k in (5, 6)]
    square_sum = sum(square for square, _ in squares)
    value = float(np.sqrt(max(square_sum, 0.0)))
    spread = float(np.sqrt(sum(error**2 for _, error in squares)))
    return Nonlinearity(value, spread / (2.0 * max(value, _NONLINEARITY.usual)))


def _mean_square(shares: Array, covariance: Array, axes: Array) -> tuple[float, float]:
    """Mean square of shares (n,) of a covariance, and its standard error; the better known weigh more."""
    # What all channels have in common is another rate, and shows nowhere.
    apart = projector(axes)
    variance, directions = np.linalg.eigh(apart @ covariance @ apart)
    counts = variance > 1e-6 * variance.max()
    variance = variance[counts]
    along = (directions.T @ shares)[counts]
    weight = (variance + _NONLINEARITY.usual**2) ** -2.0
    square = np.average(along**2 - variance, weights=weight)
    return float(square), float(np.sqrt(2.0 / weight.sum()))
