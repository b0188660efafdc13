# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Recordings as people bring them: odd stamps, odd units, many files, parts missing."""

import os
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from bag.logs import SCALED, telemetry, units, write_ulog
from bag.recordings import START, imu, write_mcap
from mavlink.autopilots import Autopilot
from mcap.writer import CompressionType

from fdi_ros.bag.reader import Recording

CASES = Path(__file__).parents[3] / "shared" / "data" / "cases"
DEGREES = np.degrees(1.0)
HEARTBEAT = 0


def case(name):
    if not (CASES / name).exists():
        pytest.skip(f"needs {CASES / name}, which is not here")
    return CASES / name


def drive(seed=0, seconds=30.0, rate=50.0, size=0.3):
    """Times (K,), s, and rates (K, 3) of three units: 8 s at rest, then gentle turns."""
    random = np.random.default_rng(seed)
    time = np.arange(round(seconds * rate)) / rate
    moving = np.clip(time - 8.0, 0.0, 1.0)[:, None]
    turns = size * moving * np.sin(np.outer(time, (0.7, 1.1, 0.5)))
    biases = random.normal(0.0, 0.015, (3, 3))
    noise = random.normal(0.0, 0.002, (3, len(time), 3))
    return time, turns + biases[:, None, :] + noise


def write_csv(path, time, rates, first=0):
    """One table of the units (k, K, 3), their columns named by numbers from the first."""
    names = [f"gyro{first + k}_{axis}" for k in range(len(rates)) for axis in "xyz"]
    table = np.column_stack([time, *rates])
    header = ",".join(["time", *names])
    np.savetxt(path, table, "%.7f", delimiter=",", header=header, comments="")
    return path


def write_bag(path, time, rates, offsets=(0, 0, 0), **options):
    """An MCAP file of Imu messages; the stamps of each unit are off by so many ns."""
    messages = []
    for k, unit in enumerate(rates):
        for at, rate in zip(
            START + np.round(time * 1e9).astype(int), unit, strict=True
        ):
            stamp = int(at) + offsets[k]
            messages.append((f"/imu_{k}/data", int(at), imu(stamp, rate)))
    messages.sort(key=lambda one: one[1])
    write_mcap(path, messages, **options)
    return path


