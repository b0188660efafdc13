# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A picture of a running monitor, made of what it publishes, wherever it runs and whatever its topics are mapped to."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node, NodeNameNonExistentError
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from sensor_msgs.msg import Imu

from fdi_ros.errors import FdiError
from fdi_ros.monitor.diagnostics import INPUT, WHOLE, Level, StatusLine
from fdi_ros.monitor.output import ChannelState
from fdi_ros.ros.messages import read_diagnostics
from fdi_ros.system.limits import LINE
from fdi_ros.system.text import shown

SERVICE = "/relearn_bias"  # a node with this service is a monitor: it is there before the node is configured
SETTLE = 1.0
"""Monitors make themselves known one after the other: wait for so long before one is taken for the only one, s."""
STATES = tuple(state.name for state in ChannelState)
DEEP = QoSProfile(depth=200, reliability=ReliabilityPolicy.BEST_EFFORT)
SILENT = {"fused": 1.0, "diagnostics": 3.0}
"""After so long without a message the last one is no longer shown as the present state, s."""
REMEMBERED = 50  # changes of state


class Change(NamedTuple):
    """Channels that changed state alike; when: s since 1970."""

    at: float
    level: Level
    words: str


@dataclass
class Picture:
    """What a monitor has published so far; the figures are those of the last message of each kind."""

    monitor: str = ""  # full name of the node
    caption: str = ""  # what else is to be known, above all; empty: nothing
    waiting: str = "looking for a monitor"  # what is waited for; empty: nothing
    since: float = field(default_factory=time.monotonic)  # when waiting for it began, s, monotonic clock
    whole: StatusLine = field(default_factory=lambda: StatusLine(Level.STALE, WHOLE, ""))
    channels: Mapping[str, StatusLine] = field(default_factory=dict)  # by name
    inputs: Sequence[StatusLine] = ()
    rate: tuple[float, float, float] | None = None  # fused rate, rad/s
    heard: dict[str, float] = field(default_factory=dict)  # when the last message of each kind came, s, monotonic clock
    changes: deque[Change] = field(default_factory=lambda: deque(maxlen=REMEMBERED))
    changed: int = 0  # how many changes there were
    ignored: int = 0  # messages that no monitor sends: nothing was taken from them
    ignored_why: str = ""  # why the last of them

    def is_silent(self, kind: str) -> bool:
        """Whether messages of a kind have stopped, or never came."""
        return time.monotonic() - self.heard.get(kind, -math.inf) > SILENT[kind]

    @property
    def evidence(self) -> tuple[float, float] | None:
        """Statistic and threshold; None: no sample is judged now."""
        found = self.whole.number("statistic"), self.whole.number("threshold")
        is_stale = self.whole.level == Level.STALE or self.is_silent("diagnostics")
        return None if is_stale or not math.isfinite(found[0]) or not found[1] > 0 else found

    def format_ignored(self) -> str:
        """Say how many messages were ignored and why the last one was; empty: none."""
        some = f"{self.ignored} message{'s' if self.ignored > 1 else ''} ignored"
        return shown(f"{some}: {self.ignored_why}", LINE) if self.ignored else ""

    def update_channels(self, channels: Mapping[str, StatusLine]) -> None:
        """Keep the present channels and remember which changed state."""
        moves: dict[tuple[Level, str], list[str]] = {}
        for name, line in channels.items():
            before, state = self.channels[name].value("state") if name in self.channels else "", line.value("state")
            if state != before:
                why = f": {line.message}" if state != "OK" and line.message else ""
                words = f"{before} -> {state}{why}" if before else f"{state}{why}"
                moves.setdefault((line.level, words), []).append(name)
        self.channels = channels
        self.changed += len(moves)
        for (level, words), names in moves.items():
            who = "all" if len(names) == len(channels) else ", ".join(names)
            self.changes.append(Change(time.time(), level, shown(f"{who}  {words}", LINE)))


