# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Telemetry logs of ground stations: read as pymavlink reads them, of one autopilot, damaged or not."""

import struct

import numpy as np
import pytest
from bag.test_logs import refusal
from hypothesis import given, settings
from hypothesis import strategies as st
from mavlink.autopilots import NS, Autopilot
from pymavlink import mavutil

from fdi_ros.bag.reader import Recording
from fdi_ros.errors import BagError
from fdi_ros.sources.imus import ImuSource

UTC = 1_790_000_000_000_000
"""Of the start of a log, us."""
SCALED = {26: 50.0, 116: 50.0, 129: 50.0}


def record(*autopilots, seconds=6.0, latency=4000, version=2):
    """What a ground station writes down: each message some ms after it was sent."""
    out = b""
    for now in range(0, round(seconds * NS), 1_000_000):
        for autopilot in autopilots:
            for data in autopilot.step(now):
                data = data if version == 2 else as_version_1(autopilot, data)
                out += struct.pack(">Q", UTC + now // 1000 + latency + int(autopilot.random.integers(3000))) + data
    return out


def as_version_1(autopilot, data):
    (message,) = autopilot.inbound.parse_buffer(data)
    return bytes(message.pack(autopilot.mav, force_mavlink1=True))


def messages(path, topic):
    with Recording(path) as recording:
        batches = list(recording.batches([topic]))
        return dict(ImuSource.parse(batch.message(k), 3) for batch in batches for k in range(len(batch)))


def written(path, data):
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("stack", ["px4", "ardupilot"])
def test_values_and_times_are_those_that_pymavlink_reads(tmp_path, stack, version):
    rates = {**SCALED, 27: 10.0, 105: 10.0}
    path = written(tmp_path / "FLIGHT.TLOG", record(Autopilot(stack, rates=rates), version=version))
    with Recording(path) as recording:
        assert [(topic.name, topic.count) for topic in recording.topics] == [(f"/imu_{k}", 300) for k in range(3)]
        assert not recording.damage
    log = mavutil.mavlink_connection(str(path))
    theirs = {}
    while (message := log.recv_match(type=["SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3"])) is not None:
        rate = (message.xgyro * 1e-3, -message.ygyro * 1e-3, -message.zgyro * 1e-3)
        theirs.setdefault(message.get_type(), []).append((message.time_boot_ms, rate, message._timestamp))
    log.close()
    late = []
    for number, name in enumerate(("SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3")):
        found = messages(path, f"/imu_{number}")
        stamps = np.array(list(found))
        boot = np.array([one[0] for one in theirs[name]])
        assert (np.diff(stamps) == np.diff(boot) * 1_000_000).all()
        np.testing.assert_allclose(list(found.values()), [one[1] for one in theirs[name]], atol=1e-12)
        late += [one[2] - stamp / 1e9 for one, stamp in zip(theirs[name], stamps.tolist(), strict=True)]
    # UTC is that of the least delayed message of all.
    assert -1e-6 <= min(late) < 1e-6
    assert max(late) < 0.012


def test_raw_imu_of_ardupilot_stands_in_for_imu_1(tmp_path):
    """What its ground stations ask for (RAW_SENS) is RAW_IMU, SCALED_IMU2 and SCALED_IMU3."""
    path = written(tmp_path / "a.tlog", record(Autopilot("ardupilot", rates={27: 50.0, 116: 50.0, 129: 50.0})))
    first, second = messages(path, "/imu_0"), messages(path, "/imu_1")
    assert len(first) == len(second) == 300
    assert np.abs(np.array(list(first.values())) - list(second.values())).max() < 0.02


def test_of_two_vehicles_the_first_is_read(tmp_path):
    one, other = Autopilot("px4", rates=SCALED, system=5), Autopilot("ardupilot", rates=SCALED, system=9, seed=4)
    mixed, alone = tmp_path / "mixed.tlog", tmp_path / "alone.tlog"
    written(mixed, record(one, other))
    written(alone, record(Autopilot("px4", rates=SCALED, system=5)))
    assert list(messages(mixed, "/imu_1").values()) == list(messages(alone, "/imu_1").values())


def test_ten_a_second_are_enough_and_two_are_not(tmp_path):
    path = written(tmp_path / "slow.tlog", record(Autopilot(rates=dict.fromkeys(SCALED, 10.0))))
    assert len(messages(path, "/imu_2")) == 60
    written(path, record(Autopilot(rates=dict.fromkeys(SCALED, 2.0)), seconds=20.0))
    with pytest.raises(BagError, match=r"at 2 Hz; needed: two IMUs .* at 5 Hz or more, .* ArduPilot: SRn_RAW_SENS"):
        Recording(path)


def test_a_log_without_imus_or_of_no_log_is_refused(tmp_path):
    path = written(tmp_path / "some.tlog", record(Autopilot()))
    with pytest.raises(BagError, match="has no SCALED_IMU"):
        Recording(path)
    with pytest.raises(BagError, match="is no log of a ground station"):
        Recording(written(tmp_path / "text.tlog", b"FMT, 128, 89"))


def test_raw_counts_of_other_autopilots_are_not_taken_for_rates(tmp_path):
    autopilot = Autopilot("ardupilot", rates={27: 50.0, 116: 50.0}, units=2)
    data = record(autopilot)
    assert len(messages(written(tmp_path / "a.tlog", data), "/imu_0")) == 300
    autopilot = Autopilot("ardupilot", rates={27: 50.0}, units=1)
    data = record(autopilot)
    assert "this autopilot sent one IMU" in refusal(written(tmp_path / "one.tlog", data))
    beat = autopilot.mav.heartbeat_encode(2, 4, 0, 0, 4)
    strange = struct.pack(">Q", UTC) + bytes(beat.pack(autopilot.mav)) + data
    assert "has no SCALED_IMU" in refusal(written(tmp_path / "b.tlog", strange))


LOG = record(Autopilot("px4", rates=SCALED), seconds=3.0)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Rates of the first IMU in the whole log."""
    return set(messages(written(tmp_path_factory.mktemp("tlog") / "whole.tlog", LOG), "/imu_0").values())


@settings(max_examples=60)
@given(
    places=st.lists(st.tuples(st.integers(0, len(LOG) - 1), st.binary(max_size=40)), min_size=1, max_size=6),
    cut=st.integers(0, len(LOG)),
)
def test_damage_is_read_around(tmp_path_factory, whole, places, cut):
    """Whatever is overwritten or missing: what is read was in the log, and the rest is counted."""
    data = bytearray(LOG)
    for at, piece in places:
        data[at : at + len(piece)] = piece
    path = tmp_path_factory.mktemp("tlog") / "damaged.tlog"
    path.write_bytes(data[: len(LOG) - cut // 4])
    try:
        found = messages(path, "/imu_0")
    except BagError:
        return
    assert len(found) >= 150 - cut // 4 // 40 - 60
    # The checksum leaves one wrong message of 65536.
    assert len(set(found.values()) - whole) <= 1
