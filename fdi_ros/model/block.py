# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A block of samples: what live topics, bags and simulations all hand to the pipeline."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Block:
    """Consecutive samples of all channels.

    Attributes
    ----------
    stamp
        Time of each sample, (N,) int64 nanoseconds, strictly increasing.
    z
        Measured channels, (N, n) float64 rad/s.
    received
        (N, n) bool: the channel delivered a value for this sample, whatever the value. None: all did.
        A value that was delivered but is NaN or infinite is a defect of the sensor; one that was not
        delivered is silence. The two are reported in different words.
    """

    stamp: NDArray[np.int64]
    z: NDArray[np.float64]
    received: NDArray[np.bool_] | None = None

    def __len__(self) -> int:
        return len(self.stamp)

    @property
    def delivered(self) -> NDArray[np.bool_]:
        """`received`, spelled out, (N, n)."""
        return np.ones(self.z.shape, dtype=bool) if self.received is None else self.received

    def __getitem__(self, rows: slice) -> Block:
        received = None if self.received is None else self.received[rows]
        return Block(self.stamp[rows], self.z[rows], received)
