"""Listens to what a running monitor publishes, wherever it runs and whatever its topics are mapped to."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu
from std_msgs.msg import Float64MultiArray

from fdi_ros.errors import FdiError
from fdi_ros.monitor.diagnostics import Level
from fdi_ros.monitor.output import ChannelState
from fdi_ros.ros.watch_view import Input, Picture

SERVICE = "/relearn_bias"
"""A node with this service is a monitor: it is there before the node is configured."""
SETTLE = 1.0
"""Monitors make themselves known one after the other: wait for so long before one is taken for the only one, s."""
LEFT = 3
"""Numbers of the integrity after the states: the protection level."""
DEEP = QoSProfile(depth=200, reliability=ReliabilityPolicy.BEST_EFFORT)


class WatchError(FdiError):
    """There is nothing that can be watched."""


class Watcher(Node):
    """Finds a monitor and keeps a picture of it.

    Parameters
    ----------
    monitor
        Full name of the node, ``/drone/fdi_node``; empty: the only one there is.
    name
        Of this node.
    """

    def __init__(self, monitor: str = "", name: str = "fdi_watch") -> None:
        super().__init__(name, start_parameter_services=False)
        self.picture = Picture(monitor)
        self._topics: dict[str, str] = {}
        """By message type; empty: not connected yet."""
        self._found = math.inf

    def look(self) -> None:
        """Look who is there; once a monitor has been found, listen to it.

        Raises
        ------
        WatchError
            If there are several monitors and none is named.
        """
        before = self.picture.waiting
        self._look()
        if self.picture.waiting != before:
            self.picture.since = time.monotonic()

    def _look(self) -> None:
        monitor = self.picture.monitor or self._choose()
        if not monitor:
            return
        if not self._topics:
            self._connect(monitor)
        elif not any(self.count_publishers(topic) for topic in self._topics.values()):
            self.picture.waiting = f"{monitor} is gone: waiting for it to come back"
        elif self.picture.is_silent("diagnostics"):
            self.picture.waiting = f"waiting for diagnostics of {monitor} on {self._topics['DiagnosticArray']}"
        else:
            self.picture.waiting = "" if self.picture.states else f"waiting for the first sample: {self.picture.whole}"

    def _choose(self) -> str:
        services = self.get_service_names_and_types()
        there = sorted(name[: -len(SERVICE)] for name, _ in services if name.endswith(SERVICE))
        now = time.monotonic()
        self._found = min(self._found, now) if there else math.inf
        if not there or now - self._found < SETTLE:
            self.picture.waiting = f"waiting for a monitor (fdi_node) on ROS_DOMAIN_ID {self.context.get_domain_id()}"
            return ""
        if len(there) > 1:
            raise WatchError(f"{len(there)} monitors are running: choose with --node one of {', '.join(there)}")
        self.picture.monitor = there[0]
        return there[0]

    def _connect(self, monitor: str) -> None:
        namespace, _, name = monitor.rpartition("/")
        if (name, namespace or "/") not in self.get_node_names_and_namespaces():
            self.picture.waiting = f"waiting for {monitor} on ROS_DOMAIN_ID {self.context.get_domain_id()}"
            return
        published = self.get_publisher_names_and_types_by_node(name, namespace or "/")
        takers: dict[str, tuple[type, Any]] = {
            "Imu": (Imu, self._on_fused),
            "Float64MultiArray": (Float64MultiArray, self._on_integrity),
            "DiagnosticArray": (DiagnosticArray, self._on_diagnostics),
        }
        topics = {kind: topic for topic, kinds in published for kind in takers if kinds[0].endswith(f"/{kind}")}
        if len(topics) < len(takers):
            self.picture.waiting = f"{monitor} is not configured: waiting for a lifecycle manager to do it"
            return
        self._topics = topics
        for kind, (message, take) in takers.items():
            self.create_subscription(message, topics[kind], take, DEEP)

    def _on_fused(self, message: Imu) -> None:
        stamp, rate = message.header.stamp, message.angular_velocity
        self.picture.rate = (rate.x, rate.y, rate.z)
        self._heard("fused")
        self.took_rate(stamp.sec * 10**9 + stamp.nanosec, self.picture.rate)

    def took_rate(self, stamp: int, rate: tuple[float, float, float]) -> None:
        """Do something with a fused rate, rad/s, at its stamp, ns."""

    def _on_integrity(self, message: Float64MultiArray) -> None:
        picture = self.picture
        picture.statistic, picture.threshold, *numbers = message.data[:-LEFT]
        picture.level = tuple(message.data[-LEFT:])
        self._heard("integrity")
        before = picture.states
        picture.take_states([ChannelState(int(number)) for number in numbers])
        if picture.states != before:
            self.took_states(before, picture.states)

    def took_states(self, before: Sequence[ChannelState], after: Sequence[ChannelState]) -> None:
        """Do something with the states of all channels, when they have changed."""

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        own = [status for status in message.status if self._is_of_monitor(status)]
        if not own:
            return
        picture = self.picture
        names = []
        inputs = []
        for status in own:
            name = status.name.rpartition(": ")[2]
            values = {value.key: value.value for value in status.values}
            if name == "monitor":
                picture.whole, picture.whole_level = status.message, Level(ord(status.level))
                picture.figures = values
            elif "residual (rad/s)" in values:
                names.append(name)
                picture.words[name] = (values.get("state", ""), status.message)
                picture.residuals[name] = _number(values["residual (rad/s)"])
            elif "topic" in values:
                rate = values.get("rate (Hz)", "?")
                inputs.append(Input(name.removeprefix("input "), Level(ord(status.level)), status.message, rate))
        picture.names, picture.inputs = tuple(names) or picture.names, inputs
        self._heard("diagnostics")
        picture.find_words()

    def _is_of_monitor(self, status: DiagnosticStatus) -> bool:
        """Whether a status is of the monitor that is watched, by its name: "drone/fdi_node: ..."."""
        return status.name.partition(": ")[0] == self.picture.monitor.strip("/")

    def _heard(self, kind: str) -> None:
        self.picture.heard[kind] = time.monotonic()


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
