# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Watch a running monitor: fdi watch."""

from __future__ import annotations

import importlib.util
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, TextIO

from fdi_ros.config.config import is_plain_name
from fdi_ros.errors import FdiError
from fdi_ros.ros.process import NO_ROS
from fdi_ros.ros.watch_view import LineReport, draw

if TYPE_CHECKING:
    from fdi_ros.ros.watch_node import Watcher

PERIOD = 0.1
"""How often the view is drawn, s."""


def can_be_drawn_on(out: TextIO) -> bool:
    """Whether an output is a terminal that shows more than ASCII, and rich is there to draw on it."""
    return out.isatty() and "utf" in (out.encoding or "").lower() and importlib.util.find_spec("rich") is not None


def watch(node: str = "", plain: bool = False) -> int:
    """Show a monitor until interrupted.

    Parameters
    ----------
    node
        Full name of the monitor; empty: the only one that is running.
    plain
        Line by line also on a terminal.

    Returns
    -------
    The exit code.

    Raises
    ------
    FdiError
        If ROS 2 is not there, or there are several monitors and none is named.
    """
    try:
        import rclpy
        from rclpy.signals import SignalHandlerOptions
    except ImportError as error:
        raise FdiError(f"watch {NO_ROS} ({error})") from error
    from fdi_ros.ros.watch_node import Watcher

    name = node
    if name and not name.startswith("/"):
        name = f"/{name}"
    if name and not is_plain_name(name):
        raise FdiError(f"--node is {node!r}, expected the full name of a node such as /drone/fdi_node")
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    try:
        show(Watcher(name), plain)
    except KeyboardInterrupt:
        # The usual end.
        return 0
    finally:
        rclpy.try_shutdown()
    return 0


def show(watcher: Watcher, plain: bool = False, over: Callable[[], bool] = lambda: False) -> None:
    """Show a monitor until that is over: drawn in place on a terminal, elsewhere or if plain line by line."""
    if not plain and can_be_drawn_on(sys.stdout):
        from rich.console import Console
        from rich.live import Live

        console = Console()
        try:
            with Live(console=console, screen=True, auto_refresh=False) as live:
                _repeat(watcher, lambda: live.update(draw(watcher.picture, console.width), refresh=True), over)
        finally:
            # The screen is that of before: what was seen last stays on it.
            console.print(draw(watcher.picture, console.width))
        return
    if sys.stdout.isatty() and not plain:
        print("line by line: for a view of the whole, pip install rich and use a UTF-8 terminal")
    report = LineReport()

    def print_lines() -> None:
        for line in report.lines(watcher.picture):
            print(line, flush=True)

    _repeat(watcher, print_lines, over)


def _repeat(watcher: Watcher, show_once: Callable[[], None], over: Callable[[], bool]) -> None:
    """Take what arrives and show it, once in a period."""
    from rclpy.executors import SingleThreadedExecutor

    executor = SingleThreadedExecutor()
    executor.add_node(watcher)
    is_over = False
    while not is_over:
        watcher.look()
        end = time.monotonic() + PERIOD
        while (left := end - time.monotonic()) > 0:
            executor.spin_once(timeout_sec=left)
        is_over = over()
        show_once()
