"""The fused body rate: weighted least squares over the channels trusted at each sample."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fdi_ros.model.geometry import Geometry, spans_space
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.rows import row_sum, transform

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MIN_SPARE_RATIO = 0.1
"""Channels under suspicion are left out as long as the rest measures its worst axis at least a tenth as well as its
best; below that, leaving them out costs more than a widened covariance."""


@dataclass(frozen=True)
class Estimator:
    """Least squares over one set of channels, zero columns for the others."""

    gain: Array
    """(n, 3), transposed: rate = z @ gain."""
    squares: Array
    """(n, 6): products of the gain, so that variances (N, n) @ squares is the covariance's upper triangle."""
    sensitivity: Array
    """(n,) S_ii of the channels in the set, 0 for the others: what of a channel's error stays in its residual."""
    spans: bool
    spare: bool
    """Spans with a condition good enough to leave the others out for a mere suspicion."""


_UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_FULL = np.array([0, 1, 2, 1, 3, 4, 2, 4, 5])


class Fusion:
    """Weighted least squares with the weights 1 / noise_std^2, one estimator a set of channels, built once."""

    def __init__(self, geometry: Geometry, noise: NoiseModel) -> None:
        self.axes = geometry.axes
        self.axes_transposed = np.ascontiguousarray(geometry.axes.T)
        self._weights = 1 / noise.noise_std**2
        self._known: dict[bytes, Estimator] = {}

    def estimator(self, mask: Mask) -> Estimator:
        """Estimator of the channels marked in mask (n,)."""
        key = mask.tobytes()
        if key not in self._known:
            self._known[key] = self._build(mask)
        return self._known[key]

    def rate(self, z: Array, mask: Mask) -> tuple[Array, Array]:
        """Body rate of every sample from the channels marked for it.

        Parameters
        ----------
        z
            (N, n) rad/s; whatever stands where the mask is False is ignored.
        mask
            (N, n).

        Returns
        -------
        Rate (N, 3) rad/s, NaN where the channels do not span space; and S_ii of the channels used, (N, n).
        """
        rate = np.full((len(z), 3), np.nan)
        sensitivity = np.zeros(z.shape)
        for rows, pattern in patterns(mask):
            estimator = self.estimator(pattern)
            sensitivity[rows] = estimator.sensitivity
            if estimator.spans:
                rate[rows] = transform(estimator.gain, np.where(pattern, z[rows], 0.0))
        return rate, sensitivity

    def covariance(self, variance: Array, mask: Mask) -> Array:
        """Covariance (N, 3, 3) of `rate` for channel variances (N, n); NaN where there is no rate."""
        covariance = np.full((len(variance), 9), np.nan)
        for rows, pattern in patterns(mask):
            estimator = self.estimator(pattern)
            if estimator.spans:
                covariance[rows] = transform(estimator.squares, np.where(pattern, variance[rows], 0.0))[:, _FULL]
        return covariance.reshape(-1, 3, 3)

    def trusted(self, usable: Mask, doubtful: Mask) -> Mask:
        """Which channels to fuse: those usable without the doubtful, unless too little would be left.

        Parameters
        ----------
        usable
            (N, n): healthy and not declared faulty.
        doubtful
            (N, n): suspect or ambiguous.
        """
        chosen = usable & ~doubtful
        if not doubtful.any():
            return chosen
        for rows, pattern in patterns(chosen):
            if not self.estimator(pattern).spare:
                chosen[rows] = usable[rows]
        return chosen

    def _build(self, mask: Mask) -> Estimator:
        n = len(mask)
        used = self.axes[mask]
        if not spans_space(used):
            return Estimator(np.zeros((n, 3)), np.zeros((n, 6)), np.zeros(n), False, False)
        weights = np.sqrt(self._weights[mask])
        gain = np.zeros((n, 3))
        gain[mask] = (np.linalg.pinv(used * weights[:, None]) * weights).T
        squares = np.column_stack([gain[:, a] * gain[:, b] for a, b in _UPPER])
        sensitivity = np.where(mask, 1 - row_sum(gain * self.axes), 0.0)
        singular = np.linalg.svd(used, compute_uv=False)
        return Estimator(gain, squares, sensitivity, True, bool(singular[-1] >= MIN_SPARE_RATIO * singular[0]))


def patterns(mask: Mask) -> list[tuple[slice | NDArray[np.intp], Mask]]:
    """Rows of a mask (N, n) grouped by equal content."""
    first = mask[0]
    if len(mask) == 1 or (mask == first).all():
        return [(slice(None), first)]
    unique, which = np.unique(mask, axis=0, return_inverse=True)
    which = which.reshape(-1)
    return [(np.flatnonzero(which == k), pattern) for k, pattern in enumerate(unique)]
