"""One ROS parameter: its description, its check, and the files it is read from."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fdi_ros.errors import ConfigError
from fdi_ros.yaml_file import read_yaml

Value = bool | int | float | str | tuple[float, ...] | tuple[str, ...]


@dataclass(frozen=True)
class Parameter:
    """One parameter: what the node declares and what a value is checked against."""

    name: str
    kind: str
    """One of: str, bool, int, float, floats, strs."""
    default: Value
    description: str
    unit: str
    low: float
    high: float
    choices: tuple[str, ...]
    runtime: bool
    """Whether it may be changed while the node runs."""


def setting(
    default: Any,
    description: str,
    unit: str = "",
    low: float = -math.inf,
    high: float = math.inf,
    choices: tuple[str, ...] = (),
    runtime: bool = False,
) -> Any:
    """Field of a settings class that is a ROS parameter."""
    about = {
        "description": description,
        "unit": unit,
        "low": low,
        "high": high,
        "choices": choices,
        "runtime": runtime,
    }
    return field(default=default, metadata=about)


ROS_PARAMETERS = (
    "use_sim_time",
    "start_type_description_service",
    "autostart",
    "executor",
    "state_file",
    "state_max_age",
)
"""Parameters of the node itself: they may stand in the file, the pipeline does not know them."""


def read_parameter_file(path: str | Path) -> dict[str, Any]:
    """Parameters of the monitor in a ROS 2 parameter file, as ``{"section.field": value}``.

    Sections ``/**`` and then those of a node named fdi_node, in whatever namespace, are taken.

    Raises
    ------
    ConfigError
        If the file is missing or is no parameter file.
    """
    return parameters_in(read_yaml(path, "config", ConfigError), f"config {path}")


def parameters_in(document: Any, called: str) -> dict[str, Any]:
    """Parameters of the monitor in what a ROS 2 parameter file holds, as `read_parameter_file` returns them.

    Raises
    ------
    ConfigError
        If it is no parameter file; called is its name there.
    """
    if not isinstance(document, dict):
        raise ConfigError(f"{called} is no ROS 2 parameter file: expected a node name, then ros__parameters")
    flat: dict[str, Any] = {}
    found = False
    for node in sorted(document, key=lambda name: name != "/**"):
        if node != "/**" and str(node).rpartition("/")[2] != "fdi_node":
            continue
        body = document[node]
        if not isinstance(body, dict) or not isinstance(body.get("ros__parameters"), dict):
            raise ConfigError(f"{called}: {node} has no ros__parameters")
        found = True
        _flatten(body["ros__parameters"], "", flat)
    if not found:
        names = ", ".join(map(str, document))
        raise ConfigError(f"{called} has no parameters for /** or fdi_node, only for: {names}")
    return {name: value for name, value in flat.items() if not is_ros_parameter(name)}


def is_ros_parameter(name: str) -> bool:
    """Whether a parameter belongs to ROS or the node itself and not to the monitor."""
    return name in ROS_PARAMETERS or name.startswith("qos_overrides.")


def _flatten(tree: Mapping[Any, Any], prefix: str, flat: dict[str, Any]) -> None:
    for key, value in tree.items():
        if isinstance(value, dict):
            _flatten(value, f"{prefix}{key}.", flat)
        else:
            flat[f"{prefix}{key}"] = value


def convert(parameter: Parameter, value: Any) -> Value:
    """Check a value and give it the parameter's type.

    Raises
    ------
    ConfigError
        If it is of another type or out of range.
    """
    if parameter.kind in ("floats", "strs"):
        # ROS hands an empty array over as an empty byte array: it has no type of its own.
        items = list(value) if isinstance(value, (list, tuple)) or hasattr(value, "tolist") else [value]
        single = "float" if parameter.kind == "floats" else "str"
        return tuple(_scalar(parameter, single, item) for item in items)
    return _scalar(parameter, parameter.kind, value)


def _scalar(parameter: Parameter, kind: str, value: Any) -> Any:
    if kind == "float" and isinstance(value, str):
        value = _number(value)
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    fits = {
        "bool": isinstance(value, bool),
        "str": isinstance(value, str),
        "float": number,
        "int": number and float(value).is_integer(),
    }[kind]
    if not fits:
        words = {"bool": "true or false", "str": "a text", "float": "a number", "int": "a whole number"}
        raise ConfigError(f"{parameter.name} is {value!r}, expected {words[kind]}")
    if kind in ("float", "int"):
        return _in_range(parameter, float(value) if kind == "float" else int(value))
    if parameter.choices and value not in parameter.choices:
        raise ConfigError(f"{parameter.name} is {value!r}, expected one of: {', '.join(parameter.choices)}")
    return value


def _in_range(parameter: Parameter, value: float) -> float:
    if not parameter.low <= value <= parameter.high:
        unit = f" {parameter.unit}" if parameter.unit else ""
        raise ConfigError(
            f"{parameter.name} is {value:g}{unit}, expected {parameter.low:g} to {parameter.high:g}{unit}"
        )
    return value


def _number(text: str) -> float | str:
    # PyYAML reads 1e-3, without a point, as text; ROS reads it as the number it is.
    try:
        return float(text)
    except ValueError:
        return text
