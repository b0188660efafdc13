# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Healthy gyros in what is no fault: flights with a false declaration, by condition, through the whole monitor.

Each flight rests for 6 s and then rests, turns and manoeuvres as a small vehicle does; axes, scale factors, biases and
sampling instants are those of small MEMS units (`GyroErrors`), within what the config allows for, except in "ideal".

lost: flights with a healthy channel FAULTY; in a set: flights with channels AMBIGUOUS; suspect, unjudged: share of time
after the first 10 s with a channel SUSPECT, UNCHECKED; no rate: without a fused rate. --trials: flights of ten minutes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from false_alarms import autoregressive, student
from scipy.signal import butter, lfilter
from trials import (
    NO_ERRORS,
    NOISE,
    REST,
    Array,
    Asked,
    Flight,
    Moving,
    Noise,
    Rng,
    Row,
    faulty,
    fresh,
    in_set,
    suspect,
    unchecked,
    walks,
    white,
)

from fdi_ros import Pipeline
from fdi_ros.experiments.simulate import GyroErrors

MEMS = GyroErrors()
SETTLED = 10.0
"""From here on shares of time are counted, s."""
BETWEEN = 0.5e-3
"""Time between the sampling instants of two units under vibration, s."""
WARMING = 1200.0
"""Time over which a temperature drift is stated, s."""
FIGURES = {"flights": "d", "lost": "d", "in_a_set": "d", **dict.fromkeys(("suspect", "unjudged", "no_rate"), ".3%")}

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
    vibration: tuple[float, float] = (0.0, 0.0)
    """Amplitude of a rotation common to all channels, rad/s, and frequency, Hz."""
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
    **{
        f"vibration {size:g} at {frequency:g} Hz": Condition(vibration=(size, frequency))
        for size in (0.05, 0.2, 0.5)
        for frequency in (10.0, 20.0, 30.0, 45.0)
    },
    **{f"local vibration {size:g}": Condition(extra=local_vibration(size)) for size in (0.01, 0.03, 0.1)},
    **{f"noise x{level:g}": Condition(level=level) for level in (0.5, 1.5, 2.0, 2.5, 3.0)},
    "Student t4": Condition(student(4)),
    "spikes of 30 sigma": Condition(extra=spikes(30.0)),
    **{f"steps of {step:g} sigma": Condition(step=step) for step in (1.0, 4.0)},
}


@dataclass(frozen=True)
class Shaken:
    """A motion with a vibration on top; its frequency wanders by 5 %, its strength by a third."""

    motion: Moving
    axis: Array
    """(3,) amplitude, rad/s."""
    frequency: float
    phase: Array
    """(3,) of the vibration, its frequency and its strength."""

    def rate_at(self, t: Array) -> Array:
        """Body rate (N, 3) rad/s at times t (N,) s."""
        turn = 2 * np.pi * self.frequency * t + self.phase[0]
        # A swing of the phase by 5 % of the frequency over 20 s.
        turn += 0.05 * self.frequency * 20.0 * np.sin(2 * np.pi * t / 20.0 + self.phase[1])
        strength = np.clip(t - REST, 0, 1) * (1 + 0.33 * np.sin(2 * np.pi * t / 7.0 + self.phase[2])) / 1.33
        return self.motion.rate_at(t) + (strength * np.sin(turn))[:, None] * self.axis


def shaken(flight: Flight, rng: Rng, amplitude: float, frequency: float) -> Flight:
    """Add a vibration, of units that are sampled one after the other."""
    axis, units = rng.standard_normal(3), flight.shape[1] // 3
    motion = Shaken(flight.motion, axis * amplitude / np.linalg.norm(axis), frequency, rng.uniform(0, 2 * np.pi, 3))
    return replace(flight, motion=motion, late=np.linspace(-0.5, 0.5, units) * BETWEEN * (units - 1))


def fly(pipeline: Pipeline, rng: Rng, condition: Condition) -> dict[str, float]:
    """Fly once; return what came of it."""
    flight = Flight.of(pipeline, rng, 60 * condition.minutes, None, condition.errors)
    flight = shaken(flight, rng, *condition.vibration) if condition.vibration[0] else flight
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


def measure(asked: Asked) -> Iterator[Row]:
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
