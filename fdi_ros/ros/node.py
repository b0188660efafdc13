# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What all nodes have: parameters declared from the table that every command shares, and requests that are answered."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, ParameterType, SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.timer import Timer

from fdi_ros.config.config import PARAMETERS, Config, is_ros_parameter, unknown_parameter
from fdi_ros.config.settings import ALL_NODES, Field, check
from fdi_ros.detectors import DETECTORS
from fdi_ros.errors import ConfigError, FdiError
from fdi_ros.ros.inputs import InputQueue
from fdi_ros.ros.messages import BoundedLog
from fdi_ros.ros.process import Stop, spin
from fdi_ros.system.limits import LINE
from fdi_ros.system.text import shown

SETTABLE = range(ParameterType.PARAMETER_BOOL, ParameterType.PARAMETER_STRING_ARRAY + 1)
"""Types that a parameter can be set to; none of ours can be deleted, which is what PARAMETER_NOT_SET asks for."""
MOST_PARAMETERS = 256  # in one request: several times what any node has
_POLICIES = {
    "history": ("keep_last", "keep_all", "system_default"),
    "depth": (),
    "reliability": ("reliable", "best_effort", "system_default"),
}
"""What QoS may be overridden, and the values it may have."""
_MAX_DEPTH = 100_000


class CheckedNode(Node):
    """A node that refuses what it cannot use, at the start and later, and answers every request.

    Nothing that many requests or messages bring about is without bound. ``fields`` are its parameters that are none of
    the settings. QoS may be overridden of the input topics, if it subscribes to them, and of topics that it
    ``publishes``. `ConfigError` if a parameter is unknown, of the wrong type or out of its range.
    """

    def __init__(
        self, name: str, fields: Mapping[str, Field], *, subscribes: bool, publishes: Sequence[str] = (), **options: Any
    ) -> None:
        self.inputs = InputQueue(self)
        self._fields = fields
        super().__init__(name, **options)
        self.log = BoundedLog(self.get_logger())  # for lines that something outside may cause as often as it likes
        # A file gives no type, and so no value, for an empty array.
        given = {name: [] if one.value is None else one.value for name, one in self._parameter_overrides.items()}
        self.config = Config.from_parameters(
            {name: value for name, value in given.items() if name not in fields and not is_ros_parameter(name)}
        )
        self._check_overrides(given, self.config.topics if subscribes else (), publishes)
        own = {**ALL_NODES, **fields}
        values = {name: field.default for name, field in own.items()} | self.config.parameters() | given
        for name, field in own.items():
            _checked(name, field, values[name])
        for name, field in (own | PARAMETERS).items():
            value = list(values[name]) if isinstance(values[name], tuple) else values[name]
            self.declare_parameter(name, value, _descriptor(name, field), ignore_override=True)
        self.add_on_set_parameters_callback(self._on_parameters)

    def values(self, changes: Sequence[Parameter] = ()) -> dict[str, Any]:
        """Return the parameters that are none of the settings, with changes made to them, checked."""
        given = {name: self.get_parameter(name).value for name in self._fields} | {p.name: p.value for p in changes}
        return {name: _checked(name, field, given[name]) for name, field in self._fields.items()}

    def change(self, changes: Sequence[Parameter]) -> None:
        """Take over parameters that are being set; `FdiError` if they cannot be: then none of them is set."""

    def _on_parameters(self, changes: list[Parameter]) -> SetParametersResult:
        try:
            self.change(changes)
        except FdiError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def every(self, seconds: float, callback: Callable[[], None]) -> Timer:
        """Call a function by the steady clock: that of a simulation, or of a recording, may stand still."""
        return self.create_timer(seconds, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def keep_up(self) -> None:
        """Do what must go on between the parts of a long request, and beside a storm of short ones."""
        self.log.begin_period()

    def live(self, stop: Stop) -> None:
        """Work until stopped."""
        spin(self, stop)

    def resolved(self, topic: str) -> str:
        """Return the full name of a topic, remapped; `ConfigError` if it is no name of a topic."""
        try:
            return str(self.resolve_topic_name(topic))
        except (ValueError, RuntimeError) as error:
            raise ConfigError(f"topic {topic!r} is no ROS name: {' '.join(str(error).split())}") from error

    def _check_overrides(self, given: Mapping[str, Any], subscribes: Sequence[str], publishes: Sequence[str]) -> None:
        """Refuse QoS overrides that would have no effect, or would fail only when the topic is made."""
        topics = [f"{self.resolved(topic)}.subscription" for topic in subscribes]
        topics += [f"{self.resolved(topic)}.publisher" for topic in publishes]
        known = {f"qos_overrides.{topic}.{policy}": _POLICIES[policy] for topic in topics for policy in _POLICIES}
        for name in filter(lambda name: name.startswith("qos_overrides."), given):
            if name not in known:
                raise ConfigError(f"unknown QoS override {name!r}, expected one of: {', '.join(known) or 'none'}")
            value, choices = given[name], known[name]
            if choices and value not in choices:
                raise ConfigError(f"{name} is {value!r}, expected one of: {', '.join(choices)}")
            if not choices and (type(value) is not int or not 1 <= value <= _MAX_DEPTH):
                raise ConfigError(f"{name} is {value!r}, expected a whole number, 1 to {_MAX_DEPTH}")

    # Requests -----------------------------------------------------------------------------------------------------

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Set parameters together; every refusal is logged too."""
        try:
            result = super().set_parameters_atomically(parameter_list)
        except ParameterNotDeclaredException:
            unknown = next(p.name for p in parameter_list if not self.has_parameter(p.name))
            result = _refusal(unknown_parameter(unknown))
        if not result.successful:
            result.reason = shown(result.reason, LINE)
            self.log.warning(f"parameters refused: {result.reason}")
        return result

    def create_service(self, kind: Any, name: str, callback: Any, **options: Any) -> Any:
        """Offer a service that answers every request; rclpy leaves one unanswered in which something is wrong."""
        if kind in (SetParameters, SetParametersAtomically):
            callback = self._on_set_parameters
        return super().create_service(kind, name, partial(self._answer, callback), **options)

    def _answer(self, callback: Any, request: Any, response: Any) -> Any:
        try:
            return callback(request, response)
        except (ValueError, TypeError, OverflowError, AssertionError, RuntimeError) as error:
            self.log.error(f"answered with nothing, as it cannot be worked: {type(error).__name__}: {error}")
            return type(response)()

    def _on_set_parameters(self, request: Any, response: Any) -> Any:
        given, results = request.parameters, []
        together = isinstance(request, SetParametersAtomically.Request)
        for k, messages in enumerate([given] if together else [[one] for one in given]):
            self.keep_up()
            many = k + len(messages) > MOST_PARAMETERS
            words = f"{len(given)} parameters in one request, expected at most {MOST_PARAMETERS}"
            results.append(_refusal(words) if many else self._set(messages))
        if together:
            response.result = results[0]
        else:
            response.results = results
        return response

    def _set(self, messages: Sequence[Any]) -> SetParametersResult:
        """Set parameters together, as they came in a message."""
        for one in messages:
            if not one.name or one.value.type not in SETTABLE:
                what = f"type {one.value.type}" if one.name else "no name"
                known = f"{SETTABLE[0]} to {SETTABLE[-1]} of rcl_interfaces/msg/ParameterType"
                reason = f"parameter {shown(one.name)!r} has {what}, expected a name and a type of {known}"
                self.log.warning(f"parameters refused: {reason}")
                return _refusal(reason)
        return self.set_parameters_atomically([Parameter.from_parameter_msg(one) for one in messages])


def _refusal(reason: str) -> SetParametersResult:
    return SetParametersResult(successful=False, reason=reason)


def _checked(name: str, field: Field, value: Any) -> Any:
    # YAML reads off as false.
    return check(field, "off" if value is False and "off" in field.choices else value, name, ConfigError)


def _descriptor(name: str, field: Field) -> ParameterDescriptor:
    """Describe a parameter to ROS: meaning, unit, range; read-only unless it may change at run time."""
    unit = f" [{field.unit}]" if field.unit else ""
    # A whole number given for a real one, or one value for an array of one, is checked by the table.
    described = ParameterDescriptor(description=field.description + unit, read_only=not field.runtime)
    described.dynamic_typing = True
    bounded = math.isfinite(field.low) and math.isfinite(field.high)
    # Not in the table of settings: detectors are a layer above it.
    choices = tuple(DETECTORS) if name == "detector.name" else field.choices
    if choices:
        described.additional_constraints = f"one of: {', '.join(choices)}"
    elif bounded and field.kind in ("float", "numbers"):
        described.additional_constraints = f"{field.low:g} to {field.high:g}{unit}"
    if bounded and field.kind == "float":
        described.floating_point_range = [FloatingPointRange(from_value=field.low, to_value=field.high)]
    if bounded and field.kind == "int":
        described.integer_range = [IntegerRange(from_value=int(field.low), to_value=int(field.high))]
    return described
