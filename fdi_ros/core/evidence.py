# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the decision gets of one sample: from the verdict of the detector, the checks, and values that repeat."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.core.bank import variance_of
from fdi_ros.core.compiled import compiled
from fdi_ros.core.core import Core
from fdi_ros.core.health import NON_FINITE_LASTING
from fdi_ros.core.stuck import add_stuck, find_stuck

SURELY = 4.0
"""Standard deviations by which a bias is beyond its limit before that counts."""


@compiled
def gather_evidence(core: Core, subsets: NDArray[Any]) -> int:
    """Fill in the evidence, but for what the verdict names; return bits of stuck channels."""
    n, evidence, limits, health = core.settings.n, core.evidence, core.settings.health, core.health
    evidence.judged = not math.isnan(core.verdict.statistic)
    evidence.checked = subsets[core.fed_mask].detectable if evidence.judged else 0
    if core.settings.estimates:
        evidence.checked &= core.estimate.checked
    evidence.held = core.saturated and evidence.stamp - core.saturated_stamp <= limits.recovery_time
    evidence.broken = evidence.repeats = clear = 0
    for i in range(n):
        if health.condition[i] == NON_FINITE_LASTING:
            evidence.broken |= 1 << i
        if limits.stuck_time and evidence.stamp - health.run_stamp[i] >= limits.stuck_time:
            evidence.repeats |= 1 << i
        if not core.verdict.suspects[i]:
            clear |= 1 << i
        evidence.error[i] = core.z[i] - core.along[i]
    find_agreement(core)
    clear &= core.usable
    return find_stuck(core, subsets[clear], clear, evidence.stamp)


@compiled
def find_agreement(core: Core) -> None:
    """Which channels agree with the others, where one that was declared may return."""
    core.evidence.agrees = 0
    if core.settings.decision.latch or not core.decision.faulty:
        return
    for i in range(core.settings.n):
        # The prediction of n - 1 channels is at worst as uncertain as the channel itself on a sane mounting.
        variance = 2 * variance_of(core.settings.sensors, i, core.along[i], core.acceleration.value)
        if core.plain >> i & 1 and abs(core.evidence.error[i]) <= core.settings.return_limit * math.sqrt(variance):
            core.evidence.agrees |= 1 << i


@compiled
def find_named(core: Core, n: int, stuck: int) -> None:
    """Fill in which channels the verdict and their repeated values name."""
    evidence, verdict = core.evidence, core.verdict
    evidence.certain = evidence.undecided = 0
    evidence.outliers, suspects = bits_of(verdict.outliers, n) | core.repeated, bits_of(verdict.suspects, n)
    if stuck & core.repeated:
        # All values of a unit are old: its driver or its bus repeats them, and no channel is worse than the others.
        stuck |= units_of(core, stuck & core.repeated)
    if core.settings.decision.evidence and verdict.alarm and not evidence.held:
        if verdict.isolated:
            evidence.certain = suspects
        else:
            evidence.undecided = suspects
    evidence.certain |= find_drifted(core)
    add_stuck(core, stuck)
    for i in range(n):
        if verdict.error[i] != 0:
            core.doubt[i] = verdict.error[i]
    evidence.named, evidence.isolated = bits_of(verdict.suspects, n), verdict.isolated
    if core.settings.decision.evidence:
        evidence.named, evidence.isolated = stuck, stuck & (stuck - 1) == 0


@compiled
def find_drifted(core: Core) -> int:
    """Channels whose bias is surely beyond what a bias may be."""
    drifted = 0
    if core.settings.estimates and core.settings.max_drift > 0.0 and core.estimate.known:
        for i in range(core.settings.n):
            bias = abs(core.estimate.bias[i]) - SURELY * core.estimate.bias_std[i]
            if core.fed_mask >> i & 1 and bias > core.settings.max_drift:
                drifted |= 1 << i
                core.verdict.suspects[i] = True
                core.verdict.error[i] = core.estimate.bias[i]
    return drifted


@compiled
def bits_of(flags: NDArray[np.uint8], n: int) -> int:
    """Set of the channels whose flag is set."""
    mask = 0
    for i in range(n):
        if flags[i]:
            mask |= 1 << i
    return mask


@compiled
def units_of(core: Core, channels: int) -> int:
    """Set of all channels of the units that these are of."""
    members, mask = core.settings.members, 0
    for u in range(core.settings.units):
        if members[u] & channels:
            mask |= members[u]
    return mask
