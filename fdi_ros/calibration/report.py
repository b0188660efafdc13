"""The page of a calibration: tables, motion and residuals over time, noise by time scale, biases over time."""

from __future__ import annotations

from typing import Any

import numpy as np

from fdi_ros.calibration.data import Array
from fdi_ros.calibration.result import Calibration
from fdi_ros.calibration.self_check import HIGH, LOW
from fdi_ros.calibration.text import CHANNEL_HEAD, CHECK_HEAD, channel_rows, check_rows, noise_lines
from fdi_ros.calibration.time_series import Course, Noise
from fdi_ros.report.page import CHANNEL_COLOURS, Section, html_list, html_table, page, time_layout
from fdi_ros.report.store import FINE, SMALL, PageStore

STORE_BYTES = 400_000
"""Text that motion and residuals may take."""
ZOOM_HINT = "Drag across a plot to zoom all in time, double-click to see everything."
ONE_SECOND = 1.0
_AXES = "xyz"
_GREY = "#8a8f98"


def calibration_page(result: Calibration, title: str, course: Course | None = None) -> str:
    """Lay out everything that was found.

    Parameters
    ----------
    result
        Of the calibration.
    title
        What was calibrated on what.
    course
        The recording over time; None: not shown.
    """
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
    bias_hint = (
        "Best estimate over the recording, each minus its mean: from the times at rest, without rest from the"
        " disagreement of the channels (what all have in common does not show)."
    )
    store = None if course is None else _store(result, course)
    sections = [
        Section("Channels", "Axes relative to the reference, with standard errors.", _channels(result)),
        Section("Noise in motion, sampling delays", "", html_list(noise_lines(result))),
        Section("Self-check", check_hint, html_table(CHECK_HEAD, check_rows(result)), [_check_figure(result)]),
        Section("Biases", bias_hint, html_table(BIAS_HEAD, _bias_rows(result)), [_bias(result)]),
        *([] if course is None else _over_time(result, course)),
        *([] if course is None else _by_scale(result, course)),
    ]
    return page(f"fdi_ros: calibration of {title}", summary, sections, store)


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
            "marker": {"color": _colour(i)},
        }
        for i, name in enumerate(result.names)
    ]
    lines = [
        {"type": "line", "y0": y, "line": {"dash": dash}} for y, dash in ((1.0, "solid"), (LOW, "dot"), (HIGH, "dot"))
    ]
    return {
        "data": data,
        "layout": {"shapes": lines, "yaxis": {"title": {"text": "normalised residual"}}, "height": 320},
    }


BIAS_HEAD = ("channel", "mean, deg/s", "+-", "moves by, deg/s", "walk, deg/s per sqrt(s)")


def _bias_rows(result: Calibration) -> list[tuple[str, ...]]:
    bias = result.bias
    figures = np.degrees([bias.mean, bias.std, np.ptp(bias.course, axis=0), bias.walk]).T
    return [(name, *(f"{value:.4g}" for value in row)) for name, row in zip(result.names, figures, strict=True)]


def _bias(result: Calibration) -> dict[str, Any]:
    bias = result.bias
    data = [
        {
            "type": "scatter",
            "mode": "lines",
            "name": name,
            "x": np.round(bias.time, 3).tolist(),
            "y": np.round(np.degrees(bias.course[:, i] - bias.mean[i]), 6).tolist(),
            "line": {"color": _colour(i)},
        }
        for i, name in enumerate(result.names)
    ]
    return {"data": data, "layout": time_layout(280, yaxis={"title": {"text": "bias minus its mean, deg/s"}})}


def _store(result: Calibration, course: Course) -> PageStore:
    n = len(result.names)
    kinds = {f"rate.{axis}": FINE for axis in _AXES}
    kinds |= {f"{what}.{i}": SMALL for what in ("before", "after") for i in range(n)}
    store = PageStore(kinds, STORE_BYTES)
    store.add(course.seconds, [course.rate, course.before, course.after])
    return store


