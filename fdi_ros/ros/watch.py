# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Watch a running monitor (fdi watch): a picture of its messages, drawn in place or printed line by line."""

from __future__ import annotations

import contextlib
import math
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node, NodeNameNonExistentError
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from sensor_msgs.msg import Imu

from fdi_ros.config.config import is_plain_name
from fdi_ros.errors import FdiError
from fdi_ros.model.quantity import FORCE, RATE
from fdi_ros.monitor.diagnostics import (
    INPUT,
    MONITOR_LINE,
    Level,
    StatusLine,
    parse_number,
)
from fdi_ros.monitor.output import ChannelState
from fdi_ros.ros.node import read_diagnostics
from fdi_ros.system.text import LINE, figures, shown

try:
    from rich.bar import Bar
    from rich.console import Console, Group
    from rich.live import Live
    from rich.table import Table
    from rich.text import Text

    CAN_DRAW = True
except ImportError:
    CAN_DRAW = False


class _WatchTimes(NamedTuple):
    """When something is shown, s."""

    #: how often the view is drawn
    drawing: float = 0.1
    #: line by line, the state of the whole is reported at least so often
    regular: float = 10.0
    #: monitors appear one by one: time until one counts as the only one
    settle: float = 1.0


WATCH_TIMES = _WatchTimes()

SERVICE = "/relearn_bias"  # a monitor has this service, before the node is configured
STATE_NAMES = {state.name for state in ChannelState}
DEEP = QoSProfile(depth=200, reliability=ReliabilityPolicy.BEST_EFFORT)
SILENT_AFTER = {
    "fused": 1.0,
    "diagnostics": 3.0,
}  # age from which a message is no longer shown, s


class _ChangesRoom(NamedTuple):
    """How many changes of state are stored and drawn."""

    #: changes of state that were not reported yet, or may be drawn
    kept: int = 50
    #: changes of state that are drawn
    shown: int = 8


CHANGES = _ChangesRoom()

COLOURS = {
    Level.OK: "green",
    Level.WARN: "yellow",
    Level.ERROR: "bold red",
    Level.STALE: "magenta",
}
GREY = "bright_black"
SCALES = tuple(digit * 10.0**power for power in range(-2, 3) for digit in (2, 5, 10))
"""Ends of a residual bar, in the unit of the channel. The least is above the noise of healthy channels."""
WIDE = 90  # columns from which the biases have room


class Change(NamedTuple):
    """Channels with the same change of state. The time counts in s since 1970."""

    #: time, s since 1970
    at: float
    #: severity of the new state
    level: Level
    #: channels and new state
    words: str


@dataclass
class Picture:
    """The newest messages of a monitor, one of each kind."""

    #: full name of the node
    monitor: str = ""
    #: notice above all others, or empty
    caption: str = ""
    #: name of the awaited monitor, or empty
    waiting: str = "looking for a monitor"
    #: start of the wait, s, monotonic clock
    since: float = field(default_factory=time.monotonic)
    #: line about the monitor as a whole
    whole: StatusLine = field(
        default_factory=lambda: StatusLine(Level.STALE, MONITOR_LINE, "")
    )
    #: line of each channel, by its name
    channels: Mapping[str, StatusLine] = field(default_factory=dict)
    #: lines about the input topics
    inputs: Sequence[StatusLine] = ()
    #: fused rate, rad/s. None: none came yet
    rate: tuple[float, float, float] | None = None
    #: when the last message of each kind came, s, monotonic clock
    heard: dict[str, float] = field(default_factory=dict)
    #: the last changes of state, the newest last
    changes: deque[Change] = field(default_factory=lambda: deque(maxlen=CHANGES.kept))

    def is_silent(self, kind: str) -> bool:
        """Whether messages of a kind have stopped, or never came."""
        return time.monotonic() - self.heard.get(kind, -math.inf) > SILENT_AFTER[kind]

    @property
    def evidence(self) -> tuple[float, float] | None:
        """Statistic and threshold, None while no sample is judged."""
        found = self.whole.number("statistic"), self.whole.number("threshold")
        is_stale = self.whole.level == Level.STALE or self.is_silent("diagnostics")
        return (
            None
            if is_stale or not math.isfinite(found[0]) or not found[1] > 0
            else found
        )

    @property
    def verdict(self) -> str:
        """Verdict on the whole: its word, and the message of the monitor."""
        word = self.whole.value("verdict")
        return f"{word}: {self.whole.message}" if word else self.whole.message

    def update_channels(self, channels: Mapping[str, StatusLine]) -> None:
        """Keep the present channels and remember which changed state."""
        moves: dict[tuple[Level, str], list[str]] = {}
        for name, line in channels.items():
            before = self.channels[name].value("state") if name in self.channels else ""
            state = line.value("state")
            if state != before:
                why = f": {line.message}" if state != "OK" and line.message else ""
                words = f"{before} -> {state}{why}" if before else f"{state}{why}"
                moves.setdefault((line.level, words), []).append(name)
        self.channels = channels
        for (level, words), names in moves.items():
            who = "all" if len(names) == len(channels) else ", ".join(names)
            self.changes.append(
                Change(time.time(), level, shown(f"{who}  {words}", LINE))
            )


