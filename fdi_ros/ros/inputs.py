# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Input topics: subscriptions to raw messages, the queue they are drained through, and the status of each topic.

Messages may come from anywhere. What does not fit is counted and reported, costs no more than its header, and never
stops the node.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription

from fdi_ros.core.path import NEVER
from fdi_ros.monitor.diagnostics import InputStatus
from fdi_ros.monitor.receiver import Receiver, Watchdog
from fdi_ros.ros.messages import BoundedLog
from fdi_ros.system.limits import LINE
from fdi_ros.system.text import shown

DEPTH = 256  # messages kept for a node that is busy for a moment: a quarter of a second at 1 kHz
LONGEST = 0.05  # others get their turn after so long, whatever waits, s: reports and requests do not wait for a flood
ARRIVES = 0.1  # a topic on which the last check but one found no message is silent, s
FLOOD = 5000  # events that may wait in the queue of an executor: some 50 ms of its work, 1 MB
FLOOD_TIME = 5.0  # so long after a flood has begun it is not looked whether it is over, s
NAMED = 4  # publishers of one topic that are named at most


class InputQueue:
    """The subscriptions of a node to raw messages: drained after every turn of the executor, and watched for a flood.

    An executor comes back after every message, which costs more than the message; asking an empty queue costs half a
    microsecond. But the EventsExecutor keeps an event for every message that arrives, without bound, also for those
    that were drained or that DDS has dropped: a flood costs memory without end, and timers wait behind it. So once too
    many events must be waiting, another kind of executor is to take over for some seconds.
    """

    def __init__(self, node: Node) -> None:
        self.subscriptions: dict[Subscription[Any], Callable[[bytes], None]] = {}  # each with what takes its messages
        self.flooded = False
        self.taken = 0  # messages that came by an event of the executor in this turn
        self._node = node
        self._waiting = 0  # events of messages that were drained
        self._until = 0.0  # until when it counts as flooded, steady time, s

    def open(self, kind: type, topic: str, take: Callable[[bytes], None]) -> None:
        """Subscribe to the bytes of the messages of a topic."""

        def take_event(data: bytes) -> None:
            self.taken += 1
            self.subscriptions[subscription](data)

        # A new QoS each time, as overrides are written into it.
        qos = QoSProfile(reliability=ReliabilityPolicy.BEST_EFFORT, history=HistoryPolicy.KEEP_LAST, depth=DEPTH)
        overriding = QoSOverridingOptions.with_default_policies()
        subscription = self._node.create_subscription(
            kind, topic, take_event, qos, qos_overriding_options=overriding, raw=True
        )
        self.subscriptions[subscription] = take

    def close(self) -> None:
        """Close all subscriptions."""
        for one in self.subscriptions:
            self._node.destroy_subscription(one)
        self.subscriptions, self.flooded, self._waiting = {}, False, 0

    def drain(self) -> int:
        """Take what waits, in the order in which it arrived, and return how many messages that were.

        What is not taken within `LONGEST`, or is more than two queues hold, stays for the next time.
        """
        takers = list(self.subscriptions.items())
        taken, end = 0, time.monotonic() + LONGEST
        heads = [_next(one) for one, _ in takers]
        while waiting := [(head[0], k, head[1]) for k, head in enumerate(heads) if head is not None]:
            _, k, data = min(waiting)
            subscription, take = takers[k]
            heads[k] = _next(subscription) if taken < 2 * DEPTH and time.monotonic() < end else None
            taken += 1
            take(data)
        self._waiting += taken
        return taken

    def turn(self, now: float) -> None:
        """Take what waits after a turn of an executor, at the steady time now, s, and see whether it is a flood."""
        self.drain()
        if self._waiting and not self.taken:
            # The turn has used up the event of a message that was drained, or was a timer's.
            self._waiting -= 1
        self.taken = 0
        if not self.flooded and self._waiting > FLOOD:
            self.flooded, self._until = True, now + FLOOD_TIME
            self._node.get_logger().warning(
                "flooded with messages: inputs are polled while it lasts", throttle_duration_sec=10.0
            )
        elif self.flooded and now >= self._until:
            self.flooded, self._waiting = False, 0


