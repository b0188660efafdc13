# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A calibration in words and tables, for a terminal, and as a page with figures.

The page: tables, motion and residuals over time, noise by time scale, biases over time.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fdi_ros.calibration.data import Array
from fdi_ros.calibration.result import Calibration, Delay, deviations
from fdi_ros.calibration.self_check import HIGH, LOW, ClassCheck
from fdi_ros.calibration.time_series import NoiseSpectra, TimeSeries
from fdi_ros.report.page import CHANNEL_COLOURS, Section, html_list, html_table, page, time_layout
from fdi_ros.report.store import FINE, SMALL, PageStore
from fdi_ros.report.text_table import table
from fdi_ros.report.unit import RADIANS, Unit

STORE_BYTES = 400_000
"""Text that motion and residuals may take."""
ZOOM_HINT = "Drag across a plot to zoom all in time, double-click to see everything."
ONE_SECOND = 1.0
_AXES = "xyz"
_GREY = "#8a8f98"
CHANNEL_HEAD = (
    "channel",
    "axis x",
    "y",
    "z",
    "scale",
    "+-%",
    "off nominal deg",
    "+-deg",
    "bias rad/s",
    "+-",
    "noise rad/s",
    "not used",
)
CHECK_HEAD = ("motion", "s", "before", "after", "expected", "residual rad/s", "largest", "false alarms /h", "alarms")
BIAS_HEAD = ("channel", "mean, rad/s", "+-", "moves by, rad/s", "walk, rad/s per sqrt(s)")
ALLAN_HEAD = ("channel", "of one sample, rad/s", "over 1 s, rad/s", "least, rad/s", "over, s")


def channel_rows(result: Calibration, unit: Unit = RADIANS) -> list[tuple[str, ...]]:
    """One row per channel."""
    angle, scale = deviations(result.axes, result.nominal)
    lost = result.unusable.total
    rows = []
    for i, name in enumerate(result.names):
        fixed = i in result.reference
        rows.append(
            (
                name,
                *(f"{v:.5f}" for v in result.axes[i]),
                f"{scale[i]:.5f}",
                "reference" if fixed else f"{100 * result.scale_error[i]:.3f}",
                f"{np.degrees(angle[i]):.3f}",
                "reference" if fixed else f"{np.degrees(result.angle_error[i]):.3f}",
                f"{result.bias.mean[i] * unit.factor:.6f}",
                f"{result.bias.std[i] * unit.factor:.6f}",
                f"{result.noise.std[i] * unit.factor:.5f}",
                str(lost[i]),
            )
        )
    return rows


def check_rows(result: Calibration, unit: Unit = RADIANS) -> list[tuple[str, ...]]:
    """One row per class of motion: normalised residuals with the settings before and after."""
    pairs = zip(result.before.classes, result.after.classes, strict=True)
    return [_check_row(before, after, unit) for before, after in pairs]


def _check_row(before: ClassCheck, after: ClassCheck, unit: Unit) -> tuple[str, ...]:
    if not after.samples:
        return (after.name, "0", "-", "-", "1", "-", "-", "-", "-")
    residuals = [unit.factor * np.sqrt(np.mean(c.residual**2)) for c in (before, after)]
    return (
        after.name,
        f"{after.seconds:.1f}",
        f"{before.overall:.2f}",
        f"{after.overall:.2f}",
        "1",
        f"{residuals[0]:.3g} -> {residuals[1]:.3g}",
        f"{before.largest:.1f} -> {after.largest:.1f}",
        f"{after.false_alarms:.2g}",
        f"{before.alarms} -> {after.alarms}",
    )


def noise_lines(result: Calibration, unit: Unit = RADIANS) -> list[str]:
    """Terms of the noise model that hold for all channels, the walk of the biases, and the delays."""
    noise, bias = result.noise, result.bias
    walk = f"biases walk {np.median(bias.walk) * unit.factor:.2g} {unit.name} per sqrt(s)"
    if not bias.shown:
        least = f"{bias.possible * unit.factor:.2g} {unit.name}"
        walk = f"no walk of the biases shown, below {least} per sqrt(s): as configured"
    lines = [
        f"scale_std {noise.scale:.5f} +- {noise.scale_error:.5f}, timing_std {1e3 * noise.timing:.3f} +-"
        f" {1e3 * noise.timing_error:.3f} ms; {walk}"
    ]
    return [*lines, *(_delay_line(result, delay) for delay in result.delays)]


