# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Accelerometers in flights of ArduPilot's simulation, whose faults are known, and in a bag with injected ones."""

from pathlib import Path

import numpy as np
import pytest
from bag.recordings import ARRAY, array, imu, write_bag
from monitor.test_accelerometers import (
    array_flight,
    array_settings,
    arrays,
    flight,
    settings,
)

from fdi_ros.bag.reader import Recording
from fdi_ros.bag.samples import read_block
from fdi_ros.replay.outputs import OutputBag
from fdi_ros.replay.run import assumed_config, replay
from fdi_ros.replay.words import summary_text

SITL = Path(__file__).parents[3] / "shared" / "data" / "sitl"
LOGS = SITL.parent / "logs"
SOLO = LOGS / "solo_log171_start.bin"
BEGINS = 55.13  # clock of the autopilot at the first message, s
TOLD = 1.0  # a fault is told of for so long after its end, s
in_sitl = pytest.mark.skipif(
    not SITL.is_dir(), reason=f"needs the recordings in {SITL}"
)
in_logs = pytest.mark.skipif(
    not LOGS.is_dir(), reason=f"needs the recordings in {LOGS}"
)


@in_sitl
@pytest.mark.parametrize("position_std", [[0.0], []])
def test_every_fault_of_the_simulated_flight_is_named_or_held_in_a_set_and_none_wrong(
    position_std,
):
    """Its units are at one place, which may not be known."""
    rows = np.genfromtxt(SITL / "accel_faults.txt", dtype=str)
    faults = [
        (float(on) - BEGINS, float(off) - BEGINS, f"imu_{int(unit)}.accel_{axis}")
        for on, off, unit, axis, kind, _ in rows
        if kind != "noise_times"
        for axis in axis.lower()
    ]
    path = SITL / "accel_faults.tlog"
    known = {"accelerometers.position_std": position_std}
    summary = replay(path, assumed_config(path).config.replaced(known))
    named = [one for one in summary.story.episodes if one.state == "FAULTY"]
    for one in summary.story.episodes:
        assert one.measured_in == "m/s^2"
        active = {name for on, off, name in faults if on <= one.start_s <= off + TOLD}
        assert active & one.ever
        assert one.state != "FAULTY" or set(one.channels) <= active
    assert len({one.channels for one in named}) >= 6
    # A scale factor that is off by 5 % is 0.5 m/s^2 under gravity.
    assert {"imu_3.accel_z"} in [set(one.channels) for one in named]
    # The others have moved by more than their noise 0.7 s after a unit has frozen.
    (frozen,) = (float(row[0]) - BEGINS for row in rows if row[4] == "no_new_samples")
    held = next(one for one in summary.story.episodes if one.start_s > frozen)
    assert (held.state, len(held.channels)) == ("AMBIGUOUS", 3)
    assert held.start_s - frozen < 0.8
    # Noise five times as large declares nothing, and is reported.
    (noise,) = (one for one in summary.concerns if "had noise" in str(one))
    assert str(noise).startswith("imu_1.accel had noise ")
    assert {on for on, _, _ in faults} <= {
        max(on for on, _, _ in faults if on <= one.start_s)
        for one in summary.story.episodes
    }


@in_logs
def test_vibration_that_one_accelerometer_rectifies_at_take_off_declares_nothing():
    """For three seconds its noise is ten times as large, and its mean off by 2.5 m/s^2."""
    summary = replay(SOLO)
    assert not summary.story.episodes
    channels = {one.name: one for one in summary.monitor.channels}
    assert channels["imu_2.accel_z"].checked > 0.9


@in_logs
@pytest.mark.parametrize(
    ("log", "channel", "start", "size"),
    [
        ("quad_20mm_cut_straight", "imu_3.accel_y", 52, 0.5),
        ("quad_5mm_cut_hover", "imu_1.accel_y", 37, 0.5),
        ("quad_25mm_cut_hover", "imu_2.accel_y", 39, 0.3),
    ],
)
def test_a_bias_is_named_in_hover_that_shakes_units_whose_positions_are_not_known(
    log, channel, start, size
):
    """What the turns to and fro add by 5 cm is as large, and leaves little in a mean."""
    fault = f"channel={channel} kind=bias size={size} start={start}"
    summary = replay(LOGS / f"{log}.bin", None, [fault])
    (outcome,) = summary.scores.faults
    assert (outcome.outcome, outcome.channels) == ("named", (channel,))
    assert outcome.isolation_delay_s < 10.0


