# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a calibration starts from: the usable samples of a recording, cut into windows.

A value that stays exactly the same for long is not usable: noise lets no gyro at work do so, a driver that repeats old
values does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fdi_ros.arrays import Array, Int, Mask
from fdi_ros.config.config import Config
from fdi_ros.model.block import Block

WINDOW = 0.25
"""Length of the windows that are at rest or not, faulty or not, s."""
LEAST_SECONDS = 1.0
"""Shorter runs of one value are chance, s."""
LEAST_SAMPLES = 50
"""So are those of fewer samples."""
COARSE = 3.0
"""Gyros that show no more values than this in a quiet while are quantised so coarsely that one value is rest."""
QUIETEST = 10.0
"""Percentile of the spans that are a quiet while."""
SPIKE = 25.0
"""Usual sizes beyond which a value is a spike."""
PORTION, RARE = 256, 0.1
"""Samples looked at at once, and share of them that may be spikes or beside one."""
MEDIAN_TO_RMS = 1.4826
"""Of normal errors: standard deviation over median absolute deviation."""


@dataclass(frozen=True)
class Data:
    """A recording made ready.

    Attributes
    ----------
    stamp
        (N,) ns.
    z
        (N, n) rad/s, NaN where not usable.
    missing, non_finite, out_of_range, repeated
        (n,) samples of each channel that are not usable, and why.
    window
        (N,) number of the window that each sample is in, from 0, increasing.
    """

    stamp: NDArray[np.int64]
    z: Array
    missing: Int
    non_finite: Int
    out_of_range: Int
    repeated: Int
    window: Int

    @property
    def seconds(self) -> Array:
        """(N,) time since the first sample, s."""
        return (self.stamp - self.stamp[0]) * 1e-9

    @property
    def duration(self) -> float:
        """Length, s."""
        return float(self.stamp[-1] - self.stamp[0]) * 1e-9

    @property
    def step(self) -> float:
        """Usual time from sample to sample, s."""
        return float(np.median(np.diff(self.stamp))) * 1e-9

    @property
    def complete(self) -> Mask:
        """(N,): every channel is usable."""
        return np.asarray(np.isfinite(self.z).all(axis=1))

    @property
    def windows(self) -> int:
        """Number of windows."""
        return int(self.window[-1]) + 1

    @property
    def starts(self) -> Int:
        """(windows + 1,) first sample of each window, and the end."""
        return np.searchsorted(self.window, np.arange(self.windows + 1))


def prepare(block: Block, max_rate: Array) -> Data:
    """Mark what cannot be used: not delivered, not finite, beyond max_rate (n,) rad/s, repeated for long."""
    received = np.ones(block.z.shape, dtype=bool) if block.received is None else block.received
    finite = np.isfinite(block.z)
    with np.errstate(invalid="ignore"):
        inside = np.abs(block.z) < max_rate
    step = float(np.median(np.diff(block.stamp))) * 1e-9 if len(block) > 1 else 0.0
    # What does not change at all is an old value: it shows neither rest nor motion.
    z = np.where(received & inside, block.z, np.nan)
    old = repeated(z, step)
    z[old] = np.nan
    window = (block.stamp - block.stamp[0]) // round(WINDOW * 1e9)
    # A gap leaves no empty windows behind: they are numbered without it.
    window = np.cumsum(np.diff(window, prepend=window[0]) > 0)
    return Data(
        block.stamp,
        z,
        np.asarray((~received).sum(axis=0)),
        np.asarray((received & ~finite).sum(axis=0)),
        np.asarray((received & finite & ~inside).sum(axis=0)),
        np.asarray(old.sum(axis=0)),
        window,
    )


def prepare_channels(block: Block, config: Config, channels: list[int]) -> Data:
    """Prepare some channels of a recording, by their numbers in the configuration."""
    rates = np.broadcast_to(np.array(config.health.max_rate), block.z.shape[1])
    if len(channels) < block.z.shape[1]:
        received = None if block.received is None else block.received[:, channels]
        block = Block(block.stamp, block.z[:, channels], received)
    return prepare(block, rates[channels])


