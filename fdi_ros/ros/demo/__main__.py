# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Run the demo: python -m fdi_ros.ros.demo."""

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
from pathlib import Path
from typing import IO

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor

from fdi_ros.compiling.notice import WORDS, announced
from fdi_ros.config.config import Config
from fdi_ros.errors import FdiError
from fdi_ros.faults.fault import parse_fault
from fdi_ros.monitor.warm import warm_messages
from fdi_ros.ros.demo.player import Flight, MonitorLog, Player, summary
from fdi_ros.ros.demo.screen import Screen
from fdi_ros.ros.watch_view import bar

ROOT = Path(__file__).parents[3]
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
