# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The second of two triads turned so that faults are easier to tell apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fdi_ros.arrays import Array
from fdi_ros.model.geometry import Geometry

ORTHOGONAL = 0.8
"""Determinant of the axes of a triad at least."""
OPTIMUM = 2 / 3
"""Smallest largest |rho| of two orthogonal triads, at ``R = 2/3 ones - I`` and equivalent rotations."""


@dataclass(frozen=True)
class Turn:
    """The second of two triads, turned so that faults are easier to tell apart."""

    largest_rho: float
    """Between channels of different triads, as mounted."""
    freedom: float
    """Angle by which the triad may be turned, rad."""
    better: float
    """Largest |rho| then."""
    rotation: Array
    """(3, 3) to be applied to the second triad, in the body frame: ``R_new = rotation @ R``."""

    @property
    def angle(self) -> float:
        """Angle of the rotation, rad."""
        return float(np.arccos(np.clip((np.trace(self.rotation) - 1) / 2, -1, 1)))

    @property
    def axis(self) -> Array:
        """(3,) axis of the rotation in the body frame; zero where there is none."""
        vector = np.array([self.rotation[2, 1], self.rotation[0, 2], self.rotation[1, 0]]) - [
            self.rotation[1, 2],
            self.rotation[2, 0],
            self.rotation[0, 1],
        ]
        norm = float(np.linalg.norm(vector))
        return vector / norm if norm > 1e-9 else np.zeros(3)


def two_triads(geometry: Geometry) -> bool:
    """Whether the channels are two units of three nearly orthogonal axes."""
    return geometry.n == 6 and all(abs(np.linalg.det(half)) > ORTHOGONAL for half in np.split(geometry.axes, 2))


def largest_rho(geometry: Geometry) -> float:
    """Largest |rho| between channels of the first triad and of the second."""
    return float(np.abs(geometry.rho[:3, 3:]).max())


def best_turn(geometry: Geometry, freedom: float) -> Turn:
    """Turn the second of two triads within a cone so that the largest |rho| between the triads becomes smallest.

    Parameters
    ----------
    geometry
        Six channels, three of each triad.
    freedom
        Largest angle of the turn, rad.
    """
    rng = np.random.default_rng(0)
    best, found = np.zeros(3), _largest_turned(geometry.axes, np.zeros(3))
    # |rho| between triads is a matter of one rotation: three numbers, a kinked function, many equal optima. Draws
    # over the cone, then smaller and smaller steps around the best few, are as good as anything and need no solver.
    direction = rng.standard_normal((1500, 3))
    radius = freedom * rng.random(1500) ** (1 / 3)
    draws = direction / np.linalg.norm(direction, axis=1)[:, None] * radius[:, None]
    values = np.array([_largest_turned(geometry.axes, vector) for vector in draws])
    for k in np.argsort(values)[:4]:
        vector, value = _descended(geometry.axes, draws[k], float(values[k]), freedom, rng)
        if value < found - 1e-6:
            best, found = vector, value
    return Turn(largest_rho(geometry), freedom, found, rotation_of(best))


def _descended(
    axes: Array, vector: Array, value: float, freedom: float, rng: np.random.Generator
) -> tuple[Array, float]:
    step = 0.2 * freedom
    while step > 1e-5:
        for _ in range(30):
            tried = vector + step * rng.standard_normal(3)
            norm = float(np.linalg.norm(tried))
            tried *= min(1.0, freedom / max(norm, 1e-12))
            if (other := _largest_turned(axes, tried)) < value:
                vector, value = tried, other
        step *= 0.6
    return vector, value


def _largest_turned(axes: Array, vector: Array) -> float:
    """Largest |rho| between the triads with the second one turned by a rotation vector, rad."""
    turned = np.vstack([axes[:3], axes[3:] @ rotation_of(vector).T])
    S = np.eye(6) - turned @ np.linalg.pinv(turned)
    scale = np.sqrt(np.maximum(np.diag(S), 1e-9))
    return float(np.abs((S / np.outer(scale, scale))[:3, 3:]).max())


def rotation_of(vector: Array) -> Array:
    """Rotation matrix (3, 3) of a rotation vector (3,) rad, by Rodrigues."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K)
