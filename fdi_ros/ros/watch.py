# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Watch a running monitor, fdi watch: drawn in place on a terminal, or line by line."""

from __future__ import annotations

import importlib.util
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from fdi_ros.config.config import is_plain_name
from fdi_ros.errors import FdiError
from fdi_ros.ros.process import NO_ROS
from fdi_ros.system.limits import LINE
from fdi_ros.system.text import shown

if TYPE_CHECKING:
    from fdi_ros.ros.watch_node import Picture, Watcher

PERIOD = 0.1  # how often the view is drawn, s
REGULAR = 10.0  # line by line, the state of the whole is reported at least so often, s


def watch(node: str = "", plain: bool = False) -> int:
    """Show a monitor until interrupted, and return the exit code; `FdiError` if there is no ROS 2, or not one monitor.

    Without the full name of a node it is the only monitor that is running. Plain is line by line also on a terminal.
    """
    try:
        import rclpy
        from rclpy.signals import SignalHandlerOptions
    except ImportError as error:
        raise FdiError(f"watch {NO_ROS} ({error})") from error
    from fdi_ros.ros.watch_node import Watcher

    name = f"/{node.removeprefix('/')}" if node else ""
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
    out = sys.stdout
    is_terminal = out.isatty() and not plain
    if is_terminal and "utf" in (out.encoding or "").lower() and importlib.util.find_spec("rich") is not None:
        from rich.console import Console
        from rich.live import Live

        from fdi_ros.ros.watch_view import draw

        console = Console()
        try:
            with Live(console=console, screen=True, auto_refresh=False) as live:
                _repeat(watcher, lambda: live.update(draw(watcher.picture, console.width), refresh=True), over)
        finally:
            # The screen is that of before: what was seen last stays on it.
            console.print(draw(watcher.picture, console.width))
        return
    if is_terminal:
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


class LineReport:
    """Reports a monitor line by line: each change, each new state of the whole, and a line now and then."""

    def __init__(self) -> None:
        self._changed = 0  # changes reported
        self._caption, self._said = "", ("", False)
        self._due = 0.0  # when the state of the whole is reported again, s since 1970

    def lines(self, picture: Picture) -> list[str]:
        """Return what is new since the last time."""
        now, caption, before = time.time(), self._caption, self._said
        new, self._changed = min(picture.changed - self._changed, len(picture.changes)), picture.changed
        whole = picture.waiting or ("" if picture.is_silent("diagnostics") else picture.whole.message)
        self._caption, self._said = picture.caption, (whole, picture.ignored > 0)
        lines = [(now, picture.caption)] if picture.caption != caption else []
        lines += [(change.at, change.words) for change in list(picture.changes)[len(picture.changes) - new :]]
        if any(self._said) and (self._said != before or now >= self._due):
            self._due = now + REGULAR
            lines.append((now, whole if picture.waiting else f"{whole}{_format_figures(picture)}"))
            lines += [(now, picture.format_ignored())] if picture.ignored else []
        return [
            f"{time.strftime('%H:%M:%S', time.localtime(at))}.{int(at * 100) % 100:02d}  {shown(words, LINE)}"
            for at, words in lines
        ]


def _format_figures(picture: Picture) -> str:
    rate, evidence = "no fused rate", "nothing judged"
    if picture.rate is not None and not picture.is_silent("fused"):
        rate = f"fused rate{''.join(f' {value:+.3f}' for value in picture.rate)} rad/s"
    if picture.evidence is not None:
        evidence = "evidence {:.3g} of {:.3g}".format(*picture.evidence)
    hertz, late = (picture.whole.value(key) or "none" for key in ("sample rate (Hz)", "latency p99 (ms)"))
    return f" | {rate} | {evidence} | {hertz} Hz, p99 {late} ms"
