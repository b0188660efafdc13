# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Test of rest, also used by calibration and inspection.

The start-up average (`core/bias.py`) and the check of repeated values (`is_at_rest` in
`core/repeated.py`) have tests of their own that need no estimator.
"""

from __future__ import annotations

from fdi_ros.compiling.compiled import compiled
from fdi_ros.estimator.estimator import LONG_TIME, REST_BLOCKS, Constants, Estimator
from fdi_ros.estimator.noise import REST, THREE_SIGMA
from fdi_ros.model.samples import Array

REST_RATIO = (
    3.0  # largest block variance over earlier rest: a hover in vibration has more
)
# rad/s, of the rate at rest: rotation of the earth, vibration of a table
REST_STD = 3e-4
UNLEARNED = 0.003
"""Largest uncertainty of the mean rate of the test, rad/s, from biases or from noise: beyond
it a turn may look like a bias, and in loud noise any slow motion like rest."""
# largest scatter of one second of blocks over noise: exceeded once in 1000 (72 degrees
# of freedom)
REST_CHI = 1.6
STEADY_FOR_S = 5.0
"""Time after which a rate that does not change is doubted, s: the vehicle turns steadily, or it stands
still with biases that are beyond what `UNLEARNED` or their priors allow."""
REST_LAST = 12.0  # largest squared distance of the last block from the mean, to end rest in time


@compiled
def rests(
    rates: Array, newest: int, variance: Array, bias_variance: Array, floor: float
) -> bool:
    """Whether the rates (`REST_BLOCKS`, c) of blocks, rad/s, scatter as noise does, about zero.

    Rates of the body or of single channels, in any order. ``newest``: place of the
    last. ``variance`` (c,): of the noise, ``bias_variance`` (c,): of the biases,
    ``floor``: of the rate at rest, all (rad/s)^2.
    """
    largest = 0.0
    for a in range(rates.shape[1]):
        mean = mean_of_blocks(rates, a)
        largest = max(
            largest,
            mean * mean / (floor + variance[a] / REST_BLOCKS + bias_variance[a]),
        )
    return largest < THREE_SIGMA and is_steady(rates, newest, variance, floor)


@compiled
def is_steady(rates: Array, newest: int, variance: Array, floor: float) -> bool:
    """Whether the rates of blocks scatter as noise does about their mean; arguments of `rests`."""
    scatter = last = 0.0
    for a in range(rates.shape[1]):
        mean = mean_of_blocks(rates, a)
        for k in range(REST_BLOCKS):
            gap = rates[k, a] - mean
            scatter += gap * gap / (variance[a] + floor)
            if k == newest:
                last = max(last, gap * gap / (variance[a] + floor))
    return scatter < rates.shape[1] * (REST_BLOCKS - 1) * REST_CHI and last < REST_LAST


@compiled
def mean_of_blocks(rates: Array, a: int) -> float:
    """Return the mean of one column, rad/s."""
    mean = 0.0
    for k in range(REST_BLOCKS):
        mean += rates[k, a] / REST_BLOCKS
    return mean


@compiled
def update_rest(params: Constants, kf: Estimator) -> None:
    """Update ``kf.rest``: the last second's rate scatters about zero as noise does."""
    for a in range(3):
        kf.rest_rates[kf.rest_count % REST_BLOCKS, a] = kf.rates[1, a]
    newest = kf.rest_count % REST_BLOCKS
    kf.rest_count += 1
    kf.rest = False
    if kf.rest_count < REST_BLOCKS:
        return
    n = params.sensors.n
    is_loud = False
    for a in range(3):
        variance = known = 0.0
        for i in range(n):
            gain = kf.fused.gain[a, i]
            part = 0.0
            if gain != 0.0:
                variance += gain * gain * kf.noise.now.block[i] / params.length
                for j in range(n):
                    part += kf.fused.gain[a, j] * kf.at.covariance[i, j]
                known += gain * part
        is_loud = is_loud or variance > REST_BLOCKS * UNLEARNED * UNLEARNED
        kf.rest_noise[a] = variance
        kf.known_variance[a] = known
        # While biases are uncertain a steady turn looks like biases.
        kf.rest_bias_variance[a] = min(known, UNLEARNED * UNLEARNED)
    kf.rest = rests(
        kf.rest_rates,
        newest,
        kf.rest_noise,
        kf.rest_bias_variance,
        params.rest_std * params.rest_std,
    )
    # A hover may turn as slowly, but has more noise than rest, or than is expected.
    compares = kf.noise.regime_seconds[REST] > LONG_TIME or is_loud
    if compares and kf.noise.regime != REST and is_louder_than_rest(params, kf):
        kf.rest = False
    # Accelerometers feel gravity, which does not change either.
    if not params.gain_is_fault and not is_loud:
        follow_steady_rate(params, kf, newest)


@compiled
def is_louder_than_rest(params: Constants, kf: Estimator) -> bool:
    """Whether a channel has much more noise than at rest."""
    for i in range(params.sensors.n):
        noise = kf.noise.now.block[i]
        if kf.masks[1] >> i & 1 and noise > REST_RATIO * kf.noise.kept[REST].block[i]:
            return True
    return False


@compiled
def follow_steady_rate(params: Constants, kf: Estimator, newest: int) -> None:
    """Note a rate that does not change for `STEADY_FOR_S`, until the vehicle is known to rest.

    It may be a turn, or what is left of the biases: no comparison tells which.
    """
    steady = is_steady(
        kf.rest_rates, newest, kf.rest_noise, params.rest_std * params.rest_std
    )
    kf.steady_seconds = kf.steady_seconds + kf.span if steady else 0.0
    for a in range(3):
        if kf.rest:
            kf.steady_rate[a] = 0.0
        elif kf.steady_seconds >= STEADY_FOR_S:
            kf.steady_rate[a] = mean_of_blocks(kf.rest_rates, a)
