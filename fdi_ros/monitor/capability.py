"""What the channels left can still do: see a fault, name it, or neither, and why."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fdi_ros.detectors.base import Detector
from fdi_ros.errors import GeometryError
from fdi_ros.monitor.output import Reason

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Capability:
    """What one set of channels can do."""

    detectable: Mask
    """(n,): a fault of the channel would be seen."""
    isolable: Mask
    """(n,): a fault of the channel would be seen and named."""
    reason: Reason
    """Why a channel of the set that is not detectable is not."""
    note: str
    """The same in more words; empty if nothing is limited."""


class Capabilities:
    """Capability of every set of channels met, worked out once."""

    def __init__(self, detector: Detector) -> None:
        self._detector = detector
        self._known: dict[bytes, Capability] = {}

    def of(self, mask: Mask) -> Capability:
        """Capability of the channels marked in mask (n,)."""
        key = mask.tobytes()
        if key not in self._known:
            self._known[key] = self._work_out(mask)
        return self._known[key]

    def prepare(self, units: list[list[int]]) -> None:
        """Work out every loss of one channel and of one whole unit now: a fault must not wait for it."""
        n = self._detector.geometry.n
        for lost in [[], *([i] for i in range(n)), *units]:
            mask = np.ones(n, dtype=bool)
            mask[lost] = False
            self.of(mask)

    def _work_out(self, mask: Mask) -> Capability:
        nothing = np.zeros(len(mask), dtype=bool)
        names = self._detector.geometry.channel_names
        try:
            reduced = self._detector.geometry.subset(mask)
        except GeometryError as error:
            return Capability(nothing, nothing, Reason.TOO_FEW, str(error))
        detector = self._detector.fewer(mask)
        if detector is None:
            refusal = self._detector.refusals[mask.tobytes()]
            return Capability(nothing, nothing, Reason.CANNOT_RUN, refusal)
        detectable, isolable = nothing.copy(), nothing.copy()
        detectable[mask], isolable[mask] = reduced.detectable, detector.isolable
        blind = [names[i] for i in np.flatnonzero(mask & ~detectable)]
        vague = [names[i] for i in np.flatnonzero(detectable & ~isolable)]
        notes = []
        if blind:
            notes.append(f"a fault of {', '.join(blind)} would not be seen")
        if vague:
            notes.append(f"a fault of {', '.join(vague)} would be seen but not named")
        return Capability(detectable, isolable, Reason.TOO_FEW, "; ".join(notes))
