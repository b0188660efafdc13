# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Recognise accelerometers in g or mg by the size of gravity."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fdi_ros.inspection.topics import TopicReport
from fdi_ros.model.quantity import FORCE
from fdi_ros.system.text import figures, listed, shown

#: usual specific force in g and in mg
UNITS = {"g": 1.0, "mg": 1000.0}
#: largest relative distance of the usual force from that
NEAR_GRAVITY = 0.1
#: quantiles of the size of the force that are near the usual one, too: without gravity, the size
#: of an acceleration falls to zero
SPREAD = (0.05, 0.95)
#: largest relative distance of these from the usual force
LARGEST_SPREAD = 0.3
#: fewest blocks of values: fewer are chance
FEWEST_WINDOWS = 40


class _InGravity(NamedTuple):
    """A unit whose accelerometers measure in units of gravity."""

    name: str
    #: g or mg
    unit: str
    #: usual size of the force, in that unit
    size: float


def in_gravity(chosen: Sequence[TopicReport]) -> str:
    """Return what shows that accelerometers of topics are in g or mg. Empty: nothing does."""
    found = [one for report in chosen if (one := _in_gravity(report)) is not None]
    if not found:
        return ""
    words = [
        f"the accelerometers of {listed([one.name for one in found if one.unit == unit])} usually"
        f" show {figures(usual, 3)}, as in {unit}; gravity is 9.81 m/s^2"
        for unit in UNITS
        if (sizes := [one.size for one in found if one.unit == unit])
        and (usual := float(np.median(sizes)))
    ]
    return "; ".join(words)


def _in_gravity(report: TopicReport) -> _InGravity | None:
    """Return the unit of the accelerometers of a topic. None: m/s^2, or it is not known."""
    if report.channels != 3 or report.forces.channels != 3 or report.forces.empty:
        return None
    sizes = FORCE.natural * np.linalg.norm(report.forces.means, axis=1)
    if len(sizes) < FEWEST_WINDOWS:
        return None
    usual = float(np.median(sizes))
    spread = np.quantile(sizes, SPREAD)
    for unit, size in UNITS.items():
        near = abs(usual / size - 1.0) < NEAR_GRAVITY
        if near and (np.abs(spread / usual - 1.0) < LARGEST_SPREAD).all():
            return _InGravity(shown(report.topic.name), unit, usual)
    return None
