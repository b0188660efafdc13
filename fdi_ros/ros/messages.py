"""Outputs of the node: the fused rate, its integrity, and diagnostics."""

from __future__ import annotations

from collections.abc import Sequence

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import Imu
from std_msgs.msg import Float64MultiArray

from fdi_ros.monitor.diagnostics import StatusLine

_NS = 10**9
LAST_STAMP = (2**31 - 1) * _NS
"""Latest time that the header of a message can hold, to the second, ns."""
DEPTH = 256
"""Messages kept until they are sent: after a moment of waiting many are worked at once, and a writer that keeps fewer
drops some."""
OVERRIDABLE = ("fused", "~/integrity")
"""Topics whose QoS may be overridden."""


def output_qos() -> QoSProfile:
    """Return the QoS of sensor data as REP-2003 wants it published: reliable, for subscribers of either kind.

    A new one each time, as overrides are written into it.
    """
    return QoSProfile(reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_LAST, depth=DEPTH)


class Publishers:
    """The node's output topics.

    Parameters
    ----------
    node
        Publishes.
    """

    def __init__(self, node: Node) -> None:
        overriding = QoSOverridingOptions.with_default_policies()
        fused, integrity = OVERRIDABLE
        self._node = node
        self.fused = node.create_publisher(Imu, fused, output_qos(), qos_overriding_options=overriding)
        self.integrity = node.create_publisher(
            Float64MultiArray, integrity, output_qos(), qos_overriding_options=overriding
        )
        self.diagnostics = node.create_publisher(DiagnosticArray, "/diagnostics", QoSProfile(depth=10))
        self.has_integrity_subscriber = False
        """Whether there was a subscriber to the integrity at the last check: if not, it is not published."""

    def count_subscribers(self) -> None:
        """Check whether there are subscribers."""
        self.has_integrity_subscriber = self.integrity.get_subscription_count() > 0

    def diagnose(self, lines: Sequence[StatusLine], now: int) -> None:
        """Publish diagnostics at the clock time now, ns."""
        self.diagnostics.publish(diagnostic_array(lines, now))

    def destroy(self) -> None:
        """Take the topics down."""
        for publisher in (self.fused, self.integrity, self.diagnostics):
            self._node.destroy_publisher(publisher)


def diagnostic_array(lines: Sequence[StatusLine], now: int) -> DiagnosticArray:
    """Return diagnostics as a message, stamped now, ns."""
    message = DiagnosticArray(status=[_status(line) for line in lines])
    # The clock of a simulator may have any time.
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(min(max(now, 0), LAST_STAMP), _NS)
    return message


def prefix_of(node: Node) -> str:
    """Return what the names of a node's statuses begin with: no two nodes of a system have the same."""
    return f"{node.get_fully_qualified_name().lstrip('/')}: "


def _status(line: StatusLine) -> DiagnosticStatus:
    return DiagnosticStatus(
        level=bytes([line.level]),
        name=line.name,
        message=line.message,
        hardware_id=line.hardware_id,
        values=[KeyValue(key=key, value=value) for key, value in line.values],
    )
