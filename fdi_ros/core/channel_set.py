# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Sets of channels: one bit each, from the first channel up; the number of a set is its place in tables of all sets."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from fdi_ros.arrays import Mask


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
