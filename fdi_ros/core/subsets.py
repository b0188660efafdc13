# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Sets of channels as bit masks: their least-squares rate, and what a method can detect.

Bit i of a mask stands for channel i. The mask is the index of the set in tables of all
sets.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import allocate, compiled
from fdi_ros.core.records import Subset
from fdi_ros.model.geometry import (
    MIN_CHANNELS,
    MIN_SENSITIVITY,
    MIN_SINGULAR_RATIO,
    Geometry,
)
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.samples import Array, Mask

#: Smallest ratio of singular values of the remaining axes for which a channel is left
#: out on mere suspicion. Below it the loss of accuracy costs more.
MIN_SPARE_RATIO = 0.1


def mask_of(channels: Iterable[int]) -> int:
    """Return the set of the given channels."""
    mask = 0
    for i in channels:
        mask |= 1 << int(i)
    return mask


def is_in(channel: int, mask: int) -> bool:
    """Return whether a channel is in a set."""
    return bool(mask >> channel & 1)


def whole_set(n: int) -> int:
    """Return the set of all n channels."""
    return (1 << n) - 1


def members(mask: int) -> tuple[int, ...]:
    """Return the channels of a set."""
    return tuple(i for i in range(mask.bit_length()) if is_in(i, mask))


def flags_of(mask: int, n: int) -> Mask:
    """Return for each of n channels whether the set contains it, (n,)."""
    return np.array([is_in(i, mask) for i in range(n)])


def single_losses(mask: int) -> list[int]:
    """Return the sets that remain when one channel of a set is lost."""
    return [mask & ~(1 << i) for i in members(mask)]


def all_sets(n: int) -> Mask:
    """Return for each of the 2^n sets whether it contains each channel, (2^n, n)."""
    masks = np.arange(1 << n)[:, None]
    bits = masks >> np.arange(n) & 1
    sets: Mask = bits.astype(np.bool_)
    return sets


def prepare_subsets(geometry: Geometry, noise: NoiseModel) -> NDArray[Any]:
    """Return the least-squares part of all 2^n sets of channels, (2^n,) `Subset`."""
    n = geometry.n
    subsets = allocate(Subset, 1 << n)
    bits = all_sets(n)
    used = bits[:, :, None] * geometry.axes
    singular = np.linalg.svd(used, compute_uv=False)
    worst = singular[:, -1]
    best = singular[:, 0]
    spans = (bits.sum(axis=1) >= 3) & (worst >= MIN_SINGULAR_RATIO * best)
    subsets["spans"] = spans
    subsets["spare"] = spans & (worst >= MIN_SPARE_RATIO * best)
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
    """Write into each subset whether a method can run on it, and what it can detect.

    ``can_run`` (n + 1,) states for each number of channels whether the method runs.
    """
    n = geometry.n
    bits = all_sets(n)
    count = bits.sum(axis=1)
    enough = (subsets["spans"] != 0) & (count >= MIN_CHANNELS)
    runs = enough & np.array(can_run)[count]
    subsets["refused"] = enough & ~runs
    subsets["detectable"] = 0
    gain = np.linalg.pinv(bits[runs][:, :, None] * geometry.axes).transpose(0, 2, 1)
    share = 1 - np.einsum("kij,ij->ki", gain, geometry.axes)
    sensitivity = np.sqrt(np.clip(share, 0, None))
    seen = bits[runs] & (sensitivity >= MIN_SENSITIVITY)
    subsets["detectable"][runs] = (seen << np.arange(n)).sum(axis=1)


@compiled
def number_in(mask: int, n: int) -> int:
    """Return the number of channels in a set, of n."""
    count = 0
    for i in range(n):
        count += mask >> i & 1
    return count


@compiled
def fill_rate(subset: Subset, n: int, mask: int, z: Array, rate: Array) -> None:
    """Write the least-squares rate (3,) of the channels in mask, rad/s, or NaN."""
    for a in range(3):
        total = 0.0
        for i in range(n):
            if mask >> i & 1:
                total += subset.gain[i, a] * z[i]
        rate[a] = total if subset.spans else math.nan
