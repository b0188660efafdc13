# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Positions of accelerometers against each other, from the turns of a recording.

An accelerometer at r from the first measures ``alpha x r + omega x (omega x r)`` more.
The difference d of the specific forces of two units in blocks of 40 ms is

    d = ([alpha x] + [omega x][omega x]) r + D f + late df/dt + b,

with the rate of the calibrated gyros, the mean force f of both units, their relative
scale and mount errors D (3, 3), and a bias b that walks. Weighted least squares over
all windows (`fdi_ros.setup.smoother`) gives r with its standard errors. Positions along
an axis that no turn shows stay at their prior, with its error.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from fdi_ros.config.config import Config
from fdi_ros.inspection.turns import TURNS
from fdi_ros.model.quantity import FORCE
from fdi_ros.model.samples import Array, Block, Int, Mask
from fdi_ros.monitor.accelerometers import (
    UNKNOWN_POSITION,
    accelerometer_names,
    felt_units,
    lever_arms,
    position_std,
)
from fdi_ros.monitor.building import UNIT_DELAY, build_geometry
from fdi_ros.setup.blocks import Blocks, make_blocks, prepare
from fdi_ros.setup.estimate import (
    LEAST_BLOCKS,
    SCALE_STD,
    USUAL_WALK,
    StateEstimate,
    misfit,
)
from fdi_ros.setup.noise import projector
from fdi_ros.setup.smoother import (
    NormalEquations,
    find_random_walk,
    positive_part,
    smooth,
)


class _PositionLimits(NamedTuple):
    """Priors of positions, and limits of measured ones."""

    #: standard deviation of a position before anything is shown, m
    std: float = 0.5
    #: standard deviation of the difference of two biases before anything is shown,
    #: m/s^2
    bias_std: float = 1.5
    #: largest standard error of a position that counts as measured, m
    shown: float = 0.01
    #: fewest windows of at least `LEAST_BLOCKS` blocks in use
    windows: int = 5
    #: angular acceleration over its noise, in power, from which a window turns
    turning: float = 3.0


POSITION_LIMITS = _PositionLimits()

#: weights of a block and its neighbours: the mean force then lasts as long as the
#: difference of two rates, to second order
SMOOTHING = np.array([1.0, 4.0, 1.0]) / 6.0
#: Numbers of states: the walking bias; and bias, position (3), scale and mount errors
#: (9) and delay together.
BIAS_COUNT, STATE_COUNT = 3, 16


class Position(NamedTuple):
    """Where the accelerometers of a unit are, seen from those of the first."""

    #: number of the unit
    unit: int
    #: its name
    name: str
    #: (3,) along the axes of the body, m
    value: Array
    #: (3,) standard errors, m
    error: Array

    @property
    def measured(self) -> Array:
        """Whether the recording shows the position, (3,) along the axes of the body."""
        return np.asarray(self.error < POSITION_LIMITS.shown)


def find_positions(
    block: Block, config: Config, found: StateEstimate
) -> tuple[Position, ...]:
    """Find the positions of all units but the first from a calibrated recording.

    Empty without accelerations of the first unit. Units with an excluded accelerometer
    are left out.
    """
    units = felt_units(block) if config.has_units else ()
    excluded = set(config.excluded_channels)
    kept = [
        unit
        for unit in units
        if excluded.isdisjoint(accelerometer_names(config, [unit]))
    ]
    if not kept or kept[0] != 0 or block.acceleration is None:
        return ()
    force = _forces(block.acceleration, config, found)
    turning, noise = turning_of(found)
    return tuple(
        Position(
            unit,
            config.imu_names[unit],
            *_position(force[:, 0], force[:, unit], turning, noise, found),
        )
        for unit in kept[1:]
    )


def _forces(block: Block, config: Config, found: StateEstimate) -> Array:
    """Specific forces (B, units, 3) in the frame of the body, over `FORCE.natural`."""
    axes = build_geometry(config).axes.reshape(-1, 3, 3)
    most = np.broadcast_to(config.accelerometers.max_acceleration, block.z.shape[1])
    data = prepare(block, most)
    blocks = make_blocks(data, delays_of(config, found))
    mean = blocks.mean.reshape(-1, len(axes), 3)
    return np.asarray(np.einsum("uab,kub->kua", np.linalg.inv(axes), mean)) / (
        FORCE.natural
    )


