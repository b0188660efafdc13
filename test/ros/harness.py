# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What talks to a real monitor on real DDS."""

import contextlib
import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from monitor.streams import swing as body_rate
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.exceptions import InvalidHandle
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros.processes import (
    PATIENCE,
    ROOT,
    Process,
    parameter_file,
    running,
    wait,
)
from sensor_msgs.msg import Imu
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger

from fdi_ros.config.config import Config
from fdi_ros.core.messages import ChannelsTemplate, ImuTemplate
from fdi_ros.core.sources import ChannelsSource, ImuSource
from fdi_ros.model.geometry import Geometry

RATE = 250.0
SIGMA = 0.0025
TWO_IMUS = Config.from_file(ROOT / "config" / "two_imus.yaml").replaced(
    {
        "sample_rate": RATE,
        "bias.startup_bias_duration": 0.0,
        "bias.turn_on_std": 0.0,
        "noise.noise_std": SIGMA,
        "noise.timing_std": 0.0,
        # A test machine may keep the publisher waiting for longer than a flight computer.
        "imus.timeout": 0.3,
        "health.stale_timeout": 0.3,
        "health.stuck_time": 0.0,
        "health.stuck_time_at_rest": 0.0,
    }
)
GEOMETRY = Geometry.from_triads(np.array(TWO_IMUS.imus.mounts).reshape(-1, 3, 3))
DEEP = QoSProfile(depth=5000, reliability=ReliabilityPolicy.BEST_EFFORT)


