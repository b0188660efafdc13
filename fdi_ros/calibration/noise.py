"""The noise model of calibrated channels: additive noise at rest, scale and timing terms in motion.

The parity vector ``p = V (z - bias)`` does not see the body rate, so its likelihood given the variances is one of
restricted maximum likelihood: ``log |V R V'| + p' (V R V')^-1 p`` a sample, with R the variances of `NoiseModel` at
the rate and the causal acceleration that the pipeline itself works out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from fdi_ros.calibration.data import Array, Data, Mask
from fdi_ros.core.acceleration import Acceleration, take_rate
from fdi_ros.core.bank import present_in
from fdi_ros.core.compiled import allocate, compiled
from fdi_ros.core.subsets import find_rate, prepare_subsets
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel

DEGREES = 6.0
"""Of the t distribution, where outliers have not been taken out yet."""
MAX_ROWS = 8000
"""Samples that the motion terms are fitted to at most, evenly picked."""
START = (0.003, 0.0003)
"""Scale and timing terms that the search begins with."""


@dataclass(frozen=True)
class View:
    """A recording as the pipeline sees it with given axes.

    Attributes
    ----------
    residual
        (N, n) of the least-squares rate, rad/s; NaN where a channel is missing.
    rate, acceleration
        (N, 3) as the pipeline works them out, rad/s and rad/s^2.
    """

    residual: Array
    rate: Array
    acceleration: Array


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
        """Return the model it makes."""
        return NoiseModel(self.std, self.scale, self.timing)


def view(stamp: NDArray[np.int64], z: Array, geometry: Geometry, std: Array, window: float) -> View:
    """Rate, acceleration and residuals of bias-free channels z (N, n), as in the pipeline.

    Parameters
    ----------
    stamp
        (N,) ns.
    z
        (N, n) rad/s, NaN: not there.
    geometry
        Calibrated axes.
    std
        (n,) noise that weighs the channels, rad/s.
    window
        noise.acceleration_window, s.
    """
    rate, acceleration, turning = np.empty((len(z), 3)), np.empty((len(z), 3)), allocate(Acceleration)
    turning["window"] = round(window * 1e9)
    find_motion(prepare_subsets(geometry, NoiseModel(std)), turning, stamp, np.ascontiguousarray(z), rate, acceleration)
    return View(z - rate @ geometry.axes.T, rate, acceleration)


@compiled
def find_motion(
    subsets: NDArray[Any],
    turning: NDArray[Any],
    stamp: NDArray[np.int64],
    z: Array,
    rate: Array,
    acceleration: Array,
) -> None:
    """Find rate and acceleration, (N, 3) each, of the channels that are there in every sample, as the sample path does.

    Parameters
    ----------
    subsets
        (2^n,) `fdi_ros.core.subsets.Subset`.
    turning
        (1,) `fdi_ros.core.acceleration.Acceleration`.
    stamp
        (N,) ns.
    z
        (N, n) rad/s, NaN: not there.
    rate, acceleration
        Take the results.
    """
    for k in range(len(z)):
        mask = present_in(z[k], z.shape[1])
        find_rate(subsets[mask], z.shape[1], mask, z[k], rate[k])
        take_rate(turning[0], stamp[k], rate[k])
        for a in range(3):
            acceleration[k, a] = turning[0].value[a]


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
    seen: View,
    rows: Mask,
    geometry: Geometry,
    at_rest: tuple[Array, Array],
    degrees: float = np.inf,
) -> NoiseFit:
    """Fit scale and timing terms to samples in motion.

    Parameters
    ----------
    data, seen
        The recording, and how the pipeline sees it.
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
    terms = _terms(data, seen, rows, geometry, std)

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


def _terms(data: Data, seen: View, rows: Mask, geometry: Geometry, std: Array) -> _Terms:
    chosen = np.flatnonzero(rows)
    chosen = chosen[:: len(chosen) // MAX_ROWS + 1]
    V = geometry.parity
    along, turning = seen.rate[chosen] @ geometry.axes.T, seen.acceleration[chosen] @ geometry.axes.T
    return _Terms(
        seen.residual[chosen] @ V.T,
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
