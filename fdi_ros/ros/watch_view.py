# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a person sees of a running monitor: drawn on a terminal, or reported line by line."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

from fdi_ros.monitor.diagnostics import WHOLE, Level, StatusLine, parse_number
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
SILENT = {"fused": 1.0, "diagnostics": 3.0}
"""After so long without a message the last one is no longer shown as the present state, s."""
REMEMBERED = 50
"""Changes of state."""
LATEST = 8
"""Of these, how many are drawn."""
WIDE = 90
"""Columns from which the biases have room."""
REGULAR = 10.0
"""Line by line, the state of the whole is reported at least so often, s."""


class Change(NamedTuple):
    """Channels that changed state alike."""

    at: float
    """Wall clock, s since 1970."""
    level: Level
    words: str


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
    whole: StatusLine = field(default_factory=lambda: StatusLine(Level.STALE, WHOLE, ""))
    channels: Mapping[str, StatusLine] = field(default_factory=dict)
    """By name."""
    inputs: Sequence[StatusLine] = ()
    rate: tuple[float, float, float] | None = None
    """Fused rate, rad/s."""
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
    def evidence(self) -> tuple[float, float] | None:
        """Statistic and threshold; None: no sample is judged now."""
        found = self.whole.number("statistic"), self.whole.number("threshold")
        is_stale = self.whole.level == Level.STALE or self.is_silent("diagnostics")
        return None if is_stale or not math.isfinite(found[0]) or not found[1] > 0 else found

    def format_ignored(self) -> str:
        """Say how many messages were ignored and why the last one was; empty: none."""
        some = f"{self.ignored} message{'s' if self.ignored > 1 else ''} ignored"
        return shown(f"{some}: {self.ignored_why}", LINE) if self.ignored else ""

    def update_channels(self, channels: Mapping[str, StatusLine]) -> None:
        """Keep the present channels and remember which changed state."""
        moves: dict[tuple[Level, str], list[str]] = {}
        for name, line in channels.items():
            before, state = self.channels[name].value("state") if name in self.channels else "", line.value("state")
            if state != before:
                why = f": {line.message}" if state != "OK" and line.message else ""
                words = f"{before} -> {state}{why}" if before else f"{state}{why}"
                moves.setdefault((line.level, words), []).append(name)
        self.channels = channels
        self.changed += len(moves)
        for (level, words), names in moves.items():
            who = "all" if len(names) == len(channels) else ", ".join(names)
            self.changes.append(Change(time.time(), level, shown(f"{who}  {words}", LINE)))


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
        parts.append(Text(picture.format_ignored(), style="yellow"))
    if not picture.is_silent("diagnostics"):
        parts.append(Text(shown(picture.whole.message, LINE), style=COLOURS[picture.whole.level]))
    if not picture.channels:
        return Group(*parts)
    parts += [Text(), _figure_table(picture), _channel_table(picture, width >= WIDE), *_input_lines(picture), Text()]
    for change in list(picture.changes)[: -LATEST - 1 : -1]:
        at = Text(time.strftime("%H:%M:%S  ", time.localtime(change.at)), style=GREY)
        parts.append(at.append(change.words, style=COLOURS[change.level]))
    return Group(*parts)


def _head(picture: Picture) -> Text:
    from rich.text import Text

    head = Text(f"{shown(picture.monitor) or 'fdi_ros'}  ", style="bold", no_wrap=True, overflow="ellipsis")
    if picture.is_silent("diagnostics"):
        return head.append("says nothing" if picture.heard else "", style="magenta")
    hertz, middle, late, detector = (
        shown(picture.whole.value(key) or "none")
        for key in ("sample rate (Hz)", "latency p50 (ms)", "latency p99 (ms)", "detector")
    )
    return head.append(f"{hertz} Hz  latency {middle} ms (p99 {late})  {detector}", style="not bold")


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
        level = [parse_number(text) for text in picture.whole.value("protection level (rad/s)").split()]
        known = bool(level) and all(map(math.isfinite, level))
        table.add_row("fused", f"{rate} rad/s", Text(f"within {max(level):.2g}" if known else "", style=GREY))
    if picture.evidence is None:
        table.add_row("evidence", Text("none: no sample is being judged", style=GREY))
    else:
        statistic, threshold = picture.evidence
        colour = "red" if statistic >= threshold else "cyan"
        bar = Bar(threshold, 0.0, min(statistic, threshold), color=colour)
        table.add_row("evidence", bar, f"{statistic:.3g} of {threshold:.3g}")
    return table


def _channel_table(picture: Picture, is_wide: bool) -> Table:
    """Draw one row per channel: state, residual, and where there is room the bias."""
    from rich.bar import Bar
    from rich.text import Text

    is_fresh, columns = not picture.is_silent("diagnostics"), 5 if is_wide else 4
    residuals = {name: line.number("residual (rad/s)") for name, line in picture.channels.items()}
    sizes = {name: abs(value) if math.isfinite(value) else 0.0 for name, value in residuals.items()}
    scale = next((scale for scale in SCALES if scale >= max(sizes.values())), SCALES[-1])
    table = _grid((max(len(shown(name)) for name in sizes), 9, None, 9, 18)[:columns])
    heads = ("channel", "state", f"residual, to {scale:g} rad/s", "rad/s", "bias, rad/s")
    table.add_row(*(Text(word, style=GREY) for word in heads[:columns]))
    for name, line in picture.channels.items():
        colour = COLOURS[line.level] if is_fresh else GREY
        cells = (
            # A string would be taken for markup.
            Text(shown(name)),
            Text(line.value("state") if is_fresh else "?", style=colour),
            Bar(scale, 0.0, min(sizes[name], scale) if is_fresh else 0.0, color=colour.removeprefix("bold ")),
            f"{residuals[name]:+.4f}" if is_fresh and math.isfinite(residuals[name]) else "none",
            _format_bias(line) if is_fresh else "none",
        )
        table.add_row(*cells[:columns])
    return table


def _format_bias(line: StatusLine) -> str:
    bias, std = line.number("bias (rad/s)"), line.number("bias known to (rad/s)")
    if not math.isfinite(bias):
        return "none"
    return f"{bias:+.4f}" + (f" +- {std:.4f}" if math.isfinite(std) else "")


def _input_lines(picture: Picture) -> list[Text]:
    """Return the inputs in which something is wrong; if there is none, the rates of all."""
    from rich.text import Text

    if picture.is_silent("diagnostics") or not picture.inputs:
        return []
    odd = [line for line in picture.inputs if line.level != Level.OK]
    if odd:
        return [Text(shown(f"input {line.name}: {line.message}", LINE), style=COLOURS[line.level]) for line in odd]
    rates = ", ".join(f"{line.name} {line.value('rate (Hz)')} Hz" for line in picture.inputs)
    return [Text(shown(f"inputs   {rates}", LINE), no_wrap=True, overflow="ellipsis")]


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
        whole = picture.waiting or ("" if picture.is_silent("diagnostics") else picture.whole.message)
        self._said = (picture.caption, whole, picture.ignored > 0)
        lines = [(now, picture.caption)] if picture.caption != before[0] else []
        lines += [(change.at, change.words) for change in list(picture.changes)[len(picture.changes) - new :]]
        if any(self._said[1:]) and (self._said[1:] != before[1:] or now >= self._due):
            self._due = now + REGULAR
            lines.append((now, f"{whole}{'' if picture.waiting else _format_figures(picture)}"))
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
