# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The times at rest: windows in which the vehicle stands still."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fdi_ros.calibration.data import MEDIAN_TO_RMS, WINDOW, Array, Data, Mask

MIN_SAMPLES = 5
"""Windows with fewer usable samples are left out."""
QUIET = 1.7
"""At rest no channel's standard deviation in a window exceeds its level at rest by this factor."""
LEAST_LEVEL = 1e-5
"""A gyro without noise must not make everything else look like motion, rad/s."""
COMMON = 3.0
"""The spread of a channel's means counts up to this many times the median one: a fault must not raise its own limit."""
CLIP = 4.0
"""Values in a window farther from its median than this many levels are clipped: one spike is no motion."""


@dataclass(frozen=True)
class Rest:
    """The windows at rest.

    Attributes
    ----------
    window
        (W,): the vehicle stood still.
    fits
        (W, n): and the channel shows it, too.
    differs
        (W, n): its mean is not what it is in its other windows at rest; that it is noisier for once does not count.
    mean, std
        (W, n) rad/s of each channel in each window, spikes clipped.
    level
        (n,) standard deviation of each channel at rest, rad/s.
    """

    window: Mask
    fits: Mask
    differs: Mask
    mean: Array
    std: Array
    level: Array

    @property
    def seconds(self) -> float:
        """Time at rest, s."""
        return float(self.window.sum()) * WINDOW


def find_rest(data: Data, max_rest_rate: float) -> Rest:
    """Find the windows in which the vehicle stood still.

    They are as quiet as the quietest, and their means agree with each other. One channel may differ (it may be
    faulty): every rotation is measured by two at least, or nothing could be checked.

    Parameters
    ----------
    data
        The recording.
    max_rest_rate
        No bias is larger than this, rad/s.
    """
    mean, std, _ = _statistics(data, None)
    level = np.maximum(np.nanpercentile(std, 10, axis=0), LEAST_LEVEL)
    for _ in range(4):
        mean, std, still = _statistics(data, level)
        quiet = (std < QUIET * level) & (np.abs(mean) < max_rest_rate) & still[:, None]
        level = _level(std, _nearly_all(quiet), quiet, level)
    window, fits, differs = _nearly_all(quiet), quiet, np.zeros_like(quiet)
    for _ in range(5):
        if not window.any():
            break
        chosen = np.where(fits, mean, np.nan)[window]
        if not np.isfinite(chosen).any(axis=0).all():
            # A channel that never rests while the others do has no rest to compare with.
            chosen = mean[window]
        centre = np.nanmedian(chosen, axis=0)
        spread = MEDIAN_TO_RMS * np.nanmedian(np.abs(mean - centre)[window], axis=0)
        spread = np.minimum(spread, COMMON * level * np.median(spread / level))
        tolerance = 6 * np.maximum(spread, level / np.sqrt(WINDOW / data.step))
        near = np.abs(mean - centre) < tolerance
        fits = quiet & near
        window = _inner(_nearly_all(fits))
        differs = window[:, None] & np.isfinite(mean) & ~near
    return Rest(window, fits, differs, mean, std, level)


def _statistics(data: Data, level: Array | None) -> tuple[Array, Array, Mask]:
    """Mean and standard deviation (W, n) in every window, NaN where too little is usable; and whether it is still.

    Not still (W,): two channels leave the level in the same sample. One alone is a spike.
    """
    starts = data.starts
    mean = np.full((data.windows, data.z.shape[1]), np.nan)
    std, still = mean.copy(), np.ones(data.windows, dtype=bool)
    for k in range(data.windows):
        z = data.z[starts[k] : starts[k + 1]]
        enough = np.isfinite(z).sum(axis=0) >= MIN_SAMPLES
        z = z[:, enough]
        if not z.size:
            continue
        if level is not None:
            # The plain median is ten times faster than the one that looks for NaN.
            median = np.median if np.isfinite(z).all() else np.nanmedian
            middle, margin = median(z, axis=0), CLIP * level[enough]
            still[k] = (np.abs(z - middle) > 1.5 * margin).sum(axis=1).max() < 2
            z = np.clip(z, middle - margin, middle + margin)
        mean[k, enough], std[k, enough] = np.nanmean(z, axis=0), np.nanstd(z, axis=0, ddof=1)
    return mean, std, still


def _level(std: Array, window: Mask, quiet: Mask, before: Array) -> Array:
    chosen = np.where(quiet & window[:, None], std, np.nan)
    usable = np.isfinite(chosen).any(axis=0)
    level = before.copy()
    level[usable] = np.sqrt(np.nanmean(chosen[:, usable] ** 2, axis=0))
    return np.maximum(level, LEAST_LEVEL)


def _nearly_all(fits: Mask) -> Mask:
    n = fits.shape[1]
    return np.asarray(fits.sum(axis=1) >= (n - 1 if n > 4 else n))


def _inner(window: Mask) -> Mask:
    """Windows whose neighbours are at rest, too: the start of a motion is hidden by the noise."""
    before, after = np.roll(window, 1), np.roll(window, -1)
    before[0] = after[-1] = True
    return np.asarray(window & before & after)
