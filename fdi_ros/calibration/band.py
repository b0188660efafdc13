# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The motion that all units share: how far up in frequency it goes, the channels confined to it, shifted in time.

A rigid body turns as one, so the units of a vehicle see one rotation, whatever their mounts and delays. Vibration is
another matter: each unit is shaken by its own bit of structure, differently in size and phase. Axes and delays are
therefore taken from the frequencies at which the units are coherent. Above them a phase between two units is no delay.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from fdi_ros.calibration.data import Array, Data, Mask, flag_runs

Spectra = NDArray[np.complex128]

SEGMENT = 2.0
"""Length of the spans whose spectra are averaged, s: 0.5 Hz apart."""
LEAST_SEGMENTS = 8
"""With fewer, three regressors explain whatever there is."""
INCOHERENT = 0.1
"""Share of a channel's power that another unit may leave unexplained where both see one motion."""
MOST = 2 / 3
"""Share of the channels that must be explained: one may be bad, or its axis hardly turned about."""
WIDEST = 0.2
"""The band ends at this share of the sampling rate at most: beyond, samples do not show a derivative."""
PERIODS = 1.5
"""Half length of the low-pass, in periods of its cut-off."""
SLOW = 10.0
"""Slower than this is left to the biases, s."""
BRIDGED = 3
"""Samples in a row that may be missing and are interpolated."""
OVERSAMPLED = 4.0
"""Rows used per period of the fastest motion."""
MOST_ROWS = 8000
"""More rows add nothing but time."""


@dataclass(frozen=True)
class Band:
    """The channels confined to the motion that they share.

    Attributes
    ----------
    cutoff
        Its upper end, Hz.
    spans
        Without gaps.
    low
        (N, n) channels below the cut-off, rad/s; NaN where there are none.
    rows
        (N,) samples that are fitted to: in motion, and no more of them than the band has independent ones.
    """

    cutoff: float
    spans: list[slice]
    low: Array
    rows: Mask


