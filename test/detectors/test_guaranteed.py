# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Guaranteed intervals: the paper's example, linear programmes as oracle, and what certainty means."""

from itertools import combinations

import numpy as np
import pytest
from detectors.detector_trials import lopsided
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from fdi_ros import FdiError, Geometry, NoiseModel
from fdi_ros.detectors.papers.guaranteed import Guaranteed


def guaranteed(geometry, bound=1.0, **options):
    return Guaranteed(geometry, NoiseModel(1.0, bound=bound), **options)


def sample(rng, geometry, bound, faults):
    error = rng.uniform(-1, 1, geometry.n) * bound
    error[rng.choice(geometry.n, faults, replace=False)] += rng.normal(0, 20, faults)
    return geometry.axes @ rng.normal(0, 10, 3) + error


def test_the_worked_example_of_the_paper():
    c, s, h = 1 / np.sqrt(3), np.sqrt(2 / 3) / 2, np.sqrt(2 / 3) * np.sqrt(3) / 2
    geometry = Geometry(
        [
            [-c, -2 * s, 0],
            [c, s, -h],
            [-c, s, h],
            [c, -2 * s, 0],
            [-c, s, -h],
            [c, s, h],
        ]
    )
    z = geometry.axes @ [-172.82, 604.19, -1284.63] + [
        0.50,
        20.10,
        -50.80,
        -0.01,
        -0.02,
        0.30,
    ]
    np.testing.assert_allclose(
        z, [-393.04, 1075.35, -612.73, -593.11, 1254.79, -761.19], atol=0.0051
    )
    detector = guaranteed(geometry, max_faults=2)
    lower, upper = (bounds[0] for bounds in detector.error_bounds(z[None]))
    printed = [0, 20.89, -51.35, 0, 0, 0]
    np.testing.assert_allclose((lower + upper) / 2, printed, atol=0.0051)
    np.testing.assert_allclose(
        (upper - lower) / 2, [1.00, 2.74, 2.74, 1.00, 1.00, 1.00], atol=0.0051
    )
    np.testing.assert_allclose(
        [z[1] - upper[1], z[1] - lower[1]], [1051.72, 1057.20], atol=0.0051
    )
    verdict = detector.detect(z[None])
    assert verdict.isolated[0]
    assert np.flatnonzero(verdict.suspects[0]).tolist() == [1, 2]
    np.testing.assert_allclose(verdict.error[0], printed, atol=0.0051)
    assert [
        detector.sets[k] for k in np.flatnonzero(detector.culprits(z[None])[0])
    ] == [(1, 2)]


@pytest.mark.parametrize(("n", "trials"), [(5, 5), (6, 4), (7, 3), (9, 3)])
def test_intervals_and_culprits_are_those_of_linear_programmes(n, trials):
    rng = np.random.default_rng(n)
    for k in range(trials):
        # Nine channels: of three axes, with up to two faults.
        geometry = Geometry.from_triads([np.eye(3)] * 3) if n == 9 else lopsided(rng, n)
        bound, most = rng.uniform(0.5, 2, n), k if n == 9 else min(2, n - 4)
        z = sample(rng, geometry, bound, most if n == 9 else int(rng.integers(3)))
        detector = guaranteed(geometry, bound, max_faults=most)
        lower, upper = detector.error_bounds(z[None])
        expected, feasible = by_programmes(geometry.axes, bound, z, most)
        np.testing.assert_allclose(np.stack([lower[0], upper[0]]), expected, atol=1e-6)
        largest = [len(channels) == most for channels in detector.sets]
        assert detector.culprits(z[None])[0][largest].tolist() == feasible


def test_the_mildest_explanation_is_that_of_a_linear_programme():
    rng, compared = np.random.default_rng(20), 0
    while compared < 6:
        geometry, bound = lopsided(rng, 6), rng.uniform(0.5, 2, 6)
        z = sample(rng, geometry, bound, int(rng.integers(3)))
        statistic = (
            guaranteed(geometry, bound, max_faults=2).detect(z[None]).statistic[0]
        )
        sizes = [
            least_largest(geometry.axes, bound, z, pair)
            for pair in combinations(range(6), 2)
        ]
        if min(sizes) > 1.001:
            assert statistic == pytest.approx(min(sizes), rel=1e-6)
            compared += 1
        else:
            assert statistic < 1.001


def minimum(cost, A, b):
    """Of a linear programme A x <= b: inf if it cannot be, -inf if without bound."""
    solved = linprog(cost, A_ub=A, b_ub=b, bounds=(None, None), method="highs")
    return {0: solved.fun, 2: np.inf, 3: -np.inf}[solved.status]