class Watcher(Node):
    """Finds a monitor and keeps a picture of its messages.

    Without a name the only monitor is taken.
    """

    def __init__(self, monitor: str = "", name: str = "fdi_watch") -> None:
        super().__init__(name, start_parameter_services=False)
        self.picture = Picture(monitor)
        self._callbacks = {Imu: self._on_fused, DiagnosticArray: self._on_diagnostics}
        self._heard_on: dict[
            type, Subscription[Any]
        ] = {}  # by message type, empty before the first subscription
        self._found = math.inf

    def look(self) -> None:
        """Look for a monitor and listen. Raise `FdiError` if several run and none is named."""
        picture = self.picture
        before = picture.waiting
        picture.monitor = picture.monitor or self._choose()
        if picture.monitor:
            picture.waiting = self._listen(picture.monitor)
        else:
            picture.waiting = f"waiting for a monitor (fdi_node) on ROS_DOMAIN_ID {self.context.get_domain_id()}"
        if picture.waiting != before:
            picture.since = time.monotonic()

    def _choose(self) -> str:
        services = self.get_service_names_and_types()
        there = sorted(
            name[: -len(SERVICE)] for name, _ in services if name.endswith(SERVICE)
        )
        now = time.monotonic()
        self._found = min(self._found, now) if there else math.inf
        if not there or now - self._found < WATCH_TIMES.settle:
            return ""
        if len(there) > 1:
            names = shown(", ".join(there), LINE)
            raise FdiError(
                f"{len(there)} monitors are running: choose with --node one of {names}"
            )
        return there[0]

    def _listen(self, monitor: str) -> str:
        """Listen to a monitor if found. Return the awaited name, or empty."""
        # Anew each time: after a restart it may publish elsewhere. Others publish on
        # the same topics, as on
        # /diagnostics: that a topic has a publisher proves nothing.
        namespace, _, name = monitor.rpartition("/")
        try:
            published = self.get_publisher_names_and_types_by_node(
                name, namespace or "/"
            )
        except NodeNameNonExistentError:
            # One that comes back has published nothing yet.
            self.picture.heard.clear()
            if self._heard_on:
                return f"{monitor} is gone: waiting for it to come back"
            return (
                f"waiting for {monitor} on ROS_DOMAIN_ID {self.context.get_domain_id()}"
            )
        topics = {
            kind: topic
            for topic, kinds in published
            for kind in self._callbacks
            if kinds[0].endswith(f"/{kind.__name__}")
        }
        if len(topics) < len(self._callbacks):
            return f"{monitor} is starting, or waits for a lifecycle manager"
        if topics != {kind: one.topic_name for kind, one in self._heard_on.items()}:
            for one in self._heard_on.values():
                self.destroy_subscription(one)
            self._heard_on = {
                kind: self.create_subscription(kind, topics[kind], callback, DEEP)
                for kind, callback in self._callbacks.items()
            }
        if self.picture.is_silent("diagnostics"):
            # DDS goes on listing one that was killed for a while.
            silent = (
                f"{monitor} is silent: it was killed or hangs; "
                if "diagnostics" in self.picture.heard
                else ""
            )
            return f"{silent}waiting for diagnostics of {monitor} on {topics[DiagnosticArray]}"
        whole = self.picture.whole
        return (
            f"waiting for the first sample: {whole.message}"
            if whole.value("samples") == "0"
            else ""
        )

    # What no monitor sends is ignored: anybody may speak there.
    def _on_fused(self, message: Imu) -> None:
        rate = message.angular_velocity
        if all(map(math.isfinite, (rate.x, rate.y, rate.z))):
            self.picture.rate = (rate.x, rate.y, rate.z)
            self.picture.heard["fused"] = time.monotonic()

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        found = []
        picture = self.picture
        with contextlib.suppress(ValueError):
            found = read_diagnostics(message, picture.monitor)
        channels = {line.name: line for line in found if line.value("state")}
        if found and STATE_NAMES.issuperset(
            line.value("state") for line in channels.values()
        ):
            picture.whole = next(
                (line for line in found if line.name == MONITOR_LINE), picture.whole
            )
            picture.inputs = [
                line._replace(name=line.name.removeprefix(INPUT))
                for line in found
                if line.name.startswith(INPUT)
            ]
            picture.update_channels(channels or picture.channels)
            picture.heard["diagnostics"] = time.monotonic()


