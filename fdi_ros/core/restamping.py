# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Correction of samples to one instant, by the delays of the units.

Delays estimated in flight do not change stamps. If the stamps of unit u are late by T_u, the
value at time t has the stamp t + T_u. A sample is corrected to its stamp less the largest
delay. Values of the latest unit are used unchanged, and the others are interpolated.
"""

from __future__ import annotations

import math

from fdi_ros.compiling.compiled import Units, compiled
from fdi_ros.core.alignment import MAX_STEPS
from fdi_ros.core.records import RESTAMP_SAMPLES, DelayBuffer, PathSettings, Sample
from fdi_ros.model.samples import Array


@compiled
def restamp(
    buffer: DelayBuffer,
    settings: PathSettings,
    late: Units,
    sample: Sample,
    received: int,
    plain: int,
    out: Array,
) -> int:
    """Store a sample, and write the values at its corrected instant to ``out`` (n,).

    Parameters
    ----------
    late
        Delay of the stamps of each unit, s, (units,).
    sample
        The sample.
    received, plain
        Masks of the values received, and of the values finite and in range.
    out
        Receives the values, NaN where missing.

    Returns
    -------
    int
        Mask of the channels with a value.
    """
    n = settings.n
    units = settings.units
    members = settings.members
    stamp = sample.stamp
    row = buffer.rows[buffer.count % RESTAMP_SAMPLES]
    if buffer.count > 0:
        step = stamp - buffer.rows[(buffer.count - 1) % RESTAMP_SAMPLES].stamp
        buffer.step = (
            step
            if buffer.step == 0
            else min(step, buffer.step + (buffer.step >> 4) + 1)
        )
    row.stamp = stamp
    row.received = received
    row.plain = plain
    buffer.count += 1
    top = 0.0
    for u in range(units):
        top = max(top, late[u])
    for i in range(n):
        row.values[i] = out[i] = sample.z[i]
    found = received
    for u in range(units):
        back = round(1e9 * (top - late[u]))
        if back > 0:
            found &= ~members[u]
            found |= interpolate(buffer, n, members[u], stamp - back, out)
    return found


@compiled
def interpolate(
    buffer: DelayBuffer, n: int, members: int, stamp: int, out: Array
) -> int:
    """Interpolate some channels at a stamp. Return the mask of the channels with a value.

    The interpolation is cubic through two samples before and two after the stamp. If one
    of the outer samples is missing or not yet received, the interpolation is linear.
    Between a value in range and one out of range or missing, no value exists.
    """
    k = buffer.count - 1
    oldest = max(buffer.count - RESTAMP_SAMPLES, 0)
    while k > oldest and buffer.rows[k % RESTAMP_SAMPLES].stamp > stamp:
        k -= 1
    before = buffer.rows[k % RESTAMP_SAMPLES]
    after = buffer.rows[(k + 1) % RESTAMP_SAMPLES]
    span = after.stamp - before.stamp
    found = members & before.received & after.received & ~(before.plain ^ after.plain)
    is_outside = k + 1 >= buffer.count or before.stamp > stamp
    if is_outside or span > MAX_STEPS * buffer.step:
        found = 0
    share = (stamp - before.stamp) / max(span, 1)
    first = buffer.rows[(k - 1) % RESTAMP_SAMPLES]
    last = buffer.rows[(k + 2) % RESTAMP_SAMPLES]
    curved = 0
    if (
        found
        and k - 1 >= oldest
        and k + 2 < buffer.count
        and last.stamp - first.stamp <= 2.0 * MAX_STEPS * buffer.step
    ):
        outer = ~(first.plain ^ before.plain) & ~(last.plain ^ before.plain)
        curved = found & first.received & last.received & outer
    # Positions of the outer samples if those of the inner ones are 0 and 1.
    a = (first.stamp - before.stamp) / max(span, 1)
    b = (last.stamp - before.stamp) / max(span, 1)
    inside = share * (1.0 - share)
    for i in range(n):
        if members >> i & 1:
            out[i] = (
                before.values[i] + share * (after.values[i] - before.values[i])
                if found >> i & 1
                else math.nan
            )
            if curved >> i & 1:
                # The remainder of the outer two, divided by s (1 - s), is linear.
                rise = after.values[i] - before.values[i]
                low = (first.values[i] - before.values[i] - a * rise) / (a * (1.0 - a))
                high = (last.values[i] - before.values[i] - b * rise) / (b * (1.0 - b))
                out[i] += inside * (low + (share - a) / (b - a) * (high - low))
    return found
