# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The demo: player, injector and monitor on a recorded flight over DDS, `fdi watch` on them, and what came of it."""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import IO

import numpy as np
import rclpy
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu

from fdi_ros.bag.samples import read_block
from fdi_ros.compiling.notice import announced
from fdi_ros.config.config import Config
from fdi_ros.errors import FdiError
from fdi_ros.faults.fault import Fault, Injector, parse_fault
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.samples import Array, Block
from fdi_ros.monitor.build import build_geometry
from fdi_ros.monitor.output import ChannelState
from fdi_ros.monitor.receiver import warm_messages
from fdi_ros.ros.watch import show
from fdi_ros.ros.watch_node import DEEP, Watcher

ROOT = Path(__file__).parents[2]
BAG, CONFIG = ROOT / "bags" / "cone_flight", ROOT / "config" / "two_imus.yaml"
FAULT = "channel=imu_2.y kind=bias size=0.15 start=18"
SUFFIX = "_faulty"
REST = 3.0
"""The recording is at rest for longer than this, s: its own mean over it is the bias of the rates to compare with."""
PATIENCE = 1200.0
"""The player waits so long for the monitor, which compiles first, on a slow and busy machine, s."""


class DemoError(FdiError):
    """The demo cannot go on."""


class Observer(Watcher):
    """Watches the monitor on a recorded flight, and remembers what it says.

    Parameters
    ----------
    flight
        The samples that are played, without the fault.
    names
        Of the channels.
    fault
        That is injected.
    """

    def __init__(self, flight: Block, names: Sequence[str], fault: Fault) -> None:
        super().__init__("/fdi_node", "fdi_demo")
        self.fault = fault
        self.struck = {names[channel] for channel in fault.channels(names)}
        self.fused: dict[int, Array] = {}
        """Fused rates, rad/s, by stamp, ns."""
        self.delays: dict[str, float] = {}
        """Time from the first faulty message to the declaration, s, by channel."""
        self.others: set[str] = set()
        """Healthy channels that were declared faulty."""
        self._begin, self._end = flight.stamp[0] / 1e9, flight.stamp[-1] / 1e9
        self._now = 0.0
        self.create_subscription(Imu, "/fused", self._on_rate, DEEP)
        self.create_subscription(Clock, "/clock", self._on_clock, DEEP)

    def _on_rate(self, message: Imu) -> None:
        stamp, rate = message.header.stamp, message.angular_velocity
        self.fused[stamp.sec * 10**9 + stamp.nanosec] = np.array((rate.x, rate.y, rate.z))

    def _on_clock(self, message: Clock) -> None:
        self._now = message.clock.sec + message.clock.nanosec / 1e9

    def is_over(self) -> bool:
        """Look at what the monitor says now; return whether the flight is over."""
        start = self._begin + self.fault.start
        state = "now" if self._now >= start else f"to come {self.fault.start:g} s after the start"
        self.picture.caption = f"recorded flight; fault {state}: {self.fault}"
        for name, channel in self.picture.channels.items():
            if name not in self.struck:
                self.others |= {name} if channel.state is ChannelState.FAULTY else set()
            elif channel.state in (ChannelState.FAULTY, ChannelState.STALE) and channel.since >= start:
                self.delays.setdefault(name, channel.since - start)
        return self._now >= self._end


def summary(observer: Observer, errors: tuple[float, float] | None) -> tuple[list[str], bool]:
    """Lines that say what came of it, and whether the monitor did what it should.

    Parameters
    ----------
    observer
        After the flight.
    errors
        As of `rate_errors`.
    """
    lines = [f"injected    {observer.fault} (it is not in the recording)"]
    lines += [
        f"isolated    {name}, {observer.delays[name]:.2f} s after its first faulty message"
        if name in observer.delays
        else f"missed      {name} was not isolated"
        for name in sorted(observer.struck)
    ]
    in_set = {name for name, one in observer.picture.channels.items() if one.state is ChannelState.AMBIGUOUS}
    others = (observer.others | in_set) - observer.struck
    lines.append(f"others      {', '.join(sorted(others))} declared too" if others else "others      none declared")
    if errors is not None:
        lines.append(f"rate error  {errors[0]:.4f} rad/s RMS with fdi_ros, {errors[1]:.4f} rad/s of all gyros averaged")
    return lines, observer.delays.keys() >= observer.struck and not others and errors is not None


