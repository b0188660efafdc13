# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Noise of channels before anything else is known, from segments of one second.

The noise of a channel alone is the lower envelope: segments about as quiet as the
quietest.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from fdi_ros.config.settings import LEAST_NOISE
from fdi_ros.estimator.estimator import BLOCK_TIME, REST_BLOCKS
from fdi_ros.estimator.noise import THREE_SIGMA
from fdi_ros.estimator.rest import REST_STD, rests
from fdi_ros.model.samples import Array, Int, Mask

#: length of a segment, s; slow channels need longer ones to fill every block
SEGMENT_LENGTH = BLOCK_TIME * REST_BLOCKS
PARABOLA = np.array([-2.0, 3.0, 6.0, 7.0, 6.0, 3.0, -2.0]) / 21.0
"""Local parabola through seven values (Savitzky and Golay 1964). Its residual is noise."""
#: ratio to the quietest noise that counts as quiet, and rounds to find such segments
AS_QUIET, ROUNDS = (
    1.5,
    10,
)
#: ratio to the noise at rest that counts as vibration; bound of slow over fast noise
VIBRATION_RATIO = 2.0
#: rad/s, that a gyro at rest has
LARGEST_BIAS = 0.1
#: segments kept; longer recordings keep every second one, then every fourth
MOST_SEGMENTS = 4096


class _SpikeSigns(NamedTuple):
    """What shows that a value is a spike."""

    #: values before a value, and after it, that it is compared with
    reach: int = 2
    #: distance from the median of the values around it, over the usual second
    #: difference of the values in its segment
    ratio: float = 12.0
    #: distance over the range of the values around it. In 34 recordings without
    #: known spikes two values of a channel at most are beyond both, and four are
    #: with 7 in place of 10
    isolation: float = 10.0
    #: share of the values of a segment from which on values far off are no spikes
    frequent: float = 0.1


SPIKES = _SpikeSigns()


class NoiseSegment(NamedTuple):
    """Values of a segment."""

    #: time of its first sample, ns
    first: int
    #: (`REST_BLOCKS`, c) of blocks, rad/s
    means: Array
    #: (c,) standard deviation of the samples, rad/s: the noise at rest, even if
    #: filtered
    std: Array
    #: (c,) noise of a sample beyond any smooth motion, rad/s, 0 if values never change
    noise: Array
    #: (c,) of the blocks, with slower noise that is no more than `VIBRATION_RATIO` times as
    #: large
    block_noise: Array


class NoiseSegments:
    """Segments of a recording, from values that arrive in portions."""

    def __init__(self, channels: int) -> None:
        self.channels = channels
        self.every = 1  # one segment in this many is kept
        self._kept: list[NoiseSegment] = []
        self._passed = 0
        # Values (K, c) that do not make a segment yet, and their times, ns.
        self._waiting = np.empty((0, channels))
        self._times = np.empty(0, dtype=np.int64)
        # Last values (at most `SPIKES.reach`, c) of the segment before, without spikes.
        self._before = np.empty((0, channels))
        # Spikes (c,) in all segments so far.
        self._spikes = np.zeros(channels, dtype=np.int64)

    def add(self, values: Array, times: Int, rate: float) -> None:
        """Take finite values (K, c), rad/s, at times (K,), ns.

        ``rate``: sample rate, Hz; 0 if not known yet.
        """
        values = np.vstack([self._waiting, values])
        times = np.concatenate([self._times, times])
        size = (
            REST_BLOCKS * max(round(SEGMENT_LENGTH * rate / REST_BLOCKS), 1)
            if rate
            else len(values) + 1
        )
        full = max(len(values) - SPIKES.reach, 0) // size * size
        for k in range(0, full, size):
            clean = self._without_spikes(values[k : k + size + SPIKES.reach], size)
            if self._passed % self.every == 0:
                self._kept.append(_segment(clean, int(times[k])))
            self._passed += 1
            if len(self._kept) > MOST_SEGMENTS:
                self._kept = self._kept[::2]
                self.every = 2 * self.every
        self._waiting = values[full:]
        self._times = times[full:]

    def _without_spikes(self, values: Array, size: int) -> Array:
        """Return the first values (size, c) of some without their spikes, and count these."""
        begin = len(self._before)
        clean, spikes = without_spikes(np.vstack([self._before, values]))
        self._spikes += spikes.sum(axis=0)
        clean = clean[begin : begin + size]
        self._before = clean[-SPIKES.reach :]
        return clean

    @property
    def spikes(self) -> Int:
        """Number (c,) of single values far from those around them."""
        _, spikes = without_spikes(np.vstack([self._before, self._waiting]))
        return np.asarray(self._spikes + spikes.sum(axis=0))

    @property
    def empty(self) -> bool:
        """Whether no value has arrived."""
        return not self._kept and not len(self._waiting)

    def all_segments(self) -> list[NoiseSegment]:
        """Segments; without any, a segment of the values so far."""
        whole = len(self._waiting) // REST_BLOCKS * REST_BLOCKS
        if self._kept or not whole:
            return self._kept
        return [_segment(self._waiting[:whole], int(self._times[0]))]

    @property
    def means(self) -> Array:
        """Means of blocks (B, c), rad/s."""
        means = [one.means for one in self.all_segments()]
        return np.concatenate(means or [np.zeros((1, self.channels))])

    def noise(self, largest_bias: float = LARGEST_BIAS) -> Noise:
        """Work out the noise of all so far, of gyros with biases of so much, rad/s."""
        segments = self.all_segments()
        unknown = np.full(self.channels, np.nan)
        if not segments:
            return Noise(unknown, unknown, [])
        least, block = _least_noise(segments)
        known = np.full(self.channels, largest_bias**2 / THREE_SIGMA)
        rest = [
            bool((one.noise <= VIBRATION_RATIO * least).all())
            and rests(
                np.ascontiguousarray(one.means),
                REST_BLOCKS - 1,
                block**2,
                known,
                REST_STD**2,
            )
            for one in segments
        ]
        still = [one.std for one, lies in zip(segments, rest, strict=True) if lies]
        quiet = np.maximum(least, np.median(still, axis=0)) if still else least
        moving = np.array(
            [one.noise for one, lies in zip(segments, rest, strict=True) if not lies]
        )
        usual = [
            np.median(column[column > 0.0]) if column.any() else 0.0
            for column in moving.T
        ]
        return Noise(quiet, np.array(usual) if len(moving) else unknown, rest)


