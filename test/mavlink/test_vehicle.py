# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The conversation with simulated autopilots: what comes out, what is asked for, and what is refused."""

import re
import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fdi_ros.errors import FdiError
from fdi_ros.mavlink.link import open_link
from fdi_ros.mavlink.report import Reporter
from fdi_ros.mavlink.signing import (
    SigningFile,
    SigningTimes,
    mark_of,
    now_in_steps,
    read_key,
)
from fdi_ros.mavlink.vehicle import parser_of
from mavlink.autopilots import NS, UTC, Autopilot, Conversation

MS = 1_000_000
ROOT = Path(__file__).parents[2]
KEY = bytes(range(32))


def check_flight(
    talk: Conversation, rate: float = 50.0, since: float = 3.0, number: int = 0
) -> None:
    """All units at their rate; every sample is the motion's at its stamp, within resolution and error of the clock."""
    autopilot = talk.autopilots[number]
    for unit in range(autopilot.units):
        samples = talk.of_unit(unit, since)
        assert len(samples) == pytest.approx(since * rate, rel=0.1, abs=2)
        stamps = np.array([sample.stamp for sample in samples])
        assert (np.diff(stamps) > 0).all()
        at = (stamps - autopilot.start) / NS
        truth = np.column_stack(
            [0.5 * np.sin(0.8 * at), -0.4 * np.cos(1.1 * at), -0.3 * np.sin(0.5 * at)]
        )
        error = np.array([sample.rate for sample in samples]) - truth
        # The noise of the motion, a step, and 6 ms of a motion of 0.6 rad/s^2.
        assert np.abs(error).max() < 5 * 0.002 + 0.001 + 0.004
        np.testing.assert_allclose(samples[0].acceleration, [0, 0, 9.80665], atol=1e-6)


@pytest.mark.parametrize("stack", ["px4", "ardupilot"])
@pytest.mark.parametrize("kind", ["", "SCALED_IMU"])
def test_every_unit_comes_at_the_rate_asked_for(stack: str, kind: str) -> None:
    autopilot = Autopilot(stack, boot=-500 * NS)
    talk = Conversation(autopilot, kind=kind, rate=100.0).run(9.0)
    assert talk.vehicle.kind == "SCALED_IMU"
    # What is not used is set back to the autopilot's own rate; nothing else was touched.
    assert set(autopilot.intervals) == {26, 116, 129}
    tried = set() if kind else {105, 27} if stack == "ardupilot" else {105}
    assert {number for _, number, _ in autopilot.commands} == {26, 116, 129} | tried
    check_flight(talk, 100.0)
    assert talk.vehicle.sync.error(talk.now) <= 3.2 * MS
    # Requests alone, as is checked of each: an answer to PX4's own would make it follow our clock.
    assert talk.sent["TIMESYNC"] > 5
    stamps = [
        np.array([sample.stamp for sample in talk.of_unit(k)][-100:]) for k in range(3)
    ]
    # Of one instant, within the resolution.
    assert (
        stack == "px4"
        or max(np.abs(stamps[0] - other).max() for other in stamps[1:]) <= MS
    )


@pytest.mark.parametrize(
    ("autopilot", "kind"),
    [
        # HIGHRES_IMU of PX4 is the selected IMU again, under id 0, with the bias of the estimator taken off.
        (lambda: Autopilot("px4", units=2, rates={105: 200.0}), ""),
        # A third compass is no third IMU.
        (lambda: Autopilot("ardupilot", units=2, compasses=3), "SCALED_IMU"),
    ],
)
def test_one_imu_is_never_its_own_witness_and_a_compass_is_none(
    autopilot: Callable[[], Autopilot], kind: str
) -> None:
    talk = Conversation(autopilot(), kind=kind).run(6.0)
    assert talk.vehicle.kind == "SCALED_IMU"
    assert {sample.unit for _, sample in talk.samples} == {0, 1}
    assert talk.vehicle.magnetometers == ({2} if kind else set())


def reboot(talk: Conversation) -> None:
    talk.autopilots[0].reboot(talk.now)
    talk.run(25.0)


def step(talk: Conversation, seconds: float) -> None:
    """The motion goes on; only the clock is another."""
    talk.autopilots[0].boot -= round(seconds * NS)
    talk.run(8.0)


