# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What all nodes have: parameters, requests that are answered, a bounded log, topics of bytes that never stop them."""

from __future__ import annotations

import importlib
import logging
import math
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

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
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from rclpy.timer import Timer

from fdi_ros.config.config import (
    PARAMETERS,
    Config,
    is_ros_parameter,
    unknown_parameter,
)
from fdi_ros.config.settings import ALL_NODES, Field, check
from fdi_ros.detectors import DETECTORS
from fdi_ros.errors import ConfigError, FdiError
from fdi_ros.monitor.diagnostics import DIAGNOSTICS, Level, StatusLine
from fdi_ros.ros.process import Stop, spin
from fdi_ros.system.text import LINE, shown


class _Load(NamedTuple):
    """How much a busy node takes."""

    #: messages that a topic keeps, in and out: a quarter of a second at 1 kHz
    depth: int = 256
    #: longest turn, s: reports and requests do not wait for a flood
    turn: float = 0.05
    #: events that may wait in the queue of an executor: some 50 ms of its work, 1
    #: MB
    flood: int = 5000
    #: time after the start of a flood before the first check for its end, s
    flood_time: float = 5.0
    #: parameters in one request: several times what any node has
    parameters: int = 256
    #: longest queue that may be asked for, messages: 100 s at 1 kHz
    max_depth: int = 100_000


LOAD = _Load()

REPORT_PERIOD = 1.0  # from one regular report of a node to the next, s
# Most lines of the log of one severity in a `REPORT_PERIOD`: lines that anybody can
# cause with requests must not hide a declaration.
MOST_LINES = 20
SETTABLE = range(ParameterType.PARAMETER_BOOL, ParameterType.PARAMETER_STRING_ARRAY + 1)
"""Types that a parameter can be set to.

PARAMETER_NOT_SET is absent, because no parameter can be deleted.
"""
OVERRIDABLE = {"qos_overriding_options": QoSOverridingOptions.with_default_policies()}
_POLICIES = {
    "history": ("keep_last", "keep_all", "system_default"),
    "depth": (),
    "reliability": ("reliable", "best_effort", "system_default"),
}  # QoS policies that may be overridden, and their values


def message_class(name: str) -> Any:
    """Return the class of a message type, ``sensor_msgs/msg/Imu``.

    Raise `FdiError` if its package is not installed.
    """
    package, _, kind = name.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), kind)
    except ImportError as error:
        raise FdiError(
            f"messages of type {name} need the ROS package {package}: {error}"
        ) from error


def read_diagnostics(message: Any, node: str) -> list[StatusLine]:
    """Return the statuses of a node in a message of /diagnostics, without its name.

    Raise `ValueError` for a wrong level.
    """
    prefix = f"{node.strip('/')}: "
    found = []
    for status in message.status:
        if status.name.startswith(prefix):
            level = ord(status.level)
            if level > max(Level):
                raise ValueError(f"level {level}, expected 0 to {max(Level)}")
            values = tuple((pair.key, pair.value) for pair in status.values)
            name = status.name.removeprefix(prefix)
            found.append(
                StatusLine(
                    Level(level), name, status.message, status.hardware_id, values
                )
            )
    return found


class BoundedLog(logging.Handler):
    """Log with a bound on the lines per second and on their length.

    The log counts the lines left out.
    """

    def __init__(
        self, logger: Any, clock: Callable[[], float] = time.monotonic
    ) -> None:
        super().__init__()
        self._logger = logger
        self._clock = clock
        self._since = clock()
        self._lines: Counter[str] = Counter()
        self._left_out = 0

    # The logger of ROS refuses another severity from the same line of code.
    def info(self, words: str) -> None:
        """Log a normal event."""
        if self._has_room("info"):
            self._logger.info(shown(words, LINE))

    def warning(self, words: str) -> None:
        """Log what somebody should know of."""
        if self._has_room("warning"):
            self._logger.warning(shown(words, LINE))

    def error(self, words: str) -> None:
        """Log what somebody should act on."""
        if self._has_room("error"):
            self._logger.error(shown(words, LINE))

    def begin_period(self) -> None:
        """Begin the next period if due, with a line on the lines left out of the last one."""
        now = self._clock()
        if now - self._since < REPORT_PERIOD:
            return
        left_out = self._left_out
        self._since = now
        self._left_out = 0
        self._lines.clear()
        if left_out:
            self._lines["warning"] = 1
            self._logger.warning(f"and {left_out} more lines, left out")

    def _has_room(self, severity: str) -> bool:
        self.begin_period()
        has_room = self._lines[severity] < MOST_LINES
        self._lines[severity] += has_room
        self._left_out += not has_room
        return has_room

    def emit(self, record: logging.LogRecord) -> None:
        """Log a record of the package's logger. See `take_over`."""
        self.info(record.getMessage())

    def take_over(self) -> None:
        """Take what the package logs, which then goes nowhere else."""
        package = logging.getLogger("fdi_ros")
        package.handlers = [self]
        package.propagate = False


