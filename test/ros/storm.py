# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Storms upon a monitor, each made by a process of its own: python -m ros.storm KIND SECONDS SEED.

`benchmark/storm.py` runs them for as long as one likes, `test_storm.py` for a moment each.
"""

from __future__ import annotations

import math
import os
import random
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetAvailableTransitions, GetState
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters, SetParametersAtomically
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from ros.harness import DEEP, TRANSITIONS, TWO_IMUS, Listener, Process
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger

from fdi_ros.core.messages import ImuTemplate

OUTSTANDING = 8
"""Requests that wait for their answers: DDS keeps ten of a service."""
NAMES = [
    *TWO_IMUS.parameters(),
    "use_sim_time",
    "state_file",
    "autostart",
    "executor",
    "start_type_description_service",
]
WORDS = (
    "",
    "x",
    "\n\x1b[2J",
    "a" * 5000,
    "é\u202e",
    "sequential",
    "likelihood_ratio",
    "cusum",
    "imu_1.z",
    "~/a//b",
    "%s%n",
)
REALS = (0.0, -1.0, 1e-300, 1e308, math.nan, math.inf, 0.01, 1e5)
WHOLE = (0, 1, -1, 2**31, 2**63 - 1, -(2**63))


class Storm(Node):
    """Sends what one kind of storm is made of."""

    def __init__(self, seed: int) -> None:
        super().__init__(f"storm_{os.getpid()}")
        self.draw = random.Random(seed)
        self.sent = self.answered = 0
        self._by_service: dict[str, Any] = {}
        self._waiting: list[Any] = []
        self._turning = SingleThreadedExecutor()
        self._turning.add_node(self)

    def ask(self, kind: type, service: str, request: Any) -> Any:
        """Send a request as soon as not too many wait."""
        if service not in self._by_service:
            self._by_service[service] = self.create_client(kind, f"/fdi_node/{service}")
            assert self._by_service[service].wait_for_service(30.0), service
        while len(self._waiting) >= OUTSTANDING:
            self.turn()
        future = self._by_service[service].call_async(request)
        self._waiting.append(future)
        self.sent += 1
        self.turn(0.0)
        return future

    def turn(self, seconds: float = 0.05) -> None:
        self._turning.spin_once(timeout_sec=seconds)
        done = [one for one in self._waiting if one.done()]
        self.answered += len(done)
        self._waiting = [one for one in self._waiting if not one.done()]

    def settle(self, seconds: float = 60.0) -> None:
        """Wait for all answers."""
        end = time.monotonic() + seconds
        while self._waiting and time.monotonic() < end:
            self.turn()

    # What storms are made of ------------------------------------------------------------------------------------------

    def value(self) -> ParameterValue:
        draw = self.draw
        kind = draw.choice((*range(10), 10, 11, 128, 255))
        many = draw.choice((0, 1, 2, 9, 300))
        return ParameterValue(
            type=kind,
            bool_value=draw.random() < 0.5,
            integer_value=draw.choice(WHOLE),
            double_value=draw.choice(REALS),
            string_value=draw.choice(WORDS),
            double_array_value=[draw.choice(REALS) for _ in range(many)],
            string_array_value=[draw.choice(WORDS) for _ in range(min(many, 9))],
            integer_array_value=[draw.choice(WHOLE) for _ in range(many)],
        )

    def parameter(self) -> Parameter:
        draw = self.draw
        if draw.random() < 0.2:
            # One that fits.
            name, kind, value = draw.choice(
                (
                    ("detector.false_alarms_per_hour", 3, {"double_value": draw.choice((0.01, 0.1, 1.0))}),
                    ("detector.name", 4, {"string_value": draw.choice(("sequential", "likelihood_ratio", "cusum"))}),
                    ("publish_under_doubt", 1, {"bool_value": draw.random() < 0.5}),
                    ("excluded_channels", 9, {"string_array_value": draw.choice(([], ["imu_1.z"]))}),
                )
            )
            return Parameter(name=name, value=ParameterValue(type=kind, **value))
        name = draw.choice(NAMES) if draw.random() < 0.7 else draw.choice((*WORDS, "detector.nmae", "b" * 100_000))
        return Parameter(name=name, value=self.value())

    def send_parameters(self) -> None:
        draw = self.draw
        names = [draw.choice((*NAMES, *WORDS)) for _ in range(draw.choice((0, 1, 50)))]
        changes = [self.parameter() for _ in range(draw.choice((0, 1, 1, 1, 3, 60)))]
        kind = draw.randrange(6)
        if kind <= 1:
            self.ask(SetParameters, "set_parameters", SetParameters.Request(parameters=changes))
        elif kind == 2:
            self.ask(
                SetParametersAtomically,
                "set_parameters_atomically",
                SetParametersAtomically.Request(parameters=changes),
            )
        elif kind == 3:
            self.ask(GetParameters, "get_parameters", GetParameters.Request(names=names))
        elif kind == 4:
            self.ask(DescribeParameters, "describe_parameters", DescribeParameters.Request(names=names))
        else:
            request = ListParameters.Request(prefixes=names[:3], depth=draw.choice((0, 1, 2**63)))
            self.ask(ListParameters, "list_parameters", request)

    def send_services(self) -> None:
        self.ask(Trigger, self.draw.choice(("reset", "relearn_bias")), Trigger.Request())

    def send_lifecycle(self) -> None:
        wanted = self.draw.choice((*(n for paths in TRANSITIONS.values() for n in paths), 0, 9, 60, 99, 255))
        label = self.draw.choice(("", "", "", "configure", "activate", "c" * 5000, "\n"))
        self.ask(ChangeState, "change_state", ChangeState.Request(transition=Transition(id=wanted, label=label)))
        if self.draw.random() < 0.1:
            self.ask(GetAvailableTransitions, "get_available_transitions", GetAvailableTransitions.Request())

    def send_links(self) -> None:
        """Publishers that come, say what is true, false, damaged or nothing, and go."""
        draw = self.draw
        topic = draw.choice(TWO_IMUS.topics)
        output = self.create_publisher(Imu, topic, DEEP)
        template = ImuTemplate("imu")
        kind = draw.choice(("true", "true", "noise", "damaged", "late", "flood"))
        for _ in range(draw.choice((0, 3, 100)) if kind != "flood" else 5000):
            stamp = time.time_ns() - (draw.choice((10**9, 10**12, -(10**15))) if kind == "late" else 0)
            rate = tuple(draw.choice((*REALS, 1e-3)) for _ in range(3)) if kind == "noise" else (0.0, 0.0, 0.0)
            data = bytes(template.fill(max(stamp, 0) % (2**31 * 10**9), rate, (0.0,) * 9))
            output.publish(data[: draw.choice((0, 3, 20, len(data)))] if kind == "damaged" else data)
            self.sent += 1
            if kind != "flood":
                time.sleep(0.002)
        self.answered = self.sent
        self.destroy_publisher(output)


def activate(storm: Storm) -> None:
    """Bring the node back to where it works."""
    for _ in range(50):
        future = storm.ask(GetState, "get_state", GetState.Request())
        storm.settle()
        now = future.result().current_state.label
        if now == "active":
            return
        wanted = {"unconfigured": 1, "inactive": 3}.get(now)
        assert wanted, now
        storm.ask(ChangeState, "change_state", ChangeState.Request(transition=Transition(id=wanted)))
        storm.settle()


KINDS = ("parameters", "services", "lifecycle", "links")


def rage(kind: str, seconds: float, seed: int) -> str:
    """Be one storm; how many requests or messages were sent, and how many requests answered."""
    rclpy.init()
    storm = Storm(seed)
    act: Callable[[], None] = getattr(storm, f"send_{kind}")
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        act()
    storm.settle()
    sent, answered = storm.sent, storm.answered
    if kind == "lifecycle":
        activate(storm)
    return f"{sent} {answered}"


def weather(listener: Listener, process: Process, kind: str, seconds: float, seed: int) -> dict[str, float]:
    """Let one storm loose on a monitor; what it cost."""
    words = [sys.executable, "-m", "ros.storm", kind, str(seconds), str(seed)]
    lines = process.said().count("\n")
    begun = time.monotonic()
    path = os.pathsep.join(filter(None, (str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH"))))
    env = {**os.environ, "PYTHONPATH": path}
    done = subprocess.run(words, capture_output=True, text=True, timeout=seconds + 300, check=False, env=env)
    assert done.returncode == 0, done.stderr
    took = time.monotonic() - begun
    sent, answered = map(int, done.stdout.split()[-2:])
    times = [at for at, _ in list(listener.diagnostics) if begun - 2 <= at]
    return {
        "sent": sent,
        "answered": answered,
        "longest gap of the diagnostics, s": max(np.diff([*times, time.monotonic()]), default=math.inf),
        "lines of the log a second": (process.said().count("\n") - lines) / took,
        "memory, MB": process.memory(),
    }


if __name__ == "__main__":
    print(rage(sys.argv[1], float(sys.argv[2]), int(sys.argv[3])))
