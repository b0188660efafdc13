# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Settings of the monitor from a calibration."""

from __future__ import annotations

import numpy as np

from fdi_ros.calibration.data import Array
from fdi_ros.calibration.estimate import Estimate, Task, skew
from fdi_ros.calibration.noise import NoiseFit
from fdi_ros.config.config import Config
from fdi_ros.monitor.build import build_geometry, build_noise
from fdi_ros.sources import source_of

LEAST_NOISE = 1e-9
"""What noise.noise_std may be at least, rad/s."""


REPLACED = ("imus.mounts", "geometry.cone_channels")
"""Parameters that say nothing any more beside geometry.axes."""


def settings(task: Task, active: list[int], estimate: Estimate, noise: NoiseFit, late: Array) -> dict[str, object]:
    """Parameters to be changed; channels that are not in use keep what they have.

    Parameters
    ----------
    task
        With the configuration as it was.
    active
        Numbers of the channels calibrated.
    estimate, noise
        Of these.
    late
        (k,) delays to be taken off, s.
    """
    config = task.config
    all_axes = build_geometry(config).axes.copy()
    n = len(all_axes)
    all_axes[active] = estimate.geometry.axes
    all_bias = np.array(config.bias.fixed) if config.bias.fixed else np.zeros(n)
    all_bias[active] = estimate.bias.mean
    before = build_noise(config, n)
    std, scale, timing = before.noise_std.copy(), before.scale_std.copy(), before.timing_std.copy()
    std[active], scale[active], timing[active] = np.maximum(noise.std, LEAST_NOISE), noise.scale, noise.timing
    changed: dict[str, object] = {
        "geometry.preset": "axes",
        "geometry.axes": _rounded(all_axes.ravel(), 6),
        "noise.noise_std": [float(f"{value:.4g}") for value in std],
        "noise.scale_std": _short(scale),
        "noise.timing_std": _short(timing),
        "bias.fixed": _rounded(all_bias, 7),
        "bias.startup_bias_duration": 0.0,
        # No single recording shows how biases differ from one start to the next.
        "bias.turn_on_std": config.bias.turn_on_std,
    }
    if estimate.bias.shown:
        walk = np.broadcast_to(np.array(config.noise.bias_walk), n).copy()
        walk[active] = estimate.bias.walk
        changed["noise.bias_walk"] = _short(walk)
    if source_of(config).stamped:
        changed["imus.delays"] = _delays(config, active, late)
        if (narrow := skew(task, late)) < config.imus.max_skew:
            changed["imus.max_skew"] = narrow
    return changed


def _delays(config: Config, active: list[int], late: Array) -> list[float]:
    """Delays of all units against the first, those that were taken off already included, s."""
    source = source_of(config)
    before = np.array(source.delays)
    found = np.zeros(len(before))
    found[[source.chip_of(channel) for channel in active]] = late
    total = before + found
    return _rounded(total - total[0], 6)


def _rounded(values: Array, digits: int) -> list[float]:
    # Adding zero turns -0.0 into 0.0.
    return [round(float(value), digits) + 0.0 for value in values]


def _short(values: Array) -> list[float]:
    numbers = [float(f"{value:.4g}") for value in values]
    return numbers[:1] if len(set(numbers)) == 1 else numbers
