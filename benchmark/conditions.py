# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Sound gyros in what is no fault: flights with a false declaration, by condition, through the whole monitor.

Each flight rests for 6 s and then rests, turns and manoeuvres as a small vehicle does; axes, scale factors, biases and
sampling instants are those of small MEMS units (`GyroErrors`), within what the config allows for, except in "ideal".
Two mountings: the two-triad cone of config/two_imus.yaml and three parallel units with the same settings.

    python benchmark/conditions.py [--detector NAME] [--hours 10] [--only vibration] [--quick] [--json FILE]

lost: flights with a sound channel FAULTY; in a set: flights with channels AMBIGUOUS; suspect, unjudged: share of time
after the first 10 s with a channel SUSPECT, UNCHECKED; no rate: without a fused rate.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.signal import butter, lfilter
from trials import (
    Array,
    Moving,
    Rng,
    Table,
    Unit,
    arguments_of,
    configs_of,
    faulty,
    in_set,
    made,
    repeated,
    seconds_of,
    simulated,
    size_of,
    suspect,
    unchecked,
)

from fdi_ros import Pipeline
from fdi_ros.experiments.simulate import Motion, vehicle_motion

REST = 6.0
"""At the start of a flight, s: no vibration, no local noise."""
SETTLED = 10.0
"""From here on shares of time are counted, s."""
BETWEEN = 0.5e-3
"""Time between the sampling instants of two units under vibration, s."""
WARMING = 1200.0
"""Time over which a temperature drift is stated, s."""

Noise = Callable[[Rng, int, int], Array]
"""Noise of unit variance, (rows, n)."""


def white(rng: Rng, rows: int, n: int) -> Array:
    return rng.standard_normal((rows, n))


def autoregressive(phi: float) -> Noise:
    def noise(rng: Rng, rows: int, n: int) -> Array:
        steps = rng.standard_normal((rows, n))
        steps[0] /= np.sqrt(1 - phi**2)
        return np.asarray(lfilter([np.sqrt(1 - phi**2)], [1.0, -phi], steps, axis=0))

    return noise


def low_pass(cutoff: float, sample_rate: float) -> Noise:
    b, a = butter(2, cutoff, fs=sample_rate)
    gain = np.sqrt(np.sum(lfilter(b, a, np.eye(1, 4096)[0]) ** 2))

    def noise(rng: Rng, rows: int, n: int) -> Array:
        return np.asarray(lfilter(b, a, rng.standard_normal((rows + 500, n)), axis=0)[500:] / gain)

    return noise


def student(rng: Rng, rows: int, n: int) -> Array:
    return rng.standard_t(4, (rows, n)) / np.sqrt(2.0)


@dataclass(frozen=True)
class Condition:
    """What sound channels are up against."""

    name: str
    noise: Noise = white
    level: float = 1.0
    """Of the noise, in noise_std."""
    walk: float = 0.0
    """Of each bias, rad/s per square root of a second."""
    drift: float = 0.0
    """Of each bias at most, rad/s in 20 min."""
    vibration: float = 0.0
    """Amplitude of a rotation common to all channels, rad/s."""
    frequency: float = 0.0
    """Hz."""
    local: float = 0.0
    """Standard deviation of a narrow-band noise of each channel while it is there, rad/s."""
    spikes: float = 0.0
    """Size of spikes, one per second on one channel or another, in noise_std."""
    step: float = 0.0
    """Of the converter, in noise_std."""
    ideal: bool = False
    sample_rate: float | None = None
    """Hz; None: as configured."""
    minutes: float = 10.0


CONDITIONS = (
    Condition("ideal, white", ideal=True),
    Condition("white"),
    Condition("AR(1) 0.5", autoregressive(0.5)),
    Condition("AR(1) 0.9", autoregressive(0.9)),
    Condition("40 Hz low-pass at 1 kHz", low_pass(40.0, 1000.0), sample_rate=1000.0),
    *(Condition(f"bias walk {walk:g}", walk=walk) for walk in (2e-5, 1e-4)),
    *(Condition(f"temperature {drift:g}", drift=drift, minutes=20.0) for drift in (0.01, 0.02, 0.05)),
    *(
        Condition(f"vibration {size:g} at {frequency:g} Hz", vibration=size, frequency=frequency)
        for size in (0.05, 0.2, 0.5)
        for frequency in (10.0, 20.0, 30.0, 45.0)
    ),
    *(Condition(f"local vibration {size:g}", local=size) for size in (0.01, 0.03, 0.1)),
    *(Condition(f"noise x{level:g}", level=level) for level in (0.5, 1.5, 2.0, 2.5, 3.0)),
    Condition("Student t4", student),
    Condition("spikes of 30 sigma", spikes=30.0),
    *(Condition(f"steps of {step:g} sigma", step=step) for step in (1.0, 4.0)),
)


@dataclass(frozen=True)
class Shaken:
    """A motion with a vibration on top; its frequency wanders by 5 %, its strength by a third."""

    motion: Motion
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


