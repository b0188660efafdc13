# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Changes of state in the log of a node."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy", reason="the log is that of a node")

from fdi_ros.monitor.output import ChannelState, Event, Reason
from fdi_ros.monitor.status import ApartStatus
from fdi_ros.ros.running import QUIET, ChangeLog

OK, UNCHECKED, SUSPECT = ChannelState.OK, ChannelState.UNCHECKED, ChannelState.SUSPECT
AMBIGUOUS, FAULTY = ChannelState.AMBIGUOUS, ChannelState.FAULTY
NAMES = ("imu_1.x", "imu_1.y", "imu_2.x", "imu_2.y")


@pytest.fixture
def said():
    """Severity and words of each line of the log."""
    return []


@pytest.fixture
def now():
    return [100.0]


@pytest.fixture
def changes(said, now) -> ChangeLog:
    log = {name: lambda words, name=name: said.append((name, words)) for name in ("info", "warning", "error")}
    return ChangeLog(SimpleNamespace(**log), NAMES, lambda: now[0])


def events(before, after, *channels: int, why=Reason.NONE) -> list[Event]:
    group = channels if after is AMBIGUOUS else ()
    return [Event(12 * 10**9, channel, before, after, why, group or (channel,), 0.0) for channel in channels]


def test_channels_that_change_alike_share_a_line(changes, said) -> None:
    changes.add(events(UNCHECKED, OK, 0, 1, 3) + events(OK, FAULTY, 2, why=Reason.DISAGREES), 2 * 10**9, None)
    assert said == [
        ("info", "imu_1.x, imu_1.y, imu_2.y: UNCHECKED -> OK at 10.000 s"),
        ("error", f"imu_2.x: OK -> FAULTY at 10.000 s: {Reason.DISAGREES.value}"),
    ]


def test_a_link_that_jitters_does_not_flood_the_log_and_what_was_left_out_is_counted(changes, said, now) -> None:
    for k in range(2000):
        changes.add(events(OK, UNCHECKED, k % 4) if k % 2 else events(UNCHECKED, OK, k % 4), 0, None)
        changes.check()
        now[0] += 0.01
    # 100 changes a second for 20 s: one line a channel in 5 s.
    assert len(said) <= len(NAMES) * (20 / QUIET + 1)
    now[0] += QUIET
    changes.check()
    changes.check()
    (last,) = [line for _, line in said[-2:] if "imu_2.y" in line]
    assert "UNCHECKED now, after" in last
    assert "more changes" in last
    count = len(said)
    now[0] += 10 * QUIET
    changes.check()
    assert len(said) == count


def test_what_becomes_worse_is_said_at_once(changes, said, now) -> None:
    pair = ApartStatus(("imu_1.x", "imu_2.x"), "the x axis of imu_1 or imu_2,", 0.1, 0.002)
    before = OK
    for after, channels in ((UNCHECKED, (0,)), (SUSPECT, (0,)), (OK, (0,)), (SUSPECT, (0,)), (AMBIGUOUS, (0, 2))):
        changes.add(events(before, after, *channels), 0, pair)
        before = after
        now[0] += 0.05
    changes.add(events(AMBIGUOUS, FAULTY, 0), 0, None)
    assert [line.split(" at ")[0] for _, line in said] == [
        "imu_1.x: OK -> UNCHECKED",
        "imu_1.x: UNCHECKED -> SUSPECT",
        "imu_1.x, imu_2.x: SUSPECT -> AMBIGUOUS",
        "imu_1.x: AMBIGUOUS -> FAULTY",
    ]
    assert "the x axis of imu_1 or imu_2, 0.100 +- 0.002 rad/s apart" in said[2][1]
