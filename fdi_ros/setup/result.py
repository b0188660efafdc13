# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a calibration found: figures with their uncertainty, in words, and the settings that follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from fdi_ros.config.config import Config
from fdi_ros.model.noise import noisier_words
from fdi_ros.model.samples import Array, Int, Mask
from fdi_ros.report.layout import RADIANS, Column, Unit, figures_of, first_of
from fdi_ros.setup.estimate import Estimate

SHOWN = 3.0
"""Standard errors from which a delay is shown."""


@dataclass(frozen=True)
class Delay:
    """By how much the stamps of a unit are late against those of the first."""

    channels: tuple[int, ...]
    value: float
    """s; positive: their stamps are late, what they stand for was measured that much earlier. As imus.delays has it."""
    error: float
    """s."""

    @property
    def shown(self) -> bool:
        """Whether the data show one."""
        return abs(self.value) > SHOWN * self.error


@dataclass(frozen=True)
class Seconds:
    """Length of the recording, of its times at rest and of its motion, s."""

    all: float
    rest: float
    motion: float


@dataclass(frozen=True)
class Span:
    """Channels, one of which at least is faulty from one time to another."""

    channels: tuple[int, ...]
    start: float
    """s from the start of the part calibrated on."""
    end: float
    """s."""


@dataclass(frozen=True)
class Calibration:
    """Result for the channels in use; all that is per channel is in their order."""

    names: tuple[str, ...]
    channels: tuple[int, ...]
    """Number of each of these channels in the configuration."""
    nominal: Array
    """(n, 3) as configured."""
    estimate: Estimate
    scale: tuple[float, float]
    """Scale error left between channels, as written, and its uncertainty."""
    timing: float
    """What is not known of the sampling instants, s, as written."""
    delays: tuple[Delay, ...]
    """Of all units but the first."""
    faults: tuple[Span, ...]
    unusable: dict[str, Int]
    """(n,) samples of each channel that were not used, by the reason: as of `Data`, and spikes."""
    seconds: Seconds
    settings: dict[str, object]
    """Parameters to be changed, ``{"section.field": value}``."""
    weak: tuple[str, ...] = ()
    """What the recording does not show, what is taken instead, and how to get it, one line each."""
    warnings: tuple[str, ...] = ()
    """What to look at before trusting it, one line each."""

    @property
    def units(self) -> tuple[tuple[int, ...], ...]:
        """Places of the channels of each unit; of an array without units each channel is alone."""
        unit_of = [name.rpartition(".")[0] or name for name in self.names]
        return tuple(tuple(i for i, one in enumerate(unit_of) if one == unit) for unit in dict.fromkeys(unit_of))

    @property
    def axes(self) -> Array:
        """(n, 3)."""
        return self.estimate.axes

    @property
    def axes_std(self) -> Array:
        """(n, 3) standard errors of the axes."""
        return np.sqrt(np.diag(self.estimate.axes_covariance)).reshape(-1, 3)

    @property
    def bias_std(self) -> Array:
        """(n,) standard errors of the mean biases, rad/s."""
        return np.sqrt(np.diag(self.estimate.bias_covariance))

    @property
    def scale_error(self) -> Array:
        """(n,) standard error of each scale factor, relative."""
        unit, n = self.axes / np.linalg.norm(self.axes, axis=1)[:, None], len(self.names)
        each = self.estimate.axes_covariance.reshape(n, 3, n, 3)[range(n), :, range(n)]
        return np.sqrt(np.maximum(np.einsum("ia,iab,ib->i", unit, each, unit), 0))

    @property
    def measured(self) -> Mask:
        """(n,) channels whose scale factor the recording shows, against the others."""
        error, unit = axis_errors(self), self.axes / np.linalg.norm(self.axes, axis=1)[:, None]
        return np.asarray(np.sqrt(unit**2 @ error**2) < UNMEASURED)

    @property
    def angle_error(self) -> Array:
        """(n,) standard error of each direction, rad, in each of the two directions across it."""
        across = (self.axes_std**2).sum(axis=1) - self.scale_error**2
        return np.sqrt(np.maximum(across, 0) / 2) / np.linalg.norm(self.axes, axis=1)


def deviations(axes: Array, nominal: Array) -> tuple[Array, Array]:
    """Angle (n,) rad between calibrated and nominal axes, and scale factor (n,) relative to nominal."""
    norm, nominal_norm = np.linalg.norm(axes, axis=1), np.linalg.norm(nominal, axis=1)
    sine = np.linalg.norm(np.cross(axes, nominal), axis=1)
    return np.arctan2(sine, (axes * nominal).sum(axis=1)), norm / nominal_norm


