# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Accelerometers of units and of arrays, judged beside the gyros."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from bag.recordings import array, imu
from monitor.streams import RATE, SIGMA, START, mounted, parallel, struck, told
from monitor.test_receiver import Ear
from vehicles import vehicle, with_forces

from fdi_ros.config.config import Config
from fdi_ros.core.messages import integrity_labels
from fdi_ros.core.sources import ChannelsSource, ImuSource
from fdi_ros.detectors import DETECTORS, detector_class
from fdi_ros.detectors.sequential import Sequential
from fdi_ros.errors import ConfigError, FdiError
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.quantity import FORCE
from fdi_ros.model.samples import Block
from fdi_ros.monitor.output import ChannelState, Reason
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


@pytest.mark.parametrize("seed", range(3))
def test_a_vertical_accelerometer_is_named_where_the_gain_of_its_unit_explains_as_much(
    seed,
):
    """One tenth of gravity, in hover: of an IMU with a wrong gain the vertical accelerometer is wrong as well."""
    block, _ = flight(1500, seed=seed, scale=0.005, size=0.05)
    pipeline = Pipeline(settings())
    pipeline.sense(range(3))
    fault = "channel=imu_2.accel_z kind=bias size=0.98 start=4"
    output = pipeline.process(struck(block, [fault], pipeline.channel_names))
    assert [
        output.channel_names[event.channel]
        for event in output.events
        if event.after.name == "FAULTY"
    ] == ["imu_2.accel_z"]


def doubled(values):
    values[600:, 6:] *= 2.0


def shaken(values):
    size = 0.4 if np.abs(values).max() < 5.0 else 4.0
    swing = np.sin(2 * np.pi * 2.0 * np.arange(len(values) - 600) / RATE)
    values[600:, 6:] += size * np.outer(swing, [0.6, 0.5, 0.6])


def on_one_axis(values):
    values[600:, 8] += 0.5 if np.abs(values).max() < 5.0 else 5.0


@pytest.mark.parametrize(
    ("fault", "is_whole"), [(doubled, True), (shaken, True), (on_one_axis, False)]
)
def test_a_unit_that_fails_in_both_halves_is_reported_as_one(fault, is_whole):
    block, _ = flight(1000)
    for values in (block.z, block.acceleration.z):
        fault(values)
    pipeline = Pipeline(settings())
    pipeline.sense(range(3))
    said = set()
    for begin in range(0, 1000, 10):
        pipeline.process(block[begin : begin + 10])
        said.add(told(pipeline)["monitor"].message)
    words = "imu_3 (gyros and accelerometers) is faulty, as a whole or in part"
    wholly = "imu_3 as a whole is faulty"
    assert any(words in one or wholly in one for one in said) == is_whole
    half = "imu_3 is faulty, as a whole or in part: undecided"
    assert not any(words in one and half in one for one in said)
    assert not any(
        f"imu_{unit}{more}" in one
        for one in said
        for unit in (1, 2)
        for more in (" (gyros", " is faulty", " as a whole")
    )


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


TAKE_OFF, LANDING = 800, 2000  # samples


def rectified(seed, vibration, shift, at_the_end=0.0, length=2400):
    """A flight that shakes all units alike from take-off to landing, and moves every bias while it does, m/s^2.

    ``at_the_end``: what one bias moves by with the landing, and keeps.
    """
    block, _ = flight(length, seed=seed, scale=0.005, bias=0.1, size=0.5)
    rng = np.random.default_rng(seed)
    runs = np.zeros(length)
    runs[TAKE_OFF:LANDING] = 1.0
    runs = np.convolve(runs, np.full(50, 0.02))[:length, None]
    body = np.tile(rng.normal(0, vibration, (length, 3)), 3)
    own = rng.normal(0, 0.1 * vibration, (length, 9)) + rng.normal(0, shift, 9)
    force = block.acceleration.z + runs * (body + own)
    force[LANDING:, 4] += at_the_end
    return replace(block, acceleration=Block(block.stamp, force))


