# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Failover: never a healthy IMU, never the last, never worse than none; and its conversation with an autopilot."""

import copy
import copyreg
import errno
import functools
import json
import math
import os
import struct
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fdi_ros.errors import ConfigError
from fdi_ros.mavlink import kept_file
from fdi_ros.mavlink.failover.controller import OVERSAMPLING, Failover
from fdi_ros.mavlink.failover.file import FailoverFile, Saved
from fdi_ros.mavlink.failover.policy import PolicySettings
from fdi_ros.mavlink.failover.words import Condition, imu_name, text_of
from fdi_ros.system.clocks import Clocks
from mavlink.autopilots import (
    EKF_LANES,
    EKF_PRIMARY,
    NS,
    PARAMETERS,
    UTC,
    Autopilot,
    Conversation,
    Gentle,
    Motion,
    gentle,
)
from mavlink.flights import Flight

MS = 1_000_000
#: Simulated time between two turns of failover, ns. A node takes them faster, and a turn
#: costs a test as much as a simulated link of 15 ms.
TURN = 60 * MS
OK, SUSPECT, AMBIGUOUS, FAULTY, STALE, UNCHECKED = range(6)
CHANNELS = [f"imu_{k}.{axis}" for k in (1, 2, 3) for axis in "xyz"]
DANGER = "faulty AND IN USE: land"


#: Flights that failed once: the report of an order to take an IMU out came after its
#: release (493), the link fell silent (1170).
ODD_SEEDS = (493, 1170)


@pytest.mark.parametrize("seeds", [range(14), [*range(14, 26), *ODD_SEEDS]])
def test_the_vehicle_never_loses_its_last_imu_by_our_hand(seeds: Sequence[int]) -> None:
    """By the truth of random flights; `python -m mavlink.flights 20000` for more."""
    done = sum((Flight(seed).fly() for seed in seeds), Counter())
    kinds = ("out of use", "in use", "DANGER", "LEFT_ALONE", "STAYS_OUT", "LAST_LANE")
    assert min(done[kind] for kind in kinds) > 0


class Monitored(Conversation):
    """A conversation with failover and a monitor that reports given states, each `TURN`."""

    def __init__(
        self,
        path: Path,
        *autopilots: Autopilot,
        limit: int = 0,
        min_size: float = 0.03,
        **settings,
    ) -> None:
        rate = 50.0 * OVERSAMPLING
        super().__init__(*autopilots, may_set=True, rate=rate, **settings)
        policy = PolicySettings(limit, min_size)
        self.failover = Failover(
            self.vehicle, CHANNELS, policy, path / "out.json", self.read_clocks
        )
        #: Clocks of the companion. None: Unix time alone.
        self.clocks: Callable[[], Clocks] | None = None
        self.states = [OK] * 9
        #: Simulated seconds pass in milliseconds, too short for a real disk.
        self.waits_for_disk = True
        self.failover.is_alone = self.reports = True
        self.failover.age = 0.02
        self._fed = 0

    def read_clocks(self) -> Clocks:
        return self.clocks() if self.clocks else Clocks(self.unix())

    def copy(self, path: Path, monkeypatch: pytest.MonkeyPatch) -> "Monitored":
        """Return the same flight at the same time, with a file of its own."""
        lock = type(self.autopilots[0]._lock)
        with monkeypatch.context() as patch:
            for kind in (struct.Struct, ModuleType):
                patch.setitem(copyreg.dispatch_table, kind, lambda _: "itself")
            patch.setitem(copyreg.dispatch_table, lock, lambda _: (threading.Lock, ()))
            file = FailoverFile(path / "out.json", 3)
            samples = list(self.samples)
            known = {id(self.failover._file): file, id(self.samples): samples}
            return copy.deepcopy(self, known)

    def run(self, seconds: float) -> "Monitored":
        end = self.now + round(seconds * NS)
        while self.now < end:
            super().run(min(TURN, end - self.now) / NS)
            for _, sample in self.samples[self._fed :]:
                self.failover.feed(sample)
            self._fed = len(self.samples)
            if self.reports:
                self.failover.reported = self.now
            self.failover.evidence.hear(self.states, self.now)
            self.failover.turn(self.now)
            if self.waits_for_disk:
                self.failover._file._wait()
        return self

    def fault(
        self,
        imu: int,
        size: float | Sequence[float],
        states: Sequence[int] = (OK, FAULTY, OK),
        seconds: float = 0.0,
    ) -> "Monitored":
        """Give IMU `imu` (1 to 3) an error on y, or on its axes, and the states of its channels."""
        self.autopilots[0].bias[imu - 1] = (
            (0.0, size, 0.0) if isinstance(size, float) else size
        )
        self.states[3 * imu - 3 : 3 * imu] = states
        return self.run(seconds)

    def heal(self, imu: int, seconds: float = 0.0) -> "Monitored":
        return self.fault(imu, 0.0, (OK, OK, OK), seconds)

    @property
    def texts(self) -> list[str]:
        return [text.removeprefix("FDI: ") for _, text in self.autopilots[0].texts]

    @property
    def in_use(self) -> list[bool]:
        parameters = self.autopilots[0].parameters
        return [bool(parameters[name]) for name in PARAMETERS]


def kept(talk: Monitored, folder: Path, out: Sequence[int] = (1,)) -> tuple:
    """System and IMUs in the file; a thread writes it, so the flight goes on meanwhile."""
    file, content = folder / "out.json", {"system_id": 0, "out_of_use": []}

    def is_written() -> bool:
        if file.exists():
            content.update(json.loads(file.read_text()))
        return file.exists() and content["out_of_use"] == list(out)

    until(talk, is_written)
    return content["system_id"], content["out_of_use"]


def until(talk: Monitored, condition: Callable[[], bool]) -> bool:
    """Fly on until something has come about that a thread does; whether it has."""
    end = time.monotonic() + 60.0
    while not condition() and time.monotonic() < end:
        time.sleep(0.02)
        talk.run(0.02)
    return condition()


class Moved:
    """Motion of three IMUs that a test changes in flight, with noise of 2 mrad/s."""

    def __init__(self, *rate: float, noise: float = 0.002) -> None:
        self.rate = np.array(rate)
        #: Factors by IMU and axis, and standard deviations by IMU that replace 2 mrad/s.
        self.scale = np.ones((3, 3))
        self.noise = np.full((3, 1), noise)
        self.random = np.random.default_rng(1)

    def __call__(self, t: float) -> np.ndarray:
        wobble = self.rate * (1.0 + 0.3 * math.sin(3.0 * t))
        return wobble * self.scale + self.noise * self.random.normal(size=(3, 3))


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Monitored]:
    """Flights that several tests begin with, each flown once: 10 s on the ground, 3 s armed."""

    @functools.cache
    def fly(limit: int = 0, motion: tuple[float, ...] = (), **settings) -> Monitored:
        moved = Moved(*motion[:3], noise=motion[3]) if motion else None
        autopilot = Autopilot("ardupilot", motion=moved, **settings)
        folder = tmp_path_factory.mktemp("flight")
        talk = Monitored(folder, autopilot, limit=limit).run(10.0)
        autopilot.armed = True
        return talk.run(3.0)

    return fly


@pytest.fixture
def begin(
    flown: Callable[..., Monitored], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., Monitored]:
    """Begin with such a flight, whose file is in the folder of the test."""
    return lambda **settings: flown(**settings).copy(tmp_path, monkeypatch)


@pytest.fixture
def flying(begin: Callable[..., Monitored]) -> Monitored:
    return begin(late_reads=80 * MS)


Moving = Callable[..., tuple[Monitored, Moved]]


@pytest.fixture
def moving(begin: Callable[..., Monitored]) -> Moving:
    """Begin with a flight at some rate, rad/s: the flight and its motion."""

    def fly(*rate: float, noise: float = 0.002) -> tuple[Monitored, Moved]:
        talk = begin(motion=(*rate, noise))
        return talk, talk.autopilots[0].motion

    return fly


# What it does in flight ----------------------------------------------------------------


def test_a_bad_imu_is_out_soon_and_back_two_seconds_after_it_agrees(
    flying: Monitored, tmp_path: Path
) -> None:
    autopilot, at = flying.autopilots[0], flying.now
    flying.fault(1, 0.3, seconds=1.0)
    assert autopilot.sets[0] == (pytest.approx(at, abs=300 * MS), "INS_USE", 0.0)
    assert {order[1:] for order in autopilot.sets} == {("INS_USE", 0.0)}
    assert autopilot.flies_with == 1
    assert flying.texts[-1].startswith("IMU 1 out of use (gyro y +0.3")
    assert kept(flying, tmp_path) == (1, [1])
    # The monitor still names it: in flight its raw values decide, as it costs an EKF lane.
    flying.fault(1, 0.0, seconds=1.5)
    assert flying.in_use == [False, True, True]
    flying.run(1.5)
    assert flying.in_use == [True, True, True]
    assert flying.run(4.0).texts[-1] == "IMU 1 in use, does not differ"
    assert kept(flying, tmp_path, ()) == (1, [])


def test_a_healthy_flight_has_no_order_and_no_critical_text(flying: Monitored) -> None:
    flying.run(30.0)
    assert not flying.autopilots[0].sets
    assert flying.texts == ["failover is ready"]


def test_a_harmless_error_takes_no_slot(flying: Monitored) -> None:
    """0.012 rad/s stays on IMU 2, then 1.0 on IMU 1: the flight that hit the ground."""
    flying.fault(2, 0.012, seconds=10.0)
    assert not flying.autopilots[0].sets
    flying.fault(1, 1.0, seconds=0.5)
    assert flying.in_use == [False, True, True]
    assert not any(DANGER in text for text in flying.texts)


def test_a_misled_primary_lane_is_left_after_the_order(flying: Monitored) -> None:
    """Without it ArduCopter stayed on the lane, and lost 1.3 m of height."""
    autopilot = flying.autopilots[0]
    flying.fault(1, 0.5, seconds=0.6)
    assert flying.in_use == [False, True, True]
    assert autopilot.misled[0] > 0.02
    flying.run(3.0)
    assert autopilot.primary == 1
    assert len(autopilot.lane_asks) == 1
    flying.run(2.0)
    flying.fault(2, [0.0, 0.0, 0.5], (OK, OK, FAULTY), 4.0)
    assert flying.in_use == [False, False, True]
    assert [autopilot.primary, len(autopilot.lane_asks)] == [2, 2]