def by_programmes(H, bound, z, faults):
    """Extremes (2, n) of every channel's error over all sets left out, and which sets are feasible."""
    n, feasible = len(H), []
    hull = np.stack([np.full(n, np.inf), np.full(n, -np.inf)])
    for struck in combinations(range(n), faults):
        kept = [i for i in range(n) if i not in struck]
        A, b = (
            np.vstack([H[kept], -H[kept]]),
            np.concatenate([z[kept] + bound[kept], bound[kept] - z[kept]]),
        )
        feasible.append(minimum(np.zeros(3), A, b) == 0)
        if feasible[-1]:
            for i in range(n):
                hull[0, i] = min(hull[0, i], z[i] + minimum(-H[i], A, b))
                hull[1, i] = max(hull[1, i], z[i] - minimum(H[i], A, b))
    return (hull if any(feasible) else np.full((2, n), np.nan)), feasible


def least_largest(H, bound, z, struck):
    """Least t for which the errors of the channels struck stay within t bounds and all others within one."""
    grows = np.isin(np.arange(len(H)), struck) * bound
    fixed = bound - grows
    A = np.vstack(
        [np.column_stack([H, -grows]), np.column_stack([-H, -grows]), [0, 0, 0, -1]]
    )
    return minimum([0, 0, 0, 1], A, np.concatenate([z + fixed, fixed - z, [0]]))


@settings(max_examples=60)
@given(
    seed=st.integers(0, 1_000_000),
    n=st.integers(4, 9),
    size=st.floats(0, 100),
    threshold=st.sampled_from([0.5, 1, 3, 10]),
)
def test_what_is_certain_is_true(seed, n, size, threshold):
    rng = np.random.default_rng(seed)
    geometry, bound = lopsided(rng, n), rng.uniform(0.5, 2, n)
    detector = guaranteed(geometry, bound, threshold=threshold)
    rows = 30
    error = rng.uniform(-1, 1, (rows, n)) * bound
    for row in error:
        row[rng.choice(n, detector.max_faults, replace=False)] += size * rng.normal(
            size=detector.max_faults
        )
    z = rng.normal(0, 5, (rows, 3)) @ geometry.axes.T + error
    lower, upper = detector.error_bounds(z)
    assert (lower <= error + 1e-9).all()
    assert (upper >= error - 1e-9).all()
    verdict = detector.detect(z)
    failed = np.abs(error) >= threshold * bound * (1 - 1e-9)
    largest = (np.abs(error) / bound).max(axis=1)
    assert (verdict.statistic <= largest * (1 + 1e-9) + 1e-9).all()
    assert failed[verdict.isolated[:, None] & verdict.suspects].all()
    if geometry.detectable.all():
        assert (failed & verdict.suspects).any(axis=1)[verdict.alarm].all()
    assert (verdict.scores <= np.abs(error) / bound + 1e-9).all()


def test_more_faults_than_allowed_are_a_contradiction():
    assert [guaranteed(Geometry.cone(n)).max_faults for n in range(4, 10)] == [
        0,
        1,
        2,
        2,
        2,
        2,
    ]
    geometry = Geometry.dodecahedron()
    z = (geometry.axes @ [1.0, 2.0, 3.0] + [60, -70, 80, 0, 0, 0])[None]
    detector = guaranteed(geometry, max_faults=1)
    assert np.isnan(detector.error_bounds(z)).all()
    assert not detector.culprits(z).any()
    verdict = detector.detect(z)
    assert (verdict.statistic[0], verdict.alarm[0], verdict.isolated[0]) == (
        np.inf,
        True,
        False,
    )
    assert verdict.suspects.all()
    assert not verdict.error.any()


def test_both_channels_of_an_axis_struck_leave_it_without_bounds():
    # With both x channels struck nothing measures x: the pair may be off by any amount.
    detector = guaranteed(Geometry.from_triads([np.eye(3), np.eye(3)]), max_faults=2)
    z = np.array([[30.0, 0, 0, 0, 0, 0]])
    lower, upper = detector.error_bounds(z)
    assert lower[0, [0, 3]].tolist() == [-np.inf, -np.inf]
    assert upper[0, [0, 3]].tolist() == [np.inf, np.inf]
    np.testing.assert_allclose(upper[0, [1, 2, 4, 5]], 1)
    verdict = detector.detect(z)
    assert np.flatnonzero(verdict.suspects[0]).tolist() == [0, 3]
    assert not verdict.isolated[0]
    assert np.isfinite(verdict.error).all()


def test_without_a_bound_and_with_too_many_faults_it_is_refused():
    with pytest.raises(FdiError, match=r"needs noise.bound"):
        Guaranteed(Geometry.two_triad_cone(), NoiseModel(1.0))
    with pytest.raises(
        FdiError, match="max_faults is 2 with 5 channels, expected at most 1"
    ):
        guaranteed(Geometry.cone(5), max_faults=2)
