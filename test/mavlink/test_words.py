# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Words of failover: one condition at a time, the first that holds, and when it is announced."""

import math
from dataclasses import replace

import pytest

from fdi_ros.mavlink.failover.policy import (
    GROUNDED,
    LONG_AGO,
    QUICK_TRIES,
    Imu,
    Memory,
    PolicySettings,
    View,
)
from fdi_ros.mavlink.failover.ready import NO_OTHER
from fdi_ros.mavlink.failover.words import (
    VEHICLE,
    Condition,
    Note,
    Readiness,
    WordsState,
    announce,
    imu_condition,
    text_of,
    vehicle_condition,
)
from fdi_ros.mavlink.report import TEXT_LENGTH

MS = 1_000_000
NS = 1000 * MS
NOW = 1000 * NS
STEP = 100 * MS
LOST_LANE = 1.5  # rad
SETTINGS = PolicySettings()
GOOD = Imu(use=True, heard=NOW, named=False, ok=True, delivers=True, size=0.0, agreed=1)
BAD = GOOD._replace(named=True, blamed=True, ok=False, size=0.5, agreed=None)
DOUBTED = GOOD._replace(ok=False)
WAITING = GOOD._replace(agreed=None, waits="xz")
APART = DOUBTED._replace(size=0.1, least=0.1, agreed=None)
OUT = Memory(ours=True, held=True, seen=False, out_sent=LONG_AGO + 1, tries=1, taken=1)
USED = Memory(seen=True)
DISPUTED = Memory(seen=True, against_since=NOW)


def view(*imus: Imu, armed: bool = True, **given) -> View:
    """Return a view of three IMUs, of which those not given are good."""
    imus = (*imus, *(GOOD,) * (3 - len(imus)))
    ground = {} if armed else {"disarmed": GROUNDED}
    return View(imus, linked=True, armed=armed, monitored=True, **ground)._replace(
        **given
    )


@pytest.mark.parametrize(
    ("condition", "memory", "imu", "note", "armed"),
    [
        (Condition.DANGER, USED, BAD, Note(bad_since=0), True),
        (
            Condition.STUCK_OUT,
            replace(OUT, held=False, tries=QUICK_TRIES + 1),
            GOOD,
            Note(),
            False,
        ),
        (Condition.REBOOT, replace(OUT, without_notch=True), BAD, Note(), False),
        (Condition.STAYS_OUT, OUT, BAD, Note(), False),
        (Condition.FROZEN, OUT, DOUBTED._replace(stuck=True), Note(), False),
        (Condition.NOT_OK, OUT, DOUBTED, Note(), False),
        (Condition.WAITS, OUT, WAITING, Note(), False),
        (Condition.WAITS, OUT, WAITING, Note(waits_since=0), True),
        # Not for long.
        (Condition.OUT, OUT, WAITING, Note(waits_since=NOW - NS), True),
        (Condition.OUT, OUT, BAD, Note(), True),
        (Condition.LEFT_ALONE, Memory(seen=False, left_alone=True), BAD, Note(), True),
        (Condition.UNUSED, Memory(seen=False), BAD, Note(), True),
        (Condition.APART, USED, APART, Note(apart_since=0), True),
        (Condition.NO_NOTCH, replace(USED, without_notch=True), GOOD, Note(), True),
        (Condition.FINE, USED, GOOD, Note(), True),
        # About to go back.
        (None, OUT, GOOD, Note(), False),
        (None, replace(OUT, held=False), GOOD._replace(agreed=None), Note(), True),
        # Off from those in use, but not from one that is out and has healed.
        (None, USED, APART._replace(least=0.0), Note(apart_since=0), True),
        # Off, but not for long; of unknown size; not reported in use.
        (None, USED, APART, Note(apart_since=NOW - NS), True),
        # In use, but the newest report says that it is not, or an order is under way.
        (None, DISPUTED, GOOD, Note(), True),
        (None, replace(OUT, seen=True), GOOD, Note(), True),
        (None, USED, GOOD._replace(size=math.nan), Note(), True),
        (None, Memory(), GOOD, Note(), True),
    ],
)
def test_an_imu_has_the_first_condition_that_holds(
    condition: Condition | None, memory: Memory, imu: Imu, note: Note, armed: bool
) -> None:
    notes = (note, Note(), Note())
    memories = (memory, USED, USED)
    found = imu_condition(0, notes, memories, view(imu, armed=armed), NOW, SETTINGS)
    assert found is condition


ASTRAY = Note(lane_angle=LOST_LANE)
LONG_APART = Note(apart_since=0)
DEAD = Memory(seen=True, dead_since=0)


