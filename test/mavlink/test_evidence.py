# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Evidence against an IMU: what raw rates and the monitor's states are enough for."""

import copy
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace

import numpy as np
import pytest

from fdi_ros.core.states import ChannelState
from fdi_ros.mavlink.failover.evidence import Evidence
from fdi_ros.mavlink.failover.policy import Imu, PolicySettings, is_reserve
from fdi_ros.mavlink.failover.raw import RawComparison, Rows
from fdi_ros.mavlink.failover.wrong import UNKNOWN, WITHOUT_SCALE, Wrong
from mavlink.watched_flights import WatchedFlight

MS = 1_000_000
NS = 1000 * MS
STEP = 20 * MS
NINE = 9 * MS  #: Interval of the messages of a link at 50 Hz.
START = 1000 * NS
OK, SUSPECT, AMBIGUOUS, FAULTY, STALE, UNCHECKED, EXCLUDED = map(
    int, list(ChannelState)[:7]
)

#: Rates of one IMU in rad/s, given those of the vehicle.
Gyro = Callable[[np.ndarray], Sequence[float]]


def sound(rate: np.ndarray) -> Sequence[float]:
    return rate


def zero(rate: np.ndarray) -> Sequence[float]:
    return 0.0 * rate


class Watched:
    """Evidence of IMUs in a vehicle that turns by up to 1 rad/s, with noise of 2 mrad/s.

    Samples come each interval, ns, at the next turn of the autopilot's loop, Hz, with
    stamps in whole milliseconds.
    """

    def __init__(self, count: int, interval: int, loop: float) -> None:
        self.evidence = Evidence(count, interval, min_size=0.03)
        self.interval = interval
        self.loop = loop
        self.sent = self.looked = 0
        self.t = 0.0  # time of the last samples since the start, s
        self.gyros: list[Gyro] = [sound] * count
        self.states = [OK] * 3 * count
        self.out: list[int] = []
        self.taken: list[int] = []
        #: IMUs of which nine of ten samples are missing, so that no difference is known.
        self.slow: list[int] = []
        self.is_reporting = True
        self.now = START
        self.random = np.random.default_rng(1)

    def rate(self, t: float) -> np.ndarray:
        """Return the rate of the vehicle at a time since the start, rad/s."""
        return np.array([math.sin(2.1 * t), 0.8 * math.cos(1.7 * t), 0.3 * math.sin(t)])

    def run(self, seconds: float) -> "Watched":
        for _ in range(round(seconds * NS / self.interval)):
            self.step()
        return self

    def step(self) -> Sequence[Imu]:
        self.sent += self.interval
        self.t = math.ceil(self.sent / NS * self.loop - 1e-6) / self.loop
        self.now = START + int(self.t * 1000.0 + 1e-6) * MS
        rate = self.rate(self.t)
        for unit, gyro in enumerate(self.gyros):
            if unit in self.slow and self.sent // self.interval % 10:
                continue
            noisy = rate + self.random.normal(0.0, 0.002, 3)
            x, y, z = (round(value, 3) for value in map(float, gyro(noisy)))
            self.evidence.raw.feed(unit, self.now, (x, y, z))
        if self.is_reporting:
            self.evidence.hear(self.states, self.now)
        delivers = [True] * len(self.gyros)
        if self.now - self.looked < 3 * STEP // 4:
            return self.evidence.imus
        self.looked = self.now
        return self.evidence.look(delivers, self.out, self.now, self.taken)

    def blamed(self, seconds: float) -> set[int]:
        """Return the IMUs, from 0, that are blamed at some time of the next seconds."""
        found: set[int] = set()
        for _ in range(round(seconds * NS / self.interval)):
            found |= {k for k, imu in enumerate(self.step()) if imu.blamed}
        return found


@functools.cache
def after_3_s(count: int, interval: int, loop: float) -> Watched:
    return Watched(count, interval, loop).run(3.0)


def watch(count: int = 3, interval: int = STEP, loop: float = 1000.0) -> Watched:
    """Return such a vehicle after 3 s. Most tests begin alike: it is run once and copied."""
    return copy.deepcopy(after_3_s(count, interval, loop))


def biased(size: float, axis: int = 0) -> Gyro:
    """Return a gyro with an error on one axis, rad/s."""
    return lambda rate: rate + size * np.eye(3)[axis]


@pytest.mark.parametrize("size", [0.7, -1.0])
def test_the_odd_one_of_three_is_blamed_without_the_monitor(size: float) -> None:
    watched = watch()
    watched.gyros[1] = biased(size)
    assert watched.blamed(0.06) == {1}
    assert watched.blamed(1.0) == {1}


@pytest.mark.parametrize(("size", "blamed"), [(0.45, set()), (0.65, {1})])
def test_half_a_rad_per_second_needs_no_doubt_of_the_monitor(
    size: float, blamed: set[int]
) -> None:
    """Scales and the turn between two samples may add 0.1 rad/s to that."""
    watched = watch()
    watched.gyros[1] = biased(size)
    assert watched.blamed(1.0) == blamed


def test_the_odd_one_is_blamed_after_it_was_suspected_for_a_second() -> None:
    watched = watch()
    watched.gyros[1] = biased(0.25)
    watched.states[3] = SUSPECT
    assert watched.blamed(0.9) == set()
    assert watched.blamed(0.4) == {1}


# Two that are wrong alike -----------------------------------------------------------------


@pytest.mark.parametrize("between", [0.0, 0.02, 1.0, 6.0])
@pytest.mark.parametrize("state", [OK, FAULTY])
def test_two_gyros_that_stand_still_do_not_outvote_a_sound_one(
    between: float, state: int
) -> None:
    """One after the other, or at once; the monitor sees or does not see what they do."""
    watched = watch()
    watched.gyros[0] = zero
    watched.run(between)
    watched.states[:3] = [state] * 3
    watched.gyros[1] = zero
    watched.states[3:6] = [state] * 3
    assert 2 not in watched.blamed(8.0)


def test_two_that_die_in_one_hover_do_not_outvote_the_third() -> None:
    """The first is out; at rest it agrees with all others, and the second dies alike."""
    watched = watch()
    dead = [lambda rate: 0.01 * rate] * 2
    watched.gyros[0] = dead[0]
    watched.states[:3] = [FAULTY] * 3
    watched.run(1.0)
    watched.out = [0]
    turning = watched.rate
    watched.rate = lambda t: np.array([0.015 * math.sin(2.0 * t), 0.01, 0.0])
    watched.run(4.0)
    watched.gyros[1] = dead[1]
    watched.run(2.0)
    watched.rate = turning
    assert 2 not in watched.blamed(3.0)


@pytest.mark.parametrize("state", [SUSPECT, AMBIGUOUS, FAULTY])
def test_two_axes_that_die_in_a_calm_hover_do_not_outvote_the_third(state: int) -> None:
    """Nobody sees the two die 4 s apart. In a turn they agree, and the third differs."""
    watched = watch()
    moving = watched.rate
    watched.rate = hovering
    dead = functools.partial(np.multiply, [1.0, 1.0, 0.0])
    for k in (0, 1):
        watched.gyros[k] = lambda rate: dead(rate) + watched.random.normal(0, 0.002, 3)
        watched.run(4.0)
    watched.rate = turning_about(2)
    watched.states[8] = state
    assert not watched.blamed(2.0)
    # Two that move have a vote again.
    watched.gyros[:2] = [sound] * 2
    watched.rate = moving
    watched.states[8] = OK
    watched.run(3.0)
    watched.states[8] = state
    watched.gyros[2] = biased(0.3, axis=2)
    assert watched.blamed(2.0) == {2}