def watch(node: str = "", plain: bool = False) -> int:
    """Show a monitor, by its full name or the only one, until interrupted.

    Raise `FdiError` unless exactly one is found.
    """
    name = f"/{node.removeprefix('/')}" if node else ""
    if name and not is_plain_name(name):
        raise FdiError(
            f"--node is {node!r}, expected the full name of a node such as /drone/fdi_node"
        )
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    try:
        # The usual end.
        with contextlib.suppress(KeyboardInterrupt):
            show(Watcher(name), plain)
    finally:
        rclpy.try_shutdown()
    return 0


def show(
    watcher: Watcher, plain: bool = False, over: Callable[[], bool] = lambda: False
) -> None:
    """Show a monitor until that is over: drawn in place on a terminal, elsewhere or if plain line by line."""
    is_terminal = sys.stdout.isatty() and not plain
    showing: AbstractContextManager[Callable[[], None]] = contextlib.nullcontext(
        LineReport(watcher.picture).print
    )
    if is_terminal and CAN_DRAW and "utf" in (sys.stdout.encoding or "").lower():
        showing = drawing(watcher.picture)
    elif is_terminal:
        print(
            "line by line: for a view of the whole, pip install rich and use a UTF-8 terminal"
        )
    executor = SingleThreadedExecutor()
    executor.add_node(watcher)
    is_over = False
    with showing as show_once:
        while not is_over:
            watcher.look()
            end = time.monotonic() + WATCH_TIMES.drawing
            while (left := end - time.monotonic()) > 0:
                executor.spin_once(timeout_sec=left)
            is_over = over()
            show_once()


class LineReport:
    """Reports a monitor line by line: each change, each new state of the whole, and a line now and then."""

    def __init__(self, picture: Picture) -> None:
        self._picture = picture
        self._caption = self._said = ""
        self._due = 0.0  # when the state of the whole is reported again, s since 1970

    def print(self) -> None:
        """Print new lines since the last call."""
        for line in self.lines():
            print(line, flush=True)

    def lines(self) -> list[str]:
        """Return new lines since the last call, and take their changes out of the picture."""
        picture = self._picture
        now = time.time()
        caption = self._caption
        before = self._said
        whole = picture.waiting or (
            "" if picture.is_silent("diagnostics") else picture.verdict
        )
        self._caption = picture.caption
        self._said = whole
        lines = [(now, picture.caption)] if picture.caption != caption else []
        lines += [(change.at, change.words) for change in picture.changes]
        picture.changes.clear()
        if whole and (whole != before or now >= self._due):
            self._due = now + WATCH_TIMES.regular
            lines.append(
                (
                    now,
                    whole if picture.waiting else f"{whole}{_format_figures(picture)}",
                )
            )
        return [f"{_clock_words(at)}  {shown(words, LINE)}" for at, words in lines]


