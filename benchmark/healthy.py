# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Healthy gyros, and what is declared of them.

false: declarations in noise of many kinds, where 10 an hour are asked for. Flights of ten minutes as a small vehicle
flies, axes and clocks as the config says, noise as strong as it says. A flight ends with its first declaration: every
one is a fresh start. over asked: realised over asked, by the time flown.

conditions: flights with a false declaration in what is no fault, through the whole monitor. Each flight rests for 6 s
and then rests, turns and manoeuvres as a small vehicle does; axes, scale factors, biases and sampling instants are
those of small MEMS units (`GyroErrors`), within what the config allows for, except in "ideal". lost: flights with a
healthy channel FAULTY; in a set: flights with channels AMBIGUOUS; suspect, unjudged: share of time after the first 10 s
with a channel SUSPECT, UNCHECKED; no rate: without a fused rate. --trials: flights of ten minutes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, lfilter
from trials import (
    IDEAL,
    NO_ERRORS,
    NOISE,
    RATE,
    REST,
    Array,
    Asked,
    Flight,
    Noise,
    Rng,
    Row,
    faulty,
    fresh,
    in_set,
    labelled,
    suspect,
    unchecked,
    walks,
    white,
)

from fdi_ros import Pipeline
from fdi_ros.experiments.simulate import GyroErrors

FALSE_FIGURES = {"events": "d", "hours": ".2f", "an_hour": ".2f", "over_asked": ".3f", "error": ".3f"}
ASKED = 10.0
"""An hour."""
LENGTH = 600.0
"""Of a flight, s."""


def student(freedom: float) -> Noise:
    """Student's t, of unit variance."""
    return lambda rng, rows, n: rng.standard_t(freedom, (rows, n)) / np.sqrt(freedom / (freedom - 2))


def laplace(rng: Rng, rows: int, n: int) -> Array:
    """Two-sided exponential."""
    return rng.laplace(size=(rows, n)) / np.sqrt(2)


def autoregressive(phi: float) -> Noise:
    """Of first order."""

    def noise(rng: Rng, rows: int, n: int) -> Array:
        steps = rng.standard_normal((rows, n))
        steps[0] /= np.sqrt(1 - phi**2)
        return np.asarray(lfilter([np.sqrt(1 - phi**2)], [1.0, -phi], steps, axis=0))

    return noise


def volatile(of_each: bool) -> Noise:
    """White noise whose strength changes within half a second, by a factor of 1.6, of each channel or of all alike."""

    def noise(rng: Rng, rows: int, n: int) -> Array:
        level = autoregressive(np.exp(-1 / (0.5 * RATE)))(rng, rows, n if of_each else 1)
        return np.asarray(rng.standard_normal((rows, n)) * np.exp(0.5 * level - 0.25))

    return noise


