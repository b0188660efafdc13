# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A monitor as it stands after some samples: kept, and gone on from as often as one likes.

What follows is the same to the last bit as if the monitor had seen all samples before.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.monitor.pipeline import Pipeline


@dataclass(frozen=True)
class Snapshot:
    """All that a monitor remembers."""

    core: NDArray[Any]
    """(1,) `fdi_ros.core.core.Core`."""
    states: dict[int, NDArray[Any]]
    """Memory of the detector for each set of channels, by its bits."""

    @classmethod
    def of(cls, pipeline: Pipeline) -> Snapshot:
        """Keep what a monitor remembers after its last sample."""
        detector = pipeline.detector
        rows = detector.bank["row"][0]
        states = {int(mask): detector.states[rows[mask]].copy() for mask in np.flatnonzero(rows >= 0)}
        return cls(pipeline.core.copy(), states)

    def restore(self, pipeline: Pipeline) -> None:
        """Put a monitor with the same settings to this moment, whatever it has seen since."""
        detector = pipeline.detector
        # Sets that were met later are as if they had just been prepared.
        detector.states[: int(detector.bank["rows"][0])] = np.zeros((), dtype=detector.states.dtype)
        for mask, state in self.states.items():
            detector.prepare(mask)
            detector.states[int(detector.bank["row"][0, mask])] = state
        pipeline.core[:] = self.core
