# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""How the units are turned against each other, from the motion that they share.

All units of a rigid body see one rotation, each in its own frame: the mount of a unit against the first is the rotation
that takes its rates into those of the first (Wahba 1965). Rotation about one axis alone leaves the turn about that axis
open; which axes of the vehicle the first unit has, no gyro measures.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from fdi_ros.calibration.agreement import SIGNED_AXES
from fdi_ros.model.samples import Array, Block

WINDOW = 0.25
"""Rates are averaged over so long: vibration, and delays of some ms, average out, s."""
LEAST_WINDOWS = 20
"""With fewer, no mount is estimated."""
LEAST_RATE = 0.01
"""Rotation about some axis, root mean square, below which the recording is at rest, rad/s."""
LARGEST_ERROR = np.radians(2.0)
"""A mount less certain than this, in any direction, is not shown."""
LARGEST_SCALE = 3.0
"""Rates this many times larger or smaller than those of the first unit are brought to their scale."""
LEAST_SHARED = 0.5
"""Share of the rotation of a unit that a mount must explain."""
MIRRORED = 0.9
"""Share of the rotation that a mirrored frame must explain, and no mount, to be one."""
SQUARE = np.radians(10.0)
"""A mount this close to axes along axes is taken for that: the rest is misalignment, which a calibration finds."""


@dataclass(frozen=True)
class Mount:
    """How one unit is turned against the first."""

    rotation: Array
    """(3, 3) by rows: v_first = R v_unit; identity where it is not shown."""
    shown: bool
    square: bool
    """Taken for axes along axes."""
    off: float
    """What it was measured to be away from `rotation`, rad."""
    error: float
    """Standard error in the least certain direction, rad; infinite: not shown at all."""
    shared: float
    """Share of the rotation of the unit that is that of the first one."""
    words: str
    """What it is, or why it is not known."""
    contradicts: bool = False
    """It turns, and not as the first unit does, however it may be mounted."""
    mirrored: bool = False
    """One of the two is no right-handed frame."""


def find_mounts(block: Block, max_rate: float) -> tuple[Mount, ...]:
    """Find the mounts of units of three channels each.

    Parameters
    ----------
    block
        The recording, channels as measured, three by three.
    max_rate
        Values beyond are clipped and left out, rad/s.
    """
    means = _means(block, max_rate)
    units = block.z.shape[1] // 3
    first = Mount(np.eye(3), True, True, 0.0, 0.0, 1.0, "the body frame is taken to be its own")
    return (first, *(_against(means[:, :3], means[:, 3 * k : 3 * k + 3]) for k in range(1, units)))


def _means(block: Block, max_rate: float) -> Array:
    """Rates (W, n) averaged over windows with all channels in range, less their means: a bias is no rotation."""
    with np.errstate(invalid="ignore"):
        good = np.all(block.delivered & (np.abs(block.z) < max_rate), axis=1)
    window = (block.stamp - block.stamp[0]) // round(WINDOW * 1e9)
    starts = np.flatnonzero(np.diff(window, prepend=-1))
    whole = np.minimum.reduceat(good, starts)
    counts = np.diff([*starts, len(window)])
    sums = np.add.reduceat(np.where(good[:, None], block.z, 0.0), starts, axis=0)
    # A window at the end, or beside a gap, may hold few samples.
    whole &= counts >= 0.5 * np.median(counts)
    means = sums[whole] / counts[whole, None]
    return means - means.mean(axis=0) if len(means) else means


def _against(first: Array, own: Array) -> Mount:
    """Mount of a unit whose rates are own (W, 3) against the one that shows first (W, 3), rad/s."""
    if len(own) < LEAST_WINDOWS:
        return _unknown(f"only {len(own) * WINDOW:.0f} s in which every unit gives values", 0.0)
    most, second = np.sqrt(np.linalg.eigvalsh(own.T @ own / len(own)))[:0:-1]
    if most < LEAST_RATE:
        return _unknown(f"it does not turn ({most:.2g} rad/s rms)", 0.0)
    scale = float(np.sqrt((own**2).sum() / max((first**2).sum(), 1e-30)))
    if not 1 / LARGEST_SCALE < scale < LARGEST_SCALE:
        # Another unit of measurement hides the share that is in common, not the turn.
        own = own / scale
    found, _, sensitivity = Rotation.align_vectors(first, own, return_sensitivity=True)
    left = first - found.apply(own)
    shared = 1.0 - float((left**2).sum() / (first**2).sum())
    error = float(np.sqrt(np.mean(left**2) * np.linalg.eigvalsh(sensitivity)[-1]))
    mirrored = -Rotation.align_vectors(first, -own)[0].as_matrix()
    if shared < MIRRORED < 1.0 - float(((first - own @ mirrored.T) ** 2).sum() / (first**2).sum()):
        return replace(_unknown("mirrored against the first unit", shared), contradicts=True, mirrored=True)
    if shared < LEAST_SHARED:
        words = f"it does not turn as the first unit does ({max(shared, 0.0):.0%} in common)"
        return replace(_unknown(words, shared), contradicts=True)
    if error > LARGEST_ERROR:
        words = f"it turns too little about a second axis ({most:.2g} and {second:.2g} rad/s rms)"
        return _unknown(f"{words}: uncertain by {np.degrees(error):.1f} deg", shared)
    nearest = min(_SQUARE, key=lambda one: (one.inv() * found).magnitude())
    off = float((nearest.inv() * found).magnitude())
    if off > SQUARE:
        words = f"turned by {np.degrees(found.magnitude()):.1f} +- {np.degrees(error):.1f} deg"
        return Mount(np.round(found.as_matrix(), 6), True, False, 0.0, error, shared, words)
    return Mount(nearest.as_matrix().round() + 0.0, True, True, off, error, shared, _square_words(nearest, off, error))


def _unknown(words: str, shared: float) -> Mount:
    return Mount(np.eye(3), False, True, 0.0, np.inf, shared, f"NOT KNOWN: {words}")


def _square_words(rotation: Rotation, off: float, error: float) -> str:
    axes = ["xyz"[int(np.abs(row).argmax())] for row in rotation.as_matrix()]
    signs = ["-" if row.min() < -0.5 else "" for row in rotation.as_matrix()]
    along = ", ".join(f"{body} is its {sign}{own}" for body, sign, own in zip("xyz", signs, axes, strict=True))
    turn = "as the first" if rotation.magnitude() < 0.1 else f"turned: body {along}"
    return f"{turn}; measured {np.degrees(off):.1f} +- {np.degrees(error):.1f} deg from that"


_SQUARE = [Rotation.from_matrix(axes) for axes in SIGNED_AXES if np.linalg.det(axes) > 0]
"""All 24 rotations that take axes to axes."""
