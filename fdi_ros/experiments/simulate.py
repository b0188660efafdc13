# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Simulated flights: vehicle motion, gyros with the errors of real ones, and the truth behind them.

Measurement of channel i at time t, in this order:

    z_i(t) = round(clip(h_i . omega(t + delay_i) + bias_i + walk_i(t) + noise_i(t)))

h_i (3,) is the true axis: the nominal one, turned by the misalignment and lengthened by the scale factor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fdi_ros.model.geometry import Geometry
from fdi_ros.model.samples import Array, Block

STEEPEST = 1.5  # largest slope of the smooth step 3 u^2 - 2 u^3, at its middle


@dataclass(frozen=True)
class Motion:
    """Body rate as a smooth function of time: holds and smooth steps between knots."""

    time: Array  # knots, (K,) s, strictly increasing
    rate: Array  # body rate at the knots, (K, 3) rad/s. It stays what it is before the first and after the last.

    def rate_at(self, t: Array) -> Array:
        """Body rate (N, 3) rad/s at times t (N,) s."""
        k = np.clip(np.searchsorted(self.time, t, side="right") - 1, 0, len(self.time) - 2)
        u = np.clip((t - self.time[k]) / (self.time[k + 1] - self.time[k]), 0, 1)
        return self.rate[k] + (self.rate[k + 1] - self.rate[k]) * (u * u * (3 - 2 * u))[:, None]


def vehicle_motion(
    duration: float,
    rng: np.random.Generator,
    *,
    rest: float = 6.0,
    max_rate: float = 2.0,
    max_acceleration: float = 20.0,
) -> Motion:
    """Motion of a small vehicle: a rest at the start, then rests, slow turns and fast manoeuvres as they come.

    It ends at rest after about ``duration``, s; the first rest takes ``rest``, s. ``max_rate``: largest rate of a
    component in a fast manoeuvre, rad/s; slow turns reach 0.15 of it. ``max_acceleration``: largest angular
    acceleration of a component, rad/s^2.
    """
    times: list[float] = [0.0, rest]
    rates: list[Array] = [np.zeros(3), np.zeros(3)]
    while times[-1] < duration:
        kind = rng.choice(["rest", "turn", "manoeuvre"], p=[0.25, 0.35, 0.4])
        for target, hold in _phase(str(kind), max_rate, rng):
            step = float(np.abs(target - rates[-1]).max())
            slowest = 1.0 if kind == "turn" else 0.1
            times += [times[-1] + max(slowest, STEEPEST * step / max_acceleration)]
            times += [times[-1] + hold]
            rates += [target, target]
    return Motion(np.array(times), np.array(rates))


def _phase(kind: str, max_rate: float, rng: np.random.Generator) -> list[tuple[Array, float]]:
    """Rates to go to and how long to hold each, s; ends at rest."""
    stop = (np.zeros(3), float(rng.uniform(0.2, 0.6)))
    if kind == "rest":
        return [(np.zeros(3), float(rng.uniform(1.0, 3.0)))]
    if kind == "turn":
        # Mostly about the vertical, as vehicles turn.
        heading = rng.uniform(-0.15, 0.15, 3) * max_rate * [0.3, 0.3, 1.0]
        return [(heading, float(rng.uniform(1.0, 3.0))), stop]
    count = int(rng.integers(3, 7))
    swings = [(rng.uniform(-max_rate, max_rate, 3), float(rng.uniform(0.02, 0.3))) for _ in range(count)]
    return [*swings, stop]


@dataclass(frozen=True)
class GyroErrors:
    """How far gyros of one make differ from ideal ones; the defaults are those of a small MEMS unit."""

    noise_std: float = 0.0025  # white noise of one sample, rad/s
    bias_std: float = 0.01  # bias at switch-on, rad/s
    bias_walk: float = 2e-5  # random walk of the bias, rad/s per square root of a second
    scale_std: float = 0.001  # scale factor, dimensionless
    misalignment_std: float = 0.001  # angle between true and nominal axis, rad, in each of the two directions across it
    delay_std: float = 0.0002  # sampling instant of a chip against the stamp, s
    resolution: float = float(np.radians(1 / 16.4))  # step of the converter, rad/s; 0: none
    max_rate: float = 34.9  # range of the converter, rad/s
    channels_per_chip: int = 3  # channels that are sampled together

    def draw(self, geometry: Geometry, rng: np.random.Generator) -> Gyros:
        """Make one unit: draw all that stays as it is from switch-on."""
        n = geometry.n
        across = rng.normal(0, self.misalignment_std, (n, 3))
        along = np.sum(across * geometry.axes, axis=1) / np.sum(geometry.axes**2, axis=1)
        tilted = geometry.axes + across - along[:, None] * geometry.axes
        chip = np.arange(n) // self.channels_per_chip
        return Gyros(
            axes=tilted * (1 + rng.normal(0, self.scale_std, (n, 1))),
            bias=rng.normal(0, self.bias_std, n),
            delay=rng.normal(0, self.delay_std, n)[chip],
            errors=self,
        )


@dataclass(frozen=True)
class Gyros:
    """One made unit: its true axes (n, 3), bias (n,) rad/s and sampling delay (n,) s."""

    axes: Array
    bias: Array
    delay: Array
    errors: GyroErrors

    def measure(self, motion: Motion, stamp: NDArray[np.int64], rng: np.random.Generator) -> Block:
        """Sample at the given stamps, (N,) ns, strictly increasing; the motion's time is 0 at the first."""
        errors = self.errors
        seconds = (stamp - stamp[0]) * 1e-9
        z: Array = np.empty((len(stamp), len(self.axes)))
        for delay in np.unique(self.delay):
            chip = np.flatnonzero(self.delay == delay)
            z[:, chip] = motion.rate_at(seconds + delay) @ self.axes[chip].T
        step = np.sqrt(np.diff(seconds, prepend=0.0))[:, None]
        walk = np.cumsum(errors.bias_walk * step * rng.standard_normal(z.shape), axis=0)
        z += self.bias + walk + errors.noise_std * rng.standard_normal(z.shape)
        np.clip(z, -errors.max_rate, errors.max_rate, out=z)
        if errors.resolution:
            z = np.round(z / errors.resolution) * errors.resolution
        return Block(stamp, z)


def regular_stamps(duration: float, sample_rate: float, start: int = 0) -> NDArray[np.int64]:
    """Stamps of evenly spaced samples, (N,) ns, from start ns."""
    count = int(np.floor(duration * sample_rate)) + 1
    return start + np.round(np.arange(count) * (1e9 / sample_rate)).astype(np.int64)
