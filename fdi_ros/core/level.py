# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Protection level of the fused rate.

A name or a set may be wrong: other channels may be faulty in place of the channels left
out. D are the channels left out as faulty. W is the union of D and the fused channels.
A rival hypothesis h assumes that D is healthy and that one or two others, R, are
faulty. With u = A z and the gain G of W (`fdi_ros.core.parity`), its error and rate are
those of solution separation (`fdi_ros.monitor.integrity`):

    f_h = A_RR^-1 u_R,    x_h = G z - G_R f_h,    P_h = P_W + G_R A_RR^-1 G_R',    chi_h
    = z' A z - u_R' f_h.

Its odds against the name in this sample are ``o_h exp(-(chi_h - chi_0) / 2)``, where
o_h are the prior odds of its faults against a single fault. Therefore the level of an
axis is at least ``|x_0 - x_h| + q sigma_h``, with the Chernoff bound ``Q(q) <= exp(-q^2
/ 2)`` on the risk, which all rivals share. Each sample is judged alone: earlier samples
make no rival unlikely.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from numpy.typing import NDArray

from fdi_ros.compiling.compiled import compiled
from fdi_ros.core.algebra import along, dot_in
from fdi_ros.core.parity import LEAST_IN_RESIDUAL, fill_parity, gained_rate
from fdi_ros.core.records import Core, Parity, Subset
from fdi_ros.core.subsets import number_in
from fdi_ros.model.samples import Array


@compiled
def fill_error_ratio(
    n: int, noise_std: Array, variance: Array, remaining: Array, error_ratio: Array
) -> None:
    """Write the mean square error of each channel over noise_std^2 into error_ratio (n,).

    ``variance`` (n,) of the sample, (rad/s)^2. ``remaining`` (n,) is the
    standard deviation of each channel's unknown bias, rad/s. The correlation of the
    biases is unknown. An axis with gains G is off by up to ``sum |G_i| std(b_i)``, as
    by the nominal biases of Blanch et al. (2015). The square of this sum is at most n
    times the square for independent biases.
    """
    for i in range(n):
        error_ratio[i] = (variance[i] + n * remaining[i] * remaining[i]) / (
            noise_std[i] * noise_std[i]
        )


@compiled
def fill_level(
    subset: Subset, n: int, mask: int, error_ratio: Array, level: Array
) -> None:
    """Write the protection level (3,) of the channels in mask for error_ratio (n,), rad/s.

    For fixed shares of the risk, the level is the largest of several functions that are
    concave in the variances and homogeneous of degree 1/2. The tangent to each function
    is an upper bound. Among the tangents at multiples of noise_std^2, the best one
    gives ``level sqrt(sum_i p_i growth_i)`` with weights p that sum to one.
    ``subset.share`` contains the largest p_i over all functions.
    """
    least = math.inf
    most = 0.0
    for i in range(n):
        if mask >> i & 1:
            least = min(least, error_ratio[i])
            most = max(most, error_ratio[i])
    for a in range(3):
        total = least
        for i in range(n):
            if mask >> i & 1:
                total += subset.share[i, a] * (error_ratio[i] - least)
        level[a] = subset.level[a] * math.sqrt(min(total, most))


@compiled
def passes_test(
    subset: Subset,
    axes: Array,
    noise_std: Array,
    n: int,
    mask: int,
    error_ratio: Array,
    residual: Array,
) -> bool:
    """Return whether the residuals (n,) of the channels in mask pass the separation test.

    The protection level presumes that they do.
    """
    passes = True
    least = math.inf
    for i in range(n):
        if mask >> i & 1:
            least = min(least, error_ratio[i])
    for i in range(n):
        # In most samples this cheap bound decides.
        bound = subset.limit[i] * math.sqrt(least)
        if mask >> i & 1 and not abs(residual[i]) <= bound:
            before = after = 0.0
            for j in range(n):
                if mask >> j & 1:
                    taken = along(axes[i], subset.gain[j])
                    part = ((1.0 if i == j else 0.0) - taken) * noise_std[j]
                    before += part * part
                    after += part * part * error_ratio[j]
            if not abs(residual[i]) <= subset.limit[i] * math.sqrt(after / before):
                passes = False
    return passes