def bursts(rng: Rng, rows: int, n: int) -> Array:
    """White noise, and on one unit narrow-band noise of 3 sigma that comes within 0.2 s and goes, 20 % of the time."""
    noise = rng.standard_normal((rows, n))
    unit = 3 * int(rng.integers(n // 3))
    for begin in np.flatnonzero(rng.random(rows) < 1 / (5 * RATE)).tolist():
        length = min(int(RATE * rng.uniform(0.4, 2.0)), rows - begin)
        radius, turn = np.exp(-np.pi * 2.0 / RATE), 2 * np.pi * rng.uniform(10, 45) / RATE
        tone = lfilter([1.0], [1.0, -2 * radius * np.cos(turn), radius**2], rng.standard_normal((length + 50, 3)), 0)
        edge = np.minimum(np.arange(length), np.arange(length)[::-1]) / (0.2 * RATE)
        noise[begin : begin + length, unit : unit + 3] += 3.0 * tone[50:] / tone.std() * np.minimum(edge, 1)[:, None]
    return noise


NOISES: dict[str, Noise] = {
    "white": white,
    "t3": student(3),
    "t4": student(4),
    "Laplace": laplace,
    "AR 0.8": autoregressive(0.8),
    "AR 0.95": autoregressive(0.95),
    "volatile, each channel": volatile(True),
    "volatile, all alike": volatile(False),
    "local vibration": bursts,
}


def measure_false(asked: Asked) -> Iterator[Row]:
    """Count the declarations in so many hours of each noise."""
    for label, pipeline, name in labelled(asked, {**IDEAL, "detector.false_alarms_per_hour": ASKED}, NOISES):
        events, flown = 0, 0.0
        for k in range(round(asked.count(3) * 3600 / LENGTH)):
            rng = asked.rng("false", label, k)
            flight = Flight.of(pipeline, rng, LENGTH, None)
            block = flight.block(NOISES[name](rng, *flight.shape))
            pipeline.restart()
            for output in pipeline.steps(block):
                flown += len(output) / RATE / 3600
                if any(event.declares for event in output.events):
                    events += 1
                    break
        hourly, one = events / flown, pipeline.config.detector.false_alarms_per_hour * flown
        over = {"over_asked": events / one, "error": max(events, 1) ** 0.5 / one}
        yield label, {"events": events, "hours": flown, "an_hour": hourly, **over}


# Conditions -----------------------------------------------------------------------------------------------------------


MEMS = GyroErrors()
SETTLED = 10.0
"""From here on shares of time are counted, s."""
WARMING = 1200.0
"""Time over which a temperature drift is stated, s."""
CONDITION_FIGURES = {
    "flights": "d",
    "lost": "d",
    "in_a_set": "d",
    **dict.fromkeys(("suspect", "unjudged", "no_rate"), ".3%"),
}

Extra = Callable[[Rng, Array, int], Array]
"""What comes on top of the noise, (rows, n) rad/s, at times (rows,) s."""


def low_pass(cutoff: float, sample_rate: float) -> Noise:
    b, a = butter(2, cutoff, fs=sample_rate)
    gain = np.sqrt(np.sum(lfilter(b, a, np.eye(1, 4096)[0]) ** 2))
    return lambda rng, rows, n: np.asarray(lfilter(b, a, white(rng, rows + 500, n), axis=0)[500:] / gain)


def walking(walk: float) -> Extra:
    return lambda rng, seconds, n: NOISE * walks(rng, (len(seconds), n), walk)


def warming(drift: float) -> Extra:
    def extra(rng: Rng, seconds: Array, n: int) -> Array:
        return drift * rng.choice([-1, 1], n) * rng.uniform(0.5, 1, n) * (seconds / WARMING)[:, None]

    return extra


def spikes(size: float) -> Extra:
    """One per second on one channel or another, in sigma."""

    def extra(rng: Rng, seconds: Array, n: int) -> Array:
        added, struck = np.zeros((len(seconds), n)), np.flatnonzero(rng.random(len(seconds)) < seconds[1])
        added[struck, rng.integers(n, size=len(struck))] = NOISE * size * rng.choice([-1, 1], len(struck))
        return added

    return extra


def local_vibration(size: float) -> Extra:
    """Noise about a frequency of each channel's own, 10 to 45 Hz, that comes for seconds and goes."""

    def extra(rng: Rng, seconds: Array, n: int) -> Array:
        rate, noise = 1 / seconds[1], np.empty((len(seconds), n))
        for i in range(n):
            radius, turn = np.exp(-np.pi * 2.0 / rate), 2 * np.pi * rng.uniform(10, 45) / rate
            tone = lfilter([1.0], [1.0, -2 * radius * np.cos(turn), radius**2], rng.standard_normal(len(seconds)))
            # On for about a third of the time, up and down within half a second.
            gate = np.repeat(rng.random(len(seconds) // round(5 * rate) + 1) < 0.35, round(5 * rate))[: len(seconds)]
            width = round(rate / 2)
            noise[:, i] = tone / tone.std() * lfilter(np.ones(width) / width, [1.0], gate.astype(float))
        return noise * size * np.clip(seconds - REST, 0, 1)[:, None]

    return extra


@dataclass(frozen=True)
class Condition:
    """What healthy channels are up against."""

    noise: Noise = white
    level: float = 1.0
    """Of the noise, in sigma."""
    extra: Extra | None = None
    step: float = 0.0
    """Of the converter, in sigma."""
    errors: GyroErrors = MEMS
    sample_rate: float | None = None
    """Hz; None: as configured."""
    minutes: float = 10.0


CONDITIONS = {
    "ideal, white": Condition(errors=NO_ERRORS),
    "white": Condition(),
    "AR(1) 0.5": Condition(autoregressive(0.5)),
    "AR(1) 0.9": Condition(autoregressive(0.9)),
    "40 Hz low-pass at 1 kHz": Condition(low_pass(40.0, 1000.0), sample_rate=1000.0),
    **{f"bias walk {walk:g}": Condition(extra=walking(walk)) for walk in (2e-5, 1e-4)},
    **{f"temperature {drift:g}": Condition(extra=warming(drift), minutes=20.0) for drift in (0.01, 0.02, 0.05)},
    **{f"local vibration {size:g}": Condition(extra=local_vibration(size)) for size in (0.01, 0.03, 0.1)},
    **{f"noise x{level:g}": Condition(level=level) for level in (0.5, 1.5, 2.0, 2.5, 3.0)},
    "Student t4": Condition(student(4)),
    "spikes of 30 sigma": Condition(extra=spikes(30.0)),
    **{f"steps of {step:g} sigma": Condition(step=step) for step in (1.0, 4.0)},
}


def fly(pipeline: Pipeline, rng: Rng, condition: Condition) -> dict[str, float]:
    """Fly once; return what came of it."""
    flight = Flight.of(pipeline, rng, 60 * condition.minutes, None, condition.errors)
    block = flight.block(condition.level * condition.noise(rng, *flight.shape))
    if condition.extra:
        block.z[:] += condition.extra(rng, flight.seconds, flight.shape[1])
    if condition.step:
        block.z[:] = np.round(block.z / (condition.step * NOISE)) * (condition.step * NOISE)
    output, after = fresh(pipeline, block), flight.seconds >= SETTLED
    return {
        "lost": float(faulty(output).any()),
        "in_a_set": float(in_set(output).any()),
        "suspect": float(suspect(output)[after].any(axis=1).mean()),
        "unjudged": float(unchecked(output)[after].any(axis=1).mean()),
        "no_rate": float((~output.valid[after]).mean()),
    }


def measure_conditions(asked: Asked) -> Iterator[Row]:
    """Every condition and mounting."""
    for mounting, config in asked.configs().items():
        for name, condition in CONDITIONS.items():
            if not asked.wants(label := f"{mounting} {name}"):
                continue
            rate = condition.sample_rate or config.sample_rate
            pipeline = Pipeline.from_config(config.replaced({"sample_rate": rate}))
            flights = max(round(asked.count(4) * 10 / condition.minutes), 1)
            outcomes = [fly(pipeline, asked.rng(label, k), condition) for k in range(flights)]
            means = {word: float(np.mean([o[word] for o in outcomes])) for word in outcomes[0]}
            counts = {word: round(means[word] * flights) for word in ("lost", "in_a_set")}
            yield label, {"flights": flights, **means, **counts}
