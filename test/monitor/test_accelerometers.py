# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The accelerometers of the units, judged beside the gyros."""

from dataclasses import replace

import numpy as np
import pytest
from bag.recordings import imu
from monitor.streams import RATE, SIGMA, START, parallel, struck
from monitor.test_receiver import Ear

from fdi_ros.config.config import Config
from fdi_ros.core.messages import integrity_labels
from fdi_ros.core.sources import ChannelsSource, ImuSource
from fdi_ros.errors import ConfigError
from fdi_ros.model.samples import Block
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.monitor.state_file import StateFile

GRAVITY = 9.81
NOISE = 0.15  # m/s^2
ARMS = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.05], [0.0, -0.1, 0.02]])
"""Positions of three units from the first, m."""


def flight(samples, units=3, seed=0, arms=None, scale=0.0, bias=0.0, size=1.0):
    """A vehicle that tilts, turns and accelerates: samples of its units, and the true specific force at the first.

    ``arms``: positions (units, 3), m. ``scale``, ``bias``: standard deviations of what
    is not known of the scale factors, axes and biases of the accelerometers.
    """
    rng = np.random.default_rng(seed)
    time = np.arange(samples) / RATE
    phase = rng.uniform(0, 2 * np.pi, 6)
    omega = size * np.stack(
        [np.sin(3.0 * time + phase[0]), np.cos(2.2 * time), np.sin(1.1 * time)], axis=1
    )
    alpha = size * np.stack(
        [
            3.0 * np.cos(3.0 * time + phase[0]),
            -2.2 * np.sin(2.2 * time),
            1.1 * np.cos(1.1 * time),
        ],
        axis=1,
    )
    tilt = 0.4 * np.sin(0.7 * time + phase[1])
    force = np.stack(
        [GRAVITY * np.sin(tilt), 2.0 * np.sin(1.7 * time), GRAVITY * np.cos(tilt)],
        axis=1,
    )
    felt = []
    for unit in range(units):
        arm = np.zeros(3) if arms is None else arms[unit]
        turning = np.cross(alpha, arm) + np.cross(omega, np.cross(omega, arm))
        axes = np.eye(3) + rng.normal(0, scale, (3, 3))
        noise = rng.normal(0, NOISE, (samples, 3)) + rng.normal(0, bias, 3)
        felt.append((force + turning) @ axes.T + noise)
    z = np.tile(omega, units) + rng.normal(0, SIGMA, (samples, 3 * units))
    stamp = START + np.arange(samples, dtype=np.int64) * round(1e9 / RATE)
    return Block(stamp, z, None, Block(stamp, np.hstack(felt))), force


def settings(units=3, **changes):
    """Settings that fit `flight`."""
    changes = {"noise__scale_std": 0.001, "detector__name": "sequential"} | changes
    return parallel(units, accelerometers__noise_std=NOISE, **changes)


def test_gyros_are_judged_to_the_bit_as_without_accelerometers():
    block, _ = flight(600)
    names = Pipeline(settings()).channel_names
    block = struck(block, ["channel=imu_2.y kind=bias size=0.3 start=3"], names)
    both, gyros = Pipeline(settings()).process(block), Pipeline(settings())
    alone = gyros.process(replace(block, acceleration=None))
    assert both.rows.tobytes() == alone.rows.tobytes()
    assert [one for one in both.events if one.channel < 9] == list(alone.events)
    assert alone.acceleration is None
    assert alone.channel_names == gyros.channel_names == names


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("axis", "xyz")
def test_the_fault_of_an_accelerometer_is_named_with_its_size(axis, seed):
    pipeline = Pipeline(settings())
    block, _ = flight(800, seed=seed, scale=0.005)
    pipeline.sense(range(3))
    fault = f"channel=imu_2.accel_{axis} kind=bias size=3 start=4"
    output = pipeline.process(struck(block, [fault], pipeline.channel_names))
    declared = [event for event in output.events if event.declares]
    named = [event for event in declared if event.after.name == "FAULTY"]
    assert [output.channel_names[one.channel] for one in named] == [
        f"imu_2.accel_{axis}"
    ]
    assert named[0].unit == "m/s^2"
    assert 2.0 < abs(named[0].error) < 4.0
    assert 0 < (named[0].stamp - START) / 1e9 - 4 < 1.0
    channel = pipeline.status().channels[9 + 3 + "xyz".index(axis)]
    assert (channel.state.name, channel.unit) == ("FAULTY", "m/s^2")
    assert output.state.shape == output.residual.shape == (800, 18)
    assert abs(output.residual[-1, named[0].channel]) == pytest.approx(3.0, abs=1.0)


def test_the_fused_specific_force_is_as_far_off_as_its_covariance_says():
    squares = []
    for seed in range(6):
        block, force = flight(600, seed=seed, scale=0.01, bias=0.3)
        pipeline = Pipeline(settings(accelerometers__turn_on_std=0.3))
        output = pipeline.process(block).acceleration
        assert not [event for event in output.events if event.declares]
        assert (np.abs(output.rate - force) < output.level).all()
        rows = slice(100, None, 50)
        error = (output.rate - force)[rows]
        inverse = np.linalg.inv(output.covariance[rows])
        squares.append(np.einsum("ki,kij,kj->k", error, inverse, error).mean() / 3)
    assert 0.5 < np.mean(squares) < 2.0