def test_the_lane_is_not_left_for_an_imu_that_it_does_not_run_on(
    flying: Monitored,
) -> None:
    """The lane that the bad IMU misled just now may still have the better score."""
    autopilot = flying.autopilots[0]
    flying.fault(2, 0.5, seconds=5.0)
    flying.heal(2, 8.0)
    flying.fault(3, -0.5, seconds=5.0)
    assert not autopilot.lane_asks
    assert autopilot.primary == 0


def test_a_lane_that_the_autopilot_has_left_by_itself_is_known(
    flying: Monitored,
) -> None:
    autopilot = flying.autopilots[0]
    out: list[bytes] = []
    autopilot.change_primary(1, flying.now, out)
    flying.inject(b"".join(out))
    flying.fault(1, 0.5, seconds=5.0)
    assert not autopilot.lane_asks
    flying.heal(1, 8.0)
    flying.fault(2, 0.5, seconds=5.0)
    assert autopilot.lane_asks
    assert autopilot.primary == 2


@pytest.mark.parametrize("parameters", [{EKF_LANES: 6.0}, {EKF_PRIMARY: None}])
def test_without_knowing_the_lanes_none_is_asked_for(
    tmp_path: Path, parameters: dict[str, float | None]
) -> None:
    autopilot = Autopilot("ardupilot")
    for name, value in parameters.items():
        if value is None:
            del autopilot.parameters[name]
        else:
            autopilot.parameters[name] = value
    autopilot.reboot(autopilot.boot)
    talk = Monitored(tmp_path, autopilot).run(10.0)
    autopilot.armed = True
    talk.run(3.0).fault(1, 0.5, seconds=5.0)
    assert talk.in_use == [False, True, True]
    assert not autopilot.lane_asks


@pytest.mark.parametrize("gap", [0.02, 0.3, 0.42, 0.48, 1.0])
def test_after_a_gap_in_flight_no_lane_is_asked_for_until_one_is_named(
    flying: Monitored, gap: float
) -> None:
    """Both texts of a change may have been lost; from 0.4 s on the numbers look late."""
    autopilot = flying.autopilots[0]
    flying.cut = True
    flying.run(gap)
    autopilot.change_primary(1, flying.now, [])
    flying.cut = False
    flying.run(6.0).fault(1, 0.5, seconds=5.0)
    assert flying.in_use == [False, True, True]
    assert not autopilot.lane_asks
    flying.heal(1, 8.0)
    out: list[bytes] = []
    autopilot.change_primary(2, flying.now, out)
    flying.inject(b"".join(out))
    flying.run(6.0).fault(3, 0.5, seconds=5.0)
    assert autopilot.lane_asks


def test_a_silence_after_which_the_numbers_go_on_may_hide_texts_too(
    flying: Monitored,
) -> None:
    """256 lost messages leave no gap in the sequence numbers."""
    autopilot = flying.autopilots[0]
    number = autopilot.mav.seq
    flying.cut = True
    flying.run(0.6)
    autopilot.mav.seq = number
    flying.cut = False
    flying.run(6.0).fault(1, 0.5, seconds=5.0)
    assert flying.in_use == [False, True, True]
    assert not autopilot.lane_asks


@pytest.mark.parametrize("lost", [1, 2])
def test_two_lost_messages_in_a_row_may_be_the_texts_and_one_is_not(
    flying: Monitored, lost: int
) -> None:
    autopilot = flying.autopilots[0]
    autopilot.mav.seq = (autopilot.mav.seq + lost) % 256
    flying.run(1.0).fault(1, 0.5, seconds=3.0)
    assert flying.in_use == [False, True, True]
    assert bool(autopilot.lane_asks) == (lost == 1)


@pytest.mark.parametrize("lost", [0, 1])
def test_one_text_of_a_change_suffices(flying: Monitored, lost: int) -> None:
    autopilot = flying.autopilots[0]
    out: list[bytes] = []
    autopilot.change_primary(1, flying.now, out)
    del out[lost]
    flying.inject(b"".join(out))
    flying.run(6.0).fault(2, 0.5, seconds=3.0)
    assert autopilot.lane_asks
    assert autopilot.primary == 0


def test_a_text_that_comes_late_names_no_lane(flying: Monitored) -> None:
    """It may be from before the last change."""
    autopilot = flying.autopilots[0]
    old: list[bytes] = []
    autopilot.change_primary(1, flying.now, old)
    new: list[bytes] = []
    autopilot.change_primary(0, flying.now, new)
    flying.inject(b"".join(new + old))
    flying.run(6.0).fault(2, 0.5, seconds=5.0)
    assert flying.in_use == [True, False, True]
    assert not autopilot.lane_asks


def test_of_other_vehicles_than_copters_no_lane_is_asked_for(tmp_path: Path) -> None:
    """They do not name the lane to which they return when disarmed."""
    autopilot = Autopilot("ardupilot", vehicle=mavlink.MAV_TYPE_FIXED_WING)
    talk = Monitored(tmp_path, autopilot).run(10.0)
    autopilot.armed = True
    talk.run(3.0).fault(1, 0.5, seconds=5.0)
    assert talk.in_use == [False, True, True]
    assert not autopilot.lane_asks


