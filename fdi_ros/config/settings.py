# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Fields with type and range, and the settings of a monitor, which are such fields.

Parameters of the node, settings of a Monte-Carlo study and options of a fault are all
declared on dataclasses with `setting`. The annotation is the type.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

from fdi_ros.errors import FdiError

Value = bool | int | float | str | tuple[float, ...] | tuple[str, ...]

#: default of a field that must be given
REQUIRED = dataclasses.MISSING


@dataclass(frozen=True)
class Field:
    """Type and range of a value."""

    #: bool, int, float, text, numbers or texts; other types are checked by their reader
    kind: str
    default: Any
    low: float = -math.inf
    high: float = math.inf
    #: choices of a text; empty allows any text
    choices: tuple[str, ...] = ()
    unit: str = ""
    description: str = ""
    #: whether the parameter may change while the node runs
    runtime: bool = False
    #: of a list: channel or triad, with `each` values for each; empty allows any length
    per: str = ""
    each: int = 1
    #: lengths that such a list may have besides
    other_lengths: tuple[int, ...] = ()

    @property
    def unit_suffix(self) -> str:
        """The unit as written after a number."""
        return f" {self.unit}" if self.unit else ""


def setting(
    default: Any,
    description: str,
    unit: str = "",
    low: float = -math.inf,
    high: float = math.inf,
    **about: Any,
) -> Any:
    """Declare a field of a dataclass, arguments as in `Field`."""
    metadata = {
        "description": description,
        "unit": unit,
        "low": low,
        "high": high,
        **about,
    }
    return dataclasses.field(default=default, metadata=metadata)


_ANNOTATION_KINDS = {
    "float | None": "float",
    "str": "text",
    "tuple[float, ...]": "numbers",
    "tuple[str, ...]": "texts",
}
"""Kinds by annotations as they are written, where these are other words."""


def fields_of(owner: Any) -> dict[str, Field]:
    """Fields of a dataclass that are declared with `setting`, by name."""
    declared = [
        (str(field.type), field)
        for field in dataclasses.fields(owner)
        if "description" in field.metadata
    ]
    return {
        field.name: Field(
            _ANNOTATION_KINDS.get(kind, kind), field.default, **field.metadata
        )
        for kind, field in declared
    }


def check(field: Field, value: Any, name: str, error: type[FdiError]) -> Any:
    """Check a value, called ``name`` in errors of class ``error``, and convert its type.

    A list with one item may be given as that item. A number may be given as text:
    PyYAML reads 1e-3 as text, ROS reads a number.
    """
    if field.kind in ("numbers", "texts"):
        # ROS passes an empty array as an empty byte array, since emptiness has no type.
        items = (
            list(value)
            if isinstance(value, (list, tuple)) or hasattr(value, "tolist")
            else [value]
        )
        one = dataclasses.replace(
            field, kind="float" if field.kind == "numbers" else "text"
        )
        return tuple(check(one, item, name, error) for item in items)
    if field.kind in ("int", "float"):
        return _check_number(field, value, name, error)
    if not isinstance(value, bool if field.kind == "bool" else str):
        raise error(f"{name} is {value!r}, expected {_EXPECTED[field.kind]}")
    if field.choices and value not in field.choices:
        raise error(f"{name} is {value!r}, expected one of: {', '.join(field.choices)}")
    return value


_EXPECTED = {
    "bool": "true or false",
    "text": "a text",
    "float": "a number",
    "int": "a whole number",
}


def _check_number(field: Field, value: Any, name: str, error: type[FdiError]) -> float:
    unit = field.unit_suffix
    try:
        number = float("no number" if isinstance(value, bool) else value)
    except (TypeError, ValueError, OverflowError):
        raise error(f"{name} is {value!r}, expected {_EXPECTED[field.kind]}") from None
    if not field.low <= number <= field.high:
        raise error(
            f"{name} is {number:g}{unit}, expected {field.low:g} to {field.high:g}{unit}"
        )
    if field.kind == "int" and not number.is_integer():
        raise error(f"{name} is {number:g}{unit}, expected a whole number")
    return int(number) if field.kind == "int" else number


# Sections of the settings: a frozen dataclass each, a ROS parameter a field -------------------------------------------


#: noise of a sample below this is rounding of a constant value, rad/s
LEAST_NOISE = 1e-9


