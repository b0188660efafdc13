# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Delays between units: compensation of sure delays, and the time offset of the corrected values."""

from __future__ import annotations

from fdi_ros.compiling.compiled import compiled
from fdi_ros.core.records import SampleInput
from fdi_ros.estimator.error_states import bound_variance
from fdi_ros.estimator.estimator import Constants, Estimator

# s. A smaller delay stays an error state: its first order is accurate enough
LEAST_COMPENSATED_DELAY = 0.002
SURE_DELAY = (
    25.0  # squared delay over its variance from which values are moved by the delay
)
# s that are made up for at most: what `RESTAMP_SAMPLES` hold at 16 kHz
LONGEST_DELAY = 0.06
FILTERS = 0.006
"""Standard deviation of the delay between two units of their accelerometers against that of
their gyros, s: filters differ. With 2 ms, a healthy real flight with vibration ends in
sets, with 6 ms none of eight does."""


@compiled
def update_time_offsets(params: Constants, kf: Estimator) -> None:
    """Update ``kf.behind`` and ``kf.largest_delay``.

    ``behind`` is the time from the measurement of the corrected values to their stamp,
    if the earliest unit is not late. ``largest_delay`` is that between two units.

    `restamp` brings all units to the instant of the latest unit. The delay states then
    refer to the first unit.
    """
    latest = earliest = least = most = 0.0
    for u in range(1, params.units):
        late = kf.late[u]
        remaining = late + kf.states.x[params.layout.delays[u]]
        latest = max(latest, late)
        earliest = min(earliest, late)
        most = max(most, remaining)
        least = min(least, remaining)
    kf.behind = latest - earliest
    kf.largest_delay = most - least


@compiled
def unresolved_share(params: Constants, kf: Estimator, u: int) -> float:
    """Share of the angular acceleration, squared, of unit u that blocks do not resolve.

    It may be vibration near the sample rate, which looks like a slow turn with any delay.
    """
    turn_square = 0.0
    for i in range(params.sensors.n):
        if params.unit[i] == u:
            turn_square += kf.turn_square[i]
    return min(kf.usual_shaken / max(turn_square, 1e-12), 1.0)


@compiled
def transfer_delays(params: Constants, kf: Estimator) -> bool:
    """Move sure delays from their states to ``late``, which `restamp` compensates. Return whether any moved."""
    changed = False
    for u in range(1, params.units):
        place = params.layout.delays[u]
        delay = kf.states.x[place]
        unresolved = params.layout.prior[place] * unresolved_share(params, kf, u)
        variance = kf.states.p[place, place] + unresolved * unresolved
        variance += kf.taught_delay[u] * kf.taught_delay[u]
        if (
            abs(delay) > LEAST_COMPENSATED_DELAY
            and delay * delay > SURE_DELAY * variance
        ):
            step = min(
                max(delay, -LONGEST_DELAY - kf.late[u]), LONGEST_DELAY - kf.late[u]
            )
            kf.late[u] += step
            kf.states.x[place] -= step
            changed = changed or step != 0.0
    return changed


@compiled
def learn_delays_of_gyros(
    params: Constants, kf: Estimator, sample: SampleInput
) -> None:
    """Learn the delays of accelerometers from the gyros of their units, where these know more."""
    for u in range(1, params.units):
        if sample.delay_variance[u] > 0.0:
            place = params.layout.delays[u]
            value = sample.delay[u] - kf.late[u]
            variance = sample.delay_variance[u] + FILTERS * FILTERS
            bound_variance(params.layout, kf.states, place, value, variance)
