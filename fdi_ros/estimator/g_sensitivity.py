# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Gyro biases that depend on the specific force: g-sensitivity.

The fused specific force of the accelerometers gives the change, and the sensitivity of
each gyro is unknown. The biases belong to a reference force. At another force every
gyro has an additional error, which is a variance of samples, blocks and means. If the
other force lasts, it becomes the reference: the biases widen by that error, and the
estimator learns them again. Where a force comes back, so do its biases: a fault that
begins with a boost shows at its end. States for the sensitivities, three a gyro, would
double the cost of a block.
"""

from __future__ import annotations

import math

from fdi_ros.compiling.compiled import compiled
from fdi_ros.core.records import SampleInput
from fdi_ros.estimator.estimator import Constants, Estimator, update_weights
from fdi_ros.estimator.snapshots import (
    add_to_biases,
    best_snapshot,
    recall_biases,
    variance_since,
)

LEAST_CHANGE = 9.8
"""Smallest change of the specific force that counts, m/s^2. The bias random walk covers
smaller ones, as in ordinary manoeuvres: below 2 mrad/s at 0.1 deg/s/g."""
SMOOTHING_TIME = 0.05  # time constant of the specific force, s: vibration is no change
NEW_FORCE_AFTER_S = 0.5  # s after which another specific force becomes the reference
FADE = 0.92  # factor per block on the variance: it fades within half a second
NEGLIGIBLE = 1e-10  # variance that fades to zero, (rad/s)^2
# relative growth of the variance of a sample that counts before the block ends
GROWTH = 0.3


@compiled
def follow_force(params: Constants, kf: Estimator, sample: SampleInput) -> None:
    """Follow the specific force, and the variance of the gyros by its distance from the reference."""
    if not sample.has_force or params.g_sensitivity == 0.0:
        return
    share = min(params.period / SMOOTHING_TIME, 1.0)
    if not kf.has_force:
        share = 1.0
        kf.near_at = kf.seconds
    for a in range(3):
        kf.force[a] += share * (sample.force[a] - kf.force[a])
        if not kf.has_force:
            kf.reference_force[a] = kf.force[a]
    kf.has_force = True
    change = change_of_force(kf)
    if change == 0.0:
        kf.near_at = kf.seconds
        return
    error = params.g_sensitivity * change
    kf.force_variance = max(kf.force_variance, error * error)
    count_growth(params, kf)


@compiled
def change_of_force(kf: Estimator) -> float:
    """Return the distance of the specific force from the reference, m/s^2. It is 0 if it does not count."""
    square = 0.0
    for a in range(3):
        step = kf.force[a] - kf.reference_force[a]
        square += step * step
    return math.sqrt(square) if square > LEAST_CHANGE * LEAST_CHANGE else 0.0


@compiled
def count_growth(params: Constants, kf: Estimator) -> None:
    """Judge the present sample with the variance by g-sensitivity, where it has grown since the last block."""
    n = params.sensors.n
    lasting = 2.0 * params.length
    grown = kf.force_variance - kf.counted_variance
    begins = False
    for i in range(n):
        known = kf.noise.now.sample[i] + lasting * kf.counted_variance
        begins = begins or lasting * grown > GROWTH * known
    if begins:
        for i in range(n):
            kf.at.covariance[i, i] += grown
        kf.counted_variance = kf.force_variance
        update_weights(params, kf)


@compiled
def renew_reference(params: Constants, kf: Estimator, may_recall: bool) -> bool:
    """Fade the variance after a block. Make a specific force that lasts the reference of the biases.

    Return whether the biases are those of a snapshot from that force.
    """
    kf.force_variance *= FADE
    if kf.force_variance < NEGLIGIBLE:
        kf.force_variance = 0.0
    change = change_of_force(kf)
    if change == 0.0 or kf.seconds - kf.near_at < NEW_FORCE_AFTER_S:
        return False
    for a in range(3):
        kf.reference_force[a] = kf.force[a]
    kf.force_variance = 0.0
    kf.near_at = kf.changed_at = kf.seconds
    kf.largest_change = max(kf.largest_change, change)
    std = params.g_sensitivity * change
    best = best_snapshot(params, kf, kf.seconds)
    if may_recall and best >= 0:
        snapshot = kf.snapshots[best]
        if variance_since(params, kf, snapshot) < std * std:
            recall_biases(params, kf, snapshot)
            return True
    add_to_biases(params, kf.states, std, 0.0)
    return False
