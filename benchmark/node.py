# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The live node, with gyros alone and with both halves, beside two rclpy relays.

Latency, CPU, loss at 2 x 1 kHz, and the highest rate without loss.

Two Imu topics go in, one Imu comes out. The plain relay takes ordinary messages on a SingleThreadedExecutor and
republishes one Imu per pair; the raw relay passes the bytes of one on with an EventsExecutor: the floor of rclpy.
Neither judges anything. Publisher, node and listener are processes of their own. Latency is from just
before the first of a pair is published to the arrival of the answer. The listener subscribes best effort, as for
sensor data.

All four run in turn, --rounds times, and also at each rate of the search. Shares of the plain relay are medians of the
ratios in each round, as the machine may change its speed between rounds.

    python benchmark/node.py [--seconds 10] [--rounds 3] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

ROOT = Path(__file__).parents[1]
TOPICS = ("imu_1/data_raw", "imu_2/data_raw")
RATES = (
    1000,
    1500,
    2000,
    3000,
    4000,
    5000,
    6000,
    8000,
    10000,
    12000,
    14000,
    16000,
    20000,
)
SUSTAINED = 1e-3  # loss above this share is no sustained rate: the listener itself may be kept waiting for a moment
STARTED = 0.1  # CPU time in a second of a process that waits, s
NODE = (
    *("-m", "fdi_ros.ros.process", "fdi_node", "--ros-args"),
    *("--params-file", str(ROOT / "config" / "two_imus.yaml")),
    *("-p", "bias.startup_bias_duration:=0.0"),
    *("-p", "sample_rate:=1000.0"),
    *("-p", "health.stuck_time:=0.0"),
)
CANDIDATES = {
    "gyros": [*NODE, "-p", "accelerometers.enabled:='off'"],
    "both halves": [*NODE, "-p", "accelerometers.enabled:='on'"],
    "plain relay": [__file__, "relay", "plain"],
    "raw relay": [__file__, "relay", "raw"],
}
YARDSTICK = "plain relay"
Run = dict[str, Any]  # figures of one candidate at one rate


def relay(raw: bool) -> None:
    """Pass one of each pair on; raw: its bytes, on an EventsExecutor."""
    import rclpy
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
    from rclpy.experimental import EventsExecutor
    from rclpy.qos import QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
    from sensor_msgs.msg import Imu

    rclpy.init()
    node = rclpy.create_node("relay")
    qos = QoSProfile(depth=256, reliability=ReliabilityPolicy.BEST_EFFORT)
    output = node.create_publisher(Imu, "fused", qos_profile_sensor_data if raw else 10)
    node.create_subscription(Imu, TOPICS[0], lambda message: None, qos, raw=raw)
    node.create_subscription(Imu, TOPICS[1], output.publish, qos, raw=raw)
    executor = EventsExecutor() if raw else SingleThreadedExecutor()
    executor.add_node(node)
    try:
        while rclpy.ok():
            executor.spin_once(timeout_sec=0.2)
    except (KeyboardInterrupt, ExternalShutdownException):
        return


def source(rate: float, seconds: float) -> None:
    """Publish pairs at a rate, both of a pair with the time of now as their stamp."""
    import numpy as np
    import rclpy
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import Imu

    from fdi_ros.core.messages import ImuTemplate, fill_force

    rclpy.init()
    node = rclpy.create_node("source")
    outputs = [
        node.create_publisher(Imu, topic, qos_profile_sensor_data) for topic in TOPICS
    ]
    while not all(output.get_subscription_count() for output in outputs):
        time.sleep(0.05)
    print("ready", flush=True)
    sys.stdin.readline()
    template, nothing = ImuTemplate("imu"), (0.0,) * 9
    rng = np.random.default_rng(0)
    values = rng.normal(0, 0.003, (5000, 2, 3)).tolist()
    forces = rng.normal([0.0, 0.0, 9.81], 0.15, (5000, 2, 3))

    def encoded(value: list[float], force: Any) -> bytearray:
        template.fill(0, value, nothing)
        fill_force(template.bytes, template.at, 1.0, force, np.zeros(6))
        return bytearray(template.bytes)

    messages = [list(map(encoded, *pair)) for pair in zip(values, forces, strict=True)]
    start = time.perf_counter()
    for k in range(round(rate * seconds)):
        due = start + k / rate
        while (ahead := due - time.perf_counter()) > 0:
            if ahead > 1e-4:
                time.sleep(ahead - 5e-5)
        stamp = divmod(time.time_ns(), 10**9)
        for output, message in zip(outputs, messages[k % 5000], strict=True):
            struct.pack_into("<iI", message, 4, *stamp)
            output.publish(bytes(message))
    # The achieved rate: a source that cannot keep up is no measure of the node.
    print(
        round(rate * seconds),
        (round(rate * seconds) - 1) / (time.perf_counter() - start),
    )


def sink(file: str) -> None:
    """Keep stamp and time of arrival of every answer, and write them down at the end."""
    import rclpy
    from rclpy.experimental import EventsExecutor
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from rclpy.signals import SignalHandlerOptions
    from sensor_msgs.msg import Imu

    stop: list[int] = []
    signal.signal(signal.SIGINT, lambda *_: stop.append(1))
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("sink")
    arrived: list[tuple[int, bytes]] = []
    qos = QoSProfile(depth=5000, reliability=ReliabilityPolicy.BEST_EFFORT)
    node.create_subscription(
        Imu,
        "fused",
        lambda data: arrived.append((time.time_ns(), data[:12])),
        qos,
        raw=True,
    )
    executor = EventsExecutor()
    executor.add_node(node)
    while not stop and not node.count_publishers("fused"):
        executor.spin_once(timeout_sec=0.1)
    print("ready", flush=True)
    while not stop:
        executor.spin_once(timeout_sec=0.1)
    stamps = [struct.unpack_from("<iI", head, 4) for _, head in arrived]
    Path(file).write_text(
        json.dumps(
            [
                (at, sec * 10**9 + ns)
                for (at, _), (sec, ns) in zip(arrived, stamps, strict=True)
            ]
        )
    )


