# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Angular acceleration of the body, causally from the rates so far: what the timing term of the noise model needs."""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from fdi_ros.core.compiled import compiled
from fdi_ros.core.record import Vector, Whole, record

LONGEST = 1024
"""Samples that the window spans at most; of a longer one the last so many count."""


@record
class TimedRate:
    """A body rate and its time."""

    stamp: Whole  # ns
    rate: Vector  # rad/s; NaN where there was none


@record
class Acceleration:
    """Rates of the last samples.

    The acceleration is the difference of the rate to the latest sample at least `window` older, at least one sample.
    A difference over one sample at 1 kHz would turn a fault's own step into so much acceleration that the timing
    term hides the fault; over 10 ms it cannot. Where there was no rate at the older end, the one before it is taken.
    """

    window: Whole  # ns
    count: Whole  # samples so far
    oldest: Whole  # number of the sample that the difference is taken to
    history: Annotated[list[TimedRate], LONGEST]  # by number of the sample, modulo `LONGEST`
    known: TimedRate  # last rate there was up to the oldest
    known_count: Whole  # 0: there was none yet
    value: Vector  # rad/s^2; zero where it is not known


@compiled
def take_rate(own: Acceleration, stamp: int, rate: NDArray[np.float64]) -> None:
    """Take the rate (3,) of one sample; the acceleration is then in ``own.value``."""
    here = own.count
    own.count += 1
    newest = own.history[here % LONGEST]
    newest.stamp = stamp
    for a in range(3):
        newest.rate[a] = rate[a]
        own.value[a] = 0.0
    if here == 0:
        note_known(own, newest)
        return
    while own.oldest + 1 < here and (
        here - own.oldest >= LONGEST or own.history[(own.oldest + 1) % LONGEST].stamp <= stamp - own.window
    ):
        own.oldest += 1
        note_known(own, own.history[own.oldest % LONGEST])
    if own.known_count and math.isfinite(rate[0]):
        seconds = (stamp - own.known.stamp) * 1e-9
        for a in range(3):
            own.value[a] = (rate[a] - own.known.rate[a]) / seconds


@compiled
def note_known(own: Acceleration, one: TimedRate) -> None:
    """Remember the rate of the oldest sample if it had one."""
    if math.isfinite(one.rate[0]):
        own.known_count = 1
        own.known.stamp = one.stamp
        for a in range(3):
            own.known.rate[a] = one.rate[a]
