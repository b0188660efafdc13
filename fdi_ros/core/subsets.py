# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Sets of channels: one bit each, from the first channel up; least squares over a set, and its protection level.

How the rate of a set changes stands here, too.

The number of a set, its bits, is its place in tables of all sets.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import allocate, compiled
from fdi_ros.core.records import ACCELERATION_SAMPLES, Acceleration, Subset, TimedRate
from fdi_ros.model.geometry import MIN_CHANNELS, MIN_SENSITIVITY, MIN_SINGULAR_RATIO, Geometry
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.samples import Array, Mask

MIN_SPARE_RATIO = 0.1
"""Channels under suspicion are left out as long as the rest measures its worst axis at least a tenth as well as its
best; below that, leaving them out costs more than a widened covariance."""


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
    subsets["spans"], subsets["spare"] = spans, spans & (worst >= MIN_SPARE_RATIO * best)
    roots = bits[spans] / noise.noise_std
    gain = np.linalg.pinv(roots[:, :, None] * geometry.axes).transpose(0, 2, 1) * roots[:, :, None]
    subsets["gain"][spans, :n] = gain
    share = 1 - np.einsum("kij,ij->ki", gain, geometry.axes)
    subsets["sensitivity"][spans, :n] = np.where(bits[spans], share, 0.0)
    return subsets


def prepare_capability(subsets: NDArray[Any], geometry: Geometry, can_run: list[bool]) -> None:
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
def fill_growth(n: int, noise_std: Array, variance: Array, remaining: Array, growth: Array) -> None:
    """How many times noise_std^2 the square of each channel's error in a sample is, into growth (n,).

    ``variance`` (n,): of the sample, (rad/s)^2; ``remaining`` (n,): what is not known of each channel's bias, standard
    deviation, rad/s. How the biases that remain hang together is not known: an axis with gains G is off by G b with a
    standard deviation of up to ``sum |G_i| std(b_i)`` (as by the nominal biases of Blanch et al. 2015), whose square is
    at most n times that of independent ones.
    """
    for i in range(n):
        growth[i] = (variance[i] + n * remaining[i] * remaining[i]) / (noise_std[i] * noise_std[i])


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
    subset: Subset, axes: Array, noise_std: Array, n: int, mask: int, growth: Array, residual: Array
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
                        axes[i, 0] * subset.gain[j, 0] + axes[i, 1] * subset.gain[j, 1] + axes[i, 2] * subset.gain[j, 2]
                    )
                    part = ((1.0 if i == j else 0.0) - taken) * noise_std[j]
                    before += part * part
                    after += part * part * growth[j]
            if not abs(residual[i]) <= subset.limit[i] * math.sqrt(after / before):
                passes = False
    return passes


@compiled
def differentiate_rate(acceleration: Acceleration, stamp: int, rate: NDArray[np.float64]) -> None:
    """Take the rate (3,) of one sample; the acceleration is then in ``acceleration.value``."""
    here = acceleration.count
    acceleration.count += 1
    newest = acceleration.history[here % ACCELERATION_SAMPLES]
    newest.stamp = stamp
    for a in range(3):
        newest.rate[a] = rate[a]
        acceleration.value[a] = 0.0
    if here == 0:
        note_known(acceleration, newest)
        return
    while acceleration.oldest + 1 < here and (
        here - acceleration.oldest >= ACCELERATION_SAMPLES
        or acceleration.history[(acceleration.oldest + 1) % ACCELERATION_SAMPLES].stamp <= stamp - acceleration.window
    ):
        acceleration.oldest += 1
        note_known(acceleration, acceleration.history[acceleration.oldest % ACCELERATION_SAMPLES])
    if acceleration.has_known and math.isfinite(rate[0]):
        seconds = (stamp - acceleration.known.stamp) * 1e-9
        for a in range(3):
            acceleration.value[a] = (rate[a] - acceleration.known.rate[a]) / seconds


@compiled
def note_known(acceleration: Acceleration, one: TimedRate) -> None:
    """Remember the rate of the oldest sample if it had one."""
    if math.isfinite(one.rate[0]):
        acceleration.has_known = 1
        acceleration.known.stamp = one.stamp
        for a in range(3):
            acceleration.known.rate[a] = one.rate[a]
