# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The parts of a monitor from its settings: geometry, noise, detector, and the record of the sample path."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import allocate
from fdi_ros.config.config import Config, check_lengths
from fdi_ros.core.alignment import MAX_STAMP
from fdi_ros.core.bias import EFFICIENCY, FIXED, LEARNING, prepare_limits
from fdi_ros.core.decision import RETURN_MEAN
from fdi_ros.core.records import Core
from fdi_ros.core.sensors import describe_sensors
from fdi_ros.core.sources import source_of
from fdi_ros.core.states import REASONS, ChannelState, Reason
from fdi_ros.core.subsets import mask_of
from fdi_ros.detectors import create_detector, detector_class
from fdi_ros.detectors.base import Detector, accepted_options
from fdi_ros.errors import ConfigError
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import MAX_RUN_LENGTH, FalseAlarmRate, NoiseModel, normal_isf
from fdi_ros.model.quantity import RATE, Quantity

UNIT_DELAY, CHANNEL_DELAY = 0.015, 0.001
"""Prior standard deviation of the delay between two units, s: for units with stamps of
their own, and for channels that arrive in one message."""
BOUND_IN_NOISE = 4.0  # default guaranteed bound, in noise_std. White noise exceeds the bound in 6e-5 of samples
# at rest the standard deviation of a channel is at most this many noise_std
REST_NOISE = 4.0
# chance that a healthy channel disagrees in one sample while returning
RETURN_PROBABILITY = 1e-6


def build_geometry(config: Config) -> Geometry:
    """Sensitivity axes of a configuration.

    Raise `FdiError` if axes, names and topics contradict each other.
    """
    geometry = _axes(config)
    source_of(config).check_channels(geometry.n)
    units = config.channels.units
    if units and config.has_units:
        raise ConfigError(
            "channels.units is given, but input is 'imus': each topic is a unit"
        )
    if units and len(units) != geometry.n:
        raise ConfigError(
            f"channels.units has {len(units)} names, expected {geometry.n}, one for each channel"
        )
    # Some presets consist of triads. Names with a point show triads, too.
    if (
        not config.has_units
        and not any("." in name for name in config.channel_names)
        and geometry.units
    ):
        units = units or geometry.unit_of
    return Geometry(geometry.axes, config.channel_names or None, units or None)


def build_noise(config: Config, n: int) -> NoiseModel:
    """Error model of a configuration.

    A bias averaged at the start is known as well as white noise allows.
    """
    noise = config.noise
    std = np.array(noise.noise_std)
    bound = np.array(noise.bound) if noise.bound else BOUND_IN_NOISE * std
    averaged = EFFICIENCY * config.bias.startup_bias_duration * config.sample_rate
    bias_std = std / np.sqrt(max(averaged, 1.0)) if averaged > 0 else 0.0 * std
    values = (
        std,
        np.array(noise.scale_std),
        np.array(noise.timing_std),
        bound,
        bias_std,
        np.array(noise.nonlinearity_std),
    )
    return NoiseModel(*map(np.squeeze, values)).for_channels(n)


def alarm_probability(config: Config) -> float:
    """False-alarm probability per sample that a configuration asks for."""
    return _false_alarm_rate(config).per_sample()


def _false_alarm_rate(config: Config, by_run_length: bool = False) -> FalseAlarmRate:
    """Of what the settings state the first: a run length, if the detector takes one, a probability, a rate per hour."""
    settings = config.detector
    rate = config.sample_rate
    if by_run_length and settings.run_length > 0:
        return FalseAlarmRate(run_length=settings.run_length, sample_rate=rate)
    if settings.false_alarm_probability > 0:
        return FalseAlarmRate(
            false_alarm_probability=settings.false_alarm_probability, sample_rate=rate
        )
    return FalseAlarmRate(
        false_alarms_per_hour=settings.false_alarms_per_hour, sample_rate=rate
    )


