# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Body angular acceleration, from the rates of the last samples."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import compiled
from fdi_ros.core.records import ACCELERATION_SAMPLES, Acceleration


@compiled
def differentiate_rate(
    acceleration: Acceleration, stamp: int, rate: NDArray[np.float64]
) -> None:
    """Add the rate (3,) of one sample, and update ``acceleration.value``."""
    here = acceleration.count
    acceleration.count += 1
    newest = acceleration.history[here % ACCELERATION_SAMPLES]
    newest.stamp = stamp
    for a in range(3):
        newest.rate[a] = rate[a]
        acceleration.value[a] = 0.0
    if here == 0:
        note_known(acceleration, 0)
        return
    while acceleration.oldest + 1 < here and (
        here - acceleration.oldest >= ACCELERATION_SAMPLES
        or acceleration.history[(acceleration.oldest + 1) % ACCELERATION_SAMPLES].stamp
        <= stamp - acceleration.window
    ):
        note_known(acceleration, acceleration.oldest + 1)
    if acceleration.has_last_rate and math.isfinite(rate[0]):
        seconds = (stamp - acceleration.last_rate.stamp) * 1e-9
        for a in range(3):
            acceleration.value[a] = (rate[a] - acceleration.last_rate.rate[a]) / seconds


@compiled
def note_known(acceleration: Acceleration, oldest: int) -> None:
    """Move the oldest sample to a number, and store its rate if it has one."""
    acceleration.oldest = oldest
    one = acceleration.history[oldest % ACCELERATION_SAMPLES]
    if math.isfinite(one.rate[0]):
        acceleration.has_last_rate = 1
        acceleration.last_rate.stamp = one.stamp
        for a in range(3):
            acceleration.last_rate.rate[a] = one.rate[a]