def test_without_any_text_of_the_autopilot_no_lane_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A router may drop them."""
    autopilot = Autopilot("ardupilot")
    monkeypatch.setattr(autopilot, "say", lambda *_: None)
    talk = Monitored(tmp_path, autopilot).run(10.0)
    autopilot.armed = True
    talk.run(3.0).fault(1, 0.5, seconds=5.0)
    assert talk.in_use == [False, True, True]
    assert not autopilot.lane_asks


def test_two_bad_imus_are_both_out_and_the_last_one_stays(flying: Monitored) -> None:
    """A bad IMU that goes back for a worse one misleads two EKF lanes: ground at 21 m/s."""
    flying.fault(2, 0.3, seconds=4.0)
    flying.fault(3, 1.0, seconds=8.0)
    assert flying.in_use == [True, False, False]
    assert [value for *_, value in flying.autopilots[0].sets].count(1.0) == 0
    assert "one IMU left in use: land" in flying.texts
    assert not any("lane" in text or "differs" in text for text in flying.texts)
    flying.fault(1, 0.5, seconds=2.0)
    assert flying.in_use == [True, False, False]
    assert flying.texts[-1] == "IMU 1 faulty AND IN USE: land"
    flying.heal(1, 1.0)
    flying.heal(3, 5.0)
    assert flying.in_use == [True, False, True]
    assert "two IMUs or more agree again" in flying.texts


def test_a_late_answer_puts_no_bad_imu_back_beside_the_one_that_healed(
    flying: Monitored,
) -> None:
    """IMU 2 goes back for the last one; an answer from before that reports none in use."""
    flying.fault(1, 0.3, seconds=4.0)
    flying.fault(2, -0.3, seconds=4.0)
    flying.fault(3, [0.5, 0.0, 0.0], (FAULTY, OK, OK), 8.0)
    assert flying.in_use == [False, False, True]
    orders = len(flying.autopilots[0].sets)
    flying.heal(2, 6.0)
    sent = {(name, value) for _, name, value in flying.autopilots[0].sets[orders:]}
    assert sent == {("INS_USE2", 1.0), ("INS_USE3", 0.0)}
    assert flying.in_use == [False, True, False]


def test_a_harmless_error_is_no_lost_lane_and_no_odd_one_beside_a_worse(
    begin: Callable[..., Monitored],
) -> None:
    """IMU 2 is FAULTY for ever on z, and apart on x only from IMU 3, which fails and heals."""
    flying = begin(late_reads=80 * MS, limit=1)
    flying.fault(2, [0.0, 0.0, 0.02], (OK, OK, FAULTY), 5.0)
    flying.fault(1, 0.1, seconds=4.0)
    assert flying.in_use == [False, True, True]
    flying.fault(3, [0.8, 0.0, 0.0], (FAULTY, OK, OK), 4.9)
    flying.heal(3, 4.0)
    assert "IMU 3 faulty AND IN USE: land" in flying.texts
    assert not any("lane" in text for text in flying.texts)
    assert "IMU 2 differs from the others" not in flying.texts


def test_with_a_limit_a_worse_imu_is_announced_and_stays(
    begin: Callable[..., Monitored],
) -> None:
    flying = begin(late_reads=80 * MS, limit=1)
    flying.fault(2, 0.3, seconds=4.0)
    flying.fault(3, 1.0, seconds=4.0)
    assert flying.in_use == [True, False, True]
    assert "IMU 3 faulty AND IN USE: land" in flying.texts


def test_over_a_lossy_link_an_imu_that_is_named_for_ever_is_a_witness(
    flying: Monitored,
) -> None:
    """IMU 3 has healed, but stays declared: the next fault is in a set of IMU 1 and 2."""
    flying.autopilots[0].late_reads = 0
    flying.autopilots[0].loss = 0.2
    flying.fault(3, 0.3, seconds=4.0)
    flying.fault(3, 0.0, seconds=7.0)
    flying.states[:6] = [OK, AMBIGUOUS, OK] * 2
    flying.fault(1, 0.2, [OK, AMBIGUOUS, OK], seconds=3.0)
    assert flying.in_use == [False, True, True]


@pytest.mark.parametrize(
    ("frequency", "pause"), [(49.8, 0.14), (99.7, 0.14), (99.7, 0.09), (99.7, 0.07)]
)
def test_a_pause_of_the_link_makes_no_error_of_vibration(
    flying: Monitored, frequency: float, pause: float
) -> None:
    """Neither the first samples after it alone nor those around it show an oscillation."""
    shake(flying, (3,), frequency, 0.3)
    flying.states[6:] = [FAULTY, OK, OK]
    for _ in range(6):
        flying.cut = True
        flying.run(pause)
        flying.cut = False
        flying.run(1.0)
    assert not flying.autopilots[0].sets


def test_an_order_lost_as_the_companion_dies_is_given_again(
    flying: Monitored, tmp_path: Path
) -> None:
    autopilot = flying.autopilots[0]
    autopilot.read_only.update(PARAMETERS)
    flying.fault(2, 1.0, seconds=0.5)
    flying.failover.close()
    autopilot.read_only.clear()
    boot, start = autopilot.boot, autopilot.start
    again = Monitored(tmp_path, autopilot)
    again.now, autopilot.boot, autopilot.start = flying.now, boot, start
    again.fault(2, 1.0, seconds=15.0)
    assert again.in_use == [True, False, True]
    assert not any("left alone" in text for text in again.texts)


@pytest.mark.parametrize("size", [0.0, 0.02])
def test_a_name_without_a_raw_difference_does_nothing(
    flying: Monitored, size: float
) -> None:
    """An IMU whose fault is over may still be declared, or be declared in error."""
    flying.fault(3, size, seconds=10.0)
    assert not flying.autopilots[0].sets


def test_the_odd_one_that_the_monitor_suspects_for_a_second_is_out(
    flying: Monitored,
) -> None:
    """In a simulated flight 0.3 rad/s stayed SUSPECT, and in use, for 7 s."""
    flying.fault(1, 0.1, (OK, SUSPECT, OK), seconds=0.9)
    flying.fault(1, 0.1, (OK, OK, OK), seconds=0.4)
    flying.fault(1, 0.1, (OK, SUSPECT, OK), seconds=0.9)
    assert not flying.autopilots[0].sets
    assert flying.run(0.6).in_use == [False, True, True]


@pytest.mark.parametrize("state", [OK, UNCHECKED])
def test_a_raw_difference_without_the_monitor_does_nothing(
    flying: Monitored, state: int
) -> None:
    flying.fault(1, 0.2, (OK, state, OK), seconds=4.0)
    assert not flying.autopilots[0].sets
    flying.run(3.0)
    assert "IMU 1 differs from the others" in flying.texts


def test_a_set_within_one_imu_names_it_after_300_ms(flying: Monitored) -> None:
    autopilot, at = flying.autopilots[0], flying.now
    flying.fault(1, (0.2, -0.2, 0.2), [AMBIGUOUS] * 3, seconds=1.0)
    (moment, name, value) = autopilot.sets[0]
    assert (name, value) == ("INS_USE", 0.0)
    assert 0.3 <= (moment - at) / NS <= 0.6


@pytest.mark.parametrize("state", [SUSPECT, AMBIGUOUS, STALE])
def test_a_large_error_of_a_unit_needs_no_name_but_a_doubt(
    flying: Monitored, state: int
) -> None:
    """The others agree: an autopilot whose gyro stands still is at 50 deg after 0.3 s."""
    at = flying.now
    flying.states[3:6] = [state] * 3
    flying.fault(1, (1.0, -2.0, 0.5), [state] * 3, seconds=0.6)
    assert flying.in_use == [False, True, True]
    assert (flying.autopilots[0].sets[0][0] - at) / NS <= 0.35


def test_a_clear_error_does_not_wait_for_the_monitor(flying: Monitored) -> None:
    """It excludes a spike for 0.2 s; three samples far off while two IMUs agree are none."""
    at = flying.now
    flying.fault(1, (1.0, -2.0, 0.5), [OK] * 3, seconds=0.2)
    flying.heal(1, 5.0)
    assert (flying.autopilots[0].sets[0][0] - at) / NS <= 0.15
    assert flying.in_use == [True] * 3
    flying.autopilots[0].sets.clear()
    for seconds in (0.02, 0.04):
        flying.fault(2, 3.0, [SUSPECT] * 3, seconds=seconds)
        flying.heal(2, 1.0)
    assert not flying.autopilots[0].sets


def test_a_clear_error_while_the_others_differ_names_nobody(flying: Monitored) -> None:
    flying.fault(1, (1.0, -2.0, 1.5), [OK] * 3)
    flying.fault(2, (-0.3, 0.3, -0.3), [OK] * 3, seconds=3.0)
    assert not flying.autopilots[0].sets


def test_a_clear_error_on_an_axis_on_which_the_others_agree_is_out(
    flying: Monitored,
) -> None:
    flying.fault(1, (1.0, -2.0, 0.5), [OK] * 3)
    flying.fault(2, 0.3, [OK] * 3, seconds=3.0)
    assert flying.in_use == [False, True, True]


def test_of_the_last_two_on_an_axis_none_goes_out_and_the_pilot_is_told(
    flying: Monitored,
) -> None:
    """IMU 3 has failed on z, and then IMU 1: nothing shows that it was not IMU 2."""
    flying.fault(3, (0.0, 0.0, 0.3), (OK, OK, FAULTY), 4.0)
    flying.states[5] = AMBIGUOUS
    flying.fault(1, (0.0, 0.0, 0.2), (OK, OK, AMBIGUOUS), 7.0)
    assert flying.in_use == [True, True, False]
    assert flying.texts[-1] == "the IMUs disagree: land"


def test_no_fault_is_not_said_of_an_imu_that_differs(flying: Monitored) -> None:
    """IMU 2 is the odd one for long, then nobody is, then it is again."""
    flying.fault(2, 0.2, [UNCHECKED] * 3, seconds=7.0)
    assert flying.texts[-1] == "IMU 2 differs from the others"
    flying.fault(1, 0.6, [UNCHECKED] * 3)
    flying.states[6:] = [UNCHECKED] * 3
    flying.run(10.0)
    assert "the IMUs disagree: land" in flying.texts
    flying.fault(1, 0.0, [UNCHECKED] * 3, seconds=4.0)
    assert not any("no more" in text for text in flying.texts)
    flying.heal(2, 2.0)
    assert "IMU 2 in use, does not differ" in flying.texts


def shaken(
    still: Motion, imus: Sequence[int], frequency: float, amplitude: float
) -> Motion:
    """Return a motion in which some IMUs also vibrate about x."""

    def rates(t: float) -> np.ndarray:
        found = still(t)
        phase = 2.0 * np.pi * frequency * t
        found[[k - 1 for k in imus], 0] += amplitude * np.sin(phase)
        return found

    return rates


def shake(
    talk: Monitored, imus: Sequence[int], frequency: float, amplitude: float
) -> None:
    """Let some IMUs vibrate, and fly on for 2 s."""
    autopilot = talk.autopilots[0]
    autopilot.motion = shaken(autopilot.motion, imus, frequency, amplitude)
    talk.run(2.0)


@pytest.mark.parametrize(
    ("frequency", "amplitude", "imus"),
    [
        (49.0, 0.8, (3,)),
        (49.8, 0.1, (3,)),
        (99.7, 0.3, (3,)),
        (50.5, 0.8, (1, 2)),
        (149.5, 0.8, (1, 2)),
    ],
)
def test_vibration_near_a_multiple_of_50_hz_is_no_error(
    flying: Monitored, frequency: float, amplitude: float, imus: Sequence[int]
) -> None:
    """Each 20 ms it would be a slow error, and the monitor names IMU 3 for it."""
    shake(flying, imus, frequency, amplitude)
    assert reason(flying) == "ready"
    flying.states[6:] = [FAULTY, OK, OK]
    flying.run(6.0)
    assert not flying.autopilots[0].sets
    assert not any("out of use" in text or "differs" in text for text in flying.texts)


def test_imus_that_come_at_50_hz_are_not_ready_and_bring_no_order(
    tmp_path: Path,
) -> None:
    """Over a slow line, or another station asks for another rate."""
    motion = shaken(gentle(3), (3,), 49.8, 0.1)
    autopilot = Autopilot("ardupilot", refuses={26, 116, 129}, motion=motion)
    autopilot.intervals = dict.fromkeys((26, 116, 129), 20_000)
    talk = Monitored(tmp_path, autopilot).run(15.0)
    assert reason(talk) == "no failover: IMUs come too slowly"
    autopilot.armed = True
    talk.states[6:] = [FAULTY, OK, OK]
    talk.run(8.0)
    assert not autopilot.sets


def test_samples_that_a_link_has_kept_are_no_boot(flying: Monitored) -> None:
    """It stalls for 6 s, then delivers what it has kept, eight times as fast."""
    flying.fault(2, 0.3, seconds=1.0)
    flying.heal(2)
    begin = flying.now
    end = begin + 6 * NS
    send = flying._travel
    last = {True: 0, False: 0}

    def late(to, data, peer) -> None:
        now = flying.now
        at = now + 3 * MS if now >= end else end + (now - begin) // 8
        last[to is None] = max(at, last[to is None])
        flying.latency = lambda: last[to is None] - now
        send(to, data, peer)

    flying._travel = late
    flying.run(15.0)
    assert flying.in_use == [True] * 3
    assert not any("notch" in text for text in flying.texts)


def test_a_link_that_is_late_for_long_is_no_boot(flying: Monitored) -> None:
    """All that comes down is 5 s late, for 12 s, and in order."""
    flying.fault(2, 0.5, seconds=1.0)
    send = flying._travel
    newest = 0
    begin = flying.now

    def travel(to, data, peer) -> None:
        nonlocal newest
        late = 5 * NS if flying.now < begin + 12 * NS else 3 * MS
        at = flying.now + (3 * MS if to is not None else late)
        if to is None:
            at = newest = max(newest + 1, at)
        flying.latency = lambda: at - flying.now
        send(to, data, peer)

    flying._travel = travel
    flying.run(18.0)
    flying.heal(2, 10.0)
    assert flying.in_use == [True] * 3
    assert not any("notch" in text for text in flying.texts)


def test_reports_from_before_an_order_that_come_late_are_no_reports(
    flying: Monitored,
) -> None:
    """The answer to an order is lost, and the way down gets 2.5 s long, for 4 s."""
    send = flying._travel
    late = 5 * NS // 2
    until = 0
    before = flying.sent["PARAM_SET"]

    def travel(to, data, peer) -> None:
        nonlocal until
        if flying.sent["PARAM_SET"] > before and not until:
            until = flying.now + 4 * NS
            flying._under_way = [
                (at + late if number < 0 else at, order, number, peer, data)
                for at, order, number, peer, data in flying._under_way
            ]
        waits = max(0, min(late, until + late - flying.now)) if until else 0
        flying.latency = lambda: 3 * MS + (waits if to is None else 0)
        if to is not None or not 0 <= flying.now - until + 4 * NS <= 10 * MS:
            send(to, data, peer)

    flying._travel = travel
    flying.fault(2, 0.6, seconds=10.0)
    assert flying.in_use == [True, False, True]
    assert not any("left alone" in text for text in flying.texts)
    flying.heal(2, 8.0)
    assert flying.in_use == [True] * 3


def test_an_imu_that_is_dead_with_its_accelerometer_is_out(flying: Monitored) -> None:
    """A message of zeros: of a unit that has delivered it is a sample."""
    autopilot = flying.autopilots[0]
    turning = autopilot.motion
    autopilot.motion = lambda t: turning(t) + np.array([1.2, 0.0, 0.0])
    whole = autopilot._imu

    def dead(number: int, now: int, out: list[bytes]) -> None:
        if number != 26:
            return whole(number, now, out)
        stamp = autopilot.clock(now) // 1000
        return autopilot._send(autopilot.mav.scaled_imu_encode(stamp, *(0,) * 9), out)

    autopilot._imu = dead
    flying.run(0.5)
    assert flying.in_use == [False, True, True]


def test_a_sound_imu_goes_back_when_all_in_use_are_bad(flying: Monitored) -> None:
    """IMU 1 has healed and waits; the only one in use fails meanwhile."""
    flying.fault(3, -0.5, seconds=3.0)
    flying.fault(1, 0.3, seconds=2.0)
    assert flying.in_use == [False, True, False]
    flying.heal(1, 1.0)
    flying.fault(2, 0.4, seconds=1.5)
    assert flying.in_use == [True, False, False]


def test_an_order_lost_in_a_boot_leaves_no_imu_without_notch(
    flying: Monitored,
) -> None:
    autopilot = flying.autopilots[0]
    autopilot.read_only.update(PARAMETERS)
    flying.fault(1, 0.5, seconds=0.3)
    flying.cut = True
    flying.run(2.0)
    autopilot.read_only.clear()
    autopilot.reboot(flying.now)
    flying.cut = False
    flying.run(8.0)
    flying.heal(1, 20.0)
    assert flying.in_use == [True] * 3
    assert not any("notch" in text for text in flying.texts)


def test_words_are_true_of_the_vehicle(flying: Monitored) -> None:
    """Two out and landed are not two that agree; one that is out is not in use."""
    autopilot = flying.autopilots[0]
    flying.fault(2, 0.3, seconds=3.0)
    flying.fault(3, 1.0, seconds=3.0)
    assert flying.in_use == [True, False, False]
    autopilot.armed = False
    flying.run(5.0)
    assert not any("agree again" in text for text in flying.texts)
    flying.heal(2, 5.0)
    flying.heal(3, 5.0)
    assert "two IMUs or more agree again" in flying.texts
    autopilot.parameters["INS_USE"] = 0.0
    flying.run(5.0)
    assert flying.texts[-1] == "IMU 1 not in use, not by failover"


def test_a_stream_that_stalls_is_no_dead_imu_and_no_lost_lane(
    flying: Monitored,
) -> None:
    autopilot = flying.autopilots[0]
    flying.fault(1, 0.3, seconds=3.0)
    keep = autopilot._send_value, autopilot._imu
    autopilot._send_value = lambda *_: None
    flying.run(15.0)
    autopilot._send_value = keep[0]
    autopilot._imu = lambda *_: None
    flying.run(2.0)
    autopilot._imu = keep[1]
    flying.run(5.0)
    assert not any("land" in text for text in flying.texts)


@pytest.mark.parametrize(
    ("dead", "states"),
    [
        ("frozen", [OK] * 9),
        ("silent", [FAULTY] * 6 + [OK] * 3),
        ("silent", [STALE] * 6 + [UNCHECKED] * 3),
        ("frozen", [UNCHECKED] * 6 + [AMBIGUOUS] * 3),
        ("frozen", [OK] * 6 + [FAULTY] * 3),
        ("silent", [OK] * 6 + [FAULTY] * 3),
    ],
)
def test_two_that_die_at_once_bring_one_true_sentence(
    flying: Monitored, dead: str, states: list[int]
) -> None:
    autopilot = flying.autopilots[0]
    if dead == "frozen":
        motion = autopilot.motion
        kept = motion(20.0)
        autopilot.motion = lambda t: np.stack([kept[0], kept[1], motion(t)[2]])
    else:
        del autopilot.intervals[26], autopilot.intervals[116]
        autopilot.refuses = {26, 116}
    flying.run(0.2)
    flying.states = states
    flying.run(8.0)
    assert flying.in_use[2]
    assert "one IMU or none is alive: land" in flying.texts
    assert not any("IMU 3" in text for text in flying.texts)
    assert not any("no more" in text for text in flying.texts)


def test_an_imu_that_healed_while_the_link_was_cut_stays_in_use(
    flying: Monitored,
) -> None:
    """It is still named, and its error was large: a second later nothing is done or said."""
    flying.cut = True
    flying.fault(1, 2.0, seconds=1.0)
    flying.cut = False
    flying.fault(1, 0.0, seconds=3.0)
    assert not flying.autopilots[0].sets
    assert not any(DANGER in text for text in flying.texts)


def test_two_imus_that_differ_are_no_name(begin: Callable[..., Monitored]) -> None:
    talk = begin(units=2)
    talk.states[:6] = [AMBIGUOUS] * 6
    talk.fault(1, 0.5, [AMBIGUOUS] * 3, seconds=5.0)
    assert not talk.autopilots[0].sets


def test_a_fault_whose_onset_nobody_saw_is_answered(flying: Monitored) -> None:
    """The link is cut for 3 s at the onset."""
    flying.cut = True
    flying.fault(1, 1.0, seconds=3.0)
    flying.cut = False
    flying.run(2.0)
    assert flying.in_use == [False, True, True]


def test_a_danger_that_cannot_be_answered_is_repeated(flying: Monitored) -> None:
    autopilot = flying.autopilots[0]
    autopilot.read_only.add("INS_USE")
    flying.fault(1, 0.5, seconds=25.0)
    told = [text for text in flying.texts if DANGER in text]
    assert told == ["IMU 1 faulty AND IN USE: land"] * 3
    assert {text for severity, text in autopilot.texts if severity < 4}


def test_an_order_that_was_lost_is_an_imu_in_use(flying: Monitored) -> None:
    """A set is lost for good, the autopilot reports "in use": the slot is free again."""
    flying.autopilots[0].late_reads = 0
    flying.autopilots[0].read_only.add("INS_USE2")
    flying.fault(2, 0.1, seconds=1.0)
    flying.heal(2, 6.0)
    flying.fault(1, 1.0, seconds=1.0)
    assert flying.in_use == [False, True, True]


def test_an_answer_from_before_our_order_is_nobody_elses_hand(
    flying: Monitored,
) -> None:
    """ArduPilot answers reads late: 0 is followed by 1, and by 0 again."""
    for imu in (1, 2, 3):
        flying.fault(imu, 0.4, seconds=2.0)
        flying.heal(imu, 8.0)
    assert not any("left alone" in text for text in flying.texts)
    assert flying.in_use == [True] * 3
    assert sum(value == 0.0 for _, _, value in flying.autopilots[0].sets) <= 9


@pytest.mark.parametrize("wait", [0.2, 5.0])
def test_an_imu_that_somebody_else_has_set_is_left_alone(
    flying: Monitored, wait: float
) -> None:
    autopilot = flying.autopilots[0]
    flying.fault(1, 0.3, seconds=wait + 0.5)
    autopilot.parameters["INS_USE"] = 1.0
    count = len(autopilot.sets)
    flying.run(3.0)
    assert autopilot.sets[count:] == []
    assert flying.in_use[0]
    assert flying.texts[-1] == "IMU 1 faulty AND IN USE: land"
    assert "IMU 1 left alone in this flight" in flying.heal(1, 2.0).texts
    # After landing it is no news.
    said = len(flying.fault(1, 0.3, seconds=3.0).texts)
    autopilot.armed = False
    assert flying.run(4.0).texts[said:] == []


def test_one_lane_left_is_announced_and_a_short_hit_is_none(flying: Monitored) -> None:
    """A lane that followed 1.0 rad/s for 0.2 s recovers; one that followed 3 rad does not."""
    flying.fault(1, 1.0, seconds=1.0)
    flying.heal(1, 15.0)
    assert not any("lane" in text for text in flying.texts)
    flying.autopilots[0].read_only.update(PARAMETERS)
    for imu in (1, 2):
        flying.fault(imu, 2.5, seconds=1.5)
        flying.heal(imu, 1.0)
    assert "one EKF lane or none left: land" in flying.texts


def test_a_slow_disk_holds_up_no_order(
    flying: Monitored, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A card may take seconds to sync: the write of the file waits, the link does not."""
    release = threading.Event()
    whole = kept_file.replacing

    def slow(path: Path):
        release.wait(10.0)
        return whole(path)

    monkeypatch.setattr(kept_file, "replacing", slow)
    flying.waits_for_disk = False
    flying.fault(1, 0.5, seconds=1.0)
    assert flying.in_use == [False, True, True]
    assert flying.failover.status(flying.now)[1].endswith(
        "failover_file is not written"
    )
    release.set()
    flying.failover.close()


