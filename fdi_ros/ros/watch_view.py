# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a person sees of a running monitor: drawn on a terminal, or reported line by line."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from fdi_ros.monitor.diagnostics import Level
from fdi_ros.monitor.output import ChannelState
from fdi_ros.system.limits import LINE
from fdi_ros.system.text import shown

if TYPE_CHECKING:
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

COLOURS = {Level.OK: "green", Level.WARN: "yellow", Level.ERROR: "bold red", Level.STALE: "magenta"}
GREY = "bright_black"
SCALES = tuple(digit * 10.0**power for power in range(-2, 3) for digit in (2, 5, 10))
"""What a residual bar may end at, rad/s; the least is above the noise of healthy channels."""
SILENT = {"integrity": 1.0, "fused": 1.0, "diagnostics": 3.0}
"""After so long without a message the last one is no longer shown as the present state, s."""
REMEMBERED = 50
"""Changes of state."""
LATEST = 8
"""Of these, how many are drawn."""
WIDE = 90
"""Columns from which the biases have room."""
REGULAR = 10.0
"""Line by line, the state of the whole is reported at least so often, s."""


@dataclass
class Channel:
    """One channel, from its diagnostics."""

    state: ChannelState
    level: Level
    words: str
    """On its state."""
    since: float
    """Stamp of the sample that brought the state, s."""
    residual: float
    """rad/s; NaN: none, as for the bias and its standard deviation."""
    bias: float
    bias_std: float


@dataclass
class Change:
    """Channels that changed state alike."""

    at: float
    """Wall clock, s since 1970."""
    names: tuple[str, ...]
    before: ChannelState | None
    after: ChannelState
    level: Level
    words: str

    def text(self, total: int) -> str:
        """Say it in a line; of all channels together as "all"."""
        names = "all" if len(self.names) == total else ", ".join(self.names)
        was = f"{self.before.name} -> " if self.before is not None else ""
        return shown(f"{names}  {was}{self.after.name}" + (f": {self.words}" if self.words else ""), LINE)


@dataclass
class Input:
    """One input of the monitor, from its diagnostics."""

    name: str
    level: Level
    words: str
    rate: str


@dataclass
class Picture:
    """What a monitor has published so far; the figures are those of the last message of each kind."""

    monitor: str = ""
    """Full name of the node."""
    caption: str = ""
    """What else is to be known, above all; empty: nothing."""
    waiting: str = "looking for a monitor"
    """What is waited for; empty: nothing."""
    since: float = field(default_factory=time.monotonic)
    """When waiting for it began, s, monotonic clock."""
    channels: Mapping[str, Channel] = field(default_factory=dict)
    """By name."""
    statistic: float = math.nan
    threshold: float = math.nan
    level: tuple[float, ...] = ()
    """Protection level of the fused rate about x, y, z, rad/s."""
    rate: tuple[float, float, float] | None = None
    """Fused rate, rad/s."""
    whole: str = ""
    whole_level: Level = Level.STALE
    figures: Mapping[str, str] = field(default_factory=dict)
    """Of the whole."""
    inputs: list[Input] = field(default_factory=list)
    heard: dict[str, float] = field(default_factory=dict)
    """When the last message of each kind came, s, monotonic clock."""
    changes: deque[Change] = field(default_factory=lambda: deque(maxlen=REMEMBERED))
    changed: int = 0
    """How many changes there were."""
    ignored: int = 0
    """Messages that no monitor sends: nothing was taken from them."""
    ignored_why: str = ""
    """Why the last of them."""

    def is_silent(self, kind: str) -> bool:
        """Whether messages of a kind have stopped, or never came."""
        return time.monotonic() - self.heard.get(kind, -math.inf) > SILENT[kind]

    @property
    def is_judged(self) -> bool:
        """Whether there is a statistic to be shown."""
        return math.isfinite(self.statistic) and self.threshold > 0 and not self.is_silent("integrity")

    def ignored_words(self) -> str:
        """Say how many messages were ignored and why the last one was; empty: none."""
        some = f"{self.ignored} message{'s' if self.ignored > 1 else ''} ignored"
        return f"{some}: {self.ignored_why}" if self.ignored else ""

    def update_channels(self, channels: Mapping[str, Channel]) -> None:
        """Take the present channels and remember which changed state."""
        moves: dict[tuple[ChannelState | None, ChannelState, Level, str], list[str]] = {}
        for name, channel in channels.items():
            before = self.channels[name].state if name in self.channels else None
            if channel.state is not before:
                words = "" if channel.state is ChannelState.OK else channel.words
                moves.setdefault((before, channel.state, channel.level, words), []).append(name)
        self.channels = channels
        self.changed += len(moves)
        self.changes += [Change(time.time(), tuple(names), *move) for move, names in moves.items()]