SHAKEN = [(1.0, 0.2), (1.0, 0.3), (5.0, 0.5)]
"""Vibration, and standard deviation of what it moves the biases by, m/s^2."""


def named_in(output):
    return [
        output.channel_names[event.channel]
        for event in output.events
        if event.after == ChannelState.FAULTY
    ]


@pytest.mark.parametrize(
    ("vibration", "shift", "seed"),
    [
        *((size, moved, k) for size, moved in SHAKEN for k in (3, 10, 11)),
        # One bias moves by more than twice what the others do.
        (0.5, 0.3, 15),
        (0.3, 0.2, 3),
        (0.3, 0.2, 15),
    ],
)
def test_no_accelerometer_is_named_where_all_rectify_vibration(vibration, shift, seed):
    output = Pipeline(settings()).process(rectified(seed, vibration, shift))
    assert named_in(output) == []


@pytest.mark.parametrize("seed", [3, 10])
@pytest.mark.parametrize("move", [-0.3, 0.3])
def test_a_bias_that_moves_as_vibration_ends_is_not_named_at_once(seed, move):
    """The flight ends 4 s later. One that stays where it is becomes a fault after 6 to 16 s."""
    output = Pipeline(settings()).process(rectified(seed, 1.0, 0.0, move))
    assert named_in(output) == []


@pytest.mark.parametrize("seed", [3, 10, 11])
def test_a_fault_is_named_where_all_accelerometers_rectify_vibration(seed):
    pipeline = Pipeline(settings())
    pipeline.sense(range(3))
    fault = "channel=imu_2.accel_y kind=bias size=3 start=14"
    block = struck(rectified(seed, 1.0, 0.2), [fault], pipeline.channel_names)
    output = pipeline.process(block)
    assert named_in(output) == ["imu_2.accel_y"]
    first = next(event for event in output.events if event.after == ChannelState.FAULTY)
    assert (first.stamp - START) / 1e9 - 14 < 9.0


@pytest.mark.parametrize(
    ("vibration", "size", "within"), [(2.0, 3.0, 1.0), (5.0, 4.0, 18.0)]
)
def test_a_fault_that_begins_as_vibration_ends_is_named(vibration, size, within):
    """A bias may have moved then, but not for the rest of the flight."""
    pipeline = Pipeline(settings())
    pipeline.sense(range(3))
    block = rectified(3, vibration, 0.0, length=LANDING + 1800)
    fault = f"channel=imu_2.accel_y kind=bias size={size} start={LANDING / 100}"
    output = pipeline.process(struck(block, [fault], pipeline.channel_names))
    assert named_in(output) == ["imu_2.accel_y"]
    first = next(event for event in output.events if event.after == ChannelState.FAULTY)
    assert (first.stamp - START) / 1e9 - LANDING / 100 < within


@pytest.mark.parametrize("rate", [50.0, 100.0])
def test_vibration_that_stays_the_same_does_not_change(rate):
    """At 50 Hz a block is two samples, whose rate is always on a line."""
    axes = np.tile(np.eye(3), (3, 1))
    detector = Sequential(
        Geometry(axes, units=[f"imu_{k // 3}" for k in range(9)]),
        NoiseModel(0.2 / FORCE.natural, scale_std=0.01),
        sample_rate=rate,
        rectified=FORCE.rectified,
    )
    rng = np.random.default_rng(5)
    shaken = rng.normal(0, 3.0, (int(20 * rate), 3)) @ axes.T
    z = (shaken + rng.normal(0, 0.1, shaken.shape)) / FORCE.natural
    for seconds in range(10, 20):
        detector.detect(z[: int(seconds * rate)])
        assert not detector.states[0]["estimator"]["vibration_changes"]


