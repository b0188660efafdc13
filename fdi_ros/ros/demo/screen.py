"""What the demo shows: a table redrawn in place on a terminal, a line a change anywhere else."""

from __future__ import annotations

import sys
from collections.abc import Sequence
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


class Screen:
    """Shows a view, and the changes in it as they come."""

    def __init__(self, view: View, out: TextIO = sys.stdout) -> None:
        self.view = view
        self.out = out
        self.live = out.isatty()
        self._drawn = 0

    def change(self, at: float, channel: int, before: ChannelState | None, after: ChannelState) -> None:
        """Tell of one change of state, at seconds from the start."""
        if not self.live:
            was = f"{before.name} -> " if before is not None else ""
            self._say(f"t = {at:6.2f} s  {self.view.names[channel]:8} {was}{after.name}")

    def message(self, at: float, name: str, text: str) -> None:
        """Tell of a new text in /diagnostics."""
        if not self.live:
            self._say(f"t = {at:6.2f} s  {name:8} /diagnostics: {text}")

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
        rows = [f"t = {view.elapsed:5.1f} s   {view.note}", "", f"{'channel':10}{'state':12}/diagnostics says"]
        for name, state in zip(view.names, view.states, strict=False):
            colour = COLOURS.get(state, GREY)
            words = view.words.get(name, "")[:70]
            rows.append(f"{name:10}\x1b[{colour}m{state.name:12}\x1b[0m{words}")
        rows += [
            "",
            f"statistic {view.statistic:8.2f}    threshold {view.threshold:.2f}",
            f"error of the rate now: {view.error_with:.4f} rad/s with monitoring, {view.error_without:.4f} without",
        ]
        return rows
