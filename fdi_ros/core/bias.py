# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Bias of each channel: fixed, or averaged over an initial time at rest.

The average is robust. Values are taken in groups of eight, without the largest and the
smallest. The means of the groups are averaged over fifteen portions of the time. The
bias is the mean of the portions without the largest and smallest fifth. Thus neither
single spikes nor a few disturbed portions change the bias.

Rest is tested for each channel alone (mean and scatter), and for all channels together.
A rotation lies in the three-dimensional part of the channels that a body rate explains.
Biases and noise of equal channels have the same size in each dimension, inside and
outside that part. C is the mean square per dimension in the part of the rate (3), and P
the mean square per dimension outside (k - 3 of k channels):

- averages: C / s^2 is F-distributed with 3 and k degrees of freedom. The size of the
  biases is known by a prior alone, scaled inverse chi-square about `USUAL` with 3 degrees
  of freedom (Gelman et al., Bayesian Data Analysis, 3rd ed., 3.3):
  s^2 = (3 USUAL^2 + (k - 3) P) / k.
- deviations of the 15 portions from their mean: C / P is F-distributed with 42 and
  14 (k - 3) degrees of freedom in noise of any colour that is not slower than the
  portions. Vibration below the noise of one sample is not rotation, and passes.
"""

from __future__ import annotations

import functools
import math
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import MAX_CHANNELS, compiled
from fdi_ros.core.algebra import along, square
from fdi_ros.core.parity import apply_gain, eliminate_rate
from fdi_ros.core.records import BIAS_PORTIONS, Bias, Core, Portion, Subset, ValueGroup
from fdi_ros.model.samples import MAX_RATE, Array


class BiasOrigin(IntEnum):
    """Origin of the bias, or reason why the last average was refused."""

    #: as the settings give it, or zero
    FIXED = 0
    #: an average at rest is under way
    LEARNING = 1
    #: averaged at rest
    LEARNED = 2
    #: read from the state file
    RESTORED = 3
    #: refused: too few channels or samples
    TOO_FEW = 4
    #: refused: the vehicle moved
    NOT_AT_REST = 5
    #: the vehicle starts in motion: biases as given
    IN_MOTION = 6


FIXED, LEARNING, LEARNED, RESTORED, TOO_FEW, NOT_AT_REST, IN_MOTION = map(
    int, BiasOrigin
)
#: Smallest number of samples of an average. Fewer may be a single group without scatter.
LEAST_ROWS = 10
#: A channel must give a value in one of this many samples: units may have lower rates.
LEAST_GIVEN = 4
#: Values in a group, of which the largest and the smallest are left out.
GROUP = 8
#: Mean square of the middle six of eight normal values about their mean, in variances.
MIDDLE_SQUARE = 0.3995
#: Variance of the plain mean in white noise, relative to the variance of this mean:
#: 0.934 by the groups times 0.88 by the portions.
EFFICIENCY = 0.82
#: Usual residual bias of calibrated MEMS gyros, rad/s: 0.3 deg/s.
USUAL = 0.005
#: Degrees of freedom of the prior about `USUAL`, which allows 0.5 to 4 times its size.
PRIOR = 3
#: Probability to take biases for a rotation. Such a vehicle needs biases as settings.
FALSE_TURN = 0.003
#: Probability to take noise for motion. It is lower, since each costs one more average.
FALSE_SWAY = 0.001


def restart_bias(core: NDArray[Any]) -> None:
    """Begin a new average of the bias. ``core`` has shape (1,)."""
    bias = core[0]["bias"]
    if not bias["duration"]:
        # Without a setting: 2 s, which reduces white noise to less than a tenth.
        bias["duration"] = 2_000_000_000
        settings = core["settings"]
        averaged = EFFICIENCY * 2.0 / settings["period"][0]
        settings["learned"][0] = settings["sensors"]["noise_std"][0] / averaged**0.5
    bias["learning"] = True
    bias["started"] = False
    bias["outcome"] = LEARNING


def prepare_limits(bias: Any) -> None:
    """Write the ratios above which the vehicle was not at rest."""
    bias["turn_ratio"] = np.inf
    bias["sway_ratio"] = np.inf
    for k in range(3, MAX_CHANNELS + 1):
        bias["turn_ratio"][k - 1] = f_quantile(FALSE_TURN, 3, k - 3 + PRIOR)
        if k > 3:
            freedom = BIAS_PORTIONS - 1
            bias["sway_ratio"][k - 1] = f_quantile(
                FALSE_SWAY, 3 * freedom, (k - 3) * freedom
            )


@functools.cache
def f_quantile(probability: float, above: int, below: int) -> float:
    """Return the value that an F-distributed variable exceeds with a probability.

    ``above`` and ``below`` are the degrees of freedom. For probabilities from 1e-4 to
    0.5 the relative error is at most 0.1 %.
    """
    # F = (below / above) / tan^2(angle), with the density cos^(above - 1) sin^(below - 1).
    edges = np.linspace(0.0, np.pi / 2, 8001)
    middle = 0.5 * (edges[1:] + edges[:-1])
    density = (above - 1) * np.log(np.cos(middle)) + (below - 1) * np.log(
        np.sin(middle)
    )
    relative = np.exp(density - density.max())
    share = np.concatenate([[0.0], np.cumsum(relative)])
    angle = float(np.interp(probability * share[-1], share, edges))
    return below / above / math.tan(angle) ** 2


@compiled
def update_bias(
    core: Core, subsets: NDArray[Any], stamp: int, good: int, lost: int
) -> bool:
    """Add one sample to the average, and return whether the sample was used.

    The sample that completes the average is not used. ``good`` is the mask of channels
    that are finite and in range. ``lost`` is the mask of channels declared faulty or
    taken out, which are no evidence about rest and keep their bias.
    """
    average = core.bias
    n = core.settings.n
    z = core.now.aligned
    if average.started and stamp >= average.start + average.duration:
        conclude(core, subsets, lost)
        if not average.learning:
            return False
    if not average.started:
        begin(average, n, stamp)
    average.rows += 1
    portion = average.portions[
        (stamp - average.start) * BIAS_PORTIONS // average.duration
    ]
    for i in range(n):
        if good >> i & 1:
            average.count[i] += 1
            add_value(
                average.groups[i], portion, i, min(max(z[i], -MAX_RATE), MAX_RATE)
            )
    return True


@compiled
def begin(average: Bias, n: int, stamp: int) -> None:
    """Begin a new average."""
    average.started = True
    average.start = stamp
    average.rows = 0
    for i in range(n):
        average.count[i] = average.groups[i].count = 0
        for b in range(BIAS_PORTIONS):
            average.portions[b].count[i] = 0
            average.portions[b].total[i] = average.portions[b].squares[i] = 0.0


@compiled
def add_value(group: ValueGroup, portion: Portion, i: int, value: float) -> None:
    """Add a value of channel i to its group. A full group is added to the portion."""
    if group.count == 0:
        group.total = group.squares = 0.0
        group.low = group.high = value
    group.count += 1
    group.total += value
    group.squares += value * value
    group.low = min(group.low, value)
    group.high = max(group.high, value)
    if group.count == GROUP:
        group.count = 0
        middle = (group.total - group.low - group.high) / (GROUP - 2)
        squares = (group.squares - group.low * group.low - group.high * group.high) / (
            GROUP - 2
        )
        portion.count[i] += 1
        portion.total[i] += middle
        portion.squares[i] += max(squares - middle * middle, 0.0)


@compiled
def middle_mean(values: Array, count: int) -> float:
    """Return the mean of the first ``count`` values without the outer fifths.

    The values are sorted in place.
    """
    for k in range(1, count):
        value = values[k]
        j = k
        while j > 0 and values[j - 1] > value:
            values[j] = values[j - 1]
            j -= 1
        values[j] = value
    out = count // 5
    total = 0.0
    for k in range(out, count - out):
        total += values[k]
    return total / (count - 2 * out)


@compiled
def average_channel(average: Bias, i: int) -> bool:
    """Calculate average and scatter of one channel. Return False without a full group."""
    filled = 0
    for b in range(BIAS_PORTIONS):
        portion = average.portions[b]
        if portion.count[i] > 0:
            average.ordered[filled] = portion.total[i] / portion.count[i]
            filled += 1
    if filled == 0:
        average.average[i] = average.scatter[i] = 0.0
        return False
    average.average[i] = middle_mean(average.ordered, filled)
    for b in range(filled):
        gap = average.ordered[b] - average.average[i]
        average.ordered[b] = gap * gap
    between = middle_mean(average.ordered, filled)
    filled = 0
    for b in range(BIAS_PORTIONS):
        portion = average.portions[b]
        if portion.count[i] > 0:
            average.ordered[filled] = (
                portion.squares[i] / portion.count[i] / MIDDLE_SQUARE
            )
            filled += 1
    average.scatter[i] = math.sqrt(middle_mean(average.ordered, filled) + between)
    return True


@compiled
def begin_in_motion(average: Bias, n: int) -> None:
    """End the start-up average in motion: begin with the biases of the settings."""
    average.learning = False
    average.outcome = IN_MOTION
    for i in range(n):
        average.value[i] = average.centre[i]
    average.channels_known = (1 << n) - 1


@compiled
def conclude(core: Core, subsets: NDArray[Any], lost: int) -> None:
    """Set the bias if the vehicle was at rest, or else store the reason."""
    average = core.bias
    n = core.settings.n
    heard = at_rest = resting = restless = 0
    for i in range(n):
        enough = average_channel(average, i)
        if (
            enough
            and average.count[i] * LEAST_GIVEN > average.rows
            and not lost >> i & 1
        ):
            heard |= 1 << i
            if (
                abs(average.average[i]) <= average.max_rate
                and average.scatter[i] <= average.max_std[i]
            ):
                at_rest |= 1 << i
                resting += 1
            else:
                restless += 1
    average.started = False
    average.heard = heard
    average.restless = heard & ~at_rest
    moved = moves_together(core, subsets[at_rest], at_rest, resting)
    # One restless channel is a bad channel. More than one indicate a moving vehicle.
    if restless <= 1 and resting >= 3 and average.rows >= LEAST_ROWS and not moved:
        for i in range(n):
            if at_rest >> i & 1:
                average.value[i] = average.average[i]
        average.channels_known = at_rest | lost
        average.learning = False
        average.outcome = LEARNED
    else:
        average.outcome = NOT_AT_REST if average.restless or moved else TOO_FEW


@compiled
def moves_together(core: Core, subset: Subset, mask: int, k: int) -> bool:
    """Return whether the k channels in mask have turned together.

    The size of the rotation and its limits are stored.
    """
    average = core.bias
    sensors = core.settings.sensors
    parity = core.now.parity
    average.common_rate = average.sway = 0.0
    average.max_common_rate = average.max_sway = math.inf
    if not subset.spans:
        return False
    noise = 0.0
    for i in range(sensors.n):
        average.part[i] = average.average[i] - average.centre[i]
        for j in range(sensors.n):
            parity.weight[i, j] = 0.0
        if mask >> i & 1:
            # All channels have equal weights, whatever their noise.
            parity.weight[i, i] = 1.0
            noise += sensors.noise_std[i] * sensors.noise_std[i] / k
    eliminate_rate(parity, sensors.n, sensors.axes, 0.0)
    turn, explained, other = split(core, mask)
    size = (PRIOR * USUAL * USUAL + other) / (k - 3 + PRIOR)
    average.common_rate = turn
    average.max_common_rate = turn * math.sqrt(
        average.turn_ratio[k - 1] * size * 3 / max(explained, 1e-30)
    )
    explained, other, count = split_portions(core, mask)
    if k > 3 and count > 1:
        average.sway = math.sqrt(explained / (3 * (count - 1)))
        average.max_sway = math.sqrt(
            average.sway_ratio[k - 1] * other / ((k - 3) * (count - 1)) + noise
        )
    return (
        average.common_rate > average.max_common_rate or average.sway > average.max_sway
    )


@compiled
def split(core: Core, mask: int) -> tuple[float, float, float]:
    """Split ``bias.part`` into a rate and the rest.

    Return the length of the rate, and the sums of squares of the explained part and of
    the rest.
    """
    axes = core.settings.sensors.axes
    part = core.bias.part
    rate = core.bias.turn
    apply_gain(core.now.parity.gain, core.settings.n, part, rate)
    explained = other = 0.0
    for i in range(core.settings.n):
        if mask >> i & 1:
            turn = along(axes[i], rate)
            explained += turn * turn
            other += (part[i] - turn) * (part[i] - turn)
    return (
        math.sqrt(square(rate)),
        explained,
        other,
    )


@compiled
def split_portions(core: Core, mask: int) -> tuple[float, float, int]:
    """Split the deviations of the portions from their mean into a rate and the rest.

    Return the sums of squares of both parts, and the number of portions.
    """
    average = core.bias
    n = core.settings.n
    count = 0
    explained = 0.0
    other = 0.0
    for i in range(n):
        average.middle[i] = 0.0
    for b in range(BIAS_PORTIONS):
        portion = average.portions[b]
        if is_filled(portion, n, mask):
            count += 1
            for i in range(n):
                if mask >> i & 1:
                    average.middle[i] += portion.total[i] / portion.count[i]
    for b in range(BIAS_PORTIONS):
        portion = average.portions[b]
        if is_filled(portion, n, mask):
            for i in range(n):
                if mask >> i & 1:
                    average.part[i] = (
                        portion.total[i] / portion.count[i] - average.middle[i] / count
                    )
            _, one, two = split(core, mask)
            explained += one
            other += two
    return explained, other, count


@compiled
def is_filled(portion: Portion, n: int, mask: int) -> bool:
    """Return whether every channel in mask gave a group of values in a portion."""
    filled = 0
    for i in range(n):
        if portion.count[i] > 0:
            filled |= 1 << i
    return mask & ~filled == 0
