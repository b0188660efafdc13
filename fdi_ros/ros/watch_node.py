# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Subscribes to what a running monitor publishes, wherever it runs and whatever its topics are mapped to."""

from __future__ import annotations

import math
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node, NodeNameNonExistentError
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from sensor_msgs.msg import Imu

from fdi_ros.errors import FdiError
from fdi_ros.monitor.diagnostics import INPUT, WHOLE
from fdi_ros.monitor.output import ChannelState
from fdi_ros.ros.messages import read_diagnostics
from fdi_ros.ros.watch_view import Picture
from fdi_ros.system.limits import LINE
from fdi_ros.system.text import shown

SERVICE = "/relearn_bias"
"""A node with this service is a monitor: it is there before the node is configured."""
SETTLE = 1.0
"""Monitors make themselves known one after the other: wait for so long before one is taken for the only one, s."""
STATES = tuple(state.name for state in ChannelState)
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
        self._callbacks: dict[str, tuple[type, Any]] = {
            "Imu": (Imu, self._on_fused),
            "DiagnosticArray": (DiagnosticArray, self._on_diagnostics),
        }
        """By message type."""
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
        monitor = self.picture.monitor or self._choose()
        if monitor:
            self.picture.waiting = self._listen(monitor)
        if self.picture.waiting != before:
            self.picture.since = time.monotonic()

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

    def _listen(self, monitor: str) -> str:
        """Listen to a monitor if it is there; return what is waited for, empty: nothing."""
        # Anew each time: after a restart it may publish elsewhere.
        topics = self._published(monitor)
        if topics is None:
            # One that comes back has published nothing yet.
            self.picture.heard.clear()
            if self._topics:
                return f"{monitor} is gone: waiting for it to come back"
            return f"waiting for {monitor} on ROS_DOMAIN_ID {self.context.get_domain_id()}"
        if len(topics) < len(self._callbacks):
            return f"{monitor} is not configured: waiting for a lifecycle manager to do it"
        if topics != self._topics:
            self._connect(topics)
        if self.picture.is_silent("diagnostics"):
            # DDS goes on listing one that was killed for a while.
            silent = f"{monitor} is silent: it was killed or hangs; " if "diagnostics" in self.picture.heard else ""
            return f"{silent}waiting for diagnostics of {monitor} on {topics['DiagnosticArray']}"
        whole = self.picture.whole
        return f"waiting for the first sample: {whole.message}" if whole.value("samples") == "0" else ""

    def _published(self, monitor: str) -> dict[str, str] | None:
        """Topics of the monitor itself by message type; None: it is not there.

        Others publish on the same topics, as on /diagnostics: that a topic has a publisher proves nothing.
        """
        namespace, _, name = monitor.rpartition("/")
        try:
            published = self.get_publisher_names_and_types_by_node(name, namespace or "/")
        except NodeNameNonExistentError:
            return None
        return {kind: topic for topic, kinds in published for kind in self._callbacks if kinds[0].endswith(f"/{kind}")}

    def _connect(self, topics: dict[str, str]) -> None:
        for subscription in self._heard_on:
            self.destroy_subscription(subscription)
        self._topics = topics
        self._heard_on = [
            self.create_subscription(message, topics[kind], callback, DEEP)
            for kind, (message, callback) in self._callbacks.items()
        ]

    def _ignore(self, kind: str, why: str) -> None:
        """Count a message that no monitor sends, and remember why."""
        self.picture.ignored += 1
        self.picture.ignored_why = f"{self._topics[kind]}: {why}"

    def _on_fused(self, message: Imu) -> None:
        rate = message.angular_velocity
        if not all(map(math.isfinite, (rate.x, rate.y, rate.z))):
            self._ignore("Imu", "a rate that is not finite")
            return
        self.picture.rate = (rate.x, rate.y, rate.z)
        self.picture.heard["fused"] = time.monotonic()

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        try:
            found = read_diagnostics(message, self.picture.monitor)
        except ValueError as error:
            self._ignore("DiagnosticArray", str(error))
            return
        channels = {line.name: line for line in found if line.value("state")}
        wrong = next((state for line in channels.values() if (state := line.value("state")) not in STATES), "")
        if wrong:
            self._ignore("DiagnosticArray", f"state {wrong!r}, expected one of {', '.join(STATES)}")
        elif found:
            picture = self.picture
            picture.whole = next((line for line in found if line.name == WHOLE), picture.whole)
            picture.inputs = [
                line._replace(name=line.name.removeprefix(INPUT)) for line in found if line.name.startswith(INPUT)
            ]
            picture.update_channels(channels or picture.channels)
            picture.heard["diagnostics"] = time.monotonic()
