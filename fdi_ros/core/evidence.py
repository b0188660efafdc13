# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Evidence of one sample for the decision: verdict of the detector, stuck, drifted and broken channels."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import compiled
from fdi_ros.core.health import (
    CERTAIN_BEYOND,
    INTERMITTENT_SHARE,
    broken_channels,
    intermittent_channels,
)
from fdi_ros.core.records import Core, Current, PathSettings, SampleInput
from fdi_ros.core.repeated import add_stuck, update_stuck
from fdi_ros.core.sensors import variance_of

#: Standard deviations by which a bias must exceed its limit: by chance 1 in 30 000.
SURE_DRIFT = 4.0


@compiled
def gather_evidence(core: Core, subsets: NDArray[Any]) -> int:
    """Write the evidence except the suspects of the verdict.

    Return the mask of stuck channels.
    """
    settings = core.settings
    health = core.health
    now = core.now
    evidence = core.now.evidence
    evidence.judged = not math.isnan(now.verdict.statistic)
    evidence.checked = subsets[core.sample.mask].detectable if evidence.judged else 0
    evidence.checked &= core.sample.estimate.checked
    evidence.no_votes = core.sample.in_recovery
    evidence.broken = broken_channels(settings, health, evidence.stamp)
    evidence.repeats = evidence.agrees = clear = 0
    may_return = not settings.latch and core.decision.faulty != 0
    for i in range(settings.n):
        if (
            settings.stuck_time
            and evidence.stamp - health.run_stamp[i] >= settings.stuck_time
        ):
            evidence.repeats |= 1 << i
        if not now.verdict.suspects[i]:
            clear |= 1 << i
        evidence.error[i] = now.corrected[i] - now.along[i]
        # Old values are no agreement: a stuck value is near the others at rest.
        renewed = now.plain & ~now.repeated & ~evidence.repeats
        if may_return and renewed >> i & 1 and not now.all_repeat:
            # In a usual geometry the prediction by n - 1 channels is at most as
            # uncertain as the channel itself.
            variance = 2 * variance_of(
                settings.sensors, i, now.along[i], core.acceleration.value
            )
            if abs(evidence.error[i]) <= settings.return_limit * math.sqrt(variance):
                evidence.agrees |= 1 << i
    evidence.intermittent = intermittent_channels(
        settings,
        health,
        health.gone,
        health.leaves,
        (INTERMITTENT_SHARE, CERTAIN_BEYOND),
    )
    evidence.unclear = unclear_members(core)
    clear &= now.usable
    return update_stuck(core, subsets, clear, evidence.stamp)


@compiled
def unclear_members(core: Core) -> int:
    """Return the members of the set that have not agreed with others in this sample.

    Nothing checks them, or they still repeat the value for which they are in the set. A
    set of which the operator took out a channel has none.
    """
    decision = core.decision
    evidence = core.now.evidence
    if decision.ambiguous & core.excluded:
        return 0
    return int(
        decision.ambiguous & ~evidence.checked | decision.voted & evidence.repeats
    )


@compiled
def fill_suspects(core: Core, stuck: int) -> None:
    """Write the channels suspected by the verdict or by repeated values."""
    settings = core.settings
    now = core.now
    evidence = core.now.evidence
    verdict = core.now.verdict
    n = settings.n
    evidence.certain = 0
    evidence.undecided = 0
    evidence.outliers = bits_of(verdict.outliers, n) | now.repeated | evidence.flickers
    if settings.by_evidence and verdict.alarm and not evidence.no_votes:
        if verdict.isolated:
            evidence.certain = bits_of(verdict.suspects, n)
        else:
            evidence.undecided = bits_of(verdict.suspects, n)
    for u in range(settings.units):
        # The driver or the bus repeats all values of the unit: no channel is worse than
        # the others.
        if settings.members[u] & stuck & now.repeated:
            stuck |= settings.members[u] & now.in_use
    update_drifted(settings, core.sample, now)
    evidence.certain |= evidence.drifted
    evidence.suspected = evidence.isolated = 0
    if not settings.by_evidence:
        evidence.suspected = bits_of(verdict.suspects, n)
        evidence.isolated = evidence.suspected if verdict.isolated else 0
    add_stuck(settings, now, stuck)
    evidence.suspected |= stuck
    if stuck & (stuck - 1) == 0:
        evidence.isolated |= stuck


@compiled
def update_drifted(settings: PathSettings, sample: SampleInput, now: Current) -> None:
    """Find channels whose bias certainly exceeds ``max_drift``, and add them as suspects."""
    now.evidence.drifted = 0
    estimate = sample.estimate
    if settings.max_drift > 0.0 and estimate.is_current:
        for i in range(settings.n):
            bias = abs(estimate.bias[i]) - SURE_DRIFT * estimate.bias_std[i]
            clear = sample.mask & ~estimate.unclear
            if clear >> i & 1 and bias > settings.max_drift:
                now.evidence.drifted |= 1 << i
                now.verdict.suspects[i] = True
                now.verdict.error[i] = estimate.bias[i]


@compiled
def bits_of(flags: NDArray[np.uint8], n: int) -> int:
    """Return the mask of the channels whose flag is set."""
    mask = 0
    for i in range(n):
        if flags[i]:
            mask |= 1 << i
    return mask
