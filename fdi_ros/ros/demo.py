# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The demo: a recorded flight played to the monitor over DDS, with a fault on the way, and how the monitor did."""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import textwrap
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Imu

from fdi_ros.bag.samples import read_block
from fdi_ros.compiling.notice import WORDS, announced
from fdi_ros.config.config import Config
from fdi_ros.errors import FdiError
from fdi_ros.faults.fault import Fault, Injector, parse_fault
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.samples import Array, Block
from fdi_ros.monitor.build import build_geometry
from fdi_ros.monitor.output import ChannelState
from fdi_ros.monitor.receiver import warm_messages
from fdi_ros.ros.demo_screen import Scene, Screen, rate_error
from fdi_ros.ros.watch_node import Watcher
from fdi_ros.ros.watch_view import bar

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


ROOT = Path(__file__).parents[2]
BAR = 30
"""Characters of the bar of compiling."""
BAG, CONFIG = ROOT / "bags" / "cone_flight", ROOT / "config" / "two_imus.yaml"
FAULT = "channel=imu_2.y kind=bias size=0.15 start=18"
NODE = [sys.executable, "-m", "fdi_ros.ros.process", "fdi_node", "--ros-args", "--params-file", str(CONFIG)]


class DemoError(FdiError):
    """The demo cannot go on."""


LONGEST_START = 1200.0
"""s; of a node that compiles first, on a slow and busy machine."""


def isolate_environment() -> None:
    """Keep the demo to this machine and out of other ROS programs' way."""
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    os.environ.setdefault("ROS_LOG_DIR", tempfile.mkdtemp(prefix="fdi_demo_"))


def fly(flight: Flight) -> MonitorLog:
    """Start the node, play the flight to it, stop the node.

    Raises
    ------
    DemoError
        If the node ends or does not connect within `LONGEST_START`.
    """
    with tempfile.TemporaryFile("w+") as output, subprocess.Popen(NODE, stdout=output, stderr=output) as monitor:
        rclpy.init()
        player = Player(flight, Config.from_file(CONFIG))
        executor = SingleThreadedExecutor()
        executor.add_node(player)
        listening = threading.Thread(target=_spin, args=[executor], daemon=True)
        listening.start()
        try:
            with Screen(player.scene, player.picture) as screen:
                # The node begins with its detector, so both do not compile the same; where all is there, none does.
                with announced(_OnScreen(screen)):
                    warm_messages()
                _await_connection(player, monitor, output, screen)
                player.play(screen)
        finally:
            monitor.send_signal(signal.SIGINT)
            rclpy.try_shutdown()
            listening.join(5)
            try:
                monitor.wait(10)
            except subprocess.TimeoutExpired:
                monitor.kill()
    return player.log


class _OnScreen:
    """Shows on the demo's screen how far compiling is: a `View` of `announced`."""

    def __init__(self, screen: Screen) -> None:
        self._screen = screen
        self._begun = 0.0

    def begin(self) -> None:
        """Say that it begins."""
        self._screen.say(WORDS)
        self._begun = time.monotonic()

    def draw(self, share: float) -> None:
        """Draw the share done."""
        self._screen.wait(
            f"compiling, once on this machine |{bar(share, BAR)}| {share:.0%}", time.monotonic() - self._begun
        )

    def wipe(self) -> None:
        """Leave the screen to others."""


def _spin(executor: SingleThreadedExecutor) -> None:
    try:
        executor.spin()
    except ExternalShutdownException:
        return


def _await_connection(player: Player, monitor: subprocess.Popen[bytes], output: IO[str], screen: Screen) -> None:
    begin = time.monotonic()
    while not player.connected():
        waited, ended = time.monotonic() - begin, monitor.poll() is not None
        if ended or waited > LONGEST_START:
            output.seek(0)
            said = output.read().strip().splitlines()[-1:] or ["it said nothing"]
            raise DemoError(
                f"the node {'ended' if ended else f'did not connect within {LONGEST_START:g} s'}: {said[0]}"
            )
        screen.wait("fdi_node starts", waited)
        time.sleep(0.05)


def _say(line: str) -> None:
    """Print a line; on a terminal folded between words."""
    if sys.stdout.isatty():
        line = textwrap.fill(line, max(40, shutil.get_terminal_size().columns), subsequent_indent=" " * 12)
    print(line, flush=True)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the demo; 0 if the fault was isolated and nothing else declared."""
    parser = argparse.ArgumentParser(prog="make demo", description="A gyro goes bad in flight; the real node finds it.")
    parser.add_argument("--fault", default=FAULT, metavar="TEXT", help=f"what to inject (default: {FAULT})")
    parser.add_argument("--seconds", type=float, default=32.0, help="how much of the minute of flight to play")
    options = parser.parse_args(argv)
    isolate_environment()
    try:
        fault = parse_fault(options.fault)
        flight = Flight.load(BAG, Config.from_file(CONFIG), fault, options.seconds)
        if not fault.start < flight.seconds[-1]:
            raise DemoError(f"the fault starts at {fault.start:g} s, expected less than {flight.seconds[-1]:g} s")
        _say(
            f"fdi_node on two IMUs, {flight.seconds[-1]:.0f} s of {BAG.relative_to(ROOT)} over DDS at recorded rate,"
            f" ROS_DOMAIN_ID {os.environ['ROS_DOMAIN_ID']}; fault to come: {fault}"
        )
        log = fly(flight)
    except FdiError as error:
        print(f"demo: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    lines, good = summary(flight, log)
    print()
    for line in lines:
        _say(line)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
