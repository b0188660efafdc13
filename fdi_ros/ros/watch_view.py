# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a person sees of a running monitor: drawn on a terminal, or reported line by line."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from fdi_ros.limits import LINE
from fdi_ros.monitor.diagnostics import Level
from fdi_ros.monitor.output import ChannelState
from fdi_ros.text import shown

if TYPE_CHECKING:
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

COLOURS = {
    ChannelState.OK: "green",
    ChannelState.SUSPECT: "yellow",
    ChannelState.AMBIGUOUS: "yellow",
    ChannelState.FAULTY: "bold red",
    ChannelState.STALE: "magenta",
}
LEVEL_COLOURS = {Level.OK: "green", Level.WARN: "yellow", Level.ERROR: "bold red", Level.STALE: "magenta"}
GREY = "bright_black"
SCALES = tuple(digit * 10.0**power for power in range(-3, 3) for digit in (1, 2, 5))
"""What a residual bar may end at, rad/s."""
BEYOND = 1.25
"""The bar of the statistic ends at so many thresholds: how far beyond does not matter."""
SILENT = {"integrity": 1.0, "fused": 1.0, "diagnostics": 3.0}
"""After so long without a message the last one is no longer shown as the present state, s."""
REMEMBERED = 50
"""Changes of state."""
WIDE = 90
"""Columns from which the biases have room."""
LEAST_EVENTS = 3
"""The last changes of state are shown even where there is little room for them."""
WORDS_TIMEOUT = 1.2
"""The words to a change come with the next diagnostics, in a second at most; then it is reported without, s."""


