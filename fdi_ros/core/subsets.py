# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What depends on which channels are there: least squares over a set, its protection level, the detector's constants.

A set has one bit for each channel, from the first up; its number is its place in tables of all sets. How the rate of a
set changes stands here, too, and what a sample says of the errors of its channels once the body rate is eliminated.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import Symmetric, Vector, allocate, call, compiled
from fdi_ros.core.records import (
    ACCELERATION_SAMPLES,
    Acceleration,
    Bank,
    Parity,
    SampleInput,
    SampleVerdict,
    Sensors,
    Subset,
)
from fdi_ros.model.geometry import (
    MIN_CHANNELS,
    MIN_SENSITIVITY,
    MIN_SINGULAR_RATIO,
    Geometry,
)
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.samples import MAX_RATE, Array, Mask

MIN_SPARE_RATIO = 0.1  # worst over best axis of the rest, below which leaving out costs more than a wider covariance


def mask_of(channels: Iterable[int]) -> int:
    """Set of the given channels."""
    mask = 0
    for i in channels:
        mask |= 1 << int(i)
    return mask


def is_in(channel: int, mask: int) -> bool:
    """Whether a channel is in a set."""
    return bool(mask >> channel & 1)


def whole_set(n: int) -> int:
    """Set of all n channels."""
    return (1 << n) - 1


def members(mask: int) -> tuple[int, ...]:
    """Channels of a set."""
    return tuple(i for i in range(mask.bit_length()) if is_in(i, mask))


def flags_of(mask: int, n: int) -> Mask:
    """Which of n channels are in a set, (n,)."""
    return np.array([is_in(i, mask) for i in range(n)])


def single_losses(mask: int) -> list[int]:
    """Return the sets that are left when one channel of a set is lost."""
    return [mask & ~(1 << i) for i in members(mask)]


def all_sets(n: int) -> Mask:
    """Which channels are in each of the 2^n sets, (2^n, n)."""
    sets: Mask = (np.arange(1 << n)[:, None] >> np.arange(n) & 1).astype(np.bool_)
    return sets


# Tables of all sets -------------------------------------------------------------------------------------------------


def prepare_subsets(geometry: Geometry, noise: NoiseModel) -> NDArray[Any]:
    """Return the least-squares part of all 2^n sets of channels, (2^n,) `Subset`."""
    n = geometry.n
    subsets = allocate(Subset, 1 << n)
    bits = all_sets(n)
    used = bits[:, :, None] * geometry.axes
    singular = np.linalg.svd(used, compute_uv=False)
    worst, best = singular[:, -1], singular[:, 0]
    spans = (bits.sum(axis=1) >= 3) & (worst >= MIN_SINGULAR_RATIO * best)
    subsets["spans"], subsets["spare"] = (
        spans,
        spans & (worst >= MIN_SPARE_RATIO * best),
    )
    roots = bits[spans] / noise.noise_std
    gain = (
        np.linalg.pinv(roots[:, :, None] * geometry.axes).transpose(0, 2, 1)
        * roots[:, :, None]
    )
    subsets["gain"][spans, :n] = gain
    share = 1 - np.einsum("kij,ij->ki", gain, geometry.axes)
    subsets["sensitivity"][spans, :n] = np.where(bits[spans], share, 0.0)
    return subsets


def prepare_capability(
    subsets: NDArray[Any], geometry: Geometry, can_run: list[bool]
) -> None:
    """Complete subsets with what a method can do with each; can_run (n + 1,): whether it runs on k channels."""
    n = geometry.n
    bits = all_sets(n)
    count = bits.sum(axis=1)
    enough = (subsets["spans"] != 0) & (count >= MIN_CHANNELS)
    runs = enough & np.array(can_run)[count]
    subsets["refused"], subsets["detectable"] = enough & ~runs, 0
    gain = np.linalg.pinv(bits[runs][:, :, None] * geometry.axes).transpose(0, 2, 1)
    share = 1 - np.einsum("kij,ij->ki", gain, geometry.axes)
    seen = bits[runs] & (np.sqrt(np.clip(share, 0, None)) >= MIN_SENSITIVITY)
    subsets["detectable"][runs] = (seen << np.arange(n)).sum(axis=1)


@compiled
def fill_rate(subset: Subset, n: int, mask: int, z: Array, rate: Array) -> None:
    """Least-squares rate (3,) of the channels in mask, rad/s; NaN where they do not span space."""
    for a in range(3):
        total = 0.0
        for i in range(n):
            if mask >> i & 1:
                total += subset.gain[i, a] * z[i]
        rate[a] = total if subset.spans else math.nan


