# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What keeps an executor's queue short in a flood, and inputs that are one topic."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator

import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2")

import rclpy
import rclpy.executors
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription
from ros.harness import DEEP, TWO_IMUS, Process, healthy, listening, parameter_file, wait
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger

from fdi_ros.core.messages import ImuTemplate
from fdi_ros.core.states import ChannelState
from fdi_ros.ros.inputs import DEPTH, FLOOD, FLOOD_END_TIME, LONGEST, InputQueue
from fdi_ros.ros.process import replace_executor


class Taker(Node):
    """Takes the messages of one topic."""

    def __init__(self, context: rclpy.Context) -> None:
        self.inputs = InputQueue(self)
        self.got: list[bytes] = []
        super().__init__("taker", context=context)
        self.inputs.open(Imu, "flooded", self.got.append)

    @property
    def subscriptions(self) -> Iterator[Subscription]:
        return self.inputs.visible(super().subscriptions)


@pytest.fixture
def flooded() -> Iterator[tuple[rclpy.Context, Taker, Node, Publisher]]:
    """A taker, a node that publishes to it, and what it publishes with."""
    context = rclpy.Context()
    rclpy.init(context=context)
    node, source = Taker(context), rclpy.create_node("source", context=context)
    yield context, node, source, source.create_publisher(Imu, "flooded", DEEP)
    node.destroy_node()
    source.destroy_node()
    rclpy.shutdown(context=context)


def test_a_flood_is_polled_and_then_taken_by_events_again(flooded) -> None:
    experimental = pytest.importorskip("rclpy.experimental", reason="no EventsExecutor here")
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    context, node, source, output = flooded
    executor = experimental.EventsExecutor(context=context)
    executor.add_node(node)
    message = ImuTemplate("imu").fill(0, (0.0, 0.0, 0.0), (0.0,) * 9)

    node.create_service(Trigger, "asked", lambda _, response: response)
    client, requests = source.create_client(Trigger, "asked"), []
    assert client.wait_for_service(10.0)
    by_event = 0

    def turn() -> bool:
        nonlocal by_event, executor
        executor.spin_once(timeout_sec=0.01)
        by_event += node.inputs.taken
        if node.inputs.turn(executor, time.monotonic(), bounded=False):
            # Announced to the executor, and then behind all that waits in its queue.
            requests.append(client.call_async(Trigger.Request()))
            time.sleep(0.2)
            executor = replace_executor(node, executor)
        return True

    def burst(count: int) -> bool:
        for _ in range(count):
            output.publish(message)
        return turn()

    try:
        (queued,) = node.inputs.subscriptions
        assert wait(lambda: burst(1) and by_event)
        assert not node.inputs.flooded
        # More in a turn than a turn uses up: each message leaves an event behind.
        assert wait(lambda: burst(DEPTH // 2) and node.inputs.flooded)
        assert len(node.got) > FLOOD
        # Before another turn, in which the flood may be over: nobody knows how long a turn takes on a busy machine.
        assert queued not in list(node.subscriptions)
        listening = rclpy.executors.SingleThreadedExecutor(context=context)
        listening.add_node(source)
        assert wait(lambda: listening.spin_once(0.01) or (turn() and requests[0].done()), 5.0)
        requests.append(client.call_async(Trigger.Request()))
        assert wait(lambda: listening.spin_once(0.01) or (turn() and requests[1].done()), 5.0)
        taken, got = by_event, len(node.got)
        assert wait(lambda: burst(1) and len(node.got) > got)
        assert wait(lambda: turn() and not node.inputs.flooded, 5 * FLOOD_END_TIME)
        assert wait(lambda: burst(1) and by_event > taken)
    finally:
        executor.shutdown()
        for number, handler in zip((signal.SIGINT, signal.SIGTERM), before, strict=True):
            signal.signal(number, handler)


def test_what_takes_long_is_taken_in_parts_and_in_order(flooded) -> None:
    """Reports and requests do not wait for all of it."""
    _, node, _, output = flooded
    (one,) = node.inputs.subscriptions

    def work(data: bytes) -> None:
        time.sleep(LONGEST / 4)
        node.got.append(data)

    node.inputs.subscriptions[one] = work
    assert wait(output.get_subscription_count)
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
