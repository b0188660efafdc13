# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Whether a fault began suddenly: healthy biases move slowly.

The change at the onset is the mean of some samples from the onset on less the mean of as
many samples before it. Errors that were there before cancel, and a healthy bias moves less
in this time than since the onset.
"""

from __future__ import annotations

import math

from fdi_ros.compiling.compiled import compiled
from fdi_ros.core.algebra import along
from fdi_ros.detectors.naming import (
    LEAST_PRESENCE,
    Inference,
    explain_with_misfit,
    noise_of_mean,
)
from fdi_ros.estimator.error_states import (
    ONE,
    SIGNALS,
    SPEED,
    fill_signals,
    project,
    subtract_errors,
)
from fdi_ros.estimator.estimator import Constants, Estimator, Total, total_before
from fdi_ros.estimator.noise import MOTION

LARGEST_STRETCH = 1.5
"""Largest length of a stored time over the time asked for. Sums of long ago are stored for
some moments only, and in a longer time a healthy bias moves farther."""


@compiled
def samples_of_change(params: Constants, kf: Estimator, moves_in: float) -> int:
    """Return the number of samples on each side of the onset that show the change best.

    Noise falls with the number, and the move of a healthy bias grows with it: by
    ``Constants.bias_move`` in ``moves_in``, s. The variance of a change over w seconds is
    ``2 v T / w + (w move / moves_in)^2``, least where ``w^3 = v T (moves_in / move)^2``.
    """
    noise = 0.0
    for i in range(params.sensors.n):
        noise = max(noise, noise_of_mean(params, kf.noise, i, params.length))
    noise *= params.length * params.period
    ratio = moves_in / params.bias_move
    seconds = (noise * ratio * ratio) ** (1.0 / 3.0)
    return max(int(min(seconds, moves_in) / params.period), params.length)


@compiled
def explain_change(
    params: Constants, kf: Estimator, inference: Inference, onset: int, size: int
) -> bool:
    """Explain the change at the onset; return whether its samples are stored.

    Each healthy bias may have moved by ``inference.moved``, rad/s.
    """
    total_before(kf, onset - size, inference.before, params.sensors.n)
    total_before(kf, onset, inference.middle, params.sensors.n)
    total_before(kf, onset + size, inference.until, params.sensors.n)
    first = inference.middle.sample - inference.before.sample
    second = inference.until.sample - inference.middle.sample
    if not size <= LARGEST_STRETCH * first <= LARGEST_STRETCH**2 * size:
        return False
    if not size <= LARGEST_STRETCH * second <= LARGEST_STRETCH**2 * size:
        return False
    fill_change(params, kf, inference, first, second)
    subtract_errors(
        params.layout, kf.states, inference.at.signals, inference.y, inference.y
    )
    project(params.layout, kf.states, inference.at)
    fill_covariance_of_change(params, kf, inference, min(first, second))
    explain_with_misfit(params, inference)
    return True


@compiled
def fill_change(
    params: Constants, kf: Estimator, inference: Inference, first: int, second: int
) -> None:
    """Compute the changes of the values and of the motion: ``first`` samples before, ``second`` after the onset."""
    n = params.sensors.n
    layout = params.layout
    before, middle, until = inference.before, inference.middle, inference.until
    inference.mask = 0
    for i in range(n):
        count = middle.count[i] - before.count[i]
        counted = until.count[i] - middle.count[i]
        missing = count < LEAST_PRESENCE * first or counted < LEAST_PRESENCE * second
        if kf.mask >> i & 1 and not missing:
            inference.mask |= 1 << i
            mean = (until.values[i] - middle.values[i]) / counted
            inference.y[i] = mean - (middle.values[i] - before.values[i]) / count
    inference.judged = inference.mask & kf.judged
    moves = 1.0 if kf.noise.regime == MOTION else 0.0
    # A wrong range changes its unit by the gain of the whole rate, not of the change.
    inference.steady = False
    for a in range(3):
        rate = (until.rate[a] - middle.rate[a]) / second
        inference.rate[a] = moves * (rate - (middle.rate[a] - before.rate[a]) / first)
        turn = (until.instant[a] - middle.instant[a]) / second
        turn -= (middle.instant[a] - before.instant[a]) / first
        inference.change[a] = moves * turn / params.period
    for i in range(n):
        axis = params.sensors.axes[i]
        inference.angular_acceleration[i] = along(axis, inference.change)
    signals = inference.at.signals
    fill_signals(layout, inference.rate, inference.angular_acceleration, signals)
    for i in range(n):
        for k in range(SIGNALS):
            if layout.by[k] == ONE:
                signals[i, k] = 0.0
            elif layout.by[k] == SPEED:
                speed = mean_speed(middle, until, i) - mean_speed(before, middle, i)
                signals[i, k] = moves * speed


@compiled
def mean_speed(since: Total, until: Total, i: int) -> float:
    """Return the mean absolute rate along channel i between two moments, rad/s."""
    return (until.speed[i] - since.speed[i]) / (until.sample - since.sample)


@compiled
def fill_covariance_of_change(
    params: Constants, kf: Estimator, inference: Inference, size: int
) -> None:
    """Compute the covariance of the difference of two means of ``size`` samples each."""
    n = params.sensors.n
    longest = kf.noise.longest
    moves = 1.0 if kf.noise.regime == MOTION else 0.0
    for i in range(n):
        for j in range(n):
            line = kf.shared.line_covariance[i, j]
            if size >= params.length:
                line *= math.sqrt(longest[i] * longest[j])
            inference.covariance[i, j] = inference.at.covariance[i, j]
            inference.covariance[i, j] += 2.0 * line / size
        noise = noise_of_mean(params, kf.noise, i, size) + inference.louder[i] / size
        speed = mean_speed(inference.before, inference.until, i)
        nonlinear_error = moves * params.nonlinearity[i] * speed
        # The mean of what a turn adds is the change of the rate, whatever is between.
        timing_error = params.timing[i] * inference.angular_acceleration[i]
        inference.covariance[i, i] += (
            2.0 * (noise + nonlinear_error * nonlinear_error)
            + timing_error * timing_error
            + inference.moved * inference.moved
            + kf.force_variance
        )
