# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Geometry, noise and thresholds: identities, published figures, SciPy and simulation as oracles, refusals."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import combinations

import numpy as np
import pytest
from detectors.detector_trials import lopsided
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import chdtrc, chdtri

from fdi_ros import FdiError, Geometry, NoiseModel
from fdi_ros.model.noise import chi2_isf, chi2_sf, max_normal_threshold, normal_isf


@given(seed=st.integers(0, 10_000), n=st.integers(4, 12))
def test_identities(seed: int, n: int) -> None:
    geometry = lopsided(np.random.default_rng(seed), n)
    H, S, V = geometry.axes, geometry.S, geometry.parity
    np.testing.assert_allclose(geometry.least_squares @ H, np.eye(3), atol=1e-10)
    np.testing.assert_allclose(S @ S, S, atol=1e-10)
    np.testing.assert_allclose(S @ H, 0, atol=1e-10)
    np.testing.assert_allclose(V @ V.T, np.eye(n - 3), atol=1e-10)
    np.testing.assert_allclose(V.T @ V, S, atol=1e-10)
    assert np.trace(S) == pytest.approx(n - 3)
    # A channel that reaches no parity direction has no angle to the others.
    seen = geometry.detectable
    unit = V[:, seen] / np.linalg.norm(V[:, seen], axis=0)
    np.testing.assert_allclose(
        geometry.rho[np.ix_(seen, seen)], unit.T @ unit, atol=1e-8
    )


ARRANGEMENTS = {
    "dodecahedron": (Geometry.dodecahedron(), 0.4472, 0.809),
    "two-triad cone": (Geometry.two_triad_cone(), 0.6667, 0.894),
    "parallel triads": (Geometry.from_triads([np.eye(3), np.eye(3)]), 1.0, None),
}


@pytest.mark.parametrize("name", ARRANGEMENTS)
def test_published_figures(name: str) -> None:
    geometry, largest_rho, after_one = ARRANGEMENTS[name]
    np.testing.assert_allclose(
        geometry.axes.T @ geometry.axes, 2 * np.eye(3), atol=1e-12
    )
    np.testing.assert_allclose(np.diag(geometry.S), 0.5, atol=1e-12)
    off = ~np.eye(6, dtype=bool)
    assert np.abs(geometry.rho[off]).max() == pytest.approx(largest_rho, abs=5e-5)
    assert geometry.gdop == pytest.approx(1.2247, abs=5e-5)
    for lost in range(6):
        left = geometry.subset(np.arange(6) != lost)
        assert left.gdop == pytest.approx(1.4142, abs=5e-5)
        if after_one is not None:
            assert np.abs(left.rho[~np.eye(5, dtype=bool)]).max() == pytest.approx(
                after_one, abs=5e-4
            )


def test_two_triad_cone_as_the_paper_says() -> None:
    geometry = Geometry.two_triad_cone()
    np.testing.assert_allclose(geometry.covariance(), 0.5 * np.eye(3), atol=1e-12)
    determinants = [
        abs(np.linalg.det(geometry.axes[list(three)]))
        for three in combinations(range(6), 3)
    ]
    assert min(determinants) == pytest.approx(1 / 3)
    for i, j in combinations(range(6), 2):
        expected = 0.0 if i // 3 == j // 3 else (-1 / 3 if j == i + 3 else 2 / 3)
        assert geometry.rho[i, j] == pytest.approx(expected, abs=1e-12)