@pytest.mark.parametrize("seed", [0, 3, 6])
def test_noise_of_dead_axes_is_no_motion(seed: int) -> None:
    """As above, with a noise of 6 mrad/s: by chance the means of both change alike by 5 mrad/s."""
    watched = watch()
    moving = watched.rate
    random = np.random.default_rng(seed)

    def noisy(rate: np.ndarray) -> Sequence[float]:
        return rate + random.normal(0.0, 0.006, 3)

    def dead(rate: np.ndarray) -> Sequence[float]:
        return noisy(rate * [0.0, 1.0, 1.0])

    watched.gyros = [noisy] * 3
    watched.rate = hovering
    watched.run(3.0)
    watched.gyros[0] = dead
    watched.run(10.0)
    watched.gyros[1] = dead
    watched.run(2.0)
    watched.rate = turning_about(0)
    watched.states[6] = AMBIGUOUS
    assert 2 not in watched.blamed(3.0)
    watched.gyros[:2] = [noisy] * 2
    watched.rate = moving
    watched.states[6] = OK
    watched.run(3.0)
    watched.states[6] = AMBIGUOUS
    watched.gyros[2] = biased(0.3)
    assert watched.blamed(2.0) == {2}


def test_an_error_at_rest_counts_once_the_vehicle_turns() -> None:
    """Flown with, it turns the vehicle, and the healthy ones move."""
    watched = watch()
    watched.rate = hovering
    watched.run(6.0)
    watched.gyros[1] = biased(0.3, axis=2)
    watched.states[5] = FAULTY
    assert not watched.blamed(1.0)
    turned = watched.t
    watched.rate = lambda t: np.array([0.0, 0.0, -min(0.3, t - turned)])
    assert watched.blamed(0.3) == {1}


@pytest.mark.parametrize("gap", [False, True])
def test_what_was_unknown_was_not_off(gap: bool) -> None:
    """In a hover with small moves, after a start in flight, or a gap of the link beside a bad IMU."""
    watched = watch()
    watched.rate = lambda t: 0.02 * np.sin(t * np.array([3.0, 2.3, 1.9]))
    if gap:
        watched.gyros[0] = biased(0.3)
        watched.states[0] = FAULTY
        assert watched.blamed(1.0) == {0}
        watched.out = [0]
        watched.sent += NS
    else:
        watched.evidence = Evidence(3, STEP, min_size=0.03)
    watched.run(4.0)
    # Its name is older than its error, so it has to be outvoted.
    watched.states[5] = FAULTY
    assert 1 not in watched.blamed(1.0)
    watched.gyros[1] = biased(0.3, axis=2)
    assert watched.blamed(1.0) - {0} == {1}


def test_two_that_are_dead_from_the_start_do_not_outvote_the_third() -> None:
    """All agree at rest. Only a turn shows that two gyros measure."""
    watched = watch()
    watched.evidence = Evidence(3, STEP, min_size=0.03)
    turning = watched.rate
    watched.rate = lambda t: np.zeros(3)
    watched.gyros[:2] = [lambda rate: watched.random.normal(0.0, 0.002, 3)] * 2
    watched.run(5.0)
    watched.rate = turning
    assert 2 not in watched.blamed(3.0)


@pytest.mark.parametrize("state", [SUSPECT, AMBIGUOUS, STALE])
def test_two_that_the_monitor_doubts_do_not_outvote_one_that_it_does_not(
    state: int,
) -> None:
    """Their values go on changing: a rate that is lost, but noise that is not."""
    watched = watch()
    watched.states[:6] = [state] * 6
    watched.gyros[:2] = [lambda rate: 0.01 * rate] * 2
    assert 2 not in watched.blamed(8.0)


def test_two_that_were_wrong_before_are_not_trusted_once_they_agree() -> None:
    watched = watch()
    for k in (0, 1):
        watched.gyros[k] = lambda rate: 0.01 * rate
        watched.states[3 * k : 3 * k + 3] = [FAULTY] * 3
        watched.run(5.0 * (1 - k))
    watched.states = [OK] * 9
    assert 2 not in watched.blamed(8.0)


@pytest.mark.parametrize("state", [OK, AMBIGUOUS])
@pytest.mark.parametrize(
    ("taken", "blamed"), [([0], {2}), ([0, 1], set()), ([0, 1, 2], {2})]
)
def test_two_that_were_bad_in_this_flight_do_not_outvote_one_that_was_not(
    taken: list[int], blamed: set[int], state: int
) -> None:
    """They do once they have agreed in turns about all axes."""
    watched = watch()
    moving = watched.rate
    watched.rate = turning_about(0)
    watched.run(0.5).out = taken
    watched.run(0.5).out = []
    watched.taken = taken
    assert watched.run(1.0).step()[0].votes == (0 not in taken)
    watched.gyros[2] = biased(0.7)
    watched.states[6] = state
    assert watched.blamed(3.0) == blamed
    watched.states[6] = FAULTY
    assert watched.blamed(1.0) == {2}
    watched.gyros[2] = sound
    watched.states[6] = OK
    watched.rate = moving
    assert watched.run(4.0).step()[0].votes
    watched.gyros[2] = biased(0.7)
    watched.states[6] = state
    assert watched.blamed(1.0) == {2}


def test_held_imus_that_both_read_zero_do_not_agree() -> None:
    """And neither agrees with one in use that reads zero too, beside a sound one."""
    watched = watch()
    watched.gyros[:2] = [zero, lambda rate: 0.01 * rate]
    watched.states[:6] = [FAULTY] * 6
    watched.states[6:] = [UNCHECKED] * 3
    watched.out = [0, 1]
    watched.run(1.0)
    assert all(watched.step()[k].agreed is None for k in (0, 1) for _ in range(200))
    watched.out = [0]
    watched.run(1.0)
    assert all(watched.step()[0].agreed is None for _ in range(200))
    # One that has healed agrees with the last one in use.
    watched.out = [0, 1]
    watched.gyros[0] = sound
    imu = watched.run(3.0).step()[0]
    assert imu.agreed is not None
    assert 2 * NS <= watched.now - imu.agreed <= 3 * NS


def test_a_gyro_that_is_stuck_does_not_agree_in_hover() -> None:
    """Its value is within 0.03 rad/s of the others', but does not follow them."""
    watched = watch(2)
    watched.rate = lambda t: np.array([0.02 * math.sin(5.0 * t), 0.0, 0.0])
    watched.out = [0]
    watched.gyros[0] = zero
    watched.run(2.0)
    assert all(watched.step()[0].agreed is None for _ in range(100))
    watched.gyros[0] = sound
    watched.rate = lambda t: 0.2 * math.sin(5.0 * t) * np.ones(3)
    assert watched.run(2.0).step()[0].agreed is not None


@pytest.mark.parametrize(("count", "blamed"), [(2, set()), (3, {0})])
def test_a_gyro_named_in_a_hover_does_not_agree_in_a_turn_about_another_axis(
    count: int, blamed: set[int]
) -> None:
    """The turn shows nothing of the axis that is dead. Of two IMUs the name may be for another error."""
    watched = watch(count)
    hover = np.array([0.0, 0.0, 0.01])
    watched.rate = lambda t: hover
    watched.gyros[0] = lambda rate: rate * np.array([0.0, 1.0, 1.0])
    watched.states[0] = FAULTY
    assert not watched.blamed(1.0)
    watched.rate = lambda t: np.array([0.0, 0.0, 0.4])
    assert not watched.blamed(4.0)
    assert watched.step()[0].agreed is None
    watched.rate = lambda t: np.array([0.2, 0.0, 0.0])
    assert watched.blamed(2.0) == blamed


def test_a_stuck_gyro_is_blamed_beside_one_that_has_just_healed() -> None:
    """All three have not agreed since: nothing but the change of the values is known of two."""
    watched = watch()
    watched.out = watched.taken = [2]
    watched.gyros[2] = biased(0.3, axis=2)
    watched.states[8] = FAULTY
    watched.run(3.0)
    watched.gyros[2] = sound
    watched.states[8] = OK
    watched.run(0.2)
    watched.gyros[0] = lambda rate: [0.1, -0.2, 0.3]
    watched.states[:3] = [AMBIGUOUS] * 3
    assert watched.blamed(1.5) == {0}


@pytest.mark.parametrize("state", [OK, AMBIGUOUS, FAULTY])
def test_a_quiet_imu_at_rest_is_not_frozen_beside_one_that_jumps(state: int) -> None:
    """Its values repeat in whole mrad/s: what one other IMU shows proves no motion."""
    watched = watch(2)
    watched.rate = hovering
    quiet: list[Gyro] = [lambda rate: [0.0, 0.001, 0.0], biased(0.0)]
    watched.gyros = quiet
    watched.run(3.0)
    watched.states = [state] * 3 + [UNCHECKED] * 3
    watched.gyros[1] = biased(0.3)
    for _ in range(200):
        one, other = watched.step()
        assert not (one.blamed and is_reserve(other, one, PolicySettings()))


