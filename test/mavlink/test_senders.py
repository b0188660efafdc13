# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Two autopilots with one system id behind one address are reported, and nothing else looks like them."""

from collections.abc import Callable, Iterable

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fdi_ros.mavlink.link import open_link
from fdi_ros.mavlink.report import Reporter
from fdi_ros.mavlink.senders import REMEMBERED, Senders
from fdi_ros.monitor.diagnostics import Level
from mavlink.autopilots import NS, Autopilot, Conversation, gentle

MS = 1_000_000
Message = tuple[int, int, bytes]
"""Arrival, ns, number and content of a message."""


def other_autopilot(stack: str, ahead: float, number: int = 0, **given) -> Autopilot:
    """Return an autopilot that began earlier, with rates of 0.5 rad/s more, and its next number."""
    motion = gentle(3, 5)
    boot = -round((10 + ahead) * NS)
    made = Autopilot(stack, lambda t: motion(t) + 0.5, boot=boot, seed=5, **given)
    made.mav.seq = number
    return made


def link_line(talk: Conversation):
    link = open_link("udpin:127.0.0.1:14998")
    link.trouble = ""
    return Reporter(link, talk.vehicle, ["imu_1"], ["/imu_1"]).lines("", "", talk.now)[
        0
    ]


@pytest.mark.parametrize("stack", ["px4", "ardupilot"])
@pytest.mark.parametrize(
    ("ahead", "number", "loss"),
    [(0.5, 100, 0.0), (-0.5, 3, 0.1), (0.003, 0, 0.1), (300.0, 8, 0.1)],
)
def test_two_autopilots_of_one_system_are_reported(
    stack: str, ahead: float, number: int, loss: float
) -> None:
    one = Autopilot(stack, seed=3, loss=loss)
    talk = Conversation(one, other_autopilot(stack, ahead, number, loss=loss))
    talk.run(12.0)
    line = link_line(talk)
    assert line.level == Level.WARN
    assert "two senders as system 1 behind one address" in line.message
    assert sum("two senders" in one for one in talk.vehicle.events) == 1


def reboot(talk: Conversation) -> None:
    talk.autopilots[0].reboot(talk.now)


def reboot_twice_with_new_numbers(talk: Conversation) -> None:
    for _ in range(2):
        talk.autopilots[0].reboot(talk.now)
        talk.autopilots[0].mav.seq = 0
        talk.run(2.0)


def lose_a_third(talk: Conversation) -> None:
    talk.autopilots[0].loss = 0.35


def come_late(talk: Conversation) -> None:
    random = np.random.default_rng(0)
    talk.latency = lambda: round(random.exponential(40 * MS))


def come_late_in_turn(talk: Conversation) -> None:
    """Every other second takes 400 ms longer, and overtakes no longer."""
    talk.latency = lambda: 405 * MS if talk.now // NS % 2 else 5 * MS


@pytest.mark.parametrize(
    "event",
    [
        reboot,
        reboot_twice_with_new_numbers,
        lose_a_third,
        come_late,
        come_late_in_turn,
    ],
)
@pytest.mark.parametrize("stack", ["px4", "ardupilot"])
def test_one_autopilot_is_one_sender_whatever_its_link_does(
    stack: str, event: Callable[[Conversation], None]
) -> None:
    talk = Conversation(Autopilot(stack)).run(6.0)
    event(talk)
    talk.run(15.0)
    assert not any("two senders" in one for one in talk.vehicle.events)


def test_a_companion_of_the_same_system_is_another_component() -> None:
    talk = Conversation(Autopilot("ardupilot"))
    companion = mavlink.MAVLink(None, 1, 191)
    for _ in range(400):
        talk.run(0.02)
        beat = mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)
        talk.inject(bytes(beat.pack(companion)))
        companion.seq = (companion.seq + 1) % 256
    assert talk.vehicle.counts["of others"] == 400
    assert not any("two senders" in one for one in talk.vehicle.events)


def numbered(seconds: float, rate: float, first: int, mark: str) -> list[Message]:
    """Return the messages of one sender."""
    return [
        (round(k * NS / rate), first + k & 255, f"{mark}{k}".encode())
        for k in range(round(seconds * rate))
    ]


