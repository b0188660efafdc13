# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Watch a running monitor: fdi watch."""

from __future__ import annotations

import argparse
import importlib.util
import sys
import time
from typing import TYPE_CHECKING, Any, TextIO

from fdi_ros.config.config import is_plain_name
from fdi_ros.errors import FdiError
from fdi_ros.ros.watch_view import LineReport, draw

if TYPE_CHECKING:
    from fdi_ros.ros.watch_node import Watcher

PERIOD = 0.1
"""How often the view is drawn, s."""


def is_drawn(out: TextIO) -> bool:
    """Whether the output can be drawn on: a terminal that shows more than ASCII, and rich is there to do it."""
    return out.isatty() and "utf" in (out.encoding or "").lower() and importlib.util.find_spec("rich") is not None


def run(arguments: argparse.Namespace) -> int:
    """Show a monitor until interrupted.

    Raises
    ------
    FdiError
        If ROS 2 is not there, or there are several monitors and none is named.
    """
    try:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.signals import SignalHandlerOptions
    except ImportError as error:
        raise FdiError(f"watch needs ROS 2: source it, or pip install 'fdi_ros[ros]' ({error})") from error
    from fdi_ros.ros.watch_node import Watcher

    name = arguments.node
    if name and not name.startswith("/"):
        name = f"/{name}"
    if name and not is_plain_name(name):
        raise FdiError(f"--node is {arguments.node!r}, expected the full name of a node such as /drone/fdi_node")
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    try:
        watcher, executor = Watcher(name), SingleThreadedExecutor()
        executor.add_node(watcher)
        if arguments.plain or not is_drawn(sys.stdout):
            if sys.stdout.isatty() and not arguments.plain:
                print("line by line: for a view of the whole, pip install 'fdi_ros[watch]' and use a UTF-8 terminal")
            _print_lines(watcher, executor)
        else:
            _draw(watcher, executor)
    except KeyboardInterrupt:
        # The usual end.
        return 0
    finally:
        rclpy.try_shutdown()
    return 0


def _spin_for_period(watcher: Watcher, executor: Any) -> None:
    """Take what arrives in one period."""
    watcher.look()
    end = time.monotonic() + PERIOD
    while (left := end - time.monotonic()) > 0:
        executor.spin_once(timeout_sec=left)


def _print_lines(watcher: Watcher, executor: Any) -> None:
    report = LineReport()
    while True:
        _spin_for_period(watcher, executor)
        for line in report.lines(watcher.picture):
            print(line, flush=True)


def _draw(watcher: Watcher, executor: Any) -> None:
    from rich.console import Console
    from rich.live import Live

    console = Console()
    try:
        with Live(console=console, screen=True, auto_refresh=False) as live:
            while True:
                _spin_for_period(watcher, executor)
                live.update(draw(watcher.picture, console.width, console.height), refresh=True)
    finally:
        # The screen is that of before: what was seen last stays on it.
        console.print(draw(watcher.picture, console.width, 0))
