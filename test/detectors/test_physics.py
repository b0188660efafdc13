# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Physics of healthy gyros is no fault, and faults beside it are found all the same."""

import numpy as np
import pytest

from fdi_ros import Block, Config, Pipeline
from fdi_ros.monitor.output import ChannelState

RATE = 100.0
NOISE = 0.003
NAMES = ("imu_1", "imu_2", "imu_3")
DECLARED = (ChannelState.FAULTY, ChannelState.AMBIGUOUS)


def three_units(**settings):
    changes = {name.replace("__", "."): value for name, value in settings.items()}
    return Pipeline.from_config(
        Config.from_parameters(
            {
                "input": "imus",
                "sample_rate": RATE,
                "imus.topics": tuple(f"{name}/data_raw" for name in NAMES),
                "imus.names": NAMES,
                "noise.noise_std": (NOISE,),
                "noise.scale_std": (0.01,),
                "noise.timing_std": (0.0003,),
                "bias.startup_bias_duration": 3.0,
                **changes,
            }
        )
    )


def flight(seed, seconds, size=1.0):
    """Times (N,), body rate (N, 3) at rest for 6 s and then turning, and the noise of nine channels (N, 9)."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 1 / RATE)
    begun = np.clip(t - 6.0, 0, 1)[:, None]
    waves = np.sin(np.outer(t, rng.uniform(0.7, 2.0, 3)) + rng.uniform(0, 6, 3))
    return t, size * begun * waves, NOISE * rng.standard_normal((len(t), 9))


@pytest.fixture(scope="module")
def pipeline():
    return three_units()


def judge(pipeline, t, z):
    pipeline.restart()
    return pipeline.process(Block(np.round(1e9 * t).astype(np.int64) + 10**18, z))


def declared(output):
    return np.isin(output.state, DECLARED)


def first_named(output, t, channel):
    """Seconds at which a channel is FAULTY; inf: never."""
    rows = output.state[:, channel] == ChannelState.FAULTY
    return t[rows.argmax()] if rows.any() else np.inf


@pytest.mark.parametrize("order", [1, 2, 3])
def test_an_error_that_is_not_linear_in_the_rate_is_no_fault(pipeline, order):
    """Asymmetry of 0.5 %, and a nonlinearity of 1 % at 3 rad/s; a bias of 0.05 rad/s is named within 2 s."""
    for seed in range(2):
        t, rate, noise = flight(seed, 40.0, 3.0)
        along = np.tile(rate, 3)
        rng = np.random.default_rng(seed)
        if order == 1:
            bent = 0.0025 * rng.choice([-1, 1], 9) * np.abs(along)
        else:
            size = 0.01 * rng.uniform(-1, 1, 9)
            bent = size * along * np.abs(along / 3) ** (order - 1)
        z = along + noise + bent
        assert not declared(judge(pipeline, t, z)).any()
        z[t > 30.0, 4] += 0.05
        output = judge(pipeline, t, z)
        assert 30.0 < first_named(output, t, 4) < 32.0
        assert not (np.delete(output.state, 4, axis=1) == ChannelState.FAULTY).any()


@pytest.mark.parametrize("detector", ["sequential", "guaranteed"])
@pytest.mark.parametrize("kind", ["ramp", "bias"])
def test_a_quiet_gyro_is_not_stuck_because_another_one_fails(detector, kind):
    """At rest in steps of 1 mrad/s values repeat; in a turn a value that repeats is stuck."""
    quiet = three_units(
        detector__name=detector,
        health__stuck_time=0.5,
        health__stuck_time_at_rest=0.0,
        bias__startup_bias_duration=0.0,
    )
    for seed in range(4):
        t, rate, noise = flight(seed, 20.0)
        noise *= 0.1
        since = np.maximum(t - 10.0, 0.0)
        fault = 0.02 * since if kind == "ramp" else 0.08 * (since > 0)
        still = noise.copy()
        still[:, seed % 9] += fault
        faulty = judge(quiet, t, np.round(still, 3)).state == ChannelState.FAULTY
        named = set(np.flatnonzero(faulty.any(axis=0)))
        assert named <= {seed % 9}
        assert named or detector == "guaranteed", "two faults of two may look like one"
        z = np.round(np.tile(rate, 3) + noise, 3)
        z[t > 12.0, 5] = z[t > 12.0, 5][0]
        limit = 14.0 if detector == "sequential" else 20.0
        assert 12.0 < first_named(judge(quiet, t, z), t, 5) < limit


def test_biases_that_all_shift_as_a_boost_begins_are_no_fault(pipeline):
    """By 20 mrad/s from 14 to 19 s, as the body begins to spin; 0.3 rad/s afterwards is named within 2 s."""
    for seed in range(3):
        t, rate, noise = flight(seed, 60.0)
        rng = np.random.default_rng(seed)
        spin = 2.0 * np.clip(t - 14.0, 0.0, 1.0)[:, None] * [0.0, 0.0, 1.0]
        pushed = np.clip((t - 14.0) / 0.2, 0, 1) * np.clip((19.0 - t) / 0.5, 0, 1)
        shift = 0.02 * rng.standard_normal(9) * pushed[:, None]
        z = np.tile(rate + spin, 3) * (1 + 0.003 * rng.standard_normal(9))
        z += noise + shift
        z[t > 45.0, 4] += 0.3
        output = judge(pipeline, t, z)
        assert 45.0 < first_named(output, t, 4) < 47.0
        assert not (np.delete(output.state, 4, axis=1) == ChannelState.FAULTY).any()
        assert not declared(output)[(t > 30.0) & (t < 45.0)].any()


@pytest.mark.parametrize("seed", [6, 8, 13])
def test_biases_that_return_as_a_boost_ends_are_known_again(pipeline, seed):
    """0.03 rad/s after a boost in vibration is named within 8 s; it was hidden by what the states had learned."""
    t, rate, noise = flight(seed, 40.0)
    rng = np.random.default_rng(seed)
    pushed = np.clip((t - 14.0) / 0.2, 0, 1) * np.clip((19.0 - t) / 0.5, 0, 1)
    noise += 0.02 * rng.standard_normal(9) * pushed[:, None]
    line = np.sin(2 * np.pi * 37.0 * t[:, None] + rng.uniform(0, 6, 9))
    noise += 0.05 * np.clip(t - 10.0, 0, 1)[:, None] * line
    z = np.tile(rate, 3) * (1 + 0.003 * rng.standard_normal(9)) + noise
    z[t > 30.0, 4] += 0.03
    output = judge(pipeline, t, z)
    assert 30.0 < first_named(output, t, 4) < 38.0
    assert not (np.delete(output.state, 4, axis=1) == ChannelState.FAULTY).any()


def test_biases_that_move_one_unit_after_another_are_no_fault(pipeline):
    """By 6 mrad/s within 10 s, as in a thermal shock; 0.1 rad/s is named within 2 s all the same."""
    for seed in range(3):
        t, rate, noise = flight(seed, 100.0)
        rng = np.random.default_rng(seed)
        z = np.tile(rate, 3) + noise
        for unit in range(3):
            done = np.clip((t - 15.0 - 20.0 * unit) / 10.0, 0.0, 1.0)
            size = rng.choice([-1, 1], 3) * rng.uniform(0.003, 0.006, 3)
            z[:, 3 * unit : 3 * unit + 3] += np.outer(done, size)
        assert not (judge(pipeline, t, z).state == ChannelState.FAULTY).any()
        z[t > 80.0, 4] += 0.1
        output = judge(pipeline, t, z)
        assert 80.0 < first_named(output, t, 4) < 82.0
        assert not (np.delete(output.state, 4, axis=1) == ChannelState.FAULTY).any()


def test_a_small_fault_that_begins_suddenly_is_no_slow_move():
    """On a cone of six, 9 mrad/s at once are named within 3 s; 9 mrad/s within 5 s, as a healthy bias moves, never."""
    cone = Pipeline.from_config(
        Config.from_parameters(
            {
                "input": "channels",
                "sample_rate": RATE,
                "geometry.preset": "two_triad_cone",
                "noise.noise_std": (NOISE,),
                "bias.startup_bias_duration": 3.0,
            }
        )
    )
    for seed in range(4):
        t, rate, noise = flight(seed, 50.0, 0.1)
        healthy = rate @ cone.geometry.axes.T + noise[:, :6]
        since = np.maximum(t - 40.0, 0.0)
        for rises, limit in ((0.01, 43.0), (5.0, np.inf)):
            z = healthy.copy()
            z[:, seed] += 0.009 * np.minimum(since / rises, 1.0)
            output = judge(cone, t, z)
            named = first_named(output, t, seed)
            assert 40.0 < named < limit if rises < 1.0 else named == np.inf
            assert not (
                np.delete(output.state, seed, axis=1) == ChannelState.FAULTY
            ).any()