def test_axes_that_stick_in_a_steady_turn_do_not_outvote_the_third() -> None:
    """Both keep the rate of the turn after it has ended."""
    watched = watch()
    turn = np.array([0.0, 0.0, 0.4])
    watched.rate = lambda t: turn
    watched.run(6.0)
    for k in (0, 1):
        watched.gyros[k] = lambda rate: [rate[0], rate[1], 0.4]
        watched.run(8.0)
    watched.states[8] = AMBIGUOUS
    watched.rate = hovering
    assert 2 not in watched.blamed(3.0)


@pytest.mark.parametrize("lost", [4, 20])
def test_an_imu_whose_samples_are_lost_is_not_stuck(lost: int) -> None:
    raw = RawComparison(2, STEP)
    for k in range(100):
        rate = (math.sin(0.1 * k), 0.0, 0.0)
        raw.feed(0, START + k * STEP, rate)
        if not k % (lost + 1):
            raw.feed(1, START + k * STEP, rate)
        assert not raw.is_stuck(0)
        assert not raw.is_stuck(1)


def test_two_dead_gyros_with_noise_do_not_outvote_the_third_by_its_set() -> None:
    """The monitor takes the first one back and has a set in the sound one."""
    watched = watch()
    quiet = np.random.default_rng(2)

    def dead(rate: np.ndarray) -> np.ndarray:
        return quiet.normal(0.0, 0.002, 3)

    watched.gyros[0] = dead
    watched.states[:3] = [FAULTY] * 3
    assert watched.blamed(2.5) == {0}
    watched.out = [0]
    watched.gyros[1] = dead
    watched.states = [OK] * 6 + [AMBIGUOUS] * 3
    for _ in range(400):
        imus = watched.step()
        assert not imus[2].blamed
        assert imus[0].agreed is None, "it differs from one that nobody has named"


def test_a_set_within_one_of_three_is_blamed_while_the_others_are_trusted() -> None:
    watched = watch()
    watched.gyros[2] = biased(0.1)
    watched.states[6:] = [AMBIGUOUS] * 3
    assert watched.blamed(1.0) == {2}


@pytest.mark.parametrize(
    ("size", "seconds", "is_blamed"),
    [(0.08, 1.0, True), (0.08, 0.3, False), (0.05, 3.0, False)],
)
def test_a_set_of_several_imus_names_the_odd_one_by_its_size_and_time(
    size: float, seconds: float, is_blamed: bool
) -> None:
    """One of three axes is wrong, and two of them agree: from 0.06 rad/s on it is the third."""
    watched = watch()
    watched.rate = lambda t: 0.1 * np.array([math.sin(2.1 * t), math.cos(t), 0.5])
    watched.gyros[2] = biased(size)
    watched.states[::3] = [AMBIGUOUS] * 3
    assert watched.blamed(seconds) == ({2} if is_blamed else set())


def test_a_set_of_several_imus_without_an_odd_one_names_nobody() -> None:
    watched = watch()
    watched.gyros[1:] = [biased(-0.1), biased(0.1)]
    watched.states[::3] = [AMBIGUOUS] * 3
    assert not watched.blamed(3.0)
    watched = watch()
    watched.gyros[2] = biased(0.1)
    watched.states[1::3] = [AMBIGUOUS] * 3
    assert not watched.blamed(3.0), "a set of another axis"


@pytest.mark.parametrize("state", [UNCHECKED, EXCLUDED])
def test_an_axis_that_the_monitor_leaves_out_for_long_is_not_judged(state: int) -> None:
    """Where a turn begins, all axes are left out for a moment."""
    watched = watch()
    assert not any(imu.unjudged for imu in watched.step())
    watched.states[4] = state
    assert not any(imu.unjudged for imu in watched.run(0.9).step())
    assert [imu.unjudged for imu in watched.run(0.2).step()] == ["", "y", ""]
    watched.states[4] = OK
    assert not any(imu.unjudged for imu in watched.step())


@pytest.mark.parametrize(
    ("state", "axes"),
    [(FAULTY, "y"), (AMBIGUOUS, "y"), (SUSPECT, ""), (STALE, ""), (UNCHECKED, "")],
)
def test_a_declared_axis_is_one_that_is_faulty_or_in_a_set(
    state: int, axes: str
) -> None:
    watched = watch()
    assert not any(imu.declared for imu in watched.step())
    watched.states[4] = state
    assert [imu.declared for imu in watched.step()] == ["", axes, ""]
    watched.states[4] = OK
    assert not any(imu.declared for imu in watched.step())


def test_what_was_never_judged_is_not_judged() -> None:
    never = Evidence(3, STEP, min_size=0.03)
    assert [imu.unjudged for imu in never.look([True] * 3, [], START)] == ["xyz"] * 3


# Compared with one other alone ---------------------------------------------------------------


def test_an_imu_that_comes_too_slowly_hides_no_error_of_another() -> None:
    """Another station has slowed it down. The two others can still be compared."""
    watched = watch()
    watched.slow = [2]
    watched.run(1.0)
    watched.gyros[1] = biased(0.3)
    watched.states[3] = FAULTY
    assert watched.blamed(1.0) == {1}


@pytest.mark.parametrize(
    ("size", "of_other", "state", "is_blamed"),
    [
        (0.025, -0.02, OK, False),
        (0.025, -0.3, AMBIGUOUS, False),
        (0.025, -0.3, SUSPECT, False),
        (0.1, 0.0, OK, True),
        (0.1, 0.0, UNCHECKED, True),
    ],
)
def test_of_two_that_differ_the_named_one_is_blamed_only_if_the_other_is_sound(
    size: float, of_other: float, state: int, is_blamed: bool
) -> None:
    """The third is out. Two harmless errors add up, and the one not named may be the worse."""
    watched = watch()
    watched.rate = lambda t: 0.1 * np.array([math.sin(2.1 * t), math.cos(t), 0.5])
    watched.gyros[2] = biased(0.3)
    watched.states[6] = FAULTY
    watched.out = [2]
    watched.run(1.0)
    watched.gyros[:2] = [biased(size, axis=2), biased(of_other, axis=2)]
    watched.states[2], watched.states[5] = FAULTY, state
    assert (0 in watched.blamed(2.0)) == is_blamed


@pytest.mark.parametrize("state", [OK, UNCHECKED])
def test_a_named_imu_that_agrees_with_one_that_is_not_doubted_is_not_blamed(
    state: int,
) -> None:
    """The third is off by less than two harmless errors that add up; the monitor cannot check the second."""
    watched = watch()
    watched.rate = lambda t: 0.1 * np.array([math.sin(2.1 * t), math.cos(t), 0.5])
    watched.gyros[2] = biased(0.055)
    watched.states[0], watched.states[3] = FAULTY, state
    assert watched.blamed(2.0) == set()


# What is no steady error ------------------------------------------------------------------


def test_an_oscillation_is_no_clear_error() -> None:
    """1.2 rad/s at 15 Hz on the axis x, and 9 Hz on y: the mean is zero."""
    watched = watch()
    times = iter(np.arange(0.0, 100.0, 0.02))

    def shaken(rate: np.ndarray) -> Sequence[float]:
        t = next(times)
        return rate + 1.2 * np.sin(2.0 * math.pi * t * np.array([15.0, 12.0, 0.0]))

    watched.gyros[0] = shaken
    assert not watched.blamed(8.0)


def late_by(watched: Watched, delay: float) -> Gyro:
    """Return a gyro that measures this much earlier than its stamp, s."""
    return lambda rate: watched.rate(watched.t - delay)


@pytest.mark.parametrize("delay", [0.005, 0.02])
def test_an_imu_that_measures_later_is_not_blamed_in_hard_manoeuvres(
    delay: float,
) -> None:
    """Up to 60 rad/s^2: 1.2 rad/s within 20 ms."""
    watched = watch()
    watched.rate = lambda t: np.array([6.0 * math.sin(10.0 * t), 0.0, 0.0])
    watched.gyros[2] = late_by(watched, delay)
    watched.states[6:] = [SUSPECT] * 3
    assert not watched.blamed(10.0)