def test_a_dead_axis_stays_out_until_a_turn_about_it(moving: Moving) -> None:
    """Two seconds of yaw prove nothing about roll."""
    talk, moved = moving(0.4, 0.3, 0.1)
    moved.scale[0, 0] = 0.0
    talk.fault(1, 0.0, (FAULTY, OK, OK), seconds=2.0)
    assert talk.in_use == [False, True, True]
    moved.rate = np.array([0.04, 0.2, 0.5])
    assert talk.heal(1, 8.0).in_use == [False, True, True]
    moved.scale[0, 0] = 1.0
    assert talk.run(5.0).in_use == [False, True, True]
    moved.rate = np.array([0.3, 0.2, 0.1])
    assert talk.run(4.0).in_use == [True, True, True]


def test_a_lost_part_of_the_scale_stays_out_in_slow_turns(moving: Moving) -> None:
    talk, moved = moving(2.0, 0.1, 0.1)
    moved.scale[0, 0] = 0.7
    talk.fault(1, 0.0, (FAULTY, OK, OK), seconds=2.0)
    assert talk.in_use == [False, True, True]
    moved.rate = np.array([0.07, 0.1, 0.1])
    assert talk.heal(1, 8.0).in_use == [False, True, True]


@pytest.mark.parametrize("duration", [0.08, 1.0])
@pytest.mark.parametrize("is_dead", [True, False])
def test_a_short_error_in_a_hover_goes_back_after_a_turn(
    moving: Moving, duration: float, is_dead: bool
) -> None:
    """Since then the gyro may be dead, which a hover does not show."""
    talk, moved = moving(0.4, 0.3, 0.1)
    moved.rate = np.array([0.01, 0.02, 0.01])
    talk.fault(2, 1.0, (OK, OK, OK), seconds=duration)
    moved.scale[1] = 0.0 if is_dead else 1.0
    assert talk.heal(2, 8.0).in_use == [True, False, True]
    moved.rate = np.array([0.01, 0.2, 0.01])
    assert talk.run(4.0).in_use == [True, not is_dead, True]
    assert talk.in_use[2]


