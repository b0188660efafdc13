# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Recordings of vehicles with units on random mounts, late stamps and biases that move, and the truth behind them."""

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from fdi_ros.config.config import Config
from fdi_ros.experiments.flight import Motion
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.samples import Array, Block

Rng = np.random.Generator

KINDS = ("rest and turns", "flight with rest", "flight alone")
SCALE, MISALIGNMENT = 0.005, float(np.radians(0.5))
BIAS, WALK, WARMING = 0.02, 2e-5, 5e-6
"""rad/s, rad/s/sqrt(s) and rad/s^2."""
DELAY = 0.04
"""Largest between units, s."""
NOISE, VIBRATION = 0.0025, (0.003, 0.02)
"""Of one sample, rad/s; of vibration the smallest and largest."""
START = 10**18


@dataclass(frozen=True)
class Vehicle:
    """A recording, and the truth behind it."""

    config: Config
    """Nominal mounts."""
    block: Block
    axes: Array
    """(n, 3)."""
    bias: Array
    """(n,) average over the recording, rad/s."""
    late: Array
    """(units,) by how much their stamps are late against those of the first, s."""
    motion: Motion

    @property
    def nominal(self):
        """Axes as configured."""
        return Geometry.from_triads(
            list(np.reshape(self.config.imus.mounts, (-1, 3, 3)))
        )


def turns_by_hand(begins):
    """Knots of turns about every axis, back and forth, some 1 rad/s, with rests between."""
    time, rates = [begins], [np.zeros(3)]
    for axis in np.eye(3):
        for swing in (0.8, -0.8, 1.2, -1.2, 0.0):
            time += [time[-1] + 0.5, time[-1] + 1.2]
            rates += [swing * axis, swing * axis]
        time.append(time[-1] + 2.0)
        rates.append(np.zeros(3))
    return time, rates


def flight(rng, begins, lasts, rate):
    """Knots of a flight: smooth steps between random rates of this size about every axis, 0.3 to 0.9 s each."""
    time, rates = [begins], [np.zeros(3)]
    while time[-1] < begins + lasts:
        time.append(time[-1] + float(rng.uniform(0.3, 0.9)))
        rates.append(rate * rng.standard_normal(3).clip(-2, 2))
    return [*time, time[-1] + 0.5], [*rates, np.zeros(3)]


def vehicle(seed, kind, units=3, sample_rate=100.0):
    """Simulate a vehicle with 2 to 4 units on random mounts, one of `KINDS`, at so many Hz; by a seed."""
    rng = np.random.default_rng([20, seed])
    # Drawn evenly: unit quaternions from four normal numbers, w first.
    turns = (np.roll(rng.standard_normal(4), -1) for _ in range(units - 1))
    mounts = [np.eye(3), *(Rotation.from_quat(turn).as_matrix() for turn in turns)]
    nominal = Geometry.from_triads(mounts)
    n = nominal.n
    across = rng.normal(0, MISALIGNMENT, (n, 3))
    across -= (across * nominal.axes).sum(axis=1)[:, None] * nominal.axes
    axes = (nominal.axes + across) * (1 + rng.normal(0, SCALE, (n, 1)))
    late = np.concatenate([[0.0], rng.uniform(-DELAY, DELAY, units - 1)])
    hand = kind == "rest and turns"
    begins = 0.5 if kind == "flight alone" else 15.0
    time, rates = turns_by_hand(begins) if hand else flight(rng, begins, 60.0, 0.6)
    ends = time[-1] + (0.0 if kind == "flight alone" else 5.0)
    motion = Motion(np.array([0.0, *time]), np.array([np.zeros(3), *rates]))
    t = np.arange(int(ends * sample_rate)) / sample_rate
    z = np.hstack(
        [motion.rate_at(t - late[u]) @ axes[3 * u : 3 * u + 3].T for u in range(units)]
    )
    walk = np.cumsum(WALK / np.sqrt(sample_rate) * rng.standard_normal(z.shape), axis=0)
    bias = rng.normal(0, BIAS, n) + walk + rng.normal(0, WARMING, n) * t[:, None]
    shaken = 0.0 if hand else rng.uniform(*VIBRATION) * ((t > begins) & (t < time[-1]))
    z += bias + np.hypot(NOISE, shaken * np.ones(len(t)))[
        :, None
    ] * rng.standard_normal(z.shape)
    config = Config.from_parameters(
        {
            "input": "imus",
            "imus.topics": [f"/imu_{k + 1}/data_raw" for k in range(units)],
            "imus.mounts": np.concatenate([mount.ravel() for mount in mounts]).tolist(),
            "noise.noise_std": [0.003],
            "noise.timing_std": [5e-4],
            "sample_rate": sample_rate,
        }
    )
    return Vehicle(
        config,
        Block(START + np.round(t * 1e9).astype(np.int64), z),
        axes,
        bias.mean(axis=0),
        late,
        motion,
    )


