# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Figures of single detectors that docs/methods.md has and no study of config/studies: python benchmark/methods.py.

White noise of standard deviation 1 on every channel, at rest; all random numbers follow from SEED. The tables come in
the form of that page.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from fdi_ros import Geometry, NoiseModel, create_detector
from fdi_ros.detectors.base import Detector
from fdi_ros.experiments.contenders import moustakides_delay
from fdi_ros.model.samples import Array

SEED = 1
NOISE = NoiseModel(1.0)
MOUNTINGS = {
    "dodecahedron": Geometry.dodecahedron(),
    "two-triad cone": Geometry.two_triad_cone(),
    "5 on a cone": Geometry.cone(5),
    "9 on a cone": Geometry.cone(9),
}
ISOLATING = ("max_residual", "projector", "mean_abs_residual", "mean_square_residual", "rate_deviation")
SAMPLES, ALARMS, RUNS = 100_000, 500, 200
SETTLED = 4000
"""Samples before a fault of the delays: 40 s at 100 Hz."""


def white(rng: np.random.Generator, samples: int, n: int) -> Array:
    """Draw samples (N, n) of healthy channels at rest."""
    return rng.standard_normal((samples, n))


def one_fault(rng: np.random.Generator, geometry: Geometry, size: float) -> tuple[Array, NDArray[np.intp]]:
    """Draw SAMPLES samples (N, n), each with one channel off by size, all in turn: samples, faulty channels (N,)."""
    z, faulty = white(rng, SAMPLES, geometry.n), np.arange(SAMPLES) % geometry.n
    z[np.arange(SAMPLES), faulty] += size
    return z, faulty


