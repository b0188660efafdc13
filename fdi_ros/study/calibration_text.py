"""A calibration in words and tables, for a terminal."""

from __future__ import annotations

import numpy as np

from fdi_ros.study.calibration_check import HIGH, LOW, ClassCheck
from fdi_ros.study.calibration_reference import deviations
from fdi_ros.study.calibration_result import Calibration, Delay
from fdi_ros.study.text_table import table

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


def channel_rows(result: Calibration) -> list[tuple[str, ...]]:
    """One row a channel."""
    angle, scale = deviations(result.axes, result.nominal)
    unusable = result.unusable
    lost = unusable.missing + unusable.non_finite + unusable.out_of_range + unusable.spikes
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
                f"{result.bias.mean[i]:.6f}",
                f"{result.bias.std[i]:.6f}",
                f"{result.noise.std[i]:.5f}",
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


def noise_lines(result: Calibration) -> list[str]:
    """Terms of the noise model that hold for all channels, the walk of the biases, and the delays."""
    noise, bias = result.noise, result.bias
    walk = f"biases walk {np.median(bias.walk):.2g} rad/s per sqrt(s)"
    if not bias.shown:
        walk = f"no walk of the biases shown, below {bias.possible:.2g} rad/s per sqrt(s): as configured"
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


def calibration_text(result: Calibration) -> str:
    """Everything, for a terminal."""
    seconds = result.seconds
    reference = ", ".join(result.names[i] for i in result.reference)
    lines = [
        f"calibrated on {seconds['all']:.1f} s: {seconds['rest']:.1f} s at rest, {seconds['motion']:.1f} s in motion;"
        f" reference {reference}",
        "",
        *table(CHANNEL_HEAD, channel_rows(result)),
        "",
        *noise_lines(result),
        *(f"note: {line}" for line in result.notes),
        "",
        "self-check: root mean square of the normalised residuals, before and after",
        *table(CHECK_HEAD, check_rows(result)),
        f"false alarms per hour of such motion: {result.after.implied:.2g} implied, {result.after.configured:.2g}"
        f" configured; a figure outside {LOW} to {HIGH} is worth a look",
        *(f"warning: {line}" for line in result.warnings),
    ]
    return "\n".join(line.rstrip() for line in lines) + "\n"
