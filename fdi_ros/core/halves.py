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

from fdi_ros.compiling.compiled import Vector, compiled
from fdi_ros.core.records import Core, Sample, Turning
from fdi_ros.model.samples import Array

TURN_TIME = 0.05
"""Time constant of the rotation that displaces accelerometers, s: a block and a little more.
The derivative of single samples is mostly noise."""


@compiled
def give_sample(core: Core, gyros: Core, sample: Sample, half: int) -> None:
    """Fill ``core.given`` with the values of one half of a sample, in units of the path.

    ``gyros`` is the core of the gyros. For the accelerometers, the gyros of the same
    sample must have been processed.
    """
    given = core.given
    settings = core.settings
    given.stamp = sample.stamp
    given.shift = sample.shift
    for i in range(settings.n):
        if half == 0:
            given.z[i] = sample.z[i]
            given.received[i] = sample.received[i]
        else:
            place = settings.places[i]
            given.z[i] = sample.force[place]
            given.received[i] = sample.felt[place]
    if half == 1:
        if settings.lever:
            take_off_lever_arms(core, gyros, given.z)
        follow_turn(core.turning, gyros.last.rate, sample.stamp)
        for a in range(3):
            core.sample.spin[a] = core.turning.newest[a]
        for i in range(settings.n):
            given.z[i] /= settings.natural
            core.sample.position_std[i] = settings.position_std[i]
            core.sample.displaced[i] = displaced_variance(core, i)


@compiled
def give_force(core: Core, accelerometers: Core) -> None:
    """Give the gyros the fused specific force of the sample before."""
    last = accelerometers.last
    core.sample.has_force = last.valid
    for a in range(3):
        core.sample.force[a] = accelerometers.settings.natural * last.rate[a]


@compiled
def follow_turn(turning: Turning, rate: Vector, stamp: int) -> None:
    """Follow the rotation of the body with the fused rate (3,) of a sample, rad/s."""
    since = (stamp - turning.stamp) * 1e-9
    turning.stamp = stamp
    if not math.isfinite(rate[0]):
        return
    for a in range(3):
        turning.newest[a] = rate[a]
        step = rate[a] - turning.rate[a]
        turning.rate[a] += step * min(since / TURN_TIME, 1.0)
        turning.acceleration[a] = step / TURN_TIME if since < TURN_TIME else 0.0


@compiled
def displaced_variance(core: Core, i: int) -> float:
    """Variance of accelerometer i by what is unknown of its position, (m/s^2)^2 over natural^2.

    A displacement r adds ``r . v`` along the axis h, with ``v = h x alpha + omega
    (omega . h) - omega^2 h``.
    """
    settings = core.settings
    turning = core.turning
    std = settings.position_std[i]
    if std == 0.0:
        return 0.0
    omega = turning.rate
    alpha = turning.acceleration
    h = settings.sensors.axes[i]
    along = omega[0] * h[0] + omega[1] * h[1] + omega[2] * h[2]
    speed = omega[0] ** 2 + omega[1] ** 2 + omega[2] ** 2
    square = 0.0
    for a in range(3):
        b = (a + 1) % 3
        c = (a + 2) % 3
        by = h[b] * alpha[c] - h[c] * alpha[b] + omega[a] * along - speed * h[a]
        square += by * by
    return float(std * std * square)


@compiled
def take_off_lever_arms(core: Core, gyros: Core, force: Array) -> None:
    """Subtract the accelerations by rotation of the body at each accelerometer, m/s^2."""
    omega = gyros.last.rate
    alpha = gyros.acceleration.value
    settings = core.settings
    if not math.isfinite(omega[0]):
        return
    for i in range(settings.n):
        arm = settings.arms[i]
        axis = settings.sensors.axes[i]
        along = omega[0] * arm[0] + omega[1] * arm[1] + omega[2] * arm[2]
        square = omega[0] ** 2 + omega[1] ** 2 + omega[2] ** 2
        for a in range(3):
            b = (a + 1) % 3
            c = (a + 2) % 3
            turning = alpha[b] * arm[c] - alpha[c] * arm[b]
            force[i] -= axis[a] * (turning + omega[a] * along - square * arm[a])
