# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Monitors that no other test has taught anything: in a module of their own, where no other node stands."""

from __future__ import annotations

import time

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2")

from rclpy.serialization import deserialize_message
from ros.harness import SIGMA, TWO_IMUS, monitoring, sound, wait, warmed
from sensor_msgs.msg import Imu

from fdi_ros.core.alignment import Alignment
from fdi_ros.sources.imus import ImuSource


def test_the_fused_message_is_complete(tmp_path) -> None:
    # By a monitor that no other test has taught anything.
    with monitoring(TWO_IMUS, tmp_path) as (listener, _):
        assert listener.settle()
        listener.clear()
        # A second of motion, which shows the delay.
        stamps = listener.play(sound(250)[1])
        assert wait(lambda: listener.fused and ImuSource.parse(listener.fused[-1], 3)[0] == stamps[-1])
        message = deserialize_message(listener.fused[-1], Imu)
    assert message.header.frame_id == "base_link"
    assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == stamps[-1]
    assert message.orientation_covariance[0] == message.linear_acceleration_covariance[0] == -1.0
    covariance = np.array(message.angular_velocity_covariance).reshape(3, 3)
    # Two triads: half the variance of one, and what is not known of bias, scale and delay in motion.
    assert (np.diag(covariance) > 0.8 * SIGMA**2 / 2).all()
    assert (np.diag(covariance) < 4.0 * SIGMA**2 / 2).all()
    assert (np.linalg.eigvalsh(covariance) > 0).all()


def test_the_live_node_says_what_the_pipeline_says_of_the_same_stream(tmp_path) -> None:
    # By a node of its own, as what the default learns of noise and delays outlives a reset.
    alike = TWO_IMUS.replaced({"detector.name": "likelihood_ratio"})
    z = sound(400, 5)[1]
    z[150:, 4] += 0.05
    with monitoring(alike, tmp_path) as (listener, _):
        assert listener.settle()
        time.sleep(0.1)
        listener.clear()
        stamps = listener.play(z, skew=300_000)
        assert wait(lambda: len(listener.fused) == 400)
        states, rates = listener.states(), listener.rates()
    aligner = Alignment(2, 2_000_000, 300_000_000)
    block = aligner.push_block(
        np.tile([0, 1], 400), np.column_stack([stamps, stamps + 300_000]).reshape(-1), z.reshape(-1, 3)
    )
    output = warmed(alike, int(stamps[0])).process(block)
    assert block.stamp.tolist() == stamps.tolist()
    np.testing.assert_array_equal(states, output.state)
    assert [rates[stamp] for stamp in stamps.tolist()] == list(map(tuple, output.rate.tolist()))
