"""Settings: frozen dataclasses, read from a ROS 2 parameter file, validated once, here.

The node and every offline command read the same file. Each field below is one ROS parameter, named
``<section>.<field>``; its unit, range and meaning stand beside it and are shown by ``ros2 param describe``.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from fdi_ros.errors import ConfigError
from fdi_ros.parameter import Parameter, Value, convert, read_parameter_file, setting


@dataclass(frozen=True)
class ChannelsConfig:
    """Input as one std_msgs/Float64MultiArray of all channels."""

    topic: str = setting("gyro_channels", "topic of the channels, one std_msgs/Float64MultiArray a sample")
    names: tuple[str, ...] = setting((), "name of each channel; empty: g1, g2, ... or imu_1.x, ...")


@dataclass(frozen=True)
class ImusConfig:
    """Input as one sensor_msgs/Imu topic per triad."""

    topics: tuple[str, ...] = setting((), "topic of each triad, 2 to 4")
    names: tuple[str, ...] = setting((), "name of each triad; empty: imu_1, imu_2, ...")
    mounts: tuple[float, ...] = setting(
        (), "mount rotations, 9 numbers a triad by rows: v_body = R v_imu; empty: identity", "", -1.001, 1.001
    )
    max_skew: float = setting(0.002, "stamps of two triads this close count as one instant", "s", 0.0, 1.0)
    timeout: float = setting(0.1, "a triad silent for this long is STALE; the rest goes on", "s", 0.001, 10.0)


@dataclass(frozen=True)
class GeometryConfig:
    """Sensitivity axes in the body frame."""

    preset: str = setting(
        "auto",
        "mounting; auto: axes if given, else the triads' mounts, else two_triad_cone",
        choices=("auto", "two_triad_cone", "dodecahedron", "cone", "axes", "triads"),
    )
    axes: tuple[float, ...] = setting((), "sensitivity axes, 3 numbers a channel, norm 0.5 to 2", "", -2.0, 2.0)
    cone_channels: int = setting(6, "number of channels of the cone preset", "", 4, 12)


@dataclass(frozen=True)
class NoiseConfig:
    """Error of a sound channel; one value, or one a channel."""

    noise_std: tuple[float, ...] = setting(
        (0.0025,), "standard deviation of the additive error in one sample", "rad/s", 1e-9, 10.0
    )
    scale_std: tuple[float, ...] = setting((0.0,), "standard deviation of the scale factor", "", 0.0, 1.0)
    timing_std: tuple[float, ...] = setting((0.0,), "standard deviation of the sampling instant", "s", 0.0, 1.0)
    bound: tuple[float, ...] = setting(
        (), "guaranteed limit of the error, for the guaranteed detector; empty: 4 noise_std", "rad/s", 1e-9, 100.0
    )
    acceleration_window: float = setting(
        0.01, "span over which the angular acceleration is taken, at least one sample", "s", 0.0, 1.0
    )


@dataclass(frozen=True)
class BiasConfig:
    """Bias subtracted before the channels are compared."""

    fixed: tuple[float, ...] = setting((), "bias of each channel; empty: zero", "rad/s", -10.0, 10.0)
    startup_bias_duration: float = setting(
        0.0, "average each channel over this long at rest at the start and subtract it; 0: off", "s", 0.0, 600.0
    )
    max_rest_rate: float = setting(
        0.1, "not at rest if the mean of a channel over that time exceeds this", "rad/s", 1e-6, 10.0
    )


@dataclass(frozen=True)
class DetectorConfig:
    """The detector and its options; each detector takes those it knows."""

    name: str = setting("likelihood_ratio", "name of the detector", runtime=True)
    false_alarms_per_hour: float = setting(
        0.001, "alarms on sound channels per hour of samples; 0: use the probability", "1/h", 0.0, 3.6e6, runtime=True
    )
    false_alarm_probability: float = setting(
        0.0, "alarms on sound channels per sample; 0: use the rate per hour", "", 0.0, 0.5, runtime=True
    )
    confidence: float = setting(
        0.999, "likelihood_ratio: confidence at which a rival explanation is ruled out", "", 0.5, 0.999999, runtime=True
    )
    tolerance: str = setting(
        "calibrated",
        "residual searches: the paper's tolerance (8), or one derived from the false-alarm rate",
        choices=("paper", "calibrated"),
        runtime=True,
    )
    construction: str = setting("svd", "projector: construction", choices=("svd", "qr"), runtime=True)
    norm: str = setting("l2", "projector: norm of the error estimate", choices=("l2", "l1"), runtime=True)
    criterion: str = setting(
        "determinant", "determinant: criterion", choices=("determinant", "condition_number"), runtime=True
    )
    max_faults: int = setting(2, "guaranteed: faulty channels at most", "", 0, 2, runtime=True)
    threshold: float = setting(
        10.0, "guaranteed: declared beyond this many bounds of certain error", "", 1e-6, 1e6, runtime=True
    )
    shift: float = setting(
        0.5, "cusum: shift of a normalised residual to be found fastest", "sigma", 0.05, 3.0, runtime=True
    )
    run_length: float = setting(
        0.0, "cusum: samples to a false alarm; 0: from false_alarms_per_hour", "samples", 0.0, 1e15, runtime=True
    )


@dataclass(frozen=True)
class HealthConfig:
    """Checks of each channel by itself."""

    max_rate: tuple[float, ...] = setting(
        (34.9,), "a value beyond this is out of range (saturated); one, or one a channel", "rad/s", 1e-3, 1e4
    )
    range_recovery_time: float = setting(
        0.1, "after a value out of range, alarms do not count towards a declaration for this long", "s", 0.0, 10.0
    )
    non_finite_time: float = setting(0.1, "faulty when nothing but NaN or infinity for this long", "s", 0.0, 60.0)
    stuck_time: float = setting(
        0.2, "faulty when the value repeats for this long against motion that the others see; 0: off", "s", 0.0, 60.0
    )
    stuck_time_at_rest: float = setting(
        10.0, "stale when the value repeats for this long without motion; 0: off", "s", 0.0, 86400.0
    )
    stale_timeout: float = setting(0.1, "stale when a channel gives nothing for this long", "s", 0.001, 60.0)


@dataclass(frozen=True)
class DecisionConfig:
    """From alarms to declarations."""

    confirm_alarms: int = setting(4, "alarms on the same suspects that confirm a fault", "samples", 1, 1000)
    confirm_window: int = setting(8, "the last samples among which those alarms count", "samples", 1, 1000)
    latch: bool = setting(True, "a declared fault stays until reset; false: returns after clean_time")
    clean_time: float = setting(5.0, "time without disagreement after which a channel returns", "s", 0.01, 3600.0)


@dataclass(frozen=True)
class IntegrityConfig:
    """Protection level of the fused rate."""

    risk: float = setting(
        1e-7, "allowed probability at one sample of an unnoticed error above the level; 0: no level", "", 0.0, 0.1
    )
    fault_rate: tuple[float, ...] = setting((1e-4,), "faults of a channel; one, or one a channel", "1/h", 0.0, 1.0)
    exposure: float = setting(1.0, "time for which a fault may have gone unnoticed", "h", 1e-6, 1e3)
    max_rate: float = setting(2.0, "body rate up to which the level holds", "rad/s", 0.0, 100.0)
    max_acceleration: float = setting(20.0, "angular acceleration up to which it holds", "rad/s^2", 0.0, 1e4)


@dataclass(frozen=True)
class Config:
    """All settings of one monitor."""

    input: str = setting("channels", "what arrives", choices=("channels", "imus"))
    body_frame: str = setting("base_link", "frame_id of the fused rate")
    hardware_id: str = setting("gyros", "hardware_id in the diagnostics")
    sample_rate: float = setting(100.0, "nominal rate of the samples", "Hz", 0.1, 1e5)
    excluded_channels: tuple[str, ...] = setting((), "channels taken out by the operator", runtime=True)
    channels: ChannelsConfig = field(default_factory=ChannelsConfig)
    imus: ImusConfig = field(default_factory=ImusConfig)
    geometry: GeometryConfig = field(default_factory=GeometryConfig)
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    bias: BiasConfig = field(default_factory=BiasConfig)
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    health: HealthConfig = field(default_factory=HealthConfig)
    decision: DecisionConfig = field(default_factory=DecisionConfig)
    integrity: IntegrityConfig = field(default_factory=IntegrityConfig)

    @classmethod
    def from_parameters(cls, parameters: Mapping[str, Any]) -> Config:
        """Build from ``{"section.field": value}``; what is not given keeps its default.

        Raises
        ------
        ConfigError
            If a parameter is unknown, of the wrong type or out of its range, or two contradict each other.
        """
        sections: dict[str, dict[str, Any]] = {}
        for name, value in parameters.items():
            if name not in PARAMETERS:
                raise ConfigError(f"unknown parameter {name!r}{_nearest(name)}")
            section, _, key = name.rpartition(".")
            sections.setdefault(section, {})[key] = convert(PARAMETERS[name], value)
        top = sections.pop("", {})
        nested = {name: _SECTIONS[name](**values) for name, values in sections.items()}
        config = cls(**top, **nested)
        _check_consistency(config)
        return config

    @classmethod
    def from_file(cls, path: str | Path, overrides: Mapping[str, Any] | None = None) -> Config:
        """Read a ROS 2 parameter file; overrides ``{"section.field": value}`` win over it.

        Raises
        ------
        ConfigError
            If the file is missing, is no parameter file, or holds a bad parameter.
        """
        return cls.from_parameters({**read_parameter_file(path), **(overrides or {})})

    def parameters(self) -> dict[str, Value]:
        """All settings as ``{"section.field": value}``."""
        flat = {}
        for name in PARAMETERS:
            section, _, key = name.rpartition(".")
            flat[name] = getattr(getattr(self, section) if section else self, key)
        return flat

    def replaced(self, changes: Mapping[str, Any]) -> Config:
        """Return a copy with some parameters changed, validated as a whole."""
        return Config.from_parameters({**self.parameters(), **changes})

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels; for the channels input without names: empty, the geometry numbers them."""
        if self.channels.names or self.input == "channels":
            return self.channels.names
        return tuple(f"{imu}.{axis}" for imu in self.imu_names for axis in "xyz")

    @property
    def imu_names(self) -> tuple[str, ...]:
        """Names of the triads."""
        return self.imus.names or tuple(f"imu_{k + 1}" for k in range(len(self.imus.topics)))

    @property
    def topics(self) -> tuple[str, ...]:
        """The input topics."""
        return (self.channels.topic,) if self.input == "channels" else self.imus.topics


