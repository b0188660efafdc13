# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Agreement of units and channels in their common motion: mounts and contradictions.

All units of a rigid body measure one rotation, each in its own frame. The mount of a
unit against the first is the rotation between their rates (Wahba 1965). Motion about a
single axis leaves the turn about that axis open. No gyro measures how the first unit is
mounted in the vehicle.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.errors import DisagreementError
from fdi_ros.estimator.shared_noise import UNEQUAL
from fdi_ros.inspection.turns import TURNS, angle_of, find_turn
from fdi_ros.model.geometry import Geometry, spans_space
from fdi_ros.model.samples import Array, Int
from fdi_ros.setup.blocks import Data
from fdi_ros.system.text import figures, percent


class _Agreement(NamedTuple):
    """From where the rotations of two units agree."""

    #: smallest response of a channel to the rotation of others, and the reverse
    response: float = 0.3
    #: share of rotation in common from which two units show one rotation, along
    #: other axes or on another scale
    same: float = 0.9


AGREEMENT = _Agreement()

_OR_EXCLUDE = "or name its channels in excluded_channels"
SIGNED_AXES = [  # all 48 ways to swap and reverse three axes
    np.eye(3)[list(order)] * np.array(signs)[:, None]
    for order in itertools.permutations(range(3))
    for signs in itertools.product((1.0, -1.0), repeat=3)
]


def check_agreement(data: Data, nominal: Geometry, unknown: Sequence[int] = ()) -> None:
    """Refuse units and channels that do not measure one rotation.

    Configured axes suffice for that, except for unknown mounts. `DisagreementError`
    names the unit with another scale or other axes, the channel without response, or
    all if nothing decides.
    """
    means = data.slow_rates()
    if len(means) < TURNS.least_windows:
        return
    _check_units(means, nominal, unknown)
    length = np.linalg.norm(nominal.axes, axis=1)
    rate = np.median(np.abs(means) / np.maximum(length, 1e-9), axis=1)
    moving = means[rate >= TURNS.least_rotation / 2]
    if len(moving) >= TURNS.least_windows and not unknown:
        _check_response(moving, nominal)


class _Turns(NamedTuple):
    """Rotation as each of u units shows it, while they move."""

    #: (u, 3) channels of each unit
    units: list[list[int]]
    #: (u,) names
    names: list[str]
    #: (W, n) rates of the channels, rad/s
    means: Array
    #: (u, W, 3) rates of the units in the body frame, by their configured axes, rad/s
    rates: list[Array]
    #: (u, u) size of the rotation in a unit over that in another
    ratio: Array


def _check_units(means: Array, nominal: Geometry, unknown: Sequence[int]) -> None:
    """Refuse a unit with another scale than most, such as deg/s, or with other axes."""
    turns = _turns_of(means, nominal)
    if turns is None:
        return
    alike = _have_one_scale(turns)
    # Axes of unknown mounts cannot be compared.
    known = [not {*unit} & {*unknown} for unit in turns.units]
    along_same_axes = [
        [
            not (known[k] and known[j]) or _in_common(one, other) > TURNS.shared
            for j, other in enumerate(turns.rates)
        ]
        for k, one in enumerate(turns.rates)
    ]
    agree = alike & np.array(along_same_axes)
    most = np.flatnonzero(agree[int(agree.sum(axis=1).argmax())])
    others = (k for k in range(len(turns.units)) if k not in most)
    odd = next(others, None)
    if odd is None:
        return
    if alike[odd, most].all():
        raise DisagreementError(_other_axes(turns, nominal, odd, most))
    if 2 * len(most) > len(turns.units):
        ratio = np.median(turns.ratio[odd, most])
        raise DisagreementError(
            f"{turns.names[odd]} measures {figures(ratio)} times the rotation of"
            f" {_joined(turns, most)}: repair it {_OR_EXCLUDE}"
        )
    raise DisagreementError(_other_rotations(turns))


