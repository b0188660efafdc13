# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Noise, biases, scales and misalignments of accelerometers against each other.

The estimate of the gyros (`fdi_ros.setup.estimate`) runs on specific forces over
`FORCE.natural`, less what the turning of the body adds at known positions. Accelerometers
are never at rest in its sense: gravity turns with the attitude, and rest, as the gyros
show it, means a constant specific force. Rest in several attitudes and motion tell scale
errors from biases. Errors that all accelerometers have in common stay at zero, because no
accelerometer contradicts them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fdi_ros.config.config import PARAMETERS, Config
from fdi_ros.errors import CalibrationError, DisagreementError
from fdi_ros.model.quantity import FORCE
from fdi_ros.model.samples import Array, Block, Int, Mask
from fdi_ros.monitor.accelerometers import (
    accelerometer_names,
    felt_units,
    lever_arms,
    possible_units,
)
from fdi_ros.monitor.building import UNIT_DELAY, build_geometry
from fdi_ros.setup.agreement import AGREEMENT
from fdi_ros.setup.blocks import Data, prepare, resampled, spikes
from fdi_ros.setup.channels import ChannelFit
from fdi_ros.setup.estimate import (
    REFERENCE_STD,
    SCALE_STD,
    Priors,
    StateEstimate,
    estimate,
)
from fdi_ros.setup.noise import projector
from fdi_ros.setup.positions import delays_of, turning_of
from fdi_ros.system.text import figures, percent

#: Smallest share of usable samples of an accelerometer, relative to the median of all
#: (counted as at least this share, too).
LEAST_OF_USUAL = 0.3
#: largest angle between the specific forces of two units, rad: swapped or reversed axes
#: make more
LARGEST_TURN = float(np.radians(30.0))
#: median specific force of accelerometers that measure in g
IN_G = (0.8, 1.2)
#: smallest noise_std written, m/s^2: a bench shows less than a flight, and motion of
#: units that are not sampled at one instant looks like noise
LEAST_NOISE_STD = float(PARAMETERS["accelerometers.noise_std"].default[0])


@dataclass
class AccelerometerFit(ChannelFit):
    """What a recording shows of the accelerometers, in m/s^2.

    `estimate` holds the differences from what all have in common.
    """

    #: parameters to be changed, ``{"section.field": value}``
    settings: dict[str, object]
    #: what the monitor declares in this recording
    faults: tuple[Any, ...] = ()


@dataclass
class Prepared:
    """The accelerometers of a recording, ready for the estimate."""

    #: of the channels in use
    names: tuple[str, ...]
    #: (n,) numbers of the channels in use among those of all units of the config
    active: Int
    #: (N, n) over `FORCE.natural`, less what the turning of the body adds
    data: Data
    #: for the estimate
    priors: Priors
    #: (N, n) samples left out as spikes
    spiky: Mask

    def as_monitored(self, stamp: Int, width: int) -> Block:
        """Return the forces (N, width) as a monitor has them with delays taken off, m/s^2."""
        delay = self.priors.delay[self.priors.unit]
        z = np.full((len(stamp), width), np.nan)
        shifted, _ = resampled(self.data, delay)
        z[:, self.active] = shifted * FORCE.natural
        return Block(stamp, z, np.isfinite(z))


