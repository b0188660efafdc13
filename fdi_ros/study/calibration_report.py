"""The page of a calibration: tables, normalised residuals by motion, biases over time."""

from __future__ import annotations

from typing import Any

import numpy as np

from fdi_ros.study.calibration_check import HIGH, LOW
from fdi_ros.study.calibration_result import Calibration
from fdi_ros.study.calibration_text import CHANNEL_HEAD, CHECK_HEAD, channel_rows, check_rows, noise_lines
from fdi_ros.study.figure_page import PALETTE, Section, html_table, page


def calibration_page(result: Calibration, title: str) -> str:
    """Lay out everything that was found."""
    after = result.after
    summary = [
        f"{result.seconds['rest']:.1f} s at rest and {result.seconds['motion']:.1f} s in motion were used.",
        f"{after.implied:.2g} false alarms per hour implied, {after.configured:.2g} configured.",
        *result.notes,
        *(result.warnings or ("Nothing to warn of.",)),
    ]
    check_hint = (
        "Root mean square of each channel's residual over the standard deviation that the settings give it."
        f" Right is 1; {LOW} to {HIGH} is good."
    )
    sections = [
        Section("Channels", "Axes relative to the reference, with standard errors.", _channels(result)),
        Section("Noise in motion, sampling delays", "; ".join(noise_lines(result))),
        Section("Self-check", check_hint, html_table(CHECK_HEAD, check_rows(result)), [_check_figure(result)]),
        Section("Biases", "Best estimate over the recording; the walk between times at rest.", "", [_bias(result)]),
    ]
    return page(f"fdi_ros: calibration of {title}", summary, sections)


def _channels(result: Calibration) -> str:
    return html_table(CHANNEL_HEAD, channel_rows(result))


def _check_figure(result: Calibration) -> dict[str, Any]:
    classes = [c for c in result.after.classes if c.samples]
    names = [c.name for c in classes]
    data: list[dict[str, Any]] = [
        {
            "type": "bar",
            "name": name,
            "x": names,
            "y": [round(float(c.normalised[i]), 4) for c in classes],
            "marker": {"color": PALETTE[i % len(PALETTE)]},
        }
        for i, name in enumerate(result.names)
    ]
    lines = [
        {"type": "line", "xref": "paper", "x0": 0, "x1": 1, "y0": y, "y1": y, "line": {"dash": dash, "color": "#888"}}
        for y, dash in ((1.0, "solid"), (LOW, "dot"), (HIGH, "dot"))
    ]
    return {
        "data": data,
        "layout": {"barmode": "group", "shapes": lines, "yaxis": {"title": {"text": "normalised residual"}}},
    }


def _bias(result: Calibration) -> dict[str, Any]:
    bias = result.bias
    data = [
        {
            "type": "scatter",
            "mode": "lines",
            "name": name,
            "x": np.round(bias.time, 2).tolist(),
            "y": np.round(np.degrees(bias.course[:, i] - bias.mean[i]), 5).tolist(),
            "line": {"color": PALETTE[i % len(PALETTE)]},
        }
        for i, name in enumerate(result.names)
    ]
    titles = {"xaxis": {"title": {"text": "s"}}, "yaxis": {"title": {"text": "bias minus its mean, deg/s"}}}
    return {"data": data, "layout": titles}
