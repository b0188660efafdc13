# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Flight logs: the values, times and frames of their IMUs, whole or damaged, and the verdicts that come of them."""

import contextlib
import json
import os
import random
import struct
import sys
from pathlib import Path

import numpy as np
import pytest
from bag import logs
from bag.logs import FIX, SCALE, UTC, format_record, units, write_dataflash, write_ulog
from bag.recordings import IMU, STORE, bounded
from pymavlink.DFReader import DFReader_binary

from fdi_ros.bag import dataflash, flight_log, ulog
from fdi_ros.bag.flight_context import KEPT, Thinned
from fdi_ros.bag.reader import Recording
from fdi_ros.config.config import Config
from fdi_ros.core.sources import ImuSource
from fdi_ros.errors import BagError, FdiError
from fdi_ros.inspection.topics import inspect

FLU = np.array([1.0, -1.0, -1.0])
KINDS = {
    **dict.fromkeys(
        ("IMU", "IMU2", "IMT", "TimeMS", "GYR1"), ("log.bin", write_dataflash)
    ),
    "GYR": ("log.BIN", write_dataflash),
    **dict.fromkeys(
        ("sensor_gyro", "sensor_gyro_fifo", "vehicle_imu_status"),
        ("log.ulg", write_ulog),
    ),
    "vehicle_imu": ("log.ulog", write_ulog),
}
EVERY = pytest.mark.parametrize(
    "kind", [kind for kind in KINDS if kind != "vehicle_imu_status"]
)


def topics_of(kind, count=3):
    """Topics of a log: ArduPilot counts IMUs from 1, PX4 from 0."""
    first = int(KINDS[kind][1] is write_dataflash)
    return [f"/imu_{first + k}" for k in range(count)]


EITHER = pytest.mark.parametrize("kind", ["IMU", "sensor_gyro"])


def real(name):
    path = Path(__file__).parents[3] / "shared" / "data" / "logs" / name
    return (
        path
        if path.exists()
        else pytest.skip(f"the recorded data is not there: ../shared/data/logs/{name}")
    )


def log(folder, kind, made=None, **options):
    name, write = KINDS[kind]
    return write(folder / name, made or units(seconds=8.0), kind, **options)


def messages(path):
    """Messages of each topic: stamps in ns, rates and bytes; and what is damaged."""
    with Recording(path) as recording:
        names = [topic.name for topic in recording.topics]
        assert {topic.type for topic in recording.topics} == {IMU}
        found = {name: [] for name in names}
        for batch in recording.batches(names):
            decoded = ImuSource.decode(batch.buffer, batch.offset, batch.length, 3)
            assert decoded.good.all()
            assert (decoded.stamp == batch.log_time).all()
            for k, topic in enumerate(batch.topic.tolist()):
                found[names[topic]].append(
                    (decoded.stamp[k], decoded.values[k], batch.message(k))
                )
        assert [topic.count for topic in recording.topics] == [
            len(found[name]) for name in names
        ]
        columns = {name: list(zip(*rows, strict=True)) for name, rows in found.items()}
        return {
            name: (np.array(a), np.array(b), list(c))
            for name, (a, b, c) in columns.items()
        }, recording.damage.report()


