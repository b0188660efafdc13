# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Subscribes to what a running monitor publishes, wherever it runs and whatever its topics are mapped to."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node, NodeNameNonExistentError
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from sensor_msgs.msg import Imu
from std_msgs.msg import Float64MultiArray

from fdi_ros.compiling.record import MAX_CHANNELS
from fdi_ros.errors import FdiError
from fdi_ros.limits import LINE
from fdi_ros.monitor.diagnostics import Level
from fdi_ros.monitor.output import ChannelState
from fdi_ros.ros.watch_view import Input, Picture
from fdi_ros.text import shown

SERVICE = "/relearn_bias"
"""A node with this service is a monitor: it is there before the node is configured."""
SETTLE = 1.0
"""Monitors make themselves known one after the other: wait for so long before one is taken for the only one, s."""
FIRST, LEFT = 2, 3
"""Numbers of the integrity before the states, statistic and threshold, and after them, the protection level."""
STATES = frozenset(map(int, ChannelState))
LEVELS = {bytes([level]): level for level in Level}
"""As a message carries them."""
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
        """By message type, those that are listened to; empty: none yet."""
        self._heard_on: list[Subscription[Any]] = []
        self._found = math.inf

    def look(self) -> None:
        """Look for a monitor; once it has been found, listen to it.

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
        # Anew each time: after a restart it may publish elsewhere.
        topics = self._published(monitor)
        if topics is None:
            gone = f"{monitor} is gone: waiting for it to come back"
            alone = f"waiting for {monitor} on ROS_DOMAIN_ID {self.context.get_domain_id()}"
            self.picture.waiting = gone if self._topics else alone
            # One that comes back has published nothing yet.
            self.picture.heard.clear()
        elif len(topics) < len(self._takers()):
            self.picture.waiting = f"{monitor} is not configured: waiting for a lifecycle manager to do it"
        else:
            if topics != self._topics:
                self._connect(topics)
            self.picture.waiting = self._missing(monitor)

    def _missing(self, monitor: str) -> str:
        """Say which messages of a monitor that is there do not come; empty: none."""
        if self.picture.is_silent("diagnostics"):
            # DDS goes on listing one that was killed for a while.
            silent = f"{monitor} is silent: it was killed or hangs; " if "diagnostics" in self.picture.heard else ""
            return f"{silent}waiting for diagnostics of {monitor} on {self._topics['DiagnosticArray']}"
        return "" if self.picture.states else f"waiting for the first sample: {self.picture.whole}"

    def _choose(self) -> str:
        services = self.get_service_names_and_types()
        there = sorted(name[: -len(SERVICE)] for name, _ in services if name.endswith(SERVICE))
        now = time.monotonic()
        self._found = min(self._found, now) if there else math.inf
        if not there or now - self._found < SETTLE:
            self.picture.waiting = f"waiting for a monitor (fdi_node) on ROS_DOMAIN_ID {self.context.get_domain_id()}"
            return ""
        if len(there) > 1:
            names = shown(", ".join(there), LINE)
            raise WatchError(f"{len(there)} monitors are running: choose with --node one of {names}")
        self.picture.monitor = there[0]
        return there[0]

    def _published(self, monitor: str) -> dict[str, str] | None:
        """Topics of the monitor itself by message type; None: it is not there.

        Others publish on the same topics, as on /diagnostics: that a topic has a publisher proves nothing.
        """
        namespace, _, name = monitor.rpartition("/")
        try:
            published = self.get_publisher_names_and_types_by_node(name, namespace or "/")
        except NodeNameNonExistentError:
            return None
        return {kind: topic for topic, kinds in published for kind in self._takers() if kinds[0].endswith(f"/{kind}")}

    def _takers(self) -> dict[str, tuple[type, Any]]:
        return {
            "Imu": (Imu, self._on_fused),
            "Float64MultiArray": (Float64MultiArray, self._on_integrity),
            "DiagnosticArray": (DiagnosticArray, self._on_diagnostics),
        }

    def _connect(self, topics: dict[str, str]) -> None:
        for subscription in self._heard_on:
            self.destroy_subscription(subscription)
        self._topics = topics
        self._heard_on = [
            self.create_subscription(message, topics[kind], take, DEEP)
            for kind, (message, take) in self._takers().items()
        ]

    def _ignore(self, kind: str, why: str) -> None:
        """Count a message that no monitor sends, and remember why."""
        self.picture.ignored += 1
        self.picture.ignored_why = f"{self._topics[kind]}: {why}"

    def _on_fused(self, message: Imu) -> None:
        stamp, rate = message.header.stamp, message.angular_velocity
        if not all(map(math.isfinite, (rate.x, rate.y, rate.z))):
            self._ignore("Imu", "a rate that is not finite")
            return
        self.picture.rate = (rate.x, rate.y, rate.z)
        self._heard("fused")
        self.took_rate(stamp.sec * 10**9 + stamp.nanosec, self.picture.rate)

    def took_rate(self, stamp: int, rate: tuple[float, float, float]) -> None:
        """Do something with a fused rate, rad/s, at its stamp, ns."""

    def _on_integrity(self, message: Float64MultiArray) -> None:
        picture, count = self.picture, len(message.data) - FIRST - LEFT
        if not 0 < count <= MAX_CHANNELS:
            expected = f"{FIRST + LEFT + 1} to {FIRST + LEFT + MAX_CHANNELS}"
            self._ignore("Float64MultiArray", f"{len(message.data)} numbers, expected {expected}")
            return
        numbers = message.data[FIRST:-LEFT]
        odd = [number for number in numbers if number not in STATES]
        if odd:
            self._ignore("Float64MultiArray", f"state {odd[0]:g}, expected 0 to {max(STATES)}")
            return
        picture.statistic, picture.threshold = message.data[:FIRST]
        picture.level = tuple(message.data[-LEFT:])
        self._heard("integrity")
        before = picture.states
        picture.take_states([ChannelState(number) for number in numbers])
        if picture.states != before:
            self.took_states(before, picture.states)

    def took_states(self, before: Sequence[ChannelState], after: Sequence[ChannelState]) -> None:
        """Do something with the states of all channels, when they have changed."""

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        own = [status for status in message.status if self._is_of_monitor(status)]
        if not own:
            return
        odd = [ord(status.level) for status in own if status.level not in LEVELS]
        if odd:
            self._ignore("DiagnosticArray", f"level {odd[0]}, expected 0 to {max(Level)}")
            return
        picture = self.picture
        names = []
        inputs = []
        for status in own:
            name = status.name.rpartition(": ")[2]
            values = {value.key: value.value for value in status.values}
            if name == "monitor":
                picture.whole, picture.whole_level = status.message, LEVELS[status.level]
                picture.figures = values
            elif "residual (rad/s)" in values:
                names.append(name)
                picture.words[name] = (values.get("state", ""), status.message)
                picture.residuals[name] = _number(values["residual (rad/s)"])
                known = (_number(values.get(key, "none")) for key in ("bias (rad/s)", "bias known to (rad/s)"))
                picture.biases[name] = next(known), next(known)
            elif "topic" in values:
                rate = values.get("rate (Hz)", "?")
                inputs.append(Input(name.removeprefix("input "), LEVELS[status.level], status.message, rate))
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
