# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Rotation between two units of one rigid body, from the rates that both measure."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fdi_ros.model.geometry import ROUNDING
from fdi_ros.model.samples import Array


class TurnLimits(NamedTuple):
    """Which turns show how units are mounted."""

    #: root mean square rotation about any axis while in motion, rad/s: biases are
    #: mostly less
    least_rotation: float = 0.05
    #: windows in motion: with fewer, units are not compared, and no mount is
    #: estimated
    least_windows: int = 20
    #: time over which rates are averaged before units are compared, s: turns by
    #: hand stay, noise goes
    window: float = 0.25
    #: share of the rotation that two units of one body have in common at least.
    #: Vibration and late stamps take the rest
    shared: float = 0.7
    #: angle from axes along axes, rad, up to which a mount is taken for that: the
    #: rest is misalignment
    square: float = np.radians(10.0)


TURNS = TurnLimits()


def find_turn(first: Array, unit: Array) -> tuple[Array, Array, float]:
    """Find the rotation between two units from rates (W, 3) of both, rad/s (Kabsch 1976).

    Returns the rotation (3, 3) with v_first = R v_unit that fits best, the best
    mirrored frame (3, 3), and the variance of the least certain direction, rad^2,
    divided by the mean square residual, (rad/s)^2. That ratio is infinite if the
    units never turn about two axes.
    """
    left, size, right = np.linalg.svd(first.T @ unit)
    handedness = np.sign(np.linalg.det(left @ right))
    sign = np.array([1.0, 1.0, handedness])
    rotation = (left * sign) @ right
    mirrored = (left * sign * [1.0, 1.0, -1.0]) @ right
    if size[1] <= ROUNDING * size[0]:
        return rotation, mirrored, math.inf
    a, b, c = size * sign
    gram = (left * size**2) @ left.T
    spread = ((a * b + b * c + c * a) * np.eye(3) + gram) / (
        (a + b) * (b + c) * (c + a)
    )
    return rotation, mirrored, float(np.linalg.eigvalsh(spread)[-1])


def angle_of(rotation: Array) -> float:
    """Angle of a rotation (3, 3), rad."""
    distance = float(np.linalg.norm(rotation - np.eye(3)))
    return 2.0 * math.asin(min(distance / math.sqrt(8.0), 1.0))
