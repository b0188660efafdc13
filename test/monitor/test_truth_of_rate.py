# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The fused rate with its instant and covariance is true where clocks, steps of the values or the motion are odd.

Each figure is bounded from both sides.
"""

import numpy as np
import pytest
from monitor.streams import RATE, SIGMA, START, config, parallel

from fdi_ros.model.samples import Block
from fdi_ros.monitor.output import ChannelState
from fdi_ros.monitor.pipeline import Pipeline

MILLISECOND = 1_000_000


def swung(seconds):
    """Quick turns about all axes, (N, 3) rad/s, with up to 9 rad/s^2."""
    return 2.0 * np.sin(2 * np.pi * np.outer(seconds, [0.5, 0.7, 0.3]) + np.arange(3.0))


def late_unit(delay, seconds=30.0, seed=0):
    """Output of three units mounted alike, of which the second is stamped late by a delay, s."""
    pipeline = Pipeline(parallel(3, detector__name="sequential"))
    time = np.arange(round(seconds * RATE)) / RATE
    z = np.hstack([swung(time), swung(time - delay), swung(time)])
    z += np.random.default_rng(seed).normal(0.0, SIGMA, z.shape)
    stamp = START + np.round(1e9 * time).astype(np.int64)
    return pipeline.process(Block(stamp, z)), stamp


def test_the_rate_is_of_the_instant_that_is_stated():
    output, stamp = late_unit(0.008)
    last = slice(-500, None)
    back = (stamp - output.instant)[last] / MILLISECOND
    assert back.min() > 7.0
    assert back.max() < 9.0
    seconds = (output.instant[last] - START) * 1e-9
    error = output.rate[last] - swung(seconds)
    # At the stamp the rate is off by up to 70 mrad/s.
    assert np.sqrt((error**2).mean()) < 0.004


def test_instants_increase_where_a_delay_of_several_samples_is_found():
    """The rate then belongs to an instant before the one of the last sample, for some samples."""
    output, stamp = late_unit(0.025, seconds=15.0)
    steps = np.diff(output.instant)
    assert steps.min() == 1
    assert steps.max() < 20 * MILLISECOND
    back = (stamp - output.instant) / MILLISECOND
    assert (back[:100] == 0.0).all()
    assert back[-1] == pytest.approx(25.0, abs=2.0)


def test_a_delay_that_is_not_taken_off_is_in_the_covariance_of_a_turn():
    """Each unit may be the one in time: the rate is of any instant between theirs."""
    delay = 0.0016
    output, stamp = late_unit(delay)
    assert (stamp == output.instant).all()
    acceleration = np.gradient(swung(np.arange(len(stamp)) / RATE), 1.0 / RATE, axis=0)
    quick = np.abs(acceleration[:, 1]) > 7.0
    quick[:-500] = False
    std = np.sqrt(output.covariance[:, 1, 1])
    own = std[-500:].min()
    ratio = np.sqrt(std[quick] ** 2 - own**2) / (delay * np.abs(acceleration[quick, 1]))
    assert 0.45 < ratio.mean() < 0.9


def test_steps_of_the_values_are_in_the_covariance_of_a_bias_that_was_learned_at_rest():
    """Without noise a gyro in coarse steps shows a bias within half of one, and the same one all the time."""
    step, found, stds = 0.004, [], []
    given = {"noise__noise_std": 0.0005, "bias__startup_bias_duration": 2.0}
    for seed in range(40):
        random = np.random.default_rng(seed)
        pipeline = Pipeline(config(**given))
        bias = random.uniform(-0.9, 0.9, pipeline.geometry.n) * step
        time = np.arange(260) / RATE
        rate = np.zeros((260, 3))
        rate[210:] = 0.5 * np.sin(np.outer(time[210:] - 2.1, [9.0, 7.0, 8.0]))
        z = rate @ pipeline.geometry.axes.T + bias
        z += random.normal(0.0, 0.0003, z.shape)
        z = np.round(z / step) * step
        output = pipeline.process(Block(START + np.arange(260) * 10 * MILLISECOND, z))
        error = output.rate[215] - rate[215]
        found.append(error @ np.linalg.solve(output.covariance[215], error))
        stds.append(pipeline.core["sample"]["bias_std"][0, : pipeline.geometry.n])
    # In some flights no value changes at rest, and the step stays unknown.
    assert np.median(stds) == pytest.approx(step / np.sqrt(12.0), rel=0.02)
    # The mean of a chi-square with 3 degrees of freedom is 3.
    assert 1.5 < np.mean(found) < 5.0


def test_a_sample_that_is_not_judged_has_the_uncertainty_of_its_own_motion():
    """After rest a vehicle turns beyond the range of one gyro at once, and no errors of scale were known before."""
    scale = 0.01
    which = parallel(3, health__max_rate=[4.0] + [30.0] * 8, noise__scale_std=scale)
    pipeline = Pipeline(which)
    z = np.zeros((330, 9))
    z[300:, [0, 3, 6]] = 5.0
    z[300:, 0] = 4.0
    z += np.random.default_rng(0).normal(0.0, SIGMA, z.shape)
    z[300:, 0] = 4.0
    output = pipeline.process(Block(START + np.arange(330) * 10 * MILLISECOND, z))
    std = np.sqrt(output.covariance[301:310, 0, 0])
    assert (std > 0.8 * scale * 5.0 / np.sqrt(2.0)).all()
    assert (std < 3.0 * scale * 5.0).all()


@pytest.mark.parametrize(("repeated", "published"), [(0.08, True), (0.25, False)])
def test_a_rate_of_values_that_all_repeat_in_motion_is_withheld(repeated, published):
    pipeline = Pipeline(parallel(3))
    time = np.arange(400) / RATE
    z = np.tile(swung(time), 3)
    z += np.random.default_rng(0).normal(0.0, SIGMA, z.shape)
    last = 200 + round(repeated * RATE)
    z[200:last] = z[200]
    output = pipeline.process(Block(START + np.arange(400) * 10 * MILLISECOND, z))
    assert output.valid[last - 1] == published
    assert output.valid[250:].all()


@pytest.mark.parametrize(("size", "copied"), [(0.02, False), (0.5, True)])
def test_smooth_values_make_no_copy_where_noise_would_hide_the_motion(size, copied):
    """Equal values to the bit are one sensor only where they change by more than noise may."""
    pipeline = Pipeline(parallel(2))
    time = np.arange(600) / RATE
    z = np.tile(0.5 * size * swung(time), 2)
    pipeline.process(Block(START + np.arange(600) * 10 * MILLISECOND, z))
    assert bool(pipeline.core["copies"]["channels"][0]) == copied


def test_a_channel_without_numbers_stays_faulty_where_a_copy_is_found():
    """imu_1.x sends NaN from 3 to 4.5 s, and imu_3 repeats imu_2 from 6 s on."""
    pipeline = Pipeline(parallel(3, detector__name="sequential"))
    time = np.arange(1500) / RATE
    z = np.tile(0.3 * swung(time), 3)
    z += np.random.default_rng(0).normal(0.0, SIGMA, z.shape)
    z[300:450, 0] = np.nan
    z[600:, 6:] = z[600:, 3:6]
    output = pipeline.process(Block(START + np.arange(1500) * 10 * MILLISECOND, z))
    assert pipeline.core["copies"]["channels"][0]
    assert (output.state[450:, 0] == ChannelState.FAULTY).all()
    assert not (output.state[:, 1:6] == ChannelState.FAULTY).any()


def test_a_bias_that_is_learned_anew_is_known_as_well_without_a_start_up_average():
    z = np.random.default_rng(0).normal(0.0, SIGMA, (800, 9))
    block = Block(START + np.arange(800) * 10 * MILLISECOND, z)
    known = []
    for duration in (0.0, 2.0):
        changes = {"bias__startup_bias_duration": duration}
        pipeline = Pipeline(parallel(3, detector__name="sequential", **changes))
        pipeline.process(block[:300])
        pipeline.relearn_bias()
        known.append(pipeline.process(block[300:]))
    np.testing.assert_allclose(known[0].covariance, known[1].covariance, rtol=0.05)
    np.testing.assert_allclose(known[0].level, known[1].level, rtol=0.05)


def test_the_bias_of_a_unit_at_half_the_rate_is_learned():
    pipeline = Pipeline(parallel(3, detector__name="sequential"))
    time = np.arange(2000) / RATE
    z = np.tile(0.3 * swung(time), 3)
    z += np.random.default_rng(0).normal(0.0, SIGMA, z.shape)
    z[:, 6] += 0.006
    received = np.ones(z.shape, dtype=bool)
    received[::2, 6:] = False
    pipeline.process(Block(START + np.arange(2000) * 10 * MILLISECOND, z, received))
    bias = pipeline.core["sample"]["estimate"]["bias"][0, :9]
    assert bias[6] - (bias[0] + bias[3]) / 2 == pytest.approx(0.006, abs=0.0015)


def test_noise_beyond_the_settings_is_no_fault_for_a_method_that_learns_none():
    """It judges residuals by the noise of the moment, so three times the noise brings no alarm more than usual."""
    pipeline = Pipeline(parallel(3, detector__name="likelihood_ratio"))
    time = np.arange(3000) / RATE
    z = np.tile(0.3 * swung(time), 3)
    z += np.random.default_rng(0).normal(0.0, 3.0 * SIGMA, z.shape)
    output = pipeline.process(Block(START + np.arange(3000) * 10 * MILLISECOND, z))
    assert not any(event.declares for event in output.events)
    assert output.alarm[500:].mean() < 0.002


@pytest.mark.parametrize("late", [1, 2, 4])
def test_while_two_units_disagree_one_alone_is_not_believed(late):
    """For 0.12 s: imu_2.x is off by 1 rad/s, and imu_1 misses every second sample."""
    time = np.arange(round(20.0 * RATE)) / RATE
    for seed in range(4):
        random = np.random.default_rng(seed)
        pipeline = Pipeline(parallel(2, detector__name="sequential"))
        z = np.hstack([0.3 * swung(time)] * 2)
        z += random.normal(0.0, SIGMA, z.shape)
        onset = 1500 + 7 * seed
        z[onset:, 3] += 1.0
        z[onset + late : onset + 12 : 2, :3] = np.nan
        output = pipeline.process(
            Block(START + np.arange(len(time)) * 10 * MILLISECOND, z)
        )
        error = np.abs(output.rate[:, 0] - 0.3 * swung(time)[:, 0])
        std = np.sqrt(output.covariance[:, 0, 0])
        disagree = slice(onset, onset + 16)
        assert (error < 4.0 * std)[disagree].all()
        assert std[onset - 200 : onset].max() < 0.02
        if late == 1:
            # imu_1 has returned before the alarm, and imu_2.x is the one that jumped.
            assert error[onset + 2] < 0.05
            assert std[onset + 2] < 0.05


def spike_beside_an_offset(z, late):
    z[late, 4] += 1.0
    z[np.argmax(late) + 3, 2] += 30.0


def spike_as_vibration_begins(z, late):
    seconds = np.arange(len(z)) / RATE
    vibration = late * np.sin(2 * np.pi * 23.0 * seconds)
    z += np.outer(vibration, np.tile([0.1, -0.1, 0.1], 2))
    z[np.argmax(late) + 110, 4] += 5.0
    return np.outer(vibration, [0.1, -0.1, 0.1])


def stuck(z, late):
    z[late, 0] = z[np.argmax(late), 0]


def spikes_of_the_last_channel(z, late):
    z[late, 1] = np.nan
    z[np.argmax(late) + 300 :: 50, 4] += 5.0


@pytest.mark.parametrize(
    ("disturb", "usual"),
    [
        (spike_beside_an_offset, 0.01),
        (spike_as_vibration_begins, 0.05),
        (stuck, 0.01),
        (spikes_of_the_last_channel, 0.01),
    ],
)
def test_channels_that_contradict_the_rate_are_in_its_covariance(disturb, usual):
    """Two units, which cannot tell who is wrong. The median std stays below ``usual``, rad/s."""
    time = np.arange(round(12.0 * RATE)) / RATE
    pipeline = Pipeline(parallel(2, detector__name="sequential"))
    for seed in range(4):
        motion = swung(time) * np.clip(time - 2.0, 0.0, 1.0)[:, None]
        z = np.hstack([motion, motion])
        z += np.random.default_rng(seed).normal(0.0, SIGMA, z.shape)
        common = disturb(z, time >= 6.0 + 0.4 * seed)
        truth = motion if common is None else motion + common
        pipeline.restart()
        output = pipeline.process(Block(START + np.round(1e9 * time).astype(int), z))
        error = output.rate - truth
        inverse = np.linalg.inv(output.covariance)
        square = np.einsum("ki,kij,kj->k", error, inverse, error)
        assert np.nanmax(square) < 60.0
        assert np.nanmedian(np.sqrt(output.covariance[:, 2, 2])) < usual


def test_while_two_units_are_in_doubt_as_wholes_either_may_be_the_right_one():
    """From 20 s on one of two shows a turn a fifth larger: the rate is off by a tenth of it.

    The square of that error counts three times in the covariance: for the channels, for the
    units, and for the hypotheses on what is wrong.
    """
    pipeline = Pipeline(parallel(2, detector__name="sequential"))
    time = np.arange(2300) / RATE
    turn = np.clip(time - 3.0, 0.0, 1.0)[:, None] * np.array([0.5, 0.4, -0.6])
    z = np.tile(turn, 2)
    z[2000:, 3:] *= 1.2
    z += np.random.default_rng(5).normal(0.0, SIGMA, z.shape)
    output = pipeline.process(Block(START + np.arange(2300) * 10 * MILLISECOND, z))
    last = slice(2050, None)
    assert (output.state[last] == ChannelState.AMBIGUOUS).all()
    ratio = (
        np.diagonal(output.covariance[last], axis1=1, axis2=2) / (0.1 * turn[-1]) ** 2
    )
    assert ratio.mean(axis=0) == pytest.approx(3.0, abs=0.4)


@pytest.mark.parametrize("offset", range(4))
def test_a_turn_that_changes_in_a_hole_leaves_the_covariance_as_it_was(offset):
    """From 2 to 8 rad/s about z in 0.6 s; the hole begins at each place of a block of four samples."""
    pipeline = Pipeline(parallel(3, detector__name="sequential"))
    stds = []
    for first in (8.0, 2.0):
        time = np.arange(round(5.4 * RATE)) / RATE
        begin = 4.0 + offset / RATE
        turn = np.where(time < begin + 0.3, first, 8.0) + 0.5 * np.sin(0.5 * time)
        motion = np.column_stack([0.0 * time, 0.0 * time, turn])
        z = np.hstack([motion] * 3)
        z += np.random.default_rng(5).normal(0.0, SIGMA, z.shape)
        seen = (time < begin - 1e-6) | (time > begin + 0.6)
        stamp = START + np.round(1e9 * time).astype(np.int64)
        pipeline.restart()
        output = pipeline.process(Block(stamp[seen], z[seen]))
        stds.append(np.sqrt(output.covariance[-60:, 2, 2]))
    assert stds[1].max() < 1.3 * stds[0].max()
    assert stds[1].min() > 0.7 * stds[0].min()


@pytest.mark.parametrize("shared", [0.0, 0.01])
def test_scale_errors_that_all_gyros_share_are_in_the_covariance(shared):
    """No comparison shows them. Calibrated to 5e-5 of each other, they spin at 10 rad/s."""
    errors = []
    for seed in range(20):
        random = np.random.default_rng(seed)
        time = np.arange(round(12.0 * RATE)) / RATE
        rate = swung(time) / 2.0
        rate[:, 2] += 10.0 * np.clip((time - 6.0) / 2.0, 0.0, 1.0)
        scale = 1.0 + random.normal(0.0, 0.01, 3)
        z = np.tile(rate * scale, (1, 3))
        z += random.normal(0.0, SIGMA, z.shape)
        given = {
            "detector__name": "sequential",
            "noise__scale_std": 5e-5,
            "noise__shared_scale_std": shared,
        }
        output = Pipeline(parallel(3, **given)).process(
            Block(START + np.round(1e9 * time).astype(np.int64), z)
        )
        assert set(output.state[-1].tolist()) == {ChannelState.OK}
        error = output.rate[-1] - rate[-1]
        errors.append(error @ np.linalg.solve(output.covariance[-1], error) / 3.0)
    if shared:
        assert 0.25 < np.mean(errors) < 2.0
    else:
        assert np.mean(errors) > 3.0, "or this test shows nothing"


def test_a_shared_scale_error_changes_nothing_at_rest_and_hides_no_fault():
    time = np.arange(round(8.0 * RATE)) / RATE
    rate = swung(time) * np.clip((time - 3.0) / 2.0, 0.0, 1.0)[:, None]
    z = np.tile(rate, (1, 3)) + np.random.default_rng(1).normal(0.0, SIGMA, (800, 9))
    z[600:, 4] += 0.1
    stamp = START + np.round(1e9 * time).astype(np.int64)
    plain, allowed = (
        Pipeline(
            parallel(3, detector__name="sequential", noise__shared_scale_std=shared)
        ).process(Block(stamp, z))
        for shared in (0.0, 0.005)
    )
    assert np.abs((allowed.rate - plain.rate)[:600]).max() < 0.2 * SIGMA
    np.testing.assert_array_equal(allowed.state[-1], plain.state[-1])
    assert allowed.state[-1, 4] == ChannelState.FAULTY
    np.testing.assert_allclose(allowed.covariance[:290], plain.covariance[:290], 1e-4)
    assert (allowed.covariance[580, 0, 0] > plain.covariance[580, 0, 0]).all()


def test_a_shared_scale_error_leaves_weights_where_all_gyros_reach_their_range():
    """Gyros are silent beyond 4 rad/s, and the last motion known is another one."""
    given = {
        "detector__name": "sequential",
        "health__max_rate": [4.0],
        "noise__scale_std": 5e-5,
        "noise__shared_scale_std": 0.05,
    }
    time = np.arange(round(20.0 * RATE)) / RATE
    rate = 3.0 * swung(time)
    z = np.tile(rate, (1, 3)) + np.random.default_rng(1).normal(0.0, SIGMA, (2000, 9))
    stamp = START + np.round(1e9 * time).astype(np.int64)
    output = Pipeline(parallel(3, **given)).process(Block(stamp, np.clip(z, -4.5, 4.5)))
    known = output.valid.astype(bool)
    assert 0.05 < known.mean() <= 1.0
    assert np.abs(output.rate[known]).max() < 10.0
