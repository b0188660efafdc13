# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Are covariance and protection level true.

nees: NEES/3 of the fused rate, and its error beside the best possible. Axes and clocks are known, biases are not;
bias_walk is 5e-5 rad/s/sqrt(s), in the settings and in the gyros where they walk. Counted from 10 s after whatever
begins at 60 s. nees: e' P^-1 e / 3 with the truth, mean of all samples (median of the flights beside); over best: rms
error over that of known biases, noise and faults, median; beyond 5: share of samples with an axis more than 5 published
standard deviations off; doubt: share of the samples with a channel AMBIGUOUS (only these count in "under doubt"); no
rate: without a fused rate.

recovery: the level beside the error of the rate under the worst fault of one channel. The settings allow 1e-5 in a
sample at a prior of 1e-3 for a fault of any channel: one sample in 100 may exceed the level while a channel is faulty.
A bias of 2 to 10 sigma begins after 15 s, or one of 8 after an hour at rest; at each age of it, 10 ms to 2 s, the error
of each axis over its level is taken of all trials, and of these the 99 % point (the largest of fewer than 100). worst:
the largest over sizes, ages and axes; level over: its inverse (below 1: it does not hold); sigma, age: where; no level:
share of the samples with none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from trials import (
    IDEAL,
    NOISE,
    RATE,
    Array,
    Asked,
    Flight,
    Rng,
    Row,
    Sines,
    fresh,
    is_state,
    labelled,
    walks,
)

from fdi_ros import Pipeline
from fdi_ros.monitor.output import ChannelState

WALK = 5e-5  # rad/s per square root of a second
ONSET, SETTLED, LENGTH = 60.0, 10.0, 300.0
"""When things begin, what is not counted after it, and how long a flight takes, s."""
FIGURES = {
    **dict.fromkeys(("nees", "nees_median", "over_best"), ".2f"),
    "beyond_5": ".2%",
    "doubt": ".0%",
    "no_rate": ".1%",
}

Change = Callable[[Flight, Rng, Array], Array]
"""Adds to noise (N, n), in sigma, from the onset on; returns the standard deviations (n,) that it then has: inf of
channels that are of no use."""


def nothing(flight: Flight, rng: Rng, added: Array) -> Array:
    return np.ones(flight.shape[1])


