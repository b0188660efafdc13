# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A flood of messages on both inputs: memory of the node, its CPU, and how often it still gives diagnostics.

Two processes publish one IMU topic each as fast as they are told; the report says what they reached.

    python benchmark/flood.py [--rate 25000] [--seconds 60] [--executor auto]
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from itertools import pairwise
from pathlib import Path

ROOT = Path(__file__).parents[1]
# The harness of the node tests starts the node and talks to it.
sys.path[:0] = [str(ROOT), str(ROOT / "test")]
os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
os.environ.setdefault("ROS_LOG_DIR", tempfile.mkdtemp(prefix="fdi_flood_"))

from ros.harness import TWO_IMUS, Listener, Process, monitoring, sound  # noqa: E402

EVERY = 5.0
"""Seconds between two lines."""


def publish(topic: str, rate: float, seconds: float) -> None:
    """Publish messages with the time of now on one topic, and say how many."""
    import rclpy
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import Imu

    from fdi_ros.core.messages import ImuTemplate

    rclpy.init()
    node = rclpy.create_node("flood")
    output = node.create_publisher(Imu, topic, qos_profile_sensor_data)
    while not output.get_subscription_count():
        time.sleep(0.01)
    template = ImuTemplate("imu")
    start, sent = time.monotonic(), 0
    while (now := time.monotonic()) < start + seconds:
        due = int((now - start) * rate) - sent
        for _ in range(due):
            output.publish(template.fill(time.time_ns(), (0.0, 0.0, 0.0), (0.0,) * 9))
        sent += due
        time.sleep(0.0005)
    print(sent)


def flood(listener: Listener, process: Process, rate: float, seconds: float) -> dict[str, float]:
    """Flood both inputs of the node; return what it cost."""
    words = [sys.executable, __file__, "publish"]
    sources = [
        subprocess.Popen([*words, topic, str(rate / 2), str(seconds)], stdout=subprocess.PIPE, text=True)
        for topic in TWO_IMUS.topics
    ]
    while not all(listener.count_publishers(topic) > 1 for topic in TWO_IMUS.topics):
        time.sleep(0.01)
    listener.clear()
    begin, cpu, memory = time.monotonic(), process.cpu(), [process.memory()]
    while any(source.poll() is None for source in sources):
        time.sleep(min(EVERY, seconds))
        memory.append(process.memory())
        print(
            f"{time.monotonic() - begin:5.0f} s  {memory[-1]:.1f} MB  {len(listener.diagnostics)} reports", flush=True
        )
    ended = time.monotonic()
    used = 100 * (process.cpu() - cpu) / (ended - begin)
    times = [begin, *(at for at, _ in listener.diagnostics if at <= ended)]
    gaps = [after - before for before, after in pairwise(times)]
    time.sleep(3.0)
    return {
        "offered, Hz": sum(int(source.communicate()[0]) for source in sources) / seconds,
        "memory before, MB": memory[0],
        "memory after 5 s, MB": memory[1],
        "memory at the end, MB": memory[-1],
        "memory 3 s later, MB": process.memory(),
        "CPU, %": used,
        "reports a second": len(gaps) / (ended - begin),
        "longest time without a report, s": max(gaps, default=float("inf")),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rate", type=float, default=25000.0, help="messages a second, both topics together")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--executor", default="auto")
    arguments = parser.parse_args()
    folder = tempfile.mkdtemp(prefix="fdi_flood_")
    with monitoring(TWO_IMUS, Path(folder), executor=arguments.executor) as (listener, process):
        listener.play(sound(50)[1])
        # The listener could not keep up with the rates, and would hear the reports late.
        for subscription in list(listener.subscriptions):
            if subscription.topic_name != "/diagnostics":
                listener.destroy_subscription(subscription)
        result = flood(listener, process, arguments.rate, arguments.seconds)
        said = [line for line in process.said().splitlines() if "flood" in line]
    print("\n".join([*(f"{name:36}{value:.6g}" for name, value in result.items()), *said]))


if __name__ == "__main__":
    if sys.argv[1:2] == ["publish"]:
        publish(sys.argv[2], float(sys.argv[3]), float(sys.argv[4]))
    else:
        main()