def prepare_accelerometers(
    block: Block, config: Config, gyros: StateEstimate, trusted: Sequence[str] = ()
) -> Prepared | None:
    """Prepare the accelerometers of a recording whose gyros are calibrated.

    ``config``: with calibrated axes of the gyros, and with the positions.
    ``trusted``: names of units that are taken as configured. None without
    accelerometers of two units or of an array. `CalibrationError` if they give too few
    values, or contradict each other.
    """
    force = block.acceleration
    everywhere = possible_units(config, block.z.shape[1])
    units = felt_units(block) if config.has_units else tuple(everywhere)
    if len(units) < 2 or force is None:
        return None
    whole, felt = (accelerometer_names(config, which) for which in (everywhere, units))
    names = tuple(name for name in felt if name not in config.excluded_channels)
    active = np.array([whole.index(name) for name in names])
    axes = nominal_axes(config)[active]
    most = np.broadcast_to(config.accelerometers.max_acceleration, len(whole))[active]
    delivered = force.delivered[:, active]
    data = prepare(Block(force.stamp, force.z[:, active], delivered), most)
    _check_amount(data, names)
    # All accelerometers of an array are sampled at one instant, as those of a unit are.
    of_unit = active // 3 if config.has_units else np.zeros_like(active)
    numbers, first, of = np.unique(of_unit, return_index=True, return_inverse=True)
    delay = np.zeros(len(active))
    if config.has_units:
        _check_forces(data.z, [config.imu_names[k] for k in numbers], of, axes)
        delay = delays_of(config, gyros)[active]
    arms = lever_arms(config, everywhere)[active]
    data.z = (data.z - _added(data, gyros, axes, arms, delay)) / FORCE.natural
    spiky = spikes(data.z, axes)
    data.z[spiky] = np.nan
    owners = [name.rpartition(".")[0] for name in names]
    known = [config.has_units and unit in trusted for unit in owners]
    priors = Priors(
        axes=axes,
        unit=of,
        units=len(numbers),
        scale_std=np.where(known, REFERENCE_STD, SCALE_STD),
        bias_std=max(config.accelerometers.turn_on_std / FORCE.natural, 1e-6),
        delay_std=UNIT_DELAY,
        delay=delay[first],
        rest=gyros.rest,
    )
    return Prepared(names, active, data, priors, spiky)


def nominal_axes(config: Config) -> Array:
    """Return the axes (n, 3) of all accelerometers, as configured.

    Without such settings, those of the gyros; of units as the nearest right angles: scale
    factors and misalignments of gyros are not those of accelerometers.
    """
    if config.accelerometers.axes:
        return np.reshape(config.accelerometers.axes, (-1, 3))
    axes = build_geometry(config).axes
    if not config.has_units:
        return axes
    u, _, v = np.linalg.svd(axes.reshape(-1, 3, 3))
    return np.asarray((u @ v).reshape(-1, 3))


def _added(
    data: Data, gyros: StateEstimate, axes: Array, arms: Array, delay: Array
) -> Array:
    """Return what the turning of the body adds to each value (N, n), m/s^2."""
    added = np.zeros_like(data.z)
    if not arms.any():
        return added
    turning = np.nan_to_num(turning_of(gyros)[0])
    seconds = gyros.blocks.seconds
    along = np.einsum("bac,nc,na->bn", turning, arms, axes)
    for i, values in enumerate(along.T):
        added[:, i] = np.interp(data.seconds - delay[i], seconds, values)
    return added


def _check_amount(data: Data, names: Sequence[str]) -> None:
    share = np.isfinite(data.z).mean(axis=0)
    if len(names) < 4:
        raise CalibrationError(
            f"{len(names)} accelerometers are in use, expected at least 4"
        )
    usual = float(np.median(share))
    if (least := float(share.min())) < LEAST_OF_USUAL * max(usual, LEAST_OF_USUAL):
        raise CalibrationError(
            f"{names[int(share.argmin())]} gives a usable value in {percent(least)} of the samples"
        )


def _check_forces(z: Array, units: Sequence[str], unit: Int, axes: Array) -> None:
    """Refuse units that do not measure one specific force: other units, or other axes.

    ``z`` (N, n), m/s^2, of channels in units (n,) with nominal axes (n, 3).
    """
    whole = [k for k in range(len(units)) if (unit == k).sum() == 3]
    rows = z[np.isfinite(z).all(axis=1)]
    if len(whole) < 2 or len(rows) < 1:
        return
    columns = [unit == k for k in whole]
    inverses = [np.linalg.inv(axes[own]) for own in columns]
    pairs = zip(columns, inverses, strict=True)
    forces = np.array([rows[:, own] @ inverse.T for own, inverse in pairs])
    sizes = np.linalg.norm(forces, axis=2)
    size = np.median(sizes, axis=1)
    units_there = range(len(size))
    others = np.array([np.median(np.delete(size, k)) for k in units_there])
    ratio = size / np.maximum(others, 1e-9)
    odd = int(np.abs(np.log(np.maximum(ratio, 1e-9))).argmax())
    name = units[whole[odd]]
    if not AGREEMENT.response < ratio[odd] < 1.0 / AGREEMENT.response:
        raise DisagreementError(
            f"the accelerometers of {name} measure {figures(ratio[odd])} times the specific force of the others: look"
            " at its unit (m/s^2), or name them in excluded_channels"
        )
    if IN_G[0] < np.median(size) < IN_G[1]:
        raise CalibrationError(
            f"the accelerometers measure {figures(np.median(size))} m/s^2 in the median,"
            " expected about 9.8: they are in g"
        )
    directions = forces / np.maximum(sizes, 1e-9)[:, :, None]
    cosine = np.median(np.einsum("jna,kna->jkn", directions, directions), axis=2)
    mean = (cosine.sum(axis=1) - 1.0) / (len(whole) - 1)
    odd = int(mean.argmin())
    nearest = np.max(np.delete(cosine[odd], odd))
    angle = float(np.arccos(np.clip(nearest, -1.0, 1.0)))
    if angle > LARGEST_TURN:
        raise DisagreementError(
            f"the accelerometers of {units[whole[odd]]} measure a specific force {np.degrees(angle):.0f} deg from"
            " that of the others, with the mount of their gyros: its axes are swapped or reversed in the driver"
        )


