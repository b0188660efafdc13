# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Delays of units: against plain least squares, in motion, and at rest where nothing shows them."""

from __future__ import annotations

import numpy as np
import pytest
from monitor.streams import RATE, SIGMA, START, parallel

from fdi_ros.core.unit_delay import BLOCK, KNOWN_SHARE, LEAST_CHANGE, LONGEST, MEMORY, SLOPE
from fdi_ros.model.block import Block
from fdi_ros.monitor.build import UNIT_DELAY
from fdi_ros.monitor.diagnostics import unit_words
from fdi_ros.monitor.pipeline import Pipeline


def monitor(**changes: object) -> Pipeline:
    """Three parallel triads that are not known to be in step; their biases are not followed."""
    settings = {"detector__name": "sequential", "bias__max_drift": 0.0, "bias__turn_on_std": 0.002}
    return Pipeline(parallel(3, **(settings | changes)))


def rate_at(t: np.ndarray, size: float) -> np.ndarray:
    """Body rate (N, 3) rad/s, with up to three times `size` of acceleration."""
    return size * np.stack([np.sin(2.0 * t), 0.6 * np.cos(3.1 * t), 0.8 * np.sin(1.3 * t + 1.0)], axis=1)


def stream(late: tuple[float, ...], size: float, seconds: float = 15.0, seed: int = 0) -> Block:
    """Triads whose stamps are late by so much each: their values are those of an earlier instant."""
    t = np.arange(round(seconds * RATE)) / RATE
    z = np.hstack([rate_at(t - delay, size) for delay in late])
    z += np.random.default_rng(seed).normal(0, SIGMA, z.shape)
    return Block(START + np.arange(len(t), dtype=np.int64) * round(1e9 / RATE), z)


def relative(delays: np.ndarray) -> np.ndarray:
    return np.asarray(delays) - np.mean(delays)


def found(pipeline: Pipeline) -> np.ndarray:
    return np.asarray(pipeline.core["delays"]["value"][0, :3])


def least_squares(pipeline: Pipeline, block: Block) -> tuple[np.ndarray, np.ndarray]:
    """Delays of the units and their standard deviations, by `numpy.linalg` on all the rows at once."""
    axes, n = pipeline.geometry.axes, pipeline.geometry.n
    solution = np.linalg.pinv(axes)
    rate, residual = block.z @ solution.T, block.z @ pipeline.geometry.S
    shortest = int(np.ceil(BLOCK * 1e-9 * RATE))
    rows, right, ends, scatter, begin = [], [], [], 0.0, 0
    for k in range(len(rate)):
        change, steps = rate[k] - rate[begin], k - begin
        turned = 0.5 * np.sum((axes @ change) ** 2) / SIGMA**2 >= LEAST_CHANGE
        if steps >= shortest and turned:
            seconds = steps / RATE
            area = np.asarray(np.trapezoid(residual[begin : k + 1], dx=1 / RATE, axis=0)) / seconds
            scatter += (min(float(area @ area) / SIGMA**2 / (n - 3), 1e4) - scatter) * seconds / MEMORY
            turn = (axes @ change) / seconds
            units = np.kron(np.eye(3), np.ones((3, 1))) * turn[:, None]
            rows.append(-(pipeline.geometry.S @ units) / SIGMA)
            right.append(area / SIGMA)
            ends.append(k)
            begin = k
        elif steps >= LONGEST * 1e-9 * RATE:
            begin = k
    age = (begin - np.array(ends)) / RATE
    weight = np.sqrt(np.exp(-age / MEMORY) / max(scatter, 1.0))
    lines = [w * np.hstack([row, -late * row]) for w, row, late in zip(weight, rows, age, strict=True)]
    matrix = np.vstack([np.diag(np.repeat([1 / UNIT_DELAY, 1 / SLOPE], 3)), *lines])
    target = np.concatenate([np.zeros(6), *(w * one for w, one in zip(weight, right, strict=True))])
    value = np.linalg.lstsq(matrix, target, rcond=None)[0]
    return value[:3], np.sqrt(np.diag(np.linalg.inv(matrix.T @ matrix)))[:3]


