# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A calibration checked on its own recording: normalised residuals by motion, and the false alarms they imply."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fdi_ros.calibration.data import Array, Mask
from fdi_ros.calibration.motion import Motion, motion_of
from fdi_ros.config.config import Config
from fdi_ros.core.channel_set import mask_of
from fdi_ros.model.block import Block
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.thresholds import normal_isf
from fdi_ros.monitor.build import alarm_probability
from fdi_ros.monitor.output import Output
from fdi_ros.monitor.pipeline import Pipeline

SLOW_RATE, SLOW_ACCELERATION = 0.5, 10.0
"""Slow motion stays below, rad/s and rad/s^2."""
VIOLENT_RATE, VIOLENT_ACCELERATION = 5.0, 60.0
"""Violent motion exceeds one of these, rad/s and rad/s^2."""
CLASSES = ("rest", "slow", "fast", "violent")
LOW, HIGH = 0.8, 1.25
"""Bounds within which a normalised residual is as expected."""


@dataclass(frozen=True)
class ClassCheck:
    """Samples of one class of motion."""

    name: str
    samples: int
    seconds: float
    normalised: Array
    """(n,) root mean square of the normalised residuals; expected 1."""
    residual: Array
    """(n,) root mean square of the residuals, rad/s."""
    largest: float
    """Largest |normalised residual|."""
    false_alarms: float
    """Per hour of such motion, from the root mean square over all channels, errors taken as normal."""
    alarms: int
    """Samples at which the configured detector gave alarm."""

    @property
    def overall(self) -> float:
        """Root mean square over all channels; NaN without samples."""
        return float(np.sqrt(np.mean(self.normalised**2))) if self.samples else math.nan


@dataclass(frozen=True)
class SelfCheck:
    """All classes, and the faults that the monitor declared in the recording."""

    classes: tuple[ClassCheck, ...]
    configured: float
    """False alarms per hour, as configured."""
    implied: float
    """Per hour of motion as in the recording."""
    declared: tuple[tuple[float, str], ...]
    """Faults that the pipeline declared: time s, and name with reason."""

    def of(self, name: str) -> ClassCheck:
        """Return the class of motion of a name."""
        return self.classes[CLASSES.index(name)]


def normalised_residuals(motion: Motion, geometry: Geometry, noise: NoiseModel, gain: Array) -> Array:
    """Residuals (N, n) over the standard deviations that the noise model gives them; gain (n, 3) of the rate."""
    projector = np.eye(geometry.n) - geometry.axes @ gain.T
    variance = noise.variance(geometry, motion.rate, motion.acceleration) @ (projector**2).T
    return np.asarray(motion.residual / np.sqrt(np.maximum(variance, 1e-300)))


def motion_class(rate: Array, acceleration: Array, rest: Mask) -> Array:
    """Class (N,) of each sample, index into CLASSES; rest (N,) is known already."""
    speed, turning = np.linalg.norm(rate, axis=1), np.linalg.norm(acceleration, axis=1)
    kind = np.where((speed > SLOW_RATE) | (turning > SLOW_ACCELERATION), 2, 1)
    kind[(speed > VIOLENT_RATE) | (turning > VIOLENT_ACCELERATION)] = 3
    kind[rest] = 0
    return np.asarray(kind)


def check(config: Config, block: Block, z: Array, rest: Mask, rows: Mask) -> SelfCheck:
    """Check a configuration on the recording it was made from, or on another one.

    Biases are those that the pipeline itself subtracted at the end, fixed or learned.

    Parameters
    ----------
    config
        As the node would run with it.
    block
        The recording, as the pipeline gets it.
    z
        (N, n) usable values of the channels, rad/s; NaN: not usable; a column of NaN: not in use.
    rest
        (N,) samples at rest.
    rows
        (N,) samples that count: complete and without a known fault.
    """
    pipeline = Pipeline.from_config(config)
    output = pipeline.process(block)
    geometry, noise = pipeline.geometry, pipeline.noise
    used = np.asarray(np.isfinite(z).any(axis=0))
    steady = z - np.array(pipeline.status().bias)
    motion = motion_of(block.stamp, steady, geometry, noise.noise_std, config.noise.acceleration_window)
    gain = pipeline.subsets["gain"][mask_of(np.flatnonzero(used)), : geometry.n]
    normalised = normalised_residuals(motion, geometry, noise, gain)[:, used]
    probability = alarm_probability(config)
    kind = motion_class(motion.rate, motion.acceleration, rest)
    step = float(np.median(np.diff(block.stamp))) * 1e-9
    classes = tuple(
        _class_check(name, rows & (kind == k), motion.residual[:, used], normalised, step, probability, output.alarm)
        for k, name in enumerate(CLASSES)
    )
    total = sum(c.seconds for c in classes)
    implied = sum(c.seconds * c.false_alarms for c in classes if c.samples) / max(total, step)
    declared = _declared(output, pipeline.channel_names, int(block.stamp[0]))
    return SelfCheck(classes, probability * 3600 / step, implied, declared)


def _declared(output: Output, names: Sequence[str], start: int) -> tuple[tuple[float, str], ...]:
    """Faults that were declared: time since the start, whose stamp is in ns, s, and name with reason."""
    return tuple(
        ((event.stamp - start) * 1e-9, f"{names[event.channel]} {event.reason.value}")
        for event in output.events
        if event.declares
    )


def _class_check(
    name: str, rows: Mask, residual: Array, normalised: Array, step: float, probability: float, alarm: Mask
) -> ClassCheck:
    n, count = residual.shape[1], int(rows.sum())
    if not count:
        empty = np.full(n, np.nan)
        return ClassCheck(name, 0, 0.0, empty, empty, math.nan, math.nan, 0)
    normalised, residual = normalised[rows], residual[rows]
    rms = np.sqrt(np.mean(normalised**2, axis=0))
    # The largest of n normal variables, by Bonferroni: exact to a percent this far out.
    threshold = normal_isf(probability / (2 * n))
    spread = float(np.sqrt(np.mean(rms**2)))
    implied = min(1.0, n * math.erfc(threshold / (spread * math.sqrt(2)))) * 3600 / step
    return ClassCheck(
        name,
        count,
        count * step,
        rms,
        np.sqrt(np.mean(residual**2, axis=0)),
        float(np.abs(normalised).max()),
        implied,
        int(alarm[rows].sum()),
    )