@dataclass
class Change:
    """Channels that changed state alike."""

    at: float
    """Wall clock, s since 1970."""
    names: tuple[str, ...]
    before: ChannelState | None
    after: ChannelState
    words: str = ""
    """From the diagnostics; empty: none yet."""

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
    waiting: str = "looking for a monitor"
    """What is waited for; empty: nothing."""
    since: float = field(default_factory=time.monotonic)
    """When waiting for it began, s, monotonic clock."""
    names: tuple[str, ...] = ()
    states: tuple[ChannelState, ...] = ()
    statistic: float = math.nan
    threshold: float = math.nan
    level: tuple[float, ...] = ()
    """Protection level of the fused rate about x, y, z, rad/s."""
    rate: tuple[float, float, float] | None = None
    """Fused rate, rad/s."""
    whole: str = ""
    whole_level: Level = Level.STALE
    figures: dict[str, str] = field(default_factory=dict)
    """Of the whole."""
    words: dict[str, tuple[str, str]] = field(default_factory=dict)
    """Of each channel: its state, and the message of its diagnostics."""
    residuals: dict[str, float] = field(default_factory=dict)
    """Of each channel, rad/s; NaN: none."""
    biases: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Of each channel, and what is known of it, standard deviation, rad/s; NaN: not estimated."""
    inputs: list[Input] = field(default_factory=list)
    heard: dict[str, float] = field(default_factory=dict)
    """When the last message of each kind came, s, monotonic clock."""
    changes: deque[Change] = field(default_factory=lambda: deque(maxlen=REMEMBERED))
    ignored: int = 0
    """Messages that no monitor sends: nothing was taken from them."""
    ignored_why: str = ""
    """Why the last of them."""

    def is_silent(self, kind: str) -> bool:
        """Whether messages of a kind have stopped, or never came."""
        return time.monotonic() - self.heard.get(kind, -math.inf) > SILENT[kind]

    def name(self, channel: int) -> str:
        """Name of a channel; its number before the diagnostics have come."""
        return self.names[channel] if channel < len(self.names) else f"channel {channel}"

    def ignored_words(self) -> str:
        """Say how many messages were ignored and why the last one was; empty: none."""
        some = f"{self.ignored} message{'s' if self.ignored > 1 else ''} left aside"
        return f"{some}: {self.ignored_why}" if self.ignored else ""

    def take_states(self, states: Sequence[ChannelState]) -> None:
        """Take the states of all channels and remember what changed."""
        before: Sequence[ChannelState | None] = self.states if len(self.states) == len(states) else [None] * len(states)
        moves: dict[tuple[ChannelState | None, ChannelState], list[int]] = {}
        for channel, (was, state) in enumerate(zip(before, states, strict=True)):
            if state is not was:
                moves.setdefault((was, state), []).append(channel)
        self.states = tuple(states)
        for (was, state), channels in moves.items():
            self.changes.append(Change(time.time(), tuple(map(self.name, channels)), was, state))

    def find_words(self) -> None:
        """Give the changes their words from the diagnostics."""
        for change in self.changes:
            state, words = self.words.get(change.names[0], ("", ""))
            if not change.words and state == change.after.name and change.after is not ChannelState.OK:
                change.words = words


def scale_of(picture: Picture) -> float:
    """Where the residual bars end, rad/s: above the greatest residual and the noise of healthy channels."""
    greatest = max((abs(value) for value in picture.residuals.values() if math.isfinite(value)), default=0.0)
    return next((scale for scale in SCALES if scale >= max(greatest, 0.02)), SCALES[-1])


def bar(share: float, width: int, mark: float | None = None) -> str:
    """Draw a bar of a share of the width, with a mark where a threshold stands."""
    full = round(min(max(share, 0.0), 1.0) * width) if math.isfinite(share) else 0
    cells = ["█"] * full + ["·"] * (width - full)
    if mark is not None:
        cells[min(round(mark * width), width - 1)] = "┃"
    return "".join(cells)


def statistic_line(picture: Picture, width: int) -> Text:
    """Draw the statistic against its threshold: the evidence of all channels together."""
    from rich.text import Text

    known = math.isfinite(picture.statistic) and picture.threshold > 0 and not picture.is_silent("integrity")
    if not known:
        return Text("evidence  none: no sample is being judged", style=GREY, no_wrap=True, overflow="ellipsis")
    figures = f" {picture.statistic:.3g} of {picture.threshold:.3g}"
    alarm = picture.statistic >= picture.threshold
    line = Text("evidence  ", no_wrap=True, overflow="ellipsis")
    drawn = bar(picture.statistic / picture.threshold / BEYOND, max(8, width - 12 - len(figures)), 1 / BEYOND)
    return line.append(drawn, style="red" if alarm else "cyan").append(figures)


def channel_table(picture: Picture, width: int) -> Table:
    """Draw one row per channel: state and residual."""
    from rich.table import Table
    from rich.text import Text

    scale, fresh = scale_of(picture), not picture.is_silent("integrity")
    names = [shown(picture.name(k)) for k in range(len(picture.states))]
    room = max([7, *map(len, names)])
    more = width >= WIDE
    length = max(6, width - room - 9 - 10 - 4 - (19 if more else 0))
    table = Table.grid(padding=(0, 1))
    for wide in (room, 9, length, 9, 18)[: 5 if more else 4]:
        table.add_column(width=wide, no_wrap=True, overflow="ellipsis")
    heads = ("channel", "state", f"residual, to {scale:g} rad/s", "rad/s", "bias, rad/s")[: 5 if more else 4]
    table.add_row(*(Text(word, style=GREY) for word in heads))
    has_residuals = not picture.is_silent("diagnostics")
    for k, state in enumerate(picture.states):
        colour = COLOURS.get(state, GREY) if fresh else GREY
        residual = picture.residuals.get(picture.name(k), math.nan) if has_residuals else math.nan
        table.add_row(
            # A string would be taken for markup.
            Text(names[k]),
            Text(state.name if fresh else "?", style=colour),
            Text(bar(abs(residual) / scale, length), style=colour if state is not ChannelState.OK else "cyan"),
            f"{residual:+.4f}" if math.isfinite(residual) else "none",
            *([_bias_words(picture, k)] if more else []),
        )
    return table


def _bias_words(picture: Picture, k: int) -> str:
    value, std = picture.biases.get(picture.name(k), (math.nan, math.nan))
    if picture.is_silent("diagnostics") or not math.isfinite(value):
        return "none"
    return f"{value:+.4f}" + (f" +- {std:.4f}" if math.isfinite(std) else "")


def _head(picture: Picture, width: int) -> Text:
    from rich.text import Text

    head = Text(f"{shown(picture.monitor) or 'fdi_ros'}  ", style="bold", no_wrap=True, overflow="ellipsis")
    if picture.is_silent("diagnostics"):
        return head.append("says nothing" if picture.heard else "", style="magenta")
    hertz, middle, late = (
        picture.figures.get(key, "none") for key in ("sample rate (Hz)", "latency p50 (ms)", "latency p99 (ms)")
    )
    figures = [f"{hertz} Hz", f"latency {middle} ms (p99 {late})", picture.figures.get("detector", "")]
    return head.append("  ".join(map(shown, figures)), style="not bold")


def _rate_line(picture: Picture) -> Text:
    from rich.text import Text

    line = Text("fused     ", no_wrap=True, overflow="ellipsis")
    if picture.rate is None or picture.is_silent("fused"):
        return line.append("no rate", style="bold red")
    line.append("  ".join(f"{axis} {value:+.3f}" for axis, value in zip("xyz", picture.rate, strict=True)) + " rad/s")
    if picture.level and all(map(math.isfinite, picture.level)):
        line.append(f"  within {max(picture.level):.2g}", style=GREY)
    return line


def draw(picture: Picture, width: int, height: int) -> Group:
    """Draw a monitor, no line wider than the terminal; where there is room, with space between the parts."""
    from rich.console import Group
    from rich.text import Text

    parts: list[Text | Table] = [_head(picture, width)]
    if picture.waiting:
        parts.append(
            Text(f"{shown(picture.waiting, LINE)} ... {time.monotonic() - picture.since:.0f} s", style="yellow")
        )
    if picture.ignored:
        parts.append(Text(shown(picture.ignored_words(), LINE), style="yellow"))
    if not picture.states:
        return Group(*parts)
    if not picture.is_silent("diagnostics"):
        parts.append(Text(shown(picture.whole, LINE), style=LEVEL_COLOURS[picture.whole_level]))
    needed = len(picture.states) + 12
    space = [Text()] if height >= needed + LEAST_EVENTS else []
    parts += [*space, _rate_line(picture), statistic_line(picture, width), *space, channel_table(picture, width)]
    inputs = [] if picture.is_silent("diagnostics") else picture.inputs
    odd = [unit for unit in inputs if unit.level != Level.OK]
    parts += [Text(shown(f"input {unit.name}: {unit.words}", LINE), style=LEVEL_COLOURS[unit.level]) for unit in odd]
    if inputs and not odd:
        rates = ", ".join(f"{unit.name} {unit.rate} Hz" for unit in inputs)
        parts.append(Text(shown(f"inputs    {rates}", LINE), no_wrap=True, overflow="ellipsis"))
    return Group(*parts, *space, *event_lines(picture, max(LEAST_EVENTS, height - needed)))


def event_lines(picture: Picture, count: int) -> list[Text]:
    """Return the last changes of state, the newest first."""
    from rich.text import Text

    lines = []
    for change in list(picture.changes)[: -count - 1 : -1]:
        at = time.strftime("%H:%M:%S", time.localtime(change.at))
        text = Text(f"{at}  ", style=GREY)
        lines.append(text.append(change.text(len(picture.states)), style=COLOURS.get(change.after, GREY)))
    return lines


class LineReport:
    """Reports a monitor line by line: each change, each new state of the whole, and a line now and then."""

    EVERY = 10.0
    """The regular line, s."""

    def __init__(self) -> None:
        self._due = 0.0
        self._reported: Change | None = None
        """The last one."""
        self._said = ""
        self._ignored = 0
        self._ignored_due = 0.0
        self._remarks: list[tuple[float, str]] = []
        """What is to be reported of the whole and when, s since 1970, not reported yet."""

    def lines(self, picture: Picture) -> list[str]:
        """Return what is new since the last time, in order of time."""
        now = time.time()
        self._remark(picture, now)
        ready: list[tuple[float, str]] = []
        held = math.inf
        for change in self._unreported(picture):
            # Until its words have come, or will not come any more; what is after it waits, so the order stays.
            if not change.words and change.after is not ChannelState.OK and now - change.at < WORDS_TIMEOUT:
                held = change.at
                break
            self._reported = change
            ready.append((change.at, change.text(len(picture.states))))
        ready += [remark for remark in self._remarks if remark[0] < held]
        self._remarks = [remark for remark in self._remarks if remark[0] >= held]
        return [f"{_clock(at)}  {words}" for at, words in sorted(ready, key=lambda line: line[0])]

    def _unreported(self, picture: Picture) -> list[Change]:
        changes = list(picture.changes)
        return changes[next((k + 1 for k, change in enumerate(changes) if change is self._reported), 0) :]

    def _remark(self, picture: Picture, now: float) -> None:
        """Note what is to be reported of the whole."""
        # At once, and of many that follow one another now and then.
        if picture.ignored > self._ignored and now >= self._ignored_due:
            self._ignored, self._ignored_due = picture.ignored, now + self.EVERY
            self._remarks.append((now, shown(picture.ignored_words(), LINE)))
        words = picture.waiting or (picture.whole if not picture.is_silent("diagnostics") else "")
        if words and (words != self._said or now >= self._due):
            self._said, self._due = words, now + self.EVERY
            self._remarks.append((now, shown(f"{words}{_figures(picture)}", LINE)))


def _clock(at: float) -> str:
    return f"{time.strftime('%H:%M:%S', time.localtime(at))}.{int(at * 100) % 100:02d}"


def _figures(picture: Picture) -> str:
    if picture.waiting:
        return ""
    rate = "no fused rate" if picture.rate is None or picture.is_silent("fused") else "fused rate"
    if rate == "fused rate" and picture.rate is not None:
        rate += "".join(f" {value:+.3f}" for value in picture.rate) + " rad/s"
    hertz, late = (picture.figures.get(key, "none") for key in ("sample rate (Hz)", "latency p99 (ms)"))
    judged = math.isfinite(picture.statistic) and not picture.is_silent("integrity")
    evidence = f"evidence {picture.statistic:.3g} of {picture.threshold:.3g}" if judged else "nothing judged"
    return f" | {rate} | {evidence} | {hertz} Hz, p99 {late} ms"