def _next(subscription: Subscription[Any]) -> tuple[int, bytes] | None:
    """Take a message out of the queue: when it arrived, ns, and its bytes."""
    with subscription.handle:
        message = subscription.handle.take_message(subscription.msg_type, True)
    return None if message is None else (message[1]["received_timestamp"], message[0])


class InputTopic:
    """Status of one input topic of a monitor; number: among the topics of the receiver."""

    def __init__(self, receiver: Receiver, number: int, topic: str) -> None:
        self.topic = topic
        self._receiver, self._number = receiver, number
        self._name = receiver.source.names[number]
        self._watchdog = Watchdog(round(receiver.source.timeout * 1e9))
        self._was_heard = self._was_unstamped = False
        self._sources = ""  # what is wrong with who publishes on it; empty: nothing
        self._rate, self._reported_at, self._reported_messages = 0.0, 0, 0
        self._reported_counts: dict[str, int] = {}

    @property
    def _inlet(self) -> Any:
        return self._receiver.live["inlets"][0, self._number]

    @property
    def _received(self) -> int:
        return int(self._inlet["received"])

    @property
    def _is_unstamped(self) -> bool:
        # One may be of 0 s, not several.
        return self._inlet["stamp"] == 0 and self._receiver.counts(self._number).get("duplicate", 0) > 0

    def status(self, now: int) -> InputStatus:
        """Describe the topic at the clock time now, ns."""
        counts, receiver, watchdog = self._receiver.counts(self._number), self._receiver, self._watchdog
        stamp, lag = int(self._inlet["stamp"]), int(self._inlet["lag"])
        return InputStatus(
            name=self._name,
            topic=self.topic,
            received=self._received,
            rate=self._rate,
            silent=watchdog.seconds(now) if self._received else None,
            live=receiver.is_live(self._number) and not watchdog.silent,
            arrives=watchdog.seconds(now) < ARRIVES,
            lag=max(lag, 0) / 1e9,
            max_lag=receiver.source.max_lag,
            offset=None if stamp == NEVER else (watchdog.at - stamp) / 1e9,
            counts=counts,
            recent={kind: count - self._reported_counts.get(kind, 0) for kind, count in counts.items()},
            error=receiver.errors[self._number],
            unstamped=self._is_unstamped,
            parted=receiver.are_parted,
            sources=self._sources,
        )

    def check(self, now: int, log: BoundedLog) -> bool:
        """Log what is new at the clock time now, ns; return whether the topic fell silent, or came back."""
        changed = self._watchdog.check(self._received, now)
        if changed and not self._watchdog.silent:
            log.info(f"{self._name}: messages on {self.topic}{' again' if self._was_heard else ''}")
        elif changed and not self._received:
            log.warning(f"{self._name}: no message yet on {self.topic}")
        elif changed:
            log.error(f"{self._name}: no message on {self.topic}")
        self._was_heard |= self._received > 0
        if self._is_unstamped and not self._was_unstamped:
            self._was_unstamped = True
            log.warning(f"{self.topic}: stamps are not set")
        return changed

    def check_sources(self, node: Node, inputs: Sequence[InputTopic], log: BoundedLog) -> None:
        """Log when more than one publisher comes to be on the topic, or an input before it reads the same one."""
        before, self._sources = self._sources, ""
        first = next(one for one in inputs if one.topic == self.topic)
        if first is not self:
            self._sources = f"{self._name} and {first._name} read the same topic {self.topic}"
        elif len(found := node.get_publishers_info_by_topic(self.topic)) > 1:
            names = sorted(f"{one.node_namespace.rstrip('/')}/{one.node_name}" for one in found[:NAMED])
            self._sources = shown(f"{len(found)} publishers on {self.topic}, expected one: {', '.join(names)}", LINE)
        if self._sources and self._sources != before:
            log.warning(self._sources)

    def count_anew(self, now: int) -> None:
        """Begin to count anew what is recent, at the clock time now, ns."""
        messages, before = self._received - self._reported_messages, self._reported_at
        self._rate = 1e9 * messages / (now - before) if before and now > before else 0.0
        self._reported_at, self._reported_messages = now, self._received
        self._reported_counts = self._receiver.counts(self._number)
        self._inlet["lag"] = NEVER
