# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Telemetry logs of ground stations: read as pymavlink reads them, of one autopilot, damaged or not."""

import contextlib
import os
import struct

import numpy as np
import pytest
from bag import test_logs as logs
from bag.logs import SCALED, UTC, telemetry
from hypothesis import given, settings
from hypothesis import strategies as st
from mavlink.autopilots import NS, Autopilot
from pymavlink import mavutil

from fdi_ros.bag.reader import Recording
from fdi_ros.bag.tlog import Tlog
from fdi_ros.errors import BagError


def messages(path, topic):
    """Rates of a topic by stamp."""
    stamp, rate, _ = logs.messages(path)[0][topic]
    return dict(zip(stamp.tolist(), map(tuple, rate.tolist()), strict=True))


def written(path, data):
    path.write_bytes(data)
    return path


def shown(path):
    """All that an opened log says."""
    with Recording(path) as recording:
        said = [recording.topics, recording.texts, recording.system, recording.context]
        batches = list(recording.batches([one.name for one in recording.topics]))
        sent = [one.buffer.tobytes() for one in batches]
        return repr([*said, recording.hardware_id, recording.damage.report()]), sent


@pytest.mark.parametrize("beats", [True, False])
def test_a_log_that_is_opened_again_says_the_same_and_another_one_its_own(
    tmp_path, monkeypatch, beats
):
    """Also one of the same name, length and time of change; in the first some bytes are lost."""
    left_out = () if beats else (0,)  # HEARTBEAT
    data = telemetry(Autopilot("ardupilot", rates=SCALED), left_out=left_out) + b"lost"
    path = written(tmp_path / "a.tlog", data)
    os.utime(path, (1, 1))
    monkeypatch.setattr(Tlog, "_read_last", (b"", {}, {}))
    first = shown(path)
    assert "bytes belong to no whole record" in first[0]
    assert ("no HEARTBEAT" in first[0]) == (not beats)
    with monkeypatch.context() as patch:
        patch.setattr(Tlog, "_decode", None)
        assert shown(path) == shown(path) == first
    other = telemetry(Autopilot("ardupilot", rates=SCALED, seed=5), seconds=7.0)
    path.write_bytes(other[: len(data)])
    os.utime(path, (1, 1))
    again = shown(path)
    assert again[1] != first[1]
    monkeypatch.setattr(Tlog, "_read_last", (b"", {}, {}))
    assert shown(path) == again


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("stack", ["px4", "ardupilot"])
def test_values_and_times_are_those_that_pymavlink_reads(tmp_path, stack, version):
    rates = {**SCALED, 27: 10.0, 105: 10.0}
    path = written(
        tmp_path / "FLIGHT.TLOG",
        telemetry(Autopilot(stack, rates=rates), version=version),
    )
    with Recording(path) as recording:
        assert [(topic.name, topic.count) for topic in recording.topics] == [
            (f"/imu_{k}", 300) for k in (1, 2, 3)
        ]
        assert not recording.damage
    theirs, late = {"SCALED_IMU": [], "SCALED_IMU2": [], "SCALED_IMU3": []}, []
    with contextlib.closing(mavutil.mavlink_connection(str(path))) as log:
        while (message := log.recv_match(type=[*theirs])) is not None:
            theirs[message.get_type()].append(message)
    for number, sent in enumerate(theirs.values(), 1):
        found = messages(path, f"/imu_{number}")
        assert (
            np.diff(list(found))
            == np.diff([one.time_boot_ms for one in sent]) * 1_000_000
        ).all()
        expected = [
            (1e-3 * one.xgyro, -1e-3 * one.ygyro, -1e-3 * one.zgyro) for one in sent
        ]
        np.testing.assert_allclose(list(found.values()), expected, atol=1e-12)
        late += [
            one._timestamp - stamp / 1e9 for one, stamp in zip(sent, found, strict=True)
        ]
    # UTC is that of the least delayed message of all.
    assert -1e-6 <= min(late) < 1e-6
    assert max(late) < 0.012


SPOKE = 4.0
"""Time of a text, a mode and a throttle, s of the autopilot."""


def spoken(pace, damaged=()):
    """Return a log in which the autopilot's time passes at a pace that changes at half of `SPOKE`.

    The ground station notes its own time. Of some samples near the text, by number, that time is
    damaged.
    """
    autopilot = Autopilot("ardupilot", rates=SCALED)
    out, number = b"", 0
    for now in range(0, 6 * NS, 1_000_000):
        slow = max(now - round(SPOKE / 2 * NS), 0)
        came = (UTC + now + round(slow * (1 / pace - 1))) // 1000 + 5000
        for data in autopilot.step(now):
            if data[7] | data[8] << 8 in SCALED and now >= SPOKE * NS:
                number += 1
            wrong = 30_000_000 * (number in damaged)
            out += struct.pack(">Q", came + wrong) + data
        if now == SPOKE * NS:
            mav = autopilot.mav
            for one in (
                mav.statustext_encode(2, b"Crash: Disarming"),
                mav.heartbeat_encode(2, 3, 1, 9, 4),
                mav.vfr_hud_encode(0, 0, 0, 70, 0, 0),
            ):
                out += struct.pack(">Q", came) + bytes(one.pack(mav))
    return out


