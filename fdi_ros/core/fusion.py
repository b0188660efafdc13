# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Fused rate of a sample, and its covariance."""

from __future__ import annotations

import math
from typing import Any

from numpy.typing import NDArray

from fdi_ros.compiling.compiled import Symmetric, Vector, compiled
from fdi_ros.core.algebra import along, dot
from fdi_ros.core.parity import (
    LEAST_IN_RESIDUAL,
    apply_gain,
    covariance_of,
    fill_parity,
)
from fdi_ros.core.records import (
    ACCELERATION_SAMPLES,
    Acceleration,
    Core,
    Current,
    Estimate,
    Health,
    OutputRow,
    PathSettings,
    Subset,
)
from fdi_ros.core.repeated import is_at_rest
from fdi_ros.core.sensors import variance_of
from fdi_ros.core.subsets import fill_rate

CONTRADICTION = 30.0
"""Squared residual over its variance from which a channel contradicts the rate. Normal
noise reaches it in one of 2e7 samples."""
JUMP = 54.0
"""Squared second difference of an unchecked channel, in units of its variance, from which
it is a jump: three standard deviations of independent noise."""
# Largest error that is added, rad/s: far beyond any gyro, and squared still without
# rounding errors in the other axes.
LARGEST_DIFFERENCE = 1e3


@compiled
def fuse(core: Core, subsets: NDArray[Any], doubtful: int) -> None:
    """Fuse the usable channels without the doubtful ones.

    If too few remain, doubtful channels are fused as well, or no rate is given.
    """
    settings = core.settings
    last = core.last
    now = core.now
    n = settings.n
    now.fused = choose_fused(settings, core.health, now, subsets, doubtful)
    subset = subsets[now.fused]
    fill_rate(subset, n, now.fused, now.corrected, now.plain_rate)
    last.valid = not math.isnan(now.plain_rate[0])
    update_gain(settings, core.sample.estimate, core.acceleration, now, subset)
    for a in range(3):
        last.rate[a] = now.plain_rate[a]
    if last.valid:
        apply_gain(now.gain, n, now.corrected, last.rate)
    update_residuals(settings, now, last)
    update_course(core)
    update_lag(core)
    if last.valid:
        covariance_of(
            now.gain, n, now.variance, core.sample.estimate.covariance, last.covariance
        )
        contradicted = find_contradicted(core, now, last)
        update_leapt(core, now, last, subsets, contradicted)
        candidates = contradicted | doubtful & now.usable
        add_alternatives(core, now, last, subsets, candidates)
        add_unchecked(core, now, last, subsets, candidates)
        add_jumps(core, now, last, subsets)
        if doubtful & now.usable:
            add_units(settings, now, last, subsets, doubtful & now.usable)
        add_square(last.covariance, now.lagging, 1.0)
        # The rate is stated for the instant of the earliest unit. The true instant lies
        # between those of the earliest and the latest unit.
        for a in range(3):
            now.doubt[a] = (
                core.sample.estimate.largest_delay * core.acceleration.value[a]
            )
        add_square(last.covariance, now.doubt, 1.0 / 3.0)
        update_common_error(core)
    else:
        for k in range(6):
            last.covariance[k] = math.nan


@compiled
def update_lag(core: Core) -> None:
    """Calculate the instant of the rate, which is before the stamp if units are late.

    Instants only increase.
    """
    true = core.now.evidence.stamp - round(1e9 * core.sample.estimate.behind)
    core.last.instant = max(true, core.last.instant + 1)
    for a in range(3):
        core.now.lagging[a] = (
            1e-9 * (core.last.instant - true) * core.acceleration.value[a]
        )


@compiled
def choose_fused(
    settings: PathSettings,
    health: Health,
    now: Current,
    subsets: NDArray[Any],
    doubtful: int,
) -> int:
    """Return the channels to fuse."""
    usable = now.usable
    # Before an alarm, an outlier of this sample is worse than a channel that returns.
    outliers = 0 if now.verdict.alarm else now.evidence.outliers
    for i in range(settings.n):
        rest = usable & ~(1 << i)
        if health.returning[i] and subsets[rest & ~outliers].spare:
            usable = rest
    trusted = usable & ~doubtful
    now.withheld = False
    if doubtful and not subsets[trusted].spare:
        trusted = usable & ~now.evidence.outliers
        if not subsets[trusted].spare:
            trusted = usable
        if doubtful & trusted and not settings.publish_under_doubt:
            now.withheld = True
            trusted = 0
    if now.all_repeat and not is_at_rest(settings, now):
        # A turning vehicle does not repeat values exactly: repeated values are old.
        now.withheld = True
        trusted = 0
    return trusted


@compiled
def update_residuals(settings: PathSettings, now: Current, last: OutputRow) -> None:
    """Calculate residuals from the fused rate, and from the rate with expected weights."""
    axes = settings.sensors.axes
    for i in range(settings.n):
        last.residual[i] = now.tested[i] = math.nan
        if math.isfinite(now.corrected[i]):
            last.residual[i] = now.corrected[i] - along(axes[i], last.rate)
            now.tested[i] = now.corrected[i] - along(axes[i], now.plain_rate)