def cpu_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def settled(pid: int) -> float:
    """Wait until a process waits for messages; return its CPU time, s. Starting takes most of a core."""
    spent = cpu_seconds(pid)
    for _ in range(60):
        time.sleep(1.0)
        before, spent = spent, cpu_seconds(pid)
        if spent - before < STARTED:
            break
    return spent


def measure(candidate: str, rate: float, seconds: float) -> Run:
    """One run: latency, CPU share and loss of a candidate at a rate."""
    with tempfile.TemporaryDirectory() as folder:
        file = f"{folder}/arrived.json"
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        node = subprocess.Popen(
            [sys.executable, *CANDIDATES[candidate]], cwd=ROOT, **quiet
        )
        listener = subprocess.Popen(
            [sys.executable, __file__, "sink", file], stdout=subprocess.PIPE, text=True
        )
        words = [sys.executable, __file__, "source", str(rate), str(seconds)]
        sender = subprocess.Popen(
            words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        try:
            for process in (listener, sender):
                assert process.stdout is not None
                process.stdout.readline()
            before = settled(node.pid)
            begin = time.perf_counter()
            said, _ = sender.communicate("go\n", timeout=60 + seconds)
            used = cpu_seconds(node.pid) - before
            time.sleep(0.5)
        finally:
            sender.kill()
            for process in (node, listener):
                process.send_signal(signal.SIGINT)
                process.wait(10)
        arrived = json.loads(Path(file).read_text())
    sent, achieved = (float(word) for word in said.split())
    latency = sorted((at - stamp) / 1e3 for at, stamp in arrived)
    return {
        "rate": rate,
        "achieved_rate": achieved,
        "sent": sent,
        "lost": sent - len(arrived),
        "cpu_percent": 100
        * used
        / min(seconds * rate / achieved, time.perf_counter() - begin),
        "p50_us": latency[len(latency) // 2] if latency else float("nan"),
        "p99_us": latency[len(latency) * 99 // 100] if latency else float("nan"),
    }


def highest(seconds: float) -> tuple[dict[str, float], list[Run]]:
    """Return the highest rate tried that each candidate passes without loss, and all runs."""
    best, runs = dict.fromkeys(CANDIDATES, 0.0), []
    left = list(CANDIDATES)
    for rate in RATES:
        for candidate in [*left]:
            run = measure(candidate, rate, seconds)
            runs.append({"candidate": candidate, **run})
            print(
                f"  {candidate}: {rate} Hz, achieved {run['achieved_rate']:.0f}, lost {run['lost']:.0f}",
                flush=True,
            )
            lossy = run["lost"] > SUSTAINED * run["sent"]
            if lossy or run["achieved_rate"] < 0.97 * rate:
                left.remove(candidate)
            else:
                best[candidate] = rate
    return best, runs


def middle(rounds: list[dict[str, Run]], candidate: str, figure: str) -> float:
    """Median of a figure over the rounds."""
    return median(one[candidate][figure] for one in rounds)


def share(rounds: list[dict[str, Run]], candidate: str, figure: str) -> float:
    """Median over the rounds of a figure over that of the yardstick."""
    return median(one[candidate][figure] / one[YARDSTICK][figure] for one in rounds)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--search-seconds", type=float, default=3.0)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["ROS_LOG_DIR"] = tempfile.mkdtemp(prefix="fdi_benchmark_")
    os.environ["PYTHONPATH"] = os.pathsep.join(
        [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    )
    rounds = [
        {
            candidate: measure(candidate, 1000, arguments.seconds)
            for candidate in CANDIDATES
        }
        for _ in range(arguments.rounds)
    ]
    best, search = highest(arguments.search_seconds)
    load = os.getloadavg()[0]
    print(
        f"\n2 x 1 kHz, {arguments.rounds} times {arguments.seconds:g} s, {os.cpu_count()} cores, "
        f"load of the machine {load:.1f}"
    )
    print(
        f"{'':14}{'CPU %':>8}{'p50 us':>9}{'p99 us':>9}{'lost':>6}{'CPU, p50 of the plain relay':>30}"
        f"{'highest rate without loss, Hz':>32}"
    )
    for candidate in CANDIDATES:
        cpu, p50, p99 = (
            middle(rounds, candidate, figure)
            for figure in ("cpu_percent", "p50_us", "p99_us")
        )
        lost = sum(one[candidate]["lost"] for one in rounds)
        shares = ", ".join(
            f"{share(rounds, candidate, figure):.2f}"
            for figure in ("cpu_percent", "p50_us")
        )
        print(
            f"{candidate:14}{cpu:8.1f}{p50:9.0f}{p99:9.0f}{lost:6.0f}{shares:>30}{best[candidate]:32.0f}"
        )
    if arguments.json:
        result = {"at_1_khz": rounds, "highest_rate": best, "search": search}
        arguments.json.write_text(json.dumps(result, indent=2))


if __name__ == "__main__":
    if sys.argv[1:2] == ["relay"]:
        relay(sys.argv[2] == "raw")
    elif sys.argv[1:2] == ["source"]:
        source(float(sys.argv[2]), float(sys.argv[3]))
    elif sys.argv[1:2] == ["sink"]:
        sink(sys.argv[2])
    else:
        main()
