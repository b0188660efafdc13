# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""How soon after its onset a shift of all biases must be complete, from both sides."""

import numpy as np
import pytest

from fdi_ros.compiling.compiled import allocate
from fdi_ros.detectors.case import State, is_steady
from fdi_ros.estimator.estimator import Constants
from fdi_ros.estimator.noise import BLOCK

BLOCKS = 60  # of 40 ms


@pytest.mark.parametrize("size", [-12.0, 12.0])
@pytest.mark.parametrize(
    ("begins", "steady"), [(0.0, True), (0.2, True), (0.6, False), (0.8, False)]
)
def test_a_shift_that_is_complete_within_a_quarter_of_a_second_stays(
    begins, steady, size
):
    """Time from the onset, a second ago, until the error is there: motors or a boost start."""
    params, state = allocate(Constants)[0], allocate(State)[0]
    params["period"] = 0.01
    params["sensors"]["n"] = 1
    state["estimator"]["samples"] = 1000
    state["case"]["onset"] = 900
    scale = state["scales"][BLOCK]
    scale["kept"], scale["newest"] = BLOCKS, BLOCKS - 1
    ago = 0.04 * np.arange(BLOCKS)[::-1]
    scale["series"][:BLOCKS, 0] = np.where(ago < 1.0 - begins, size, 0.0)
    assert is_steady(params, state) == steady
