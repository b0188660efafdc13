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
from fdi_ros.model.rows import transform

Array = NDArray[np.float64]

CHUNK = 512
"""Rows worked on at a time where a sample needs thousands of numbers: what fits the processor's cache."""

MAX_RATIO = 1e6
"""Variances are cut at so many times the smallest of the sample. Under a wrong hypothesis a huge fault passes for rate,
and weights further apart would leave no correct digit in the normal equations."""


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
        self._axes = axes
        self._squares = np.ascontiguousarray(axes[:, _ROW] * axes[:, _COLUMN])
        self._out_axes = axes[self.out].transpose(2, 1, 0)[..., None].copy()
        self._at = self.out.T, np.arange(len(self.out))

    def fit(self, z: Array, acceleration: Array | None) -> tuple[Array, Array]:
        """Errors of the channels left out, (l, K, N) rad/s, and remaining chi-square, (K, N)."""
        parts = [self._fit(*part) for part in _chunks(z, acceleration)]
        return _joined([part[0] for part in parts]), _joined([part[1] for part in parts])

    def whitened(self, z: Array, acceleration: Array | None) -> Array:
        """Errors over their standard deviations, (l, K, N)."""
        return _joined([self._whitened(*part) for part in _chunks(z, acceleration)])

    def _fit(self, z: Array, acceleration: Array | None) -> tuple[Array, Array]:
        residual, _, weighted, covariance = self._weigh(z, acceleration)
        moment, correction, error = self._correct(residual, weighted, covariance)
        squares = _channel_sum(np.ones((z.shape[1], 1)), weighted * residual)[0]
        return error, np.maximum(squares - _dot(moment, correction), 0.0)

    def _whitened(self, z: Array, acceleration: Array | None) -> Array:
        residual, variance, weighted, covariance = self._weigh(z, acceleration)
        _, _, error = self._correct(residual, weighted, covariance)
        along = _product(covariance[:, None], self._out_axes)
        error /= np.sqrt(variance[self._at] + _dot(self._out_axes, along))
        return error

    def _weigh(self, z: Array, acceleration: Array | None) -> tuple[Array, Array, Array, Array]:
        """Residuals, variances and weighted residuals, (n, K, N), and covariance of the rate, (6, K, N)."""
        n, k, rows = z.shape[1], len(self.out), len(z)
        # Residuals about the plain least-squares rate of the channels kept: of the size of the noise, so that
        # the weighted solution is a small correction to them and no digits are lost to a large rate.
        residual = transform(self._residual, z).T.reshape(n, k, rows)
        variance = self._variance(z.T[:, None, :] - residual, acceleration)
        weight = self._kept / variance
        return residual, variance, weight * residual, inverse_symmetric(_channel_sum(self._squares, weight))

    def _correct(self, residual: Array, weighted: Array, covariance: Array) -> tuple[Array, Array, Array]:
        """Moment and correction of the rate, (3, K, N), and errors of the channels left out, (l, K, N)."""
        moment = _channel_sum(self._axes, weighted)
        correction = _product(covariance, moment)
        return moment, correction, residual[self._at] - _dot(self._out_axes, correction[:, None])

    def _variance(self, rate: Array, acceleration: Array | None) -> Array:
        scaled = self.noise.scale_std[:, None, None] * rate
        variance = scaled * scaled
        variance += (self.noise.noise_std * self.noise.noise_std)[:, None, None]
        if acceleration is not None:
            timing = self.noise.timing_std[:, None] * transform(self._axes.T, acceleration).T
            variance += (timing * timing)[:, None, :]
        return np.minimum(variance, MAX_RATIO * np.minimum.reduce(variance, axis=0))


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


def _channel_sum(matrix: Array, values: Array) -> Array:
    """Sum over channels of matrix (n, c) times values (n, K, N), in channel order: (c, K, N)."""
    n, k, rows = values.shape
    if rows == 1:
        products = matrix[:, :, None, None] * values[:, None]
        return np.add.accumulate(products, axis=0)[-1]
    return transform(matrix, values.reshape(n, -1).T).T.reshape(-1, k, rows)


def _chunks(z: Array, acceleration: Array | None) -> list[tuple[Array, Array | None]]:
    edges = range(0, len(z), CHUNK)
    return [(z[i : i + CHUNK], None if acceleration is None else acceleration[i : i + CHUNK]) for i in edges]


def _joined(parts: list[Array]) -> Array:
    return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=-1)
