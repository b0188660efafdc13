# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Whether the error of a channel follows the temperature of its unit.

The bias of a MEMS sensor changes with its temperature T, nearly in proportion over some
degrees. With means over spans of time, the model of an error e is

    e = c + s v + k (T - T0)

v is the vector that the other channels measure. The term s v holds errors of scale and of
mounting. The model competes with faults that know no temperature: the last term is replaced
by a step, or by a straight line from some time on.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fdi_ros.model.quantity import FORCE, RATE
from fdi_ros.model.samples import Array


class _WarmingSigns(NamedTuple):
    """What shows that an error follows the temperature."""

    #: smallest number of means. The model has five constants, and a step two more
    #: choices
    spans: int = 20
    #: smallest range of temperature, degC. Healthy flights in the recorded logs
    #: that begin with a warm vehicle have 0.2 to 1.5 degC
    warming: float = 3.0
    #: smallest share of the variance beside s v that the temperature explains. In
    #: the log of a real gyro that warms it is 0.987 and 0.993, and of its healthy
    #: channels at most 0.83
    explained: float = 0.9
    #: smallest share of the whole variance that the temperature explains alone.
    #: With less, the error is mostly one of scale
    of_all: float = 0.5
    #: unexplained variance of a model over that of another from which on the other
    #: is the better one. In that log steps and lines leave 5 to 32 times as much as
    #: the temperature. Of 16 000 random walks beside temperatures that have no part
    #: in them, a ratio of 1.5 calls 44 warming, 2 calls 14 and 3 none. It leaves
    #: 102 open
    rival_ratio: float = 3.0
    #: share of a sum of squares, or of a singular value, that is rounding error
    rounding: float = 1e-9


WARMING_SIGNS = _WarmingSigns()

LARGEST_SLOPE = {RATE.unit: 0.01, FORCE.unit: 0.03}
"""Largest change of a bias by temperature, in the unit of the channel per degC.
About twice that of the data sheet of the MPU-6000 (PS-MPU-6000A-00): 20 deg/s over the 60 degC
from 25 to 85 degC, and 60 mg over the 45 degC from 25 to 70 degC. A larger error is a fault."""


@dataclass(frozen=True)
class Warming:
    """An error that goes with the temperature of the unit."""

    channel: str
    """Name of the channel."""
    unit: str
    """Name of its unit."""
    slope_per_c: float
    """Change of the error with the temperature, in the unit of the channel (rad/s or m/s^2) per degC."""
    range_c: float
    """Difference of the highest and the lowest temperature, degC. Negative: the unit cools."""
    explained: float
    """Share of the variance of the error that the temperature explains, without the part that goes
    with the rate."""
    certain: bool
    """Whether no step and no steady drift explains the error nearly as well."""


class Fit(NamedTuple):
    """How an error goes with a temperature."""

    slope: float
    """Change of the error, in its unit per degC."""
    range: float
    """Difference of the highest and the lowest temperature, degC. Negative: it falls with time."""
    explained: float
    """Share of the variance beside s v that the temperature explains."""
    certain: bool
    """Whether steps and straight lines in time explain the error worse by `WARMING_SIGNS.rival_ratio`."""


def fit_warming(
    time: Array,
    error: Array,
    temperature: Array,
    vector: Array,
    largest_slope: float = LARGEST_SLOPE[RATE.unit],
) -> Fit | None:
    """Return how an error follows a temperature. None: it does not.

    Parameters
    ----------
    time
        (k,) times, s, ascending.
    error
        (k,) mean errors of a channel around these times, rad/s or m/s^2.
    temperature
        (k,) temperatures of its unit, degC.
    vector
        (k, 3) means of what the other channels measure, in the unit of the error.
    largest_slope
        Largest slope of a healthy sensor, in the unit of the error per degC.

    Rows with a value that is not finite are left out.
    """
    rows = np.column_stack([time, error, temperature, vector])
    rows = rows[np.isfinite(rows).all(axis=1)]
    if len(rows) < WARMING_SIGNS.spans:
        return None
    time, error, temperature = rows[:, :3].T
    warming = float(np.ptp(temperature))
    if warming < WARMING_SIGNS.warming:
        return None
    constant = np.ones((len(rows), 1))
    alone = _Regression(error, constant)
    if alone.share_left(temperature[:, None])[0] > 1.0 - WARMING_SIGNS.of_all:
        return None
    beside = _Regression(error, np.hstack([constant, rows[:, 3:]]))
    left = float(beside.share_left(temperature[:, None])[0])
    slope = beside.slope(temperature)
    if not (left <= 1.0 - WARMING_SIGNS.explained and abs(slope) <= largest_slope):
        return None
    since = time[:, None] - time[None, :-1]
    step = float(beside.share_left((since > 0.0).astype(np.float64)).min())
    line = float(beside.share_left(np.maximum(since, 0.0)).min())
    left = max(left, WARMING_SIGNS.rounding)
    if (
        step < WARMING_SIGNS.rival_ratio * left
        or WARMING_SIGNS.rival_ratio * line < left
    ):
        return None
    falls = _Regression(temperature, constant).slope(time) < 0.0
    return Fit(
        slope,
        -warming if falls else warming,
        1.0 - left,
        line >= WARMING_SIGNS.rival_ratio * left,
    )


class _Regression:
    """Regression of an error (k,) on one more column beside those that are always there.

    By the theorem of Frisch, Waugh and Lovell: error and column without what the columns
    (k, c) explain give slope and unexplained variance of the whole regression.
    """

    def __init__(self, error: Array, columns: Array) -> None:
        basis, size, _ = np.linalg.svd(columns, full_matrices=False)
        self._basis = basis[:, size > WARMING_SIGNS.rounding * size[0]]
        self._error = self._rest(error[:, None])[:, 0]
        self._square = float(self._error @ self._error)
        total = float(error @ error)
        if self._square <= WARMING_SIGNS.rounding**2 * total:
            # What is left is rounding error, and nothing has to be explained.
            self._square = 0.0

    def share_left(self, candidates: Array) -> Array:
        """Return the share of the variance that each of the candidates (k, m) leaves, (m,)."""
        rest = self._rest(candidates)
        square = (rest**2).sum(axis=0)
        known = square > WARMING_SIGNS.rounding * (candidates**2).sum(axis=0)
        if not self._square:
            return np.ones(len(square))
        product = self._error @ rest
        explained = product**2 / np.where(known, square * self._square, np.inf)
        return np.clip(1.0 - explained, 0.0, 1.0)

    def slope(self, candidate: Array) -> float:
        """Return the coefficient of a candidate (k,)."""
        rest = self._rest(candidate[:, None])[:, 0]
        return float(self._error @ rest) / float(rest @ rest)

    def _rest(self, values: Array) -> Array:
        """Return values (k, m) without what the columns explain."""
        rest: Array = values - self._basis @ (self._basis.T @ values)
        return rest
