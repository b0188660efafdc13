"""Fault hypotheses "these channels are arbitrary, all others sound": their fit and the errors they estimate.

A hypothesis leaves a set L of channels out. The others give the weighted least-squares rate, and with it

- the error of each channel left out, ``z_i - h_i omega_L``: linear in z_i with slope one, whatever the noise;
- the remaining chi-square, the weighted squares of the others' residuals, n - 3 - |L| degrees of freedom.

With noise that depends on the rate, the variances under a hypothesis are those at the rate which the channels
*kept* give. So neither figure's weights depend on the channels left out, and a fault of channel i moves the
statistic of hypothesis {i} in proportion: a larger fault is never less visible, however large its share in the
rate estimate of all channels is.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fdi_ros.model.geometry import Geometry, spans_space
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.rows import row_sum, transform

Array = NDArray[np.float64]

CHUNK = 512
"""Rows worked on at a time where a sample needs thousands of numbers: what fits the processor's cache."""


def singles(geometry: Geometry) -> list[tuple[int, ...]]:
    """Every channel whose fault reaches the parity vector, as a set of one."""
    return [(int(i),) for i in np.flatnonzero(geometry.detectable)]


def pairs(geometry: Geometry) -> list[tuple[int, ...]]:
    """All pairs of detectable channels that can be told apart: twins together explain no more than one of them."""
    seen, same = geometry.detectable, geometry.group_matrix
    n = geometry.n
    return [(i, j) for i in range(n) for j in range(i + 1, n) if seen[i] and seen[j] and not same[i, j]]


def whole_units(geometry: Geometry) -> list[tuple[int, ...]]:
    """Units of three channels whose common fault leaves at least one check: one chip or one cable gone bad."""
    seen = geometry.detectable
    return [
        unit for unit in geometry.units if len(unit) == 3 and seen[list(unit)].all() and _spans_without(geometry, unit)
    ]


def _spans_without(geometry: Geometry, unit: tuple[int, ...]) -> bool:
    rest = np.delete(geometry.axes, unit, axis=0)
    return len(rest) > 3 and spans_space(rest)


def whitened_directions(geometry: Geometry, noise: NoiseModel) -> Array:
    """Return the unit parity directions of the detectable channels, (k, n - 3), for variances noise_std^2."""
    white = geometry.axes / noise.noise_std[:, None]
    directions = np.linalg.qr(white, mode="complete")[0][:, 3:][geometry.detectable]
    return np.asarray(directions / np.linalg.norm(directions, axis=1)[:, None])


class FixedFits:
    """Fits of hypotheses under constant noise: matrices, computed once.

    Parameters
    ----------
    geometry
        Sensitivity axes.
    noise
        Error model, one value a channel; only noise_std is used.
    left_out
        K sets of channels, all of the same size l.
    """

    def __init__(self, geometry: Geometry, noise: NoiseModel, left_out: Sequence[tuple[int, ...]]) -> None:
        n, sigma = geometry.n, noise.noise_std
        self.out = np.array(left_out, dtype=np.intp)
        self.kept = _complement(self.out, n)
        index = np.arange(len(self.out))[:, None]
        white = geometry.axes[self.kept] / sigma[self.kept][:, :, None]
        predict = geometry.axes[self.out] @ np.linalg.pinv(white)
        gain = np.zeros((*self.out.shape, n))
        gain[index[:, :, None], np.arange(self.out.shape[1])[None, :, None], self.kept[:, None, :]] = (
            -predict / sigma[self.kept][:, None, :]
        )
        gain[index, np.arange(self.out.shape[1]), self.out] = 1.0
        self.spread: Array = np.sqrt(sigma[self.out] ** 2 + (predict**2).sum(axis=2))
        self._errors = _as_transposed(gain.transpose(1, 0, 2))
        basis = np.linalg.qr(white, mode="complete")[0][:, :, 3:].transpose(2, 0, 1)
        checks = np.zeros((len(basis), len(self.out), n))
        checks[:, index, self.kept] = basis / sigma[self.kept]
        self._checks = _as_transposed(checks)

    def errors(self, z: Array) -> Array:
        """Errors of the channels left out, (l, K, N) rad/s."""
        size, k = self.out.shape[1], len(self.out)
        return transform(self._errors, z).T.reshape(size, k, len(z))

    def fit(self, z: Array, acceleration: Array | None) -> tuple[Array, Array]:
        """Errors of the channels left out, (l, K, N) rad/s, and remaining chi-square, (K, N)."""
        remaining = np.zeros((len(self.out), len(z)))
        if self._checks.shape[1]:
            left = transform(self._checks, z).T.reshape(-1, len(self.out), len(z))
            for component in left:
                remaining += component * component
        return self.errors(z), remaining

    def whitened(self, z: Array, acceleration: Array | None) -> Array:
        """Errors over their standard deviations, (l, K, N)."""
        return self.errors(z) / self.spread.T[:, :, None]