@pytest.mark.parametrize(
    ("kind", "start", "gps", "begin", "room"),
    [
        *(
            (kind, 10.0, True, UTC - FIX * 1000, 32)
            for kind in KINDS
            if kind != "vehicle_imu_status"
        ),
        *(
            ("sensor_gyro_fifo", 10.0, True, UTC - FIX * 1000, room)
            for room in (8, 20, 33)
        ),
        # The 32 bits of GYR before 3.3 begin anew after 72 minutes.
        ("GYR1", 2**32 * 1e-6 - 3.0, False, 0, 32),
        # A simulation stamps by the clock of its computer; its GPS may say any other time.
        ("vehicle_imu", UTC * 1e-9, True, 0, 32),
        # Without GPS time counts from the start of the autopilot.
        ("IMU", 10.0, False, 0, 32),
        ("sensor_gyro", 10.0, False, 0, 32),
    ],
)
def test_rates_and_times_are_those_of_the_samples_in_front_left_up(
    tmp_path, monkeypatch, kind, start, gps, begin, room
):
    """Time counts from `begin`, ns; a FIFO may be of any length."""
    fifo = logs.ULOG_FORMATS["sensor_gyro_fifo"].replace("[32]", f"[{room}]")
    monkeypatch.setitem(logs.ULOG_FORMATS, "sensor_gyro_fifo", fifo)
    made = units(seconds=8.0, start=start, apart=137)
    found, damage = messages(log(tmp_path, kind, made, gps=gps))
    topics = topics_of(kind)
    assert list(found) == topics
    assert damage == ()
    for unit, (stamp, rate, _) in zip(made, found.values(), strict=True):
        step = 1000 if kind == "TimeMS" else 1
        assert (stamp == begin + unit.stamp // step * step * 1000).all()
        error = {
            "vehicle_imu": 1e-7,
            "IMT": 1e-7,
            "sensor_gyro_fifo": 0.51 * SCALE,
        }.get(kind, 0.0)
        np.testing.assert_allclose(rate, unit.rate * FLU, rtol=0.0, atol=error)
    # ROS reads the same, and of an autopilot no orientation.
    message = STORE.deserialize_cdr(found[topics[1]][2][7], IMU)
    assert (
        message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        == found[topics[1]][0][7]
    )
    assert message.header.frame_id == topics[1].strip("/")
    assert message.orientation_covariance[0] == -1.0
    has_acceleration = kind in ("IMU", "IMU2", "TimeMS", "IMT", "vehicle_imu")
    expected = made[1].acceleration[7] * FLU * has_acceleration
    np.testing.assert_allclose(
        [getattr(message.linear_acceleration, axis) for axis in "xyz"],
        expected,
        rtol=1e-6,
    )
    assert message.linear_acceleration_covariance[0] == (
        0.0 if has_acceleration else -1.0
    )


def test_raw_accelerometers_of_px4_are_read_at_the_times_of_the_gyros(tmp_path):
    """Those of sensor_accel; their own times are others, and the first one begins later."""
    made = units(seconds=8.0)
    for unit in made:
        unit.acceleration[:, 0] = 1e-6 * (unit.stamp - unit.stamp[0])
    found, _ = messages(log(tmp_path, "sensor_gyro", made, accel=True))
    for unit, (stamp, rate, raw) in zip(made, found.values(), strict=True):
        assert len(stamp) == len(unit.stamp)
        np.testing.assert_array_equal(rate, unit.rate * FLU)
        felt = [STORE.deserialize_cdr(one, IMU) for one in raw]
        force = [one.linear_acceleration.x for one in felt]
        expected = unit.acceleration[:, 0] + 3e-4
        np.testing.assert_allclose(force[:-1], expected[:-1], atol=1e-6)
        covariances = [one.linear_acceleration_covariance[0] for one in felt]
        assert covariances == [0.0] * (len(felt) - 1) + [-1.0]


@pytest.mark.parametrize(
    "hole", [bytes(30 << 20), b"\xa3" * 1_000_001, b"\x95\xa3\x00" * 99_999]
)
def test_a_hole_in_a_log_is_passed_and_its_bytes_are_counted(tmp_path, hole):
    """A card that ran full, or a file system that was repaired; the record before it has none behind it to prove it."""
    path = log(tmp_path, "IMU")
    whole = messages(path)[0]
    data = path.read_bytes()
    at = len(data) // 2
    path.write_bytes(data[:at] + hole + data[at:])
    found, damage = messages(path)
    for name, (stamp, _, _) in whole.items():
        # A record is cut in two where the hole begins, the one before it not proved, and a few where damage ends.
        assert set(found[name][0]) <= set(stamp)
        assert len(found[name][0]) >= len(stamp) - 5
    (line,) = [line for line in damage if "belong to no whole record" in line]
    assert len(hole) <= int(line.split(": ")[1].split()[0]) < len(hole) + 2000


def test_erased_flash_at_the_end_of_a_log_is_no_damage(tmp_path):
    path = log(tmp_path, "IMU")
    with path.open("ab") as file:
        file.write(b"\xff" * 20_000)
    found = inspect(path)
    assert found.incomplete == ""
    # The last record has none behind it to prove it.
    assert int(found.damage[0].split(": ")[1].split()[0]) < 100
    with path.open("ab") as file:
        file.write(b"\xfe" * 20_000)
    assert inspect(path).incomplete == "is damaged"


def refusal(path):
    """The words in which a log is refused."""
    with pytest.raises(BagError) as raised:
        Recording(path)
    return str(raised.value)


def as_pymavlink_reads(path):
    """Time in s since 1970, rate in FLU, of the samples of each instance of IMU."""
    rows = {}
    with contextlib.closing(DFReader_binary(str(path))) as opened:
        while (one := opened.recv_match(type=["IMU", "IMU2", "IMU3"])) is not None:
            instance = getattr(one, "I", ("IMU", "IMU2", "IMU3").index(one.get_type()))
            rows.setdefault(f"/imu_{instance + 1}", []).append(
                (one._timestamp, one.GyrX, -one.GyrY, -one.GyrZ)
            )
    return {name: np.array(values) for name, values in rows.items()}


@pytest.mark.parametrize("kind", ["IMU", "IMU2", "TimeMS", "solo_log171_start.bin"])
def test_pymavlink_reads_the_same(tmp_path, kind):
    """The independent reader confirms what the test writes, and what is read of it and of a real log of 3.3-dev."""
    path = log(tmp_path, kind, units(seconds=1.0)) if kind in KINDS else real(kind)
    found, damage = messages(path)
    theirs = as_pymavlink_reads(path)
    assert (list(found), damage) == (topics_of("IMU"), ())
    for name, (stamp, rate, _) in found.items():
        assert (theirs[name][:, 1:] == rate).all()
        assert np.abs(theirs[name][:, 0] - stamp * 1e-9).max() < 2e-6


@pytest.mark.parametrize(
    ("units_of", "multipliers", "factor"),
    [
        (b"s#EEEooo", b"F-000000", 1.0),
        (b"s#kkkooo", b"F-000000", np.pi / 180),
        (b"s#EEEooo", b"F-CCC000", 1e-3),
    ],
)
def test_units_and_multipliers_are_those_that_the_log_says(
    tmp_path, units_of, multipliers, factor
):
    unit, multiplier = (67, "QbZ", "TimeUS,Id,Label"), (68, "Qbd", "TimeUS,Id,Mult")
    of_message = (69, "QBNN", "TimeUS,FmtType,UnitIds,MultIds")
    tables = {"UNIT": unit, "MULT": multiplier, "FMTU": of_message}
    extra = b"".join(
        format_record(number, name, *form) for name, (number, *form) in tables.items()
    )
    extra += logs.records(
        unit, 4, Id=[*b"Ekos"], Label=["rad/s", "deg/s", "m/s/s", "s"]
    ).tobytes()
    extra += logs.records(
        multiplier, 4, Id=[*b"-0FC"], Mult=[0.0, 1.0, 1e-6, 1e-3]
    ).tobytes()
    extra += logs.records(
        of_message,
        FmtType=logs.MESSAGES["IMU"][0],
        UnitIds=units_of,
        MultIds=multipliers,
    ).tobytes()
    made = units(seconds=8.0)
    found, _ = messages(log(tmp_path, "IMU", made, extra=extra))
    np.testing.assert_allclose(
        found["/imu_2"][1], made[1].rate * FLU * factor, rtol=1e-12
    )


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_a_number_of_a_unit_or_an_error_that_is_none_is_no_defect(tmp_path, number):
    unit, error = (67, "fZ", "Id,Label"), (90, "Qff", "TimeUS,Subsys,ECode")
    extra = (
        format_record(67, "UNIT", *unit[1:])
        + logs.records(unit, Id=number, Label="deg/s").tobytes()
    )
    extra += (
        format_record(90, "ERR", *error[1:])
        + logs.records(error, Subsys=number, ECode=1.0).tobytes()
    )
    found, damage = messages(log(tmp_path, "IMU", units(seconds=8.0), extra=extra))
    assert (list(found), damage) == (topics_of("IMU"), ())


def test_what_was_appended_is_read_from_its_offset(tmp_path):
    """As after a crash: the message before it is cut off."""
    path = log(tmp_path, "sensor_gyro", gps=False)
    data, (whole, _) = path.read_bytes(), messages(path)
    size = logs.ulog_type("sensor_gyro").itemsize
    cut = len(data) - 300 * size - 20
    flags = struct.pack("<8s8s3Q", bytes(8), b"\1" + bytes(7), cut, 0, 0)
    # There the numbers of topics are given anew.
    again = b"".join(
        logs.ulog_message(b"A", struct.pack("<BH", k, k) + b"sensor_gyro")
        for k in (2, 1, 0)
    )
    later = again + data[len(data) - 300 * size :]
    path.write_bytes(
        data[:16]
        + struct.pack("<HB", 40, ord("B"))
        + flags
        + data[16 + 43 : cut]
        + later
    )
    found, damage = messages(path)
    assert damage == ()
    assert sum(len(one[2]) for one in found.values()) == 2400 - 1
    assert all({*found[name][2]} <= {*sent} for name, (_, _, sent) in whole.items())


def test_dropouts_of_the_logger_are_told(tmp_path):
    dropouts = b"".join(
        logs.ulog_message(b"O", struct.pack("<H", ms)) for ms in (120, 3000)
    )
    path = log(tmp_path, "sensor_gyro")
    path.write_bytes(path.read_bytes() + dropouts)
    _, damage = messages(path)
    assert damage == (
        "log.ulg: the logger dropped out 2 times, for 3.12 s in all and 3 s at most",
    )


@EITHER
def test_what_is_read_does_not_depend_on_the_portions(tmp_path, kind, monkeypatch):
    path = log(tmp_path, kind)
    whole = messages(path)
    monkeypatch.setattr(dataflash, "_PORTION_BYTES", 5000)
    monkeypatch.setattr(ulog.Ulog, "together", 50)
    monkeypatch.setattr(flight_log, "_LOG_BATCH", 64)
    cut = messages(path)
    assert cut[1] == whole[1]
    assert [one[2] for one in cut[0].values()] == [one[2] for one in whole[0].values()]


@EITHER
def test_of_a_log_damaged_or_cut_off_all_else_is_read_and_nothing_invented(
    tmp_path, kind
):
    path = log(tmp_path, kind)
    data, (whole, _) = path.read_bytes(), messages(path)
    draw = random.Random(1)
    for k in range(14):
        at = draw.randrange(len(data) // 6, len(data) - 3000)
        size = draw.choice((1, 10, 1000))
        gone, new = (
            draw.choice(((size, 0), (size, size), (0, size)))
            if k < 8
            else (len(data), 0)
        )
        path.write_bytes(data[:at] + draw.randbytes(new) + data[at + gone :])
        found, damage = messages(path)
        for name, (_, _, sent) in found.items():
            # Of a message whose values alone are hit there is nothing to tell.
            assert len({*sent} - {*whole[name][2]}) <= (
                1 + 2 * (new == gone) * size // 50
            ) * (k < 8)
        counts = [len(one[2]) for one in found.values()]
        assert len(damage) <= 2
        assert damage or (new == gone and sum(counts) == 2400) or k >= 8
        if k >= 8:
            # At most the last message of the three is cut.
            assert max(counts) - min(counts) <= 1
            assert sum(counts) >= 2400 * at / len(data) - 60
        else:
            # pyulog stops at a message that is longer than the rest of the file.
            assert sum(counts) >= (2400 - 40 - size // 20 if kind == "IMU" else 200)


@EITHER
def test_damaged_times_are_left_out_and_a_gap_is_not(tmp_path, kind):
    made = units(seconds=8.0, apart=137)
    stamp = made[1].stamp
    stamp[400:] += 3600 * 10**6
    path = log(tmp_path, kind, made)
    data, day = path.read_bytes(), 86400 * 10**6
    damaged = {0: 3 * day, 100: -9 * 10**6, 300: day, 301: day, 399: 20 * day}
    for k, by in damaged.items():
        assert data.count(struct.pack("<Q", stamp[k])) == 1
        data = data.replace(
            struct.pack("<Q", stamp[k]), struct.pack("<Q", stamp[k] + by)
        )
    path.write_bytes(data)
    found, damage = messages(path)
    # What is 9 s too early is not told from what is late.
    expected = np.delete(
        stamp + 10**6 * np.array([-9 * (k == 100) for k in range(len(stamp))]),
        [0, 300, 301, 399],
    )
    assert sorted(found[topics_of(kind)[1]][0]) == sorted(UTC + (expected - FIX) * 1000)
    assert [line.partition(": ")[2] for line in damage] == [
        "samples with impossible times were left out"
    ]


@EITHER
def test_a_log_gives_the_verdicts_of_the_bag_made_of_it(tmp_path, kind, fdi):
    path, config = (
        log(tmp_path, kind, units(seconds=20.0, apart=700)),
        tmp_path / "made.yaml",
    )
    assert fdi("inspect", path, "--write", config, "--quiet").code == 0
    assert Config.from_file(config).topics == tuple(topics_of(kind))
    assert fdi("convert", path, "--output", tmp_path / "converted", "--quiet").code == 0
    found, words = (
        [],
        [
            "--config",
            config,
            "--fault",
            "channel=imu_2.y kind=bias size=0.3 start=12",
            "--json",
            "-",
        ],
    )
    for one in (path, tmp_path / "converted"):
        figures = json.loads(fdi("replay", one, *words, "--quiet").out)
        assert figures["faults"][0]["isolated"]
        assert figures["declared"] == []
        for unit in figures["units"]:
            # A bag has no word of the message in the log.
            unit.pop("origin")
            unit.pop("temperature_c")
        found.append(
            {
                key: value
                for key, value in figures.items()
                if key not in ("bag", "seconds", "us_per_sample")
            }
        )
    assert found[0] == found[1]


def thinned(unit, kept):
    return type(unit)(*(values[kept] for values in vars(unit).values()))


@EITHER
@pytest.mark.parametrize(
    ("kept", "words"),
    [
        (slice(None, None, 20), "is logged at 5 Hz, expected at least 20 Hz"),
        (slice(1), "has too few samples to judge its rate (1)"),
    ],
)
def test_a_unit_that_is_logged_slowly_or_hardly_is_left_out(
    tmp_path, kind, kept, words
):
    made = units(seconds=8.0)
    made[1] = thinned(made[1], kept)
    path = log(tmp_path, kind, made)
    found, damage = messages(path)
    assert list(found) == topics_of(kind)[::2]
    origin = "IMU[1]" if kind == "IMU" else "sensor_gyro 1"
    assert damage == (f"{path.name}: {origin} {words}, and was left out",)


def test_a_sensor_logged_twice_is_read_once(tmp_path):
    """GYR has all samples of the sensors, before and, as further instances, after the filters."""
    raw = log(tmp_path, "GYR", units(6, seconds=8.0, rate=200.0)).read_bytes()
    path = tmp_path / "both.bin"
    path.write_bytes(raw + log(tmp_path, "IMU", units(3, seconds=8.0)).read_bytes())
    found, _ = messages(path)
    assert {name: len(one[0]) for name, one in found.items()} == {
        "/imu_1": 1600,
        "/imu_2": 1600,
        "/imu_3": 1600,
    }


def filtered(unit):
    """What is logged of the same samples behind a filter."""
    rate = np.stack(
        [np.convolve(axis, np.full(5, 0.2))[: len(axis)] for axis in unit.rate.T],
        axis=1,
    )
    return type(unit)(unit.stamp, rate.astype("f4"), unit.acceleration)


@pytest.mark.parametrize("count", [2, 3])
@pytest.mark.parametrize("apart", [0, 137])
def test_a_sensor_logged_before_and_after_its_filters_is_read_once(
    tmp_path, count, apart
):
    """Without IMU, which has the number of sensors; also if all are sampled at once, as in a simulation."""
    made = units(count, seconds=8.0, apart=apart)
    path = log(tmp_path, "GYR", [*made, *map(filtered, made)])
    data = path.read_bytes()
    # Where the logger falls behind some records are missing.
    size = logs.record_type(*logs.MESSAGES["GYR"][1:]).itemsize
    at = data.index(struct.pack("<Q", made[0].stamp[200])) - 12
    path.write_bytes(data[:at] + data[at + size :])
    found, damage = messages(path)
    assert list(found) == topics_of("GYR", count)
    assert (found[f"/imu_{count}"][1][-500:] == made[-1].rate[-500:] * FLU).all()
    words = [
        f"log.BIN: GYR {count + k} has the times of GYR {k}: taken for the same sensor"
        for k in range(count)
    ]
    assert [line[: len(words[0])] for line in damage] == words


@EVERY
@pytest.mark.parametrize("gps", [True, False])
def test_a_log_ends_where_the_time_steps_back(tmp_path, kind, gps, monkeypatch):
    """There the log of another flight begins; its GPS says nothing of the first."""
    monkeypatch.setattr(dataflash, "_PORTION_BYTES", 50_000)
    path = log(tmp_path, kind, units(seconds=8.0, start=11.0, apart=137), gps=gps)
    data = path.read_bytes()
    whole = messages(path)[0]
    second = log(tmp_path, kind, units(seconds=20.0, start=7.0, seed=1)).read_bytes()
    path.write_bytes(data + second)
    found, damage = messages(path)
    assert {name: sent for name, (_, _, sent) in found.items()} == {
        name: sent for name, (_, _, sent) in whole.items()
    }
    (line,) = damage
    assert (
        "the time steps back"
        if KINDS[kind][1] is write_dataflash
        else "a second log begins"
    ) in line
    assert f" at byte {len(data)}" in line
    assert f"the {len(second)} bytes" in line


@pytest.mark.parametrize(
    ("kind", "setting"),
    [
        ("IMU", "on ArduPilot, set LOG_BITMASK bit 18"),
        ("sensor_gyro", "logger_topics.txt"),
    ],
)
@pytest.mark.parametrize(
    ("rate", "kept", "words"),
    [
        (100.0, slice(2), "at 100 Hz, 2 samples; needed: two IMUs"),
        (100.0, slice(9), "at 100 Hz, 9 samples; needed: two IMUs"),
        (100.0, slice(1), "once; needed: two IMUs"),
        (
            18.0,
            slice(None),
            "at 18 Hz; needed: two IMUs or more, each with 20 samples or more at 20 Hz or more",
        ),
        (100.0, np.arange(800) % 20 < 2, "at 10.1 Hz; needed: two IMUs"),
    ],
)
def test_why_a_log_is_refused_and_the_setting_that_helps(
    tmp_path, kind, setting, rate, kept, words
):
    said = refusal(
        log(
            tmp_path,
            kind,
            [thinned(unit, kept) for unit in units(seconds=8.0, rate=rate)],
        )
    )
    assert (
        f"too few samples to compare two IMUs: it has {kind} of 3 IMUs {words}" in said
    )
    assert setting in said
    assert 'docs/flight_logs.md, "Settings of the logger"' in said


@EITHER
def test_a_rate_at_the_limit_is_read_with_jitter(tmp_path, kind):
    made = units(seconds=20.0, rate=20.0)
    for unit in made:
        unit.stamp[::2] += 8000
    found, damage = messages(log(tmp_path, kind, made))
    assert (len(found), damage) == (3, ())


LACKS = "which is not read (its format lacks a field"


@pytest.mark.parametrize(
    ("kind", "before", "after", "words"),
    [
        ("sensor_gyro_fifo", b"int16_t[32] y", b"int16_t[31] y", LACKS),
        ("sensor_gyro_fifo", b"int16_t[32] y", b"int16_t[00] y", LACKS),
        ("vehicle_imu", b"float[3] delta_angle;", b"float[9] delta_angle;", LACKS),
        ("vehicle_imu", b"float[3] delta_angle;", b"float[99999] delta__;", LACKS),
        ("sensor_gyro", b"uint8_t[3] clip", b"nested_[3] clip", LACKS),
        (
            "sensor_gyro",
            b"(\0B" + bytes(9),
            b"(\0B" + bytes(8) + b"\2",
            "is a ULog of a later version",
        ),
    ],
)
def test_a_topic_of_another_form_is_not_read(tmp_path, kind, before, after, words):
    path = log(tmp_path, kind)
    data = path.read_bytes()
    assert data.count(before) == 1
    path.write_bytes(data.replace(before, after))
    assert words in refusal(path)


@pytest.mark.parametrize(
    "nested",
    [
        {"part": "uint16_t[3] a;inner b;float c;", "inner": "uint8_t[2] a;part b;"},
        {"part": "inner[999] a;", "inner": "inne_[999] a;", "inne_": "uint8_t[999] a;"},
        {"part": "l0 a;"}
        | {f"l{k}": f"l{k + 1} a;" for k in range(1500)}
        | {"l1500": "uint8_t[16] a;"},
    ],
    ids=["within itself", "too large", "too deep"],
)
def test_formats_that_nest_without_end_are_refused(tmp_path, nested, monkeypatch):
    form = logs.ULOG_FORMATS["sensor_gyro"].replace(
        "float x;", "part[2] parts;float x;"
    )
    for name, text in {"sensor_gyro": form, **nested}.items():
        monkeypatch.setitem(logs.ULOG_FORMATS, name, text)
    monkeypatch.setitem(logs.ULOG_TYPES, "part", "V16")
    assert "defines a message of more than 1000 fields" in refusal(
        log(tmp_path, "sensor_gyro")
    )


def test_instances_without_end_are_no_instances(tmp_path):
    """Each would be a topic."""
    size, path = 30_000, tmp_path / "log.bin"
    message = (70, "QQfff", "TimeUS,I,GyrX,GyrY,GyrZ")
    records = logs.records(
        message, size, TimeUS=1000 * np.arange(size), I=np.arange(size)
    )
    path.write_bytes(format_record(70, "IMU", *message[1:]) + records.tobytes())
    assert "this autopilot logged no other (IMU of 1 IMU at 1000 Hz)" in refusal(path)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.bin", b"", "is empty"),
        (
            "a.bin",
            b"ULog\x01\x12\x35",
            "is no log of ArduPilot: it starts with the text 'UL'",
        ),
        ("a.ulg", b"a\nb c d e", "is no log of PX4: it starts with the text 'a b c d'"),
        (
            "a.ulg",
            b"\xa3\x95\x80" * 9,
            "is no log of PX4: it starts with the bytes a3 95 80 ",
        ),
        ("a.ulg", logs.ULOG_HEAD + bytes(4), "Header too short"),
        (
            "a.bin",
            b"\xa3\x95\x80" * 900,
            "has no IMU or GYR or IMT, it has 1 unknown. ",
        ),
        (
            "a.ulg",
            b"ULog\x01\x12\x35" + b"Z" * 900,
            "has no vehicle_imu or sensor_gyro or sensor_gyro_fifo, it has",
        ),
        (
            "a.log",
            b"FMT, 128",
            "expected a rosbag2 folder, a .mcap, .db3, .bag, .csv, .tsv, .bin, .ulg, .ulog or .tlog file",
        ),
    ],
)
def test_what_is_no_log_is_refused(tmp_path, name, content, words):
    (tmp_path / name).write_bytes(content)
    assert words in refusal(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "write", "library", "bound"),
    [
        ("log.ulg", lambda path: write_ulog(path, units(seconds=1.0)), "pyulog", 256),
        ("log.tlog", logs.write_tlog, "pymavlink", 128),
    ],
)
def test_a_log_that_a_library_reads_needs_it_and_has_a_bound(
    tmp_path, name, write, library, bound, refused, monkeypatch
):
    """Of its size, which is told before anything is read."""
    path = write(tmp_path / name)
    with monkeypatch.context() as without:
        without.setitem(sys.modules, library, None)
        with pytest.raises(
            FdiError, match=rf"needs {library}: .*pip install .*{library}$"
        ):
            Recording(path)
    os.truncate(path, 300 << 20)
    words = f"{name} has 300 MB, expected at most {bound}: such a log is read whole"
    assert words in refused("inspect", path)


