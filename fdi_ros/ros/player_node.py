# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Play the input topics of a recording, as they were recorded, with /clock.

Unlike other players it needs no more than this package: the messages go out byte for byte, read by the same code
that replays them offline.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from builtin_interfaces.msg import Time
from rclpy.executors import SingleThreadedExecutor
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from fdi_ros.bag.reader import Recording
from fdi_ros.config.settings import PLAYER
from fdi_ros.core.messages import LAST_STAMP
from fdi_ros.core.sources import source_of
from fdi_ros.errors import BagError
from fdi_ros.ros.node import CheckedNode
from fdi_ros.ros.process import Stop, guarded


class _Pace(NamedTuple):
    """How closely the player keeps to the recorded times."""

    #: a request, or a signal, waits at most this long for its answer, s
    patience: float = 0.1
    #: longest pause that is played, s
    longest_step: float = 60.0
    #: largest disorder of messages, s
    disorder: float = 1.0
    #: largest delay of a message, s: messages due meanwhile fit into a queue at 10
    #: kHz
    behind: float = 0.01
    #: /clock is published at most this often, ns of recorded time
    clock_step: int = 1_000_000


PACE = _Pace()


class PlayerNode(CheckedNode):
    """Plays the input topics of a monitor's settings.

    Raise `FdiError` if the recording lacks them.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__("player_node", PLAYER, subscribes=False, **options)
        values = self.values()
        if not values["bag"]:
            raise BagError("no recording given: set the parameter bag")
        self._rate, self._patience, self._loop = (
            values[name] for name in ("rate", "wait", "loop")
        )
        self._paused = False
        source = source_of(self.config)
        self.recording = Recording(values["bag"])
        self.recording.require(source.topics, source.type)
        self.outputs = [
            self.create_output(source.type, topic) for topic in source.topics
        ]
        self._clock_output = (
            self.create_publisher(Clock, "/clock", 10) if values["clock"] else None
        )
        self.create_service(Trigger, "~/pause", partial(self._on_pause, True))
        self.create_service(Trigger, "~/resume", partial(self._on_pause, False))

    def _on_pause(
        self, pause: bool, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        response.success = True
        response.message = "paused" if pause else "playing"
        if pause != self._paused:
            self.log.info(response.message)
        self._paused = pause
        return response

    def live(self, stop: Stop) -> None:
        """Publish every message when its time comes, and answer requests meanwhile."""
        executor = SingleThreadedExecutor()
        executor.add_node(self)

        def spin(seconds: float) -> None:
            with guarded(self):
                executor.spin_once(timeout_sec=seconds)

        try:
            self._await_subscribers(stop, spin)
            while self._play_once(stop, spin) and self._loop:
                self.log.info("the recording has ended: from its beginning")
                spin(0.0)
        finally:
            executor.remove_node(self)

    def _await_subscribers(self, stop: Stop, spin: Callable[[float], None]) -> None:
        """Wait for a subscriber to every topic, as long as the user has patience."""
        start = time.monotonic()
        if lacking := self._without_subscriber():
            self.log.info(
                f"waiting for subscribers of {lacking}, at most {self._patience:g} s"
            )
        while (
            self._without_subscriber()
            and not stop.asked
            and time.monotonic() < start + self._patience
        ):
            spin(0.05)
        if (lacking := self._without_subscriber()) and not stop.asked:
            self.log.warning(f"no subscriber to {lacking}: playing all the same")
        # A publisher sees a subscriber a moment before the subscriber can receive.
        time.sleep(0.3 if not stop.asked else 0)

    def _play_once(self, stop: Stop, spin: Callable[[float], None]) -> bool:
        """Play the recording.

        Return whether the end was reached. Raise `BagError` if no message is found.
        """
        start = answered = math.nan
        for due in self.messages():
            now = time.monotonic()
            if math.isnan(start):
                # Counted from the first message that is ready, as reading takes a while.
                start = answered = now
            while True:
                ahead = start + due / self._rate - now
                paused = self._paused
                # What was late, as a chunk was read, is not made up for in a burst that
                # no queue holds.
                start += max(0.0, -ahead - PACE.behind)
                if paused or ahead > 0 or now - answered > PACE.patience:
                    spin(
                        PACE.patience if paused else min(max(ahead, 0.0), PACE.patience)
                    )
                    answered = time.monotonic()
                    # Pauses do not count either.
                    start += answered - now if paused else 0.0
                if stop.asked:
                    return False
                now = time.monotonic()
                if not self._paused and start + due / self._rate <= now:
                    break
        if math.isnan(start):
            raise BagError(
                f"{self.recording.path} holds no message of {', '.join(self.config.topics)}"
            )
        return not stop.asked

    def _without_subscriber(self) -> str:
        """Topics that have no subscriber."""
        return ", ".join(
            output.topic_name
            for output in self.outputs
            if not output.get_subscription_count()
        )

    def messages(self) -> Iterator[float]:
        """Publish the messages one by one. Before each, yield its due time, s from the first."""
        last = clock = None
        due = 0.0
        for batch in self.recording.batches(self.config.topics):
            for k in np.argsort(batch.log_time, kind="stable").tolist():
                now = int(batch.log_time[k])
                step = 0.0 if last is None else (now - last) / 1e9
                if -PACE.disorder < step < PACE.longest_step:
                    due += step
                else:
                    clock = None
                    self.log.info(
                        f"the time of the recording steps by {step:.0f} s, which is not waited for"
                    )
                last = now
                yield due
                if self._clock_output is not None and (
                    clock is None or now - clock >= PACE.clock_step
                ):
                    clock = now
                    if not 0 <= now <= LAST_STAMP:
                        words = f"a message of {now} ns since 1970 is beyond what /clock can say"
                        raise BagError(f"{self.recording.path}: {words}")
                    sec, nanosec = divmod(now, 10**9)
                    self._clock_output.publish(
                        Clock(clock=Time(sec=sec, nanosec=nanosec))
                    )
                self.outputs[int(batch.topic[k])].publish(batch.message(k))

    def destroy_node(self) -> None:
        """Close the recording too."""
        self.recording.close()
        super().destroy_node()