def _clock_words(at: float) -> str:
    """Return a time since 1970 as local time, to hundredths of a second."""
    seconds = time.strftime("%H:%M:%S", time.localtime(at))
    return f"{seconds}.{int(at * 100) % 100:02d}"


def _format_figures(picture: Picture) -> str:
    rate = "no fused rate"
    evidence = "nothing judged"
    if picture.rate is not None and not picture.is_silent("fused"):
        rate = f"fused rate{''.join(f' {value:+.3f}' for value in picture.rate)} rad/s"
    if picture.evidence is not None:
        statistic, threshold = map(figures, picture.evidence)
        evidence = f"evidence {statistic} of {threshold}"
    hertz, late = (
        picture.whole.value(key) or "none"
        for key in ("sample rate (Hz)", "latency p99 (ms)")
    )
    return f" | {rate} | {evidence} | {hertz} Hz, latency p99 {late} ms"


# Drawn on a terminal ------------------------------------------------------------------
# ------------------------------


@contextlib.contextmanager
def drawing(picture: Picture) -> Iterator[Callable[[], None]]:
    """Yield a function that draws a monitor on a screen of its own.

    The last picture stays on the former screen.
    """
    console = Console()
    try:
        with Live(console=console, screen=True, auto_refresh=False) as live:
            yield lambda: live.update(draw(picture, console.width), refresh=True)
    finally:
        console.print(draw(picture, console.width))


def draw(picture: Picture, width: int) -> Group:
    """Draw a monitor, no line wider than the terminal."""
    parts: list[Text | Table] = (
        [Text(shown(picture.caption, LINE), style="bold")] if picture.caption else []
    )
    parts.append(_head(picture))
    if picture.waiting:
        waited = time.monotonic() - picture.since
        parts.append(
            Text(f"{shown(picture.waiting, LINE)} ... {waited:.0f} s", style="yellow")
        )
    if not picture.is_silent("diagnostics"):
        parts.append(
            Text(shown(picture.verdict, LINE), style=COLOURS[picture.whole.level])
        )
    if not picture.channels:
        return Group(*parts)
    parts += [
        Text(),
        _figure_table(picture),
        _channel_table(picture, width >= WIDE),
        *_input_lines(picture),
        Text(),
    ]
    for change in list(picture.changes)[: -CHANGES.shown - 1 : -1]:
        at = Text(time.strftime("%H:%M:%S  ", time.localtime(change.at)), style=GREY)
        parts.append(at.append(change.words, style=COLOURS[change.level]))
    return Group(*parts)


def _head(picture: Picture) -> Text:
    head = Text(
        f"{shown(picture.monitor) or 'fdi_ros'}  ",
        style="bold",
        no_wrap=True,
        overflow="ellipsis",
    )
    if picture.is_silent("diagnostics"):
        return head.append("says nothing" if picture.heard else "", style="magenta")
    keys = ("sample rate (Hz)", "latency p50 (ms)", "latency p99 (ms)", "detector")
    hertz, middle, late, detector = (
        shown(picture.whole.value(key) or "none") for key in keys
    )
    return head.append(
        f"{hertz} Hz  latency {middle} ms (p99 {late})  {detector}", style="not bold"
    )


def _grid(widths: Sequence[int | None]) -> Table:
    """Make a table without lines. A width of None takes the rest of the terminal."""
    table = Table.grid(padding=(0, 1), expand=True)
    for wide in widths:
        table.add_column(
            width=wide,
            ratio=1 if wide is None else None,
            no_wrap=True,
            overflow="ellipsis",
        )
    return table


