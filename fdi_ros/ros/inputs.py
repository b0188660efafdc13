"""Input topics: raw messages in, samples out, and all that was wrong with them counted.

Messages come from anybody. What does not fit is counted and named, costs no more than its header, and never stops
the node.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

from rclpy.clock import Clock
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import Imu
from std_msgs.msg import Float64MultiArray

from fdi_ros.cdr import MessageError, read_channels, read_imu
from fdi_ros.config import Config
from fdi_ros.monitor.alignment import Aligner, Sample
from fdi_ros.monitor.diagnostics import InputStatus

DEPTH = 256
"""Messages kept for a node that is busy for a moment: a quarter of a second at 1 kHz."""
INPUT_QOS = QoSProfile(reliability=ReliabilityPolicy.BEST_EFFORT, history=HistoryPolicy.KEEP_LAST, depth=DEPTH)
ARRIVES = 0.1
"""A topic on which the last look but one found no message is silent, s."""
STEP_BACK = 100_000_000
"""A clock set back by more than this is followed, ns; less is waited out."""

Deliver = Callable[[Sample], None]


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

    An executor comes back after every message. Who is behind would work sample by sample, at the full cost of each,
    and stay behind with full queues. Asking an empty queue costs half a microsecond.
    """
    heads = [inlet.next() for inlet in inlets]
    while any(heads):
        _, k = min((head[0], k) for k, head in enumerate(heads) if head is not None)
        head, heads[k] = heads[k], inlets[k].next() if limit > 0 else None
        limit -= 1
        assert head is not None
        inlets[k].take(head[1])


class Silence:
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
    """One input topic, and what is counted of it."""

    def __init__(self, name: str, topic: str, timeout: int) -> None:
        self.name = name
        self.topic = topic
        self.received = 0
        self.malformed = 0
        self.error = ""
        self.stamp: int | None = None
        """Of the last message, ns; None where messages carry none."""
        self.lag: int | None = None
        """Least lag behind the other inputs since the last regular report, ns."""
        self.silence = Silence(timeout)
        self._report = (0, 0, dict[str, int]())
        self._rate = 0.0

    def refuse(self, error: MessageError) -> None:
        """Count a message that is none."""
        self.malformed += 1
        self.error = str(error)

    def status(self, now: int, counts: dict[str, int], live: bool, max_lag: float) -> InputStatus:
        """Describe the topic at the clock time now, ns."""
        counts = {"malformed": self.malformed, **counts}
        recent = {kind: count - self._report[2].get(kind, 0) for kind, count in counts.items()}
        return InputStatus(
            name=self.name,
            topic=self.topic,
            received=self.received,
            rate=self._rate,
            silent=self.silence.seconds(now) if self.received else None,
            live=live and not self.silence.silent,
            arrives=self.silence.seconds(now) < ARRIVES,
            lag=(self.lag or 0) / 1e9,
            max_lag=max_lag,
            offset=None if self.stamp is None else (self.silence.at - self.stamp) / 1e9,
            counts=counts,
            recent=recent,
            error=self.error,
        )

    def reported(self, now: int, counts: dict[str, int]) -> None:
        """Begin to count anew what is recent."""
        received, before, _ = self._report
        self._rate = 1e9 * (self.received - received) / (now - before) if before and now > before else 0.0
        self._report = (self.received, now, {"malformed": self.malformed, **counts})
        self.lag = None


class ChannelsInput:
    """One std_msgs/Float64MultiArray of all channels a sample, stamped when it arrives.

    Parameters
    ----------
    clock
        Stamps the samples.
    config
        Settings.
    channels
        Number of values expected.
    deliver
        Takes each sample.
    """

    def __init__(self, clock: Clock, config: Config, channels: int, deliver: Deliver) -> None:
        self._clock = clock
        self._channels = channels
        self._deliver = deliver
        self._last = 0
        self._shift = 0
        self.restarts = 0
        topic = config.channels.topic
        self.topics = (Topic(topic, topic, round(config.health.stale_timeout * 1e9)),)

    def subscribe(self, node: Node) -> list[Inlet]:
        """Begin to listen; what was learned of the time of the samples stays from before."""
        return [Inlet(node, Float64MultiArray, topic.topic, self._take) for topic in self.topics]

    def _take(self, data: bytes) -> None:
        (topic,) = self.topics
        topic.received += 1
        try:
            values = read_channels(data, self._channels)
        except MessageError as error:
            topic.refuse(error)
            return
        now = self._clock.now().nanoseconds + self._shift
        if now <= self._last:
            if self._last - now > STEP_BACK:
                self._shift += self._last - now
                self.restarts += 1
            now = self._last + 1
        self._last = now
        self._deliver(Sample(now, list(values), None, self._shift))

    def statuses(self, now: int) -> list[InputStatus]:
        """Describe the topic at the clock time now, ns."""
        return [topic.status(now, {}, True, math.inf) for topic in self.topics]

    def reported(self, now: int) -> None:
        """Begin to count anew what is recent."""
        for topic in self.topics:
            topic.reported(now, {})


class ImusInput:
    """One sensor_msgs/Imu topic a triad, aligned by their stamps.

    Parameters
    ----------
    config
        Settings.
    channels
        Three a triad.
    deliver
        Takes each sample.
    """

    def __init__(self, config: Config, channels: int, deliver: Deliver) -> None:
        timeout = round(config.imus.timeout * 1e9)
        self._deliver = deliver
        self._max_lag = config.imus.max_skew
        self.aligner = Aligner(channels // 3, round(config.imus.max_skew * 1e9), timeout)
        pairs = zip(config.imu_names, config.imus.topics, strict=True)
        self.topics = tuple(Topic(name, topic, timeout) for name, topic in pairs)

    def subscribe(self, node: Node) -> list[Inlet]:
        """Begin to listen; what was learned of the time of the samples stays from before."""
        return [
            Inlet(node, Imu, topic.topic, partial(self._take, triad, topic)) for triad, topic in enumerate(self.topics)
        ]

    @property
    def restarts(self) -> int:
        """How often the time of all inputs began anew."""
        return self.aligner.base.restarts

    def _take(self, triad: int, topic: Topic, data: bytes) -> None:
        topic.received += 1
        try:
            topic.stamp, rate = read_imu(data)
        except MessageError as error:
            topic.refuse(error)
            return
        for sample in self.aligner.push(triad, topic.stamp, rate):
            self._deliver(sample)
        lag = self.aligner.base.lag[triad]
        if topic.lag is None or lag < topic.lag:
            topic.lag = lag

    def statuses(self, now: int) -> list[InputStatus]:
        """Describe each topic at the clock time now, ns."""
        return [
            topic.status(now, self._counts(triad), self.aligner.is_live(triad), self._max_lag)
            for triad, topic in enumerate(self.topics)
        ]

    def reported(self, now: int) -> None:
        """Begin to count anew what is recent."""
        for triad, topic in enumerate(self.topics):
            topic.reported(now, self._counts(triad))

    def _counts(self, triad: int) -> dict[str, int]:
        counts = self.aligner.counters[triad].as_dict()
        del counts["received"]
        return counts


Input = ChannelsInput | ImusInput
