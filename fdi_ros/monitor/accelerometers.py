# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The settings of the accelerometers as those of a monitor of its own.

A specific force is divided by its natural size as it enters, and so are the settings of
its errors here. Everything else (mounts, topics, detector, decision, integrity) is that
of the gyros.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from fdi_ros.config.config import PARAMETERS, Config, check_lengths
from fdi_ros.config.settings import Value
from fdi_ros.model.quantity import FORCE
from fdi_ros.model.samples import Array, Block

#: specific force and its change for which the level after one more loss is foretold,
#: m/s^2 and m/s^3
FORETOLD_FORCE, FORETOLD_CHANGE = 20.0, 200.0
#: standard deviation of a position along an axis where none is given, m: units of a
#: vehicle are up to 10 cm apart
UNKNOWN_POSITION = 0.05


def possible_units(config: Config, gyros: int) -> range:
    """Numbers of all units whose accelerometers may be judged, beside a number of gyros.

    An accelerometer of an array is a unit by itself.
    """
    if config.accelerometers.enabled == "off":
        return range(0)
    if config.has_units:
        return range(len(config.topics))
    count = len(config.accelerometers.axes) // 3 or gyros
    return range(count if config.has_force_array else 0)


def places(config: Config, units: Sequence[int]) -> list[int]:
    """Return the number of each accelerometer of some units among all of a sample."""
    each = 3 if config.has_units else 1
    return [each * unit + k for unit in units for k in range(each)]


def accelerometer_names(config: Config, units: Sequence[int]) -> tuple[str, ...]:
    """Names of the accelerometers of some units: ``imu_1.accel_x``; of an array ``a1``."""
    if not config.has_units:
        return tuple(f"a{unit + 1}" for unit in units)
    names = config.imu_names
    return tuple(f"{names[unit]}.accel_{axis}" for unit in units for axis in "xyz")


def possible_names(config: Config, gyros: Sequence[str]) -> tuple[str, ...]:
    """Names of the gyros and of all accelerometers that the settings allow."""
    units = possible_units(config, len(gyros))
    return (*gyros, *accelerometer_names(config, units))


def check_accelerometers(config: Config, gyros: int) -> None:
    """Check the lengths of lists with values per accelerometer (`ConfigError`)."""
    units = possible_units(config, gyros)
    if units:
        check_lengths(config, "accelerometer", len(places(config, units)))
        check_lengths(config, "place", len(units))


def accelerometer_config(config: Config, units: Sequence[int]) -> Config:
    """Return the settings of the accelerometers of some units, numbers from 0, in units of `FORCE.natural`."""
    own = config.accelerometers
    chosen = places(config, units)

    def of_channels(values: Sequence[Any]) -> tuple[Any, ...]:
        """Pick the values of the channels, where there is one for each."""
        return tuple(values[i] for i in chosen) if len(values) > 1 else tuple(values)

    def scaled(values: Sequence[float]) -> tuple[float, ...]:
        return tuple(value / FORCE.natural for value in of_channels(values))

    own_section = (n for n in PARAMETERS if n.startswith("accelerometers."))
    names = accelerometer_names(config, units)
    changes: dict[str, Value] = {
        **{name: PARAMETERS[name].default for name in own_section},
        "accelerometers.enabled": "off",
        "excluded_channels": tuple(
            name for name in config.excluded_channels if name in names
        ),
        "channels.names": names,
        "noise.noise_std": scaled(own.noise_std),
        "noise.scale_std": of_channels(own.scale_std),
        "noise.bias_walk": scaled(own.bias_walk),
        # Asymmetry under gravity, which lasts, looks like a bias.
        "noise.nonlinearity_std": (0.0,),
        "noise.shared_scale_std": 0.0,
        "noise.g_sensitivity_std": 0.0,
        "noise.bound": (),
        "bias.turn_on_std": own.turn_on_std / FORCE.natural,
        "bias.max_drift": own.max_drift / FORCE.natural,
        "health.max_rate": scaled(own.max_acceleration),
        "integrity.max_rate": FORETOLD_FORCE / FORCE.natural,
        "integrity.max_acceleration": FORETOLD_CHANGE / FORCE.natural,
        "bias.fixed": scaled(own.bias),
        # Accelerometers are never at rest.
        "bias.startup_bias_duration": 0.0,
        **(_unit_settings if config.has_units else _array_settings)(config, units),
    }
    return config.replaced(changes)


