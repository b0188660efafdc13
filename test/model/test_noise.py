# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Variance of a healthy channel, its channels, refusals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fdi_ros import Geometry, NoiseModel, create_detector
from fdi_ros.errors import ConfigError


def test_variance_is_that_of_simulated_errors() -> None:
    geometry, rng, rows = Geometry.two_triad_cone(), np.random.default_rng(1), 400_000
    noise = NoiseModel(2e-3, scale_std=np.linspace(0.001, 0.006, 6), timing_std=4e-4).for_channels(6)
    rate, acceleration = np.array([[1.0, -2.0, 0.5]]), np.array([[5.0, 10.0, -3.0]])
    errors = rng.standard_normal((rows, 6)) * noise.noise_std
    errors += rng.standard_normal((rows, 6)) * noise.scale_std * (rate @ geometry.axes.T)
    errors += rng.standard_normal((rows, 6)) * noise.timing_std * (acceleration @ geometry.axes.T)
    variance = noise.variance(geometry, rate, acceleration)[0]
    # The standard error of a variance from N samples is variance * sqrt(2 / N).
    np.testing.assert_allclose(errors.var(axis=0), variance, rtol=4 * np.sqrt(2 / rows))


def test_no_acceleration_is_zero_acceleration_and_where_nothing_depends_on_motion() -> None:
    geometry, noise = Geometry.cone(5), NoiseModel(1e-3, timing_std=1e-3).for_channels(5)
    rate = np.ones((3, 3))
    np.testing.assert_array_equal(noise.variance(geometry, rate), noise.variance(geometry, rate, np.zeros((3, 3))))
    assert NoiseModel(1.0).constant
    assert not NoiseModel(1.0, scale_std=1e-3).constant
    assert not NoiseModel(1.0, timing_std=[0, 0, 0, 1e-3]).constant


def test_subset_takes_the_channels_left() -> None:
    noise = NoiseModel([1.0, 2, 3, 4, 5], scale_std=0.1, bound=[5.0, 6, 7, 8, 9], bias_std=[0.0, 1, 2, 3, 4])
    left = noise.subset([True, False, True, True, True])
    expected = {"noise_std": [1, 3, 4, 5], "scale_std": [0.1] * 4, "bound": [5, 7, 8, 9], "bias_std": [0, 2, 3, 4]}
    for name, values in expected.items():
        np.testing.assert_array_equal(getattr(left, name), values)
    assert NoiseModel(1.0).subset([True] * 4).bound is None


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"noise_std": 0.0}, "noise.noise_std is 0.0 rad/s, expected finite, > 0"),
        ({"noise_std": -1.0}, "noise.noise_std is -1.0 rad/s"),
        ({"noise_std": [1.0, np.nan]}, "noise.noise_std is nan"),
        ({"noise_std": np.inf}, "noise.noise_std is inf"),
        ({"noise_std": []}, r"noise.noise_std is \[\]"),
        ({"noise_std": 1.0, "scale_std": -0.1}, "noise.scale_std is -0.1, expected finite, >= 0 and <= 1"),
        ({"noise_std": 1.0, "scale_std": 1.5}, "noise.scale_std is 1.5"),
        ({"noise_std": 1.0, "timing_std": 2.0}, "noise.timing_std is 2.0 s, expected finite, >= 0 and <= 1"),
        ({"noise_std": 1.0, "bias_std": -1.0}, "noise.bias_std is -1.0 rad/s, expected finite, >= 0"),
        ({"noise_std": 1.0, "bias_std": np.inf}, "noise.bias_std is inf"),
        ({"noise_std": 1.0, "bound": 0.0}, "noise.bound is 0.0 rad/s, expected finite, > 0"),
        ({"noise_std": 1.0, "scale_std": [0.1, 0.2, 0.3]}, r"noise\.scale_std has 3 values, expected 1 or 5"),
    ],
)
def test_refused(values: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words) as caught:
        create_detector("likelihood_ratio", Geometry.cone(5), NoiseModel(**values))
    assert "\n" not in str(caught.value)