@pytest.mark.parametrize(
    ("condition", "memories", "imus", "notes"),
    [
        (Condition.ALONE, (DEAD, DEAD), (), (ASTRAY, ASTRAY)),
        (Condition.LAST_IMU, (OUT, OUT), (BAD, BAD), (ASTRAY, ASTRAY)),
        (Condition.LAST_LANE, (), (DOUBTED,) * 3, (ASTRAY, ASTRAY, LONG_APART)),
        (Condition.DISAGREE, (), (DOUBTED,) * 3, (LONG_APART,)),
        (Condition.DISAGREE, (), (APART,) * 3, (LONG_APART,)),
        (Condition.REDUNDANT, (), (APART,), (LONG_APART,)),
        (None, (), (APART, APART), (LONG_APART,)),
        (None, (DISPUTED,), (GOOD, APART), (Note(), LONG_APART)),
    ],
)
@pytest.mark.parametrize("armed", [True, False])
def test_the_vehicle_has_the_first_condition_that_holds(
    condition: Condition | None,
    memories: tuple[Memory, ...],
    imus: tuple[Imu, ...],
    notes: tuple[Note, ...],
    armed: bool,
) -> None:
    """Nothing is announced of a disarmed vehicle but good news."""
    notes = (*notes, *(Note(),) * (3 - len(notes)))
    memories = (*memories, *(USED,) * (3 - len(memories)))
    found = vehicle_condition(notes, memories, view(*imus, armed=armed), NOW, SETTINGS)
    ending = (None, Condition.REDUNDANT) if not armed else (condition,)
    assert found in ending


