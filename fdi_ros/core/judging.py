# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Calls of a detector. Constants and memory have one row for each set of channels, or one row."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import call, compiled
from fdi_ros.core.algebra import along
from fdi_ros.core.records import Bank, Core, Current, SampleInput, SampleVerdict

UNPREPARED, REFUSED = -1, -2
"""In place of a row: not prepared yet, or refused by the method."""
#: Larger finite values are limited to this, so that squares remain finite, rad/s.
LARGEST_RATE = 1e6


@compiled
def present_in(z: NDArray[np.float64], n: int) -> int:
    """Return the mask of channels with a finite value."""
    mask = 0
    for i in range(n):
        if math.isfinite(z[i]):
            mask |= 1 << i
    return mask


@compiled
def clear_verdict(verdict: SampleVerdict, n: int) -> None:
    """Write the verdict on a sample that was not judged, which is not a healthy one."""
    verdict.statistic = verdict.threshold = math.nan
    verdict.alarm = verdict.isolated = False
    for i in range(n):
        verdict.suspects[i] = verdict.outliers[i] = False
        verdict.error[i] = verdict.noise[i] = 0.0
        verdict.scores[i] = math.nan


@compiled
def judge_sample(
    bank: Bank, sample: SampleInput, z: NDArray[np.float64], verdict: SampleVerdict
) -> bool:
    """Judge a sample by the values z (n,) of the channels in its mask.

    The other fields of the sample must be filled in. Return False, without judging, if
    the constants of the set are not prepared.
    """
    mask = sample.mask
    judged = bank.judged
    row = 0 if bank.takes_any else bank.row[mask]
    if row == UNPREPARED:
        return False
    clear_verdict(verdict, bank.n)
    # What the method does not state of this sample must not stay from an earlier one.
    sample.estimate.is_current = False
    sample.estimate.checked = sample.estimate.doubtful = 0
    if row == REFUSED:
        return True
    k = 0
    for i in range(bank.n):
        if bank.takes_any or mask >> i & 1:
            sample.z[k] = (
                min(max(z[i], -LARGEST_RATE), LARGEST_RATE)
                if math.isfinite(z[i])
                else 0.0
            )
            # Fields that a method does not write must not mean an alarm.
            judged.suspects[k] = judged.outliers[k] = False
            judged.error[k] = judged.noise[k] = 0.0
            judged.scores[k] = math.nan if bank.takes_any else 0.0
            k += 1
    judged.alarm = judged.isolated = False
    call(
        bank.judge,
        bank.constants,
        row,
        bank.constants_size,
        bank.states,
        bank.states_size,
        sample,
        judged,
    )
    verdict.statistic = judged.statistic
    verdict.threshold = judged.threshold
    verdict.alarm = judged.alarm
    verdict.isolated = judged.isolated
    k = 0
    for i in range(bank.n):
        if bank.takes_any or mask >> i & 1:
            verdict.suspects[i] = judged.suspects[k]
            verdict.outliers[i] = judged.outliers[k]
            verdict.error[i] = judged.error[k]
            verdict.scores[i] = judged.scores[k]
            verdict.noise[i] = judged.noise[k]
            k += 1
    return True


@compiled
def is_prepared(bank: Bank, mask: int) -> bool:
    """Return whether the constants of a set are prepared, or the method refuses the set."""
    return bank.takes_any or bank.row[mask] != UNPREPARED


@compiled
def judge_corrected(core: Core, bank: Bank) -> None:
    """Judge the corrected values by another method than the estimator's own.

    The result is in ``now.verdict``. The method was prepared for the expected noise.
    Residuals are divided by the square root of the excess of the present noise, so that
    the method keeps its false-alarm rate. Noise and outliers are those of the estimator.
    """
    now = core.now
    asked = core.now.asked
    axes = core.settings.sensors.axes
    scale = math.sqrt(max(core.sample.estimate.excess, 1.0))
    asked.stamp = core.sample.stamp
    asked.mask = core.sample.mask
    for i in range(core.settings.n):
        expected = along(axes[i], now.rate)
        now.scaled[i] = expected + (now.corrected[i] - expected) / scale
    judge_sample(bank, asked, now.scaled, now.verdict)
    for i in range(core.settings.n):
        now.verdict.error[i] *= scale
        now.verdict.noise[i] = now.guard.noise[i]
        now.verdict.outliers[i] = now.guard.outliers[i]


@compiled
def take_verdict(now: Current, n: int) -> None:
    """Copy the verdict of the estimator's own detector to the one that declares."""
    source = now.guard
    target = now.verdict
    target.statistic = source.statistic
    target.threshold = source.threshold
    target.alarm = source.alarm
    target.isolated = source.isolated
    for i in range(n):
        target.suspects[i] = source.suspects[i]
        target.outliers[i] = source.outliers[i]
        target.error[i] = source.error[i]
        target.scores[i] = source.scores[i]
        target.noise[i] = source.noise[i]