def print_table(title: str, head: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """One table, as Markdown."""
    print(f"\n{title}\n")
    for row in (head, ["---"] * len(head), *rows):
        print(f"| {' | '.join(row)} |", flush=True)


def naming() -> None:
    """Print the share of samples in which the faulty channel has the best score, whether there is an alarm or not."""
    geometry, rows = MOUNTINGS["two-triad cone"], []
    for name, best in (("projector", np.argmin), ("recursive", np.argmax)):
        rng, shares = np.random.default_rng(SEED), []
        for size in (4, 6, 8, 20):
            z, faulty = one_fault(rng, geometry, size)
            scores = create_detector(name, geometry, NOISE).detect(z).scores
            shares.append(f"{np.mean(best(scores, axis=1) == faulty):.2f}")
        rows.append([f"`{name}` names it", *shares])
    head = ["fault on the two-triad cone", "4 sigma", "6 sigma", "8 sigma", "20 sigma"]
    print_table("recursive", head, rows)


def confidence() -> None:
    """Print the share of samples in which the faulty channel alone is isolated, and of wrong names."""
    rows = []
    for mounting in ("dodecahedron", "two-triad cone"):
        geometry = MOUNTINGS[mounting]
        for level in (0.999, 0.99):
            detector = create_detector(
                "likelihood_ratio", geometry, NOISE, false_alarm_probability=1e-3, confidence=level
            )
            rng, cells = np.random.default_rng(SEED), []
            for size in (6, 8, 10, 12):
                z, faulty = one_fault(rng, geometry, size)
                verdict = detector.detect(z)
                right = verdict.suspects[np.arange(SAMPLES), faulty]
                alone = verdict.isolated & (verdict.suspects.sum(axis=1) == 1) & right
                wrong = verdict.isolated & ~alone
                cells.append(f"{alone.mean():.2f} ({wrong.sum() / max(verdict.isolated.sum(), 1):.0e})")
            rows.append([f"{mounting}, confidence {level:g}", *cells])
    print_table("likelihood_ratio", ["", "6 sigma", "8 sigma", "10 sigma", "12 sigma"], rows)


def mean_run_length(detector: Detector, rng: np.random.Generator, chunk: int) -> float:
    """Mean number of samples to a false alarm, over ALARMS of them, from a fresh memory each time."""
    total = 0
    for _ in range(ALARMS):
        detector.reset()
        while True:
            alarm = detector.detect(white(rng, chunk, detector.geometry.n)).alarm
            if alarm.any():
                total += int(alarm.argmax()) + 1
                break
            total += chunk
    return total / ALARMS


def run_lengths() -> None:
    """Print mean run lengths of cusum, simulated, over those asked for."""
    rows = []
    for mounting, geometry in MOUNTINGS.items():
        cells = []
        for asked in (1000, 5000):
            ratios = []
            for shift in (0.5, 1.0, 2.0):
                detector = create_detector("cusum", geometry, NOISE, run_length=float(asked), shift=shift)
                ratios.append(mean_run_length(detector, np.random.default_rng(SEED), asked) / asked)
            cells.append(" / ".join(f"{ratio:.2f}" for ratio in ratios))
        rows.append([f"{mounting}, shift 0.5 / 1 / 2", *cells])
    print_table("cusum", ["", "1000 samples", "5000 samples"], rows)


def delays() -> None:
    """Print samples to the alarm and to the isolated channel of sequential, the first faulty one counted."""
    geometry, run_length = MOUNTINGS["two-triad cone"], 3.6e8
    detector = create_detector("sequential", geometry, NOISE, run_length=run_length)
    share = float(np.sqrt(geometry.S[1, 1]))
    rng, columns = np.random.default_rng(SEED), []
    for size in (2.0, 4.0, 8.0):
        alarms, names = [], []
        for _ in range(RUNS):
            detector.reset()
            z = white(rng, SETTLED + 400, geometry.n)
            z[SETTLED:, 1] += size
            verdict = detector.detect(z)
            alone = verdict.isolated & (verdict.suspects.sum(axis=1) == 1) & verdict.suspects[:, 1]
            alarms.append(int(verdict.alarm[SETTLED:].argmax()) + 1)
            names.append(int(alone[SETTLED:].argmax()) + 1)
        columns.append([moustakides_delay(size * share, run_length), np.mean(alarms), np.mean(names)])
    head = [f"two-triad cone, white noise, after 40 s, B = 3.6e8, {RUNS} runs", "2 sigma", "4 sigma", "8 sigma"]
    words = ("least possible mean delay, channel and size known", "alarm, the first faulty sample counted", "isolated")
    rows = [[word, *(f"{column[k]:.1f}" for column in columns)] for k, word in enumerate(words)]
    print_table("sequential", head, rows)


def random_axes() -> None:
    """Count channels that single-fault methods call isolable on random axes, and wrong isolated verdicts."""
    rows = []
    for name in (*ISOLATING, "projector, l1"):
        method, _, norm = name.partition(", ")
        rng, isolable, channels, wrong = np.random.default_rng(SEED), 0, 0, {50.0: 0, 5000.0: 0}
        for k in range(60):
            axes = rng.standard_normal((5 + k % 5, 3))
            geometry = Geometry.from_axes(axes / np.linalg.norm(axes, axis=1)[:, None])
            options = {"norm": norm} if norm else {}
            detector = create_detector(method, geometry, NOISE, false_alarm_probability=1e-6, **options)
            channels += int(geometry.isolable.sum())
            isolable += int((detector.isolable & geometry.isolable).sum())
            for i in np.flatnonzero(geometry.isolable):
                for size in wrong:
                    z = white(rng, 20, geometry.n)
                    z[:, i] += size
                    verdict = detector.detect(z)
                    wrong[size] += bool((verdict.isolated & ~verdict.suspects[:, i]).any())
        rows.append([f"`{name}`", f"{isolable} of {channels}", *(str(count) for count in wrong.values())])
    print_table("residual searches and projector", ["", "isolable", "wrong at 50", "wrong at 5000"], rows)


if __name__ == "__main__":
    naming()
    confidence()
    delays()
    random_axes()
    run_lengths()
