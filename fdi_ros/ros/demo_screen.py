# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the demo shows: what is about to happen, both rates large side by side, and what fdi watch shows."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from fdi_ros.faults.fault import Fault
from fdi_ros.ros.watch import is_drawn
from fdi_ros.ros.watch_view import Change, Picture, bar, draw

if TYPE_CHECKING:
    from rich.console import Console, Group
    from rich.table import Table

DIGITS = {
    "0": ("█▀█", "█ █", "▀▀▀"),
    "1": ("▀█ ", " █ ", "▀▀▀"),
    "2": ("▀▀█", "█▀▀", "▀▀▀"),
    "3": ("▀▀█", " ▀█", "▀▀▀"),
    "4": ("█ █", "▀▀█", "  ▀"),
    "5": ("█▀▀", "▀▀█", "▀▀▀"),
    "6": ("█▀▀", "█▀█", "▀▀▀"),
    "7": ("▀▀█", "  █", "  ▀"),
    "8": ("█▀█", "█▀█", "▀▀▀"),
    "9": ("█▀█", "▀▀█", "▀▀▀"),
    ".": (" ", " ", "▀"),
    "-": ("   ", "▀▀▀", "   "),
}
REST = 8.0
"""The bundled flight is at rest for so long, s."""
ABOVE = 8
"""Lines above what fdi watch shows."""
REGULAR = 5.0
"""Where the output is no terminal, a line at least so often, s."""


@dataclass
class Scene:
    """Where the demo stands."""

    fault: Fault
    struck: Sequence[str]
    """Names of the channels with the fault."""
    learning: float
    """How long the node learns the biases, s."""
    duration: float
    elapsed: float = 0.0
    turning_with: float = math.nan
    """Size of the fused rate, rad/s."""
    turning_without: float = math.nan
    """Size of the least-squares rate of all channels, rad/s."""
    error_with: float = math.nan
    """Error of the fused rate, rad/s."""
    error_without: float = math.nan
    """Error of the least-squares rate of all channels, rad/s."""
    left_out: float | None = None
    """When the struck channels were left out of the fused rate, s after the first faulty sample; None: not yet."""
    named: float | None = None
    """When they were declared faulty, s after the first faulty sample; None: not yet."""

    @property
    def begun(self) -> bool:
        """Whether the fault has begun."""
        return self.elapsed >= self.fault.start

    def headline(self) -> tuple[str, str]:
        """Return what goes on, and what has come of the fault or when it comes."""
        struck = ", ".join(self.struck)
        if not self.begun:
            phase = (
                "At rest: the node learns the biases of its gyros."
                if self.elapsed < self.learning
                else f"{'At rest' if self.elapsed < REST else 'In flight'}: no gyro is faulty."
            )
            return phase, f"{struck} goes bad in {self.fault.start - self.elapsed:.0f} s"
        since = self.elapsed - self.fault.start
        over = self.elapsed >= self.fault.stop
        what = f"{struck} {'was' if over else 'is'} bad: {_described(self.fault)}"
        if self.named is not None and self.left_out is not None:
            return what, f"left out after {self.left_out * 1e3:.0f} ms, isolated after {self.named * 1e3:.0f} ms"
        if self.left_out is not None:
            return what, f"left out after {self.left_out * 1e3:.0f} ms, not isolated yet"
        return what, f"for {since:.1f} s, not detected yet"


def _described(fault: Fault) -> str:
    """Say a fault without its channel and its times, which are said beside it."""
    said = (word.partition("=") for word in str(fault).split())
    return " ".join(
        value if key == "kind" else f"{key} {value}" for key, _, value in said if key not in ("channel", "start")
    )


def rate_error(error: float) -> str:
    """Error of a rate in words, rad/s; NaN: there was no rate."""
    return "no rate" if math.isnan(error) else f"{error:.4f} rad/s"


