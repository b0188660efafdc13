# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Cost of the whole monitor beside one NumPy statistic, `abs(S @ z).argmax()` of one sample.

One by one: one sample through `Pipeline.process`, and one of as many messages as there are units through the node's
receiver; medians, us. Offline: many samples at once, us of CPU time a sample, median of five. calm: healthy channels in
motion; faults: every ten seconds one channel is off for one second, and declarations are forgiven after half a second;
noise: twice what the settings say. nine and nine: nine gyros and the nine accelerometers beside them. --trials:
thousands of samples offline.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from statistics import median
from typing import Any

import numpy as np
from trials import NOISE, PARALLEL, Asked, Flight, Row, Sines

from fdi_ros import Block, Config, Pipeline
from fdi_ros.core.live import MORE, SUPPLY
from fdi_ros.core.messages import ImuTemplate, fill_force
from fdi_ros.monitor.receiver import Receiver

FIGURES = {
    **dict.fromkeys(
        ("statistic", "sample", "times", "messages", "message_times"), ".2f"
    )
}
FOUR = {
    **PARALLEL,
    "imus.topics": (*PARALLEL["imus.topics"], "imu_4/data_raw"),
    "imus.names": (*PARALLEL["imus.names"], "imu_4"),
}
GRAVITY, SWAY, FORCE_NOISE = 9.81, 2.0, 0.15  # m/s^2
FORGIVING = {"decision.latch": False, "decision.clean_time": 0.5}
SITUATIONS = ("calm", "faults", "noise")
WARM, MEASURED, REPEATS = 3000, 3000, 5  # samples one by one, and runs offline


def stream(pipeline: Pipeline, asked: Asked, count: int, situation: str) -> Block:
    """Simulate a vehicle that rests and then turns about all axes."""
    rng, rate = asked.rng("cost", situation), pipeline.config.sample_rate
    flight = Flight.of(pipeline, rng, (count - 1) / rate, Sines.drawn(0.6, rng))
    added = (2.0 if situation == "noise" else 1.0) * rng.standard_normal(flight.shape)
    if situation == "faults":
        second = flight.seconds.astype(int)
        struck = (second % 10 == 9) & (second > 10)
        added[struck, second[struck] // 10 % flight.shape[1]] += 0.1 / NOISE
    block = flight.block(added)
    if pipeline.accelerometers is None:
        return block
    force = FORCE_NOISE * rng.standard_normal(block.z.shape)
    force += SWAY * np.sin(1.7 * flight.seconds)[:, np.newaxis]
    force[:, 2::3] += GRAVITY
    return replace(block, acceleration=Block(block.stamp, force))


def messages_of(block: Block, units: range) -> list[list[bytes]]:
    """Return the messages of each sample."""
    template = ImuTemplate("imu")
    messages = []
    for k, (stamp, row) in enumerate(zip(block.stamp, block.z, strict=True)):
        of_sample = []
        for unit in units:
            own = slice(3 * unit, 3 * unit + 3)
            template.fill(int(stamp), row[own].tolist(), (0.0,) * 9)
            if block.acceleration is not None:
                force = block.acceleration.z[k, own]
                fill_force(template.bytes, template.at, 1.0, force, np.zeros(6))
            of_sample.append(template.bytes.tobytes())
        messages.append(of_sample)
    return messages


def each(call: Callable[[int], Any], count: int) -> float:
    """Median time of so many calls, us."""
    spent = []
    for k in range(count):
        begun = time.perf_counter_ns()
        call(k)
        spent.append(time.perf_counter_ns() - begun)
    return median(spent) / 1e3


def one_by_one(config: Config, asked: Asked) -> dict[str, float]:
    """Time one statistic, one sample, and one sample of messages."""
    pipeline = Pipeline.from_config(config)
    block = stream(pipeline, asked, WARM + MEASURED, "calm")
    pipeline.process(block[:WARM])
    S, z = pipeline.geometry.S, block.z
    receiver = Receiver(Pipeline.from_config(config))
    messages = messages_of(block, range(pipeline.geometry.n // 3))

    def take(k: int) -> None:
        for unit, message in enumerate(messages[k]):
            told = receiver.receive(unit, message)
            while told:
                if told & SUPPLY:
                    receiver.supply()
                told = receiver.go_on() if told & MORE else 0

    for k in range(WARM):
        take(k)
    statistic = each(lambda k: np.abs(S @ z[k]).argmax(), MEASURED)
    sample = each(lambda k: pipeline.process(block[WARM + k : WARM + k + 1]), MEASURED)
    received = each(lambda k: take(WARM + k), MEASURED)
    ratios = {"times": sample / statistic, "message_times": received / statistic}
    return {"statistic": statistic, "sample": sample, "messages": received, **ratios}


def offline(pipeline: Pipeline, block: Block) -> float:
    """Time a whole stream, us a sample."""
    spent = []
    for _ in range(REPEATS):
        pipeline.restart()
        pipeline.process(block[:10])
        begun = time.thread_time()
        pipeline.process(block[10:])
        spent.append(time.thread_time() - begun)
    return 1e6 * median(spent) / len(block)


def measure(asked: Asked) -> Iterator[Row]:
    """Six, nine and twelve channels, and nine with their accelerometers, at 100 Hz and 1 kHz."""
    felt = {"accelerometers.enabled": "on", "accelerometers.noise_std": FORCE_NOISE}
    configs = {
        **asked.configs(),
        "twelve": asked.configs(FOUR)["six"],
        "nine and nine": asked.configs(felt)["nine"],
    }
    for mounting, config in configs.items():
        if not asked.wants(mounting):
            continue
        single = one_by_one(config, asked)
        yield f"{mounting}, one by one", single
        for rate in (100.0, 1000.0):
            pipeline = Pipeline.from_config(
                config.replaced({**FORGIVING, "sample_rate": rate})
            )
            for situation in SITUATIONS:
                spent = offline(
                    pipeline,
                    stream(pipeline, asked, 1000 * asked.count(300), situation),
                )
                yield (
                    f"{mounting}, offline, {rate:g} Hz, {situation}",
                    {
                        "sample": spent,
                        "times": spent / single["statistic"],
                    },
                )
