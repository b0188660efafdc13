# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Sensitivity axes of redundant gyros: least squares, parity, which faults can be told apart, names for sets.

Measurement model: ``z = H @ omega + error``; row i of H (n, 3) is the sensitivity axis
of channel i in the body frame, a unit vector times the channel's scale factor.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fdi_ros.compiling.compiled import MAX_CHANNELS
from fdi_ros.config.unit_names import short_names
from fdi_ros.errors import GeometryError
from fdi_ros.model.samples import Array
from fdi_ros.system.text import html_table, listed

#: Three axes determine the rate; a fourth makes it redundant.
MIN_CHANNELS = 4
MIN_NORM, MAX_NORM = 0.5, 2.0
#: |rho| above which two channels have, in practice, the same parity direction.
SAME_DIRECTION = 0.999
#: Relative bound of rounding errors: 1e-16, multiplied by products of matrices.
ROUNDING = 1e-9
#: Smallest ratio of the singular values of axes that span space.
MIN_SINGULAR_RATIO = 0.02
#: sqrt(S_ii) below which a fault of channel i does not reach the parity vector.
MIN_SENSITIVITY = 0.03


def spans_space(axes: Array) -> bool:
    """Return whether axes (k, 3) determine all three components of a body rate."""
    if len(axes) < 3:
        return False
    singular = np.linalg.svd(axes, compute_uv=False)
    return bool(singular[-1] >= MIN_SINGULAR_RATIO * singular[0])


