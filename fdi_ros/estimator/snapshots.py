# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The states kept from moments before, 0.12 to 490 s apart, and the way back to them after a fault."""

from __future__ import annotations

from fdi_ros.compiling.compiled import compiled
from fdi_ros.estimator.error_states import copy_states, predict
from fdi_ros.estimator.estimator import SNAPSHOTS, TIERS, Constants, Estimator

UNWATCHED, LONG_HOLE = 3e-4, 3600.0
"""Random walk of a bias over a hole in the stream, rad/s/sqrt(s), which has gone its way in so many s."""


@compiled
def keep_snapshot(own: Constants, est: Estimator) -> None:
    """Keep the states, so that they can be had again from before a fault."""
    tier = 0
    while tier < TIERS:
        snapshot = est.snapshots[tier * SNAPSHOTS + est.taken[tier] % SNAPSHOTS]
        snapshot.seconds = est.seconds
        copy_states(own.layout, est.states, snapshot.states)
        for u in range(own.units):
            snapshot.late[u] = est.late[u]
        est.taken[tier] += 1
        if est.taken[tier] % SNAPSHOTS != 1:
            return
        tier += 1


@compiled
def doubt_biases(own: Constants, est: Estimator, seconds: float) -> None:
    """Let the biases be others after a hole: nobody has watched them, and the sensors may have been switched off."""
    for i in range(own.sensors.n):
        est.states.p[i, i] += UNWATCHED * UNWATCHED * min(seconds, LONG_HOLE)
    forget_snapshots(est)


@compiled
def doubt_delays(own: Constants, est: Estimator, units: int) -> None:
    """Let delays be others: of the units all of whose channels are among some; of the first, against which all are."""
    for u in range(1, own.units):
        if own.members[u] & ~units == 0 or own.members[0] & ~units == 0:
            place = own.layout.delays[u]
            est.states.p[place, place] += own.layout.prior[place] * own.layout.prior[place]
            forget_snapshots(est)


@compiled
def forget_snapshots(est: Estimator) -> None:
    """Forget all states before now: they were surer than what is known now."""
    for tier in range(TIERS):
        est.taken[tier] = 0


@compiled
def go_back(own: Constants, est: Estimator, seconds: float) -> None:
    """Go on from the last snapshot before a time, s; without one from where the states are."""
    best, latest = -1, 0.0
    for tier in range(TIERS):
        for k in range(min(est.taken[tier], SNAPSHOTS)):
            snapshot = est.snapshots[tier * SNAPSHOTS + k]
            if snapshot.seconds <= seconds and (best < 0 or snapshot.seconds > latest):
                best, latest = tier * SNAPSHOTS + k, snapshot.seconds
    if best < 0:
        return
    snapshot = est.snapshots[best]
    copy_states(own.layout, snapshot.states, est.states)
    for u in range(1, own.units):
        est.states.x[own.layout.delays[u]] += snapshot.late[u] - est.late[u]
    predict(own.layout, est.states, est.seconds - latest)
