# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The protection level where a name, or a set, may be wrong: other channels may be faulty in place of those left out.

D are channels that are left out as faulty, W those fused and D together, all of which give a value. A rival h says that
D is healthy and that one or two others, R, are faulty. With u = A z and gain G of W (`fdi_ros.core.parity`), its error
and rate are those of solution separation (`fdi_ros.monitor.integrity`):

    f_h = A_RR^-1 u_R,    x_h = G z - G_R f_h,    P_h = P_W + G_R A_RR^-1 G_R',    chi_h = z' A z - u_R' f_h.

Against the name its odds in this sample are ``o_h exp(-(chi_h - chi_0) / 2)``, o_h those of its faults beside a single
one. So the level of an axis is at least ``|x_0 - x_h| + q sigma_h``, with the Chernoff bound ``Q(q) <= exp(-q^2 / 2)``
on the risk shared by all rivals. Samples are judged one by one: what others have shown before makes no rival unlikely.
"""

from __future__ import annotations

import math

from fdi_ros.compiling.compiled import compiled
from fdi_ros.core.parity import UNKNOWN_RATE, compute_weights, eliminate_rate
from fdi_ros.core.records import Core, Parity
from fdi_ros.model.samples import Array

APART = 1e-3
"""Least share of a channel's own variance in its parity, and of A_ii A_jj in the determinant of two: else no residual
shows them, or they look alike and one is enough."""


@compiled
def cover_rivals(core: Core) -> None:
    """Raise ``core.last.level`` to what holds if a name or the set is wrong; the covariance of the sample is known."""
    now, decision, n = core.now, core.decision, core.settings.n
    update_parity(core, now.fused)
    chi = chi_of(now.parity, n, now.fused, now.corrected)
    for i in range(n):
        if decision.faulty >> i & 1 and now.plain >> i & 1:
            cover(core, 1 << i, chi)
    doubted = decision.ambiguous
    if doubted and not doubted & (now.fused | ~now.plain):
        cover(core, doubted, chi)


@compiled
def update_parity(core: Core, mask: int) -> None:
    """Work out the parity of the channels in mask."""
    compute_weights(core.now.parity, core.settings.n, mask, core.now.uncertainty)
    eliminate_rate(core.now.parity, core.settings.n, core.settings.sensors.axes, UNKNOWN_RATE)


@compiled
def chi_of(parity: Parity, n: int, mask: int, z: Array) -> float:
    """Chi-square z' A z of the channels in mask."""
    total = 0.0
    for i in range(n):
        for j in range(n):
            if mask >> i & 1 and mask >> j & 1:
                total += z[i] * parity.information[i, j] * z[j]
    return total


@compiled
def cover(core: Core, out: int, chi: float) -> None:
    """Raise the level to what holds if the channels in ``out`` are healthy, and one or two of those fused are not.

    chi: chi-square of those fused.
    """
    n, now, parity, prior = core.settings.n, core.now, core.now.parity, core.settings.prior
    mask, count, free = now.fused | out, 0, -1.0
    update_parity(core, mask)
    for i in range(n):
        count += now.fused >> i & 1
        free += out >> i & 1
        now.rival[i] = 0.0
        for j in range(n):
            if mask >> j & 1:
                now.rival[i] += parity.information[i, j] * now.corrected[j]
    # Each channel of a set takes a degree of freedom out of chi.
    base = 0.5 * (chi - chi_of(parity, n, mask, now.corrected)) + free - math.log(core.settings.risk / (count * count))
    for i in range(n):
        a, u = parity.information[i, i], now.rival[i]
        if now.fused >> i & 1 and a * now.uncertainty[i] > APART:
            cover_one(core, i, i, (u / a, 0.0), (1.0 / a, 0.0, 0.0), base + 0.5 * u * u / a)
        for j in range(i):
            b, c, v = parity.information[j, j], parity.information[i, j], now.rival[j]
            if now.fused >> i & now.fused >> j & 1 and a * b - c * c > APART * a * b:
                det = a * b - c * c
                f = (b * u - c * v) / det, (a * v - c * u) / det
                odds = base + 0.5 * (f[0] * u + f[1] * v) + math.log(prior[i] + prior[j])
                cover_one(core, i, j, f, (b / det, a / det, -c / det), odds)


@compiled
def cover_one(core: Core, i: int, j: int, f: tuple[float, float], p: tuple[float, float, float], odds: float) -> None:
    """Raise the level to what holds if channels i and j have errors f of covariance p (ii, jj, ij).

    odds: logarithm of the odds of that over its share of the risk.
    """
    now, last = core.now, core.last
    for a in range(3 if odds > 0.0 else 0):
        g, h, rate = now.parity.gain[a, i], now.parity.gain[a, j], 0.0
        for k in range(core.settings.n):
            if now.parity.gain[a, k] != 0.0:
                rate += now.parity.gain[a, k] * now.corrected[k]
        off = abs(last.rate[a] - rate + g * f[0] + h * f[1])
        variance = now.parity.inverse[a, a] + g * g * p[0] + h * h * p[1] + 2.0 * g * h * p[2]
        last.level[a] = max(last.level[a], off + math.sqrt(2.0 * odds * variance))