class Geometry:
    """The sensitivity axes of 4 to 12 gyro channels and derived quantities.

    Parameters
    ----------
    axes
        Sensitivity axes in the body frame, (n, 3), norm 0.5 to 2 (a norm other than 1
        is a scale factor).
    channel_names
        One name per channel; default g1, g2, ...
    units
        Name of the unit of each channel, (n,): channels of one housing, which may fail
        together. Default: the part of the channel's name before the last point.

    Raises
    ------
    GeometryError
        If the axes are of the wrong shape or number, non-finite, of a norm out of
        range, or of rank below 3.
    """

    def __init__(
        self,
        axes: ArrayLike,
        channel_names: Sequence[str] | None = None,
        units: Sequence[str] | None = None,
    ) -> None:
        self.axes: Array = np.array(axes, dtype=np.float64)
        _check_axes(self.axes)
        self.axes.flags.writeable = False
        self.n = len(self.axes)
        names = tuple(channel_names or (f"g{i + 1}" for i in range(self.n)))
        self.unit_of = (
            tuple(name.rpartition(".")[0] for name in names)
            if units is None
            else tuple(units)
        )
        """Unit of each channel, or "" without a unit."""
        for count, called in (
            (len(names), "channel names"),
            (len(self.unit_of), "names of units"),
        ):
            if count != self.n:
                raise GeometryError(f"{count} {called} for {self.n} axes")
        if len(set(names)) != self.n:
            raise GeometryError(f"channel names are not unique: {', '.join(names)}")
        self.channel_names = names

    def __repr__(self) -> str:
        return f"Geometry({self.n} channels: {', '.join(self.channel_names)})"

    def _repr_html_(self) -> str:
        rows = zip(
            self.channel_names,
            self.axes.tolist(),
            self.sensitivity.tolist(),
            strict=True,
        )
        cells = [
            [name, *(f"{part:.4f}" for part in axis), f"{seen:.3f}"]
            for name, axis, seen in rows
        ]
        head = ("channel", "axis x", "y", "z", "share of a fault that is seen")
        return html_table(f"{self.n} gyro channels", head, cells)

    @classmethod
    def from_axes(
        cls, axes: ArrayLike, channel_names: Sequence[str] | None = None
    ) -> Geometry:
        """Geometry of given sensitivity axes (n, 3)."""
        return cls(axes, channel_names)

    @classmethod
    def two_triad_cone(cls) -> Geometry:
        """Two mirrored three-axis blocks on a cone of half-angle 54.7 deg (Gorelov et al. 2019, eq. 1)."""
        r = np.sqrt(3.0)
        a = (r + 1) / 2
        b = (r - 1) / 2
        upper = np.array([[1, -1, -1], [1, a, -b], [1, -b, a]])
        return cls(
            np.vstack([upper, upper * [-1, 1, 1]]) / r,
            units=3 * ["triad_1"] + 3 * ["triad_2"],
        )

    @classmethod
    def dodecahedron(cls) -> Geometry:
        """Six axes normal to the faces of a dodecahedron: 63.4 deg between any two."""
        golden = (1 + np.sqrt(5.0)) / 2
        rows = [
            [0, 1, golden],
            [0, -1, golden],
            [1, golden, 0],
            [-1, golden, 0],
            [golden, 0, 1],
            [golden, 0, -1],
        ]
        return cls(np.array(rows) / np.hypot(1, golden))

    @classmethod
    def cone(cls, n: int) -> Geometry:
        """Build n axes evenly spread on a cone of half-angle arccos(1/sqrt 3) about body z."""
        azimuth = 2 * np.pi * np.arange(n) / n
        c = 1 / np.sqrt(3.0)
        s = np.sqrt(2 / 3)
        x = s * np.cos(azimuth)
        y = s * np.sin(azimuth)
        return cls(np.column_stack([x, y, np.full(n, c)]))

    @classmethod
    def from_triads(
        cls, mounts: Sequence[ArrayLike], channel_names: Sequence[str] | None = None
    ) -> Geometry:
        """Axes of three-axis units; ``v_body = R @ v_unit`` with one rotation R (3, 3) per unit.

        Channels are named imu_1.x, imu_1.y, ... unless names are given.

        Raises
        ------
        GeometryError
            If a mount is not a rotation matrix.
        """
        rotations = [_rotation(mount, k) for k, mount in enumerate(mounts)]
        names = channel_names or [
            f"imu_{k + 1}.{axis}" for k in range(len(rotations)) for axis in "xyz"
        ]
        return cls(np.vstack([rotation.T for rotation in rotations]), names)

    @cached_property
    def least_squares(self) -> Array:
        """pinv(H), (3, n): maps z to the least-squares body rate."""
        return np.asarray(np.linalg.pinv(self.axes), dtype=np.float64)

    @cached_property
    def S(self) -> Array:  # noqa: N802 - the papers' symbol
        """I - H pinv(H), (n, n): maps z to the least-squares residuals."""
        return np.eye(self.n) - self.axes @ self.least_squares

    @cached_property
    def parity(self) -> Array:
        """V (n - 3, n): orthonormal rows with V @ H = 0; the parity vector is V @ z."""
        return np.linalg.svd(self.axes)[0][:, 3:].T.copy()

    @cached_property
    def sensitivity(self) -> Array:
        """sqrt(S_ii), (n,): share of a fault of channel i in the parity vector, 0 to 1."""
        return np.sqrt(np.clip(np.diag(self.S), 0, None))

    @cached_property
    def rho(self) -> Array:
        """Correlation of the normalised residuals, (n, n), 0 for undetectable channels."""
        scale = np.where(self.detectable, self.sensitivity, np.inf)
        correlation = self.S / np.outer(scale, scale)
        np.fill_diagonal(correlation, 1.0)
        return correlation

    @cached_property
    def detectable(self) -> NDArray[np.bool_]:
        """(n,): whether a fault of the channel reaches the parity vector at all."""
        return self.sensitivity >= MIN_SENSITIVITY

    @cached_property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """Groups of indistinguishable channels (``|rho| > 0.999``), each channel in one."""
        same = np.abs(self.rho) > SAME_DIRECTION
        left = list(range(self.n))
        groups = []
        while left:
            group = tuple(j for j in left if same[left[0], j])
            groups.append(group)
            left = [j for j in left if j not in group]
        return tuple(groups)

    @cached_property
    def group_matrix(self) -> NDArray[np.bool_]:
        """(n, n): row i marks channel i and all channels indistinguishable from it."""
        number = np.array(
            [
                next(k for k, group in enumerate(self.groups) if i in group)
                for i in range(self.n)
            ]
        )
        return np.asarray(number[:, None] == number)

    @cached_property
    def isolable(self) -> NDArray[np.bool_]:
        """(n,): whether a single fault of the channel is detectable and distinguishable."""
        alone: NDArray[np.bool_] = self.group_matrix.sum(axis=1) == 1
        return alone & self.detectable

    @cached_property
    def units(self) -> tuple[tuple[int, ...], ...]:
        """Channels of each unit with at least two channels."""
        names = dict.fromkeys(filter(None, self.unit_of))
        members: dict[str, list[int]] = {name: [] for name in names}
        for i, name in enumerate(self.unit_of):
            if name:
                members[name].append(i)
        return tuple(tuple(unit) for unit in members.values() if len(unit) > 1)

    def covariance(self, variance: ArrayLike = 1.0) -> Array:
        """Return the covariance (3, 3) of the least-squares rate, (rad/s)^2.

        ``variance`` of the channels: scalar or (n,), (rad/s)^2.
        """
        gain = self.least_squares
        return (
            gain * np.broadcast_to(np.asarray(variance, dtype=np.float64), self.n)
        ) @ gain.T

    @cached_property
    def gdop(self) -> float:
        """sqrt(trace((H'H)^-1)): error of the rate for a unit error in every channel."""
        return float(np.sqrt(np.trace(self.covariance())))

    def subset(self, mask: ArrayLike) -> Geometry:
        """Return the geometry of the channels marked in mask, (n,) bool.

        Raise `GeometryError` if they are too few, or in a plane.
        """
        kept = np.flatnonzero(np.asarray(mask, dtype=bool))
        names = [self.channel_names[i] for i in kept]
        units = [self.unit_of[i] for i in kept]
        return Geometry(self.axes[kept], names, units)


