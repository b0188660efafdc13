# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Figures of calibrated channels, derived from an estimate of their error states."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fdi_ros.model.samples import Array, Int
from fdi_ros.setup.estimate import SCALE_STD, StateEstimate
from fdi_ros.setup.noise import projector

#: uncertainty of the axes along a direction of the body from which they are not
#: measured
UNMEASURED = SCALE_STD / 2


@dataclass
class ChannelFit:
    """Channels in use, in their order, and what a recording shows of their errors."""

    #: of the channels
    names: tuple[str, ...]
    #: (n, 3) as configured
    nominal: Array
    #: errors of the channels with their covariance
    estimate: StateEstimate
    #: (n,) samples of each channel that were not used, by the reason: as of `Data`, and
    #: spikes
    unusable: dict[str, Int]

    def __post_init__(self) -> None:
        found = self.estimate
        n = len(self.names)
        self.axes = axes = found.axes
        """(n, 3)."""
        self.axes_std = np.sqrt(np.diag(found.axes_covariance)).reshape(-1, 3)
        """(n, 3) standard errors."""
        self.bias_std = np.sqrt(np.diag(found.bias_covariance))
        """(n,) standard errors of the mean biases, in the unit of the channels."""
        self.scale = found.disagreement()
        """Scale error left between channels, as written, and its uncertainty."""
        sine = np.linalg.norm(np.cross(axes, self.nominal), axis=1)
        self.angle = np.arctan2(sine, (axes * self.nominal).sum(axis=1))
        """(n,) angle between calibrated and nominal axes, rad."""
        length = np.linalg.norm(axes, axis=1)
        self.factor = length / np.linalg.norm(self.nominal, axis=1)
        """(n,) scale factor relative to nominal."""
        each = found.axes_covariance.reshape(n, 3, n, 3)
        along = axes / length[:, None]
        own = each[range(n), :, range(n)]
        square = np.einsum("ia,iab,ib->i", along, own, along)
        self.factor_error = np.sqrt(np.maximum(square, 0))
        """(n,) standard errors of the scale factors."""
        across = (self.axes_std**2).sum(axis=1) - self.factor_error**2
        self.angle_error = np.sqrt(np.maximum(across, 0) / 2) / length
        """(n,) standard error of the angle in each of two directions, rad."""
        apart = projector(axes)
        checks = max(n - 3, 1)
        squares = [
            np.trace(apart @ each[:, a, :, a] @ apart) / checks for a in range(3)
        ]
        self.axis_errors = np.sqrt(np.maximum(squares, 0.0))
        """(3,) uncertainty of the disagreement of axes along x, y and z of the body."""
        self.measured = np.sqrt(along**2 @ self.axis_errors**2) < UNMEASURED
        """(n,) channels whose scale factor the recording shows, against the others."""
        # Channels of an array form units of one.
        unit_of = [name.rpartition(".")[0] or name for name in self.names]
        self.units = [
            [i for i, one in enumerate(unit_of) if one == unit]
            for unit in dict.fromkeys(unit_of)
        ]
        """Channels of each unit."""