class SampleFits:
    """Fits of hypotheses under noise that depends on rate and acceleration: weights computed for every sample.

    Parameters as in `FixedFits`.
    """

    def __init__(self, geometry: Geometry, noise: NoiseModel, left_out: Sequence[tuple[int, ...]]) -> None:
        n, axes = geometry.n, geometry.axes
        self.noise = noise
        self.out = np.array(left_out, dtype=np.intp)
        kept = _complement(self.out, n)
        residual = np.tile(np.eye(n), (len(self.out), 1, 1))
        index = np.arange(len(self.out))[:, None, None]
        residual[index, np.arange(n)[None, :, None], kept[:, None, :]] -= axes @ np.linalg.pinv(axes[kept])
        self._residual = _as_transposed(residual.transpose(1, 0, 2))
        weight = np.ones((n, len(self.out), 1))
        weight[self.out, np.arange(len(self.out))[:, None]] = 0.0
        self._kept = weight
        self._axes = np.ascontiguousarray(axes.T)
        self._squares = np.ascontiguousarray(axes[:, _ROW] * axes[:, _COLUMN])
        self._out_axes = axes[self.out].transpose(2, 1, 0)[..., None].copy()

    def fit(self, z: Array, acceleration: Array | None) -> tuple[Array, Array]:
        """Errors of the channels left out, (l, K, N) rad/s, and remaining chi-square, (K, N)."""
        parts = [self._solve(z[at], None if acceleration is None else acceleration[at]) for at in _chunks(len(z))]
        return np.concatenate([p[0] for p in parts], axis=2), np.concatenate([p[2] for p in parts], axis=1)

    def whitened(self, z: Array, acceleration: Array | None) -> Array:
        """Errors over their standard deviations, (l, K, N)."""
        parts = [self._solve(z[at], None if acceleration is None else acceleration[at]) for at in _chunks(len(z))]
        return np.concatenate([p[0] / np.sqrt(p[1]) for p in parts], axis=2)

    def _solve(self, z: Array, acceleration: Array | None) -> tuple[Array, Array, Array]:
        """Errors (l, K, N), their variances (l, K, N), remaining chi-square (K, N)."""
        n, k, rows = z.shape[1], len(self.out), len(z)
        # Residuals about the plain least-squares rate of the channels kept: of the size of the noise, so that
        # the weighted solution is a small correction to them and no digits are lost to a large rate.
        residual = transform(self._residual, z).T.reshape(n, k, rows)
        variance = self._variance(z.T[:, None, :] - residual, acceleration)
        weight = self._kept / variance
        weighted = weight * residual
        information = transform(self._squares, weight.reshape(n, -1).T).T.reshape(6, k, rows)
        moment = transform(self._axes.T, weighted.reshape(n, -1).T).T.reshape(3, k, rows)
        squares = row_sum((weighted * residual).reshape(n, -1).T).reshape(k, rows)
        covariance = inverse_symmetric(information)
        correction = _product(covariance, moment)
        remaining = squares - _dot(moment, correction)
        out = self.out.T, np.arange(k)
        error = residual[out] - _dot(self._out_axes, correction[:, None])
        along = _product(covariance[:, None], self._out_axes)
        return error, variance[out] + _dot(self._out_axes, along), np.maximum(remaining, 0.0)

    def _variance(self, rate: Array, acceleration: Array | None) -> Array:
        scaled = self.noise.scale_std[:, None, None] * rate
        variance = scaled * scaled
        variance += (self.noise.noise_std * self.noise.noise_std)[:, None, None]
        if acceleration is not None:
            timing = self.noise.timing_std[:, None] * transform(self._axes, acceleration).T
            variance += (timing * timing)[:, None, :]
        return variance


_ROW, _COLUMN = [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]
"""Order in which the six entries of a symmetric (3, 3) matrix are kept."""
_FULL = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
_COFACTOR = np.array([[3, 5, 4, 4], [2, 4, 1, 5], [1, 4, 2, 3], [0, 5, 2, 2], [1, 2, 0, 4], [0, 3, 1, 1]]).T


def inverse_symmetric(matrix: Array) -> Array:
    """Inverse of symmetric (3, 3) matrices given and returned by their entries xx, xy, xz, yy, yz, zz, (6, ...)."""
    a, b, c, d = _COFACTOR
    cofactor = matrix[a] * matrix[b] - matrix[c] * matrix[d]
    return cofactor / _dot(matrix[:3], cofactor[:3])


def _product(symmetric: Array, vector: Array) -> Array:
    return _dot(symmetric[_FULL.T], vector[:, None])


def _dot(left: Array, right: Array) -> Array:
    """Sum over the leading axis of length 3, always in the same order."""
    product = left * right
    return product[0] + product[1] + product[2]


def _complement(out: NDArray[np.intp], n: int) -> NDArray[np.intp]:
    kept = np.ones((len(out), n), dtype=bool)
    kept[np.arange(len(out))[:, None], out] = False
    return np.nonzero(kept)[1].reshape(len(out), -1)


def _as_transposed(rows: Array) -> Array:
    """Rows (..., n) as one matrix, transposed for `transform`: (n, product of the leading axes)."""
    return np.ascontiguousarray(rows.reshape(-1, rows.shape[-1]).T)


def _chunks(rows: int) -> list[slice]:
    return [slice(start, start + CHUNK) for start in range(0, rows, CHUNK)]
