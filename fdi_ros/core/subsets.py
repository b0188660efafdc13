"""Every set of channels, by its bits: least squares over it, what the method can do with it, its protection level."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.core.compiled import allocate, compiled
from fdi_ros.core.record import Axes, Channels, Flag, Mask, Vector, record
from fdi_ros.model.geometry import MIN_CHANNELS, MIN_SENSITIVITY, MIN_SINGULAR_RATIO, Geometry
from fdi_ros.model.noise import NoiseModel

Array = NDArray[np.float64]

MIN_SPARE_RATIO = 0.1
"""Channels under suspicion are left out as long as the rest measures its worst axis at least a tenth as well as its
best; below that, leaving them out costs more than a widened covariance."""


@record
class Subset:
    """Weighted least squares over one set of channels; zero for the others."""

    gain: Axes  # row i: share of channel i in the rate, weights 1 / noise_std^2
    sensitivity: Channels  # what of a channel's own error stays in its residual, 0 to 1
    spans: Flag  # the channels span space
    spare: Flag  # well enough to leave the others out for a mere suspicion
    refused: Flag  # enough channels, and the method cannot run on them
    detectable: Mask  # channels whose fault the method sees
    has_level: Flag  # level and limit were worked out
    level: Vector  # protection level of each body axis, rad/s
    limit: Channels  # largest residual that passes the separation test, rad/s


def prepare_subsets(geometry: Geometry, noise: NoiseModel) -> NDArray[Any]:
    """Return the least-squares part of all 2^n sets of channels, (2^n,) `Subset`."""
    n = geometry.n
    subsets = allocate(Subset, 1 << n)
    bits = np.arange(1 << n)[:, None] >> np.arange(n) & 1
    used = bits[:, :, None] * geometry.axes
    singular = np.linalg.svd(used, compute_uv=False)
    worst, best = singular[:, -1], singular[:, 0]
    spans = (bits.sum(axis=1) >= 3) & (worst >= MIN_SINGULAR_RATIO * best)
    subsets["spans"], subsets["spare"] = spans, spans & (worst >= MIN_SPARE_RATIO * best)
    roots = bits[spans] / noise.noise_std
    gain = np.linalg.pinv(roots[:, :, None] * geometry.axes).transpose(0, 2, 1) * roots[:, :, None]
    subsets["gain"][spans, :n] = gain
    share = 1 - np.einsum("kij,ij->ki", gain, geometry.axes)
    subsets["sensitivity"][spans, :n] = np.where(bits[spans] == 1, share, 0.0)
    return subsets


def prepare_capability(subsets: NDArray[Any], geometry: Geometry, can_run: list[bool]) -> None:
    """Note what a method can do with each set of channels.

    Parameters
    ----------
    subsets
        To be completed.
    geometry
        All channels.
    can_run
        Whether the method runs on k channels, (n + 1,).
    """
    n = geometry.n
    bits = np.arange(1 << n)[:, None] >> np.arange(n) & 1
    count = bits.sum(axis=1)
    enough = (subsets["spans"] != 0) & (count >= MIN_CHANNELS)
    runs = enough & np.array(can_run)[count]
    subsets["refused"], subsets["detectable"] = enough & ~runs, 0
    gain = np.linalg.pinv(bits[runs][:, :, None] * geometry.axes).transpose(0, 2, 1)
    share = 1 - np.einsum("kij,ij->ki", gain, geometry.axes)
    seen = (bits[runs] == 1) & (np.sqrt(np.clip(share, 0, None)) >= MIN_SENSITIVITY)
    subsets["detectable"][runs] = (seen << np.arange(n)).sum(axis=1)


@compiled
def find_rate(subset: Subset, n: int, mask: int, z: Array, rate: Array) -> None:
    """Least-squares rate (3,) of the channels in mask, rad/s; NaN where they do not span space."""
    for a in range(3):
        total = 0.0
        for i in range(n):
            if mask >> i & 1:
                total += subset.gain[i, a] * z[i]
        rate[a] = total if subset.spans else math.nan


@compiled
def find_covariance(subset: Subset, n: int, mask: int, variance: Array, covariance: Array) -> None:
    """Covariance (6,) of the rate for channel variances (n,), upper triangle; NaN where there is no rate."""
    for k in range(6):
        covariance[k] = 0.0 if subset.spans else math.nan
    if subset.spans:
        for i in range(n):
            if mask >> i & 1:
                x, y, z = subset.gain[i, 0], subset.gain[i, 1], subset.gain[i, 2]
                covariance[0] += variance[i] * (x * x)
                covariance[1] += variance[i] * (x * y)
                covariance[2] += variance[i] * (x * z)
                covariance[3] += variance[i] * (y * y)
                covariance[4] += variance[i] * (y * z)
                covariance[5] += variance[i] * (z * z)
