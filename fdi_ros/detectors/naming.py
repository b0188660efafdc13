# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Which channels explain a mean: the odds of every hypothesis, and the smallest set that holds the culprit.

The mean y (n,) of the values over some time, less what is known of their errors, is
``H w + D f + e`` with e normal of covariance M, f the errors and D (n, k) the directions of
a hypothesis: a channel, a pair, a unit as a whole, its gain, its delay.
docs/methods.md#naming has the mathematics, in the same symbols.
"""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import (
    MAX_CHANNELS,
    MAX_UNITS,
    Channels,
    Flag,
    Mask,
    Real,
    Square,
    Vector,
    Whole,
    compiled,
    record,
)
from fdi_ros.core.algebra import along, dot, dot_in, invert
from fdi_ros.core.parity import UNKNOWN_RATE, fill_joint_parity
from fdi_ros.core.records import Matrix, Parity
from fdi_ros.estimator.error_states import (
    SIGNALS,
    SPEED,
    Layout,
    Projection,
    fill_signals,
    project,
    subtract_errors,
)
from fdi_ros.estimator.estimator import Constants, Estimator, Total, total_before
from fdi_ros.estimator.noise import BLOCK, BURST, MOTION, Noise
from fdi_ros.model.geometry import ROUNDING
from fdi_ros.model.samples import Array

MOST = MAX_CHANNELS + MAX_CHANNELS * (MAX_CHANNELS - 1) // 2 + 3 * MAX_UNITS
"""Hypotheses at most: channels, pairs, three of each unit."""
COINCIDENCE = 0.1
"""Prior odds of all pairs of one channel together, and of each way in which any unit is
wrong, against a channel. It is large for what it stands for: of three parallel gyros,
two with the same fault look like the third with the opposite one, and only the odds of
such a coincidence keep a healthy gyro from being named."""
TWO_CHECKS = COINCIDENCE / 2
"""Of the odds of pairs where there are two checks: two of five explain anything, and no
fault would ever be named."""
GAIN_STD, DELAY_STD = 0.1, 0.01
"""Of a unit that is wrong as a whole: gain, as by a wrong range, and delay in s, as of
a clock that was set."""
LEAST_PRESENCE = (
    0.9  # share of the samples that a channel has delivered where its mean counts
)
# logarithm that each amplitude costs, for sizes that may be anything over four decades
SPREAD = 1.3
# share of the largest error by which the model may be wrong: axes and scale factors
MISFIT = 0.004
FIT, FIT_PER_CHECK = 6.0, 2.5
"""Chi-square of what is left unexplained at most: so much, and so much for each degree
of freedom. Noise alone exceeds it once in 240 at most."""
SET_MARGIN = 5.0
"""A set holds all that are wrong with a probability of being incomplete of so many
times what a name may be wrong by: that it holds none of them is far less likely."""
UNEXPLAINED_SHARE = 0.2
"""All biases have moved where the best hypothesis of a fault leaves this share of the
chi-square: a fault of one or two channels leaves hardly any, were it ever so large."""
NO_LOG = -1e300

Odds = Annotated[NDArray[np.float64], "f8", (MOST,)]
Sets = Annotated[NDArray[np.int64], "i8", (MOST,)]
Wholes = Annotated[NDArray[np.uint8], "u1", (MOST,)]
Errors = Annotated[NDArray[np.float64], "f8", (MOST, MAX_CHANNELS)]
Directions = Annotated[NDArray[np.float64], "f8", (3, MAX_CHANNELS)]


@record
class Inference:
    """A mean to be explained, the odds of all hypotheses on it, and the answer."""

    mask: Mask  # channels that it is of
    judged: Mask  # of these, those whose fault shows
    before: Total  # sums of all samples before it
    y: Channels  # values less what is known of their errors, rad/s
    covariance: Square  # M, (rad/s)^2
    rate: Vector  # mean body rate, rad/s
    angular_acceleration: (
        Channels  # angular acceleration along each channel, lately largest, rad/s^2
    )
    change: Vector  # of the body rate over that time, rad/s
    at: Projection  # of the states in that motion
    parity: Parity
    u: Channels  # A y, s/rad
    total: Real  # y' A y / 2
    direction: Directions
    matrix: Matrix
    inverse: Matrix
    along: Vector  # D' u
    amplitude: Vector  # estimated f, rad/s
    fit: Real  # of the last hypothesis, in its best amplitude: what it explains of ``total``
    count: Whole  # hypotheses
    odds: Odds  # logarithms; then shares
    fits: Odds
    errors: Errors  # of each channel by each hypothesis, rad/s
    members: Sets  # channels of each hypothesis
    whole: Wholes  # by the hypothesis the gyros are healthy, their unit is not
    # The answer:
    log_odds: Real  # of the likeliest hypothesis against none
    # channels that all likely hypotheses have in common, if the likeliest fits: they
    # are faulty
    common: Mask
    union: Mask  # channels of which at least one is faulty
    likeliest: Mask  # channels of the likeliest hypothesis
    fit_of_best: Real  # what it explains of ``total``
    fitted: Flag  # what it leaves is noise
    error: Channels  # of each channel if it alone is faulty, rad/s
    largest: Real  # of those of the likeliest hypothesis, rad/s
    spread: Square  # mean square of the errors over all hypotheses, by their odds, (rad/s)^2


@compiled
def set_mean_speed(
    layout: Layout, kf: Estimator, before: Total, share: float, signals: Array
) -> None:
    """Put a share of the sums of absolute rates since ``before`` into signals (n, `SIGNALS`), rad/s.

    In a turn to and fro the mean rate is zero, and the mean of the absolute rate is not.
    """
    for k in range(SIGNALS):
        if layout.by[k] == SPEED:
            for i in range(layout.n):
                signals[i, k] = share * (kf.total.speed[i] - before.speed[i])


@compiled
def set_mean(params: Constants, kf: Estimator, inference: Inference, size: int) -> None:
    """Set the mean of the last ``size`` samples to be explained, and its covariance."""
    n, layout, before = params.sensors.n, params.layout, inference.before
    total_before(kf, kf.samples - size + 1, before, n)
    # The sums are kept at some moments only.
    size = kf.samples - before.sample
    fill_mean(params, kf, inference, size)
    signals = inference.at.signals
    fill_signals(layout, inference.rate, inference.angular_acceleration, signals)
    moves = 1.0 if kf.noise.regime == MOTION else 0.0
    set_mean_speed(layout, kf, before, moves / size, signals)
    subtract_errors(layout, kf.states, signals, inference.y, inference.y)
    project(layout, kf.states, inference.at)
    for i in range(n):
        for j in range(n):
            inference.covariance[i, j] = inference.at.covariance[i, j]
    add_noise(params, kf, inference, size)
    add_line(params, kf, inference, size)


@compiled
def fill_mean(
    params: Constants, kf: Estimator, inference: Inference, size: int
) -> None:
    """Work out the mean of the values and of the motion since the sums before."""
    n, before = params.sensors.n, inference.before
    inference.mask = 0
    for i in range(n):
        count = kf.total.count[i] - before.count[i]
        if kf.mask >> i & 1 and count > LEAST_PRESENCE * size:
            inference.mask |= 1 << i
            # What may still turn out to be a spike counts as long as it lasts.
            total = kf.total.values[i] + kf.spike_sum[i]
            inference.y[i] = (total - before.values[i]) / count
    inference.judged = inference.mask & kf.judged
    # At rest a seeming rate is the fault itself, and no motion.
    moves = 1.0 if kf.noise.regime == MOTION else 0.0
    for a in range(3):
        inference.rate[a] = moves * (kf.total.rate[a] - before.rate[a]) / size
        inference.change[a] = kf.rate[a] - before.instant[a]
    for i in range(n):
        change = moves * along(params.sensors.axes[i], inference.change)
        inference.angular_acceleration[i] = change / (size * params.period)


@compiled
def noise_of_mean(params: Constants, noise: Noise, i: int, size: int) -> float:
    """Variance of the mean of ``size`` samples of channel i by noise, (rad/s)^2."""
    variance, slow = noise.now.sample[i], noise.longest[i]
    if size >= params.length:
        colour = max(1.0, noise.now.level[BLOCK, i] * slow)
        variance *= noise.unknown[i] * colour
    else:
        burst = variance * max(1.0, BURST * noise.quick[i])
        variance = max(burst, noise.now.block[i] * slow * size / params.length)
    return variance / size


@compiled
def add_noise(
    params: Constants, kf: Estimator, inference: Inference, size: int
) -> None:
    """Add to the covariance noise, and what motion makes of delays and of scale that is not linear."""
    # A turn that ends as it began leaves no trace of a delay in the mean.
    part = min(1.0, 3.0 * params.length / size)
    moves = 1.0 if kf.noise.regime == MOTION else 0.0
    for i in range(params.sensors.n):
        noise = noise_of_mean(params, kf.noise, i, size)
        speed = moves * (kf.total.speed[i] - inference.before.speed[i]) / size
        bent = params.nonlinearity[i] * speed
        inference.covariance[i, i] += noise + kf.peak_extra[i] * part + bent * bent
        inference.covariance[i, i] += kf.displaced[i]
        place = params.layout.delays[params.unit[i]]
        if place >= 0:
            swing = moves * kf.peak_turn[i] * part
            inference.covariance[i, i] += kf.states.p[place, place] * swing * swing


@compiled
def add_line(params: Constants, kf: Estimator, inference: Inference, size: int) -> None:
    """Add vibration to the covariance: channels that show the same line are no independent witnesses."""
    n, longest = params.sensors.n, kf.noise.longest
    for i in range(n):
        for j in range(n):
            slow = 1.0
            if size >= params.length:
                slow = math.sqrt(longest[i] * longest[j])
            inference.covariance[i, j] += kf.shared.line[i, j] * slow / size


@compiled
def checks(mask: int, n: int) -> int:
    """Return how many more channels a set has than the three that a rate takes."""
    count = -3
    for i in range(n):
        count += mask >> i & 1
    return count


@compiled
def reduce(inference: Inference, n: int, k: int) -> None:
    """Work out D' u and D' A D for the first k directions."""
    direction, information = inference.direction, inference.parity.information
    for p in range(k):
        inference.along[p] = dot(direction[p], inference.u, n)
        for q in range(p + 1):
            total = 0.0
            for i in range(n):
                if direction[p, i] != 0.0:
                    for j in range(n):
                        total += direction[p, i] * information[i, j] * direction[q, j]
            inference.matrix[p, q] = inference.matrix[q, p] = total


@compiled
def log_ratio(inference: Inference, n: int, k: int, given: float) -> float:
    """Log likelihood ratio of errors along the first k directions; given: their variance, 0: as they are estimated."""
    reduce(inference, n, k)
    for p in range(k):
        # Channels that look alike have no matrix that can be inverted.
        inference.matrix[p, p] += ROUNDING * inference.matrix[p, p]
        if not inference.matrix[p, p] > 0.0:
            return NO_LOG
    invert(inference.matrix, k, inference.inverse)
    inference.fit, t = 0.0, given
    for p in range(k):
        inference.amplitude[p] = dot(inference.inverse[p], inference.along, k)
        inference.fit += 0.5 * inference.amplitude[p] * inference.along[p]
        if given == 0.0:
            t += (
                inference.amplitude[p] * inference.amplitude[p]
                + inference.inverse[p, p]
            ) / k
    for p in range(k):
        inference.matrix[p, p] += 1.0 / t
    log_det = invert(inference.matrix, k, inference.inverse) + k * math.log(t)
    gain = 0.0
    for p in range(k):
        for q in range(k):
            gain += (
                0.5 * inference.along[p] * inference.inverse[p, q] * inference.along[q]
            )
    return gain - 0.5 * log_det


@compiled
def add(
    inference: Inference, n: int, k: int, log_odds: float, members: int, whole: bool
) -> None:
    """Add a hypothesis, that of k directions whose ratio was worked out last."""
    for i in range(n):
        inference.errors[inference.count, i] = 0.0
        for p in range(k):
            inference.errors[inference.count, i] += (
                inference.direction[p, i] * inference.amplitude[p]
            )
    inference.odds[inference.count], inference.fits[inference.count] = (
        log_odds,
        inference.fit,
    )
    inference.members[inference.count], inference.whole[inference.count] = (
        members,
        whole,
    )
    inference.count += 1


@compiled
def set_direction(inference: Inference, n: int, k: int, channel: int) -> None:
    """Make direction k the unit vector of a channel."""
    for i in range(n):
        inference.direction[k, i] = 1.0 if i == channel else 0.0


@compiled
def add_channels(inference: Inference, n: int) -> None:
    """Add each channel, and each pair of them where there are checks for it."""
    free, information = checks(inference.mask, n), inference.parity.information
    for i in range(n):
        inference.error[i] = 0.0
        if inference.judged >> i & 1:
            set_direction(inference, n, 0, i)
            odds = log_ratio(inference, n, 1, 0.0)
            inference.error[i] = inference.amplitude[0]
            add(inference, n, 1, odds - SPREAD, 1 << i, False)
    if free < 2:
        return
    prior = (
        math.log((COINCIDENCE if free > 2 else TWO_CHECKS * COINCIDENCE) / n)
        - 2.0 * SPREAD
    )
    for i in range(n):
        for j in range(i):
            if inference.judged >> i & 1 and inference.judged >> j & 1:
                aii, ajj, aij = information[i, i], information[j, j], information[i, j]
                # Of two that cannot be told apart one is enough.
                if aii * ajj - aij * aij > 1e-3 * aii * ajj:
                    set_direction(inference, n, 0, i)
                    set_direction(inference, n, 1, j)
                    add(
                        inference,
                        n,
                        2,
                        prior + log_ratio(inference, n, 2, 0.0),
                        1 << i | 1 << j,
                        False,
                    )


@compiled
def add_units(params: Constants, inference: Inference) -> None:
    """Add each unit as a whole: any errors of its channels, its gain, its delay."""
    n, axes, rate = params.sensors.n, params.sensors.axes, inference.rate
    prior = math.log(COINCIDENCE / max(params.units, 1))
    for unit in range(params.units):
        inside = params.members[unit] & inference.mask
        count = 0
        for i in range(n):
            if inside >> i & 1 and count < 3:
                set_direction(inference, n, count, i)
                count += 1
        if count < 2 or inside == inference.mask:
            continue
        # Of a unit the others cannot check in all its axes, the rest is as good a hypothesis.
        add(
            inference,
            n,
            count,
            prior - count * SPREAD + log_ratio(inference, n, count, 0.0),
            inside,
            False,
        )
        for way in range(2):
            std = GAIN_STD if way == 0 else DELAY_STD
            for i in range(n):
                size = inference.angular_acceleration[i]
                if way == 0:
                    size = along(axes[i], rate)
                inference.direction[0, i] = size if inside >> i & 1 else 0.0
            odds = log_ratio(inference, n, 1, std * std)
            if odds > NO_LOG:
                odds += params.gain_odds if way == 0 else 0.0
                add(inference, n, 1, prior + odds, inside, True)


@compiled
def update_spread(inference: Inference, n: int, total: float) -> None:
    """Mean square of the errors over all hypotheses, whose shares of ``total`` are in ``inference.odds``."""
    for i in range(n):
        for j in range(n):
            inference.spread[i, j] = 0.0
    for k in range(inference.count):
        share = inference.odds[k] / total
        if share > 1e-4:
            for i in range(n):
                for j in range(n):
                    inference.spread[i, j] += (
                        share * inference.errors[k, i] * inference.errors[k, j]
                    )


@compiled
def largest_of(inference: Inference) -> int:
    """Return the number of the likeliest hypothesis of those not taken."""
    best = 0
    for k in range(inference.count):
        if inference.odds[k] > inference.odds[best]:
            best = k
    return best


@compiled
def update_best(inference: Inference, n: int) -> None:
    """Note the likeliest hypothesis, and whether what it leaves is noise."""
    best = largest_of(inference)
    inference.log_odds, inference.likeliest = (
        inference.odds[best],
        inference.members[best],
    )
    inference.fit_of_best = inference.fits[best]
    free = checks(inference.mask & ~inference.likeliest, n)
    inference.fitted = 2.0 * (
        inference.total - inference.fit_of_best
    ) <= FIT + FIT_PER_CHECK * max(free, 0)
    inference.largest = 0.0
    for i in range(n):
        if inference.likeliest >> i & 1:
            inference.largest = max(inference.largest, abs(inference.error[i]))


@compiled
def choose(inference: Inference, n: int, confidence: float) -> None:
    """Take the most likely hypotheses until their odds make up the confidence.

    Where all of them contain a channel, it is faulty; but where some of them say that a
    unit measures motion wrongly, its gyros may all be healthy.
    """
    update_best(inference, n)
    top, total = inference.log_odds, 0.0
    for k in range(inference.count):
        inference.odds[k] = math.exp(max(inference.odds[k] - top, -700.0))
        total += inference.odds[k]
    update_spread(inference, n, total)
    mass, union, common, enough = 0.0, 0, -1, 1.0 - SET_MARGIN * (1.0 - confidence)
    some_whole = False
    for _ in range(inference.count):
        if mass >= confidence * total:
            break
        best = largest_of(inference)
        # A set of one channel would look like a name: it goes on to the next.
        if mass < enough * total or union & (union - 1) == 0:
            union |= inference.members[best]
        mass += inference.odds[best]
        inference.odds[best] = 0.0
        common &= inference.members[best]
        some_whole = some_whole or inference.whole[best] != 0
    # Of a unit that is off in all its channels each is suspect, and none is sure: some
    # may be off by very little.
    few = common & (common - 1) & ((common & (common - 1)) - 1) == 0
    named = inference.fitted and common > 0 and few and not some_whole
    inference.common = common if named else 0
    inference.union = union if inference.fitted else inference.judged


@compiled
def explain(params: Constants, inference: Inference) -> None:
    """Explain a mean: find the smallest set of hypotheses that holds the truth with the confidence."""
    n = params.sensors.n
    fill_joint_parity(
        inference.parity,
        params.sensors,
        inference.mask,
        inference.covariance,
        UNKNOWN_RATE,
    )
    inference.total = 0.0
    for i in range(n):
        information = inference.parity.information[i]
        inference.u[i] = dot_in(information, inference.y, n, inference.mask)
        if inference.mask >> i & 1:
            inference.total += 0.5 * inference.u[i] * inference.y[i]
    inference.count = 0
    add_channels(inference, n)
    add_units(params, inference)
    choose(inference, n, params.confidence)


@compiled
def moved_by(inference: Inference, n: int) -> float:
    """By how much all biases have moved, standard deviation, if that is what the mean shows; 0: it is not.

    So it is where no hypothesis of a few channels leaves noise, and the best of them
    much of what is to be explained.
    """
    residual = 2.0 * (inference.total - inference.fit_of_best)
    if inference.fitted or residual < UNEXPLAINED_SHARE * 2.0 * inference.total:
        return 0.0
    trace = 0.0
    for i in range(n):
        if inference.mask >> i & 1:
            trace += inference.parity.information[i, i]
    square = max(2.0 * inference.total - checks(inference.mask, n), 0.0) / max(
        trace, 1e-12
    )
    return math.sqrt(square)
