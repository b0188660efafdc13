# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Information about the errors of channels after elimination of the body rate.

With values ``y = H w + d``, errors d of covariance M, and the prior N(0, K^-1) of the
rate w, K = k I:

    A = W - W H (H' W H + K)^-1 H' W,    W = M^-1,        G = (H' W H + K)^-1 H' W.

A is the information about d from the redundancy (a projector if M = I and k = 0), and G
is the gain of weighted least squares. No basis of the null space is needed. For an
absent channel the row is left out: rows and columns of channels outside a set are zero.
"""

from __future__ import annotations

from fdi_ros.compiling.compiled import Symmetric, Vector, compiled
from fdi_ros.core.algebra import along, dot, invert
from fdi_ros.core.records import Parity, Sensors
from fdi_ros.model.samples import MAX_RATE, Array

#: k of an unknown rate. It is not zero, so that an unmeasured axis has an inverse.
UNKNOWN_RATE = 1.0 / MAX_RATE**2
#: Smallest share of a channel's variance that must remain in its residual. Below it no
#: residual shows the channel, and no method judges it.
LEAST_IN_RESIDUAL = 1e-3


@compiled
def update_normal(
    parity: Parity, n: int, axes: Array, prior_information: float
) -> None:
    """Calculate W H, and the lower triangle of ``H' W H + K``."""
    for i in range(n):
        for a in range(3):
            parity.weighted[i, a] = dot(parity.weight[i], axes[:, a], n)
    for a in range(3):
        for b in range(a + 1):
            total = prior_information if a == b else 0.0
            for i in range(n):
                total += axes[i, a] * parity.weighted[i, b]
            parity.normal[a, b] = total


@compiled
def eliminate_rate(
    parity: Parity, n: int, axes: Array, prior_information: float
) -> float:
    """Calculate A and G from W; return the log of the determinant of H' W H + K.

    ``prior_information`` is k, s^2/rad^2.
    """
    update_normal(parity, n, axes, prior_information)
    log_det = invert(parity.normal, 3, parity.inverse)
    for a in range(3):
        for i in range(n):
            parity.gain[a, i] = along(parity.inverse[a], parity.weighted[i])
    for i in range(n):
        for j in range(i + 1):
            total = parity.weight[i, j]
            for a in range(3):
                total -= parity.weighted[i, a] * parity.gain[a, j]
            parity.information[i, j] = parity.information[j, i] = total
    return log_det


@compiled
def fill_parity(parity: Parity, sensors: Sensors, mask: int, variance: Array) -> None:
    """Calculate A and G for independent errors of an unknown rate.

    ``variance`` (n,) contains the variances of the errors, (rad/s)^2.
    """
    n = sensors.n
    for i in range(n):
        for j in range(n):
            parity.weight[i, j] = 0.0
        if mask >> i & 1:
            parity.weight[i, i] = 1.0 / variance[i]
    eliminate_rate(parity, n, sensors.axes, UNKNOWN_RATE)


@compiled
def fill_joint_parity(
    parity: Parity,
    sensors: Sensors,
    mask: int,
    covariance: Array,
    prior_information: float,
) -> float:
    """Calculate A and G for correlated errors; return the log of the determinants of M and of H' W H + K.

    ``covariance`` (n, n) of the errors, (rad/s)^2, and ``prior_information`` the prior
    information k of the rate, s^2/rad^2.
    """
    n = sensors.n
    count = 0
    for i in range(n):
        if mask >> i & 1:
            parity.place[count] = i
            count += 1
            for q in range(count):
                parity.information[count - 1, q] = covariance[i, parity.place[q]]
    log_det = invert(parity.information, count, parity.weight)
    for p in range(count):
        for q in range(count):
            parity.information[p, q] = parity.weight[p, q]
    for i in range(n):
        for j in range(n):
            parity.weight[i, j] = 0.0
    for p in range(count):
        for q in range(count):
            parity.weight[parity.place[p], parity.place[q]] = parity.information[p, q]
    return log_det + eliminate_rate(parity, n, sensors.axes, prior_information)


@compiled
def gained_rate(gain: Array, values: Array, n: int) -> float:
    """Return the rate about one axis from its gains (n,) and values (n,), rad/s.

    Values with zero gain may be NaN.
    """
    total = 0.0
    for i in range(n):
        if gain[i] != 0.0:
            total += gain[i] * values[i]
    return total


@compiled
def apply_gain(gain: Array, n: int, values: Array, rate: Vector) -> None:
    """Write the rate (3,) of values (n,), rad/s. Values with zero gain may be NaN."""
    for a in range(3):
        rate[a] = gained_rate(gain[a], values, n)


@compiled
def covariance_of(
    gain: Array, n: int, variance: Array, together: Array, out: Symmetric
) -> None:
    """Write the covariance G (diag(variance) + together) G' of a rate, (rad/s)^2.

    ``out`` (6,) receives the upper triangle.
    """
    k = 0
    for a in range(3):
        for b in range(a, 3):
            total = 0.0
            for i in range(n):
                if gain[a, i] != 0.0 or gain[b, i] != 0.0:
                    total += gain[a, i] * gain[b, i] * variance[i]
                    total += gain[a, i] * dot(gain[b], together[i], n)
            out[k] = total
            k += 1
