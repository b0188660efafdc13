# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Gyros whose biases change with the specific force, in the boost of a rocket."""

from dataclasses import replace

import numpy as np
import pytest
from monitor.streams import RATE, START, struck
from monitor.test_accelerometers import GRAVITY, flight, settings

from fdi_ros.model.samples import Block
from fdi_ros.monitor.output import ChannelState
from fdi_ros.monitor.pipeline import Pipeline

BEGINS, ENDS = 8.0, 12.0  # of the boost, s
SENSITIVITY = np.radians(0.1) / GRAVITY  # (rad/s)/(m/s^2)
LENGTH = 1800  # samples


def boosted(seed, sensitivity=SENSITIVITY, size=0.3):
    """A flight with a boost of 10 g, in which every gyro has a sensitivity of its own."""
    block, force = flight(LENGTH, seed=seed, size=size)
    time = np.arange(LENGTH) / RATE
    pushed = np.clip((time - BEGINS) / 0.2, 0.0, 1.0)
    pushed *= np.clip((ENDS - time) / 0.3, 0.0, 1.0)
    boost = np.outer(9.0 * GRAVITY * pushed, [0.0, 0.0, 1.0])
    felt = block.acceleration.z + np.tile(boost, 3)
    each = np.random.default_rng(100 + seed).normal(0.0, sensitivity, (9, 3))
    z = block.z + (force + boost) @ each.T
    return Block(block.stamp, z, None, Block(block.stamp, felt))


def declared(block, *faults, **changes):
    """Declarations of gyros: time, name and state."""
    pipeline = Pipeline(settings(**changes))
    pipeline.sense(range(3))
    names = pipeline.channel_names
    output = pipeline.process(struck(block, list(faults), names))
    return [
        (1e-9 * (one.stamp - START), names[one.channel], one.after)
        for one in output.events
        if one.declares and one.channel < 9
    ]


def test_a_boost_declares_no_gyro_beside_accelerometers():
    seeds = range(8)
    assert not [one for seed in seeds for one in declared(boosted(seed))]
    ignored = {"noise__g_sensitivity_std": 0.0}
    assert any(declared(boosted(seed), **ignored) for seed in seeds)


@pytest.mark.parametrize("onset", [6.0, 10.0, 15.0])
def test_a_fault_is_named_before_in_and_after_a_boost(onset):
    fault = f"channel=imu_2.y kind=bias size=0.2 start={onset}"
    for seed in range(3):
        events = declared(boosted(seed), fault)
        faulty = [one for one in events if one[2] == ChannelState.FAULTY]
        assert [name for _, name, _ in faulty] == ["imu_2.y"]
        assert 0.0 < faulty[0][0] - onset < 1.0


def test_a_small_fault_that_begins_with_a_boost_is_named_after_its_end():
    fault = f"channel=imu_2.y kind=bias size=0.06 start={BEGINS + 0.1}"
    for seed in range(3):
        events = declared(boosted(seed), fault)
        faulty = [one for one in events if one[2] == ChannelState.FAULTY]
        assert [name for _, name, _ in faulty] == ["imu_2.y"]
        assert ENDS < faulty[0][0] < ENDS + 2.0


def test_outside_boosts_a_fault_is_named_as_soon_as_without_g_sensitivity():
    block, _ = flight(900, size=0.3)
    fault = "channel=imu_2.y kind=bias size=0.1 start=6"
    assert declared(block, fault)
    assert declared(block, fault) == declared(
        block, fault, noise__g_sensitivity_std=0.0
    )


def test_the_covariance_holds_what_a_boost_does_to_the_biases():
    squares = []
    rows = slice(round(BEGINS * RATE), round((ENDS + 1.0) * RATE))
    for seed in range(6):
        # flights with the same noise
        output = Pipeline(settings()).process(boosted(seed))
        insensitive = Pipeline(settings()).process(boosted(seed, 0.0))
        error = (output.rate - insensitive.rate)[rows]
        solved = np.linalg.solve(output.covariance[rows], error[..., np.newaxis])
        squares.append(np.einsum("ki,ki->k", error, solved[..., 0]).mean() / 3)
    assert 0.05 < np.mean(squares) < 1.5


def test_gyros_without_accelerations_are_judged_as_before():
    block = replace(boosted(0), acceleration=None)
    rows = [
        Pipeline(settings(noise__g_sensitivity_std=std)).process(block).rows.tobytes()
        for std in (0.0, SENSITIVITY)
    ]
    assert rows[0] == rows[1]


@pytest.mark.parametrize(("seconds", "counts"), [(0.3, False), (0.6, True)])
def test_biases_move_only_with_a_force_that_lasts_for_half_a_second(seconds, counts):
    """A landing or a gust is over before, and the biases are known as well as ever."""
    block, _ = flight(1000)
    time = np.arange(1000) / RATE
    push = 3.0 * GRAVITY * ((time >= BEGINS) & (time < BEGINS + seconds))
    felt = block.acceleration.z + np.tile(np.outer(push, [0.0, 0.0, 1.0]), 3)
    pushed = replace(block, acceleration=Block(block.stamp, felt))
    pipeline = Pipeline(settings(noise__g_sensitivity_std=SENSITIVITY))
    pipeline.sense(range(3))
    std = []
    for rows in (slice(0, 798), slice(798, 798 + round(seconds * RATE))):
        pipeline.process(pushed[rows])
        std.append(pipeline.core["sample"]["estimate"]["bias_std"][0, :9].copy())
    grown = (std[1] ** 2 - std[0] ** 2) / (3.0 * GRAVITY * SENSITIVITY) ** 2
    # By the square of the sensitivity times the force, less what has been learned since.
    assert grown.min() > (0.3 if counts else -0.03)
    assert grown.max() < (1.2 if counts else 0.03)
