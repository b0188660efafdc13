# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Samples from a bias of one channel to its declaration, beside the information bound; and of the next one after it.

A bias of 0.5 to 8 sigma (standard deviations of the channel's noise) comes after a calm minute, and is watched for
another. It shifts the normalised residual of the channel by sqrt(S_ii) times as much: S_ii is 1/2 on the cone of six
channels and 2/3 on three parallel units. The bound is that of a CUSUM which knows channel and size (Moustakides 1986),
by Markov chain, at one false alarm in 3.6e8 samples: 0.001 an hour at 100 Hz.

declared: mean samples (median beside) to the first declaration of the channel or of a set that holds it; a fault that
is missed counts with the time watched; named: until it stands alone. `after`: the same fault so long after another
channel (20 sigma) was declared, beside the fault alone, with all channels and where the other was taken out from the
start (`excluded_channels`), which is the same problem.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from trials import FOUND, IDEAL, NO_ERRORS, RATE, Asked, Flight, Found, Row, Sines, faulty, found, fresh, summary

from fdi_ros import Pipeline
from fdi_ros.experiments.contenders import moustakides_delay
from fdi_ros.experiments.simulate import GyroErrors

FIGURES = {"bound": ".1f", "times_bound": ".2f", **FOUND}
AFTER_FIGURES = {"times_excluded": ".2f", **FOUND}
SIZES = (0.5, 1.0, 2.0, 4.0, 6.0, 8.0)
RUN_LENGTH = 3.6e8
"""Samples to a false alarm."""
CALM = WATCHED = 60.0
"""s."""
MOTIONS = {
    "at rest": (0.0, NO_ERRORS, IDEAL),
    "gentle motion": (0.05, NO_ERRORS, IDEAL),
    "motion 0.5 rad/s, scale errors": (0.5, GyroErrors(scale_std=0.002, misalignment_std=0.002, delay_std=0.0003), {}),
}
"""Amplitude, rad/s, errors of the gyros and settings: axes and clocks are known, or off by what is configured."""
FIRST = 20.0
"""Size of the fault before, sigma."""
GAPS = (0.5, 2.0, 5.0, 15.0)
"""s from its declaration."""


def measure(asked: Asked) -> Iterator[Row]:
    """One bias."""
    trials = asked.count(50)
    for motion, (amplitude, errors, settings) in MOTIONS.items():
        for mounting, pipeline in asked.monitors({**settings, "detector.false_alarms_per_hour": 0.001}).items():
            for size in SIZES:
                if not asked.wants(label := f"{mounting}, {motion}, {size:g} sigma"):
                    continue
                outcomes = []
                for k in range(trials):
                    rng = asked.rng("delay", label, k)
                    flight = Flight.of(pipeline, rng, CALM + WATCHED, Sines.drawn(amplitude, rng), errors)
                    added, onset = rng.standard_normal(flight.shape), round(CALM * RATE)
                    channel = int(rng.integers(flight.shape[1]))
                    added[onset:, channel] += rng.choice([-1, 1]) * size
                    outcomes.append(found(fresh(pipeline, flight.block(added)), channel, onset))
                bound = moustakides_delay(size * math.sqrt(pipeline.geometry.S[0, 0]), RUN_LENGTH)
                figures = summary(outcomes, WATCHED * RATE)
                times = figures["declared"] / bound if "declared" in figures else None
                yield label, {"bound": bound, "times_bound": times, **figures}


def measure_after(asked: Asked) -> Iterator[Row]:
    """Add the next bias, of another channel."""
    trials = asked.count(20)
    settings = {**IDEAL, "detector.false_alarms_per_hour": 0.001}
    for (mounting, config), size in ((c, s) for c in asked.configs(settings).items() for s in (2.0, 4.0)):
        if not asked.wants(f"{mounting}, {size:g} sigma"):
            continue
        pipeline = Pipeline.from_config(config)
        names = pipeline.channel_names
        without = [Pipeline.from_config(config.replaced({"excluded_channels": (name,)})) for name in names]
        outcomes: dict[str, list[Found]] = {}
        for k in range(trials):
            rng = asked.rng("after", mounting, size, k)
            flight = Flight.of(pipeline, rng, CALM + WATCHED, Sines.drawn(0.05, rng))
            noise, onset = rng.standard_normal(flight.shape), round(CALM * RATE)
            one, other = rng.choice(flight.shape[1], 2, replace=False).tolist()
            faults = rng.choice([-1, 1], 2) * (FIRST, size)
            second = noise.copy()
            second[onset:, other] += faults[1]
            block = flight.block(second)
            outcomes.setdefault("alone", []).append(found(fresh(pipeline, block), other, onset))
            outcomes.setdefault("other excluded", []).append(found(fresh(without[one], block), other, onset, (one,)))
            for gap in GAPS:
                both = noise.copy()
                # The fault before is declared at a sample that is not known beforehand.
                both[onset - round((gap + 20) * RATE) :, one] += faults[0]
                alone = faulty(fresh(pipeline, flight.block(both)))[:, one]
                begin = int(alone.argmax()) + round(gap * RATE)
                both[begin:, other] += faults[1]
                struck = found(fresh(pipeline, flight.block(both)), other, begin, (one,), int(alone.argmax()))
                outcomes.setdefault(f"{gap:g} s after", []).append(struck._replace(judged=bool(alone.any())))
        figures = {name: summary(those, WATCHED * RATE) for name, those in outcomes.items()}
        base = figures["other excluded"].get("declared")
        for name, those in figures.items():
            times = those["declared"] / base if base and "declared" in those else None
            yield f"{mounting}, {size:g} sigma, {name}", {"times_excluded": times, **those}
