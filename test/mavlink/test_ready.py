# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Readiness of failover: nothing unknown counts as good, and each reason has its sentence."""

from typing import Any

import pytest

from fdi_ros.mavlink.failover.policy import Imu, Memory, PolicySettings, View
from fdi_ros.mavlink.failover.ready import Facts, not_ready

NS = 1_000_000_000
NOW = 100 * NS
GOOD = Imu(use=True, heard=NOW, named=False, ok=True, delivers=True, size=0.0, agreed=1)
FACTS = Facts(age=0.02, lost=0.0, trip=20_000_000, obeys=(True,) * 3)


def reason(
    facts: dict[str, Any] | None = None,
    memory: dict[str, Any] | None = None,
    count: int = 3,
    second: dict[str, Any] | None = None,
    **view: Any,
) -> str:
    """Return the reason where all is good but what is given, of the second IMU too."""
    imus = [GOOD] * count
    imus[1] = GOOD._replace(**second or {})
    memories = [Memory(seen=True, acquainted=True) for _ in range(count)]
    for name, value in (memory or {}).items():
        setattr(memories[1], name, value)
    now = View(tuple(imus), linked=True, monitored=True)._replace(**view)
    given = FACTS._replace(**facts or {})
    return not_ready(memories, now, given, NOW, PolicySettings())


def test_all_good_is_ready_and_two_imus_are_not() -> None:
    assert reason() == ""
    assert reason(count=2) == "two IMUs: no third to decide"


def test_two_that_were_bad_have_no_vote_on_the_third() -> None:
    words = "two were bad: no vote"
    for bad, why in ([0], ""), ([0, 1], words), ([0, 2], words), ([0, 1, 2], ""):
        memories = [Memory(seen=True, acquainted=True)] * 3
        imus = tuple(GOOD._replace(votes=k not in bad) for k in range(3))
        view = View(imus, linked=True, monitored=True)
        assert not_ready(memories, view, FACTS, NOW, PolicySettings()) == why


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"facts": {"age": float("nan")}}, "the monitor is late"),
        ({"facts": {"age": -1.5}}, "the monitor is late"),
        ({"facts": {"lost": 0.11}}, "link loses messages"),
        ({"facts": {"trip": None}}, "link is slow"),
        ({"facts": {"is_mixed": True}}, "two senders with one system id"),
        ({"facts": {"is_slow": True}}, "IMUs come too slowly"),
        ({"facts": {"other": 7}}, "failover_file is of system 7"),
        ({"facts": {"is_file_fine": False}}, "failover_file is not usable"),
        ({"facts": {"has_lanes": False}}, "EK3_IMU_MASK is not reported"),
        ({"facts": {"obeys": (True, None, True)}}, "setting INS_USE2 is not answered"),
        (
            {"facts": {"obeys": (True, False, None)}},
            "setting INS_USE2 has no effect",
        ),
        ({"linked": False}, "no ArduPilot that sends each IMU"),
        ({"monitored": False}, "monitor silent or not alone"),
        ({"second": {"use": None}}, "use of IMU 2 is not reported"),
        ({"memory": {"seen": False}}, "IMU 2 not in use"),
        ({"second": {"agreed": None}}, "IMU 2 agrees with none"),
        ({"second": {"delivers": False}}, "IMU 2 sends nothing"),
        ({"second": {"size": 0.05}}, "IMU 2 differs and is in use"),
        ({"second": {"unjudged": "xy"}}, "IMU 2 x, y not judged"),
        ({"second": {"declared": "xy"}}, "IMU 2 x, y faulty or in a set"),
        ({"second": {"lane": False}}, "EK3_IMU_MASK is without IMU 2"),
        ({"memory": {"acquainted": False}}, "IMU 2 not seen to agree yet"),
        ({"memory": {"left_alone": True}}, "IMU 2 left alone in this flight"),
    ],
)
def test_each_doubt_has_its_sentence(given: dict[str, Any], words: str) -> None:
    assert reason(**given) == words


@pytest.mark.parametrize(
    ("imus", "words"),
    [
        ({0: {"size": 0.3}, 1: {"size": 0.3}}, "IMUs 1, 2 differ"),
        (
            {0: {"size": 0.3}, 1: {"size": 0.3, "named": True, "blamed": True}},
            "IMU 2 faulty and in use",
        ),
    ],
)
def test_no_healthy_imu_is_named_for_another(
    imus: dict[int, dict[str, Any]], words: str
) -> None:
    memories = [Memory(seen=True, acquainted=True)] * 3
    seen = tuple(GOOD._replace(**imus.get(k, {})) for k in range(3))
    view = View(seen, linked=True, monitored=True)
    assert not_ready(memories, view, FACTS, NOW, PolicySettings()) == words


def test_a_late_answer_that_the_policy_ignores_changes_nothing() -> None:
    """ArduPilot answers a read with the value from before our order."""
    late = {"second": {"use": False}}
    assert reason(memory={"seen": True}, **late) == ""
    disputed = {"seen": True, "against_since": NOW}
    assert reason(memory=disputed, **late) == "IMU 2 not in use"


@pytest.mark.parametrize(
    ("fine", "doubtful"),
    [
        ({"age": 0.95}, {"age": 1.05}),
        ({"lost": 0.095}, {"lost": 0.105}),
        ({"trip": 295_000_000}, {"trip": 305_000_000}),
    ],
)
def test_monitor_and_link_are_in_doubt_from_these_sizes_on(
    fine: dict[str, Any], doubtful: dict[str, Any]
) -> None:
    assert reason(facts=fine) == ""
    assert reason(facts=doubtful)


def test_what_the_monitor_declares_counts_before_arming_only() -> None:
    """In flight failover answers beside a declared gyro that does not differ."""
    assert reason(second={"declared": "x"}, armed=True) == ""
    assert reason(second={"declared": "x", "agreed": None}, armed=True)


def test_the_gravest_reason_comes_first() -> None:
    """A link that is silent is not slow, and an IMU has its name before a rule has its."""
    silent = {"facts": {"trip": None}, "linked": False, "monitored": False}
    assert reason(**silent) == "no ArduPilot that sends each IMU"
    faulty = {"blamed": True, "size": 0.5, "agreed": None}
    assert reason(second=faulty) == "IMU 2 faulty and in use"