class Screen:
    """Shows a scene and the monitor: drawn in place on a terminal, line by line anywhere else.

    Parameters
    ----------
    scene, picture
        Shown.
    """

    def __init__(self, scene: Scene, picture: Picture) -> None:
        self.scene = scene
        self.picture = picture
        self.drawn = is_drawn(sys.stdout)
        self._live: Any = None
        self._shown: list[Change] = []
        self._due = 0.0
        self._was_begun = False

    def __enter__(self) -> Screen:
        """Take the terminal."""
        if self.drawn:
            from rich.console import Console
            from rich.live import Live

            console = Console()
            self._live = Live(console=console, screen=True, auto_refresh=False)
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Give the terminal back; what was seen last stays on it."""
        if self._live is not None:
            console = self._live.console
            self._live.stop()
            self._live = None
            if self.picture.states:
                console.print(self._frame(console, 0))

    def say(self, text: str) -> None:
        """Say a line, where the screen is not drawn."""
        if self._live is None:
            print(text, flush=True)

    def wait(self, words: str, seconds: float) -> None:
        """Show that something is waited for, and for how long."""
        if self._live is not None:
            from rich.text import Text

            self._live.update(Text(f"{words} ... {seconds:.0f} s"), refresh=True)

    def update(self) -> None:
        """Show what is."""
        if self._live is None:
            self._print_lines()
        else:
            console = self._live.console
            self._live.update(self._frame(console, console.height - ABOVE), refresh=True)

    def _print_lines(self) -> None:
        scene, picture = self.scene, self.picture
        if scene.begun and not self._was_begun:
            self._was_begun = True
            self.say(f"t = {scene.elapsed:6.2f} s  the fault begins: {scene.fault}")
        for change in list(picture.changes):
            if not any(change is shown for shown in self._shown):
                self._shown.append(change)
                self.say(f"t = {scene.elapsed:6.2f} s  {change.text(len(picture.states))}")
        if scene.elapsed >= self._due:
            self._due = scene.elapsed + REGULAR
            self.say(f"t = {scene.elapsed:6.2f} s  {' '.join(scene.headline())}; {'; '.join(self._both())}")

    def _both(self) -> tuple[str, str]:
        scene = self.scene
        kind = "wrong by" if scene.begun else "turning at"
        values = (scene.error_without, scene.error_with) if scene.begun else (scene.turning_without, scene.turning_with)
        names = ("all gyros averaged", "fdi_ros")
        said = tuple(
            f"{name}: no rate yet" if math.isnan(value) else f"{name} {kind} {value:.3f} rad/s"
            for name, value in zip(names, values, strict=True)
        )
        return said[0], said[1]

    def _frame(self, console: Console, height: int) -> Group:
        from rich.console import Group
        from rich.text import Text

        scene, width = self.scene, console.width
        what, then = scene.headline()
        style = "bold green" if scene.named is not None else "bold red" if scene.begun else "bold"
        progress = Text(bar(scene.elapsed / scene.duration, width, scene.fault.start / scene.duration), style="blue")
        time = f"{scene.elapsed:5.1f} s  "
        return Group(
            Text(time + what, style=style, no_wrap=True, overflow="ellipsis"),
            Text(" " * len(time) + then, style=style, no_wrap=True, overflow="ellipsis"),
            progress,
            self._figures(width),
            draw(self.picture, width, height),
        )

    def _figures(self, width: int) -> Table:
        """Both rates large side by side: before the fault how fast it turns, then how wrong they are."""
        from rich.panel import Panel
        from rich.table import Table
        from rich.text import Text

        scene = self.scene
        if scene.begun:
            sides = ((scene.error_without, "red"), (scene.error_with, "green"))
            unit = "rad/s wrong"
        else:
            sides = ((scene.turning_without, "default"), (scene.turning_with, "default"))
            unit = "rad/s turning"
        table = Table.grid()
        table.add_column(width=width // 2)
        table.add_column(width=width - width // 2)
        panels = [
            Panel(
                Text(large(value), style=f"bold {colour}", justify="center", no_wrap=True),
                title=title,
                subtitle=unit if math.isfinite(value) else "no rate yet",
                border_style=colour,
                padding=0,
            )
            for (value, colour), title in zip(sides, ("all gyros averaged", "fdi_ros"), strict=True)
        ]
        table.add_row(*panels)
        return table


def large(value: float) -> str:
    """Write a figure three lines high; NaN as a dash."""
    glyphs = [DIGITS[digit] for digit in (f"{value:.3f}" if math.isfinite(value) else "-")]
    return "\n".join(" ".join(glyph[row] for glyph in glyphs) for row in range(3))
