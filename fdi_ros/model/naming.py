# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Names for sets of channels as a person would say them: a pair that measures one axis, a unit, all channels."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from fdi_ros.model.geometry import Geometry

PARALLEL = 0.985
"""Two channels measure the same axis from this cosine of the angle between them on: 10 deg."""
_AXES = "xyz"
_FEW = 3
"""Names that are told one by one; of more it is said how many they are, or which few are not among them."""


def are_parallel(geometry: Geometry, channels: Sequence[int]) -> bool:
    """Whether channels, two at least, all measure one axis, with either sign."""
    axes = geometry.axes[list(channels)]
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    return len(channels) > 1 and bool((np.abs(axes @ axes[0]) >= PARALLEL).all())


def lone_pairs(geometry: Geometry) -> list[tuple[int, int]]:
    """Pairs of channels that alone measure one axis: of these no evidence tells which is wrong."""
    pairs = [pair for pair in combinations(range(geometry.n), 2) if are_parallel(geometry, pair)]
    often = np.bincount(np.ravel(pairs).astype(np.intp), minlength=geometry.n)
    return [pair for pair in pairs if (often[list(pair)] == 1).all()]


def whole_units(geometry: Geometry, channels: Sequence[int]) -> list[str]:
    """Names of the units that a set of channels consists of; empty if it consists of other than whole units."""
    inside = [unit for unit in geometry.units if set(channels).issuperset(unit)]
    whole = sum(map(len, inside)) == len(channels)
    return [geometry.channel_names[unit[0]].rpartition(".")[0] for unit in inside] if whole else []


def one_of_words(geometry: Geometry, channels: Sequence[int]) -> str:
    """Say which channels one is of: `the x axis of imu_1 or imu_2`, `imu_1 or imu_2`, `imu_1.x or imu_2.y`."""
    names = [geometry.channel_names[i] for i in channels]
    if len(names) == geometry.n:
        return f"any of the {geometry.n} channels"
    units = whole_units(geometry, channels)
    if units:
        return f"any axis of {_either(units)}"
    parts = [name.rpartition(".") for name in names]
    if are_parallel(geometry, channels):
        if all(unit and axis == parts[0][2] for unit, _, axis in parts):
            return f"the {parts[0][2]} axis of {_either([unit for unit, *_ in parts])}"
        return f"{_either(names)}, which measure one axis,"
    others = [name for i, name in enumerate(geometry.channel_names) if i not in channels]
    if len(names) > _FEW:
        return f"any channel but {_either(others)}" if len(others) <= _FEW else f"any of {len(names)} channels"
    return _either(names)


def all_of_words(geometry: Geometry, channels: Sequence[int]) -> str:
    """Say which channels all are meant: `imu_2.y`, `imu_2`, `imu_2.x and imu_2.y`."""
    names = whole_units(geometry, channels) or [geometry.channel_names[i] for i in channels]
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))


def axis_words(geometry: Geometry, channel: int) -> str:
    """Say what axis of the body a channel measures: `-y`, or its direction."""
    axis = geometry.axes[channel] / np.linalg.norm(geometry.axes[channel])
    largest = int(np.abs(axis).argmax())
    if abs(axis[largest]) >= PARALLEL:
        return f"{'-' if axis[largest] < 0 else ''}{_AXES[largest]}"
    return " ".join(f"{value:.2f}" for value in axis)


def _either(names: Sequence[str]) -> str:
    return " or ".join(filter(None, [", ".join(names[:-1]), names[-1]]))