def _per_channel(*about: Any, lengths: tuple[int, ...] = (1,)) -> Any:
    """Declare a list with one value per channel, another length, or one value for all."""
    return setting(*about, per="channel", other_lengths=lengths)


def _per_accelerometer(*about: Any) -> Any:
    """Declare a list with one value per accelerometer, or one value for all."""
    return setting(*about, per="accelerometer", other_lengths=(1,))


def _per_triad(*about: Any, each: int = 1) -> Any:
    """Declare a list with a fixed number of values per triad, or none."""
    return setting(*about, per="triad", each=each, other_lengths=(0,))


def _live(*about: Any, **more: Any) -> Any:
    """Declare a field that may be changed while the node runs."""
    return setting(*about, runtime=True, **more)


class Input(NamedTuple):
    """One kind of input."""

    section: str
    """Section of settings: ``channels`` for arrays of channels, ``imus`` for three-axis
    units.
    """
    #: class in `fdi_ros.core.sources` that reads this input
    source: str


INPUTS = {
    "channels": Input("channels", "ChannelsSource"),
    "imus": Input("imus", "ImuSource"),
}
"""Kinds of input by the value of the parameter ``input``."""


@dataclass(frozen=True)
class ChannelsConfig:
    """Input as one std_msgs/Float64MultiArray of all channels."""

    topic: str = setting(
        "gyro_channels",
        "topic of the channels, one std_msgs/Float64MultiArray a sample",
    )
    acceleration_topic: str = setting(
        "",
        "topic of 4 to 12 accelerometers, one std_msgs/Float64MultiArray a sample, m/s^2; empty: there are none",
    )
    names: tuple[str, ...] = setting(
        (), "name of each channel; empty: g1, g2, ... or by the triads: imu_1.x, ..."
    )
    units: tuple[str, ...] = _per_channel(
        (),
        "name of the unit (chip, housing) that each channel belongs to and that may fail as a whole; empty: the triads"
        " of the preset, or by names with a point",
        lengths=(0,),
    )


@dataclass(frozen=True)
class ImusConfig:
    """Input as one sensor_msgs/Imu topic per triad."""

    topics: tuple[str, ...] = setting((), "topic of each triad, 2 to 4")
    names: tuple[str, ...] = _per_triad(
        (), "name of each triad; empty: by the topics, /imu_1/data_raw is imu_1"
    )
    mounts: tuple[float, ...] = _per_triad(
        (),
        "mount rotations, 9 numbers per triad by rows: v_body = R v_imu; empty: identity",
        "",
        -1.001,
        1.001,
        each=9,
    )
    delays: tuple[float, ...] = _per_triad(
        (),
        "delay of each triad: measured that much before its stamp; empty: none",
        "s",
        -0.1,
        0.1,
    )
    max_skew: float = setting(
        0.002, "stamps of two triads this close count as one instant", "s", 0.0, 1.0
    )
    timeout: float = setting(
        0.1,
        "a unit silent for so long, and for 4 samples, is not waited for; its input is STALE",
        "s",
        0.001,
        10.0,
    )


@dataclass(frozen=True)
class GeometryConfig:
    """Sensitivity axes in the body frame."""

    preset: str = setting(
        "auto",
        "mounting; auto: axes if given, else the triads' mounts, else two_triad_cone",
        choices=("auto", "two_triad_cone", "dodecahedron", "cone", "axes", "triads"),
    )
    axes: tuple[float, ...] = setting(
        (), "sensitivity axes, 3 numbers per channel, norm 0.5 to 2", "", -2.0, 2.0
    )
    cone_channels: int = setting(6, "number of channels of the cone preset", "", 4, 12)


