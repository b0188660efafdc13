"""What the node says: the fused rate, its integrity, and diagnostics."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import Imu
from std_msgs.msg import Float64MultiArray

from fdi_ros.cdr import ChannelsTemplate, ImuTemplate
from fdi_ros.monitor.diagnostics import StatusLine
from fdi_ros.monitor.output import Output

_NS = 10**9


class Publishers:
    """The node's output topics.

    Parameters
    ----------
    node
        Publishes.
    body_frame
        frame_id of the fused rate.
    channels
        Number of channels.
    """

    def __init__(self, node: Node, body_frame: str, channels: int) -> None:
        overriding = QoSOverridingOptions.with_default_policies()
        sensor = {"qos_profile": qos_profile_sensor_data, "qos_overriding_options": overriding}
        self._node = node
        self.fused = node.create_publisher(Imu, "fused", **sensor)
        self.integrity = node.create_publisher(Float64MultiArray, "~/integrity", **sensor)
        self.diagnostics = node.create_publisher(DiagnosticArray, "/diagnostics", QoSProfile(depth=10))
        self._imu = ImuTemplate(body_frame)
        self._array = ChannelsTemplate(2 + channels + 3)
        self.integrity_is_heard = False
        """Whether anybody listens to the integrity, at the last look: if not, it is not even worked out."""

    def look(self) -> None:
        """Look who listens."""
        self.integrity_is_heard = self.integrity.get_subscription_count() > 0

    def publish_rate(self, output: Output, shifts: Sequence[int]) -> int:
        """Publish the fused rate of N samples where there is one; return how many had none.

        Parameters
        ----------
        output
            Of the pipeline.
        shifts
            (N,) to be taken off the stamps, ns.
        """
        stamps, valid = output.stamp.tolist(), output.valid.tolist()
        rates, covariances = output.rate.tolist(), output.covariance.reshape(-1, 9).tolist()
        for k, stamp in enumerate(stamps):
            if valid[k]:
                self.fused.publish(self._imu.fill(stamp - shifts[k], rates[k], covariances[k]))
        return len(valid) - sum(valid)

    def publish_integrity(self, output: Output, protection: NDArray[np.float64]) -> None:
        """Publish the integrity of N samples.

        Parameters
        ----------
        output
            Of the pipeline.
        protection
            (N, 3) protection level of each sample, rad/s.
        """
        statistic, threshold = output.statistic.tolist(), output.threshold.tolist()
        for figures in zip(statistic, threshold, output.state.tolist(), protection.tolist(), strict=True):
            self.integrity.publish(self._array.fill((*figures[:2], *figures[2], *figures[3])))

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