@in_sitl
def test_nothing_is_declared_in_a_healthy_simulated_flight_with_vibration():
    summary = replay(SITL / "accel_healthy_vibration.tlog")
    assert summary.verdict.word == "HEALTHY"
    assert len(summary.monitor.channels) == 18
    assert all(one.checked > 0.9 for one in summary.monitor.channels)


def recorded(path, stamp, rates, forces, units=3):
    """Write rates and forces (N, 3 * units) of some units to a bag."""
    messages = [
        (topic, stamp + 1000 * k, imu(stamp, rate, force=tuple(force)))
        for stamp, all_rates, all_forces in zip(
            stamp.tolist(), rates, forces, strict=True
        )
        for k, (topic, rate, force) in enumerate(
            zip(
                settings(units).topics,
                np.split(all_rates, units),
                np.split(all_forces, units),
                strict=True,
            )
        )
    ]
    return write_bag(path, messages)


def with_wrong_range(rates, forces):
    for values in (rates, forces):
        values[600:, 6:] *= 2.0


def turned(rates, forces):
    for values in (rates, forces):
        values[600:, 6:] = values[600:, [7, 6, 8]]


def frozen(rates, forces):
    for values in (rates, forces):
        values[600:, 6:] = values[600, 6:]


def wrong_about_one_axis_each(rates, forces):
    rates[600:, 8] += 0.5
    forces[600:, 8] += 5.0


@pytest.mark.parametrize(
    ("fault", "count"),
    [
        (with_wrong_range, 1),
        (turned, 1),
        (frozen, 1),
        (wrong_about_one_axis_each, 2),
    ],
)
def test_a_fault_of_a_unit_is_one_episode_of_gyros_and_accelerometers(
    fault, count, tmp_path
):
    block, _ = flight(1400)
    rates = block.z.copy()
    forces = block.acceleration.z.copy()
    fault(rates, forces)
    path = recorded(tmp_path / "flight", block.stamp, rates, forces)
    summary = replay(path, settings())
    assert len(summary.story.episodes) == count
    assert ("imu_3 (gyros and accelerometers)" in summary.verdict.sentence) == (
        count == 1
    )
    faults, _, advice = summary.verdict.sentence.partition(" Do not fly ")
    assert faults.count("imu_3") == count
    assert advice == "before imu_3 is checked or replaced."
    assert all(name.startswith("imu_3.") for name in summary.verdict.channels)
    assert "m/s^2" in summary_text(summary)


@pytest.mark.parametrize("in_both", [True, False])
@pytest.mark.parametrize("hertz", [2.0, 6.0])
@pytest.mark.parametrize(("units", "seed"), [(2, 0), (2, 1), (3, 1)])
def test_a_loose_unit_is_one_episode_that_names_no_other(
    units, hertz, in_both, seed, tmp_path
):
    """It oscillates in its mounting, and both of its halves or its gyros alone feel that."""
    block, _ = flight(1800, units=units, seed=seed)
    rates = block.z.copy()
    forces = block.acceleration.z.copy()
    axes = np.random.default_rng(seed).standard_normal((2, 3))
    about, along = axes / np.linalg.norm(axes, axis=1)[:, np.newaxis]
    phase = 2 * np.pi * hertz * np.arange(1200) / 100.0
    rates[600:, -3:] += np.outer(0.4 * np.sin(phase), about)
    if in_both:
        forces[600:, -3:] += np.outer(4.0 * np.sin(phase + 0.7), along)
    path = recorded(tmp_path / "flight", block.stamp, rates, forces, units)
    summary = replay(path, settings(units))
    if (units, hertz, seed) == (2, 6.0, 0):
        # The monitor suspects it and declares nothing.
        assert summary.verdict.word == "LOOK"
        return
    (one,) = summary.story.episodes
    assert {step.state for step in one.steps} == {"AMBIGUOUS"}
    loose = {"imu_1", "imu_2"} if units == 2 else {"imu_3"}
    assert {name.partition(".")[0] for name in one.channels} == loose
    assert 6.0 <= one.start_s < 6.2
    assert bool(one.halves) == (hertz == 2.0 and in_both)
    sentence = summary.verdict.sentence
    if hertz == 2.0:
        assert "times, as the error of a loose unit does." in sentence
    if units == 3:
        assert "before imu_3 is checked for a loose mounting or replaced." in sentence
        assert "imu_1" not in sentence
        assert "imu_2" not in sentence