def _check_axes(axes: Array) -> None:
    if axes.ndim != 2 or axes.shape[1] != 3:
        raise GeometryError(f"axes have shape {axes.shape}, expected (n, 3)")
    if not MIN_CHANNELS <= len(axes) <= MAX_CHANNELS:
        raise GeometryError(
            f"{len(axes)} channels, expected {MIN_CHANNELS} to {MAX_CHANNELS}"
        )
    for row, norm in enumerate(np.linalg.norm(axes, axis=1)):
        if not np.isfinite(axes[row]).all():
            raise GeometryError(
                f"axis of channel {row + 1} is not finite: {axes[row].tolist()}"
            )
        if not MIN_NORM <= norm <= MAX_NORM:
            raise GeometryError(
                f"axis of channel {row + 1} has norm {norm:.4g}, expected {MIN_NORM} to {MAX_NORM:g}"
            )
    if not spans_space(axes):
        singular = np.linalg.svd(axes, compute_uv=False)
        raise GeometryError(
            f"axes do not span three dimensions: singular values {np.array2string(singular, precision=3)},"
            f" the smallest must be at least {MIN_SINGULAR_RATIO:g} of the largest"
        )


def _rotation(mount: ArrayLike, index: int) -> Array:
    rotation = np.asarray(mount, dtype=np.float64)
    if rotation.shape != (3, 3):
        raise GeometryError(
            f"mount of unit {index + 1} has shape {rotation.shape}, expected (3, 3)"
        )
    if not np.isfinite(rotation).all():
        raise GeometryError(f"mount of unit {index + 1} is not finite")
    difference = rotation @ rotation.T - np.eye(3)
    deviation = float(np.abs(difference).max())
    if deviation > 1e-3:
        raise GeometryError(
            f"mount of unit {index + 1} is no rotation: |R R' - I| is {deviation:.3g}, at most 0.001"
        )
    if np.linalg.det(rotation) < 0:
        raise GeometryError(
            f"mount of unit {index + 1} is a reflection: det R is -1, expected +1"
        )
    return rotation