def delays_of(half, units):
    """Delays of the units after the first, s, and their standard deviations."""
    estimate = half.core["sample"]["estimate"][0]
    return estimate["delay"][1:units], np.sqrt(estimate["delay_variance"][1:units])


def test_accelerometers_are_late_as_the_gyros_of_their_units_are():
    """A vehicle that turns and hardly accelerates. The first unit has no accelerometers."""
    block, _ = flight(3000, units=4)
    force = np.tile([0.0, 0.0, GRAVITY], (len(block), 4))
    force += np.random.default_rng(8).normal(0, NOISE, force.shape)
    z = block.z.copy()
    z[1:, 3:6] = block.z[:-1, 3:6]
    z[2:, 9:] = block.z[:-2, 9:]
    received = np.ones(force.shape, dtype=bool)
    received[:, :3] = False
    felt = Block(block.stamp, force, received)
    pipeline = Pipeline(settings(4))
    output = pipeline.process(Block(block.stamp, z, None, felt))
    gyros = delays_of(pipeline, 4)
    accelerometers = delays_of(pipeline.accelerometers, 3)
    assert gyros[0] == pytest.approx([0.01, 0.0, 0.02], abs=0.001)
    assert (gyros[1] < 0.001).all()
    assert accelerometers[1].min() > 0.003
    assert accelerometers[1].max() < 0.0065
    assert (abs(accelerometers[0] - [-0.01, 0.01]) < accelerometers[1]).all()
    assert (output.acceleration.state[500:] == ChannelState.OK).all()


def test_known_lever_arms_are_taken_off():
    block, _ = flight(600, arms=ARMS, size=4.0)

    def residual(**changes):
        output = Pipeline(settings(**changes)).process(block).acceleration
        return np.sqrt((output.residual[100:] ** 2).mean(axis=0)).max()

    corrected = residual(accelerometers__positions=ARMS.ravel().tolist())
    assert corrected < 1.2 * NOISE < 2 * NOISE < residual()


def silent(block):
    received = np.ones(block.z.shape, bool)
    received[300:500] = False
    return replace(block, received=received)


def one_axis_silent(block):
    received = np.ones(block.z.shape, bool)
    received[300:500, [2, 5, 8]] = False
    return replace(block, received=received)


def frozen(block):
    z = block.z.copy()
    z[300:500] = z[300]
    return replace(block, z=z)


def with_holes(block):
    received = np.ones(block.z.shape, bool)
    received[np.arange(len(block)) % 40 < 20] = False
    return replace(block, received=received)


def two_disagree(block):
    z = block.z.copy()
    z[300:, 3:6] += 1.5
    return replace(block, z=z)


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize(
    ("without_rate", "units", "changes"),
    [
        (lambda block: block, 3, {"bias__startup_bias_duration": 3.0}),
        (silent, 3, {}),
        (one_axis_silent, 3, {}),
        (frozen, 3, {}),
        (with_holes, 3, {}),
        (two_disagree, 2, {}),
    ],
    ids=["start-up average", "silent", "axis", "frozen", "holes", "disagreement"],
)
def test_no_accelerometer_is_suspected_where_the_gyros_give_no_sure_rate(
    without_rate, units, changes, known
):
    """Lever arms of 0.1 m in turns of 4 rad/s: 1.6 m/s^2 beside noise of 0.15."""
    if known:
        changes = changes | {"accelerometers__positions": ARMS[:units].ravel()}
    for seed in range(3):
        block, force = flight(700, units, seed=seed, arms=ARMS, size=4.0)
        block = without_rate(block)
        output = Pipeline(settings(units, **changes)).process(block).acceleration
        assert not [event for event in output.events if event.declares]
        assert output.valid.all()
        assert (np.abs(output.rate - force) < output.level).all()
        assert (output.state[:, 3:] == ChannelState.OK).mean() < 0.9


