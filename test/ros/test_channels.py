# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""All channels in one array, stamped on arrival."""

from __future__ import annotations

import time

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2")

from builtin_interfaces.msg import Time
from ros.harness import GEOMETRY, RATE, SIGMA, TWO_IMUS, monitoring, sound, wait, warmed
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64MultiArray

from fdi_ros.model.block import Block
from fdi_ros.sources.imus import ImuSource


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
        omega, z = sound(300)
        z[150:, 4] += 0.3
        for k, values in enumerate(z.tolist()):
            listener.send_channels(values)
            if k == 100:
                for wrong in ([1.0] * 5, [1.0] * 7, [], [0.0] * 10_000):
                    listener.outputs[0].publish(Float64MultiArray(data=wrong))
            time.sleep(1 / RATE)
        assert wait(lambda: len(listener.fused) == 300), len(listener.fused)
        stamps = [ImuSource.parse(data, 3)[0] for data in listener.fused]
        assert stamps == sorted(set(stamps))
        rates = np.array(list(listener.rates().values()))
        error = np.abs(rates - omega).max(axis=1)
        # Stamped when they come, which a busy machine makes uneven: in the first moments it may be open who is wrong.
        assert np.delete(error, np.s_[150:225]).max() < 6 * 1.5 * SIGMA
        assert error.max() < 0.3 / 2
        assert listener.says("g5", "isolated")
        assert wait(lambda: {v.key: v.value for v in listener.status("input gyros").values}["malformed"] == "4")
        output = warmed(config, stamps[0]).process(Block(np.array(stamps), z))
        # Nor does the monitor that was warmed up here know as much of its gyros to the last bit.
        known = np.r_[:150, 225:300]
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
