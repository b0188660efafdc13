# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The node's parameters: declared from the table that every command shares, checked by it, changed as a whole."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    ParameterType,
    SetParametersResult,
)
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rclpy.timer import Timer

from fdi_ros.config.config import PARAMETERS, Config, is_ros_parameter, unknown_parameter
from fdi_ros.config.settings import ALL_NODES, Field, check
from fdi_ros.detectors import DETECTORS
from fdi_ros.errors import ConfigError
from fdi_ros.ros.messages import BoundedLog
from fdi_ros.ros.process import Stop, spin
from fdi_ros.system.limits import LINE
from fdi_ros.system.text import shown

_INT64 = 2**63 - 1
SETTABLE = range(ParameterType.PARAMETER_BOOL, ParameterType.PARAMETER_STRING_ARRAY + 1)
"""Types that a parameter can be set to; none of ours can be deleted, which is what PARAMETER_NOT_SET asks for."""
MOST_PARAMETERS = 256
"""In one request: several times what any node has."""
_OVERRIDES = "qos_overrides."
_POLICIES = {
    "history": ("keep_last", "keep_all", "system_default"),
    "depth": (),
    "reliability": ("reliable", "best_effort", "system_default"),
}
"""What QoS may be overridden, and the values it may have."""
_MAX_DEPTH = 100_000


