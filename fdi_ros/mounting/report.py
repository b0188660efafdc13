"""The page of a mounting: the axes in space, look-alikes, losses."""

from __future__ import annotations

from typing import Any

import numpy as np

from fdi_ros.model.detectability import DETECTION, summary_line
from fdi_ros.mounting.analysis import Mounting
from fdi_ros.mounting.text import (
    LOSS_HEAD,
    RHO_TITLE,
    SMALLEST_HEAD,
    WAITING_HEAD,
    WAITING_HINT,
    covariance_rows,
    double_lines,
    loss_rows,
    pair_lines,
    rho_rows,
    smallest_rows,
    turn_lines,
    waiting_rows,
)
from fdi_ros.report.page import PALETTE, Section, html_table, page


def mounting_page(result: Mounting, title: str) -> str:
    """Lay out everything."""
    names = result.geometry.channel_names
    summary = [
        summary_line(result.geometry, result.noise, result.false_alarm_probability),
        *pair_lines(result),
        *turn_lines(result),
    ]
    smallest = f"Seen in one sample at rest with {DETECTION:.0%}, at {result.false_alarm_probability:.3g} false alarms."
    sections = [
        Section("Axes", "In the body frame; drag, or press the arrow keys, to turn.", "", [_axes_figure(result)]),
        Section("Smallest detectable error", smallest, html_table(SMALLEST_HEAD, smallest_rows(result))),
        *(
            Section(f"Found by waiting, {waiting.condition}", WAITING_HINT, html_table(WAITING_HEAD, rows))
            for waiting in result.waiting
            for rows in [waiting_rows(result, waiting)]
        ),
        Section("Covariance of the rate", "(rad/s)^2, at rest.", html_table(("", *"xyz"), covariance_rows(result))),
        Section("Look-alikes", RHO_TITLE, html_table(("", *names), rho_rows(result)), [_rho_figure(result)]),
        Section(
            "After each possible first fault",
            " ".join(double_lines(result)),
            html_table(LOSS_HEAD, loss_rows(result, [result.whole, *result.single])),
        ),
        Section("After two", "", html_table(LOSS_HEAD, loss_rows(result, result.double))),
    ]
    return page(f"fdi_ros: mounting of {title}", summary, sections)


def _axes_figure(result: Mounting) -> dict[str, Any]:
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


def _rho_figure(result: Mounting) -> dict[str, Any]:
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
