# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Topics of the node: what is published, with which QoS, and the classes of their messages."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any

from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from fdi_ros.errors import FdiError
from fdi_ros.monitor.diagnostics import StatusLine
from fdi_ros.monitor.encoder import DIAGNOSTICS, FUSED, INTEGRITY, encode_diagnostics

DEPTH = 256
"""Messages kept until they are sent: after a moment of waiting many are worked at once, and a writer that keeps fewer
drops some."""
OVERRIDABLE = (FUSED.name, INTEGRITY.name)
"""Topics whose QoS may be overridden."""


def output_qos() -> QoSProfile:
    """Return the QoS of sensor data as REP-2003 wants it published: reliable, for subscribers of either kind.

    A new one each time, as overrides are written into it.
    """
    return QoSProfile(reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_LAST, depth=DEPTH)


def diagnostics_publisher(node: Node) -> Any:
    """Publish diagnostics; they are handed over as bytes."""
    return node.create_publisher(message_class(DIAGNOSTICS.type), DIAGNOSTICS.name, QoSProfile(depth=10))


class Publishers:
    """The node's output topics.

    Parameters
    ----------
    node
        Publishes.
    """

    def __init__(self, node: Node) -> None:
        overriding = QoSOverridingOptions.with_default_policies()
        self._node = node
        self.fused, self.integrity = (
            node.create_publisher(
                message_class(topic.type), topic.name, output_qos(), qos_overriding_options=overriding
            )
            for topic in (FUSED, INTEGRITY)
        )
        self.diagnostics = diagnostics_publisher(node)
        self.has_integrity_subscriber = False
        """Whether there was a subscriber to the integrity at the last check: if not, it is not published."""

    def count_subscribers(self) -> None:
        """Check whether there are subscribers."""
        self.has_integrity_subscriber = self.integrity.get_subscription_count() > 0

    def diagnose(self, lines: Sequence[StatusLine], now: int) -> None:
        """Publish diagnostics at the clock time now, ns."""
        self.diagnostics.publish(encode_diagnostics(lines, now).data)

    def destroy(self) -> None:
        """Take the topics down."""
        for publisher in (self.fused, self.integrity, self.diagnostics):
            self._node.destroy_publisher(publisher)


def message_class(name: str) -> Any:
    """Return the class of a message type, ``sensor_msgs/msg/Imu``.

    Raises
    ------
    FdiError
        If its package is not installed.
    """
    package, _, kind = name.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), kind)
    except ImportError as error:
        raise FdiError(f"messages of type {name} need the ROS package {package}: {error}") from error


def prefix_of(node: Node) -> str:
    """Return what the names of a node's statuses begin with: no two nodes of a system have the same."""
    return f"{node.get_fully_qualified_name().lstrip('/')}: "