def louder(count: int, factor: float) -> Change:
    """Noise of one channel, or of the three of a unit, so many times as strong."""

    def change(flight: Flight, rng: Rng, added: Array) -> Array:
        std, n = np.ones(flight.shape[1]), flight.shape[1]
        std[
            int(rng.integers(n))
            if count == 1
            else 3 * int(rng.integers(n // 3)) + np.arange(3)
        ] = factor
        added[round(ONSET * RATE) :] *= std
        return std

    return change


def biased(flight: Flight, rng: Rng, added: Array) -> Array:
    """One channel, 20 sigma."""
    channel, std = int(rng.integers(flight.shape[1])), np.ones(flight.shape[1])
    added[round(ONSET * RATE) :, channel] += 20.0 * rng.choice([-1, 1])
    std[channel] = np.inf
    return std


def two_biases(flight: Flight, rng: Rng, added: Array) -> Array:
    """Of two channels that are parallel where there are three units, 12 and 20 sigma."""
    added[round(ONSET * RATE) :, [0, 3]] += np.array([12.0, 20.0]) * rng.choice(
        [-1, 1], 2
    )
    return np.ones(flight.shape[1])


def replaying(flight: Flight, rng: Rng, added: Array) -> Array:
    """One unit shows what it showed 5 s before."""
    onset, back, own = round(ONSET * RATE), round(5 * RATE), slice(0, 3)
    shown = flight.shown()[:, own] / NOISE + added[:, own]
    added[onset:, own] += shown[onset - back : -back] - shown[onset:]
    return np.array([np.inf] * 3 + [1.0] * (flight.shape[1] - 3))


@dataclass(frozen=True)
class Case:
    """What the gyros are up against."""

    amplitude: float = 0.5  # of the motion, rad/s
    walk: float = 0.0
    length: float = LENGTH
    change: Change = nothing
    known: bool = True  # whether there is a best possible error
    doubt: bool = False


CASES = {
    "white, at rest": Case(0.0),
    "white, in motion": Case(),
    "walk, an hour at rest": Case(0.0, WALK, 3600.0, known=False),
    "walk, an hour in motion": Case(0.5, WALK, 3600.0, known=False),
    "one channel excluded": Case(change=biased),
    "one channel x3": Case(change=louder(1, 3.0)),
    "one channel x10": Case(change=louder(1, 10.0)),
    "one channel x10, at rest": Case(0.0, change=louder(1, 10.0)),
    "one unit x3": Case(change=louder(3, 3.0)),
    "under doubt, two biases": Case(change=two_biases, known=False, doubt=True),
    "under doubt, one unit replays": Case(change=replaying, known=False, doubt=True),
}


def measure(asked: Asked) -> Iterator[Row]:
    """Every case and mounting."""
    settings = {**IDEAL, "noise.bias_walk": (WALK,)}
    for label, pipeline, name in labelled(asked, settings, CASES):
        case, parts = CASES[name], []
        for k in range(asked.count(4)):
            rng = asked.rng("nees", label, k)
            flight = Flight.of(
                pipeline, rng, case.length, Sines.drawn(case.amplitude, rng)
            )
            added = rng.standard_normal(flight.shape)
            added += walks(rng, flight.shape, case.walk) if case.walk else 0.0
            std = case.change(flight, rng, added)
            output = fresh(pipeline, flight.block(added))
            after, doubt = (
                flight.seconds >= ONSET + SETTLED,
                is_state(output, ChannelState.AMBIGUOUS).any(axis=1),
            )
            rows = after & doubt if case.doubt else after
            error, cov = (output.rate - flight.truth)[rows], output.covariance[rows]
            given = np.isfinite(error).all(axis=1)
            error, cov = error[given], cov[given]
            H = flight.geometry.axes
            best = (
                NOISE**2 * np.trace(np.linalg.inv(H.T @ (H / std[:, None] ** 2)))
                if case.known
                else np.nan
            )
            sigmas = np.abs(error) / np.sqrt(np.einsum("kii->ki", cov))
            parts.append(
                {
                    "nees": np.einsum(
                        "ki,ki->k",
                        error,
                        np.linalg.solve(cov, error[..., None])[..., 0],
                    )
                    / 3,
                    "over_best": (error**2).sum(axis=1, keepdims=True).mean(axis=0)
                    / best,
                    "beyond_5": (sigmas > 5).any(axis=1),
                    "doubt": doubt[after],
                    "no_rate": ~output.valid[after],
                }
            )
        yield label, figures(parts)


def figures(parts: list[dict[str, Array]]) -> dict[str, Any]:
    """Means over all samples of all flights, or medians of the flights."""
    every = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    means: dict[str, Any] = {
        name: float(values.mean()) if len(values) else None
        for name, values in every.items()
    }
    each = [float(part["nees"].mean()) for part in parts if len(part["nees"])]
    middle = {"nees_median": float(np.median(each)) if each else None}
    return {
        **means,
        **middle,
        "over_best": float(np.sqrt(np.median(every["over_best"]))),
    }


# Protection level -----------------------------------------------------------------------------------------------------


PRIOR = 1e-3
SETTINGS = {**IDEAL, "integrity.risk": 1e-5, "integrity.exposure": 1.0}
POINT = 0.99
SIZES = (2.0, 4.0, 6.0, 8.0, 10.0)  # sigma; the fourth alone after an hour
AGES = np.array([0, 1, 2, 4, 9, 19, 49, 99, 199])  # samples since the fault began
READY, WATCHED, HOUR = 15.0, 2.5, 3600.0  # s
LEVEL_FIGURES = {
    **dict.fromkeys(("worst", "level_over"), ".2f"),
    "sigma": ".0f",
    "age": "d",
    "no_level": ".1%",
}
MOTIONS = {
    "at rest": (0.0, READY),
    "in motion": (0.5, READY),
    "an hour at rest": (0.0, HOUR),
}
"""Amplitude, rad/s, and when the fault begins, s."""


def measure_level(asked: Asked) -> Iterator[Row]:
    """Faults at rest, in motion, and after an hour at rest (a fifth of the trials)."""
    for mounting, config in asked.configs(SETTINGS).items():
        rate = {"integrity.fault_rate": (PRIOR / (3 * len(config.topics)),)}
        pipeline = Pipeline.from_config(config.replaced(rate))
        for motion, (amplitude, begin) in MOTIONS.items():
            if not asked.wants(label := f"{mounting}, {motion}"):
                continue
            trials = asked.count(100) if begin < HOUR else max(asked.count(100) // 5, 1)
            worst, without = (0.0, 0.0, 0), []
            for size in SIZES if begin < HOUR else SIZES[3:4]:
                ratios = []
                for k in range(trials):
                    rng = asked.rng("level", label, size, k)
                    flight = Flight.of(
                        pipeline, rng, begin + WATCHED, Sines.drawn(amplitude, rng)
                    )
                    added, onset = (
                        rng.standard_normal(flight.shape),
                        round(begin * RATE),
                    )
                    added[onset:, int(rng.integers(flight.shape[1]))] += (
                        rng.choice([-1, 1]) * size
                    )
                    output = fresh(pipeline, flight.block(added))
                    # No rate, or no level, claims nothing.
                    ratio = np.nan_to_num(
                        np.abs(output.rate - flight.truth) / output.level
                    )
                    ratios.append(ratio[onset + AGES])
                    without.append(
                        float((~np.isfinite(output.level[onset:, 0])).mean())
                    )
                points = np.quantile(ratios, POINT, axis=0, method="higher").max(axis=1)
                worst = max(
                    worst, (float(points.max()), size, int(AGES[points.argmax()]))
                )
            figures = dict(zip(("worst", "sigma", "age"), worst, strict=True))
            level_over = 1 / worst[0] if worst[0] else None
            yield (
                label,
                {
                    **figures,
                    "level_over": level_over,
                    "no_level": float(np.mean(without)),
                },
            )
