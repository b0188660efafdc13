# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The whole monitor: one sample, one message, and many samples offline, beside one NumPy statistic.

Settings are those of config/two_imus.yaml. Calm: sound channels in motion; faults: every ten seconds one channel is
off for one second, and declarations are forgiven after half a second; noise: twice what the settings say.

    python benchmark/pipeline.py [--samples 1000000] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from fdi_ros import Block, Config, Pipeline
from fdi_ros.core.live import MORE, SUPPLY
from fdi_ros.core.messages import ImuTemplate
from fdi_ros.detectors import DETECTORS
from fdi_ros.errors import FdiError
from fdi_ros.monitor.receiver import Receiver

CONFIG = Path(__file__).parents[1] / "config" / "two_imus.yaml"
RATE = 100.0
STEP = round(1e9 / RATE)
SITUATIONS = ("calm", "faults", "noise")
REPEATS = 5


def stream(pipeline: Pipeline, count: int, situation: str) -> Block:
    """Simulate a vehicle that rests for four seconds and then turns about all axes."""
    rng, t = np.random.default_rng(0), np.arange(count) / RATE
    rate = np.column_stack([np.sin(0.7 * t), 0.6 * np.cos(1.1 * t), 0.8 * np.sin(0.3 * t + 1)])
    rate[: round(4 * RATE)] = 0.0
    z = rate @ pipeline.geometry.axes.T
    z += rng.normal(0, 0.003 * (2 if situation == "noise" else 1), z.shape)
    if situation == "faults":
        second = (np.arange(count) // RATE).astype(int)
        struck = (second % 10 == 9) & (second > 10)
        z[struck, second[struck] // 10 % z.shape[1]] += 0.1
    return Block(10**18 + STEP * np.arange(count, dtype=np.int64), z)


def each(call: Callable[[int], Any], count: int) -> float:
    """Median time of so many calls, us."""
    spent = []
    for k in range(count):
        begun = time.perf_counter_ns()
        call(k)
        spent.append(time.perf_counter_ns() - begun)
    return median(spent) / 1e3


def one_by_one(config: Config) -> dict[str, float]:
    """One NumPy statistic, one sample through `Pipeline.process`, one sample of two messages, us."""
    pipeline = Pipeline.from_config(config)
    block = stream(pipeline, 6000, "calm")
    pipeline.process(block[:3000])
    S, z = pipeline.geometry.S, block.z
    receiver = Receiver(Pipeline.from_config(config))
    template = ImuTemplate("imu")
    messages = [
        template.fill(int(stamp), row[3 * unit : 3 * unit + 3].tolist(), (0.0,) * 9)
        for stamp, row in zip(block.stamp, z, strict=True)
        for unit in (0, 1)
    ]

    def take(k: int) -> None:
        for unit in (0, 1):
            told = receiver.take(unit, messages[2 * k + unit])
            while told:
                if told & SUPPLY:
                    receiver.supply()
                told = receiver.go_on() if told & MORE else 0

    for k in range(3000):
        take(k)
    return {
        "NumPy statistic": each(lambda k: np.abs(S @ z[k]).argmax(), 3000),
        "one sample": each(lambda k: pipeline.process(block[3000 + k : 3001 + k]), 3000),
        "two messages": each(lambda k: take(3000 + k), 3000),
    }


def offline(config: Config, count: int, situation: str) -> float:
    """Return the samples a second of a whole stream, the median of some runs."""
    block = stream(Pipeline.from_config(config), count, situation)
    spent = []
    for _ in range(REPEATS):
        pipeline = Pipeline.from_config(config)
        pipeline.process(block[:10])
        begun = time.perf_counter()
        pipeline.process(block[10:])
        spent.append(time.perf_counter() - begun)
    return count / median(spent)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--samples", type=int, default=1_000_000)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    config = Config.from_file(CONFIG)
    single = one_by_one(config)
    floor = single["NumPy statistic"]
    for name, spent in single.items():
        print(f"{name:20}{spent:8.2f} us{spent / floor:8.2f} x the statistic")
    speeds: dict[str, Any] = {}
    print(f"\n{'offline, M samples/s':22}" + "".join(f"{situation:>8}" for situation in SITUATIONS))
    for name in DETECTORS:
        forgiving = config.replaced(
            {"detector.name": name, "decision.latch": False, "decision.clean_time": 0.5, "decision.confirm_alarms": 4}
        )
        try:
            speeds[name] = {situation: offline(forgiving, arguments.samples, situation) for situation in SITUATIONS}
        except FdiError as error:
            speeds[name] = str(error)
            print(f"{name:22}{error}")
            continue
        print(f"{name:22}" + "".join(f"{speeds[name][situation] / 1e6:8.2f}" for situation in SITUATIONS), flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps({"one_sample_us": single, "offline": speeds}, indent=2))


if __name__ == "__main__":
    main()
