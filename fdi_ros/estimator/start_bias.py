# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A bias that no healthy sensor begins with.

A sensor that is faulty from the first sample on looks like one with a large bias, and the states
learn it. Their priors tell how unlikely it is: with the prior variance V of a bias, and its state x
of variance P, x is normal with variance V - P. Where one bias is beyond that, the alternative is
that it has no prior. The states then change by P[:, k] x_k / (V - P[k, k]) (Sherman and Morrison):
this much of the others' biases, and of the fused rate, is in doubt.
"""

from __future__ import annotations

import math

from fdi_ros.compiling.compiled import compiled
from fdi_ros.core.algebra import along
from fdi_ros.estimator.estimator import Constants, Estimator

FAR = 4.0
"""Standard deviations from which a bias is far beyond its prior: one healthy start in 16 000."""
DOUBTED = 3.0
"""The same from which the covariance allows for it, in full from `FAR` on."""
START_FOR = 10.0
"""Time in which the start is judged, s. Later, vibration, holes and warming move healthy biases."""
HEALED_SHARE = 0.25
"""Share of a far bias below which the states have left it: of two units they hold half of it."""
FARTHEST = 12.0
"""Multiple of ``turn_on_std`` from which a steady rate is a turn, whatever the biases."""
UNSHOWN = 0.25
"""Least share of the variance by biases that must be left: a rest, however short, leaves less."""
LEAST_SHOWN = 0.05
"""Least share of its prior variance that must be known of a bias."""


@compiled
def doubt_start(params: Constants, kf: Estimator, is_start: bool) -> None:
    """Find the biases that are far beyond their priors, and the error of all if the worst has none.

    Written to ``kf.far_bias``, rad/s, zero where a bias is plausible, and to ``kf.bias_error``. What
    is found stays until the bias heals. ``is_start``: the states began with their priors.
    """
    if params.turn_on_std == 0.0:
        return
    doubt_steady_rate(params, kf)
    if not is_start or kf.seconds > START_FOR:
        forget_healed(params, kf)
        return
    n = params.sensors.n
    states = kf.states
    prior = params.turn_on_std**2
    worst = -1
    largest = DOUBTED * DOUBTED
    for i in range(n):
        kf.far_bias[i] = kf.bias_error[i] = 0.0
        shown = prior - states.p[i, i]
        if shown > LEAST_SHOWN * prior and states.x[i] ** 2 > largest * shown:
            largest = states.x[i] ** 2 / shown
            worst = i
    if worst < 0:
        return
    shown = prior - states.p[worst, worst]
    for i in range(n):
        error = states.p[i, worst] * states.x[worst] / shown
        kf.bias_error[i] = weight_of(largest) * error
        if largest > FAR * FAR:
            kf.far_bias[i] = far_bias(params, kf, i, worst)


@compiled
def forget_healed(params: Constants, kf: Estimator) -> None:
    """Forget what the start has shown once a bias that was far has gone."""
    healed = False
    for i in range(params.sensors.n):
        before = abs(kf.far_bias[i])
        healed = healed or abs(kf.states.x[i]) < HEALED_SHARE * before
    if healed:
        for i in range(params.sensors.n):
            kf.far_bias[i] = kf.bias_error[i] = 0.0


@compiled
def weight_of(ratio: float) -> float:
    """Return the share of an error that the covariance allows for: all from `FAR` squared on."""
    beyond = (ratio - DOUBTED * DOUBTED) / (FAR * FAR - DOUBTED * DOUBTED)
    return math.sqrt(max(min(beyond, 1.0), 0.0))


@compiled
def doubt_steady_rate(params: Constants, kf: Estimator) -> None:
    """Doubt a steady rate that is far beyond the priors of biases that no rest has shown.

    If all biases are off alike, the vehicle stands still.
    """
    largest = square = 0.0
    for a in range(3):
        known = kf.known_variance[a]
        square += kf.steady_rate[a] ** 2
        if known > UNSHOWN * alike_variance(params, kf, a):
            largest = max(largest, kf.steady_rate[a] ** 2 / known)
    if square > (FARTHEST * params.turn_on_std) ** 2:
        largest = 0.0
    for i in range(params.sensors.n):
        kf.alike_bias[i] = weight_of(largest) * along(
            params.sensors.axes[i], kf.steady_rate
        )


@compiled
def alike_variance(params: Constants, kf: Estimator, a: int) -> float:
    """Return the variance of the rate by the biases before any rest, (rad/s)^2."""
    variance = 0.0
    for i in range(params.sensors.n):
        variance += (kf.fused.gain[a, i] * params.turn_on_std) ** 2
    return variance


@compiled
def far_bias(params: Constants, kf: Estimator, i: int, worst: int) -> float:
    """Return bias i if it had no prior, rad/s, or 0 if it is plausible beside the worst one."""
    states = kf.states
    prior = params.turn_on_std**2
    known = prior - states.p[i, i]
    if known <= LEAST_SHOWN * prior:
        return 0.0
    value = states.x[i]
    variance = known
    if i != worst:
        gain = states.p[i, worst] / (prior - states.p[worst, worst])
        left = known - gain * states.p[i, worst]
        # Else only the difference of the two is known: either may be the one.
        if left > LEAST_SHOWN * prior:
            value += gain * states.x[worst]
            variance = left
    is_far = value * value > FAR * FAR * variance
    return value * prior / variance if is_far else 0.0
