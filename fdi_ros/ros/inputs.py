# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Input topics: subscriptions to raw messages, the queue they are drained through, and the status of each topic.

Messages may come from anywhere. What does not fit is counted and reported, costs no more than its header, and never
stops the node.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from fdi_ros.core.path import NEVER
from fdi_ros.monitor.diagnostics import InputStatus
from fdi_ros.monitor.receiver import Receiver, Watchdog
from fdi_ros.system.limits import LINE
from fdi_ros.system.text import shown

DEPTH = 256
"""Messages kept for a node that is busy for a moment: a quarter of a second at 1 kHz."""
LONGEST = 0.05
"""Others get their turn after so long, whatever waits, s: reports and requests do not wait for a flood."""
ARRIVES = 0.1
"""A topic on which the last check but one found no message is silent, s."""
FLOOD = 5000
"""Events that may wait in the queue of an executor: some 50 ms of its work, 1 MB."""
FLOOD_END_RATE = 10_000.0
"""Messages per second below which a flood is over: all that IMUs send."""
NAMED = 4
"""Publishers of one topic that are named at most."""
FLOOD_END_TIME = 1.0
"""Time over which they are counted, s."""


def input_qos() -> QoSProfile:
    """Return the QoS of an input; a new one each time, as overrides are written into it."""
    return QoSProfile(reliability=ReliabilityPolicy.BEST_EFFORT, history=HistoryPolicy.KEEP_LAST, depth=DEPTH)


class RawSubscription:
    """A subscription to the bytes of the messages of a topic, which can also be polled for what has arrived."""

    def __init__(self, node: Node, kind: type, topic: str, take: Callable[[bytes], None], queue: InputQueue) -> None:
        overriding = QoSOverridingOptions.with_default_policies()
        self.take = take
        self.subscription = node.create_subscription(
            kind, topic, self._take, input_qos(), qos_overriding_options=overriding, raw=True
        )
        self._queue = queue

    def _take(self, data: bytes) -> None:
        self._queue.taken += 1
        self.take(data)

    def next(self) -> tuple[int, bytes] | None:
        """Take a message out of the queue: when it arrived, ns, and its bytes."""
        handle = self.subscription.handle
        with handle:
            message = handle.take_message(self.subscription.msg_type, True)
        return None if message is None else (message[1]["received_timestamp"], message[0])


def drain(subscriptions: Sequence[RawSubscription]) -> int:
    """Take what waits in all queues, in the order in which it arrived, and return how many messages that were.

    What is not taken within `LONGEST`, or is more than two queues hold, stays for the next time.

    An executor comes back after every message, which costs more than the message; asking an empty queue costs half a
    microsecond.
    """
    taken, end = 0, time.monotonic() + LONGEST
    heads = [one.next() for one in subscriptions]
    while waiting := [(head[0], k, head[1]) for k, head in enumerate(heads) if head is not None]:
        _, k, data = min(waiting)
        heads[k] = subscriptions[k].next() if taken < 2 * DEPTH and time.monotonic() < end else None
        taken += 1
        subscriptions[k].take(data)
    return taken


class InputQueue:
    """The raw subscriptions of a node: drained after every turn of the executor, and bounded in a flood.

    The EventsExecutor keeps an event for every message that arrives, without bound, also for those that were drained
    or that DDS has dropped: a flood costs memory without end, and timers wait behind it. So once too many events must
    be waiting, a new executor with an empty queue takes over. These subscriptions are hidden from it (`visible`) and
    only drained, in short turns, until the flood is over.
    """

    def __init__(self, node: Node) -> None:
        self.subscriptions: list[RawSubscription] = []
        self.flooded = False
        self.taken = 0
        """Messages that came by an event of the executor in this turn."""
        self._node = node
        self._waiting = 0
        """Events of messages that were drained."""
        self._count, self._since, self._full = 0, 0.0, False
        """In a flood: messages since when, s, and whether a queue was full."""

    def open(self, kind: type, topic: str, take: Callable[[bytes], None]) -> RawSubscription:
        """Subscribe to a topic."""
        self.subscriptions.append(RawSubscription(self._node, kind, topic, take, self))
        return self.subscriptions[-1]

    @property
    def is_open(self) -> bool:
        """Whether any topic is subscribed to."""
        return bool(self.subscriptions)

    def close(self) -> None:
        """Close all subscriptions."""
        for one in self.subscriptions:
            self._node.destroy_subscription(one.subscription)
        self.subscriptions, self.flooded, self._waiting = [], False, 0

    def drain(self) -> None:
        """Take what waits."""
        if self.subscriptions:
            self._count += (drained := drain(self.subscriptions))
            self._waiting += drained
            self._full |= drained >= DEPTH

    def turn(self, executor: Any, now: float, bounded: bool) -> bool:
        """Drain after a turn of the executor, at the steady time now, s.

        Parameters
        ----------
        executor
            To be woken when the subscriptions are visible to it again.
        now
            Steady time, s.
        bounded
            Whether the executor needs no help against floods.

        Returns
        -------
        Whether a new executor is to take over.
        """
        self.drain()
        if bounded or not self.subscriptions:
            return False
        if self.flooded:
            if now - self._since >= FLOOD_END_TIME:
                over = self._count < FLOOD_END_RATE * (now - self._since) and not self._full
                self._count, self._since, self._full = 0, now, False
                if over:
                    self._change(flooded=False)
                    executor.wake()
            return False
        if self._waiting and not self.taken:
            # The turn has used up the event of a message that was drained, or was a timer's.
            self._waiting -= 1
        self.taken = 0
        if self._waiting <= FLOOD:
            return False
        self._count, self._since, self._full = 0, now, False
        self._change(flooded=True)
        return True

    def _change(self, flooded: bool) -> None:
        self.flooded, self._waiting, self.taken = flooded, 0, 0
        words = "flooded with messages: inputs are polled until it is over" if flooded else "the flood is over"
        self._node.get_logger().warning(words, throttle_duration_sec=10.0)

    def visible(self, subscriptions: Iterator[Any]) -> Iterator[Any]:
        """Return those of a node's subscriptions that its executor is to wait for."""
        hidden = {id(one.subscription) for one in self.subscriptions} if self.flooded else set()
        return (one for one in subscriptions if id(one) not in hidden)