@dataclass(frozen=True)
class NoiseConfig:
    """Error of a healthy channel: one value, or one per channel."""

    noise_std: tuple[float, ...] = _per_channel(
        (0.0025,),
        "standard deviation of the additive error in one sample",
        "rad/s",
        LEAST_NOISE,
        10.0,
    )
    scale_std: tuple[float, ...] = _per_channel(
        (0.0,), "standard deviation of the scale factor", "", 0.0, 1.0
    )
    timing_std: tuple[float, ...] = _per_channel(
        (0.0,), "standard deviation of the sampling instant", "s", 0.0, 1.0
    )
    nonlinearity_std: tuple[float, ...] = _per_channel(
        (0.002,),
        "standard deviation of the error that is not linear in the rate, share of the rate",
        "",
        0.0,
        1.0,
    )
    bound: tuple[float, ...] = _per_channel(
        (),
        "guaranteed limit of the error, for the guaranteed detector; empty: 4 noise_std",
        *("rad/s", 1e-9, 100.0),
        lengths=(0, 1),
    )
    bias_walk: tuple[float, ...] = _per_channel(
        (5e-5,),
        "random walk of the bias of a channel in flight",
        "rad/s/sqrt(s)",
        0.0,
        1.0,
    )
    shared_scale_std: float = setting(
        0.0,
        "standard deviation of the scale errors that all gyros have in common, per axis",
        "",
        0.0,
        0.1,
    )
    g_sensitivity_std: float = setting(
        1.8e-4,
        "standard deviation of the change of a gyro's bias with the specific force, beside accelerometers; 0: none",
        "(rad/s)/(m/s^2)",
        0.0,
        0.01,
    )
    acceleration_window: float = setting(
        0.01,
        "span over which the angular acceleration is taken, at least one sample",
        "s",
        0.0,
        1.0,
    )


@dataclass(frozen=True)
class BiasConfig:
    """Bias subtracted before the channels are compared."""

    fixed: tuple[float, ...] = _per_channel(
        (), "bias of each channel; empty: zero", "rad/s", -10.0, 10.0, lengths=(0,)
    )
    turn_on_std: float = setting(
        0.02,
        "standard deviation of a bias from one start to the next, where it is not learned",
        "rad/s",
        0.0,
        1.0,
    )
    max_drift: float = setting(
        0.1,
        "a bias is followed in flight up to this far; beyond, the channel has drifted",
        "rad/s",
        0.0,
        10.0,
    )
    startup_bias_duration: float = setting(
        0.0,
        "average each channel over this long at rest at the start and subtract it; 0: off",
        "s",
        0.0,
        600.0,
    )
    max_rest_rate: float = setting(
        0.1,
        "not at rest if the mean of a channel over that time exceeds this",
        "rad/s",
        1e-6,
        10.0,
    )


@dataclass(frozen=True)
class DetectorConfig:
    """The detector and its options. Each detector reads its own options."""

    name: str = _live("sequential", "name of the detector")
    false_alarms_per_hour: float = _live(
        0.001,
        "alarms on healthy channels per hour of samples; 0: use the probability",
        "1/h",
        0.0,
        3.6e6,
    )
    false_alarm_probability: float = _live(
        0.0,
        "alarms on healthy channels per sample; 0: use the rate per hour",
        "",
        0.0,
        0.5,
    )
    confidence: float = _live(
        0.999,
        "sequential, likelihood_ratio: confidence at which a rival explanation is ruled out",
        "",
        0.5,
        0.999999,
    )
    tolerance: str = _live(
        "calibrated",
        "residual searches: the paper's tolerance (8), or one derived from the false-alarm rate",
        choices=("paper", "calibrated"),
    )
    construction: str = _live("svd", "projector: construction", choices=("svd", "qr"))
    norm: str = _live(
        "l2", "projector: norm of the error estimate", choices=("l2", "l1")
    )
    criterion: str = _live(
        "determinant",
        "determinant: criterion",
        choices=("determinant", "condition_number"),
    )
    max_faults: int = _live(2, "guaranteed: faulty channels at most", "", 0, 2)
    threshold: float = _live(
        10.0,
        "guaranteed: declared beyond this many bounds of certain error",
        "",
        1e-6,
        1e6,
    )
    shift: float = _live(
        0.5,
        "cusum: shift of a normalised residual to be found fastest",
        "sigma",
        0.05,
        3.0,
    )
    run_length: float = _live(
        0.0,
        "sequential, cusum: samples to a false alarm; 0: the other rates",
        "samples",
        0.0,
        1e15,
    )


@dataclass(frozen=True)
class HealthConfig:
    """Checks of each channel by itself."""

    max_rate: tuple[float, ...] = _per_channel(
        (34.9,),
        "a value beyond this is out of range (saturated); one, or one per channel",
        "rad/s",
        1e-3,
        1e4,
    )
    range_recovery_time: float = setting(
        0.1,
        "after a value out of range, alarms do not count towards a declaration for this long",
        "s",
        0.0,
        10.0,
    )
    non_finite_time: float = setting(
        0.1, "faulty when nothing but NaN or infinity for this long", "s", 0.0, 60.0
    )
    stuck_time: float = setting(
        0.2,
        "faulty when the value repeats for this long against motion that the others see; 0: off",
        "s",
        0.0,
        60.0,
    )
    stuck_time_at_rest: float = setting(
        10.0,
        "stale when the value repeats for this long, also at rest; 0: off",
        "s",
        0.0,
        86400.0,
    )
    stale_timeout: float = setting(
        0.1,
        "stale when a channel gives nothing for this long, and for 4 samples",
        "s",
        0.001,
        60.0,
    )


