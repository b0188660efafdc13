# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the page of a calibration shows of its recording: motion and residuals over time, noise by time scale.

Noise by time scale is the overlapping Allan deviation and the spectral density, of series with breaks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import welch

from fdi_ros.calibration.data import Array, Mask, prepare_channels
from fdi_ros.calibration.rest import find_rest
from fdi_ros.calibration.result import Calibration
from fdi_ros.config.config import Config
from fdi_ros.model.block import Block
from fdi_ros.monitor.pipeline import Pipeline

PER_DECADE = 8
"""Averaging times per decade."""
LEAST_PAIRS = 3
"""Averaging times go up to the length of a series over this."""
SHORTEST_SEGMENT, LONGEST_SEGMENT = 32, 1024
"""Samples that one spectrum is taken of."""
SEGMENTS = 4
"""Of the longest run: fewer give a spectrum that is mostly chance."""


@dataclass(frozen=True)
class NoiseSpectra:
    """Noise of n channels by time scale: Allan deviation and spectral density.

    Attributes
    ----------
    seconds
        Length of all that it is taken from, s.
    time, deviation
        (T,) s and (T, n) rad/s.
    frequency, density
        (F,) Hz and (F, n) rad/s per square root of Hz.
    """

    seconds: float
    time: Array
    deviation: Array
    frequency: Array
    density: Array


@dataclass(frozen=True)
class TimeSeries:
    """The recording over time, replayed with the settings before and after the calibration.

    Attributes
    ----------
    seconds
        (N,) from the first sample.
    rate
        (N, 3) fused with the new settings, rad/s; NaN where there is none.
    before, after
        (N, n) residuals of the channels in use with the old and with the new settings, rad/s.
    rest
        First and last time of each span at rest, s.
    still
        Noise of the channels at rest.
    moving
        Noise of the new residuals in motion.
    """

    seconds: Array
    rate: Array
    before: Array
    after: Array
    rest: tuple[tuple[float, float], ...]
    still: NoiseSpectra
    moving: NoiseSpectra


def time_series(block: Block, config: Config, result: Calibration) -> TimeSeries:
    """Replay the recording through the monitor with both settings.

    Parameters
    ----------
    block
        The recording that was calibrated on.
    config
        As it was before.
    result
        Of the calibration on it.
    """
    channels = list(result.channels)
    old = Pipeline.from_config(config).process(block)
    tried = Config.from_parameters({**config.parameters(), **result.settings})
    new = Pipeline.from_config(tried).process(block)
    data = prepare_channels(block, config, channels)
    still = find_rest(data, config.bias.max_rest_rate).window[data.window]
    spans = [data.seconds[[run.start, run.stop - 1]].tolist() for run in runs_of(still, data.seconds, data.step)]
    after = new.residual[:, channels]
    moving = np.isfinite(after).all(axis=1) & ~still
    return TimeSeries(
        data.seconds,
        new.rate,
        old.residual[:, channels],
        after,
        tuple((first, last) for first, last in spans),
        _spectra(data.z, still & data.complete, data.seconds, data.step),
        _spectra(after, moving, data.seconds, data.step),
    )


def _spectra(values: Array, rows: Mask, seconds: Array, step: float) -> NoiseSpectra:
    runs = [values[run] for run in runs_of(rows, seconds, step)]
    return NoiseSpectra(float(rows.sum()) * step, *allan_deviation(runs, step), *spectral_density(runs, step))


def runs_of(rows: Mask, seconds: Array, step: float) -> list[slice]:
    """Find the runs of rows (N,) that follow each other without a break.

    Parameters
    ----------
    rows
        (N,) samples that count.
    seconds
        (N,) s.
    step
        Usual time from sample to sample, s.
    """
    broken = np.diff(seconds) > 1.5 * step
    edges = np.flatnonzero(np.concatenate([[True], broken | (np.diff(rows) != 0), [True]]))
    return [slice(a, b) for a, b in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True) if rows[a]]


def allan_deviation(runs: Sequence[Array], step: float) -> tuple[Array, Array]:
    """Overlapping Allan deviation over all runs together.

    Parameters
    ----------
    runs
        Each (k, n) samples of n channels, rad/s, `step` seconds apart.
    step
        s.

    Returns
    -------
    Averaging times (T,) s, and deviations (T, n) rad/s.
    """
    longest = max((len(run) for run in runs), default=0) // LEAST_PAIRS
    if not longest:
        return np.empty(0), np.empty((0, runs[0].shape[1] if runs else 0))
    count = max(1, round(PER_DECADE * np.log10(longest)) + 1)
    lengths = np.unique(np.round(np.geomspace(1, longest, count)).astype(np.int64))
    # Sums from the start of each run: a mean over m samples is a difference of two.
    sums = [np.vstack([np.zeros(run.shape[1]), np.cumsum(run - run.mean(axis=0), axis=0)]) for run in runs]
    deviations = []
    for m in lengths.tolist():
        apart = [(s[2 * m :] - 2 * s[m:-m] + s[: -2 * m]) / m for s in sums if len(s) > 2 * m]
        square = sum((d**2).sum(axis=0) for d in apart) / sum(map(len, apart))
        deviations.append(np.sqrt(square / 2))
    return np.asarray(lengths * step, dtype=np.float64), np.array(deviations)


def spectral_density(runs: Sequence[Array], step: float) -> tuple[Array, Array]:
    """Root of the one-sided power spectral density by Welch's method, over all runs long enough.

    Parameters
    ----------
    runs
        Each (k, n) samples of n channels, rad/s, `step` seconds apart.
    step
        s.

    Returns
    -------
    Frequencies (F,) Hz without 0, and densities (F, n) rad/s per square root of Hz.
    """
    longest = max((len(run) for run in runs), default=0)
    if longest < SHORTEST_SEGMENT:
        return np.empty(0), np.empty((0, runs[0].shape[1] if runs else 0))
    segment = 2 ** int(np.log2(np.clip(longest // SEGMENTS, SHORTEST_SEGMENT, LONGEST_SEGMENT)))
    long = [run for run in runs if len(run) >= segment]
    found = [welch(run, 1 / step, nperseg=segment, axis=0) for run in long]
    weights = [len(run) // (segment // 2) - 1 for run in long]
    density = sum(w * power for w, (_, power) in zip(weights, found, strict=True)) / sum(weights)
    return found[0][0][1:], np.sqrt(density[1:])
