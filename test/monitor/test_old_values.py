# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A driver or a link that repeats old values, while the other units go on."""

import numpy as np
import pytest
from monitor.streams import (
    RATE,
    SIGMA,
    body_rate,
    config,
    parallel,
    seconds,
    stream,
)

from fdi_ros.model.samples import Block
from fdi_ros.monitor.output import ChannelState, Reason
from fdi_ros.monitor.pipeline import Pipeline

SEQUENTIAL = {"detector__name": "sequential", "bias__startup_bias_duration": 0.0}
RETURNS = {**SEQUENTIAL, "decision__latch": False}
OK, AMBIGUOUS, FAULTY = ChannelState.OK, ChannelState.AMBIGUOUS, ChannelState.FAULTY
THIRD = slice(6, 9)  #: Channels of the third unit.


def repeated(block: Block, start: int, stop: int) -> Block:
    """Return the stream with values of the third unit that repeat from one row to another."""
    z = block.z.copy()
    z[start:stop, THIRD] = z[start, THIRD]
    return Block(block.stamp, z)


@pytest.mark.parametrize("excluded", [(), ("imu_3.x", "imu_3.y", "imu_3.z")])
def test_beside_a_unit_that_repeats_old_values_the_others_still_check_each_other(
    excluded,
):
    pipeline = Pipeline(parallel(3, excluded_channels=excluded, **SEQUENTIAL))
    block = repeated(stream(pipeline.geometry, 900), 300, 900)
    block.z[700:, 0] += 0.15
    output = pipeline.process(block)
    fault = [one for one in output.events if one.declares and one.channel in (0, 3)]
    assert {pipeline.channel_names[one.channel] for one in fault} == {
        "imu_1.x",
        "imu_2.x",
    }
    assert all(7.0 <= seconds(one) < 7.1 for one in fault)
    assert (output.state[720:, [0, 3]] == AMBIGUOUS).all()
    assert (output.state[320:700, [0, 1, 2, 3, 4, 5]] == OK).all()
    assert (output.state[-1, [1, 2, 4, 5]] == OK).all()
    assert not (output.state == FAULTY).any()
    off = np.abs(output.rate - body_rate(900))[720:, 0]
    assert (off < 3 * np.sqrt(output.covariance[720:, 0, 0])).all()


def slowly(samples: int, start: int) -> np.ndarray:
    """Return a rotation about all axes that begins at a row and gets faster, (N, 3) rad/s."""
    since = np.maximum(np.arange(samples) - start, 0) / RATE
    return np.outer(since, [0.04, -0.036, 0.032])


def test_a_unit_that_repeats_is_found_in_a_motion_about_all_axes():
    """Its old values disagree about each axis, and are no doubt of the motion that the others measure."""
    pipeline = Pipeline(parallel(3, **SEQUENTIAL))
    block = stream(pipeline.geometry, 900, size=0.0)
    block.z[:] += np.tile(slowly(900, 600), 3)
    output = pipeline.process(repeated(block, 600, 900))
    # Six standard deviations of the difference to the two others are 18 mrad/s.
    assert (output.state[660:, THIRD] == AMBIGUOUS).all()
    assert (output.state[:630, THIRD] != AMBIGUOUS).all()
    assert {one.reason for one in output.events if one.declares} == {Reason.OLD}
    assert (output.state[300:, :6] == OK).all()


def test_a_unit_that_moves_alone_is_no_motion_for_others_in_coarse_steps():
    pipeline = Pipeline(parallel(3, **SEQUENTIAL))
    block = stream(pipeline.geometry, 900, size=0.0)
    noise = np.random.default_rng(3).normal(0, 0.15, block.z.shape)
    block.z[:] = np.round(noise) * SIGMA
    block.z[:, :3] += slowly(900, 600)
    output = pipeline.process(block)
    assert not np.isin(output.state[:, 3:], (AMBIGUOUS, FAULTY)).any()


def test_beside_a_fault_at_rest_values_in_coarse_steps_are_not_old_nor_called_checked():
    pipeline = Pipeline(config(**SEQUENTIAL))
    block = stream(pipeline.geometry, 900, size=0.0)
    noise = np.random.default_rng(3).normal(0, 0.15, block.z.shape)
    block.z[:] = np.round(noise) * SIGMA
    block.z[500:, 2] += 0.5
    output = pipeline.process(block)
    assert (output.state[400, :] == OK).all()
    assert not (output.state[540:] == OK).any()
    assert not (output.state[:, [0, 1, 3, 4, 5]] == FAULTY).any()


def test_a_set_by_old_values_ends_after_the_clean_time_with_new_ones():
    pipeline = Pipeline(parallel(3, **SEQUENTIAL))
    block = repeated(stream(pipeline.geometry, 2000), 300, 1300)
    output = pipeline.process(block)
    third = output.state[:, THIRD]
    assert (third[330:1790] == AMBIGUOUS).all()
    assert (third[1850:] == OK).all()
    assert (output.state[300:, :6] == OK).all()
    said = {one.reason for one in output.events if one.row >= 300 and one.after != OK}
    assert said == {Reason.OLD}


