"""Settings of the monitor from a calibration."""

from __future__ import annotations

import numpy as np

from fdi_ros.config import Config
from fdi_ros.monitor.build import build_geometry, build_noise
from fdi_ros.study.calibration_data import Array
from fdi_ros.study.calibration_noise import NoiseFit

LEAST_NOISE = 1e-9
"""What noise.noise_std may be at least, rad/s."""


def settings(config: Config, active: list[int], axes: Array, bias: Array, noise: NoiseFit) -> dict[str, object]:
    """Parameters to be changed; channels that are not in use keep what they have.

    Parameters
    ----------
    config
        As it was.
    active
        Numbers of the channels calibrated.
    axes, bias, noise
        Of these, (k, 3), (k,) rad/s.
    """
    all_axes = build_geometry(config).axes.copy()
    n = len(all_axes)
    all_axes[active] = axes
    all_bias = np.array(config.bias.fixed) if config.bias.fixed else np.zeros(n)
    all_bias[active] = bias
    before = build_noise(config, n)
    std, scale, timing = before.noise_std.copy(), before.scale_std.copy(), before.timing_std.copy()
    std[active], scale[active], timing[active] = np.maximum(noise.std, LEAST_NOISE), noise.scale, noise.timing
    return {
        "geometry.preset": "axes",
        "geometry.axes": _rounded(all_axes.ravel(), 6),
        "noise.noise_std": [float(f"{value:.4g}") for value in std],
        "noise.scale_std": _short(scale),
        "noise.timing_std": _short(timing),
        "bias.fixed": _rounded(all_bias, 7),
        "bias.startup_bias_duration": 0.0,
    }


def _rounded(values: Array, digits: int) -> list[float]:
    # Adding zero turns -0.0 into 0.0.
    return [round(float(value), digits) + 0.0 for value in values]


def _short(values: Array) -> list[float]:
    numbers = [float(f"{value:.4g}") for value in values]
    return numbers[:1] if len(set(numbers)) == 1 else numbers