def test_what_can_be_told_apart() -> None:
    geometry = Geometry.from_triads([np.eye(3), np.eye(3)])
    assert geometry.groups == ((0, 3), (1, 4), (2, 5))
    for group in geometry.groups:
        for i in group:
            assert np.flatnonzero(geometry.group_matrix[i]).tolist() == list(group)
    assert not geometry.isolable.any()
    assert geometry.detectable.all()
    assert geometry.channel_names[:4] == ("imu_1.x", "imu_1.y", "imu_1.z", "imu_2.x")
    assert Geometry.cone(4).groups == ((0, 1, 2, 3),)
    # Nothing checks two of these axes.
    alone = Geometry([[1, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    assert alone.detectable.tolist() == [True, True, False, False]
    assert not alone.rho[2, [0, 1, 3]].any()


def test_variance_is_that_of_simulated_errors() -> None:
    geometry, rng, rows = Geometry.two_triad_cone(), np.random.default_rng(1), 400_000
    noise = NoiseModel(
        2e-3, scale_std=np.linspace(0.001, 0.006, 6), timing_std=4e-4
    ).for_channels(6)
    rate, acceleration = np.array([[1.0, -2.0, 0.5]]), np.array([[5.0, 10.0, -3.0]])
    errors = rng.standard_normal((rows, 6)) * noise.noise_std
    errors += (
        rng.standard_normal((rows, 6)) * noise.scale_std * (rate @ geometry.axes.T)
    )
    errors += (
        rng.standard_normal((rows, 6))
        * noise.timing_std
        * (acceleration @ geometry.axes.T)
    )
    variance = noise.variance(geometry, rate, acceleration)[0]
    # The standard error of a variance from N samples is variance * sqrt(2 / N).
    np.testing.assert_allclose(errors.var(axis=0), variance, rtol=4 * np.sqrt(2 / rows))
    still = noise.variance(geometry, rate, np.zeros((1, 3)))
    np.testing.assert_array_equal(
        noise.variance(geometry, rate), still, err_msg="without acceleration"
    )


def test_subset_takes_the_channels_left() -> None:
    kept, geometry = [True, False, True, True, True], Geometry.cone(5)
    part = geometry.subset(kept)
    assert part.channel_names == ("g1", "g3", "g4", "g5")
    np.testing.assert_array_equal(part.axes, geometry.axes[kept])
    noise = NoiseModel(
        [1.0, 2, 3, 4, 5],
        scale_std=0.1,
        bound=[5.0, 6, 7, 8, 9],
        bias_std=[0.0, 1, 2, 3, 4],
    )
    left = noise.subset(kept)
    expected = {
        "noise_std": [1, 3, 4, 5],
        "scale_std": [0.1] * 4,
        "bound": [5, 7, 8, 9],
        "bias_std": [0, 2, 3, 4],
    }
    for name, values in expected.items():
        np.testing.assert_array_equal(getattr(left, name), values)
    assert NoiseModel(1.0).subset([True] * 4).bound is None


def directions(geometry: Geometry) -> np.ndarray:
    v = geometry.parity.T
    return v / np.linalg.norm(v, axis=1, keepdims=True)


PUBLISHED = {
    # 1e-2, 1e-3, and 1e-3 false alarms an hour at 100 Hz.
    "dodecahedron": (Geometry.dodecahedron(), (3.117, 3.756, 6.231)),
    "two-triad cone": (Geometry.two_triad_cone(), (3.099, 3.744, 6.2305)),
    "Bonferroni": (None, (3.144, 3.765, 6.231)),
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_largest_of_six_published(name: str) -> None:
    geometry, published = PUBLISHED[name]
    for probability, expected in zip(
        (1e-2, 1e-3, 1e-3 / (3600 * 100)), published, strict=True
    ):
        own = (
            normal_isf(probability / 12)
            if geometry is None
            else max_normal_threshold(directions(geometry), probability)
        )
        assert own == pytest.approx(expected, abs=6e-4)


@pytest.mark.parametrize("dof", range(1, 10))
def test_chi_square_equals_scipy(dof: int) -> None:
    x = np.array([1e-3, 0.5, 3.0, 20.0, 80.0, 300.0])
    np.testing.assert_allclose(chi2_sf(x, dof), chdtrc(dof, x), rtol=1e-10)
    for probability in (0.3, 1e-3, 1e-9):
        assert chi2_isf(probability, dof) == pytest.approx(
            chdtri(dof, probability), rel=1e-7
        )


def test_twins_count_once() -> None:
    twin_triads = Geometry.from_triads([np.eye(3), np.eye(3)])
    three_independent = math.sqrt(chi2_isf(1 - (1 - 1e-3) ** (1 / 3), 1))
    assert max_normal_threshold(directions(twin_triads), 1e-3) == pytest.approx(
        three_independent, abs=2e-4
    )


PLANE = [[1, 0, 0], [0, 1, 0], [0.6, 0.8, 0], [0.8, -0.6, 0]]


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: Geometry(np.ones((4, 2))), r"shape \(4, 2\), expected \(n, 3\)"),
        (lambda: Geometry(np.eye(3)), "3 channels, expected 4 to 12"),
        (lambda: Geometry([*np.eye(3), [0, np.nan, 1]]), "channel 4 is not finite"),
        (
            lambda: Geometry([*np.eye(3), [0, 0.1, 0.1]]),
            "channel 4 has norm 0.1414, expected 0.5 to 2",
        ),
        (lambda: Geometry(PLANE), "do not span three dimensions"),
        (
            lambda: Geometry(Geometry.cone(4).axes, ["a", "b"]),
            "2 channel names for 4 axes",
        ),
        (
            lambda: Geometry(Geometry.cone(4).axes, ["a", "b", "a", "c"]),
            "names are not unique",
        ),
        (
            lambda: Geometry.from_triads([np.eye(3), 1.1 * np.eye(3)]),
            "unit 2 is no rotation",
        ),
        (
            lambda: Geometry.from_triads([np.eye(3), -np.eye(3)]),
            "unit 2 is a reflection",
        ),
        (
            lambda: Geometry.from_triads([np.eye(3), np.eye(2)]),
            r"unit 2 has shape \(2, 2\)",
        ),
        (
            lambda: Geometry.from_triads([np.eye(3), np.full((3, 3), np.nan)]),
            "unit 2 is not finite",
        ),
        (
            lambda: Geometry.cone(5).subset([True, True, True, False, False]),
            "3 channels, expected 4 to 12",
        ),
        (lambda: NoiseModel(0.0), "noise.noise_std is 0.0 rad/s, expected finite, > 0"),
        (lambda: NoiseModel([1.0, np.nan]), "noise.noise_std is nan"),
        (lambda: NoiseModel([]), r"noise.noise_std is \[\]"),
        (
            lambda: NoiseModel(1.0, scale_std=-0.1),
            "noise.scale_std is -0.1, expected finite, >= 0 and <= 1",
        ),
        (
            lambda: NoiseModel(1.0, timing_std=2.0),
            "noise.timing_std is 2.0 s, expected finite, >= 0 and <= 1",
        ),
        (
            lambda: NoiseModel(1.0, bias_std=-1.0),
            "noise.bias_std is -1.0 rad/s, expected finite, >= 0",
        ),
        (
            lambda: NoiseModel(1.0, bound=0.0),
            "noise.bound is 0.0 rad/s, expected finite, > 0",
        ),
        (
            lambda: NoiseModel(1.0, scale_std=[0.1, 0.2, 0.3]).for_channels(5),
            r"noise\.scale_std has 3 values, expected 1 or 5",
        ),
    ],
)
def test_refused(build: Callable[[], object], words: str) -> None:
    with pytest.raises(FdiError, match=words) as caught:
        build()
    assert "\n" not in str(caught.value)
