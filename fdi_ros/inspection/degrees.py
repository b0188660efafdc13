# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Recognise rates in deg/s by the rotation, the range and the bias of gyros, and by gravity."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fdi_ros.estimator.estimator import REST_BLOCKS
from fdi_ros.inspection.segments import LARGEST_BIAS, SEGMENT_LENGTH
from fdi_ros.inspection.tilt import sum_of, swings_of
from fdi_ros.inspection.topics import (
    TopicReport,
)
from fdi_ros.inspection.turns import TURNS
from fdi_ros.model.samples import LARGEST_GYRO_RANGE, Array
from fdi_ros.report.layout import DEGREES
from fdi_ros.system.text import figures, shown


class _DegreeSigns(NamedTuple):
    """What shows that a unit sends deg/s in place of rad/s."""

    #: largest relative distance of a factor from a degree
    near: float = 0.2
    #: time beyond every gyro's range, s: less is a shock or damage
    fast_time: float = 0.5
    #: share of the recording beyond every range, from which on values may be of any
    #: size
    fast_share: float = 0.01
    #: share of a recording at rest that is much of it
    still: float = 0.3
    #: share of a recording at rest that is all of it
    always_still: float = 0.95
    #: shortest rest, s: in a flight with vibration less may be chance
    least_rest: float = 4.0
    #: noise of a sample at rest, rad/s, that no gyro has
    noisiest: float = 0.02
    #: smallest rotation in gentle motion, rad/s, of which three quantiles are
    #: compared
    gentle_rotation: float = 0.01
    #: the same rotation over the noise of its mean
    gentle_over_noise: float = 10.0


DEGREE_SIGNS = _DegreeSigns()

#: of the rates of a unit, that are compared with those of another
QUANTILES = (
    0.5,
    0.7,
    0.9,
    0.97,
    0.99,
)


class _SwingSigns(NamedTuple):
    """Which swings of gravity show the unit of the rates."""

    #: swings that rates in rad/s foretell, rad: a multicopter and a pendulum swing
    #: with gravity, and so far only if they fly or swing hard
    least_size: float = 0.3
    #: largest change of the size of the specific force, as a share of it, over the
    #: square of the swings: about 1 on a pendulum and 0.35 in a multicopter that
    #: keeps its height
    largest_change: float = 0.1
    #: share of the swings of the accelerometers that the rates explain. In healthy
    #: recordings in which they are 57 times too small, by chance, it is 0.01
    least_shared: float = 0.5
    #: windows that show so, each by itself
    least_windows: int = 2


SWINGS = _SwingSigns()


def in_degrees(
    chosen: Sequence[TopicReport], largest_rate: float = LARGEST_GYRO_RANGE
) -> str:
    """Return why topics of one body are in deg/s, empty if nothing shows that.

    ``largest_rate``: range of the gyros, rad/s.
    """
    chosen = [one for one in chosen if one.complete]
    # The size of the rate: a bias is no rotation.
    apart = [
        one.segments.means - np.median(one.segments.means, axis=0) for one in chosen
    ]
    rates = [np.quantile(np.linalg.norm(each, axis=1), QUANTILES) for each in apart]
    for (fast_one, fast), (slow_one, slow) in itertools.product(
        zip(chosen, rates, strict=True), repeat=2
    ):
        gentle = max(
            DEGREE_SIGNS.gentle_rotation,
            DEGREE_SIGNS.gentle_over_noise * _mean_noise(slow_one),
        )
        factor = _degrees_factor(fast, slow, TURNS.least_rotation, 2)
        factor = factor or _degrees_factor(fast, slow, gentle, 3)
        if factor:
            times = (
                f"{figures(factor)} times the rotation of {shown(slow_one.topic.name)}"
            )
            return f"rad/s: {shown(fast_one.topic.name)} is in deg/s, it shows {times}"
    if chosen and all(_is_beyond(one, largest_rate) for one in chosen):
        largest = max(one.largest for one in chosen)
        why = f"{figures(largest)} rad/s would be {figures(largest / 2 / math.pi, 2)} turns a second"
    elif chosen and _no_gyros_at_rest(chosen):
        noise = max(float(one.segments.noise().quiet.max()) for one in chosen)
        why = f"no gyro at rest has a bias and noise of {figures(noise, 2)} rad/s"
    elif swung := [one for one in chosen if _swings_in_degrees(one)]:
        chosen = swung
        verb = "shows" if len(swung) == 1 else "show"
        why = (
            f"and {verb} {figures(DEGREES.factor)} times the tilt of the accelerometers"
        )
    else:
        return ""
    names = " and ".join(shown(one.topic.name) for one in chosen)
    return f"rad/s: {names} {'is' if len(chosen) == 1 else 'are'} in deg/s, {why}"


