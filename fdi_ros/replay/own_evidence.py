# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Evidence against each channel that is left out as faulty, by its own residual.

The statistic of the monitor falls when a channel is named, because the channels that
remain agree. The residual of the channel itself shows for how long its fault lasts.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fdi_ros.core.states import ChannelState
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.samples import Array
from fdi_ros.monitor.output import Output
from fdi_ros.report.layout import FINE, PageStore

SPAN = 1.0
"""Time over which a residual is averaged, s."""
MOST_STORED = 2000
"""Largest number of spans of a recording that the page has."""


class OwnEvidence:
    """Log of the likelihood ratio of an error, over each span of time, while a channel is FAULTY.

    For the mean residual m of a span and the variance v of m, the ratio is exp(m^2 / 2v)
    if the error is as large as m. The noise of the samples is taken as white.

    Parameters
    ----------
    geometry
        Channels, n.
    noise_std
        (n,) standard deviation of the noise of each channel.
    names
        Names of the n series in `store`.
    """

    def __init__(self, geometry: Geometry, noise_std: Array, names: list[str]) -> None:
        #: the evidence of each channel over the time of the recording
        self.store = PageStore(dict.fromkeys(names, FINE), MOST_STORED)
        #: largest evidence of any channel
        self.peak = 0.0
        self._axes = geometry.axes
        self._variance = noise_std**2
        self._span = 0
        self._clear()

    def add(self, time: Array, output: Output) -> None:
        """Add samples at times (N,), s."""
        faulty = output.state == ChannelState.FAULTY
        delivered = faulty & np.isfinite(output.residual)
        spans = np.floor(time / SPAN).astype(np.int64)
        bounds = np.flatnonzero(np.diff(spans)) + 1
        for rows in np.split(np.arange(len(time)), bounds):
            if len(rows) and spans[rows[0]] != self._span:
                self._close()
                self._span = int(spans[rows[0]])
            if delivered[rows].any():
                self._sum_up(output, rows, delivered[rows])

    def finish(self) -> None:
        """Close the last span."""
        self._close()

    def _clear(self) -> None:
        self._count = np.zeros(len(self._axes))
        self._residual = np.zeros(len(self._axes))
        self._of_rate = np.zeros(len(self._axes))

    def _sum_up(
        self, output: Output, rows: NDArray[np.int64], delivered: NDArray[np.bool_]
    ) -> None:
        covariance = output.covariance[rows]
        of_rate = np.einsum("ij,njk,ik->ni", self._axes, covariance, self._axes)
        self._count += delivered.sum(axis=0)
        self._residual += np.where(delivered, output.residual[rows], 0.0).sum(axis=0)
        self._of_rate += np.where(delivered, of_rate, 0.0).sum(axis=0)

    def _close(self) -> None:
        """Store the evidence of the span that ends."""
        count = np.where(self._count > 0, self._count, np.nan)
        variance = (self._variance + self._of_rate) / count
        evidence = (self._residual / count) ** 2 / (2.0 * variance)
        known = evidence[np.isfinite(evidence)]
        self.peak = max(self.peak, known.max(initial=0.0))
        middle = (self._span + 0.5) * SPAN
        self.store.add(np.array([middle]), evidence[None, :])
        self._clear()
