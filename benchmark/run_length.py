# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Run length of `cusum` alone: mean samples to a false alarm in white noise, from the alarms in so many samples.

    python benchmark/run_length.py [--samples 3.6e9] [--run-length 3.6e8] [--channels 4]

It begins anew after each alarm. What the whole monitor declares: `python benchmark/estimator.py false`.
"""

from __future__ import annotations

import argparse
import os
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np

from fdi_ros import Geometry, NoiseModel, create_detector

JOBS = 20


def runs(seed: int, samples: int, channels: int, run_length: float) -> tuple[int, int]:
    """Watch healthy noise; return samples and alarms, beginning anew after each."""
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
    parser.add_argument("--samples", type=float, default=3.6e9)
    parser.add_argument("--run-length", type=float, default=3.6e8)
    parser.add_argument("--channels", type=int, default=4)
    asked = parser.parse_args()
    with ProcessPoolExecutor(os.cpu_count() or 1, mp_context=get_context("spawn")) as pool:
        each = (round(asked.samples / JOBS), asked.channels, asked.run_length)
        jobs = [pool.submit(runs, k, *each) for k in range(JOBS)]
        samples, alarms = (sum(figures) for figures in zip(*(job.result() for job in jobs), strict=True))
    mean = samples / alarms if alarms else float("inf")
    print(
        f"{samples:.3g} samples, {alarms} alarms: one in {mean:.3g} (+- {100 / max(alarms, 1) ** 0.5:.0f} %),"
        f" one in {asked.run_length:.3g} asked for"
    )


if __name__ == "__main__":
    main()
