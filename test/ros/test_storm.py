# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A moment of each storm, and the log of a node, bounded whatever causes its lines; changes of state in it.

The long form of the storms, with the times, is benchmark/mavlink.py storms.
"""

from collections import Counter

import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2")

from ros.storm import KINDS, vehicle, weather

from fdi_ros.monitor.output import ChannelState, Event, Reason
from fdi_ros.monitor.status import ApartStatus
from fdi_ros.ros.node import MOST_LINES, REPORT_PERIOD, BoundedLog
from fdi_ros.ros.running import REPORT_TIMES, ChangeLog

SECONDS = 0.7
THROTTLED = (
    10  # lines that are limited each by itself, at most so many a second together
)
OK, UNCHECKED, SUSPECT = ChannelState.OK, ChannelState.UNCHECKED, ChannelState.SUSPECT
AMBIGUOUS, FAULTY = ChannelState.AMBIGUOUS, ChannelState.FAULTY
NAMES = ("imu_1.x", "imu_1.y", "imu_2.x", "imu_2.y")


def test_in_every_storm_all_is_answered_and_the_log_and_the_memory_are_bounded(
    tmp_path, compiled
) -> None:
    with vehicle(tmp_path) as over:
        for seed, kind in enumerate(KINDS):
            told = weather(over, kind, SECONDS, seed)
            assert told["sent"] > 0
            assert told["answered"] == told["sent"], kind
            for name, process in (("monitor", over.monitor), ("link", over.link)):
                assert process.popen.poll() is None
                # A storm of little more than a second lies in two periods of the log.
                assert told[f"{name}: lines of the log a second"] < 2 * (
                    3 * MOST_LINES + THROTTLED
                ), process.said()
                assert "Exception in" not in process.said()
                assert told[f"{name}: memory, MB"] < 400
        assert over.listener.trigger("reset").success
        over.listener.clear()
        assert over.listener.says("monitor", "of 9 channels healthy")


class Paper:
    """Takes lines of all severities, and has the time, s."""

    def __init__(self) -> None:
        self.lines: list[tuple[str, str]] = []
        self.now = 100.0
        self.changes = ChangeLog(self, NAMES, lambda: self.now)

    def __getattr__(self, severity: str):
        return lambda words: self.lines.append((severity, words))


def test_a_log_is_bounded_and_says_how_much_was_left_out() -> None:
    paper = Paper()
    log = BoundedLog(paper, lambda: paper.now)
    for k in range(1000):
        (log.info, log.warning, log.error)[k % 3](f"line {k}\n" + "x" * 10**5)
    # Each severity has its own room: requests without end hide no declaration.
    assert Counter(severity for severity, _ in paper.lines) == dict.fromkeys(
        ("info", "warning", "error"), MOST_LINES
    )
    assert all(len(line) <= 5000 and "\n" not in line for _, line in paper.lines)
    paper.now += REPORT_PERIOD
    log.begin_period()
    log.info("again")
    assert paper.lines[-2:] == [
        ("warning", f"and {1000 - 3 * MOST_LINES} more lines, left out"),
        ("info", "again"),
    ]


def events(before, after, *channels: int, why=Reason.NONE) -> list[Event]:
    group = channels if after is AMBIGUOUS else ()
    return [
        Event(12 * 10**9, channel, before, after, why, group or (channel,), 0.0)
        for channel in channels
    ]


def test_a_link_that_jitters_does_not_flood_the_log_and_what_was_left_out_is_counted() -> (
    None
):
    paper = Paper()
    for k in range(2000):
        paper.changes.add(
            events(OK, UNCHECKED, k % 4) if k % 2 else events(UNCHECKED, OK, k % 4),
            0,
            None,
        )
        paper.changes.check()
        paper.now += 0.01
    # 100 changes a second for 20 s: one line a channel in 5 s.
    assert len(paper.lines) <= len(NAMES) * (20 / REPORT_TIMES.quiet + 1)
    paper.now += REPORT_TIMES.quiet
    paper.changes.check()
    (last,) = [line for _, line in paper.lines[-2:] if "imu_2.y" in line]
    assert "UNCHECKED now, after" in last
    assert "more changes" in last
    count = len(paper.lines)
    paper.now += 10 * REPORT_TIMES.quiet
    paper.changes.check()
    assert len(paper.lines) == count


def test_what_becomes_worse_is_said_at_once_and_channels_that_change_alike_share_a_line() -> (
    None
):
    paper = Paper()
    pair = ApartStatus(
        ("imu_1.x", "imu_2.x"), "the x axis of imu_1 or imu_2,", 0.1, 0.002
    )
    before = OK
    for after, channels in (
        (UNCHECKED, (0,)),
        (SUSPECT, (0,)),
        (OK, (0,)),
        (SUSPECT, (0,)),
        (AMBIGUOUS, (0, 2)),
    ):
        paper.changes.add(events(before, after, *channels), 0, pair)
        before = after
        paper.now += 0.05
    paper.changes.add(
        events(AMBIGUOUS, FAULTY, 0, why=Reason.DISAGREES), 2 * 10**9, None
    )
    assert paper.lines[-1] == (
        "error",
        f"imu_1.x: AMBIGUOUS -> FAULTY at 10.000 s: {Reason.DISAGREES.value}",
    )
    assert [line.split(" at ")[0] for _, line in paper.lines] == [
        "imu_1.x: OK -> UNCHECKED",
        "imu_1.x: UNCHECKED -> SUSPECT",
        "imu_1.x, imu_2.x: SUSPECT -> AMBIGUOUS",
        "imu_1.x: AMBIGUOUS -> FAULTY",
    ]
    assert (
        "the x axis of imu_1 or imu_2, 0.100 +- 0.002 rad/s apart" in paper.lines[2][1]
    )