def delays_of(config: Config, found: StateEstimate) -> Array:
    """Delay of the stamps of every channel (3 units,), s, 0 for units not in use."""
    used = np.array(
        [
            name not in config.excluded_channels
            for name in build_geometry(config).channel_names
        ]
    )
    delay = np.zeros(len(used))
    delay[used] = found.delay
    of_units = delay.reshape(-1, 3)
    largest = np.abs(of_units).argmax(1)
    return np.repeat(of_units[np.arange(len(of_units)), largest], 3)


def turning_of(found: StateEstimate) -> tuple[Array, Array]:
    """Return the matrices (B, 3, 3) that positions are multiplied by, 1/s^2, NaN if unknown.

    Also the covariance (W, 3, 3) of the noise of the angular acceleration.
    """
    blocks = found.blocks
    rate = found.rate
    acceleration = blocks.slopes(rate)
    # What no rate explains is noise, about alike in all channels.
    apart = projector(found.axes)
    steps = np.diff(blocks.mean, axis=0) @ apart
    size = np.nan_to_num(steps**2).sum(axis=1) / 2
    total = np.add.reduceat(np.append(size, 0.0), blocks.start) / blocks.size
    of_rate = np.linalg.inv(found.axes.T @ found.axes) / max(len(apart) - 3, 1)
    noise = total[:, None, None] * of_rate / (2.0 * blocks.length**2)
    square = (rate**2).sum(axis=1)[:, None, None] * np.eye(3)
    inward = (rate[:, :, None] * rate[:, None, :] - square).reshape(-1, 9)
    turning = _cross(acceleration) + _smooth(inward).reshape(-1, 3, 3)
    return turning, np.asarray(noise)


def _smooth(values: Array) -> Array:
    """Average blocks (B, c) with their neighbours; NaN at both ends."""
    found = np.full_like(values, np.nan)
    found[1:-1] = (
        SMOOTHING[0] * (values[2:] + values[:-2]) + SMOOTHING[1] * values[1:-1]
    )
    return found


def _cross(vectors: Array) -> Array:
    """Matrices (B, 3, 3) of the vector product with vectors (B, 3)."""
    columns = np.cross(vectors[:, None, :], np.eye(3))
    return np.asarray(columns.swapaxes(1, 2))


@dataclass(frozen=True)
class _ForceEvidence:
    """Evidence of windows (W,) about the difference of the forces of two units.

    States: bias (3), position (3), scale and mount errors (9), delay. Forces are over
    `FORCE.natural`.
    """

    #: (B, 3, STATE_COUNT) change of each force with the bias and with the states
    signals: Array
    #: (B, 3) difference of the forces, 0 where unknown
    difference: Array
    #: (B,) blocks in use
    good: Mask
    #: (W,) blocks in use
    count: Int
    #: (W, STATE_COUNT, STATE_COUNT) sums of products of signals, without those of noise
    moments: Array
    #: (W, STATE_COUNT) sums of products of signals and difference
    cross: Array

    @property
    def known(self) -> Mask:
        """Windows (W,) with enough blocks."""
        return np.asarray(self.count >= LEAST_BLOCKS)


def _windows_of(
    first: Array, other: Array, turning: Array, noise: Array, blocks: Blocks
) -> _ForceEvidence:
    """Return the evidence in forces (B, 3) of the first unit and of another one."""
    # The difference has other noise than the mean.
    difference = _smooth(other - first)
    mean = _smooth(0.5 * (first + other))
    signals = np.zeros((len(mean), 3, STATE_COUNT))
    signals[:, :, :3] = np.eye(3)
    signals[:, :, 3:6] = turning / FORCE.natural
    of_mean = np.kron(np.eye(3), mean[:, None, :])
    signals[:, :, 6:15] = of_mean.reshape(-1, 3, 9)
    signals[:, :, 15] = np.gradient(mean, blocks.seconds, axis=0)
    usable = np.isfinite(signals).all(axis=2) & np.isfinite(difference)
    good: Mask = np.asarray(usable.all(axis=1))
    count = np.add.reduceat(good, blocks.start)
    signals[~good] = 0.0
    difference = np.where(good[:, None], difference, 0.0)
    # Of noise alone no position is learned.
    of_noise = np.trace(noise, axis1=1, axis2=2)[:, None, None] * np.eye(3) - noise
    of_noise /= FORCE.natural**2
    power = (signals[:, :, 3:6] ** 2).sum(axis=(1, 2))
    power = np.add.reduceat(power, blocks.start) / np.maximum(count, 1)
    turns = power > POSITION_LIMITS.turning * np.trace(of_noise, axis1=1, axis2=2)
    signals[:, :, 3:6] *= turns[blocks.window][:, None, None]
    moments = np.add.reduceat(np.einsum("bas,bat->bst", signals, signals), blocks.start)
    moments[:, 3:6, 3:6] -= (count * turns)[:, None, None] * of_noise
    cross = np.add.reduceat(np.einsum("bas,ba->bs", signals, difference), blocks.start)
    return _ForceEvidence(
        signals, difference, good, count, positive_part(moments), cross
    )


