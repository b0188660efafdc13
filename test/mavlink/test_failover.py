# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Failover: never a healthy IMU, never the last, always put back; and the conversation by which that is done."""

import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from fdi_ros.errors import ConfigError
from fdi_ros.mavlink.failover import (
    HEALED,
    SETTLED,
    Failover,
    FailoverState,
    FailoverUnit,
    Known,
    Order,
    decide,
    failover_text,
    objection,
)
from mavlink.autopilots import NS, PARAMETERS, Autopilot, Conversation
from mavlink.flights import Flight

MS = 1_000_000
OK, SUSPECT, AMBIGUOUS, FAULTY, STALE, UNCHECKED = range(6)
CHANNELS = [f"imu_{k}.{axis}" for k in (1, 2, 3) for axis in "xyz"]


HEALTHY = FailoverUnit(use=True, heard=1, ok=True, well=1, delivers=True)
FAULT = HEALTHY._replace(declared=10 * NS, ok=False, well=None)
FLIGHT = Known((FAULT, HEALTHY, HEALTHY), linked=True, armed=True, monitored=True)
NOW = 10 * NS + 1


def test_one_that_may_be_out_is_no_reserve_and_what_somebody_else_has_set_is_left_alone() -> (
    None
):
    """Of what else speaks against taking one out the random flights tell."""
    known = FLIGHT._replace(units=(FAULT, HEALTHY, FAULT))
    assert (
        objection(FailoverState({1: Order(False)}), known, 0, 1)
        == "no other is healthy"
    )
    assert objection(FailoverState(left_alone={0}), FLIGHT, 0, 1) == "set by others"


def test_an_old_declaration_is_not_acted_on_and_it_is_said_once() -> None:
    state, actions = decide(FailoverState(), FLIGHT, 12 * NS)
    assert actions == [("stays", 0, True, "declared too long ago")]
    assert decide(state, FLIGHT, 13 * NS)[1] == []


def test_another_fault_takes_the_place_of_one_that_has_healed() -> None:
    """With the limit reached: the healed one back first, and only when that is confirmed the faulty one out."""
    out = FailoverState(
        orders={1: Order(False, tries=1, begun=1, sent=1, confirmed=True)},
        seen={1: False},
    )
    healed = HEALTHY._replace(use=False, heard=2, well=NOW - HEALED)
    known = FLIGHT._replace(units=(FAULT, healed, HEALTHY))
    for changes in (
        {"well": NOW - HEALED + 1},
        {"well": None},
        {"ok": False},
        {"delivers": False},
    ):
        assert (
            decide(
                out,
                known._replace(units=(FAULT, healed._replace(**changes), HEALTHY)),
                NOW,
            )[1]
            == []
        )
    state, actions = decide(out, known, NOW)
    assert actions == [("set", 1, True, "")]
    assert decide(state, known, NOW + 50 * MS)[1] == []
    known = known._replace(
        units=(FAULT, healed._replace(use=True, heard=NOW + 60 * MS), HEALTHY)
    )
    state, actions = decide(state, known, NOW + 60 * MS)
    assert actions == [("back", 1, False, ""), ("set", 0, False, "")]
    assert set(state.orders) == {0, 1}, "the first until it is sure"


@pytest.mark.parametrize(
    ("wait", "again"), [(SETTLED - 1, [("set", 1, False, "")]), (SETTLED, [])]
)
def test_a_late_answer_to_a_put_back_may_be_somebody_elses(
    wait: int, again: list
) -> None:
    """IMU 2 is put back in flight; where that has been answered late, another fault of it is the pilot's."""
    state = FailoverState(
        orders={1: Order(True, tries=1, begun=NOW, sent=NOW)}, seen={1: False}
    )
    back = HEALTHY._replace(heard=NOW + wait)
    state, actions = decide(
        state, FLIGHT._replace(units=(HEALTHY, back, HEALTHY)), NOW + wait
    )
    assert actions[0] == ("back", 1, False, "")
    fault = back._replace(declared=NOW + wait + 1, ok=False)
    assert (
        decide(state, FLIGHT._replace(units=(HEALTHY, fault, HEALTHY)), NOW + wait + 2)[
            1
        ]
        == again
    )


@pytest.mark.parametrize("seeds", [range(40 * k, 40 * (k + 1)) for k in range(4)])
def test_nothing_healthy_nothing_last_and_all_back_whatever_happens(
    seeds: range,
) -> None:
    """`python -m mavlink.flights 10000` for more."""
    done = sum((Flight(seed).fly() for seed in seeds), Counter())
    assert min(done[kind] for kind in ("out", "back", "changed", "stays")) > 5


