# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Biases followed in flight: the recursion, what it leaves alone, and that it absorbs no fault."""

from __future__ import annotations

import numpy as np
import pytest
from monitor.streams import RATE, SIGMA, START, config, declarations, parallel

from fdi_ros.core.tracking import BLOCK, DELAYED, MEMORY, RISE
from fdi_ros.model.block import Block
from fdi_ros.monitor.output import ChannelState, Output
from fdi_ros.monitor.pipeline import Pipeline

NEVER = 1e-9
"""False alarms an hour so few that noise raises no suspicion."""
ROWS = int(BLOCK * 1e-9 * RATE) + 1
"""Samples of a block: the last one closes it."""


def monitor(**changes: object) -> Pipeline:
    return Pipeline(config(**({"detector__name": "sequential"} | changes)))


def noise(seconds: float, seed: int = 0, n: int = 6) -> np.ndarray:
    return np.random.default_rng(seed).normal(0, SIGMA, (round(seconds * RATE), n))


def flown(pipeline: Pipeline, *parts: np.ndarray) -> list[tuple[Output, np.ndarray]]:
    """What the monitor says of parts that follow each other, and after each the biases that it follows."""
    said, begin = [], int(pipeline.core["samples"][0])
    for z in parts:
        stamp = START + (begin + np.arange(len(z), dtype=np.int64)) * round(1e9 / RATE)
        begin += len(z)
        output = pipeline.process(Block(stamp, z))
        said.append((output, followed(pipeline)))
    return said


def followed(pipeline: Pipeline) -> np.ndarray:
    return pipeline.core["tracking"]["value"][0, : pipeline.geometry.n].copy()


def kalman(z: np.ndarray, residual: np.ndarray, start: float, walk: float) -> tuple[np.ndarray, np.ndarray]:
    """Biases and variances of all channels after the stream, each by the scalar recursion over the block means."""
    n = z.shape[1]
    means = np.stack([z[k : k + ROWS].mean(axis=0) for k in range(0, len(z) - ROWS + 1, ROWS)])
    value, variance = np.zeros(n), np.full(n, start**2)
    scatter, last, seconds = np.zeros(n), np.full(n, np.nan), (ROWS - 1) / RATE
    for k in range(len(means)):
        if k >= DELAYED:
            off = residual @ (means[k - DELAYED] - value)
            white = SIGMA**2 / ROWS
            step = off + value - last
            if np.isfinite(last).all():
                scatter += (np.minimum(step**2 / 2, RISE * np.maximum(scatter, white)) - scatter) / MEMORY
            last = off + value
            gain = variance / (variance + np.maximum(white, scatter))
            value, variance = value + gain * off, variance * (1 - gain)
        variance = variance + walk**2 * seconds
    return value, variance