@compiled
def cover_rivals(core: Core) -> None:
    """Raise ``core.last.level`` to a bound that also holds if a name or the set is wrong.

    A channel that has no value in this sample is no better named than before, so what it
    raised the level by last is kept.
    """
    now = core.now
    decision = core.decision
    n = core.settings.n
    fill_parity(now.parity, core.settings.sensors, now.fused, now.own)
    chi = chi_of(now.parity, n, now.fused, now.corrected)
    level = core.last.level
    for a in range(3):
        now.uncovered[a] = now.covered[a] = level[a]
    for i in range(n + 1):
        out = decision.faulty & 1 << i if i < n else decision.ambiguous
        raised = core.raised[i]
        if out == 0:
            for a in range(3):
                raised[a] = 0.0
        elif not out & (now.fused | ~now.plain):
            for a in range(3):
                level[a] = now.uncovered[a]
            cover(core, out, chi)
            for a in range(3):
                raised[a] = level[a] - now.uncovered[a]
        for a in range(3):
            now.covered[a] = max(now.covered[a], now.uncovered[a] + raised[a])
    for a in range(3):
        level[a] = now.covered[a]


@compiled
def forget_rivals(core: Core) -> None:
    """Forget what declared channels raised the level by, as none is declared."""
    for i in range(core.settings.n + 1):
        for a in range(3):
            core.raised[i, a] = 0.0


class Rival(NamedTuple):
    """A rival of the declaration: one or two of the fused channels are faulty."""

    first: int  #: Channel, from 0.
    second: int  #: Channel, from 0. Equal to ``first`` for a single fault.
    error: tuple[float, float]  #: Estimated errors of both channels, rad/s.
    variance: tuple[float, float]  #: Variances of the estimates, (rad/s)^2.
    covariance: float  #: Covariance of the two estimates, (rad/s)^2.
    log_odds: float  #: Logarithm of its odds, divided by its share of the risk.


@compiled
def chi_of(parity: Parity, n: int, mask: int, z: Array) -> float:
    """Return the chi-square z' A z of the channels in mask."""
    total = 0.0
    for i in range(n):
        for j in range(n):
            if mask >> i & 1 and mask >> j & 1:
                total += z[i] * parity.information[i, j] * z[j]
    return total


@compiled
def cover(core: Core, out: int, chi: float) -> None:
    """Raise the level for the rivals of ``out``: its channels healthy, one or two fused faulty.

    ``chi`` is the chi-square of the fused channels.
    """
    n = core.settings.n
    now = core.now
    information = core.now.parity.information
    mask = now.fused | out
    fill_parity(now.parity, core.settings.sensors, mask, now.own)
    for i in range(n):
        now.rival[i] = dot_in(information[i], now.corrected, n, mask)
    # Each channel left out reduces the degrees of freedom of chi by one.
    gained = 0.5 * (chi - chi_of(now.parity, n, mask, now.corrected))
    rivals = number_in(now.fused, n) ** 2
    free = number_in(out, n) - 1.0
    base = gained + free - math.log(core.settings.risk / rivals)
    for i in range(n):
        if now.fused >> i & 1:
            cover_single(core, i, base)
            for j in range(i):
                if now.fused >> j & 1:
                    cover_pair(core, i, j, base)


@compiled
def cover_single(core: Core, i: int, base: float) -> None:
    """Raise the level for a fault of channel i.

    ``base`` is the logarithm of the odds of a fault that explains no residual.
    """
    information = core.now.parity.information[i, i]
    u = core.now.rival[i]
    # With less, no residual shows the channel.
    if information * core.now.own[i] > LEAST_IN_RESIDUAL:
        log_odds = base + 0.5 * u * u / information
        cover_rival(
            core,
            Rival(
                i, i, (u / information, 0.0), (1.0 / information, 0.0), 0.0, log_odds
            ),
        )


