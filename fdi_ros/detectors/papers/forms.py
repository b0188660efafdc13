# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Linear forms of a sample in which the body rate cancels: predictions, innovations, determinants.

``f = F @ z`` with ``F @ H = 0``: only the channels' errors reach f, so its standard deviation follows from the noise
model alone.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fdi_ros.core.compiled import compiled
from fdi_ros.model.geometry import MIN_SENSITIVITY, Geometry
from fdi_ros.model.noise import NoiseModel
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


def resting_std(forms: Array, noise: NoiseModel) -> Array:
    """Return the standard deviation of forms (k, n) at rest, (k,) rad/s times their unit."""
    return np.sqrt(forms**2 @ noise.noise_std**2)


def largest_form_threshold(forms: Array, geometry: Geometry, noise: NoiseModel, probability: float) -> float:
    """Level that the largest |f| / std of forms (k, n) exceeds with a probability when every channel is healthy.

    A row of zeros is a form that is always zero.
    """
    gain = forms[np.abs(forms).max(axis=1) > 0] @ geometry.parity.T
    covariance = (geometry.parity * noise.noise_std**2) @ geometry.parity.T
    directions = gain @ np.linalg.cholesky(covariance)
    return max_normal_threshold(directions / np.linalg.norm(directions, axis=1, keepdims=True), probability)


@compiled
def value_of(form: Array, z: Array, n: int) -> float:
    """Value of one form for the first n of z."""
    total = 0.0
    for j in range(n):
        total += form[j] * z[j]
    return total


@compiled
def std_of(form: Array, variance: Array, n: int) -> float:
    """Return the standard deviation of one form when the n channels have these error variances, (rad/s)^2."""
    total = 0.0
    for j in range(n):
        total += form[j] * form[j] * variance[j]
    return math.sqrt(total)
