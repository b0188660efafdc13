# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Samples: types of arrays by what they hold, and the block that topics, bags and simulations hand to the pipeline."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fdi_ros.errors import ConfigError

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Int = NDArray[np.int64]
Bytes = NDArray[np.uint8]

# rad/s; a larger finite value counts as this: no gyro measures as much, no vehicle
# survives it
MAX_RATE = 1e3
#: rad/s; ranges of vehicle gyros reach 2000 deg/s, 34.9 rad/s
LARGEST_GYRO_RANGE = 36.0


def flag_runs(flags: Mask) -> Int:
    """First index and end (R, 2) of every run of set flags (N,)."""
    with_ends = np.concatenate([[False], flags, [False]])
    edges = np.diff(with_ends.astype(np.int8))
    return np.flatnonzero(edges).reshape(-1, 2)


@dataclass(frozen=True)
class Block:
    """Consecutive samples of all channels.

    Raises
    ------
    ConfigError
        If the arrays do not fit each other.
    """

    stamp: NDArray[
        np.int64
    ]  #: time of each sample, (N,) int64 nanoseconds, strictly increasing
    z: NDArray[np.float64]  #: measured channels, (N, n) float64 rad/s
    received: NDArray[np.bool_] | None = None
    """(N, n) bool: the channel delivered a value for this sample, whatever the value.
    None: all did. A value that was delivered but is NaN or infinite is a defect of the
    sensor; one that was not delivered is silence. The two are reported in different
    words."""
    acceleration: Block | None = None
    """The same samples of the accelerometers, z (N, m) m/s^2, three of every unit. None:
    no unit has any."""

    def __post_init__(self) -> None:
        stamp = np.asarray(self.stamp)
        z = np.asarray(self.z)
        if z.ndim != 2 or z.dtype.kind not in "fiu":
            raise ConfigError(
                f"samples have shape {z.shape} of {z.dtype}, expected (N, n) real numbers"
            )
        if stamp.shape != z.shape[:1] or stamp.dtype.kind not in "iu":
            raise ConfigError(
                f"stamps have shape {stamp.shape} of {stamp.dtype}, expected ({len(z)},) whole numbers, ns"
            )
        received = None if self.received is None else np.asarray(self.received)
        if received is not None and (
            received.shape != z.shape or received.dtype != np.bool_
        ):
            raise ConfigError(
                f"received has shape {received.shape} of {received.dtype}, expected {z.shape} bool"
            )
        other = self.acceleration
        if other is not None and not np.array_equal(other.stamp, stamp):
            raise ConfigError("gyros and accelerometers have different stamps")

    def __len__(self) -> int:
        return len(self.stamp)

    def __repr__(self) -> str:
        span = (
            f", {(int(self.stamp[-1]) - int(self.stamp[0])) / 1e9:.3f} s"
            if len(self)
            else ""
        )
        channels = sum(half.z.shape[1] for half in self.halves)
        return f"Block({len(self)} samples of {channels} channels{span})"

    @property
    def halves(self) -> tuple[Block, ...]:
        """Gyros, and accelerometers if there are any."""
        return (self,) if self.acceleration is None else (self, self.acceleration)

    @property
    def delivered(self) -> NDArray[np.bool_]:
        """`received`, spelled out, (N, n)."""
        return (
            np.ones(self.z.shape, dtype=bool)
            if self.received is None
            else self.received
        )

    def __getitem__(self, rows: slice) -> Block:
        received = None if self.received is None else self.received[rows]
        other = None if self.acceleration is None else self.acceleration[rows]
        return Block(self.stamp[rows], self.z[rows], received, other)
