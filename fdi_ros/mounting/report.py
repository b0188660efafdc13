# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A mounting in words and tables, for a terminal, and as a page: the axes in space, look-alikes, losses."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import numpy as np

from fdi_ros.model.detectability import DETECTION, assumption_words, summary_line
from fdi_ros.model.geometry import SAME_DIRECTION
from fdi_ros.mounting.analysis import OPTIMUM, WAITS, Loss, Mounting, Waiting
from fdi_ros.report.page import PALETTE, Section, html_table, page
from fdi_ros.report.text_table import RADIANS, Unit, table

LOSS_HEAD = ("lost", "GDOP", "std x rad/s", "y", "z", "still seen", "still isolated")
RHO_TITLE = "|rho| of the normalised residuals: 1 is not to be told apart"
WAITING_TITLE = "smallest error found on average within a time, rad/s"
WAITING_HINT = (
    "The bound of the best test, which knows channel and size (Lorden 1971, Moustakides 1986): about 2 ln(A) / s^2"
    " samples for a shift of s standard deviations and A samples to a false alarm; noise taken as white."
)
WAITING_PAGE_HINT = f"Smallest error, rad/s, found on average within a time. {WAITING_HINT}"
WAITING_HEAD = ("channel", *(f"{wait:g} s" for wait in WAITS))
SMALLEST_HEAD = ("channel", "axis x", "y", "z", "noise rad/s", "smallest rad/s")


def pair_lines(result: Mounting) -> list[str]:
    """Describe pairs of channels that look alike."""
    g = result.geometry
    lines = []
    for i, j in result.alike:
        a, b = g.channel_names[i], g.channel_names[j]
        cosine = float(g.axes[i] @ g.axes[j] / np.linalg.norm(g.axes[i]) / np.linalg.norm(g.axes[j]))
        if abs(cosine) > SAME_DIRECTION:
            lines.append(f"{a} and {b} measure the same axis: a fault in either is seen, which one is not")
        else:
            lines.append(f"faults of {a} and {b} look the same: a fault in either is seen, which one is not")
    lines += [
        f"{g.channel_names[i]} and {g.channel_names[j]} are hard to tell apart (|rho| {abs(g.rho[i, j]):.3f})"
        for i, j in result.similar
    ]
    blind = np.flatnonzero(~g.detectable).tolist()
    lines += [f"a fault of {g.channel_names[i]} is never seen: no other channel checks it" for i in blind]
    return lines or ["every single fault is seen and can be told from all others"]


def _names(numbers: Sequence[int], names: tuple[str, ...], among: int) -> str:
    if len(numbers) == among:
        return "all"
    return ", ".join(names[i] for i in numbers) or "none"


def loss_rows(result: Mounting, losses: Sequence[Loss], unit: Unit = RADIANS) -> list[tuple[str, ...]]:
    """One row per loss."""
    names = result.geometry.channel_names
    return [
        (
            ", ".join(names[i] for i in loss.lost) or "none",
            f"{loss.gdop:.3f}" if np.isfinite(loss.gdop) else "no rate",
            *(f"{v * unit.factor:.5f}" if np.isfinite(v) else "-" for v in loss.std),
            _names(loss.detectable, names, len(names) - len(loss.lost)),
            _names(loss.isolable, names, len(names) - len(loss.lost)),
        )
        for loss in losses
    ]


def double_lines(result: Mounting) -> list[str]:
    """Summary of the losses of two channels."""
    spanning = [loss for loss in result.double if np.isfinite(loss.gdop)]
    names = result.geometry.channel_names
    lines = [f"two lost: {len(spanning)} of {len(result.double)} pairs leave a rate"]
    if spanning:
        worst = max(spanning, key=lambda loss: loss.gdop)
        lines[0] += f", GDOP {min(loss.gdop for loss in spanning):.3f} to {worst.gdop:.3f}"
        lines[0] += f" (worst without {' and '.join(names[i] for i in worst.lost)})"
        named = sum(1 for loss in spanning if loss.isolable)
        seen = sum(1 for loss in spanning if loss.detectable)
        lines.append(f"of these, {seen} still see a third fault in some channel and {named} can isolate it in some")
    return lines


def turn_lines(result: Mounting) -> list[str]:
    """How far two triads are from the best turn, and a better one within reach."""
    turn = result.turn
    if turn is None:
        return []
    lines = [
        f"largest |rho| between the two triads {turn.largest_rho:.3f}; the best turn of the second has {OPTIMUM:.3f}"
        " (the first one's axes seen as 2/3, 2/3, -1/3)"
    ]
    if turn.better < turn.largest_rho - 1e-3:
        axis = ", ".join(f"{v:.3f}" for v in turn.axis)
        lines.append(
            f"within {np.degrees(turn.freedom):.0f} deg: turn the second triad by {np.degrees(turn.angle):.1f} deg"
            f" about ({axis}) of the body: largest |rho| {turn.better:.3f}"
        )
    else:
        lines.append(f"within {np.degrees(turn.freedom):.0f} deg there is no better turn")
    return lines


def rho_rows(result: Mounting) -> list[tuple[str, ...]]:
    """Matrix of |rho|."""
    g = result.geometry
    return [(name, *(f"{abs(v):.3f}" for v in g.rho[i])) for i, name in enumerate(g.channel_names)]


def smallest_rows(result: Mounting, unit: Unit = RADIANS) -> list[tuple[str, ...]]:
    """Smallest detectable error of each channel."""
    g = result.geometry
    rows = []
    for i, name in enumerate(g.channel_names):
        size = result.smallest[i]
        seen = f"{size * unit.factor:.5f}" if np.isfinite(size) else "never"
        noise = f"{result.noise.noise_std[i] * unit.factor:.5f}"
        rows.append((name, *(f"{v:.4f}" for v in g.axes[i]), noise, seen))
    return rows


