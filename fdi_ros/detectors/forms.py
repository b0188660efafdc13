"""Linear forms of a sample in which the body rate cancels: predictions, innovations, determinants.

``f = F @ z`` with ``F @ H = 0``: only the channels' errors reach f, so its standard deviation follows from the noise
model alone.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fdi_ros.model.geometry import MIN_SENSITIVITY, Geometry
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.rows import transform
from fdi_ros.model.thresholds import max_normal_threshold

Array = NDArray[np.float64]


def prediction_errors(axes: Array) -> Array:
    """Matrix (n, n) that maps z to ``z_i - z_ip``, each channel against its prediction from all the others.

    ``z_i - z_ip = r_i / S_ii`` on any axes (n, 3). Rows of channels no fault of which is seen are zero.
    """
    residuals = np.eye(len(axes)) - axes @ np.linalg.pinv(axes)
    share = np.diag(residuals)[:, None]
    seen = share >= MIN_SENSITIVITY**2
    return np.where(seen, residuals / np.where(seen, share, 1.0), 0.0)


class ParityForms:
    """Standard deviation of forms F (k, n) under the noise model, and the threshold of the largest of them.

    Parameters
    ----------
    matrix
        F, (k, n), with F @ H = 0; a row of zeros is a form that is always zero.
    geometry
        Sensitivity axes.
    noise
        Error model, one value a channel.
    """

    def __init__(self, matrix: Array, geometry: Geometry, noise: NoiseModel) -> None:
        self._matrix = matrix
        self._geometry = geometry
        self._noise = noise
        self._used: NDArray[np.bool_] = np.abs(matrix).max(axis=1) > 0
        # A form that is always zero gets a deviation of its own, so that zero over it is zero.
        squares = np.where(self._used[:, None], matrix**2, 1.0)
        self._squares = np.ascontiguousarray(squares.T)
        self._rows = squares.tolist()
        self.resting = np.sqrt(squares @ noise.noise_std**2)
        """Standard deviation of each form at rest, (k,) rad/s times the unit of F."""

    def std(self, rate_along: Array, acceleration: Array | None) -> Array:
        """Give the standard deviation of each form, (N, k), from the rate along each axis (N, n), rad/s."""
        return np.sqrt(transform(self._squares, self._noise.variance_along(self._geometry, rate_along, acceleration)))

    def std_one(self, rate_along: Array, acceleration: Array | None, form: int) -> float:
        """Give the standard deviation of one form in one sample (1, n), equal to `std` to the last bit."""
        variance = self._noise.variance_along(self._geometry, rate_along, acceleration)[0].tolist()
        total = 0.0
        for square, channel in zip(self._rows[form], variance, strict=True):
            total += square * channel
        return math.sqrt(total)

    def threshold(self, probability: float) -> float:
        """Level that the largest |f| / std exceeds with the given probability when every channel is sound."""
        gain = self._matrix[self._used] @ self._geometry.parity.T
        covariance = (self._geometry.parity * self._noise.noise_std**2) @ self._geometry.parity.T
        directions = gain @ np.linalg.cholesky(covariance)
        return max_normal_threshold(directions / np.linalg.norm(directions, axis=1, keepdims=True), probability)
