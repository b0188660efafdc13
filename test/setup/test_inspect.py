# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What inspection says of a recording is what was put into it."""

import json

import numpy as np
import pytest
from bag.recordings import (
    ARRAY,
    START,
    STEP,
    TOPICS,
    array,
    flight,
    imu,
    imu_messages,
    write_mcap,
)

from fdi_ros.bag.samples import read_block
from fdi_ros.config.config import Config
from fdi_ros.inspection.fitness import NEEDED, candidates, message_findings, needs
from fdi_ros.inspection.starting_config import starting_config, starting_config_of
from fdi_ros.inspection.topics import inspect, recording_text, topics_text
from fdi_ros.monitor.pipeline import Pipeline


def test_rates_gaps_and_noise_are_found(tmp_path):
    messages, _ = flight(2000)
    gap = range(START + 500 * STEP, START + 540 * STEP)
    kept = [m for m in messages if m[0] == TOPICS[0] or m[1] not in gap]
    reports, damage, *_ = inspect(write_mcap(tmp_path / "bag.mcap", kept))
    first, second = reports
    assert damage == ()
    assert (first.received, first.gaps, second.received, second.gaps) == (
        2000,
        0,
        1960,
        1,
    )
    assert first.rate == pytest.approx(100)
    assert second.longest == pytest.approx(0.41, abs=1e-6)
    np.testing.assert_allclose(
        [one.segments.noise().quiet for one in reports], 0.002, rtol=0.15
    )
    assert first.largest == pytest.approx(1.4, abs=0.2)


@pytest.mark.parametrize("every", [41, 100, 330])
def test_spikes_are_counted_and_are_no_noise(every, tmp_path):
    """One channel has spikes of 0.3 to 5 rad/s of either sign, and noise of 0.002."""
    messages, z = flight(6000)
    struck = np.arange(30, 5990, every)
    random = np.random.default_rng(1)
    size = random.uniform(0.3, 5.0, len(struck)) * random.choice([-1, 1], len(struck))
    z[struck, 1] += size
    spiky = imu_messages(START + STEP * np.arange(len(z)), z, apart=1000)
    clean, _ = inspect(write_mcap(tmp_path / "clean.mcap", messages))[0]
    found, other = inspect(write_mcap(tmp_path / "spiky.mcap", spiky))[0]
    for was, noise in zip(clean.segments.noise(), found.segments.noise(), strict=True):
        np.testing.assert_allclose(noise, was, rtol=0.04)
    assert found.segments.spikes.tolist() == [0, len(struck), 0]
    assert not other.segments.spikes.any()


@pytest.mark.parametrize(
    ("stuck", "words"),
    [
        ([4], "/imu_2/data_raw y repeats one value"),
        ([3, 4, 5], "/imu_2/data_raw repeats"),
    ],
)
def test_the_channels_that_repeat_one_value_are_named(stuck, words, tmp_path, fdi):
    _, z = flight(1000)
    z[500:, stuck] = z[500, stuck]
    messages = imu_messages(START + STEP * np.arange(len(z)), z)
    assert words in fdi("inspect", write_mcap(tmp_path / "bag.mcap", messages)).out


def test_the_noise_of_accelerometers_is_found_where_there_are_any(tmp_path, fdi):
    """The second unit has none: its messages say so, or have zeros."""
    random = np.random.default_rng(0)
    noise = np.array([0.05, 0.1, 0.3])
    messages = []
    for k in range(2000):
        at = START + k * STEP
        force = tuple(np.array([0.0, 0.0, 9.81]) + noise * random.normal(size=3))
        absent = None if k % 2 else (0.0, 0.0, 0.0)
        for topic, felt in zip(TOPICS, (force, absent), strict=True):
            rate = random.normal(0.0, 0.01, 3)
            messages.append((topic, at, imu(at, rate, force=felt)))
    path = write_mcap(tmp_path / "bag.mcap", messages)
    first, second = inspect(path)[0]
    np.testing.assert_allclose(first.force_noise.quiet, noise, rtol=0.1)
    assert first.force_noise.share == 0.0
    assert second.force_noise is None
    said = fdi("inspect", path).out
    assert "3 accelerometers, noise 0.05 to 0.3 m/s^2" in said
    assert said.count("accelerometers") == 1
    figures = tmp_path / "figures.json"
    assert fdi("inspect", path, "--json", figures).code == 0
    topics = json.loads(figures.read_text())["topics"]
    found = [one.get("accelerometer_quiet_noise") for one in topics]
    np.testing.assert_allclose(found[0], noise, rtol=0.1)
    assert found[1] is None