class Monitored(Conversation):
    """A conversation with failover and a monitor that says what it is told to, at 50 Hz."""

    def __init__(
        self, path: Path, *autopilots: Autopilot, limit: int = 1, **settings
    ) -> None:
        super().__init__(*autopilots, may_set=True, **settings)
        self.failover = Failover(self.vehicle, CHANNELS, limit, path / "out.json")
        self.states = [OK] * 9
        self.failover.is_alone = self.reports = True

    def run(self, seconds: float) -> "Monitored":
        for _ in range(round(seconds * 50)):
            super().run(0.02)
            self.failover.reported = (
                self.now if self.reports else self.failover.reported
            )
            self.failover.declarations.hear(self.states, self.now)
            self.failover.turn(self.now)
        return self

    def declare(
        self, channel: str, seconds: float = 0.0, state: int = FAULTY
    ) -> "Monitored":
        """Have a channel declared, and let so many seconds go by."""
        self.states[CHANNELS.index(channel)] = state
        return self.run(seconds)


@pytest.fixture
def flying(tmp_path: Path) -> Monitored:
    talk = Monitored(tmp_path, Autopilot("ardupilot")).run(4.0)
    talk.autopilots[0].armed = True
    return talk.run(2.0)


def test_an_imu_is_out_within_100_ms_told_kept_and_put_back_on_disarm(
    flying: Monitored, tmp_path: Path
) -> None:
    autopilot, at = flying.autopilots[0], flying.now
    flying.failover.errors["imu_1.y"] = 0.301
    flying.declare("imu_1.y", 1.0)
    assert autopilot.sets == [(pytest.approx(at, abs=100 * MS), "INS_USE", 0.0)]
    assert autopilot.flies_with == 1
    assert autopilot.texts == [
        (2, "FDI: IMU 1 (imu_1) out of use (gyro y -0.30 rad/s)")
    ]
    assert json.loads((tmp_path / "out.json").read_text()) == {
        "system_id": 1,
        "out_of_use": [1],
    }
    flying.states = [OK] * 9
    assert flying.run(20.0).autopilots[0].flies_with == 1, (
        "healthy again, it stays out in flight"
    )
    autopilot.armed = False
    flying.run(6.0)
    assert set(autopilot.parameters.values()) == {1.0}
    assert autopilot.texts[-1] == (6, "FDI: IMU 1 (imu_1) in use again")
    assert json.loads((tmp_path / "out.json").read_text())["out_of_use"] == []


@pytest.mark.parametrize("state", [SUSPECT, AMBIGUOUS, STALE, UNCHECKED])
def test_what_is_not_declared_by_name_stays(flying: Monitored, state: int) -> None:
    flying.declare("imu_1.y", state=state)
    assert not flying.declare("imu_2.y", 3.0, state).autopilots[0].sets


def test_on_the_ground_over_another_stack_or_before_an_answer_nothing_is_set(
    tmp_path: Path,
) -> None:
    deaf = Autopilot(
        "ardupilot", armed=True, parameters=dict.fromkeys(PARAMETERS[:2], 1.0)
    )
    for autopilot in (Autopilot("ardupilot"), Autopilot("px4", armed=True), deaf):
        talk = Monitored(tmp_path, autopilot).run(5.0)
        assert not talk.declare("imu_1.y", 3.0).autopilots[0].sets


def test_it_is_repeated_over_a_poor_link_and_given_up_where_refused(
    tmp_path: Path,
) -> None:
    random = np.random.default_rng(1)
    autopilot = Autopilot("ardupilot", loss=0.4, armed=True)
    talk = Monitored(
        tmp_path, autopilot, latency=lambda: int(random.exponential(50 * MS))
    ).run(12.0)
    talk.declare("imu_3.x", 2.0)
    assert autopilot.flies_with == 0
    assert autopilot.parameters["INS_USE3"] == 0.0
    refusing = Autopilot("ardupilot", armed=True, read_only={"INS_USE2"})
    talk = Monitored(tmp_path / "..", refusing, limit=2).run(6.0)
    talk.declare("imu_2.x", 5.0)
    assert len(refusing.sets) == 10
    assert refusing.texts == [(2, "FDI: IMU 2 (imu_2) out of use: not accepted")]
    refusing.read_only.clear()
    refusing.armed = False
    talk.run(8.0)
    assert set(refusing.parameters.values()) == {1.0}
    assert not talk.failover._state.orders


@pytest.mark.parametrize("wait", [0.5, 5.0])
def test_what_somebody_else_sets_is_left_alone_however_soon(
    flying: Monitored, wait: float
) -> None:
    autopilot, out = flying.autopilots[0], []
    flying.declare("imu_1.y")
    flying.run(wait)
    autopilot.parameters["INS_USE"] = 1.0
    autopilot.say_parameter("INS_USE", out)
    flying.inject(out[0])
    flying.run(1.0 if wait > 2.0 else 5.0)
    assert autopilot.texts[-1] == (4, "FDI: IMU 1 (imu_1) set by others, left alone")
    flying.declare("imu_1.y", 3.0, OK)
    flying.declare("imu_1.y", 3.0)
    assert [value for _, _, value in autopilot.sets] == [0.0]
    assert autopilot.texts[-1] == (2, "FDI: IMU 1 (imu_1) stays: set by others")