def test_a_named_imu_that_measures_later_is_not_blamed_in_manoeuvres() -> None:
    """Up to 8 rad/s^2: 0.06 rad/s within 7 ms. An error of 0.1 rad/s is blamed there."""
    watched = watch()
    watched.rate = lambda t: np.array([2.0 * math.sin(4.0 * t), 0.0, 0.0])
    watched.gyros[2] = late_by(watched, 0.007)
    watched.states[6] = FAULTY
    assert not watched.blamed(8.0)
    watched.gyros[2] = biased(0.1)
    assert watched.blamed(1.0) == {2}


@pytest.mark.parametrize(
    ("turn", "factor", "is_blamed"),
    [(20.0, 1.03, False), (20.0, 1.15, True), (20.0, 0.0, True), (0.7, 0.0, True)],
)
def test_an_error_of_scale_in_a_fast_turn_is_no_clear_error(
    turn: float, factor: float, is_blamed: bool
) -> None:
    watched = watch()
    watched.rate = lambda t: np.array([turn, 0.0, 0.0])
    watched.gyros[2] = lambda rate: factor * rate
    assert watched.blamed(0.5) == ({2} if is_blamed else set())


def test_a_named_gyro_within_the_tolerance_of_scales_is_not_blamed() -> None:
    """0.12 rad/s in a turn of 4 rad/s are 3 %; at rest they are an error."""
    watched = watch()
    watched.rate = lambda t: np.array([4.0, 0.0, 0.0])
    watched.gyros[2] = lambda rate: 1.03 * rate
    watched.states[6] = FAULTY
    assert not watched.blamed(2.0)
    watched.gyros[2] = biased(0.12)
    watched.rate = lambda t: np.array([0.2, 0.0, 0.0])
    assert watched.blamed(2.0) == {2}


@pytest.mark.parametrize(("size", "hertz"), [(3.0, 5.0), (3.0, 20.0), (0.4, 12.0)])
def test_an_imu_that_oscillates_and_is_named_does_not_agree(
    size: float, hertz: float
) -> None:
    """A large oscillation is an error; a smaller one may be vibration: no order, no trust."""
    watched = watch()
    watched.gyros[0] = lambda rate: (
        rate + size * np.sin(2.0 * math.pi * hertz * watched.now / NS) * np.eye(3)[0]
    )
    watched.run(1.0)
    watched.states[0] = FAULTY
    watched.run(0.2)
    found = [watched.step()[0] for _ in range(200)]
    assert not any(imu.agreed for imu in found)
    assert any(imu.blamed for imu in found) == (size > 1.0)
    assert watched.evidence.bound(0) > 0.1, "the monitor's name is not contradicted"


def vibrating(
    watched: Watched, size: float, frequency: float, bias: float = 0.0
) -> Gyro:
    """Return a gyro that vibrates about x, rad/s and Hz, with an error on the same axis."""

    def gyro(rate: np.ndarray) -> Sequence[float]:
        shaken = size * math.sin(2.0 * math.pi * frequency * watched.t)
        return rate + np.array([shaken + bias, 0.0, 0.0])

    return gyro


@pytest.mark.parametrize("loop", [400.0, 300.0])
def test_a_vibration_that_is_named_is_no_error(loop: float) -> None:
    """Each frequency is near a sum of multiples of the rates of messages and of the loop."""
    watched = watch(interval=NINE, loop=loop)
    for frequency in (65.5, 69.0, 78.0, 105.0, 116.5, 133.3, 155.6, 187.0):
        watched.states[6] = FAULTY
        watched.gyros[2] = vibrating(watched, 0.8, frequency)
        assert not watched.blamed(1.5), frequency
        watched.gyros[2] = sound
        watched.run(0.5)


def test_an_error_beside_a_vibration_is_blamed_all_the_same() -> None:
    watched = watch(interval=NINE, loop=400.0)
    watched.states[6] = FAULTY
    watched.gyros[2] = vibrating(watched, 0.2, 66.0)
    assert not watched.blamed(2.0)
    watched.gyros[2] = vibrating(watched, 0.2, 66.0, bias=0.3)
    assert watched.blamed(0.7) == {2}


def test_an_imu_that_has_healed_agrees_under_usual_vibration() -> None:
    watched = watch(interval=NINE, loop=400.0)
    watched.states[0] = FAULTY
    watched.out = [0]
    watched.gyros[0] = biased(1.0)
    assert watched.run(1.0).step()[0].agreed is None
    watched.gyros = [vibrating(watched, 0.08, f) for f in (80.0, 91.0, 73.0)]
    assert watched.run(1.0).step()[0].agreed is not None


@pytest.mark.parametrize("frequency", [49.8, 90.0, 99.7])
def test_a_pause_of_the_messages_makes_no_error_of_a_vibration(
    frequency: float,
) -> None:
    """After it the mean is of one sample, and nothing is known of the spread."""
    watched = watch(interval=NINE, loop=400.0)
    watched.states[6] = FAULTY
    watched.gyros[2] = vibrating(watched, 0.3, frequency)
    watched.run(1.0)
    for pause in (8, 14, 20):
        watched.sent += pause * NINE
        assert not watched.blamed(0.4)


def over_a_lossy_link(share: float, period: float = 0.0) -> Watched:
    """Return IMUs of whose messages a link loses a share, at random or each period, s."""
    watched = watch(interval=NINE, loop=400.0)
    lost = np.random.default_rng(3)
    feed = watched.evidence.raw.feed

    def lossy(unit: int, stamp: int, rate: tuple[float, float, float]) -> None:
        phase = stamp / NS % period / period if period else lost.random()
        if phase >= share:
            feed(unit, stamp, rate)

    watched.evidence.raw.feed = lossy  # type: ignore[method-assign]
    return watched


@pytest.mark.parametrize(
    ("frequency", "share", "period"),
    [
        (10.0, 0.45, 0.1),
        (9.8, 0.4, 0.1),
        (20.2, 0.5, 0.05),
        (5.1, 0.5, 0.2),
        (5.1, 0.3, 0.2),
    ],
)
def test_holes_that_come_as_often_as_a_vibration_make_no_error_of_it(
    frequency: float, share: float, period: float
) -> None:
    watched = over_a_lossy_link(share, period)
    watched.gyros[2] = vibrating(watched, 0.3, frequency)
    watched.run(1.0)
    watched.states[6] = FAULTY
    assert not watched.blamed(4.0)
    watched.gyros[2] = biased(0.3)
    assert watched.blamed(0.5) == {2}


def test_a_difference_stays_known_over_a_link_that_loses_messages() -> None:
    watched = over_a_lossy_link(0.4)
    for _ in range(4000):
        assert not any(math.isnan(imu.size) for imu in watched.step())


@pytest.mark.parametrize("share", [0.0, 0.2, 0.4])
def test_an_error_over_a_link_that_loses_messages_is_blamed(share: float) -> None:
    watched = over_a_lossy_link(share).run(1.0)
    watched.states[6] = FAULTY
    watched.gyros[2] = biased(0.3)
    assert watched.blamed(0.25 if share < 0.3 else 0.5) == {2}


def test_a_dead_gyro_with_noise_does_not_agree_in_a_quiet_hover() -> None:
    """Its rate differs from the others' only while they turn."""
    watched = watch()
    watched.gyros[0] = lambda rate: 0.01 * rate
    watched.states[:3] = [FAULTY] * 3
    watched.run(1.0)
    watched.out = [0]
    watched.rate = lambda t: 0.01 * np.array([math.sin(2.1 * t), 1.0, 0.0])
    assert not any(watched.step()[0].agreed for _ in range(500))
    # One that has healed agrees once the vehicle turns, and at once if it is not doubted.
    watched.gyros[0] = sound
    assert watched.run(1.0).step()[0].agreed is None
    watched.rate = lambda t: 0.2 * np.array([math.sin(2.1 * t), 1.0, 0.5])
    assert watched.run(1.0).step()[0].agreed is not None


def spiked(watched: Watched, unit: int, axis: int, size: float) -> None:
    """Let one axis of an IMU have an error for 0.4 s, in which it is named and taken out."""
    watched.gyros[unit] = biased(size, axis)
    watched.states[3 * unit + axis] = FAULTY
    assert watched.blamed(0.4) == {unit}
    watched.out = [*watched.out, unit]