def _over_time(result: Calibration, course: Course) -> list[Section]:
    rests = [{"type": "rect", "kind": "rest", "x0": first, "x1": last} for first, last in course.rest]
    seconds = sum(last - first for first, last in course.rest)
    shaded = f"Shaded: at rest, {seconds:.1f} s in {len(rests)} spans." if rests else "Nowhere at rest."
    motion = [
        {"type": "scatter", "packed": f"rate.{axis}", "name": axis, "line": {"color": CHANNEL_COLOURS[k], "width": 1.2}}
        for k, axis in enumerate(_AXES)
    ]
    rate = time_layout(280, yaxis={"title": {"text": "fused rate, rad/s"}}, shapes=rests, robust=True)
    residuals = []
    for i, name in enumerate(result.names):
        data = [
            {"type": "scatter", "packed": f"{what}.{i}", "name": what, "line": {"color": colour, "width": 1.1}}
            for what, colour in (("before", _GREY), ("after", _colour(0)))
        ]
        last = i == len(result.names) - 1
        title = {"title": {"text": f"{name}, rad/s"}}
        residuals.append({"data": data, "layout": time_layout(112, last, yaxis=title, shapes=rests, robust=True)})
    rms = [
        (name, *(f"{np.degrees(_rms(values[:, i])):.4f}" for values in (course.before, course.after)))
        for i, name in enumerate(result.names)
    ]
    hint = "Channel minus fused rate along its axis, as the monitor sees it with the old and with the new settings."
    head = ("channel", "rms before, deg/s", "after, deg/s")
    return [
        Section("Motion", f"{shaded} {ZOOM_HINT}", "", [{"data": motion, "layout": rate}]),
        Section("Residuals before and after", hint, html_table(head, rms), residuals),
    ]


def _by_scale(result: Calibration, course: Course) -> list[Section]:
    sections = []
    for noise, title, hint in (
        (course.still, "at rest", "Of the channels themselves, over all spans at rest."),
        (course.moving, "in motion", "Of the residuals with the new settings: vibration, axes, delays, and noise."),
    ):
        if len(noise.time):
            level = f" White noise falls as the dashed line: noise_std {np.median(result.noise.std):.3g} rad/s."
            sections.append(
                Section(
                    f"Allan deviation {title}",
                    f"{hint} {noise.seconds:.1f} s.{level}",
                    html_table(ALLAN_HEAD, _allan_rows(result, noise)),
                    [_loglog(result, noise.time, noise.deviation, "averaging time, s", "rad/s", _white(result, noise))],
                )
            )
        if len(noise.frequency):
            unit = "rad/s per sqrt(Hz)"
            figure = _loglog(result, noise.frequency, noise.density, "frequency, Hz", unit, [])
            sections.append(Section(f"Spectrum {title}", f"{hint} {noise.seconds:.1f} s.", "", [figure]))
    return sections


ALLAN_HEAD = ("channel", "of one sample, deg/s", "over 1 s, deg/s", "least, deg/s", "over, s")


def _allan_rows(result: Calibration, noise: Noise) -> list[tuple[str, ...]]:
    deviation = np.degrees(noise.deviation)
    second = int(np.abs(np.log(noise.time / ONE_SECOND)).argmin())
    shown = noise.time[second] > ONE_SECOND / 2
    least = deviation.argmin(axis=0)
    return [
        (
            name,
            f"{deviation[0, i]:.4g}",
            f"{deviation[second, i]:.4g}" if shown else "-",
            f"{deviation[least[i], i]:.4g}",
            f"{noise.time[least[i]]:.3g}",
        )
        for i, name in enumerate(result.names)
    ]


def _white(result: Calibration, noise: Noise) -> list[dict[str, Any]]:
    ends = noise.time[[0, -1]]
    level = float(np.median(result.noise.std)) * np.sqrt(noise.time[0] / ends)
    line = {"color": _GREY, "dash": "dash"}
    return [{"type": "scatter", "name": "white noise", "x": ends.tolist(), "y": level.tolist(), "line": line}]


def _loglog(
    result: Calibration, x: Array, y: Array, x_title: str, y_title: str, more: list[dict[str, Any]]
) -> dict[str, Any]:
    data = [
        {
            "type": "scatter",
            "name": name,
            "x": [float(f"{value:.4g}") for value in x],
            "y": [float(f"{value:.4g}") for value in y[:, i]],
            "line": {"color": _colour(i)},
        }
        for i, name in enumerate(result.names)
    ]
    axes = {f"{k}axis": {"type": "log", "title": {"text": title}} for k, title in (("x", x_title), ("y", y_title))}
    return {"data": [*data, *more], "layout": {**axes, "height": 360}}


def _rms(values: Array) -> float:
    return float(np.sqrt(np.nanmean(values**2))) if np.isfinite(values).any() else float("nan")


def _colour(channel: int) -> str:
    return CHANNEL_COLOURS[channel % len(CHANNEL_COLOURS)]