@pytest.mark.parametrize("is_dead", [True, False])
def test_a_fast_turn_about_another_axis_hides_no_error(
    moving: Moving, is_dead: bool
) -> None:
    """5 % of a yaw of 2 rad/s is more than the error of each IMU on another axis."""
    talk, moved = moving(0.4, 0.3, 0.1)
    for imu, size in ((1, 0.12), (2, -0.1)):
        if is_dead:
            moved.scale[imu - 1, 0] = 0.0
            talk.fault(imu, 0.0, (FAULTY, OK, OK), seconds=1.0)
        else:
            talk.fault(imu, size, seconds=1.0)
    assert talk.in_use == [False, False, True]
    moved.rate = np.array([0.05, 0.05, 2.0])
    assert talk.run(6.0).in_use == [False, False, True]
    moved.rate = np.array([1.0, 0.05, 0.1])
    assert talk.run(3.0).in_use == [False, False, True]
    moved.rate = np.array([0.3, 0.3, 2.0])
    moved.scale[:] = 1.0
    talk.heal(1)
    assert talk.heal(2, 6.0).in_use == [True] * 3


def restarted(talk: Monitored, path: Path) -> Monitored:
    """Return the same flight with a companion that starts anew."""
    talk.failover.close()
    autopilot = talk.autopilots[0]
    boot, start = autopilot.boot, autopilot.start
    again = Monitored(path, autopilot)
    again.now, autopilot.boot, autopilot.start = talk.now, boot, start
    again.states = talk.states
    return again


@pytest.mark.parametrize("flies", [True, False])
def test_a_restart_of_the_companion_forgets_no_axis(
    moving: Moving, tmp_path: Path, flies: bool
) -> None:
    """Two dead gyros that go back in a turn about another axis would outvote the third."""
    talk, moved = moving(0.4, 0.3, 0.1)
    for imu in (1, 2):
        moved.scale[imu - 1, 0] = 0.0
        talk.fault(imu, 0.0, (FAULTY, OK, OK), seconds=1.0)
    assert talk.in_use == [False, False, True]
    moved.rate = np.array([0.01, 0.01, 0.02])
    talk.run(1.0)
    talk.autopilots[0].armed = flies
    again = restarted(talk, tmp_path)
    moved.rate = np.array([0.01, 0.01, 0.5])
    again.heal(1)
    again.heal(2, 8.0)
    assert again.in_use == [False, False, True]
    moved.rate = np.array([1.0, 0.01, 0.02])
    assert again.run(3.0).in_use == [False, False, True]
    moved.scale[:] = 1.0
    assert again.run(8.0).in_use == [True] * 3


@pytest.mark.parametrize("errors", ["kept", "of an older file"])
def test_a_restart_of_the_companion_does_not_heal_a_gyro_that_lost_some_scale(
    moving: Moving, tmp_path: Path, errors: str
) -> None:
    """IMU 1 has lost a quarter about y: in a turn of 0.1 rad/s it differs by 0.025 rad/s.

    An older file has no more than the axes: it takes a turn that shows any loss.
    """
    talk, moved = moving(0.1, 0.8, 0.1)
    moved.scale[0, 1] = 0.75
    talk.fault(1, 0.0, seconds=2.0)
    assert talk.in_use == [False, True, True]
    moved.rate = np.array([0.01, 0.1, 0.02])
    talk.heal(1, 6.0)
    assert talk.in_use == [False, True, True]
    talk.failover.close()
    file = tmp_path / "out.json"
    content = json.loads(file.read_text())
    rate, share = content["bad_errors"][0]["y"]
    assert 0.8 < rate < 1.5
    assert 0.15 < share < 0.27
    if errors != "kept":
        del content["bad_errors"]
        file.write_text(json.dumps(content))
    again = restarted(talk, tmp_path).run(6.0)
    assert again.in_use == [False, True, True]
    moved.scale[:] = 1.0
    moved.rate = np.array([0.01, 0.7, 0.02])
    assert again.run(6.0).in_use == [errors == "kept", True, True]
    moved.rate = np.array([0.01, 1.4, 0.02])
    assert again.run(6.0).in_use == [True, True, True]


def test_two_gyros_that_die_in_a_hover_do_not_outvote_the_third(
    moving: Moving,
) -> None:
    """At rest a dead gyro agrees, also after the monitor has named it."""
    talk, moved = moving(0.4, 0.3, 0.1)
    moved.rate = np.array([0.01, 0.01, 0.01])
    talk.run(2.0)
    for imu in (1, 2):
        moved.scale[imu - 1] = 0.0
        talk.fault(imu, 0.0, [FAULTY] * 3, seconds=1.0)
    talk.run(4.0)
    moved.rate = np.array([0.01, 0.01, 0.7])
    assert talk.run(3.0).in_use[2]
    assert ("INS_USE3", 0.0) not in {order[1:] for order in talk.autopilots[0].sets}


@pytest.mark.parametrize("bad", [(2,), (2, 3)])
def test_bad_imus_that_scatter_beside_one_at_rest_stay_out(
    moving: Moving, bad: tuple[int, ...]
) -> None:
    """A quiet gyro at rest repeats zero, in whole mrad/s: rest is no death."""
    talk, moved = moving(0.5, 0.3, 0.1, noise=0.0003)
    for imu in bad:
        moved.noise[imu - 1] = 0.1
        talk.fault(imu, (1.0, 0.0, 0.0), (FAULTY, OK, OK), seconds=2.0)
    expected = [imu not in bad for imu in (1, 2, 3)]
    assert talk.in_use == expected
    moved.rate = np.zeros(3)
    talk.run(10.0)
    assert not any(value for *_, value in talk.autopilots[0].sets)
    assert talk.in_use == expected
    assert not any("alive" in text or "lane" in text for text in talk.texts)


@pytest.mark.parametrize("state", [OK, STALE])
def test_a_frozen_imu_is_out_where_two_others_agree(moving: Moving, state: int) -> None:
    """It repeats its value while others move, and differs: a monitor need not name it."""
    talk, moved = moving(0.02, 0.25, 0.05)
    moved.scale[0] = 0.0
    moved.noise[0] = 0.0
    talk.states[:3] = [state] * 3
    assert talk.run(1.5).in_use == [False, True, True]


def test_a_lesser_error_is_better_than_none_sound(flying: Monitored) -> None:
    """Two are out for 0.07 and 0.1 rad/s, then the last one is off by 1 rad/s."""
    flying.fault(1, 0.07, seconds=4.0)
    flying.fault(2, -0.1, seconds=4.0)
    assert flying.in_use == [False, False, True]
    flying.fault(3, 1.0, seconds=3.0)
    assert flying.in_use == [True, True, True]
    assert flying.run(8.0).in_use == [True, True, True]


def test_a_step_at_rest_says_nothing_of_the_others(moving: Moving) -> None:
    """As in the check list of the docs: an offset of IMU 2, armed on the ground, and a turn."""
    talk, motion = moving(0.0, 0.0, 0.0, noise=0.0003)
    talk.fault(2, 0.3, seconds=10.0)
    assert talk.in_use == [True, True, True]
    motion.rate[1] = 0.1
    talk.run(1.0)
    assert talk.in_use == [True, False, True]
    assert not any("IMU 3" in text or "IMU 1" in text for text in talk.texts)


# On the ground ---------------------------------------------------------------------------


def test_a_gyro_that_is_still_faulty_stays_out_and_is_announced(
    flying: Monitored,
) -> None:
    autopilot = flying.autopilots[0]
    flying.fault(2, 0.3, seconds=3.0)
    autopilot.armed = False
    flying.run(10.0)
    assert flying.in_use == [True, False, True]
    assert flying.texts[-1] == "IMU 2 still faulty, stays out of use"
    assert "out of use: IMU 2" in flying.failover.status(flying.now)[1]
    autopilot.armed = True
    flying.fault(2, 0.5, seconds=5.0)
    assert flying.in_use == [True, False, True]
    autopilot.armed = False
    flying.fault(2, 0.0, [UNCHECKED] * 3, seconds=10.0)
    assert flying.in_use == [True, False, True], "not seen to be well"
    assert flying.texts[-1] == "IMU 2 stays out, monitor does not find it OK"
    flying.heal(2, 10.0)
    assert flying.in_use == [True] * 3


def test_after_landing_an_imu_stays_out_until_it_has_agreed_while_turning(
    flying: Monitored,
) -> None:
    """At rest a gyro that has lost its scale agrees, and the monitor finds it OK."""
    autopilot = flying.autopilots[0]
    turning = autopilot.motion
    rests = False

    def scaled(t: float) -> np.ndarray:
        rates = turning(t)
        if rests:
            rates -= rates.mean(axis=0)
        rates[1] *= scale
        return rates

    autopilot.motion = scaled
    scale = 0.3
    flying.fault(2, 0.0, [AMBIGUOUS] * 3, seconds=3.0)
    assert flying.in_use == [True, False, True]
    rests = True
    autopilot.armed = False
    flying.heal(2, 20.0)
    assert flying.in_use == [True, False, True]
    assert flying.texts[-1] == "IMU 2 waits to agree in a turn about x, y, z"
    assert "out of use: IMU 2" in flying.failover.status(flying.now)[1]
    assert flying.failover.is_done, "nothing to wait for at a stop"
    autopilot.armed = True
    flying.run(5.0)
    assert flying.in_use == [True, False, True]
    rests = False
    flying.run(5.0)
    assert flying.in_use == [True, False, True], "turned, and it does not agree"
    scale = 1.0
    said = len(flying.texts)
    flying.run(8.0)
    assert flying.in_use == [True] * 3
    assert flying.texts[said:] == ["IMU 2 in use, does not differ"]