@dataclass(frozen=True)
class Forces:
    """A recording with accelerometers, and the truth behind them."""

    block: Block
    axes: Array
    """(n, 3) of the accelerometers."""
    bias: Array
    """(n,) m/s^2."""


def with_forces(one, arms, noise=0.05, seed=0):
    """Return the recording of a vehicle with accelerometers, as `forces_of` does."""
    return forces_of(one, arms, noise, seed).block


def turned(steps):
    """Return the attitude before each of the turns (N, 3), rad, each in the body frame of its time."""
    turns = np.vstack([np.zeros(3), steps[:-1]])
    # In rows: the products along all rows at once, and then from row to row.
    width = math.isqrt(len(turns)) + 1
    padded = np.zeros((width * width, 3))
    padded[: len(turns)] = turns
    rows = Rotation.from_rotvec(padded).as_quat().reshape(width, width, 4)
    begins = np.empty((width, 4))
    for k in range(1, width):
        before = Rotation.from_quat(rows[:, k - 1])
        rows[:, k] = (before * Rotation.from_quat(rows[:, k])).as_quat()
    before = Rotation.identity()
    for k, ends in enumerate(rows[:, -1]):
        begins[k] = before.as_quat()
        before = before * Rotation.from_quat(ends)
    first = Rotation.from_quat(np.repeat(begins, width, axis=0)[: len(turns)])
    return first * Rotation.from_quat(rows.reshape(-1, 4)[: len(turns)])


def forces_of(one, arms, noise=0.05, seed=0):
    """Add accelerometers at arms (units, 3), m, to a vehicle; errors of 0.2 m/s^2 and 0.5 %."""
    rng, t = np.random.default_rng([21, seed]), (one.block.stamp - START) * 1e-9
    step, z = 2e-3, np.empty((len(t), len(arms), 3))
    fine = np.arange(-DELAY - 0.01, t[-1] + DELAY + 0.01, step)
    rate = one.motion.rate_at(fine)
    attitude = turned(rate * step).inv().apply([0.0, 0.0, 9.81])
    alpha = np.gradient(rate, step, axis=0)
    axes, bias = np.empty((len(arms), 3, 3)), np.empty((len(arms), 3))
    for k, arm in enumerate(arms):
        force = attitude + np.cross(alpha, arm) + np.cross(rate, np.cross(rate, arm))
        at = np.column_stack([np.interp(t - one.late[k], fine, f) for f in force.T])
        axes[k] = one.axes[3 * k : 3 * k + 3] + rng.normal(0, SCALE, (3, 3))
        bias[k] = rng.normal(0, 0.2, 3)
        z[:, k] = at @ axes[k].T + bias[k]
    z += noise * rng.standard_normal(z.shape)
    force = Block(one.block.stamp, z.reshape(len(t), -1))
    block = replace(one.block, acceleration=force)
    return Forces(block, axes.reshape(-1, 3), bias.ravel())
