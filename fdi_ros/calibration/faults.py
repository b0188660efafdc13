# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Channels that are faulty during a calibration recording: found, named and kept out, not averaged in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fdi_ros.calibration.data import MEDIAN_TO_RMS, WINDOW, Array, Data, Index, Mask, flag_runs
from fdi_ros.calibration.motion import Motion
from fdi_ros.calibration.noise import NoiseFit
from fdi_ros.calibration.rest import COMMON, Rest
from fdi_ros.model.geometry import Geometry

SPIKE = 7.0
"""Normalised residual beyond which one sample is an outlier."""
OWN_SHARE = 0.8
"""Share of a sample's disagreement that one channel explains, if it is that channel's spike and not a knock on all."""
FAULTY = 3.0
"""Scatter of the normalised residuals in a window at which its channel is faulty there; sound ones have 1."""
OFF = 1.5
"""The middle of its window must be off by so much, in standard deviations of one sample."""
UNUSUAL = 6.0
"""And this many times farther than sound windows are, whatever their colour."""
LEAST_COUNT = 5
"""Samples of a window at least."""
LEAST_WINDOWS = 2
"""Windows in a row that make a fault; one alone is a knock."""
GAP = 8
"""Windows without disagreement that still belong to the fault around them."""


@dataclass(frozen=True)
class Span:
    """One channel, or one of several that cannot be told apart, is faulty from one time to another."""

    channels: tuple[int, ...]
    start: float
    """s from the start of the part calibrated on."""
    end: float
    """s."""
    size: float
    """Usual size of its disagreement, rad/s."""


@dataclass(frozen=True)
class Faults:
    """Faults of samples that are plausible one by one.

    Attributes
    ----------
    spans
        Faults that last.
    windows
        (W, n): the channel is faulty in this window.
    outliers
        (N, n): the channel has a spike.
    """

    spans: tuple[Span, ...]
    windows: Mask
    outliers: Mask

    @property
    def faulty_windows(self) -> Mask:
        """(W,): some channel is faulty."""
        return np.asarray(self.windows.any(axis=1))

    def bad_rows(self, data: Data) -> Mask:
        """(N,): some channel is faulty or has a spike."""
        return self.faulty_windows[data.window] | np.asarray(self.outliers.any(axis=1))


def no_faults(data: Data) -> Faults:
    """Return no faults."""
    n = data.z.shape[1]
    return Faults((), np.zeros((data.windows, n), dtype=bool), np.zeros(data.z.shape, dtype=bool))


def find_faults(data: Data, rest: Rest, motion: Motion, geometry: Geometry, noise: NoiseFit) -> Faults:
    """Find windows and single samples in which one channel disagrees with the others.

    Parameters
    ----------
    data, rest
        The recording and its times at rest.
    motion
        Residuals with the axes estimated so far.
    geometry, noise
        Axes and noise fitted so far, robustly.
    """
    rows = np.flatnonzero(np.isfinite(motion.residual).all(axis=1))
    scores, size, total = _scores(motion, rows, geometry, noise)
    worst = np.abs(scores).argmax(axis=1)
    largest = scores[np.arange(len(rows)), worst] ** 2
    beyond = (largest > SPIKE**2) & (largest > OWN_SHARE * total)
    outliers = np.zeros(data.z.shape, dtype=bool)
    outliers[rows[beyond], worst[beyond]] = True
    middle, scatter = _windows(data, rows, scores)
    errors = np.abs(_windows(data, rows, size)[0])
    faulty = _disagreeing(middle, scatter, rest.window, np.diff(data.starts)) | rest.differs
    # Channels of one group disagree in turn: in time they are one fault.
    faulty = (faulty.astype(np.int64) @ geometry.group_matrix.astype(np.int64)) > 0
    windows = np.column_stack([_lasting(column) for column in faulty.T])
    spans = [
        Span(group, data.seconds_of(first), data.seconds_of(end - 1) + WINDOW, float(np.sqrt(np.mean(part**2))))
        for group in geometry.groups
        for first, end in flag_runs(windows[:, group[0]])
        if len(part := errors[first:end, list(group)])
    ]
    return Faults(tuple(sorted(spans, key=lambda span: span.start)), windows, outliers)


def _scores(motion: Motion, rows: NDArray[np.intp], geometry: Geometry, noise: NoiseFit) -> tuple[Array, Array, Array]:
    """Normalised residuals (K, n), the error of the channel that each would mean, rad/s, and the chi-square (K,)."""
    model = noise.model().for_channels(geometry.n)
    variance = model.variance(geometry, motion.rate[rows], motion.acceleration[rows])
    V = geometry.parity
    covariance = np.einsum("ai,ki,bi->kab", V, variance, V, optimize=True)
    inverse = np.linalg.inv(covariance)
    p = motion.residual[rows] @ V.T
    pulled = np.einsum("kab,kb->ka", inverse, p)
    pull = pulled @ V
    weight = np.einsum("ai,kab,bi->ki", V, inverse, V, optimize=True)
    weight = np.maximum(weight, 1e-12)
    return pull / np.sqrt(weight), pull / weight, np.asarray((p * pulled).sum(axis=1))


def _windows(data: Data, rows: NDArray[np.intp], values: Array) -> tuple[Array, Array]:
    """Median (W, n) in every window and the usual distance from it, which a few spikes do not raise; 0 without rows."""
    middle, scatter = np.zeros((data.windows, values.shape[1])), np.zeros((data.windows, values.shape[1]))
    edges = np.searchsorted(data.window[rows], np.arange(data.windows + 1))
    for k in range(data.windows):
        if edges[k] < edges[k + 1]:
            part = values[edges[k] : edges[k + 1]]
            middle[k] = np.median(part, axis=0)
            scatter[k] = MEDIAN_TO_RMS * np.median(np.abs(part - middle[k]), axis=0)
    return middle, scatter


def _disagreeing(middle: Array, scatter: Array, still: Mask, count: Index) -> Mask:
    """Windows (W, n) in which one channel is off, by its middle or by its scatter, farther than all others.

    How far the middle of a sound window strays is taken from the windows themselves, at rest and in motion apart: the
    samples of a coloured noise are worth few, and vibration rises for all channels at once.
    """
    level = np.maximum(np.median(scatter, axis=1), 1.0)[:, None]
    size = scatter / (FAULTY * level)
    for kind in (still, ~still):
        if kind.any():
            # A fault that lasts has its share in the bias: what is usual is the median, not zero.
            off = np.abs(middle[kind] - np.median(middle[kind], axis=0)) / level[kind]
            spread = MEDIAN_TO_RMS * np.median(off, axis=0)
            spread = np.minimum(spread, COMMON * np.median(spread))
            size[kind] = np.maximum(size[kind], off / np.maximum(OFF, UNUSUAL * spread))
    size[count < LEAST_COUNT] = 0.0
    return np.asarray((size > 1) & (np.arange(size.shape[1]) == size.argmax(axis=1)[:, None]))


def _lasting(flags: Mask) -> Mask:
    """Keep runs long enough to be faults, and close short gaps between them."""
    kept = np.zeros_like(flags)
    for first, end in flag_runs(flags):
        if end - first >= LEAST_WINDOWS:
            kept[first:end] = True
    runs = flag_runs(kept)
    for end, after in zip(runs[:-1, 1], runs[1:, 0], strict=True):
        if after - end <= GAP:
            kept[end:after] = True
    return kept
