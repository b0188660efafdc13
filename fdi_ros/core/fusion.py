# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Fused rate of a sample, its covariance and its protection level."""

from __future__ import annotations

import math
from typing import Any

from numpy.typing import NDArray

from fdi_ros.core.bank import variance_of
from fdi_ros.core.bias import IN_MOTION
from fdi_ros.core.compiled import compiled
from fdi_ros.core.core import Core
from fdi_ros.core.states import AMBIGUOUS, SUSPECT
from fdi_ros.core.subsets import find_covariance, find_growth, find_level_of, find_rate, passes_test
from fdi_ros.model.geometry import MIN_SENSITIVITY

NOISE_SEEN = 1.5
"""A channel with more than so many times the noise expected is that much noisier; less is chance."""


@compiled
def fuse(core: Core, subsets: NDArray[Any], doubtful: int) -> None:
    """Fused rate of the usable channels without the doubtful; with them, or none, if too little would be left."""
    n, last, sensors = core.settings.n, core.last, core.settings.sensors
    trusted = core.usable & ~doubtful
    core.withheld = False
    if doubtful and not subsets[trusted].spare:
        trusted = core.usable & ~core.evidence.outliers
        if not subsets[trusted].spare:
            trusted = core.usable
        if doubtful & trusted and not core.settings.publish_under_doubt:
            core.withheld, trusted = True, 0
    core.fused = trusted
    find_rate(subsets[trusted], n, trusted, core.z, last.rate)
    last.valid = not math.isnan(last.rate[0])
    for i in range(n):
        h = sensors.axes[i]
        along = h[0] * last.rate[0] + h[1] * last.rate[1] + h[2] * last.rate[2]
        core.variance[i] = variance_of(sensors, i, along, core.acceleration.value)
        if core.verdict.noise[i] > NOISE_SEEN:
            core.variance[i] += (core.verdict.noise[i] * core.verdict.noise[i] - 1.0) * (
                sensors.noise_std[i] * sensors.noise_std[i]
            )
        if core.bias.outcome == IN_MOTION:
            # What the biases have in common shows in no residual.
            core.variance[i] += core.remaining[i] * core.remaining[i]
        if doubtful & trusted & (1 << i):
            # It could not be left out: what it may be wrong by belongs into the covariance.
            doubt = core.doubt[i]
            if doubt == 0 and subsets[trusted].sensitivity[i] > MIN_SENSITIVITY:
                # No verdict has estimated it: its difference from the others now.
                doubt = (core.z[i] - along) / subsets[trusted].sensitivity[i]
            core.variance[i] += doubt * doubt
        last.residual[i] = core.z[i] - along if math.isfinite(core.z[i]) else math.nan
    find_covariance(subsets[trusted], n, trusted, core.variance, last.covariance)


@compiled
def find_level(core: Core, subsets: NDArray[Any]) -> None:
    """Protection level of the fused rate; if it is still to be worked out for the channels fused, ``core.wanted``.

    It is for the errors that this sample may have, in its own motion. There is none without a fused rate, while a
    channel under suspicion has to be fused for want of others, and where the separation test fails, whatever the
    verdict is.
    """
    last, subset = core.last, subsets[core.fused]
    passes = last.valid != 0
    for i in range(core.settings.n):
        if core.fused >> i & 1 and last.state[i] in (SUSPECT, AMBIGUOUS):
            passes = False
    core.wanted = core.fused if passes and not subset.has_level else 0
    n, sensors = core.settings.n, core.settings.sensors
    find_growth(n, sensors.noise_std, core.variance, core.remaining, core.growth)
    find_level_of(subset, n, core.fused, core.growth, last.level)
    if not passes or not passes_test(
        subset, sensors.axes, sensors.noise_std, n, core.fused, core.growth, last.residual
    ):
        for a in range(3):
            last.level[a] = math.inf
