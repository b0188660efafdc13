# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The task of a calibration and its estimate so far, whether from rest or from motion alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fdi_ros.calibration.bias import Bias
from fdi_ros.calibration.data import Array, Data, Index
from fdi_ros.calibration.faults import Faults
from fdi_ros.calibration.motion import Motion
from fdi_ros.calibration.noise import NoiseFit
from fdi_ros.calibration.rest import Rest
from fdi_ros.config.config import Config
from fdi_ros.model.geometry import Geometry

SHOWN = 3.0
"""Standard errors from which a delay is shown."""
LEAST_SKEW = 5e-5
"""What imus.max_skew is at least where delays smaller than it are to be taken off, s."""


@dataclass(frozen=True)
class Task:
    """The recording, its channels in use, and the configuration of these."""

    config: Config
    data: Data
    nominal: Geometry
    reference: list[int]
    groups: Index
    """(m,) for every other channel which of them it is sampled together with; -1: with the reference."""
    units: list[list[int]]
    """Channels of each unit; where units are not known: the reference, and all others."""

    @property
    def others(self) -> list[int]:
        """Channels other than the reference."""
        return [i for i in range(self.nominal.n) if i not in self.reference]


@dataclass(frozen=True)
class Estimate:
    """Estimate of all that is calibrated, after some iterations."""

    rest: Rest
    faults: Faults
    bias: Bias
    geometry: Geometry
    covariance: Array
    """(n, 3, 3) of the axes."""
    late: Array
    """(n,) by how much the stamps of each channel are late against those of the reference, s."""
    late_error: Array
    """(n,) its standard error, s."""
    noise: NoiseFit
    """With the delays taken out."""
    motion: Motion
    """With these axes; residuals with faults in them, so that the next iteration finds them again."""
    notes: tuple[str, ...] = ()
    """What the recording does not show, and what is taken instead."""

    @property
    def late_shown(self) -> Array:
        """(n,) delays that the recording shows, the others zero, s."""
        return np.where(np.abs(self.late) > SHOWN * self.late_error, self.late, 0.0)


def skew(task: Task, late: Array) -> float:
    """Find imus.max_skew, s, with which the delays (n,) s are taken off: within it, stamps count as one instant."""
    configured = task.config.imus.max_skew
    left = np.abs(late - np.round(late / task.data.step) * task.data.step)
    hidden = left[(left > 2 * LEAST_SKEW) & (left <= configured)]
    return float(f"{hidden.min() / 2:.2g}") if len(hidden) else configured


def uncertainty(covariance: Array, late_error: Array, others: list[int]) -> Array:
    """Scale and timing errors (2,) that calibrated channels have at least: what is not known of axes and delays, s."""
    axes = np.sqrt(np.trace(covariance, axis1=1, axis2=2)[others].mean() / 3)
    return np.array([axes, np.sqrt(np.mean(late_error[others] ** 2))])
