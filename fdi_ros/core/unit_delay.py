# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""How late the stamps of each unit are, from what its channels do in motion.

Where the stamps of unit u are late by T_u, its values are those of an earlier instant, ``z_i(t) = h_i omega(t - T_u)``:
they are off by ``-T_u h_i a`` with a the angular acceleration. Least squares over the last seconds, weights
``1 / noise_std^2``, with a prior of zero mean; the common delay shows in no residual, and stays at zero.
A clock may run fast or slow: over those seconds a delay is a straight line, estimated with its slope; its value is that
at their end.

Over a block of some milliseconds, longer while the rate changes by no more than its noise, the mean residual is set
against the change of the rate from its start to its end: both are of the same time, and no difference lags.
"""

from __future__ import annotations

import math
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.core.bank import Circumstances, Sensors
from fdi_ros.core.compiled import compiled
from fdi_ros.core.record import MAX_UNITS, Channels, Mask, Real, Vector, Whole, record
from fdi_ros.core.subsets import find_rate

BLOCK = 9_000_000
"""ns; at least one sample."""
LONGEST = 100_000_000
"""ns; a block in which the rate has not changed by then shows nothing, and neither does a longer hole."""
LEAST_CHANGE = 30.0
"""Square of that change in variances of its noise: with 3 degrees of freedom, noise exceeds it in 1e-6 of blocks.
Noise in the change would pass for motion, and of a delay that is there nothing would be seen in it."""
LATE, SURE = 0.003, 4.0
"""A unit is late as a whole beyond so many s, surely: then its stamps are why its channels disagree in motion."""
EXPLAINED = 0.3
"""Delays are accepted while they explain so large a share of the residuals, times without a turn included."""
KNOWN_SHARE = 0.4
"""A delay that is known counts as this share of it in standard deviations: it is there, but no larger."""
MEMORY = 10.0
"""s."""
SLOPE = 1e-4
"""Standard deviation of the slope of a delay, beforehand, s/s: two clocks differ by some 100 ppm at most."""

Units = Annotated[NDArray[np.float64], "f8", (MAX_UNITS,)]
Lines = Annotated[NDArray[np.float64], "f8", (2 * MAX_UNITS,)]
Pairs = Annotated[NDArray[np.float64], "f8", (2 * MAX_UNITS, 2 * MAX_UNITS)]


@record
class DelaySettings:
    """Which channels share stamps."""

    units: Whole
    members: Annotated[NDArray[np.int64], "i8", (MAX_UNITS,)]  # bits of the channels of each
    prior: Real  # standard deviation of a delay, s


@record
class Delays:
    """What motion has shown of the delays."""

    mask: Mask  # channels of the block
    start: Whole  # of it, ns
    begun: Vector  # rate at its start, rad/s
    last_stamp: Whole  # ns
    last: Channels  # residuals of the last sample, rad/s
    area: Channels  # integral of the residuals over the block, rad
    information: Pairs  # of delays, 1/s^2, and, `MAX_UNITS` places on, of slopes, at the end of the block
    moment: Lines  # of delays, 1/s, and of slopes
    late: Mask  # channels of units that are late as a whole
    scatter: Real  # of the residuals, in variances that the noise explains
    energy: Real  # sum of squares of the residuals beyond noise, of all blocks, in variances
    explained: Real  # of it, by the delays
    value: Units  # delay of the stamps of each unit, s
    spread: Units  # standard deviation of each, s
    turn: Channels  # angular acceleration along each channel, rad/s^2
    column: Channels
    rate: Vector
    matrix: Pairs
    inverse: Pairs


@compiled
def take_for_delay(
    own: Delays,
    limits: DelaySettings,
    sensors: Sensors,
    subsets: NDArray[Any],
    stamp: int,
    mask: int,
    rate: NDArray[Any],
    z: NDArray[Any],
    along: NDArray[Any],
    known: Circumstances,
) -> None:
    """Take one sample: values less their bias z (n,) of the channels in mask, rate (3,) and rate along each (n,)."""
    n = sensors.n
    if own.mask != mask or stamp - own.last_stamp > LONGEST or not math.isfinite(rate[0]):
        own.mask = mask if math.isfinite(rate[0]) else 0
        restart(own, n, stamp, rate)
    else:
        half = 0.5e-9 * (stamp - own.last_stamp)
        for i in range(n):
            own.area[i] += half * (own.last[i] + z[i] - along[i])
    for i in range(n):
        own.last[i] = z[i] - along[i]
    own.last_stamp = stamp
    if stamp - own.start >= BLOCK:
        turned = change_of(own, sensors, rate) >= LEAST_CHANGE
        seconds = (stamp - own.start) * 1e-9
        if not turned and stamp - own.start < LONGEST:
            return
        fade(own, limits, seconds)
        square, checks = square_of(own, sensors, seconds)
        own.energy += square - checks
        if turned:
            if checks > 0.0:
                # A block of several samples has less noise than one; only its excess over that of one is of interest.
                own.scatter += (min(square / checks, 1e4) - own.scatter) * seconds / MEMORY
            conclude_block(own, limits, sensors, subsets, seconds, rate)
        restart(own, n, stamp, rate)
        solve(own, limits, n, known)


@compiled
def change_of(own: Delays, sensors: Sensors, rate: NDArray[Any]) -> float:
    """Return the square of the change of the rate since the start of the block, in variances of its noise."""
    total = 0.0
    for i in range(sensors.n):
        if own.mask >> i & 1:
            h = sensors.axes[i]
            change = h[0] * (rate[0] - own.begun[0]) + h[1] * (rate[1] - own.begun[1]) + h[2] * (rate[2] - own.begun[2])
            total += change * change / (sensors.noise_std[i] * sensors.noise_std[i])
    return 0.5 * total


@compiled
def restart(own: Delays, n: int, stamp: int, rate: NDArray[Any]) -> None:
    """Begin a new block."""
    own.start = stamp
    for a in range(3):
        own.begun[a] = rate[a]
    for i in range(n):
        own.area[i] = 0.0


@compiled
def fade(own: Delays, limits: DelaySettings, seconds: float) -> None:
    """Let what was shown count less, and refer it to a later time: a delay then was that of now less so much slope."""
    keep, m = math.exp(-seconds / MEMORY), limits.units
    own.energy *= keep
    for u in range(m):
        own.moment[MAX_UNITS + u] = keep * (own.moment[MAX_UNITS + u] - seconds * own.moment[u])
        own.moment[u] *= keep
        for v in range(m):
            one, mixed = own.information[u, v], own.information[u, MAX_UNITS + v]
            both = mixed + own.information[MAX_UNITS + u, v]
            slopes = own.information[MAX_UNITS + u, MAX_UNITS + v]
            own.information[MAX_UNITS + u, MAX_UNITS + v] = keep * (slopes - seconds * (both - seconds * one))
            own.information[u, MAX_UNITS + v] = keep * (mixed - seconds * one)
            own.information[MAX_UNITS + u, v] = keep * (own.information[MAX_UNITS + u, v] - seconds * one)
            own.information[u, v] *= keep


@compiled
def square_of(own: Delays, sensors: Sensors, seconds: float) -> tuple[float, float]:
    """Sum of squares of the mean residuals of a block, in variances of one sample, and its degrees of freedom."""
    square, count = 0.0, 0
    for i in range(sensors.n):
        if own.mask >> i & 1:
            residual = own.area[i] / seconds / sensors.noise_std[i]
            square += residual * residual
            count += 1
    return square, max(count - 3.0, 0.0)


@compiled
def conclude_block(
    own: Delays, limits: DelaySettings, sensors: Sensors, subsets: NDArray[Any], seconds: float, rate: NDArray[Any]
) -> None:
    """Add a block to the normal equations."""
    n, subset = sensors.n, subsets[own.mask]
    for i in range(n):
        h = sensors.axes[i]
        change = h[0] * (rate[0] - own.begun[0]) + h[1] * (rate[1] - own.begun[1]) + h[2] * (rate[2] - own.begun[2])
        own.turn[i] = change / seconds if own.mask >> i & 1 else 0.0
    for u in range(limits.units):
        add_unit(own, limits, sensors, subset, u, seconds)


@compiled
def add_unit(own: Delays, limits: DelaySettings, sensors: Sensors, subset: Any, u: int, seconds: float) -> None:
    """Add the row of one unit."""
    n = sensors.n
    for i in range(n):
        own.column[i] = own.turn[i] if limits.members[u] >> i & 1 else 0.0
    find_rate(subset, n, own.mask, own.column, own.rate)
    for i in range(n):
        if own.mask >> i & 1:
            h = sensors.axes[i]
            part = own.column[i] - (h[0] * own.rate[0] + h[1] * own.rate[1] + h[2] * own.rate[2])
            weight = part / (sensors.noise_std[i] * sensors.noise_std[i])
            own.moment[u] -= weight * own.area[i] / seconds
            for v in range(limits.units):
                if limits.members[v] >> i & 1:
                    own.information[u, v] += weight * own.turn[i]


@compiled
def place_of(k: int, units: int) -> int:
    """Place of delay k, or of slope k - units, in the normal equations."""
    return k if k < units else MAX_UNITS + k - units


@compiled
def invert(own: Delays, size: int) -> None:
    """Invert the matrix by Gauss-Jordan elimination: ``own.inverse`` begins as the unit matrix."""
    for k in range(size):
        pivot = own.matrix[k, k]
        for v in range(size):
            own.matrix[k, v] /= pivot
            own.inverse[k, v] /= pivot
        for u in range(size):
            if u != k:
                factor = own.matrix[u, k]
                for v in range(size):
                    own.matrix[u, v] -= factor * own.matrix[k, v]
                    own.inverse[u, v] -= factor * own.inverse[k, v]


@compiled
def solve(own: Delays, limits: DelaySettings, n: int, known: Circumstances) -> None:
    """Find the delays and their standard deviations; the matrix is positive definite."""
    m = limits.units
    inflation = max(own.scatter, 1.0)
    for u in range(2 * m):
        for v in range(2 * m):
            own.matrix[u, v] = own.information[place_of(u, m), place_of(v, m)] / inflation
            own.inverse[u, v] = 1.0 if u == v else 0.0
        std = limits.prior if u < m else SLOPE
        own.matrix[u, u] += 1.0 / (std * std)
    invert(own, 2 * m)
    own.explained = 0.0
    for u in range(2 * m):
        total = 0.0
        for v in range(2 * m):
            total += own.inverse[u, v] * own.moment[place_of(v, m)] / inflation
        own.explained += total * own.moment[place_of(u, m)]
        if u < m:
            own.value[u] = total
            own.spread[u] = math.sqrt(max(own.inverse[u, u], 0.0))
    fill_delay_std(own, limits, n, known)


@compiled
def fill_delay_std(own: Delays, limits: DelaySettings, n: int, known: Circumstances) -> None:
    """Fill in how late the values of each channel may be, for the detector."""
    m = limits.units
    # What delays do not explain goes on in times without a turn, and is something else: an error of a gyro.
    shown = own.explained > EXPLAINED * own.energy
    for u in range(m):
        # The common delay is known to the prior alone, and matters to no residual: against the mean of the units.
        mean, variance = 0.0, own.inverse[u, u]
        for v in range(m):
            mean += own.value[v] / m
            variance -= 2.0 * own.inverse[u, v] / m
            for w in range(m):
                variance += own.inverse[v, w] / (m * m)
        late, variance = own.value[u] - mean, max(variance, 0.0)
        doubt = SURE * math.sqrt(variance)
        # Once late it stays so, until it is surely not: what is known of a delay fades without motion.
        if shown and abs(late) - doubt > LATE:
            own.late |= limits.members[u]
        elif not shown or abs(late) + doubt < LATE:
            own.late &= ~limits.members[u]
        for i in range(n):
            if limits.members[u] >> i & 1:
                error = KNOWN_SHARE * abs(late)
                known.delay_std[i] = (error if shown else min(error, limits.prior)) + math.sqrt(variance)