def hovering(t: float) -> np.ndarray:
    """Return the rate of a vehicle that does not turn."""
    return np.zeros(3)


def turning_about(axis: int) -> Callable[[float], np.ndarray]:
    """Return the rate of a vehicle that turns to and fro about one axis."""
    return lambda t: 0.5 * math.sin(2.1 * t) * np.eye(3)[axis]


@pytest.mark.parametrize("is_seen", [True, False])
def test_an_imu_agrees_only_after_a_turn_about_each_axis_that_was_bad(
    is_seen: bool,
) -> None:
    """A spike on x, then y is dead: seen by less, or only named in a hover."""
    watched = watch()
    spiked(watched, 0, axis=0, size=3.0)
    watched.rate = turning_about(1) if is_seen else hovering
    watched.gyros[0] = lambda rate: rate * np.array([1.0, 0.01, 1.0])
    watched.states[1] = OK if is_seen else FAULTY
    watched.run(2.0)
    watched.rate = hovering
    assert watched.run(1.0).step()[0].waits == "xy"
    watched.rate = turning_about(0)
    assert not any(watched.step()[0].agreed for _ in range(200))
    assert watched.step()[0].waits == "y"
    watched.gyros[0] = sound
    watched.rate = turning_about(1)
    imu = watched.run(2.0).step()[0]
    assert imu.agreed is not None
    assert not imu.waits


def scaled(share: float) -> Gyro:
    """Return a gyro that measures a share of the rate about y."""
    return lambda rate: rate * np.array([1.0, share, 1.0])


def turning_fast(t: float) -> np.ndarray:
    """Return the rate of a vehicle that turns to and fro about y by up to 1.2 rad/s."""
    return 2.4 * turning_about(1)(t)


def without_scale(share: float = 0.5) -> Watched:
    """Return a flight in which IMU 0 keeps a share of its scale about y, goes out, and hovers."""
    watched = watch()
    watched.rate = turning_fast
    watched.gyros[0] = scaled(share)
    watched.states[1] = FAULTY
    assert watched.blamed(1.0) == {0}
    watched.out = [0]
    watched.run(2.0).rate = hovering
    return watched.run(1.0)


@pytest.mark.parametrize(
    ("first", "share"), [(0.5, 0.44), (0.5, 0.5), (0.5, 0.6), (1.5, 1.4), (2.0, 2.05)]
)
def test_one_without_scale_shows_nothing_by_agreeing_with_one_that_fails_alike(
    first: float, share: float
) -> None:
    """The monitor names the healthy one instead: in a hover before, so that it stays in use."""
    watched = without_scale(first)
    watched.gyros[1] = scaled(share)
    watched.states = [OK] * 7 + [FAULTY, OK]
    watched.run(1.0).rate = turning_fast
    waits = {watched.step()[0].waits for _ in range(400)}
    assert waits == {"y"}
    # Nor do two seconds of hover give it its vote.
    watched.states = [OK] * 9
    watched.rate = hovering
    watched.run(3.0).rate = turning_fast
    watched.states[7] = SUSPECT
    assert watched.blamed(4.0) == set()


@pytest.mark.parametrize("third", [biased(0.5, axis=1), zero, scaled(-1.0)])
def test_one_that_has_healed_shows_that_beside_a_third_that_differs_otherwise(
    third: Gyro,
) -> None:
    watched = without_scale()
    watched.gyros[0] = sound
    watched.gyros[2] = third
    watched.states = [OK] * 7 + [FAULTY, OK]
    watched.out = [0, 2]
    watched.run(1.0).rate = turning_fast
    imu = watched.run(4.0).step()[0]
    assert not imu.waits
    assert imu.agreed is not None


def test_one_that_has_healed_shows_that_beside_one_that_never_sent() -> None:
    evidence = Evidence(3, STEP, min_size=0.03)
    evidence.remember({0: {"y": Wrong(1.0, 0.5)}})
    for step in range(200):
        now = START + step * STEP
        rate = math.sin(2.1 * step * STEP / NS)
        for unit in (0, 1):
            evidence.raw.feed(unit, now, (0.0, round(rate, 3), 0.0))
        evidence.hear([OK] * 9, now)
        imus = evidence.look([True, True, False], [0], now)
    assert not imus[0].waits


@pytest.mark.parametrize(("share", "third"), [(1.1, 1.045), (1.08, 1.03)])
def test_a_small_error_of_scale_of_the_third_keeps_no_healed_one_out(
    share: float, third: float
) -> None:
    watched = watch()
    watched.rate = lambda t: np.array([0.2, 1.6 + 0.2 * math.sin(t), 0.0])
    watched.gyros[0] = scaled(share)
    watched.gyros[2] = scaled(third)
    watched.states[1] = FAULTY
    watched.run(3.0).out = [0]
    watched.run(1.0).gyros[0] = sound
    watched.states = [OK] * 9
    watched.rate = lambda t: np.array([0.2, 1.6 * math.sin(0.5 * t), 0.0])
    watched.run(12.0)
    imu = watched.step()[0]
    assert imu.agreed is not None
    assert not imu.waits


def test_agreement_with_an_axis_that_the_monitor_doubts_shows_nothing() -> None:
    """While the third one differs, in whatever way."""
    watched = without_scale()
    watched.gyros[0] = sound
    watched.gyros[2] = biased(0.5, axis=1)
    watched.states = [OK] * 4 + [AMBIGUOUS, OK] + [OK, FAULTY, OK]
    watched.out = [0, 2]
    watched.rate = turning_fast
    assert {watched.step()[0].waits for _ in range(200)} == {"y"}
    watched.states[4] = OK
    assert not watched.run(2.0).step()[0].waits


@pytest.mark.parametrize("error", ["of scale, the third agrees", "at rest, too"])
def test_agreement_with_a_doubted_axis_shows_enough_if_that_cannot_fail_alike(
    error: str,
) -> None:
    """One axis may be doubted for an error of 0.02 rad/s as long as the flight lasts."""
    watched = without_scale()
    if error == "at rest, too":
        watched.gyros[0] = biased(0.5, axis=1)
        watched.run(1.0)
        watched.gyros[2] = biased(0.08, axis=1)
    watched.gyros[0] = sound
    watched.states = [OK] * 9
    watched.states[4] = watched.states[7] = AMBIGUOUS
    watched.run(1.0).rate = turning_fast
    assert not watched.run(2.0).step()[0].waits


def test_one_that_has_failed_again_is_not_trusted_for_a_turn_from_before() -> None:
    """It heals for half a second in a turn, and fails again, together with a second one."""
    watched = without_scale()
    watched.rate = turning_fast
    watched.run(1.0).gyros[0] = sound
    watched.states = [OK] * 9
    assert not watched.run(0.5).step()[0].waits
    watched.gyros[:2] = [scaled(0.5)] * 2
    watched.run(2.0).rate = hovering
    assert watched.run(3.0).step()[0].waits == "y"
    watched.rate = turning_fast
    assert watched.blamed(3.0) == set()


def test_one_that_has_healed_and_turned_has_its_vote_again() -> None:
    watched = without_scale()
    watched.gyros[0] = sound
    watched.states = [OK] * 9
    watched.rate = turning_fast
    watched.run(4.0).gyros[2] = biased(0.8, axis=1)
    assert watched.blamed(0.5) == {2}


@pytest.mark.parametrize(("first", "second"), [(0.5, 0.4), (2.0, 2.1)])
def test_a_new_name_does_not_blame_the_one_from_which_two_differ_alike(
    first: float, second: float
) -> None:
    """The second one loses scale as the first one did; the monitor names the healthy third."""
    watched = without_scale(first)
    watched.states = [OK] * 9
    watched.gyros[1] = scaled(second)
    watched.run(1.0).rate = turning_fast
    watched.states[7] = FAULTY
    assert watched.blamed(4.0) == set()