def _delay_line(result: Calibration, delay: Delay) -> str:
    names = ", ".join(result.names[i] for i in delay.channels)
    size, error = 1e3 * abs(delay.value), 1e3 * delay.error
    side = "late (measured earlier than stamped)" if delay.value > 0 else "early (measured later than stamped)"
    words = f"{names}: stamps {size:.3f} +- {error:.3f} ms {side} against the reference"
    if not delay.shown:
        return f"{words}: within its error, not taken off"
    return f"{words}: taken off by imus.delays" if "imus.delays" in result.settings else f"{words}: not taken off"


def set_lines(result: Calibration, before: Mapping[str, object]) -> list[str]:
    """List the settings that are new in the file: the short ones with the value that they had."""
    changed = []
    for name, value in result.settings.items():
        old = before.get(name)
        short = not isinstance(value, list)
        changed.append(f"{name} {value} (was {old})" if short and value != old else name)
    return [f"set: {', '.join(changed)}"]


def calibration_text(result: Calibration, unit: Unit = RADIANS) -> str:
    """Return everything, for a terminal."""
    seconds = result.seconds
    reference = ", ".join(result.names[i] for i in result.reference)
    lines = [
        f"calibrated on {seconds.all:.1f} s: {seconds.rest:.1f} s at rest, {seconds.motion:.1f} s in motion;"
        f" reference {reference}",
        "",
        *table(unit.head(CHANNEL_HEAD), channel_rows(result, unit)),
        "",
        *noise_lines(result, unit),
        *(f"note: {line}" for line in result.notes),
        "",
        "self-check: root mean square of the normalised residuals, before and after",
        *table(unit.head(CHECK_HEAD), check_rows(result, unit)),
        f"false alarms per hour of such motion: {result.after.implied:.2g} implied, {result.after.configured:.2g}"
        f" configured; a figure outside {LOW} to {HIGH} is worth a look",
        *(f"warning: {line}" for line in result.warnings),
    ]
    return "\n".join(line.rstrip() for line in lines) + "\n"