_RATES = {"false_alarms_per_hour", "false_alarm_probability", "run_length"}
"""Options in which one false-alarm rate is stated."""


GUARD = "sequential"
"""Name of the detector that keeps the estimator of the errors of the sensors, whichever method declares."""


def build_guard(
    config: Config, geometry: Geometry, noise: NoiseModel, quantity: Quantity = RATE
) -> Detector:
    """Detector that keeps the estimator, for channels that measure a quantity."""
    detector = config.detector
    if detector.name != GUARD and detector.false_alarm_probability > 0:
        # Another method may be asked for rarer alarms than any run length states.
        rarest = max(detector.false_alarm_probability, 1.0 / MAX_RUN_LENGTH)
        config = config.replaced({"detector.false_alarm_probability": rarest})
    return _build(GUARD, config, geometry, noise, quantity)


def build_detector(config: Config, geometry: Geometry, noise: NoiseModel) -> Detector:
    """Detector that declares, by a configuration.

    A method other than `GUARD` is given corrected values, and the noise of the moment with what is not known of scale
    and timing (`judge_corrected`): it is built for the additive noise alone.
    """
    if config.detector.name != GUARD:
        noise = NoiseModel(
            noise.noise_std, bound=noise.bound, bias_std=noise.bias_std
        ).for_channels(geometry.n)
    return _build(config.detector.name, config, geometry, noise)


def _build(
    name: str,
    config: Config,
    geometry: Geometry,
    noise: NoiseModel,
    quantity: Quantity = RATE,
) -> Detector:
    """Build a detector by name, with the options that it takes."""
    settings = config.detector
    accepted = accepted_options(detector_class(name))
    known = {field.name for field in fields(settings)} - _RATES
    options: dict[str, Any] = {
        option: getattr(settings, option) for option in accepted if option in known
    }
    delay_std = UNIT_DELAY if source_of(config).stamped else CHANNEL_DELAY
    turn_on_std = config.bias.turn_on_std
    errors = {
        "bias_walk": config.noise.bias_walk,
        "turn_on_std": turn_on_std,
        "bias_move": quantity.bias_move * turn_on_std,
        "rectified": quantity.rectified if turn_on_std > 0.0 else 0.0,
        # With a turn-on error of 0 the biases are known, and stay so.
        "largest_move": quantity.largest_move if turn_on_std > 0.0 else 0.0,
        "shared_scale_std": config.noise.shared_scale_std,
        "g_sensitivity_std": config.noise.g_sensitivity_std,
        "delay_std": delay_std,
        "gain_is_fault": quantity.gain_is_fault,
        "louder": quantity.louder,
    }
    options |= {option: value for option, value in errors.items() if option in accepted}
    # The paper's tolerance keeps no false-alarm rate, and refuses to be given one.
    if options.get("tolerance") != "paper":
        options |= _false_alarm_rate(config, "run_length" in accepted).as_options(
            accepted
        )
    return create_detector(name, geometry, noise, **options)


def build_core(config: Config, geometry: Geometry, noise: NoiseModel) -> NDArray[Any]:
    """Record of a monitor before its first sample, (1,) `Core`.

    Raise `ConfigError` if a setting has a wrong length.
    """
    n = geometry.n
    check_lengths(config, "channel", n)
    cores = allocate(Core)
    core = cores[0]
    _fill_settings(core["settings"], config, geometry, noise)
    _fill_bias(core["bias"], config, noise)
    core["remaining"][:n] = noise.bias_std
    core["sample"]["bias_std"][:n] = (
        noise.bias_std if core["bias"]["learning"] else config.bias.turn_on_std
    )
    core["last_stamp"] = -MAX_STAMP
    core["acceleration"]["window"] = _nanoseconds(config.noise.acceleration_window)
    core["state"][:n], core["reason"][:n] = (
        ChannelState.UNCHECKED,
        REASONS.index(Reason.NO_DATA),
    )
    return cores


