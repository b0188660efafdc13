# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What of a channel contradicts the fused rate, from both sides."""

import numpy as np
import pytest

from fdi_ros.compiling.compiled import allocate
from fdi_ros.core.fusion import is_contradicted
from fdi_ros.core.records import Core

NOISE = 0.002


def fused(residual, mask):
    """Two parallel triads at rest, of which the first channel has a residual, rad/s."""
    core = allocate(Core)[0]
    core["settings"]["n"] = 6
    core["settings"]["sensors"]["axes"][:6] = np.tile(np.eye(3), (2, 1))
    core["now"]["variance"][:6] = core["now"]["uncertainty"][:6] = NOISE**2
    core["now"]["fused"] = mask
    core["last"]["residual"][0] = residual
    return core


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize(("size", "contradicts"), [(5.4, False), (5.6, True)])
def test_a_channel_contradicts_the_rate_from_five_and_a_half_deviations_on(
    size, contradicts, sign
):
    """Its residual is less uncertain than itself if it is in the rate, and more if it is not."""
    for mask, times in ((0b111111, 0.5), (0b111110, 2.0)):
        core = fused(sign * size * np.sqrt(times) * NOISE, mask)
        of_rate = NOISE**2 / (2.0 if mask & 1 else 1.0)
        core["last"]["covariance"][[0, 3, 5]] = of_rate, NOISE**2 / 2, NOISE**2 / 2
        found = is_contradicted(core["settings"], core["now"], core["last"], 0)
        assert found == contradicts