def late(messages: Iterable[Message], by: Callable[[], float]) -> list[Message]:
    """Return messages that each come later, s."""
    return [(at + round(NS * by()), *rest) for at, *rest in messages]


def found(*paths: Iterable[Message]) -> float | None:
    """Return when two senders are found, s. None: never."""
    senders = Senders()
    for at, number, data in sorted(one for path in paths for one in path):
        if senders.take(number, data, at):
            return at / NS
    return None


@pytest.mark.parametrize("rate", [40.0, 160.0, 900.0])
@pytest.mark.parametrize("other_rate", [35.0, 161.0])
@pytest.mark.parametrize("first", [0, 1, 128, 255])
def test_two_counts_are_found_whatever_their_rates(
    rate: float, other_rate: float, first: int
) -> None:
    one = numbered(20.0, rate, 0, "a")
    at = found(one, late(numbered(20.0, other_rate, first, "b"), lambda: 1e-4))
    assert at is not None
    assert 10.0 <= at < 16.0


def test_two_counts_are_found_though_each_four_messages_come_in_reverse_order() -> None:
    """A number that comes late is not missing."""

    def reversed_by_four(messages: list[Message]) -> list[Message]:
        fours = [messages[k : k + 4] for k in range(0, len(messages) - 3, 4)]
        return [
            (at, *rest)
            for four in fours
            for (at, *_), (_, *rest) in zip(four, four[::-1], strict=True)
        ]

    one = numbered(20.0, 160.0, 0, "a")
    other = late(numbered(20.0, 161.0, 128, "b"), lambda: 1e-4)
    assert found(reversed_by_four(one)) is None
    at = found(reversed_by_four(one), reversed_by_four(other))
    assert at is not None
    assert 10.0 <= at < 16.0


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("rate", [40.0, 160.0, 900.0])
def test_two_paths_of_one_sender_are_one(rate: float, seed: int) -> None:
    random = np.random.default_rng(seed)
    sent = numbered(30.0, rate, 0, "a")
    spread = random.uniform(0.0, 0.3)
    jittered = late(sent, lambda: random.exponential(spread))
    lag = random.uniform(0.01, 2.0)
    copies = late(sent, lambda: lag)
    assert found(jittered) is None
    assert found(sent, copies) is None
    # Each message takes one of two paths, the slow one for some time.
    for share in (0.1, 0.5):
        slow = random.random(len(sent)) < share
        fast = [one for one, is_slow in zip(sent, slow, strict=True) if not is_slow]
        other = [one for one, is_slow in zip(sent, slow, strict=True) if is_slow]
        assert found(fast, late(other, lambda: lag)) is None
    lasting = round(2.5 * rate)
    parts = [sent[k : k + lasting] for k in range(0, len(sent), lasting)]
    turns = [late(part, lambda: lag) for part in parts[::2]] + parts[1::2]
    assert found(*turns) is None


@pytest.mark.parametrize("rate", [60.0, 200.0, 400.0])
@pytest.mark.parametrize("every", [3, 7])
def test_a_sender_that_was_complete_for_a_minute_may_split_later(
    rate: float, every: int
) -> None:
    sent = numbered(90.0, rate, 0, "a")
    whole = round(60.0 * rate)
    fast = sent[:whole] + sent[whole::every]
    slow = [one for k, one in enumerate(sent[whole:]) if k % every]
    assert found(fast, late(slow, lambda: 0.3)) is None


@pytest.mark.parametrize("out", [2.0, 3.5, 6.0])
def test_a_second_path_brings_what_the_first_one_lost(out: float) -> None:
    sent = numbered(60.0, 200.0, 0, "a")
    begin = round(30.0 * 200.0)
    first = sent[:begin] + sent[begin + round(out * 200.0) :]
    assert found(first, late(sent, lambda: out)) is None


def test_two_senders_are_forgotten_after_one_is_gone() -> None:
    senders = Senders()
    both = numbered(15.0, 100.0, 0, "a") + numbered(15.0, 100.0, 90, "b")
    alone = late(numbered(30.0, 100.0, 7, "c"), lambda: 15.0)
    last = 0
    for at, number, data in sorted(both + alone):
        senders.take(number, data, at)
        last = at if senders.are_several(at) else last
    assert last == pytest.approx(15 * NS + REMEMBERED, abs=NS)
