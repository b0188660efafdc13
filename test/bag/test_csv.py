# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Tables of text: which columns are read by their names or as asked, their units and times, and what is damaged."""

import os
import re

import numpy as np
import pytest
from bag.logs import UTC, units
from bag.recordings import bounded
from bag.test_logs import messages, refusal
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import Imu

from fdi_ros.system.files import TABLE

AXES = "xyz"
UNITS = units(2, seconds=4.0)
TIME = (UNITS[0].stamp - UNITS[0].stamp[0]) * 1e-6
RATES = np.hstack([unit.rate for unit in UNITS]).astype(float)


def write(folder, names, time=TIME, rates=RATES, delimiter=",", head="", tail=""):
    path = folder / "flight.csv"
    rows = [
        delimiter.join([repr(t), *map(repr, row)])
        for t, row in zip(time.tolist(), rates.tolist(), strict=True)
    ]
    path.write_text(head + "\n".join([delimiter.join(names), *rows]) + "\n" + tail)
    return path


def named(form):
    return ["t", *(form.format(k=k, axis=axis) for k in (1, 2) for axis in AXES)]


NAMES = [
    *map(named, ("omega_{k}{axis}", "imu_{k}.{axis}", "gyro{k}_{axis}", "w{axis}{k}", "G{axis}_{k} [rad/s]")),
    ["field.header.stamp", *(f"field.imu{k}.angular_velocity.{axis}" for k in "ab" for axis in AXES)],
    ["Timestamp (s)", *(f"gyro_{k}[{axis}]" for k in "ab" for axis in range(3))],
]  # fmt: skip


@pytest.mark.parametrize("names", NAMES, ids=lambda names: names[1])
def test_columns_are_those_that_their_names_say(tmp_path, names):
    others = ["acc_x", "acc_y", "acc_z", "temperature"]
    table = np.hstack([RATES, np.full((len(RATES), 4), 9.0)])
    found, damage = messages(write(tmp_path, [*names, *others], rates=table))
    # An IMU keeps its number.
    topics = ["/imu_1", "/imu_2"] if "1" in names[1] else ["/imu_0", "/imu_1"]
    assert list(found) == topics
    for k, (stamp, rate, _) in enumerate(found.values()):
        assert (stamp == np.round(TIME * 1e6) * 1000).all()
        assert (rate == RATES[:, 3 * k : 3 * k + 3]).all()
    assert damage == (
        f"flight.csv: columns, by their names: time = {names[0]}; {topics[0]} ="
        f" {', '.join(names[1:4])}; {topics[1]} = {', '.join(names[4:])}"
        + ("" if "rad" in names[1] else "; no unit in the names: rad/s assumed"),
    )


@pytest.mark.parametrize(
    ("name", "scale", "start"),
    [
        *(("time_ms", 1e3, 0), ("TimeUS", 1e6, 0), ("t [ns]", 1e9, 0)),
        *(("stamp", 1e9, UTC), ("time", 1e3, UTC), ("t", 1.0, UTC)),
    ],
)
def test_times_have_the_unit_of_their_name_or_that_of_a_date(
    tmp_path, name, scale, start
):
    names = [name, *(f"gyro_{axis}{k} (deg/s)" for k in (1, 2) for axis in AXES)]
    time = (start * 1e-9 + TIME) * scale
    found, (said,) = messages(write(tmp_path, names, time, np.degrees(RATES)))
    for k, (stamp, rate, _) in enumerate(found.values()):
        np.testing.assert_allclose(stamp - start, TIME * 1e9, atol=1500)
        np.testing.assert_allclose(rate, RATES[:, 3 * k : 3 * k + 3], rtol=1e-12)
    assert said.endswith(" in deg/s")


