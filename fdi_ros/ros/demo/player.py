# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Plays a flight to the monitor over DDS and keeps what it publishes."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Imu

from fdi_ros.config.config import Config
from fdi_ros.monitor.output import ChannelState
from fdi_ros.ros.demo.flight import BAD, NAMED, Flight, MonitorLog, first_time
from fdi_ros.ros.demo.screen import Scene, Screen
from fdi_ros.ros.watch_node import Watcher

MONITOR = "/fdi_node"
FRAMES = 10
"""Samples from one drawing to the next."""


class Player(Watcher):
    """Plays a flight to the monitor and keeps what it publishes."""

    def __init__(self, flight: Flight, config: Config) -> None:
        super().__init__(MONITOR, "fdi_demo")
        self.flight = flight
        self.log = MonitorLog()
        self.struck = flight.fault.channels(flight.geometry.channel_names)
        self.picture.names = tuple(flight.geometry.channel_names)
        self.scene = Scene(
            flight.fault,
            [flight.geometry.channel_names[channel] for channel in self.struck],
            config.bias.startup_bias_duration,
            float(flight.seconds[-1]),
        )
        self.first = int(np.searchsorted(flight.seconds, flight.fault.start))
        """First sample with the fault."""
        self.over = False
        self.shift = 0
        self.units = config.imu_names
        self.outputs = [self.create_publisher(Imu, topic, qos_profile_sensor_data) for topic in config.topics]

    def connected(self) -> bool:
        """Whether the monitor listens and is listened to."""
        self.look()
        return all(output.get_subscription_count() for output in self.outputs) and not self.picture.is_silent(
            "diagnostics"
        )

    def play(self, screen: Screen) -> None:
        """Publish every sample when its time comes, stamped with the time of now."""
        start = time.monotonic()
        stamps = self.flight.block.stamp
        self.shift = time.time_ns() - int(stamps[0])
        for k, at in enumerate(self.flight.seconds.tolist()):
            time.sleep(max(0.0, start + at - time.monotonic()))
            self._publish(k)
            if k % FRAMES == 0:
                self._show(at, screen)
        self.over = True
        # The last answers are under way.
        time.sleep(0.2)
        self._show(float(self.flight.seconds[-1]), screen)

    def _show(self, at: float, screen: Screen) -> None:
        self.look()
        scene, k = self.scene, len(self.log.published) - 1
        scene.elapsed = at
        scene.turning_without = float(np.linalg.norm(self.flight.unmonitored[k]))
        scene.error_without = float(np.linalg.norm(self.flight.unmonitored[k] - self.flight.truth[k]))
        if scene.begun and scene.named is None:
            begin = self.log.published[self.first]
            scene.left_out = self._latest((*BAD, ChannelState.SUSPECT), begin)
            scene.named = self._latest(NAMED, begin)
        screen.update()

    def _latest(self, states: Sequence[ChannelState], begin: float) -> float | None:
        """When the last of the struck channels came into one of the states, s; None: not all have."""
        times = [first_time(self.log, channel, states, begin) for channel in self.struck]
        known = [seconds for seconds in times if seconds is not None]
        return max(known) if len(known) == len(times) else None

    def _publish(self, k: int) -> None:
        block = self.flight.block
        sec, nanosec = divmod(int(block.stamp[k]) + self.shift, 10**9)
        self.log.published.append(time.monotonic())
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

    def took_rate(self, stamp: int, rate: tuple[float, float, float]) -> None:
        """Compare a fused rate with that of the recording without the fault."""
        stamp -= self.shift
        self.log.rates[stamp] = fused = np.array(rate)
        k = int(np.searchsorted(self.flight.block.stamp, stamp))
        if k < len(self.flight.truth):
            self.scene.turning_with = float(np.linalg.norm(fused))
            self.scene.error_with = float(np.linalg.norm(fused - self.flight.truth[k]))

    def took_states(self, before: Sequence[ChannelState], after: Sequence[ChannelState]) -> None:
        """Remember when which channel changed."""
        now = time.monotonic()
        for channel, state in enumerate(after):
            if channel >= len(before) or state is not before[channel]:
                self.log.changes.append((now, channel, state))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        # When nothing is played any more, silent inputs are no news.
        if not self.over:
            super()._on_diagnostics(message)
