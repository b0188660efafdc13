# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Times of the failover policy, each from both sides: one step earlier nothing happens."""

from dataclasses import replace
from itertools import pairwise

import pytest

from fdi_ros.mavlink.failover.policy import (
    Imu,
    Memory,
    PolicySettings,
    PolicyState,
    View,
    decide,
    objection,
)

MS = 1_000_000
#: Times that are promised to pilots, ns: not those of the module, which may change by mistake.
FIRST_PAUSE = 2000 * MS
CHANGE_STANDS = 1000 * MS
STALE_ANSWER = 500 * MS
GROUNDED = 2000 * MS
QUICK_TRIES = 10
START = 1000 * 1000 * MS
OUT = Memory(ours=True, held=True, seen=False, out_sent=START, tries=1, taken=1)


def tick(memory, now, *, use, agreed=None, size=0.0):
    """Memory of the first of three IMUs after one tick; its INS_USE is reported now."""
    first = Imu(use, now, delivers=True, ok=True, size=size, agreed=agreed)
    others = (Imu(True, now, delivers=True, ok=True, size=0.0, agreed=START),) * 2
    view = View((first, *others), linked=True, armed=True, monitored=True)
    state = PolicyState((memory, Memory(seen=True), Memory(seen=True)))
    return decide(state, view, now, PolicySettings()).state.memories[0]


@pytest.mark.parametrize(
    ("taken", "seconds"), [(1, 2), (2, 4), (3, 8), (4, 16), (5, 16), (9, 16)]
)
def test_the_pause_before_an_imu_goes_back_doubles_each_time_it_was_taken_out(
    taken, seconds
):
    pause = seconds * 1000 * MS
    memory, agreed = replace(OUT, taken=taken), START + 1000 * MS
    assert tick(memory, agreed + pause - MS, use=False, agreed=agreed).held
    assert not tick(memory, agreed + pause, use=False, agreed=agreed).held


def test_the_pause_counts_from_our_order_where_the_agreement_is_older():
    """An error of less than 100 ms ends no agreement."""
    agreed = START - 10 * FIRST_PAUSE
    assert tick(OUT, START + FIRST_PAUSE - MS, use=False, agreed=agreed).held
    assert not tick(OUT, START + FIRST_PAUSE, use=False, agreed=agreed).held


def reported(memory, first, last, use=True):
    """Memory after reports of an IMU in use or not, every 20 ms from one time to another."""
    for now in range(first, last, 20 * MS):
        memory = tick(memory, now, use=use)
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


def test_a_late_answer_after_our_order_back_is_nobodys_hand_either():
    """The order is obeyed and reported at once, and then comes what was read before it."""
    earlier = START - 20 * 1000 * MS
    back = replace(OUT, ours=False, held=False, seen=True, out_sent=earlier)
    back = replace(back, back_sent=START)
    begin, stands = START + 20 * MS, START + STALE_ANSWER + CHANGE_STANDS
    assert not reported(back, begin, stands - 40 * MS, use=False).left_alone
    assert reported(back, begin, stands + 40 * MS, use=False).left_alone


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
    return decide(PolicyState(memories), view, now, PolicySettings())


@pytest.mark.parametrize(
    ("named", "goes_back"), [(False, True), (True, False), (None, False)]
)
def test_on_the_ground_an_imu_goes_back_only_where_the_monitor_reports_no_fault(
    named, goes_back
):
    decision = on_the_ground(OUT, START + 60 * 1000 * MS, named=named)
    assert [order.use for order in decision.orders] == [True] * goes_back


def test_on_the_ground_an_imu_stays_out_until_it_has_agreed_while_turning():
    assert not on_the_ground(OUT, START + 60 * 1000 * MS, turned=False).orders


def test_a_boot_begins_anew_with_orders_that_were_not_answered():
    """The IMU was ordered back in vain before; it is in use from the start of the next."""
    tired = replace(OUT, held=False, tries=QUICK_TRIES + 5, back_sent=START + MS)
    now = START + 60 * 1000 * MS
    before = on_the_ground(tired, now, boots=1)
    assert before.state.memories[0].without_notch
    assert not before.orders
    memory = on_the_ground(tired, now, use=True, boots=1).state.memories[0]
    assert (memory.ours, memory.held, memory.without_notch) == (False,) * 3


@pytest.mark.parametrize(
    ("count", "waits", "goes_out"), [(2, "x", False), (2, "", True), (3, "x", True)]
)
def test_of_two_imus_a_bad_one_stays_beside_one_that_waits_for_a_turn(
    count, waits, goes_out
):
    """One that was bad goes back for it, but may be dead, as all agree at rest."""
    now = START + 10 * FIRST_PAUSE
    bad = Imu(True, now, named=True, blamed=True, delivers=True, size=0.2, least=0.2)
    back = Imu(False, now, delivers=True, ok=True, size=0.2, least=0.2, waits=waits)
    state = PolicyState((OUT, *[Memory(seen=True)] * (count - 1)))
    for k in range(10):
        at = now + k * 20 * MS
        others = (bad._replace(heard=at),) * (count - 1)
        imus = (back._replace(use=k > 0, heard=at), *others)
        view = View(imus, linked=True, armed=True, monitored=True)
        state = decide(state, view, at, PolicySettings()).state
        assert not state.memories[0].held
    # The last order counts as under way for a while.
    state.memories[0].ours = False
    state = decide(state, view, at + 20 * MS, PolicySettings()).state
    assert state.memories[1].held == goes_out


