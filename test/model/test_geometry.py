# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Identities of the parity space, published figures of the arrangements, refusals."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fdi_ros import Geometry
from fdi_ros.errors import GeometryError


def random_geometry(seed: int, n: int) -> Geometry:
    rng = np.random.default_rng(seed)
    while True:
        axes = rng.standard_normal((n, 3))
        axes *= rng.uniform(0.6, 1.9, (n, 1)) / np.linalg.norm(axes, axis=1, keepdims=True)
        if np.linalg.svd(axes, compute_uv=False)[-1] > 0.1:
            return Geometry(axes)


@given(seed=st.integers(0, 10_000), n=st.integers(4, 12))
def test_identities(seed: int, n: int) -> None:
    geometry = random_geometry(seed, n)
    H, S, V = geometry.axes, geometry.S, geometry.parity
    np.testing.assert_allclose(geometry.least_squares @ H, np.eye(3), atol=1e-10)
    np.testing.assert_allclose(S @ S, S, atol=1e-10)
    np.testing.assert_allclose(S @ H, 0, atol=1e-10)
    np.testing.assert_allclose(V @ V.T, np.eye(n - 3), atol=1e-10)
    np.testing.assert_allclose(V.T @ V, S, atol=1e-10)
    assert np.trace(S) == pytest.approx(n - 3)
    unit = V / np.linalg.norm(V, axis=0)
    expected = unit.T @ unit
    seen = geometry.detectable
    np.testing.assert_allclose(geometry.rho[np.ix_(seen, seen)], expected[np.ix_(seen, seen)], atol=1e-8)


ARRANGEMENTS = {
    "dodecahedron": (Geometry.dodecahedron(), 0.4472, 0.809),
    "two-triad cone": (Geometry.two_triad_cone(), 0.6667, 0.894),
    "parallel triads": (Geometry.from_triads([np.eye(3), np.eye(3)]), 1.0, None),
}


@pytest.mark.parametrize("name", ARRANGEMENTS)
def test_published_figures(name: str) -> None:
    geometry, largest_rho, after_one = ARRANGEMENTS[name]
    np.testing.assert_allclose(geometry.axes.T @ geometry.axes, 2 * np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.diag(geometry.S), 0.5, atol=1e-12)
    off = ~np.eye(6, dtype=bool)
    assert np.abs(geometry.rho[off]).max() == pytest.approx(largest_rho, abs=5e-5)
    assert geometry.gdop == pytest.approx(1.2247, abs=5e-5)
    for lost in range(6):
        left = geometry.subset(np.arange(6) != lost)
        assert left.gdop == pytest.approx(1.4142, abs=5e-5)
        if after_one is not None:
            assert np.abs(left.rho[~np.eye(5, dtype=bool)]).max() == pytest.approx(after_one, abs=5e-4)


def test_two_triad_cone_as_the_paper_says() -> None:
    geometry = Geometry.two_triad_cone()
    np.testing.assert_allclose(geometry.covariance(), 0.5 * np.eye(3), atol=1e-12)
    determinants = [abs(np.linalg.det(geometry.axes[list(three)])) for three in combinations(range(6), 3)]
    assert min(determinants) == pytest.approx(1 / 3)
    for i, j in combinations(range(6), 2):
        expected = 0.0 if i // 3 == j // 3 else (-1 / 3 if j == i + 3 else 2 / 3)
        assert geometry.rho[i, j] == pytest.approx(expected, abs=1e-12)


@given(seed=st.integers(0, 10_000))
def test_two_turned_triads_correlate_by_the_rotation(seed: int) -> None:
    rotation = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    rho = Geometry.from_triads([np.eye(3), rotation]).rho
    np.testing.assert_allclose(np.abs(rho[:3, 3:]), np.abs(rotation), atol=1e-9)


@pytest.mark.parametrize("n", [4, 5, 7, 9, 12])
def test_cone(n: int) -> None:
    axes = Geometry.cone(n).axes
    np.testing.assert_allclose(axes @ [0, 0, 1], np.full(n, 1 / np.sqrt(3)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(axes, axis=1), 1, atol=1e-12)


def test_dodecahedron_angles() -> None:
    axes = Geometry.dodecahedron().axes
    np.testing.assert_allclose(np.abs(axes @ axes.T)[~np.eye(6, dtype=bool)], np.sqrt(1 / 5), atol=1e-12)


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


def test_subset_keeps_names_and_axes_which_cannot_be_written_to() -> None:
    geometry = Geometry.two_triad_cone()
    left = geometry.subset([True, False, True, True, True, True])
    assert left.channel_names == ("g1", "g3", "g4", "g5", "g6")
    np.testing.assert_array_equal(left.axes, geometry.axes[[0, 2, 3, 4, 5]])
    with pytest.raises(ValueError, match="read-only"):
        left.axes[0, 0] = 1.0


PLANE = [[1, 0, 0], [0, 1, 0], [0.6, 0.8, 0], [0.8, -0.6, 0]]


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: Geometry(np.ones((4, 2))), r"shape \(4, 2\), expected \(n, 3\)"),
        (lambda: Geometry(np.eye(3)), "3 channels, expected 4 to 12"),
        (lambda: Geometry.cone(13), "13 channels, expected 4 to 12"),
        (lambda: Geometry([*np.eye(3), [0, np.nan, 1]]), "channel 4 is not finite"),
        (lambda: Geometry([*np.eye(3), [0, 0.1, 0.1]]), "channel 4 has norm 0.1414, expected 0.5 to 2"),
        (lambda: Geometry([*np.eye(3), [3, 0, 0]]), "channel 4 has norm 3, expected 0.5 to 2"),
        (lambda: Geometry(PLANE), "do not span three dimensions"),
        (lambda: Geometry(Geometry.cone(4).axes, ["a", "b"]), "2 channel names for 4 axes"),
        (lambda: Geometry(Geometry.cone(4).axes, ["a", "b", "a", "c"]), "names are not unique"),
        (lambda: Geometry.from_triads([np.eye(3), 1.1 * np.eye(3)]), "unit 2 is no rotation"),
        (lambda: Geometry.from_triads([np.eye(3), -np.eye(3)]), "unit 2 is a reflection"),
        (lambda: Geometry.from_triads([np.eye(3), np.eye(2)]), r"unit 2 has shape \(2, 2\)"),
        (lambda: Geometry.from_triads([np.eye(3), np.full((3, 3), np.nan)]), "unit 2 is not finite"),
        (lambda: Geometry.cone(5).subset([True, True, True, False, False]), "3 channels, expected 4 to 12"),
    ],
)
def test_refused(build: Callable[[], Geometry], words: str) -> None:
    with pytest.raises(GeometryError, match=words) as caught:
        build()
    assert "\n" not in str(caught.value)
