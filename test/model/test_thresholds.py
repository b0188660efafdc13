# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Thresholds and false-alarm rates against published figures, SciPy and simulation."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from fdi_ros import Geometry
from fdi_ros.errors import ConfigError
from fdi_ros.model.thresholds import FalseAlarmRate, chi2_isf, chi2_sf, max_normal_threshold, normal_isf


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
    for probability, expected in zip((1e-2, 1e-3, 1e-3 / (3600 * 100)), published, strict=True):
        own = (
            normal_isf(probability / 12)
            if geometry is None
            else max_normal_threshold(directions(geometry), probability)
        )
        assert own == pytest.approx(expected, abs=6e-4)


@pytest.mark.parametrize("dof", range(1, 10))
def test_chi_square_equals_scipy(dof: int) -> None:
    x = np.array([1e-3, 0.5, 3.0, 20.0, 80.0, 300.0])
    np.testing.assert_allclose(chi2_sf(x, dof), stats.chi2.sf(x, dof), rtol=1e-10)
    for probability in (0.3, 1e-3, 1e-9):
        assert chi2_isf(probability, dof) == pytest.approx(stats.chi2.isf(probability, dof), rel=1e-7)


def test_chi_square_published() -> None:
    assert chi2_isf(1e-3, 3) == pytest.approx(16.266, abs=5e-4)


@pytest.mark.parametrize("n", [4, 5, 6, 7, 9, 12])
@pytest.mark.parametrize("probability", [1e-2, 1e-3])
def test_largest_of_correlated_normals_by_simulation(n: int, probability: float) -> None:
    axes = np.random.default_rng(n).standard_normal((n, 3))
    unit = directions(Geometry(axes / np.linalg.norm(axes, axis=1, keepdims=True)))
    threshold = max_normal_threshold(unit, probability)
    rng, rows, hits = np.random.default_rng(100 + n), 600_000, 0
    for _ in range(6):
        hits += int((np.abs(rng.standard_normal((rows // 6, n - 3)) @ unit.T).max(axis=1) >= threshold).sum())
    error = math.sqrt(rows * probability)
    # Above three parity dimensions the threshold is itself an average over samples, good to about 1 %.
    assert abs(hits - rows * probability) < 3.5 * error + 0.01 * rows * probability


@pytest.mark.parametrize("n", [4, 6, 9])
@pytest.mark.parametrize("probability", [1e-2, 1e-6, 1e-12])
def test_between_one_normal_and_bonferroni(n: int, probability: float) -> None:
    threshold = max_normal_threshold(directions(Geometry.cone(n)), probability)
    assert normal_isf(probability / 2) - 1e-6 <= threshold <= normal_isf(probability / (2 * n)) + 1e-6


def test_twins_count_once() -> None:
    twin_triads = Geometry.from_triads([np.eye(3), np.eye(3)])
    three_independent = math.sqrt(chi2_isf(1 - (1 - 1e-3) ** (1 / 3), 1))
    assert max_normal_threshold(directions(twin_triads), 1e-3) == pytest.approx(three_independent, abs=2e-4)


def test_single_direction_is_a_normal() -> None:
    assert max_normal_threshold(directions(Geometry.cone(4)), 1e-4) == pytest.approx(normal_isf(5e-5), abs=1e-6)


RATE = {"run_length", "false_alarms_per_hour", "sample_rate"}
"""Options of a detector that takes a run length."""


def test_three_ways_to_state_the_same() -> None:
    hourly = FalseAlarmRate(per_hour=1e-3, sample_rate=100.0)
    assert hourly.per_sample() == pytest.approx(2.7778e-9, rel=1e-4)
    assert hourly.mean_run_length() == pytest.approx(3.6e8)
    single = FalseAlarmRate(1e-4)
    assert single.per_sample() == 1e-4
    assert single.mean_run_length() == pytest.approx(1e4)
    assert FalseAlarmRate(run_length=1e4).per_sample() == pytest.approx(1e-4)
    assert FalseAlarmRate().per_sample() == 1e-6
    assert FalseAlarmRate().mean_run_length() == 3.6e8


def test_a_detector_gets_what_it_takes() -> None:
    assert FalseAlarmRate(1e-4, sample_rate=50.0).as_options(RATE) == {"run_length": 1e4, "sample_rate": 50.0}
    assert FalseAlarmRate(0.9).as_options(RATE) == {"run_length": 2.0}
    assert FalseAlarmRate(1e-4).as_options({"false_alarm_probability"}) == {"false_alarm_probability": 1e-4}
    hourly = FalseAlarmRate(per_hour=1.0, sample_rate=100.0)
    assert hourly.as_options() == {"false_alarms_per_hour": 1.0, "sample_rate": 100.0}
    assert hourly.as_options({"max_faults"}) == {}


@pytest.mark.parametrize(
    ("stated", "words"),
    [
        ({"probability": -1e-3}, "is -0.001, expected between 0 and 1"),
        ({"probability": 1.0}, "is 1, expected between 0 and 1"),
        ({"probability": 1e-3, "per_hour": 1.0, "sample_rate": 100.0}, "not both"),
        ({"run_length": 1e3, "per_hour": 1.0, "sample_rate": 100.0}, "give run_length or false_alarms_per_hour, not"),
        ({"per_hour": 0.0, "sample_rate": 100.0}, "is 0, expected > 0"),
        ({"per_hour": 1.0}, "needs a sample_rate > 0 Hz"),
        ({"per_hour": 1.0, "sample_rate": -5.0}, "got -5"),
        ({"per_hour": 1e9, "sample_rate": 1.0}, "expected between 0 and 1"),
        ({"run_length": 1.0}, "run_length is 1 samples, expected 2 to 1e+15"),
    ],
)
def test_refused(stated: dict[str, float], words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        FalseAlarmRate(**stated).per_sample()
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