@pytest.mark.parametrize("size", [0.1, 1.0, 3.0])
def test_is_least_squares_with_a_memory(size: float) -> None:
    pipeline, block = monitor(bias__turn_on_std=0.1), stream((0.0, 0.002, -0.001), size)
    pipeline.process(block)
    value, std = least_squares(pipeline, block)
    np.testing.assert_allclose(found(pipeline), value, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(pipeline.core["delays"]["spread"][0, :3], std, rtol=1e-6)


@pytest.mark.parametrize("late", [(0.0, 0.001, 0.0), (0.0, 0.004, 0.0), (-0.004, 0.0, 0.0), (0.001, -0.002, 0.004)])
def test_in_motion_it_is_right_to_a_third_of_a_millisecond(late: tuple[float, ...]) -> None:
    pipeline = monitor()
    pipeline.process(stream(late, 1.0))
    assert np.abs(relative(found(pipeline)) - relative(np.array(late))).max() < 3e-4


@pytest.mark.parametrize("ppm", [-200.0, 20.0, 200.0])
def test_a_clock_that_runs_away_is_followed(ppm: float) -> None:
    pipeline = monitor()
    t = np.arange(round(40 * RATE)) / RATE
    z = np.hstack([rate_at(t - slope * t, 1.0) for slope in (0.0, 1e-6 * ppm, 0.0)])
    z += np.random.default_rng(0).normal(0, SIGMA, z.shape)
    pipeline.process(Block(START + np.arange(len(t), dtype=np.int64) * round(1e9 / RATE), z))
    assert relative(found(pipeline))[1] == pytest.approx(2 / 3 * 1e-6 * ppm * t[-1], abs=3e-4)


def test_units_that_are_in_step_are_said_to_be() -> None:
    pipeline = monitor()
    pipeline.process(stream((0.0, 0.0, 0.0), 1.0))
    assert np.abs(relative(found(pipeline))).max() < 1e-4


@pytest.mark.parametrize("channel", range(0, 9, 4))
def test_a_fault_is_not_taken_for_a_late_unit(channel: int) -> None:
    """The step of a large fault at rest looks like motion; what stays afterwards does not."""
    pipeline, block = monitor(), stream((0.0, 0.0, 0.0), 0.0, seconds=8.0)
    block.z[700:, channel] += 0.5
    output = pipeline.process(block)
    named = {e.channel for e in output.events if e.declares and e.after.name == "FAULTY"}
    assert named == {channel}
    assert "late" not in str(unit_words(pipeline.status()))


def test_the_common_delay_is_not_seen() -> None:
    pipeline, other = monitor(), monitor()
    pipeline.process(stream((0.02, 0.023, 0.02), 1.0))
    other.process(stream((0.0, 0.003, 0.0), 1.0))
    assert relative(found(pipeline)) == pytest.approx(relative(found(other)), abs=2e-4)
    assert abs(found(pipeline).sum()) < 1e-5


def test_at_rest_noise_shows_no_delay() -> None:
    """And what is not known is said to be unknown, so that the first motion does not come as a surprise."""
    pipeline = monitor()
    pipeline.process(stream((0.0, 0.008, 0.0), 0.0, seconds=30.0))
    assert np.array_equal(found(pipeline), np.zeros(3))
    assert pipeline.core["delays"]["spread"][0, :3] == pytest.approx(UNIT_DELAY)
    # Against the mean of the three.
    assert pipeline.core["known"]["delay_std"][0, :9] == pytest.approx(UNIT_DELAY * np.sqrt(2 / 3))


def test_a_late_unit_is_no_fault_of_its_gyros_when_motion_begins_after_rest() -> None:
    pipeline = monitor(noise__scale_std=0.002, noise__timing_std=0.0003)
    pipeline.process(stream((0.0, 0.004, 0.0), 0.0, seconds=10.0))
    moving = stream((0.0, 0.004, 0.0), 1.0, seed=1)
    output = pipeline.process(Block(moving.stamp + 10_000_000_000, moving.z))
    assert not [event for event in output.events if event.declares]
    # A delay that is known is not an error beyond itself: a share of it is kept for what differs from the model.
    own = relative(found(pipeline))
    assert pipeline.core["known"]["delay_std"][0, 3] == pytest.approx(KNOWN_SHARE * own[1], abs=2e-4)
