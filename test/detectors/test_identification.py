# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Projector, recursion and determinants against their definitions, linear programmes and the tables of their paper."""

import numpy as np
import pytest
from detectors.detector_trials import FIVE, alarms, random_axes
from scipy.optimize import linprog

from fdi_ros import Geometry, NoiseModel, create_detector
from fdi_ros.detectors.papers.identification import CRITERIA, Determinant, Projector, Recursive

UNIT = NoiseModel(1.0)


def noisy(rng, geometry, rows):
    return rng.uniform(-3, 3, (rows, 3)) @ geometry.axes.T + rng.standard_normal((rows, geometry.n))


@pytest.mark.parametrize("construction", ["svd", "qr"])
@pytest.mark.parametrize("n", [4, 5, 6, 7, 9])
def test_scores_are_j_by_its_definition(n, construction):
    geometry = random_axes(np.random.default_rng(n), n)
    z = noisy(np.random.default_rng(n), geometry, 50)
    detector = Projector(geometry, UNIT, false_alarm_probability=0.999, construction=construction)
    verdict, gain = detector.detect(z), geometry.S
    e0 = z @ gain.T
    kappa = e0 @ gain / (gain**2).sum(axis=0)
    left = ((gain.T * kappa[..., None] - e0[:, None]) ** 2).sum(axis=2)
    np.testing.assert_allclose(verdict.scores, left, atol=1e-12)
    named, rows = left.argmin(axis=1), np.flatnonzero(verdict.alarm & (n > 4))
    assert verdict.suspects[rows, named[rows]].all()
    np.testing.assert_allclose(verdict.error[rows, named[rows]], kappa[rows, named[rows]], rtol=1e-9)


@pytest.mark.parametrize("n", [5, 6, 7, 9])
def test_names_the_likelihood_ratio_choice(n):
    rng = np.random.default_rng(n)
    for _ in range(20):
        geometry = random_axes(rng, n)
        z = noisy(rng, geometry, 200)
        one, other = Projector(geometry, UNIT).detect(z), create_detector("likelihood_ratio", geometry, UNIT).detect(z)
        second, largest = np.sort(other.scores, axis=1)[:, -2:].T
        clear = largest - second > 1e-9
        assert np.array_equal(one.scores.argmin(axis=1)[clear], other.scores.argmax(axis=1)[clear])
        np.testing.assert_allclose(one.statistic, other.statistic, rtol=1e-9)
        np.testing.assert_allclose(one.threshold, other.threshold, rtol=1e-9)
        assert np.array_equal(one.alarm, other.alarm)


@pytest.mark.parametrize("n", [4, 5, 6, 7])
def test_least_one_norm_equals_a_linear_programme(n):
    rng = np.random.default_rng(n)
    for _ in range(12):
        geometry = random_axes(rng, n)
        z = noisy(rng, geometry, 8)
        scores = np.nan_to_num(Projector(geometry, UNIT, norm="l1").detect(z).scores)
        for row, sample in enumerate(z):
            both = np.hstack([geometry.parity, -geometry.parity])
            best = linprog(np.ones(2 * n), A_eq=both, b_eq=geometry.parity @ sample, bounds=(0, None), method="highs")
            assert scores[row].sum() == pytest.approx(best.fun, rel=1e-9)
            # The optimum of continuous data is unique: not only its size, every entry is the programme's.
            np.testing.assert_allclose(scores[row], np.abs(best.x[:n] - best.x[n:]), atol=1e-7)


def test_false_alarms_of_the_least_one_norm_are_at_most_those_asked_for():
    detector = Projector(Geometry.dodecahedron(), UNIT, norm="l1", false_alarm_probability=1e-3)
    assert 100 < alarms(detector, UNIT, 200_000, 20) <= 240


