# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Noise of channels about which nothing is known yet, from segments of one second.

The noise of a channel by itself is the lower envelope: segments about as quiet as the quietest.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fdi_ros.config.settings import LEAST_NOISE
from fdi_ros.estimator.estimator import BLOCK_TIME, REST_BLOCKS
from fdi_ros.estimator.noise import THREE_SIGMA
from fdi_ros.estimator.rest import REST_STD, rests
from fdi_ros.model.samples import Array, Int

LENGTH = (
    BLOCK_TIME * REST_BLOCKS
)  # of a segment, s; longer where so few samples are in it that blocks were empty
SMOOTH = np.array([-2.0, 3.0, 6.0, 7.0, 6.0, 3.0, -2.0]) / 21.0
"""Local parabola through seven values (Savitzky and Golay 1964): what it leaves is noise, not motion."""
AS_QUIET, ROUNDS = (
    1.5,
    10,
)  # noise this many times that of the quietest is as quiet; rounds in which these are found
LOUDER = 2.0  # noise this many times that of rest is vibration, and slower noise no more than it of the other
LARGEST_BIAS = 0.1  # rad/s, that a gyro at rest has
MOST = 4096  # segments kept; of a longer recording every second one, and so on: memory does not grow with its length


class NoiseSegment(NamedTuple):
    """Values of a segment."""

    first: int  # time of its first sample, ns
    means: Array  # (`REST_BLOCKS`, c) of blocks, rad/s
    std: Array  # (c,) of the samples about their mean, rad/s: at rest their noise, also where a filter has smoothed it
    noise: Array  # (c,) of a sample, rad/s: what no smooth motion reaches; 0: the values never change
    block_noise: Array  # (c,) of the blocks, with slower noise that is no more than `LOUDER` times as large


class NoiseSegments:
    """Segments of a recording, as its values of so many channels come."""

    def __init__(self, channels: int) -> None:
        self.channels = channels
        self.every = 1  # of so many segments one is kept
        self._kept: list[NoiseSegment] = []
        self._passed = 0
        # Values (K, c) that do not make a segment yet, and their times, ns.
        self._waiting, self._times = (
            np.empty((0, channels)),
            np.empty(0, dtype=np.int64),
        )

    def add(self, values: Array, times: Int, rate: float) -> None:
        """Take in values (K, c) rad/s of a rate, Hz (0: not known yet), all finite, at times (K,) ns."""
        values, times = (
            np.vstack([self._waiting, values]),
            np.concatenate([self._times, times]),
        )
        size = (
            REST_BLOCKS * max(round(LENGTH * rate / REST_BLOCKS), 1)
            if rate
            else len(values) + 1
        )
        full = len(values) // size * size
        for k in range(0, full, size):
            if self._passed % self.every == 0:
                self._kept.append(_segment(values[k : k + size], int(times[k])))
            self._passed += 1
            if len(self._kept) > MOST:
                self._kept, self.every = self._kept[::2], 2 * self.every
        self._waiting, self._times = values[full:], times[full:]

    @property
    def empty(self) -> bool:
        """Whether there is not a single value."""
        return not self._kept and not len(self._waiting)

    def all_segments(self) -> list[NoiseSegment]:
        """Segments, with the values at the end if there is no other."""
        whole = len(self._waiting) // REST_BLOCKS * REST_BLOCKS
        return self._kept or (
            [_segment(self._waiting[:whole], int(self._times[0]))] if whole else []
        )

    @property
    def means(self) -> Array:
        """Means of blocks (B, c), rad/s."""
        return np.concatenate(
            [one.means for one in self.all_segments()] or [np.zeros((1, self.channels))]
        )

    def noise(self, largest_bias: float = LARGEST_BIAS) -> Noise:
        """Work out the noise of all so far, of gyros with biases of so much, rad/s."""
        segments, unknown = self.all_segments(), np.full(self.channels, np.nan)
        if not segments:
            return Noise(unknown, unknown, [])
        least, block = _least_noise(segments)
        known = np.full(self.channels, largest_bias**2 / THREE_SIGMA)
        rest = [
            bool((one.noise <= LOUDER * least).all())
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
    """Noise of a sample of each channel (c,), rad/s; NaN: not known."""

    quiet: Array  # at rest, or else when quietest
    moving: Array  # in motion, vibration included
    rest: list[
        bool
    ]  # whether nothing moves in a segment: by the monitor's own test, and as quiet as the quietest

    @property
    def share(self) -> float:
        """Share of the recording in motion."""
        return 1.0 - sum(self.rest) / len(self.rest) if self.rest else 0.0


def _least_noise(segments: list[NoiseSegment]) -> tuple[Array, Array]:
    """Noise (c,) of a sample and of a block when quietest, rad/s."""
    noise, block = (
        np.array([one.noise for one in segments]),
        np.array([one.block_noise for one in segments]),
    )
    # Where a unit repeats its values it says nothing of its noise, which is then what it usually is.
    for column in (*noise.T, *block.T):
        if column.any():
            column[column == 0.0] = np.median(column[column > 0.0])
    quiet = np.argsort((noise**2).sum(axis=1))[: max(3, len(noise) // 100)]
    # The quietest few are so by chance, too: all that are about as quiet tell it without that bias.
    for _ in range(ROUNDS):
        alike = np.flatnonzero(
            (noise <= AS_QUIET * np.median(noise[quiet], axis=0)).all(axis=1)
        )
        if len(alike) <= len(quiet):
            break
        quiet = alike
    return np.median(noise[quiet], axis=0), np.median(block[quiet], axis=0)


def _segment(values: Array, first: int) -> NoiseSegment:
    means = values.reshape(REST_BLOCKS, -1, values.shape[1]).mean(axis=1)
    least, std = _noise(means), values.std(axis=0)
    return NoiseSegment(
        first,
        means,
        std,
        _noise(values),
        np.clip(means.std(axis=0), least, LOUDER * least),
    )


def _noise(values: Array) -> Array:
    inside, smooth = (
        len(SMOOTH) // 2,
        np.column_stack([np.convolve(v, SMOOTH, mode="valid") for v in values.T]),
    )
    # Of white noise the parabola takes its share with it.
    noise = np.sqrt(
        np.mean((values[inside:-inside] - smooth) ** 2, axis=0) / (1.0 - SMOOTH[inside])
    )
    return np.where(noise > LEAST_NOISE, noise, 0.0)