def fit_accelerometers(
    ready: Prepared,
    config: Config,
    without: Callable[[Data, tuple[str, ...]], Data] = lambda data, names: data,
    faults: tuple[Any, ...] = (),
) -> AccelerometerFit:
    """Estimate noise, biases, axes of the accelerometers.

    ``without`` leaves out the samples of the ``faults``, which were declared.
    """
    data = without(ready.data, ready.names)
    names = ready.names
    found = estimate(data, ready.priors)
    return AccelerometerFit(
        names=names,
        nominal=ready.priors.axes,
        estimate=_differences(_scaled(found), ready.priors.axes),
        unusable=data.unusable | {"spikes": np.asarray(ready.spiky.sum(axis=0))},
        settings=_settings(config, ready.active, found),
        faults=faults,
    )


def _scaled(found: StateEstimate) -> StateEstimate:
    """Return the estimate in m/s^2."""
    size = FORCE.natural
    floor = found.floor
    walk = found.bias_walk
    return replace(
        found,
        bias=found.bias * size,
        bias_covariance=found.bias_covariance * size**2,
        curve=found.curve * size,
        bias_walk=walk._replace(value=walk.value * size, possible=walk.possible * size),
        floor=replace(floor, std=floor.std * size, error=floor.error * size),
        moment=found.moment * size,
        rate=found.rate * size,
    )


def _differences(found: StateEstimate, nominal: Array) -> StateEstimate:
    """Return biases and axes without what all channels have in common.

    That common part is a specific force to the accelerometers, or a turn and scale of
    the body frame: no channel contradicts them.
    """
    apart = projector(found.axes)
    of_axes = np.kron(apart, np.eye(3))
    return replace(
        found,
        axes=nominal + apart @ (found.axes - nominal),
        axes_covariance=of_axes @ found.axes_covariance @ of_axes,
        bias=apart @ found.bias,
        bias_covariance=apart @ found.bias_covariance @ apart,
        curve=found.curve @ apart,
    )


def _settings(config: Config, active: Int, found: StateEstimate) -> dict[str, object]:
    """Return the changed parameters."""
    own = config.accelerometers
    axes = nominal_axes(config)
    n = len(axes)

    def changed(before: Sequence[float], new: Array | float) -> list[float]:
        """Replace the values of the channels in use, and give them back with 4 digits."""
        values = np.array(np.broadcast_to(before, n), dtype=float)
        values[active] = new
        return [float(f"{value:.4g}") + 0.0 for value in values]

    axes = axes.copy()
    axes[active] = found.axes
    # At least the nonlinearity of consumer accelerometers.
    scale = max(found.disagreement()[0], 0.002)
    settings: dict[str, object] = {
        "accelerometers.noise_std": changed(
            own.noise_std,
            np.maximum(found.noise_std * FORCE.natural, LEAST_NOISE_STD),
        ),
        "accelerometers.scale_std": changed(own.scale_std, scale),
        "accelerometers.bias": changed(own.bias or (0.0,), found.bias * FORCE.natural),
        "accelerometers.axes": [round(float(v), 6) + 0.0 for v in axes.ravel()],
    }
    walk = found.bias_walk.value * FORCE.natural
    # A bench shows less than a flight, where vibration moves the biases.
    if walk > max(own.bias_walk):
        settings["accelerometers.bias_walk"] = changed(own.bias_walk, walk)
    return settings