def _unit_settings(config: Config, units: Sequence[int]) -> dict[str, Value]:
    """Return what the accelerometers have in common with the gyros of their units."""
    imus = config.imus
    noise = config.noise
    chosen = places(config, units)
    axes = config.accelerometers.axes

    def of_channels(values: Sequence[float]) -> tuple[float, ...]:
        return tuple(values[i] for i in chosen) if len(values) > 1 else tuple(values)

    def of_units(values: Sequence[Any], each: int = 1) -> tuple[Any, ...]:
        """Pick the values of the units, where there are any."""
        if not values:
            return ()
        return tuple(x for u in units for x in values[each * u : each * (u + 1)])

    return {
        "imus.topics": of_units(imus.topics),
        "imus.names": of_units(config.imu_names),
        "imus.mounts": of_units(imus.mounts, 9),
        "imus.delays": of_units(imus.delays),
        "geometry.axes": of_units(axes or config.geometry.axes, 9),
        "geometry.preset": "axes" if axes else config.geometry.preset,
        "noise.timing_std": of_channels(noise.timing_std),
        "integrity.fault_rate": of_channels(config.integrity.fault_rate),
    }


def _array_settings(config: Config, units: Sequence[int]) -> dict[str, Value]:
    """Return the settings of an array of accelerometers; those without axes of their own stand as the gyros do."""
    axes = config.accelerometers.axes
    changes: dict[str, Value] = {
        "channels.topic": config.channels.acceleration_topic,
        "channels.acceleration_topic": "",
        "noise.timing_std": (max(config.noise.timing_std),),
        "integrity.fault_rate": (max(config.integrity.fault_rate),),
    }
    if axes:
        changes |= {
            "geometry.preset": "axes",
            "geometry.axes": axes,
            "channels.units": (),
        }
    return changes


def lever_arms(config: Config, units: Sequence[int]) -> Array:
    """Position of each accelerometer of some units from the first unit, (m, 3) m."""
    each = 3 if config.has_units else 1
    positions = np.reshape(config.accelerometers.positions, (-1, 3))
    if not len(positions):
        return np.zeros((each * len(units), 3))
    return np.repeat(positions[list(units)], each, axis=0)


def position_std(config: Config, units: Sequence[int]) -> Array:
    """Return the standard deviation of the position of each accelerometer along an axis, (m,) m.

    Positions are counted from the first place, whose own is known.
    """
    own = config.accelerometers
    each = 3 if config.has_units else 1
    std = own.position_std or (0.0 if own.positions else UNKNOWN_POSITION,)
    of_units = [0.0 if unit == 0 else std[unit % len(std)] for unit in units]
    return np.repeat(np.array(of_units), each)


def felt_units(block: Block) -> tuple[int, ...]:
    """Return the units whose accelerometers are to be judged: all but those that give rates without accelerations.

    A unit that has given nothing yet is among them. None are, if no unit gives
    accelerations, or they are the same in all of several samples: some drivers and
    simulations fill in a constant.
    """
    force = block.acceleration
    if force is None or (len(block) > 1 and not varies(force.z)):
        return ()
    felt = _delivering(force)
    heard = _delivering(block)
    units = range(block.z.shape[1] // 3)
    return tuple(unit for unit in units if unit in felt or unit not in heard)


def varies(values: Array) -> bool:
    """Whether any column of values (k, m) has two that differ; NaN are left out."""
    columns = (column[~np.isnan(column)] for column in values.T)
    return any(len(np.unique(column)) > 1 for column in columns)


def _delivering(block: Block) -> set[int]:
    """Numbers of the units that delivered a value."""
    return {int(i) // 3 for i in np.flatnonzero(block.delivered.any(axis=0))}