def test_known_lever_arms_are_taken_off():
    block, _ = flight(600, arms=ARMS, size=4.0)

    def residual(**changes):
        output = Pipeline(settings(**changes)).process(block).acceleration
        return np.sqrt((output.residual[100:] ** 2).mean(axis=0)).max()

    corrected = residual(accelerometers__positions=ARMS.ravel().tolist())
    assert corrected < 1.2 * NOISE < 2 * NOISE < residual()


def sent(block, absent=()):
    """The Imu messages of a block, unit and bytes; some units give no accelerations."""
    for k, stamp in enumerate(block.stamp.tolist()):
        for unit in range(3):
            part = slice(3 * unit, 3 * unit + 3)
            force = None if unit in absent else tuple(block.acceleration.z[k, part])
            yield unit, imu(stamp + unit * 500_000, block.z[k, part], force=force)


def test_message_by_message_equals_the_block():
    block, _ = flight(300)
    block = struck(
        block,
        ["channel=imu_1.accel_z kind=bias size=4 start=2"],
        Pipeline(settings(accelerometers__enabled="on")).channel_names,
    )
    ear, offline = Ear(Pipeline(settings())), Pipeline(settings())
    for unit, data in sent(block):
        ear.take(unit, data)
    read = np.array([ImuSource.parse(data, 6)[1] for data in ear.fused])
    live = ear.receiver.pipeline
    assert live.channel_names == (
        *(f"imu_{k}.{axis}" for k in (1, 2, 3) for axis in "xyz"),
        *(f"imu_{k}.accel_{axis}" for k in (1, 2, 3) for axis in "xyz"),
    )
    # The first sample alone cannot show that accelerations vary.
    output = offline.process(block[1:])
    assert np.isnan(read[0, 3:]).all()
    count = len(read) - 1
    np.testing.assert_allclose(
        read[1:, 3:], output.acceleration.rate[:count], rtol=0, atol=1e-9
    )
    named = {live.channel_names[one.channel] for one in ear.events if one.declares}
    assert "imu_1.accel_z" in named
    labels = integrity_labels(live.channel_names, 9)
    _, values = ChannelsSource.parse(ear.integrity[-1], len(labels))
    last = dict(zip(labels, values, strict=True))
    assert last["state imu_1.accel_z"] == live.status().channels[11].state
    assert last["accelerometers protection level x [m/s^2]"] > 0.1


@pytest.mark.parametrize(
    ("absent", "names"),
    [((0, 1, 2), ()), ((1,), ("imu_1", "imu_3")), ((0, 1), ())],
)
def test_units_without_accelerations_have_no_accelerometers(absent, names):
    ear, (block, _) = Ear(Pipeline(settings())), flight(30)
    for unit, data in sent(block, absent):
        ear.take(unit, data)
    found = ear.receiver.pipeline.channel_names[9:]
    assert found == tuple(f"{name}.accel_{axis}" for name in names for axis in "xyz")
    (covariance,) = np.frombuffer(ear.fused[-1][-72:-64])
    assert (covariance == -1.0) == (not names)


def test_a_constant_is_no_acceleration_and_zeros_are_none():
    block, _ = flight(50)
    for force in (np.full((50, 9), GRAVITY), np.full((50, 9), np.nan)):
        constant = replace(block, acceleration=Block(block.stamp, force))
        pipeline = Pipeline(settings())
        assert pipeline.process(constant).acceleration is None
        assert len(pipeline.channel_names) == 9
    data = imu(START, (0.1, 0.2, 0.3), force=(0.0, 0.0, 0.0))
    assert np.isnan(ImuSource.parse(data, 6)[1][3:]).all()


def test_a_patched_message_has_another_rate_and_force_and_nothing_else():
    data = imu(START, (0.1, 0.2, 0.3), force=(1.0, 2.0, 3.0))
    after = ImuSource.patch(data, (0.4, 0.5, 0.6, 4.0, 5.0, 6.0))
    assert ImuSource.parse(after, 6) == (START, (0.4, 0.5, 0.6, 4.0, 5.0, 6.0))
    assert ImuSource.patch(after, ImuSource.parse(data, 6)[1]) == data


def test_accelerometers_may_be_excluded_and_the_detector_changed_under_way():
    pipeline, (block, _) = Pipeline(settings()), flight(200)
    pipeline.process(block[:100])
    name = "imu_3.accel_y"
    changes = {"excluded_channels": [name], "detector.name": "guaranteed"}
    pipeline.reconfigure(pipeline.config.replaced(changes))
    pipeline.process(block[100:])
    states = {one.name: one.state.name for one in pipeline.status().channels}
    assert [one for one in states if states[one] == "EXCLUDED"] == [name]
    assert pipeline.accelerometers.detector.name == "guaranteed"
    before = pipeline.config
    lost = [f"imu_{k}.accel_x" for k in (1, 2, 3)]
    with pytest.raises(ConfigError, match="leaves no rate"):
        pipeline.reconfigure(before.replaced({"excluded_channels": lost}))
    assert pipeline.config is before


def test_the_state_file_keeps_the_gyros(tmp_path):
    pipeline, (block, _) = Pipeline(settings()), flight(200)
    pipeline.process(block)
    assert len(pipeline.channel_names) == 18
    assert StateFile(tmp_path / "state", 60.0).save(pipeline)
    again = Pipeline(settings())
    assert StateFile(tmp_path / "state", 60.0).restore(again)


def test_an_array_of_gyros_has_no_accelerometers():
    with pytest.raises(ConfigError, match="input is 'channels': expected input 'imus'"):
        Config.from_parameters({"accelerometers.enabled": "on"})