def test_an_accelerometer_at_its_limit_is_out_of_range_also_on_a_lever_arm():
    """Less its lever arm the value lies 2 m/s^2 below the limit."""
    block, _ = flight(700, arms=ARMS, size=4.0)
    limit = 13.0
    block.acceleration.z[300:500, [2, 5, 8]] = limit
    changes = {"accelerometers__max_acceleration": limit}
    positions = {"accelerometers__positions": ARMS.ravel()}
    output = Pipeline(settings(**changes, **positions)).process(block).acceleration
    assert not [event for event in output.events if event.after == ChannelState.FAULTY]
    assert (output.state[300:500, [2, 5, 8]] == ChannelState.SUSPECT).all()


@pytest.mark.parametrize("seed", range(3))
def test_unknown_lever_arms_are_no_faults_and_are_in_the_covariance(seed):
    """Units 0.1 m apart in turns of 6 rad/s: 3.6 m/s^2 beside noise of 0.15."""
    block, force = flight(1500, seed=seed, arms=ARMS, size=6.0, scale=0.005, bias=0.2)
    given = {"accelerometers__scale_std": 0.005, "accelerometers__turn_on_std": 0.2}

    def output(**changes):
        return Pipeline(settings(**given, **changes)).process(block).acceleration

    assert [
        one for one in output(accelerometers__position_std=0.0).events if one.declares
    ]
    allowed = output()
    assert not [one for one in allowed.events if one.declares]
    error = (allowed.rate - force)[200::20]
    inverse = np.linalg.inv(allowed.covariance[200::20])
    assert 0.3 < np.einsum("ki,kij,kj->k", error, inverse, error).mean() / 3 < 1.0
    assert (np.abs(allowed.rate - force) < allowed.level).all()


def test_units_10_cm_apart_are_healthy_in_a_flight_with_turns():
    """Four of them, whose positions are not known; axes, delays and biases are not exact either."""
    one = vehicle(0, "flight with rest", units=4)
    arms = np.array([[0, 0, 0], [0.1, 0, 0], [-0.06, 0.08, 0], [0, -0.06, 0.08]])
    changes = {"accelerometers.noise_std": 0.06, "accelerometers.enabled": "on"}
    output = Pipeline(one.config.replaced(changes)).process(with_forces(one, arms))
    assert not [event for event in output.events if event.declares]


def test_positions_that_are_given_are_known_unless_their_error_is_given():
    given = {"accelerometers__positions": ARMS.ravel().tolist()}
    for changes, expected in (
        ({}, (0.0, 0.05, 0.05)),
        (given, (0.0, 0.0, 0.0)),
        ({"accelerometers__position_std": 0.1}, (0.0, 0.1, 0.1)),
        (given | {"accelerometers__position_std": [0.0, 0.1, 0.3]}, (0.0, 0.1, 0.3)),
    ):
        pipeline = Pipeline(settings(accelerometers__enabled="on", **changes))
        std = 150.0 * pipeline.accelerometers.core["settings"]["position_std"]
        np.testing.assert_allclose(std[0, :9], np.repeat(expected, 3), rtol=1e-12)


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
    # With "auto" they begin at the second sample, beside gyros that have learned from the
    # first one already.
    config = settings(accelerometers__enabled="on")
    ear, offline = Ear(Pipeline(config)), Pipeline(config)
    for unit, data in sent(block):
        ear.take(unit, data)
    read = np.array([ImuSource.parse(data, 6)[1] for data in ear.fused])
    live = ear.receiver.pipeline
    assert live.channel_names == (
        *(f"imu_{k}.{axis}" for k in (1, 2, 3) for axis in "xyz"),
        *(f"imu_{k}.accel_{axis}" for k in (1, 2, 3) for axis in "xyz"),
    )
    force = offline.process(block).acceleration
    assert np.array_equal(read[:, 3:], force.rate[: len(read)])
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


