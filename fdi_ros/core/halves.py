# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The two halves of a sample: gyros, and accelerometers in units of `PathSettings.natural`.

Both pass the same path. A specific force f enters as the rate f / natural, so that one
set of constants in rad/s serves both. Accelerometers follow the gyros, because their
lever arms need the rate: a unit at r from the first measures ``alpha x r + omega x
(omega x r)`` in addition. In samples without a sure rate this is unknown, and such units
are hidden: neither judged nor fused.
"""

from __future__ import annotations

import math

from fdi_ros.compiling.compiled import Vector, compiled
from fdi_ros.core.acceleration import differentiate_rate
from fdi_ros.core.algebra import along, square
from fdi_ros.core.records import Core, PathSettings, Sample, Turning
from fdi_ros.core.repeated import is_at_rest

TURN_TIME = 0.05
"""Time constant of the rotation that displaces accelerometers, s: a block and a little more.
The derivative of single samples is mostly noise."""
SLACK_SAMPLES = 2.0
"""Samples by which the difference of two rates may be longer than its window, because of
the distance of samples and one lost sample."""


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
            given.z[i] = sample.force[place] / settings.natural
            given.received[i] = sample.felt[place]
    if half == 1:
        follow_turn(core, gyros, sample.stamp)
        give_delays(core, gyros)
        fill_parts(core)
        for a in range(3):
            core.sample.spin[a] = core.turning.newest[a]
        for i in range(settings.n):
            core.sample.position_std[i] = settings.position_std[i]
            core.sample.displaced[i] = displaced_variance(core, i)


@compiled
def give_delays(core: Core, gyros: Core) -> None:
    """Give the accelerometers the delays of their units by the gyros, against their first unit."""
    estimate = gyros.sample.estimate
    first = unit_of_place(core, gyros, 0)
    for u in range(core.settings.units):
        unit = unit_of_place(core, gyros, u)
        variance = estimate.delay_variance[unit] + estimate.delay_variance[first]
        core.sample.delay[u] = estimate.delay[unit] - estimate.delay[first]
        core.sample.delay_variance[u] = variance if estimate.is_current else 0.0


@compiled
def unit_of_place(core: Core, gyros: Core, u: int) -> int:
    """Return the number of unit u of the accelerometers among the units of the gyros."""
    for i in range(core.settings.n):
        if core.settings.members[u] >> i & 1:
            for unit in range(gyros.settings.units):
                if gyros.settings.members[unit] >> core.settings.places[i] & 1:
                    return unit
    return 0


@compiled
def give_force(core: Core, accelerometers: Core) -> None:
    """Give the gyros the fused specific force of the sample before."""
    last = accelerometers.last
    core.sample.has_force = last.valid
    for a in range(3):
        core.sample.force[a] = accelerometers.settings.natural * last.rate[a]


@compiled
def follow_turn(core: Core, gyros: Core, stamp: int) -> None:
    """Follow the rotation of the body with the fused rate of the gyros in the same sample."""
    turning = core.turning
    rate = gyros.last.rate
    since = (stamp - turning.stamp) * 1e-9
    turning.stamp = stamp
    is_measured = measures_turn(core, gyros)
    for a in range(3):
        turning.usable[a] = rate[a] if is_measured else math.nan
    turning.unsmoothed.window = gyros.acceleration.window
    differentiate_rate(turning.unsmoothed, stamp, turning.usable)
    turning.known = is_measured and spans_no_hole(core.settings, turning, stamp)
    if not math.isfinite(rate[0]):
        return
    for a in range(3):
        turning.newest[a] = rate[a]
        step = rate[a] - turning.rate[a]
        turning.rate[a] += step * min(since / TURN_TIME, 1.0)
        turning.acceleration[a] = step / TURN_TIME if since < TURN_TIME else 0.0


@compiled
def measures_turn(core: Core, gyros: Core) -> bool:
    """Whether the fused rate is of this sample, and sure enough for the lever arms.

    An error e of the rate changes what a turn omega adds at a distance r by up to
    ``(2 omega + e) e r``. This must be less than the noise of the accelerometer.
    """
    if not gyros.last.valid or not is_new(gyros):
        return False
    settings = core.settings
    rate = gyros.last.rate
    covariance = gyros.last.covariance
    doubt = covariance[0] + covariance[3] + covariance[5]
    error = doubt * (4.0 * square(rate) + doubt) / settings.natural**2
    for i in range(settings.n):
        expected = settings.sensors.noise_std[i]
        noise = max(expected * expected, core.sample.estimate.variance[i])
        if error * square(settings.arms[i]) > noise:
            return False
    return True


@compiled
def is_new(gyros: Core) -> bool:
    """Whether the fused rate has a new value, or the vehicle rests, where values may repeat."""
    now = gyros.now
    for i in range(gyros.settings.n):
        changed = gyros.health.run_stamp[i] == gyros.last.stamp
        if now.fused >> i & 1 and changed:
            return True
    return is_at_rest(gyros.settings, now) and not now.all_repeat


@compiled
def spans_no_hole(settings: PathSettings, turning: Turning, stamp: int) -> bool:
    """Whether the angular acceleration is a difference over its window, and not over a hole."""
    longest = turning.unsmoothed.window + round(SLACK_SAMPLES * 1e9 * settings.period)
    since = stamp - turning.unsmoothed.last_rate.stamp
    return turning.unsmoothed.has_last_rate == 1 and since <= longest


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
def fill_parts(core: Core) -> None:
    """Calculate what the rotation of the body adds to each accelerometer.

    If the rotation is not known, all accelerometers away from the first unit are hidden,
    also those of unknown position: what it adds is no fault.
    """
    turning = core.turning
    settings = core.settings
    turning.hidden = 0
    for i in range(settings.n):
        arm = settings.arms[i]
        turning.part[i] = 0.0
        if turning.known:
            turning.part[i] = added_by_turn(turning, arm, settings.sensors.axes[i])
            turning.part[i] /= settings.natural
        elif square(arm) > 0.0 or settings.position_std[i] > 0.0:
            turning.hidden |= 1 << i


@compiled
def added_by_turn(turning: Turning, arm: Vector, axis: Vector) -> float:
    """Return the acceleration by rotation of the body at a position (3,), along an axis (3,), m/s^2."""
    omega = turning.usable
    alpha = turning.unsmoothed.value
    inward = along(omega, arm)
    speed = square(omega)
    added = 0.0
    for a in range(3):
        b = (a + 1) % 3
        c = (a + 2) % 3
        turn = alpha[b] * arm[c] - alpha[c] * arm[b]
        added += axis[a] * (turn + omega[a] * inward - speed * arm[a])
    return float(added)
