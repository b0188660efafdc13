# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The two halves of a sample: gyros, and accelerometers in units of `PathSettings.natural`.

Both pass the same path. A specific force f enters as the rate f / natural, so that one
set of constants in rad/s serves both. Accelerometers follow the gyros, because their
lever arms need the rate: a unit at r from the first measures ``alpha x r + omega x
(omega x r)`` in addition.
"""

from __future__ import annotations

import math

from fdi_ros.compiling.compiled import compiled
from fdi_ros.core.records import Core, Sample
from fdi_ros.model.samples import Array


@compiled
def give_sample(core: Core, gyros: Core, sample: Sample, half: int) -> None:
    """Fill ``core.given`` with the values of one half of a sample, in units of the path.

    ``gyros`` is the core of the gyros. For the accelerometers, the gyros of the same
    sample must have been processed.
    """
    given, settings = core.given, core.settings
    given.stamp, given.shift = sample.stamp, sample.shift
    for i in range(settings.n):
        if half == 0:
            given.z[i], given.received[i] = sample.z[i], sample.received[i]
        else:
            place = settings.places[i]
            given.z[i], given.received[i] = sample.force[place], sample.felt[place]
    if half == 1:
        if settings.lever:
            take_off_lever_arms(core, gyros, given.z)
        for i in range(settings.n):
            given.z[i] /= settings.natural


@compiled
def take_off_lever_arms(core: Core, gyros: Core, force: Array) -> None:
    """Subtract the accelerations by rotation of the body at each accelerometer, m/s^2."""
    omega, alpha, settings = gyros.last.rate, gyros.acceleration.value, core.settings
    if not math.isfinite(omega[0]):
        return
    for i in range(settings.n):
        arm, axis = settings.arms[i], settings.sensors.axes[i]
        along = omega[0] * arm[0] + omega[1] * arm[1] + omega[2] * arm[2]
        square = omega[0] ** 2 + omega[1] ** 2 + omega[2] ** 2
        for a in range(3):
            b, c = (a + 1) % 3, (a + 2) % 3
            turning = alpha[b] * arm[c] - alpha[c] * arm[b]
            force[i] -= axis[a] * (turning + omega[a] * along - square * arm[a])
