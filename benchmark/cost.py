# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Cost of the whole monitor beside one NumPy statistic, `abs(S @ z).argmax()` of one sample.

One by one: one sample through `Pipeline.process`, and one of as many messages as there are units through the node's
receiver; medians, us. Offline: many samples at once, us of CPU time a sample, median of five. calm: healthy channels in
motion; faults: every ten seconds one channel is off for one second, and declarations are forgiven after half a second;
noise: twice what the settings say. nine and nine: nine gyros and the nine accelerometers beside them. --trials:
thousands of samples offline.

The machine may change its speed within a run. So statistic and monitor are timed in turn, some ten milliseconds each:
times and message_times are medians of the ratios of neighbours, offline of the mean ratio of a run.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise
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
WARM, MEASURED, REPEATS = 3000, 6000, 5  # samples one by one, and runs offline
IN_TURN = 200  # samples one by one before it is the turn of the next
PIECES = 30  # of a run offline, each beside the statistic


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


def each(call: Callable[[int], Any], samples: range) -> float:
    """Median time of a call for each of these samples, us."""
    spent = []
    for k in samples:
        begun = time.perf_counter_ns()
        call(k)
        spent.append(time.perf_counter_ns() - begun)
    return median(spent) / 1e3


def statistic_of(pipeline: Pipeline, block: Block) -> Callable[[int], Any]:
    """Return the yardstick: the statistic of sample k."""
    S, z = pipeline.geometry.S, block.z
    return lambda k: np.abs(S @ z[k]).argmax()


def one_by_one(config: Config, asked: Asked) -> dict[str, float]:
    """Time one statistic, one sample, and one sample of messages."""
    pipeline = Pipeline.from_config(config)
    block = stream(pipeline, asked, WARM + MEASURED, "calm")
    pipeline.process(block[:WARM])
    statistic = statistic_of(pipeline, block)
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
    calls = (statistic, lambda k: pipeline.process(block[k : k + 1]), take)
    turns = [
        [each(call, range(begin, begin + IN_TURN)) for call in calls]
        for begin in range(WARM, WARM + MEASURED, IN_TURN)
    ]
    spent = np.array(turns)
    names = ("statistic", "sample", "messages")
    figures = dict(zip(names, np.median(spent, axis=0).tolist(), strict=True))
    times, message_times = np.median(spent[:, 1:] / spent[:, :1], axis=0).tolist()
    return {**figures, "times": times, "message_times": message_times}


def offline(pipeline: Pipeline, block: Block) -> dict[str, float]:
    """Time a whole stream in pieces, each beside the statistic."""
    statistic = statistic_of(pipeline, block)
    edges = np.linspace(10, len(block), PIECES + 1).astype(int).tolist()
    spent = np.empty((REPEATS, PIECES, 2))
    for run in spent:
        pipeline.restart()
        pipeline.process(block[:10])
        for turn, (begin, end) in zip(run, pairwise(edges), strict=True):
            turn[0] = each(statistic, range(begin, begin + IN_TURN))
            begun = time.thread_time()
            pipeline.process(block[begin:end])
            turn[1] = 1e6 * (time.thread_time() - begun) / (end - begin)
    ratios = spent[..., 1] / spent[..., 0]
    return {
        "statistic": float(np.median(spent[..., 0])),
        "sample": float(np.median(spent[..., 1].mean(axis=1))),
        "times": float(np.median(ratios.mean(axis=1))),
    }


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
        yield f"{mounting}, one by one", one_by_one(config, asked)
        for rate in (100.0, 1000.0):
            pipeline = Pipeline.from_config(
                config.replaced({**FORGIVING, "sample_rate": rate})
            )
            for situation in SITUATIONS:
                block = stream(pipeline, asked, 1000 * asked.count(300), situation)
                label = f"{mounting}, offline, {rate:g} Hz, {situation}"
                yield label, offline(pipeline, block)