@compiled
def update_gain(
    settings: PathSettings,
    estimate: Estimate,
    acceleration: Acceleration,
    now: Current,
    subset: Subset,
) -> None:
    """Calculate the variance of every channel, and the gain of the fused channels."""
    n = settings.n
    sensors = settings.sensors
    for i in range(n):
        now.variance[i] = estimate.variance[i]
        if not estimate.is_current:
            # The sample was not judged: the estimate belongs to an earlier motion.
            rate_along = along(sensors.axes[i], now.plain_rate)
            expected = variance_of(sensors, i, rate_along, acceleration.value)
            now.variance[i] = max(now.variance[i], expected)
        now.uncertainty[i] = now.variance[i] + estimate.covariance[i, i]
        now.own[i] = max(now.uncertainty[i] - estimate.common[i], now.variance[i])
        is_fused = now.fused >> i & 1
        for a in range(3):
            now.gain[a, i] = subset.gain[i, a] if is_fused else 0.0
    if subset.spans:
        fill_parity(now.parity, sensors, now.fused, now.own)
        for a in range(3):
            for i in range(n):
                now.gain[a, i] = now.parity.gain[a, i]


@compiled
def is_contradicted(
    settings: PathSettings, now: Current, last: OutputRow, i: int
) -> bool:
    """Whether the residual of channel i is beyond what its noise and the rate's explain."""
    rate_variance = variance_in(last.covariance, settings.sensors.axes[i])
    if now.fused >> i & 1:
        # A channel that nothing checks has no residual but rounding.
        own = now.uncertainty[i]
        expected = max(own - rate_variance, LEAST_IN_RESIDUAL * own)
    else:
        # The uncertainty of an outlier contains its deviation.
        expected = now.variance[i] + rate_variance
    return last.residual[i] * last.residual[i] > CONTRADICTION * expected


@compiled
def find_contradicted(core: Core, now: Current, last: OutputRow) -> int:
    """Return the usable channels that contradict the rate."""
    contradicted = 0
    for i in range(core.settings.n):
        if now.usable >> i & 1 and is_contradicted(core.settings, now, last, i):
            contradicted |= 1 << i
    return contradicted


@compiled
def update_course(core: Core) -> None:
    """Extrapolate the last two values of each channel to this sample."""
    now = core.now
    history = core.acceleration.history
    count = core.acceleration.count
    ratio = math.nan
    if count >= 3:
        before = history[(count - 2) % ACCELERATION_SAMPLES].stamp
        step = before - history[(count - 3) % ACCELERATION_SAMPLES].stamp
        if step > 0:
            ratio = (now.evidence.stamp - before) / step
    for i in range(core.settings.n):
        change = core.before[i] - core.earlier[i]
        now.course[i] = core.before[i] + ratio * change
        core.earlier[i] = core.before[i]
        core.before[i] = now.corrected[i]


@compiled
def update_leapt(
    core: Core, now: Current, last: OutputRow, subsets: NDArray[Any], contradicted: int
) -> None:
    """Note which channels were left out as they jumped from their course, as a spike does."""
    for i in range(core.settings.n):
        if contradicted >> i & 1:
            jump = now.corrected[i] - now.course[i]
            residual = last.residual[i]
            if jump * jump > 0.25 * residual * residual:
                core.leapt |= 1 << i
        elif now.usable >> i & 1 and subsets[now.usable & ~(1 << i)].spans:
            core.leapt &= ~(1 << i)


@compiled
def add_alternatives(
    core: Core,
    now: Current,
    last: OutputRow,
    subsets: NDArray[Any],
    candidates: int,
) -> None:
    """Widen the covariance for usable channels that contradict the rate or are in doubt.

    Such a channel may be wrong if it is fused. If it is left out, it may be right unless
    it jumped away, and then a channel is wrong that no other fused channel replaces.
    Half the squared difference of each such rate from the fused one is added: the error
    of a mean of two channels, one of which is wrong, is then one standard deviation.
    """
    n = core.settings.n
    wrong = candidates & now.fused
    right = candidates & ~now.fused & ~core.leapt
    if wrong | right == 0:
        return
    for i in range(n):
        if wrong >> i & 1:
            add_alternative(core.settings, now, last, subsets, now.fused & ~(1 << i))
        if not right >> i & 1:
            continue
        for j in range(n):
            rest = now.fused & ~(1 << j)
            if now.fused >> j & 1 and not subsets[rest].spans:
                add_alternative(core.settings, now, last, subsets, rest | 1 << i)