@compiled
def cover_pair(core: Core, i: int, j: int, base: float) -> None:
    """Raise the level for faults of channels i and j, with base as in `cover_single`."""
    information = core.now.parity.information
    prior = core.settings.prior
    a = information[i, i]
    b = information[j, j]
    c = information[i, j]
    u = core.now.rival[i]
    v = core.now.rival[j]
    determinant = a * b - c * c
    # Two channels that look alike are covered by the single faults.
    # With a smaller determinant the two channels look alike.
    if determinant > LEAST_IN_RESIDUAL * a * b:
        error = (b * u - c * v) / determinant, (a * v - c * u) / determinant
        explained = 0.5 * (error[0] * u + error[1] * v)
        log_odds = base + explained + math.log(prior[i] + prior[j])
        variance = b / determinant, a / determinant
        cover_rival(core, Rival(i, j, error, variance, -c / determinant, log_odds))


@compiled
def cover_rival(core: Core, rival: Rival) -> None:
    """Raise the level of each axis to a bound that holds if the rival is true."""
    if rival.log_odds <= 0.0:
        return
    now = core.now
    last = core.last
    parity = core.now.parity
    for a in range(3):
        g = parity.gain[a, rival.first]
        h = parity.gain[a, rival.second]
        rate = gained_rate(parity.gain[a], now.corrected, core.settings.n)
        off = abs(last.rate[a] - rate + g * rival.error[0] + h * rival.error[1])
        variance = (
            parity.inverse[a, a]
            + g * g * rival.variance[0]
            + h * h * rival.variance[1]
            + 2.0 * g * h * rival.covariance
        )
        bound = off + math.sqrt(2.0 * rival.log_odds * variance)
        last.level[a] = max(last.level[a], bound)


@compiled
def update_level(core: Core, subsets: NDArray[Any]) -> None:
    """Update the protection level of the fused rate in this sample.

    The level is a sum of five parts: the level of the rate with its expected weights,
    the difference between that rate and the fused rate, a bound on the errors that all
    channels share, which no residual shows, and the changes of the rate up to the
    stated instant and between the units. The level is infinite without a fused
    rate, while a doubtful channel is fused for want of others, and where the separation
    test fails. If the level of the fused channels has not been calculated yet,
    ``core.wanted`` is set to their mask.
    """
    last = core.last
    now = core.now
    subset = subsets[core.now.fused]
    passes = last.valid != 0 and not now.all_repeat and not now.doubtful & now.fused
    core.wanted = now.fused if passes and not subset.has_level else 0
    n = core.settings.n
    sensors = core.settings.sensors
    fill_error_ratio(
        n, sensors.noise_std, now.variance, core.remaining, now.error_ratio
    )
    fill_level(subset, n, now.fused, now.error_ratio, last.level)
    if not passes or not passes_test(
        subset,
        sensors.axes,
        sensors.noise_std,
        n,
        now.fused,
        now.error_ratio,
        now.tested,
    ):
        for a in range(3):
            last.level[a] = math.inf
    else:
        for a in range(3):
            common = math.sqrt(
                max(now.common[0 if a == 0 else 3 if a == 1 else 5], 0.0)
            )
            left_out = abs(last.rate[a] - now.plain_rate[a])
            last.level[a] += left_out + abs(now.lagging[a])
            last.level[a] += core.settings.reach * common
            # The units measure at different instants, and each may be the right one.
            apart = core.sample.estimate.largest_delay * core.acceleration.value[a]
            last.level[a] += abs(apart)
        if core.settings.risk > 0.0 and core.decision.faulty | core.decision.ambiguous:
            cover_rivals(core)
    if core.decision.faulty | core.decision.ambiguous == 0:
        forget_rivals(core)
