# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Body rate, angular acceleration and residuals of a recording, as the sample path computes them with given axes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.calibration.data import Array
from fdi_ros.core.acceleration import Acceleration, take_rate
from fdi_ros.core.bank import present_in
from fdi_ros.core.compiled import allocate, compiled
from fdi_ros.core.subsets import find_rate, prepare_subsets
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel


@dataclass(frozen=True)
class Motion:
    """Motion of the body in a recording, and what of the channels it does not explain.

    Attributes
    ----------
    residual
        (N, n) of the least-squares rate, rad/s; NaN where a channel is missing.
    rate, acceleration
        (N, 3) as the sample path computes them, rad/s and rad/s^2.
    """

    residual: Array
    rate: Array
    acceleration: Array


def motion_of(stamp: NDArray[np.int64], z: Array, geometry: Geometry, std: Array, window: float) -> Motion:
    """Compute rate, acceleration and residuals of bias-free channels z (N, n).

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
    return Motion(z - rate @ geometry.axes.T, rate, acceleration)


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
