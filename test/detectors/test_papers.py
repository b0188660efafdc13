# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Methods of papers against their definitions, published figures, least squares and linear programmes.

Residual searches, projector, recursion, determinants and likelihood ratio; CUSUM and guaranteed intervals have files
of their own.
"""

import math
from itertools import combinations

import numpy as np
import pytest
from detectors.detector_trials import FIVE, alarms, random_axes, sound
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from fdi_ros import Geometry, NoiseModel, create_detector
from fdi_ros.detectors.papers.identification import (
    CRITERIA,
    Determinant,
    Projector,
    Recursive,
)
from fdi_ros.model.noise import chi2_isf

UNIT = NoiseModel(1.0)
SEARCHES = (
    "mean_abs_residual",
    "mean_square_residual",
    "rate_deviation",
    "max_residual",
)
each_search = pytest.mark.parametrize("name", SEARCHES)


def noisy(rng, geometry, rows, std=1.0):
    return (
        rng.uniform(-3, 3, (rows, 3)) @ geometry.axes.T
        + rng.standard_normal((rows, geometry.n)) * std
    )


def without(z, axes, *channels):
    """Least-squares rate without some channels."""
    kept = np.delete(np.arange(len(axes)), channels)
    return np.linalg.lstsq(axes[kept], z[kept], rcond=None)[0]


# Residual searches ---------------------------------------------------------------------------------------------------


def by_definition(name, axes, z):
    """Scores of one sample, least squares solved anew for every set of channels, as the paper writes them."""
    n = len(axes)
    if name == "max_residual":
        return np.array([abs(z[i] - axes[i] @ without(z, axes, i)) for i in range(n)])
    scores = []
    for i in range(n):
        others = [j for j in range(n) if j != i]
        residuals = np.array([z[j] - axes[j] @ without(z, axes, i, j) for j in others])
        deviations = np.array(
            [without(z, axes, i) - without(z, axes, i, j) for j in others]
        )
        figure = {
            "mean_abs_residual": np.abs(residuals),
            "mean_square_residual": residuals**2,
            "rate_deviation": deviations**2,
        }
        scores.append(figure[name].mean())
    return np.array(scores)


@each_search
@pytest.mark.parametrize("n", [5, 6, 7, 9])
def test_scores_are_the_papers_figures(name, n):
    rng = np.random.default_rng(n)
    geometry = random_axes(rng, n)
    z = noisy(rng, geometry, 10)
    scores = create_detector(name, geometry, UNIT).detect(z).scores
    expected = [by_definition(name, geometry.axes, row) for row in z]
    np.testing.assert_allclose(scores, expected, rtol=1e-9)


@each_search
def test_channel_that_nothing_predicts_is_left_out_of_the_mean(name):
    geometry = Geometry.from_triads([np.eye(3), np.eye(3)])
    z = np.array([[0.1, 0.2, 0.3, 0.1, 0.5, 0.4]])
    scores = create_detector(name, geometry, UNIT).detect(z).scores[0]
    # Without one x axis the other is alone: the y and z pairs, 0.3 and 0.1 apart, are all that is left to disagree.
    expected = {
        "mean_abs_residual": (0.3 + 0.1) / 2,
        "mean_square_residual": (0.3**2 + 0.1**2) / 2,
        "rate_deviation": (0.15**2 + 0.05**2) / 6,
        "max_residual": 0.0,
    }
    assert scores[0] == pytest.approx(expected[name], abs=1e-15)
    assert scores[0] == pytest.approx(scores[3], abs=1e-15)


@each_search
def test_paper_tolerance_is_equation_8(name):
    rng = np.random.default_rng(1)
    geometry = Geometry.two_triad_cone()
    zero, scale = rng.uniform(0.5, 2, 6), rng.uniform(0.01, 0.2, 6)
    z = rng.uniform(-20, 20, (60, 3)) @ geometry.axes.T + 3 * rng.standard_normal(
        (60, 6)
    )
    verdict = create_detector(
        name, geometry, NoiseModel(zero, scale), tolerance="paper"
    ).detect(z)
    for row, sample in enumerate(z):
        scores = by_definition(name, geometry.axes, sample)
        worst = scores.argmax() if name == "max_residual" else scores.argmin()
        predicted = geometry.axes[worst] @ without(sample, geometry.axes, worst)
        limit = 3 * np.sqrt(zero[worst] ** 2 + scale[worst] ** 2 * predicted**2)
        assert verdict.statistic[row] == pytest.approx(
            abs(sample[worst] - predicted), rel=1e-9
        )
        assert verdict.threshold[row] == pytest.approx(limit, rel=1e-9)
        assert np.flatnonzero(verdict.suspects[row]).tolist() == (
            [worst] if verdict.alarm[row] else []
        )
    assert 6 < verdict.alarm.sum() < 57


# Projector, recursion, determinants -----------------------------------------------------------------------------------


@pytest.mark.parametrize("construction", ["svd", "qr"])
@pytest.mark.parametrize("n", [4, 5, 6, 7, 9])
def test_scores_are_j_by_its_definition(n, construction):
    geometry = random_axes(np.random.default_rng(n), n)
    z = noisy(np.random.default_rng(n), geometry, 50)
    detector = Projector(
        geometry, UNIT, false_alarm_probability=0.999, construction=construction
    )
    verdict, gain = detector.detect(z), geometry.S
    e0 = z @ gain.T
    kappa = e0 @ gain / (gain**2).sum(axis=0)
    left = ((gain.T * kappa[..., None] - e0[:, None]) ** 2).sum(axis=2)
    np.testing.assert_allclose(verdict.scores, left, atol=1e-12)
    named, rows = left.argmin(axis=1), np.flatnonzero(verdict.alarm & (n > 4))
    assert verdict.suspects[rows, named[rows]].all()
    np.testing.assert_allclose(
        verdict.error[rows, named[rows]], kappa[rows, named[rows]], rtol=1e-9
    )


@pytest.mark.parametrize("n", [4, 5, 6, 7])
def test_least_one_norm_equals_a_linear_programme(n):
    rng = np.random.default_rng(n)
    for _ in range(12):
        geometry = random_axes(rng, n)
        z = noisy(rng, geometry, 8)
        scores = np.nan_to_num(Projector(geometry, UNIT, norm="l1").detect(z).scores)
        for row, sample in enumerate(z):
            both = np.hstack([geometry.parity, -geometry.parity])
            best = linprog(
                np.ones(2 * n),
                A_eq=both,
                b_eq=geometry.parity @ sample,
                bounds=(0, None),
                method="highs",
            )
            assert scores[row].sum() == pytest.approx(best.fun, rel=1e-9)
            # The optimum of continuous data is unique: not only its size, every entry is the programme's.
            np.testing.assert_allclose(
                scores[row], np.abs(best.x[:n] - best.x[n:]), atol=1e-7
            )


def test_false_alarms_of_the_least_one_norm_are_at_most_those_asked_for():
    detector = Projector(
        Geometry.dodecahedron(), UNIT, norm="l1", false_alarm_probability=1e-3
    )
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
    z = noisy(rng, geometry, 10, std)
    verdict = Recursive(geometry, NoiseModel(std)).detect(z)
    for row, sample in enumerate(z):
        figures = np.array([k_s(geometry.axes, std, sample, last) for last in range(n)])
        assert verdict.statistic[row] == pytest.approx(figures.max(), rel=1e-7)
        if n > 4:
            np.testing.assert_allclose(
                verdict.scores[row], figures[:, -1] / figures[:, -2], rtol=1e-6
            )
        else:
            assert np.isnan(verdict.scores[row]).all()


def struck(axes, z):
    """[axes z] of samples (N, 5) without each row in turn, (N, 5, 4, 4)."""
    both = np.concatenate(
        [np.broadcast_to(axes, (len(z), 5, 3)), z[:, :, None]], axis=2
    )
    return np.stack([np.delete(both, j, axis=1) for j in range(5)], axis=1)


@pytest.mark.parametrize(
    ("criterion", "definition"),
    [
        ("determinant", lambda m: np.abs(np.linalg.det(m))),
        ("condition_number", np.linalg.cond),
    ],
)
def test_scores_are_determinants_or_condition_numbers_of_the_2_norm(
    criterion, definition
):
    rng = np.random.default_rng(4)
    for _ in range(40):
        geometry, sizes = random_axes(rng, 5), 10 ** rng.uniform(-2, 2, (100, 1))
        z = (
            rng.standard_normal((100, 3)) * sizes @ geometry.axes.T
            + rng.standard_normal((100, 5)) / sizes
        )
        scores = Determinant(geometry, UNIT, criterion=criterion).detect(z).scores
        expected = definition(struck(geometry.axes, z))
        ordinary = expected < 1e6
        assert ordinary.mean() > 0.5
        np.testing.assert_allclose(
            scores[ordinary], expected[ordinary], rtol=1e-8, atol=1e-11
        )


TABLE_2 = np.array(
    [
        [0.0814, 0.6730, 1.0075, 0.9572, 0.5413],
        [0.4245, 0.1671, 0.6949, 0.9572, 0.8539],
        [0.7371, 0.3388, 0.1890, 0.6446, 0.8539],
        [0.8999, 0.9857, 0.6949, 0.1387, 0.4705],
        [0.5873, 0.9857, 1.0075, 0.6446, 0.0354],
    ]
)
"""Of the paper on identification: [i, j] is d_j with a fault of 1 in channel i; omega = (1, 2, 3)."""


def test_determinants_are_those_of_table_2():
    """The noise is not printed; off the diagonal the fault decides the sign, and entries are linear in the noise."""
    struck = np.array(
        [
            [
                np.linalg.det(np.delete(np.column_stack([FIVE, channel]), j, axis=0))
                for channel in np.eye(5)
            ]
            for j in range(5)
        ]
    )
    off, clean = ~np.eye(5, dtype=bool), struck.T
    left = (np.sign(clean) * TABLE_2 - clean)[off]
    noise = np.linalg.lstsq(np.broadcast_to(struck, (5, 5, 5))[off], left, rcond=None)[
        0
    ]
    scores = (
        Determinant(Geometry(FIVE), UNIT)
        .detect(FIVE @ [1.0, 2.0, 3.0] + noise + np.eye(5))
        .scores
    )
    np.testing.assert_allclose(scores, TABLE_2, atol=1e-4)
    assert np.abs(noise).max() <= 0.1


def test_an_infinite_condition_number_is_no_alarm():
    verdict = Determinant(Geometry(FIVE), UNIT, criterion="condition_number").detect(
        np.zeros((3, 5))
    )
    assert np.isposinf(verdict.scores).all()
    assert not verdict.alarm.any()


@pytest.mark.parametrize(
    ("method", "options", "share"),
    [
        (Recursive, {}, 0.999),
        *((Determinant, {"criterion": name}, 0.999) for name in CRITERIA),
        (Projector, {}, 0.98),
    ],
    ids=str,
)
def test_the_example_of_the_paper_is_named_correctly_for_all_five_faults(
    method, options, share
):
    z = FIVE @ [1.0, 2.0, 3.0] + np.random.default_rng(3).uniform(
        -0.1, 0.1, (10_000, 5)
    )
    detector = method(Geometry(FIVE), NoiseModel(0.1 / np.sqrt(3)), **options)
    for channel in range(5):
        verdict = detector.detect(z + np.eye(5)[channel])
        assert (verdict.suspects[:, channel] & verdict.isolated).mean() > share
        assert verdict.error[:, channel].mean() == pytest.approx(1.0, abs=0.01)


# Likelihood ratio ----------------------------------------------------------------------------------------------------

MOVING = NoiseModel(1e-3, scale_std=2e-3, timing_std=3e-4)
CONFIDENCE = 0.999


def fit(geometry, noise, z, a, *out):
    """Weighted least squares without some channels: rate, its covariance, chi-square left, variances of channels."""
    kept = np.delete(np.arange(geometry.n), out)
    rate = without(z, geometry.axes, *out)
    variance = noise.for_channels(geometry.n).variance(geometry, rate[None], a[None])[0]
    white, of = (
        geometry.axes[kept] / np.sqrt(variance[kept])[:, None],
        z[kept] / np.sqrt(variance[kept]),
    )
    rate = np.linalg.lstsq(white, of, rcond=None)[0]
    return (
        rate,
        np.linalg.inv(white.T @ white),
        float(((of - white @ rate) ** 2).sum()),
        variance,
    )


@settings(max_examples=20)
@given(seed=st.integers(0, 100_000), n=st.integers(4, 9), moving=st.booleans())
def test_statistics_equal_weighted_least_squares(seed, n, moving):
    rng = np.random.default_rng(seed)
    geometry = random_axes(rng, n)
    assume(geometry.sensitivity.min() > 0.1)
    noise = MOVING if moving else NoiseModel(rng.uniform(0.5e-3, 2e-3, n))
    z, a = sound(rng, geometry, noise, 3)
    z[1, 0] += 0.02
    scores = create_detector("likelihood_ratio", geometry, noise).detect(z, a).scores
    for row in range(3):
        for i in range(n):
            rate, covariance, _, variance = fit(geometry, noise, z[row], a[row], i)
            h = geometry.axes[i]
            w = (z[row, i] - h @ rate) / math.sqrt(variance[i] + h @ covariance @ h)
            assert scores[row, i] == pytest.approx(abs(w), rel=1e-7, abs=1e-7)


@pytest.mark.parametrize(
    "geometry", [Geometry.dodecahedron(), Geometry.two_triad_cone(), Geometry.cone(5)]
)
@pytest.mark.parametrize("confidence", [0.9, 0.999])
def test_true_channel_is_lost_no_more_often_than_the_confidence_says(
    geometry, confidence
):
    options = {"false_alarm_probability": 1e-3, "confidence": confidence}
    detector, rows = (
        create_detector("likelihood_ratio", geometry, UNIT, **options),
        100_000,
    )
    for b in (3, 5, 7, 10):
        z = np.random.default_rng(42).standard_normal((rows, geometry.n))
        z[:, 1] += b
        verdict = detector.detect(z)
        lost = int((verdict.alarm & ~verdict.suspects[:, 1]).sum())
        assert lost < rows * (1 - confidence) + 3 * math.sqrt(rows * (1 - confidence))


@settings(max_examples=20)
@given(
    seed=st.integers(0, 100_000),
    n=st.integers(6, 8),
    moving=st.booleans(),
    size=st.floats(8, 40),
)
def test_suspects_are_the_channels_of_all_pairs_that_fit(seed, n, moving, size):
    rng = np.random.default_rng(seed)
    geometry = random_axes(rng, n)
    assume(
        np.abs(geometry.rho[~np.eye(n, dtype=bool)]).max() < 0.99
        and geometry.sensitivity.min() > 0.1
    )
    noise = MOVING if moving else NoiseModel(1e-3)
    z, a = sound(rng, geometry, noise, 1)
    z[0, [0, 1]] += size * 1e-3 * np.array([1.0, rng.choice([-1.2, 1.2])])
    verdict = create_detector(
        "likelihood_ratio", geometry, noise, confidence=CONFIDENCE
    ).detect(z, a)
    assume(verdict.alarm[0])
    left = {
        out: fit(geometry, noise, z[0], a[0], *out)[2]
        for out in combinations(range(n), 2)
    }
    alone = [fit(geometry, noise, z[0], a[0], i)[2] for i in range(n)]
    single_limit, pair_limit = (
        chi2_isf(1 - CONFIDENCE, n - 4),
        chi2_isf(1 - CONFIDENCE, n - 5),
    )
    if min(alone) <= single_limit:
        margin = 2 * math.log(CONFIDENCE / (1 - CONFIDENCE))
        expected = {i for i in range(n) if alone[i] <= min(alone) + margin}
        isolated = len(expected) == 1
    else:
        fits = [pair for pair, chi in left.items() if chi <= pair_limit]
        expected = {i for pair in fits for i in pair} or set(range(n))
        isolated = len(fits) == 1
    assert set(np.flatnonzero(verdict.suspects[0])) == expected
    assert verdict.isolated[0] == isolated


def test_five_channels_never_isolate_a_pair():
    geometry = Geometry.cone(5)
    z = np.random.default_rng(53).standard_normal((5000, 5))
    # Two neighbouring parity directions, 36 deg apart: the sum is 18 deg from the nearest single one.
    i, j = next(
        (i, j) for i, j in combinations(range(5), 2) if abs(geometry.rho[i, j]) > 0.8
    )
    z[:, i] += 40
    z[:, j] += 40 * np.sign(geometry.rho[i, j])
    verdict = create_detector("likelihood_ratio", geometry, UNIT).detect(z)
    assert verdict.alarm.all()
    no_single = verdict.suspects.all(axis=1)
    assert no_single.mean() > 0.9
    assert not verdict.isolated[no_single].any()