class InputQueue:
    """The subscriptions of a node to raw messages: drained after every turn of the executor, and watched for a flood.

    An executor comes back after every message, which costs more than the message; asking an empty queue costs half a
    microsecond. But the EventsExecutor keeps an event for every message that arrives, without bound, also for those
    that were drained or that DDS has dropped: a flood costs memory without end, and timers wait behind it. So once too
    many events must be waiting, another kind of executor is to take over for some seconds.
    """

    def __init__(self, node: Node) -> None:
        self.subscriptions: dict[
            Subscription[Any], Callable[[bytes], None]
        ] = {}  # each with what takes its messages
        self.flooded = False
        self._node = node
        self._taken = 0  # messages that came by an event of the executor in this turn
        self._waiting = 0  # events of messages that were drained
        self._until = 0.0  # steady time at which the flood ends at the earliest, s

    def open(self, kind: str, topic: str, take: Callable[[bytes], None]) -> None:
        """Subscribe to the bytes of the messages of a topic."""

        def take_event(data: bytes) -> None:
            self._taken += 1
            # An event outlives its subscription where the node is cleaned up before its turn.
            if subscription in self.subscriptions:
                take(data)

        # A new QoS each time, as rclpy writes overrides into the object.
        qos = QoSProfile(depth=LOAD.depth, reliability=ReliabilityPolicy.BEST_EFFORT)
        message = message_class(kind)
        subscription = self._node.create_subscription(
            message, topic, take_event, qos, raw=True, **OVERRIDABLE
        )
        self.subscriptions[subscription] = take

    def close(self) -> None:
        """Close all subscriptions."""
        for one in self.subscriptions:
            self._node.destroy_subscription(one)
        self.subscriptions = {}
        self.flooded = False
        self._waiting = 0

    def drain(self) -> None:
        """Take waiting messages in the order of their arrival, for `LOAD.turn` or two full queues at most."""
        takers = list(self.subscriptions.items())
        taken = 0
        end = time.monotonic() + LOAD.turn
        heads = [_next(one) for one, _ in takers]
        while waiting := [
            (head[0], k, head[1]) for k, head in enumerate(heads) if head is not None
        ]:
            _, k, data = min(waiting)
            subscription, take = takers[k]
            heads[k] = (
                _next(subscription)
                if taken < 2 * LOAD.depth and time.monotonic() < end
                else None
            )
            taken += 1
            take(data)
        self._waiting += taken

    def turn(self) -> None:
        """Take waiting messages after a turn of an EventsExecutor, and check for a flood."""
        self.drain()
        if self._waiting and not self._taken:
            # The turn has used up the event of a message that was drained, or was a timer's.
            self._waiting -= 1
        self._taken, now = 0, time.monotonic()
        if not self.flooded and self._waiting > LOAD.flood:
            self.flooded = True
            self._until = now + LOAD.flood_time
            words = "flooded with messages: inputs are polled while it lasts"
            self._node.get_logger().warning(words, throttle_duration_sec=10.0)
        elif self.flooded and now >= self._until:
            self.flooded = False
            self._waiting = 0


def _next(subscription: Subscription[Any]) -> tuple[int, bytes] | None:
    """Take a message out of the queue: time of arrival, ns, and bytes."""
    with subscription.handle:
        message = subscription.handle.take_message(subscription.msg_type, True)
    return None if message is None else (message[1]["received_timestamp"], message[0])


