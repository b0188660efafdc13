# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Storms upon a monitor and its link to an autopilot.

`python benchmark/mavlink.py storms` runs them for as long as one likes, `test_storm.py` for a moment each.
"""

import contextlib
import math
import random
import re
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetAvailableTransitions
from mavlink.autopilots import Autopilot, OverUdp, free_port
from pymavlink.dialects.v20 import ardupilotmega as dialect
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
from rclpy.parameter import Parameter as Given
from ros.harness import DEEP, TRANSITIONS, Listener, monitoring
from ros.processes import ROOT, Process, running, wait
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger

from fdi_ros.config.config import Config
from fdi_ros.config.settings import ALL_NODES, MONITOR
from fdi_ros.core.messages import ImuTemplate

KINDS = ("parameters", "services", "lifecycle", "links", "mavlink")
STACK = ROOT / "config" / "px4.yaml"
CONFIG = Config.from_file(STACK)
NODES = ("fdi_node", "mavlink_node")

OUTSTANDING = 8  # requests that wait for their answers: DDS keeps ten of a service
NAMES = [
    *CONFIG.parameters(),
    *MONITOR,
    *ALL_NODES,
    "url",
    "rate",
    "named_values",
    "use_sim_time",
]
WORDS = [
    "",
    "x",
    "\n\x1b[2J",
    "a" * 5000,
    "é\u202e",
    "sequential",
    "likelihood_ratio",
    "imu_1.z",
    "~/a//b",
    "%s%n",
]
REALS = (0.0, -1.0, 1e-300, 1e308, math.nan, math.inf, 0.01, 1e5)
WHOLE = (0, 1, -1, 2**31, 2**63 - 1, -(2**63))
FITTING = [
    *(
        Given("detector.false_alarms_per_hour", value=value)
        for value in (0.01, 0.1, 1.0)
    ),
    *(
        Given("detector.name", value=value)
        for value in ("sequential", "likelihood_ratio", "cusum")
    ),
    *(Given("publish_under_doubt", value=value) for value in (False, True)),
    *(
        Given("excluded_channels", Given.Type.STRING_ARRAY, value)
        for value in ([], ["imu_1.z"])
    ),
]
PACKETS = (
    "garbage",
    "cut messages",
    "any message of others",
    "any message in its name",
    "strangers",
    "flood",
)
NUMBERS = sorted(number for number in dialect.mavlink_map if number >= 0)


class Storm:
    """Sends what one kind of storm is made of, by a listener that spins; port: of the link to the autopilot."""

    def __init__(self, listener: Listener, port: int, seed: int) -> None:
        self.listener, self.draw, self.port = listener, random.Random(seed), port
        self.socket, self.codec = (
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM),
            dialect.MAVLink(None),
        )
        self.sent = self.answered = 0
        self._clients: dict[str, Any] = {}
        self._waiting: list[Any] = []
        """Requests without an answer."""

    def rage(self, kind: str, seconds: float) -> None:
        """Be a storm of a kind, and wait for all answers."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            getattr(self, f"send_{kind}")()
        wait(lambda: not self._count_waiting())
        while kind == "lifecycle" and (now := self.listener.state()) != "active":
            self.listener.change({"unconfigured": 1, "inactive": 3}[now])
        for client in self._clients.values():
            self.listener.destroy_client(client)
        self.socket.close()

    def ask(self, kind: type, service: str, request: Any, node: str = NODES[0]) -> None:
        """Send a request as soon as not too many wait."""
        service = f"/{node}/{service}"
        if service not in self._clients:
            self._clients[service] = self.listener.create_client(kind, service)
            assert self._clients[service].wait_for_service(30.0), service
        wait(lambda: self._count_waiting() < OUTSTANDING)
        self._waiting.append(self._clients[service].call_async(request))
        self.sent += 1

    def _count_waiting(self) -> int:
        left = [one for one in self._waiting if not one.done()]
        self.answered += len(self._waiting) - len(left)
        self._waiting = left
        return len(left)

    def value(self) -> ParameterValue:
        choice = self.draw.choice
        many = choice((0, 1, 2, 9, 300))
        return ParameterValue(
            type=choice((*range(10), 10, 11, 128, 255)),
            bool_value=choice((False, True)),
            integer_value=choice(WHOLE),
            double_value=choice(REALS),
            string_value=choice(WORDS),
            double_array_value=[choice(REALS) for _ in range(many)],
            string_array_value=[choice(WORDS) for _ in range(min(many, 9))],
            integer_array_value=[choice(WHOLE) for _ in range(many)],
        )

    def parameter(self) -> Parameter:
        draw = self.draw
        if draw.random() < 0.2:
            return draw.choice(FITTING).to_parameter_msg()
        odd = (*WORDS, "detector.nmae", "b" * 100_000)
        return Parameter(
            name=draw.choice(NAMES if draw.random() < 0.7 else odd), value=self.value()
        )

    def send_parameters(self) -> None:
        choice = self.draw.choice
        names = [choice((*NAMES, *WORDS)) for _ in range(choice((0, 1, 50)))]
        changes = [self.parameter() for _ in range(choice((0, 1, 1, 1, 3, 60)))]
        kind, request = choice(
            (
                *[(SetParameters, SetParameters.Request(parameters=changes))] * 2,
                (
                    SetParametersAtomically,
                    SetParametersAtomically.Request(parameters=changes),
                ),
                (GetParameters, GetParameters.Request(names=names)),
                (DescribeParameters, DescribeParameters.Request(names=names)),
                (
                    ListParameters,
                    ListParameters.Request(
                        prefixes=names[:3], depth=choice((0, 1, 2**63))
                    ),
                ),
            )
        )
        self.ask(
            kind,
            re.sub("(?<!^)([A-Z])", r"_\1", kind.__name__).lower(),
            request,
            choice(NODES),
        )

    def send_services(self) -> None:
        self.ask(
            Trigger, self.draw.choice(("reset", "relearn_bias")), Trigger.Request()
        )

    def send_lifecycle(self) -> None:
        wanted = self.draw.choice(
            (*(n for paths in TRANSITIONS.values() for n in paths), 0, 9, 60, 99, 255)
        )
        label = self.draw.choice(
            ("", "", "", "configure", "activate", "c" * 5000, "\n")
        )
        self.ask(
            ChangeState,
            "change_state",
            ChangeState.Request(transition=Transition(id=wanted, label=label)),
        )
        if self.draw.random() < 0.1:
            self.ask(
                GetAvailableTransitions,
                "get_available_transitions",
                GetAvailableTransitions.Request(),
            )

    def send_links(self) -> None:
        """Publishers that come, say what is true, false, damaged or nothing, and go."""
        draw, template = self.draw, ImuTemplate("imu")
        output = self.listener.create_publisher(Imu, draw.choice(CONFIG.topics), DEEP)
        kind = draw.choice(("true", "true", "noise", "damaged", "late", "flood"))
        for _ in range(draw.choice((0, 3, 100)) if kind != "flood" else 5000):
            stamp = time.time_ns() - (
                draw.choice((10**9, 10**12, -(10**15))) if kind == "late" else 0
            )
            rate = (
                tuple(draw.choice((*REALS, 1e-3)) for _ in range(3))
                if kind == "noise"
                else (0.0, 0.0, 0.0)
            )
            data = bytes(
                template.fill(max(stamp, 0) % (2**31 * 10**9), rate, (0.0,) * 9)
            )
            output.publish(
                data[: draw.choice((0, 3, 20, len(data)))]
                if kind == "damaged"
                else data
            )
            self.sent += 1
            if kind != "flood":
                time.sleep(0.002)
        self.answered = self.sent
        self.listener.destroy_publisher(output)

    def send_mavlink(self) -> None:
        """Packets of a kind to the link; each stranger has an address of its own."""
        kind = self.draw.choice(PACKETS)
        for _ in range(self.draw.choice((1, 50)) if kind != "flood" else 1):
            made = [
                self.packet(kind)
                for _ in range({"strangers": 1, "flood": 200}.get(kind, 20))
            ]
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
                source = stranger if kind == "strangers" else self.socket
                for packet in made * (10 if kind == "flood" else 1):
                    with contextlib.suppress(OSError):
                        source.sendto(packet, ("127.0.0.1", self.port))
                    self.sent += 1
            time.sleep(0.02)
        self.answered = self.sent

    def packet(self, kind: str) -> bytes:
        """Any message of the dialect, with any payload, of any system, perhaps cut; or what is none."""
        draw, codec = self.draw, self.codec
        if kind == "garbage":
            return draw.randbytes(draw.randrange(1, 400))
        message = dialect.mavlink_map[draw.choice(NUMBERS)]
        size = message.unpacker.size
        payload = draw.randbytes(size) if draw.random() < 0.7 else bytes(size)
        codec.srcSystem = (
            1
            if kind in ("any message in its name", "strangers")
            else draw.randrange(2, 256)
        )
        codec.srcComponent, codec.seq = (
            draw.choice((1, 1, 1, draw.randrange(256))),
            draw.randrange(256),
        )
        data = bytes(
            dialect.MAVLink_message(message.id, message.msgname)._pack(
                codec, message.crc_extra, payload
            )
        )
        return data[: draw.randrange(1, len(data))] if kind == "cut messages" else data


