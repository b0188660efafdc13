# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Error model of the channels for all methods."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import compiled
from fdi_ros.core.algebra import along
from fdi_ros.core.records import Sensors
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel


@compiled
def variance_of(
    sensors: Sensors, i: int, rate_along: float, acceleration: NDArray[np.float64]
) -> float:
    """Return the error variance of a channel, (rad/s)^2, at a rate along its axis, rad/s."""
    scale = sensors.scale_std[i] * rate_along
    timing = sensors.timing_std[i] * along(sensors.axes[i], acceleration)
    return sensors.noise_std[i] * sensors.noise_std[i] + scale * scale + timing * timing


def describe_sensors(sensors: Any, geometry: Geometry, noise: NoiseModel) -> None:
    """Fill a record of `Sensors` from noise with one value per channel."""
    n = geometry.n
    sensors["n"] = n
    sensors["constant"] = noise.constant
    sensors["axes"][:n] = geometry.axes
    sensors["gain"][:n] = geometry.least_squares.T
    for name in ("noise_std", "scale_std", "timing_std"):
        sensors[name][:n] = getattr(noise, name)
    sensors["share"][:n] = np.diag(geometry.S)
    sensors["detectable"][:n] = geometry.detectable
    sensors["alike"][:n, :n] = geometry.group_matrix
