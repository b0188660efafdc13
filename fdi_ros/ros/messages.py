# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a node says: its topics, with QoS and classes of messages, and its log, bounded whatever causes it."""

from __future__ import annotations

import importlib
import logging
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy

from fdi_ros.errors import FdiError
from fdi_ros.monitor.diagnostics import DIAGNOSTICS, Level, StatusLine
from fdi_ros.monitor.output import OUTPUTS
from fdi_ros.system.limits import LINE
from fdi_ros.system.text import shown

DEPTH = 256
"""Messages kept until they are sent: after a moment of waiting many are worked at once, and a writer that keeps fewer
drops some."""
REPORT_PERIOD = 1.0  # from one regular report of a node to the next, s
OVERRIDABLE = tuple(output.topic.name for output in OUTPUTS)  # topics whose QoS may be overridden


def output_qos() -> QoSProfile:
    """Return the QoS of sensor data as REP-2003 wants it published: reliable, for subscribers of either kind.

    A new one each time, as overrides are written into it.
    """
    return QoSProfile(reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_LAST, depth=DEPTH)


def diagnostics_publisher(node: Node) -> Any:
    """Publish diagnostics; they are handed over as bytes."""
    return node.create_publisher(message_class(DIAGNOSTICS.type), DIAGNOSTICS.name, QoSProfile(depth=10))


def read_diagnostics(message: Any, node: str) -> list[StatusLine]:
    """Return what a node, by its full name, says in a message of /diagnostics, where all speak.

    The names are without that of the node. `ValueError` if a level is none.
    """
    prefix = f"{node.strip('/')}: "
    found = []
    for status in message.status:
        if status.name.startswith(prefix):
            level = ord(status.level)
            if level > max(Level):
                raise ValueError(f"level {level}, expected 0 to {max(Level)}")
            values = tuple((pair.key, pair.value) for pair in status.values)
            name = status.name.removeprefix(prefix)
            found.append(StatusLine(Level(level), name, status.message, status.hardware_id, values))
    return found


def message_class(name: str) -> Any:
    """Return the class of a message type, ``sensor_msgs/msg/Imu``; `FdiError` if its package is not installed."""
    package, _, kind = name.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), kind)
    except ImportError as error:
        raise FdiError(f"messages of type {name} need the ROS package {package}: {error}") from error


def prefix_of(node: Node) -> str:
    """Return what the names of a node's statuses begin with: no two nodes of a system have the same."""
    return f"{node.get_fully_qualified_name().lstrip('/')}: "


MOST = 20  # lines of one severity in one period: what anybody may cause with requests hides no declaration
PERIOD = 1.0  # s


class BoundedLog(logging.Handler):
    """Logs so many lines a second at most, each of bounded length, and says how many were left out."""

    def __init__(self, logger: Any, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._logger, self._clock = logger, clock
        self._since = clock()
        self._lines: Counter[str] = Counter()
        self._left_out = 0

    # The logger of ROS refuses another severity from the same line of code.
    def info(self, words: str) -> None:
        """Log what is as it should be."""
        if self._has_room("info"):
            self._logger.info(shown(words, LINE))

    def warning(self, words: str) -> None:
        """Log what somebody should know of."""
        if self._has_room("warning"):
            self._logger.warning(shown(words, LINE))

    def error(self, words: str) -> None:
        """Log what somebody should act on."""
        if self._has_room("error"):
            self._logger.error(shown(words, LINE))

    def begin_period(self) -> None:
        """Begin the next period if it is time, with a line on what was left out of the last one."""
        now = self._clock()
        if now - self._since < PERIOD:
            return
        left_out, self._since, self._left_out = self._left_out, now, 0
        self._lines.clear()
        if left_out:
            self._lines["warning"] = 1
            self._logger.warning(f"and {left_out} more lines, left out")

    def _has_room(self, severity: str) -> bool:
        self.begin_period()
        has_room = self._lines[severity] < MOST
        self._lines[severity] += has_room
        self._left_out += not has_room
        return has_room

    def emit(self, record: logging.LogRecord) -> None:
        """Log what the package says; see `take_over`."""
        self.info(record.getMessage())

    def take_over(self) -> None:
        """Take what the package logs, which then goes nowhere else."""
        package = logging.getLogger("fdi_ros")
        package.handlers, package.propagate = [self], False