@pytest.mark.parametrize(
    ("excluded", "members"),
    [((), (6, 7, 8)), (("imu_3.x",), (7, 8))],
)
@pytest.mark.parametrize("detector", ["sequential", "likelihood_ratio"])
def test_no_channel_of_a_unit_that_repeats_is_worse_than_the_others(
    detector, excluded, members
):
    pipeline = Pipeline(
        parallel(3, detector__name=detector, excluded_channels=excluded)
    )
    output = pipeline.process(repeated(stream(pipeline.geometry, 400), 300, 400))
    assert not (output.state == FAULTY).any()
    found = [one.group for one in output.events if one.after == AMBIGUOUS]
    assert found == [members] * len(members)


@pytest.mark.parametrize("wrong", [0, 3])
@pytest.mark.parametrize("detector", ["sequential", "likelihood_ratio"])
def test_one_of_a_set_stays_in_doubt_when_the_other_one_sends_no_numbers(
    detector, wrong
):
    pipeline = Pipeline(parallel(2, detector__name=detector, publish_under_doubt=False))
    block = stream(pipeline.geometry, 1200)
    block.z[300:, wrong] += 0.15
    block.z[450:600, 0] = np.nan
    output = pipeline.process(block)
    assert (output.state[500:, 0] == FAULTY).all()
    assert (output.state[310:, 3] == AMBIGUOUS).all()
    assert not output.valid[310:].any()


def test_one_of_a_set_leaves_it_once_another_unit_checks_it():
    pipeline = Pipeline(parallel(3, **SEQUENTIAL))
    block = stream(pipeline.geometry, 1200)
    block.z[300:, 0] += 0.15
    block.z[450:600, 0] = np.nan
    received = np.ones(block.z.shape, bool)
    received[:800, THIRD] = False
    output = pipeline.process(Block(block.stamp, block.z, received))
    assert (output.state[310:800, 3] == AMBIGUOUS).all()
    assert (output.state[-1, 1:] == OK).all()
    assert output.state[-1, 0] == FAULTY


def test_a_stuck_channel_does_not_return_at_rest_while_it_is_stuck():
    pipeline = Pipeline(parallel(3, **RETURNS))
    block = stream(pipeline.geometry, 2400, size=0.0)
    turn = np.zeros((2400, 3))
    turn[300:500] = 0.6 * np.sin(np.pi * np.arange(200) / 100)[:, None]
    block.z[:] += np.tile(turn, 3)
    block.z[300:1700, 6] = 0.0
    output = pipeline.process(block)
    assert (output.state[350:1700, 6] == FAULTY).all()
    left = 1700 + np.argmin(output.state[1700:, 6] == FAULTY)
    assert 2190 < left < 2230


def test_a_channel_does_not_return_while_the_values_of_all_repeat():
    pipeline = Pipeline(parallel(3, **RETURNS))
    block = stream(pipeline.geometry, 2400, size=0.0)
    block.z[300:600, 6] += 0.15
    block.z[620:1300] = block.z[620, [0, 1, 2] * 3]
    output = pipeline.process(block)
    assert (output.state[350:1300, 6] == FAULTY).all()
    left = 1300 + np.argmin(output.state[1300:, 6] == FAULTY)
    assert 1790 < left < 1830


def test_no_time_is_clean_in_which_the_bias_is_learned():
    pipeline = Pipeline(parallel(3, **{**RETURNS, "bias__startup_bias_duration": 6.0}))
    block = stream(pipeline.geometry, 2400, size=0.0)
    block.z[800:1590, 6] += 0.05
    first = pipeline.process(Block(block.stamp[:1000], block.z[:1000]))
    assert first.state[-1, 6] == FAULTY
    pipeline.relearn_bias()
    second = pipeline.process(Block(block.stamp[1000:], block.z[1000:]))
    learned = 1000 + np.argmax(second.valid)
    left = 1000 + np.argmin(second.state[:, 6] == FAULTY)
    assert 1590 < learned < 1620
    assert learned + 490 < left < learned + 530


def test_while_the_bias_is_learned_nothing_is_reported_of_the_samples_before():
    pipeline = Pipeline(parallel(3, **SEQUENTIAL))
    block = stream(pipeline.geometry, 400, size=0.0)
    block.z[300:350] = block.z[300, [0, 1, 2] * 3]
    pipeline.process(Block(block.stamp[:350], block.z[:350]))
    assert pipeline.status().all_repeat
    pipeline.relearn_bias()
    pipeline.process(Block(block.stamp[350:], block.z[350:]))
    assert not pipeline.status().all_repeat