def cut(talk: Conversation) -> None:
    talk.cut, before = True, len(talk.samples)
    talk.run(20.0)
    assert not talk.vehicle.in_reach
    assert len(talk.samples) <= before + 3
    talk.cut = False
    talk.run(5.0)
    words = list(talk.vehicle.events)
    assert [
        word for word in words if word.startswith(("nothing of ", "again"))
    ] == words[-2:]


def lower(talk: Conversation) -> None:
    """Somebody else lowers the rate: it is asked for again."""
    autopilot = talk.autopilots[0]
    autopilot.intervals = dict.fromkeys(autopilot.intervals, 500_000)
    talk.run(16.0)


@pytest.mark.parametrize("stack", ["px4", "ardupilot"])
@pytest.mark.parametrize(
    ("trouble", "restarts"),
    [
        (reboot, {0, 1}),
        *((partial(step, seconds=by), {1}) for by in (-3000.0, -5.0, 20.0)),
        (cut, {0}),
        (lower, {0}),
    ],
)
def test_after_whatever_happens_all_units_come_as_before(
    stack: str, trouble: Callable, restarts: set[int]
) -> None:
    talk = Conversation(Autopilot(stack, boot=-4000 * NS)).run(5.0)
    trouble(talk)
    assert talk.vehicle.clock.restarts in restarts
    assert ("stepped" in " ".join(talk.vehicle.events)) == bool(
        talk.vehicle.clock.restarts
    )
    check_flight(talk)


def jitter(now: int) -> int:
    return round(np.random.default_rng(now).exponential(20 * MS))


def slow_at_times(now: int) -> int:
    """Round trips of 800 and 10 ms in turn: the first offsets are poor, and better ones are steps."""
    return 5 * MS if (now - 1000 * NS) // (4 * NS) % 2 else 400 * MS


@pytest.mark.parametrize(
    ("latency", "loss", "share"), [(jitter, 0.2, 0.4), (slow_at_times, 0.0, 0.7)]
)
def test_over_a_poor_link_losses_are_counted_and_no_stamp_goes_back(
    latency: Callable, loss: float, share: float
):
    talk = Conversation(
        Autopilot("px4", loss=loss, seed=2), latency=lambda: latency(talk.now)
    )
    talk.run(24.0)
    for unit in range(3):
        stamps = [sample.stamp for sample in talk.of_unit(unit)]
        assert (np.diff(stamps) > 0).all()
        assert len(stamps) > share * 50 * 24
    assert talk.vehicle.counts["lost"] >= 0.5 * loss * talk.vehicle.counts["messages"]
    assert talk.vehicle.clock.restarts == 0


@pytest.mark.parametrize(("ahead", "taken"), [(0.5, 1), (3.0, 0)])
def test_a_sample_from_the_future_is_taken_as_far_as_clocks_may_be_apart(
    ahead: float, taken: int
) -> None:
    one = Autopilot("ardupilot")
    talk = Conversation(one).run(6.0)
    time = round((talk.now - one.boot) * 1e-6 + 1000 * ahead)
    values = (0, 0, 1000, 10, 20, 30, 0, 0, 0)
    message = mavlink.MAVLink_scaled_imu_message(time, *values)
    before = len(talk.samples)
    talk.inject(bytes(message.pack(one.mav)))
    assert len(talk.samples) == before + taken


def test_without_a_system_id_the_one_with_gyros_is_taken_until_it_is_lost() -> None:
    one, other = Autopilot("px4", system=3), Autopilot("px4", system=7, seed=9)
    talk = Conversation(one, other, kind="")
    stranger = mavlink.MAVLink(None, 9, 1)
    beat = bytes(mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3).pack(stranger))
    # A heartbeat that comes first takes nothing from who has gyros, and later ones change nothing.
    talk.inject(beat)
    other.step, steps = lambda now: [], other.step
    talk.run(9.0)
    check_flight(talk, since=2.0)
    for _ in range(20):
        talk.inject(beat)
        talk.run(0.2)
    check_flight(talk)
    one.step, other.step = other.step, steps
    one.take = lambda data, now: []
    talk.run(17.0)
    assert (talk.vehicle.system, talk.vehicle.kind) == (7, "SCALED_IMU")
    check_flight(talk, number=1)


def test_the_same_system_from_another_address_is_left_aside() -> None:
    one, other = (
        Autopilot("px4"),
        Autopilot("px4", seed=5, rates={26: 50, 116: 50, 129: 50}),
    )
    talk = Conversation(one, other, peers=(("a", 1), ("b", 2))).run(6.0)
    check_flight(talk)
    assert talk.vehicle.counts["from elsewhere"] > 500
    assert not other.commands