@pytest.mark.parametrize(
    ("kind", "content"),
    [
        (b"L", b"6" + bytes(8) + "\N{GRINNING FACE}".encode()),
        (b"P", b"\x09int32_t a" + bytes(4)),
        (b"O", b"\1\0"),
        (b"A", b"\0\xff\0sensor_gyro"),
    ],
)
def test_what_a_library_would_keep_of_a_log_is_bounded(tmp_path, kind, content):
    """A million of its objects would take hundreds of megabytes; the samples before them are read."""
    path = log(tmp_path, "sensor_gyro")
    path.write_bytes(path.read_bytes() + logs.ulog_message(kind, content) * 600_000)
    with bounded(growth=250 << 10):
        found, damage = messages(path)
    assert len(found["/imu_2"][0]) == 800
    assert any("it is cut off or damaged: read up to byte" in line for line in damage)


def test_of_a_default_log_of_px4_the_means_are_a_coarse_check(tmp_path):
    """Means that were not taken at mostly the same time are not compared; the others get a common stamp."""
    made = units(seconds=60.0, rate=1.0)
    for unit, late in zip(made, (0, 20_000, -15_000), strict=True):
        unit.stamp += late
    made[2].stamp[30:40] += 200_000
    found, (_, said) = messages(log(tmp_path, "vehicle_imu_status", made))
    kept = np.delete(np.arange(60), np.arange(30, 40))
    for unit, (stamp, rate, _) in zip(made, found.values(), strict=True):
        assert (stamp == UTC + (made[0].stamp[kept] - 50_000 - FIX) * 1000).all()
        np.testing.assert_array_equal(rate, unit.rate[kept] * FLU)
    assert "A COARSE CHECK" in said
    assert "noise, vibration and short faults cannot be seen" in said


