# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Fused rate of a sample, its covariance and its protection level."""

from __future__ import annotations

import math
from typing import Any

from numpy.typing import NDArray

from fdi_ros.compiling.compiled import compiled
from fdi_ros.compiling.record import Symmetric, Vector
from fdi_ros.core.bank import variance_of
from fdi_ros.core.health import stands
from fdi_ros.core.parity import UNKNOWN_RATE, apply_gain, covariance_of, eliminate_rate, weigh_each
from fdi_ros.core.records import Core, Subset
from fdi_ros.core.subsets import find_growth, find_level_of, find_rate, passes_test
from fdi_ros.model.geometry import MIN_SENSITIVITY


@compiled
def fuse(core: Core, subsets: NDArray[Any], doubtful: int) -> None:
    """Fused rate of the usable channels without the doubtful; with them, or none, if too little would be left.

    Weights are those of the noise and of what is not known of the errors at the moment, where a detector estimates
    them; else those of the noise expected.
    """
    n, last = core.settings.n, core.last
    core.fused = find_trusted(core, subsets, doubtful)
    subset = subsets[core.fused]
    find_rate(subset, n, core.fused, core.z, core.plain_rate)
    last.valid = not math.isnan(core.plain_rate[0])
    find_gain(core, subset)
    for a in range(3):
        last.rate[a] = core.plain_rate[a]
    if last.valid and core.settings.estimates:
        apply_gain(core.gain, n, core.z, last.rate)
    find_residuals(core)
    find_lagging(core)
    if last.valid:
        covariance_of(core.gain, n, core.variance, core.estimate.covariance, last.covariance)
        if doubtful & core.usable:
            add_doubt(core, subsets, doubtful & core.usable)
        add_square(last.covariance, core.lagging, 1.0)
        find_common(core)
    else:
        for k in range(6):
            last.covariance[k] = math.nan


@compiled
def find_lagging(core: Core) -> None:
    """Find the instant that the rate is of, and by how much the rate has changed up to it where that has to wait.

    Where units are late the values are of an instant before the stamp. Those of the samples only ever go forwards: when
    more is taken off, the next ones come close after each other.
    """
    true = core.evidence.stamp - core.line.lag
    core.last.instant = max(true, core.last.instant + 1)
    for a in range(3):
        core.lagging[a] = 1e-9 * (core.last.instant - true) * core.acceleration.value[a]


@compiled
def find_trusted(core: Core, subsets: NDArray[Any], doubtful: int) -> int:
    """Channels that are to be fused."""
    trusted = core.usable & ~doubtful
    core.withheld = False
    if doubtful and not subsets[trusted].spare:
        trusted = core.usable & ~core.evidence.outliers
        if not subsets[trusted].spare:
            trusted = core.usable
        if doubtful & trusted and not core.settings.publish_under_doubt:
            core.withheld, trusted = True, 0
    if core.frozen and not stands(core):
        # A vehicle that turns does not give the same bits twice: what is repeated is old.
        core.withheld, trusted = True, 0
    return trusted


@compiled
def find_residuals(core: Core) -> None:
    """Differences of the channels from the fused rate, and from that with weights as expected."""
    axes, last = core.settings.sensors.axes, core.last
    for i in range(core.settings.n):
        along = tested = 0.0
        for a in range(3):
            along += axes[i, a] * last.rate[a]
            tested += axes[i, a] * core.plain_rate[a]
        known = math.isfinite(core.z[i])
        last.residual[i] = core.z[i] - along if known else math.nan
        core.tested[i] = core.z[i] - tested if known else math.nan


@compiled
def find_gain(core: Core, subset: Subset) -> None:
    """Variance of every channel, and the gain of the channels fused."""
    n, sensors, estimate = core.settings.n, core.settings.sensors, core.estimate
    for i in range(n):
        h, rate = sensors.axes[i], core.plain_rate
        if core.settings.estimates and estimate.variance[i] > 0.0:
            core.variance[i] = estimate.variance[i]
        else:
            along = h[0] * rate[0] + h[1] * rate[1] + h[2] * rate[2]
            core.variance[i] = variance_of(sensors, i, along, core.acceleration.value)
        core.uncertainty[i] = core.variance[i] + estimate.covariance[i, i]
        for a in range(3):
            core.gain[a, i] = subset.gain[i, a] if core.fused >> i & 1 else 0.0
    if core.settings.estimates and subset.spans:
        weigh_each(core.parity, n, core.fused, core.uncertainty)
        eliminate_rate(core.parity, n, sensors.axes, UNKNOWN_RATE)
        for a in range(3):
            for i in range(n):
                core.gain[a, i] = core.parity.gain[a, i]


