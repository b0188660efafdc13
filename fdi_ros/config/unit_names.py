# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Names of units, taken from the topics that carry them, and of their channels in short."""

from __future__ import annotations

import re
from collections.abc import Sequence

from fdi_ros.system.text import own_numbers

_NOT_IN_NAMES = re.compile(r"[^A-Za-z0-9]+")
_BARE = ("", "imu", "imus")
"""Words before the number of an IMU that say no more than ``imu``."""


def unit_names(topics: Sequence[str]) -> list[str]:
    """Name each unit after its topic.

    Topics with numbers behind ``imu``, or behind no word, and no number twice, give
    ``imu_<number>``: ``/imu_0/data`` and ``/imu_1/data`` give ``imu_0`` and ``imu_1``. Other
    topics are named by the parts in which they differ: ``/front/imu`` and ``/rear/imu`` give
    ``front`` and ``rear``, ``/robot1/imu`` and ``/robot2/imu`` give ``robot1`` and
    ``robot2``, ``/bno055`` and ``/icm42688`` keep their names. If these are not unique,
    units are numbered from 0 in the order of the topics.
    """
    if numbers := own_numbers(topics, _BARE):
        return [f"imu_{number}" for number in numbers]
    return _by_difference(topics) or [f"imu_{k}" for k in range(len(topics))]


def _by_difference(topics: Sequence[str]) -> list[str]:
    """Return names by the parts of the topics in which they differ; empty if they are not unique."""
    paths = [topic.strip("/").split("/") for topic in topics]
    same_head = _common(paths)
    same_tail = _common([path[same_head:][::-1] for path in paths])
    differ = [path[same_head : len(path) - same_tail] for path in paths]
    own = [part or path for part, path in zip(differ, paths, strict=True)]
    names = [_NOT_IN_NAMES.sub("_", "_".join(parts)).strip("_") for parts in own]
    named = all(name and not name[0].isdigit() for name in names)
    return names if named and len(set(names)) == len(names) else []


def _common(paths: Sequence[Sequence[str]]) -> int:
    """Return how many parts at the beginning are the same in all paths."""
    count = 0
    for parts in zip(*paths, strict=False):
        if len(set(parts)) > 1:
            break
        count += 1
    return count


def short_names(names: Sequence[str]) -> list[str]:
    """Replace the three axes of a gyro or accelerometer by one name, in the order of the names.

    ``imu_0.x, imu_0.y, imu_0.z`` become ``imu_0``, and those of its accelerometer
    ``imu_0.accel``.
    """
    axes: dict[str, list[str]] = {}
    for name in names:
        axes.setdefault(name[:-1], []).append(name[-1:])
    found: dict[str, None] = {}
    for name in names:
        stem = name[:-1]
        whole = stem.endswith((".", "accel_")) and axes[stem] == ["x", "y", "z"]
        found[stem[:-1] if whole else name] = None
    return list(found)
