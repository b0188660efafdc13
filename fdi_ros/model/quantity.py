# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The two quantities that the channels of a monitor measure."""

from __future__ import annotations

import math
from typing import NamedTuple

STANDARD_GRAVITY = 9.80665  #: m/s^2


class Quantity(NamedTuple):
    """What a group of channels measures, and how large it is beside a body rate.

    Constants of the monitor are in rad/s. Values of another quantity are divided by its
    natural size as they enter and multiplied by it as they leave.
    """

    name: str  #: as in ``a gyro``
    #: of the values, as in reports
    unit: str
    natural: float  #: stands for 1 rad/s, in the unit
    gain_is_fault: bool
    """Whether a wrong gain of a unit makes its channels faulty. Gyros at rest are healthy
    whatever the gain. Gravity shows the gain of accelerometers at all times, as an error of
    the vertical one."""
    louder: float
    """Noise variance over the largest before from which slow noise is unknown anew. Vibration
    moves an accelerometer itself: what it rectifies and folds down comes with its noise."""
    bias_move: float
    """Standard deviation of the move of a healthy bias in flight, in ``turn_on_std``.

    With 0.04 a thermal shock of 6 mrad/s names a healthy gyro in 1 of 16 flights, with 0.06
    in none, and the IMU that warms in a crash is declared at 17 s and 21 s. Accelerometers: 0,
    as a fault of 0.3 m/s^2 would not be named."""
    rectified: float
    """Standard deviation of the move of a bias by vibration, over the root mean square of the
    vibration about all axes. Of accelerometers in nine real flights 0.01 to 0.07, once 0.27.
    0.2 is between these and the 0.4 of simulated flights."""
    largest_move: float
    """By which all healthy biases may move together within half a minute, over the natural size.

    Gyros warm, or feel motors and boosts. Accelerometers rectify vibration, and stop when it
    ends: without such moves healthy ones are named in 26 of 120 simulated flights, with
    them in 3."""


RATE = Quantity("gyro", "rad/s", 1.0, False, math.inf, 0.06, 0.0, 0.04)
#: 150 m/s^2 for 1 rad/s: then nothing is declared in thirty vibrating flights
FORCE = Quantity("accelerometer", "m/s^2", 150.0, True, 16.0, 0.0, 0.2, 0.6 / 150.0)