class InputTopic:
    """Status of one input topic."""

    def __init__(self, receiver: Receiver, number: int, topic: str) -> None:
        self.topic = topic
        self.was_heard = False
        """Whether there was a message at the last check."""
        self.was_unstamped = False
        """Whether it had no stamps at a check before."""
        self.sources = ""
        """What is wrong with who publishes on it; see `find_sources`."""
        self.name = receiver.source.names[number]
        self.watchdog = Watchdog(round(receiver.source.timeout * 1e9))
        self._receiver = receiver
        self._number = number
        self._max_lag = receiver.source.max_lag
        self._reported_at = self._reported_messages = 0
        self._reported_counts: dict[str, int] = {}
        self._rate = 0.0

    @property
    def received(self) -> int:
        """Messages so far."""
        return int(self._inlet["received"])

    @property
    def is_unstamped(self) -> bool:
        """Whether its messages have headers without a stamp: one may be of 0 s, not several."""
        return self._inlet["stamp"] == 0 and self._receiver.counts(self._number).get("duplicate", 0) > 0

    def status(self, now: int) -> InputStatus:
        """Describe the topic at the clock time now, ns."""
        counts, inlet = self._receiver.counts(self._number), self._inlet
        stamp, lag = int(inlet["stamp"]), int(inlet["lag"])
        return InputStatus(
            name=self.name,
            topic=self.topic,
            received=self.received,
            rate=self._rate,
            silent=self.watchdog.seconds(now) if self.received else None,
            live=self._receiver.is_live(self._number) and not self.watchdog.silent,
            arrives=self.watchdog.seconds(now) < ARRIVES,
            lag=max(lag, 0) / 1e9,
            max_lag=self._max_lag,
            offset=None if stamp == NEVER else (self.watchdog.at - stamp) / 1e9,
            counts=counts,
            recent={kind: count - self._reported_counts.get(kind, 0) for kind, count in counts.items()},
            error=self._receiver.errors[self._number],
            unstamped=self.is_unstamped,
            parted=self._receiver.are_parted,
            sources=self.sources,
        )

    def find_sources(self, node: Node, inputs: Sequence[InputTopic]) -> str:
        """Say whether more than one publisher is on the topic, or an input before it reads the same one."""
        first = next(one for one in inputs if one.topic == self.topic)
        if first is not self:
            return f"{self.name} and {first.name} read the same topic {self.topic}"
        publishers = node.get_publishers_info_by_topic(self.topic)
        if len(publishers) < 2:
            return ""
        names = [f"{one.node_namespace.rstrip('/')}/{one.node_name}" for one in publishers[:NAMED]]
        return shown(f"{len(publishers)} publishers on {self.topic}, expected one: {', '.join(sorted(names))}", LINE)

    def reported(self, now: int) -> None:
        """Begin to count anew what is recent, at the clock time now, ns."""
        messages, before = self.received - self._reported_messages, self._reported_at
        self._rate = 1e9 * messages / (now - before) if before and now > before else 0.0
        self._reported_at, self._reported_messages = now, self.received
        self._reported_counts = self._receiver.counts(self._number)
        self._inlet["lag"] = NEVER

    @property
    def _inlet(self) -> dict[str, int]:
        inlet: dict[str, int] = self._receiver.live["inlets"][0, self._number]
        return inlet
