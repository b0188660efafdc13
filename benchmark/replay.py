# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Speed and memory of a whole replay, beside rosbags merely iterating the same raw messages.

Two Imu topics at 1 kHz. Every figure is taken in a process of its own, one after the other:

- iterate: rosbags yields every raw message, nothing is done with it;
- replay: `fdi replay` without faults: reading, decoding, alignment, health, detector, decision, fusion, evaluation;
- rosbags' deserialiser: the same replay, but each message is deserialised by rosbags.

    python benchmark/replay.py [--minutes 10]
"""

from __future__ import annotations

import argparse
import json
import resource
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from fdi_ros.config.config import Config
from fdi_ros.core.messages import Decoded
from fdi_ros.replay.run import Request, replay
from fdi_ros.sources.imus import ImuSource

RATE = 1000
START = 1_700_000_000_000_000_000
IMU = "sensor_msgs/msg/Imu"
TOPICS = ("/imu_1/data_raw", "/imu_2/data_raw")
# Two triads turned against each other: the second as far from every axis of the first as it can be.
TURNED = [2 / 3, -1 / 3, 2 / 3, 2 / 3, 2 / 3, -1 / 3, -1 / 3, 2 / 3, 2 / 3]
PARAMETERS = {
    "input": "imus",
    "sample_rate": float(RATE),
    "imus.topics": TOPICS,
    "imus.mounts": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, *TURNED],
    "noise.noise_std": [0.0025],
    "noise.scale_std": [0.002],
    "noise.timing_std": [0.0002],
}


def write_bag(path: Path, minutes: float) -> Path:
    """Write a recording of smooth motion, seeded."""
    store = get_typestore(Stores.ROS2_JAZZY)
    random = np.random.default_rng(1)
    mounts = np.array(PARAMETERS["imus.mounts"]).reshape(2, 3, 3)
    plain = np.zeros(37)
    plain[[4, 28]] = -1
    heads = [struct.pack("<BBBBiII", 0, 1, 0, 0, 0, 0, 6) + name + bytes(6) for name in (b"imu_1\0", b"imu_2\0")]
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = [writer.add_connection(topic, IMU, typestore=store) for topic in TOPICS]
        for second in range(round(60 * minutes)):
            at = second + np.arange(RATE) / RATE
            omega = np.column_stack([np.sin(at), np.cos(1.3 * at), 0.5 * np.sin(0.7 * at)])
            rates = [omega @ mount + random.normal(0, 0.0025, (RATE, 3)) for mount in mounts]
            for k in range(RATE):
                stamp = START + second * 1_000_000_000 + k * 1_000_000
                for connection, head, rate in zip(connections, heads, rates, strict=True):
                    plain[13:16] = rate[k]
                    data = bytearray(head + plain.tobytes())
                    struct.pack_into("<iI", data, 4, *divmod(stamp, 1_000_000_000))
                    writer.write(connection, stamp, bytes(data))
    return path


def iterate(path: Path) -> int:
    """Let rosbags yield every raw message."""
    with Reader(path) as reader:
        return sum(1 for _ in reader.messages())


def deserialised(buffer: np.ndarray, offset: np.ndarray, length: np.ndarray, count: int) -> Decoded:
    """Decode a batch by rosbags, message by message."""
    store = get_typestore(Stores.ROS2_JAZZY)
    decoded = Decoded.nothing(len(offset), count)
    data = buffer.tobytes()
    for k, (start, size) in enumerate(zip(offset.tolist(), length.tolist(), strict=True)):
        message = store.deserialize_cdr(data[start : start + size], IMU)
        rate, stamp = message.angular_velocity, message.header.stamp
        decoded.stamp[k] = stamp.sec * 1_000_000_000 + stamp.nanosec
        decoded.values[k] = rate.x, rate.y, rate.z
    return decoded


def measure(what: str, path: Path) -> dict[str, float]:
    """Take one figure in this process."""
    if what == "iterate":
        begun = time.perf_counter()
        messages = iterate(path)
    else:
        detector, _, slow = what.partition("+")
        config = Config.from_parameters({**PARAMETERS, "detector.name": detector})
        if slow:
            ImuSource.decode = staticmethod(deserialised)
        begun = time.perf_counter()
        summary = replay(Request(path, config))
        messages = summary.stream.messages
        if summary.scores.samples_judged != messages // 2:
            raise SystemExit(f"{detector} judged {summary.scores.samples_judged} of {messages // 2} samples")
    seconds = time.perf_counter() - begun
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"messages": messages, "seconds": seconds, "MB": memory}


def in_own_process(what: str, path: Path) -> dict[str, float]:
    words = [sys.executable, __file__, "--measure", what, "--bag", str(path)]
    return json.loads(subprocess.run(words, capture_output=True, text=True, check=True).stdout)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--measure", help=argparse.SUPPRESS)
    parser.add_argument("--bag", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        print(json.dumps(measure(arguments.measure, arguments.bag)))
        return
    with tempfile.TemporaryDirectory() as folder:
        bags = {minutes: write_bag(Path(folder) / f"{minutes:g}", minutes) for minutes in (1.0, arguments.minutes)}
        print(f"two Imu topics at {RATE} Hz; {arguments.minutes:g} minutes; messages a second")
        print(f"{'':42}{'messages/s':>12}{'of iterate':>12}{'MB, 1 min':>12}{f'MB, {arguments.minutes:g} min':>12}")
        bare = 0.0
        for what in ("iterate", "likelihood_ratio", "guaranteed", "likelihood_ratio+rosbags' deserialiser"):
            small, large = (in_own_process(what, bag) for bag in bags.values())
            speed = large["messages"] / large["seconds"]
            bare = bare or speed
            name = "rosbags iterates raw messages" if what == "iterate" else f"replay, {what.replace('+', ', ')}"
            print(f"{name:42}{speed:12.0f}{100 * speed / bare:11.0f}%{small['MB']:12.0f}{large['MB']:12.0f}")


if __name__ == "__main__":
    main()
