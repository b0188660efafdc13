# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Limits of the monitor, each from both sides: what lies within passes, what lies beyond does not.

A test of one side passes a monitor that has grown timid, or bold.
"""

import math

import numpy as np
import pytest
from monitor.streams import (
    RATE,
    SIGMA,
    START,
    declarations,
    parallel,
    stream,
    swing,
)

from fdi_ros.model.samples import Block
from fdi_ros.monitor.building import build_core, build_geometry, build_noise
from fdi_ros.monitor.output import ChannelState
from fdi_ros.monitor.pipeline import Pipeline

FAULT, OVER = round(2.0 * RATE), round(4.0 * RATE)


@pytest.mark.parametrize(("left", "returns"), [(0.3, True), (0.7, False)])
def test_a_declared_channel_returns_when_its_mean_error_is_half_its_noise(
    left, returns
):
    """An error of 50 sigma that ends, but for a bias of `left` sigma."""
    clean = {"decision__latch": False, "decision__clean_time": 5.0}
    pipeline = Pipeline(parallel(3, **clean))
    block = stream(pipeline.geometry, round(30 * RATE))
    channel, share = 4, pipeline.geometry.S[4, 4]
    block.z[FAULT:, channel] += left * SIGMA / share
    block.z[FAULT:OVER, channel] += 50 * SIGMA
    state = pipeline.process(block).state[:, channel]
    assert state[OVER - 1] == ChannelState.FAULTY
    assert (state[-1] == ChannelState.OK) == returns


def test_a_value_that_is_not_finite_and_the_two_after_it_are_not_in_the_rate():
    """A change of two sigma in them moves the fused rate by nothing, in the value after them by its share."""

    def rate(changed):
        pipeline = Pipeline(parallel(3, detector__name="sequential"))
        block = stream(pipeline.geometry, 320)
        block.z[300, 4] = np.nan
        block.z[300 + changed, 4] += 2 * SIGMA
        return pipeline.process(block).rate[300 + changed]

    def reference(row):
        pipeline = Pipeline(parallel(3, detector__name="sequential"))
        block = stream(pipeline.geometry, 320)
        block.z[300, 4] = np.nan
        return pipeline.process(block).rate[300 + row]

    moved = [np.linalg.norm(rate(k) - reference(k)) / SIGMA for k in (1, 2, 3)]
    assert max(moved[:2]) < 0.02
    assert 0.4 < moved[2] < 0.9


@pytest.mark.parametrize(("turn", "declared"), [(0.8, True), (0.98, False)])
def test_a_value_out_of_range_is_a_fault_where_the_others_predict_far_less(
    turn, declared
):
    """`turn` is a share of the range, which the others measure while one channel is beyond the range."""
    limit = 4.0
    pipeline = Pipeline(parallel(3, health__max_rate=limit))
    block = stream(pipeline.geometry, round(6 * RATE), size=0.0)
    ramp = np.clip((np.arange(len(block)) - 100) / 100, 0.0, 1.0)
    block.z[:, [0, 3, 6]] += turn * limit * ramp[:, None]
    block.z[300:400, 3] = 1.01 * limit
    output = pipeline.process(block)
    assert (("imu_2.x", "FAULTY") in declarations(pipeline, output)) == declared


def stuck_samples(sigmas):
    """Samples in which a repeated value counts as stuck, while the body turns by so many deviations.

    Beside a detector that hardly ever alarms by itself.
    """
    rare = {"detector__false_alarms_per_hour": 1e-9}
    pipeline = Pipeline(parallel(3, **rare))
    block = stream(pipeline.geometry, round(6 * RATE), size=0.0)
    share = pipeline.geometry.S[4, 4]
    turned = np.clip((np.arange(len(block)) - 200) / 20, 0.0, 1.0)
    block.z[:, [1, 4, 7]] += sigmas * SIGMA / math.sqrt(share) * turned[:, None]
    block.z[200:, 4] = block.z[199, 4]
    pipeline.process(block)
    return pipeline.status().channels[4].counts["stuck"]


def test_a_value_that_repeats_is_stuck_once_the_others_have_moved_by_six_deviations():
    assert stuck_samples(8.0) > 0
    assert stuck_samples(4.0) == 0


@pytest.mark.parametrize(("others", "noisy"), [(1.0, True), (3.6, False)])
def test_a_channel_is_noisy_only_if_it_is_so_above_the_others(others, noisy):
    """Noise of 4 noise_std in one channel; `others`: that of all others, the vibration of the body."""
    pipeline = Pipeline(parallel(3, detector__name="sequential"))
    random = np.random.default_rng(1)
    time = np.arange(round(20 * RATE)) / RATE
    factor = np.full(9, others)
    factor[4] = 4.5
    z = swing(time) @ pipeline.geometry.axes.T
    z += factor * random.normal(0.0, SIGMA, z.shape)
    pipeline.process(Block(START + np.round(1e9 * time).astype(np.int64), z))
    found = {one.name for one in pipeline.status().channels if one.noisy}
    assert found == ({"imu_2.y"} if noisy else set())


@pytest.mark.parametrize("times", [5.0, 10.0, 30.0])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_channel_that_becomes_noisy_is_noisy_and_not_faulty(times, seed):
    """From 10 s on, for ten seconds. A bias that the noise does not hide is still a fault."""
    pipeline = Pipeline(parallel(3, detector__name="sequential"))
    block = stream(pipeline.geometry, round(24 * RATE), seed=seed)
    healthy = block.z.copy()
    noise = np.random.default_rng(seed).normal(0.0, times * SIGMA, round(10 * RATE))
    block.z[1000:2000, 4] += noise
    output = pipeline.process(block)
    assert not declarations(pipeline, output)
    spell = pipeline.status().channels[4].longest_noisy
    assert spell.seconds == pytest.approx(10.0, abs=3.0)
    assert (spell.since - START) / 1e9 == pytest.approx(10.0, abs=3.0)
    assert spell.times == pytest.approx(times, rel=0.5)
    assert not any(
        one.longest_noisy.seconds > 0.5
        for one in pipeline.status().channels
        if one.name != "imu_2.y"
    )
    healthy[1500:, 4] += noise[:900] + times * SIGMA
    pipeline = Pipeline(parallel(3, detector__name="sequential"))
    output = pipeline.process(Block(block.stamp, healthy))
    assert declarations(pipeline, output)[-1] == ("imu_2.y", "FAULTY")


def test_a_large_fault_that_a_filter_spreads_over_samples_is_named_at_once():
    """A low-pass filter of 20 Hz: its step response is no noise."""
    pipeline = Pipeline(parallel(3, detector__name="sequential"))
    block = stream(pipeline.geometry, round(12 * RATE))
    since = np.maximum(np.arange(len(block)) - 1000, 0) / RATE
    block.z[:, 4] += 1.0 - np.exp(-since / 0.012)
    output = pipeline.process(block)
    assert declarations(pipeline, output)[-1] == ("imu_2.y", "FAULTY")
    named = [event for event in output.events if event.after == ChannelState.FAULTY]
    assert (named[0].stamp - START) / 1e9 < 10.1


@pytest.mark.parametrize(("rate", "hours"), [(1e-4, 1.0), (1e-3, 2.0), (0.1, 0.5)])
def test_the_prior_of_a_fault_is_that_of_its_rate_over_the_exposure_in_hours(
    rate, hours
):
    """Odds of a fault in the exposure time against none, for failures of a constant rate."""
    settings = parallel(3, integrity__fault_rate=rate, integrity__exposure=hours)
    geometry = build_geometry(settings)
    core = build_core(settings, geometry, build_noise(settings, geometry.n))
    probability = 1.0 - math.exp(-rate * hours)
    odds = core["settings"]["prior"][0, : geometry.n]
    np.testing.assert_allclose(odds, probability / (1.0 - probability), rtol=1e-12)


@pytest.mark.parametrize(
    ("units", "name"), [(2, "likelihood_ratio"), (3, "sequential")]
)
def test_a_fault_of_the_size_of_the_noise_is_not_declared_and_one_of_twelve_is(
    units, name
):
    for size, declared in ((1.0, False), (12.0, True)):
        pipeline = Pipeline(parallel(units, detector__name=name))
        block = stream(pipeline.geometry, round(8 * RATE), seed=3)
        block.z[round(4 * RATE) :, 1] += size * SIGMA
        states = {e for _, e in declarations(pipeline, pipeline.process(block))}
        assert bool(states) == declared, (size, states)


@pytest.mark.parametrize("units", [2, 3, 4])
def test_the_level_of_healthy_gyros_is_little_more_than_the_quantile_of_their_noise(
    units,
):
    """In standard deviations of the fused rate: 5.33 for 1e-7, and the share of faults unnoticed."""
    pipeline = Pipeline(parallel(units, detector__name="sequential"))
    output = pipeline.process(stream(pipeline.geometry, round(20 * RATE)))
    std = np.sqrt(np.diagonal(output.covariance, axis1=1, axis2=2))
    ratio = (output.level / std)[round(5 * RATE) :]
    assert ratio.min() >= 5.33
    assert ratio.max() < 8.0


@pytest.mark.parametrize(("turn_on_std", "checked"), [(SIGMA, True), (0.02, False)])
def test_a_channel_whose_bias_may_be_far_larger_than_its_noise_is_checked_only_once_it_is_known(
    turn_on_std, checked
):
    """Before, a bias of that size would hide a fault of ten times the noise."""
    settings = parallel(3, detector__name="sequential", bias__turn_on_std=turn_on_std)
    pipeline = Pipeline(settings)
    state = pipeline.process(stream(pipeline.geometry, round(2 * RATE))).state
    assert ((state[5] == ChannelState.OK) == checked).all()
    assert ((state[5] == ChannelState.UNCHECKED) != checked).all()
    assert (state[-1] == ChannelState.OK).all()


def test_a_unit_that_repeated_its_values_is_a_set_until_it_was_clean_for_long_enough():
    """Values of one second again and again, while the body turns; `clean_time` after them all is as before."""
    clean = 5.0
    settings = parallel(
        2, detector__name="sequential", decision__clean_time=clean, decision__latch=True
    )
    pipeline = Pipeline(settings)
    block = stream(pipeline.geometry, round(13 * RATE), size=2.0)
    block.z[500:600, 3:] = block.z[500, 3:]
    state = pipeline.process(block).state
    last = 600 + round(clean * RATE)
    assert (state[580 : last - 5, 3:] == ChannelState.AMBIGUOUS).all()
    assert (state[last + 100 :] == ChannelState.OK).all()