def _figure_table(picture: Picture) -> Table:
    """Draw the fused rate, and the statistic against its threshold: the evidence of all channels together."""
    table = _grid((8, None, 14))
    if picture.rate is None or picture.is_silent("fused"):
        table.add_row("fused", Text("no rate", style="bold red"))
    else:
        rate = "  ".join(
            f"{axis} {value:+.3f}"
            for axis, value in zip("xyz", picture.rate, strict=True)
        )
        level = [
            parse_number(text)
            for text in picture.whole.value("protection level (rad/s)").split()
        ]
        known = bool(level) and all(map(math.isfinite, level))
        table.add_row(
            "fused",
            f"{rate} rad/s",
            Text(f"within {max(level):.2g}" if known else "", style=GREY),
        )
    if picture.evidence is None:
        table.add_row("evidence", Text("none: no sample is being judged", style=GREY))
    else:
        statistic, threshold = picture.evidence
        bar = Bar(
            threshold,
            0.0,
            min(statistic, threshold),
            color="red" if statistic >= threshold else "cyan",
        )
        table.add_row("evidence", bar, f"{figures(statistic)} of {figures(threshold)}")
    return table


def _channel_table(picture: Picture, is_wide: bool) -> Table:
    """Draw one row per channel: state, residual, and the bias if the width allows.

    Gyros come first, then accelerometers, each with a scale in their own unit.
    """
    is_fresh = not picture.is_silent("diagnostics")
    columns = 5 if is_wide else 4
    longest = max(len(shown(name)) for name in picture.channels)
    table = _grid((longest, 9, None, 9, 18)[:columns])
    for unit in (RATE.unit, FORCE.unit):
        lines = {
            name: line
            for name, line in picture.channels.items()
            if _unit_of(line) == unit
        }
        if lines:
            for cells in _channel_rows(lines, unit, is_fresh):
                table.add_row(*cells[:columns])
    return table


def _unit_of(line: StatusLine) -> str:
    """Return the unit of a channel: names of its values end with it."""
    has_force = any(name.endswith(f"({FORCE.unit})") for name, _ in line.values)
    return FORCE.unit if has_force else RATE.unit


def _channel_rows(
    lines: Mapping[str, StatusLine], unit: str, is_fresh: bool
) -> Iterator[Sequence[Text | Bar | str]]:
    """Yield the heads, then a row for each channel."""
    residuals = {
        name: line.number(f"residual ({unit})") for name, line in lines.items()
    }
    sizes = {
        name: abs(value) if math.isfinite(value) else 0.0
        for name, value in residuals.items()
    }
    largest = max(sizes.values())
    scale = next((scale for scale in SCALES if scale >= largest), SCALES[-1])
    heads = (
        "channel",
        "state",
        f"residual, to {scale:g} {unit}",
        unit,
        f"bias, {unit}",
    )
    yield [Text(word, style=GREY) for word in heads]
    for name, line in lines.items():
        # A string would be taken for markup.
        cells: list[Text | Bar | str] = [
            Text(shown(name)),
            Text("?", style=GREY),
            Bar(scale, 0.0, 0.0),
            "none",
            "none",
        ]
        if is_fresh:
            colour = COLOURS[line.level]
            residual = residuals[name]
            bar = Bar(
                scale, 0.0, min(sizes[name], scale), color=colour.removeprefix("bold ")
            )
            figure = f"{residual:+.4f}" if math.isfinite(residual) else "none"
            state = Text(line.value("state"), style=colour)
            cells[1:] = [state, bar, figure, _format_bias(line, unit)]
        yield cells


def _format_bias(line: StatusLine, unit: str) -> str:
    bias = line.number(f"bias ({unit})")
    std = line.number(f"bias known to ({unit})")
    known = f" +- {std:.4f}" if math.isfinite(std) else ""
    return f"{bias:+.4f}{known}" if math.isfinite(bias) else "none"


def _input_lines(picture: Picture) -> list[Text]:
    """Return the inputs with a fault, or the rates of all inputs if none has one."""
    if picture.is_silent("diagnostics") or not picture.inputs:
        return []
    odd = [line for line in picture.inputs if line.level != Level.OK]
    if odd:
        return [
            Text(
                shown(f"input {line.name}: {line.message}", LINE),
                style=COLOURS[line.level],
            )
            for line in odd
        ]
    rates = ", ".join(
        f"{line.name} {line.value('rate (Hz)')} Hz" for line in picture.inputs
    )
    return [Text(shown(f"inputs   {rates}", LINE), no_wrap=True, overflow="ellipsis")]
