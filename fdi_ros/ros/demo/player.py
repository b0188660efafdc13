# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The flight that the demo plays to the monitor over DDS, with its fault; what the monitor says, and how it did."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Imu

from fdi_ros.arrays import Array
from fdi_ros.bag.samples import read_block
from fdi_ros.config.config import Config
from fdi_ros.faults.fault import Fault, Injector
from fdi_ros.model.block import Block
from fdi_ros.model.geometry import Geometry
from fdi_ros.monitor.build import build_geometry
from fdi_ros.monitor.output import ChannelState
from fdi_ros.ros.demo.screen import Scene, Screen, rate_error
from fdi_ros.ros.watch_node import Watcher

MONITOR = "/fdi_node"
FRAMES = 10
"""Samples from one drawing to the next."""
LEARNING = 3.0
"""The recording is at rest for longer than this, s: its own mean over it is the bias of the rates to compare with."""
NAMED = (ChannelState.FAULTY, ChannelState.STALE)
BAD = (*NAMED, ChannelState.AMBIGUOUS)


@dataclass
class Flight:
    """A recorded flight with a fault in it, and the rates to compare with."""

    geometry: Geometry
    fault: Fault
    block: Block
    """With the fault."""
    truth: Array
    """(N, 3) least-squares rate of all channels of the recording as it is, rad/s."""
    unmonitored: Array
    """(N, 3) least-squares rate of all channels with the fault, rad/s."""

    @classmethod
    def load(cls, bag: Path, config: Config, fault: Fault, seconds: float) -> Flight:
        """Read the first seconds of a recording and put the fault in."""
        geometry = build_geometry(config)
        clean = read_block(bag, config, end=seconds)
        block = Injector([fault], geometry.channel_names).apply(clean)
        bias = clean.z[clean.stamp - clean.stamp[0] < LEARNING * 1e9].mean(axis=0)
        rates = [(z - bias) @ geometry.least_squares.T for z in (clean.z, block.z)]
        return cls(geometry, fault, block, *rates)

    @property
    def seconds(self) -> Array:
        """(N,) time of each sample from the first, s."""
        return (self.block.stamp - self.block.stamp[0]) * 1e-9


@dataclass
class MonitorLog:
    """What the node published, and when the samples went out to it."""

    rates: dict[int, Array] = field(default_factory=dict)
    """Fused rate by its stamp, ns."""
    changes: list[tuple[float, int, ChannelState]] = field(default_factory=list)
    """When (s, monotonic clock), channel, new state."""
    published: list[float] = field(default_factory=list)
    """When each sample was published, s, monotonic clock."""


def first_time(log: MonitorLog, channel: int, states: Sequence[ChannelState], after: float) -> float | None:
    """Seconds from a time to the first change of a channel into one of the states; None if there is none."""
    return next((t - after for t, c, state in log.changes if c == channel and t >= after and state in states), None)


def summary(flight: Flight, log: MonitorLog) -> tuple[list[str], bool]:
    """Lines that say how it went, and whether the monitor did what it should."""
    names = flight.geometry.channel_names
    struck = flight.fault.channels(names)
    k = int(np.searchsorted(flight.seconds, flight.fault.start))
    begin = log.published[k]
    lines = [f"injected    {flight.fault} (it is not in the recording)"]
    for channel in struck:
        out = first_time(log, channel, (*BAD, ChannelState.SUSPECT), begin)
        declared = first_time(log, channel, NAMED, begin)
        lines.append(
            f"missed      {names[channel]} was not isolated"
            if out is None or declared is None
            else f"isolated    {names[channel]}: left out of the fused rate {out * 1e3:.0f} ms after the first faulty"
            f" message, isolated after {declared * 1e3:.0f} ms"
        )
    # In a set for a moment is not declared: what counts is a name, and the set that is left.
    last = {c: state for _, c, state in log.changes}
    named = {c for _, c, state in log.changes if state == ChannelState.FAULTY}
    others = sorted({names[c] for c in named | {c for c, state in last.items() if state in BAD} if c not in struck})
    lines.append(f"others      {', '.join(others)} declared too" if others else "others      none declared")
    errors = _errors_from(flight, log, k)
    if errors is not None:
        with_, without = map(rate_error, errors)
        lines.append(f"rate error  {with_} RMS with monitoring, {without} without, since the fault")
    found = all(first_time(log, channel, NAMED, begin) is not None for channel in struck)
    return lines, found and not others and errors is not None


def _errors_from(flight: Flight, log: MonitorLog, k: int) -> tuple[float, float] | None:
    """RMS error, rad/s, of the fused rate and of the rate of all channels, from sample k on."""
    stamps = flight.block.stamp.tolist()
    rows = [i for i in range(k, len(stamps)) if stamps[i] in log.rates]
    if not rows:
        return None
    fused = np.array([log.rates[stamps[i]] for i in rows])
    squares = [np.sum((rate - flight.truth[rows]) ** 2, axis=1) for rate in (fused, flight.unmonitored[rows])]
    return float(np.sqrt(np.mean(squares[0]))), float(np.sqrt(np.mean(squares[1])))


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