def find_band(data: Data, good: Mask, moving: Mask, units: list[list[int]]) -> Band | None:
    """Confine the channels to the motion that they share; None where they share none.

    Parameters
    ----------
    data
        The recording.
    good
        (N,) complete samples without a fault found so far.
    moving
        (N,) samples in motion.
    units
        Channels of each unit.
    """
    spans = gapless_spans(data, good)
    full = bridged(data, data.z, good, spans)
    cutoff = motion_band(data, full, spans, moving, units)
    if not cutoff:
        return None
    spans, low = confined(data, good, cutoff)
    sparse = np.zeros(len(good), dtype=bool)
    sparse[:: max(int(1 / (OVERSAMPLED * cutoff * data.step)), len(good) // MOST_ROWS, 1)] = True
    return Band(cutoff, spans, low, sparse & moving & np.isfinite(low).all(axis=1))


def confined(data: Data, good: Mask, cutoff: float) -> tuple[list[slice], Array]:
    """Spans without a gap of good samples (N,), and the channels (N, n) in them below a frequency, Hz."""
    spans = gapless_spans(data, good)
    return spans, low_pass(data, bridged(data, data.z, good, spans), spans, cutoff)


def gapless_spans(data: Data, good: Mask) -> list[slice]:
    """Spans without a gap in time, and without more than `BRIDGED` samples in a row that are not good (N,)."""
    hole = np.zeros(len(good), dtype=bool)
    for first, end in flag_runs(~good):
        hole[first:end] = end - first > BRIDGED or first == 0 or end == len(good)
    kept = np.flatnonzero(~hole)
    if not len(kept):
        return []
    apart = (np.diff(kept) > 1) | (np.diff(data.seconds[kept]) > 1.5 * data.step)
    parts = np.split(kept, np.flatnonzero(apart) + 1)
    # Between two gaps in time there may be nothing good.
    return [slice(int(part[0]), int(part[-1]) + 1) for part in parts if good[part].any()]


def bridged(data: Data, z: Array, good: Mask, spans: list[slice]) -> Array:
    """Channels (N, n) with the samples in the spans that are not good interpolated, NaN outside the spans."""
    full = np.full_like(z, np.nan)
    for span in spans:
        t, part, there = data.seconds[span], z[span], good[span]
        full[span] = part
        if not there.all():
            full[span] = np.column_stack([np.interp(t, t[there], column[there]) for column in part.T])
    return full


def motion_band(data: Data, z: Array, spans: list[slice], moving: Mask, units: list[list[int]]) -> float:
    """Frequency up to which the units see one and the same motion, Hz; 0: they do not.

    Parameters
    ----------
    data
        The recording.
    z
        (N, n) channels, complete in the spans, rad/s.
    spans
        Without gaps.
    moving
        (N,) samples in motion: spectra are taken where most of a segment is.
    units
        Channels of each unit; those of three or more explain the others.
    """
    spectra = _spectra(data, z, spans, moving)
    if len(spectra) < LEAST_SEGMENTS:
        return 0.0
    share = np.quantile(_incoherent(spectra, units), MOST, axis=1)
    smooth = np.convolve(share, np.ones(3) / 3, mode="same")
    # The first bin holds the biases; the means at both ends lack a neighbour.
    above = np.flatnonzero(smooth[2:-1] > INCOHERENT)
    last = int(above[0]) + 2 if len(above) else len(smooth) - 1
    return float(min((last - 0.5) / SEGMENT, WIDEST / data.step)) if last > 2 else 0.0


def _spectra(data: Data, z: Array, spans: list[slice], moving: Mask) -> Spectra:
    """Fourier transforms (K, F, n) of segments that overlap by half."""
    length = max(round(SEGMENT / data.step), 8)
    window = np.hanning(length + 2)[1:-1]
    found = []
    for span in spans:
        for first in range(span.start, span.stop - length + 1, length // 2):
            if moving[first : first + length].mean() > 0.5:
                part = z[first : first + length]
                found.append(np.fft.rfft((part - part.mean(axis=0)) * window[:, None], axis=0))
    return np.array(found)


def _incoherent(spectra: Spectra, units: list[list[int]]) -> Array:
    """Share (F, c) of the power of each channel that the best one of the other units does not explain.

    The gains are complex and any: neither a wrong mount nor a delay costs coherence. Channels that no unit of three
    could explain are left out.
    """
    shares = np.full(spectra.shape[1:], np.inf)
    for unit in units:
        for other in units:
            if other is unit or len(other) < 3:
                continue
            y, x = spectra[:, :, unit].transpose(1, 0, 2), spectra[:, :, other].transpose(1, 0, 2)
            left = (np.abs(y - x @ (np.linalg.pinv(x) @ y)) ** 2).sum(axis=1) / max(len(spectra) - len(other), 1)
            total = (np.abs(y) ** 2).sum(axis=1) / len(spectra)
            shares[:, unit] = np.minimum(shares[:, unit], left / np.maximum(total, 1e-300))
    return np.asarray(shares[:, np.isfinite(shares).all(axis=0)])


def low_pass(data: Data, z: Array, spans: list[slice], cutoff: float) -> Array:
    """Channels (N, n) below a frequency, Hz, without lag; NaN where the filter lacks samples on one side."""
    half = int(np.ceil(PERIODS / (cutoff * data.step)))
    at = np.arange(-half, half + 1)
    weight = np.sinc(2 * cutoff * data.step * at) * np.hanning(2 * half + 3)[1:-1]
    weight /= weight.sum()
    low = np.full_like(z, np.nan)
    for span in spans:
        if span.stop - span.start > 2 * half:
            columns = [np.convolve(column, weight, mode="valid") for column in z[span].T]
            low[span.start + half : span.stop - half] = np.column_stack(columns)
    return low


def without_slow(data: Data, z: Array) -> Array:
    """Channels (N, n) less their mean over `SLOW` seconds around, as far as there are samples: biases fall out."""
    there = np.asarray(np.isfinite(z).all(axis=1))
    sums = np.vstack([np.zeros(z.shape[1]), np.cumsum(np.where(there[:, None], z, 0.0), axis=0)])
    count = np.concatenate([[0], np.cumsum(there)])
    first = np.searchsorted(data.seconds, data.seconds - SLOW / 2)
    end = np.searchsorted(data.seconds, data.seconds + SLOW / 2, side="right")
    mean = (sums[end] - sums[first]) / np.maximum(count[end] - count[first], 1)[:, None]
    return np.asarray(z - mean)


def shifted(data: Data, z: Array, spans: list[slice], late: Array) -> Array:
    """Channels (N, n) as they were at the stamps, each stamped late (n,) by so much, s; NaN outside what is known."""
    moved = np.full_like(z, np.nan)
    for span in spans:
        rows = np.flatnonzero(np.isfinite(z[span]).all(axis=1)) + span.start
        if len(rows) < 4:
            continue
        t = data.seconds[rows]
        for value in np.unique(late):
            at = data.seconds[span] + value
            column = np.flatnonzero(late == value)
            line = CubicSpline(t, z[rows][:, column])(at) if value else z[span][:, column]
            inside = np.asarray((at >= t[0]) & (at <= t[-1]))
            moved[span, column] = np.where(inside[:, None], line, np.nan)
    return moved


def aligned(data: Data, z: Array, late: Array, max_skew: float) -> Array:
    """Channels (N, n) as the monitor aligns them once it takes the delays off.

    A message within max_skew, s, of the instant counts as it is, else the line between the messages on both sides.

    Parameters
    ----------
    data
        The recording.
    z
        (N, n) rad/s.
    late
        (n,) by how much the stamps of each channel are late against those of the first, s.
    max_skew
        imus.max_skew, s.
    """
    moved, t = z.copy(), data.seconds
    for value in np.unique(late[late != 0]):
        at, column = t + value, np.flatnonzero(late == value)
        after = np.clip(np.searchsorted(t, at), 1, len(t) - 1)
        span = t[after] - t[after - 1]
        share = np.clip((at - t[after - 1]) / span, 0.0, 1.0)
        share = np.where(np.minimum(share, 1 - share) * span <= max_skew, np.round(share), share)[:, None]
        before, behind = z[after - 1][:, column], z[after][:, column]
        line = np.where(share == 0, before, np.where(share == 1, behind, (1 - share) * before + share * behind))
        outside = (at < t[0]) | (at > t[-1]) | ((span > 1.5 * data.step) & (share[:, 0] % 1 > 0))
        moved[:, column] = np.where(np.asarray(outside)[:, None], np.nan, line)
    return moved