def test_a_doubt_from_before_an_imu_is_out_ends_in_words(flying: Monitored) -> None:
    flying.reports = False
    flying.run(9.0)
    assert flying.texts[-1] == "no failover: monitor silent or not alone"
    flying.reports = True
    flying.fault(3, 0.6, seconds=6.0)
    assert flying.in_use == [True, True, False]
    assert flying.texts[-1] == "failover acts again"


def test_an_order_without_effect_is_not_shown_as_out_of_use(flying: Monitored) -> None:
    flying.autopilots[0].read_only.update(PARAMETERS)
    flying.fault(2, 0.3, seconds=4.0)
    assert reason(flying) == "ordered out, reported in use: IMU 2"
    flying.autopilots[0].read_only.clear()
    assert reason(flying.run(4.0)).startswith("out of use: IMU 2 of system 1")


def test_an_imu_in_use_is_not_shown_as_out_of_use_as_it_goes_back(
    flying: Monitored,
) -> None:
    flying.autopilots[0].read_only.update(PARAMETERS)
    flying.fault(2, 0.3, seconds=4.0)
    flying.failover.restore(flying.now)
    assert reason(flying) == "ordered out, reported in use: IMU 2"
    assert reason(flying.heal(2, 4.0)).startswith("no failover")


def test_a_gap_of_the_link_hides_no_end_and_no_begin_of_a_doubt(
    flying: Monitored,
) -> None:
    """What is sent into a gap reaches nobody, and its end is no news then."""
    said = len(flying.texts)
    for lasts in (False, True):
        flying.cut = True
        flying.failover.age = 1.5
        flying.run(2.0)
        flying.failover.age = 1.5 if lasts else 0.02
        flying.cut = False
        flying.run(1.0)
        flying.failover.age = 0.02
        flying.run(5.0)
        late = ["no failover: the monitor is late", "failover is ready"]
        assert flying.texts[said:] == late * lasts


def test_a_condition_that_begins_in_a_gap_of_the_link_is_announced_after_it(
    flying: Monitored,
) -> None:
    flying.fault(2, 0.3, seconds=1.0)
    flying.autopilots[0].armed = False
    flying.fault(2, 0.05, (OK, SUSPECT, OK), seconds=4.0)
    assert flying.texts[-1] == "IMU 2 stays out, monitor does not find it OK"
    flying.cut = True
    flying.fault(2, 0.05, seconds=1.5)
    flying.cut = False
    flying.run(1.0)
    assert flying.texts[-1] == "IMU 2 still faulty, stays out of use"


@pytest.mark.parametrize("by_station", [False, True])
def test_what_goes_back_on_the_ground_is_not_announced_as_out(
    flying: Monitored, by_station: bool
) -> None:
    autopilot = flying.autopilots[0]
    turning = autopilot.motion
    flying.fault(2, 0.3, seconds=4.0)
    autopilot.armed = False
    autopilot.motion = Gentle(3, 0.002, np.random.default_rng(3), size=0.0)
    flying.fault(2, 0.0, (OK, FAULTY, OK), seconds=5.0)
    flying.heal(2, 5.0)
    said = len(flying.texts)
    if by_station:
        autopilot.parameters["INS_USE2"] = 1.0
    else:
        autopilot.motion = turning
    flying.run(8.0)
    assert flying.in_use == [True] * 3
    wrong = ("IMU 2 out of use", "IMU 2 left alone")
    assert not [text for text in flying.texts[said:] if text.startswith(wrong)]


def test_a_stop_after_landing_waits_for_an_imu_that_agrees(flying: Monitored) -> None:
    flying.fault(2, 0.3, seconds=3.0)
    assert flying.failover.is_done, "in flight it stays out"
    flying.autopilots[0].armed = False
    flying.heal(2)
    waits = [not flying.run(0.2).failover.is_done for _ in range(25)]
    assert any(waits)
    assert not waits[-1]
    assert flying.in_use == [True] * 3


def started_anew(flying: Monitored, path: Path) -> Monitored:
    """The companion dies in flight, the autopilot is started anew with IMU 1 out of use."""
    autopilot = flying.autopilots[0]
    flying.fault(1, 0.3, seconds=1.0)
    flying.failover.close()
    flying.heal(1)
    autopilot.armed = False
    autopilot.reboot(flying.now + NS)
    assert autopilot.notches == [False, True, True]
    autopilot.texts.clear()
    again = Monitored(path, autopilot)
    again.now = 1000 * NS + 60 * NS
    autopilot.boot = autopilot.start = again.now - 5 * NS
    return again


def test_a_boot_without_notch_filters_is_not_hidden(
    flying: Monitored, tmp_path: Path
) -> None:
    autopilot = flying.autopilots[0]
    again = started_anew(flying, tmp_path).run(15.0)
    assert not again.in_use[0], "no IMU without a notch filter by our hand"
    assert "IMU 1 no notch: set INS_USE 1 and reboot" in again.texts
    assert "reboot before flight" in again.failover.status(again.now)[1]
    autopilot.parameters["INS_USE"] = 1.0
    assert again.run(5.0).texts[-1] == "IMU 1 no notch: reboot"
    # Nor does the next start of the node forget it, though it is not out any more.
    again = restarted(again, tmp_path).run(15.0)
    assert again.failover.status(again.now)[1] == "no failover: reboot before flight"
    autopilot.reboot(again.now)
    assert again.run(12.0).failover.status(again.now)[1] == "ready"


def test_a_node_that_starts_anew_knows_who_has_no_notch_filter(
    flying: Monitored, tmp_path: Path
) -> None:
    """The autopilot was started with IMU 2 out of use, then IMU 1 goes out, too."""
    autopilot = flying.autopilots[0]
    flying.clocks = lambda: Clocks(UTC + flying.now / NS, flying.now / NS, "a")
    flying.fault(2, 0.3, seconds=1.0)
    autopilot.armed = False
    flying.run(3.0)
    autopilot.reboot(flying.now)
    flying.run(6.0)
    assert not any("IMU 2 in use" in text for text in flying.texts)
    autopilot.armed = True
    flying.heal(2, 8.0)
    flying.fault(1, 0.5, seconds=1.0)
    assert flying.in_use == [False, False, True]
    flying.failover.close()
    boot, start = autopilot.boot, autopilot.start
    again = Monitored(tmp_path, autopilot)
    again.now, autopilot.boot, autopilot.start = flying.now, boot, start
    again.clocks = lambda: Clocks(UTC + again.now / NS, again.now / NS, "a")
    again.states = list(flying.states)
    again.run(12.0)
    assert again.in_use == [False, False, True], "no IMU without a notch filter"


@pytest.mark.parametrize("together", [True, False])
def test_a_power_cut_is_a_boot_though_unix_time_begins_again(
    flying: Monitored, tmp_path: Path, together: bool
) -> None:
    """A computer without a time source begins each time with the same Unix time."""
    autopilot = flying.autopilots[0]
    again = started_anew(flying, tmp_path)
    unix = json.loads((tmp_path / "out.json").read_text())["autopilot_booted"]

    def clocks() -> Clocks:
        ago = (again.now - autopilot.boot) / NS
        later = 20.0 if together else 300.0
        moved = 0.0 if together else 100.0
        return Clocks(unix + ago + moved, ago + later, "second")

    again.clocks = clocks
    again.run(15.0)
    assert not again.in_use[0], "no IMU without a notch filter by our hand"
    assert "reboot before flight" in again.failover.status(again.now)[1]


def test_a_new_start_of_the_node_needs_no_right_unix_time(
    flying: Monitored, tmp_path: Path
) -> None:
    """The node is started again in flight, after Unix time was set by an hour."""
    autopilot = flying.autopilots[0]
    flying.clocks = lambda: Clocks(UTC + flying.now / NS, flying.now / NS, "a")
    flying.fault(1, 0.3, seconds=1.0)
    flying.failover.close()
    boot, start = autopilot.boot, autopilot.start
    again = Monitored(tmp_path, autopilot)
    again.now, autopilot.boot, autopilot.start = flying.now, boot, start
    again.clocks = lambda: Clocks(UTC - 3600.0 + again.now / NS, again.now / NS, "a")
    again.heal(1, 12.0)
    assert again.in_use == [True] * 3


def test_an_operator_puts_back(flying: Monitored) -> None:
    flying.fault(1, 0.3, seconds=1.0)
    assert flying.failover.restore(flying.now) == (
        True,
        "the autopilot is asked to use IMU 1 again",
    )
    flying.run(5.0)
    assert flying.in_use == [True] * 3
    answer = flying.failover.restore(flying.now)
    assert answer == (True, "no IMU is out of use by failover")


def test_on_the_ground_over_another_stack_or_unheard_nothing_is_set(
    tmp_path: Path,
) -> None:
    deaf = Autopilot(
        "ardupilot", armed=True, parameters=dict.fromkeys(PARAMETERS[:2], 1.0)
    )
    for autopilot in (Autopilot("ardupilot"), Autopilot("px4", armed=True)):
        talk = Monitored(tmp_path, autopilot).run(10.0)
        assert not talk.fault(1, 0.5, seconds=3.0).autopilots[0].sets
    talk = Monitored(tmp_path, deaf).run(10.0)
    talk.fault(3, 0.5, seconds=3.0)
    assert not deaf.sets


# Whether it is ready ---------------------------------------------------------------------


def reason(talk: Monitored) -> str:
    return talk.failover.status(talk.now)[1]


def test_it_is_ready_once_every_imu_has_agreed(tmp_path: Path) -> None:
    """A start in flight beside 0.07 rad/s, which the monitor learns as a bias, is not ready."""
    autopilot = Autopilot("ardupilot", armed=True)
    autopilot.bias[1] = (0.0, 0.07, 0.0)
    talk = Monitored(tmp_path, autopilot).run(12.0)
    assert reason(talk) == "no failover: IMU 2 differs and is in use"
    assert "no failover: IMU 2 differs and is in use" in talk.texts
    autopilot.bias[:] = 0.0
    assert reason(talk.run(7.0)) == "ready"


