"""What the demo shows: a table redrawn in place on a terminal, a line a change anywhere else."""

from __future__ import annotations

import math
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TextIO

from fdi_ros.monitor.output import ChannelState

COLOURS = {ChannelState.OK: 32, ChannelState.FAULTY: 31, ChannelState.SUSPECT: 33, ChannelState.AMBIGUOUS: 33}
GREY = 90


@dataclass
class View:
    """What is known of the flight so far; the numbers are those of the last message of each kind."""

    names: Sequence[str]
    elapsed: float = 0.0
    states: list[ChannelState] = field(default_factory=list)
    words: dict[str, str] = field(default_factory=dict)
    """What /diagnostics says of each channel."""
    statistic: float = float("nan")
    threshold: float = float("nan")
    error_with: float = float("nan")
    """Error of the fused rate, rad/s."""
    error_without: float = float("nan")
    """Error of the least-squares rate of all channels, rad/s."""
    note: str = ""
    """What is going to happen."""


def rate_error(error: float) -> str:
    """Error of a rate in words, rad/s; NaN: there was no rate."""
    return "no rate" if math.isnan(error) else f"{error:.4f} rad/s"


class Screen:
    """Shows a view, and the changes in it as they come."""

    def __init__(self, view: View, out: TextIO = sys.stdout) -> None:
        self.view = view
        self.out = out
        self.live = out.isatty()
        self._drawn = 0
        self._news: set[str] = set()

    def change(self, at: float, channels: Sequence[int], before: ChannelState | None, after: ChannelState) -> None:
        """Tell of channels that changed state alike, at seconds from the start."""
        names = [self.view.names[channel] for channel in channels]
        self._news.update(names)
        if not self.live:
            was = f"{before.name} -> " if before is not None else ""
            self._say(f"t = {at:6.2f} s  {self._listed(names)}  {was}{after.name}")

    def messages(self, at: float, texts: Mapping[str, str]) -> None:
        """Take what /diagnostics says of each channel; tell it of those that changed state since it last said it."""
        self.view.words.update(texts)
        news = {name: text for name, text in texts.items() if name in self._news}
        self._news.difference_update(news)
        if self.live:
            return
        for text in dict.fromkeys(news.values()):
            names = [name for name, its in news.items() if its == text]
            self._say(f"t = {at:6.2f} s  {self._listed(names)}  /diagnostics: {text}")

    def _listed(self, names: Sequence[str]) -> str:
        return f"{'all' if len(names) == len(self.view.names) else ', '.join(names):8}"

    def say(self, text: str) -> None:
        """Say something that stays."""
        self._drawn = 0
        self._say(text)

    def draw(self) -> None:
        """Draw the table over the one before; nothing where there is no terminal."""
        if not self.live:
            return
        lines = list(self._table())
        # Up to the first line of the last drawing, then each line cleared as it is written.
        up = f"\x1b[{self._drawn}F" if self._drawn else ""
        self.out.write(up + "".join(f"\x1b[2K{line}\n" for line in lines))
        self.out.flush()
        self._drawn = len(lines)

    def _say(self, text: str) -> None:
        self.out.write(f"{text}\n")
        self.out.flush()

    def _table(self) -> list[str]:
        view = self.view
        # A line that wraps would shift all that is drawn over it.
        room = max(20, shutil.get_terminal_size().columns - 23)
        rows = [f"t = {view.elapsed:5.1f} s   {view.note}", "", f"{'channel':10}{'state':12}/diagnostics says"]
        for name, state in zip(view.names, view.states, strict=False):
            colour = COLOURS.get(state, GREY)
            words = view.words.get(name, "")[:room]
            rows.append(f"{name:10}\x1b[{colour}m{state.name:12}\x1b[0m{words}")
        rows += [
            "",
            f"statistic {view.statistic:8.2f}    threshold {view.threshold:.2f}",
            f"error of the rate now: {rate_error(view.error_with)} with monitoring,"
            f" {rate_error(view.error_without)} without",
        ]
        return rows
