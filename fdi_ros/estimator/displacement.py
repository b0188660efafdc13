# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What turns of the body add to accelerometers whose positions are not known.

An accelerometer of axis h at r from the first unit measures ``r . v`` more, with ``v = h
x alpha + omega (omega . h) - omega^2 h``. The channels of one unit have one r, so their
errors are correlated. The mean of a channel contains the mean of v, in which alpha is
the change of the rate over that time: little remains of a turn back and forth. For
single samples alpha is mostly noise, so the recent peak of the variance is used
instead.
"""

from __future__ import annotations

from fdi_ros.compiling.compiled import Square, Vector, compiled
from fdi_ros.core.records import Matrix, SampleInput
from fdi_ros.estimator.estimator import Constants, Estimator, Total, update_weights
from fdi_ros.model.samples import Array

# growth of the variance of a sample by unknown positions, from which it counts at once:
# more than the peak fades from block to block
DISPLACED = 0.3
EDGES = 3.0
"""Blocks of motion by which a mean of the gyros and one of the accelerometers may differ at
their ends: filters and sampling instants are not the same."""


@compiled
def follow_displacement(params: Constants, kf: Estimator, sample: SampleInput) -> None:
    """Follow the variance by unknown positions, and the turn of the body. A turn that begins counts at once."""
    n = params.sensors.n
    lasting = 2.0 * params.length
    begins = False
    kf.may_be_apart = False
    for i in range(n):
        kf.position_std[i] = sample.position_std[i]
        kf.may_be_apart = kf.may_be_apart or sample.position_std[i] > 0.0
    if not kf.may_be_apart:
        return
    spin = sample.spin
    turned = kf.total.turned
    speed = spin[0] ** 2 + spin[1] ** 2 + spin[2] ** 2
    for a in range(3):
        kf.total.spin[a] = spin[a]
        kf.spin_sum[a] += spin[a]
        turned[a, a] -= speed
        for b in range(3):
            turned[a, b] += spin[a] * spin[b]
    for i in range(n):
        kf.displaced[i] = max(kf.displaced[i], sample.displaced[i])
        known = kf.noise.now.sample[i] + lasting * kf.allowed[i]
        grown = lasting * (kf.displaced[i] - kf.allowed[i])
        begins = begins or grown > DISPLACED * known
    if not begins:
        return
    for i in range(n):
        kf.at.covariance[i, i] += kf.displaced[i] - kf.allowed[i]
        kf.allowed[i] = kf.displaced[i]
    update_weights(params, kf)


@compiled
def close_turn(params: Constants, kf: Estimator) -> None:
    """Take the mean rate of the gyros over a block that is complete."""
    for a in range(3):
        kf.spins[2, a] = kf.spins[1, a]
        kf.spins[1, a] = kf.spins[0, a]
        kf.spins[0, a] = kf.spin_sum[a] / params.length
        kf.spin_sum[a] = 0.0


@compiled
def add_displacement_of_block(
    params: Constants, kf: Estimator, covariance: Square
) -> None:
    """Add the covariance of the mean of the block before by unknown positions, (rad/s)^2."""
    if not kf.may_be_apart:
        return
    ahead = kf.times[0] - kf.times[1]
    behind = kf.times[1] - kf.times[2]
    spin = kf.spins[1]
    speed = spin[0] ** 2 + spin[1] ** 2 + spin[2] ** 2
    for a in range(3):
        after = (kf.spins[0, a] - kf.spins[1, a]) / ahead
        before = (kf.spins[1, a] - kf.spins[2, a]) / behind
        kf.spin_change[a] = 0.5 * (after + before)
        kf.unresolved[a] = 0.5 * (after - before)
        for b in range(3):
            of_axis = speed if a == b else 0.0
            kf.turned[a, b] = spin[a] * spin[b] - of_axis
    add_displacement(params, kf, kf.turned, kf.spin_change, covariance)
    for i in range(params.sensors.n):
        # Motion faster than blocks reaches the accelerometers in its own way.
        h = params.sensors.axes[i]
        square = 0.0
        for a in range(3):
            b = (a + 1) % 3
            c = (a + 2) % 3
            by = h[b] * kf.unresolved[c] - h[c] * kf.unresolved[b]
            square += by * by
        covariance[i, i] += kf.position_std[i] ** 2 * square


@compiled
def add_displacement_of_mean(
    params: Constants, kf: Estimator, before: Total, size: int, covariance: Square
) -> None:
    """Add the covariance of the mean of the last ``size`` samples by unknown positions, (rad/s)^2.

    ``before``: sums of all samples before them.
    """
    if not kf.may_be_apart:
        return
    for a in range(3):
        change = kf.total.spin[a] - before.spin[a]
        kf.spin_change[a] = change / (size * params.period)
        for b in range(3):
            turned = kf.total.turned[a, b] - before.turned[a, b]
            kf.turned[a, b] = turned / size
    add_displacement(params, kf, kf.turned, kf.spin_change, covariance)
    edges = min(1.0, EDGES * params.length / size)
    for i in range(params.sensors.n):
        covariance[i, i] += kf.displaced[i] * edges * edges


@compiled
def add_displacement(
    params: Constants, kf: Estimator, turned: Matrix, change: Vector, covariance: Array
) -> None:
    """Add the covariance by unknown positions in a turn.

    ``turned``: centripetal part (3, 3), rad^2/s^2; ``change``: angular acceleration (3,),
    rad/s^2; ``covariance``: (n, n), (rad/s)^2.
    """
    n = params.sensors.n
    axes = params.sensors.axes
    for i in range(n):
        for a in range(3):
            b = (a + 1) % 3
            c = (a + 2) % 3
            by = axes[i, b] * change[c] - axes[i, c] * change[b]
            for k in range(3):
                by += axes[i, k] * turned[k, a]
            kf.displacement[i, a] = kf.position_std[i] * by
        for j in range(i + 1):
            in_one_unit = params.units > 1 and params.unit[i] == params.unit[j]
            if i == j or in_one_unit:
                common = 0.0
                for a in range(3):
                    common += kf.displacement[i, a] * kf.displacement[j, a]
                covariance[i, j] += common
                if i != j:
                    covariance[j, i] += common
