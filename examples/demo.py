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

import rclpy
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock

from fdi_ros.bag.samples import read_block
from fdi_ros.compiling.notice import announced
from fdi_ros.config.config import Config
from fdi_ros.errors import FdiError
from fdi_ros.faults.fault import Fault, parse_fault
from fdi_ros.monitor.building import build_geometry
from fdi_ros.monitor.receiver import warm_path
from fdi_ros.ros.watch import DEEP, Watcher, show

ROOT = Path(__file__).parents[1]
BAG, CONFIG = ROOT / "bags" / "cone_flight", ROOT / "config" / "two_imus.yaml"
FAULT = "channel=imu_2.y kind=bias size=0.15 start=18"
SUFFIX = "_faulty"
PATIENCE = 1200.0  # the player waits so long for the monitor, which compiles first, on a slow and busy machine, s


class Observer(Watcher):
    """Watches the monitor on a flight, from one stamp to another, s, and remembers what it declares.

    The fault is injected into the channels that are named as struck.
    """

    def __init__(
        self, begin: float, end: float, fault: Fault, struck: set[str]
    ) -> None:
        super().__init__("/fdi_node", "fdi_demo")
        self.fault, self.struck = fault, struck
        self.delays: dict[
            str, float
        ] = {}  # time from the first faulty message to the declaration, s, by channel
        self.others: set[str] = set()  # healthy channels that were declared faulty
        self._start, self._end, self._now = begin + fault.start, end, 0.0
        self.create_subscription(Clock, "/clock", self._on_clock, DEEP)

    def _on_clock(self, message: Clock) -> None:
        self._now = message.clock.sec + message.clock.nanosec / 1e9

    def is_over(self) -> bool:
        """Look at what the monitor says now; return whether the flight is over."""
        begun = self._now >= self._start
        state = "since" if begun else "to come at"
        self.picture.caption = (
            f"recorded flight; fault {state} {self.fault.start:g} s: {self.fault}"
        )
        for name, line in self.picture.channels.items():
            since = line.number("state since (stamp, s)")
            if name not in self.struck:
                self.others |= {name} if line.value("state") == "FAULTY" else set()
            elif line.value("state") in ("FAULTY", "STALE") and since >= self._start:
                self.delays.setdefault(name, since - self._start)
        return self._now >= self._end

    def summary(self) -> tuple[list[str], bool]:
        """Return lines that say what came of it, and whether the monitor did what it should."""
        start = self.fault.start
        lines = [f"{start:.2f} s  the demo adds the fault: {self.fault}"]
        for name in sorted(self.struck):
            if name in self.delays:
                at, after = start + self.delays[name], self.delays[name]
                lines.append(
                    f"{at:.2f} s  the monitor names {name}, {after:.2f} s later"
                )
            else:
                lines.append(f"the monitor did not name {name}")
        in_set = {
            name
            for name, line in self.picture.channels.items()
            if line.value("state") == "AMBIGUOUS"
        }
        others = (self.others | in_set) - self.struck
        lines.append(
            f"wrongly named: {', '.join(sorted(others))}"
            if others
            else "no healthy gyro was named"
        )
        return lines, self.delays.keys() >= self.struck and not others


@contextlib.contextmanager
def running(commands: dict[str, list[str]]) -> Iterator[Callable[[], None]]:
    """Run nodes of ours, stopped at the end; what is yielded raises `FdiError` once one of them has failed."""

    def check() -> None:
        for name, (process, output) in nodes.items():
            if process.poll():
                output.seek(0)
                raise FdiError(
                    f"{name} has ended: {(output.read().strip() or 'it said nothing').splitlines()[-1]}"
                )

    def end(process: subprocess.Popen[bytes]) -> None:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()

    nodes: dict[str, tuple[subprocess.Popen[bytes], IO[str]]] = {}
    with contextlib.ExitStack() as stack:
        for name, words in commands.items():
            command = [
                sys.executable,
                "-m",
                "fdi_ros.ros.process",
                name,
                "--ros-args",
                *words,
            ]
            log = stack.enter_context(tempfile.TemporaryFile("w+"))
            nodes[name] = subprocess.Popen(command, stdout=log, stderr=log), log
            stack.callback(end, nodes[name][0])
        yield check


