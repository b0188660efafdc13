# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What keeps an executor's queue short in a flood, and inputs that are one topic."""

from __future__ import annotations

import signal
import time

import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2")

from rclpy.executors import SingleThreadedExecutor
from ros.harness import TWO_IMUS, Process, healthy, listening, parameter_file, wait
from std_srvs.srv import Trigger

from fdi_ros.core.decision import ChannelState
from fdi_ros.core.messages import ImuTemplate
from fdi_ros.ros import node as node_module
from fdi_ros.ros.node import DEPTH, FLOOD, LONGEST, CheckedNode
from fdi_ros.ros.process import replace_executor


@pytest.fixture
def flooded():
    """A listener that publishes on a topic, and a node that takes the messages of it."""
    with listening(("flooded",)) as listener:
        node = CheckedNode("taker", {}, subscribes=False)
        node.got = []
        node.inputs.open("sensor_msgs/msg/Imu", "flooded", node.got.append)
        assert wait(listener.outputs[0].get_subscription_count)
        yield listener, node
        node.destroy_node()


def test_a_flood_is_polled_and_then_taken_by_events_again(flooded, monkeypatch) -> None:
    monkeypatch.setattr(node_module, "FLOOD_TIME", 1.0)
    experimental = pytest.importorskip("rclpy.experimental", reason="no EventsExecutor here")
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    listener, node = flooded
    node.create_service(Trigger, "asked", lambda _, response: response)
    client = listener.create_client(Trigger, "asked")
    assert client.wait_for_service(10.0)
    executor, by_event = experimental.EventsExecutor(context=node.context), 0
    executor.add_node(node)

    def turn(count: int = 0) -> None:
        """One turn of the node's executor, after so many messages."""
        nonlocal by_event, executor
        for _ in range(count):
            listener.send_imu(0, 0, (0.0, 0.0, 0.0))
        executor.spin_once(timeout_sec=0.01)
        by_event += node.inputs.taken
        was_flooded = node.inputs.flooded
        node.inputs.turn(time.monotonic())
        if node.inputs.flooded != was_flooded:
            # What is announced to one executor is answered by the other.
            requests.append(client.call_async(Trigger.Request()))
            time.sleep(0.2)
            executor = replace_executor(node, executor, not was_flooded)

    requests = []
    try:
        assert wait(lambda: turn(1) or by_event)
        assert not node.inputs.flooded
        # More in a turn than a turn uses up: each message leaves an event behind.
        assert wait(lambda: turn(DEPTH // 2) or node.inputs.flooded)
        assert len(node.got) > FLOOD
        assert isinstance(executor, SingleThreadedExecutor)
        got = len(node.got)
        assert wait(lambda: turn(1) or (len(node.got) > got and requests[0].done()))
        assert wait(lambda: turn() or not node.inputs.flooded)
        taken = by_event
        assert wait(lambda: turn(1) or (by_event > taken and requests[1].done()))
    finally:
        executor.shutdown()
        for number, handler in zip((signal.SIGINT, signal.SIGTERM), before, strict=True):
            signal.signal(number, handler)


def test_what_takes_long_is_taken_in_parts_and_in_order(flooded) -> None:
    """Reports and requests do not wait for all of it."""
    listener, node = flooded
    (one,), (output,) = node.inputs.subscriptions, listener.outputs

    def work(data: bytes) -> None:
        time.sleep(LONGEST / 4)
        node.got.append(data)

    node.inputs.subscriptions[one] = work
    template = ImuTemplate("imu")
    sent = [bytes(template.fill(k, (0.0, 0.0, 0.0), (0.0,) * 9)) for k in range(20)]
    # Until one has come no other is sent: the first are lost while the two find each other.
    assert wait(lambda: output.publish(sent[0]) or node.inputs.drain() or node.got)
    assert wait(lambda: not node.inputs.drain())
    node.got.clear()
    for data in sent:
        output.publish(data)
    parts = []
    while len(node.got) < len(sent) and len(parts) < 100_000:
        parts.append(node.inputs.drain())
    assert node.got == sent
    assert max(parts) <= 5


def test_two_inputs_on_one_topic_are_named_and_are_no_redundancy(tmp_path, compiled) -> None:
    file = parameter_file(TWO_IMUS, tmp_path)
    with listening(TWO_IMUS.topics) as listener:
        remapped = ("-r", "imu_2/data_raw:=imu_1/data_raw")
        process = Process("fdi_node", "--ros-args", "--params-file", str(file), *remapped)
        try:
            assert wait(lambda: listener.outputs[0].get_subscription_count() > 1), process.said()
            listener.play(healthy(1250)[1], triads=(0,))
            assert listener.says("monitor", "(imu_1/data_raw) and imu_2 (imu_2/data_raw) give the same values")
            assert listener.says("input imu_2", "imu_2 and imu_1 read the same topic /imu_1/data_raw")
            assert listener.says("imu_2.x", "one sensor, no redundancy")
            assert wait(lambda: (listener.states()[-1][3:] == ChannelState.UNCHECKED).all())
        finally:
            process.end()