def test_evidence_that_lasts_and_is_too_little_to_declare_leaves_no_channel_ok():
    """A small fault, where the positions of the units are not known."""
    block, _ = flight(1600, seed=3, scale=0.005, arms=ARMS)
    pipeline = Pipeline(settings())
    pipeline.sense(range(3))
    fault = "channel=imu_2.accel_y kind=bias size=0.35 start=6"
    output = pipeline.process(struck(block, [fault], pipeline.channel_names))
    force = output.acceleration
    assert not any(event.declares for event in output.events)
    at_limit = force.statistic > 0.999 * force.threshold
    states = force.state[:, force.channel_names.index("imu_2.accel_y")]
    assert at_limit.sum() > 600
    assert (states[at_limit] == ChannelState.UNCHECKED).mean() > 0.6
    assert (states[~at_limit] == ChannelState.OK).mean() > 0.8
    reasons = {one.reason for one in output.events if one.after.name == "UNCHECKED"}
    assert Reason.DOUBTFUL in reasons
    assert (output.state[:, :9][500:] == ChannelState.OK).all()


@pytest.mark.parametrize("enabled", ["auto", "on"])
def test_the_state_file_keeps_gyros_and_accelerometers(tmp_path, enabled):
    config = settings(accelerometers__enabled=enabled)
    pipeline, (block, _) = Pipeline(config), flight(1000, bias=0.3)
    pipeline.sense(range(3))
    fault = "channel=imu_2.accel_y kind=bias size=3 start=4"
    block = struck(block, [fault], pipeline.channel_names)
    pipeline.process(block[:900])
    file = StateFile(tmp_path / "state", 60.0)
    assert file.save(pipeline)
    assert not file.save(pipeline)
    again = Pipeline(config)
    kept = StateFile(tmp_path / "state", 60.0)
    assert kept.restore(again)
    assert "imu_2.accel_y FAULTY" in kept.words
    output = again.process(block[900:])
    place = output.channel_names.index("imu_2.accel_y")
    assert (output.state[:, place] == ChannelState.FAULTY).all()
    assert not (np.delete(output.state, place, axis=1) == ChannelState.FAULTY).any()
    before, after = (
        one.accelerometers.guard.states[0]["estimator"]["states"]["x"][:9]
        for one in (pipeline, again)
    )
    np.testing.assert_allclose(after, before, atol=0.1 / 150)
    # Another monitor has other accelerometers.
    other = Pipeline(settings(accelerometers__enabled="off"))
    assert not StateFile(tmp_path / "state", 60.0).restore(other)


def test_live_a_unit_without_accelerations_leaves_those_of_the_others_in_place():
    ear, (block, force) = Ear(Pipeline(settings())), flight(100)
    for unit, data in sent(block, absent=(1,)):
        ear.take(unit, data)
    last = np.array(ImuSource.parse(ear.fused[-1], 6)[1][3:])
    assert np.abs(last - force[-len(force) + len(ear.fused) - 1]).max() < 1.0
    assert len(ear.receiver.pipeline.channel_names) == 9 + 6


# An array of accelerometers
# ------------------------------------------------------------------------------------------------------


C, S = 1 / np.sqrt(3), np.sqrt(2 / 3) / 2
H = S * np.sqrt(3)
CONE = np.array(
    [[-C, -2 * S, 0], [C, S, -H], [-C, S, H], [C, -2 * S, 0], [-C, S, -H], [C, S, H]]
)
"""Sensitivity axes of six channels on the cone of the paper on guaranteed bounds."""
FIVE = Geometry.cone(5).axes


def array_settings(gyros=CONE, **changes):
    """Settings of a unit of gyros with these axes (n, 3) and of as many accelerometers."""
    given = {
        "channels__acceleration_topic": "accelerations",
        "accelerometers__noise_std": NOISE,
    }
    return mounted(gyros, **given | changes)


