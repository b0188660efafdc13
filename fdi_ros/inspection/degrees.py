# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Rates in deg/s where rad/s are expected: recognised by the rotation, the range and the bias of gyros."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fdi_ros.config.config import (
    Config,
)
from fdi_ros.errors import BagError
from fdi_ros.estimator.estimator import REST_BLOCKS
from fdi_ros.inspection.segments import LARGEST_BIAS, LENGTH
from fdi_ros.inspection.topics import (
    FASTEST,
    TopicReport,
    inspect,
)
from fdi_ros.inspection.turns import (
    LEAST_ROTATION,
)
from fdi_ros.report.layout import DEGREES
from fdi_ros.system.text import shown

NEAR = 0.2  # a factor this close, relative, to that of a degree may be it: scale factors and vibration differ by less
QUANTILES = (
    0.5,
    0.7,
    0.9,
    0.97,
    0.99,
)  # of the rates of a unit, that are compared with those of another
FAST_SHARE, FAST_TIME = (
    0.01,
    0.5,
)  # share of the time, or s, beyond every gyro's range: less is a shock or damage
STILL, NOISIEST = (
    0.3,
    0.02,
)  # share of a recording that lies still; noise there, rad/s, that no gyro at rest has


def in_degrees(chosen: Sequence[TopicReport], largest_rate: float = FASTEST) -> str:
    """Say which topics, of one body, are in deg/s, and what shows it, of gyros of a range; empty: nothing does."""
    chosen = [one for one in chosen if one.complete]
    # The size of the rate: a bias is no rotation.
    apart = [
        one.segments.means - np.median(one.segments.means, axis=0) for one in chosen
    ]
    rates = [np.quantile(np.linalg.norm(each, axis=1), QUANTILES) for each in apart]
    for (fast_one, fast), (slow_one, slow) in itertools.product(
        zip(chosen, rates, strict=True), repeat=2
    ):
        moving = (slow > LEAST_ROTATION) & np.isfinite(fast + slow)
        factors = fast[moving] / slow[moving]
        if moving.sum() > 1 and (np.abs(factors / DEGREES.factor - 1.0) < NEAR).all():
            times = f"{float(np.median(factors)):.3g} times the rotation of {shown(slow_one.topic.name)}"
            return f"rad/s: {shown(fast_one.topic.name)} is in deg/s, it shows {times}"
    if chosen and all(_is_beyond(one, largest_rate) for one in chosen):
        largest = max(one.largest for one in chosen)
        why = f"{largest:.3g} rad/s would be {largest / 2 / math.pi:.2g} turns a second"
    elif chosen and all(map(_no_gyro_at_rest, chosen)):
        noise = max(float(one.segments.noise().quiet.max()) for one in chosen)
        why = f"no gyro at rest has a bias and noise of {noise:.2g} rad/s"
    else:
        return ""
    names = " and ".join(shown(one.topic.name) for one in chosen)
    return f"rad/s: {names} {'is' if len(chosen) == 1 else 'are'} in deg/s, {why}"


def _is_beyond(report: TopicReport, largest_rate: float) -> bool:
    """Whether rates are beyond the range of gyros for long."""
    largest = np.abs(report.segments.means).max(axis=1)
    beyond = largest > largest_rate
    # Of what is deg/s no gyro shows more than twice its range.
    lasting = beyond & (largest < 2.0 * DEGREES.factor * largest_rate)
    seconds = report.segments.every * LENGTH / REST_BLOCKS * float(lasting.sum())
    return bool(beyond.mean() > FAST_SHARE) or seconds > FAST_TIME


def _no_gyro_at_rest(report: TopicReport) -> bool:
    """Whether it lies still, and with more noise and bias than any gyro in rad/s has."""
    noise, segments = (
        report.segments.noise(largest_bias=FASTEST),
        report.segments.all_segments(),
    )
    if (
        noise.share >= 1.0 - STILL
        or not (report.segments.noise().quiet > NOISIEST).all()
    ):
        return False
    still = [
        one.means.mean(axis=0)
        for one, lies in zip(segments, noise.rest, strict=True)
        if lies
    ]
    return bool(np.abs(np.median(still, axis=0)).max() > LARGEST_BIAS)


def refuse_degrees(bag: Path, config: Config) -> list[TopicReport]:
    """Return what was seen of the topics of a config; `BagError` if one is in deg/s, or the recording is damaged."""
    chosen = [one for one in inspect(bag, config.topics)[0] if one.channels]
    if words := in_degrees(chosen, max(FASTEST, *config.health.max_rate)):
        raise BagError(f"{bag} needs {words}; mend the driver")
    return chosen
