# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Whether all biases have returned to what they were before a move.

A boost that ends takes its move of all biases with it. The biases from before the move,
which were known far better, then explain the values, and none of them has to be learned
again.
"""

from __future__ import annotations

from typing import Annotated

from fdi_ros.compiling.compiled import Channels, Real, Square, Whole, compiled, record
from fdi_ros.detectors.naming import (
    FIT,
    FIT_PER_CHECK,
    Inference,
    fill_total,
    noise_of_mean,
    redundancy,
)
from fdi_ros.estimator.error_states import ErrorStates, Layout
from fdi_ros.estimator.estimator import SNAPSHOTS, TIERS, Constants, Estimator

REFERENCES = 4
"""Number of the last moves of all biases whose end is looked for."""
LONGEST_MOVE = 300.0
"""Largest age of biases that are taken again, s. Their covariance is that of the estimator up
to this age; at 1200 s it is 0.6 of it."""


@record
class Reference:
    """The biases of a moment, and their rates of change."""

    seconds: Real  # since the start
    evidence: Real  # that all biases have returned to it, log odds
    bias: Channels  # rad/s
    rate: Channels  # rad/s^2
    covariance: Square  # of the biases, (rad/s)^2
    mixed: Square  # of the biases (rows) with the rates, rad^2/s^3
    rate_covariance: Square  # of the rates, (rad/s^2)^2


@record
class References:
    """The biases before the last moves of all biases."""

    count: Whole  # moves so far
    kept: Annotated[list[Reference], REFERENCES]


@compiled
def first_rate(layout: Layout) -> int:
    """Return the state that is the rate of change of the first bias. The others follow."""
    for r in range(layout.count):
        if layout.feeds[r] == 0:
            return r
    return -1


@compiled
def keep_reference(
    params: Constants, kf: Estimator, states: ErrorStates, references: References
) -> None:
    """Keep the biases of ``states``, which are of now."""
    n = params.sensors.n
    rates = first_rate(params.layout)
    reference = references.kept[references.count % REFERENCES]
    references.count += 1
    reference.seconds = kf.seconds
    reference.evidence = 0.0
    for i in range(n):
        reference.bias[i] = states.x[i]
        reference.rate[i] = states.x[rates + i]
        for j in range(n):
            reference.covariance[i, j] = states.p[i, j]
            reference.mixed[i, j] = states.p[i, rates + j]
            reference.rate_covariance[i, j] = states.p[rates + i, rates + j]


@compiled
def covariance_since(
    params: Constants, reference: Reference, seconds: float, i: int, j: int
) -> float:
    """Return the covariance of biases i and j so long after the reference, (rad/s)^2."""
    total = reference.covariance[i, j]
    total += seconds * (reference.mixed[i, j] + reference.mixed[j, i])
    total += seconds * seconds * reference.rate_covariance[i, j]
    if i == j:
        walk = params.layout.walk[i]
        total += seconds * walk * walk + params.bias_move * params.bias_move
    return total


@compiled
def believe_noise(params: Constants, kf: Estimator, inference: Inference) -> None:
    """Take the noise of a mean of several blocks as it has been so far.

    Unknown slow noise would hide how well the biases of a reference explain the mean.
    Where there is such noise, they do not explain it.
    """
    size = kf.samples - inference.before.sample
    for i in range(params.sensors.n):
        doubted = noise_of_mean(params, kf.noise, i, size)
        known = doubted / kf.noise.unknown[i]
        inference.covariance[i, i] += known - doubted


@compiled
def log_evidence(params: Constants, inference: Inference) -> float:
    """Return the log likelihood of the mean, whatever the rate."""
    log_det = fill_total(params, inference)
    return -inference.total - 0.5 * log_det


@compiled
def suppose_returned(
    params: Constants,
    kf: Estimator,
    inference: Inference,
    reference: Reference,
    sign: float,
) -> None:
    """Put the biases of a reference in place of the present ones in a mean, or take them out again (``sign`` -1).

    What the mean contains of the other states stays.
    """
    n = params.sensors.n
    passed = kf.seconds - reference.seconds
    columns = inference.at.columns
    for i in range(n):
        before = reference.bias[i] + passed * reference.rate[i]
        inference.y[i] += sign * (kf.states.x[i] - before)
        for j in range(n):
            present = columns[i, j] + columns[j, i] - kf.states.p[i, j]
            returned = covariance_since(params, reference, passed, i, j)
            inference.covariance[i, j] += sign * (returned - present)


@compiled
def find_returned(
    params: Constants,
    kf: Estimator,
    references: References,
    inference: Inference,
    least: float,
) -> int:
    """Add the evidence of a mean to that of each reference; return the one to which all biases have returned, or -1.

    ``inference`` has a mean that begins where the last one ended. The evidence is the sum
    of the log likelihood ratios against the present biases since it was last negative. It
    must exceed ``least``, and the biases of the reference must leave only noise.
    """
    best = -1
    free = redundancy(inference.mask, params.sensors.n)
    now = log_evidence(params, inference)
    for k in range(min(references.count, REFERENCES)):
        reference = references.kept[k]
        suppose_returned(params, kf, inference, reference, 1.0)
        gained = log_evidence(params, inference) - now
        rest = 2.0 * inference.total
        suppose_returned(params, kf, inference, reference, -1.0)
        reference.evidence = max(reference.evidence, 0.0) + gained
        fits = rest <= FIT + FIT_PER_CHECK * max(free, 0)
        is_recent = kf.seconds - reference.seconds < LONGEST_MOVE
        if fits and is_recent and reference.evidence > least:
            best = k
            least = reference.evidence
    return best


@compiled
def return_biases(
    params: Constants, kf: Estimator, references: References, k: int, mask: int
) -> None:
    """Give the present states, and all snapshots since, the biases of a reference.

    mask: channels that showed the return. The others, which were silent, keep their own.
    """
    reference = references.kept[k]
    for other in range(REFERENCES):
        references.kept[other].evidence = 0.0
    replace_biases(params, kf.states, reference, kf.seconds - reference.seconds, mask)
    for k in range(TIERS * SNAPSHOTS):
        snapshot = kf.snapshots[k]
        passed = snapshot.seconds - reference.seconds
        if passed > 0.0:
            replace_biases(params, snapshot.states, reference, passed, mask)


@compiled
def replace_biases(
    params: Constants,
    states: ErrorStates,
    reference: Reference,
    seconds: float,
    mask: int,
) -> None:
    """Replace the biases and rates of some channels by those of a reference so long before."""
    n = params.sensors.n
    layout = params.layout
    rates = first_rate(layout)
    for i in range(n):
        if not mask >> i & 1:
            continue
        for r in (i, rates + i):
            for c in range(layout.count):
                states.p[r, c] = states.p[c, r] = 0.0
    for i in range(n):
        if not mask >> i & 1:
            continue
        states.x[i] = reference.bias[i] + seconds * reference.rate[i]
        states.x[rates + i] = reference.rate[i]
        for j in range(n):
            if not mask >> j & 1:
                continue
            mixed = reference.mixed[i, j] + seconds * reference.rate_covariance[i, j]
            states.p[i, j] = covariance_since(params, reference, seconds, i, j)
            states.p[i, rates + j] = states.p[rates + j, i] = mixed
            states.p[rates + i, rates + j] = reference.rate_covariance[i, j]