def test_is_a_kalman_filter_of_the_residuals() -> None:
    settings = {"bias__turn_on_std": 0.02, "noise__bias_walk": 3e-4, "detector__false_alarms_per_hour": NEVER}
    pipeline, z = monitor(**settings), noise(60) + np.array([0.01, -0.004, 0.002, 0.0, -0.012, 0.006])
    flown(pipeline, z)
    value, variance = kalman(z, pipeline.geometry.S, 0.02, 3e-4)
    np.testing.assert_allclose(followed(pipeline), value, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(pipeline.core["tracking"]["variance"][0, :6], variance, rtol=1e-9)
    # What waits is not known yet either.
    told = np.sqrt(variance + 3e-4**2 * DELAYED * BLOCK * 1e-9)
    np.testing.assert_allclose(pipeline.core["known"]["bias_std"][0, :6], told, rtol=1e-9)


def test_finds_what_the_channels_see_of_each_other() -> None:
    bias = np.array([0.03, -0.02, 0.01, 0.0, -0.02, 0.01])
    pipeline = monitor(bias__turn_on_std=0.02)
    ((output, value),) = flown(pipeline, noise(60, 1) + bias)
    visible = pipeline.geometry.S @ bias
    assert value == pytest.approx(visible, abs=5e-4)
    assert not declarations(pipeline, output)


def test_a_rate_and_the_bias_that_all_have_in_common_leave_it_alone() -> None:
    pipeline = monitor(bias__turn_on_std=0.02)
    rate = np.cumsum(np.random.default_rng(2).normal(0, 0.05, (3000, 3)), axis=0)
    common = pipeline.geometry.axes @ [0.03, -0.02, 0.01]
    flown(pipeline, rate @ pipeline.geometry.axes.T + common)
    assert np.abs(followed(pipeline)).max() < 1e-12


def test_nothing_passes_for_rate() -> None:
    """What is followed is a residual: the rate that it takes away is small beside it."""
    pipeline = monitor(bias__turn_on_std=0.02)
    ((_, value),) = flown(pipeline, noise(60, 3) + np.random.default_rng(3).normal(0, 0.01, 6))
    assert np.linalg.norm(pipeline.geometry.least_squares @ value) < 0.02 * np.linalg.norm(value)


def test_a_wandering_bias_is_followed_without_an_alarm() -> None:
    """Two minutes of walks as they are configured."""
    pipeline, rng = monitor(bias__turn_on_std=0.005, noise__bias_walk=5e-4), np.random.default_rng(4)
    walk = np.cumsum(rng.normal(0, 5e-4 / np.sqrt(RATE), (12_000, 6)), axis=0)
    ((output, value),) = flown(pipeline, noise(120, 4) + walk)
    assert not output.alarm.any()
    assert np.abs(value - pipeline.geometry.S @ walk[-1]).max() < 5e-3
    assert np.abs(pipeline.geometry.S @ walk[-1]).max() > 1.5 * SIGMA


@pytest.mark.parametrize("channel", [0, 4])
def test_a_fault_is_not_absorbed(channel: int) -> None:
    """Two standard deviations, by the time that it is declared and for a minute after."""
    pipeline = monitor(bias__startup_bias_duration=3.0, noise__bias_walk=1e-5)
    fault = 2.0 * SIGMA / pipeline.geometry.sensitivity[channel] * np.eye(6)[channel]
    (_, before), (found, at), (later, after) = flown(pipeline, noise(30, 5), noise(3, 6) + fault, noise(60, 7) + fault)
    assert found.alarm.any()
    assert np.abs(at - before).max() < 0.1 * fault[channel]
    assert abs(after - before)[channel] < 0.1 * fault[channel]
    assert later.state[-1, channel] in (ChannelState.FAULTY, ChannelState.AMBIGUOUS)


def test_is_held_still_while_a_set_is_undecided() -> None:
    """Two parallel triads: the set holds two channels, and neither takes the error for its bias."""
    pipeline = Pipeline(parallel(2, detector__name="sequential", bias__startup_bias_duration=3.0))
    fault = 10 * SIGMA * np.eye(6)[1]
    (_, _), (output, at), (later, after) = flown(pipeline, noise(20, 8), noise(2, 9) + fault, noise(40, 10) + fault)
    assert set(declarations(pipeline, output)) >= {("imu_1.y", "AMBIGUOUS"), ("imu_2.y", "AMBIGUOUS")}
    assert np.array_equal(at, after)
    assert (later.state[-1, [1, 4]] == ChannelState.AMBIGUOUS).all()


def test_goes_no_further_than_it_may() -> None:
    """A bias of any size passes for one that was not known at the start; beyond the bound, the channel has drifted."""
    pipeline = monitor(bias__turn_on_std=0.2, bias__max_drift=0.05)
    ramp = np.linspace(0, 0.4, 12_000)[:, None] * np.eye(6)[2]
    ((output, value),) = flown(pipeline, noise(120, 11) + ramp)
    assert np.abs(value).max() <= 0.05 * (1 + 1e-12)
    assert {name for name, _ in declarations(pipeline, output)} >= {"g3"}


def test_a_silent_channel_keeps_its_bias() -> None:
    pipeline, bias = monitor(bias__turn_on_std=0.02), 0.02 * np.eye(6)[3]
    silent = noise(10, 13) + bias
    silent[:, 3] = np.nan
    (_, before), (_, during), (output, after) = flown(pipeline, noise(40, 12) + bias, silent, noise(10, 14) + bias)
    assert during[3] == pytest.approx(before[3], abs=1e-4)
    assert after[3] == pytest.approx(before[3], abs=5e-4)
    assert not declarations(pipeline, output)
