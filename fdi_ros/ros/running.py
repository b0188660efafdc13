# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What exists only while the node is configured: monitor, outputs and supervision, and the path of a message."""

from __future__ import annotations

import time
from functools import partial

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node

from fdi_ros.core.live import HAS_EVENTS, HAS_RATE, MALFORMED, MORE, SUPPLY, WORKED
from fdi_ros.core.messages import LAST_STAMP
from fdi_ros.monitor.receiver import Receiver
from fdi_ros.monitor.state_file import StateFile
from fdi_ros.ros.inputs import InputQueue
from fdi_ros.ros.messages import Publishers, message_class
from fdi_ros.ros.supervision import Supervisor

REMEMBERED = 4096
"""Samples whose latency is remembered."""


class Latency:
    """Times from the arrival of a message to the publication of its sample, of the last samples."""

    def __init__(self) -> None:
        self._times: NDArray[np.int64] = np.zeros(REMEMBERED, dtype=np.int64)
        self._count = 0

    def add(self, nanoseconds: int) -> None:
        """Take the time of one sample, ns."""
        self._times[self._count % REMEMBERED] = nanoseconds
        self._count += 1

    def percentiles(self) -> tuple[float, float]:
        """Median and 99th percentile, ms; zeros before the first sample."""
        known = self._times[: min(self._count, REMEMBERED)]
        if not len(known):
            return 0.0, 0.0
        median, late = np.percentile(known, (50, 99), method="lower") / 1e6
        return float(median), float(late)


class Running:
    """A configured monitor.

    Parameters
    ----------
    node
        Subscribes and publishes.
    queue
        Of its inputs.
    receiver
        The monitor.
    state_file
        Of the monitor, if it has one.
    """

    def __init__(self, node: Node, queue: InputQueue, receiver: Receiver, state_file: StateFile | None) -> None:
        self.publishers = Publishers(node)
        self.latency = Latency()
        self._node, self._queue, self._state_file = node, queue, state_file
        self.start(receiver)

    def start(self, receiver: Receiver) -> None:
        """Run a monitor from now on, its first or another one."""
        self.receiver = receiver
        self.supervisor = Supervisor(
            *(self._node, self._queue, receiver, self.publishers),
            latency=self.latency.percentiles,
            state_file=self._state_file,
        )

    def listen(self) -> None:
        """Subscribe to the input topics."""
        source = self.receiver.source
        kind, take = message_class(source.type), self._take if source.stamped else self._take_arrived
        for k, topic in enumerate(source.topics):
            self._queue.open(kind, topic, partial(take, k))

    def destroy(self) -> None:
        """Take the output topics down."""
        self.publishers.destroy()

    def _take(self, inlet: int, data: bytes) -> None:
        begun = time.perf_counter_ns()
        result = self.receiver.take(inlet, data)
        if result:
            self._publish(result, begun, inlet, data)

    def _take_arrived(self, inlet: int, data: bytes) -> None:
        begun = time.perf_counter_ns()
        # The clock of a simulator may have any time: what the header of a message cannot hold is its end.
        result = self.receiver.take(inlet, data, min(self._node.get_clock().now().nanoseconds, LAST_STAMP))
        if result:
            self._publish(result, begun, inlet, data)

    def _publish(self, result: int, begun: int, inlet: int, data: bytes) -> None:
        """Publish what a message has brought, and go on with all samples that it completes."""
        receiver, publishers = self.receiver, self.publishers
        while result:
            if result & SUPPLY:
                receiver.supply()
            if result & HAS_RATE:
                publishers.fused.publish(receiver.fused.tobytes())
            if result & WORKED:
                if publishers.has_integrity_subscriber:
                    publishers.integrity.publish(receiver.integrity.tobytes())
                self.latency.add(time.perf_counter_ns() - begun)
            if result & HAS_EVENTS:
                self.supervisor.report_events(receiver.events)
            if result & MALFORMED:
                receiver.refused(inlet, data)
            result = receiver.go_on() if result & MORE else 0