def shaken(motion: Motion, condition: Condition, rng: Rng) -> Moving:
    if not condition.vibration:
        return motion
    axis = rng.standard_normal(3)
    axis *= condition.vibration / np.linalg.norm(axis)
    return Shaken(motion, axis, condition.frequency, rng.uniform(0, 2 * np.pi, 3))


def local_vibration(rng: Rng, seconds: Array, n: int, size: float) -> Array:
    """Noise about a frequency of each channel's own, 10 to 45 Hz, that comes for seconds and goes, (rows, n) rad/s."""
    rate = 1 / (seconds[1] - seconds[0])
    noise = np.empty((len(seconds), n))
    for i in range(n):
        radius, turn = np.exp(-np.pi * 2.0 / rate), 2 * np.pi * rng.uniform(10, 45) / rate
        tone = lfilter([1.0], [1.0, -2 * radius * np.cos(turn), radius**2], rng.standard_normal(len(seconds)))
        # On for about a third of the time, up and down within half a second.
        gate = np.repeat(rng.random(len(seconds) // round(5 * rate) + 1) < 0.35, round(5 * rate))[: len(seconds)]
        width = round(rate / 2)
        noise[:, i] = tone / tone.std() * lfilter(np.ones(width) / width, [1.0], gate.astype(float))
    return noise * size * np.clip(seconds - REST, 0, 1)[:, None]


def disturbances(condition: Condition, unit: Unit, rng: Rng, seconds: Array) -> Array:
    """All that comes on top of white noise, (rows, n) rad/s."""
    rows, n = len(seconds), unit.geometry.n
    extra = np.zeros((rows, n))
    if condition.walk:
        extra += np.cumsum(condition.walk * np.sqrt(seconds[1]) * rng.standard_normal((rows, n)), axis=0)
    if condition.drift:
        extra += condition.drift * rng.choice([-1, 1], n) * rng.uniform(0.5, 1, n) * (seconds / WARMING)[:, None]
    if condition.local:
        extra += local_vibration(rng, seconds, n, condition.local)
    if condition.spikes:
        struck = np.flatnonzero(rng.random(rows) < seconds[1])
        channel = rng.integers(n, size=len(struck))
        extra[struck, channel] += condition.spikes * rng.choice([-1, 1], len(struck)) * unit.noise_std[channel]
    return extra


def fly(pipeline: Pipeline, rng: Rng, condition: Condition) -> dict[str, float]:
    """Fly once; return what came of it."""
    unit = made(pipeline, rng, condition.ideal)
    motion = vehicle_motion(60 * condition.minutes, rng, rest=REST)
    stamp = unit.stamps(60 * condition.minutes)
    seconds, units = seconds_of(stamp), unit.geometry.n // 3
    late = np.linspace(-0.5, 0.5, units) * BETWEEN * (units - 1) if condition.vibration else 0.0
    noise = condition.level * condition.noise(rng, len(stamp), unit.geometry.n)
    noise += disturbances(condition, unit, rng, seconds) / unit.noise_std
    block = simulated(unit, stamp, unit.rates(shaken(motion, condition, rng), seconds, late), noise)
    if condition.step:
        step = condition.step * unit.noise_std
        np.multiply(np.round(block.z / step), step, out=block.z)
    output = pipeline.process(block)
    after = seconds >= SETTLED
    return {
        "lost": float(faulty(output).any()),
        "in_a_set": float(in_set(output).any()),
        "suspect": float(suspect(output)[after].any(axis=1).mean()),
        "unjudged": float(unchecked(output)[after].any(axis=1).mean()),
        "no_rate": float((~output.valid[after]).mean()),
    }


def main() -> None:
    about: dict[str, dict[str, Any]] = {
        "hours": {"type": float, "default": 10.0, "help": "of each condition and mounting; 1 with --quick"},
        "only": {"default": "", "help": "conditions with this in their name"},
    }
    arguments = arguments_of(__doc__, **about)
    hours = size_of(arguments, "hours", 1.0)
    shares = dict.fromkeys(("suspect", "unjudged", "no_rate"), ">9.3%")
    table = Table(mounting="<9", condition="<26", flights=">7d", lost=">5d", in_a_set=">8d", **shares, took_s=">7.1f")
    for mounting, config in configs_of(arguments).items():
        for condition in CONDITIONS:
            if arguments.only not in condition.name:
                continue
            rate = condition.sample_rate or config.sample_rate
            pipeline = Pipeline.from_config(config.replaced({"sample_rate": rate}))
            flights, name = max(round(60 * hours / condition.minutes), 1), condition.name
            outcomes, took = repeated(pipeline, flights, fly, condition, arguments.seed, mounting, name)
            counted = {name: round(sum(o[name] for o in outcomes)) for name in ("lost", "in_a_set")}
            mean = {name: float(np.mean([o[name] for o in outcomes])) for name in shares}
            table.add(mounting=mounting, condition=condition.name, flights=flights, **counted, **mean, took_s=took)
    table.write(arguments)


if __name__ == "__main__":
    main()
