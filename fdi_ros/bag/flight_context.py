# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a flight log holds beside the rates: temperatures, throttle and flight modes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.model.samples import Array, Int


class ContextLimits(NamedTuple):
    """Limits of the context of a flight beside its rates."""

    #: values of a course. Beyond, every second one is dropped
    values: int = 2048
    #: shortest interval of the values of a course, us
    interval_us: int = 200_000
    #: changes of the flight mode: the first ones
    modes: int = 500
    #: texts of a log: the first ones
    texts: int = 1000
    #: largest throttle. Larger values are damage: those of old logs pass 1000 a
    #: little
    throttle: float = 1500.0


KEPT = ContextLimits()

COLDEST, HOTTEST = -60.0, 130.0
"""Range of possible temperatures of an IMU, degC."""


class Course(NamedTuple):
    """A quantity over time."""

    stamp: Int
    """(k,) times of recording, ns."""
    value: Array
    """(k,) values."""


class Mode(NamedTuple):
    """A change of the flight mode."""

    stamp: int
    """Time of recording, ns; us of the samples while the log is read."""
    name: str
    """The new mode, as the autopilot calls it."""


@dataclass(frozen=True)
class FlightContext:
    """What a log holds of the flight beside the rates."""

    origins: dict[str, str] = field(default_factory=dict)
    """Message and instance of the log that each topic was made of, and the device."""
    temperatures: dict[str, Course] = field(default_factory=dict)
    """Temperature of the IMU of each topic, degC."""
    throttle: Course | None = None
    """Throttle from 0 to 1. None: not logged."""
    modes: tuple[Mode, ...] = ()
    """Changes of the flight mode, in order."""


class Thinned:
    """A course in bounded memory, in the time of the samples of a log."""

    def __init__(self, low: float, high: float) -> None:
        """``low`` and ``high``: range of possible values. Others are left out."""
        self._range = low, high
        self._interval = KEPT.interval_us
        self._stamps: list[int] = []
        self._values: list[float] = []

    def add(self, stamp: NDArray[Any], value: NDArray[Any]) -> None:
        """Take values (k,) at stamps (k,), us, in the order of the log."""
        low, high = self._range
        value = value.astype(np.float64)
        good = np.isfinite(value) & (value >= low) & (value <= high)
        stamp = stamp[good].astype(np.int64)
        value = value[good]
        interval = stamp // self._interval
        for k in np.flatnonzero(np.diff(interval, prepend=-1)).tolist():
            at = int(stamp[k])
            if self._stamps and 0 <= at - self._stamps[-1] < self._interval:
                continue
            self._stamps.append(at)
            self._values.append(float(value[k]))
            if len(self._stamps) > KEPT.values:
                del self._stamps[1::2], self._values[1::2]
                self._interval *= 2

    def course(self, shift: int) -> Course | None:
        """Return the values with times of recording. ``shift``: us. None: no value."""
        if not self._stamps:
            return None
        stamp = (np.array(self._stamps, dtype=np.int64) + shift) * 1000
        order = np.argsort(stamp, kind="stable")
        return Course(stamp[order], np.array(self._values)[order])