def spikes(z: Array, axes: Array) -> Mask:
    """Find single values (N, n) far off what both neighbours and all other channels say.

    Parameters
    ----------
    z
        (N, n) channels, rad/s.
    axes
        (n, 3), roughly.
    """
    found = np.zeros(z.shape, dtype=bool)
    projector = np.eye(len(axes)) - axes @ np.linalg.pinv(axes)
    # What is usual changes with the vibration.
    for first in range(0, max(len(z) - 2, 0), PORTION):
        part = z[first : first + PORTION + 2]
        size = np.abs((part[1:-1] - 0.5 * (part[2:] + part[:-2])) @ projector)
        whole = size[np.isfinite(size).all(axis=1)]
        if len(whole) < PORTION // 4:
            continue
        level = MEDIAN_TO_RMS * np.median(whole, axis=0)
        ratio = np.nan_to_num(size / np.maximum(level, 1e-9))
        far = ratio.max(axis=1) > SPIKE
        if far.mean() < RARE:
            found[first + 1 + np.flatnonzero(far), ratio[far].argmax(axis=1)] = True
    return found


def flag_runs(flags: Mask) -> Int:
    """First index and end (R, 2) of every run of set flags (N,)."""
    edges = np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8))
    return np.flatnonzero(edges).reshape(-1, 2)


def least_run(step: float) -> int:
    """Return the samples from which a run of one value is long, at a time from sample to sample, s; 0: not known."""
    return max(LEAST_SAMPLES, round(LEAST_SECONDS / step)) if step > 0 else LEAST_SAMPLES


def run_lengths(values: Array) -> NDArray[np.int64]:
    """Lengths of the runs of one value in values (N,), N > 0, in order."""
    return np.diff(np.flatnonzero(np.concatenate([[True], values[1:] != values[:-1], [True]])))


def repeated(z: Array, step: float) -> Mask:
    """Find samples (N, n) of each channel that are part of a long run of one value.

    Parameters
    ----------
    z
        (N, n) channels, NaN where there is none.
    step
        Time from sample to sample, s.
    """
    found, least = np.zeros(z.shape, dtype=bool), least_run(step)
    for k, values in enumerate(z.T):
        lengths = run_lengths(values)
        long = lengths >= least
        if long.any() and not _coarse(values, np.repeat(long, lengths), least):
            found[:, k] = np.repeat(long, lengths)
    return found


def _coarse(values: Array, long: Mask, size: int) -> bool:
    """Whether values (N,) outside the long runs (N,), too, hardly change when it is quiet, in spans of a size."""
    left = values[np.isfinite(values) & ~long]
    spans = left[: len(left) // size * size].reshape(-1, size)
    if not len(spans):
        return False
    different = (np.diff(np.sort(spans, axis=1), axis=1) > 0).sum(axis=1) + 1
    return bool(np.percentile(different, QUIETEST) <= COARSE)


class Repeats:
    """Counts values in long runs of one value, of messages that come bit by bit."""

    def __init__(self, channels: int) -> None:
        self.count = np.zeros(channels, dtype=np.int64)
        """(c,) values in long runs."""
        self._last = np.full(channels, np.nan)
        self._run = np.zeros(channels, dtype=np.int64)

    def add(self, values: Array, step: float) -> None:
        """Take in the next values (N, c), which come every `step` s; 0: not known yet."""
        least = least_run(step)
        for k, column in enumerate(values.T if len(values) else ()):
            lengths, before = run_lengths(column), 0
            if column[0] == self._last[k]:
                before = int(self._run[k])
                lengths[0] += before
            self.count[k] += lengths[lengths >= least].sum() - (before if before >= least else 0)
            self._last[k], self._run[k] = column[-1], lengths[-1]