def _introduction(
    names: Sequence[str], struck: set[str], fault: Fault, seconds: float
) -> str:
    """Return what the demo shows, before anything happens."""
    units = sorted({name.rpartition(".")[0] for name in names})
    return (
        f"This demo plays {seconds:.0f} s of a recorded flight ({BAG.relative_to(ROOT)}) to the\n"
        f"monitor (fdi_node, ROS_DOMAIN_ID {os.environ['ROS_DOMAIN_ID']}). It measures with {len(names)} gyros:"
        f" {', '.join(units)}, three\naxes each. {fault.start:g} s after the start"
        f" {', '.join(sorted(struck))} goes wrong: the demo adds\n    {fault}\n"
        "The monitor should name that gyro, and no other. In the first turn, at 8 s, all gyros are\n"
        "UNCHECKED for 0.3 s, but stay in use: a turn shows errors that rest hides, for example\n"
        "delays. The table below has for each gyro: its residual (how far it is\n"
        "from what the others measure) and its state. The evidence for a fault stands above it:\n"
        "a gyro is named when the evidence reaches the threshold.\n"
    )


def fly(
    config: Config, fault: Fault, seconds: float, plain: bool
) -> tuple[list[str], bool]:
    """Run the nodes as replay.launch.py does, show the monitor until the flight is over, and sum up."""
    names, flight = (
        build_geometry(config).channel_names,
        read_block(BAG, config, end=seconds),
    )
    begin, end = flight.stamp[0] / 1e9, flight.stamp[-1] / 1e9
    struck = {names[channel] for channel in fault.channels(names)}
    if not fault.start < end - begin:
        raise FdiError(
            f"the fault starts at {fault.start:g} s, expected less than {end - begin:g} s"
        )
    simulated = ["--params-file", str(CONFIG), "-p", "use_sim_time:=true"]
    commands = {
        "injector_node": [
            *simulated,
            "-p",
            "enabled:=true",
            "-p",
            f"faults:='{fault}'",
            "-p",
            f"suffix:={SUFFIX}",
        ],
        "fdi_node": [
            *simulated,
            *(
                word
                for topic in config.topics
                for word in ("-r", f"{topic}:={topic}{SUFFIX}")
            ),
        ],
        "player_node": [
            "--params-file",
            str(CONFIG),
            "-p",
            f"bag:={BAG}",
            "-p",
            f"wait:={PATIENCE}",
        ],
    }
    print(_introduction(names, struck, fault, end - begin), flush=True)
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    try:
        # One process compiles, and all find it done.
        with announced():
            warm_path()
        observer = Observer(begin, end, fault, struck)
        with running(commands) as check:
            show(observer, plain, lambda: (check(), observer.is_over())[1])
    finally:
        rclpy.try_shutdown()
    return observer.summary()


def main(argv: Sequence[str] | None = None) -> int:
    """Run the demo; 0 if the fault was isolated and nothing else declared."""
    parser = argparse.ArgumentParser(
        prog="make demo",
        description="A gyro goes bad in flight; the real node finds it.",
    )
    parser.add_argument(
        "--fault",
        default=FAULT,
        metavar="TEXT",
        help=f"what to inject (default: {FAULT})",
    )
    parser.add_argument(
        "--seconds",
        type=float,
        default=32.0,
        help="how much of the minute of flight to play",
    )
    parser.add_argument(
        "--plain",
        action="store_true",
        help="line by line, as where the output is no terminal",
    )
    options = parser.parse_args(argv)
    # To this machine, and out of the way of other ROS programs.
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    os.environ.setdefault("ROS_LOG_DIR", tempfile.mkdtemp(prefix="fdi_demo_"))
    try:
        fault = parse_fault(options.fault)
        lines, good = fly(
            Config.from_file(CONFIG), fault, options.seconds, options.plain
        )
    except FdiError as error:
        print(f"demo: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    print("", *lines, sep="\n")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