@compiled
def add_doubt(core: Core, subsets: NDArray[Any], doubtful: int) -> None:
    """Add to the covariance what channels under doubt may be wrong by that could not be left out.

    Where units are in doubt as a whole, the rates that would be left without one or the other are as likely as each
    other; else, where no detector has estimated it, each channel may be off by its difference from the others.
    """
    if core.settings.estimates:
        add_units(core, subsets, doubtful)
        return
    for i in range(core.settings.n):
        if doubtful & core.fused & (1 << i):
            doubt = core.doubt[i]
            if doubt == 0.0 and subsets[core.fused].sensitivity[i] > MIN_SENSITIVITY:
                # No verdict has estimated it: its difference from the others now.
                doubt = core.tested[i] / subsets[core.fused].sensitivity[i]
            for a in range(3):
                core.others_rate[a] = core.gain[a, i] * doubt
            add_square(core.last.covariance, core.others_rate, 1.0)


@compiled
def add_units(core: Core, subsets: NDArray[Any], doubtful: int) -> None:
    """Add how far the rates without one unit in doubt or another are from the fused one, as likely as each other."""
    n, settings, whole = core.settings.n, core.settings, 0
    for u in range(settings.units):
        whole += is_doubted(core, subsets, doubtful, u)
    for u in range(settings.units if whole else 0):
        if is_doubted(core, subsets, doubtful, u):
            rest = core.usable & ~settings.members[u]
            find_rate(subsets[rest], n, rest, core.z, core.others_rate)
            for a in range(3):
                core.others_rate[a] -= core.last.rate[a]
            add_square(core.last.covariance, core.others_rate, 1.0 / whole)


@compiled
def is_doubted(core: Core, subsets: NDArray[Any], doubtful: int, unit: int) -> bool:
    """Whether a unit is in doubt as a whole, and there is a rate without it."""
    inside = core.usable & core.settings.members[unit]
    return inside != 0 and not inside & ~doubtful and subsets[core.usable & ~inside].spans != 0


@compiled
def add_square(covariance: Symmetric, error: Vector, share: float) -> None:
    """Add the outer product of an error of the rate (3,) with itself."""
    k = 0
    for a in range(3):
        for b in range(a, 3):
            covariance[k] += share * error[a] * error[b]
            k += 1


@compiled
def find_common(core: Core) -> None:
    """Split what is not known of the errors into what passes for rate, and what shows in the residuals.

    With C its covariance and ``B = G C G'``: B is in ``core.common``, and of ``(I - H G) C (I - H G)'`` the roots of
    the diagonal in ``core.remaining``.
    """
    if not core.settings.estimates:
        return
    n, axes, taken = core.settings.n, core.settings.sensors.axes, core.parity.weighted
    for i in range(n):
        for a in range(3):
            total = 0.0
            for j in range(n):
                total += core.gain[a, j] * core.estimate.covariance[i, j]
            taken[i, a] = total
    k = 0
    for a in range(3):
        for c in range(a, 3):
            total = 0.0
            for i in range(n):
                total += core.gain[a, i] * taken[i, c]
            core.common[k] = total
            k += 1
    b = core.common
    for i in range(n):
        x, y, z = axes[i, 0], axes[i, 1], axes[i, 2]
        square = x * x * b[0] + y * y * b[3] + z * z * b[5] + 2.0 * (x * y * b[1] + x * z * b[2] + y * z * b[4])
        mixed = x * taken[i, 0] + y * taken[i, 1] + z * taken[i, 2]
        core.remaining[i] = math.sqrt(max(core.estimate.covariance[i, i] - 2.0 * mixed + square, 0.0))


@compiled
def find_level(core: Core, subsets: NDArray[Any]) -> None:
    """Protection level of the fused rate; if it is still to be worked out for the channels fused, ``core.wanted``.

    It is for the errors that this sample may have, in its own motion: that of the rate with weights as expected, by how
    much the fused rate differs from that, and what passes for rate and shows in no residual. There is none without a
    fused rate, while a doubtful channel has to be fused for want of others, and where the separation test
    fails, whatever the verdict is.
    """
    last, subset = core.last, subsets[core.fused]
    passes = last.valid != 0 and not core.frozen and not core.doubtful & core.fused
    core.wanted = core.fused if passes and not subset.has_level else 0
    n, sensors = core.settings.n, core.settings.sensors
    find_growth(n, sensors.noise_std, core.variance, core.remaining, core.growth)
    find_level_of(subset, n, core.fused, core.growth, last.level)
    if not passes or not passes_test(subset, sensors.axes, sensors.noise_std, n, core.fused, core.growth, core.tested):
        for a in range(3):
            last.level[a] = math.inf
    elif core.settings.estimates:
        for a in range(3):
            common = math.sqrt(max(core.common[0 if a == 0 else 3 if a == 1 else 5], 0.0))
            last.level[a] += abs(last.rate[a] - core.plain_rate[a]) + abs(core.lagging[a])
            last.level[a] += core.settings.reach * common
