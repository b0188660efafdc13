# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The settings of a monitor, read from a ROS 2 parameter file and validated once.

The node and all offline commands read the same file. Each field, here and in
`settings.py`, is one ROS parameter ``<section>.<field>``. Unit, range and meaning are
declared beside the field and appear in ``ros2 param describe``.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from fdi_ros.config.settings import (
    ALL_NODES,
    INPUTS,
    MONITOR,
    AccelerometersConfig,
    BiasConfig,
    ChannelsConfig,
    DecisionConfig,
    DetectorConfig,
    Field,
    GeometryConfig,
    HealthConfig,
    ImusConfig,
    IntegrityConfig,
    NoiseConfig,
    Value,
    check,
    fields_of,
    setting,
)
from fdi_ros.config.unit_names import unit_names
from fdi_ros.errors import ConfigError
from fdi_ros.system import find_shipped
from fdi_ros.system.files import RECORDING
from fdi_ros.system.text import did_you_mean, html_table, shown
from fdi_ros.system.yaml_file import parse_yaml, read_yaml


@dataclass(frozen=True)
class Config:
    """All settings of one monitor."""

    input: str = setting("channels", "what arrives", choices=tuple(INPUTS))
    body_frame: str = setting("base_link", "frame_id of the fused rate")
    hardware_id: str = setting("gyros", "hardware_id in the diagnostics")
    sample_rate: float = setting(100.0, "nominal rate of the samples", "Hz", 0.1, 1e5)
    excluded_channels: tuple[str, ...] = setting(
        (), "channels taken out by the operator", runtime=True
    )
    publish_under_doubt: bool = setting(
        True,
        "fused rate also where channels under doubt cannot be left out (their doubt is in its covariance), or none",
        runtime=True,
    )
    channels: ChannelsConfig = field(default_factory=ChannelsConfig)
    imus: ImusConfig = field(default_factory=ImusConfig)
    geometry: GeometryConfig = field(default_factory=GeometryConfig)
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    bias: BiasConfig = field(default_factory=BiasConfig)
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    health: HealthConfig = field(default_factory=HealthConfig)
    decision: DecisionConfig = field(default_factory=DecisionConfig)
    integrity: IntegrityConfig = field(default_factory=IntegrityConfig)
    accelerometers: AccelerometersConfig = field(default_factory=AccelerometersConfig)

    @classmethod
    def from_parameters(cls, parameters: Mapping[str, Any]) -> Config:
        """Build from ``{"section.field": value}``; missing parameters keep their defaults.

        `ConfigError` if a parameter is unknown, has the wrong type, is out of range, or
        contradicts another one.
        """
        sections: dict[str, dict[str, Any]] = {}
        for name, value in parameters.items():
            if name not in PARAMETERS:
                raise ConfigError(unknown_parameter(name))
            section, _, key = name.rpartition(".")
            sections.setdefault(section, {})[key] = check(
                PARAMETERS[name], value, name, ConfigError
            )
        top = sections.pop("", {})
        nested = {name: _SECTIONS[name](**values) for name, values in sections.items()}
        config = cls(**top, **nested)
        _check_consistency(config)
        return config

    @classmethod
    def from_file(
        cls,
        path: str | Path | Sequence[str | Path],
        overrides: Mapping[str, Any] | None = None,
    ) -> Config:
        """Read one or more ROS 2 parameter files; later files win, as with ``--params-file``.

        Parameters
        ----------
        path
            Paths, or names of shipped files: ``two_imus.yaml``, ``px4``.
        overrides
            ``{"section.field": value}``, which win over all files.

        Raises
        ------
        ConfigError
            If a file is missing or is no parameter file, or a parameter is wrong.
        """
        given_paths = [path] if isinstance(path, (str, Path)) else path
        files = [find_shipped(Path(one)) for one in given_paths]
        given = {
            name: value
            for file in files
            for name, value in read_parameter_file(file).items()
        }
        return cls.from_parameters({**given, **(overrides or {})})

    @classmethod
    def of(cls, settings: Config | str | PathLike[str]) -> Config:
        """Return settings as they are, or those of a parameter file."""
        return (
            settings if isinstance(settings, Config) else cls.from_file(Path(settings))
        )

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
    def changed(self) -> dict[str, Value]:
        """Parameters that differ from their defaults, as ``{"section.field": value}``."""
        return {
            name: value
            for name, value in self.parameters().items()
            if value != PARAMETERS[name].default
        }

    def __repr__(self) -> str:
        """Describe the parameters that differ from their defaults."""
        words = [f"{name}={value!r}" for name, value in self.changed.items()]
        return f"Config({', '.join(words)})"

    def _repr_html_(self) -> str:
        rows = [
            (name, value, PARAMETERS[name].default, PARAMETERS[name].unit)
            for name, value in self.changed.items()
        ]
        return html_table(
            "settings other than the default",
            ("parameter", "value", "default", "unit"),
            rows,
        )

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels, empty if the geometry numbers them (input ``channels``)."""
        if self.channels.names or not self.has_units:
            return self.channels.names
        return tuple(f"{imu}.{axis}" for imu in self.imu_names for axis in "xyz")

    @property
    def unit_timeout(self) -> float:
        """Time after which a unit is not waited for, s.

        It is ``imus.timeout``, and `SAMPLES.least_wait` samples at least.
        """
        return max(self.imus.timeout, SAMPLES.least_wait / self.sample_rate)

    @property
    def stale_timeout(self) -> float:
        """Time after which a silent channel is stale, s.

        It is ``health.stale_timeout``, and `SAMPLES.least_wait` samples at least.
        """
        return max(self.health.stale_timeout, SAMPLES.least_wait / self.sample_rate)

    @property
    def has_units(self) -> bool:
        """Whether the input is three-axis units, each on a topic of its own."""
        return INPUTS[self.input].section == "imus"

    @property
    def imu_names(self) -> tuple[str, ...]:
        """Names of the triads: as given, or by their topics."""
        return self.imus.names or tuple(unit_names(self.imus.topics))

    @property
    def topics(self) -> tuple[str, ...]:
        """The input topics: of the units, or of the arrays of gyros and of accelerometers."""
        if self.has_units:
            return self.imus.topics
        array = self.channels
        forces = (array.acceleration_topic,) if self.has_force_array else ()
        return (array.topic, *forces)

    @property
    def has_force_array(self) -> bool:
        """Whether accelerometers that are judged arrive as an array of their own."""
        given = bool(self.channels.acceleration_topic) and not self.has_units
        return given and self.accelerometers.enabled != "off"


_SECTIONS: dict[str, Callable[..., Any]] = {
    f.name: f.default_factory
    for f in fields(Config)
    if f.default_factory is not MISSING
}
"""Dataclass of each section."""
PARAMETERS: dict[str, Field] = {
    f"{section}.{name}" if section else name: declared
    for section, owner in (("", Config), *_SECTIONS.items())
    for name, declared in fields_of(owner).items()
}
"""Every parameter by its full name, in the order of the file."""


def unknown_parameter(name: str) -> str:
    """Return the error line for an unknown parameter, with the most similar name."""
    return f"unknown parameter {shown(name)!r}, {did_you_mean(name, tuple(PARAMETERS))}"


def check_lengths(config: Config, per: str, count: int) -> None:
    """Check the lengths of lists with values per channel or per triad (`ConfigError`)."""
    values: dict[str, Any] = config.parameters()
    for name, declared in PARAMETERS.items():
        lengths = (*declared.other_lengths, declared.each * count)
        if declared.per == per and len(values[name]) not in lengths:
            each = "one" if declared.each == 1 else declared.each
            expected = f"{' or '.join(map(str, lengths))} ({each} per {per})"
            raise ConfigError(
                f"{name} has {len(values[name])} values, expected {expected}"
            )


class SampleLimits(NamedTuple):
    """Limits of settings that are times, in samples."""

    #: wait for a unit at least: with fewer, a message that is late or lost looks
    #: like a silent unit
    least_wait: int = 4
    #: samples that a bias is learned from at a start at rest
    min_learned: int = 10
    #: samples over which the angular acceleration is taken at most
    max_span: int = 1000


SAMPLES = SampleLimits()

_TOKEN = "[A-Za-z_{][A-Za-z0-9_{}]*"
_TOPIC = re.compile(f"(?:/|~/)?{_TOKEN}(?:/{_TOKEN})*")


def is_topic(name: str) -> bool:
    """Whether a text is a valid ROS topic name, substitutions in braces included."""
    return len(name) <= RECORDING.name_length and _TOPIC.fullmatch(name) is not None


def is_plain_name(name: str) -> bool:
    """Whether a text is such a name in which nothing is to be put in."""
    return is_topic(name) and not set(name) & set("~{}")


def _check_consistency(config: Config) -> None:
    _check_topics(config)
    _check_names(config)
    if len(config.geometry.axes) % 3:
        raise ConfigError(
            f"geometry.axes has {len(config.geometry.axes)} numbers, expected 3 per channel"
        )
    _check_accelerometers(config)
    learned = config.bias.startup_bias_duration * config.sample_rate
    if 0 < learned < SAMPLES.min_learned:
        raise ConfigError(
            f"bias.startup_bias_duration is {config.bias.startup_bias_duration:g} s, {learned:.1f} samples at"
            f" {config.sample_rate:g} Hz, expected at least {SAMPLES.min_learned} samples"
        )
    span = config.noise.acceleration_window * config.sample_rate
    if span > SAMPLES.max_span:
        raise ConfigError(
            f"noise.acceleration_window is {config.noise.acceleration_window:g} s, {span:g} samples at"
            f" {config.sample_rate:g} Hz, expected at most {SAMPLES.max_span} samples"
        )
    if config.decision.confirm_alarms > config.decision.confirm_window:
        raise ConfigError(
            f"decision.confirm_alarms is {config.decision.confirm_alarms},"
            f" expected at most decision.confirm_window {config.decision.confirm_window}"
        )
    if (
        config.detector.false_alarms_per_hour == 0
        and config.detector.false_alarm_probability == 0
    ):
        raise ConfigError(
            "detector.false_alarms_per_hour and detector.false_alarm_probability are both 0: give one"
        )


def _check_accelerometers(config: Config) -> None:
    own = config.accelerometers
    topic = config.channels.acceleration_topic
    if own.enabled == "on" and not (config.has_units or topic):
        raise ConfigError(
            f"accelerometers.enabled is 'on', but input is {config.input!r} without channels.acceleration_topic"
        )
    if topic and config.has_units:
        raise ConfigError(
            f"channels.acceleration_topic is given, but input is {config.input!r}: expected input 'channels'"
        )
    of_units = 9 * len(config.topics)
    if own.axes and config.has_units and len(own.axes) != of_units:
        raise ConfigError(
            f"accelerometers.axes has {len(own.axes)} numbers, expected {of_units} (9 per unit)"
        )
    if len(own.axes) % 3:
        raise ConfigError(
            f"accelerometers.axes has {len(own.axes)} numbers, expected 3 per accelerometer"
        )
    if topic and topic == config.channels.topic:
        raise ConfigError(
            f"channels.topic and channels.acceleration_topic are both {topic!r}, expected two topics"
        )


def _check_names(config: Config) -> None:
    """Names stand in tables, pages and diagnostics."""
    named = {"channels.names": config.channels.names, "imus.names": config.imus.names}
    named |= {"hardware_id": (config.hardware_id,), "body_frame": (config.body_frame,)}
    for parameter, names in named.items():
        for name in names:
            if len(name) > RECORDING.name_length or not name.isprintable():
                raise ConfigError(
                    f"{parameter}: {name!r} is no name: expected at most {RECORDING.name_length} printable characters"
                )


def _check_topics(config: Config) -> None:
    if config.imus.delays and not config.has_units:
        raise ConfigError(
            f"imus.delays is given, but input is {config.input!r}: an array has one stamp for all"
        )
    for topic in config.topics:
        if not is_topic(topic):
            raise ConfigError(
                f"topic {topic!r} is no ROS name: expected letters, digits, _ and /, no digit first"
            )
    if config.has_units:
        count = len(config.imus.topics)
        if not 2 <= count <= 4:
            raise ConfigError(f"imus.topics has {count} topics, expected 2 to 4")
        if len(set(config.imus.topics)) != count:
            raise ConfigError(
                f"imus.topics repeats a topic: {', '.join(config.imus.topics)}"
            )
        check_lengths(config, "triad", count)


# Parameter files ----------------------------------------------------------------------------------------------------

ROS_PARAMETERS = (
    "use_sim_time",
    "start_type_description_service",
    *ALL_NODES,
    *MONITOR,
)
"""Parameters of the node itself, which a file may hold beside those of the monitor."""


def read_parameter_file(path: str | Path) -> dict[str, Any]:
    """Return the monitor's parameters in a ROS 2 parameter file, ``{"section.field": value}``.

    Sections ``/**`` are read first, then those of a node fdi_node in any namespace.
    `ConfigError` if the file is missing or is not a parameter file.
    """
    return parameters_in(read_yaml(path, "config", ConfigError), f"config {path}")


def parameters_in(document: Any, called: str, ros: bool = False) -> dict[str, Any]:
    """Return the monitor's parameters in a parsed parameter file.

    ``called``: name for errors. ``ros``: return the parameters of ROS and of the node
    itself instead. `ConfigError` if the content is not a parameter file.
    """
    if not isinstance(document, dict):
        raise ConfigError(
            f"{called} is no ROS 2 parameter file: expected a node name, then ros__parameters"
        )
    # Later sections win.
    monitors = sorted(filter(is_monitor, document), key=lambda node: node != "/**")
    if not monitors:
        names = ", ".join(map(str, document))
        raise ConfigError(
            f"{called} has no parameters for /** or fdi_node, only for: {names}"
        )
    flat: dict[str, Any] = {}
    for node in monitors:
        body = document[node]
        if not isinstance(body, dict) or not isinstance(
            body.get("ros__parameters"), dict
        ):
            raise ConfigError(f"{called}: {node} has no ros__parameters")
        _flatten(body["ros__parameters"], "", flat)
    return {
        name: value for name, value in flat.items() if is_ros_parameter(name) == ros
    }


def is_monitor(node: object) -> bool:
    """Whether a node name in a parameter file stands for the monitor."""
    return node == "/**" or str(node).rpartition("/")[2] == "fdi_node"


def is_ros_parameter(name: str) -> bool:
    """Whether a parameter belongs to ROS or the node itself and not to the monitor."""
    return name in ROS_PARAMETERS or name.startswith("qos_overrides.")


def _flatten(tree: Mapping[Any, Any], prefix: str, flat: dict[str, Any]) -> None:
    for key, value in tree.items():
        if isinstance(value, dict):
            _flatten(value, f"{prefix}{key}.", flat)
        else:
            flat[f"{prefix}{key}"] = value


# Parameter files, written ---------------------------------------------------------------------------------------------
# Parameters appear in the order of their declaration, with unit and meaning. A file
# made from another one keeps its values, but not its comments.

#: width of a file; a value without a comment may be longer
WIDTH = 110
_PLAIN = re.compile(r"[A-Za-z_/~][A-Za-z0-9_/~.*-]*")
"""Texts that need no quotes. The parser of ROS reads more words as values than PyYAML."""
_WORDS = {
    "y",
    "n",
    "yes",
    "no",
    "on",
    "off",
    "true",
    "false",
    "null",
    "nan",
    "inf",
    "infinity",
    "~",
}


class _Dumper(yaml.SafeDumper):  # type: ignore[misc]
    """Writes texts in quotes where they could be taken for something else."""

    def text(self, text: str) -> yaml.Node:
        """Return the node of a text."""
        plain = _PLAIN.fullmatch(text) and text.lower() not in _WORDS
        return self.represent_scalar(
            "tag:yaml.org,2002:str", text, style=None if plain else '"'
        )


_Dumper.add_representer(str, _Dumper.text)


def parameters_of(text: str) -> dict[str, Any]:
    """Return the parameters in the text of a parameter file (`ConfigError`)."""
    return parameters_in(parse_yaml(text, "config", ConfigError), "config")


def parameter_file(
    parameters: Mapping[str, Any],
    origin: str,
    remarks: Mapping[str, str] | None = None,
    node: str = "/**",
    ros: Mapping[str, Any] | None = None,
) -> str:
    """Return the text of a parameter file with the parameters ``{"section.field": value}``.

    ``origin``: comment lines at the top. ``remarks``: further comments by parameter.
    ``ros``: parameters of ROS and of the node itself.
    """
    lines = textwrap.indent(_yaml(ros), " " * 4).splitlines() if ros else []
    section = ""
    for name in filter(parameters.__contains__, PARAMETERS):
        before = section
        section = name.rpartition(".")[0]
        if section != before:
            lines += ["", f"    {section}:"]
        lines += _entry(
            name, parameters[name], (remarks or {}).get(name, ""), 6 if section else 4
        )
    top = [*(f"# {line}" for line in origin.splitlines()), f"{node}:"]
    return (
        "\n".join([*top, f"  ros__parameters:{'' if lines else ' {}'}", *lines]) + "\n"
    )


def with_parameters(
    files: Sequence[Path],
    changes: Mapping[str, Any],
    origin: str,
    remarks: Mapping[str, str],
    without: Sequence[str] = (),
) -> str:
    """Return the text of a parameter file made from others, other nodes included.

    Later files win. ``changes``: ``{"section.field": value}`` with new values.
    ``without``: parameters that the changes replace. ``origin`` and ``remarks`` as in
    `parameter_file`. `ConfigError` if a file is not a parameter file.
    """
    given: dict[str, Any] = {}
    ros: dict[str, Any] = {}
    others: dict[Any, Any] = {}
    monitors: set[str] = set()
    for file in files:
        document = read_yaml(file, "config", ConfigError)
        given |= parameters_in(document, f"config {file}")
        ros |= parameters_in(document, f"config {file}", ros=True)
        monitors |= set(filter(is_monitor, document))
        _update(
            others,
            {node: body for node, body in document.items() if not is_monitor(node)},
        )
    # As checked: of a number that is written as a text the number.
    values = Config.from_parameters(given).parameters()
    kept = {name: values[name] for name in given if name not in without}
    node = monitors.pop() if len(monitors) == 1 else "/**"
    text = parameter_file({**kept, **changes}, origin, remarks, node, ros)
    return f"{text}\n{_yaml(others)}" if others else text


def _update(tree: dict[Any, Any], new: Mapping[Any, Any]) -> None:
    """Take over the values of a tree into another."""
    for key, value in new.items():
        if isinstance(value, dict):
            if not isinstance(tree.get(key), dict):
                tree[key] = {}
            _update(tree[key], value)
        else:
            tree[key] = value


def _entry(name: str, value: Any, remark: str, indent: int) -> Iterator[str]:
    """Return the lines of one parameter. A comment too long for the line goes above."""
    declared = PARAMETERS[name]
    margin = " " * indent
    meaning = (
        f"{declared.unit}: {declared.description}"
        if declared.unit
        else declared.description
    )
    comment = f"# {meaning}"
    if remark:
        comment += f". {remark[0].upper()}{remark[1:]}"
    rows = list(_value(value))
    key = name.rpartition(".")[2]
    row = rows[0] if len(rows) == 1 else ""
    line = f"{margin}{key}: {row}".rstrip()
    width = len(line) + 1 + len(comment)
    if len(rows) == 1 and width <= WIDTH:
        yield f"{line} {comment}"
        return
    yield from textwrap.wrap(
        comment,
        WIDTH,
        initial_indent=margin,
        subsequent_indent=f"{margin}# ",
        break_long_words=False,
    )
    yield line
    yield from (f"{margin}  {row}" for row in rows if len(rows) > 1)


def _value(value: Any) -> Iterator[str]:
    """Format a value; long lists have three numbers per line (an axis, a unit, a row)."""
    if (
        not isinstance(value, (list, tuple))
        or len(_flow(value)) <= WIDTH // 2
        or len(value) % 3
    ):
        yield _flow(value)
        return
    for k in range(0, len(value), 3):
        row = _flow(value[k : k + 3])[1:-1]
        begin = " " if k else "["
        end = "," if k + 3 < len(value) else "]"
        yield f"{begin}{row}{end}"


def _flow(value: Any) -> str:
    """Write a value on one line."""
    return _yaml(value, default_flow_style=True).partition("\n")[0]


def _yaml(value: Any, **options: Any) -> str:
    return str(
        yaml.dump(
            value,
            Dumper=_Dumper,
            sort_keys=False,
            allow_unicode=True,
            width=1 << 30,
            **options,
        )
    )