class CheckedParameters:
    """What a node of ours adds to how rclpy takes parameters and requests; to be named before the class of the node.

    Every request is answered, whatever it holds, and nothing that many of them bring about is without bound.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        self._log: BoundedLog | None = None
        self.given: list[str] | None = None
        """Names of the parameters that the node was started with."""
        self.empty_arrays: list[str] = []
        """Parameters given as an empty array: a file gives no type for it, and rclpy does not declare one without."""
        # So an unknown parameter is there to be refused by `declare`, and not silently ignored.
        super().__init__(*arguments, automatically_declare_parameters_from_overrides=True, **options)  # type: ignore[call-arg]

    def declare_parameters(self, namespace: str, parameters: Any, ignore_override: bool = False) -> Any:
        """Declare parameters; those without a value are set aside, for `declare` to declare them."""
        given = list(parameters)
        if self.given is None:
            # rclpy's own call, by which it declares what the node was started with.
            self.given = [one[0] for one in given]
            self.empty_arrays = [one[0] for one in given if one[1] is None]
            given = [one for one in given if one[1] is not None]
        return super().declare_parameters(namespace, given, ignore_override)  # type: ignore[misc]

    @property
    def log(self) -> BoundedLog:
        """The log for lines that something outside may cause as often as it likes."""
        if self._log is None:
            self._log = BoundedLog(self.get_logger())  # type: ignore[attr-defined]
        return self._log

    def every(self, seconds: float, callback: Callable[[], None]) -> Timer:
        """Call a function by the steady clock: that of a simulation, or of a recording, may stand still."""
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        return self.create_timer(seconds, callback, clock=steady)  # type: ignore[attr-defined]

    def values(self, fields: Mapping[str, Field]) -> dict[str, Any]:
        """Values of parameters that are none of the settings."""
        return {name: checked(name, field, self.get_parameter(name).value) for name, field in fields.items()}  # type: ignore[attr-defined]

    def keep_up(self) -> None:
        """Do what must go on between the parts of a long request, and beside a storm of short ones."""
        self.log.begin_period()

    def live(self, stop: Stop) -> None:
        """Work until stopped."""
        spin(self, stop)

    def set_parameters_atomically(self, parameter_list: list[RosParameter]) -> SetParametersResult:
        """Set parameters together; every refusal is logged too."""
        try:
            result = super().set_parameters_atomically(parameter_list)  # type: ignore[misc]
        except ParameterNotDeclaredException:
            unknown = [p.name for p in parameter_list if not self.has_parameter(p.name)]  # type: ignore[attr-defined]
            result = SetParametersResult(successful=False, reason=unknown_parameter(unknown[0]))
        if not result.successful:
            result.reason = shown(result.reason, LINE)
            self.log.warning(f"parameters refused: {result.reason}")
        return result

    def create_service(self, kind: Any, name: str, callback: Any, **options: Any) -> Any:
        """Offer a service that answers every request; rclpy leaves one unanswered in which something is wrong."""
        handlers = {SetParameters: self._on_set_parameters, SetParametersAtomically: self._on_set_parameters_atomically}
        answer = partial(self._answer, handlers.get(kind, callback))
        return super().create_service(kind, name, answer, **options)  # type: ignore[misc]

    def _answer(self, callback: Any, request: Any, response: Any) -> Any:
        try:
            return callback(request, response)
        except (ValueError, TypeError, OverflowError, AssertionError, RuntimeError) as error:
            self.log.error(f"answered with nothing, as it cannot be worked: {type(error).__name__}: {error}")
            return type(response)()

    def _on_set_parameters(self, request: Any, response: Any) -> Any:
        for k, one in enumerate(request.parameters):
            self.keep_up()
            response.results.append(self._set([one]) if k < MOST_PARAMETERS else _too_many(len(request.parameters)))
        return response

    def _on_set_parameters_atomically(self, request: Any, response: Any) -> Any:
        count = len(request.parameters)
        response.result = self._set(request.parameters) if count <= MOST_PARAMETERS else _too_many(count)
        return response

    def _set(self, messages: Sequence[Any]) -> SetParametersResult:
        """Set parameters together, as they came in a message."""
        for one in messages:
            if not one.name or one.value.type not in SETTABLE:
                what = f"type {one.value.type}" if one.name else "no name"
                known = f"{SETTABLE[0]} to {SETTABLE[-1]} of rcl_interfaces/msg/ParameterType"
                reason = f"parameter {shown(one.name)!r} has {what}, expected a name and a type of {known}"
                self.log.warning(f"parameters refused: {reason}")
                return SetParametersResult(successful=False, reason=reason)
        return self.set_parameters_atomically([RosParameter.from_parameter_msg(one) for one in messages])


def _too_many(count: int) -> SetParametersResult:
    return SetParametersResult(
        successful=False, reason=f"{count} parameters in one request, expected at most {MOST_PARAMETERS}"
    )


def declare(
    node: Node,
    fields: Mapping[str, Field],
    publishers: Sequence[str] = (),
    subscribes: bool = True,
) -> Config:
    """Check what the node was given, declare all parameters, and return the settings.

    Parameters
    ----------
    node
        Whose parameters.
    fields
        Parameters of the node that are none of the settings.
    publishers
        Topics of the node's publishers whose QoS may be overridden.
    subscribes
        Whether the node subscribes to the input topics, with QoS that may be overridden.

    Raises
    ------
    ConfigError
        If a parameter is unknown, of the wrong type or out of its range.
    """
    given = {name: parameter.value for name, parameter in node.get_parameters_by_prefix("").items()}
    empty = dict.fromkeys(getattr(node, "empty_arrays", ()), ())
    config = Config.from_parameters(
        {name: value for name, value in (given | empty).items() if name not in fields and not is_ros_parameter(name)}
    )
    _check_overrides(node, given | empty, config.topics if subscribes else (), publishers)
    for name, field in {**ALL_NODES, **fields}.items():
        if name in empty:
            raise ConfigError(f"{name} is an empty array, expected one value")
        if name in given:
            checked(name, field, given[name])
        _declare(node, name, field.default, descriptor(name, field), given)
    for name, value in config.parameters().items():
        default = list(value) if isinstance(value, tuple) else value
        _declare(node, name, default, descriptor(name, PARAMETERS[name]), given)
    return config


def checked(name: str, field: Field, value: Any) -> Any:
    """Return the value of a parameter that is none of the settings.

    Raises
    ------
    ConfigError
        If it is of the wrong type or out of its range.
    """
    # YAML reads off as false.
    return check(field, "off" if value is False and "off" in field.choices else value, name, ConfigError)


def _declare(node: Node, name: str, default: Any, described: ParameterDescriptor, given: Mapping[str, Any]) -> None:
    if name in given:
        node.set_descriptor(name, described)
    else:
        # Nothing but an empty array, which is the default then, can have been given.
        node.declare_parameter(name, default, described, ignore_override=True)


def resolved(node: Node, topic: str) -> str:
    """Return the full name of a topic, remapped.

    Raises
    ------
    ConfigError
        If it is no name of a topic.
    """
    try:
        return str(node.resolve_topic_name(topic))
    except (ValueError, RuntimeError) as error:
        raise ConfigError(f"topic {topic!r} is no ROS name: {' '.join(str(error).split())}") from error


def _check_overrides(
    node: Node, given: Mapping[str, Any], subscriptions: Sequence[str], publishers: Sequence[str]
) -> None:
    """Refuse QoS overrides that would have no effect, or would fail only when the topic is made."""
    topics = [(topic, "subscription") for topic in subscriptions] + [(topic, "publisher") for topic in publishers]
    known = {
        f"{_OVERRIDES}{resolved(node, topic)}.{kind}.{policy}": policy for topic, kind in topics for policy in _POLICIES
    }
    for name, value in given.items():
        if not name.startswith(_OVERRIDES):
            continue
        if name not in known:
            raise ConfigError(f"unknown QoS override {name!r}, expected one of: {', '.join(known) or 'none'}")
        choices = _POLICIES[known[name]]
        if choices and value not in choices:
            raise ConfigError(f"{name} is {value!r}, expected one of: {', '.join(choices)}")
        if not choices and (isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= _MAX_DEPTH):
            raise ConfigError(f"{name} is {value!r}, expected a whole number, 1 to {_MAX_DEPTH}")


def descriptor(name: str, parameter: Field) -> ParameterDescriptor:
    """Describe a parameter to ROS: meaning, unit, range; read-only unless it may change at run time."""
    unit = f" [{parameter.unit}]" if parameter.unit else ""
    described = ParameterDescriptor(
        description=parameter.description + unit,
        read_only=not parameter.runtime,
        # A whole number given for a real one, or one value for an array of one, is checked by the table.
        dynamic_typing=True,
    )
    bounded = math.isfinite(parameter.low) and math.isfinite(parameter.high)
    # Not in the table of settings: detectors are a layer above it.
    choices = tuple(DETECTORS) if name == "detector.name" else parameter.choices
    if choices:
        described.additional_constraints = f"one of: {', '.join(choices)}"
    elif bounded and parameter.kind in ("float", "numbers"):
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
