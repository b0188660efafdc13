# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A case: an alarm that stands, and the totals since its onset that its channels are named by."""

from __future__ import annotations

from fdi_ros.core.bank import SampleInput
from fdi_ros.core.compiled import compiled
from fdi_ros.core.record import Channels, Flag, Mask, Whole, record
from fdi_ros.detectors.naming import Inference, allow_misfit, explain_mean, fits
from fdi_ros.detectors.scales import BIAS_COVERAGE, KEPT, Block, Constants, Moment, Scale

RENAME = 16
"""Channels are named again when the case has grown by this part."""


@record
class Case:
    """An alarm that stands, and the totals since its onset that channels are named by."""

    open: Flag
    samples: Whole
    next: Whole  # samples at which channels are named again
    total: Block
    marked: Whole  # samples at the last power of two
    mark: Block  # totals then
    earlier: Whole  # samples at the power of two before that
    early: Block  # totals then: a quarter to a half of all
    part: Block
    variance: Channels  # of the noise over long, in that of noise_std
    suspects: Mask  # named last
    inference: Inference


@compiled
def add_block(own: Constants, case: Case, block: Block, samples: int, share: float) -> None:
    """Add a block to the totals: its values, so many times."""
    total = case.total
    for i in range(own.sensors.n):
        total.z[i] += share * block.z[i]
        total.bias[i] += share * block.bias[i]
        total.motion[i] += share * block.motion[i]
    for a in range(3):
        total.rate[a] += share * block.rate[a]
        total.acceleration[a] += share * block.acceleration[a]
    case.samples += samples


@compiled
def add_sample(own: Constants, case: Case, now: Moment, sample: SampleInput) -> None:
    """Add a sample to the totals."""
    total = case.total
    for i in range(own.sensors.n):
        total.z[i] += sample.z[i]
        total.bias[i] += now.bias[i]
        total.motion[i] += now.motion[i]
    for a in range(3):
        total.rate[a] += now.rate[a]
        total.acceleration[a] += sample.acceleration[a]
    case.samples += 1
    mark(own, case)


@compiled
def open_case(own: Constants, case: Case, scale: Scale, length: int, since: int) -> None:
    """Begin the totals with the blocks since the onset."""
    total = case.total
    case.open, case.samples, case.marked, case.earlier = True, 0, 0, 0
    for i in range(own.sensors.n):
        total.z[i] = total.bias[i] = total.motion[i] = 0.0
    for a in range(3):
        total.rate[a] = total.acceleration[a] = 0.0
    for k in range(since):
        add_block(own, case, scale.history[(scale.blocks - since + k) % KEPT], length, length)
        mark(own, case)
    if scale.count:
        add_block(own, case, scale.filling, scale.count, 1.0)
    case.next, case.suspects = case.samples, 0


@compiled
def copy_block(n: int, source: Block, target: Block) -> None:
    """Copy the totals of n channels."""
    for i in range(n):
        target.z[i], target.bias[i] = source.z[i], source.bias[i]
    for a in range(3):
        target.rate[a], target.acceleration[a] = source.rate[a], source.acceleration[a]


@compiled
def mark(own: Constants, case: Case) -> None:
    """Keep the totals at the last powers of two of the samples."""
    n = own.sensors.n
    if case.marked == 0 or case.samples >= 2 * case.marked:
        case.earlier = case.marked
        copy_block(n, case.mark, case.early)
        case.marked = case.samples
        copy_block(n, case.total, case.mark)


@compiled
def set_mean(own: Constants, case: Case, now: Moment, total: Block, count: int) -> None:
    """Set the mean to be explained from totals of so many samples."""
    sensors, inference, speed = own.sensors, case.inference, 0.0
    inference.turning = 0.0
    for a in range(3):
        inference.rate[a], inference.acceleration[a] = total.rate[a] / count, total.acceleration[a] / count
        speed += inference.rate[a] * inference.rate[a]
    for j in range(sensors.n):
        noise = sensors.noise_std[j] * sensors.noise_std[j] * case.variance[j]
        h, turning = sensors.axes[j], inference.acceleration
        timing = now.timing[j] * (h[0] * turning[0] + h[1] * turning[1] + h[2] * turning[2])
        bias, scale = total.bias[j] / count / BIAS_COVERAGE, sensors.scale_std[j]
        inference.turning = max(inference.turning, now.turning[j])
        inference.y[j] = total.z[j] / count
        inference.variance[j] = noise / count + bias * bias + scale * scale * speed + timing * timing


@compiled
def fits_parts(own: Constants, case: Case, now: Moment, channels: int) -> bool:
    """Whether errors of these channels explain the earlier time and the later time each by itself.

    While one error after the other begins, the mean of the whole time passes through many a direction.
    """
    part, n = case.part, own.sensors.n
    if case.earlier < 1:
        return True
    for late in range(2):
        sign = 1.0 if late else 0.0
        for i in range(n):
            part.z[i] = sign * case.total.z[i] + (1.0 - 2.0 * late) * case.early.z[i]
            part.bias[i] = sign * case.total.bias[i] + (1.0 - 2.0 * late) * case.early.bias[i]
        for a in range(3):
            part.rate[a] = sign * case.total.rate[a] + (1.0 - 2.0 * late) * case.early.rate[a]
            part.acceleration[a] = sign * case.total.acceleration[a] + (1.0 - 2.0 * late) * case.early.acceleration[a]
        set_mean(own, case, now, part, case.samples - case.earlier if late else case.earlier)
        allow_misfit(own.sensors, case.inference)
        if not fits(own.sensors, case.inference, channels):
            return False
    return True


@compiled
def name(own: Constants, case: Case, now: Moment) -> None:
    """Name the channels that explain the mean since the onset."""
    inference, count = case.inference, case.samples
    set_mean(own, case, now, case.total, count)
    explain_mean(own.sensors, inference, own.units, own.confidence)
    if not (
        fits_parts(own, case, now, inference.named)
        if inference.isolated
        else fits(own.sensors, inference, inference.best)
    ):
        # More is wrong than by any hypothesis: it may be anything.
        inference.isolated = False
        for i in range(own.sensors.n):
            if own.sensors.detectable[i]:
                inference.named |= 1 << i
    case.suspects = inference.named
    case.next = count + 1 + count // RENAME
