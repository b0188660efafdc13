# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The player as a node: messages of a recording onto the topics that a monitor listens to."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from fdi_ros.bag.reader import Recording
from fdi_ros.core.messages import LAST_STAMP
from fdi_ros.errors import BagError, ConfigError
from fdi_ros.ros import parameters
from fdi_ros.ros.messages import message_class, output_qos
from fdi_ros.sources import source_of

OWN = {
    "bag": parameters.own("", "rosbag2 folder, .mcap or .db3 file"),
    "rate": parameters.own(1.0, "speed; 2.0: twice as fast as recorded"),
    "loop": parameters.own(False, "begin anew at the end of the recording"),
    "clock": parameters.own(True, "publish /clock, the time of recording"),
    "wait": parameters.own(10.0, "wait at most this long for a subscriber to every topic, s"),
}
LONGEST_STEP, DISORDER = 60.0, 1.0
"""s without a message, more of which is not waited for; s by which messages may stand out of order."""
CLOCK_STEP = 1_000_000
"""/clock is published at most this often, ns of recorded time."""


class PlayerNode(parameters.CheckedParameters, Node):
    """Plays the input topics of a monitor's settings.

    Raises
    ------
    FdiError
        If a parameter is wrong, or the recording does not hold the topics.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__("player_node", automatically_declare_parameters_from_overrides=True, **options)
        self.config = parameters.declare(self, OWN, subscribes=False)
        values = {name: self.get_parameter(name).value for name in OWN}
        if not 1e-3 <= values["rate"] <= 1e3:
            raise ConfigError(f"rate is {values['rate']:g}, expected 0.001 to 1000")
        if not values["bag"]:
            raise BagError("no recording given: set the parameter bag")
        self.rate: float = values["rate"]
        self.patience: float = values["wait"]
        self.loop: bool = values["loop"]
        self.paused = False
        source = source_of(self.config)
        self.recording = Recording(values["bag"])
        self.recording.require(source.topics, source.type)
        kind = message_class(source.type)
        self.outputs = [self.create_publisher(kind, topic, output_qos()) for topic in source.topics]
        self._clock_output = self.create_publisher(Clock, "/clock", 10) if values["clock"] else None
        self.create_service(Trigger, "~/pause", partial(self._on_pause, True))
        self.create_service(Trigger, "~/resume", partial(self._on_pause, False))

    def _on_pause(self, pause: bool, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = True, "paused" if pause else "playing"
        if pause != self.paused:
            self.log.info(response.message)
        self.paused = pause
        return response

    def without_subscriber(self) -> list[str]:
        """Topics that have no subscriber."""
        return [output.topic_name for output in self.outputs if not output.get_subscription_count()]

    def messages(self) -> Iterator[float]:
        """Publish the messages one by one; before each, yield when it is due, s from the first.

        Hours without a message, and times that are damaged, are not waited for.
        """
        last = clock = None
        due = 0.0
        for batch in self.recording.batches(self.config.topics):
            for k in np.argsort(batch.log_time, kind="stable").tolist():
                now = int(batch.log_time[k])
                step = 0.0 if last is None else (now - last) / 1e9
                if -DISORDER < step < LONGEST_STEP:
                    due += step
                else:
                    clock = None
                    self.log.info(f"the time of the recording steps by {step:.0f} s, which is not waited for")
                last = now
                yield due
                if clock is None or now - clock >= CLOCK_STEP:
                    clock = now
                    self._publish_clock(now)
                self.outputs[int(batch.topic[k])].publish(batch.message(k))

    def _publish_clock(self, now: int) -> None:
        if self._clock_output is not None:
            if not 0 <= now <= LAST_STAMP:
                raise BagError(f"{self.recording.path}: a message of {now} ns since 1970 is beyond what /clock can say")
            message = Clock()
            message.clock.sec, message.clock.nanosec = divmod(now, 10**9)
            self._clock_output.publish(message)

    def destroy_node(self) -> None:
        """Close the recording too."""
        self.recording.close()
        super().destroy_node()