# Drawn ----------------------------------------------------------------------------------------------------------------


def draw(picture: Picture, width: int) -> Group:
    """Draw a monitor, no line wider than the terminal."""
    from rich.console import Group
    from rich.text import Text

    parts: list[Text | Table] = [Text(shown(picture.caption, LINE), style="bold")] if picture.caption else []
    parts.append(_head(picture))
    if picture.waiting:
        waited = time.monotonic() - picture.since
        parts.append(Text(f"{shown(picture.waiting, LINE)} ... {waited:.0f} s", style="yellow"))
    if picture.ignored:
        parts.append(Text(shown(picture.ignored_words(), LINE), style="yellow"))
    if not picture.channels:
        return Group(*parts)
    if not picture.is_silent("diagnostics"):
        parts.append(Text(shown(picture.whole, LINE), style=COLOURS[picture.whole_level]))
    parts += [Text(), _figure_table(picture), _channel_table(picture, width >= WIDE), *_input_lines(picture), Text()]
    for change in list(picture.changes)[: -LATEST - 1 : -1]:
        at = Text(time.strftime("%H:%M:%S  ", time.localtime(change.at)), style=GREY)
        parts.append(at.append(change.text(len(picture.channels)), style=COLOURS[change.level]))
    return Group(*parts)


def _head(picture: Picture) -> Text:
    from rich.text import Text

    head = Text(f"{shown(picture.monitor) or 'fdi_ros'}  ", style="bold", no_wrap=True, overflow="ellipsis")
    if picture.is_silent("diagnostics"):
        return head.append("says nothing" if picture.heard else "", style="magenta")
    hertz, middle, late = (
        picture.figures.get(key, "none") for key in ("sample rate (Hz)", "latency p50 (ms)", "latency p99 (ms)")
    )
    figures = [f"{hertz} Hz", f"latency {middle} ms (p99 {late})", picture.figures.get("detector", "")]
    return head.append("  ".join(map(shown, figures)), style="not bold")


def _grid(widths: Sequence[int | None]) -> Table:
    """Make a table without lines; None: the column that takes what is left of the terminal."""
    from rich.table import Table

    table = Table.grid(padding=(0, 1), expand=True)
    for wide in widths:
        table.add_column(width=wide, ratio=1 if wide is None else None, no_wrap=True, overflow="ellipsis")
    return table


def _figure_table(picture: Picture) -> Table:
    """Draw the fused rate, and the statistic against its threshold: the evidence of all channels together."""
    from rich.bar import Bar
    from rich.text import Text

    table = _grid((8, None, 14))
    if picture.rate is None or picture.is_silent("fused"):
        table.add_row("fused", Text("no rate", style="bold red"))
    else:
        rate = "  ".join(f"{axis} {value:+.3f}" for axis, value in zip("xyz", picture.rate, strict=True))
        known = bool(picture.level) and all(map(math.isfinite, picture.level))
        table.add_row("fused", f"{rate} rad/s", Text(f"within {max(picture.level):.2g}" if known else "", style=GREY))
    if not picture.is_judged:
        table.add_row("evidence", Text("none: no sample is being judged", style=GREY))
    else:
        colour = "red" if picture.statistic >= picture.threshold else "cyan"
        bar = Bar(picture.threshold, 0.0, min(picture.statistic, picture.threshold), color=colour)
        table.add_row("evidence", bar, f"{picture.statistic:.3g} of {picture.threshold:.3g}")
    return table


