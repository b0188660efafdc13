# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A picture of a monitor drawn on a terminal; needs rich."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

from rich.bar import Bar
from rich.console import Group
from rich.table import Table
from rich.text import Text

from fdi_ros.monitor.diagnostics import Level, StatusLine, parse_number
from fdi_ros.ros.watch_node import Picture
from fdi_ros.system.limits import LINE
from fdi_ros.system.text import shown

COLOURS = {Level.OK: "green", Level.WARN: "yellow", Level.ERROR: "bold red", Level.STALE: "magenta"}
GREY = "bright_black"
SCALES = tuple(digit * 10.0**power for power in range(-2, 3) for digit in (2, 5, 10))
"""What a residual bar may end at, rad/s; the least is above the noise of healthy channels."""
LATEST = 8  # changes of state that are drawn
WIDE = 90  # columns from which the biases have room


def draw(picture: Picture, width: int) -> Group:
    """Draw a monitor, no line wider than the terminal."""
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
    head = Text(f"{shown(picture.monitor) or 'fdi_ros'}  ", style="bold", no_wrap=True, overflow="ellipsis")
    if picture.is_silent("diagnostics"):
        return head.append("says nothing" if picture.heard else "", style="magenta")
    keys = ("sample rate (Hz)", "latency p50 (ms)", "latency p99 (ms)", "detector")
    hertz, middle, late, detector = (shown(picture.whole.value(key) or "none") for key in keys)
    return head.append(f"{hertz} Hz  latency {middle} ms (p99 {late})  {detector}", style="not bold")


def _grid(widths: Sequence[int | None]) -> Table:
    """Make a table without lines; None: the column that takes what is left of the terminal."""
    table = Table.grid(padding=(0, 1), expand=True)
    for wide in widths:
        table.add_column(width=wide, ratio=1 if wide is None else None, no_wrap=True, overflow="ellipsis")
    return table


def _figure_table(picture: Picture) -> Table:
    """Draw the fused rate, and the statistic against its threshold: the evidence of all channels together."""
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
        bar = Bar(threshold, 0.0, min(statistic, threshold), color="red" if statistic >= threshold else "cyan")
        table.add_row("evidence", bar, f"{statistic:.3g} of {threshold:.3g}")
    return table


def _channel_table(picture: Picture, is_wide: bool) -> Table:
    """Draw one row per channel: state, residual, and where there is room the bias."""
    is_fresh, columns = not picture.is_silent("diagnostics"), 5 if is_wide else 4
    residuals = {name: line.number("residual (rad/s)") for name, line in picture.channels.items()}
    sizes = {name: abs(value) if math.isfinite(value) else 0.0 for name, value in residuals.items()}
    scale = next((scale for scale in SCALES if scale >= max(sizes.values())), SCALES[-1])
    table = _grid((max(len(shown(name)) for name in sizes), 9, None, 9, 18)[:columns])
    heads = ("channel", "state", f"residual, to {scale:g} rad/s", "rad/s", "bias, rad/s")
    table.add_row(*(Text(word, style=GREY) for word in heads[:columns]))
    for name, line in picture.channels.items():
        # A string would be taken for markup.
        cells: list[Text | Bar | str] = [Text(shown(name)), Text("?", style=GREY), Bar(scale, 0.0, 0.0), "none", "none"]
        if is_fresh:
            colour, residual = COLOURS[line.level], residuals[name]
            bar = Bar(scale, 0.0, min(sizes[name], scale), color=colour.removeprefix("bold "))
            figure = f"{residual:+.4f}" if math.isfinite(residual) else "none"
            cells[1:] = [Text(line.value("state"), style=colour), bar, figure, _format_bias(line)]
        table.add_row(*cells[:columns])
    return table


def _format_bias(line: StatusLine) -> str:
    bias, std = line.number("bias (rad/s)"), line.number("bias known to (rad/s)")
    if not math.isfinite(bias):
        return "none"
    return f"{bias:+.4f}" + (f" +- {std:.4f}" if math.isfinite(std) else "")


def _input_lines(picture: Picture) -> list[Text]:
    """Return the inputs in which something is wrong; if there is none, the rates of all."""
    if picture.is_silent("diagnostics") or not picture.inputs:
        return []
    odd = [line for line in picture.inputs if line.level != Level.OK]
    if odd:
        return [Text(shown(f"input {line.name}: {line.message}", LINE), style=COLOURS[line.level]) for line in odd]
    rates = ", ".join(f"{line.name} {line.value('rate (Hz)')} Hz" for line in picture.inputs)
    return [Text(shown(f"inputs   {rates}", LINE), no_wrap=True, overflow="ellipsis")]