def test_what_could_be_gyros_and_what_could_not(tmp_path):
    random = np.random.default_rng(0)
    messages = []
    for k in range(200):
        at = START + k * STEP
        messages += [
            ("/six", at, array(list(random.normal(0, 0.01, 6)))),
            ("/three", at, array([1.0, 2.0, 3.0])),
        ]
        messages += [("/imu", at, imu(at, random.normal(0, 0.01, 3)))]
    types = {"/six": ARRAY, "/three": ARRAY}
    reports, *_ = inspect(write_mcap(tmp_path / "bag.mcap", messages, types=types))
    assert {report.topic.name for report in reports if report.could_be_gyros} == {
        "/six",
        "/imu",
    }
    (chosen,) = candidates(reports)
    assert chosen.topic.name == "/six"
    settings = starting_config([chosen], tmp_path).parameters
    assert (settings["channels.topic"], settings["geometry.cone_channels"]) == (
        "/six",
        6,
    )
    assert settings["noise.noise_std"][0] == pytest.approx(0.01, rel=0.3)


def test_malformed_messages_and_stamps_that_go_back_are_said(tmp_path):
    messages, _ = flight(100)
    messages[40] = (messages[40][0], messages[40][1], messages[40][2][:50])
    messages[60] = (messages[60][0], messages[60][1], imu(START, (0.0, 0.0, 0.0)))
    # One value again and again, on the one topic for long: in chunks that end anywhere.
    for k in range(200):
        rate = (0.5, 0.01 * k, 0.5) if k < 150 else (0.01 * k, 0.01 * k, 0.5)
        messages += [
            (TOPICS[0], messages[-1][1] + STEP, imu(messages[-1][1] + STEP, rate))
        ]
    reports, damage, *_ = inspect(write_mcap(tmp_path / "bag.mcap", messages))
    assert [report.repeats.count.tolist() for report in reports] == [
        [150, 0, 200],
        [0, 0, 0],
    ]
    text = topics_text(reports, damage)
    assert "one value for 1 s or more: x in 150 and z in 200 messages" in text
    assert "1 malformed" in text
    # It does not contradict the column "noise in motion".
    assert "rotation and slow shaking are no noise" in text
    assert "1 stamp does not increase" in " ".join(text.split())


