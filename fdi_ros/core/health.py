# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Checks of each channel by itself: finite, in range, delivering at all, and not the same value for too long.

A value that repeats is no defect by itself: a quantised sensor at rest repeats for minutes. It counts after a much
longer time, or against motion that the other channels see along this channel's axis (`stuck.py`).
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from fdi_ros.core.compiled import compiled
from fdi_ros.core.record import MAX_CHANNELS, Channels, Counts, Flags, Stamps, Whole, record


class Condition(IntEnum):
    """What is wrong with one value by itself; the larger number wins."""

    FINE = 0
    MISSING = 1
    NON_FINITE = 2
    OUT_OF_RANGE = 3
    FROZEN = 4
    SILENT = 5
    NON_FINITE_LASTING = 6


FINE, MISSING, NON_FINITE = int(Condition.FINE), int(Condition.MISSING), int(Condition.NON_FINITE)
OUT_OF_RANGE, FROZEN, SILENT = int(Condition.OUT_OF_RANGE), int(Condition.FROZEN), int(Condition.SILENT)
NON_FINITE_LASTING = int(Condition.NON_FINITE_LASTING)
NOT_BAD = -(1 << 62)
"""Instead of the stamp at which a run of non-finite values began."""


@record
class HealthSettings:
    """Limits and times of the checks."""

    max_rate: Channels  # rad/s
    non_finite_time: Whole  # ns
    stuck_time: Whole  # ns; 0: never stuck
    rest_time: Whole  # ns; 0: never frozen
    stale_time: Whole  # ns
    recovery_time: Whole  # ns


@record
class Health:
    """What the checks remember of the samples before, and how each channel fares in this one."""

    begun: Whole  # samples so far
    value: Channels  # last finite value delivered, rad/s; NaN before the first
    run_stamp: Stamps  # when it was first seen, ns
    received_stamp: Stamps  # of the last sample that the channel delivered, ns
    bad_stamp: Stamps  # start of the present run of non-finite values, ns, or `NOT_BAD`
    condition: Flags  # `Condition` in this sample
    counts: Annotated[NDArray[np.int64], "i8", (len(Condition), MAX_CHANNELS)]  # samples in each condition
    samples: Counts  # samples delivered
    stuck: Counts  # samples that repeated a value against the motion of the others
    step: Channels  # smallest change of the value so far, rad/s: that of a quantised sensor; 0 before any


@compiled
def check(
    limits: HealthSettings,
    health: Health,
    n: int,
    stamp: int,
    z: NDArray[np.float64],
    received: NDArray[np.uint8],
) -> None:
    """Check the values z (n,) of one sample; results in ``health.condition``."""
    if health.begun == 0:
        for i in range(n):
            health.value[i] = math.nan
            health.run_stamp[i] = health.received_stamp[i] = stamp
            health.bad_stamp[i] = NOT_BAD
    health.begun += 1
    for i in range(n):
        condition = check_channel(limits, health, i, stamp, z[i], received[i] != 0)
        health.condition[i] = condition
        health.counts[condition, i] += 1
        if condition != MISSING and condition != SILENT:
            health.samples[i] += 1


@compiled
def check_channel(limits: HealthSettings, health: Health, i: int, stamp: int, value: float, received: bool) -> int:
    """Check one value and remember it; return its `Condition`."""
    # Across a hole it is unknown what the value was: a run begins anew.
    hole = stamp - health.received_stamp[i] > limits.stale_time
    condition = MISSING
    if received:
        health.received_stamp[i] = stamp
        if math.isfinite(value):
            if value != health.value[i] or hole:
                health.run_stamp[i] = stamp
            change = abs(value - health.value[i])
            if change > 0.0 and (change < health.step[i] or health.step[i] == 0.0):
                health.step[i] = change
            health.value[i] = value
            health.bad_stamp[i] = NOT_BAD
            condition = OUT_OF_RANGE if abs(value) >= limits.max_rate[i] else FINE
        else:
            if health.bad_stamp[i] == NOT_BAD or hole:
                health.bad_stamp[i] = stamp
            lasting = stamp - health.bad_stamp[i] >= limits.non_finite_time
            condition = NON_FINITE_LASTING if lasting else NON_FINITE
    if condition == FINE and limits.rest_time and stamp - health.run_stamp[i] >= limits.rest_time:
        condition = FROZEN
    if stamp - health.received_stamp[i] > limits.stale_time:
        condition = SILENT
    return condition