@pytest.mark.parametrize("size", [0.15, 0.5])
def test_a_new_name_blames_one_that_differs_otherwise_beside_one_that_waits(
    size: float,
) -> None:
    """The first one has healed in a hover and waits for a turn."""
    watched = without_scale()
    watched.gyros[0] = sound
    watched.states = [OK] * 9
    watched.rate = lambda t: 0.03 * np.sin([2.1 * t, 1.7 * t, t])
    assert watched.run(2.0).step()[0].waits == "y"
    watched.gyros[2] = biased(size, axis=1)
    watched.states[7] = FAULTY
    assert watched.blamed(2.0) == {2}


def anew(watched: Watched, bad: Mapping[str, Wrong] | None = None) -> Watched:
    """Start the node anew, with what it knew of IMU 0, or with something else."""
    known = watched.evidence.bad(0) if bad is None else bad
    watched.evidence = Evidence(3, watched.interval, min_size=0.03)
    watched.evidence.remember({0: known})
    return watched


@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
@pytest.mark.parametrize(("factor", "waits"), [(0.7, "y"), (1.6, "")])
def test_a_turn_shows_a_lost_scale_after_a_restart_as_before(
    share: float, factor: float, waits: str
) -> None:
    """One that has lost a fifth differs by 0.03 rad/s from one that turns by 0.15."""
    watched = without_scale(share)
    needed = 0.06 / (1.0 - share)
    for flight in (copy.deepcopy(watched), anew(watched)):
        flight.gyros[0] = sound
        flight.rate = lambda t: 2.0 * factor * needed * turning_about(1)(t)
        assert flight.run(4.0).step()[0].waits == waits


@pytest.mark.parametrize(("rate", "waits"), [(1.1, "y"), (1.4, "")])
def test_of_an_axis_of_unknown_error_a_turn_shows_any_loss_of_scale(
    rate: float, waits: str
) -> None:
    watched = anew(without_scale(), {"y": UNKNOWN})
    watched.gyros[0] = sound
    watched.rate = lambda t: 2.0 * rate * turning_about(1)(t)
    assert watched.run(4.0).step()[0].waits == waits


def test_after_a_restart_one_that_waits_has_no_vote() -> None:
    """A second gyro loses as much of its scale. All agree in a hover, before and after it."""
    watched = without_scale()
    watched.gyros[1] = scaled(0.5)
    watched = anew(watched)
    watched.states = [OK] * 9
    watched.run(6.0).rate = turning_fast
    watched.states[7] = SUSPECT
    assert watched.blamed(4.0) == set()


@pytest.mark.parametrize(
    ("share", "less", "too_little", "more", "too_much"),
    [
        (0.1, 0.70, 0.64, 1.30, 1.36),
        (0.4, 0.40, 0.34, 1.60, 1.66),
        (0.8, 0.15, 0.09, 2.00, 2.06),
        (1.1, 0.15, 0.09, 2.30, 2.36),
        (1.3, math.nan, 0.90, math.nan, 1.1),
    ],
)
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_an_error_of_scale_explains_rates_within_two_tenths(
    share: float,
    less: float,
    too_little: float,
    more: float,
    too_much: float,
    sign: float,
) -> None:
    """Beside a gyro that measures 1 rad/s, with errors of 0.03 rad/s at rest."""
    wrong = Wrong(1.0, share)
    for rate, is_explained in (
        (less, True),
        (too_little, False),
        (more, True),
        (too_much, False),
    ):
        found = wrong.explains(sign, sign * rate, 0.03)
        assert math.isnan(rate) or found == is_explained
    # It may have been any error.
    assert UNKNOWN.explains(sign, 0.15 * sign, 0.03)
    assert UNKNOWN.explains(sign, 2.2 * sign, 0.03)


@pytest.mark.parametrize("rate", [0.013, 0.4, 1.25, 30.0, math.inf])
@pytest.mark.parametrize("share", [0.03, 0.2, 1.0, 40.0])
def test_what_a_file_keeps_of_an_error_is_shown_by_a_turn_that_shows_it(
    rate: float, share: float
) -> None:
    wrong = Wrong(rate, share)
    kept = wrong.in_steps()
    assert wrong.rate <= kept.rate <= 1.26 * rate
    assert share / 1.26 <= kept.share <= share * 1.001
    assert kept.in_steps() == pytest.approx(kept)
    for exact in (UNKNOWN, WITHOUT_SCALE):
        assert exact.in_steps() == exact


def test_an_imu_that_is_out_without_a_known_axis_waits_for_turns_about_all() -> None:
    watched = watch()
    watched.rate = turning_about(2)
    watched.run(0.5).out = [0]
    assert watched.run(2.0).step()[0].waits == "xy"


def test_a_contradiction_of_an_unnamed_imu_suspends_the_time_of_agreement() -> None:
    """The other one fails for half a second. A turn about its bad axis is needed after it."""
    watched = watch()
    spiked(watched, 0, axis=0, size=3.0)
    watched.gyros[0] = sound
    watched.states[0] = OK
    before = watched.run(4.0).step()[0]
    begun = watched.now
    watched.gyros[1] = biased(0.2, axis=1)
    assert watched.blamed(0.5) == set()
    during = watched.step()[0]
    assert before.agreed is not None
    assert (during.agreed, during.waits) == (None, "y")
    watched.gyros[1] = sound
    ended = watched.now
    after = watched.run(2.0).step()[0]
    assert after.agreed is not None
    counted = watched.now - after.agreed
    assert counted < watched.now - before.agreed - (ended - begun) + 200 * MS
    assert counted > begun - before.agreed + NS


def test_of_two_imus_that_fail_alike_each_differs_from_one_that_is_ok() -> None:
    """Both in use and FAULTY agree with each other: both are apart from the third."""
    watched = watch()
    watched.gyros[:2] = [lambda rate: rate * np.array([1.0, 0.01, 1.0])] * 2
    watched.states[1] = watched.states[4] = FAULTY
    assert watched.blamed(1.0) == {0, 1}
    # A name that is remembered is no witness against one that agrees with the third.
    watched.gyros[:2] = [sound] * 2
    assert watched.run(1.0).blamed(1.0) == set()


def test_a_noisy_gyro_at_rest_does_not_make_the_others_stuck() -> None:
    watched = watch()
    watched.gyros[1] = lambda rate: watched.random.normal(0.0, 0.03, 3)
    watched.gyros[0] = watched.gyros[2] = zero
    assert not any(imu.stuck for _ in range(300) for imu in watched.step())


def test_scales_explain_a_difference_until_the_turn_is_out_of_the_average() -> None:
    """A roll of 12 rad/s that stops within 60 ms, and a scale that is 3 % off."""
    watched = watch()
    begun = watched.now
    watched.rate = lambda t: np.array(
        [
            12.0 * float(np.clip((1.0 - (watched.now - begun) / NS) / 0.06, 0.0, 1.0)),
            0,
            0,
        ]
    )
    watched.gyros[2] = lambda rate: 1.03 * rate
    watched.states[6] = FAULTY
    assert not watched.blamed(2.0)


