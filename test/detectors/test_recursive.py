# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Recursion over cyclic permutations, against the recursion written out and the paper's Table 1."""

from __future__ import annotations

import numpy as np
import pytest
from detectors.detector_trials import (
    FIVE,
    FIVE_RATE,
    paper_trials,
    random_axes,
    table_noise,
)

from fdi_ros import Geometry, NoiseModel
from fdi_ros.detectors.papers.identification import Projector, Recursive, innovations

UNIT = NoiseModel(1.0)


def k_s(axes: np.ndarray, std: np.ndarray, z: np.ndarray, last: int) -> list[float]:
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
def test_all_permutations_at_once_equal_the_recursion(n: int) -> None:
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


@pytest.mark.parametrize("n", [5, 6, 9])
def test_innovations_of_every_permutation_are_white_and_complete(n: int) -> None:
    rng = np.random.default_rng(n)
    geometry = random_axes(rng, n)
    std = rng.uniform(0.5, 2.0, n)
    forms = innovations(geometry.axes, std)
    for last in range(n):
        permutation = forms[:, last]
        np.testing.assert_allclose(permutation @ geometry.axes, 0, atol=1e-9)
        np.testing.assert_allclose((permutation * std**2) @ permutation.T, np.eye(n - 3), atol=1e-9)


def test_last_innovation_is_the_normalised_residual() -> None:
    geometry = Geometry.dodecahedron()
    w = geometry.S / geometry.sensitivity[:, None]
    np.testing.assert_allclose(np.abs(innovations(geometry.axes, np.ones(6))[-1]), np.abs(w), atol=1e-12)


def test_first_equations_in_one_plane_find_the_rate_later() -> None:
    root = np.sqrt(0.5)
    axes = np.array([[1, 0, 0], [0, 1, 0], [root, root, 0], [root, -root, 0], [0, 0, 1], [0.6, 0, 0.8]])
    forms = innovations(axes, np.ones(6))
    for last in range(6):
        np.testing.assert_allclose(forms[:, last] @ axes, 0, atol=1e-12)
        np.testing.assert_allclose(forms[:, last] @ forms[:, last].T, np.eye(3), atol=1e-12)


class TestPaperExample:
    def test_table_1_largest_ratio_is_where_the_failed_channel_is_last(self) -> None:
        detector = Recursive(Geometry(FIVE), NoiseModel(0.1 / np.sqrt(3)))
        scores = detector.detect(FIVE @ FIVE_RATE + table_noise() + np.eye(5)).scores
        assert scores.argmax(axis=1).tolist() == [0, 1, 2, 3, 4]
        ordered = np.sort(scores, axis=1)
        lead = ordered[:, -1] / ordered[:, -2]
        # The paper's rows: by a factor of 1.6 to 248 over the runner-up.
        assert (lead > 1.6).all()

    def test_named_correctly_for_all_five_faults(self) -> None:
        z, _ = paper_trials(np.random.default_rng(1), 20_000)
        detector = Recursive(Geometry(FIVE), NoiseModel(0.1 / np.sqrt(3)))
        for channel in range(5):
            verdict = detector.detect(np.ascontiguousarray(z[:, channel]))
            assert (verdict.scores.argmax(axis=1) == channel).mean() > 0.999
            assert (verdict.suspects[:, channel] & verdict.isolated).mean() > 0.999
            assert verdict.error[:, channel].mean() == pytest.approx(1.0, abs=0.01)

    def test_with_five_channels_it_names_what_the_projector_names(self) -> None:
        # Two innovations: their sum is the parity vector's power, so that the ratio grows with the last one alone.
        rng = np.random.default_rng(2)
        geometry = random_axes(rng, 5)
        z = rng.standard_normal((5000, 5))
        named = Recursive(geometry, UNIT).detect(z).scores.argmax(axis=1)
        assert np.array_equal(named, Projector(geometry, UNIT).detect(z).scores.argmin(axis=1))


def test_without_noise_the_ratio_is_defined_and_right() -> None:
    geometry = Geometry.dodecahedron()
    verdict = Recursive(geometry, UNIT).detect(np.vstack([np.zeros((1, 6)), 50 * np.eye(6)]))
    assert not verdict.scores[0].any()
    assert verdict.scores[1:].argmax(axis=1).tolist() == list(range(6))
    assert np.isfinite(verdict.scores).all()
