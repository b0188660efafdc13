"""Input topics: raw messages in, and what an operator is told of each topic.

Messages may come from anywhere. What does not fit is counted and named, costs no more than its header, and never stops
the node.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from fdi_ros.config import Config
from fdi_ros.core.live import NEVER
from fdi_ros.monitor.diagnostics import InputStatus
from fdi_ros.monitor.receiver import Receiver

DEPTH = 256
"""Messages kept for a node that is busy for a moment: a quarter of a second at 1 kHz."""
INPUT_QOS = QoSProfile(reliability=ReliabilityPolicy.BEST_EFFORT, history=HistoryPolicy.KEEP_LAST, depth=DEPTH)
ARRIVES = 0.1
"""A topic on which the last look but one found no message is silent, s."""


class Inlet:
    """A subscription to the bytes of the messages of a topic, which can also be asked for what has arrived."""

    def __init__(self, node: Node, kind: type, topic: str, take: Callable[[bytes], None]) -> None:
        overriding = QoSOverridingOptions.with_default_policies()
        self.take = take
        self.subscription = node.create_subscription(
            kind, topic, take, INPUT_QOS, qos_overriding_options=overriding, raw=True
        )

    def next(self) -> tuple[int, bytes] | None:
        """Take a message out of the queue: when it arrived, ns, and its bytes."""
        handle = self.subscription.handle
        with handle:
            message = handle.take_message(self.subscription.msg_type, True)
        return None if message is None else (message[1]["received_timestamp"], message[0])


def drain(inlets: Sequence[Inlet], limit: int = 2 * DEPTH) -> None:
    """Take what waits in all queues, in the order in which it arrived.

    An executor comes back after every message, which costs more than the message; asking an empty queue costs half a
    microsecond.
    """
    heads = [inlet.next() for inlet in inlets]
    while any(heads):
        _, k = min((head[0], k) for k, head in enumerate(heads) if head is not None)
        head, heads[k] = heads[k], inlets[k].next() if limit > 0 else None
        limit -= 1
        assert head is not None
        inlets[k].take(head[1])


class Watchdog:
    """Whether something that counts up has stood still for longer than a timeout, ns, by the clock."""

    def __init__(self, timeout: int) -> None:
        self.timeout = timeout
        self.silent = False
        self.at = 0
        """Clock time at which it last moved, to the precision of the looks, ns."""
        self._count = -1

    def look(self, count: int, now: int) -> bool:
        """Look at the count at the clock time now, ns; True if silence began or ended."""
        # A clock that went back, or was not running at the last look, tells nothing of the time between.
        if count != self._count or now < self.at or not self.at:
            self._count, self.at = count, now
        before, self.silent = self.silent, now - self.at > self.timeout
        return self.silent != before

    def seconds(self, now: int) -> float:
        """How long it has stood still, s."""
        return max(0, now - self.at) / 1e9


class Topic:
    """One input topic as an operator sees it.

    Parameters
    ----------
    receiver
        Takes its messages.
    number
        Of the topic.
    config
        Settings.
    """

    def __init__(self, receiver: Receiver, number: int, config: Config) -> None:
        imus = config.input == "imus"
        self.topic = config.topics[number]
        self.name = config.imu_names[number] if imus else self.topic
        self.watchdog = Watchdog(round((config.imus.timeout if imus else config.health.stale_timeout) * 1e9))
        self._receiver = receiver
        self._number = number
        self._max_lag = config.imus.max_skew if imus else math.inf
        self._reported_at = self._reported_messages = 0
        self._reported_counts: dict[str, int] = {}
        self._rate = 0.0

    @property
    def received(self) -> int:
        """Messages so far."""
        return int(self._inlet["received"])

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
        )

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
