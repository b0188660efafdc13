# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""How units and channels agree by the motion that they share: mounts found, contradictions named and refused.

Units must rotate at one rate (`check_units`) and about the same axes (`check_axes`), and channels follow the rotation
(`check_response`). Each raises DisagreementError.

All units of a rigid body see one rotation, each in its own frame: the mount of a unit against the first is the rotation
that takes its rates into those of the first (Wahba 1965). Rotation about one axis alone leaves the turn about that axis
open; which axes of the vehicle the first unit has, no gyro measures.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from fdi_ros.errors import DisagreementError
from fdi_ros.estimator.shared_noise import UNEQUAL
from fdi_ros.model.geometry import Geometry, spans_space
from fdi_ros.model.samples import Array, Int
from fdi_ros.setup.blocks import WINDOW, Data

LEAST_ROTATION = 0.05
"""Root mean square rotation about any axis while in motion, rad/s."""
LEAST_RESPONSE = 0.3
"""Share of the rotation that others see which a working channel shows at least, and they of what it shows."""
FOLLOWS = 0.9
"""Correlation from which a channel shows the rotation, if on another scale."""
LEAST_WINDOWS = 20
"""In motion; with fewer, units are not compared, and no mount is estimated."""
SHARED, SAME = 0.7, 0.9
"""Share of the rotation that units have in common: less contradicts, more shows by which axes it would not."""


def check_units(data: Data, units: Sequence[Sequence[int]], names: Sequence[str]) -> None:
    """Refuse units of three channels on quite different scales; the mounts do not matter.

    Parameters
    ----------
    data
        The recording.
    units
        Channels of each unit; those that are not three are left out.
    names
        Of all channels, ``unit.axis``.

    Raises
    ------
    DisagreementError
        Naming the unit that most others contradict, or all where nothing decides, and by what factor.
    """
    whole = [list(unit) for unit in units if len(unit) == 3]
    means = _means(data)
    if len(whole) < 2 or len(means) < LEAST_WINDOWS:
        return
    turning = np.stack([np.linalg.norm(means[:, unit], axis=1) for unit in whole], axis=1)
    moving = np.median(turning, axis=1) >= LEAST_ROTATION
    if moving.sum() < LEAST_WINDOWS:
        return
    turning, means = np.maximum(turning[moving], 1e-9), means[moving]
    ratio = np.median(turning[:, :, None] / turning[:, None, :], axis=0)
    # Along the directions in which each unit turns most to least: one bad axis is not the scale of the unit.
    along = np.sqrt(np.maximum([np.linalg.eigvalsh(np.cov(means[:, unit].T)) for unit in whole], 1e-18))
    least = np.maximum(ratio, (along[:, None] / along[None]).max(axis=2))
    agree = (least > LEAST_RESPONSE) & (least.T > LEAST_RESPONSE)
    most = np.flatnonzero(agree[int(agree.sum(axis=1).argmax())])
    if len(most) < len(whole):
        raise DisagreementError(_contradiction([names[unit[0]].rpartition(".")[0] for unit in whole], most, ratio))


def _contradiction(units: list[str], most: Int, ratio: Array) -> str:
    """Name the unit that those which agree (k,) contradict, or all; ratio (u, u) of their rotations."""
    if 2 * len(most) > len(units):
        odd = next(k for k in range(len(units)) if k not in most)
        others = " and ".join(units[k] for k in most)
        factor = float(np.median(ratio[odd, most]))
        return (
            f"{units[odd]} shows {factor:.3g} times the rotation that {others} show:"
            f" mend it or name its channels in excluded_channels"
        )
    low, high = (int(pick(np.median(ratio, axis=1))) for pick in (np.argmin, np.argmax))
    return (
        f"{' and '.join(units)} do not show one rotation, and nothing decides which is right:"
        f" {units[high]} shows {ratio[high, low]:.3g} times that of {units[low]}; mend the one that is wrong"
    )


