"""Cost of every detector: one sample at a time and in blocks, beside the cheapest statistic there is.

    python benchmark/detectors.py [--json FILE] [--quick]

One at a time: `detect` on blocks of one row, microseconds, median and 99th percentile over distinct samples; "sound":
no fault in them, "faulty": channel 2 is 30 standard deviations off in every one. Blocks: samples a second in a block of
100 000 sound rows, best of three. The floor is ``abs(S @ z).argmax()`` of one row. The guaranteed intervals are also
found by linear programmes, two a channel and pair of channels left out (180 at n = 6), with HiGHS through SciPy.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from collections.abc import Callable
from itertools import combinations
from typing import Any

import numpy as np
from scipy.optimize import linprog

from fdi_ros import Geometry, NoiseModel, create_detector
from fdi_ros.detectors import DETECTORS, Detector

SIGMA = 1e-3
CONSTANT = NoiseModel(SIGMA, bound=4 * SIGMA)
RATE_DEPENDENT = NoiseModel(SIGMA, scale_std=1e-3, timing_std=3e-4, bound=4 * SIGMA)
GEOMETRIES = {5: Geometry.cone(5), 6: Geometry.two_triad_cone(), 9: Geometry.cone(9)}
CASES: list[tuple[str, str, NoiseModel, tuple[int, ...]]] = [
    *((name, name, CONSTANT, (5,) if name == "determinant" else (6, 9)) for name in DETECTORS),
    ("likelihood_ratio, rate-dependent noise", "likelihood_ratio", RATE_DEPENDENT, (6, 9)),
    ("cusum, rate-dependent noise", "cusum", RATE_DEPENDENT, (6, 9)),
]

Row = dict[str, Any]


def samples(geometry: Geometry, rows: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    rate = rng.uniform(-1, 1, (rows, 3))
    return rate @ geometry.axes.T + rng.normal(0, SIGMA, (rows, geometry.n))


def microseconds(call: Callable[[np.ndarray], Any], z: np.ndarray) -> tuple[float, float]:
    """Median and 99th percentile of one call on one row."""
    rows = [z[i : i + 1] for i in range(len(z))]
    for row in rows[:50]:
        call(row)
    spent = np.empty(len(rows))
    clock = time.perf_counter
    for i, row in enumerate(rows):
        start = clock()
        call(row)
        spent[i] = clock() - start
    return 1e6 * float(np.median(spent)), 1e6 * float(np.percentile(spent, 99))


def floor(geometry: Geometry, rows: int) -> Row:
    S = geometry.S
    z = samples(geometry, rows, 1)
    median, p99 = microseconds(lambda row: abs(S @ row[0]).argmax(), z)
    return {"case": "floor: abs(S @ z).argmax()", "n": geometry.n, "sound_us": median, "sound_p99_us": p99}


def block_rate(detector: Detector, rows: int) -> float:
    z = samples(detector.geometry, rows, 2)
    best = np.inf
    for _ in range(3):
        detector.reset()
        start = time.perf_counter()
        detector.detect(z)
        best = min(best, time.perf_counter() - start)
    return rows / best


def measure(case: str, name: str, noise: NoiseModel, n: int, rows: int, block: int) -> Row:
    geometry = GEOMETRIES[n]
    start = time.perf_counter()
    detector = create_detector(name, geometry, noise)
    built = time.perf_counter() - start
    z = samples(geometry, rows, 1)
    median, p99 = microseconds(detector.detect, z)
    detector.reset()
    z[:, 1] += 30 * SIGMA
    faulty, faulty_p99 = microseconds(detector.detect, z)
    return {
        "case": case,
        "n": n,
        "sound_us": median,
        "sound_p99_us": p99,
        "faulty_us": faulty,
        "faulty_p99_us": faulty_p99,
        "samples_per_s": block_rate(detector, block),
        "build_ms": 1e3 * built,
    }


def programmes(geometry: Geometry, bound: float, z: np.ndarray) -> int:
    """Extremes of every channel over all pairs left out, by the dual programmes; how many were solved."""
    H, solved = geometry.axes, 0
    for pair in combinations(range(geometry.n), 2):
        kept = [i for i in range(geometry.n) if i not in pair]
        rows = H[kept].T
        equal = np.hstack([rows, -rows])
        for axis in H:
            for sign in (1.0, -1.0):
                cost = np.concatenate([bound + z[kept], bound - z[kept]])
                linprog(cost, A_eq=equal, b_eq=sign * axis, bounds=(0, None), method="highs")
                solved += 1
    return solved


def measure_programmes(repeats: int) -> tuple[Row, Row]:
    geometry, bound = GEOMETRIES[6], 4 * SIGMA
    z = samples(geometry, repeats, 3)
    z[:, 1] += 30 * SIGMA
    spent = []
    for sample in z:
        start = time.perf_counter()
        solved = programmes(geometry, bound, sample)
        spent.append(time.perf_counter() - start)
    detector: Any = create_detector("guaranteed", geometry, CONSTANT)
    rows = samples(geometry, 2000, 4)
    rows[:, 1] += 30 * SIGMA
    median, p99 = microseconds(detector.error_bounds, rows)
    highs = {"case": f"{solved} HiGHS programmes", "n": 6, "faulty_us": 1e6 * float(np.median(spent))}
    return highs, {"case": "guaranteed.error_bounds", "n": 6, "faulty_us": median, "faulty_p99_us": p99}


def print_table(rows: list[Row]) -> None:
    floors = {row["n"]: row["sound_us"] for row in rows if row["case"].startswith("floor")}
    heads = (("", 40), ("n", 3), ("sound us", 10), ("p99", 8), ("x floor", 9), ("faulty us", 11), ("p99", 8))
    print("".join(f"{head:>{width}}" for head, width in (*heads, ("samples/s", 12), ("build ms", 10))))
    for row in rows:
        sound, faulty = row.get("sound_us"), row.get("faulty_us")
        cells = [
            f"{sound:10.1f}{row['sound_p99_us']:8.1f}{sound / floors[row['n']]:9.1f}" if sound else f"{'':27}",
            f"{faulty:11.1f}" if faulty else "",
            f"{row['faulty_p99_us']:8.1f}" if "faulty_p99_us" in row else "",
            f"{row['samples_per_s']:12,.0f}{row['build_ms']:10.1f}" if "samples_per_s" in row else "",
        ]
        print(f"{row['case']:40}{row['n']:3}" + "".join(cells))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", help="also write the figures to this file")
    parser.add_argument("--quick", action="store_true", help="fewer samples: a check that it runs")
    arguments = parser.parse_args()
    rows, block, repeats = (300, 10_000, 1) if arguments.quick else (4000, 100_000, 5)
    results = [floor(GEOMETRIES[n], rows) for n in GEOMETRIES]
    results += [measure(case, name, noise, n, rows, block) for case, name, noise, sizes in CASES for n in sizes]
    highs, bounds = measure_programmes(repeats)
    results += [highs, bounds]
    print_table(results)
    print(f"guaranteed: {highs['faulty_us'] / bounds['faulty_us']:,.0f} times as fast as the programmes")
    if arguments.json:
        machine = {"python": platform.python_version(), "numpy": np.__version__, "machine": platform.machine()}
        with open(arguments.json, "w", encoding="utf-8") as file:
            json.dump({"machine": machine, "results": results}, file, indent=1)


if __name__ == "__main__":
    main()
