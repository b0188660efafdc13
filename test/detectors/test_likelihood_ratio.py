# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Likelihood ratio: published probabilities, independent least squares, false alarms, what it may claim."""

import math
from itertools import combinations

import numpy as np
import pytest
from detectors.detector_trials import random_axes, sound
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from fdi_ros import Geometry, NoiseModel, create_detector
from fdi_ros.model.noise import chi2_isf

UNIT = NoiseModel(1.0)
MOVING = NoiseModel(1e-3, scale_std=2e-3, timing_std=3e-4)
CONFIDENCE = 0.999


def fit(H, z, variance, kept):
    """Weighted least squares of the channels kept: rate, chi-square left, covariance of the rate."""
    white = H[kept] / np.sqrt(variance[kept])[:, None]
    rate = np.linalg.lstsq(white, z[kept] / np.sqrt(variance[kept]), rcond=None)[0]
    left = z[kept] / np.sqrt(variance[kept]) - white @ rate
    return rate, float(left @ left), np.linalg.inv(white.T @ white)


def variance_without(geometry, noise, z, a, kept):
    rate = np.linalg.lstsq(geometry.axes[kept], z[kept], rcond=None)[0]
    return noise.for_channels(geometry.n).variance(geometry, rate[None], a[None])[0]


def chi_square_without(geometry, noise, z, a, out):
    kept = [i for i in range(geometry.n) if i not in out]
    return fit(geometry.axes, z, variance_without(geometry, noise, z, a, kept), kept)[1]


@settings(max_examples=40)
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
            kept = [j for j in range(n) if j != i]
            variance = variance_without(geometry, noise, z[row], a[row], kept)
            rate, _, covariance = fit(geometry.axes, z[row], variance, kept)
            h = geometry.axes[i]
            w = (z[row, i] - h @ rate) / math.sqrt(variance[i] + h @ covariance @ h)
            assert scores[row, i] == pytest.approx(abs(w), rel=1e-7, abs=1e-7)


@pytest.mark.parametrize("geometry", [Geometry.dodecahedron(), Geometry.two_triad_cone(), Geometry.cone(5)])
@pytest.mark.parametrize("confidence", [0.9, 0.999])
def test_true_channel_is_lost_no_more_often_than_the_confidence_says(geometry, confidence):
    options = {"false_alarm_probability": 1e-3, "confidence": confidence}
    detector, rows = create_detector("likelihood_ratio", geometry, UNIT, **options), 100_000
    for b in (3, 5, 7, 10):
        z = np.random.default_rng(42).standard_normal((rows, geometry.n))
        z[:, 1] += b
        verdict = detector.detect(z)
        lost = int((verdict.alarm & ~verdict.suspects[:, 1]).sum())
        assert lost < rows * (1 - confidence) + 3 * math.sqrt(rows * (1 - confidence))


@settings(max_examples=40)
@given(seed=st.integers(0, 100_000), n=st.integers(6, 8), moving=st.booleans(), size=st.floats(8, 40))
def test_suspects_are_the_channels_of_all_pairs_that_fit(seed, n, moving, size):
    rng = np.random.default_rng(seed)
    geometry = random_axes(rng, n)
    assume(np.abs(geometry.rho[~np.eye(n, dtype=bool)]).max() < 0.99 and geometry.sensitivity.min() > 0.1)
    noise = MOVING if moving else NoiseModel(1e-3)
    z, a = sound(rng, geometry, noise, 1)
    z[0, [0, 1]] += size * 1e-3 * np.array([1.0, rng.choice([-1.2, 1.2])])
    verdict = create_detector("likelihood_ratio", geometry, noise, confidence=CONFIDENCE).detect(z, a)
    assume(verdict.alarm[0])
    left = {out: chi_square_without(geometry, noise, z[0], a[0], out) for out in combinations(range(n), 2)}
    alone = [chi_square_without(geometry, noise, z[0], a[0], (i,)) for i in range(n)]
    single_limit, pair_limit = chi2_isf(1 - CONFIDENCE, n - 4), chi2_isf(1 - CONFIDENCE, n - 5)
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
    i, j = next((i, j) for i, j in combinations(range(5), 2) if abs(geometry.rho[i, j]) > 0.8)
    z[:, i] += 40
    z[:, j] += 40 * np.sign(geometry.rho[i, j])
    verdict = create_detector("likelihood_ratio", geometry, UNIT).detect(z)
    assert verdict.alarm.all()
    no_single = verdict.suspects.all(axis=1)
    assert no_single.mean() > 0.9
    assert not verdict.isolated[no_single].any()