def _means(data: Data) -> Array:
    """Rates (W, n) averaged over the windows that are complete, less their medians: a bias is no rotation."""
    starts, counts = data.starts[:-1], np.diff(data.starts)
    # A window at the end, or beside a gap, may hold few samples.
    good = np.minimum.reduceat(data.complete, starts) & (counts >= 0.5 * np.median(counts))
    means = np.add.reduceat(np.where(np.isfinite(data.z), data.z, 0.0), starts, axis=0)[good] / counts[good, None]
    return means - np.median(means, axis=0) if len(means) else means


def _moving(means: Array, axes: Array) -> Array:
    """Windows (W, n) in which the vehicle turns, by most of the channels."""
    rate = np.median(np.abs(means) / np.maximum(np.linalg.norm(axes, axis=1), 1e-9), axis=1) if len(means) else []
    return means[np.asarray(rate) >= LEAST_ROTATION / 2]


def check_axes(data: Data, nominal: Geometry, units: Sequence[Sequence[int]]) -> None:
    """Refuse units of three channels that turn about other axes than the others, and name their axes.

    Raises
    ------
    DisagreementError
        Naming the unit, and how its axes would agree.
    """
    whole = [list(unit) for unit in units if len(unit) == 3 and spans_space(nominal.axes[list(unit)])]
    means = _moving(_means(data), nominal.axes)
    if len(whole) < 2 or len(means) < LEAST_WINDOWS:
        return
    rates = [means[:, unit] @ np.linalg.inv(nominal.axes[unit]).T for unit in whole]
    agree = np.array([[_in_common(a, b) > SHARED for b in rates] for a in rates])
    most = np.flatnonzero(agree[int(agree.sum(axis=1).argmax())])
    if len(most) == len(whole):
        return
    names = [nominal.channel_names[unit[0]].rpartition(".")[0] or "one triad" for unit in whole]
    odd = next(k for k in range(len(whole)) if k not in most)
    others = " and ".join(names[k] for k in most)
    doubt = "" if len(most) > 1 else " (or the other way round: nothing decides between two)"
    true = np.mean([rates[k] for k in most], axis=0) @ nominal.axes[whole[odd]].T
    shares = [_in_common(means[:, whole[odd]], true @ signed.T) for signed in SIGNED_AXES]
    best, share = SIGNED_AXES[int(np.argmax(shares))], max(shares)
    if share < SAME:
        raise DisagreementError(
            f"{names[odd]} does not turn as {others} do ({max(share, 0.0):.0%} in common): its mount in the config is"
            f" wrong, it is not on the same body, or its clock is off by seconds{doubt}"
        )
    raise DisagreementError(
        f"{names[odd]} {_wrong_axes(best)}, against {others}{doubt}: mend its driver or mount, or name its channels in"
        " excluded_channels"
    )


_REVERSED = (
    "shows a roll to the right as one to the left",
    "shows nose up as nose down",
    "shows a left turn as a right turn",
)
"""What is seen of a unit whose x, y or z axis is reversed; x forward, y left, z up."""


def _wrong_axes(signed: Array) -> str:
    """Say what a unit shows whose channels are these rows (3, 3) of its axes as configured."""
    if (np.diag(signed) != 0.0).all():
        return " and ".join(_REVERSED[a] for a in range(3) if signed[a, a] < 0.0)
    axes = [f"{'-' if row.sum() < 0 else ''}{'xyz'[int(np.abs(row).argmax())]}" for row in signed]
    kind = "has mirrored axes" if np.linalg.det(signed) < 0 else "has swapped axes"
    return f"{kind}: its channels x, y, z are {', '.join(axes)} of its mount as configured"


def _in_common(one: Array, other: Array) -> float:
    """Share of the rotation (W, 3) of two units that they have in common."""
    return 1.0 - float(((one - other) ** 2).sum() / max((one**2).sum() + (other**2).sum(), 1e-30))


SIGNED_AXES = [
    np.eye(3)[list(order)] * np.array(signs)[:, None]
    for order in itertools.permutations(range(3))
    for signs in itertools.product((1.0, -1.0), repeat=3)
]
"""All 48 ways to swap and reverse three axes."""


