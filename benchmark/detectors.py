# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Cost of every detector: one sample through `detect`, and a recording, beside the cheapest statistic there is.

    python benchmark/detectors.py [--json FILE]

One sample: `detect` on one healthy row, microseconds, median over distinct rows. The floor is ``abs(S @ z).argmax()``
of one row. A recording: millions of samples a second, median of five: healthy; with channel 2 off by 30 standard
deviations in every sample; healthy with twice the noise assumed. The noise is constant, or depends on rate and
acceleration.
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from fdi_ros import Geometry, NoiseModel, create_detector
from fdi_ros.detectors import DETECTORS

SIGMA = 1e-3
NOISES = {
    "constant": NoiseModel(SIGMA, bound=4 * SIGMA),
    "rate-dependent": NoiseModel(SIGMA, scale_std=1e-3, timing_std=3e-4, bound=4 * SIGMA),
}
GEOMETRIES = {5: Geometry.cone(5), 6: Geometry.two_triad_cone(), 9: Geometry.cone(9)}
ROWS, ONE_BY_ONE, REPEATS = 100_000, 2000, 5

Row = dict[str, Any]


def samples(geometry: Geometry, noise: NoiseModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Values without errors (ROWS, n), errors of healthy channels (ROWS, n), and accelerations (ROWS, 3)."""
    rng = np.random.default_rng(1)
    rate, acceleration = rng.uniform(-1, 1, (ROWS, 3)), rng.normal(0, 3, (ROWS, 3))
    std = np.sqrt(noise.for_channels(geometry.n).variance(geometry, rate, acceleration))
    return rate @ geometry.axes.T, std * rng.standard_normal(std.shape), acceleration


def seconds(call: Callable[[], Any]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def microseconds(call: Callable[[int], Any]) -> float:
    """Median time of a call with 0, 1, 2, ..."""
    return 1e6 * statistics.median(seconds(lambda k=k: call(k)) for k in range(ONE_BY_ONE))


def measure(name: str, noise_name: str, n: int) -> Row:
    geometry, noise = GEOMETRIES[n], NOISES[noise_name]
    clean, error, acceleration = samples(geometry, noise)
    sound = clean + error
    detector = create_detector(name, geometry, noise)
    detector.detect(sound[:1], acceleration[:1])

    def one(k: int) -> None:
        detector.detect(sound[k : k + 1], acceleration[k : k + 1])

    def per_second(z: np.ndarray) -> float:
        detector.reset()
        return ROWS / statistics.median(seconds(lambda: detector.detect(z, acceleration)) for _ in range(REPEATS))

    return {
        "detector": name,
        "n": n,
        "noise": noise_name,
        "one_us": microseconds(one),
        "sound_per_s": per_second(sound),
        "faulty_per_s": per_second(sound + 30 * SIGMA * (np.arange(n) == 1)),
        "double_noise_per_s": per_second(clean + 2 * error),
    }


def floor(n: int) -> Row:
    S, (clean, error, _) = GEOMETRIES[n].S, samples(GEOMETRIES[n], NOISES["constant"])
    z = clean + error
    return {"detector": "abs(S @ z).argmax()", "n": n, "one_us": microseconds(lambda k: abs(S @ z[k]).argmax())}


def print_row(row: Row) -> None:
    rates = "".join(f"{row[key] / 1e6:9.2f}" for key in row if key.endswith("_per_s"))
    print(f"{row['detector']:20}{row['n']:3}  {row.get('noise', ''):15}{row['one_us']:7.1f}{rates}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    arguments = parser.parse_args()
    print(f"{'':20}{'n':>3}  {'noise':15}{'one us':>7}{'healthy':>9}{'faulty':>9}{'2x noise':>9}  M samples/s")
    results = []
    for n in GEOMETRIES:
        names = ["determinant"] if n == 5 else [name for name in DETECTORS if name != "determinant"]
        results.append(floor(n))
        print_row(results[-1])
        for name in names:
            for noise in NOISES:
                results.append(measure(name, noise, n))
                print_row(results[-1])
    if arguments.json:
        machine = {"python": platform.python_version(), "numpy": np.__version__, "machine": platform.machine()}
        arguments.json.write_text(json.dumps({"machine": machine, "results": results}, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
