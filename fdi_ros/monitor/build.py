"""From settings to the parts: axes, error model, detector. The only place that reads those sections."""

from __future__ import annotations

from typing import Any

import numpy as np

from fdi_ros.config import Config
from fdi_ros.detectors import Detector, accepted_options, create_detector, detector_class
from fdi_ros.errors import ConfigError
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.thresholds import false_alarm_probability

BOUND_IN_NOISE = 4.0
"""Default guaranteed bound, in noise_std: white noise exceeds it in 6e-5 of samples."""


def build_geometry(config: Config) -> Geometry:
    """Sensitivity axes of a configuration.

    Raises
    ------
    ConfigError
        If the number of axes, names and topics do not fit each other.
    GeometryError
        If the axes themselves are unfit.
    """
    geometry = _axes(config)
    if config.input == "imus" and geometry.n != 3 * len(config.imus.topics):
        raise ConfigError(
            f"geometry has {geometry.n} channels, expected 3 a topic: {3 * len(config.imus.topics)}"
            f" for {len(config.imus.topics)} imus.topics"
        )
    return Geometry(geometry.axes, config.channel_names or None)


def build_noise(config: Config, n: int) -> NoiseModel:
    """Error model of a configuration, one value a channel.

    A bias averaged at start-up is known no better than white noise lets the average be.
    """
    noise = config.noise
    std = np.array(noise.noise_std)
    bound = np.array(noise.bound) if noise.bound else BOUND_IN_NOISE * std
    averaged = config.bias.startup_bias_duration * config.sample_rate
    bias_std = std / np.sqrt(max(averaged, 1.0)) if averaged > 0 else 0.0 * std
    values = (std, np.array(noise.scale_std), np.array(noise.timing_std), bound, bias_std)
    return NoiseModel(*(_scalar(value) for value in values)).for_channels(n)


def alarm_probability(config: Config) -> float:
    """False-alarm probability per sample that a configuration asks for."""
    given = config.detector.false_alarm_probability
    per_hour = config.detector.false_alarms_per_hour if given == 0 else None
    return false_alarm_probability(given if given > 0 else None, per_hour, config.sample_rate)


def build_detector(config: Config, geometry: Geometry, noise: NoiseModel) -> Detector:
    """Detector of a configuration, with those of the options that it knows."""
    settings = config.detector
    probability = settings.false_alarm_probability
    options: dict[str, Any] = {
        "false_alarm_probability": probability if probability > 0 else None,
        "false_alarms_per_hour": settings.false_alarms_per_hour if probability == 0 else None,
        "sample_rate": config.sample_rate,
    }
    for name in ("confidence", "tolerance", "construction", "norm", "criterion", "max_faults", "threshold"):
        options[name] = getattr(settings, name)
    accepted = accepted_options(detector_class(settings.name))
    options["shift"] = settings.shift
    if "run_length" in accepted and settings.run_length > 0:
        options |= {"run_length": settings.run_length, "false_alarms_per_hour": None}
    elif "run_length" in accepted and probability > 0:
        options |= {"run_length": 1 / probability, "false_alarms_per_hour": None}
    return create_detector(settings.name, geometry, noise, **{k: v for k, v in options.items() if k in accepted})


def _axes(config: Config) -> Geometry:
    preset = config.geometry.preset
    if preset == "auto":
        preset = "axes" if config.geometry.axes else "triads" if config.input == "imus" else "two_triad_cone"
    if preset == "axes":
        if not config.geometry.axes:
            raise ConfigError("geometry.preset is 'axes', but geometry.axes is empty")
        return Geometry(np.reshape(config.geometry.axes, (-1, 3)))
    if preset == "triads":
        if config.input != "imus":
            raise ConfigError(f"geometry.preset is 'triads', expected input 'imus', got {config.input!r}")
        mounts = config.imus.mounts or tuple(np.eye(3).ravel()) * len(config.imus.topics)
        return Geometry.from_triads(list(np.reshape(mounts, (-1, 3, 3))))
    if preset == "cone":
        return Geometry.cone(config.geometry.cone_channels)
    return Geometry.dodecahedron() if preset == "dodecahedron" else Geometry.two_triad_cone()


def _scalar(values: np.ndarray[Any, np.dtype[np.float64]]) -> Any:
    return values[0] if len(values) == 1 else values
