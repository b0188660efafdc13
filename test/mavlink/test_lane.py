# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""When another EKF lane is asked for: only where ours has misled lane is known to be flown with."""

from dataclasses import replace

import pytest

from fdi_ros.mavlink.failover.lane import LaneReport, LaneState, follow
from fdi_ros.mavlink.failover.policy import Imu, Memory, PolicySettings, View

MS = 1_000_000
NS = 1000 * MS
TICK = 20 * MS
USED = Memory(seen=True)
OUT = Memory(ours=True, held=True, seen=False)
#: Times from the report "out" at which it is asked for, ms: those that the docs promise.
ALL = [300, 600, 1000, 2000, 3000, 4000, 5500]
KNOWN = LaneReport(configured=0, lanes=3, is_complete=True, has_texts=True)


class Lanes:
    """Three IMUs in flight, with what the autopilot reports of its lanes."""

    def __init__(
        self,
        report: LaneReport = KNOWN,
        settings: PolicySettings = PolicySettings(),  # noqa: B008
    ) -> None:
        self.settings = settings
        self.now = 100 * NS
        self.state = LaneState()
        self.report = report
        self.memories = [replace(USED) for _ in range(3)]
        imu = Imu(use=True, delivers=True, ok=True, size=0.0)
        self.imus = [imu, imu, imu]
        self.armed = False
        self.linked = self.monitored = True
        self.boots = 0
        self.asked: list[int] = []  # ms since `mark`
        self.mark = 0

    def run(self, seconds: float, named: int | None = None) -> "Lanes":
        """Fly on; a text names a lane at first."""
        for _ in range(round(seconds * NS / TICK)):
            self.now += TICK
            view = View(
                tuple(self.imus),
                linked=self.linked,
                armed=self.armed,
                monitored=self.monitored,
                boots=self.boots,
            )
            report = self.report._replace(named=named)
            named = None
            self.state, asks = follow(
                self.state, report, self.memories, view, self.now, self.settings
            )
            if asks:
                self.asked.append((self.now - self.mark) // MS)
        return self

    def fly(self) -> "Lanes":
        self.run(3.0)
        self.armed = True
        return self.run(3.0)

    def out(self, *imus: int, seconds: float = 8.0) -> "Lanes":
        """IMUs, from 0, are reported out after our order."""
        for k in imus:
            self.memories[k] = replace(OUT)
        # The first tick that knows it.
        self.mark = self.now + TICK
        return self.run(seconds)


def test_it_is_asked_until_after_the_five_seconds_of_ardupilot() -> None:
    assert Lanes().fly().out(0, seconds=60.0).asked == ALL


@pytest.mark.parametrize("configured", [0, 1, 2])
def test_only_the_imu_of_the_primary_lane_counts(configured: int) -> None:
    for k in range(3):
        lanes = Lanes(KNOWN._replace(configured=configured)).fly().out(k)
        assert bool(lanes.asked) == (k == configured)


@pytest.mark.parametrize("configured", [3, 255])
def test_a_primary_lane_that_does_not_exist_is_the_first(configured: int) -> None:
    assert Lanes(KNOWN._replace(configured=configured)).fly().out(0).asked


def test_the_lane_that_a_text_has_named_counts() -> None:
    assert not Lanes().fly().run(0.1, named=1).out(0).asked
    assert Lanes().fly().run(0.1, named=1).out(1).asked


def test_nothing_is_asked_after_the_lane_has_changed() -> None:
    lanes = Lanes().fly().out(0, seconds=0.4)
    assert lanes.asked == [300]
    assert lanes.run(5.0, named=2).asked == [300]


def test_a_lane_named_again_that_was_primary_is_no_change() -> None:
    """ArduPilot sends two texts of each change."""
    lanes = Lanes().fly().run(0.1, named=1).run(0.1, named=1).out(1)
    assert lanes.asked == ALL


def test_a_lane_that_runs_on_another_imu_is_misled_by_that_one() -> None:
    """IMU 1 is out, ArduPilot stays on its lane, which runs on IMU 2; then this one fails."""
    lanes = Lanes().fly().out(0)
    lanes.asked.clear()
    assert lanes.out(1).asked == ALL
    other = Lanes().fly().out(0)
    other.asked.clear()
    assert not other.out(2).asked


def test_an_imu_that_others_took_out_has_misled_nothing() -> None:
    lanes = Lanes().fly()
    lanes.memories[0] = Memory(seen=False)
    assert not lanes.run(5.0).asked


@pytest.mark.parametrize(
    "change",
    [
        {"configured": None},
        {"lanes": 0},
        {"lanes": 1},
        {"is_complete": False},
        {"has_texts": False},
    ],
)
def test_nothing_is_asked_of_an_autopilot_whose_lanes_are_not_known(change) -> None:
    assert not Lanes(KNOWN._replace(**change)).fly().out(0).asked


@pytest.mark.parametrize("gap", [0.02, 3.0])
def test_a_text_that_may_be_lost_makes_the_lane_unknown_until_one_names_it(
    gap: float,
) -> None:
    lanes = Lanes().fly()
    lanes.report = KNOWN._replace(is_complete=False)
    lanes.run(gap)
    lanes.report = KNOWN
    assert not lanes.run(1.0).out(0).asked
    named = lanes.run(0.1, named=1)
    named.memories[0] = replace(USED)
    assert named.out(1).asked


def test_after_the_landing_the_lane_is_the_configured_one_again() -> None:
    lanes = Lanes().fly().run(20.0, named=2)
    lanes.armed = False
    assert lanes.fly().out(0).asked
    again = Lanes().fly().run(20.0, named=2)
    again.armed = False
    assert not again.fly().out(2).asked


def test_a_start_in_flight_knows_no_lane() -> None:
    lanes = Lanes()
    lanes.armed = True
    assert not lanes.run(3.0).out(0).asked


def test_a_start_of_the_autopilot_is_forgotten_with_its_lanes() -> None:
    lanes = Lanes().fly()
    lanes.boots = 1
    assert not lanes.run(1.0).out(0).asked


@pytest.mark.parametrize(
    "state",
    [
        {"size": 0.03},
        {"size": float("nan")},
        {"stuck": True},
        {"delivers": False},
    ],
)
@pytest.mark.parametrize("imu", [1, 2])
def test_nothing_is_asked_while_an_imu_in_use_may_be_bad(imu: int, state) -> None:
    lanes = Lanes().fly()
    lanes.imus[imu] = lanes.imus[imu]._replace(**state)
    assert not lanes.out(0).asked


def test_what_is_not_allowed_when_due_is_left_out() -> None:
    lanes = Lanes().fly()
    fine = lanes.imus[1]
    lanes.imus[1] = fine._replace(size=0.1)
    lanes.out(0, seconds=0.8)
    lanes.imus[1] = fine
    # A second after that its lane has a score.
    assert lanes.run(8.0).asked == ALL[3:]


@pytest.mark.parametrize("name", ["linked", "monitored", "armed"])
def test_nothing_is_asked_without_link_monitor_or_flight(name: str) -> None:
    lanes = Lanes().fly()
    setattr(lanes, name, False)
    assert not lanes.out(0).asked


def test_with_no_other_lane_on_an_imu_in_use_nothing_is_asked() -> None:
    """IMU 3, the last one in use, has no lane."""
    assert not Lanes(KNOWN._replace(lanes=2)).fly().out(0, 1).asked
    assert Lanes(KNOWN._replace(lanes=2)).fly().out(0).asked


def test_an_imu_that_is_back_before_the_end_is_still_asked_for() -> None:
    """The lane is misled, whether its IMU is back or not."""
    lanes = Lanes().fly().out(0, seconds=0.5)
    lanes.memories[0] = replace(USED)
    assert lanes.run(8.0).asked == ALL


def test_nothing_is_asked_within_a_second_of_another_lane_that_was_misled() -> None:
    """Its score may still be the lowest: IMU 2 is out 0.5 s before IMU 1."""
    lanes = Lanes().fly()
    fine = lanes.imus[1]
    lanes.imus[1] = fine._replace(size=0.3)
    lanes.run(0.2).out(1, seconds=0.5)
    assert lanes.out(0).asked == ALL[1:]


@pytest.mark.parametrize(
    "memory",
    [
        Memory(ours=True, held=True, seen=True, tries=1),  # not confirmed
        Memory(ours=True, held=False, seen=True),  # just back
    ],
)
def test_an_imu_that_is_ours_and_still_in_use_must_be_fine_too(memory: Memory) -> None:
    for size, asked in ((0.0, ALL), (0.3, [])):
        lanes = Lanes().fly()
        lanes.memories[1] = replace(memory)
        lanes.imus[1] = lanes.imus[1]._replace(size=size)
        assert lanes.out(0).asked == asked


def test_only_the_lane_of_its_own_imu_that_is_back_is_left_to_change_to() -> None:
    """The primary lane was misled by IMU 2; its own one, IMU 1, is the only one in use."""
    lanes = Lanes().fly().out(0)
    lanes.asked.clear()
    lanes.memories[2] = Memory(seen=False)
    lanes.out(1, seconds=0.1)
    lanes.memories[0] = replace(USED)
    assert not lanes.run(8.0).asked


def test_an_imu_is_fine_below_the_least_size_of_the_settings() -> None:
    lanes = Lanes().fly()
    lanes.imus[2] = lanes.imus[2]._replace(size=0.05)
    assert not lanes.out(0).asked
    wide = Lanes(settings=PolicySettings(min_size=0.06)).fly()
    wide.imus[2] = wide.imus[2]._replace(size=0.05)
    assert wide.out(0).asked == ALL


def test_nothing_is_asked_long_after_the_report() -> None:
    """The node may have hung: the vehicle flies otherwise by then."""
    lanes = Lanes().fly().out(0, seconds=0.1)
    lanes.now += 5800 * MS
    assert lanes.run(0.1).asked == [5900]
    late = Lanes().fly().out(0, seconds=0.1)
    late.now += 6000 * MS
    assert not late.run(5.0).asked


def test_an_imu_that_was_out_before_a_start_has_misled_nothing() -> None:
    """Its first report since then is no consequence of an order."""
    lanes = Lanes().fly()
    lanes.memories[0] = Memory(ours=True, held=True)
    assert not lanes.run(1.0).out(0).asked


def test_a_lane_that_is_not_of_this_vehicle_makes_the_primary_one_unknown() -> None:
    lanes = Lanes().fly().run(0.1, named=3)
    assert not lanes.run(1.0).out(0).asked
    assert lanes.run(0.1, named=2).out(2).asked


def test_a_text_from_the_flight_before_does_not_outlive_the_landing() -> None:
    lanes = Lanes().fly().run(0.1, named=2)
    lanes.armed = False
    lanes.run(0.1)
    lanes.armed = True
    assert not lanes.run(1.0).out(2).asked
    assert lanes.out(0).asked == ALL


def test_a_text_on_the_ground_makes_the_lane_unknown_for_two_seconds() -> None:
    """It may be of the landing, or of an arming whose heartbeat is still to come."""
    for seconds, lane in ((1.9, None), (2.1, 0)):
        lanes = Lanes().run(3.0).run(seconds, named=1)
        lanes.armed = True
        assert lanes.run(1.0).state.primary == lane


def test_disarmed_it_ends() -> None:
    lanes = Lanes().fly().out(0, seconds=0.7)
    lanes.armed = False
    assert lanes.run(8.0).asked == ALL[:2]
    lanes.armed = True
    assert lanes.run(8.0).asked == ALL[:2]
