# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Which channels explain a mean residual: the odds of every hypothesis, and the smallest set that holds the culprit.

The mean y (n,) of the bias-free values over some time is ``H omega + E f + e`` with e normal of variances M, and E the
columns of the hypothesis:

- a channel, or a pair of channels, is off: their unit vectors;
- a unit as a whole is off: the unit vectors of its channels;
- a unit as a whole measures too much or too little: ``h_i omega`` on its channels;
- a unit as a whole is late or early: ``h_i`` times the angular acceleration on its channels.

The rate omega is unknown altogether, and drops out: with ``A = W - W H (H' W H)^-1 H' W``, ``W = M^-1``, and
``u = A y``, an amplitude f ~ N(0, T) makes the data more likely than no fault by

    log L = u_E' (A_EE + T^-1)^-1 u_E / 2 - log det(I + T A_EE) / 2,     u_E = E' u,  A_EE = E' A E.

The determinant is the price of a hypothesis that could explain more (Occam's factor; MacKay 1992). Odds are these
likelihoods times `PRIOR`; they hold at any time, however often they are looked at.
"""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from fdi_ros.core.bank import Sensors
from fdi_ros.core.compiled import compiled
from fdi_ros.core.record import MAX_CHANNELS, Channels, Flag, Mask, Real, Square, Vector, Whole, record

MOST = MAX_CHANNELS + MAX_CHANNELS * (MAX_CHANNELS - 1) // 2 + 12
"""Hypotheses at most: channels, pairs, three of each unit."""
PAIRS, UNITS = 0.1, 0.1
"""Prior odds of all pairs of one channel together, and of each way in which a unit is wrong, against a channel. They
are large for what they stand for: of three parallel gyros, two with the same fault look like the third with the
opposite one, and only the odds of such a coincidence keep a sound gyro from being named."""
GAIN_STD, DELAY_STD = 0.1, 0.01
"""Of a unit that is wrong as a whole: gain, and delay in s."""
FIVE = 0.005
"""Of all pairs of one channel of five: two of five explain anything, and no fault would ever be named."""
MISFIT, SCALES = 0.005, 1.0
"""Share of the largest error by which the model may be wrong, at least and in scale_std: axes and scale factors."""
FIT, FIT_PER_CHECK = 12.0, 4.0
"""Chi-square of what is left unexplained at most: so much, and so much for each degree of freedom."""
SET = 5.0
"""A set holds all that are wrong with a probability of being incomplete of so many times what a name may be wrong by:
that it holds none of them is far less likely."""
LAG = 0.5
"""Share of the motion at its fastest by which it may differ from what it is taken for, by a difference that lags."""
ANY = 1e6
"""Variance of an error of any size, in squares of the largest value."""
NO_LOG = -1e300

Matrix = Annotated[NDArray[np.float64], "f8", (3, 3)]


@record
class Inference:
    """A mean to be explained, the odds of all hypotheses on it, and the answer."""

    y: Channels  # mean of the bias-free values, rad/s
    variance: Channels  # of each, (rad/s)^2
    rate: Vector  # mean body rate, rad/s
    acceleration: Vector  # mean angular acceleration, rad/s^2
    turning: Real  # lately largest, rad/s^2
    information: Square  # A
    u: Channels  # A y
    channel: Annotated[NDArray[np.int64], "i8", (3,)]  # of a unit; -1: none
    prior: Matrix  # covariance of their errors by a hypothesis, (rad/s)^2
    matrix: Matrix
    weighted: Vector
    square: Real  # u' (A + T^-1)^-1 u
    log_odds: Annotated[NDArray[np.float64], "f8", (MOST,)]
    members: Annotated[NDArray[np.int64], "i8", (MOST,)]  # bits of the channels of each hypothesis
    whole: Annotated[NDArray[np.uint8], "u1", (MOST,)]  # by the hypothesis the gyros are sound, their unit is not
    count: Whole  # hypotheses
    # The answer:
    named: Mask  # by the confidence asked for
    best: Mask  # of the likeliest hypothesis
    isolated: Flag  # all that are named are wrong
    error: Channels  # of each channel if it alone is wrong, rad/s
    largest: Real  # of these, rad/s
    likeliest: Whole  # channel that explains most by itself


@compiled
def find_information(sensors: Sensors, inference: Inference) -> None:
    """Work out A and ``A y``."""
    n = sensors.n
    xx = xy = xz = yy = yz = zz = 0.0
    for i in range(n):
        w, h = 1.0 / inference.variance[i], sensors.axes[i]
        xx += w * h[0] * h[0]
        xy += w * h[0] * h[1]
        xz += w * h[0] * h[2]
        yy += w * h[1] * h[1]
        yz += w * h[1] * h[2]
        zz += w * h[2] * h[2]
    a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    det = xx * a + xy * b + xz * c
    d, e, f = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    for i in range(n):
        h, wi = sensors.axes[i], 1.0 / inference.variance[i]
        p = (a * h[0] + b * h[1] + c * h[2]) / det
        q = (b * h[0] + d * h[1] + e * h[2]) / det
        r = (c * h[0] + e * h[1] + f * h[2]) / det
        for j in range(n):
            g = sensors.axes[j]
            share = -wi / inference.variance[j] * (p * g[0] + q * g[1] + r * g[2])
            inference.information[i, j] = share + wi if i == j else share
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += inference.information[i, j] * inference.y[j]
        inference.u[i] = total


@compiled
def add(inference: Inference, log_odds: float, members: int, whole: bool) -> None:
    """Add a hypothesis."""
    inference.log_odds[inference.count] = log_odds
    inference.members[inference.count] = members
    inference.whole[inference.count] = whole
    inference.count += 1


@compiled
def log_one(information: float, u: float, variance: float) -> float:
    """Log likelihood ratio of one amplitude of that prior variance."""
    spread = 1.0 + variance * information
    return 0.5 * u * u * variance / spread - 0.5 * math.log(spread)


@compiled
def add_channels(sensors: Sensors, inference: Inference) -> float:
    """Add each channel; return the largest error estimated."""
    largest = most = 0.0
    for i in range(sensors.n):
        inference.error[i] = 0.0
        if sensors.detectable[i]:
            a, u = inference.information[i, i], inference.u[i]
            error = inference.error[i] = u / a
            largest = max(largest, abs(error))
            if u * error > most:
                most, inference.likeliest = u * error, i
            add(inference, log_one(a, u, error * error + 1.0 / a), 1 << i, False)
    return largest


@compiled
def add_pairs(sensors: Sensors, inference: Inference) -> None:
    """Add each pair of channels that can be told apart."""
    n = sensors.n
    prior = math.log((PAIRS if n > 5 else FIVE) / n)
    for i in range(n):
        for j in range(i + 1, n):
            aii, ajj, aij = inference.information[i, i], inference.information[j, j], inference.information[i, j]
            det = aii * ajj - aij * aij
            if not (sensors.detectable[i] and sensors.detectable[j]) or not det > 1e-3 * aii * ajj:
                continue
            ui, uj = inference.u[i], inference.u[j]
            ei, ej = (ajj * ui - aij * uj) / det, (aii * uj - aij * ui) / det
            t = 0.5 * (ei * ei + ej * ej) + 0.5 * (ajj + aii) / det
            # With T = t I: (A + I / t)^-1 by hand.
            bii, bjj = aii + 1.0 / t, ajj + 1.0 / t
            inner = bii * bjj - aij * aij
            gain = 0.5 * (bjj * ui * ui - 2.0 * aij * ui * uj + bii * uj * uj) / inner
            add(inference, prior + gain - 0.5 * math.log(t * t * inner), 1 << i | 1 << j, False)


@compiled
def log_unit(inference: Inference, channel: NDArray[np.int64]) -> float:
    """Log likelihood ratio of errors of up to three channels with the prior covariance ``inference.prior``.

    ``(A + T^-1)^-1 = (I + T A)^-1 T``: T may be singular, and A of all the checks there are may be.
    """
    m, t = inference.matrix, inference.prior
    for r in range(3):
        inference.weighted[r] = 0.0
        for c in range(3):
            total = 1.0 if r == c else 0.0
            for k in range(3):
                if channel[k] >= 0 and channel[c] >= 0:
                    total += t[r, k] * inference.information[channel[k], channel[c]]
            m[r, c] = total
            if channel[c] >= 0:
                inference.weighted[r] += t[r, c] * inference.u[channel[c]]
    det = (
        m[0, 0] * (m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1])
        - m[0, 1] * (m[1, 0] * m[2, 2] - m[1, 2] * m[2, 0])
        + m[0, 2] * (m[1, 0] * m[2, 1] - m[1, 1] * m[2, 0])
    )
    square = 0.0
    for c in range(3):
        # Cramer's rule: row r of the inverse by cofactors.
        total = 0.0
        for r in range(3):
            p, q, v, w = (r + 1) % 3, (r + 2) % 3, (c + 1) % 3, (c + 2) % 3
            total += (m[p, v] * m[q, w] - m[p, w] * m[q, v]) * inference.weighted[r]
        if channel[c] >= 0:
            square += inference.u[channel[c]] * total
    inference.square = square / det
    return 0.5 * inference.square - 0.5 * math.log(max(det, 1.0))


@compiled
def list_members(inference: Inference, n: int, mask: int) -> int:
    """List up to three channels of a set in ``inference.channel``; return how many."""
    count = 0
    for c in range(3):
        inference.channel[c] = -1
    for i in range(n):
        if mask >> i & 1 and count < 3:
            inference.channel[count] = i
            count += 1
    return count


@compiled
def add_units(sensors: Sensors, inference: Inference, units: NDArray[np.int64]) -> None:
    """Add each unit as a whole: any errors, its gain, its delay."""
    prior = math.log(UNITS)
    for members in units:
        if members == 0:
            break
        if list_members(inference, sensors.n, members) < 2:
            continue
        size = 0.0
        for c in range(3):
            i = inference.channel[c]
            if i >= 0:
                size += inference.error[i] * inference.error[i] + inference.variance[i]
        for r in range(3):
            for c in range(3):
                inference.prior[r, c] = size / 3.0 if r == c else 0.0
        add(inference, prior + log_unit(inference, inference.channel), members, False)
        for way in range(2):
            about, std = (inference.rate, GAIN_STD) if way == 0 else (inference.acceleration, DELAY_STD)
            set_prior(sensors, inference, about, std, 0.0 if way == 0 else inference.turning)
            add(inference, prior + log_unit(inference, inference.channel), members, True)


@compiled
def set_prior(sensors: Sensors, inference: Inference, about: NDArray[np.float64], std: float, peak: float) -> None:
    """Set the covariance of what a unit shows of a motion that it measures by a share too much, or too late."""
    square = 0.0
    for c in range(3):
        i = inference.channel[c]
        inference.weighted[c] = 0.0
        if i >= 0:
            h = sensors.axes[i]
            inference.weighted[c] = h[0] * about[0] + h[1] * about[1] + h[2] * about[2]
        square += inference.weighted[c] * inference.weighted[c]
    square = LAG * LAG * max(square, peak * peak)
    for r in range(3):
        for c in range(3):
            along = inference.weighted[r] * inference.weighted[c]
            inference.prior[r, c] = std * std * (along + (square / 3.0 if r == c else 0.0))


@compiled
def allow_misfit(sensors: Sensors, inference: Inference) -> None:
    """Add to the variances by how much the model may be wrong for an error as large as the largest."""
    for i in range(sensors.n):
        misfit = (MISFIT + SCALES * sensors.scale_std[i]) * inference.largest
        inference.variance[i] += misfit * misfit


@compiled
def fits(sensors: Sensors, inference: Inference, channels: int) -> bool:
    """Whether any errors of these channels, three at most, leave no more of ``inference.y`` unexplained than noise."""
    n = sensors.n
    find_information(sensors, inference)
    left, size = 0.0, 0.0
    for i in range(n):
        left += inference.y[i] * inference.u[i]
        size = max(size, inference.y[i] * inference.y[i], inference.variance[i])
    count = list_members(inference, n, channels)
    for r in range(3):
        for c in range(3):
            inference.prior[r, c] = ANY * size if r == c else 0.0
    log_unit(inference, inference.channel)
    return left - inference.square <= FIT + FIT_PER_CHECK * (n - 3 - count)


@compiled
def explain_mean(sensors: Sensors, inference: Inference, units: NDArray[np.int64], confidence: float) -> None:
    """Find the smallest set of hypotheses that holds the truth with the confidence, and name their channels.

    Where all of them contain a channel, it is isolated; but where some of them say that a unit measures motion wrongly
    and others do not, its gyros may all be sound, and nothing is.
    """
    n = sensors.n
    find_information(sensors, inference)
    inference.count = 0
    inference.largest = add_channels(sensors, inference)
    allow_misfit(sensors, inference)
    find_information(sensors, inference)
    inference.count = 0
    add_channels(sensors, inference)
    if n > 4:
        add_pairs(sensors, inference)
    add_units(sensors, inference, units)
    choose(inference, confidence)


@compiled
def choose(inference: Inference, confidence: float) -> None:
    """Take the most likely hypotheses until their odds make up the confidence."""
    top = NO_LOG
    for k in range(inference.count):
        top = max(top, inference.log_odds[k])
    total = 0.0
    for k in range(inference.count):
        inference.log_odds[k] = math.exp(max(inference.log_odds[k] - top, -700.0))
        total += inference.log_odds[k]
    mass, union, common, enough = 0.0, 0, -1, 1.0 - SET * (1.0 - confidence)
    some_whole = some_single = False
    for _ in range(inference.count):
        if mass >= confidence * total:
            break
        best = 0
        for k in range(inference.count):
            if inference.log_odds[k] > inference.log_odds[best]:
                best = k
        # A set of one channel would look like a name: it goes on to the next.
        if mass < enough * total or union & (union - 1) == 0:
            union |= inference.members[best]
        if mass == 0.0:
            inference.best = inference.members[best]
        mass += inference.log_odds[best]
        inference.log_odds[best] = 0.0
        common &= inference.members[best]
        if inference.whole[best]:
            some_whole = True
        else:
            some_single = True
    # Of a unit that is off in all its channels each is suspect, and none is sure: some may be off by very little.
    few = common & (common - 1) & ((common & (common - 1)) - 1) == 0
    inference.isolated = common != 0 and few and not (some_whole and some_single)
    inference.named = common if inference.isolated else union