def _degrees_factor(fast: Array, slow: Array, least: float, count: int) -> float:
    """Return the ratio of the rotations of two units if it is that of deg/s, else 0.

    At least ``count`` quantiles with a rotation above ``least``, rad/s, must agree.
    """
    moving = (slow > least) & np.isfinite(fast + slow)
    factors = fast[moving] / slow[moving]
    near = np.abs(factors / DEGREES.factor - 1.0) < DEGREE_SIGNS.near
    is_sure = len(factors) >= count and near.all()
    return float(np.median(factors)) if is_sure else 0.0


def _mean_noise(report: TopicReport) -> float:
    """Return the noise of the mean of a segment, rad/s, of the quietest axis."""
    quiet = float(report.segments.noise().quiet.min())
    samples = max(1.0, (report.rate or 1.0) * SEGMENT_LENGTH / REST_BLOCKS)
    return quiet / math.sqrt(samples) if math.isfinite(quiet) else math.inf


def _is_beyond(report: TopicReport, largest_rate: float) -> bool:
    """Whether rates are beyond the range of gyros for long."""
    largest = np.abs(report.segments.means).max(axis=1)
    beyond = largest > largest_rate
    # Values in deg/s stay below twice the range of the gyro.
    lasting = beyond & (largest < 2.0 * DEGREES.factor * largest_rate)
    each = report.segments.every * SEGMENT_LENGTH / REST_BLOCKS
    often = beyond.mean() > DEGREE_SIGNS.fast_share
    return bool(each * (beyond if often else lasting).sum() > DEGREE_SIGNS.fast_time)


def _swings_in_degrees(report: TopicReport) -> bool:
    """Whether gravity swings as the rates of a unit foretell, but 57 times less."""
    if report.channels != report.forces.channels:
        return False
    swings = swings_of(report.segments, report.forces)
    alike = [
        one
        for one in swings
        if one.size > SWINGS.least_size
        and one.change < SWINGS.largest_change * one.size**2
        and one.shared > SWINGS.least_shared
        and abs(one.factor / DEGREES.factor - 1.0) < DEGREE_SIGNS.near
    ]
    if len(alike) < SWINGS.least_windows:
        return False
    whole = sum_of(swings)
    near = abs(whole.factor / DEGREES.factor - 1.0) < DEGREE_SIGNS.near
    return near and whole.shared > SWINGS.least_shared


class _Rest(NamedTuple):
    """A unit at rest, if its values are rates in deg/s."""

    #: time at rest
    seconds: float
    #: of the recording
    share: float
    #: of its quietest axis, per sample, in the unit of the values
    noise: float
    #: (3,) in the unit of the values
    bias: Array


def _rest_of(report: TopicReport) -> _Rest:
    """Find the noise and the bias of a unit at rest."""
    segments = report.segments.all_segments()
    noise = report.segments.noise(largest_bias=LARGEST_GYRO_RANGE)
    still = [
        one.means.mean(axis=0)
        for one, lies in zip(segments, noise.rest, strict=True)
        if lies
    ]
    quiet = float(report.segments.noise().quiet.min())
    seconds = len(still) * report.segments.every * SEGMENT_LENGTH
    if not still:
        return _Rest(0.0, 0.0, quiet, np.zeros(report.channels))
    bias = np.median(still, axis=0)
    return _Rest(seconds, 1.0 - noise.share, quiet, bias)


def _no_gyros_at_rest(chosen: Sequence[TopicReport]) -> bool:
    """Whether all units rest with more noise and bias than gyros in rad/s have.

    A steady turn is common to all units and is not a bias. Biases must therefore differ
    between units, or the units rest for much of the recording and move in between.
    """
    rests = [_rest_of(one) for one in chosen]
    for one in rests:
        loud = (
            one.noise > DEGREE_SIGNS.noisiest and np.abs(one.bias).max() > LARGEST_BIAS
        )
        if not loud or one.seconds < DEGREE_SIGNS.least_rest:
            return False
    if all(DEGREE_SIGNS.still < one.share < DEGREE_SIGNS.always_still for one in rests):
        return True
    apart = [
        float(np.linalg.norm(one.bias - other.bias))
        if _are_mounted_alike(first, second)
        else abs(float(np.linalg.norm(one.bias) - np.linalg.norm(other.bias)))
        for (first, one), (second, other) in itertools.combinations(
            zip(chosen, rests, strict=True), 2
        )
    ]
    return max(apart, default=0.0) > LARGEST_BIAS


def _are_mounted_alike(first: TopicReport, second: TopicReport) -> bool:
    """Whether two units show the same motion about the same axes."""
    means = [one.segments.means for one in (first, second)]
    size = min(map(len, means))
    whole = [each[:size] for each in means]
    one, other = (each - np.median(each, axis=0) for each in whole)
    power = float((one**2).sum() + (other**2).sum())
    apart = float(((one - other) ** 2).sum())
    return apart < (1.0 - TURNS.shared) * power
