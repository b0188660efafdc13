# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The errors of a healthy channel: additive noise, scale factor, sampling instant, and their guaranteed bound."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from fdi_ros.arrays import Array
from fdi_ros.errors import ConfigError
from fdi_ros.model.geometry import Geometry


class NoiseModel:
    """Error of a healthy channel in one sample.

    The variance of channel i is ``noise_std^2 + (scale_std * rate_i)^2 + (timing_std * accel_i)^2`` with rate_i
    and accel_i the body rate and angular acceleration along the channel's axis.

    Parameters
    ----------
    noise_std
        Standard deviation of the additive error in one sample, rad/s, > 0 (the papers' sigma_0).
    scale_std
        Standard deviation of the scale-factor error, dimensionless, 0 to 1 (sigma_k).
    timing_std
        Standard deviation of the sampling instant, s, 0 to 1; it multiplies the angular acceleration.
    bound
        Guaranteed limit of the error, rad/s, > 0 (the guaranteeing method's sigma); needed by `guaranteed` alone.

    bias_std
        Standard deviation of the bias left after its correction, rad/s, >= 0; it does not average out, so only
        methods that accumulate count it.

    Each is a scalar, or (n,) with one value per channel.

    Raises
    ------
    ConfigError
        If a value is not finite or out of its range.
    """

    def __init__(
        self,
        noise_std: ArrayLike,
        scale_std: ArrayLike = 0.0,
        timing_std: ArrayLike = 0.0,
        bound: ArrayLike | None = None,
        bias_std: ArrayLike = 0.0,
    ) -> None:
        self.noise_std = _checked("noise_std", noise_std, "rad/s", 0.0, np.inf, open_low=True)
        self.scale_std = _checked("scale_std", scale_std, "", 0.0, 1.0)
        self.timing_std = _checked("timing_std", timing_std, "s", 0.0, 1.0)
        self.bound = None if bound is None else _checked("bound", bound, "rad/s", 0.0, np.inf, open_low=True)
        self.bias_std = _checked("bias_std", bias_std, "rad/s", 0.0, np.inf)

    def __repr__(self) -> str:
        return (
            f"NoiseModel(noise_std={self.noise_std}, scale_std={self.scale_std},"
            f" timing_std={self.timing_std}, bound={self.bound}, bias_std={self.bias_std})"
        )

    @property
    def constant(self) -> bool:
        """Whether the variance depends on neither rate nor acceleration."""
        return not (self.scale_std.any() or self.timing_std.any())

    def for_channels(self, n: int) -> NoiseModel:
        """Return the same model with one value per channel.

        Raises
        ------
        ConfigError
            If a value is given per channel for another number of channels than n.
        """
        bound = None if self.bound is None else _spread("bound", self.bound, n)
        return NoiseModel(
            _spread("noise_std", self.noise_std, n),
            _spread("scale_std", self.scale_std, n),
            _spread("timing_std", self.timing_std, n),
            bound,
            _spread("bias_std", self.bias_std, n),
        )

    def subset(self, mask: ArrayLike) -> NoiseModel:
        """Return the model of the channels marked in mask (n,) bool."""
        kept = np.asarray(mask, dtype=bool)
        full = self.for_channels(len(kept))
        bound = None if full.bound is None else full.bound[kept]
        return NoiseModel(full.noise_std[kept], full.scale_std[kept], full.timing_std[kept], bound, full.bias_std[kept])

    def variance(self, geometry: Geometry, rate: Array, acceleration: Array | None = None) -> Array:
        """Error variance of every channel, (N, n) (rad/s)^2.

        Parameters
        ----------
        geometry
            The channels' axes.
        rate
            Body rate, (N, 3) rad/s.
        acceleration
            Body angular acceleration, (N, 3) rad/s^2; None is zero.
        """
        return self.variance_along(geometry, rate @ geometry.axes.T, acceleration)

    def variance_along(self, geometry: Geometry, rate_along: Array, acceleration: Array | None = None) -> Array:
        """Error variance of every channel, (N, n) (rad/s)^2, from the rate along its own axis, (N, n) rad/s."""
        total = rate_along * self.scale_std
        total *= total
        total += self.noise_std * self.noise_std
        if acceleration is not None:
            timing = acceleration @ geometry.axes.T
            timing *= self.timing_std
            timing *= timing
            total += timing
        return total


def _spread(name: str, value: Array, n: int) -> Array:
    if value.ndim == 1 and len(value) not in (1, n):
        raise ConfigError(f"noise.{name} has {len(value)} values, expected 1 or {n} (one per channel)")
    return np.broadcast_to(value, n).copy()


def _checked(name: str, value: ArrayLike, unit: str, low: float, high: float, open_low: bool = False) -> Array:
    array = np.array(value, dtype=np.float64)
    within = (array > low if open_low else array >= low) & (array <= high) & np.isfinite(array)
    if array.ndim > 1 or array.size == 0 or not within.all():
        wrong = array if array.ndim > 1 or array.size == 0 else array[~within].flat[0]
        bound = f"> {low:g}" if open_low else f">= {low:g}"
        upper = "" if high == np.inf else f" and <= {high:g}"
        raise ConfigError(f"noise.{name} is {wrong}{' ' + unit if unit else ''}, expected finite, {bound}{upper}")
    array.flags.writeable = False
    return array