@dataclass(frozen=True)
class DecisionConfig:
    """From alarms to declarations."""

    rule: str = setting(
        "auto",
        "evidence: an alarm declares at once; votes: confirm_alarms of confirm_window; auto: what the detector is for",
        choices=("auto", "evidence", "votes"),
    )
    confirm_alarms: int = setting(
        4, "alarms on the same suspects that confirm a fault", "samples", 1, 1000
    )
    confirm_window: int = setting(
        8, "the last samples among which those alarms count", "samples", 1, 1000
    )
    latch: bool = setting(
        True, "a declared fault stays until reset; false: returns after clean_time"
    )
    clean_time: float = setting(
        5.0,
        "time without disagreement after which a channel returns",
        "s",
        0.01,
        3600.0,
    )


@dataclass(frozen=True)
class IntegrityConfig:
    """Protection level of the fused rate."""

    risk: float = setting(
        1e-7,
        "allowed probability at one sample of an unnoticed error above the level; 0: no level",
        "",
        0.0,
        0.1,
    )
    fault_rate: tuple[float, ...] = _per_channel(
        (1e-4,), "faults of a channel; one, or one per channel", "1/h", 0.0, 1.0
    )
    exposure: float = setting(
        1.0, "time for which a fault may have gone unnoticed", "h", 1e-6, 1e3
    )
    max_rate: float = setting(
        2.0,
        "body rate for which the level after one more loss is foretold",
        "rad/s",
        0.0,
        100.0,
    )
    max_acceleration: float = setting(
        20.0, "angular acceleration of that", "rad/s^2", 0.0, 1e4
    )


@dataclass(frozen=True)
class AccelerometersConfig:
    """The accelerometers, judged beside the gyros; one value for all, or one per accelerometer."""

    enabled: str = setting(
        "auto",
        "judge the accelerometers; auto: those of channels.acceleration_topic, or of units whose messages carry"
        " accelerations (not -1 in the covariance, not all zero), if these are two or more",
        choices=("auto", "on", "off"),
    )
    noise_std: tuple[float, ...] = _per_accelerometer(
        (0.2,),
        "standard deviation of the additive error in one sample",
        "m/s^2",
        1e-6,
        1e3,
    )
    scale_std: tuple[float, ...] = _per_accelerometer(
        (0.01,), "standard deviation of the scale factor", "", 0.0, 1.0
    )
    bias_walk: tuple[float, ...] = _per_accelerometer(
        (0.006,),
        "random walk of the bias of an accelerometer in flight",
        "m/s^2/sqrt(s)",
        0.0,
        100.0,
    )
    turn_on_std: float = setting(
        0.5,
        "standard deviation of a bias from one start to the next",
        "m/s^2",
        0.0,
        100.0,
    )
    max_drift: float = setting(
        5.0,
        "a bias is followed in flight up to this far; beyond, the accelerometer has drifted",
        "m/s^2",
        0.0,
        1000.0,
    )
    max_acceleration: tuple[float, ...] = _per_accelerometer(
        (156.9,),
        "a value beyond this is out of range (saturated)",
        "m/s^2",
        1.0,
        1e5,
    )
    bias: tuple[float, ...] = setting(
        (),
        "bias of each accelerometer, as `fdi setup` measures it against the others; empty: 0",
        "m/s^2",
        -100.0,
        100.0,
        per="accelerometer",
        other_lengths=(0,),
    )
    axes: tuple[float, ...] = setting(
        (),
        "sensitivity axes of the accelerometers, 3 numbers each, norm 0.5 to 2; empty: those of the gyros",
        "",
        -2.0,
        2.0,
    )
    positions: tuple[float, ...] = setting(
        (),
        "position of each triad, or accelerometer of an array, in the body frame, from the first, 3 numbers each;"
        " empty: all at one place",
        "m",
        -10.0,
        10.0,
        per="place",
        each=3,
        other_lengths=(0,),
    )
    position_std: tuple[float, ...] = setting(
        (),
        "standard deviation of a position along each axis, one value for all but the first, or one per place; empty:"
        " 0.05 without positions, else 0",
        "m",
        0.0,
        10.0,
        per="place",
        other_lengths=(0, 1),
    )