def test_another_system_says_nothing_of_the_imu_that_is_out(tmp_path: Path) -> None:
    """The one with an IMU out falls silent, another is heard, then the first again, landed."""
    first, second = (
        Autopilot("ardupilot", armed=True),
        Autopilot("ardupilot", system=2, armed=True, loss=1.0),
    )
    talk = Monitored(tmp_path, first, second).run(6.0)
    talk.declare("imu_1.y", 5.0)
    first.loss, second.loss = 1.0, 0.0
    talk.run(15.0)
    assert talk.vehicle.system == 2
    assert json.loads((tmp_path / "out.json").read_text()) == {
        "system_id": 1,
        "out_of_use": [1],
    }
    first.loss, second.loss, first.armed = 0.0, 1.0, False
    talk.run(20.0)
    assert first.flies_with == 0
    assert not second.sets


def test_after_a_start_in_flight_what_is_in_use_again_is_left_alone(
    tmp_path: Path,
) -> None:
    (tmp_path / "out.json").write_text('{"system_id": 1, "out_of_use": [1]}')
    talk = Monitored(tmp_path, Autopilot("ardupilot", armed=True)).run(6.0)
    talk.declare("imu_1.y", 3.0)
    assert talk.autopilots[0].texts == [(2, "FDI: IMU 1 (imu_1) stays: set by others")]
    assert not talk.autopilots[0].sets


def test_a_monitor_that_was_silent_is_believed_after_its_next_report(
    flying: Monitored,
) -> None:
    """It may have been started anew, with other IMUs by the same names."""
    Conversation.run(flying, 1.5)
    flying.reports = False
    flying.run(0.1)
    assert not flying.declare("imu_1.y", 0.5).autopilots[0].sets
    flying.reports = True
    assert flying.run(0.1).autopilots[0].sets


def test_a_file_that_cannot_be_written_in_flight_is_told_and_written_later(
    flying: Monitored, tmp_path: Path
) -> None:
    for file in tmp_path.iterdir():
        file.unlink()
    tmp_path.rmdir()
    flying.declare("imu_1.y", 1.0)
    assert flying.failover.status(flying.now)[1].endswith(
        "of system 1; failover_file is not written"
    )
    tmp_path.mkdir()
    flying.run(2.0)
    assert json.loads((tmp_path / "out.json").read_text()) == {
        "system_id": 1,
        "out_of_use": [1],
    }


def test_a_companion_that_dies_tells_and_puts_back_at_its_next_start(
    flying: Monitored, tmp_path: Path
) -> None:
    autopilot = flying.autopilots[0]
    flying.declare("imu_1.y", 1.0)
    autopilot.reboot(flying.now)
    autopilot.armed = False
    autopilot.texts.clear()
    autopilot.boot = -100 * NS
    again = Monitored(tmp_path, autopilot).run(12.0)
    assert autopilot.texts == [
        (2, "FDI: IMU 1 (imu_1) out of use"),
        (6, "FDI: IMU 1 (imu_1) in use again"),
    ]
    assert autopilot.flies_with == 0
    assert again.failover.status(again.now)[1] == "ready"


def test_what_failover_would_have_done_in_a_recording() -> None:
    begin = [(0.5, name, "OK") for name in CHANNELS]
    assert failover_text(begin, CHANNELS) == "failover, if armed: nothing to do"
    first = [
        (105.2, "imu_1.x", "SUSPECT"),
        (105.3, "imu_1.x", "FAULTY"),
        (122.0, "imu_1.x", "OK"),
    ]
    second = [(130.0, "imu_3.y", "FAULTY"), (131.5, "imu_2.z", "FAULTY")]
    assert failover_text(begin + first + second, CHANNELS) == (
        "failover, if armed: IMU 1 (imu_1) out of use at 105.3 s; IMU 1 (imu_1) in use again at 130.0 s;"
        " IMU 3 (imu_3) out of use at 130.0 s;"
        " IMU 2 (imu_2) stays: limit at 132.5 s"
    )
    assert failover_text(begin, CHANNELS[:4]) == ""


def test_an_operator_puts_back(flying: Monitored) -> None:
    flying.declare("imu_1.y", 1.0)
    assert flying.failover.restore(flying.now) == (True, "IMU 1 (imu_1) is put back")
    flying.run(5.0)
    assert flying.autopilots[0].flies_with == 0
    assert flying.failover.restore(flying.now) == (
        True,
        "no IMU is out of use by failover",
    )


@pytest.mark.parametrize("text", ["[]", '{"system_id": 1, "out_of_use": [4]}'])
def test_a_file_that_is_none_of_ours_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "out.json").write_text(text)
    with pytest.raises(ConfigError, match="does not say which"):
        Monitored(tmp_path, Autopilot("ardupilot"))
    (tmp_path / "out.json").chmod(0o666)
    with pytest.raises(ConfigError, match="others can write it"):
        Monitored(tmp_path, Autopilot("ardupilot"))
