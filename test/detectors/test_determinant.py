# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Determinants of five channels, against NumPy's determinants and condition numbers and the paper's Table 2."""

from __future__ import annotations

import numpy as np
import pytest
from detectors.detector_trials import (
    FIVE,
    FIVE_RATE,
    TABLE_2,
    paper_trials,
    random_axes,
    table_noise,
)

from fdi_ros import Geometry, NoiseModel
from fdi_ros.detectors.papers.identification import Determinant

UNIT = NoiseModel(1.0)


def struck(axes: np.ndarray, z: np.ndarray) -> np.ndarray:
    """[axes z] of samples (N, 5) without each row in turn, (N, 5, 4, 4)."""
    both = np.concatenate([np.broadcast_to(axes, (len(z), 5, 3)), z[:, :, None]], axis=2)
    return np.stack([np.delete(both, j, axis=1) for j in range(5)], axis=1)


def test_scores_are_the_determinants() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        geometry = random_axes(rng, 5)
        z = rng.uniform(-3, 3, (50, 3)) @ geometry.axes.T + rng.standard_normal((50, 5))
        scores = Determinant(geometry, UNIT).detect(z).scores
        np.testing.assert_allclose(scores, np.abs(np.linalg.det(struck(geometry.axes, z))), rtol=1e-9, atol=1e-12)


def test_determinant_is_parity_without_the_row() -> None:
    rng = np.random.default_rng(2)
    geometry = random_axes(rng, 5)
    z = rng.standard_normal((100, 5))
    scores = Determinant(geometry, UNIT).detect(z).scores
    residual_power = np.sum((z @ geometry.parity.T) ** 2, axis=1)[:, None] - (z @ geometry.S.T) ** 2 / np.diag(
        geometry.S
    )
    factor = scores / np.sqrt(residual_power)
    np.testing.assert_allclose(factor, np.broadcast_to(factor[0], factor.shape), rtol=1e-6)


def test_without_noise_it_is_zero_for_the_failed_channel_and_only_there() -> None:
    scores = Determinant(Geometry(FIVE), UNIT).detect(FIVE @ FIVE_RATE + np.eye(5)).scores
    np.testing.assert_allclose(np.diag(scores), 0, atol=1e-14)
    assert (scores[~np.eye(5, dtype=bool)] > 0.3).all()


def test_table_2() -> None:
    scores = Determinant(Geometry(FIVE), UNIT).detect(FIVE @ FIVE_RATE + table_noise() + np.eye(5)).scores
    np.testing.assert_allclose(scores, TABLE_2, atol=1e-4)
    assert np.abs(table_noise()).max() <= 0.1


@pytest.mark.parametrize("criterion", ["determinant", "condition_number"])
def test_named_correctly_for_all_five_faults(criterion: str) -> None:
    z, _ = paper_trials(np.random.default_rng(3), 10_000)
    detector = Determinant(Geometry(FIVE), NoiseModel(0.1 / np.sqrt(3)), criterion=criterion)
    for channel in range(5):
        verdict = detector.detect(np.ascontiguousarray(z[:, channel]))
        assert verdict.suspects[:, channel].mean() > 0.999
        assert verdict.isolated.mean() > 0.999
        assert verdict.error[:, channel].mean() == pytest.approx(1.0, abs=0.01)


class TestConditionNumber:
    def test_equals_the_2_norm_condition_number(self) -> None:
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

    def test_singular_is_infinite_and_no_alarm(self) -> None:
        verdict = Determinant(Geometry(FIVE), UNIT, criterion="condition_number").detect(np.zeros((3, 5)))
        assert np.isposinf(verdict.scores).all()
        assert not verdict.alarm.any()

    def test_channel_no_fault_of_which_is_seen_is_never_named(self) -> None:
        # Without channel 5 the others lie in one plane: that matrix is singular, whatever the sample.
        root = np.sqrt(0.5)
        geometry = Geometry([[1, 0, 0], [0, 1, 0], [root, root, 0], [root, -root, 0], [0, 0, 1]])
        z = np.random.default_rng(8).standard_normal((200, 5)) + 50 * np.eye(5)[0]
        verdict = Determinant(geometry, UNIT, criterion="condition_number").detect(z)
        assert verdict.alarm.all()
        assert verdict.suspects[:, :4].any(axis=1).all()
        assert not verdict.suspects[:, 4].any()

    def test_misleads_where_the_fault_outweighs_the_rate(self) -> None:
        # What the documentation warns of: at rest the matrix with the fault in it is the worse scaled one.
        rng = np.random.default_rng(5)
        z = rng.standard_normal((2000, 5)) + 50 * np.eye(5)[0]
        right = [
            Determinant(Geometry(FIVE), UNIT, criterion=criterion).detect(z).suspects[:, 0].mean()
            for criterion in ("determinant", "condition_number")
        ]
        assert right[0] > 0.99
        assert right[1] < 0.1
