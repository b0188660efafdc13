# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Times of the failover policy, each from both sides: one step earlier nothing happens."""

from dataclasses import replace

import pytest

from fdi_ros.mavlink.failover_policy import (
    CHANGE_STANDS,
    FIRST_PAUSE,
    GROUNDED,
    LONGEST_PAUSE,
    QUICK_TRIES,
    STALE_ANSWER,
    VEHICLE,
    Condition,
    Imu,
    Memory,
    PolicySettings,
    PolicyState,
    View,
    decide,
)

MS = 1_000_000
START = 1000 * 1000 * MS
OUT = Memory(ours=True, held=True, seen=False, out_sent=START, tries=1, taken=1)


def tick(memory, now, *, use, agreed=None, size=0.0):
    """Memory of the first of three IMUs after one tick; its INS_USE is reported now."""
    first = Imu(use, now, delivers=True, ok=True, size=size, agreed=agreed)
    others = (Imu(True, now, delivers=True, ok=True, size=0.0, agreed=START),) * 2
    view = View((first, *others), linked=True, armed=True, monitored=True)
    state = PolicyState(
        (memory, Memory(seen=True), Memory(seen=True)), at=now - 20 * MS
    )
    return decide(state, view, now, PolicySettings()).state.memories[0]


@pytest.mark.parametrize("taken", [1, 2, 3, 9])
def test_the_pause_before_an_imu_goes_back_doubles_each_time_it_was_taken_out(taken):
    pause = min(FIRST_PAUSE * 2 ** (taken - 1), LONGEST_PAUSE)
    memory, agreed = replace(OUT, taken=taken), START + 1000 * MS
    assert tick(memory, agreed + pause - MS, use=False, agreed=agreed).held
    assert not tick(memory, agreed + pause, use=False, agreed=agreed).held


def reported(memory, first, last):
    """Memory after reports of an IMU in use, every 20 ms from one time to another."""
    for now in range(first, last, 20 * MS):
        memory = tick(memory, now, use=True)
    return memory


def test_a_late_answer_to_a_read_is_nobodys_hand_and_a_later_one_is():
    """By then it says how the IMU is, and not how it was before our order."""
    late = reported(
        OUT, START + 20 * MS, START + STALE_ANSWER + CHANGE_STANDS - 40 * MS
    )
    assert late.ours
    assert not late.left_alone
    begin = START + STALE_ANSWER
    assert not reported(OUT, begin, begin + CHANGE_STANDS - 20 * MS).left_alone
    assert reported(OUT, begin, begin + CHANGE_STANDS + 40 * MS).left_alone


def on_the_ground(memory, now, *, named=False, use=False, boots=0, turned=True):
    """Decision about the first of three IMUs, which has agreed for long, disarmed."""
    imu = Imu(use, now, named=named, ok=named is False, delivers=True, size=0.0)
    agreed = START - 10**12
    first = imu._replace(agreed=agreed if turned else None)
    other = imu._replace(use=True, agreed=agreed)
    view = View(
        (first, other, other),
        linked=True,
        disarmed=GROUNDED,
        monitored=True,
        boots=boots,
    )
    memories = (memory, Memory(seen=True), Memory(seen=True))
    return decide(PolicyState(memories, at=now - 20 * MS), view, now, PolicySettings())


@pytest.mark.parametrize(
    ("named", "condition"),
    [(False, None), (True, Condition.STAYS_OUT), (None, Condition.NOT_OK)],
)
def test_on_the_ground_an_imu_goes_back_only_where_the_monitor_reports_no_fault(
    named, condition
):
    decision = on_the_ground(OUT, START + 60 * 1000 * MS, named=named)
    assert [order.use for order in decision.orders] == ([] if condition else [True])
    assert condition is None or (0, condition) in decision.words


def test_on_the_ground_an_imu_stays_out_until_it_has_agreed_while_turning():
    decision = on_the_ground(OUT, START + 60 * 1000 * MS, turned=False)
    assert not decision.orders
    assert (0, Condition.UNTURNED) in decision.words


def test_the_time_apart_counts_from_the_return_of_an_imu():
    """While it was out of use, its difference mattered to nobody."""
    now = START + 10_000 * MS
    back = replace(OUT, held=False, back_sent=now - 100 * MS, apart_since=START)
    assert tick(back, now, use=True, size=0.5).apart_since == now
    assert tick(back, now, use=False, size=0.5).apart_since == START


def test_a_monitor_that_flickers_does_not_flood_the_pilot():
    memories = (OUT, Memory(seen=True), Memory(seen=True))
    state = PolicyState(memories, at=START)
    other = Imu(True, delivers=True, ok=True, size=0.0, agreed=START)
    words = []
    for k in range(100):
        now = START + 60_000 * MS + k * 100 * MS
        named = k % 2 == 0
        first = Imu(False, now, named=named, delivers=True, size=0.0)
        imus = (first, other._replace(heard=now), other._replace(heard=now))
        view = View(imus, linked=True, disarmed=GROUNDED, monitored=True)
        decision = decide(state, view, now, PolicySettings())
        state = decision.state
        words += decision.words
    assert 5 <= len(words) <= 11


@pytest.mark.parametrize("is_out", [True, False])
def test_an_imu_that_is_out_of_use_does_not_disagree(is_out):
    """The monitor finds none OK, as over a lossy link: the two in use agree."""
    now = START + 10_000 * MS
    bad = Imu(not is_out, now, named=True, blamed=True, delivers=True, size=0.5)
    other = Imu(True, now, delivers=True, size=0.0, agreed=START)
    view = View((bad, other, other), linked=True, armed=True, monitored=True)
    memory = replace(OUT, apart_since=START) if is_out else Memory(apart_since=START)
    memories = (memory, Memory(seen=True), Memory(seen=True))
    words = decide(PolicyState(memories, at=now), view, now, PolicySettings()).words
    assert ((VEHICLE, Condition.DISAGREE) in words) is not is_out


def test_a_boot_begins_anew_with_orders_that_were_not_answered():
    """The IMU was ordered back in vain before; it is in use from the start of the next."""
    tired = replace(OUT, held=False, tries=QUICK_TRIES + 5, back_sent=START + MS)
    now = START + 60 * 1000 * MS
    assert (0, Condition.STUCK_OUT) in on_the_ground(tired, now).words
    before = on_the_ground(tired, now, boots=1)
    assert (0, Condition.REBOOT) in before.words
    assert not before.orders
    after = on_the_ground(tired, now, use=True, boots=1)
    assert not after.words
    memory = after.state.memories[0]
    assert (memory.ours, memory.held, memory.without_notch) == (False,) * 3
