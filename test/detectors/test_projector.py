# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Projector: its identities, the likelihood-ratio choice, and the L1 estimate against a linear programme."""

from __future__ import annotations

import numpy as np
import pytest
from detectors.detector_trials import FIVE, alarms, paper_trials, random_axes
from scipy.optimize import linprog

from fdi_ros import Geometry, NoiseModel, create_detector
from fdi_ros.detectors.papers.identification import Projector

UNIT = NoiseModel(1.0)


def noisy(rng: np.random.Generator, geometry: Geometry, rows: int) -> np.ndarray:
    return rng.uniform(-3, 3, (rows, 3)) @ geometry.axes.T + rng.standard_normal((rows, geometry.n))


@pytest.mark.parametrize("n", [4, 5, 6, 7, 9])
def test_scores_are_j_by_its_definition(n: int) -> None:
    rng = np.random.default_rng(n)
    geometry = random_axes(rng, n)
    z = noisy(rng, geometry, 50)
    detector = Projector(geometry, UNIT, false_alarm_probability=0.999)
    verdict = detector.detect(z)
    gain = geometry.S
    for row, sample in enumerate(z):
        e0 = gain @ sample
        kappa = np.array([g @ e0 / (g @ g) for g in gain.T])
        left = [np.sum((g * k - e0) ** 2) for g, k in zip(gain.T, kappa, strict=True)]
        np.testing.assert_allclose(verdict.scores[row], left, atol=1e-12)
        if n > 4 and verdict.alarm[row]:
            named = int(np.argmin(left))
            assert verdict.suspects[row, named]
            assert verdict.error[row, named] == pytest.approx(kappa[named], rel=1e-9)


def test_svd_equals_qr() -> None:
    rng = np.random.default_rng(2)
    for n in (5, 6, 8):
        geometry = random_axes(rng, n)
        z = noisy(rng, geometry, 300) + 8 * np.eye(n)[rng.integers(n, size=300)]
        one, other = (Projector(geometry, UNIT, construction=c).detect(z) for c in ("svd", "qr"))
        np.testing.assert_allclose(one.scores, other.scores, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(one.statistic, other.statistic, rtol=1e-9)
        np.testing.assert_allclose(one.error, other.error, rtol=1e-9, atol=1e-12)
        assert np.array_equal(one.suspects, other.suspects)
        assert one.alarm.sum() > 50


@pytest.mark.parametrize("n", [5, 6, 7, 9])
def test_names_the_likelihood_ratio_choice(n: int) -> None:
    rng = np.random.default_rng(n)
    for _ in range(20):
        geometry = random_axes(rng, n)
        z = noisy(rng, geometry, 200)
        verdict = Projector(geometry, UNIT).detect(z)
        w = np.abs(z @ geometry.S.T) / geometry.sensitivity
        likely = w.argmax(axis=1)
        second = np.sort(w, axis=1)[:, -2]
        clear = w.max(axis=1) - second > 1e-9
        assert np.array_equal(verdict.scores.argmin(axis=1)[clear], likely[clear])
        np.testing.assert_allclose(verdict.statistic, w.max(axis=1), rtol=1e-9)


@pytest.mark.parametrize("geometry", [Geometry.two_triad_cone(), Geometry.dodecahedron()], ids=["cone", "dodecahedron"])
def test_agrees_with_likelihood_ratio_detector(geometry: Geometry) -> None:
    rng = np.random.default_rng(3)
    z = rng.standard_normal((20_000, 6))
    one = create_detector("projector", geometry, UNIT, false_alarm_probability=1e-2).detect(z)
    other = create_detector("likelihood_ratio", geometry, UNIT, false_alarm_probability=1e-2).detect(z)
    np.testing.assert_allclose(one.statistic, other.statistic, rtol=1e-9)
    np.testing.assert_allclose(one.threshold, other.threshold, rtol=1e-9)
    assert np.array_equal(one.alarm, other.alarm)
    assert one.alarm.sum() > 100


class TestLeastOneNorm:
    @pytest.mark.parametrize("n", [4, 5, 6, 7])
    def test_equals_a_linear_programme(self, n: int) -> None:
        rng = np.random.default_rng(n)
        for _ in range(12):
            geometry = random_axes(rng, n)
            z = noisy(rng, geometry, 8)
            scores = Projector(geometry, UNIT, norm="l1").detect(z).scores
            scores = np.nan_to_num(scores)
            for row, sample in enumerate(z):
                parity = geometry.parity @ sample
                both = np.hstack([geometry.parity, -geometry.parity])
                best = linprog(np.ones(2 * n), A_eq=both, b_eq=parity, bounds=(0, None), method="highs")
                assert scores[row].sum() == pytest.approx(best.fun, rel=1e-9)
                # The optimum of continuous data is unique: not only its size, every entry is the programme's.
                np.testing.assert_allclose(scores[row], np.abs(best.x[:n] - best.x[n:]), atol=1e-7)

    def test_single_fault_without_noise_is_found_exactly(self) -> None:
        geometry = Geometry.two_triad_cone()
        z = geometry.axes @ [0.1, 0.2, 0.3] + 30 * np.eye(6)
        verdict = Projector(geometry, UNIT, norm="l1").detect(z)
        np.testing.assert_allclose(verdict.scores, 30 * np.eye(6), atol=1e-12)
        np.testing.assert_allclose(verdict.error, 30 * np.eye(6), atol=1e-12)
        assert verdict.isolated.all()

    def test_false_alarms_are_at_most_those_asked_for(self) -> None:
        detector = Projector(Geometry.dodecahedron(), UNIT, norm="l1", false_alarm_probability=1e-3)
        assert 100 < alarms(detector, UNIT, 200_000, 20) <= 240


def test_five_channel_example_is_named_as_often_as_by_any_method() -> None:
    z, _ = paper_trials(np.random.default_rng(22), 2000)
    detector = Projector(Geometry(FIVE), NoiseModel(0.1 / np.sqrt(3)))
    for channel in range(5):
        named = detector.detect(np.ascontiguousarray(z[:, channel])).scores.argmin(axis=1)
        assert (named == channel).mean() > 0.98
