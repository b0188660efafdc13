# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Result of a calibration: what was found, with standard errors, and all of it as JSON."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from fdi_ros.calibration.bias import Bias
from fdi_ros.calibration.data import Array, Index
from fdi_ros.calibration.estimate import SHOWN
from fdi_ros.calibration.faults import Faults
from fdi_ros.calibration.noise import NoiseFit
from fdi_ros.calibration.self_check import ClassCheck, SelfCheck


@dataclass(frozen=True)
class Delay:
    """Delay of the stamps of channels that are sampled together, against those of the reference."""

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
class Unusable:
    """Samples of each channel that were not used, (n,) each, and why."""

    missing: Index
    non_finite: Index
    out_of_range: Index
    repeated: Index
    spikes: Index

    @property
    def total(self) -> Index:
        """(n,) for all reasons together."""
        return self.missing + self.non_finite + self.out_of_range + self.repeated + self.spikes


@dataclass(frozen=True)
class Calibration:
    """Result for the channels in use; all that is per channel is in their order."""

    names: tuple[str, ...]
    channels: tuple[int, ...]
    """Number of each of these channels in the configuration."""
    reference: tuple[int, ...]
    """The three channels that fix the body frame and the scale, as numbers of these channels."""
    nominal: Array
    """(n, 3) as configured."""
    axes: Array
    """(n, 3)."""
    axes_covariance: Array
    """(n, 3, 3); zero for the reference."""
    bias: Bias
    noise: NoiseFit
    """As the pipeline meets it."""
    delays: tuple[Delay, ...]
    faults: Faults
    unusable: Unusable
    seconds: Seconds
    settings: dict[str, object]
    """Parameters to be changed, ``{"section.field": value}``."""
    before: SelfCheck
    """The configuration as it was, on the same samples."""
    after: SelfCheck
    """With the settings."""
    notes: tuple[str, ...] = ()
    """What the recording does not show, and what is taken instead; empty: from rest, all of it is shown."""
    warnings: tuple[str, ...] = ()
    """What to look at before trusting it, one line each."""

    @property
    def scale_error(self) -> Array:
        """(n,) standard error of each scale factor, relative."""
        return np.sqrt(np.maximum(np.einsum("ia,iab,ib->i", self._unit, self.axes_covariance, self._unit), 0))

    @property
    def angle_error(self) -> Array:
        """(n,) standard error of each direction, rad, in each of the two directions across it."""
        across = np.trace(self.axes_covariance, axis1=1, axis2=2) - self.scale_error**2
        return np.sqrt(np.maximum(across, 0) / 2) / np.linalg.norm(self.axes, axis=1)

    @property
    def _unit(self) -> Array:
        return self.axes / np.linalg.norm(self.axes, axis=1)[:, None]


def deviations(axes: Array, nominal: Array) -> tuple[Array, Array]:
    """Angle (n,) rad between calibrated and nominal axes, and scale factor (n,) relative to nominal."""
    norm, nominal_norm = np.linalg.norm(axes, axis=1), np.linalg.norm(nominal, axis=1)
    sine = np.linalg.norm(np.cross(axes, nominal), axis=1)
    return np.arctan2(sine, (axes * nominal).sum(axis=1)), norm / nominal_norm


def calibration_figures(result: Calibration) -> dict[str, object]:
    """Return all figures by name, SI units: for programs."""
    names, noise, bias = result.names, result.noise, result.bias
    return {
        "seconds": asdict(result.seconds),
        "reference": [names[i] for i in result.reference],
        "channels": [_channel_figures(result, i) for i in range(len(names))],
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


def _channel_figures(result: Calibration, i: int) -> dict[str, object]:
    unusable = result.unusable
    angle, scale = deviations(result.axes, result.nominal)
    return {
        "name": result.names[i],
        "axis": result.axes[i],
        "scale": scale[i],
        "scale_std": result.scale_error[i],
        "off_nominal_rad": angle[i],
        "angle_std_rad": result.angle_error[i],
        "bias": result.bias.mean[i],
        "bias_std": result.bias.std[i],
        "noise_std": result.noise.std[i],
        "not_used": {
            "missing": unusable.missing[i],
            "not_finite": unusable.non_finite[i],
            "out_of_range": unusable.out_of_range[i],
            "repeated": unusable.repeated[i],
            "spikes": unusable.spikes[i],
        },
    }


def _check_figures(one: ClassCheck) -> dict[str, object]:
    return {
        "motion": one.name,
        "seconds": one.seconds,
        "normalised_residual": one.overall,
        "largest": one.largest,
        "residual_rms": one.residual,
        "alarms": one.alarms,
        "false_alarms_per_hour": one.false_alarms,
    }
