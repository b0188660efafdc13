# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a calibration found: figures with their uncertainty, and the settings that follow."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from fdi_ros.arrays import Array, Int
from fdi_ros.calibration.estimate import Estimate

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
class Unusable:
    """Samples of each channel that were not used, (n,) each, and why."""

    missing: Int
    non_finite: Int
    out_of_range: Int
    repeated: Int
    spikes: Int

    @property
    def total(self) -> Int:
        """(n,) for all reasons together."""
        return self.missing + self.non_finite + self.out_of_range + self.repeated + self.spikes


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
    unusable: Unusable
    seconds: Seconds
    settings: dict[str, object]
    """Parameters to be changed, ``{"section.field": value}``."""
    weak: tuple[str, ...] = ()
    """What the recording does not show, what is taken instead, and how to get it, one line each."""
    warnings: tuple[str, ...] = ()
    """What to look at before trusting it, one line each."""

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
        unit, n = self._unit, len(self.names)
        each = self.estimate.axes_covariance.reshape(n, 3, n, 3)[range(n), :, range(n)]
        return np.sqrt(np.maximum(np.einsum("ia,iab,ib->i", unit, each, unit), 0))

    @property
    def angle_error(self) -> Array:
        """(n,) standard error of each direction, rad, in each of the two directions across it."""
        across = (self.axes_std**2).sum(axis=1) - self.scale_error**2
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
    names, found = result.names, result.estimate
    return {
        "seconds": asdict(result.seconds),
        "channels": [_channel_figures(result, i) for i in range(len(names))],
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


def _channel_figures(result: Calibration, i: int) -> dict[str, object]:
    unusable, found = result.unusable, result.estimate
    angle, scale = deviations(result.axes, result.nominal)
    return {
        "name": result.names[i],
        "axis": result.axes[i],
        "axis_std": result.axes_std[i],
        "scale": scale[i],
        "scale_std": result.scale_error[i],
        "off_nominal_rad": angle[i],
        "angle_std_rad": result.angle_error[i],
        "bias": found.bias[i],
        "bias_std": result.bias_std[i],
        "noise_std": found.floor.std[i],
        "noise_std_error": found.floor.error[i],
        "noise_median": float(np.median(found.moment[:, i])),
        "noise_largest": float(found.moment[:, i].max()),
        "not_used": {
            "missing": unusable.missing[i],
            "not_finite": unusable.non_finite[i],
            "out_of_range": unusable.out_of_range[i],
            "repeated": unusable.repeated[i],
            "spikes": unusable.spikes[i],
        },
    }
