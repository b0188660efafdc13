# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""How fast biases walk, found between the walks that are tried."""

import numpy as np
import pytest

from fdi_ros.setup.smoother import WALKS, NormalEquations, find_random_walk

WINDOWS, APART = 3000, 2.0  # s
PRIOR = 0.005


def walked(walk, noise, seed):
    """Normal equations of the means of windows of one gyro, whose bias walks; and a constant that nothing shows."""
    random = np.random.default_rng(seed)
    bias = np.cumsum(walk * np.sqrt(APART) * random.standard_normal(WINDOWS))
    shown = bias + noise * random.standard_normal(WINDOWS)
    normal = np.zeros((WINDOWS, 2, 2))
    normal[:, 0, 0] = 1.0 / noise**2
    right = np.zeros((WINDOWS, 2))
    right[:, 0] = shown / noise**2
    apart, prior = np.full(WINDOWS, APART), np.full(2, PRIOR)
    return NormalEquations(1, normal, right, apart, prior, np.zeros(2))


@pytest.mark.parametrize("step", [-0.4, -0.2, 0.0, 0.2, 0.4])
def test_a_walk_between_two_that_are_tried_is_found_to_a_tenth(step):
    walk = WALKS[6] * (WALKS[1] / WALKS[0]) ** step
    found = find_random_walk(walked(walk, walk, seed=1))
    assert found.value == pytest.approx(walk, rel=0.1)
    # One of those that are tried.
    assert 0.7 * walk < found.possible < 2.0 * walk


def test_a_bias_that_does_not_walk_shows_none():
    found = find_random_walk(walked(0.0, 1e-4, seed=2))
    assert found.value == 0.0
    assert found.possible < 1e-5