def test_a_default_log_shows_a_bias_and_no_more_than_that_is_said(tmp_path, fdi):
    made, config = units(seconds=300.0, rate=1.0), tmp_path / "made.yaml"
    for faulty in (False, True):
        made[1].rate[150:, 1] += 0.1 * faulty
        path = log(tmp_path, "vehicle_imu_status", made)
        assert (
            "A COARSE CHECK" in fdi("inspect", path, "--output", config, "--force").out
        )
        check = "imu_1.y faulty" if faulty else "declared=0"
        replayed = fdi("replay", path, "--config", config, "--check", check)
        assert replayed.code == 0, replayed
        assert "A COARSE CHECK" in replayed.out
    assert "A COARSE CHECK" in fdi("convert", path, "--output", tmp_path / "bag").out


def test_the_flight_beside_the_rates_is_found_in_a_log(tmp_path):
    """Modes have ArduPilot's names, throttle is a share, an IMU has its own device."""
    mode = (91, "QMBB", "TimeUS,Mode,ModeNum,Rsn")
    control = (92, "Qff", "TimeUS,ThI,ThO")
    extra = b"".join(
        format_record(number, name, form, columns)
        for (number, form, columns), name in ((mode, "MODE"), (control, "CTUN"))
    )
    extra += logs.records(
        logs.MESSAGES["MSG"], TimeUS=10**7, Message="ArduCopter V4.6.3"
    ).tobytes()
    for at, number in ((11, 5), (12, 5), (14, 9)):
        extra += logs.records(mode, TimeUS=at * 10**6, ModeNum=number).tobytes()
    extra += logs.records(
        control, 3, TimeUS=np.array([10, 12, 14]) * 10**6, ThO=[0.0, 0.5, 0.7]
    ).tobytes()
    extra += logs.records(
        logs.MESSAGES["PARM"], Name="INS_GYR2_ID", Value=2753036.0
    ).tobytes()
    with Recording(log(tmp_path, "IMU", units(seconds=8.0), extra=extra)) as opened:
        context = opened.context
    assert context.origins == {
        "/imu_1": "IMU[0]",
        "/imu_2": "IMU[1], device 2753036",
        "/imu_3": "IMU[2]",
    }
    assert [one.name for one in context.modes] == ["LOITER", "LAND"]
    first, second = (one.stamp - UTC for one in context.modes)
    assert (first, second) == (6 * 10**9, 9 * 10**9)
    assert context.throttle.value.tolist() == pytest.approx([0.0, 0.5, 0.7])
    # The logs of the tests have zeros for temperatures: there is no thermometer.
    assert context.temperatures == {}


def test_a_course_keeps_its_extent_in_bounded_memory():
    course = Thinned(0.0, 100.0)
    stamp = np.arange(200_000) * 100_000
    for part in np.split(stamp, 100):
        course.add(part, np.full(len(part), 20.0))
    course.add(stamp[-1:], np.array([np.nan]))
    kept = course.course(shift=5)
    assert KEPT.values // 2 - 1 <= len(kept.stamp) <= KEPT.values
    assert kept.stamp[0] == 5000
    assert kept.stamp[-1] > 0.99e3 * stamp[-1]
    assert (np.diff(kept.stamp) > 0).all()