_SECTIONS: dict[str, type] = {
    "channels": ChannelsConfig,
    "imus": ImusConfig,
    "geometry": GeometryConfig,
    "noise": NoiseConfig,
    "bias": BiasConfig,
    "detector": DetectorConfig,
    "health": HealthConfig,
    "decision": DecisionConfig,
    "integrity": IntegrityConfig,
}
_KINDS = {"tuple[float, ...]": "floats", "tuple[str, ...]": "strs"}


def _parameters_of(section: str, owner: type) -> list[Parameter]:
    parameters = []
    for f in fields(owner):
        if "description" in f.metadata:
            name = f"{section}.{f.name}" if section else f.name
            default: Any = f.default
            parameters.append(Parameter(name, _KINDS.get(str(f.type), str(f.type)), default, **f.metadata))
    return parameters


PARAMETERS: dict[str, Parameter] = {
    parameter.name: parameter
    for section, owner in (("", Config), *_SECTIONS.items())
    for parameter in _parameters_of(section, owner)
}
"""Every parameter by its full name, in the order of the file."""


def _nearest(name: str) -> str:
    close = difflib.get_close_matches(name, PARAMETERS, n=1)
    return f", did you mean {close[0]!r}?" if close else f", expected one of: {', '.join(PARAMETERS)}"