def healthy(
    count: int, seed=0, size=0.5, rate=RATE, start=0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Body rate (N, 3) and healthy channels (N, 6) of the two-triad cone from a time in s on, rad/s."""
    omega = body_rate(start + np.arange(count) / rate, size)
    return omega, omega @ GEOMETRY.axes.T + SIGMA * np.random.default_rng(
        seed
    ).standard_normal((count, 6))


def struck(count: int, start: int, **options: float) -> tuple[np.ndarray, np.ndarray]:
    """As `healthy`, with a bias of 0.3 rad/s on channel 4, imu_2.y or g5, from a sample on."""
    omega, z = healthy(count, **options)
    z[start:, 4] += 0.3
    return omega, z


def stamps_of(messages: list[bytes]) -> list[int]:
    """Stamps of Imu messages, ns."""
    return [ImuSource.parse(data, 3)[0] for data in list(messages)]


class Listener(Node):
    """Publishes the inputs of a monitor and keeps all it says."""

    def __init__(self, topics, kind) -> None:
        super().__init__("listener")
        self.speaker = "fdi_node"  # whose statuses are meant where none is named
        self.outputs = [self.create_publisher(kind, topic, DEEP) for topic in topics]
        self.fused, self.integrity = (
            self.hear("fused"),
            self.hear("fdi_node/integrity", Float64MultiArray),
        )
        self.diagnostics: list[tuple[float, int, DiagnosticArray]] = []
        """With the time at which each was heard, s, and the number of samples heard before it."""
        self.create_subscription(
            DiagnosticArray, "/diagnostics", self._on_diagnostics, 100
        )
        self._templates = (ImuTemplate("imu"), ChannelsTemplate(6))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self.diagnostics.append((time.monotonic(), len(self.integrity), message))

    def hear(self, topic: str, kind: type = Imu) -> list[bytes]:
        """Messages that come on a topic from now on."""
        heard: list[bytes] = []
        self.create_subscription(kind, topic, heard.append, DEEP, raw=True)
        return heard

    def clear(self) -> None:
        for kept in (self.fused, self.integrity, self.diagnostics):
            kept.clear()

    def send_imu(self, triad: int, stamp: int, rate) -> None:
        self.outputs[triad].publish(self._templates[0].fill(stamp, rate, (0.0,) * 9))

    def send_channels(self, values) -> None:
        self.outputs[0].publish(self._templates[1].fill(values))

    def play(
        self, z: np.ndarray, triads=(0, 1), skew: int = 0, start: int | None = None
    ) -> np.ndarray:
        """Publish samples of two IMUs at their pace, stamped with the time of now, or from a start on; the stamps."""
        begun, start = time.monotonic(), time.time_ns() if start is None else start
        stamps = start + (np.arange(len(z)) * 1e9 / RATE).astype(np.int64)
        for k, stamp in enumerate(stamps.tolist()):
            time.sleep(max(0.0, begun + k / RATE - time.monotonic()))
            for j in triads:
                self.send_imu(j, stamp + j * skew, z[k, 3 * j : 3 * j + 3].tolist())
        return stamps

    def settle(self) -> bool:
        """Feed healthy samples until the monitor has nothing against any channel."""
        begin = time.monotonic()
        while (now := time.monotonic() - begin) < PATIENCE:
            # One motion through all pauses, as of a vehicle: a delay is learned from it.
            last = self.play(healthy(25, int(1e3 * now), start=now)[1])[-1]
            # All the way through, so that none of these comes after what is played next.
            wait(lambda last=last: stamps_of(self.fused[-1:]) == [last], 1.0)
            if self.integrity and not self.states()[-1].any():
                return True
        print(
            "the monitor did not come to rest; it says:",
            *self.diagnostics[-1:],
            sep="\n",
        )
        return False

    def calm(self) -> None:
        """Have a monitor that has nothing against any channel, and forget what it said until then."""
        assert self.settle()
        time.sleep(0.1)
        self.clear()

    def prime(self) -> None:
        """Publish a few samples at rest."""
        if len(self.outputs) > 1:
            self.play(healthy(10, size=0.0)[1])
        else:
            self.send_channels([0.0] * 6)
            time.sleep(1 / RATE)

    def stamps(self) -> list[int]:
        """Stamps of the fused rates, ns."""
        return stamps_of(self.fused)

    def rates(self) -> np.ndarray:
        """Fused rates, (N, 3) rad/s."""
        return np.array([ImuSource.parse(data, 3)[1] for data in list(self.fused)])

    def states(self) -> np.ndarray:
        """State of every channel in every sample, (N, 6)."""
        told = [ChannelsSource.parse(data, 13)[1][2:8] for data in list(self.integrity)]
        return np.array(told).astype(int).reshape(-1, 6)

    def status(self, name: str) -> DiagnosticStatus:
        """The last status of a name."""
        assert wait(lambda: self._statuses(name)), f"no diagnostics of {name}"
        return self._statuses(name)[-1]

    def value(self, name: str, key: str) -> str:
        """A figure of the last status of a name."""
        return {pair.key: pair.value for pair in self.status(name).values}[key]

    def reports(self) -> list[dict[str, DiagnosticStatus]]:
        """All statuses of each report, by name."""
        return [
            {s.name.removeprefix("fdi_node: "): s for s in m.status}
            for *_, m in list(self.diagnostics)
        ]

    def _statuses(self, name: str) -> list[DiagnosticStatus]:
        names = (name, f"{self.speaker}: {name}")
        return [
            status
            for *_, array in list(self.diagnostics)
            for status in array.status
            if status.name in names
        ]

    def says(
        self,
        name: str,
        words: str,
        meanwhile: Callable[[], object] = lambda: None,
    ) -> str:
        """Return the last status with these words in it since `clear`, once it has come; empty if none comes.

        ``meanwhile`` is done again and again: a busy monitor may have no time to report on
        inputs before they are silent, so they must go on.
        """
        said: list[str] = []

        def has_come() -> bool:
            said.extend(s.message for s in self._statuses(name) if words in s.message)
            if not said:
                meanwhile()
            return bool(said)

        if wait(has_come):
            return said[-1]
        print(
            f"{name} never said {words!r}; it says:", *self.diagnostics[-1:], sep="\n"
        )
        return ""

    def call(self, kind: type, service: str, **fields: object):
        """What a service answers to a request with these fields."""
        client = self.create_client(kind, service)
        assert client.wait_for_service(PATIENCE), f"no service {service}"
        future = client.call_async(kind.Request(**fields))
        assert wait(future.done), f"no answer from {service}"
        self.destroy_client(client)
        return future.result()

    def trigger(self, service: str) -> Trigger.Response:
        return self.call(Trigger, f"fdi_node/{service}")

    def change(self, transition: int) -> bool:
        """Ask the monitor for a transition of its life cycle; whether it was done."""
        return self.call(
            ChangeState, "fdi_node/change_state", transition=Transition(id=transition)
        ).success

    def state(self) -> str:
        """State of the life cycle of the monitor."""
        return self.call(GetState, "fdi_node/get_state").current_state.label

    def set(self, node: str = "fdi_node", **values: object):
        """Set parameters together; two underscores stand for a dot."""
        changes = [
            Parameter(name.replace("__", "."), value=value).to_parameter_msg()
            for name, value in values.items()
        ]
        return self.call(
            SetParametersAtomically,
            f"{node}/set_parameters_atomically",
            parameters=changes,
        ).result


TRANSITIONS = {
    "unconfigured": {Transition.TRANSITION_CONFIGURE: "inactive"},
    "inactive": {
        Transition.TRANSITION_CLEANUP: "unconfigured",
        Transition.TRANSITION_ACTIVATE: "active",
    },
    "active": {Transition.TRANSITION_DEACTIVATE: "inactive"},
}
"""Which transitions are possible in which state, but for those that end the node, and where they lead."""


@contextlib.contextmanager
def listening(topics=(), kind=Imu) -> Iterator[Listener]:
    """A listener that spins in a thread, in the ROS domain that processes started now have."""
    context = rclpy.get_default_context()
    # A test before may have had another domain.
    if context.ok() and context.get_domain_id() != int(os.environ["ROS_DOMAIN_ID"]):
        rclpy.shutdown()
    if not context.ok():
        rclpy.init()
    listener = Listener(topics, kind)
    executor = SingleThreadedExecutor()
    executor.add_node(listener)
    ended = threading.Event()

    def spin() -> None:
        while not ended.is_set():
            # What the test destroys while it is waited for ends the waiting, not the listener.
            with contextlib.suppress(InvalidHandle):
                executor.spin_once(0.2)

    thread = threading.Thread(target=spin, daemon=True)
    thread.start()
    try:
        yield listener
    finally:
        ended.set()
        thread.join()
        executor.shutdown()
        listener.destroy_node()


@contextlib.contextmanager
def monitoring(
    config: Config, folder: Path, prime=True, **parameters: object
) -> Iterator[tuple]:
    """The monitor in its own process, connected to a listener: (listener, process)."""
    kind = Imu if config.input == "imus" else Float64MultiArray
    file = parameter_file(config, folder, **parameters)
    with (
        listening(config.topics, kind) as listener,
        running("fdi_node", file) as process,
    ):
        if parameters.get("autostart", True):
            connect(listener, process, prime)
        yield listener, process


def connect(listener: Listener, process: Process, prime: bool = True) -> None:
    """Wait until the monitor listens and is listened to; prime: until samples go all the way through."""
    ended, topics = process.popen.poll, ("fused", "fdi_node/integrity")

    def connected() -> bool:
        heard = all(output.get_subscription_count() for output in listener.outputs)
        return ended() is not None or (
            heard and all(map(listener.count_publishers, topics))
        )

    assert wait(connected, 2 * PATIENCE), f"the node did not connect: {process.said()}"
    assert ended() is None, process.said()
    if prime:
        assert wait(
            lambda: listener.prime() or (listener.fused and listener.integrity)
        ), process.said()