@pytest.mark.parametrize("damaged", [(), (1, 2, 3, 4)])
@pytest.mark.parametrize("pace", [0.6, 1.0, 4.0])
def test_a_text_is_at_the_time_of_the_samples_around_it(tmp_path, pace, damaged):
    """A simulation is slower or faster than the clock of the ground station."""
    path = written(tmp_path / "slow.tlog", spoken(pace, damaged))
    first = min(messages(path, "/imu_1")) / 1e9
    with Recording(path) as recording:
        (text,) = recording.texts
        modes = {one.name: one.stamp for one in recording.context.modes}
        throttle = recording.context.throttle
    assert text.text == "Crash: Disarming"
    for stamp in (text.stamp, modes["LAND"], throttle.stamp[-1]):
        assert abs(stamp / 1e9 - first - SPOKE) < 0.05


def test_the_bundled_copter_hits_the_ground_when_its_gyros_jump(root):
    """Its simulation lost more than a second."""
    path = root / "bags" / "copter_crash.tlog"
    stamp, rate, _ = logs.messages(path)[0]["/imu_1"]
    hit = stamp[np.argmax(np.abs(rate).max(axis=1) > 10.0)]
    with Recording(path) as recording:
        (text,) = [one for one in recording.texts if "Hit ground" in one.text]
    assert abs(text.stamp - hit) < 0.1 * NS


def test_of_two_vehicles_the_first_is_read(tmp_path):
    one, other = (
        Autopilot("px4", rates=SCALED, system=5),
        Autopilot("ardupilot", rates=SCALED, system=9, seed=4),
    )
    alone = Autopilot("px4", rates=SCALED, system=5)
    mixed, alone = (
        messages(written(tmp_path / "a.tlog", telemetry(*some)), "/imu_2")
        for some in ((one, other), (alone,))
    )
    assert list(mixed.values()) == list(alone.values())


def test_what_has_no_two_imus_is_refused(tmp_path):
    """Ten a second are enough, two are not; nor raw counts, which of autopilots other than ArduPilot are no rates."""
    path = written(
        tmp_path / "a.tlog", telemetry(Autopilot(rates=dict.fromkeys(SCALED, 10.0)))
    )
    assert len(messages(path, "/imu_3")) == 60
    slow = telemetry(Autopilot(rates=dict.fromkeys(SCALED, 2.0)), seconds=20.0)
    one = Autopilot("ardupilot", rates={27: 50.0}, units=1)
    raw = telemetry(one)
    beat = bytes(one.mav.heartbeat_encode(2, 4, 0, 0, 4).pack(one.mav))
    for data, words in (
        (
            slow,
            r"at 2 Hz; needed: two IMUs .* at 5 Hz or more. What to do: on ArduPilot, raise SRn_RAW_SENS",
        ),
        (raw, "one IMU cannot be checked: this autopilot sent no other"),
        (struct.pack(">Q", UTC // 1000) + beat + raw, "has no SCALED_IMU"),
        (telemetry(Autopilot()), "has no SCALED_IMU"),
        (b"FMT, 128, 89", "is no log of a ground station"),
    ):
        with pytest.raises(BagError, match=words):
            Recording(written(path, data))


def test_raw_imu_of_ardupilot_stands_in_for_imu_1(tmp_path):
    """What its ground stations ask for (RAW_SENS) is RAW_IMU, SCALED_IMU2 and SCALED_IMU3."""
    path = written(
        tmp_path / "a.tlog",
        telemetry(Autopilot("ardupilot", rates={27: 50.0, 116: 50.0}, units=2)),
    )
    first, second = messages(path, "/imu_1"), messages(path, "/imu_2")
    assert len(first) == len(second) == 300
    assert np.abs(np.array(list(first.values())) - list(second.values())).max() < 0.02


LOG = telemetry(Autopilot("px4", rates=SCALED), seconds=3.0)


@settings(max_examples=25)
@given(
    places=st.lists(
        st.tuples(st.integers(0, len(LOG) - 1), st.binary(max_size=40)),
        min_size=1,
        max_size=6,
    ),
    cut=st.integers(0, len(LOG) // 4),
)
def test_damage_is_read_around(tmp_path_factory, places, cut):
    """Whatever is overwritten or missing: what is read was in the log, and the rest is counted."""
    data, path = bytearray(LOG), tmp_path_factory.mktemp("tlog") / "damaged.tlog"
    whole = set(messages(written(path, LOG), "/imu_1").values())
    for at, piece in places:
        data[at : at + len(piece)] = piece
    try:
        found = messages(written(path, data[: len(LOG) - cut]), "/imu_1")
    except BagError:
        return
    assert len(found) >= 150 - cut // 40 - 60
    # The checksum leaves one wrong message of 65536.
    assert len(set(found.values()) - whole) <= 1
