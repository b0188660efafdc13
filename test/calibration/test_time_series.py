# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Allan deviation and spectral density against definitions and known slopes."""

import numpy as np
import pytest
from scipy.signal import welch

from fdi_ros.calibration.time_series import allan_deviation, runs_of, spectral_density

STEP = 0.01


def drawn(rows: int = 20_000) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(7)
    return 0.01 * random.normal(size=(rows, 2)), np.cumsum(1e-4 * random.normal(size=(rows, 2)), axis=0)


def test_allan_deviation_is_what_its_definition_says() -> None:
    z = drawn(60)[0]
    time, deviation = allan_deviation([z], STEP)
    for k, m in enumerate(np.round(time / STEP).astype(int)):
        means = np.array([z[i : i + m].mean(axis=0) for i in range(len(z) - m + 1)])
        expected = np.sqrt(np.mean((means[m:] - means[:-m]) ** 2, axis=0) / 2)
        assert deviation[k] == pytest.approx(expected, rel=1e-9)
    assert time[[0, -1]] == pytest.approx([STEP, 20 * STEP])


def test_white_noise_falls_and_a_random_walk_rises_with_the_root_of_the_time() -> None:
    for z, level, slope in zip(drawn(), (0.01, 1e-4 / np.sqrt(3)), (-0.5, 0.5), strict=True):
        time, deviation = allan_deviation([z], STEP)
        # Long averages are few and scatter, sums of one step are no walk yet.
        usual = (time >= 0.1) & (time < 3)
        expected = level * (time[usual] / STEP) ** slope
        assert deviation[usual] == pytest.approx(np.tile(expected, (2, 1)).T, rel=0.2)


def test_runs_add_up_and_breaks_are_no_part_of_them() -> None:
    z, seconds = drawn()[0], STEP * np.arange(20_000)
    seconds[5000:] += 3.0
    rows = np.ones(20_000, dtype=bool)
    rows[12_000:12_010] = False
    runs = runs_of(rows, seconds, STEP)
    assert [(run.start, run.stop) for run in runs] == [(0, 5000), (5000, 12_000), (12_010, 20_000)]
    shifted = [z[run] + k for k, run in enumerate(runs)]
    whole, pieces = allan_deviation([z], STEP), allan_deviation(shifted, STEP)
    shown = whole[0] < 1
    assert pieces[1][: shown.sum()][0] == pytest.approx(whole[1][0], rel=0.02)
    assert pieces[1].max() == pytest.approx(0.01, rel=0.05)


def test_spectral_density_is_that_of_scipy_and_of_white_noise() -> None:
    z = drawn()[0]
    frequency, density = spectral_density([z], STEP)
    known = welch(z, 1 / STEP, nperseg=1024, axis=0)
    assert frequency == pytest.approx(known[0][1:])
    assert density == pytest.approx(np.sqrt(known[1][1:]))
    # One-sided: sigma sqrt(2 step).
    assert np.median(density) == pytest.approx(0.01 * np.sqrt(2 * STEP), rel=0.05)
    halves = spectral_density([z[:9000], z[9000:9010], z[9010:]], STEP)
    assert np.median(halves[1]) == pytest.approx(np.median(density), rel=0.05)


def test_too_little_gives_nothing() -> None:
    assert len(allan_deviation([], STEP)[0]) == 0
    assert spectral_density([np.zeros((31, 3))], STEP)[1].shape == (0, 3)
