"""The node's parameters: declared from the table that every command shares, judged by it, changed as a whole."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from fdi_ros.config import PARAMETERS, Config
from fdi_ros.errors import ConfigError
from fdi_ros.parameter import Parameter, is_ros_parameter

EXECUTORS = ("auto", "events", "single")


def own(
    default: Any, description: str, read_only: bool = True, constraints: str = ""
) -> tuple[Any, ParameterDescriptor]:
    """Describe a parameter of a node that is none of the settings: default and descriptor."""
    return default, ParameterDescriptor(
        description=description, read_only=read_only, additional_constraints=constraints, dynamic_typing=True
    )


EXECUTOR = own(
    "auto",
    "executor; auto: events, or single where it does not work",
    constraints=f"one of: {', '.join(EXECUTORS)}",
)
_INT64 = 2**63 - 1


def declare(node: Node, owns: Mapping[str, tuple[Any, ParameterDescriptor]]) -> Config:
    """Judge what the node was given, declare all parameters, and return the settings.

    The node must have been made with ``automatically_declare_parameters_from_overrides``: so a parameter that
    nobody knows is there to be refused, and not silently left aside.

    Parameters
    ----------
    node
        Whose parameters.
    owns
        The node's own: default and descriptor by name. A value must be of the default's type.

    Raises
    ------
    ConfigError
        If a parameter is unknown, of the wrong type or out of its range.
    """
    given = {name: parameter.value for name, parameter in node.get_parameters_by_prefix("").items()}
    config = Config.from_parameters(
        {name: value for name, value in given.items() if name not in owns and not is_ros_parameter(name)}
    )
    for name, (default, described) in {"executor": EXECUTOR, **owns}.items():
        _declare(node, name, default, described, given)
        whole_for_real = isinstance(default, float) and isinstance(given.get(name), int)
        if not isinstance(node.get_parameter(name).value, type(default)) and not whole_for_real:
            raise ConfigError(f"{name} is {given[name]!r}, expected a value like {default!r}")
    if node.get_parameter("executor").value not in EXECUTORS:
        raise ConfigError(f"executor is {given['executor']!r}, expected one of: {', '.join(EXECUTORS)}")
    for name, value in config.parameters().items():
        default = list(value) if isinstance(value, tuple) else value
        _declare(node, name, default, descriptor(PARAMETERS[name]), given)
    return config


def _declare(node: Node, name: str, default: Any, described: ParameterDescriptor, given: Mapping[str, Any]) -> None:
    if name in given:
        node.set_descriptor(name, described)
    else:
        node.declare_parameter(name, default, described)


def descriptor(parameter: Parameter) -> ParameterDescriptor:
    """Describe a parameter to ROS: meaning, unit, range; read-only unless it may change at run time."""
    unit = f" [{parameter.unit}]" if parameter.unit else ""
    described = ParameterDescriptor(
        description=parameter.description + unit,
        read_only=not parameter.runtime,
        # A whole number given for a real one, or one value for an array of one, is judged by the table.
        dynamic_typing=True,
    )
    bounded = math.isfinite(parameter.low) and math.isfinite(parameter.high)
    if parameter.choices:
        described.additional_constraints = f"one of: {', '.join(parameter.choices)}"
    elif bounded and parameter.kind in ("float", "floats"):
        described.additional_constraints = f"{parameter.low:g} to {parameter.high:g}{unit}"
    if bounded and parameter.kind == "float":
        described.floating_point_range = [FloatingPointRange(from_value=parameter.low, to_value=parameter.high)]
    if bounded and parameter.kind == "int":
        low, high = max(-_INT64, int(parameter.low)), min(_INT64, int(parameter.high))
        described.integer_range = [IntegerRange(from_value=low, to_value=high)]
    return described


def changed(config: Config, parameters: Iterable[RosParameter]) -> Config:
    """Return the settings with changes made at run time.

    Raises
    ------
    ConfigError
        If one of them is unknown, may not change at run time, or does not fit the others.
    """
    changes = {p.name: p.value for p in parameters if not is_ros_parameter(p.name)}
    for name in changes:
        if name in PARAMETERS and not PARAMETERS[name].runtime:
            raise ConfigError(f"{name} is read at the start only: change the parameter file and start anew")
    return config.replaced(changes) if changes else config
