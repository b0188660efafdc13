# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Snapshots of the states, and widening after holes in the stream.

After a fault the estimator goes back to a snapshot. The tiers keep eight snapshots
each, 0.12, 1, 8, 61 and 490 s apart, so the oldest is about an hour old.
"""

from __future__ import annotations

import math

from fdi_ros.compiling.compiled import compiled
from fdi_ros.estimator.error_states import (
    ONE,
    SIGNALS,
    TURN,
    ErrorStates,
    copy_states,
    predict,
)
from fdi_ros.estimator.estimator import (
    LONG_TIME,
    SNAPSHOTS,
    TIERS,
    Constants,
    Estimator,
    Snapshot,
)

UNWATCHED, LONG_HOLE = 3e-4, 3600.0
"""Random walk of a bias during a hole, rad/s/sqrt(s), and the longest counted hole, s.
After an hour the walk has reached the size of a turn-on bias and grows no more."""
AFTER_HOLE = 5.0 * LONG_TIME
"""s of samples after a hole in which biases are compared with those before: five
comparisons, and by then the states know what they can learn of the biases."""


@compiled
def keep_snapshot(params: Constants, kf: Estimator) -> None:
    """Keep the states, so that they can be had again from before a fault."""
    tier = 0
    while tier < TIERS:
        snapshot = kf.snapshots[tier * SNAPSHOTS + kf.taken[tier] % SNAPSHOTS]
        snapshot.seconds = kf.seconds
        copy_states(params.layout, kf.states, snapshot.states)
        for u in range(params.units):
            snapshot.late[u] = kf.late[u]
        for a in range(3):
            snapshot.force[a] = kf.reference_force[a]
        kf.taken[tier] += 1
        if kf.taken[tier] % SNAPSHOTS != 1:
            return
        tier += 1


@compiled
def pass_hole(params: Constants, kf: Estimator, seconds: float) -> None:
    """Widen the biases after a hole, in the present states and in all snapshots.

    Later the biases are compared with those of a snapshot from before the hole.
    """
    if not is_after_hole(params, kf):
        kf.hole_at = kf.seconds - seconds
        kf.hole_sample = kf.samples
    move_biases(params, kf, UNWATCHED * math.sqrt(min(seconds, LONG_HOLE)), 0.0)


@compiled
def is_after_hole(params: Constants, kf: Estimator) -> bool:
    """Whether there was a hole in the stream lately."""
    return (
        kf.hole_sample > 0
        and (kf.samples - kf.hole_sample) * params.period < AFTER_HOLE
    )


@compiled
def move_biases(params: Constants, kf: Estimator, std: float, rate_std: float) -> None:
    """Widen all biases by a standard deviation, rad/s, and their rates, rad/s^2, now and in all snapshots."""
    add_to_biases(params, kf.states, std, rate_std)
    for k in range(TIERS * SNAPSHOTS):
        add_to_biases(params, kf.snapshots[k].states, std, rate_std)


@compiled
def add_to_biases(
    params: Constants, states: ErrorStates, std: float, rate_std: float
) -> None:
    """Add to the variances of the biases and of their rates of change."""
    for r in range(params.layout.count):
        if r < params.sensors.n:
            states.p[r, r] += std * std
        elif 0 <= params.layout.feeds[r] < params.sensors.n:
            states.p[r, r] += rate_std * rate_std


@compiled
def widen_scales(params: Constants, states: ErrorStates) -> None:
    """Add their priors to the variances of the states that multiply the rate."""
    layout = params.layout
    for i in range(params.sensors.n):
        for k in range(SIGNALS):
            place = layout.place[i, k]
            by_motion = layout.by[k] != ONE and layout.by[k] != TURN
            if place >= 0 and by_motion:
                states.p[place, place] += layout.prior[place] * layout.prior[place]


@compiled
def inflate_delays(params: Constants, kf: Estimator, units: int) -> None:
    """Widen the delays of units whose channels are all in ``units``.

    All delays if the reference unit is among them: they are relative to it.
    """
    for u in range(1, params.units):
        is_one = params.members[u] & ~units == 0
        if is_one or params.members[0] & ~units == 0:
            place = params.layout.delays[u]
            kf.states.p[place, place] += (
                params.layout.prior[place] * params.layout.prior[place]
            )
            # The snapshots would be too sure.
            for tier in range(TIERS):
                kf.taken[tier] = 0


@compiled
def change_since(params: Constants, kf: Estimator, snapshot: Snapshot) -> float:
    """Return the standard deviation of a bias by the change of the specific force since a snapshot, rad/s."""
    square = 0.0
    for a in range(3):
        square += (kf.reference_force[a] - snapshot.force[a]) ** 2
    return params.g_sensitivity * math.sqrt(square)


@compiled
def variance_since(params: Constants, kf: Estimator, snapshot: Snapshot) -> float:
    """Return the variance of a bias by random walk and specific force since a snapshot, (rad/s)^2."""
    walk = params.layout.walk[0]
    change = change_since(params, kf, snapshot)
    return (kf.seconds - snapshot.seconds) * walk * walk + change * change


@compiled
def best_snapshot(params: Constants, kf: Estimator, seconds: float) -> int:
    """Find the snapshot until a time, s, since which the biases have changed least, or -1.

    This is the last one, unless the specific force was another one then.
    """
    best = -1
    least = latest = 0.0
    for tier in range(TIERS):
        for k in range(min(kf.taken[tier], SNAPSHOTS)):
            snapshot = kf.snapshots[tier * SNAPSHOTS + k]
            if snapshot.seconds > seconds:
                continue
            variance = variance_since(params, kf, snapshot)
            better = variance < least or (
                variance == least and snapshot.seconds > latest
            )
            if best < 0 or better:
                best = tier * SNAPSHOTS + k
                least = variance
                latest = snapshot.seconds
    return best


@compiled
def predict_from(
    params: Constants, kf: Estimator, seconds: float, states: ErrorStates
) -> bool:
    """Predict the present states from the best snapshot until a time, s. Return whether one exists."""
    best = best_snapshot(params, kf, seconds)
    if best < 0:
        return False
    snapshot = kf.snapshots[best]
    copy_states(params.layout, snapshot.states, states)
    for u in range(1, params.units):
        states.x[params.layout.delays[u]] += snapshot.late[u] - kf.late[u]
    predict(params.layout, states, kf.seconds - snapshot.seconds)
    add_to_biases(params, states, change_since(params, kf, snapshot), 0.0)
    return True


@compiled
def recall_biases(params: Constants, kf: Estimator, snapshot: Snapshot) -> None:
    """Take the biases of a snapshot from the specific force that has come back."""
    layout = params.layout
    passed = kf.seconds - snapshot.seconds
    change = change_since(params, kf, snapshot)
    x = kf.states.x
    p = kf.states.p
    for r in range(layout.count):
        if r < params.sensors.n:
            x[r] = snapshot.states.x[r]
        for c in range(layout.count):
            if r < params.sensors.n and c < params.sensors.n:
                p[r, c] = snapshot.states.p[r, c]
            elif r < params.sensors.n or c < params.sensors.n:
                p[r, c] = 0.0
    for r in range(layout.count):
        to = layout.feeds[r]
        if r < params.sensors.n:
            p[r, r] += passed * layout.walk[r] * layout.walk[r] + change * change
        elif 0 <= to < params.sensors.n:
            x[to] += passed * x[r]
            p[to, to] += passed * passed * p[r, r]
