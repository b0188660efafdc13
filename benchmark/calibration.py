# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Calibration of simulated units against their truth: python benchmark/calibration.py [SEEDS]."""

import sys
import time

import numpy as np

from fdi_ros.calibration.trial import Trial, run_trial

DURATION = 120.0


def rms(values: list[np.ndarray]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(values) ** 2)))


def main(seeds: int) -> None:
    begun = time.perf_counter()
    trials: list[Trial] = [run_trial(seed, DURATION) for seed in range(seeds)]
    bias = np.abs(np.concatenate([t.bias_in_errors for t in trials]))
    checks = np.array([[c.overall for c in t.calibration.after.classes[:3]] for t in trials])
    rows = [
        ("axes, angle rms", f"{np.degrees(rms([t.angle for t in trials])):.4f} deg", "0.1 deg"),
        ("axes, scale rms", f"{rms([t.scale for t in trials]):.4%}", "0.1 %"),
        ("axes, error / stated standard error, rms", f"{rms([t.axes_in_errors for t in trials]):.3f}", "0.8 to 1.2"),
        ("biases, error / stated standard error, rms", f"{rms([t.bias_in_errors for t in trials]):.3f}", "0.8 to 1.2"),
        ("biases within 3 stated standard errors", f"{np.mean(bias < 3):.2%}", "99 %"),
        ("delay, error / stated standard error, rms", f"{rms([t.delay_in_errors for t in trials]):.3f}", "0.8 to 1.2"),
        ("normalised residual at rest, slow, fast", " ".join(f"{v:.3f}" for v in checks.mean(axis=0)), "1"),
        ("faults found where there are none", str(sum(len(t.calibration.faults.spans) for t in trials)), "0"),
    ]
    print(f"{seeds} units of two triads, {DURATION:g} s each, {(time.perf_counter() - begun) / seeds:.1f} s a unit\n")
    print(f"| {'figure':<42} | {'measured':>18} | {'asked for':>10} |\n| --- | ---: | ---: |")
    for name, value, wanted in rows:
        print(f"| {name:<42} | {value:>18} | {wanted:>10} |")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 50)