def test_what_is_refused_or_not_answered_is_said_and_not_asked_without_end() -> None:
    autopilot = Autopilot("px4", refuses={129})
    talk = Conversation(autopilot).run(40.0)
    assert talk.vehicle.streams.answer_to(129) == "failed"
    assert talk.vehicle.streams.answer_to(26) == "accepted"
    assert sum(command[1] == 129 for command in autopilot.commands) == 1
    deaf = Autopilot("px4", rates={26: 10, 116: 10, 129: 10})
    deaf.take = lambda data, now: []
    talk = Conversation(deaf).run(40.0)
    assert talk.vehicle.streams.answer_to(26) == "no answer"
    assert talk.sent["COMMAND_LONG"] <= 20
    assert not talk.vehicle.sync.synchronised
    # It is used all the same, at the rate it gives.
    check_flight(talk, 10.0)


def test_a_message_of_all_units_is_asked_for_again_if_one_unit_comes_slowly() -> None:
    """HIGHRES_IMU brings the IMUs by their ids: a fast one must not hide a slow one."""
    talk = Conversation(Autopilot("px4", units=1), kind="HIGHRES_IMU").run(4.0)
    autopilot = talk.autopilots[0]
    second = mavlink.MAVLink(None, autopilot.system, 1)
    for k in range(5):
        time = autopilot.clock(talk.now) + 20_000 * k
        values = (0.0, 0.0, -9.8, 0.1, 0.0, 0.0, *(0.0,) * 7)
        message = second.highres_imu_encode(time, *values, 0x1FFF, 1)
        talk.inject(bytes(message.pack(second)))
    assert set(talk.vehicle.units) == {0, 1}
    before = len(autopilot.commands)
    talk.run(40.0)
    asked = [number for _, number, _ in autopilot.commands[before:]]
    assert 1 <= asked.count(105) <= 8


def test_raw_imu_of_ardupilot_stands_in_for_an_imu_1_that_does_not_come() -> None:
    """Without requests ArduPilot streams RAW_IMU, SCALED_IMU2, SCALED_IMU3 (RAW_SENS); the first is IMU 1."""
    for kind in ("", "SCALED_IMU"):
        deaf = Autopilot("ardupilot", rates={27: 20, 116: 20, 129: 20})
        deaf.take = lambda data, now: []
        check_flight(Conversation(deaf, kind=kind).run(12.0), 20.0)
    refusing = Autopilot("ardupilot", refuses={26})
    talk = Conversation(refusing).run(12.0)
    assert refusing.intervals.keys() == {27, 116, 129}
    check_flight(talk)


HEX = KEY.hex().encode()


def test_a_key_is_bytes_or_digits_that_nobody_else_can_reach_and_is_never_shown(
    tmp_path: Path,
) -> None:
    path = tmp_path / "key"
    path.touch(0o600)
    for data in (KEY, HEX, HEX.upper() + b"\n"):
        path.write_bytes(data)
        assert read_key(str(path)) == KEY
    for data in (b"", b"secret", KEY[:31], HEX[:-2], bytes(5000)):
        path.write_bytes(data)
        with pytest.raises(
            FdiError, match="is no key: expected 32 bytes, or 64 hexadecimal digits"
        ) as refused:
            read_key(str(path))
        assert not data or data.decode("latin1") not in str(refused.value)
    for mode in (0o640, 0o604, 0o620):
        path.chmod(mode)
        with pytest.raises(FdiError, match="can be read by others: chmod 600"):
            read_key(str(path))


def test_with_a_key_only_what_is_signed_with_it_counts() -> None:
    autopilot = Autopilot("px4", key=KEY, utc=UTC + 1000)
    talk = Conversation(autopilot, key=KEY).run(6.0)
    check_flight(talk)
    # It takes signed commands alone, and ours were taken.
    assert autopilot.inbound.signing.goodsig_count > 10
    assert not autopilot.inbound.signing.badsig_count
    for key in (b"", bytes(32)):
        stranger = Autopilot("px4", key=key, utc=UTC + 1000, rates={26: 50})
        refused = Conversation(stranger, key=KEY).run(4.0)
        assert refused.vehicle.system is None
        assert not refused.samples
        assert refused.vehicle.counts["unsigned"] > 100