def suit_detector(core: NDArray[Any], config: Config, detector: Detector) -> None:
    """Set in core (1,) all settings that may change at run time: rule of decision, estimation, withholding."""
    settings = core["settings"]
    rule = config.decision.rule
    settings["publish_under_doubt"] = config.publish_under_doubt
    settings["guard_declares"] = detector.name == GUARD
    settings["by_evidence"] = rule == "evidence" or (
        rule == "auto" and detector.name == GUARD
    )


def _fill_settings(
    settings: Any, config: Config, geometry: Geometry, noise: NoiseModel
) -> None:
    n = geometry.n
    integrity = config.integrity
    settings["n"] = n
    settings["natural"] = RATE.natural
    settings["period"] = 1.0 / config.sample_rate
    describe_sensors(settings["sensors"], geometry, noise)
    settings["largest_noise"] = noise.noise_std.max()
    settings["return_limit"] = normal_isf(RETURN_PROBABILITY / 2)
    settings["turn_on_std"] = config.bias.turn_on_std
    settings["learned"][:n] = noise.bias_std
    settings["max_drift"] = config.bias.max_drift
    settings["risk"] = integrity.risk
    settings["prior"][:n] = np.expm1(
        np.array(integrity.fault_rate) * integrity.exposure
    )
    settings["reach"] = normal_isf(integrity.risk / 2) if integrity.risk > 0 else 0.0
    settings["units"] = len(geometry.units)
    settings["members"][: len(geometry.units)] = [
        mask_of(unit) for unit in geometry.units
    ]
    health = config.health
    decision = config.decision
    settings["max_rate"][:n] = health.max_rate
    settings["non_finite_time"] = _nanoseconds(health.non_finite_time)
    settings["stuck_time"] = _nanoseconds(health.stuck_time)
    settings["frozen_time"] = _nanoseconds(health.stuck_time_at_rest)
    settings["stale_time"] = _nanoseconds(config.stale_timeout)
    settings["recovery_time"] = _nanoseconds(health.range_recovery_time)
    settings["alarms"] = decision.confirm_alarms
    settings["window"] = decision.confirm_window
    settings["latch"], settings["clean_time"] = (
        decision.latch,
        _nanoseconds(decision.clean_time),
    )
    settings["mean_limit"][:n] = RETURN_MEAN * noise.noise_std


def _fill_bias(bias: Any, config: Config, noise: NoiseModel) -> None:
    n = len(noise.noise_std)
    fixed = config.bias.fixed
    learning = config.bias.startup_bias_duration > 0
    bias["given"] = bool(fixed)
    bias["value"][:n] = bias["centre"][:n] = fixed or 0.0
    bias["channels_known"] = mask_of(range(n))
    bias["duration"] = _nanoseconds(config.bias.startup_bias_duration)
    bias["max_rate"] = config.bias.max_rest_rate
    prepare_limits(bias)
    bias["max_std"][:n] = REST_NOISE * noise.noise_std
    bias["learning"] = learning
    bias["outcome"] = LEARNING if learning else FIXED


def _nanoseconds(seconds: float) -> int:
    return round(seconds * 1e9)


def _axes(config: Config) -> Geometry:
    preset = config.geometry.preset
    if preset == "auto":
        preset = (
            "axes"
            if config.geometry.axes
            else "triads"
            if config.has_units
            else "two_triad_cone"
        )
    if preset == "axes":
        if not config.geometry.axes:
            raise ConfigError("geometry.preset is 'axes', but geometry.axes is empty")
        return Geometry(np.reshape(config.geometry.axes, (-1, 3)))
    if preset == "triads":
        if not (source := source_of(config)).units:
            raise ConfigError(
                f"geometry.preset is 'triads', expected input 'imus', got {config.input!r}"
            )
        return Geometry.from_triads(source.mounts)
    if preset == "cone":
        return Geometry.cone(config.geometry.cone_channels)
    return (
        Geometry.dodecahedron()
        if preset == "dodecahedron"
        else Geometry.two_triad_cone()
    )