def k_s(axes, std, z, last):
    """k_s of every equation after the third, by the paper's recursion, `last` taken last."""
    n = len(axes)
    order = [(last + 1 + k) % n for k in range(n)]
    first = order[:3]
    x = np.linalg.solve(axes[first], z[first])
    inverse = np.linalg.inv(axes[first])
    P = inverse @ np.diag(std[first] ** 2) @ inverse.T
    figures = []
    for k in order[3:]:
        a = axes[k]
        Y = 1 / (std[k] ** 2 + a @ P @ a)
        nu = z[k] - a @ x
        figures.append(nu * Y * nu)
        x = x + P @ a * Y * nu
        P = P - np.outer(P @ a, a @ P) * Y
    return figures


@pytest.mark.parametrize("n", [4, 5, 6, 7, 9])
def test_all_permutations_at_once_equal_the_recursion(n):
    rng = np.random.default_rng(n)
    geometry = random_axes(rng, n)
    std = rng.uniform(0.5, 2.0, n)
    z = rng.uniform(-3, 3, (10, 3)) @ geometry.axes.T + rng.standard_normal((10, n)) * std
    verdict = Recursive(geometry, NoiseModel(std)).detect(z)
    for row, sample in enumerate(z):
        figures = np.array([k_s(geometry.axes, std, sample, last) for last in range(n)])
        assert verdict.statistic[row] == pytest.approx(figures.max(), rel=1e-7)
        if n > 4:
            np.testing.assert_allclose(verdict.scores[row], figures[:, -1] / figures[:, -2], rtol=1e-6)
        else:
            assert np.isnan(verdict.scores[row]).all()


def struck(axes, z):
    """[axes z] of samples (N, 5) without each row in turn, (N, 5, 4, 4)."""
    both = np.concatenate([np.broadcast_to(axes, (len(z), 5, 3)), z[:, :, None]], axis=2)
    return np.stack([np.delete(both, j, axis=1) for j in range(5)], axis=1)


def test_scores_are_the_determinants():
    rng = np.random.default_rng(1)
    for _ in range(20):
        geometry = random_axes(rng, 5)
        z = rng.uniform(-3, 3, (50, 3)) @ geometry.axes.T + rng.standard_normal((50, 5))
        scores = Determinant(geometry, UNIT).detect(z).scores
        np.testing.assert_allclose(scores, np.abs(np.linalg.det(struck(geometry.axes, z))), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    ("method", "options", "share"),
    [(Recursive, {}, 0.999), *((Determinant, {"criterion": name}, 0.999) for name in CRITERIA), (Projector, {}, 0.98)],
    ids=str,
)
def test_the_example_of_the_paper_is_named_correctly_for_all_five_faults(method, options, share):
    z = FIVE @ [1.0, 2.0, 3.0] + np.random.default_rng(3).uniform(-0.1, 0.1, (10_000, 5))
    detector = method(Geometry(FIVE), NoiseModel(0.1 / np.sqrt(3)), **options)
    for channel in range(5):
        verdict = detector.detect(z + np.eye(5)[channel])
        assert (verdict.suspects[:, channel] & verdict.isolated).mean() > share
        assert verdict.error[:, channel].mean() == pytest.approx(1.0, abs=0.01)


def test_condition_numbers_are_those_of_the_2_norm_and_infinite_ones_no_alarm():
    rng = np.random.default_rng(4)
    for _ in range(40):
        geometry = random_axes(rng, 5)
        sizes = 10 ** rng.uniform(-3, 2, (100, 1))
        z = rng.standard_normal((100, 3)) * sizes @ geometry.axes.T + rng.standard_normal((100, 5)) / sizes
        scores = Determinant(geometry, UNIT, criterion="condition_number").detect(z).scores
        expected = np.linalg.cond(struck(geometry.axes, z))
        ordinary = expected < 1e6
        assert ordinary.mean() > 0.5
        np.testing.assert_allclose(scores[ordinary], expected[ordinary], rtol=1e-8)
    verdict = Determinant(geometry, UNIT, criterion="condition_number").detect(np.zeros((3, 5)))
    assert np.isposinf(verdict.scores).all()
    assert not verdict.alarm.any()