def covariance_rows(result: Mounting, unit: Unit = RADIANS) -> list[tuple[str, ...]]:
    """Covariance of the least-squares rate at rest, square of the unit."""
    covariance = result.geometry.covariance(result.noise.noise_std**2) * unit.factor**2
    covariance[np.abs(covariance) < 1e-9 * covariance.max()] = 0.0
    return [("xyz"[i], *(f"{v:.3e}" for v in covariance[i])) for i in range(3)]


def waiting_rows(result: Mounting, waiting: Waiting, unit: Unit = RADIANS) -> list[tuple[str, ...]]:
    """One row per channel."""
    sizes = waiting.size.T * unit.factor
    return [(name, *map(_size, row)) for name, row in zip(result.geometry.channel_names, sizes, strict=True)]


def _size(value: float) -> str:
    if np.isnan(value):
        return "-"
    return f"{value:.5f}" if np.isfinite(value) else "never"


def waiting_lines(result: Mounting, unit: Unit = RADIANS) -> list[str]:
    """Tables of all conditions, with their title."""
    lines = [unit.named(WAITING_TITLE), *textwrap.wrap(WAITING_HINT, 110)]
    for waiting in result.waiting:
        lines += [f"{waiting.condition}:", *table(WAITING_HEAD, waiting_rows(result, waiting, unit))]
    return lines


def assumption_lines(result: Mounting) -> list[str]:
    """Say what no data can tell and every name rests on."""
    words = assumption_words(result.geometry)
    return [f"names rest on {words}"] if words else []


def mounting_text(result: Mounting, unit: Unit = RADIANS) -> str:
    """Return everything, for a terminal."""
    g = result.geometry
    lines = [
        summary_line(g, result.noise, result.false_alarm_probability, unit.name, unit.factor),
        "",
        f"smallest error seen with {DETECTION:.0%} in one sample, at a false-alarm probability of"
        f" {result.false_alarm_probability:.3g} a sample",
        *table(unit.head(SMALLEST_HEAD), smallest_rows(result, unit)),
        "",
        *waiting_lines(result, unit),
        "",
        f"covariance of the rate, ({unit.name})^2",
        *table(("", "x", "y", "z"), covariance_rows(result, unit)),
        "",
        RHO_TITLE,
        *table(("", *g.channel_names), rho_rows(result)),
        "",
        *assumption_lines(result),
        *pair_lines(result),
        "",
        "after each possible first fault",
        *table(unit.head(LOSS_HEAD), loss_rows(result, [result.whole, *result.single], unit)),
        *double_lines(result),
        *(["", *turn_lines(result)] if result.turn else []),
    ]
    return "\n".join(line.rstrip() for line in lines) + "\n"


def mounting_page(result: Mounting, title: str) -> str:
    """Lay out everything."""
    names = result.geometry.channel_names
    summary = [
        summary_line(result.geometry, result.noise, result.false_alarm_probability),
        *assumption_lines(result),
        *pair_lines(result),
        *turn_lines(result),
    ]
    smallest = (
        f"Seen in one sample at rest with {DETECTION:.0%}, at a false-alarm probability of"
        f" {result.false_alarm_probability:.3g} a sample."
    )
    sections = [
        Section("Axes", "In the body frame; drag, or press the arrow keys, to turn.", "", [_axes_figure(result)]),
        Section("Smallest detectable error", smallest, html_table(SMALLEST_HEAD, smallest_rows(result))),
        *(
            Section(f"Found by waiting, {waiting.condition}", WAITING_PAGE_HINT, html_table(WAITING_HEAD, rows))
            for waiting in result.waiting
            for rows in [waiting_rows(result, waiting)]
        ),
        Section("Covariance of the rate", "(rad/s)^2, at rest.", html_table(("", *"xyz"), covariance_rows(result))),
        Section("Look-alikes", RHO_TITLE, html_table(("", *names), rho_rows(result)), [_rho_figure(result)]),
        Section(
            "After each possible first fault",
            "; ".join(double_lines(result)),
            html_table(LOSS_HEAD, loss_rows(result, [result.whole, *result.single])),
        ),
        Section("After two", "", html_table(LOSS_HEAD, loss_rows(result, result.double))),
    ]
    return page(f"fdi_ros: mounting of {title}", summary, sections)


def _axes_figure(result: Mounting) -> dict[str, object]:
    g = result.geometry
    body = [
        {
            "type": "scatter3d",
            "x": [0, 1.2 * (k == 0)],
            "y": [0, 1.2 * (k == 1)],
            "z": [0, 1.2 * (k == 2)],
            "text": ["", f"body {'xyz'[k]}"],
            "line": {"dash": "dash"},
        }
        for k in range(3)
    ]
    axes = [
        {
            "type": "scatter3d",
            "name": name,
            "x": [0, round(float(g.axes[i, 0]), 4)],
            "y": [0, round(float(g.axes[i, 1]), 4)],
            "z": [0, round(float(g.axes[i, 2]), 4)],
            "text": ["", name],
            "line": {"color": PALETTE[(i // 3) % len(PALETTE)]},
        }
        for i, name in enumerate(g.channel_names)
    ]
    return {"data": body + axes, "layout": {"height": 560}}


def _rho_figure(result: Mounting) -> dict[str, object]:
    g = result.geometry
    heat = {
        "type": "heatmap",
        "z": np.round(np.abs(g.rho), 4).tolist(),
        "x": list(g.channel_names),
        "y": list(g.channel_names),
        "zmin": 0,
        "zmax": 1,
    }
    return {"data": [heat], "layout": {"title": RHO_TITLE}}