def test_samples_that_come_too_slowly_or_too_fast() -> None:
    """Slow ones do not show vibration: unknown. Of fast ones only some are compared."""
    slow = RawComparison(2, STEP)
    fast = RawComparison(2, STEP)
    for k in range(200):
        for unit in (0, 1):
            slow.feed(unit, START + 2 * k * STEP, (0.1 * unit, 0.0, 0.0))
            fast.feed(unit, START + k * STEP // 4, (0.1 * unit, 0.0, 0.0))
    assert slow.between(0, 1, START + 400 * STEP) is None
    assert fast.between(0, 1, START + 50 * STEP, 32) is not None
    assert fast.between(0, 1, START + 50 * STEP, 33) is None


def test_a_set_that_flickers_names_its_imu() -> None:
    watched = watch()
    watched.gyros[2] = biased(0.1)
    found = set()
    for k in range(20):
        watched.states[6:] = [OK if k % 2 else AMBIGUOUS] * 3
        found |= watched.blamed(0.1)
    assert found == {2}


# Votes by axis ----------------------------------------------------------------------------


def with_one_out(rate: Callable[[float], np.ndarray], third: Gyro) -> Watched:
    """IMU 1 has a harmless error on z that is named, IMU 3 is out of use and FAULTY on x."""
    watched = watch()
    watched.rate = rate
    watched.gyros[0] = biased(0.02, axis=2)
    watched.states[2] = FAULTY
    watched.gyros[2] = third
    watched.states[6] = FAULTY
    watched.out = [2]
    return watched.run(4.0)


@pytest.mark.parametrize("state", [FAULTY, AMBIGUOUS])
def test_an_imu_that_is_out_for_one_axis_is_a_witness_on_another(state: int) -> None:
    watched = with_one_out(turning_about(2), biased(0.3, axis=0))
    watched.gyros[1] = biased(0.15, axis=2)
    watched.states[5] = state
    watched.states[8] = AMBIGUOUS
    assert watched.blamed(1.0) == {1, 2}
    assert watched.step()[0].size < 0.03


@pytest.mark.parametrize("third", [biased(0.3), zero])
def test_an_imu_that_is_out_is_no_witness_before_a_turn(third: Gyro) -> None:
    """It may be dead, as another one that dies later: the two agree at rest."""
    watched = with_one_out(turning_about(0), third)
    watched.gyros[0] = lambda rate: rate * np.array([1.0, 1.0, 0.0])
    watched.states[5] = watched.states[8] = AMBIGUOUS
    watched.rate = turning_about(2)
    assert 1 not in watched.blamed(2.0)


def test_two_that_are_bad_on_an_axis_have_no_vote_there_while_they_agree() -> None:
    """One has lost half of its scale, the other one has a bias: alike at 0.3 rad/s."""
    watched = watch()
    watched.rate = turning_about(2)
    watched.gyros[0] = lambda rate: rate * np.array([1.0, 1.0, 0.5])
    watched.states[2] = FAULTY
    watched.run(1.0).out = [0]
    watched.gyros[1] = biased(-0.15, axis=2)
    watched.states[5] = watched.states[8] = AMBIGUOUS
    watched.run(3.0)
    watched.rate = lambda t: np.array([0.0, 0.0, 0.3])
    assert 2 not in watched.blamed(3.0)


def test_an_imu_with_a_harmless_error_is_a_witness_in_a_hover() -> None:
    """It is FAULTY, but moves as the others do. So one of the two that differ is the odd one."""
    watched = watch()
    watched.rate = lambda t: 0.015 * np.sin(np.array([3.0, 2.3, 1.1]) * t)
    watched.run(1.0)
    watched.gyros[0] = biased(0.008)
    watched.states[0] = FAULTY
    watched.run(3.0)
    watched.gyros[1] = biased(0.25)
    watched.states[3] = watched.states[6] = AMBIGUOUS
    assert watched.blamed(1.0) == {1}


def test_the_last_gyro_of_an_axis_is_fine_on_the_others() -> None:
    watched = watch()
    watched.gyros[2] = biased(0.3, axis=2)
    watched.states[8] = FAULTY
    watched.out = [2]
    watched.run(2.0)
    watched.gyros[0] = zero
    watched.states[:3] = [FAULTY] * 3
    watched.states[5] = UNCHECKED
    assert watched.blamed(1.0) == {0, 2}
    watched.run(0.2)
    imus = watched.step()
    assert [imu.fine for imu in imus] == ["", "xy", ""]
    assert imus[0].worst in ("x", "y")
    watched.states[2] = OK
    assert watched.step()[1].fine == ""


def test_an_imu_that_is_apart_is_not_ok_once_it_was_doubted() -> None:
    """The monitor may withdraw its doubt while the difference lasts."""
    watched = watch(2)
    watched.gyros[1] = biased(0.3)
    watched.states[0] = watched.states[3] = AMBIGUOUS
    watched.run(0.5)
    watched.states[0], watched.states[3] = FAULTY, OK
    imu = watched.run(1.0).step()[1]
    assert (imu.ok, imu.fine) == (False, "")
    watched.gyros[1] = sound
    imu = watched.run(2.0).step()[1]
    assert (imu.ok, imu.fine) == (True, "xyz")


# A name and its size ----------------------------------------------------------------------


def test_a_name_on_another_axis_is_no_witness() -> None:
    watched = watch()
    watched.states[1] = FAULTY
    watched.gyros[0] = biased(0.2, axis=0)
    assert not watched.blamed(3.0)
    watched.gyros[0] = biased(0.2, axis=1)
    assert watched.blamed(1.0) == {0}


@pytest.mark.parametrize("state", [FAULTY, AMBIGUOUS])
def test_of_two_imus_an_old_name_is_no_witness_against_a_new_difference(
    state: int,
) -> None:
    """The monitor remembers a fault that is over; then the other gyro fails."""
    watched = watch(2)
    watched.gyros[0] = biased(0.3)
    watched.states[0] = state
    assert watched.blamed(1.0) == {0}
    watched.gyros[0] = sound
    watched.run(4.0)
    watched.gyros[1] = biased(0.3)
    assert not watched.blamed(5.0)
    # Named anew, it counts again.
    watched.gyros[1] = sound
    watched.states[0] = OK
    watched.run(1.0)
    watched.states[0] = state
    watched.gyros[0] = biased(0.3)
    assert watched.blamed(1.0) == {0}


@pytest.mark.parametrize("worse", [0, 1])
@pytest.mark.parametrize("state", [OK, UNCHECKED, FAULTY])
def test_of_two_imus_a_name_for_a_harmless_error_says_nothing_of_a_later_one(
    worse: int, state: int
) -> None:
    """Either may have failed, and the monitor may find the worse one OK for a while."""
    watched = watch(2)
    watched.gyros[0] = biased(0.02)
    watched.states[0] = FAULTY
    assert not watched.blamed(1.0)
    watched.gyros[worse] = biased(0.3)
    watched.states[3] = state
    assert not watched.blamed(5.0)


def test_two_that_differ_from_each_other_do_not_confirm_an_old_name() -> None:
    """They fail one after the other, in the same direction."""
    watched = watch()
    watched.gyros[2] = biased(0.008)
    watched.states[6] = FAULTY
    assert not watched.blamed(1.0)
    watched.gyros[1] = biased(-0.1)
    watched.gyros[0] = biased(-0.4)
    watched.states[0] = SUSPECT
    assert 2 not in watched.blamed(2.0)


def test_an_imu_is_not_blamed_for_an_error_that_has_ended() -> None:
    """Of two IMUs the monitor cannot check the other one while the first repeats one value."""
    watched = watch(2)
    watched.gyros[0] = lambda rate: [0.5, 0.5, 0.2]
    watched.states[:] = [FAULTY] * 3 + [UNCHECKED] * 3
    assert watched.blamed(2.0) == {0}
    watched.gyros[0] = sound
    watched.run(0.2)
    assert not watched.blamed(2.0)


def test_of_three_imus_an_old_name_counts_for_the_odd_one() -> None:
    """A fault that comes and goes while it stays declared."""
    watched = watch()
    watched.states[0] = FAULTY
    watched.run(4.0)
    watched.gyros[0] = biased(0.1)
    assert watched.blamed(1.0) == {0}
    watched.gyros[:2] = [sound, biased(0.1)]
    assert not watched.run(1.0).blamed(1.0)


@pytest.mark.parametrize(
    ("size", "third", "blamed"),
    [(0.5, OK, {0, 1}), (0.1, OK, {0, 1}), (0.5, AMBIGUOUS, {1})],
)
def test_an_old_name_counts_on_an_axis_on_which_the_others_agree(
    size: float, third: int, blamed: set[int]
) -> None:
    """A harmless error stays declared; another IMU fails on y; then the first error grows."""
    watched = watch()
    watched.states[0] = FAULTY
    watched.run(4.0)
    watched.gyros[1] = biased(1.0, axis=1)
    watched.states[4] = FAULTY
    assert watched.blamed(1.0) == {1}
    watched.states[6] = third
    watched.gyros[0] = biased(size, axis=0)
    assert watched.blamed(2.0) == blamed


def test_imus_are_trusted_after_two_seconds_of_agreement() -> None:
    watched = Watched(3, STEP, 1000.0).run(1.8)
    assert not any(track.is_trusted for track in watched.evidence.tracks)
    watched.run(0.6)
    assert all(track.is_trusted for track in watched.evidence.tracks)


@pytest.mark.parametrize(("rate", "trusted"), [(0.09, False), (0.11, True)])
def test_imus_are_trusted_once_they_have_turned_by_a_tenth_of_a_rad_per_second(
    rate: float, trusted: bool
) -> None:
    """A dead gyro agrees with one at rest."""
    watched = Watched(3, STEP, 1000.0)
    watched.rate = lambda t: np.array([rate, 0.0, 0.0])
    watched.run(3.0)
    assert all(track.is_trusted for track in watched.evidence.tracks) == trusted


@pytest.mark.parametrize(("change", "moves"), [(0.004, set()), (0.006, {0})])
def test_an_axis_moves_whose_rate_changes_by_five_mrad_per_second(
    change: float, moves: set[int]
) -> None:
    """Of gyros without noise. Five seconds later that is forgotten."""
    watched = Watched(3, STEP, 1000.0)
    watched.random = SimpleNamespace(normal=lambda *_: np.zeros(3))
    watched.rate = lambda t: np.array([0.1 + change * (t > 2.0), 0.0, 0.0])
    watched.run(6.5)
    assert watched.evidence.tracks[0].moves == moves
    watched.run(2.0)
    assert watched.evidence.tracks[0].moves == set()


def test_an_axis_counts_as_judged_for_a_second() -> None:
    watched = watch()
    watched.states[1] = UNCHECKED
    assert watched.run(0.9).step()[0].unjudged == ""
    assert watched.run(0.3).step()[0].unjudged == "y"


@pytest.mark.parametrize(("pause", "anew"), [(0.4, False), (0.6, True)])
def test_states_begin_anew_after_a_pause_of_half_a_second(
    pause: float, anew: bool
) -> None:
    watched = watch()
    begun = watched.evidence.begun
    watched.is_reporting = False
    watched.run(pause)
    watched.is_reporting = True
    watched.step()
    assert (watched.evidence.begun > begun) == anew


def test_what_a_monitor_said_is_unknown_five_seconds_after_it_died() -> None:
    watched = watch()
    watched.states[0] = FAULTY
    watched.run(1.0)
    assert watched.step()[0].named is True
    watched.is_reporting = False
    assert watched.run(4.5).step()[0].named is True
    found = watched.run(1.0).step()
    assert [(imu.named, imu.ok) for imu in found] == [(None, False)] * 3


def test_rows_are_the_last_ones_in_their_order() -> None:
    rows = Rows(kept=3)
    for k in range(100):
        rows.append(k, (k, 0.0, 0.0))
        assert rows.times.tolist() == list(range(max(0, k - 2), k + 1))
        assert rows.last(2)[:, 0].tolist() == list(range(max(0, k - 1), k + 1))
    rows.drop(98)
    assert rows.values.tolist() == [[99.0, 0.0, 0.0]]


def test_an_error_has_a_size_on_a_slow_link_too() -> None:
    """At 22 Hz two samples are all within the time over which it is averaged."""
    watched = watch(interval=45 * MS)
    watched.gyros[1] = biased(0.5)
    watched.run(1.0)
    axis, size = watched.evidence.error(1, watched.now) or ("", 0.0)
    assert axis == "x"
    assert size == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize("unit", [0, 1, 2])
@pytest.mark.parametrize("error", [-0.5, 0.5])
def test_an_error_has_the_sign_of_the_imu_that_is_off(unit: int, error: float) -> None:
    watched = watch()
    watched.gyros[unit] = biased(error)
    watched.run(1.0)
    axis, size = watched.evidence.error(unit, watched.now) or ("", 0.0)
    assert axis == "x"
    assert size == pytest.approx(error, abs=0.02)


@pytest.mark.parametrize(("apart", "compared"), [(7, True), (9, False)])
def test_samples_form_a_pair_within_four_tenths_of_an_interval(
    apart: int, compared: bool
) -> None:
    raw = RawComparison(2, STEP)
    for k in range(20):
        raw.feed(0, START + 20 * k * MS, (0.1, 0.0, 0.0))
        # The next sample of the first comes 20 ms later, and is not compared with this.
        raw.feed(1, START + (20 * k + apart) * MS, (0.0, 0.0, 0.0))
    found = raw.between(0, 1, START + 400 * MS)
    assert (found is not None) == compared
    assert not compared or found.mean == pytest.approx((0.1, 0.0, 0.0))


@pytest.mark.parametrize(("stands", "blamed"), [(0.2, set()), (0.6, {2})])
def test_a_doubt_of_two_is_refuted_once_they_have_agreed_for_a_time(
    stands: float, blamed: set[int]
) -> None:
    """The monitor may see a common fault of two before their raw rates show the fault."""
    watched = watch()
    watched.states[:6] = [AMBIGUOUS, OK, OK] * 2
    watched.run(stands)
    watched.gyros[2] = biased(-0.7)
    assert watched.blamed(0.5) == blamed


def shaking_late() -> Watched:
    """Return IMUs in a vehicle that shakes, the first of which measures 2.5 ms later."""
    watched = watch(interval=NINE, loop=400.0)
    watched.rate = lambda t: np.array([1.2 * math.sin(75.0 * t), 0.0, 0.0])
    watched.gyros[0] = late_by(watched, 0.0025)
    return watched


def test_imus_that_differ_by_a_delay_alone_outvote_the_third() -> None:
    watched = shaking_late().run(1.0)
    watched.states = [AMBIGUOUS, OK, OK] * 3
    watched.gyros[2] = biased(-0.2)
    assert watched.blamed(1.0) == {2}


def test_an_imu_that_has_healed_is_trusted_again_while_the_vehicle_shakes() -> None:
    watched = shaking_late()
    watched.gyros[0] = biased(0.5)
    watched.states[0] = FAULTY
    assert watched.blamed(1.0) == {0}
    watched.gyros[0] = late_by(watched, 0.0025)
    watched.run(1.5)
    watched.states[0] = OK
    watched.run(1.5)
    watched.states = [AMBIGUOUS, OK, OK] * 3
    watched.gyros[2] = biased(-0.2)
    assert watched.blamed(1.0) == {2}


@pytest.mark.parametrize("seed", [138, 1145])
def test_a_random_flight_is_right_by_the_true_errors(seed: int) -> None:
    """`python -m mavlink.watched_flights 200` flies more."""
    done = WatchedFlight(seed).fly()
    assert done["out of use"] >= 1


@pytest.mark.parametrize("seed", [41003, 41039])
def test_two_that_lose_scale_alike_never_take_the_third_out(seed: int) -> None:
    """The node is started anew in these flights, in which the healthy IMU once went out."""
    flight = WatchedFlight(seed, are_similar=True, is_anew=True)
    assert flight.fly()["out of use"] == 1


def test_two_that_read_twice_the_rate_never_take_the_third_out() -> None:
    """A fast turn about other axes once hid the error of the first, and it got its vote back."""
    flight = WatchedFlight(323, are_similar=True, more=1.5)
    assert flight.fly()["out of use"] == 1


def test_an_imu_is_not_blamed_for_the_error_of_another_that_has_healed() -> None:
    """One is out, one is FAULTY and off by 0.008 rad/s, and the last is off for a second."""
    watched = watch()
    watched.rate = hovering
    watched.gyros[1] = biased(0.3, axis=0)
    watched.states[3] = FAULTY
    watched.run(1.0).out = [1]
    watched.gyros[0] = biased(0.008, axis=2)
    watched.states[2] = FAULTY
    watched.run(2.0)
    watched.gyros[2] = biased(1.5, axis=2)
    watched.states[8] = AMBIGUOUS
    assert 0 not in watched.blamed(1.0)
    watched.gyros[2] = sound
    watched.run(0.2)
    watched.states[8] = OK
    assert 0 not in watched.blamed(2.0)


def test_a_missing_rate_does_not_make_an_oscillation_steady() -> None:
    """Differences of 0.5 rad/s that change their sign four times a second, and one NaN in 16."""
    raw = RawComparison(2, STEP)
    found = []
    for k in range(1, 400):
        size = 0.5 if k // 6 % 2 else -0.5
        raw.feed(0, START + k * STEP, (0.0, 0.0, 0.0))
        raw.feed(1, START + k * STEP, (math.nan if k % 16 == 0 else size, 0.0, 0.0))
        found.append(raw.steady(0, 1, START + k * STEP)[0])
    assert not any(abs(size) > 0.1 for size in found[50:])