def calibration_page(result: Calibration, title: str, series: TimeSeries | None = None) -> str:
    """Lay out everything that was found.

    Parameters
    ----------
    result
        Of the calibration.
    title
        What was calibrated on what.
    series
        The recording over time; None: not shown.
    """
    after = result.after
    summary = [
        f"{result.seconds.rest:.1f} s at rest and {result.seconds.motion:.1f} s in motion were used.",
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
    store = None if series is None else _store(result, series)
    sections = [
        Section("Channels", "Axes relative to the reference, with standard errors.", _channels(result)),
        Section("Noise in motion, sampling delays", "", html_list(noise_lines(result))),
        Section("Self-check", check_hint, html_table(CHECK_HEAD, check_rows(result)), [_check_figure(result)]),
        Section("Biases", bias_hint, html_table(BIAS_HEAD, _bias_rows(result)), [_bias(result)]),
        *([] if series is None else _over_time(result, series)),
        *([] if series is None else _by_scale(result, series)),
    ]
    return page(f"fdi_ros: calibration of {title}", summary, sections, store)


def _channels(result: Calibration) -> str:
    return html_table(CHANNEL_HEAD, channel_rows(result))


def _check_figure(result: Calibration) -> dict[str, object]:
    classes = [c for c in result.after.classes if c.samples]
    names = [c.name for c in classes]
    data: list[dict[str, object]] = [
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
        "layout": {
            "shapes": lines,
            "xaxis": {"title": {"text": "how the vehicle moved; a bar per channel"}},
            "yaxis": {"title": {"text": "normalised residual"}},
            "height": 320,
        },
    }


def _bias_rows(result: Calibration) -> list[tuple[str, ...]]:
    bias = result.bias
    figures = np.array([bias.mean, bias.std, np.ptp(bias.curve, axis=0), bias.walk]).T
    return [(name, *(f"{value:.4g}" for value in row)) for name, row in zip(result.names, figures, strict=True)]


def _bias(result: Calibration) -> dict[str, object]:
    bias = result.bias
    data = [
        {
            "type": "scatter",
            "mode": "lines",
            "name": name,
            "x": np.round(bias.time, 3).tolist(),
            "y": np.round(bias.curve[:, i] - bias.mean[i], 8).tolist(),
            "line": {"color": _colour(i)},
        }
        for i, name in enumerate(result.names)
    ]
    return {"data": data, "layout": time_layout(280, yaxis={"title": {"text": "bias minus its mean, rad/s"}})}


def _store(result: Calibration, series: TimeSeries) -> PageStore:
    n = len(result.names)
    kinds = {f"rate.{axis}": FINE for axis in _AXES}
    kinds |= {f"{what}.{i}": SMALL for what in ("before", "after") for i in range(n)}
    store = PageStore(kinds, STORE_BYTES)
    store.add(series.seconds, [series.rate, series.before, series.after])
    return store


def _over_time(result: Calibration, series: TimeSeries) -> list[Section]:
    rests = [{"type": "rect", "kind": "rest", "x0": first, "x1": last} for first, last in series.rest]
    seconds = sum(last - first for first, last in series.rest)
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
        layout = time_layout(112, last, yaxis=title, shapes=rests, robust=True, scale="residuals")
        residuals.append({"data": data, "layout": layout})
    rms = [
        (name, *(f"{_rms(values[:, i]):.4g}" for values in (series.before, series.after)))
        for i, name in enumerate(result.names)
    ]
    hint = (
        "Channel minus fused rate along its axis, as the monitor sees it with the old and with the new settings;"
        " all on one scale."
    )
    head = ("channel", "rms before, rad/s", "after, rad/s")
    return [
        Section("Motion", f"{shaded} {ZOOM_HINT}", "", [{"data": motion, "layout": rate}]),
        Section("Residuals before and after", hint, html_table(head, rms), residuals),
    ]


def _by_scale(result: Calibration, series: TimeSeries) -> list[Section]:
    sections = []
    for noise, title, hint in (
        (series.still, "at rest", "Of the channels themselves, over all spans at rest."),
        (series.moving, "in motion", "Of the residuals with the new settings: vibration, axes, delays, and noise."),
    ):
        if len(noise.time):
            level = f" White noise falls as the dashed line: noise_std {np.median(result.noise.std):.3g} rad/s."
            sections.append(
                Section(
                    f"Allan deviation {title}",
                    f"{hint} {noise.seconds:.1f} s.{level}",
                    html_table(ALLAN_HEAD, _allan_rows(result, noise)),
                    [
                        _loglog(
                            result,
                            noise.time,
                            noise.deviation,
                            "averaging time, s",
                            "Allan deviation, rad/s",
                            _white(result, noise),
                        )
                    ],
                )
            )
        if len(noise.frequency):
            unit = "density, rad/s per sqrt(Hz)"
            figure = _loglog(result, noise.frequency, noise.density, "frequency, Hz", unit, [])
            sections.append(Section(f"Spectrum {title}", f"{hint} {noise.seconds:.1f} s.", "", [figure]))
    return sections


def _allan_rows(result: Calibration, noise: NoiseSpectra) -> list[tuple[str, ...]]:
    deviation = noise.deviation
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


def _white(result: Calibration, noise: NoiseSpectra) -> list[dict[str, object]]:
    ends = noise.time[[0, -1]]
    level = float(np.median(result.noise.std)) * np.sqrt(noise.time[0] / ends)
    line = {"color": _GREY, "dash": "dash"}
    return [{"type": "scatter", "name": "white noise", "x": ends.tolist(), "y": level.tolist(), "line": line}]


def _loglog(
    result: Calibration, x: Array, y: Array, x_title: str, y_title: str, more: list[dict[str, object]]
) -> dict[str, object]:
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
