# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The errors of a healthy channel: additive noise, scale factor, sampling instant, and their guaranteed bound."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from fdi_ros.errors import ConfigError
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.samples import Array


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
        self.noise_std = _checked("noise_std", noise_std, "rad/s", above=True)
        self.scale_std = _checked("scale_std", scale_std, "", 1.0)
        self.timing_std = _checked("timing_std", timing_std, "s", 1.0)
        self.bound = None if bound is None else _checked("bound", bound, "rad/s", above=True)
        self.bias_std = _checked("bias_std", bias_std, "rad/s")

    def __repr__(self) -> str:
        return f"NoiseModel({', '.join(f'{name}={value}' for name, value in vars(self).items())})"

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
        return NoiseModel(**{name: _spread(name, v, n) for name, v in vars(self).items() if v is not None})

    def subset(self, mask: ArrayLike) -> NoiseModel:
        """Return the model of the channels marked in mask (n,) bool."""
        kept = np.asarray(mask, dtype=bool)
        full = vars(self.for_channels(len(kept)))
        return NoiseModel(**{name: value[kept] for name, value in full.items() if value is not None})

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
        total = (rate @ geometry.axes.T * self.scale_std) ** 2 + self.noise_std**2
        if acceleration is not None:
            total += (acceleration @ geometry.axes.T * self.timing_std) ** 2
        return np.asarray(total)


def _spread(name: str, value: Array, n: int) -> Array:
    if value.ndim == 1 and len(value) not in (1, n):
        raise ConfigError(f"noise.{name} has {len(value)} values, expected 1 or {n} (one per channel)")
    return np.broadcast_to(value, n).copy()


def _checked(name: str, value: ArrayLike, unit: str, high: float = np.inf, above: bool = False) -> Array:
    """Return a value from 0 on, or above 0, up to a limit."""
    array = np.array(value, dtype=np.float64)
    within = (array > 0 if above else array >= 0) & (array <= high) & np.isfinite(array)
    if array.ndim > 1 or array.size == 0 or not within.all():
        wrong = array if array.ndim > 1 or array.size == 0 else array[~within].flat[0]
        bounds = ("> 0" if above else ">= 0") + ("" if high == np.inf else f" and <= {high:g}")
        raise ConfigError(f"noise.{name} is {wrong}{' ' + unit if unit else ''}, expected finite, {bounds}")
    array.flags.writeable = False
    return array


MUCH_NOISIER = 3.0
"""Times the noise of every channel of other units; vibration of the body, however mounted, makes up to sqrt(3)."""


def much_noisier(noise: Array, units: Sequence[Sequence[int]]) -> list[tuple[int, float]]:
    """Find channels that are much noisier than every channel of all other units, with the noisiest of these, rad/s.

    ``noise`` (n,) of each channel, rad/s; what is not finite is not compared. ``units``: numbers of the channels of
    each; channels that fail alone are units of one.
    """
    found = []
    for k, unit in enumerate(units):
        others = noise[[i for j, other in enumerate(units) if j != k for i in other]]
        beside = float(others[np.isfinite(others)].max(initial=0.0))
        found += [(int(i), beside) for i in unit if beside > 0.0 and noise[i] > MUCH_NOISIER * beside]
    return found


def noisier_words(
    names: Sequence[str], noise: Array, units: Sequence[Sequence[int]], unit: str = "rad/s", factor: float = 1.0
) -> str:
    """Say which channels are much noisier than the others, with figures; empty: none is.

    ``noise``, ``units`` as `much_noisier` takes them. ``unit``, ``factor``: unit of rates in the words, and how many of
    it are 1 rad/s.
    """
    found = much_noisier(noise, units)
    if not found:
        return ""
    who = ", ".join(f"{names[i]} ({noise[i] * factor:.2g} {unit})" for i, _ in found)
    verb = "is" if len(found) == 1 else "are"
    return f"{who} {verb} much noisier than the other units ({max(beside for _, beside in found) * factor:.2g} at most)"