@compiled
def fill_growth(
    n: int, noise_std: Array, variance: Array, remaining: Array, growth: Array
) -> None:
    """How many times noise_std^2 the square of each channel's error in a sample is, into growth (n,).

    ``variance`` (n,): of the sample, (rad/s)^2; ``remaining`` (n,): what is not known of each channel's bias, standard
    deviation, rad/s. How these hang together is not known: an axis with gains G is off by up to ``sum |G_i| std(b_i)``
    (as by the nominal biases of Blanch et al. 2015), whose square is at most n times that of independent ones.
    """
    for i in range(n):
        growth[i] = (variance[i] + n * remaining[i] * remaining[i]) / (
            noise_std[i] * noise_std[i]
        )


@compiled
def fill_level(subset: Subset, n: int, mask: int, growth: Array, level: Array) -> None:
    """Protection level (3,) of the channels in mask, rad/s, from the growth of their errors (n,).

    For fixed shares of the risk the level is the largest of functions that are concave in the variances and of degree
    1/2: of each the tangent is an upper bound, and among the tangents at multiples of noise_std^2 the best one gives
    ``level sqrt(sum_i p_i growth_i)`` with weights p that sum to one. ``subset.share`` has the largest p_i of all these
    functions.
    """
    least, most = math.inf, 0.0
    for i in range(n):
        if mask >> i & 1:
            least, most = min(least, growth[i]), max(most, growth[i])
    for a in range(3):
        total = least
        for i in range(n):
            if mask >> i & 1:
                total += subset.share[i, a] * (growth[i] - least)
        level[a] = subset.level[a] * math.sqrt(min(total, most))


@compiled
def passes_test(
    subset: Subset,
    axes: Array,
    noise_std: Array,
    n: int,
    mask: int,
    growth: Array,
    residual: Array,
) -> bool:
    """Whether the residuals (n,) of the channels in mask pass the separation test that the level rests on."""
    passes, least = True, math.inf
    for i in range(n):
        if mask >> i & 1:
            least = min(least, growth[i])
    for i in range(n):
        # Mostly that is all that has to be looked at.
        if mask >> i & 1 and not abs(residual[i]) <= subset.limit[i] * math.sqrt(least):
            before = after = 0.0
            for j in range(n):
                if mask >> j & 1:
                    taken = (
                        axes[i, 0] * subset.gain[j, 0]
                        + axes[i, 1] * subset.gain[j, 1]
                        + axes[i, 2] * subset.gain[j, 2]
                    )
                    part = ((1.0 if i == j else 0.0) - taken) * noise_std[j]
                    before += part * part
                    after += part * part * growth[j]
            if not abs(residual[i]) <= subset.limit[i] * math.sqrt(after / before):
                passes = False
    return passes


@compiled
def differentiate_rate(
    acceleration: Acceleration, stamp: int, rate: NDArray[np.float64]
) -> None:
    """Take the rate (3,) of one sample; the acceleration is then in ``acceleration.value``."""
    here = acceleration.count
    acceleration.count += 1
    newest = acceleration.history[here % ACCELERATION_SAMPLES]
    newest.stamp = stamp
    for a in range(3):
        newest.rate[a] = rate[a]
        acceleration.value[a] = 0.0
    if here == 0:
        note_known(acceleration, 0)
        return
    while acceleration.oldest + 1 < here and (
        here - acceleration.oldest >= ACCELERATION_SAMPLES
        or acceleration.history[(acceleration.oldest + 1) % ACCELERATION_SAMPLES].stamp
        <= stamp - acceleration.window
    ):
        note_known(acceleration, acceleration.oldest + 1)
    if acceleration.has_known and math.isfinite(rate[0]):
        seconds = (stamp - acceleration.known.stamp) * 1e-9
        for a in range(3):
            acceleration.value[a] = (rate[a] - acceleration.known.rate[a]) / seconds


@compiled
def note_known(acceleration: Acceleration, oldest: int) -> None:
    """Go on to a number of the oldest sample, and remember its rate if it had one."""
    acceleration.oldest, one = (
        oldest,
        acceleration.history[oldest % ACCELERATION_SAMPLES],
    )
    if math.isfinite(one.rate[0]):
        acceleration.has_known = 1
        acceleration.known.stamp = one.stamp
        for a in range(3):
            acceleration.known.rate[a] = one.rate[a]


# The detector: one row of constants and of memory for each set of channels present, or one for all --------------------


UNPREPARED, REFUSED = (
    -1,
    -2,
)  # instead of a row: not prepared yet; the method cannot run on these channels
LARGEST_RATE = 1e6  # rad/s; methods of a paper take a larger finite value for this, so that squares stay finite


