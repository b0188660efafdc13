# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The real node in its own process on real DDS, and what is needed to talk to it."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from monitor.streams import swing as body_rate
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger

from fdi_ros.config.config import Config
from fdi_ros.core.messages import ChannelsTemplate, ImuTemplate
from fdi_ros.model.geometry import Geometry
from fdi_ros.sources import ChannelsSource, ImuSource

ROOT = Path(__file__).parents[2]
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
PATIENCE = 60.0
"""How long something that must come is waited for, s: a machine that is busy with other things makes no test fail."""


def wait(until: Callable[[], object], seconds: float = PATIENCE) -> bool:
    """Wait for something; whether it came."""
    end = time.monotonic() + seconds
    while not until():
        if time.monotonic() > end:
            return False
        time.sleep(0.01)
    return True


def rest(count: Callable[[], int]) -> None:
    """Wait until nothing more comes."""
    before = -1
    while before != (before := count()):
        time.sleep(0.3)


def healthy(count: int, seed=0, size=0.5, rate=RATE, start=0.0) -> tuple[np.ndarray, np.ndarray]:
    """Body rate (N, 3) and healthy channels (N, 6) of the two-triad cone from a time in s on, rad/s."""
    omega = body_rate(start + np.arange(count) / rate, size)
    return omega, omega @ GEOMETRY.axes.T + SIGMA * np.random.default_rng(seed).standard_normal((count, 6))


def parameter_file(config: Config, folder: Path, **more: object) -> Path:
    """Write all settings as a ROS 2 parameter file."""
    flat = {name: list(value) if isinstance(value, tuple) else value for name, value in config.parameters().items()}
    flat = {name: value for name, value in flat.items() if value != []}
    path = folder / "parameters.yaml"
    path.write_text(yaml.safe_dump({"/**": {"ros__parameters": {**flat, **more}}}))
    return path


class Process:
    """A node of ours in a process of its own; in names of parameters two underscores stand for a dot."""

    def __init__(self, name: str, file: Path, *remaps: str, **parameters: object) -> None:
        self.output = Path(tempfile.mkstemp(prefix="fdi_ros_node_", dir=os.environ["ROS_LOG_DIR"])[1])
        words = ["-m", "fdi_ros.ros.process", name, "--ros-args", "--params-file", str(file)]
        words += [word for remap in remaps for word in ("-r", remap)]
        for key, value in parameters.items():
            text = str(value).lower() if isinstance(value, bool) else str(value)
            words += ["-p", f"{key.replace('__', '.')}:={text}"]
        with self.output.open("w") as output:
            self.popen = subprocess.Popen([sys.executable, *words], stdout=output, stderr=subprocess.STDOUT, cwd=ROOT)

    def said(self) -> str:
        return self.output.read_text()

    def end(self, number: int = signal.SIGINT) -> int:
        """Send a signal and return the exit code."""
        if self.popen.poll() is None:
            self.popen.send_signal(number)
        try:
            return self.popen.wait(PATIENCE)
        finally:
            self.popen.kill()

    def memory(self) -> float:
        """Resident memory, MB."""
        pages = int(Path(f"/proc/{self.popen.pid}/statm").read_text().split()[1])
        return pages * 4096 / 1e6


@contextlib.contextmanager
def running(name: str, file: Path, *remaps: str, **parameters: object) -> Iterator[Process]:
    """A node of ours that must end well when it is asked to."""
    process = Process(name, file, *remaps, **parameters)
    try:
        yield process
    finally:
        code = process.end()
    assert code == 0, process.said()
    assert "Traceback" not in process.said()


