# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Each test with a monitor of its own, that no other test has taught anything, and of which nothing is left."""

from __future__ import annotations

import re
import time

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2")

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from ros.harness import GEOMETRY, RATE, SIGMA, TWO_IMUS, healthy, monitoring, wait, warmed
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64MultiArray

from fdi_ros.core.alignment import Alignment
from fdi_ros.model.samples import Block
from fdi_ros.sources import ImuSource


def test_the_live_node_says_what_the_pipeline_says_of_the_same_stream(tmp_path) -> None:
    # By a node of its own, as what the default learns of noise and delays outlives a reset.
    alike = TWO_IMUS.replaced({"detector.name": "likelihood_ratio"})
    z = healthy(400, 5)[1]
    z[150:, 4] += 0.05
    with monitoring(alike, tmp_path) as (listener, _):
        assert listener.settle()
        time.sleep(0.1)
        listener.clear()
        stamps = listener.play(z, skew=300_000)
        assert wait(lambda: len(listener.fused) == 400)
        states, rates = listener.states(), listener.rates()
    sent = np.column_stack([stamps, stamps + 300_000]).ravel()
    block = Alignment(2, 2_000_000, 300_000_000).push_block(np.tile([0, 1], 400), sent, z.reshape(-1, 3))
    output = warmed(alike, int(stamps[0])).process(block)
    assert block.stamp.tolist() == stamps.tolist()
    np.testing.assert_array_equal(states, output.state)
    assert [rates[stamp] for stamp in stamps.tolist()] == list(map(tuple, output.rate.tolist()))


def test_channels_in_one_array(tmp_path) -> None:
    config = TWO_IMUS.replaced(
        {
            "input": "channels",
            "channels.topic": "gyros",
            "geometry.preset": "axes",
            "geometry.axes": GEOMETRY.axes.reshape(-1).tolist(),
            "health.stale_timeout": 0.3,
        }
    )
    with monitoring(config, tmp_path) as (listener, process):
        # The first samples are not checked yet.
        assert wait(lambda: listener.prime() or not listener.states()[-1].any())
        time.sleep(0.1)
        listener.clear()
        # A name waits for half a second.
        omega, z = healthy(450)
        z[150:, 4] += 0.3
        for k, values in enumerate(z.tolist()):
            listener.send_channels(values)
            if k == 100:
                for wrong in ([1.0] * 5, [1.0] * 7, [], [0.0] * 10_000):
                    listener.outputs[0].publish(Float64MultiArray(data=wrong))
            time.sleep(1 / RATE)
        assert wait(lambda: len(listener.fused) == 450), len(listener.fused)
        stamps = [ImuSource.parse(data, 3)[0] for data in listener.fused]
        assert stamps == sorted(set(stamps))
        rates = np.array(list(listener.rates().values()))
        error = np.abs(rates - omega).max(axis=1)
        # Stamped when they come, which a busy machine makes uneven: in the first moments it may be open who is wrong.
        assert np.delete(error, np.s_[150:250]).max() < 6 * 1.5 * SIGMA
        assert error.max() < 0.3 / 2
        assert listener.says("g5", "isolated")
        assert wait(lambda: listener.value("input gyros", "malformed") == "4")
        output = warmed(config, stamps[0]).process(Block(np.array(stamps), z))
        # Nor does the monitor that was warmed up here know as much of its gyros to the last bit.
        known = np.r_[:150, 400:450]
        np.testing.assert_array_equal(listener.states()[known], output.state[known])
        # A clock that goes forth and back by decades runs the stamps of the samples out of their range, in the end.
        clock = listener.create_publisher(Clock, "/clock", 10)
        assert listener.set(use_sim_time=True).successful
        assert wait(clock.get_subscription_count)
        for k in range(12):
            for _ in range(3):
                clock.publish(Clock(clock=Time(sec=(2**31 - 1) * (k % 2), nanosec=10**9 - 1)))
                time.sleep(0.01)
                listener.send_channels(z[0].tolist())
                time.sleep(0.01)
        assert wait(lambda: "the clock went back by decades too often" in process.said())
        listener.clear()
        listener.send_channels(z[0].tolist())
        assert wait(lambda: listener.fused)


# Clocks -------------------------------------------------------------------------------------------------------------


@pytest.fixture
def listener(tmp_path):
    """The listener of a new monitor, which must still run after the test."""
    with monitoring(TWO_IMUS, tmp_path) as (listener, process):
        assert listener.settle()
        time.sleep(0.1)
        listener.clear()
        yield listener
        assert process.popen.poll() is None, process.said()


def test_a_clock_offset_is_named_and_lived_with_and_so_is_a_gap(listener) -> None:
    offset = 40_000_000
    listener.play(healthy(500)[1], skew=-offset)
    said = listener.says("input imu_2", "behind the other inputs'")
    assert wait(lambda: len(listener.fused) > 450)
    # Ten samples behind; nine where the one of the other unit came after it.
    lag = float(re.search(r"stay ([\d.]+) ms behind", said)[1])
    assert 32 <= lag <= 40.1
    # The clock is set right, and an operator tells the monitor that all is well.
    assert listener.trigger("reset").success
    assert listener.settle()
    # Nor does a gap leave anything behind.
    time.sleep(1.0)
    assert listener.settle()
    listener.clear()
    listener.play(healthy(500)[1])
    for name in ("imu_1", "imu_2"):
        assert wait(lambda name=name: listener.status(f"input {name}").message == "delivers")
        assert listener.status(f"input {name}").level == DiagnosticStatus.OK


def test_a_clock_far_from_now_is_named(listener) -> None:
    listener.play(healthy(20)[1])
    # The time begins anew when both units agree on it.
    start, z = time.time_ns() - 3600 * 10**9, healthy(1100)[1]
    z[300:, 4] += 0.3

    def send(rows: range) -> None:
        for k in rows:
            for j in (0, 1):
                listener.send_imu(j, start + k * 4_000_000, z[k, 3 * j : 3 * j + 3].tolist())
            time.sleep(0.004)

    send(range(300))
    assert listener.says("input imu_1", "behind the clock")
    assert wait(lambda: len(listener.fused) > 250)
    late = [ImuSource.parse(data, 3)[0] for data in listener.fused[-200:]]
    assert late == sorted(set(late))
    assert abs(late[-1] - start) < 10e9
    send(range(300, 1100))
    assert listener.says("imu_2.y", "isolated")
    # Since when: a stamp of the messages, which went back.
    since = listener.value("imu_2.y", "state since (stamp, s)")
    assert abs(float(since) - start / 1e9) < 10


def test_stamps_that_are_not_set_are_one_warning(tmp_path) -> None:
    with monitoring(TWO_IMUS, tmp_path, prime=False) as (listener, process):
        for _ in range(100):
            for j in (0, 1):
                listener.send_imu(j, 0, [0.0, 0.0, 0.0])
            time.sleep(0.004)
        assert listener.says("input imu_1", "stamps are not set")
        warned = [line for line in process.said().splitlines() if "stamps are not set" in line]
        assert ["[WARN]" in line for line in warned] == [True, True]
        assert "/imu_1/data_raw: stamps are not set" in warned[0]
