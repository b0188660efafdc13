# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Faults into live topics, for simulators and hardware in the loop: off until asked, loud when on.

Each input topic is republished under its name and a suffix, byte for byte while the injector is off. Settings come
from the parameter file of the monitor, so that both have the same channels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from fdi_ros.config.settings import INJECTOR
from fdi_ros.core.messages import MessageError
from fdi_ros.core.sources import source_of
from fdi_ros.errors import FdiError
from fdi_ros.faults.fault import Injector, load_scenario, parse_fault
from fdi_ros.model.samples import Block
from fdi_ros.monitor.accelerometers import possible_names
from fdi_ros.monitor.building import build_geometry
from fdi_ros.monitor.diagnostics import Level, StatusLine, encode_diagnostics
from fdi_ros.monitor.receiver import warm_codec
from fdi_ros.ros.node import CheckedNode


class InjectorNode(CheckedNode):
    """Republishes the input topics of a monitor with faults. Raise `FdiError` if a parameter or a fault is wrong.

    A topic is subscribed to when its output has found its first subscriber: who waits for this node waits for the
    monitor behind it, and nothing is lost in between.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__("injector_node", INJECTOR, subscribes=True, **options)
        gyros = build_geometry(self.config).channel_names
        self._n = len(gyros)
        self._names = possible_names(self.config, gyros)
        self._malformed = self._struck = 0
        suffix = self.values()["suffix"]
        if not suffix:
            raise FdiError(
                "suffix is empty, expected a text: an output may not have the name of its input"
            )
        self._source = source_of(self.config)
        # The first message must not wait for a compiler.
        warm_codec(self._source)
        self._unheard: dict[
            str, tuple[int, Any]
        ] = {}  # topics whose output has no subscriber yet: number, output
        for k, topic in enumerate(self._source.topics):
            self.resolved(topic + suffix)
            self._unheard[topic] = (
                k,
                self.create_output(self._source.type, topic + suffix),
            )
        self._look_timer = self.every(0.05, self._look)
        self._diagnostics = self.create_diagnostics()
        self.create_timer(1.0, self._report)
        self._switch(self.values())
        self.create_service(Trigger, "~/start", partial(self._on_switch, True))
        self.create_service(Trigger, "~/stop", partial(self._on_switch, False))

    def change(self, changes: Sequence[Parameter]) -> None:
        """Take over faults, and switch on or off."""
        own = [one for one in changes if one.name in INJECTOR]
        if own:
            self._switch(self.values(own))

    def _switch(self, values: dict[str, Any]) -> None:
        faults = tuple(
            parse_fault(text) for text in values["faults"].split(";") if text.strip()
        )
        if values["scenario"]:
            faults += load_scenario(values["scenario"])
        if values["enabled"] and not faults:
            raise FdiError("nothing to inject: both faults and scenario are empty")
        # One per topic: messages of the topics arrive separately, and each effect has
        # its own memory.
        self._injectors = [Injector(faults, self._names) for _ in self.config.topics]
        self._origin: int | None = None
        self._injecting = (
            f"INJECTING FAULTS: {'; '.join(map(str, faults))}"
            if values["enabled"]
            else ""
        )
        """The faults in words, empty while the injector is off."""
        if self._injecting:
            self.log.error(self._injecting)
        else:
            self.log.info("off: messages pass as they are")
        self._report()

    def _look(self) -> None:
        """Subscribe to the topics whose output has found a subscriber."""
        for topic, (k, publisher) in tuple(self._unheard.items()):
            if publisher.get_subscription_count():
                del self._unheard[topic]
                self.inputs.open(
                    self._source.type, topic, partial(self._pass_on, k, publisher)
                )
        if not self._unheard:
            self.destroy_timer(self._look_timer)

    def _pass_on(self, k: int, publisher: Any, data: bytes) -> None:
        struck: bytes | None = data
        if self._injecting:
            try:
                struck = self._strike(k, data)
            except MessageError:
                # The injector refuses no message: malformed ones pass unchanged.
                self._malformed += 1
        if struck is not None:
            publisher.publish(struck)

    def _strike(self, k: int, data: bytes) -> bytes | None:
        """Return the message with the faults, None if a fault drops the message."""
        n = self._n
        m = len(self._names) - self._n
        gyros, felt = brought = self._source.brought(k, n, m)
        measured, values = self._source.parse(data, brought.size)
        stamp = measured if self._source.stamped else self.get_clock().now().nanoseconds
        if self._origin is None:
            self._origin = stamp
        self._injectors[k].start_stamp = self._origin

        def block(size: int, own: slice, given: Sequence[float]) -> Block:
            z = np.full((1, size), np.nan)
            received = np.zeros((1, size), dtype=bool)
            z[0, own] = given
            received[0, own] = True
            return Block(np.array([stamp], dtype=np.int64), z, received)

        width = gyros.stop - gyros.start
        force = block(m, felt, values[width:]) if m else None
        whole = replace(block(n, gyros, values[:width]), acceleration=force)
        out = self._injectors[k].apply(whole)
        after = out.z[0, gyros].tolist()
        judged = out.delivered[0, gyros]
        if out.acceleration is not None and not width:
            judged = out.acceleration.delivered[0, felt]
        if out.acceleration is not None and not np.isnan(values[width:]).all():
            after += out.acceleration.z[0, felt].tolist()
        lost = not judged.any()
        self._struck += lost or after != list(values[: len(after)])
        return None if lost else self._source.patch(data, after)

    def _on_switch(
        self, on: bool, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        result = self.set_parameters([Parameter("enabled", value=on)])[0]
        response.success = result.successful
        response.message = result.reason or ("injecting" if on else "off")
        return response

    def _report(self) -> None:
        level, words = (
            (Level.WARN, self._injecting) if self._injecting else (Level.OK, "off")
        )
        values = (
            ("messages struck", str(self._struck)),
            ("malformed", str(self._malformed)),
        )
        line = StatusLine(
            level, self.prefix + "injector", words, self.config.hardware_id, values
        )
        self._diagnostics.publish(
            encode_diagnostics([line], self.get_clock().now().nanoseconds)
        )