@compiled
def present_in(z: NDArray[np.float64], n: int) -> int:
    """Bits of the channels whose value is finite."""
    mask = 0
    for i in range(n):
        if math.isfinite(z[i]):
            mask |= 1 << i
    return mask


@compiled
def clear_verdict(verdict: SampleVerdict, n: int) -> None:
    """Verdict on a sample that was not judged: not judged is not healthy."""
    verdict.statistic = verdict.threshold = math.nan
    verdict.alarm = verdict.isolated = False
    for i in range(n):
        verdict.suspects[i] = verdict.outliers[i] = False
        verdict.error[i] = verdict.noise[i] = 0.0
        verdict.scores[i] = math.nan


@compiled
def judge_sample(
    bank: Bank, sample: SampleInput, z: NDArray[np.float64], verdict: SampleVerdict
) -> bool:
    """Judge a sample by those of all values z (n,) that are in its mask; all else but its values is filled in already.

    False, and nothing is done, if the constants for these channels are unprepared.
    """
    mask, judged = sample.mask, bank.judged
    row = 0 if bank.takes_any else bank.row[mask]
    if row == UNPREPARED:
        return False
    clear_verdict(verdict, bank.n)
    if row == REFUSED:
        return True
    k = 0
    for i in range(bank.n):
        if bank.takes_any or mask >> i & 1:
            sample.z[k] = (
                min(max(z[i], -LARGEST_RATE), LARGEST_RATE)
                if math.isfinite(z[i])
                else 0.0
            )
            # What a method leaves untouched is no alarm.
            judged.suspects[k] = judged.outliers[k] = False
            judged.error[k] = judged.noise[k] = 0.0
            judged.scores[k] = math.nan if bank.takes_any else 0.0
            k += 1
    judged.alarm = judged.isolated = sample.estimate.known = False
    call(
        bank.judge,
        bank.constants,
        row,
        bank.constants_size,
        bank.states,
        bank.states_size,
        sample,
        judged,
    )
    verdict.statistic, verdict.threshold = judged.statistic, judged.threshold
    verdict.alarm, verdict.isolated = judged.alarm, judged.isolated
    k = 0
    for i in range(bank.n):
        if bank.takes_any or mask >> i & 1:
            verdict.suspects[i], verdict.outliers[i] = (
                judged.suspects[k],
                judged.outliers[k],
            )
            verdict.error[i], verdict.scores[i], verdict.noise[i] = (
                judged.error[k],
                judged.scores[k],
                judged.noise[k],
            )
            k += 1
    return True


@compiled
def variance_of(
    sensors: Sensors, i: int, rate_along: float, acceleration: NDArray[np.float64]
) -> float:
    """Error variance of a channel, (rad/s)^2, from the rate along its own axis, rad/s."""
    axis = sensors.axes[i]
    scale = sensors.scale_std[i] * rate_along
    timing = sensors.timing_std[i] * (
        axis[0] * acceleration[0]
        + axis[1] * acceleration[1]
        + axis[2] * acceleration[2]
    )
    return sensors.noise_std[i] * sensors.noise_std[i] + scale * scale + timing * timing


def describe_sensors(sensors: Any, geometry: Geometry, noise: NoiseModel) -> None:
    """Fill a record of `Sensors`; noise with one value per channel."""
    n = geometry.n
    sensors["n"], sensors["constant"] = n, noise.constant
    sensors["axes"][:n], sensors["gain"][:n] = geometry.axes, geometry.least_squares.T
    for name in ("noise_std", "scale_std", "timing_std"):
        sensors[name][:n] = getattr(noise, name)
    sensors["share"][:n], sensors["detectable"][:n] = (
        np.diag(geometry.S),
        geometry.detectable,
    )
    sensors["alike"][:n, :n] = geometry.group_matrix


# Parity ---------------------------------------------------------------------------------------------------------------
#
# With values ``y = H w + d``, the errors d of covariance M, and nothing known of the rate w but its prior N(0, K^-1),
# K = k I:
#
#     A = W - W H (H' W H + K)^-1 H' W,    W = M^-1,        G = (H' W H + K)^-1 H' W.
#
# A is the information about d that the redundancy holds (a projector where M = I and k = 0), G the weighted least
# squares. No basis of the null space is needed, and a channel that is absent is a row left out: rows and columns of the
# channels that are not in a set are zero.


UNKNOWN_RATE = (
    1.0 / MAX_RATE**2
)  # k where nothing is known: an axis that no channel measures is no division by zero