class Noise(NamedTuple):
    """Noise of a sample of each channel (c,), rad/s, NaN if not known."""

    #: at rest, or else when quietest
    quiet: Array
    #: in motion, vibration included
    moving: Array
    #: whether nothing moves in a segment: by the monitor's own test, and as quiet as
    #: the quietest
    rest: list[bool]

    @property
    def share(self) -> float:
        """Share of the recording in motion."""
        return 1.0 - sum(self.rest) / len(self.rest) if self.rest else 0.0


def _least_noise(segments: list[NoiseSegment]) -> tuple[Array, Array]:
    """Noise (c,) of a sample and of a block when quietest, rad/s."""
    noise = np.array([one.noise for one in segments])
    block = np.array([one.block_noise for one in segments])
    # A unit with repeated values shows no noise; its usual noise stands in.
    for column in (*noise.T, *block.T):
        if column.any():
            column[column == 0.0] = np.median(column[column > 0.0])
    power = (noise**2).sum(axis=1)
    quiet = np.argsort(power)[: max(3, len(noise) // 100)]
    # The quietest few are biased by chance. All segments about as quiet are not.
    for _ in range(ROUNDS):
        alike = np.flatnonzero(
            (noise <= AS_QUIET * np.median(noise[quiet], axis=0)).all(axis=1)
        )
        if len(alike) <= len(quiet):
            break
        quiet = alike
    return np.median(noise[quiet], axis=0), np.median(block[quiet], axis=0)


def without_spikes(values: Array) -> tuple[Array, Mask]:
    """Replace the spikes in values (N, c) by the median of the values around them.

    Returns the values (N, c), and which were spikes. The first and last
    `SPIKES.reach` values are not examined.
    """
    spikes = np.zeros(values.shape, dtype=bool)
    if len(values) <= 2 * SPIKES.reach:
        return values, spikes
    around = np.delete(
        sliding_window_view(values, 2 * SPIKES.reach + 1, axis=0), SPIKES.reach, axis=-1
    )
    median = np.median(around, axis=-1)
    change = np.abs(values[1:-1] - 0.5 * (values[2:] + values[:-2]))
    step = np.abs(np.diff(values, axis=0))
    # Coarse values at rest mostly repeat. Then one step of theirs is usual.
    least = np.where(step > 0.0, step, np.inf).min(axis=0)
    usual = np.maximum(np.median(change, axis=0), least)
    bound = np.maximum(SPIKES.ratio * usual, SPIKES.isolation * np.ptp(around, axis=-1))
    inside = spikes[SPIKES.reach : -SPIKES.reach]
    inside[:] = np.abs(values[SPIKES.reach : -SPIKES.reach] - median) > bound
    spikes &= spikes.mean(axis=0) < SPIKES.frequent
    clean = values.copy()
    clean[SPIKES.reach : -SPIKES.reach][inside] = median[inside]
    return clean, spikes


LARGEST_VALUE = 1e9
"""Bound of a value, rad/s or m/s^2: squares of the largest numbers overflow."""


def _segment(values: Array, first: int) -> NoiseSegment:
    values = np.clip(values, -LARGEST_VALUE, LARGEST_VALUE)
    means = values.reshape(REST_BLOCKS, -1, values.shape[1]).mean(axis=1)
    least = _noise(means)
    std = values.std(axis=0)
    return NoiseSegment(
        first,
        means,
        std,
        _noise(values),
        np.clip(means.std(axis=0), least, VIBRATION_RATIO * least),
    )


def _noise(values: Array) -> Array:
    inside = len(PARABOLA) // 2
    smooth = np.column_stack([np.convolve(v, PARABOLA, mode="valid") for v in values.T])
    # The parabola absorbs a share of white noise.
    noise = np.sqrt(
        np.mean((values[inside:-inside] - smooth) ** 2, axis=0)
        / (1.0 - PARABOLA[inside])
    )
    return np.where(noise > LEAST_NOISE, noise, 0.0)
