# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Compare the rates of a unit with the turning of gravity that its accelerometers show."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fdi_ros.estimator.estimator import BLOCK_TIME, REST_BLOCKS
from fdi_ros.inspection.segments import NoiseSegments
from fdi_ros.model.samples import Array


class _SwingWindows(NamedTuple):
    """Windows in which gravity may swing."""

    #: segments of a window, in a row: long enough for a slow swing, short for a
    #: drift
    segments: int = 8
    #: steps between segments, over the usual one, from which on there is a gap
    gap: float = 1.5
    #: specific force over the usual one, below which its direction is not known
    least_force: float = 0.1


SWING_WINDOWS = _SwingWindows()


class Swing(NamedTuple):
    """Swings of gravity in the axes of a unit, over a window."""

    #: number of blocks
    blocks: int

    #: square of the swings that the rates foretell, rad^2 if these are in rad/s
    foretold: float
    #: square of the swings that the accelerometers show, rad^2
    seen: float
    #: product of both
    both: float
    #: standard deviation of the size of the specific force, as a share of its mean
    change: float = 0.0

    @property
    def size(self) -> float:
        """Root mean square of the swings that the rates foretell, rad."""
        return math.sqrt(self.foretold / self.blocks)

    @property
    def factor(self) -> float:
        """How many times the seen swings the rates foretell, 0 if nothing is shared."""
        return self.foretold / self.both if self.both > 0.0 else 0.0

    @property
    def shared(self) -> float:
        """Share of the seen swings that the rates explain, 0 to 1."""
        power = self.foretold * self.seen
        return self.both**2 / power if power > 0.0 else 0.0


def swings_of(rates: NoiseSegments, forces: NoiseSegments) -> list[Swing]:
    """Return the swings of gravity in each window of a unit.

    In a body at rest or moved gently by hand or on wheels, accelerometers show gravity.
    They do not in the free flight of a multicopter: thrust turns with the body.
    """
    return [_swing(*window) for run in _runs(rates, forces) for window in _windows(run)]


def sum_of(swings: Sequence[Swing]) -> Swing:
    """Return the swings of several windows together."""
    blocks, foretold, seen, both, _ = map(sum, zip(*swings, strict=True))
    return Swing(round(blocks), foretold, seen, both)


class _Pair(NamedTuple):
    """Means of the blocks of a segment."""

    first: int  #: time of its first sample, ns
    rate: Array  #: (`REST_BLOCKS`, 3)
    force: Array  #: (`REST_BLOCKS`, 3)


def _runs(rates: NoiseSegments, forces: NoiseSegments) -> list[list[_Pair]]:
    """Return the segments that both halves of a unit have, in rows without gaps."""
    felt = forces.all_segments()
    turned = rates.all_segments()
    if not felt or len(turned) < 2:
        return []
    begin = np.array([one.first for one in felt])
    usual = float(np.median(np.diff([one.first for one in turned])))
    runs: list[list[_Pair]] = [[]]
    for one in turned:
        nearest = int(np.abs(begin - one.first).argmin())
        if abs(begin[nearest] - one.first) > BLOCK_TIME * 1e9:
            continue
        run = runs[-1]
        if run and one.first - run[-1].first > SWING_WINDOWS.gap * usual:
            runs.append([])
        runs[-1].append(_Pair(one.first, one.means, felt[nearest].means))
    return runs


def _windows(run: list[_Pair]) -> list[tuple[Array, Array, float]]:
    """Return rates (B, 3), specific forces (B, 3) and the step of blocks, s, by window."""
    parts = [
        run[k : k + SWING_WINDOWS.segments]
        for k in range(0, len(run) - SWING_WINDOWS.segments + 1, SWING_WINDOWS.segments)
    ]
    return [
        (
            np.concatenate([one.rate for one in part]),
            np.concatenate([one.force for one in part]),
            float(np.median(np.diff([one.first for one in part]))) * 1e-9 / REST_BLOCKS,
        )
        for part in parts
    ]


def _swing(rate: Array, force: Array, step: float) -> Swing:
    """Compare the swings of gravity in a window, without slow changes: biases and steady turns."""
    size = np.linalg.norm(force, axis=1)
    if size.min() <= SWING_WINDOWS.least_force * np.median(size):
        return Swing(len(rate), 0.0, 0.0, 0.0)
    gravity = force / size[:, np.newaxis]
    twice_gravity = gravity[1:] + gravity[:-1]
    between = 0.25 * np.cross(twice_gravity, rate[1:] + rate[:-1])
    foretold = np.vstack([np.zeros(3), np.cumsum(between * step, axis=0)])
    time = np.linspace(-1.0, 1.0, len(rate))
    slow, _ = np.linalg.qr(np.vander(time, 3))
    foretold = foretold - slow @ (slow.T @ foretold)
    seen = gravity - slow @ (slow.T @ gravity)
    return Swing(
        len(rate),
        float((foretold**2).sum()),
        float((seen**2).sum()),
        float((foretold * seen).sum()),
        float(size.std() / size.mean()),
    )