@pytest.mark.parametrize(
    ("form", "unit"),
    [
        ("accel_{k}_{axis} [m/s^2]", 1.0),
        ("imu_{k}.acc_{axis}_g", 9.80665),
        ("a{axis}{k} (mg)", 9.80665e-3),
        ("acc{k}_{axis}", 1.0),
    ],
)
def test_accelerations_stand_beside_the_rates_in_the_unit_of_their_name(
    tmp_path, form, unit
):
    forces = np.hstack([unit.acceleration for unit in UNITS]).astype(float)
    others = named(form)[1:]
    table = np.hstack([RATES, forces / unit])
    path = write(tmp_path, [*named("gyro_{k}_{axis}"), *others], rates=table)
    found, damage = messages(path)
    assert any("accelerations in the order of the IMUs" in line for line in damage)
    for k, (_, rate, data) in enumerate(found.values()):
        message = deserialize_message(data[7], Imu)
        given = [getattr(message.linear_acceleration, axis) for axis in AXES]
        np.testing.assert_allclose(given, forces[7, 3 * k : 3 * k + 3], rtol=1e-12)
        assert message.linear_acceleration_covariance[0] == 0.0
        assert (rate == RATES[:, 3 * k : 3 * k + 3]).all()
    # Of one accelerometer beside two gyros nothing tells whose it is.
    path = write(tmp_path, [*named("gyro_{k}_{axis}"), *others[:3]], rates=table[:, :9])
    message = deserialize_message(messages(path)[0]["/imu_1"][2][7], Imu)
    assert message.linear_acceleration_covariance[0] == -1.0


@pytest.mark.parametrize("delimiter", [";", "\t"])
def test_a_table_of_a_spreadsheet_has_decimal_commas_a_comment_and_text(
    tmp_path, delimiter
):
    names = [*named("imu_{k}.{axis}"), "note"]
    path = write(
        tmp_path,
        named("imu_{k}.{axis}"),
        delimiter=delimiter,
        head="\ufeff# a flight\n\n",
    )
    lines = path.read_text().splitlines()
    comma = delimiter == ";"
    lines[3:] = [
        (line.replace(".", ",") if comma else line) + f'{delimiter}"said {delimiter}"'
        for line in lines[3:]
    ]
    lines[2] = delimiter.join(names)
    path.write_text("\r\n".join(lines) + "\r\n")
    if delimiter == "\t":
        path = path.rename(tmp_path / "flight.TSV")
    found, _ = messages(path)
    assert (found["/imu_2"][1] == RATES[:, 3:]).all()


IMUS = "imus: [[p1, q1, r1], [p2, q2, r2]]\n"


def test_columns_yaml_says_what_names_do_not(tmp_path):
    names = ["k", "t", "p1", "q1", "r1", "p2", "q2", "r2"]
    path = write(
        tmp_path,
        names,
        np.arange(len(TIME)),
        np.column_stack([TIME * 1e3, np.degrees(RATES)]),
    )
    assert (
        "has no columns of gyros among k, t, p1, q1, r1, p2, q2, r2; columns.yaml says which: docs"
        in refusal(path)
    )
    about = tmp_path / "columns.yaml"
    about.write_text(f"time: t\ntime_unit: ms\nrate_unit: deg/s\n{IMUS}")
    found, _ = messages(path)
    np.testing.assert_allclose(found["/imu_2"][1], RATES[:, 3:], rtol=1e-12)
    assert (found["/imu_1"][0] == np.round(TIME * 1e6) * 1000).all()
    for text, words in (
        ("imus: [[p1, q1]]", "imus is a list of three columns for each IMU"),
        ("imus: [[p1, q1, z9], [p2, q2, r2]]", "has no column 'z9', it has k, t, p1"),
        (
            f"{IMUS}rate_unit: rpm",
            "column 'p1' has the unit 'rpm', expected one of rad/s",
        ),
        (
            f"{IMUS}units: 3",
            "expected acceleration_unit, accelerations, imus, rate_unit",
        ),
        (
            f"{IMUS}accelerations: [[p1, q1, r1]]",
            "accelerations names 1 IMUs, imus names 2",
        ),
        (f"{IMUS}time: [1]", "has no column [1]"),
        ("- 1", "expected acceleration_unit"),
        ("x: [", "is not YAML"),
        (
            "{time: t, time_unit: ms, imus: [[p1, q1, r1]]}",
            "this table has no other (columns of 1 IMU at 100 Hz)",
        ),
    ):
        about.write_text(text)
        assert words in refusal(path)
    about.unlink()
    os.mkfifo(about)
    assert "is no regular file" in refusal(path)