def array_flight(samples, gyros=CONE, forces=CONE, seed=0):
    """Samples of gyros and accelerometers with these axes, and the true specific force.

    Errors of the accelerometers are within four standard deviations.
    """
    block, force = flight(samples, seed=seed)
    rng = np.random.default_rng(seed + 1)
    omega = block.z[:, :3]
    z = omega @ gyros.T + rng.normal(0, SIGMA, (samples, len(gyros)))
    error = rng.normal(0, NOISE, (samples, len(forces)))
    felt = force @ forces.T + np.clip(error, -4 * NOISE, 4 * NOISE)
    return Block(block.stamp, z, None, Block(block.stamp, felt)), force


def arrays(block):
    """The messages of a block: topic, and bytes; accelerations come before the rates of their sample."""
    for rates, forces in zip(block.z, block.acceleration.z, strict=True):
        yield 1, array(forces.tolist())
        yield 0, array(rates.tolist())


def test_of_six_accelerometers_on_a_cone_two_simultaneous_faults_are_guaranteed():
    pipeline, (block, _) = (
        Pipeline(array_settings(detector="guaranteed")),
        array_flight(150),
    )
    for pair in combinations(range(6, 12), 2):
        pipeline.restart()
        names = [pipeline.channel_names[i] for i in pair]
        faults = [
            f"channel={name} kind=bias size={size} start=1"
            for name, size in zip(names, (20, -50), strict=True)
        ]
        output = pipeline.process(struck(block, faults, pipeline.channel_names))
        declared = [event for event in output.events if event.declares]
        assert [event.channel for event in declared] == list(pair)
        assert {event.after.name for event in declared} == {"FAULTY"}
        assert [event.error for event in declared] == pytest.approx([20, -50], abs=2.74)
        assert {event.row for event in declared} == {103}  # the fourth alarm


def test_the_worked_example_of_the_paper_holds_for_accelerometers():
    z = np.tile([-393.04, 1055.35, -562.73, -593.11, 1254.79, -761.19], (12, 1))
    z[4:] += [0, 20, -50, 0, 0, 0]
    known = ("turn_on_std", "scale_std", "bias_walk")
    pipeline = Pipeline(
        array_settings(
            detector="guaranteed",
            accelerometers__max_acceleration=1e4,
            **{f"accelerometers__{name}": 0.0 for name in known},
            accelerometers__noise_std=0.25,  # a bound of 1 m/s^2
        )
    )
    stamp = START + np.arange(12) * 10_000_000
    still = np.random.default_rng(0).normal(0, SIGMA, z.shape)
    output = pipeline.process(Block(stamp, still, None, Block(stamp, z)))
    found = {
        output.channel_names[event.channel]: (event.after.name, round(event.error, 2))
        for event in output.events
        if event.declares
    }
    assert found == {"a2": ("FAULTY", 20.89), "a3": ("FAULTY", -51.35)}


@pytest.mark.parametrize("name", sorted(DETECTORS))
def test_every_detector_judges_accelerometers_as_gyros(name):
    """A bias of 0.2 rad/s, and one of 30 m/s^2, which is 150 times as large in noise that is, too."""
    axes = FIVE if detector_class(name).refuses(6) else CONE
    known = ("turn_on_std", "scale_std", "bias_walk")
    pipeline = Pipeline(
        array_settings(
            axes,
            detector=name,
            noise__noise_std=NOISE / 150,
            noise__bias_walk=0.0,
            noise__nonlinearity_std=0.0,
            bias__turn_on_std=0.0,
            bias__max_drift=5.0 / 150,
            **{f"accelerometers__{key}": 0.0 for key in known},
        )
    )
    block, _ = array_flight(300)
    rng = np.random.default_rng(3)
    felt = rng.normal(0, 20, 3) @ axes.T + rng.normal(0, NOISE, (300, len(axes)))
    felt[150:, 2] += 30.0
    output = pipeline.process(
        Block(block.stamp, felt / 150, None, Block(block.stamp, felt))
    )
    gyros, accelerometers = np.split(output.state, 2, axis=1)
    assert np.array_equal(gyros, accelerometers)
    assert accelerometers[-1, 2] in (ChannelState.FAULTY, ChannelState.AMBIGUOUS)