class CheckedNode(Node):
    """A node that refuses unusable parameters (`ConfigError`), answers every request, and bounds the effect of floods.

    ``fields`` are its parameters beside the settings. QoS overrides are allowed for the
    input topics, with ``subscribes``, and for the topics in ``publishes``.
    """

    def __init__(
        self,
        name: str,
        fields: Mapping[str, Field],
        *,
        subscribes: bool,
        publishes: Sequence[str] = (),
        **options: Any,
    ) -> None:
        self.inputs = InputQueue(self)
        self._fields = fields
        super().__init__(name, **options)
        self.log = BoundedLog(
            self.get_logger()
        )  # for lines that outside events can cause at any rate
        # A file gives no type, and so no value, for an empty array.
        given = {
            name: [] if one.value is None else one.value
            for name, one in self._parameter_overrides.items()
        }
        self.config = Config.from_parameters(
            {
                name: value
                for name, value in given.items()
                if name not in fields and not is_ros_parameter(name)
            }
        )
        self._check_overrides(
            given, self.config.topics if subscribes else (), publishes
        )
        own = {**ALL_NODES, **fields}
        values = self.config.parameters()
        for name, field in own.items():
            values[name] = _checked(name, field, given.get(name, field.default))
        self._declared = own | PARAMETERS
        for name, field in self._declared.items():
            typed = _typed(Parameter(name, value=values[name]), field)
            described = _descriptor(name, field)
            if isinstance(typed.value, Sequence) and not typed.value:
                # rclpy takes any empty value for an array of bytes.
                anything = ParameterDescriptor(dynamic_typing=True)
                self.declare_parameter(
                    name, typed.value, anything, ignore_override=True
                )
                self.set_parameters([typed])
                described.type = typed.type_.value
                self.set_descriptor(name, described)
            else:
                self.declare_parameter(
                    name, typed.value, described, ignore_override=True
                )
        self.add_on_set_parameters_callback(self._on_parameters)

    def values(self, changes: Sequence[Parameter] = ()) -> dict[str, Any]:
        """Return the parameters that are none of the settings, with changes made to them, checked."""
        given = {name: self.get_parameter(name).value for name in self._fields} | {
            p.name: p.value for p in changes
        }
        return {
            name: _checked(name, field, given[name])
            for name, field in self._fields.items()
        }

    def change(self, changes: Sequence[Parameter]) -> None:
        """Take over parameters that are being set. Raise `FdiError` to refuse all."""

    def _on_parameters(self, changes: list[Parameter]) -> SetParametersResult:
        try:
            self.change(changes)
        except FdiError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def every(self, seconds: float, callback: Callable[[], None]) -> Timer:
        """Call a function by the steady clock.

        The clock of a simulation or recording may stand still.
        """
        return self.create_timer(
            seconds, callback, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )

    def keep_up(self) -> None:
        """Keep regular work going between the parts of a long request and during many short ones."""
        self.log.begin_period()

    def live(self, stop: Stop) -> None:
        """Work until stopped."""
        spin(self, stop)

    @property
    def prefix(self) -> str:
        """What the names of its statuses begin with: no two nodes of a system have the same."""
        return f"{self.get_fully_qualified_name().lstrip('/')}: "

    def create_output(self, kind: str, topic: str, **options: Any) -> Any:
        """Publish messages, given as bytes, as REP-2003 wants sensor data: reliable, for subscribers of either kind."""
        # A new QoS each time, as rclpy writes overrides into the object.
        return self.create_publisher(
            message_class(kind), topic, QoSProfile(depth=LOAD.depth), **options
        )

    def create_diagnostics(self) -> Any:
        """Publish diagnostics, given as bytes."""
        return self.create_publisher(
            message_class(DIAGNOSTICS.type), DIAGNOSTICS.name, QoSProfile(depth=10)
        )

    def resolved(self, topic: str) -> str:
        """Return the full name of a topic after remapping.

        Raise `ConfigError` if the name is invalid.
        """
        try:
            return str(self.resolve_topic_name(topic))
        except (ValueError, RuntimeError) as error:
            raise ConfigError(
                f"topic {topic!r} is no ROS name: {' '.join(str(error).split())}"
            ) from error

    def _check_overrides(
        self,
        given: Mapping[str, Any],
        subscribes: Sequence[str],
        publishes: Sequence[str],
    ) -> None:
        """Refuse QoS overrides that would have no effect, or would fail only when the topic is made."""
        topics = [f"{self.resolved(topic)}.subscription" for topic in subscribes]
        topics += [f"{self.resolved(topic)}.publisher" for topic in publishes]
        known = {
            f"qos_overrides.{topic}.{policy}": _POLICIES[policy]
            for topic in topics
            for policy in _POLICIES
        }
        for name in filter(lambda name: name.startswith("qos_overrides."), given):
            if name not in known:
                raise ConfigError(
                    f"unknown QoS override {name!r}, expected one of: {', '.join(known) or 'none'}"
                )
            value = given[name]
            choices = known[name]
            if choices and value not in choices:
                raise ConfigError(
                    f"{name} is {value!r}, expected one of: {', '.join(choices)}"
                )
            if not choices and (
                type(value) is not int or not 1 <= value <= LOAD.max_depth
            ):
                raise ConfigError(
                    f"{name} is {value!r}, expected a whole number, 1 to {LOAD.max_depth}"
                )

    # Requests -------------------------------------------------------------------------
    # ----------------------------

    def set_parameters_atomically(
        self, parameter_list: list[Parameter]
    ) -> SetParametersResult:
        """Set parameters together. Log every refusal, too."""
        typed = [
            _typed(one, self._declared[one.name]) if one.name in self._declared else one
            for one in parameter_list
        ]
        try:
            for one in typed:
                field = self._declared.get(one.name)
                if field and field.runtime and one.type_ != _TYPES[field.kind]:
                    _checked(one.name, field, one.value)
            result = super().set_parameters_atomically(typed)
        except FdiError as error:
            result = _refusal(str(error))
        except ParameterNotDeclaredException:
            unknown = next(
                p.name for p in parameter_list if not self.has_parameter(p.name)
            )
            result = _refusal(unknown_parameter(unknown))
        if not result.successful:
            result.reason = shown(result.reason, LINE)
            self.log.warning(f"parameters refused: {result.reason}")
        return result

    def create_service(
        self, kind: Any, name: str, callback: Any, **options: Any
    ) -> Any:
        """Offer a service that answers every request. rclpy leaves faulty requests unanswered."""
        if kind in (SetParameters, SetParametersAtomically):
            callback = self._on_set_parameters
        return super().create_service(
            kind, name, partial(self._answer, callback), **options
        )

    def _answer(self, callback: Any, request: Any, response: Any) -> Any:
        try:
            return callback(request, response)
        except (
            ValueError,
            TypeError,
            OverflowError,
            AssertionError,
            RuntimeError,
        ) as error:
            self.log.error(
                f"answered with nothing, as it cannot be worked: {type(error).__name__}: {error}"
            )
            return type(response)()

    def _on_set_parameters(self, request: Any, response: Any) -> Any:
        given = request.parameters
        results = []
        together = isinstance(request, SetParametersAtomically.Request)
        for k, messages in enumerate([given] if together else [[one] for one in given]):
            self.keep_up()
            many = k + len(messages) > LOAD.parameters
            words = f"{len(given)} parameters in one request, expected at most {LOAD.parameters}"
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
        return self.set_parameters_atomically(
            [Parameter.from_parameter_msg(one) for one in messages]
        )