@pytest.mark.parametrize("portion", [3000, 1 << 20])
def test_an_imu_without_values_in_a_line_has_no_message_there(
    tmp_path, monkeypatch, portion
):
    """Two IMUs of their own rates in one table; a damaged number is one, not a lost message; a second table is left."""
    monkeypatch.setattr("fdi_ros.bag.csv_file._READ_BYTES", portion)
    path = write(tmp_path, named("imu_{k}.{axis}"))
    lines = path.read_text().splitlines()
    again = lines[1:]
    lines[1::2] = [",".join([*line.split(",")[:4], "", "", ""]) for line in lines[1::2]]
    lines[100] = lines[100].replace(lines[100].split(",")[1], "0.1x2", 1)
    path.write_text(
        "\n".join([*lines[:50], "", "# pause", "no numbers", *lines[50:]]) + "\n1.0,2."
    )
    found, damage = messages(path)
    assert [len(one[0]) for one in found.values()] == [len(TIME), len(TIME) // 2]
    assert np.isnan(found["/imu_1"][1][99]).tolist() == [True, False, False]
    assert (found["/imu_2"][1] == RATES[1::2, 3:]).all()
    assert [line.partition(": ")[2] for line in damage[1:]] == [
        "the last line is not finished and was left out",
        "1 line without a time was left out",
    ]
    path.write_text("\n".join([*lines, *again]) + "\n")
    beside, damage = messages(path)
    assert [one[2] for one in beside.values()] == [one[2] for one in found.values()]
    assert "the time steps back at byte" in damage[1]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "is empty"),
        (
            "1.0,2.0,3.0,4.0\n" * 50,
            "has no names of columns: its first line holds numbers",
        ),
        (
            "t,gyro_x [LSB],gyro_y,gyro_z\n",
            "column 'gyro_x [LSB]' has the unit 'lsb', expected one of",
        ),
        (
            "t,gx,gy,gz,gx1,gy1,gz1\n" + "1,0,0,0,0,0,0\n" * 50,
            "has columns of 2 IMUs at times that do not advance",
        ),
        ("t,gx,gy,gz\n" + "1" * (TABLE.line_bytes << 2), "has a line of more than"),
        ("t," * TABLE.line_bytes, "has no line with four or more names"),
        (
            "t,gx,gy,gz,gx1,gy1,gz1\n"
            + "".join(f"{10 * k},0,0,0,0,0,0\n" for k in range(50)),
            "does the name of the time have its unit (time_ms), or columns.yaml a time_unit,",
        ),
    ],
    ids=[
        "empty",
        "no names",
        "unit",
        "time",
        "line",
        "names",
        "time in the wrong unit",
    ],
)
def test_what_is_no_table_of_gyros_is_refused_in_one_line(tmp_path, content, words):
    path = tmp_path / "a.csv"
    path.write_text(content)
    said = refusal(path)
    assert words in said
    assert "\n" not in said


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (["time", "a", "b", "_" * 40_000], "column name of 40000 characters"),
        (["time", *(f"g{k}_x" for k in range(100_000))], "100001 columns, expected at"),
        (["time", *("_" * 250 + str(k) for k in range(4_000))], "no columns of gyros"),
        (["time", *("(" * 250 + str(k) for k in range(4_000))], "no columns of gyros"),
        (["time", *("x" * 250 + str(k) for k in range(4_000))], "no columns of gyros"),
    ],
    ids=["long", "many", "underscores", "brackets", "axes"],
)
def test_names_of_columns_are_matched_in_a_time_that_follows_from_their_size(
    names, words, tmp_path
):
    path = tmp_path / "a.csv"
    path.write_text(",".join(names) + "\n" + "0," * (len(names) - 1) + "0\n")
    with bounded(10):
        assert words in refusal(path)


