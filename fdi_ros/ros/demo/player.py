"""Plays a flight to the monitor over DDS and listens to what it says."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Imu
from std_msgs.msg import Float64MultiArray

from fdi_ros.config import Config
from fdi_ros.monitor.output import ChannelState
from fdi_ros.ros.demo.flight import Flight, Record
from fdi_ros.ros.demo.screen import Screen


class Player(Node):
    """Plays a flight to the monitor and listens to what it says."""

    def __init__(self, flight: Flight, config: Config, screen: Screen) -> None:
        super().__init__("fdi_demo")
        self.flight = flight
        self.screen = screen
        self.view = screen.view
        self.record = Record()
        self.start = 0.0
        self.shift = 0
        self.over = False
        self.units = config.imu_names
        self.outputs = [self.create_publisher(Imu, topic, qos_profile_sensor_data) for topic in config.topics]
        self.create_subscription(Imu, "fused", self._on_fused, qos_profile_sensor_data)
        self.create_subscription(Float64MultiArray, "fdi_node/integrity", self._on_integrity, qos_profile_sensor_data)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)

    def connected(self) -> bool:
        """Whether the monitor listens and is listened to."""
        heard = all(output.get_subscription_count() for output in self.outputs)
        return heard and bool(self.count_publishers("fused") and self.count_publishers("fdi_node/integrity"))

    def play(self) -> None:
        """Publish every sample when its time comes, stamped with the time of now."""
        self.start = time.monotonic()
        stamps = self.flight.block.stamp
        self.shift = time.time_ns() - int(stamps[0])
        for k, at in enumerate(self.flight.seconds.tolist()):
            time.sleep(max(0.0, self.start + at - time.monotonic()))
            self._publish(k)
            if k % 20 == 0:
                self.view.elapsed = at
                self.screen.draw()
        self.over = True
        # The last answers are under way.
        time.sleep(0.2)
        self.screen.draw()

    def _publish(self, k: int) -> None:
        block = self.flight.block
        sec, nanosec = divmod(int(block.stamp[k]) + self.shift, 10**9)
        self.record.published.append(time.monotonic())
        for unit, output in enumerate(self.outputs):
            mine = slice(3 * unit, 3 * unit + 3)
            if block.received is not None and not block.received[k, mine].any():
                continue
            message = Imu()
            message.header.frame_id = self.units[unit]
            message.header.stamp.sec, message.header.stamp.nanosec = sec, nanosec
            rate = message.angular_velocity
            rate.x, rate.y, rate.z = block.z[k, mine].tolist()
            message.orientation_covariance[0] = message.linear_acceleration_covariance[0] = -1.0
            output.publish(message)

    def _on_fused(self, message: Imu) -> None:
        stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec - self.shift
        rate = message.angular_velocity
        self.record.rates[stamp] = np.array([rate.x, rate.y, rate.z])
        k = int(np.searchsorted(self.flight.block.stamp, stamp))
        if k < len(self.flight.truth):
            truth = self.flight.truth[k]
            self.view.error_with = float(np.linalg.norm(self.record.rates[stamp] - truth))
            self.view.error_without = float(np.linalg.norm(self.flight.unmonitored[k] - truth))

    def _on_integrity(self, message: Float64MultiArray) -> None:
        now = time.monotonic()
        self.view.statistic, self.view.threshold, *numbers = message.data[:-3]
        states = [ChannelState(int(number)) for number in numbers]
        before: Sequence[ChannelState | None] = self.view.states or [None] * len(states)
        moves: dict[tuple[ChannelState | None, ChannelState], list[int]] = {}
        for channel, (was, state) in enumerate(zip(before, states, strict=True)):
            if state is not was:
                self.record.changes.append((now, channel, state))
                moves.setdefault((was, state), []).append(channel)
        self.view.states = states
        for (was, state), channels in moves.items():
            self.screen.change(now - self.start, channels, was, state)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        if self.over:
            # Nothing is played any more: that the channels have gone silent is no news.
            return
        names = self.flight.geometry.channel_names
        texts = {name: status.message for status in message.status for name in names if status.name.endswith(name)}
        self.screen.messages(time.monotonic() - self.start, texts)
