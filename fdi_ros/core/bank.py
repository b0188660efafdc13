# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A detector as the sample path meets it, and the error model it is given.

It has one row of constants and of memory for each set of channels present, or one for all (`Detector.takes_any`).

A sample from which channels are absent is judged by the channels left, with constants prepared for just these
(`fdi_ros.detectors.base`). They are looked up by the bits of the channels present.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import call, compiled
from fdi_ros.core.records import Bank, Circumstances, SampleVerdict, Sensors
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel

LARGEST_RATE = 1e6
"""rad/s. No gyro measures so much: a larger finite value is taken for this, so that squares stay finite."""
UNPREPARED, REFUSED = -1, -2
"""Instead of a row: constants for these channels were not prepared yet; the method cannot run on them."""


@compiled
def present_in(z: NDArray[np.float64], n: int) -> int:
    """Bits of the channels whose value is finite."""
    mask = 0
    for i in range(n):
        if math.isfinite(z[i]):
            mask |= 1 << i
    return mask


@compiled
def clear_verdict(verdict: SampleVerdict, n: int) -> None:
    """Verdict on a sample that was not judged: not judged is not healthy."""
    verdict.statistic = verdict.threshold = math.nan
    verdict.alarm = verdict.isolated = False
    for i in range(n):
        verdict.suspects[i] = verdict.outliers[i] = False
        verdict.error[i] = verdict.noise[i] = 0.0
        verdict.scores[i] = math.nan


@compiled
def judge_sample(bank: Bank, mask: int, z: NDArray[np.float64], known: Circumstances, verdict: SampleVerdict) -> bool:
    """Judge one sample z (n,) by the channels in mask.

    Returns
    -------
    False, and nothing is done, if the constants for these channels are still to be prepared.
    """
    row = 0 if bank.takes_any else bank.row[mask]
    if row == UNPREPARED:
        return False
    if row == REFUSED:
        clear_verdict(verdict, bank.n)
        return True
    present, judged = bank.sample, bank.judged
    k = 0
    for i in range(bank.n):
        if bank.takes_any or mask >> i & 1:
            present.z[k] = min(max(z[i], -LARGEST_RATE), LARGEST_RATE) if math.isfinite(z[i]) else 0.0
            present.bias_std[k] = known.bias_std[i]
            # What a method leaves untouched is no alarm.
            judged.suspects[k] = judged.outliers[k] = False
            judged.error[k] = judged.noise[k] = 0.0
            judged.scores[k] = math.nan if bank.takes_any else 0.0
            k += 1
    for a in range(3):
        present.acceleration[a] = known.acceleration[a]
    present.mask, present.out, present.stamp = mask, known.out, known.stamp
    present.beyond = known.beyond
    present.interrupted, present.held, present.repeated = known.interrupted, known.held, known.repeated
    judged.alarm = judged.isolated = present.estimate.known = False
    call(bank.judge, bank.constants, row, bank.constants_size, bank.states, bank.states_size, present, judged)
    verdict.statistic, verdict.threshold = judged.statistic, judged.threshold
    verdict.alarm, verdict.isolated = judged.alarm, judged.isolated
    k = 0
    for i in range(bank.n):
        here = bank.takes_any or mask >> i & 1
        verdict.suspects[i] = judged.suspects[k] if here else 0
        verdict.error[i] = judged.error[k] if here else 0.0
        verdict.scores[i] = judged.scores[k] if here else math.nan
        verdict.noise[i] = judged.noise[k] if here else 0.0
        verdict.outliers[i] = judged.outliers[k] if here else 0
        k += 1 if here else 0
    return True


@compiled
def variance_of(sensors: Sensors, i: int, rate_along: float, acceleration: NDArray[np.float64]) -> float:
    """Error variance of a channel, (rad/s)^2, from the rate along its own axis, rad/s."""
    axis = sensors.axes[i]
    scale = sensors.scale_std[i] * rate_along
    timing = sensors.timing_std[i] * (axis[0] * acceleration[0] + axis[1] * acceleration[1] + axis[2] * acceleration[2])
    return sensors.noise_std[i] * sensors.noise_std[i] + scale * scale + timing * timing


def describe_sensors(sensors: Any, geometry: Geometry, noise: NoiseModel) -> None:
    """Fill a record of `Sensors`; noise with one value per channel."""
    n = geometry.n
    sensors["n"], sensors["constant"] = n, noise.constant
    sensors["axes"][:n], sensors["gain"][:n] = geometry.axes, geometry.least_squares.T
    for name in ("noise_std", "scale_std", "timing_std"):
        sensors[name][:n] = getattr(noise, name)
    sensors["share"][:n], sensors["detectable"][:n] = np.diag(geometry.S), geometry.detectable
    sensors["alike"][:n, :n] = geometry.group_matrix