# Parameters of the nodes that are no settings of the monitor ---------------------------------------------------------


def _of_node(
    default: Any,
    description: str,
    low: float = -math.inf,
    high: float = math.inf,
    **about: Any,
) -> Field:
    """Declare a parameter with the type of its default, other arguments as in `Field`."""
    kind = "text" if isinstance(default, str) else type(default).__name__
    return Field(kind, default, low, high, description=description, **about)


ALL_NODES = {
    "executor": _of_node(
        "auto",
        "executor; auto: events, or single where it does not work",
        choices=("auto", "events", "single"),
    )
}
"""Parameters that every node has."""
MONITOR = {
    "autostart": _of_node(
        True, "configure and activate at the start; false: wait for a lifecycle manager"
    ),
    "state_file": _of_node(
        "", "file that keeps biases and declarations over a restart; empty: none"
    ),
    "state_max_age": _of_node(
        3600.0, "a kept state older than this is not taken over", unit="s"
    ),
}
INJECTOR = {
    "enabled": _of_node(False, "inject; false: pass all on as it is", runtime=True),
    "faults": _of_node(
        "",
        "faults, separated by semicolons, each as 'channel=imu_2.y kind=bias size=0.2 start=0 stop=10';"
        " times count from when the injector is switched on",
        runtime=True,
    ),
    "scenario": _of_node(
        "", "scenario file with faults, besides those in 'faults'", runtime=True
    ),
    "suffix": _of_node(
        "_faulty", "added to the name of each input topic for that of the output"
    ),
}
PLAYER = {
    "bag": _of_node("", "rosbag2 folder, .mcap or .db3 file"),
    "rate": _of_node(1.0, "speed; 2.0: twice as fast as recorded", 1e-3, 1e3),
    "loop": _of_node(False, "begin anew at the end of the recording"),
    "clock": _of_node(True, "publish /clock, the time of recording"),
    "wait": _of_node(
        10.0, "wait at most this long for a subscriber to every topic", unit="s"
    ),
}
MAVLINK = {
    "url": _of_node(
        "udpin:0.0.0.0:14540",
        "the link: udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:DEVICE:BAUD",
    ),
    "system_id": _of_node(
        0,
        "system id of the autopilot; 0: the first that gives gyros, until it is lost",
        0,
        255,
    ),
    "component_id": _of_node(191, "own component id; 191: onboard computer", 1, 255),
    "messages": _of_node(
        "auto",
        "messages to be used; auto: all are asked for, and those that show the most units are kept",
        choices=("auto", "highres", "raw", "scaled"),
    ),
    "rate": _of_node(
        0.0, "rate to ask for, 1 or more; 0: sample_rate", 0.0, 1e3, unit="Hz"
    ),
    "monitor": _of_node("fdi_node", "name of the monitor whose declarations are sent"),
    "statustext": _of_node(True, "send declarations as STATUSTEXT"),
    "named_values": _of_node(
        False,
        "send statistic, threshold and readiness as NAMED_VALUE_FLOAT fdi_stat, fdi_limit, fdi_ready",
    ),
    "signing_key": _of_node(
        "",
        "file with the key for signing, 32 bytes or 64 hexadecimal digits; empty: off",
    ),
    "failover": _of_node(
        "off",
        "take an IMU that is declared faulty out of use",
        choices=("off", "ardupilot"),
    ),
    "failover_limit": _of_node(
        0, "most IMUs out of use by failover at a time; 0: all but one", 0, 2
    ),
    "failover_min_size": _of_node(
        0.03,
        "smallest difference of two IMUs for which one is taken out of use: the autopilot flies with less",
        0.0,
        10.0,
        unit="rad/s",
    ),
    "failover_file": _of_node(
        "", "holds the IMUs out of use by failover; empty: ~/.ros/NODE_failover.json"
    ),
}
NODE_SECTIONS = {
    "fdi_node": MONITOR,
    "injector_node": INJECTOR,
    "player_node": PLAYER,
    "mavlink_node": MAVLINK,
}