def _refusal(reason: str) -> SetParametersResult:
    return SetParametersResult(successful=False, reason=reason)


def _checked(name: str, field: Field, value: Any) -> Any:
    # YAML reads off as false.
    return check(
        field,
        "off" if value is False and "off" in field.choices else value,
        name,
        ConfigError,
    )


_TYPES = {
    "bool": Parameter.Type.BOOL,
    "int": Parameter.Type.INTEGER,
    "float": Parameter.Type.DOUBLE,
    "text": Parameter.Type.STRING,
    "numbers": Parameter.Type.DOUBLE_ARRAY,
    "texts": Parameter.Type.STRING_ARRAY,
}  # by the kind of a `Field`


def _typed(parameter: Parameter, field: Field) -> Parameter:
    """Return a parameter in the type of its field, or unchanged if no equal value of that type exists."""
    value = parameter.value
    kind = _TYPES[field.kind]
    is_list = isinstance(value, Sequence) and not isinstance(value, str | bytes)
    if hasattr(value, "tolist"):
        value = value.tolist()
        is_list = True
    if value is False and "off" in field.choices:
        # YAML reads off as false.
        value = "off"
    elif field.kind == "float" and type(value) is int:
        value = float(value)
    elif field.kind in ("numbers", "texts"):
        value = list(value) if is_list else [value]
        all_numbers = all(type(one) in (int, float) for one in value)
        if field.kind == "numbers" and all_numbers:
            value = [float(one) for one in value]
    try:
        return Parameter(parameter.name, kind, value)
    except ValueError:
        return parameter


def _descriptor(name: str, field: Field) -> ParameterDescriptor:
    """Describe a parameter to ROS: meaning, unit, range, and read-only unless the parameter may change at run time."""
    unit = f" [{field.unit}]" if field.unit else ""
    described = ParameterDescriptor(
        description=field.description + unit, read_only=not field.runtime
    )
    bounded = math.isfinite(field.low) and math.isfinite(field.high)
    # Not in the table of settings, because detectors are a layer above.
    choices = tuple(DETECTORS) if name == "detector.name" else field.choices
    if choices:
        described.additional_constraints = f"one of: {', '.join(choices)}"
    elif bounded and field.kind in ("float", "numbers"):
        described.additional_constraints = f"{field.low:g} to {field.high:g}{unit}"
    if bounded and field.kind == "float":
        described.floating_point_range = [
            FloatingPointRange(from_value=field.low, to_value=field.high)
        ]
    if bounded and field.kind == "int":
        described.integer_range = [
            IntegerRange(from_value=int(field.low), to_value=int(field.high))
        ]
    return described