def test_a_second_autopilot_of_the_same_system_is_not_ready(
    flying: Monitored,
) -> None:
    assert reason(flying) == "ready"
    rates = dict.fromkeys((26, 116, 129), 50.0)
    other = Autopilot("ardupilot", boot=flying.now - 30 * NS, rates=rates)
    flying.autopilots = (*flying.autopilots, other)
    flying.peers = (*flying.peers, flying.peers[0])
    assert reason(flying.run(20.0)) == "no failover: two senders with one system id"
    flying.autopilots, flying.peers = flying.autopilots[:1], flying.peers[:1]
    assert reason(flying.run(30.0)) == "ready"


def test_a_late_or_silent_monitor_and_a_poor_link_are_not_ready(
    flying: Monitored,
) -> None:
    assert reason(flying) == "ready"
    flying.failover.age = 1.5
    assert reason(flying.run(1.0)) == "no failover: the monitor is late"
    assert flying.texts[-1] == "no failover: the monitor is late"
    flying.failover.age = 0.02
    flying.reports = False
    assert reason(flying.run(6.0)) == "no failover: monitor silent or not alone"
    flying.reports = True
    flying.autopilots[0].loss = 0.3
    assert reason(flying.run(12.0)) == "no failover: link loses messages"
    flying.autopilots[0].loss = 0.0
    assert reason(flying.run(12.0)) == "ready"


def test_an_autopilot_that_refuses_orders_is_not_ready(tmp_path: Path) -> None:
    """It denies them, or a router drops them and passes all else."""
    autopilot = Autopilot("ardupilot", hears_sets=False, late_reads=80 * MS)
    talk = Monitored(tmp_path, autopilot).run(12.0)
    assert reason(talk) == "no failover: setting INS_USE is not answered"
    autopilot.hears_sets = True
    assert reason(talk.run(12.0)) == "ready"
    autopilot.probes.clear()
    talk.cut = True
    talk.run(5.0)
    talk.cut = False
    assert not talk.run(12.0).autopilots[0].probes, "once"
    assert reason(talk) == "ready"
    autopilot.read_only.add("INS_USE2")
    autopilot.reboot(talk.now)
    assert reason(talk.run(12.0)) == "no failover: setting INS_USE2 has no effect"
    assert not autopilot.sets
    assert talk.in_use == [True] * 3


def test_an_order_that_was_refused_is_remembered(flying: Monitored) -> None:
    autopilot = flying.autopilots[0]
    autopilot.read_only.add("INS_USE")
    flying.fault(1, 0.5, seconds=3.0).heal(1, 8.0)
    assert flying.in_use == [True] * 3
    assert reason(flying) == "no failover: setting INS_USE has no effect"
    assert flying.texts[-1] == reason(flying)
    autopilot.read_only.clear()
    assert flying.fault(1, 0.5, seconds=2.0).in_use == [False, True, True]
    assert reason(flying.heal(1, 12.0)) == "ready"


def test_what_cannot_be_seen_is_not_ready(flying: Monitored, tmp_path: Path) -> None:
    flying.states = [UNCHECKED] * 9
    assert reason(flying.run(2.0)) == "no failover: IMU 1 x, y, z not judged"
    flying.states = [OK] * 9
    assert reason(flying.run(1.0)) == "ready"
    flying.states[4] = UNCHECKED
    assert reason(flying.run(2.0)) == "no failover: IMU 2 y not judged"
    flying.states[4] = OK
    assert reason(flying.run(1.0)) == "ready"
    flying.latency = lambda: 600 * MS
    assert reason(flying.run(10.0)) == "no failover: link is slow"
    two = Monitored(tmp_path, Autopilot("ardupilot", units=2))
    two.autopilots[0].parameters.pop("INS_USE3")
    assert reason(two.run(15.0)) == "no failover: use of IMU 3 is not reported"


@pytest.mark.parametrize("pair", [(0, 3), (1, 4, 7)])
def test_a_set_of_two_units_is_not_ready_on_the_ground_and_acted_beside_in_flight(
    flying: Monitored, pair: tuple[int, ...]
) -> None:
    """The IMUs agree all the time: what the set is about is below what failover acts on."""
    for channel in pair:
        flying.states[channel] = AMBIGUOUS
    flying.autopilots[0].armed = False
    axis = "xyz"[pair[0]]
    words = f"no failover: IMU 1 {axis} faulty or in a set"
    assert reason(flying.run(3.0)) == words
    flying.autopilots[0].armed = True
    assert reason(flying.run(3.0)) == "ready"
    # That is true: a fault of any IMU is answered, in the set or not.
    for imu in (3, 1):
        flying.fault(imu, 0.3, seconds=2.0)
        assert flying.in_use == [k != imu for k in (1, 2, 3)]
        flying.heal(imu, 8.0)
        assert flying.in_use == [True] * 3
    flying.states = [OK] * 9
    flying.autopilots[0].armed = False
    assert reason(flying.run(3.0)) == "ready"


def test_use_that_was_not_reported_for_ten_seconds_is_unknown(
    flying: Monitored,
) -> None:
    del flying.autopilots[0].parameters["INS_USE2"]
    assert reason(flying.run(9.0)) == "ready"
    assert reason(flying.run(2.0)) == "no failover: use of IMU 2 is not reported"


def test_a_monitor_is_silent_after_five_seconds_without_diagnostics(
    flying: Monitored,
) -> None:
    """Its states come on."""
    flying.reports = False
    assert reason(flying.run(4.5)) == "ready"
    silent = "no failover: monitor silent or not alone"
    assert reason(flying.run(1.0)) == silent


def reads(talk: Monitored, seconds: float) -> int:
    """Return how often INS_USE is asked for in a time."""
    asked = []
    talk.vehicle.read_parameter = asked.append
    talk.run(seconds)
    return asked.count("INS_USE")


def test_use_is_read_ten_times_a_second_in_flight_and_oftener_in_doubt(
    flying: Monitored,
) -> None:
    """A turn of this test takes 60 ms: it asks every second turn, or in each."""
    assert 23 <= reads(flying, 3.0) <= 27
    flying.states[1] = FAULTY
    flying.run(0.2)
    assert 48 <= reads(flying, 3.0) <= 51


def test_use_is_read_twice_a_second_on_the_ground(flying: Monitored) -> None:
    flying.autopilots[0].armed = False
    flying.run(3.0)
    assert 5 <= reads(flying, 3.0) <= 7


def boots_after(talk: Monitored, step: float, seconds: float) -> int:
    """Return the boots seen where the autopilot seems to have started later than known, by s."""
    before = talk.failover._boots
    assert talk.failover._booted is not None
    talk.failover._booted -= round(step * NS)
    talk.run(seconds)
    return talk.failover._boots - before


@pytest.mark.parametrize(
    ("step", "seconds", "boots"), [(2.9, 12.0, 0), (3.1, 12.0, 1), (3.1, 9.0, 0)]
)
def test_a_time_that_is_behind_by_three_seconds_for_ten_is_a_boot(
    flying: Monitored, step: float, seconds: float, boots: int
) -> None:
    assert boots_after(flying, step, seconds) == boots


@pytest.mark.parametrize(
    ("off", "uptime", "computer", "same"),
    [
        (9.5, 500.0, "a", True),
        (10.5, 500.0, "a", False),
        (-10.5, 500.0, "a", False),
        # Another start of the computer: Unix time is compared.
        (9.5, 500.0, "b", True),
        (10.5, 500.0, "b", False),
        # Not if the computer was started within a minute of the autopilot.
        (0.0, 361.0, "b", True),
        (0.0, 359.0, "b", False),
        (0.0, 239.0, "b", True),
        (0.0, 241.0, "b", False),
    ],
)
def test_one_start_of_the_autopilot_has_one_time_within_ten_seconds(
    tmp_path: Path, off: float, uptime: float, computer: str, same: bool
) -> None:
    """It started 300 s ago, by clocks that are off since the file was written."""
    talk = Monitored(tmp_path, Autopilot("ardupilot"))
    after = uptime - 300.0
    talk.failover._file.written = Saved(booted=UTC - 300.0, after=after, computer="a")
    talk.clocks = lambda: Clocks(UTC + off, uptime + off * (computer == "a"), computer)
    assert talk.failover._is_same_boot(300.0) == same


def test_an_imu_that_sends_nothing_is_not_called_slow(flying: Monitored) -> None:
    autopilot = flying.autopilots[0]
    autopilot.refuses.add(116)
    del autopilot.intervals[116]
    assert reason(flying.run(4.0)) == "no failover: IMU 2 sends nothing"


def test_an_imu_without_an_ekf_lane_is_not_ready(tmp_path: Path) -> None:
    """ArduPilot's default has two lanes, and changes them at its start only."""
    autopilot = Autopilot("ardupilot", parameters=dict.fromkeys(PARAMETERS, 1.0))
    talk = Monitored(tmp_path, autopilot).run(12.0)
    assert reason(talk) == "no failover: EK3_IMU_MASK is not reported"
    autopilot.parameters[EKF_LANES] = 3.0
    assert reason(talk.run(1.0)) == "no failover: EK3_IMU_MASK is without IMU 3"
    autopilot.parameters[EKF_LANES] = 7.0
    assert reason(talk.run(5.0)) == "no failover: EK3_IMU_MASK is without IMU 3"
    autopilot.reboot(talk.now)
    assert reason(talk.run(12.0)) == "ready"


@pytest.mark.parametrize(("mask", "lost"), [(7, 2), (3, 1), (1, 1)])
def test_of_the_lanes_that_exist_the_last_one_is_announced(
    tmp_path: Path, mask: int, lost: int
) -> None:
    """A vehicle with one lane flies without that text, until this lane is lost."""
    autopilot = Autopilot("ardupilot")
    autopilot.parameters[EKF_LANES] = mask
    autopilot.reboot(0)
    talk = Monitored(tmp_path, autopilot).run(12.0)
    autopilot.armed = True
    talk.run(5.0)
    words = f"no failover: EK3_IMU_MASK is without IMU {mask.bit_length() + 1}"
    assert (words in talk.texts) is (mask < 7)
    autopilot.read_only.update(PARAMETERS)
    for imu in range(1, lost + 1):
        assert not any("lane" in text for text in talk.texts)
        talk.fault(imu, 2.5, seconds=1.5)
        talk.heal(imu, 1.0)
    assert "one EKF lane or none left: land" in talk.texts