# Names for sets
# ------------------------------------------------------------------------------------------------------


#: Cosine of the largest angle between channels that measure the same axis: 10 deg.
PARALLEL = 0.985
#: Largest number of names listed one by one.
_FEW_NAMES = 3


def are_parallel(geometry: Geometry, channels: Sequence[int]) -> bool:
    """Return whether two or more channels all measure one axis, with either sign."""
    axes = geometry.axes[list(channels)]
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    is_along = np.abs(axes @ axes[0]) >= PARALLEL
    return len(channels) > 1 and bool(is_along.all())


def lone_pairs(geometry: Geometry) -> list[tuple[int, int]]:
    """Return pairs of channels that alone measure one axis.

    No evidence shows which of such a pair is faulty.
    """
    pairs = [
        pair
        for pair in combinations(range(geometry.n), 2)
        if are_parallel(geometry, pair)
    ]
    often = np.bincount(np.ravel(pairs).astype(np.intp), minlength=geometry.n)
    return [pair for pair in pairs if (often[list(pair)] == 1).all()]


def whole_units(geometry: Geometry, channels: Sequence[int]) -> list[str]:
    """Return the names of the units that form a set of channels.

    Empty if the set does not consist of whole units.
    """
    inside = [unit for unit in geometry.units if set(channels).issuperset(unit)]
    if sum(map(len, inside)) != len(channels):
        return []
    return [_unit_name([geometry.channel_names[i] for i in unit]) for unit in inside]


def _unit_name(channels: Sequence[str]) -> str:
    """Return the name of all channels of a unit: ``imu_1``, or ``imu_1.accel``."""
    short = short_names(channels)
    return short[0] if len(short) == 1 else channels[0].rpartition(".")[0]


def one_of_words(
    geometry: Geometry, channels: Sequence[int], sensor: str = "channel"
) -> str:
    """Return words for one channel of a set, such as `the x axis of imu_1 or imu_2`.

    Parameters
    ----------
    geometry
        All channels of the half.
    channels
        Numbers of the channels in the set.
    sensor
        What one of these channels is, in the singular: `gyro`.
    """
    names = [geometry.channel_names[i] for i in channels]
    if len(names) == geometry.n:
        return f"any of the {geometry.n} {sensor}s"
    units = whole_units(geometry, channels)
    if units:
        return f"any axis of {listed(units, 'or')}"
    parts = [name.rpartition(".") for name in names]
    if are_parallel(geometry, channels):
        same = parts[0][2]
        if all(unit and axis == same for unit, _, axis in parts):
            owners = [unit for unit, *_ in parts]
            return f"the {same} axis of {listed(owners, 'or')}"
        return f"{listed(names, 'or')}, which measure one axis,"
    others = [
        name for i, name in enumerate(geometry.channel_names) if i not in channels
    ]
    if len(names) > _FEW_NAMES:
        return (
            f"one of the {sensor}s (all but {listed(others)})"
            if len(others) <= _FEW_NAMES
            else f"any of {len(names)} {sensor}s"
        )
    return listed(names, "or")


def all_of_words(geometry: Geometry, channels: Sequence[int]) -> str:
    """Return words for all channels of a set: `imu_2.y`, `imu_2`, `imu_2.x and imu_2.y`."""
    names = whole_units(geometry, channels) or [
        geometry.channel_names[i] for i in channels
    ]
    return listed(names)


def axis_words(geometry: Geometry, channel: int) -> str:
    """Return the body axis of a channel, such as `-y`, or its direction."""
    axis = geometry.axes[channel] / np.linalg.norm(geometry.axes[channel])
    largest = int(np.abs(axis).argmax())
    if abs(axis[largest]) >= PARALLEL:
        return f"{'-' if axis[largest] < 0 else ''}{'xyz'[largest]}"
    return " ".join(f"{value:.2f}" for value in axis)