class Watcher(Node):
    """Finds a monitor and keeps a picture of it; without the full name of a node, of the only one there is."""

    def __init__(self, monitor: str = "", name: str = "fdi_watch") -> None:
        super().__init__(name, start_parameter_services=False)
        self.picture = Picture(monitor)
        self._callbacks = {Imu: self._on_fused, DiagnosticArray: self._on_diagnostics}
        self._heard_on: dict[type, Subscription[Any]] = {}  # by message type; empty: nothing is listened to yet
        self._found = math.inf

    def look(self) -> None:
        """Look for a monitor and listen to it; `FdiError` if there are several and none is named."""
        picture = self.picture
        before, picture.monitor = picture.waiting, picture.monitor or self._choose()
        if picture.monitor:
            picture.waiting = self._listen(picture.monitor)
        else:
            picture.waiting = f"waiting for a monitor (fdi_node) on ROS_DOMAIN_ID {self.context.get_domain_id()}"
        if picture.waiting != before:
            picture.since = time.monotonic()

    def _choose(self) -> str:
        services = self.get_service_names_and_types()
        there = sorted(name[: -len(SERVICE)] for name, _ in services if name.endswith(SERVICE))
        now = time.monotonic()
        self._found = min(self._found, now) if there else math.inf
        if not there or now - self._found < SETTLE:
            return ""
        if len(there) > 1:
            names = shown(", ".join(there), LINE)
            raise FdiError(f"{len(there)} monitors are running: choose with --node one of {names}")
        return there[0]

    def _listen(self, monitor: str) -> str:
        """Listen to a monitor if it is there; return what is waited for, empty: nothing."""
        # Anew each time: after a restart it may publish elsewhere. Others publish on the same topics, as on
        # /diagnostics: that a topic has a publisher proves nothing.
        namespace, _, name = monitor.rpartition("/")
        try:
            published = self.get_publisher_names_and_types_by_node(name, namespace or "/")
        except NodeNameNonExistentError:
            # One that comes back has published nothing yet.
            self.picture.heard.clear()
            if self._heard_on:
                return f"{monitor} is gone: waiting for it to come back"
            return f"waiting for {monitor} on ROS_DOMAIN_ID {self.context.get_domain_id()}"
        topics = {
            kind: topic
            for topic, kinds in published
            for kind in self._callbacks
            if kinds[0].endswith(f"/{kind.__name__}")
        }
        if len(topics) < len(self._callbacks):
            return f"{monitor} is not configured: waiting for a lifecycle manager to do it"
        if topics != {kind: one.topic_name for kind, one in self._heard_on.items()}:
            for one in self._heard_on.values():
                self.destroy_subscription(one)
            self._heard_on = {
                kind: self.create_subscription(kind, topics[kind], callback, DEEP)
                for kind, callback in self._callbacks.items()
            }
        if self.picture.is_silent("diagnostics"):
            # DDS goes on listing one that was killed for a while.
            silent = f"{monitor} is silent: it was killed or hangs; " if "diagnostics" in self.picture.heard else ""
            return f"{silent}waiting for diagnostics of {monitor} on {topics[DiagnosticArray]}"
        whole = self.picture.whole
        return f"waiting for the first sample: {whole.message}" if whole.value("samples") == "0" else ""

    def _ignore(self, message: object, why: str) -> None:
        """Count a message that no monitor sends, and remember why."""
        self.picture.ignored += 1
        self.picture.ignored_why = f"{self._heard_on[type(message)].topic_name}: {why}"

    def _on_fused(self, message: Imu) -> None:
        rate = message.angular_velocity
        if not all(map(math.isfinite, (rate.x, rate.y, rate.z))):
            self._ignore(message, "a rate that is not finite")
            return
        self.picture.rate = (rate.x, rate.y, rate.z)
        self.picture.heard["fused"] = time.monotonic()

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        try:
            found = read_diagnostics(message, self.picture.monitor)
        except ValueError as error:
            self._ignore(message, str(error))
            return
        channels = {line.name: line for line in found if line.value("state")}
        wrong = next((state for line in channels.values() if (state := line.value("state")) not in STATES), "")
        if wrong:
            self._ignore(message, f"state {wrong!r}, expected one of {', '.join(STATES)}")
        elif found:
            picture = self.picture
            picture.whole = next((line for line in found if line.name == WHOLE), picture.whole)
            picture.inputs = [
                line._replace(name=line.name.removeprefix(INPUT)) for line in found if line.name.startswith(INPUT)
            ]
            picture.update_channels(channels or picture.channels)
            picture.heard["diagnostics"] = time.monotonic()
