# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Calibration of simulated units whose truth is known: its errors in fact, and against the errors that it states."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fdi_ros.calibration.calibrate import calibrate
from fdi_ros.calibration.result import Calibration
from fdi_ros.config.config import Config
from fdi_ros.experiments.simulate import GyroErrors, regular_stamps, vehicle_motion
from fdi_ros.model.block import Block
from fdi_ros.model.geometry import Geometry

Array = NDArray[np.float64]

ERRORS = GyroErrors(scale_std=0.01, misalignment_std=float(np.radians(1)), bias_walk=0.0, delay_std=0.0005)
"""Scale 1 %, misalignment 1 deg, delay 0.5 ms; the walk is added outside, where its mean is known."""
WALK = 2e-5
"""Random walk of the biases, rad/s per square root of a second."""
SAMPLE_RATE = 100.0
"""Hz."""


@dataclass(frozen=True)
class Unit:
    """A recording of simulated triads, and the truth behind it."""

    config: Config
    """Nominal mounts."""
    block: Block
    axes: Array
    """(n, 3) relative to the first triad, which is taken for nominal: all that can be known."""
    bias: Array
    """(n,) average over the recording, rad/s."""
    delay: Array
    """(triads - 1,) by how much their stamps are late against those of the first triad, s."""


@dataclass(frozen=True)
class Trial:
    """Errors of one calibration; those ending in _in_errors are in units of the stated standard errors."""

    calibration: Calibration
    angle: Array
    """(n - 3,) between calibrated and true axes, rad."""
    scale: Array
    """(n - 3,) relative error of the scale factors."""
    axes_in_errors: Array
    bias_in_errors: Array
    delay_in_errors: Array


def simulated_unit(seed: int, duration: float = 120.0, triads: int = 2, errors: GyroErrors = ERRORS) -> Unit:
    """Simulate triads on random mounts, moved as a small vehicle moves.

    Parameters
    ----------
    seed
        The same seed gives the same recording.
    duration
        s.
    triads
        2 to 4.
    errors
        Of the gyros.
    """
    rng = np.random.default_rng([2019, seed])
    mounts = [np.eye(3), *(_random_rotation(rng) for _ in range(triads - 1))]
    nominal = Geometry.from_triads(mounts)
    gyros = errors.draw(nominal, rng)
    stamp = regular_stamps(duration, SAMPLE_RATE)
    block = gyros.measure(vehicle_motion(duration, rng), stamp, rng)
    walk = np.cumsum(WALK / np.sqrt(SAMPLE_RATE) * rng.standard_normal(block.z.shape), axis=0)
    config = Config.from_parameters(
        {
            "input": "imus",
            "imus.topics": [f"imu_{k + 1}/data_raw" for k in range(triads)],
            "imus.mounts": np.concatenate([mount.ravel() for mount in mounts]).tolist(),
            "noise.noise_std": [0.003],
            "sample_rate": SAMPLE_RATE,
        }
    )
    relative = gyros.axes @ np.linalg.inv(gyros.axes[:3]) @ nominal.axes[:3]
    delay = gyros.delay[0] - gyros.delay[3::3]  # measured later than stamped: the stamps are early
    return Unit(config, Block(stamp, block.z + walk), relative, gyros.bias + walk.mean(axis=0), delay)


def run_trial(seed: int, duration: float = 120.0, triads: int = 2) -> Trial:
    """Calibrate one simulated unit and compare with the truth."""
    unit = simulated_unit(seed, duration, triads)
    result = calibrate(unit.block, unit.config)
    off, true = (result.axes - unit.axes)[3:], unit.axes[3:]
    norm = np.linalg.norm(true, axis=1)
    along = (off * true).sum(axis=1) / norm
    across = np.linalg.norm(off - (along / norm)[:, None] * true, axis=1)
    stated = np.sqrt(np.diagonal(result.axes_covariance, axis1=1, axis2=2)[3:])
    return Trial(
        result,
        across / norm,
        along / norm,
        (off / stated).ravel(),
        (result.bias.mean - unit.bias) / result.bias.std,
        np.array([(d.value - true) / d.error for d, true in zip(result.delays, unit.delay, strict=True)]),
    )


def _random_rotation(rng: np.random.Generator) -> Array:
    """Rotation (3, 3) drawn evenly: a unit quaternion from four normal numbers."""
    w, x, y, z = (q := rng.standard_normal(4)) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
