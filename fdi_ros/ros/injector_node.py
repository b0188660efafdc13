# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Faults into live topics, for simulators and hardware in the loop: off until asked, loud when on.

Each input topic is republished under its name and a suffix, byte for byte while the injector is off. Settings come
from the parameter file of the monitor, so that both have the same channels.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from fdi_ros.config.settings import INJECTOR
from fdi_ros.core.messages import MessageError
from fdi_ros.errors import FdiError
from fdi_ros.faults.fault import Fault, Injector, load_scenario, parse_fault
from fdi_ros.model.samples import Block
from fdi_ros.monitor.build import build_geometry
from fdi_ros.monitor.diagnostics import Level, StatusLine, encode_diagnostics
from fdi_ros.monitor.receiver import warm_codec
from fdi_ros.ros import parameters
from fdi_ros.ros.inputs import InputQueue
from fdi_ros.ros.messages import diagnostics_publisher, message_class, output_qos, prefix_of
from fdi_ros.sources import source_of

LOOK_PERIOD = 0.05
"""How often it is looked whether an output has found its first subscriber, s."""


class InjectorNode(parameters.CheckedParameters, Node):
    """Republishes the input topics of a monitor with faults in them.

    A topic is subscribed to when its output has found its first subscriber: who waits for this node waits for the
    monitor behind it, and nothing is lost in between.

    Raises
    ------
    FdiError
        If a parameter is wrong, or a fault strikes a channel that is not there.
    """

    def __init__(self, **options: Any) -> None:
        self.inputs = InputQueue(self)
        super().__init__("injector_node", **options)
        self.config = parameters.declare(self, INJECTOR)
        self.names = build_geometry(self.config).channel_names
        self.faults: tuple[Fault, ...] = ()
        self.enabled = False
        self._injectors: list[Injector] = []
        self._origin: int | None = None
        self._unheard: dict[str, tuple[int, Any]] = {}
        """Topics whose output has no subscriber yet, each with its number and its output."""
        self.malformed = 0
        self.struck = 0
        suffix = self.get_parameter("suffix").value
        if not suffix:
            raise FdiError("suffix is empty, expected a text: an output may not have the name of its input")
        self.source = source_of(self.config)
        # The first message must not wait for a compiler.
        warm_codec(self.source)
        kind = message_class(self.source.type)
        for k, topic in enumerate(self.source.topics):
            parameters.resolved(self, topic + suffix)
            self._unheard[topic] = k, self.create_publisher(kind, topic + suffix, output_qos())
        self._look_timer = self.every(LOOK_PERIOD, partial(self._look, kind))
        self._diagnostics = diagnostics_publisher(self)
        self.create_timer(1.0, self._report)
        self._switch(self.values(INJECTOR))
        self.add_on_set_parameters_callback(self._on_parameters)
        self.create_service(Trigger, "~/start", partial(self._on_switch, True))
        self.create_service(Trigger, "~/stop", partial(self._on_switch, False))

    @property
    def subscriptions(self) -> Iterator[Any]:
        """Subscriptions that an executor is to wait for."""
        return self.inputs.visible(super().subscriptions)

    def _switch(self, values: dict[str, Any]) -> None:
        """Take over faults, and switch on or off."""
        faults = tuple(parse_fault(text) for text in values["faults"].split(";") if text.strip())
        if values["scenario"]:
            faults += load_scenario(values["scenario"])
        if values["enabled"] and not faults:
            raise FdiError("nothing to inject: both faults and scenario are empty")
        # One per topic: the messages of the topics come apart, and each effect keeps its own memory of them.
        injectors = [Injector(faults, self.names) for _ in self.config.topics]
        self.faults, self.enabled, self._injectors, self._origin = faults, values["enabled"], injectors, None
        if self.enabled:
            self.log.error(f"INJECTING FAULTS: {'; '.join(map(str, faults))}")
        else:
            self.log.info("off: messages pass as they are")
        self._report()

    def _look(self, kind: Any) -> None:
        """Subscribe to the topics whose output has found a subscriber."""
        for topic, (k, publisher) in tuple(self._unheard.items()):
            if publisher.get_subscription_count():
                del self._unheard[topic]
                self.inputs.open(kind, topic, partial(self._pass_on, k, publisher))
        if not self._unheard:
            self.destroy_timer(self._look_timer)

    def _pass_on(self, k: int, publisher: Any, data: bytes) -> None:
        if self.enabled:
            try:
                struck = self._strike(k, data)
            except MessageError:
                # Not the injector's to refuse: what comes in goes out.
                self.malformed += 1
            else:
                if struck is None:
                    return
                data = struck
        publisher.publish(data)

    def _strike(self, k: int, data: bytes) -> bytes | None:
        """Return the message with the faults in it; None: it is lost."""
        n = len(self.names)
        channels = self.source.channels_of(k, n)
        measured, values = self.source.parse(data, channels.stop - channels.start)
        stamp = measured if self.source.stamped else self._now()
        if self._origin is None:
            self._origin = stamp
        z, received = np.full((1, n), np.nan), np.zeros((1, n), dtype=bool)
        z[0, channels], received[0, channels] = values, True
        self._injectors[k].start_stamp = self._origin
        out = self._injectors[k].apply(Block(np.array([stamp], dtype=np.int64), z, received))
        if out.received is not None and not out.received[0, channels].any():
            self.struck += 1
            return None
        after = out.z[0, channels].tolist()
        self.struck += after != list(values)
        return self.source.patch(data, after)

    def _now(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def _on_switch(self, on: bool, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        result = self.set_parameters([Parameter("enabled", value=on)])[0]
        response.success = result.successful
        response.message = result.reason or ("injecting" if on else "off")
        return response

    def _on_parameters(self, changes: list[Parameter]) -> SetParametersResult:
        try:
            changed = {
                p.name: parameters.checked(p.name, INJECTOR[p.name], p.value) for p in changes if p.name in INJECTOR
            }
            if changed:
                self._switch({**self.values(INJECTOR), **changed})
        except FdiError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _report(self) -> None:
        words = f"INJECTING FAULTS: {'; '.join(map(str, self.faults))}" if self.enabled else "off"
        level = Level.WARN if self.enabled else Level.OK
        values = (("messages struck", str(self.struck)), ("malformed", str(self.malformed)))
        line = StatusLine(level, prefix_of(self) + "injector", words, self.config.hardware_id, values)
        self._diagnostics.publish(encode_diagnostics([line], self._now()).data)