def test_a_forged_signature_with_a_late_time_locks_nobody_out() -> None:
    """pymavlink's own check keeps the time of a message before it looks at the signature."""
    autopilot = Autopilot("px4", key=KEY, utc=UTC + 1000)
    talk = Conversation(autopilot, key=KEY).run(4.0)
    forged = mavlink.MAVLink(None, 1, 1)
    forged.signing.secret_key, forged.signing.sign_outgoing = bytes(32), True
    for link in range(256):
        forged.signing.link_id, forged.signing.timestamp = link, (1 << 48) - 1
        talk.inject(
            bytes(mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3).pack(forged))
        )
    replayed = bytes(autopilot.mav.heartbeat_encode(2, 12, 0, 0, 4).pack(autopilot.mav))
    for _ in range(3):
        talk.inject(replayed)
    assert talk.vehicle.counts["unsigned"] == 256 + 2
    assert len(talk.vehicle._verifier._latest) == 1
    talk.run(4.0)
    check_flight(talk)


def test_an_autopilot_whose_signatures_are_behind_is_told_the_time() -> None:
    """One without GPS keeps the time of its last flight; MAVLink has it take over later times that are signed."""
    autopilot = Autopilot("px4", key=KEY, utc=UTC + 1000 - 86_400)
    talk = Conversation(autopilot, key=KEY, peers=("here",)).run(4.0)
    assert talk.vehicle.system is None
    assert talk.vehicle.behind == pytest.approx(86_400, abs=10)
    assert talk.sent_to["here"] >= 3
    link = open_link("udpin:127.0.0.1:14999")
    link.trouble = ""
    said = (
        Reporter(link, talk.vehicle, ["imu_1"], ["/imu_1"])
        .lines("", "", talk.now)[0]
        .message
    )
    assert re.search(
        r"rightly signed messages, but 864\d\d s older than expected", said
    ), said
    assert autopilot.inbound.signing.goodsig_count > 1
    autopilot.mav.signing.timestamp = autopilot.inbound.signing.timestamp
    talk.run(6.0)
    check_flight(talk)


def test_what_was_signed_before_a_restart_is_refused_after_it(tmp_path: Path) -> None:
    """A replayed message must be newer than any that came before the node was stopped."""
    autopilot = Autopilot("px4", key=KEY, utc=UTC + 1000)
    before = Conversation(autopilot, key=KEY)
    recorded: list[bytes] = []
    whole = autopilot.step
    autopilot.step = lambda now: recorded.extend(sent := whole(now)) or sent
    before.run(6.0)
    file = SigningFile(tmp_path / "signing.json")
    file.keep(before.vehicle.signing_times, before.now)
    file.close()

    times = SigningFile(tmp_path / "signing.json").written
    after = Conversation(key=KEY, times=times)
    after.now = before.now + 40 * NS
    for data in recorded:
        after.inject(data)
    assert after.vehicle.system is None
    assert not after.samples
    # The autopilot itself is heard: its times go on.
    autopilot.step = whole
    again = Conversation(autopilot, key=KEY, times=times)
    again.now, autopilot.boot, autopilot.start = (
        before.now,
        autopilot.boot - again.now,
        autopilot.start - again.now,
    )
    check_flight(again.run(6.0))


def test_a_companion_whose_clock_is_behind_knows_the_time_from_before_its_restart() -> (
    None
):
    """Without a time source, a link id not heard before would be taken with any time."""
    day = 86_400 * 100_000
    newest = now_in_steps(UTC + 1000) + day
    talk = Conversation(key=KEY, times=SigningTimes(newest))
    old = mavlink.MAVLink(None, 1, 1)
    old.signing.secret_key, old.signing.sign_outgoing = KEY, True
    old.signing.link_id, old.signing.timestamp = 7, newest - day // 2
    talk.inject(bytes(old.heartbeat_encode(2, 12, 0, 0, 4).pack(old)))
    assert talk.vehicle.system is None
    assert talk.vehicle.behind == pytest.approx(43_200, abs=1)
    # What we sign goes on from there, else the autopilot would refuse it.
    talk.run(1.1)
    assert talk.vehicle.signing_times.newest > newest


def test_an_autopilot_whose_clock_is_ahead_takes_our_messages() -> None:
    """A companion without a time source may be years behind the GPS of the autopilot."""
    year = 365 * 86_400
    autopilot = Autopilot("px4", key=KEY, utc=UTC + 1000 + year)
    check_flight(Conversation(autopilot, key=KEY).run(6.0))
    assert autopilot.inbound.signing.goodsig_count > 10