class Vehicle(NamedTuple):
    """What storms go over: an autopilot (simulated), the node of its link, a monitor."""

    listener: Listener
    monitor: Process
    link: Process
    port: int


@contextlib.contextmanager
def vehicle(folder: Path) -> Iterator[Vehicle]:
    """Three gyros of a simulated PX4 over UDP, monitored."""
    port = free_port()
    with (
        OverUdp(port, Autopilot("px4")),
        monitoring(CONFIG, folder, prime=False) as (listener, monitor),
    ):
        # A topic with two publishers has a warning, and its channels do not count as healthy.
        while listener.outputs:
            listener.destroy_publisher(listener.outputs.pop())
        with running("mavlink_node", STACK, url=f"udpin:127.0.0.1:{port}") as link:
            assert listener.says("monitor", "9 of 9 channels healthy")
            yield Vehicle(listener, monitor, link, port)


def weather(over: Vehicle, kind: str, seconds: float, seed: int) -> dict[str, float]:
    """Let one storm loose; what it cost."""
    nodes = {
        "monitor": ("fdi_node: ", over.monitor),
        "link": ("mavlink_node: ", over.link),
    }
    lines = {name: process.said().count("\n") for name, (_, process) in nodes.items()}
    begun, storm = time.monotonic(), Storm(over.listener, over.port, seed)
    storm.rage(kind, seconds)
    end, heard = (
        time.monotonic(),
        [(at, array.status[0].name) for at, _, array in [*over.listener.diagnostics]],
    )
    told: dict[str, float] = {"sent": storm.sent, "answered": storm.answered}
    for name, (prefix, process) in nodes.items():
        times = [
            at for at, status in heard if status.startswith(prefix) and begun - 2 <= at
        ]
        told[f"{name}: longest gap of the diagnostics, s"] = max(
            np.diff([*times, end]), default=math.inf
        )
        told[f"{name}: lines of the log a second"] = (
            process.said().count("\n") - lines[name]
        ) / (end - begun)
        told[f"{name}: memory, MB"] = process.memory()
    return told