_TOPIC = re.compile(r"[~/]?[A-Za-z_/~{][A-Za-z0-9_/{}]*")


def _check_consistency(config: Config) -> None:
    _check_topics(config)
    if len(config.geometry.axes) % 3:
        raise ConfigError(f"geometry.axes has {len(config.geometry.axes)} numbers, expected 3 a channel")
    learned = config.bias.startup_bias_duration * config.sample_rate
    if 0 < learned < 10:
        raise ConfigError(
            f"bias.startup_bias_duration is {config.bias.startup_bias_duration:g} s, {learned:.1f} samples at"
            f" {config.sample_rate:g} Hz, expected at least 10 samples"
        )
    if config.decision.confirm_alarms > config.decision.confirm_window:
        raise ConfigError(
            f"decision.confirm_alarms is {config.decision.confirm_alarms},"
            f" expected at most decision.confirm_window {config.decision.confirm_window}"
        )
    if config.detector.false_alarms_per_hour == 0 and config.detector.false_alarm_probability == 0:
        raise ConfigError("detector.false_alarms_per_hour and detector.false_alarm_probability are both 0: give one")


def _check_topics(config: Config) -> None:
    for topic in config.topics:
        if not _TOPIC.fullmatch(topic):
            raise ConfigError(f"topic {topic!r} is no ROS name: expected letters, digits, _ and /, no digit first")
    if config.input == "imus":
        count = len(config.imus.topics)
        if not 2 <= count <= 4:
            raise ConfigError(f"imus.topics has {count} topics, expected 2 to 4")
        if len(set(config.imus.topics)) != count:
            raise ConfigError(f"imus.topics repeats a topic: {', '.join(config.imus.topics)}")
        if len(config.imus.names) not in (0, count):
            raise ConfigError(f"imus.names has {len(config.imus.names)} names for {count} topics")
        if len(config.imus.mounts) not in (0, 9 * count):
            raise ConfigError(f"imus.mounts has {len(config.imus.mounts)} numbers, expected 9 a triad: {9 * count}")