def _turns_of(means: Array, nominal: Geometry) -> _Turns | None:
    """Return the rotation of the units, or None if fewer than two turn for long enough."""
    units = [
        list(unit)
        for unit in nominal.units
        if len(unit) == 3 and spans_space(nominal.axes[list(unit)])
    ]
    if len(units) < 2:
        return None
    turning = np.array([np.linalg.norm(means[:, unit], axis=1) for unit in units])
    moving = np.median(turning, axis=0) >= TURNS.least_rotation
    if moving.sum() < TURNS.least_windows:
        return None
    turning = np.maximum(turning[:, moving], 1e-9)
    means = means[moving]
    names = [
        nominal.channel_names[unit[0]].rpartition(".")[0] or "one triad"
        for unit in units
    ]
    inverses = [np.linalg.inv(nominal.axes[unit]) for unit in units]
    rates = [
        means[:, u] @ inverse.T for u, inverse in zip(units, inverses, strict=True)
    ]
    ratio = np.median(turning[:, None] / turning[None], axis=2)
    return _Turns(units, names, means, rates, ratio)


def _have_one_scale(turns: _Turns) -> NDArray[np.bool_]:
    """Return (u, u) whether two units measure rotation on one scale.

    They are compared along the directions in which each unit turns most to least: one
    bad axis does not change the scale of the unit.
    """
    covariances = [np.cov(turns.means[:, unit].T) for unit in turns.units]
    variances = [np.linalg.eigvalsh(one) for one in covariances]
    along = np.sqrt(np.maximum(variances, 1e-18))
    ratios = along[:, None] / along[None]
    least = np.maximum(turns.ratio, ratios.max(axis=2))
    is_alike = least > AGREEMENT.response
    return is_alike & is_alike.T


def _joined(turns: _Turns, chosen: Int) -> str:
    """Name several units."""
    return " and ".join(turns.names[k] for k in chosen)


def _other_axes(turns: _Turns, nominal: Geometry, odd: int, most: Int) -> str:
    """Describe a unit that turns as much as the others, along other axes."""
    unit = turns.units[odd]
    doubt = (
        "" if len(most) > 1 else " (or the other one is wrong: two units cannot tell)"
    )
    rate = np.mean([turns.rates[k] for k in most], axis=0)
    expected = rate @ nominal.axes[unit].T
    shares = [
        _in_common(turns.means[:, unit], expected @ signed.T) for signed in SIGNED_AXES
    ]
    if max(shares) < AGREEMENT.same:
        return (
            f"{turns.names[odd]} does not measure the rotation of {_joined(turns, most)}"
            f" ({percent(max(*shares, 0.0))} shared): its mount in the config is wrong, it is not"
            f" on the same body, or its clock is off by seconds{doubt}"
        )
    likeliest = SIGNED_AXES[int(np.argmax(shares))]
    return (
        f"{turns.names[odd]} {_wrong_axes(likeliest)},"
        f" unlike {_joined(turns, most)}{doubt}: correct its driver or mount, {_OR_EXCLUDE}"
    )


def _other_rotations(turns: _Turns) -> str:
    """Describe units of which no majority measures one rotation."""
    typical = np.median(turns.ratio, axis=1)
    low = int(typical.argmin())
    high = int(typical.argmax())
    return (
        f"{' and '.join(turns.names)} measure different rotations, and the data cannot tell"
        f" which is right: {turns.names[high]} measures {figures(turns.ratio[high, low])} times"
        f" the rotation of {turns.names[low]}; repair one"
    )


def _wrong_axes(signed: Array) -> str:
    """Describe a unit whose channels measure these rows (3, 3) of its configured axes."""
    # x forward, y left, z up.
    seen = (
        "a roll to the right as one to the left",
        "nose up as nose down",
        "a left turn as a right turn",
    )
    if (np.diag(signed) != 0.0).all():
        reversed_ones = [a for a in range(3) if signed[a, a] < 0.0]
        return " and ".join(f"shows {seen[a]}" for a in reversed_ones)
    kind = "has mirrored axes" if np.linalg.det(signed) < 0 else "has swapped axes"
    return f"{kind}: its channels x, y, z are {', '.join(_axes_of(signed))} of its mount as configured"