def test_an_array_of_accelerometers_has_axes_of_its_own():
    changes = {"accelerometers__axes": FIVE.ravel().tolist()}
    block, force = array_flight(300, forces=FIVE)
    output = Pipeline(array_settings(**changes)).process(block)
    assert output.channel_names[6:] == ("a1", "a2", "a3", "a4", "a5")
    error = output.acceleration.rate[50:] - force[50:]
    assert np.abs(error).max() < 1.0
    assert (np.abs(error) < output.acceleration.level[50:]).all()
    with pytest.raises(ConfigError, match="accelerations have shape"):
        Pipeline(array_settings(**changes)).process(array_flight(3)[0])


def test_arrays_message_by_message_equal_the_block():
    pipeline = Pipeline(array_settings())
    block, _ = array_flight(300)
    fault = "channel=a4 kind=bias size=5 start=2"
    block = struck(block, [fault], pipeline.channel_names)
    ear, offline = Ear(pipeline), Pipeline(array_settings())
    for k, (topic, data) in enumerate(arrays(block)):
        ear.take(topic, data, int(block.stamp[k // 2]))
    output = offline.process(block)
    read = np.array([ImuSource.parse(data, 6)[1] for data in ear.fused])
    np.testing.assert_allclose(
        read[:, 3:], output.acceleration.rate, rtol=0, atol=1e-12
    )
    assert ear.events == list(output.events)
    assert "a4" in {
        ear.receiver.pipeline.channel_names[one.channel] for one in ear.events
    }


def test_a_sample_takes_the_accelerations_since_the_sample_before_and_none_twice():
    ear, (block, _) = Ear(Pipeline(array_settings())), array_flight(6)
    sample = ear.receiver.live["sample"][0]
    for k, count in enumerate((1, 0, 2, 1, 0, 0)):
        expected = np.full(6, np.nan)
        for extra in range(count):
            expected = block.acceleration.z[k] + extra
            ear.take(1, array(expected.tolist()))
        ear.take(0, array(block.z[k].tolist()), int(block.stamp[k]))
        assert np.array_equal(sample["force"][:6], expected, equal_nan=True)
        assert sample["felt"][:6].tolist() == [count > 0] * 6
    short = array([1.0] * 5)
    ear.take(1, short)
    assert ear.receiver.counts(1) == {"malformed": 1}
    ear.receiver.refused(1, short)
    assert ear.receiver.errors == ["", "array has 5 values, expected 6"]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"accelerometers.enabled": "on"}, "without channels.acceleration_topic"),
        ({"channels.acceleration_topic": "gyro_channels"}, "expected two topics"),
        ({"channels.acceleration_topic": "a b"}, "is no ROS name"),
        (
            {"accelerometers.axes": [1.0, 0.0, 0.0] * 3},
            "accelerometers: 3 channels, expected 4 to 12",
        ),
        ({"accelerometers.axes": [1.0, 0.0]}, "expected 3 per accelerometer"),
        ({"accelerometers.noise_std": [0.1, 0.2]}, "expected 1 or 6"),
        ({"accelerometers.positions": [0.1] * 3}, "expected 0 or 18"),
        ({"excluded_channels": ["a7"]}, "expected some of: g1"),
        (
            {"input": "imus", "imus.topics": ["a", "b"]},
            "is given, but input is 'imus'",
        ),
    ],
)
def test_settings_of_accelerometers_that_do_not_fit_are_refused(changes, words):
    topic = (
        {}
        if "accelerometers.enabled" in changes
        else {"channels.acceleration_topic": "acc"}
    )
    with pytest.raises(FdiError, match=words):
        Pipeline(Config.from_parameters(topic | changes))
