"""A calibration in words and tables, for a terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from fdi_ros.calibration.plausibility import deviations
from fdi_ros.calibration.result import Calibration, Delay
from fdi_ros.calibration.self_check import HIGH, LOW, ClassCheck
from fdi_ros.report.text_table import table
from fdi_ros.report.unit import RADIANS, Unit

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


def channel_rows(result: Calibration, unit: Unit = RADIANS) -> list[tuple[str, ...]]:
    """One row a channel."""
    angle, scale = deviations(result.axes, result.nominal)
    unusable = result.unusable
    lost = unusable.missing + unusable.non_finite + unusable.out_of_range + unusable.repeated + unusable.spikes
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


CHECK_HEAD = ("motion", "s", "before", "after", "expected", "residual deg/s", "largest", "false alarms /h", "alarms")


def check_rows(result: Calibration) -> list[tuple[str, ...]]:
    """One row a class of motion: normalised residuals with the settings as they were, and as they are now."""
    pairs = zip(result.before.classes, result.after.classes, strict=True)
    return [_check_row(before, after) for before, after in pairs]


def _check_row(before: ClassCheck, after: ClassCheck) -> tuple[str, ...]:
    if not after.samples:
        return (after.name, "0", "-", "-", "1", "-", "-", "-", "-")
    residuals = [np.degrees(np.sqrt(np.mean(c.residual**2))) for c in (before, after)]
    return (
        after.name,
        f"{after.seconds:.1f}",
        f"{before.overall:.2f}",
        f"{after.overall:.2f}",
        "1",
        f"{residuals[0]:.3f} -> {residuals[1]:.3f}",
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
    """Say which settings the file has anew: the short ones with the value that they had."""
    said = []
    for name, value in result.settings.items():
        old = before.get(name)
        short = not isinstance(value, list)
        said.append(f"{name} {value} (was {old})" if short and value != old else name)
    return [f"set: {', '.join(said)}"]


def calibration_figures(result: Calibration) -> dict[str, Any]:
    """All figures by name, SI units: for programs."""
    names, noise, bias, unusable = result.names, result.noise, result.bias, result.unusable
    angle, scale = deviations(result.axes, result.nominal)
    return {
        "seconds": result.seconds,
        "reference": [names[i] for i in result.reference],
        "channels": [
            {
                "name": name,
                "axis": result.axes[i],
                "scale": scale[i],
                "scale_std": result.scale_error[i],
                "off_nominal_rad": angle[i],
                "angle_std_rad": result.angle_error[i],
                "bias": bias.mean[i],
                "bias_std": bias.std[i],
                "noise_std": noise.std[i],
                "not_used": {
                    "missing": unusable.missing[i],
                    "not_finite": unusable.non_finite[i],
                    "out_of_range": unusable.out_of_range[i],
                    "repeated": unusable.repeated[i],
                    "spikes": unusable.spikes[i],
                },
            }
            for i, name in enumerate(names)
        ],
        "noise": {
            "scale_std": noise.scale,
            "scale_std_error": noise.scale_error,
            "timing_std_s": noise.timing,
            "timing_std_error_s": noise.timing_error,
            "bias_walk": bias.walk if bias.shown else None,
        },
        "delays": [
            {"channels": [names[i] for i in d.channels], "late_s": d.value, "std_s": d.error, "shown": d.shown}
            for d in result.delays
        ],
        "check": {
            "configured_per_hour": result.after.configured,
            "implied_per_hour": result.after.implied,
            "before": [_check_figures(one) for one in result.before.classes],
            "after": [_check_figures(one) for one in result.after.classes],
        },
        "settings": result.settings,
        "notes": list(result.notes),
        "warnings": list(result.warnings),
    }


def _check_figures(one: ClassCheck) -> dict[str, Any]:
    return {
        "motion": one.name,
        "seconds": one.seconds,
        "normalised_residual": one.overall,
        "largest": one.largest,
        "residual_rms": one.residual,
        "alarms": one.alarms,
        "false_alarms_per_hour": one.false_alarms,
    }


def calibration_text(result: Calibration, unit: Unit = RADIANS) -> str:
    """Everything, for a terminal."""
    seconds = result.seconds
    reference = ", ".join(result.names[i] for i in result.reference)
    lines = [
        f"calibrated on {seconds['all']:.1f} s: {seconds['rest']:.1f} s at rest, {seconds['motion']:.1f} s in motion;"
        f" reference {reference}",
        "",
        *table(unit.head(CHANNEL_HEAD), channel_rows(result, unit)),
        "",
        *noise_lines(result, unit),
        *(f"note: {line}" for line in result.notes),
        "",
        "self-check: root mean square of the normalised residuals, before and after",
        *table(CHECK_HEAD, check_rows(result)),
        f"false alarms per hour of such motion: {result.after.implied:.2g} implied, {result.after.configured:.2g}"
        f" configured; a figure outside {LOW} to {HIGH} is worth a look",
        *(f"warning: {line}" for line in result.warnings),
    ]
    return "\n".join(line.rstrip() for line in lines) + "\n"