def _axes_of(signed: Array) -> list[str]:
    """Name the axis, with its sign, that each row of signed axes (3, 3) is along."""
    return [
        f"{'-' if row.sum() < 0 else ''}{'xyz'[int(np.abs(row).argmax())]}"
        for row in signed
    ]


def _in_common(one: Array, other: Array) -> float:
    """Share of the rotation (W, 3) of two units that they have in common."""
    whole = max((one**2).sum() + (other**2).sum(), 1e-30)
    return 1.0 - float(((one - other) ** 2).sum() / whole)


def _check_response(moving: Array, nominal: Geometry) -> None:
    """Refuse a channel that does not follow the rotation of the others.

    Agreement with any three others suffices: a faulty channel only contradicts threes
    that include a faulty one.
    """
    square = moving.T @ moving / len(moving)
    for i, name in enumerate(nominal.channel_names):
        if not (found := _contradictions(square, nominal.axes, i)):
            continue
        response, seen = np.median(found, axis=0).tolist()
        shows = (
            f"{percent(response)} of"
            if abs(response) < 1
            else f"{figures(response)} times"
        )
        alike = [
            nominal.channel_names[j] for j in np.flatnonzero(nominal.group_matrix[i])
        ]
        which = (
            f", and the data cannot tell which of {', '.join(alike)} is right"
            if len(alike) > 1
            else ""
        )
        raise DisagreementError(
            f"{name} does not follow the rotation: it measures {shows} the {seen:.2f} rad/s rms of the others along"
            f" its axis{which}; repair {'the wrong one' if which else 'it'} or name it in excluded_channels"
        )


def _contradictions(square: Array, axes: Array, i: int) -> list[tuple[float, float]]:
    """Return response of channel i and rotation, rad/s rms, by each three others.

    ``square``: mean products (n, n) of the channels, (rad/s)^2. Empty unless all
    contradict.
    """
    size = float(np.sqrt(square[i, i]))
    found = []
    others = [j for j in range(len(axes)) if j != i]
    for three in map(list, itertools.combinations(others, 3)):
        if not spans_space(axes[three]):
            continue
        gain = np.linalg.solve(axes[three].T, axes[i])
        power = gain @ square[np.ix_(three, three)] @ gain
        seen = float(np.sqrt(np.maximum(power, 0.0)))
        if seen < TURNS.least_rotation:
            return []
        response = float(gain @ square[three, i]) / seen**2
        small = abs(response) < AGREEMENT.response and size < AGREEMENT.response * seen
        large = (
            abs(response) > 1 / AGREEMENT.response
            and abs(response) * seen > AGREEMENT.same * size
        )
        if not small and not large:
            return []
        found.append((response, seen))
    return found


#: rotation about some axis, root mean square, below which nothing turns, rad/s
LEAST_RATE = TURNS.least_rotation / 5


class _MountErrors(NamedTuple):
    """Which errors of mounts and delays are shown."""

    #: standard error beyond which axes along axes are an assumption, rad
    doubt: float = TURNS.square
    #: a mount less certain than this, in any direction, is not shown, rad
    largest: float = np.radians(2.0)
    #: standard errors from which a delay or a mount off the axes is shown
    sigmas: float = 3.0


MOUNT_ERRORS = _MountErrors()


@dataclass(frozen=True)
class Mount:
    """How one unit is turned against the first."""

    #: description, or reason why the mount is unknown
    words: str
    #: share of rotation in common with the first unit
    shared: float = 0.0
    #: (3, 3) v_first = R v_unit, or None if unknown
    rotation: Array | None = None
    #: measured angle from `rotation`, rad
    off: float = 0.0
    #: standard error in the least certain direction, rad, infinite if unknown
    error: float = math.inf
    #: whether no mount explains the rotation of the unit
    contradicts: bool = False
    #: one of the two is no right-handed frame
    mirrored: bool = False

    @property
    def shown(self) -> bool:
        """Whether the recording shows the mount; otherwise `rotation` is assumed or None."""
        return self.rotation is not None and self.error < MOUNT_ERRORS.doubt


