# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Noise and rest of channels of which nothing is known yet, from segments of a second of their values."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from fdi_ros.config.settings import LEAST_NOISE
from fdi_ros.estimator.blocks import REST_STD, rests
from fdi_ros.estimator.estimator import REST_BLOCKS
from fdi_ros.estimator.noise import THREE_SIGMA
from fdi_ros.model.samples import Array, Int

LENGTH = 1.0
"""Of a segment, s; longer where so few samples are in it that it could not be cut into blocks."""
SMOOTH = np.array([-2.0, 3.0, 6.0, 7.0, 6.0, 3.0, -2.0]) / 21.0
"""Local parabola through seven values (Savitzky and Golay 1964): what it leaves is noise, not motion."""
FEWEST, PART = 3, 100
"""So many of the quietest segments, or one in so many, tell the noise at rest: of a long flight few are."""
AS_QUIET, ROUNDS = 1.5, 10
"""Noise this many times that of the quietest is as quiet; rounds in which the quiet ones are found."""
QUIET = SLOWER = 2.0
"""More noise is that of motion: vibration; noise that is slower than a block may be so many times the other."""
LARGEST_BIAS = 0.1
"""rad/s, that a gyro at rest has."""
MOST = 4096
"""Segments that are kept; of a longer recording every second one, and so on: memory does not grow with its length."""


@dataclass(frozen=True)
class NoiseSegment:
    """Values of a segment."""

    first: int
    """Time of its first sample, ns."""
    means: Array
    """(`REST_BLOCKS`, c) of blocks, rad/s."""
    std: Array
    """(c,) of the samples about their mean, rad/s: at rest that is their noise, also where a filter has smoothed it."""
    noise: Array
    """(c,) of a sample, rad/s: what no smooth motion reaches, vibration included; 0: the values never change."""
    block_noise: Array
    """(c,) the same of the blocks, that which is slower included where it is no more than `SLOWER` times as large."""


@dataclass
class NoiseSegments:
    """Segments of a recording, as they come."""

    channels: int
    """c."""
    kept: list[NoiseSegment] = field(default_factory=list)
    every: int = 1
    """Of so many segments one is kept."""
    passed: int = 0
    """Segments so far."""
    waiting: Array = field(default_factory=lambda: np.empty((0, 0)))
    """(K, c) values that do not make a segment yet."""
    since: int = 0
    """Time of the first of them, ns."""

    def add(self, values: Array, times: Int, rate: float) -> None:
        """Take in values (K, c) rad/s of a rate, Hz (0: not known yet), all finite, at times (K,) ns."""
        if not len(values):
            return
        if len(self.waiting):
            values = np.vstack([self.waiting, values])
            times = np.concatenate([np.full(len(self.waiting), self.since), times])
        size = REST_BLOCKS * max(round(LENGTH * rate / REST_BLOCKS), 1) if rate else len(values) + 1
        full = len(values) // size * size
        for k in range(0, full, size):
            if self.passed % self.every == 0:
                self.kept.append(_segment(values[k : k + size], int(times[k])))
            self.passed += 1
            if len(self.kept) > MOST:
                self.kept, self.every = self.kept[::2], 2 * self.every
        self.waiting = values[full:]
        self.since = int(times[full]) if full < len(times) else 0

    @property
    def empty(self) -> bool:
        """Whether there is not a single value."""
        return not self.kept and not len(self.waiting)

    def all_segments(self) -> list[NoiseSegment]:
        """Segments, with the values at the end if there is no other."""
        whole = len(self.waiting) // REST_BLOCKS * REST_BLOCKS
        return self.kept or ([_segment(self.waiting[:whole], self.since)] if whole else [])

    def _quietest(self) -> tuple[Array, Array]:
        """Noise (c,) of a sample and of a block when quietest, rad/s.

        The quietest few are so by chance, too: all that are about as quiet tell it without that bias.
        """
        segments = self.all_segments()
        noise, block = np.array([one.noise for one in segments]), np.array([one.block_noise for one in segments])
        # Where a unit repeats its values it says nothing of its noise, which is then what it usually is.
        for values in (noise, block):
            for column in values.T:
                if column.any():
                    column[column == 0.0] = np.median(column[column > 0.0])
        quiet = np.argsort((noise**2).sum(axis=1))[: max(FEWEST, len(noise) // PART)]
        for _ in range(ROUNDS):
            alike = np.flatnonzero((noise <= AS_QUIET * np.median(noise[quiet], axis=0)).all(axis=1))
            if len(alike) <= len(quiet):
                break
            quiet = alike
        return np.median(noise[quiet], axis=0), np.median(block[quiet], axis=0)

    def quiet_noise(self) -> Array:
        """Noise (c,) at rest, or else when quietest, rad/s; NaN: too little was recorded."""
        if not (segments := self.all_segments()):
            return np.full(self.channels, np.nan)
        rests = [one.std for one, rest in zip(segments, self.at_rest(), strict=True) if rest]
        return np.maximum(self._quietest()[0], np.median(rests, axis=0) if rests else 0.0)

    def at_rest(self, largest_bias: float = LARGEST_BIAS) -> list[bool]:
        """For each segment, whether nothing in it moves: by the monitor's own test, and as quiet as the quietest."""
        if not (segments := self.all_segments()):
            return []
        noise, block = self._quietest()
        known = np.full(self.channels, largest_bias**2 / THREE_SIGMA)
        return [
            bool((one.noise <= QUIET * noise).all())
            and rests(np.ascontiguousarray(one.means), REST_BLOCKS - 1, block**2, known, REST_STD**2)
            for one in segments
        ]

    def moving_noise(self) -> Array:
        """Noise (c,) in motion, vibration included, rad/s; NaN: it does not move."""
        noise = [one.noise for one, rest in zip(self.all_segments(), self.at_rest(), strict=True) if not rest]
        if not noise:
            return np.full(self.channels, np.nan)
        return np.array([np.median(column[column > 0.0]) if column.any() else 0.0 for column in np.array(noise).T])

    def moving_share(self) -> float:
        """Share of the recording in motion."""
        rest = self.at_rest()
        return 1.0 - sum(rest) / len(rest) if rest else 0.0


def _segment(values: Array, first: int) -> NoiseSegment:
    means = values.reshape(REST_BLOCKS, -1, values.shape[1]).mean(axis=1)
    least = _noise(means)
    return NoiseSegment(
        first, means, values.std(axis=0), _noise(values), np.clip(means.std(axis=0), least, SLOWER * least)
    )


def _noise(values: Array) -> Array:
    inside = len(SMOOTH) // 2
    smooth = np.column_stack([np.convolve(column, SMOOTH, mode="valid") for column in values.T])
    residual = values[inside:-inside] - smooth
    # Of white noise the parabola takes its share with it.
    noise = np.sqrt(np.mean(residual**2, axis=0) / (1.0 - SMOOTH[inside]))
    return np.where(noise > LEAST_NOISE, noise, 0.0)