def rate_errors(flight: Block, geometry: Geometry, fault: Fault, fused: dict[int, Array]) -> tuple[float, float] | None:
    """RMS errors since the fault, rad/s, of the fused rates, by stamp, and of the average; None: there is no rate."""
    seconds = (flight.stamp - flight.stamp[0]) / 1e9
    rows = [k for k in np.flatnonzero(seconds >= fault.start).tolist() if int(flight.stamp[k]) in fused]
    if not rows:
        return None
    bias = flight.z[seconds < REST].mean(axis=0)
    faulty = Injector([fault], geometry.channel_names).apply(flight)
    truth, average = ((block.z[rows] - bias) @ geometry.least_squares.T for block in (flight, faulty))
    with_ = np.array([fused[stamp] for stamp in flight.stamp[rows].tolist()])
    return _rms(with_ - truth), _rms(average - truth)


def _rms(errors: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


@contextlib.contextmanager
def running(commands: dict[str, list[str]]) -> Iterator[Callable[[], None]]:
    """Run nodes of ours, stopped at the end; what is yielded raises `DemoError` once one of them has failed."""
    nodes: dict[str, tuple[subprocess.Popen[bytes], IO[str]]] = {}

    def check() -> None:
        for name, (process, output) in nodes.items():
            if process.poll():
                output.seek(0)
                said = output.read().strip().splitlines() or ["it said nothing"]
                raise DemoError(f"{name} has ended: {said[-1]}")

    try:
        for name, words in commands.items():
            command = [sys.executable, "-m", "fdi_ros.ros.process", name, "--ros-args", *words]
            # Held open as long as the process.
            log: IO[str] = tempfile.TemporaryFile("w+")  # noqa: SIM115
            nodes[name] = subprocess.Popen(command, stdout=log, stderr=log), log
        yield check
    finally:
        for process, _ in nodes.values():
            process.send_signal(signal.SIGINT)
        for process, output in nodes.values():
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
            output.close()


def fly(config: Config, fault: Fault, seconds: float, plain: bool) -> tuple[list[str], bool]:
    """Run the nodes as replay.launch.py does, show the monitor until the flight is over, and sum up."""
    geometry, flight = build_geometry(config), read_block(BAG, config, end=seconds)
    fault.channels(geometry.channel_names)
    last = (flight.stamp[-1] - flight.stamp[0]) / 1e9
    if not fault.start < last:
        raise DemoError(f"the fault starts at {fault.start:g} s, expected less than {last:g} s")
    simulated = ["--params-file", str(CONFIG), "-p", "use_sim_time:=true"]
    commands = {
        "injector_node": [*simulated, "-p", "enabled:=true", "-p", f"faults:='{fault}'", "-p", f"suffix:={SUFFIX}"],
        "fdi_node": [*simulated, *(word for topic in config.topics for word in ("-r", f"{topic}:={topic}{SUFFIX}"))],
        "player_node": ["--params-file", str(CONFIG), "-p", f"bag:={BAG}", "-p", f"wait:={PATIENCE}"],
    }
    print(
        f"{last:.0f} s of {BAG.relative_to(ROOT)} to fdi_node, ROS_DOMAIN_ID {os.environ['ROS_DOMAIN_ID']}", flush=True
    )
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    try:
        # One process compiles, and all find it done.
        with announced():
            warm_messages()
        observer = Observer(flight, geometry.channel_names, fault)
        with running(commands) as check:
            show(observer, plain, lambda: (check(), observer.is_over())[1])
    finally:
        rclpy.try_shutdown()
    return summary(observer, rate_errors(flight, geometry, fault, observer.fused))


def isolate_environment() -> None:
    """Keep the demo to this machine and out of other ROS programs' way."""
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    os.environ.setdefault("ROS_LOG_DIR", tempfile.mkdtemp(prefix="fdi_demo_"))


def main(argv: Sequence[str] | None = None) -> int:
    """Run the demo; 0 if the fault was isolated and nothing else declared."""
    parser = argparse.ArgumentParser(prog="make demo", description="A gyro goes bad in flight; the real node finds it.")
    parser.add_argument("--fault", default=FAULT, metavar="TEXT", help=f"what to inject (default: {FAULT})")
    parser.add_argument("--seconds", type=float, default=32.0, help="how much of the minute of flight to play")
    parser.add_argument("--plain", action="store_true", help="line by line, as where the output is no terminal")
    options = parser.parse_args(argv)
    isolate_environment()
    try:
        fault = parse_fault(options.fault)
        lines, good = fly(Config.from_file(CONFIG), fault, options.seconds, options.plain)
    except FdiError as error:
        print(f"demo: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    print("", *lines, sep="\n")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