def test_a_unit_that_repeats_its_stamps_is_worth_a_look(tmp_path, fdi):
    """Of two messages with one stamp the second one is not used."""
    _, z = flight(1000)
    stamp = START + STEP * np.arange(len(z))
    messages = imu_messages(stamp, z)
    struck = [k for k, (topic, _, _) in enumerate(messages) if topic == TOPICS[1]][7::7]
    for k in struck:
        topic, at, _ = messages[k]
        messages[k] = (topic, at, imu(at - STEP, tuple(z[k // 2, 3:])))
    first = fdi("inspect", write_mcap(tmp_path / "bag.mcap", messages)).out
    words, _, advice = first.splitlines()[0].partition(" What to do: ")
    assert words.startswith(
        f"READY, BUT LOOK: {TOPICS[1]} repeats old stamps in 14 % of its messages: these are"
        " not used"
    )
    assert advice == (
        f"check the driver of {TOPICS[1]}: every message needs the time of its measurement;"
        " use `fdi setup`, because `fdi inspect` does not measure mounts"
    )
    assert " is turned by " in words


@pytest.mark.parametrize("which", ["flight", "recording"])
def test_the_config_for_a_real_recording_is_one_that_the_monitor_takes(
    which, request, tmp_path
):
    path = request.getfixturevalue(which)
    chosen = candidates(inspect(path)[0])
    (tmp_path / "start.yaml").write_text(starting_config(chosen, path).text)
    config = Config.from_file(tmp_path / "start.yaml")
    assert config.sample_rate == pytest.approx(100 if which == "flight" else 62.5)
    assert config.bias.startup_bias_duration == 3
    assert Pipeline.from_config(config).geometry.n == 3 * len(config.imus.topics)
    assert config.decision.latch


def test_after_a_fault_of_a_flight_log_the_next_one_can_be_named(root):
    assert (
        starting_config_of(root / "bags" / "copter_crash.tlog", "refused").parameters[
            "decision.latch"
        ]
        is False
    )


def test_noise_in_motion_is_told_apart_from_that_at_rest_of_each_unit_and_written_where_it_mostly_moves(
    tmp_path,
):
    k = np.arange(3000)[:, None]
    # Vibration just below half the rate, twice as large on y; and turns that are no noise.
    shake = (
        0.05
        * np.sqrt(2)
        * np.cos(2 * np.pi * 47 * k * 0.01 + np.array([0, 1, 2]))
        * [1, 2, 1]
    )
    turn = np.array([1.0, 0.5, 0.3]) * np.sin(2 * np.pi * 0.4 * k * 0.01)
    z = np.tile((k >= 800) * (shake + turn), 2)
    z += np.random.default_rng(1).normal(0, [0.002] * 3 + [0.004] * 3, (3000, 6))
    z[5, 0] = np.nan
    messages = imu_messages(START + STEP * k[:, 0], z)
    reports, damage, *_ = inspect(write_mcap(tmp_path / "bag.mcap", messages))
    for report, quiet in zip(reports, (0.002, 0.004), strict=True):
        np.testing.assert_allclose(report.segments.noise().quiet, quiet, rtol=0.2)
        np.testing.assert_allclose(
            report.segments.noise().moving, [0.05, 0.1, 0.05], rtol=0.1
        )
        assert report.segments.noise().share == pytest.approx(22 / 30, abs=0.04)
    assert "not finite: x in 1 message" in topics_text(reports, damage)
    assert [report.not_finite.tolist() for report in reports] == [[1, 0, 0], [0, 0, 0]]
    assert recording_text(reports, tmp_path / "bag.mcap").startswith(
        "bag.mcap: 30.0 s from "
    )
    settings = starting_config(candidates(reports), tmp_path).parameters
    np.testing.assert_allclose(
        settings["noise.noise_std"], [0.05, 0.1, 0.05] * 2, rtol=0.15
    )
    assert settings["bias.startup_bias_duration"] == 3
    assert "imus.timeout" not in settings


@pytest.mark.parametrize("second", [np.s_[:0], np.s_[1000:]])
def test_units_that_repeat_their_values_for_a_while_keep_their_noise(
    second, tmp_path, fdi, recwarn
):
    z = np.random.default_rng(4).normal(0, 0.002, (2000, 6))
    z[:1000, :3], z[second, 3:] = 0.123, 0.05
    write_mcap(
        bag := tmp_path / "bag.mcap", imu_messages(START + STEP * np.arange(2000), z)
    )
    parameters = starting_config_of(bag, "refused").parameters
    np.testing.assert_allclose(parameters["noise.noise_std"], 0.002, rtol=0.15)
    for topic in inspect(bag)[0]:
        moving = topic.segments.noise().moving
        assert np.isnan(moving).all() or set(moving) == {0.0}
    code, _, err = fdi("setup", bag, "--output", tmp_path / "found.yaml", "--quiet")
    # A unit that stands for half of a recording in which the other moves is not to be used.
    assert (code, err, list(recwarn)) == (4 if second.start else 3, "", [])
    assert Config.from_file(tmp_path / "found.yaml").noise.noise_std
    if second.start:
        # Where one stands as the other moves, nothing checks either.
        _, out, _ = fdi("replay", bag, "--config", tmp_path / "found.yaml")
        assert out.startswith("CANNOT TELL")
        assert "repeats old values" in out


def test_slow_units_get_a_timeout_that_lets_them_be_aligned(tmp_path):
    random = np.random.default_rng(2)
    starts = [START + k * 4 * STEP for k in range(200)]
    # The two units sample 15 ms apart: without a line between two messages no sample has both.
    messages = [
        (topic, at + lag, imu(at + lag, random.normal(0, 0.002, 3)))
        for at in starts
        for topic, lag in zip(TOPICS, (0, 15_000_000), strict=True)
    ]
    path = write_mcap(tmp_path / "bag.mcap", messages)
    (tmp_path / "start.yaml").write_text(starting_config_of(path, "refused").text)
    config = Config.from_file(tmp_path / "start.yaml")
    assert 0.16 <= config.imus.timeout <= 0.25
    assert np.isfinite(read_block(path, config).z).all(axis=1).mean() > 0.95


def test_why_there_is_no_config_is_said_of_each_topic(tmp_path, fdi, refused):
    values = {"/nan": np.nan, "/huge": 1e308, "/a b": 0.0, "/good": 0.0, "/fused": 0.0}
    messages = [
        (name, START + k * STEP, imu(START + k * STEP, (x,) * 3))
        for k in range(20)
        for name, x in values.items()
    ]
    messages += [("/equal", START, imu(START, (0.0,) * 3))] * 3 + [
        ("/one", START, imu(START, (0.0,) * 3))
    ]
    messages += [("/cut", START + k, b"") for k in range(3)]
    path = write_mcap(
        tmp_path / "bag.mcap", sorted(messages, key=lambda message: message[1])
    )
    shown = fdi("inspect", path).out
    assert shown.count("3 gyros, none with a rate") >= 2
    all_of_them = "x in 20, y in 20 and z in 20 messages\n"
    assert f"note: /nan: not finite: {all_of_them}" in shown
    assert f"note: /huge: beyond 1000000 rad/s: {all_of_them}" in shown
    made = tmp_path / "c.yaml"
    code, _, said = fdi("inspect", path, "--write", made, "--json", tmp_path / "j")
    assert (code, said.count("\n")) == (2, 1)
    assert f"{made} is not written: bag.mcap NEEDS {NEEDED}" in said
    for words in (
        "usable: only /good",
        "/nan: no message in which all values are finite and below 1000000 rad/s",
        "/huge: no message in which all values",
        "/a b: no name that ROS allows",
        "/fused: a monitor has published it",
        "/equal: its times of recording do not increase",
        "/one: a single message",
        "/cut: all 3 messages are malformed",
    ):
        assert f"; {words}" in said
    written = json.loads((tmp_path / "j").read_text())
    assert written["verdict"]["words"] == f"NEEDS {written['findings'][0]['words']}"
    figures = {topic["name"]: topic for topic in written["topics"]}
    assert (figures["/huge"]["not_finite"], figures["/huge"]["beyond_all_rates"]) == (
        [0] * 3,
        [20] * 3,
    )
    assert figures["/nan"]["largest"] is None
    error = refused("setup", path, "--output", made)
    assert f"has no gyros for a monitor: needs {NEEDED}" in error
    assert "/nan (sensor_msgs/msg/Imu, 20 messages)" in error
    assert not made.exists()


@pytest.mark.parametrize(
    ("rate", "samples", "limit"), [(60.0, 1, 35.0), (35.5, 20, 36.0)]
)
def test_a_spike_does_not_raise_the_range_but_a_fast_turn_does(
    tmp_path, rate, samples, limit
):
    """A spike lasts one sample, a turn 0.2 s."""
    stamp = START + STEP * np.arange(1000)
    z = 0.002 * np.random.default_rng(0).standard_normal((1000, 6))
    z[500 : 500 + samples, 2] = rate
    path = write_mcap(tmp_path / "bag.mcap", imu_messages(stamp, z, TOPICS[:2]))
    (found,) = starting_config_of(path, "refused").parameters["health.max_rate"]
    assert found == limit


def stamped(rate, strike):
    """Messages of two units at rest; `strike(stamps)` gives the stamps of the second one."""
    time = START + np.round(np.arange(0.0, 300 / rate, 1 / rate) * 1e9).astype(np.int64)
    random = np.random.default_rng(4)
    messages = []
    for topic, stamps in (("/a/imu", time), ("/b/imu", strike(time))):
        for log, at in zip(time.tolist(), stamps.tolist(), strict=True):
            values = random.normal(0.0, 0.003, 3)
            messages.append((topic, log, imu(at, values)))
    return sorted(messages, key=lambda one: one[1])


@pytest.mark.parametrize("rate", [20.0, 400.0])
@pytest.mark.parametrize(
    ("strike", "words"),
    [
        (lambda time: time * 0 + START, "its stamps do not increase in 99.7 % of"),
        (lambda time: time // 1000, "about 1000 times closer together"),
        (lambda time: time // 10**6, "about 1000000 times closer together"),
        (lambda time: START // 100 + time % 10**12 * 1000, "1000 times farther apart"),
        (lambda time: START + (time - START) // 3, ""),
    ],
)
def test_stamps_that_are_no_times_are_told(rate, strike, words, tmp_path):
    """The clock of a simulation may be some times slower."""
    found = inspect(write_mcap(tmp_path / "bag.mcap", stamped(rate, strike))).reports
    assert words in needs(found)
    assert bool(needs(found)) == bool(words)


def test_messages_that_come_twice_are_no_burst(tmp_path):
    """Their stamps show when the unit measured, and their noise and rate are those of one."""
    once = stamped(50.0, lambda time: time)
    twice = [
        one
        for topic, log, data in once
        for one in [(topic, log, data), (topic, log + 1000, data)][
            : 1 + (topic == "/b/imu")
        ]
    ]
    first, second = inspect(write_mcap(tmp_path / "bag.mcap", twice)).reports
    assert (second.received, second.again, second.burst) == (600, 300, 1)
    assert second.rate == pytest.approx(50.0, rel=0.01)
    ratio = second.segments.noise().quiet / first.segments.noise().quiet
    assert ratio == pytest.approx(1.0, abs=0.3)
    assert candidates([first, second]) == [first, second]


@pytest.mark.parametrize("size", [3.5, -3.5, 86400.0])
@pytest.mark.parametrize("alone", [False, True])
def test_a_clock_that_jumps_against_another_unit_is_told(size, alone, tmp_path):
    """Stamps that go back are told as such; what all units share is of another clock."""

    def jump(time):
        return time + np.where(time - START > 3 * 10**9, int(size * 1e9), 0)

    messages = stamped(50.0, jump)
    if not alone:
        messages = [(topic, log, data) for topic, log, data in messages if "b" in topic]
        messages += [("/a/imu", log, data) for _, log, data in messages]
        messages.sort(key=lambda one: one[1])
    found = inspect(write_mcap(tmp_path / "bag.mcap", messages)).reports
    words = " ".join(one.words for one in message_findings(found))
    told = f"the stamps of /b/imu advance by {abs(size):g} s more than the time of"
    assert (told in words) == (alone and size > 0)
    assert ("go back" in words) == (size < 0)


@pytest.mark.parametrize(("seconds", "short"), [(2.0, True), (5.0, True), (7.0, False)])
def test_inspect_asks_for_a_look_where_a_replay_cannot_tell(
    seconds, short, fdi, tmp_path
):
    time = START + np.round(np.arange(0.0, seconds, 0.02) * 1e9).astype(np.int64)
    rates = np.random.default_rng(3).normal(0.0, 0.003, (len(time), 6))
    path = write_mcap(tmp_path / "bag.mcap", imu_messages(time, rates))
    first = fdi("inspect", path).out.splitlines()[0]
    assert first.startswith("READY, BUT LOOK: the recording lasts") == short
    rates[len(rates) // 2 :, 4] = np.nan
    path = write_mcap(tmp_path / "nan.mcap", imu_messages(time, rates))
    first = fdi("inspect", path).out.splitlines()[0]
    assert "gave no finite value in 50 % of the messages: y" in first