def check_response(data: Data, nominal: Geometry) -> None:
    """Refuse a channel that does not follow the rotation the others see.

    A channel that agrees with any three others is not refused: a faulty one contradicts only the threes it is among.

    Parameters
    ----------
    data
        The recording.
    nominal
        Axes as configured: good enough to tell a dead channel from a live one.

    Raises
    ------
    DisagreementError
        Naming the channel, and those that cannot be distinguished from it.
    """
    moving = _moving(_means(data), nominal.axes)
    if len(moving) < LEAST_WINDOWS:
        return
    square = moving.T @ moving / len(moving)
    for i, name in enumerate(nominal.channel_names):
        found = _contradicted(square, nominal.axes, i)
        if found is None:
            continue
        response, seen = found
        shows = f"{response:.0%} of" if abs(response) < 1 else f"{response:.3g} times"
        what = f"it shows {shows} the {seen:.2f} rad/s rms that the others see along its axis"
        alike = [nominal.channel_names[j] for j in np.flatnonzero(nominal.group_matrix[i])]
        if len(alike) > 1:
            raise DisagreementError(
                f"{name} does not follow the rotation: {what}, and nothing decides which of {', '.join(alike)} is"
                " right; mend the one that is wrong or name it in excluded_channels"
            )
        raise DisagreementError(f"{name} does not follow the rotation: {what}; mend it or name it in excluded_channels")


def _contradicted(square: Array, axes: Array, i: int) -> tuple[float, float] | None:
    """Share of the rotation that channel i shows, and the rotation, rad/s rms, where all others contradict it.

    Parameters
    ----------
    square
        (n, n) mean products of the channels, (rad/s)^2.
    axes
        (n, 3).
    """
    size, found = float(np.sqrt(square[i, i])), []
    for chosen in itertools.combinations([j for j in range(len(axes)) if j != i], 3):
        three = list(chosen)
        if not spans_space(axes[three]):
            continue
        gain = np.linalg.solve(axes[three].T, axes[i])
        seen = float(np.sqrt(np.maximum(gain @ square[np.ix_(three, three)] @ gain, 0.0)))
        if seen < LEAST_ROTATION:
            return None
        response = float(gain @ square[three, i]) / seen**2
        small = abs(response) < LEAST_RESPONSE and size < LEAST_RESPONSE * seen
        large = abs(response) > 1 / LEAST_RESPONSE and abs(response) * seen > FOLLOWS * size
        if not small and not large:
            return None
        found.append((response, seen))
    if not found:
        return None
    response, seen = np.median(found, axis=0).tolist()
    return response, seen


# How the units are turned against each other --------------------------------------------------------------------------


LEAST_RATE = 0.01
"""Rotation about some axis, root mean square, below which the recording is at rest, rad/s."""
LARGEST_ERROR = np.radians(2.0)
"""A mount less certain than this, in any direction, is not shown."""
ROUNDING = 1e-9
"""Share of a rotation, about the axis that sees least of it, that is none."""
LARGEST_SCALE = 3.0
"""Rates this many times larger or smaller than those of the first unit are brought to their scale."""
LEAST_SHARED = 0.5
"""Share of the rotation of a unit that a mount must explain."""
MIRRORED = 0.9
"""Share of the rotation that a mirrored frame must explain, and no mount, to be one."""
SURELY = 3.0
"""Standard errors from which a mount is not along axes."""
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


def find_mounts(data: Data) -> tuple[Mount, ...]:
    """Find the mounts of units of three channels each.

    Parameters
    ----------
    data
        The recording, channels as measured, three by three.
    """
    means = _means(data)
    # What is taken off must turn with the unit: means do, medians do not.
    means = means - means.mean(axis=0) if len(means) else means
    first = Mount(np.eye(3), True, True, 0.0, 0.0, 1.0, "the body frame is taken to be its own")
    return (first, *(_against(means[:, :3], means[:, k : k + 3]) for k in range(3, means.shape[1], 3)))