def test_others_with_the_key_do_not_take_up_the_room_for_the_autopilot() -> None:
    autopilot = Autopilot("px4", key=KEY, utc=UTC + 1000)
    talk = Conversation(autopilot, key=KEY, system=1)
    for system, component in [
        *((k, 1) for k in range(2, 40)),
        *((1, k) for k in range(2, 40)),
    ]:
        other = mavlink.MAVLink(None, system, component)
        other.signing.secret_key, other.signing.sign_outgoing = KEY, True
        other.signing.timestamp = now_in_steps(UTC + 1000)
        talk.inject(bytes(other.heartbeat_encode(2, 12, 0, 0, 4).pack(other)))
    check_flight(talk.run(6.0))


def test_links_that_are_silent_for_long_make_room() -> None:
    """Autopilot and router change their link ids; what is dropped is too old to be taken again."""
    now = now_in_steps(UTC + 1000)
    full = SigningTimes(
        now, tuple(((link, 1, 1), now - 7_000_000) for link in range(16))
    )
    autopilot = Autopilot("px4", key=KEY, utc=UTC + 1000)
    autopilot.mav.signing.link_id = 99
    check_flight(Conversation(autopilot, key=KEY, times=full).run(6.0))
    busy = SigningTimes(now, tuple(((link, 1, 1), now - 1000) for link in range(16)))
    refused = Conversation(
        Autopilot("px4", key=KEY, utc=UTC + 1000), key=KEY, times=busy
    )
    refused.autopilots[0].mav.signing.link_id = 99
    assert not refused.run(3.0).samples


@pytest.mark.parametrize(
    "text",
    [
        "[]",
        "{}",
        '{"newest": Infinity, "latest": []}',
        '{"newest": 281474976710656, "latest": []}',
        '{"newest": 1, "latest": [[1, 1, 1, -1]]}',
        '{"newest": 1, "latest": [[1, 1]]}',
    ],
)
def test_a_file_without_times_is_named_and_begun_anew(
    tmp_path: Path, text: str
) -> None:
    path = tmp_path / "signing.json"
    path.write_text(text)
    file = SigningFile(path)
    assert file.written == SigningTimes()
    assert (
        file.trouble
        == f"signing times {path} holds no times of signed messages: begun anew"
    )
    times = SigningTimes(5, (((0, 1, 1), 4),))
    for second in range(3):
        file.keep(times, (1 + second) * NS)
    file.close()
    assert SigningFile(path).written == times


def test_keys_have_marks_of_their_own_that_do_not_reveal_them() -> None:
    marks = {mark_of(KEY), mark_of(bytes(32))}
    assert len(marks) == 2
    assert not any(mark in KEY.hex() for mark in marks)


