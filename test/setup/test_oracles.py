# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Figures of set-up against their definitions: stated errors of the noise, and what the best test finds."""

import math

import numpy as np
import pytest
from scipy.optimize import brentq

from fdi_ros.model.geometry import Geometry
from fdi_ros.setup.mounting import smallest_shift
from fdi_ros.setup.noise import find_floor


def test_the_stated_error_of_the_noise_is_its_scatter():
    """Two triads show half of the variance of a channel: the error is twice that of a channel seen alone."""
    axes, random = Geometry.two_triad_cone().axes, np.random.default_rng(3)
    windows, samples, found, stated = 40, 25, [], []
    for _ in range(60):
        z = random.standard_normal((windows, samples, 6))
        z -= z.mean(axis=1, keepdims=True)
        covariance = np.swapaxes(z, 1, 2) @ z / (samples - 1)
        floor = find_floor(
            covariance,
            np.full(windows, samples),
            np.ones((windows, 6), dtype=bool),
            axes,
        )
        found.append(floor.std)
        stated.append(floor.error)
    ratio = np.std(found, axis=0).mean() / np.mean(stated)
    assert 0.7 < ratio < 1.4


@pytest.mark.parametrize("samples", [5.0, 100.0, 6000.0])
@pytest.mark.parametrize("run_length", [1e4, 3.6e8])
def test_the_smallest_shift_is_that_of_the_cusum_with_this_run_length(
    samples, run_length
):
    """The level follows from the delay, and from the level the run length (Siegmund 1985)."""
    shift = smallest_shift(samples, run_length)
    level = brentq(
        lambda x: 2.0 * (math.exp(-x) + x - 1.0) / shift**2 - samples, 1e-6, 1e4
    )
    found = 2.0 * (math.exp(level) - level - 1.0) / shift**2
    assert found == pytest.approx(run_length, rel=1e-3)
