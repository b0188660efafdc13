# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Residual searches against their paper: figures, tolerance, agreement, and what the Monte-Carlo protocol gives."""

import numpy as np
import pytest
from detectors.detector_trials import random_axes

from fdi_ros import Geometry, NoiseModel, create_detector

SEARCHES = ("mean_abs_residual", "mean_square_residual", "rate_deviation", "max_residual")
each_search = pytest.mark.parametrize("name", SEARCHES)


def without(z, axes, *channels):
    """Least-squares rate without some channels."""
    kept = [k for k in range(len(axes)) if k not in channels]
    return np.linalg.lstsq(axes[kept], z[kept], rcond=None)[0]


def by_definition(name, axes, z):
    """Scores of one sample, least squares solved anew for every set of channels, as the paper writes them."""
    n = len(axes)
    if name == "max_residual":
        return np.array([abs(z[i] - axes[i] @ without(z, axes, i)) for i in range(n)])
    scores = []
    for i in range(n):
        others = [j for j in range(n) if j != i]
        residuals = np.array([z[j] - axes[j] @ without(z, axes, i, j) for j in others])
        deviations = np.array([without(z, axes, i) - without(z, axes, i, j) for j in others])
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
    z = rng.uniform(-2, 2, (10, 3)) @ geometry.axes.T + rng.standard_normal((10, n))
    scores = create_detector(name, geometry, NoiseModel(1.0)).detect(z).scores
    expected = [by_definition(name, geometry.axes, row) for row in z]
    np.testing.assert_allclose(scores, expected, rtol=1e-9)


@each_search
def test_channel_that_nothing_predicts_is_left_out_of_the_mean(name):
    geometry = Geometry.from_triads([np.eye(3), np.eye(3)])
    z = np.array([[0.1, 0.2, 0.3, 0.1, 0.5, 0.4]])
    scores = create_detector(name, geometry, NoiseModel(1.0)).detect(z).scores[0]
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
    z = rng.uniform(-20, 20, (200, 3)) @ geometry.axes.T + 3 * rng.standard_normal((200, 6))
    verdict = create_detector(name, geometry, NoiseModel(zero, scale), tolerance="paper").detect(z)
    for row, sample in enumerate(z):
        scores = by_definition(name, geometry.axes, sample)
        worst = scores.argmax() if name == "max_residual" else scores.argmin()
        predicted = geometry.axes[worst] @ without(sample, geometry.axes, worst)
        limit = 3 * np.sqrt(zero[worst] ** 2 + scale[worst] ** 2 * predicted**2)
        assert verdict.statistic[row] == pytest.approx(abs(sample[worst] - predicted), rel=1e-9)
        assert verdict.threshold[row] == pytest.approx(limit, rel=1e-9)
        assert np.flatnonzero(verdict.suspects[row]).tolist() == ([worst] if verdict.alarm[row] else [])
    assert 20 < verdict.alarm.sum() < 190