def _against(first: Array, unit: Array) -> Mount:
    """Mount of a unit whose rates are these (W, 3) against the one that shows first (W, 3), rad/s."""
    if len(unit) < LEAST_WINDOWS:
        return _unknown(f"only {len(unit) * WINDOW:.0f} s in which every unit gives values", 0.0)
    most, second = np.sqrt(np.maximum(np.linalg.eigvalsh(unit.T @ unit / len(unit)), 0.0))[:0:-1]
    if most < LEAST_RATE:
        return _unknown(f"it does not turn ({most:.2g} rad/s rms)", 0.0)
    scale = float(np.sqrt((unit**2).sum() / max((first**2).sum(), 1e-30)))
    if not 1 / LARGEST_SCALE < scale < LARGEST_SCALE:
        # Another unit of measurement hides the share that is in common, not the turn.
        unit = unit / scale
    in_common = np.linalg.svd(first.T @ unit, compute_uv=False)
    if in_common[1] <= ROUNDING * in_common[0]:
        return _unknown("it and the first unit never turn about two axes together", 0.0)
    found, _, sensitivity = Rotation.align_vectors(first, unit, return_sensitivity=True)
    residual = first - found.apply(unit)
    shared = 1.0 - float((residual**2).sum() / (first**2).sum())
    error = float(np.sqrt(np.mean(residual**2) * np.linalg.eigvalsh(sensitivity)[-1]))
    # Vibration that units see differently looks like a turn between them, however long it lasts.
    apart = float(np.sqrt((residual**2).sum() / (first**2).sum()))
    doubt = apart * min(1.0, apart / UNEQUAL)
    mirrored = -Rotation.align_vectors(first, -unit)[0].as_matrix()
    if shared < MIRRORED < 1.0 - float(((first - unit @ mirrored.T) ** 2).sum() / (first**2).sum()):
        return replace(_unknown("mirrored against the first unit", shared), contradicts=True, mirrored=True)
    if shared < LEAST_SHARED:
        words = f"it does not turn as the first unit does ({max(shared, 0.0):.0%} in common)"
        return replace(_unknown(words, shared), contradicts=True)
    if error > LARGEST_ERROR:
        words = f"it turns too little about a second axis ({most:.2g} and {second:.2g} rad/s rms)"
        return _unknown(f"{words}: uncertain by {min(np.degrees(error), 180.0):.1f} deg", shared)
    nearest = min(_SQUARE, key=lambda one: (one.inv() * found).magnitude())
    off = float((nearest.inv() * found).magnitude())
    if off > max(SQUARE, SURELY * doubt):
        words = f"turned by {np.degrees(found.magnitude()):.1f} +- {np.degrees(error):.1f} deg"
        return Mount(np.round(found.as_matrix(), 6), True, False, 0.0, error, shared, words)
    error = max(error, doubt)
    return Mount(nearest.as_matrix().round() + 0.0, True, True, off, error, shared, _square_words(nearest, off, error))


def _unknown(words: str, shared: float) -> Mount:
    return Mount(np.eye(3), False, True, 0.0, np.inf, shared, f"NOT KNOWN: {words}")


def _square_words(rotation: Rotation, off: float, error: float) -> str:
    axes = ["xyz"[int(np.abs(row).argmax())] for row in rotation.as_matrix()]
    signs = ["-" if row.min() < -0.5 else "" for row in rotation.as_matrix()]
    along = ", ".join(f"{body} is its {sign}{axis}" for body, sign, axis in zip("xyz", signs, axes, strict=True))
    turn = "as the first" if rotation.magnitude() < 0.1 else f"turned: body {along}"
    return f"{turn}; measured {np.degrees(off):.1f} +- {np.degrees(error):.1f} deg from that"


_SQUARE = [Rotation.from_matrix(axes) for axes in SIGNED_AXES if np.linalg.det(axes) > 0]
"""All 24 rotations that take axes to axes."""