def calibration_figures(result: Calibration) -> dict[str, object]:
    """Return all figures by name, SI units: for programs."""
    names, found = result.names, result.estimate
    return {
        "seconds": asdict(result.seconds),
        "channels": figures_of(channel_columns(result)),
        "noise": {
            "share_of_recording": found.floor.share,
            "scale_std": result.scale[0],
            "scale_std_error": result.scale[1],
            "timing_std_s": result.timing,
            "bias_walk": found.walk.value or None,
            "bias_walk_possible": found.walk.possible,
        },
        "delays": [
            {"channels": [names[i] for i in d.channels], "late_s": d.value, "std_s": d.error, "shown": d.shown}
            for d in result.delays
        ],
        "faults": [
            {"channels": [names[i] for i in span.channels], "start_s": span.start, "end_s": span.end}
            for span in result.faults
        ],
        "settings": result.settings,
        "weak": list(result.weak),
        "warnings": list(result.warnings),
    }


def channel_columns(result: Calibration, unit: Unit = RADIANS) -> list[Column]:
    """Figures of every channel, one row each."""
    found, rate, degrees = result.estimate, unit.factor, float(np.degrees(1.0))
    angle, scale = deviations(result.axes, result.nominal)

    def measured(values: Array, form: str) -> list[str]:
        return [
            f"{value:{form}}" if shown else "not measured" for value, shown in zip(values, result.measured, strict=True)
        ]

    lost = [{why: count[i] for why, count in result.unusable.items()} for i in range(len(result.names))]
    return [
        Column("name", result.names, ("channel",)),
        Column("axis", result.axes, ("axis x", "y", "z"), ".5f"),
        Column("axis_std", result.axes_std),
        Column("scale", scale),
        Column("scale_std", result.scale_error),
        Column("scale_measured", result.measured),
        Column("", measured(scale, ".5f"), ("scale",)),
        Column("", measured(100 * result.scale_error, ".3f"), ("+-%",)),
        Column("off_nominal_rad", angle, ("off nominal deg",), ".3f", degrees),
        Column("angle_std_rad", result.angle_error, ("+-deg",), ".3f", degrees),
        Column("bias", found.bias, ("bias rad/s",), ".6f", rate),
        Column("bias_std", result.bias_std, ("+-",), ".6f", rate),
        Column("noise_std", found.floor.std, ("noise rad/s",), ".5f", rate),
        Column("noise_std_error", found.floor.error, ("+-",), ".5f", rate),
        Column("noise_median", np.median(found.moment, axis=0), ("usually rad/s",), ".5f", rate),
        Column("noise_largest", found.moment.max(axis=0)),
        Column("not_used", lost, ("not used",), lambda counts: str(sum(counts.values()))),
    ]


# In words ------------------------------------------------------------------------------------------------------------

WHY = {
    "missing": "missing",
    "not_finite": "not finite",
    "out_of_range": "out of range",
    "repeated": "frozen",
    "spikes": "spikes",
}
"""Words for values that were not used."""
SHOWN_AXES = 0.002
"""Uncertainty of the axes along a direction of the body from which they are not well shown."""
UNMEASURED = 0.004
"""The same from which they are not measured: half of what is not known of scale factors before."""
SHOWN_DELAY = 0.001
"""The same of delays, s."""
LEAST_SHARE = 0.2
"""Part of a recording that supports its noise."""
LARGE_SWING = float(np.radians(0.03))
"""Change of a bias within a recording that is worth a look, rad/s."""
LARGE_BIAS = 0.2
"""rad/s."""
LARGE_ANGLE, LARGE_SCALE = np.radians(5.0), 0.05
"""Axes that far from nominal are worth a look."""


