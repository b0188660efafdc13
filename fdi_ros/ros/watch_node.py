# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Subscribes to what a running monitor publishes, wherever it runs and whatever its topics are mapped to."""

from __future__ import annotations

import math
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node, NodeNameNonExistentError
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from sensor_msgs.msg import Imu
from std_msgs.msg import Float64MultiArray

from fdi_ros.compiling.record import MAX_CHANNELS
from fdi_ros.errors import FdiError
from fdi_ros.monitor.diagnostics import INPUT, WHOLE, Level
from fdi_ros.monitor.output import ChannelState
from fdi_ros.ros.watch_view import Channel, Input, Picture
from fdi_ros.system.limits import LINE
from fdi_ros.system.text import shown

SERVICE = "/relearn_bias"
"""A node with this service is a monitor: it is there before the node is configured."""
SETTLE = 1.0
"""Monitors make themselves known one after the other: wait for so long before one is taken for the only one, s."""
FIRST, LAST = 2, 3
"""Numbers of the integrity before the states, statistic and threshold, and after them, the protection level."""
STATES = {state.name: state for state in ChannelState}
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
        self._callbacks: dict[str, tuple[type, Any]] = {
            "Imu": (Imu, self._on_fused),
            "Float64MultiArray": (Float64MultiArray, self._on_integrity),
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
        return "" if "integrity" in self.picture.heard else f"waiting for the first sample: {self.picture.whole}"

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

    def _heard(self, kind: str) -> None:
        self.picture.heard[kind] = time.monotonic()

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
        self._heard("fused")

    def _on_integrity(self, message: Float64MultiArray) -> None:
        picture, count = self.picture, len(message.data) - FIRST - LAST
        if not 0 < count <= MAX_CHANNELS:
            expected = f"{FIRST + LAST + 1} to {FIRST + LAST + MAX_CHANNELS}"
            self._ignore("Float64MultiArray", f"{len(message.data)} numbers, expected {expected}")
            return
        picture.statistic, picture.threshold = message.data[:FIRST]
        picture.level = tuple(message.data[-LAST:])
        self._heard("integrity")

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        # All nodes publish there: those of the monitor have its name, "drone/fdi_node: ...".
        prefix = f"{self.picture.monitor.strip('/')}: "
        found = [status for status in message.status if status.name.startswith(prefix)]
        if not found:
            return
        for status in found:
            if status.level not in LEVELS:
                self._ignore("DiagnosticArray", f"level {ord(status.level)}, expected 0 to {max(Level)}")
                return
        picture, channels, inputs = self.picture, {}, []
        for status in found:
            name, values = status.name.removeprefix(prefix), {value.key: value.value for value in status.values}
            if name == WHOLE:
                picture.whole, picture.whole_level = status.message, LEVELS[status.level]
                picture.figures = values
            elif name.startswith(INPUT):
                rate = values.get("rate (Hz)", "?")
                inputs.append(Input(name.removeprefix(INPUT), LEVELS[status.level], status.message, rate))
            elif (state := values.get("state")) in STATES:
                channels[name] = _channel(status, values)
            elif state is not None:
                self._ignore("DiagnosticArray", f"state {state!r}, expected one of {', '.join(STATES)}")
                return
        picture.inputs = inputs
        picture.update_channels(channels or picture.channels)
        self._heard("diagnostics")


def _channel(status: DiagnosticStatus, values: dict[str, str]) -> Channel:
    since, residual, bias, bias_std = (
        _number(values.get(key, ""))
        for key in ("state since (stamp, s)", "residual (rad/s)", "bias (rad/s)", "bias known to (rad/s)")
    )
    level = LEVELS[status.level]
    return Channel(STATES[values["state"]], level, status.message, since, residual, bias, bias_std)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
