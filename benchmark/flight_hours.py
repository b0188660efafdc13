# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Flight hours of sound white noise: how often the whole monitor declares, and how long a detector runs to its alarm.

Hours: settings of config/two_imus.yaml with another false-alarm rate and votes of one sample, so that what is asked
for can be counted; in motion, at 100 Hz. Run length: mean samples to a false alarm of a detector alone, from the
number of alarms in so many samples; it begins anew after each.

    python benchmark/flight_hours.py hours [--hours 1000] [--per-hour 0.1] [--detector likelihood_ratio]
    python benchmark/flight_hours.py run-length [--samples 3.6e9] [--run-length 3.6e8] [--channels 4]
"""

from __future__ import annotations

import argparse
import os
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from fdi_ros import Block, Config, Geometry, NoiseModel, Pipeline, create_detector

CONFIG = Path(__file__).parents[1] / "config" / "two_imus.yaml"
RATE = 100
HOUR = 3600 * RATE


def flight(seed: int, hours: int, settings: dict[str, object]) -> tuple[int, int, int]:
    """Fly for some hours; return samples, alarms of the detector, declarations."""
    config = Config.from_file(CONFIG, settings)
    pipeline = Pipeline.from_config(config)
    rng, alarms, declarations = np.random.default_rng([20261121, seed]), 0, 0
    t = np.arange(HOUR) / RATE
    rate = 0.5 * np.column_stack([np.sin(0.7 * t), 0.6 * np.cos(1.1 * t), 0.8 * np.sin(0.3 * t + 1)])
    motion = rate @ pipeline.geometry.axes.T
    for hour in range(hours):
        z = rng.standard_normal(motion.shape)
        z *= 0.003
        z += motion
        output = pipeline.process(Block((hour * HOUR + np.arange(HOUR)) * 10_000_000 + 10**18, z))
        alarms += int(output.alarm.sum())
        declarations += len({event.row for event in output.events if event.declares})
    return hours * HOUR, alarms, declarations


def runs(seed: int, samples: int, channels: int, run_length: float) -> tuple[int, int]:
    """Watch sound noise; return samples and alarms, beginning anew after each."""
    geometry = Geometry.two_triad_cone() if channels == 6 else Geometry.cone(channels)
    detector = create_detector("cusum", geometry, NoiseModel(1.0), run_length=run_length)
    rng, alarms, left, block = np.random.default_rng([20261122, seed]), 0, samples, 100_000
    while left > 0:
        z = rng.standard_normal((min(block, left), channels))
        left -= len(z)
        while len(z):
            alarm = detector.detect(z).alarm
            if not alarm.any():
                break
            alarms += 1
            detector.reset()
            z = z[int(alarm.argmax()) + 1 :]
    return samples, alarms


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("what", choices=("hours", "run-length"))
    parser.add_argument("--hours", type=int, default=1000)
    parser.add_argument("--per-hour", type=float, default=0.1)
    parser.add_argument("--detector", default="likelihood_ratio")
    parser.add_argument("--alarms", type=int, default=1, help="alarms that confirm a fault, of as many samples")
    parser.add_argument("--samples", type=float, default=3.6e9)
    parser.add_argument("--run-length", type=float, default=3.6e8)
    parser.add_argument("--channels", type=int, default=4)
    arguments = parser.parse_args()
    workers, begun = os.cpu_count() or 1, time.perf_counter()
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        (report_hours if arguments.what == "hours" else report_run_length)(pool, arguments)
    print(f"{time.perf_counter() - begun:.0f} s on {workers} cores, load {os.getloadavg()[0]:.1f}")


def report_hours(pool: ProcessPoolExecutor, arguments: argparse.Namespace) -> None:
    settings = {
        "detector.name": arguments.detector,
        "detector.false_alarms_per_hour": arguments.per_hour,
        "decision.confirm_alarms": arguments.alarms,
        "decision.confirm_window": arguments.alarms,
        "decision.latch": False,
        "decision.clean_time": 0.01,
        "noise.scale_std": 0.0,
        "noise.timing_std": 0.0,
        "bias.startup_bias_duration": 0.0,
    }
    each = 10
    jobs = [pool.submit(flight, k, each, settings) for k in range(arguments.hours // each)]
    samples, alarms, declared = (sum(figures) for figures in zip(*(job.result() for job in jobs), strict=True))
    hours = samples / HOUR
    asked = arguments.per_hour * hours
    print(
        f"{hours:g} h, {samples:.3g} samples: {alarms} alarms and {declared} declarations,"
        f" {asked:g} +- {asked**0.5:.1f} alarms asked for"
    )


def report_run_length(pool: ProcessPoolExecutor, arguments: argparse.Namespace) -> None:
    share = 20
    jobs = [
        pool.submit(runs, k, round(arguments.samples / share), arguments.channels, arguments.run_length)
        for k in range(share)
    ]
    samples, alarms = (sum(figures) for figures in zip(*(job.result() for job in jobs), strict=True))
    mean = samples / alarms if alarms else float("inf")
    print(
        f"{samples:.3g} samples, {alarms} alarms: one in {mean:.3g} (+- {100 / max(alarms, 1) ** 0.5:.0f} %),"
        f" one in {arguments.run_length:.3g} asked for"
    )


if __name__ == "__main__":
    main()