@compiled
def factorise(a: Array, size: int, factor: Array) -> float:
    """Cholesky factor of a symmetric positive definite matrix; return the log of its determinant."""
    log = 0.0
    for i in range(size):
        for j in range(i + 1):
            total = a[i, j]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i == j:
                # Rounding may leave less than zero of a singular matrix.
                factor[i, i] = math.sqrt(max(total, 1e-300))
                log += 2.0 * math.log(factor[i, i])
            else:
                factor[i, j] = total / factor[j, j]
    return log


@compiled
def invert(a: Array, size: int, out: Array) -> float:
    """Inverse of a symmetric positive definite matrix a (size, size), by Cholesky; return the log of its determinant.

    The lower triangle of a is read. ``out`` takes both triangles; on the way the factor, then its inverse.
    """
    log = factorise(a, size, out)
    for i in range(size):
        for j in range(i):
            total = 0.0
            for k in range(j, i):
                total -= out[i, k] * out[k, j]
            out[i, j] = total / out[i, i]
        out[i, i] = 1.0 / out[i, i]
    for i in range(size):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, size):
                total += out[k, i] * out[k, j]
            out[i, j] = out[j, i] = total
    return log


@compiled
def update_normal(parity: Parity, n: int, axes: Array, known: float) -> None:
    """Work out W H, and of ``H' W H + K`` the lower triangle."""
    for i in range(n):
        for a in range(3):
            total = 0.0
            for j in range(n):
                total += parity.weight[i, j] * axes[j, a]
            parity.weighted[i, a] = total
    for a in range(3):
        for b in range(a + 1):
            total = known if a == b else 0.0
            for i in range(n):
                total += axes[i, a] * parity.weighted[i, b]
            parity.normal[a, b] = total


@compiled
def eliminate_rate(parity: Parity, n: int, axes: Array, known: float) -> None:
    """Work out A and G from W; ``known``: what is known of the rate, k in s^2/rad^2."""
    update_normal(parity, n, axes, known)
    invert(parity.normal, 3, parity.inverse)
    for a in range(3):
        for i in range(n):
            total = 0.0
            for b in range(3):
                total += parity.inverse[a, b] * parity.weighted[i, b]
            parity.gain[a, i] = total
    for i in range(n):
        for j in range(i + 1):
            total = parity.weight[i, j]
            for a in range(3):
                total -= parity.weighted[i, a] * parity.gain[a, j]
            parity.information[i, j] = parity.information[j, i] = total


@compiled
def fill_parity(parity: Parity, sensors: Sensors, mask: int, variance: Array) -> None:
    """Work out A and G for independent errors of variances (n,), (rad/s)^2, while nothing is known of the rate."""
    n = sensors.n
    for i in range(n):
        for j in range(n):
            parity.weight[i, j] = 0.0
        if mask >> i & 1:
            parity.weight[i, i] = 1.0 / variance[i]
    eliminate_rate(parity, n, sensors.axes, UNKNOWN_RATE)


@compiled
def fill_joint_parity(
    parity: Parity, sensors: Sensors, mask: int, covariance: Array, known: float
) -> None:
    """Work out A and G for errors of a covariance (n, n), (rad/s)^2; ``known`` of the rate: k in s^2/rad^2."""
    n, count = sensors.n, 0
    for i in range(n):
        if mask >> i & 1:
            parity.place[count] = i
            count += 1
            for q in range(count):
                parity.information[count - 1, q] = covariance[i, parity.place[q]]
    invert(parity.information, count, parity.weight)
    for p in range(count):
        for q in range(count):
            parity.information[p, q] = parity.weight[p, q]
    for i in range(n):
        for j in range(n):
            parity.weight[i, j] = 0.0
    for p in range(count):
        for q in range(count):
            parity.weight[parity.place[p], parity.place[q]] = parity.information[p, q]
    eliminate_rate(parity, n, sensors.axes, known)


@compiled
def apply_gain(gain: Array, n: int, values: Array, rate: Vector) -> None:
    """Rate (3,) of values (n,), rad/s: those of channels left out are not read."""
    for a in range(3):
        total = 0.0
        for i in range(n):
            if gain[a, i] != 0.0:
                total += gain[a, i] * values[i]
        rate[a] = total


@compiled
def covariance_of(
    gain: Array, n: int, variance: Array, together: Array, out: Symmetric
) -> None:
    """Covariance G (diag(variance) + together) G' (6,) of a rate, upper triangle, (rad/s)^2."""
    k = 0
    for a in range(3):
        for b in range(a, 3):
            total = 0.0
            for i in range(n):
                if gain[a, i] != 0.0 or gain[b, i] != 0.0:
                    total += gain[a, i] * gain[b, i] * variance[i]
                    part = 0.0
                    for j in range(n):
                        part += gain[b, j] * together[i, j]
                    total += gain[a, i] * part
            out[k] = total
            k += 1