def test_a_fault_injected_into_an_accelerometer_is_told_of_in_its_unit(tmp_path):
    block, _ = flight(800)
    config = settings()
    path = recorded(tmp_path / "flight", block.stamp, block.z, block.acceleration.z)
    fault = "channel=imu_2.accel_z kind=bias size=2 start=4"
    summary = replay(path, config, [fault])
    (outcome,) = summary.scores.faults
    assert (outcome.outcome, outcome.channels) == ("named", ("imu_2.accel_z",))
    text = summary_text(summary)
    assert "2 m/s^2" in text
    assert "fused specific force: " in text
    (episode,) = summary.story.episodes
    assert "m/s^2" in episode.words
    assert "rad/s" not in episode.words
    lost = replay(path, config, ["channel=imu_3 kind=triad_loss start=4"])
    assert len(lost.scores.faults[0].channels) == 6
    (silent,) = lost.story.episodes
    assert (silent.who, len(silent.channels)) == ("imu_3", 6)


def test_arrays_of_a_recording_are_judged_as_their_block_is(tmp_path):
    block, _ = array_flight(800)
    config = array_settings()
    topics = ("gyro_channels", "accelerations")
    messages = [
        (topics[topic], int(block.stamp[k // 2]) - 1000 * topic, data)
        for k, (topic, data) in enumerate(arrays(block))
    ]
    types = dict.fromkeys(topics, ARRAY)
    path = write_bag(tmp_path / "flight", messages, types=types)
    fault = "channel=a3 kind=bias size=2 start=4"
    with OutputBag(tmp_path / "output", config) as out:
        summary = replay(path, config, [fault], sinks=[out])
    (outcome,) = summary.scores.faults
    assert (outcome.outcome, outcome.channels) == ("named", ("a3",))
    (episode,) = summary.story.episodes
    assert (episode.measured_in, episode.channels) == ("m/s^2", ("a3",))
    read = read_block(path, config)
    np.testing.assert_array_equal(read.z, block.z)
    np.testing.assert_array_equal(read.acceleration.z, block.acceleration.z)
    assert read.acceleration.delivered.all()
    with Recording(tmp_path / "output") as recording:
        assert set(topics) <= {topic.name.lstrip("/") for topic in recording.topics}


def test_a_sample_of_a_recording_takes_the_accelerations_since_the_sample_before(
    tmp_path,
):
    """In whatever blocks the recording is read: 20 000 samples are several."""
    block, _ = array_flight(20_000)
    rng = np.random.default_rng(0)
    counts = rng.integers(0, 3, len(block))
    messages = []
    expected = np.full(block.acceleration.z.shape, np.nan)
    for k, stamp in enumerate(block.stamp.tolist()):
        for j in range(counts[k]):
            expected[k] = block.acceleration.z[k] + j
            at = stamp - 2000 + 1000 * j
            messages.append(("accelerations", at, array(expected[k].tolist())))
        messages.append(("gyro_channels", stamp, array(block.z[k].tolist())))
    types = dict.fromkeys(("gyro_channels", "accelerations"), ARRAY)
    path = write_bag(tmp_path / "flight", messages, types=types)
    read = read_block(path, array_settings())
    np.testing.assert_array_equal(read.acceleration.z, expected)
    np.testing.assert_array_equal(
        read.acceleration.delivered, np.repeat(counts[:, np.newaxis] > 0, 6, axis=1)
    )
