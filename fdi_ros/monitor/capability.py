"""What the channels left can still do: see a fault, name it, or neither, and why."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fdi_ros.detectors.base import Detector
from fdi_ros.errors import GeometryError
from fdi_ros.model.geometry import MIN_CHANNELS

Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Capability:
    """What one set of channels can do."""

    detectable: Flags
    """(n,): a fault of the channel would be seen."""
    isolable: Flags
    """(n,): a fault of the channel would be seen and named."""
    note: str
    """Why a channel is not, in words; empty if nothing is limited."""


def capability_of(detector: Detector, mask: Flags) -> Capability:
    """Tell what the channels marked in mask (n,) can do with a detector."""
    nothing = np.zeros(len(mask), dtype=bool)
    names = detector.geometry.channel_names
    try:
        reduced = detector.geometry.subset(mask)
    except GeometryError:
        return Capability(nothing, nothing, _too_little(int(mask.sum())))
    bits = sum(1 << int(i) for i in np.flatnonzero(mask))
    method = detector.fewer(bits)
    if method is None:
        return Capability(nothing, nothing, detector.refusals[bits])
    detectable, isolable = nothing.copy(), nothing.copy()
    detectable[mask], isolable[mask] = reduced.detectable, method.isolable
    blind = [names[i] for i in np.flatnonzero(mask & ~detectable)]
    vague = [names[i] for i in np.flatnonzero(detectable & ~isolable)]
    notes = []
    if blind:
        notes.append(f"a fault of {', '.join(blind)} would not be seen")
    if vague:
        notes.append(f"a fault of {', '.join(vague)} would be seen but not named")
    return Capability(detectable, isolable, "; ".join(notes))


def _too_little(left: int) -> str:
    """Say why so many channels check nothing."""
    if left >= MIN_CHANNELS:
        return f"the axes of the {left} channels left do not span three dimensions: a fault of one would not be seen"
    if left == 0:
        return f"no channel is left: {MIN_CHANNELS} are needed to see a fault"
    plural = "s are" if left > 1 else " is"
    return f"only {left} channel{plural} left: a fault of one would not be seen, {MIN_CHANNELS} are needed"
