"""What the node says: the fused rate, its integrity, and diagnostics."""

from __future__ import annotations

from collections.abc import Sequence

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import Imu
from std_msgs.msg import Float64MultiArray

from fdi_ros.monitor.diagnostics import StatusLine

_NS = 10**9


class Publishers:
    """The node's output topics.

    Parameters
    ----------
    node
        Publishes.
    """

    def __init__(self, node: Node) -> None:
        overriding = QoSOverridingOptions.with_default_policies()
        sensor = {"qos_profile": qos_profile_sensor_data, "qos_overriding_options": overriding}
        self._node = node
        self.fused = node.create_publisher(Imu, "fused", **sensor)
        self.integrity = node.create_publisher(Float64MultiArray, "~/integrity", **sensor)
        self.diagnostics = node.create_publisher(DiagnosticArray, "/diagnostics", QoSProfile(depth=10))
        self.integrity_is_heard = False
        """Whether there is a subscriber to the integrity, at the last look: if not, it is not published."""

    def look(self) -> None:
        """Look who listens."""
        self.integrity_is_heard = self.integrity.get_subscription_count() > 0

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
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(now, _NS)
    return message


def _status(line: StatusLine) -> DiagnosticStatus:
    return DiagnosticStatus(
        level=bytes([line.level]),
        name=line.name,
        message=line.message,
        hardware_id=line.hardware_id,
        values=[KeyValue(key=key, value=value) for key, value in line.values],
    )
