# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Moves of the biases of accelerometers by vibration.

Every accelerometer rectifies vibration in its own way: its bias moves as the vibration
begins or ends, at once or as the sensor warms. A fault that begins with such a change must
exceed that move.
"""

from __future__ import annotations

import math

from fdi_ros.compiling.compiled import compiled
from fdi_ros.estimator.estimator import Constants, Estimator

LASTS = 30.0
"""Time constant with which the strongest vibration is forgotten, s: a bias that was learned in a
vibration moves back after it."""
OTHER = 4.0
"""Ratio of mean squares from which the vibration is another one: twice as strong, or half."""
SHOWS = 4.0
"""Time within which a change of the vibration has shown, s: it is averaged for a second, and the end of
a strong one takes longest. With 2 s, accelerometers are named 2.5 s after it ends."""
SETTLES = 5.0
"""Time from a change of the vibration in which the biases follow, s: sensors warm with motors."""


@compiled
def follow_vibration(params: Constants, kf: Estimator) -> None:
    """Follow the mean square of the vibration that the accelerometers feel, once a block."""
    if params.rectified == 0.0:
        return
    n = params.sensors.n
    vibration = expected = 0.0
    for a in range(3):
        vibration += kf.shared.vibration[a]
    for i in range(n):
        own = kf.noise.now.sample[i] * kf.noise.recent_ratio[i]
        vibration += 3.0 / n * max(own - params.expected[i], 0.0)
        expected += 3.0 / n * params.expected[i]
    faded = kf.strongest_vibration * math.exp(-kf.span / LASTS)
    kf.strongest_vibration = max(vibration, faded)
    ratio = (vibration + expected) / (kf.usual_vibration + expected)
    if ratio > OTHER or ratio * OTHER < 1.0:
        kf.usual_vibration = vibration
        kf.vibration_changed_at = kf.seconds


@compiled
def move_by_vibration(params: Constants, kf: Estimator, begun: float) -> float:
    """Return by how much a healthy bias may have moved since a time, standard deviation, rad/s.

    Only `Constants.bias_move`, unless the vibration changed then.
    """
    since_change = begun - kf.vibration_changed_at
    if params.rectified == 0.0 or not -SHOWS < since_change < SETTLES:
        return params.bias_move
    return params.rectified * math.sqrt(kf.strongest_vibration)