def test_a_monitor_that_was_silent_is_believed_after_its_next_report(
    flying: Monitored,
) -> None:
    """It may have been started anew, with other IMUs by the same names."""
    Conversation.run(flying, 1.5)
    flying.reports = False
    flying.run(0.1)
    assert not flying.fault(1, 0.5, seconds=0.5).autopilots[0].sets
    flying.reports = True
    assert flying.run(0.5).autopilots[0].sets


def test_another_vehicle_on_the_link_is_left_aside(tmp_path: Path) -> None:
    """The first one falls silent while another one sends gyros, and is heard again."""
    first = Autopilot("ardupilot", armed=True)
    second = Autopilot("ardupilot", system=2, armed=True, loss=1.0)
    talk = Monitored(tmp_path, first, second).run(10.0)
    first.loss, second.loss = 1.0, 0.0
    second.bias[1] = (0.0, 1.0, 0.0)
    talk.run(8.0)
    assert talk.vehicle.system == 1
    first.loss = 0.0
    talk.run(8.0)
    talk.fault(1, 0.3, seconds=2.0)
    assert first.sets[0][1] == "INS_USE"
    assert not second.sets


def test_a_file_of_another_vehicle_is_announced(tmp_path: Path) -> None:
    file = tmp_path / "out.json"
    file.write_text('{"system_id": 7, "out_of_use": [2]}')
    autopilot = Autopilot("ardupilot")
    talk = Monitored(tmp_path, autopilot).run(10.0)
    autopilot.armed = True
    talk.fault(1, 0.5, seconds=6.0)
    assert not autopilot.sets
    assert talk.texts == ["no failover: failover_file is of system 7"]
    assert (
        reason(talk)
        == "out of use: IMU 2 of system 7; no failover: failover_file is of system 7"
    )


def test_a_late_monitor_is_announced_while_an_imu_is_out(flying: Monitored) -> None:
    flying.fault(2, 0.3, seconds=2.0)
    flying.failover.age = 1.5
    flying.run(1.0)
    assert flying.texts[-1] == "no failover: the monitor is late"
    flying.failover.age = 0.02
    assert flying.run(5.0).texts[-1] == "failover acts again"


@pytest.mark.parametrize("limit", [0, 1])
def test_failover_does_not_act_again_while_an_order_is_refused(
    tmp_path: Path, limit: int
) -> None:
    autopilot = Autopilot("ardupilot")
    autopilot.read_only.add("INS_USE2")
    talk = Monitored(tmp_path, autopilot, limit=limit).run(10.0)
    autopilot.armed = True
    talk.run(5.0)
    assert talk.texts[-1] == "no failover: setting INS_USE2 has no effect"
    talk.fault(2, 0.3, seconds=8.0)
    assert talk.in_use == [True] * 3
    assert "failover acts again" not in talk.texts


def test_failover_does_not_act_again_while_no_other_imu_can_go_out(
    flying: Monitored,
) -> None:
    flying.fault(2, 0.3, seconds=2.0)
    flying.failover.age = 1.5
    flying.run(2.0)
    flying.fault(3, 0.6, seconds=4.0)
    flying.failover.age = 0.02
    flying.run(8.0)
    assert flying.in_use == [True, False, False]
    said = flying.texts
    assert said.count("no failover: the monitor is late") == 1
    assert "failover acts again" not in said
    # For a moment two are in use: the one that healed, and the last one.
    flying.fault(1, [0.5, 0.0, 0.0], (FAULTY, OK, OK), 4.0)
    flying.heal(3, 6.0)
    assert flying.in_use == [False, False, True]
    assert "failover acts again" not in flying.texts
    flying.heal(1, 8.0)
    assert flying.in_use == [True, False, True]
    assert flying.texts.count("failover acts again") == 1


# Words, file, recordings -----------------------------------------------------------------


def test_no_two_conditions_have_the_same_words_and_each_fits() -> None:
    texts = [condition.value.text for condition in Condition]
    assert len(set(texts)) == len(texts)
    assert max(len(f"FDI: IMU 1 {text}") for text in texts) <= 50


@pytest.mark.parametrize(
    ("unit", "name"),
    [
        ("imu_2", "IMU 2"),
        ("imu_1", "IMU 2 (imu_1)"),
        ("front", "IMU 2 (front)"),
        ("", "IMU 2"),
    ],
)
def test_a_unit_is_named_where_its_name_is_more_than_the_number(
    unit: str, name: str
) -> None:
    channels = [f"{unit}.{axis}" if unit else axis for axis in "xyz"]
    assert imu_name(1, ["a.x", "a.y", "a.z", *channels]) == name
    text = text_of(1, Condition.OUT, ["a.x", "a.y", "a.z", *channels])
    assert text == f"FDI: {name} out of use"


def test_a_size_is_given_when_it_is_known(flying: Monitored) -> None:
    """Noise of 150 mrad/s: 0.1 rad/s of it is not known to five standard deviations."""
    random = np.random.default_rng(1)
    flying.autopilots[0].motion = lambda _: random.normal(0.0, 0.15, (3, 3))
    flying.run(1.0)
    flying.fault(1, 0.12, seconds=2.0)
    out = [text for text in flying.texts if "out of use" in text]
    assert out in ([], ["IMU 1 out of use"])


def test_a_disk_that_never_answers_holds_up_neither_start_nor_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    release = threading.Event()
    writes: list[Path] = []

    def never(path: Path):
        writes.append(path)
        release.wait()
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(kept_file, "replacing", never)
    monkeypatch.setattr(kept_file, "LONGEST_END", 0.01)
    talk = Monitored(tmp_path, Autopilot("ardupilot"))
    talk.waits_for_disk = False
    talk.run(12.0)
    assert reason(talk) == "no failover: failover_file is not usable"
    words = "is not saved: the disk does not answer"
    assert sum(words in event for event in talk.vehicle.events) == 1
    talk.autopilots[0].armed = True
    talk.run(1.0).fault(1, 0.5, seconds=1.0)
    assert talk.in_use == [False, True, True]
    assert reason(talk).endswith("; failover_file is not written")
    assert len(writes) == 1
    with pytest.raises(ConfigError, match=words):
        talk.failover.close()
    release.set()


def test_a_file_that_cannot_be_written_in_flight_is_announced_and_written_later(
    flying: Monitored, tmp_path: Path
) -> None:
    flying.run(0.02)
    for file in tmp_path.iterdir():
        file.unlink()
    tmp_path.rmdir()
    flying.fault(1, 0.3, seconds=1.0)
    words = "of system 1; failover_file is not written"
    assert until(flying, lambda: flying.failover.status(flying.now)[1].endswith(words))
    tmp_path.mkdir()
    assert kept(flying, tmp_path) == (1, [1])


@pytest.mark.parametrize(
    "text",
    [
        "[]",
        '{"system_id": 1, "out_of_use": [4]}',
        '{"system_id": 1, "out_of_use": [2], "bad_axes": ["w"]}',
        '{"system_id": 1, "out_of_use": [2], "bad_axes": []}',
        '{"system_id": 1, "out_of_use": [2], "bad_axes": ["y"], "bad_errors": []}',
        *[
            '{"system_id": 1, "out_of_use": [2], "bad_axes": ["y"], '
            f'"bad_errors": [{{"{axis}": {error}}}]}}'
            for axis, error in (
                ("z", [0.5, 0.4]),
                ("y", []),
                ("y", 0.4),
                ("y", [0.5]),
                ("y", [0.5, 0.0]),
                ("y", [-0.5, 0.4]),
                ("y", "[NaN, 0.4]"),
            )
        ],
        '{"system_id": Infinity, "out_of_use": []}',
        '{"system_id": 1, "out_of_use": [Infinity]}',
        "[" * 4000,
    ],
)
def test_a_file_that_is_none_of_ours_is_not_believed(tmp_path: Path, text: str) -> None:
    file = tmp_path / "out.json"
    file.write_text(text)
    talk = Monitored(tmp_path, Autopilot("ardupilot"))
    assert "does not list" in talk.vehicle.events[-1]
    file.chmod(0o666)
    talk = Monitored(tmp_path, Autopilot("ardupilot"))
    assert "others can write it" in talk.vehicle.events[-1]
    talk.run(2.0)
    assert until(talk, lambda: file.read_text() != text)
    assert kept(talk, tmp_path, ()) == (1, [])


def test_a_full_disk_at_a_start_in_flight_ends_nothing(
    flying: Monitored, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The companion starts anew with IMU 1 out of use: it is put back all the same."""
    autopilot = flying.autopilots[0]
    flying.fault(1, 0.3, seconds=1.0)
    flying.failover.close()
    whole = kept_file.replacing

    def full(path: Path):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(kept_file, "replacing", full)
    boot, start = autopilot.boot, autopilot.start
    again = Monitored(tmp_path, autopilot)
    again.now, autopilot.boot, autopilot.start = flying.now, boot, start
    full_disk = "No space left on device"
    assert until(again, lambda: any(full_disk in one for one in again.vehicle.events))
    again.fault(1, 0.3, seconds=8.0)
    assert again.in_use == [False, True, True]
    assert reason(again).startswith("out of use: IMU 1 of system 1")
    again.heal(1, 8.0)
    assert again.in_use == [True] * 3
    assert reason(again) == "no failover: failover_file is not usable"
    monkeypatch.setattr(kept_file, "replacing", whole)
    assert until(again, lambda: reason(again) == "ready")
    assert kept(again, tmp_path, ())[1] == []


def test_a_trade_needs_a_reserve(begin: Callable[..., Monitored]) -> None:
    """Of two IMUs both are bad: the one that is out stays out."""
    talk = begin(units=2)
    autopilot = talk.autopilots[0]
    talk.fault(2, 0.1, seconds=2.0)
    talk.fault(1, 1.0, seconds=3.0)
    assert [value for _, _, value in autopilot.sets][-1] == 0.0
    assert not autopilot.parameters["INS_USE2"]
    assert autopilot.parameters["INS_USE"]
    assert "IMU 1 faulty AND IN USE: land" in talk.texts


def test_an_imu_without_samples_is_no_hindrance(flying: Monitored) -> None:
    autopilot = flying.autopilots[0]
    flying.fault(3, 0.2, seconds=2.0)
    autopilot.units = 2
    flying.states[6:] = [STALE] * 3
    flying.run(1.5)
    flying.fault(1, 0.6, seconds=2.0)
    assert flying.in_use[:2] == [False, True]