class Flight:
    """Words tick by tick, of three IMUs that the autopilot has all in use."""

    def __init__(self) -> None:
        self.state = WordsState((Note(),) * 3)
        self.now = NOW

    def fly(
        self, seconds: float, seen: View, memory: Memory = USED
    ) -> list[tuple[float, int, Condition]]:
        """Return time since the begin, s, subject and condition of what was announced."""
        found = []
        for k in range(round(seconds * NS) // STEP):
            self.now += STEP
            memories = (memory, USED, USED)
            self.state, words = announce(self.state, memories, seen, self.now, SETTINGS)
            found += [((k + 1) * STEP / NS, *word) for word in words]
        return found


def test_a_danger_is_announced_after_a_second_and_every_ten() -> None:
    found = Flight().fly(25.0, view(BAD))
    assert [at for at, *_ in found] == pytest.approx([1.1, 11.1, 21.1])
    assert {(imu, condition) for _, imu, condition in found} == {(0, Condition.DANGER)}


def test_what_is_left_of_a_danger_is_announced_after_five_more_seconds() -> None:
    flight = Flight()
    flight.fly(20.0, view(BAD))
    (at, *words), *others = flight.fly(20.0, view(APART))
    assert words == [0, Condition.APART]
    assert at > 5.0
    assert not others


def test_a_name_that_flickers_hides_no_difference() -> None:
    flight = Flight()
    words = []
    for k in range(14):
        words += flight.fly(0.5, view(BAD if k % 2 else APART))
    assert [condition for _, _, condition in words] == [Condition.APART]


def test_the_time_apart_counts_from_the_return_of_an_imu() -> None:
    """While it was out of use, its difference mattered to nobody."""
    flight = Flight()
    flight.fly(20.0, view(APART), OUT)
    (at, *words), *_ = flight.fly(20.0, view(APART))
    assert words == [0, Condition.APART]
    assert at > 5.0


def test_a_monitor_that_flickers_does_not_flood_the_pilot() -> None:
    flight = Flight()
    words = []
    for k in range(100):
        imu = GOOD._replace(named=k % 2 == 0, ok=False, agreed=None)
        words += flight.fly(0.1, view(imu, armed=False), OUT)
    assert 8 <= len(words) <= 11


@pytest.mark.parametrize("is_out", [True, False])
def test_an_imu_that_is_out_of_use_does_not_disagree(is_out: bool) -> None:
    """The monitor finds none OK, as over a lossy link: the two in use agree."""
    seen = view(APART, DOUBTED, DOUBTED)
    words = Flight().fly(10.0, seen, OUT if is_out else USED)
    found = {condition for _, key, condition in words if key == VEHICLE}
    assert (Condition.DISAGREE in found) is not is_out


def test_a_lane_that_was_misled_for_long_is_lost_until_the_landing() -> None:
    flight = Flight()
    for seen in (view(BAD, BAD), view()):
        words = [(key, condition) for _, key, condition in flight.fly(12.0, seen)]
        assert (VEHICLE, Condition.LAST_LANE) in words
    assert flight.fly(2.0, view(armed=False))[-1][2] is Condition.REDUNDANT
    assert not flight.fly(10.0, view())


@pytest.mark.parametrize(("seconds", "announced"), [(4.9, False), (5.1, True)])
def test_a_difference_is_announced_after_five_seconds(
    seconds: float, announced: bool
) -> None:
    note = Note(apart_since=NOW - round(seconds * NS))
    memories = (USED,) * 3
    found = imu_condition(
        0, (note, Note(), Note()), memories, view(APART), NOW, SETTINGS
    )
    assert (found is Condition.APART) == announced
    waits = Note(waits_since=NOW - round(seconds * NS))
    memories = (OUT, USED, USED)
    found = imu_condition(
        0, (waits, Note(), Note()), memories, view(WAITING), NOW, SETTINGS
    )
    assert (found is Condition.WAITS) == announced


def lane_lost_at(flight: Flight) -> float:
    """Return when the last lane is lost, s from now, of two IMUs that are off by 0.5 rad/s."""
    found = flight.fly(10.0, view(BAD, BAD))
    return next(at for at, _, what in found if what is Condition.LAST_LANE)


def test_a_lane_is_lost_that_was_misled_by_one_and_a_half_rad() -> None:
    flight = Flight()
    flight.fly(1.0, view())
    assert lane_lost_at(flight) == pytest.approx(3.0, abs=0.15)


def test_a_lane_recovers_within_ten_seconds() -> None:
    """Of 1 rad 0.6 rad are left after 5 s, and 1.8 s at 0.5 rad/s bring it to 1.5 rad."""
    flight = Flight()
    flight.fly(1.0, view())
    flight.fly(2.0, view(BAD, BAD))
    flight.fly(5.0, view())
    assert lane_lost_at(flight) == pytest.approx(1.8, abs=0.15)


def said(*course: tuple[float, str, bool, bool]) -> list[str]:
    """Return the texts on failover in a course of seconds, reason, is out, armed."""
    state = Readiness()
    now = NOW
    found = []
    for seconds, why, is_out, armed in course:
        for _ in range(round(seconds * NS) // STEP):
            now += STEP
            state, words = state.hear(why, is_out, armed, now)
            found += [words.text] if words else []
    return found


SLOW = "link is slow"


@pytest.mark.parametrize(
    ("course", "texts"),
    [
        # On the ground only good news, once.
        ([(9.0, SLOW, False, False), (9.0, "", False, False)], ["failover is ready"]),
        ([(2.9, "", False, True)], []),
        ([(9.0, "", False, True), (2.9, SLOW, False, True)], ["failover is ready"]),
        (
            [(9.0, "", False, True), (9.0, SLOW, False, True), (9.0, "", True, True)],
            ["failover is ready", f"no failover: {SLOW}", "failover acts again"],
        ),
        # The pilot would take it for more with the last IMU in use, and that it is the last
        # one is announced by itself.
        (
            [
                (9.0, SLOW, True, True),
                (9.0, NO_OTHER, True, True),
                (2.9, "", True, True),
            ],
            [f"no failover: {SLOW}"],
        ),
        (
            [
                (9.0, SLOW, True, True),
                (9.0, NO_OTHER, True, True),
                (3.1, "", True, True),
            ],
            [f"no failover: {SLOW}", "failover acts again"],
        ),
        # Right after arming an order may end the reason.
        ([(9.0, SLOW, False, False), (2.9, SLOW, False, True)], []),
        (
            [(9.0, SLOW, False, False), (3.1, SLOW, False, True)],
            [f"no failover: {SLOW}"],
        ),
        # An IMU that was out of use and is back is no news of failover.
        (
            [(9.0, "", False, True), (9.0, "", True, True), (9.0, "", False, True)],
            ["failover is ready"],
        ),
        # Out of use at the start: that it acts is news only after a doubt.
        ([(9.0, "", True, True)], []),
        (
            [(0.2, "the monitor is late", False, True)],
            ["no failover: the monitor is late"],
        ),
    ],
)
def test_what_is_announced_of_failover_itself(
    course: list[tuple[float, str, bool, bool]], texts: list[str]
) -> None:
    assert said(*course) == texts


def test_a_healed_imu_waits_in_flight_for_a_turn_and_is_announced_out_once() -> None:
    """The text comes after `UNNAMED`. If it is off again it is out as before: no news."""
    state = WordsState((Note(),) * 3)
    said = []
    for k in range(300):
        now = NOW + k * STEP
        imu = WAITING if 50 <= k < 150 else WAITING._replace(size=0.5)
        memories = (OUT, USED, USED)
        state, found = announce(state, memories, view(imu), now, SETTINGS)
        said += [(k, condition) for key, condition in found if key == 0]
    assert said == [(0, Condition.OUT), (100, Condition.WAITS)]
    text = text_of(0, Condition.WAITS, ["imu_1.x"] * 9, waits="xz")
    assert text == "FDI: IMU 1 waits to agree in a turn about x, z"
    longest = text_of(2, Condition.WAITS, ["imu_3.x"] * 9, waits="xyz")
    assert len(longest) <= TEXT_LENGTH