@compiled
def add_alternative(
    settings: PathSettings,
    now: Current,
    last: OutputRow,
    subsets: NDArray[Any],
    mask: int,
) -> None:
    """Add half the squared difference of the rate of other channels, if they give one."""
    if not subsets[mask].spans:
        return
    fill_rate(subsets[mask], settings.n, mask, now.corrected, now.doubt)
    for a in range(3):
        difference = now.doubt[a] - last.rate[a]
        now.doubt[a] = max(min(difference, LARGEST_DIFFERENCE), -LARGEST_DIFFERENCE)
    add_square(last.covariance, now.doubt, 0.5)


@compiled
def add_unchecked(
    core: Core, now: Current, last: OutputRow, subsets: NDArray[Any], candidates: int
) -> None:
    """Widen the covariance for a channel that was wrong or in doubt, and that nothing checks now.

    Its largest deviation since it is a candidate is kept while others check it. Without
    them its error counts as that large, or as large as its value: the error of a wrong
    gain or sign grows with the rate.
    """
    for i in range(core.settings.n):
        if not now.usable >> i & 1:
            continue
        rest = now.fused & ~(1 << i)
        if not subsets[rest].spans:
            if now.fused >> i & 1 and core.deviation[i] > 0.0:
                error = max(core.deviation[i], abs(now.corrected[i]))
                error = min(error, LARGEST_DIFFERENCE)
                add_square(last.covariance, now.gain[:, i], error * error)
        elif candidates >> i & 1:
            fill_rate(subsets[rest], core.settings.n, rest, now.corrected, now.doubt)
            others = along(core.settings.sensors.axes[i], now.doubt)
            deviation = abs(now.corrected[i] - others)
            core.deviation[i] = max(core.deviation[i], deviation)
        else:
            core.deviation[i] = 0.0


@compiled
def add_jumps(core: Core, now: Current, last: OutputRow, subsets: NDArray[Any]) -> None:
    """Widen the covariance where a value jumps that no other channel checks.

    The jump may be motion or a spike: nothing distinguishes them.
    """
    for i in range(core.settings.n):
        if not now.fused >> i & 1 or subsets[now.usable & ~(1 << i)].spans:
            continue
        jump = now.corrected[i] - now.course[i]
        jump = max(min(jump, LARGEST_DIFFERENCE), -LARGEST_DIFFERENCE)
        if jump * jump > JUMP * now.variance[i]:
            add_square(last.covariance, now.gain[:, i], jump * jump)


@compiled
def variance_in(covariance: Symmetric, axis: Vector) -> float:
    """Variance along an axis (3,) of a covariance given by its upper triangle (6,)."""
    x = axis[0]
    y = axis[1]
    z = axis[2]
    squares = x * x * covariance[0] + y * y * covariance[3] + z * z * covariance[5]
    products = x * y * covariance[1] + x * z * covariance[2] + y * z * covariance[4]
    return squares + 2.0 * products


@compiled
def add_units(
    settings: PathSettings,
    now: Current,
    last: OutputRow,
    subsets: NDArray[Any],
    doubtful: int,
) -> None:
    """Widen the covariance while whole units are in doubt.

    The rates without each such unit count as equally likely, and the squares of their
    differences from the fused rate are added.
    """
    doubted = whole = 0
    for u in range(settings.units):
        inside = now.usable & settings.members[u]
        is_doubted = inside and not inside & ~doubtful
        if is_doubted and subsets[now.usable & ~inside].spans:
            doubted |= 1 << u
            whole += 1
    for u in range(settings.units):
        if doubted >> u & 1:
            rest = now.usable & ~settings.members[u]
            fill_rate(subsets[rest], settings.n, rest, now.corrected, now.doubt)
            for a in range(3):
                now.doubt[a] -= last.rate[a]
            add_square(last.covariance, now.doubt, 1.0 / whole)


@compiled
def add_square(covariance: Symmetric, error: Vector, share: float) -> None:
    """Add a share of the outer product of an error (3,) with itself."""
    k = 0
    for a in range(3):
        for b in range(a, 3):
            covariance[k] += share * error[a] * error[b]
            k += 1


@compiled
def update_common_error(core: Core) -> None:
    """Split the uncertainty of the errors into a part in the rate and one in the residuals.

    C is the covariance of the errors. ``B = G C G'`` is written to ``now.common``, and
    the square roots of the diagonal of ``(I - H G) C (I - H G)'`` to ``core.remaining``.
    """
    n = core.settings.n
    axes = core.settings.sensors.axes
    gain = core.now.gain
    common = core.now.common
    shared = core.now.shared_error
    covariance = core.sample.estimate.covariance
    for i in range(n):
        for a in range(3):
            shared[i, a] = dot(gain[a], covariance[i], n)
    k = 0
    for a in range(3):
        for c in range(a, 3):
            common[k] = dot(gain[a], shared[:, c], n)
            k += 1
    for i in range(n):
        along_axis = variance_in(common, axes[i])
        mixed = along(axes[i], shared[i])
        core.remaining[i] = math.sqrt(
            max(covariance[i, i] - 2.0 * mixed + along_axis, 0.0)
        )