def assert_refused(name: str, starts: dict[str, str], *first: str) -> None:
    """Each of some starts of a node, all in one process, is refused in one line with some words in it."""
    code = f"""
import sys
from fdi_ros.ros.process import run
for arguments in {[[*first, *words.split()] for words in starts]!r}:
    print("=====", run({name!r}, arguments), file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    # rcl itself has a line to say of a file that it cannot read.
    said = [line for line in done.stderr.splitlines() if "[rcl]" not in line]
    assert said[1::2] == ["===== 2"] * len(starts), done.stderr
    for line, words in zip(said[::2], starts.values(), strict=True):
        assert line.startswith(f"{name}: ")
        assert words in line


class Listener(Node):
    """Publishes the inputs of a monitor and keeps all it says."""

    def __init__(self, topics, kind) -> None:
        super().__init__("listener")
        self.outputs = [self.create_publisher(kind, topic, DEEP) for topic in topics]
        self.fused: list[bytes] = []
        self.integrity: list[bytes] = []
        self.diagnostics: list[tuple[float, DiagnosticArray]] = []
        self.create_subscription(Imu, "fused", self.fused.append, DEEP, raw=True)
        self.create_subscription(Float64MultiArray, "fdi_node/integrity", self.integrity.append, DEEP, raw=True)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 100)
        self._templates = (ImuTemplate("imu"), ChannelsTemplate(6))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        if any(status.name == "fdi_node: monitor" for status in message.status):
            self.diagnostics.append((time.monotonic(), message))

    def clear(self) -> None:
        for kept in (self.fused, self.integrity, self.diagnostics):
            kept.clear()

    def send_imu(self, triad: int, stamp: int, rate) -> None:
        self.outputs[triad].publish(self._templates[0].fill(stamp, rate, (0.0,) * 9))

    def send_channels(self, values) -> None:
        self.outputs[0].publish(self._templates[1].fill(values))

    def play(self, z: np.ndarray, triads=(0, 1), skew: int = 0, start: int | None = None) -> np.ndarray:
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
            wait(lambda last=last: self.fused and ImuSource.parse(self.fused[-1], 3)[0] == last, 1.0)
            if self.integrity and not self.states()[-1].any():
                return True
        print("the monitor did not come to rest; it says:", *self.diagnostics[-1:], sep="\n")
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

    def rates(self) -> dict[int, tuple[float, float, float]]:
        """Fused rates by stamp."""
        return dict(ImuSource.parse(data, 3) for data in list(self.fused))

    def states(self) -> np.ndarray:
        """State of every channel in every sample, (N, 6)."""
        told = [ChannelsSource.parse(data, 11)[1][2:8] for data in list(self.integrity)]
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
        return [{s.name.removeprefix("fdi_node: "): s for s in m.status} for _, m in list(self.diagnostics)]

    def _statuses(self, name: str) -> list[DiagnosticStatus]:
        # Another monitor of the same domain speaks on /diagnostics, too, and not of the same channels.
        return [s for _, array in list(self.diagnostics) for s in array.status if s.name == f"fdi_node: {name}"]

    def says(self, name: str, words: str) -> str:
        """What a status comes to say with these words in it, or has said since `clear`, the last; empty if nothing."""
        said: list[str] = []
        if wait(lambda: said.extend(s.message for s in self._statuses(name) if words in s.message) or said):
            return said[-1]
        print(f"{name} never said {words!r}; it says:", *self.diagnostics[-1:], sep="\n")
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
        return self.call(ChangeState, "fdi_node/change_state", transition=Transition(id=transition)).success

    def state(self) -> str:
        """State of the life cycle of the monitor."""
        return self.call(GetState, "fdi_node/get_state").current_state.label

    def set(self, node: str = "fdi_node", **values: object):
        """Set parameters together; two underscores stand for a dot."""
        changes = [Parameter(name.replace("__", "."), value=value).to_parameter_msg() for name, value in values.items()]
        return self.call(SetParametersAtomically, f"{node}/set_parameters_atomically", parameters=changes).result


TRANSITIONS = {
    "unconfigured": {Transition.TRANSITION_CONFIGURE: "inactive"},
    "inactive": {Transition.TRANSITION_CLEANUP: "unconfigured", Transition.TRANSITION_ACTIVATE: "active"},
    "active": {Transition.TRANSITION_DEACTIVATE: "inactive"},
}
"""Which transitions are possible in which state, but for those that end the node, and where they lead."""


@contextlib.contextmanager
def listening(topics=(), kind=Imu, make=Listener) -> Iterator[Listener]:
    """A listener that spins in a thread, in the ROS domain that processes started now have."""
    context = rclpy.get_default_context()
    # A test before may have had another domain.
    if context.ok() and context.get_domain_id() != int(os.environ["ROS_DOMAIN_ID"]):
        rclpy.shutdown()
    if not context.ok():
        rclpy.init()
    listener = make(topics, kind)
    executor = SingleThreadedExecutor()
    executor.add_node(listener)

    done = threading.Event()

    def spin() -> None:
        while not done.is_set():
            executor.spin_once(timeout_sec=0.05)

    thread = threading.Thread(target=spin, daemon=True)
    thread.start()
    try:
        yield listener
    finally:
        done.set()
        thread.join()
        executor.remove_node(listener)
        listener.destroy_node()


@contextlib.contextmanager
def monitoring(config: Config, folder: Path, prime=True, **parameters: object) -> Iterator[tuple]:
    """The monitor in its own process, connected to a listener: (listener, process)."""
    kind = Imu if config.input == "imus" else Float64MultiArray
    file = parameter_file(config, folder, **parameters)
    with listening(config.topics, kind) as listener, running("fdi_node", file) as process:
        if parameters.get("autostart", True):
            connect(listener, process, prime)
        yield listener, process


def connect(listener: Listener, process: Process, prime: bool = True) -> None:
    """Wait until the monitor listens and is listened to; prime: until samples go all the way through."""
    ended, topics = process.popen.poll, ("fused", "fdi_node/integrity")

    def connected() -> bool:
        heard = all(output.get_subscription_count() for output in listener.outputs)
        return ended() is not None or (heard and all(map(listener.count_publishers, topics)))

    assert wait(connected, 2 * PATIENCE), f"the node did not connect: {process.said()}"
    assert ended() is None, process.said()
    if prime:
        assert wait(lambda: listener.prime() or (listener.fused and listener.integrity)), process.said()