def test_times_are_written_every_five_seconds(tmp_path: Path) -> None:
    path = tmp_path / "signing.json"
    file = SigningFile(path)
    written = set()
    for step in range(1, 121):
        file.keep(SigningTimes(step), NS + step * NS // 10)
        file._wait()
        written.add(file.written.newest)
    assert sorted(written) == [0, 51, 101]
    file.close()
    assert SigningFile(path).written.newest == 120


def test_a_message_of_another_system_hides_no_answer_of_the_autopilot() -> None:
    """What nobody here can decode counts as seen only if the autopilot sent it."""
    autopilot = Autopilot("ardupilot")
    talk = Conversation(autopilot).run(3.0)
    talk.cut = True
    talk.run(0.1)
    number = (talk.vehicle._sequence + 1) & 255
    unknown = struct.pack("<BBBBBBBHB", 0xFD, 4, 0, 0, number, 9, 1, 0x1234, 0x56)
    talk.inject(unknown + bytes(6))
    talk.vehicle.parameters.clear()
    autopilot.mav.seq = number
    answer = autopilot.mav.param_value_encode(b"INS_USE", 1.0, 9, 1, 0)
    talk.inject(bytes(answer.pack(autopilot.mav)))
    assert [*talk.vehicle.parameters] == [("INS_USE", 1.0)]


def test_messages_that_were_overtaken_are_counted_once_and_nine_in_a_row_begin_anew() -> (
    None
):
    autopilot = Autopilot("ardupilot")
    talk = Conversation(autopilot).run(3.0)
    talk.cut = True
    talk.run(0.1)
    first, lost = talk.vehicle._sequence, talk.vehicle.counts["lost"]

    def send(step: int) -> None:
        autopilot.mav.seq = (first + step) & 255
        answer = autopilot.mav.param_value_encode(b"INS_USE", float(step), 9, 1, 0)
        talk.inject(bytes(answer.pack(autopilot.mav)))

    for k in range(100):
        send(2 * k + 2)
        send(2 * k + 1)
    send(201)
    assert talk.vehicle.counts["lost"] == lost + 100
    talk.vehicle.parameters.clear()
    for step in range(100, 112):
        send(step)
    # Those before may be late, so they may be of before an order.
    assert [value for _, value in talk.vehicle.parameters] == [109.0, 110.0, 111.0]
    assert talk.vehicle.counts["lost"] == lost + 100


def test_what_has_no_checksum_that_can_be_known_is_no_sign_of_life() -> None:
    talk = Conversation(Autopilot("px4")).run(3.0)
    talk.cut = True
    unknown = struct.pack("<BBBBBBBHB", 0xFD, 4, 0, 0, 7, 1, 1, 0x1234, 0x56) + bytes(6)
    for _ in range(50):
        talk.run(0.1)
        talk.inject(unknown)
    assert talk.vehicle.counts["unknown"] == 50
    assert not talk.vehicle.in_reach


def understood(parser: mavlink.MAVLink, data: bytes) -> list[tuple[int, bytes]]:
    """Return numbers and bytes of the messages that a parser finds in bytes."""
    parser.robust_parsing = True
    found = parser.parse_buffer(data) or []
    return [(one.get_msgId(), bytes(one.get_msgbuf())) for one in found]


@pytest.mark.parametrize("is_old", [False, True])
@pytest.mark.parametrize("key", [b"", KEY], ids=["unsigned", "signed"])
def test_a_damaged_message_is_no_message_as_for_pymavlink(
    key: bytes, is_old: bool
) -> None:
    sender = mavlink.MAVLink(None, 1, 1)
    sender.signing.secret_key = key or None
    sender.signing.sign_outgoing = bool(key)
    message = sender.scaled_imu2_encode(70_000, 0, 0, -1000, 12, -30, 44, 0, 0, 0)
    data = bytes(message.pack(sender, force_mavlink1=is_old))
    heard = []
    for at in range(len(data)):
        for change in (0, 1, 0x80):
            damaged = data[:at] + bytes((data[at] ^ change,)) + data[at + 1 :]
            heard.append(understood(parser_of(mavlink)(None), damaged + data))
            assert heard[-1] == understood(mavlink.MAVLink(None), damaged + data)
    assert heard.count([(116, data), (116, data)]) >= len(data)


@settings(max_examples=12)
@given(pieces=st.lists(st.binary(max_size=300), max_size=30), seed=st.integers(0, 999))
@example(pieces=600 * [b"\xfd\xff\x00"], seed=0)
@example(pieces=600 * [struct.pack("<BBB", 0xFD, 9, 1)], seed=1)
def test_garbage_between_messages_does_no_harm_and_what_is_left_of_it_does_not_grow(
    pieces, seed
) -> None:
    talk = Conversation(Autopilot("ardupilot", seed=seed)).run(3.0)
    for piece in pieces:
        talk.inject(piece)
        talk.run(0.01)
    assert all(len(parser.buf) < 8192 for parser in talk.vehicle._parsers.values())
    talk.run(4.0)
    check_flight(talk)


def test_addresses_of_strangers_take_no_memory() -> None:
    talk = Conversation(Autopilot("px4"), peers=(("a", 1),)).run(4.0)
    for k in range(5000):
        talk.inject(b"\xfd\xff\x00", ("stranger", k))
    assert len(talk.vehicle._parsers) <= 9
    talk.run(3.0)
    check_flight(talk)


def test_the_script_of_the_docs_finds_name_and_value_in_a_message() -> None:
    """A script of ArduPilot gets a message from its checksum on, then as it was sent."""
    script = (ROOT / "docs" / "flight_stack.md").read_text()
    sent = mavlink.MAVLink(None, 1, 191).named_value_float_encode(7, b"fdi_ready", 1.0)
    data = b"??" + bytes(sent.pack(mavlink.MAVLink(None, 1, 191)))
    first, last = map(int, re.search(r"message:sub\((\d+), (\d+)\)", script).groups())
    at = int(re.search(r'unpack\("<f", message, (\d+)\)', script)[1])
    assert data[first - 1 : last] == b"fdi_ready"
    assert struct.unpack_from("<f", data, at - 1) == (1.0,)
    assert int(re.search(r"NAMED_VALUE_FLOAT = (\d+)", script)[1]) == sent.id