@pytest.mark.parametrize(
    ("worst", "fine", "is_sound"),
    [("x", "xy", True), ("z", "xy", False), ("", "xy", False), ("x", "", False)],
)
def test_a_reserve_that_is_not_ok_is_fine_where_the_bad_one_is_off_most(
    worst, fine, is_sound
):
    """On z all others are FAULTY, so the monitor cannot check it."""
    bad = Imu(
        True, START, named=True, blamed=True, worst=worst, delivers=True, size=0.4
    )
    reserve = Imu(True, START, named=False, fine=fine, delivers=True, size=0.4)
    out = bad._replace(use=False)
    view = View((bad, reserve, out), linked=True, armed=True, monitored=True)
    memories = (Memory(seen=True), Memory(seen=True), OUT)
    words = objection(0, memories, view, START, PolicySettings())
    assert words == ("" if is_sound else "no sound IMU reported in use")


SOUND = Imu(True, delivers=True, ok=True, size=0.0)
BAD = Imu(True, named=True, blamed=True, worst="y", delivers=True, size=0.4, least=0.4)


def decided(memories, imus, now, heard=0, **view):
    """Decision in flight about IMUs whose use was reported some time ago, ns."""
    imus = tuple(imu._replace(heard=now - heard) for imu in imus)
    known = {"linked": True, "armed": True, "monitored": True, **view}
    state = PolicyState(tuple(memories))
    return decide(state, View(imus, **known), now, PolicySettings())


def in_use(count):
    return tuple(Memory(seen=True) for _ in range(count))


@pytest.mark.parametrize(("age", "goes_out"), [(190, True), (210, False)])
def test_a_reserve_was_reported_in_use_within_a_fifth_of_a_second(age, goes_out):
    decision = decided(in_use(3), (BAD, SOUND, SOUND), START, age * MS)
    assert bool(decision.orders) == goes_out


def test_an_order_is_repeated_ten_times_a_second_and_after_ten_times_once_a_second():
    memories, times = in_use(3), []
    for now in range(START, START + 4000 * MS, 10 * MS):
        decision = decided(memories, (BAD, SOUND, SOUND), now)
        memories = decision.state.memories
        times += [now] * len(decision.orders)
    pauses = [(b - a) // MS for a, b in pairwise(times)]
    assert pauses[:12] == [100] * 9 + [1000] * 3


@pytest.mark.parametrize(("waited", "ours"), [(1900, True), (2100, False)])
def test_an_imu_is_ours_until_two_seconds_after_our_last_order_out(waited, ours):
    back = replace(OUT, held=False, back_sent=START + 500 * MS)
    assert tick(back, START + waited * MS, use=True).ours == ours


@pytest.mark.parametrize(("disarmed", "alone"), [(1900, True), (2100, False)])
def test_an_imu_is_left_alone_until_two_seconds_after_the_flight(disarmed, alone):
    memories = (Memory(seen=True, left_alone=True), *in_use(2))
    ground = {"armed": False, "disarmed": disarmed * MS}
    decision = decided(memories, (SOUND,) * 3, START, **ground)
    assert decision.state.memories[0].left_alone == alone


@pytest.mark.parametrize(("agreed", "known"), [(4900, False), (5100, True)])
def test_an_imu_is_acquainted_after_five_seconds_of_agreement(agreed, known):
    one = SOUND._replace(agreed=START - agreed * MS)
    decision = decided(in_use(3), (one, SOUND, SOUND), START)
    assert decision.state.memories[0].acquainted == known


@pytest.mark.parametrize(("waited", "held"), [(900, True), (1100, False)])
def test_an_imu_goes_back_when_all_others_were_dead_for_a_second(waited, held):
    out = SOUND._replace(use=False, ok=False, size=0.4, least=0.4)
    dead = SOUND._replace(delivers=False)
    memories = (OUT, *in_use(2))
    for now in (START + 5000 * MS, START + (5000 + waited) * MS):
        memories = decided(memories, (out, dead, dead), now).state.memories
    assert memories[0].held == held


@pytest.mark.parametrize(
    ("least", "waited", "held"),
    [(0.095, 1100, False), (0.095, 900, True), (0.105, 1100, True)],
)
def test_an_imu_goes_back_that_is_off_by_a_quarter_of_those_in_use_for_a_second(
    least, waited, held
):
    out = SOUND._replace(use=False, ok=False, size=0.4, least=least)
    memories = (OUT, *in_use(2))
    for now in (START + 5000 * MS, START + (5000 + waited) * MS):
        memories = decided(memories, (out, BAD, BAD), now).state.memories
    assert memories[0].held == held