def test_columns_of_one_name_are_refused_and_those_of_another_unit_are_left_out(
    tmp_path, fdi
):
    table = np.hstack([RATES, RATES[:, 3:]])
    again = [*named("gyro_{k}_{axis}"), *(f"gyro_2_{axis}" for axis in AXES)]
    words = "flight.csv has 2 columns 'gyro_2_x': give each a name of its own"
    assert words in refusal(write(tmp_path, again, rates=table))
    again[7:] = [f"gyro_2_{axis} [deg/s]" for axis in AXES]
    path = write(tmp_path, again, rates=table)
    found, damage = messages(path)
    assert list(found) == ["/imu_1", "/imu_2"]
    assert "gyro_2_z [deg/s] are left out: a column before" in damage[1]
    # What a replay says of the gyro, fdi inspect says too.
    assert fdi("inspect", path).out.startswith(
        "READY, BUT LOOK: the gyro of gyro_2_x [deg/s], gyro_2_y [deg/s], gyro_2_z [deg/s] is left out"
    )


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ((), "has names of columns, and no line of numbers below them"),
        (
            ("2026-05-04T10:00:00.02,1,2,3,4,5,6",) * 3,
            "has no line whose time is a number: it has '2026-05-04T10:00:00.02' in its column"
            " 'time'. What to do: write times in s",
        ),
    ],
)
def test_a_table_without_samples_says_what_it_lacks(lines, words, tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(
        "\n".join([",".join(["time", *named("gyro_{k}_{axis}")[1:]]), *lines, ""])
    )
    assert words in refusal(path)


def test_a_table_in_utf_16_is_refused(tmp_path):
    path = write(tmp_path, named("gyro_{k}_{axis}"))
    path.write_text(path.read_text(), encoding="utf-16")
    assert refusal(path).endswith("is UTF-16: save it as UTF-8")


def test_a_table_whose_time_steps_back_is_not_healthy(tmp_path, fdi):
    """What is behind the step, half of it, was not judged."""
    made = units(2, seconds=20.0)
    time = (made[0].stamp - made[0].stamp[0]) * 1e-6
    time[len(time) // 2 :] -= 9.0
    rates = np.hstack([unit.rate for unit in made]).astype(float)
    path = write(tmp_path, named("gyro_{k}_{axis}"), time, rates)
    words = r"but the last \d\d % of flight.csv is left out: the time steps back"
    out = fdi("replay", path)
    assert out.code == 4
    assert re.search(words, out.out.splitlines()[0])


def test_verbs_read_a_table_and_a_fleet_passes_others_by(tmp_path, fdi):
    made = units(2, seconds=20.0)
    time = (made[0].stamp - made[0].stamp[0]) * 1e-6
    path = write(
        tmp_path,
        named("imu_{k}.{axis}"),
        time,
        np.hstack([unit.rate for unit in made]).astype(float),
    )
    (tmp_path / "other.csv").write_text("name,size\na,3\n")
    (tmp_path / "other.tsv").write_text("name\tsize\na\t3\n")
    config = tmp_path / "made.yaml"
    assert "/imu_1" in fdi("inspect", path, "--output", config).out
    assert fdi("replay", path, "--config", config, "--check", "declared=0").code == 0
    said = fdi("fleet", tmp_path, "--output", tmp_path / "fleet", "--workers", 1)
    assert said.code == 0, said.err
    assert "other" not in said.out