def _weights(
    evidence: _ForceEvidence, residual: Array, removed: bool, start: Int
) -> Array:
    """Return the inverse variance (W,) of residuals (B, 3), 0 without enough blocks.

    ``removed``: whether the residuals are free of the mean bias of their window.
    """
    count = evidence.count
    square = np.add.reduceat((residual**2).sum(axis=1), start)
    if not removed:
        total = np.add.reduceat(residual, start)
        square -= (total**2).sum(axis=1) / np.maximum(count, 1)
    # Smoothing has reduced the variance of white noise by this factor.
    variance = square / np.maximum(3 * count - 3, 1) / (SMOOTHING**2).sum()
    # Some windows are quiet only by chance: bound their variance from below.
    variance = np.maximum(variance, 0.5 * np.median(variance[evidence.known]))
    return np.where(evidence.known, 1.0 / np.maximum(variance, 1e-18), 0.0)


def _position(
    first: Array,
    other: Array,
    turning: Array,
    noise: Array,
    found: StateEstimate,
) -> tuple[Array, Array]:
    """Fit the position of one unit to forces (B, 3) of the first and its own.

    Returns it with its standard errors, (3,) m.
    """
    blocks = found.blocks
    evidence = _windows_of(first, other, turning, noise, blocks)
    if evidence.known.sum() < POSITION_LIMITS.windows:
        return np.zeros(3), np.full(3, POSITION_LIMITS.std)
    prior = np.concatenate(
        [
            np.full(3, POSITION_LIMITS.bias_std / FORCE.natural),
            np.full(3, POSITION_LIMITS.std),
            np.full(9, TURNS.square),
            [UNIT_DELAY],
        ]
    )
    groups = np.arange(0, blocks.windows, blocks.group_size)
    in_group = np.diff(groups, append=blocks.windows)
    middle = np.add.reduceat(blocks.time, groups) / in_group
    apart = np.diff(middle, append=middle[-1])
    residual = evidence.difference
    # Three fits, each with the noise that the one before left in every window.
    for number in range(3):
        weight = _weights(evidence, residual, number > 0, blocks.start)
        of = NormalEquations(
            BIAS_COUNT,
            np.add.reduceat(weight[:, None, None] * evidence.moments, groups),
            np.add.reduceat(weight[:, None] * evidence.cross, groups),
            apart,
            prior,
            np.zeros(STATE_COUNT),
        )
        walk = find_random_walk(of)
        fitted = smooth(of, walk.value or min(walk.possible, USUAL_WALK))
        curve = np.repeat(fitted.curve, blocks.group_size, axis=0)
        bias = curve[blocks.window] * evidence.good[:, None]
        explained = evidence.signals[:, :, 3:] @ fitted.constant + bias
        residual = evidence.difference - explained
    covariance = fitted.constant_covariance[:3, :3] * misfit(of, fitted)
    value = fitted.constant[:3]
    # No recording shows the scale that all gyros have in common.
    common = SCALE_STD * float(np.linalg.norm(value))
    error = np.minimum(
        np.hypot(np.sqrt(np.diag(covariance)), common), POSITION_LIMITS.std
    )
    return value, error


def position_settings(
    positions: tuple[Position, ...], config: Config, likely: bool = False
) -> dict[str, Any]:
    """Return the changed parameters: what is measured, the rest as configured.

    ``likely``: the estimates, measured or not.
    """
    if not likely and not any(one.measured.any() for one in positions):
        return {}
    units = range(len(config.topics))
    known = lever_arms(config, units)[::3].copy()
    for one in positions:
        taken = np.logical_or(one.measured, likely)
        known[one.unit] = np.where(taken, one.value, known[one.unit])
    before = position_std(config, units)[::3]
    unknown = np.where(before > 0.0, before, UNKNOWN_POSITION)
    unknown[0] = 0.0
    for one in positions:
        errors = np.where(one.measured, one.error, unknown[one.unit])
        unknown[one.unit] = errors.max()
    places = [round(float(value), 4) + 0.0 for value in known.ravel()]
    std = [float(f"{value:.2g}") for value in unknown]
    both = {"accelerometers.positions": places, "accelerometers.position_std": std}
    return both if positions else {}