def weak_of(result: Calibration, config: Config) -> tuple[str, ...]:
    """List what is not observed, what is taken instead, and how to get it."""
    found, lines = result.estimate, []
    if not result.seconds.rest:
        common = float(np.sqrt(np.mean(result.bias_std**2)))
        lines.append(
            f"nowhere at rest: what all biases have in common looks like a rotation (+-{common:.2g} rad/s);"
            " noise_std is the lower envelope in motion. Let the vehicle stand still for 10 s, motors off"
        )
    elif (share := found.floor.share) <= LEAST_SHARE:
        lines.append(f"noise_std is from the quietest {share:.0%} of the recording: a longer rest would show it better")
    error, rate = axis_errors(result), found.rate - np.median(found.rate, axis=0)
    rms = np.sqrt(np.mean(rate**2, axis=0))
    if unmeasured := ["xyz"[a] for a in range(3) if error[a] > UNMEASURED]:
        axes = "" if len(unmeasured) == 3 else f" about {' and '.join(unmeasured)}"
        lines.append(
            f"scale factors{axes.replace('about', 'along')}: not measured (no turns{axes} beyond what vibration"
            " explains); they stay near those configured, with their uncertainty. Turn it back and forth, some 1 rad/s"
        )
    poor = [a for a in range(3) if SHOWN_AXES < error[a] <= UNMEASURED]
    if poor:
        words = ", ".join(f"{'xyz'[a]} ({rms[a]:.2g} rad/s rms, axes +-{error[a]:.1%})" for a in poor)
        lines.append(
            f"too little rotation about {words} of {config.body_frame}: the axes stay near those configured there."
            " Turn it back and forth about them, some 1 rad/s"
        )
    late = [d for d in result.delays if d.error > SHOWN_DELAY]
    if late:
        names = ", ".join(dict.fromkeys(result.names[d.channels[0]].rpartition(".")[0] for d in late))
        worst = max(d.error for d in late)
        lines.append(f"delays of {names} are known to {1e3 * worst:.1f} ms only: turn it faster, back and forth")
    return tuple(lines)


def axis_errors(result: Calibration) -> Array:
    """Uncertainty (3,) of the disagreement of axes along x, y and z of the body."""
    found, n = result.estimate, len(result.names)
    apart = np.eye(n) - found.axes @ np.linalg.pinv(found.axes)
    each = found.axes_covariance.reshape(n, 3, n, 3)
    error = [np.sqrt(max(np.trace(apart @ each[:, a, :, a] @ apart), 0.0) / max(n - 3, 1)) for a in range(3)]
    return np.array(error)


def warnings_of(result: Calibration) -> tuple[str, ...]:
    """List what to look at before the settings are trusted, grouped."""
    return tuple(
        line
        for line in (faults_words(result), _unusable(result), _noise(result), _axes(result), _biases(result))
        if line
    )


def _who(names: Sequence[str], total: int) -> str:
    return "every channel" if len(names) == total else ", ".join(names)


def faults_words(result: Calibration) -> str:
    """Say what the monitor declares in the recording that it was set up on; empty: nothing."""
    if not result.faults:
        return ""
    shown = [
        f"{' or '.join(result.names[i] for i in span.channels)} from {span.start:.1f} s to {span.end:.1f} s"
        for span in result.faults
    ]
    return f"the monitor declares channels in this very recording: {first_of(shown, 3, '; ')}"


def _unusable(result: Calibration) -> str:
    parts = []
    for why, count in result.unusable.items():
        bad = [result.names[i] for i in np.flatnonzero(count)]
        if bad and (why not in ("missing", "spikes") or count.max() > 0.01 * result.estimate.blocks.count.sum()):
            parts.append(f"{int(count.sum())} {WHY[why]} ({_who(bad, len(result.names))})")
    return f"values not used: {'; '.join(parts)}" if parts else ""


def noisier(result: Calibration, unit: Unit = RADIANS) -> str:
    """Say which channels are much noisier in motion than those of all other units; empty: none is."""
    return noisier_words(result.names, np.median(result.estimate.moment, axis=0), result.units, unit.name, unit.factor)


def _noise(result: Calibration) -> str:
    at_rest = noisier_words(result.names, result.estimate.floor.std, result.units)
    parts = [f"{words} {when}" for words, when in ((noisier(result), "in motion"), (at_rest, "at rest")) if words]
    return f"{'; '.join(parts)}: loose, badly isolated, of another make, or faulty" if parts else ""


def _axes(result: Calibration) -> str:
    angle, scale = deviations(result.axes, result.nominal)
    parts = [f"{result.names[i]} by {np.degrees(angle[i]):.1f} deg" for i in np.flatnonzero(angle > LARGE_ANGLE)]
    parts += [f"{result.names[i]} by {scale[i] - 1:+.1%}" for i in np.flatnonzero(np.abs(scale - 1) > LARGE_SCALE)]
    return f"axes off their nominal ones: {', '.join(parts)}" if parts else ""


def _biases(result: Calibration) -> str:
    found, names, parts = result.estimate, result.names, []
    swing = np.ptp(found.curve, axis=0)
    moving = [names[i] for i in np.flatnonzero(swing > LARGE_SWING)]
    if moving:
        parts.append(f"moved within the recording by up to {swing.max():.2g} rad/s ({_who(moving, len(names))})")
    large = np.flatnonzero(np.abs(found.bias) > LARGE_BIAS)
    parts += [f"{names[i]} has {found.bias[i]:.3f} rad/s" for i in large]
    return f"biases: {'; '.join(parts)}; bias.fixed is the mean" if parts else ""
