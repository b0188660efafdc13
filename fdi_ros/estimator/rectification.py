# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""How far a healthy bias may have moved: slowly in flight, or by vibration.

Every accelerometer rectifies vibration in its own way: its bias moves as the vibration
begins or ends, at once or as the sensor warms. A fault that begins with such a change must
exceed that move.
"""

from __future__ import annotations

import math

from fdi_ros.compiling.compiled import compiled
from fdi_ros.estimator.estimator import Constants, Estimator
from fdi_ros.estimator.noise import RECENT_BLOCKS

VIBRATION_MEMORY_S = 30.0
"""Time constant with which the strongest vibration is forgotten, s: a bias that was learned in a
vibration moves back after it."""
OTHER = 4.0
"""Ratio of mean squares from which the vibration is another one: twice as strong, or half."""
OTHER_BLOCK = 16.0
"""The same of a single block, whose mean square scatters: with `OTHER`, 1 m/s^2 is named in 24 % of
real flights in place of 94."""
SHOWS = 4.0
"""Time within which a change of the vibration has shown, s: it is averaged for a second, and the end of
a strong one takes longest. With 2 s, accelerometers are named 2.5 s after it ends."""
SETTLES = 5.0
"""Time from a change of the vibration in which the biases follow, s: sensors warm with motors."""
MOVE_TIME = 1.0
"""Age of a fault, s, from which it must exceed what healthy biases move in flight. In simulated
thermal shocks of 6 mrad/s a healthy gyro is named in 17 of 48 flights without this, in 9
with 5 s, and in 2 with 1 s."""


@compiled
def follow_vibration(params: Constants, kf: Estimator) -> None:
    """Follow the mean square of the vibration that the accelerometers feel, once a block."""
    if params.rectified == 0.0:
        return
    n = params.sensors.n
    noise = kf.noise
    vibration = present = expected = 0.0
    for a in range(3):
        vibration += kf.shared.vibration[a]
        present += kf.shared.present[a]
    for i in range(n):
        own = noise.now.sample[i]
        energy = noise.energies[kf.all_blocks % RECENT_BLOCKS, i]
        vibration += (
            3.0 / n * max(own * noise.recent_ratio[i] - params.expected[i], 0.0)
        )
        present += 3.0 / n * max(own * energy - params.expected[i], 0.0)
        expected += 3.0 / n * params.expected[i]
    faded = kf.strongest_vibration * math.exp(-kf.span / VIBRATION_MEMORY_S)
    kf.strongest_vibration = max(vibration, faded)
    usual = kf.usual_vibration + expected
    kf.vibration_changes = is_other(present + expected, usual, OTHER_BLOCK)
    if is_other(vibration + expected, usual, OTHER):
        kf.usual_vibration = vibration
        kf.vibration_changed_at = kf.seconds


@compiled
def is_other(now: float, before: float, ratio: float) -> bool:
    """Whether a vibration is another one than before, by mean squares, (rad/s)^2."""
    return now > ratio * before or now * ratio < before


@compiled
def move_of_healthy_bias(params: Constants, kf: Estimator, age: float) -> float:
    """Return by how much a healthy bias may have moved in the last ``age`` s, standard deviation, rad/s.

    By `Constants.bias_move` in `MOVE_TIME`, or at once where the vibration changed.
    """
    since_change = kf.seconds - age - kf.vibration_changed_at
    changes = kf.vibration_changes and age < SHOWS
    changed = changes or -SHOWS < since_change < SETTLES
    if params.rectified == 0.0 or not changed:
        return min(age / MOVE_TIME, 1.0) * params.bias_move
    return params.rectified * math.sqrt(kf.strongest_vibration)