def _channel_table(picture: Picture, is_wide: bool) -> Table:
    """Draw one row per channel: state, residual, and where there is room the bias."""
    from rich.bar import Bar
    from rich.text import Text

    is_fresh, columns = not picture.is_silent("diagnostics"), 5 if is_wide else 4
    sizes = {name: abs(one.residual) if math.isfinite(one.residual) else 0.0 for name, one in picture.channels.items()}
    scale = next((scale for scale in SCALES if scale >= max(sizes.values())), SCALES[-1])
    table = _grid((max(len(shown(name)) for name in sizes), 9, None, 9, 18)[:columns])
    heads = ("channel", "state", f"residual, to {scale:g} rad/s", "rad/s", "bias, rad/s")
    table.add_row(*(Text(word, style=GREY) for word in heads[:columns]))
    for name, channel in picture.channels.items():
        colour = COLOURS[channel.level] if is_fresh else GREY
        cells = (
            # A string would be taken for markup.
            Text(shown(name)),
            Text(channel.state.name if is_fresh else "?", style=colour),
            Bar(scale, 0.0, min(sizes[name], scale) if is_fresh else 0.0, color=colour.removeprefix("bold ")),
            f"{channel.residual:+.4f}" if is_fresh and math.isfinite(channel.residual) else "none",
            _bias_words(channel) if is_fresh else "none",
        )
        table.add_row(*cells[:columns])
    return table


def _bias_words(channel: Channel) -> str:
    if not math.isfinite(channel.bias):
        return "none"
    return f"{channel.bias:+.4f}" + (f" +- {channel.bias_std:.4f}" if math.isfinite(channel.bias_std) else "")


def _input_lines(picture: Picture) -> list[Text]:
    """Return the inputs in which something is wrong; if there is none, the rates of all."""
    from rich.text import Text

    if picture.is_silent("diagnostics") or not picture.inputs:
        return []
    odd = [unit for unit in picture.inputs if unit.level != Level.OK]
    if odd:
        return [Text(shown(f"input {unit.name}: {unit.words}", LINE), style=COLOURS[unit.level]) for unit in odd]
    rates = ", ".join(f"{unit.name} {unit.rate} Hz" for unit in picture.inputs)
    return [Text(shown(f"inputs   {rates}", LINE), no_wrap=True, overflow="ellipsis")]


# Line by line ---------------------------------------------------------------------------------------------------------


class LineReport:
    """Reports a monitor line by line: each change, each new state of the whole, and a line now and then."""

    def __init__(self) -> None:
        self._changed = 0
        """Changes reported."""
        self._said: tuple[str, str, bool] = ("", "", False)
        self._due = 0.0
        """When the state of the whole is reported again, s since 1970."""

    def lines(self, picture: Picture) -> list[str]:
        """Return what is new since the last time."""
        now, before = time.time(), self._said
        new, self._changed = min(picture.changed - self._changed, len(picture.changes)), picture.changed
        whole = picture.waiting or ("" if picture.is_silent("diagnostics") else picture.whole)
        self._said = (picture.caption, whole, picture.ignored > 0)
        changes = list(picture.changes)[len(picture.changes) - new :]
        lines = [(now, picture.caption)] if picture.caption != before[0] else []
        lines += [(change.at, change.text(len(picture.channels))) for change in changes]
        if any(self._said[1:]) and (self._said[1:] != before[1:] or now >= self._due):
            self._due = now + REGULAR
            lines.append((now, f"{whole}{'' if picture.waiting else _figures(picture)}"))
            lines += [(now, picture.ignored_words())] if picture.ignored else []
        return [
            f"{time.strftime('%H:%M:%S', time.localtime(at))}.{int(at * 100) % 100:02d}  {shown(words, LINE)}"
            for at, words in lines
        ]


def _figures(picture: Picture) -> str:
    if picture.rate is None or picture.is_silent("fused"):
        rate = "no fused rate"
    else:
        rate = f"fused rate{''.join(f' {value:+.3f}' for value in picture.rate)} rad/s"
    hertz, late = (picture.figures.get(key, "none") for key in ("sample rate (Hz)", "latency p99 (ms)"))
    evidence = f"evidence {picture.statistic:.3g} of {picture.threshold:.3g}" if picture.is_judged else "nothing judged"
    return f" | {rate} | {evidence} | {hertz} Hz, p99 {late} ms"