def burst(time, size):
    """Stamps of which so many come at once, when the last of them was measured."""
    count = np.arange(len(time))
    last = np.minimum(count // size * size + size - 1, len(time) - 1)
    return time[last] + 3e-4 * (count % size)


@pytest.mark.parametrize("size", [2, 5, 12])
def test_stamps_in_bursts_have_the_rate_of_the_whole_and_their_unit_is_left_out(
    size, tmp_path, fdi
):
    time, rates = drive()
    messages = []
    for k, unit in enumerate(rates):
        stamps = burst(time, size) if k == 1 else time
        for at, rate in zip(
            START + np.round(stamps * 1e9).astype(int), unit, strict=True
        ):
            messages.append((f"/imu_{k}/data", int(at), imu(int(at), rate)))
    messages.sort(key=lambda one: one[1])
    write_mcap(tmp_path / "bag.mcap", messages)
    settings = tmp_path / "settings.yaml"
    inspected = fdi("inspect", tmp_path / "bag.mcap", "--output", settings).out
    words = f"/imu_1/data is left out: its stamps come in bursts of about {size}, and do not show when it"
    assert words in inspected
    assert "sample_rate: 50.0" in settings.read_text()
    replayed = fdi("replay", tmp_path / "bag.mcap")
    assert replayed.code == 4
    assert replayed.out.startswith("LOOK: ")
    assert words in replayed.out
    assert "imu_0, imu_2 mounted alike" in replayed.out


@pytest.mark.parametrize("bursting", [(1, 2), (0, 1, 2)])
def test_bursts_of_all_but_one_unit_are_refused_by_name(
    bursting, tmp_path, fdi, refused
):
    """A rate that was guessed from them would be refused as the recording's own."""
    time, rates = drive(rate=200.0, seconds=12.0)
    messages = []
    for k, unit in enumerate(rates):
        stamps = burst(time, 20) if k in bursting else time
        for at, stamp, rate in zip(time, stamps, unit, strict=True):
            log, stamp = (START + round(1e9 * one) for one in (at, stamp))
            messages.append((f"/imu_{k}/data", log, imu(stamp, rate)))
    messages.sort(key=lambda one: one[1])
    write_mcap(tmp_path / "bag.mcap", messages)
    first = fdi("inspect", tmp_path / "bag.mcap").out.splitlines()[0]
    assert first.startswith("NEEDS two units with stamps of the time of measurement")
    for said in (first, refused("replay", tmp_path / "bag.mcap")):
        assert "come in bursts of about 20; stamp each sample when it is mea" in said
        assert all(f"/imu_{k}/data" in said for k in bursting)


def test_a_gyro_without_one_of_its_columns_is_no_healthy_gyro(tmp_path, fdi):
    time, rates = drive()
    path = write_csv(tmp_path / "a.csv", time, rates)
    cut = [line.rpartition(",")[0] for line in path.read_text().splitlines()]
    path.write_text("\n".join(cut))
    done = fdi("replay", path)
    first = done.out.splitlines()[0]
    why = "the gyro of gyro2_x and gyro2_y is left out: no column for z."
    assert first.startswith(
        f"LOOK: no fault was found in 30.0 s, but {why} What to do: "
    )
    assert done.code == 4


def test_a_folder_of_recordings_is_not_read_as_one(tmp_path, fdi, refused):
    time, rates = drive(seconds=10.0)
    for name in ("monday.mcap", "tuesday.mcap"):
        write_bag(tmp_path / name, time, rates)
    said = refused("replay", tmp_path)
    assert "holds several recordings (monday.mcap, tuesday.mcap): name one" in said
    assert "fdi fleet" in said
    table = tmp_path / "wednesday.csv"
    table.write_text("time\n")
    (tmp_path / "tuesday.mcap").rename(tmp_path / "monday_1.mcap")
    said = refused("replay", tmp_path)
    assert "(monday.mcap, monday_1.mcap, wednesday.csv): name one" in said
    table.unlink()
    (tmp_path / "monday_1.mcap").rename(tmp_path / "tuesday.mcap")
    # The pieces of one bag differ in their numbers.
    for k, name in enumerate(("monday.mcap", "tuesday.mcap")):
        (tmp_path / name).rename(tmp_path / f"flight_{k}.mcap")
    assert "no fault was found" in fdi("replay", tmp_path).out


def test_a_topic_that_is_not_there_is_compared_with_those_that_are(tmp_path, refused):
    time, rates = drive(seconds=2.0)
    path = write_bag(tmp_path / "bag.mcap", time, rates)
    config = tmp_path / "two.yaml"
    topics = "[/imu_0/data, /imu_2/dat]"
    config.write_text(
        "/**:\n  ros__parameters:\n    input: imus\n    sample_rate: 50.0\n"
        f"    imus:\n      topics: {topics}\n"
    )
    said = refused("replay", path, "--config", config)
    assert "no topic '/imu_2/dat', did you mean '/imu_2/data'? It has: " in said


@pytest.mark.parametrize("verb", ["replay", "sweep", "calibrate"])
@pytest.mark.parametrize("topic", ["", "/imu_0/data", "/gyros"])
def test_imus_with_the_config_of_an_array_are_told_the_input(
    tmp_path, refused, verb, topic
):
    """The config names no topic, one of an IMU, or one that is not there."""
    time, rates = drive(seconds=2.0)
    path = write_bag(tmp_path / "bag.mcap", time, rates)
    config = tmp_path / "array.yaml"
    given = f"    channels:\n      topic: {topic}\n" if topic else ""
    config.write_text(f"/**:\n  ros__parameters:\n    sample_rate: 50.0\n{given}")
    more = ("--output", tmp_path / "o.yaml") if verb == "calibrate" else ()
    said = refused(verb, path, "--config", config, *more)
    assert said.endswith(
        "topics of type sensor_msgs/msg/Imu: to read them, set `input: imus` and"
        " `imus.topics: [/imu_0/data, /imu_1/data, /imu_2/data]`\n"
    )


def test_stamps_that_jitter_are_no_bursts(tmp_path, fdi):
    time, rates = drive()
    time = np.sort(time + np.random.default_rng(1).uniform(-0.008, 0.008, len(time)))
    out = fdi("inspect", write_csv(tmp_path / "a.csv", time, rates)).out
    assert "burst" not in out
    assert "9 channels" in out


def test_the_shared_case_of_bursts_is_judged_at_its_rate():
    from fdi_ros.inspection.starting_config import assumed_config

    config, words, *_ = assumed_config(case("stamps_in_bursts.csv"))
    assert config.sample_rate == pytest.approx(100.0)
    assert config.topics == ("/imu_0", "/imu_2")
    assert "/imu_1 is left out" in words


@pytest.mark.parametrize("packing", [zstandard, lz4.frame])
@pytest.mark.parametrize("name", ["zstd", "none"])
def test_messages_that_were_compressed_one_by_one_are_read_as_any_others(
    name, packing, tmp_path
):
    """Of topics that cannot be gyros they stay as they are."""

    time, rates = drive(seconds=4.0)
    plain = write_bag(tmp_path / "plain.mcap", time, rates)
    messages = []
    with Recording(plain) as recording:
        for batch in recording.batches([f"/imu_{k}/data" for k in range(3)]):
            for k, at in enumerate(batch.log_time.tolist()):
                topic = f"/imu_{int(batch.topic[k])}/data"
                messages.append((topic, at, batch.message(k)))
    packed = [(topic, at, packing.compress(data)) for topic, at, data in messages]
    kind = CompressionType.ZSTD if name == "zstd" else CompressionType.NONE
    write_mcap(tmp_path / "packed.mcap", packed, kind)
    found = []
    with Recording(tmp_path / "packed.mcap") as recording:
        for batch in recording.batches([f"/imu_{k}/data" for k in range(3)]):
            assert (batch.log_time <= batch.horizon).all() or len(batch)
            for k, at in enumerate(batch.log_time.tolist()):
                topic = f"/imu_{int(batch.topic[k])}/data"
                found.append((topic, at, batch.message(k)))
        assert not recording.damage
    assert sorted(found) == sorted(messages)


def test_the_shared_bag_of_compressed_messages_is_healthy(fdi):
    done = fdi("replay", case("mcap_message_zstd"))
    assert "9 channels" in done.out
    assert "no fault was found" in done.out


def test_a_folder_of_one_table_a_unit_is_what_one_table_of_all_is(tmp_path):
    time, rates = drive()
    whole = write_csv(tmp_path / "whole.csv", time, rates)
    folder = tmp_path / "folder"
    folder.mkdir()
    for k, unit in enumerate(rates):
        write_csv(folder / f"gyro_{k}.csv", time, [unit])
    (folder / "gps.csv").write_text("time,lat,lon,alt\n1,2,3,4\n")

    def messages(path):
        with Recording(path) as recording:
            names = [topic.name for topic in recording.topics]
            found = {name: [] for name in names}
            for batch in recording.batches(names):
                for k in range(len(batch)):
                    found[names[batch.topic[k]]].append(batch.message(k))
            return found, recording.damage.report()

    found, damage = messages(folder)
    assert found == messages(whole)[0]
    assert "gps.csv: no columns of gyros, left out" in damage


def test_tables_of_a_folder_keep_their_numbers_and_are_merged_by_time(tmp_path):
    time, rates = drive(seconds=60.0, rate=400.0)
    for k, number in enumerate((7, 2, 11)):
        write_csv(tmp_path / f"imu{number}.csv", time + 0.001 * k, [rates[k]])
    with Recording(tmp_path) as recording:
        names = [topic.name for topic in recording.topics]
        assert names == ["/imu_2", "/imu_7", "/imu_11"]
        assert not recording.context.origins
        horizon = 0
        for batch in recording.batches(names):
            # No message comes later than the one before promised.
            assert batch.log_time.min() >= horizon
            horizon = batch.horizon
            assert horizon > batch.log_time.max() - 30 * 10**9


def test_names_without_numbers_are_said_below_the_verdict(tmp_path, fdi):
    """Files and columns have the names that people give their IMUs, topics have numbers."""
    time, rates = drive()
    folder = tmp_path / "boards"
    folder.mkdir()
    for name, unit in zip(("bmi088", "icm", "lsm6dso"), rates, strict=True):
        write_csv(folder / f"{name}.csv", time, [unit])
    table = write_csv(tmp_path / "table.csv", time, rates)
    text = table.read_text()
    for k, name in enumerate(("left", "right", "tail")):
        text = text.replace(f"gyro{k}_", f"{name}_gyro_")
    table.write_text(text)
    said = "In the log, imu_0 is {}; imu_1 is {}; imu_2 is {}."
    names = ("bmi088.csv", "icm.csv", "lsm6dso.csv")
    assert said.format(*names) in fdi("replay", folder).out
    columns = ("left_gyro", "right_gyro", "tail_gyro")
    assert said.format(*columns) in fdi("replay", table).out


def test_a_folder_of_whole_recordings_is_not_one_recording(tmp_path, refused):
    time, rates = drive()
    for name in ("monday", "tuesday"):
        write_csv(tmp_path / f"{name}.csv", time, rates)
    said = refused("replay", tmp_path)
    assert "holds 3 IMUs, so it is a recording of its own" in said
    assert "fdi fleet" in said


@pytest.mark.parametrize("write", [write_csv, write_bag])
@pytest.mark.parametrize("count", [2, 3])
def test_gentle_units_in_degrees_are_refused_and_in_radians_are_not(
    write, count, tmp_path, fdi, refused
):
    """Fast motion and one unit among others show it, too; here all are gentle and alike."""
    time, rates = drive()
    path = tmp_path / ("a.csv" if write is write_csv else "a.mcap")
    write(path, time, rates[:count] * DEGREES)
    said = refused("replay", path)
    assert "in deg/s" in said
    assert "no gyro at rest has a bias and noise of" in said
    write(path, time, rates[:count])
    assert "no fault was found" in fdi("replay", path).out


def test_a_steady_turn_with_vibration_is_no_bias_in_degrees(tmp_path, fdi):
    random = np.random.default_rng(2)
    time = np.arange(1500) / 50.0
    turn = np.array([0.0, 0.05, 0.4]) + random.normal(0.0, 0.03, (2, 1500, 3))
    out = fdi("inspect", write_csv(tmp_path / "a.csv", time, turn)).out
    assert "deg/s" not in out.splitlines()[0]


@pytest.mark.parametrize(
    ("offset", "words"),
    [
        (37, "37 s ahead"),
        (
            -START // 10**9 + 12,
            "54 years behind (it counts since boot, not since 1970)",
        ),
    ],
)
def test_stamps_of_other_clocks_are_said_by_replay_itself(
    offset, words, tmp_path, refused
):
    """TAI beside UTC is 37 s apart, time since boot years."""
    time, rates = drive()
    offsets = (0, offset * 10**9, 0)
    path = write_bag(tmp_path / "bag.mcap", time, rates, offsets)
    said = refused("replay", path)
    assert (
        "needs one clock: stamps are of other clocks than those of /imu_0/data" in said
    )
    assert f"/imu_1/data {words}" in said


@pytest.mark.parametrize("units", [(1,), (0, 1, 2)])
def test_a_clock_that_was_set_while_recording_is_said(units, tmp_path, refused):
    time, rates = drive(seconds=20.0)
    messages = []
    for k, unit in enumerate(rates):
        back = np.where((time > 10.0) & np.isin(k, units), 3600.0, 0.0)
        for at, stamp, rate in zip(time, time - back, unit, strict=True):
            log, stamp = (START + round(1e9 * one) for one in (at, stamp))
            messages.append((f"/imu_{k}/data", log, imu(stamp, rate)))
    messages.sort(key=lambda one: one[1])
    write_mcap(tmp_path / "bag.mcap", messages)
    names = "/imu_1/data" if units == (1,) else "/imu_0/data, /imu_1/data and /imu_2/"
    said = refused("replay", tmp_path / "bag.mcap")
    assert f"needs one clock: the last stamps of {names}" in said
    assert "are up to 3580 s before the first: a clock was set while they" in said


@pytest.mark.parametrize("late", [0.15, -0.4, 0.9])
def test_stamps_beyond_the_time_that_is_waited_are_no_lost_data(
    late, tmp_path, fdi, refused
):
    """A unit that delivers everything must not be called silent."""
    time, rates = drive()
    offsets = (0, round(late * 1e9), 0)
    path = write_bag(tmp_path / "bag.mcap", time, rates, offsets)
    side = "ahead" if late > 0 else "behind"
    said = f"/imu_1/data {abs(late):g} s {side}; a unit is waited for 0.1 s"
    assert said in refused("replay", path)
    assert said in fdi("inspect", path).out


def test_a_unit_whose_messages_are_late_is_waited_for_as_asked(tmp_path, fdi):
    time, rates = drive()
    config = tmp_path / "late.yaml"
    table = write_csv(tmp_path / "a.csv", time, rates)
    assert fdi("inspect", table, "--output", config).code == 0
    text = config.read_text()
    messages = [
        (f"/imu_{k}", int(at) + (k == 1) * 300_000_000, imu(int(at), rate))
        for k, unit in enumerate(rates)
        for at, rate in zip(START + np.round(time * 1e9).astype(int), unit, strict=True)
    ]
    messages.sort(key=lambda one: one[1])
    write_mcap(tmp_path / "late.mcap", messages)
    config.write_text(text.replace("imus:", "imus:\n      timeout: 0.5", 1))
    said = fdi("replay", tmp_path / "late.mcap", "--config", config)
    assert said.out.startswith("HEALTHY: "), said


def test_all_stamps_since_boot_are_as_good_as_dates(tmp_path, fdi):
    time, rates = drive()
    offsets = (-START + 10**9,) * 3
    path = write_bag(tmp_path / "bag.mcap", time, rates, offsets)
    assert "no fault was found" in fdi("replay", path).out


def test_tables_without_a_common_time_are_refused_in_these_words(tmp_path, refused):
    time, rates = drive()
    for k in range(2):
        write_csv(tmp_path / f"imu{k}.csv", time + 37.0 * k, [rates[k]])
    said = refused("replay", tmp_path)
    assert "no common time" in said
    assert "/imu_1 from 37 to 66.98 s" in said


@pytest.mark.parametrize("seconds", [4, 7, 19, 31])
def test_of_a_default_log_of_px4_of_any_length_the_means_are_said(
    seconds, tmp_path, fdi
):
    made = units(2, seconds=seconds, rate=1.0)
    made[1].rate[:, 2] += 0.25
    path = write_ulog(tmp_path / "log.ulg", made, kind="vehicle_imu_status")
    out = fdi("replay", path).out
    assert "A COARSE CHECK" in out
    # The log is in FRD, what is said in FLU.
    assert f"imu_1 less imu_0, median of {seconds} means: " in out
    z = float(out.partition("means: ")[2].split()[2])
    assert z == pytest.approx(-0.25, abs=0.01)
    assert "imu_1 up to 41 °C, 3 errors" in out


def test_the_status_of_an_older_px4_without_means_is_said(tmp_path, refused):
    made = units(2, seconds=6, rate=1.0)
    path = write_ulog(tmp_path / "log.ulg", made, kind="vehicle_imu_status")
    data = path.read_bytes()
    path.write_bytes(data.replace(b" mean_gyro;", b" some_gyro;"))
    said = refused("inspect", path)
    assert "imu_0 up to 40 °C" in said
    assert "imu_1 up to 41 °C, 3 errors" in said
    assert "median of" not in said


def test_a_temperature_that_was_not_measured_is_not_said(refused):
    """The log of a simulator has a temperature of 0 throughout."""
    said = refused("inspect", case("../logs/sample_px4_events.ulg"))
    assert "vehicle_imu_status (imu_0 vibration up to 0.0088 rad/s); " in said
    assert "°C" not in said


def test_what_a_short_log_lacks_comes_before_what_it_has(refused):
    said = refused("inspect", case("../logs/sample_log_small.ulg"))
    assert "has too few samples to compare two IMUs: it has vehicle_imu of 3 " in said
    assert "imu_0 vibration up to 0.000032 rad/s; imu_1" in said


def test_a_mistyped_path_gets_the_file_that_was_meant(tmp_path, refused):
    time, rates = drive()
    meant = write_csv(tmp_path / "hover_flight.csv", time, rates)
    assert (
        refused("replay", tmp_path / "hover_fligth.csv")
        .strip()
        .endswith(
            f"no recording at {tmp_path / 'hover_fligth.csv'}, did you mean {meant}?"
        )
    )
    assert "did you mean" not in refused("replay", tmp_path / "other.mcap")
    assert "did you mean" not in refused("replay", tmp_path / "no" / "hover.csv")


def test_gyros_alone_are_offered_for_a_gyro(tmp_path, refused):
    time, rates = drive()
    path = write_csv(tmp_path / "a.csv", time, rates)
    said = refused("replay", path, "--check", "imu_1.q faulty")
    assert "Expected one of: imu_0.x" in said
    assert "accel" not in said


def test_a_telemetry_log_without_heartbeat_is_read(tmp_path):
    autopilot = Autopilot("ardupilot", rates=SCALED, system=7)
    path = tmp_path / "a.tlog"
    path.write_bytes(telemetry(autopilot, left_out=(HEARTBEAT,)))
    with Recording(path) as recording:
        assert [topic.count for topic in recording.topics] == [300, 300, 300]
        (said,) = recording.damage.lines
    assert "no HEARTBEAT of an autopilot: system 7 is read" in said


def test_a_gyro_that_lacks_an_axis_is_said(tmp_path, fdi):
    time, rates = drive()
    path = write_csv(tmp_path / "a.csv", time, rates)
    head, _, rest = path.read_text().partition("\n")
    path.write_text(head.replace("gyro2_z", "altitude") + "\n" + rest)
    out = fdi("inspect", path).out
    assert "gyro2_x and gyro2_y are left out: no column for z" in out
    made = fdi("setup", path, "--output", tmp_path / "made.yaml").out
    for first in (out.splitlines()[0], made.splitlines()[0]):
        assert "gyro2_x and gyro2_y is left out: no column for z" in first


def test_an_empty_folder_says_what_it_lacks(tmp_path, refused):
    os.mkdir(tmp_path / "empty")
    said = refused("inspect", tmp_path / "empty")
    assert "is a folder without .mcap, .db3, .csv or .tsv files" in said
