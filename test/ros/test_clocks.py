# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Stamps of clocks that are behind, hours away, or broken: each told by a node of its own, which remembers them."""

from __future__ import annotations

import re
import struct
import time

import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2")

from ros.harness import TWO_IMUS, monitoring, sound, wait

from fdi_ros.core.messages import ImuTemplate
from fdi_ros.sources.imus import ImuSource


@pytest.fixture
def listener(tmp_path):
    """The listener of a new monitor, which must still run after the test."""
    with monitoring(TWO_IMUS, tmp_path) as (listener, process):
        assert listener.settle()
        time.sleep(0.1)
        listener.clear()
        yield listener
        assert process.popen.poll() is None, process.said()


def test_a_clock_offset_is_named_and_lived_with(listener) -> None:
    offset = 40_000_000
    listener.play(sound(500)[1], skew=-offset)
    said = listener.says("input imu_2", "behind the other inputs'")
    assert wait(lambda: len(listener.fused) > 450)
    # Ten samples behind; nine where the one of the other unit came after it.
    lag = float(re.search(r"stay ([\d.]+) ms behind", said)[1])
    assert 32 <= lag <= 40.1
    # The clock is set right, and an operator tells the monitor that all is well.
    assert listener.trigger("reset").success
    assert listener.settle()


def test_a_clock_far_from_now_is_named(listener) -> None:
    listener.play(sound(20)[1])
    # The time begins anew when both units agree on it.
    hour = 3600 * 10**9
    z = sound(1100)[1]
    start = time.time_ns() - hour
    for k in range(300):
        for j in (0, 1):
            listener.send_imu(j, start + k * 4_000_000, z[k, 3 * j : 3 * j + 3].tolist())
        time.sleep(0.004)
    assert listener.says("input imu_1", "behind the clock")
    assert wait(lambda: len(listener.fused) > 250)
    late = [ImuSource.parse(data, 3)[0] for data in listener.fused[-200:]]
    assert late == sorted(set(late))
    assert abs(late[-1] - (time.time_ns() - hour)) < 10e9
    for k in range(800):
        for j in (0, 1):
            row = z[300 + k, 3 * j : 3 * j + 3] + (0.0, 0.3 * j, 0.0)
            listener.send_imu(j, start + (300 + k) * 4_000_000, row.tolist())
        time.sleep(0.004)
    assert listener.says("imu_2.y", "isolated")
    # Since when: a stamp of the messages, which went back.
    since = {v.key: v.value for v in listener.status("imu_2.y").values}["state since (stamp, s)"]
    assert abs(float(since) - start / 1e9) < 10


def test_stamps_at_the_ends_of_their_range_end_nothing(listener) -> None:
    z = sound(50)[1]
    listener.play(z)
    for sec, nanosec in ((2**31 - 1, 10**9 - 1), (2**31 - 1, 2**32 - 1), (-1, 0), (-(2**31), 2**32 - 1), (0, 10**9)):
        message = bytearray(ImuTemplate("imu").fill(0, (0.0, 0.0, 0.0), (0.0,) * 9))
        struct.pack_into("<iI", message, 4, sec, nanosec)
        for output in listener.outputs:
            output.publish(bytes(message))
        listener.play(z)
    assert wait(lambda: len(listener.fused) >= 300), len(listener.fused)
    assert listener.says("input imu_2", "malformed")