def find_mounts(data: Data) -> tuple[Mount, ...]:
    """Find the mounts of units from the measured channels of a recording."""
    means = data.slow_rates()
    # Means turn with the unit, medians do not.
    means = means - means.mean(axis=0) if len(means) else means
    first = Mount("the body frame is taken to be its own", 1.0, np.eye(3), error=0.0)
    return (
        first,
        *(
            _against(means[:, :3], means[:, k : k + 3])
            for k in range(3, means.shape[1], 3)
        ),
    )


def _against(first: Array, unit: Array) -> Mount:
    """Return the mount of a unit with rates (W, 3) against the first one (W, 3), rad/s."""
    if len(unit) < TURNS.least_windows:
        return Mount(
            f"NOT KNOWN: all units give values together for only {len(unit) * TURNS.window:.0f} s"
        )
    powers = np.linalg.eigvalsh(unit.T @ unit / len(unit))
    most, second = np.sqrt(np.maximum(powers, 0.0))[:0:-1]
    if most < LEAST_RATE:
        return Mount(f"NOT KNOWN: it does not turn ({figures(most, 2)} rad/s rms)")
    rotation, mirrored, uncertainty = find_turn(first, unit)
    if math.isinf(uncertainty):
        return Mount(
            "NOT KNOWN: it and the first unit share no rotation about two axes"
        )
    power = max(float((first**2).sum()), 1e-30)
    square = (first - unit @ rotation.T) ** 2
    missed = float(square.sum()) / power
    shared = 1.0 - missed
    error = math.sqrt(float(np.mean(square)) * uncertainty)
    square_mirrored = (first - unit @ mirrored.T) ** 2
    if shared < AGREEMENT.same < 1.0 - float(square_mirrored.sum()) / power:
        return Mount(
            "NOT KNOWN: mirrored relative to the first unit",
            shared,
            contradicts=True,
            mirrored=True,
        )
    # Most of the rotation then differs.
    if shared < 0.5:
        words = f"NOT KNOWN: it does not measure the rotation of the first unit ({percent(max(shared, 0.0))} shared)"
        return Mount(words, shared, contradicts=True)
    if error > MOUNT_ERRORS.largest:
        words = f"it turns too little about a second axis ({figures(most, 2)} and {figures(second, 2)} rad/s rms)"
        return Mount(
            f"NOT KNOWN: {words}: uncertain by {min(np.degrees(error), 180.0):.1f} deg",
            shared,
        )
    # Unequal vibration of units looks like a turn, however long the recording.
    doubt = math.sqrt(missed) * min(1.0, math.sqrt(missed) / UNEQUAL)
    # Of all signed axes, a mirrored one is never the nearest.
    nearest = min(SIGNED_AXES, key=lambda axes: float(np.linalg.norm(axes - rotation)))
    off = angle_of(nearest.T @ rotation)
    if off > max(TURNS.square, MOUNT_ERRORS.sigmas * doubt):
        angle = np.degrees(angle_of(rotation))
        words = f"turned by {angle:.1f} +- {np.degrees(error):.1f} deg"
        return Mount(words, shared, np.round(rotation, 6), 0.0, error)
    error = max(error, doubt)
    along = ", ".join(
        f"{body} is its {axis}"
        for body, axis in zip("xyz", _axes_of(nearest), strict=True)
    )
    if error >= MOUNT_ERRORS.doubt:
        # The identity is the assumption of a starting config.
        words = f"NOT MEASURED, uncertain by {np.degrees(error):.0f} deg: vibration"
        words += " masks the turns that would show it"
        return Mount(words, shared, np.eye(3), off, error)
    turn = "as the first" if (nearest == np.eye(3)).all() else f"turned: body {along}"
    words = f"{turn}; measured {np.degrees(off):.1f} +- {np.degrees(error):.1f} deg from that"
    return Mount(words, shared, nearest, off, error)
