# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Healthy gyros, and what is declared of them.

false: declarations in noise of many kinds, where 10 an hour are asked for. Flights of ten minutes as a small vehicle
flies, axes and clocks as the config says, noise as strong as it says. A flight ends with its first declaration: every
one is a fresh start. over asked: realised over asked, by the time flown.

conditions: flights with a false declaration in what is no fault, through the whole monitor. Each flight rests for 6 s
and then rests, turns and manoeuvres as a small vehicle does; axes, scale factors, biases and sampling instants are
those of small MEMS units (`GyroErrors`), within what the config allows for. lost: flights with a healthy channel
FAULTY; in a set: with channels AMBIGUOUS; suspect, unjudged: share of time after the first 10 s with a channel SUSPECT,
UNCHECKED; no rate: without a fused rate. --trials: flights of ten minutes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter
from trials import (
    IDEAL,
    NOISE,
    RATE,
    Array,
    Asked,
    Flight,
    Noise,
    Rng,
    Row,
    faulty,
    fresh,
    is_state,
    labelled,
    walks,
    white,
)

from fdi_ros import Pipeline
from fdi_ros.experiments.flight import GyroErrors
from fdi_ros.monitor.output import ChannelState

FALSE_FIGURES = {
    "events": "d",
    "hours": ".2f",
    "an_hour": ".2f",
    "over_asked": ".3f",
    "error": ".3f",
}
ASKED = 10.0  # an hour
LENGTH = 600.0  # of a flight, s


def student(freedom: float) -> Noise:
    """Student's t, of unit variance."""
    return lambda rng, rows, n: (
        rng.standard_t(freedom, (rows, n)) / np.sqrt(freedom / (freedom - 2))
    )


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
        level = autoregressive(np.exp(-1 / (0.5 * RATE)))(
            rng, rows, n if of_each else 1
        )
        return np.asarray(rng.standard_normal((rows, n)) * np.exp(0.5 * level - 0.25))

    return noise


def bursts(rng: Rng, rows: int, n: int) -> Array:
    """White noise, and on one unit narrow-band noise of 3 sigma that comes within 0.2 s and goes, 20 % of the time."""
    noise = rng.standard_normal((rows, n))
    unit = 3 * int(rng.integers(n // 3))
    for begin in np.flatnonzero(rng.random(rows) < 1 / (5 * RATE)).tolist():
        length = min(int(RATE * rng.uniform(0.4, 2.0)), rows - begin)
        radius, turn = (
            np.exp(-np.pi * 2.0 / RATE),
            2 * np.pi * rng.uniform(10, 45) / RATE,
        )
        tone = lfilter(
            [1.0],
            [1.0, -2 * radius * np.cos(turn), radius**2],
            rng.standard_normal((length + 50, 3)),
            0,
        )
        edge = np.minimum(np.arange(length), np.arange(length)[::-1]) / (0.2 * RATE)
        noise[begin : begin + length, unit : unit + 3] += (
            3.0 * tone[50:] / tone.std() * np.minimum(edge, 1)[:, None]
        )
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
    for label, pipeline, name in labelled(
        asked, {**IDEAL, "detector.false_alarms_per_hour": ASKED}, NOISES
    ):
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
        hourly, one = (
            events / flown,
            pipeline.config.detector.false_alarms_per_hour * flown,
        )
        over = {"over_asked": events / one, "error": max(events, 1) ** 0.5 / one}
        yield label, {"events": events, "hours": flown, "an_hour": hourly, **over}


# Conditions -----------------------------------------------------------------------------------------------------------


SETTLED = 10.0  # from here on shares of time are counted, s
WARMING = 1200.0  # time over which a temperature drift is stated, s
CONDITION_FIGURES = {
    "flights": "d",
    "lost": "d",
    "in_a_set": "d",
    **dict.fromkeys(("suspect", "unjudged", "no_rate"), ".3%"),
}

Extra = Callable[
    [Rng, Array, int], Array
]  # what comes on top of the noise, (rows, n) rad/s, at times (rows,) s


def walking(walk: float) -> Extra:
    return lambda rng, seconds, n: NOISE * walks(rng, (len(seconds), n), walk)


def warming(drift: float) -> Extra:
    def extra(rng: Rng, seconds: Array, n: int) -> Array:
        return (
            drift
            * rng.choice([-1, 1], n)
            * rng.uniform(0.5, 1, n)
            * (seconds / WARMING)[:, None]
        )

    return extra


def spikes(size: float) -> Extra:
    """One per second on one channel or another, in sigma."""

    def extra(rng: Rng, seconds: Array, n: int) -> Array:
        added, struck = (
            np.zeros((len(seconds), n)),
            np.flatnonzero(rng.random(len(seconds)) < seconds[1]),
        )
        added[struck, rng.integers(n, size=len(struck))] = (
            NOISE * size * rng.choice([-1, 1], len(struck))
        )
        return added

    return extra


@dataclass(frozen=True)
class Condition:
    """What healthy channels are up against."""

    noise: Noise = white
    level: float = 1.0  # of the noise, in sigma
    extra: Extra | None = None
    step: float = 0.0  # of the converter, in sigma
    minutes: float = 10.0


CONDITIONS = {
    "white": Condition(),
    "AR(1) 0.5": Condition(autoregressive(0.5)),
    **{f"bias walk {walk:g}": Condition(extra=walking(walk)) for walk in (2e-5, 1e-4)},
    **{
        f"temperature {drift:g}": Condition(extra=warming(drift), minutes=20.0)
        for drift in (0.01, 0.02, 0.05)
    },
    **{
        f"noise x{level:g}": Condition(level=level)
        for level in (0.5, 1.5, 2.0, 2.5, 3.0)
    },
    "Student t4": Condition(student(4)),
    "spikes of 30 sigma": Condition(extra=spikes(30.0)),
    **{f"steps of {step:g} sigma": Condition(step=step) for step in (1.0, 4.0)},
}


def fly(pipeline: Pipeline, rng: Rng, condition: Condition) -> dict[str, float]:
    """Fly once; return what came of it."""
    flight = Flight.of(pipeline, rng, 60 * condition.minutes, None, GyroErrors())
    block = flight.block(condition.level * condition.noise(rng, *flight.shape))
    if condition.extra:
        block.z[:] += condition.extra(rng, flight.seconds, flight.shape[1])
    if condition.step:
        block.z[:] = np.round(block.z / (condition.step * NOISE)) * (
            condition.step * NOISE
        )
    output, after = fresh(pipeline, block), flight.seconds >= SETTLED
    return {
        "lost": float(faulty(output).any()),
        "in_a_set": float(is_state(output, ChannelState.AMBIGUOUS).any()),
        "suspect": float(
            is_state(output, ChannelState.SUSPECT)[after].any(axis=1).mean()
        ),
        "unjudged": float(
            is_state(output, ChannelState.UNCHECKED)[after].any(axis=1).mean()
        ),
        "no_rate": float((~output.valid[after]).mean()),
    }


def measure_conditions(asked: Asked) -> Iterator[Row]:
    """Every condition and mounting."""
    for label, pipeline, name in labelled(asked, None, CONDITIONS):
        flights = max(round(asked.count(4) * 10 / CONDITIONS[name].minutes), 1)
        outcomes = [
            fly(pipeline, asked.rng(label, k), CONDITIONS[name]) for k in range(flights)
        ]
        means = {
            word: float(np.mean([o[word] for o in outcomes])) for word in outcomes[0]
        }
        counts = {word: round(means[word] * flights) for word in ("lost", "in_a_set")}
        yield label, {"flights": flights, **means, **counts}
