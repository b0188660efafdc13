# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""How large the errors are in a turn that no state of the estimator describes."""

import numpy as np
import pytest

from fdi_ros.compiling.compiled import allocate
from fdi_ros.estimator.blocks import update_extra_variance
from fdi_ros.estimator.estimator import Constants, Estimator

BLOCK, TIMING, NOISE = 0.04, 1e-3, 0.2  # s, s, rad/s^2


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize(
    ("turn", "newest", "sure"),
    [
        # Less two standard deviations of its noise.
        (3.0, 1.0, 2.6),
        (1.0, 3.0, 2.6),
        (-1.0, 3.0, 2.6),
        (2.0, 2.0, 1.6),
        (0.3, -0.39, 0.0),
    ],
)
def test_a_late_sample_is_off_by_the_largest_angular_acceleration_of_late(
    turn, newest, sure, sign
):
    """That of the block before, or the newest: a turn may begin or end."""
    params, kf = allocate(Constants)[0], allocate(Estimator)[0]
    params["layout"]["delays"][0] = -1
    params["sensors"]["axes"][0] = [0.0, 1.0, 0.0]
    params["timing"][0] = TIMING
    kf["times"][:] = 2.0 * BLOCK, BLOCK, 0.0
    kf["acceleration"][1] = sign * turn
    kf["rates"][0, 1] = sign * newest * BLOCK
    kf["turn_noise"] = NOISE**2
    update_extra_variance(params, kf, 0)
    assert np.sqrt(kf["extra"][0]) == pytest.approx(TIMING * sure, abs=1e-12)
