# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""CUSUM: run lengths and delays by simulation, the recursion itself, onset, bounded memory."""

import math

import numpy as np
import pytest
from detectors.detector_trials import sound

from fdi_ros import Geometry, NoiseModel
from fdi_ros.detectors.papers.cusum import Cusum, threshold_for

UNIT = NoiseModel(1.0)
MOVING = NoiseModel(1e-3, scale_std=2e-3, timing_std=3e-4)
TWO_SIDES = np.array([[1.0, -1.0], [-1.0, 1.0]])
TABLE = [(0.25, 66.6, 510), (0.5, 35.5, 138), (1.0, 18.5, 37), (2.0, 9.4, 10)]
"""Shift, threshold for a run length of 3.6e8 samples of one two-sided sum, mean samples until it is found."""


def runs_to_alarm(detector, noise, runs, seed, shift=0.0, block=500):
    """Samples until the alarm, from the start, in so many runs."""
    rng, lengths = np.random.default_rng(seed), []
    for _ in range(runs):
        detector.reset()
        length, alarm = 0, np.zeros(0, dtype=bool)
        while not alarm.any():
            length += len(alarm)
            z, acceleration = sound(rng, detector.geometry, noise, block)
            alarm = detector.detect(z + shift, acceleration).alarm
        lengths.append(length + int(alarm.argmax()) + 1)
    return np.array(lengths)


def test_scores_are_the_sums():
    geometry, z = (
        Geometry.dodecahedron(),
        np.random.default_rng(1).normal(0.3, 1, (200, 6)),
    )
    detector = Cusum(geometry, UNIT, shift=0.5)
    w = (z @ geometry.S) / geometry.sensitivity
    up = down = np.zeros(6)
    for row, scores in zip(w, detector.detect(z).scores, strict=True):
        up, down = np.maximum(0, up + row - 0.25), np.maximum(0, down - row - 0.25)
        np.testing.assert_allclose(scores, np.maximum(up, down), atol=1e-9)


@pytest.mark.parametrize(("shift", "h", "published"), TABLE)
def test_threshold_and_delay_are_those_published(shift, h, published):
    assert threshold_for(3.6e8, shift / 2, TWO_SIDES) == pytest.approx(h, abs=0.06)
    geometry = Geometry.cone(4)
    detector = Cusum(geometry, UNIT, shift=shift)
    # Four channels carry a single statistic: the detector's threshold is that of one two-sided sum.
    assert detector.threshold == pytest.approx(h, abs=0.06)
    fault = shift / geometry.sensitivity[1] * np.eye(4)[1]
    delays = runs_to_alarm(detector, UNIT, 400, 7, fault, block=int(2 * published))
    assert delays.mean() == pytest.approx(published, rel=0.10)


@pytest.mark.parametrize(
    ("geometry", "noise", "shift"),
    [
        (Geometry.cone(4), UNIT, 2.0),
        (Geometry.dodecahedron(), NoiseModel([1, 2, 0.5, 1, 3, 1]), 1.0),
        (Geometry.from_triads([np.eye(3), np.eye(3)]), UNIT, 1.0),
        (Geometry.cone(9), UNIT, 2.0),
    ],
)
def test_run_length(geometry, noise, shift):
    # 3.6e8 samples take minutes: here shorter ones, where the approximation is worse.
    detector = Cusum(geometry, noise, shift=shift, run_length=1000)
    lengths = runs_to_alarm(detector, noise, 600, 5)
    assert lengths.mean() == pytest.approx(1000, rel=0.14)


def test_a_scale_factor_error_in_a_long_turn_is_no_drift():
    """It keeps its sign for as long as the turn lasts: as white noise it would alarm within seconds."""
    geometry, rng = Geometry.two_triad_cone(), np.random.default_rng(11)
    noise = NoiseModel(0.003, scale_std=0.002, timing_std=0.0)
    turn = np.array([1.0, -0.7, 0.5])
    z = rng.normal(0, 0.003, (20_000, 6))
    z[5000:15_000] += (geometry.axes @ turn) * (1 + 0.002 * rng.uniform(-2, 2, 6))
    detector = Cusum(geometry, noise, run_length=1e7)
    assert not detector.detect(z).alarm.any()
    drifting = z.copy()
    drifting[15_000:, 3] += 0.003
    found = detector.detect(drifting)
    assert not found.alarm[:15_000].any()
    assert found.alarm[15_000:].any()
    assert found.suspects[-1].tolist() == [False, False, False, True, False, False]


def test_what_a_start_up_average_leaves_is_no_drift():
    """12 runs of 300 s at rest at 100 Hz, after an average over 3 s."""
    geometry, rng = Geometry.two_triad_cone(), np.random.default_rng(12)
    noise = NoiseModel(0.003, bias_std=0.003 / math.sqrt(300))
    # A small shift has a small k: this is where the bias adds up.
    slow, usual = Cusum(geometry, noise, shift=0.1), Cusum(geometry, noise)
    for _ in range(12):
        z = rng.normal(0, 0.003, (30_000, 6)) - rng.normal(0, 0.003, (300, 6)).mean(
            axis=0
        )
        for detector in (slow, usual):
            detector.reset()
            assert not detector.detect(z).alarm.any()
    usual.reset()
    drifting = usual.detect(z + 0.003 * np.eye(6)[2])
    assert drifting.isolated[-1]
    assert np.flatnonzero(drifting.suspects[-1]).tolist() == [2]


def test_onset():
    detector, rng, off = (
        Cusum(Geometry.dodecahedron(), UNIT, shift=1.0),
        np.random.default_rng(11),
        [],
    )
    for _ in range(150):
        begin = int(rng.integers(300, 700))
        z = rng.standard_normal((begin + 400, 6))
        z[begin:, 4] += 1.0 / math.sqrt(0.5)
        detector.reset()
        alarm = int(detector.detect(z).alarm.argmax())
        detector.reset()
        for part in np.array_split(z[: alarm + 1], 3):
            detector.detect(part)
        off.append(alarm + 1 - int(detector.samples_since_onset()[4]) - begin)
    assert abs(np.median(off)) <= 3
    assert np.mean(np.abs(off)) < 10


@pytest.mark.parametrize(("scale", "timing"), [(0.002, 0.0003), (0.01, 0.0005)])
@pytest.mark.parametrize("size", [0.1, 0.5, 2.0, 5.0, 30.0])
def test_no_sound_channel_is_isolated_under_rate_dependent_noise(scale, timing, size):
    """A large fault passes for rate in the statistics of the others, and shrinks them."""
    geometry, rng = Geometry.two_triad_cone(), np.random.default_rng(13)
    noise = NoiseModel(0.0025, scale, timing)
    detector = Cusum(geometry, noise)
    for channel in range(6):
        z, acceleration = sound(rng, geometry, noise, 500)
        z[150:, channel] += size
        detector.reset()
        verdict = detector.detect(z, acceleration)
        sound_ones = np.arange(6) != channel
        assert not verdict.suspects[verdict.isolated][:, sound_ones].any()
        assert verdict.isolated[-1] or size < 0.5
        assert verdict.suspects[-1, channel]
        assert verdict.error[-1, channel] == pytest.approx(size, rel=0.1)
