# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""From the fault of one gyro to its declaration: slow drifts, steps, and the step after another fault.

drift: 0.6 rad/s about each axis, gyros of small MEMS units; it begins after a minute and is watched for 30 (healthy
ones that warm up are in `conditions`). declared, named: s since it began, median; off: largest error of the fused rate,
averaged over a second, over its published standard deviation while all channels are OK: median and largest.

delay: samples from a bias of 0.5 to 8 sigma to its declaration, beside the information bound. It comes after a calm
minute, and is watched for another. It shifts the normalised residual of the channel by sqrt(S_ii) times as much: S_ii
is 1/2 on the cone of six channels and 2/3 on three parallel units. The bound is that of a CUSUM which knows channel and
size (Moustakides 1986), by Markov chain, at one false alarm in 3.6e8 samples: 0.001 an hour at 100 Hz. declared: mean
samples (median beside) to the first declaration of the channel or of a set that holds it; a fault that is missed counts
with the time watched; named: until it stands alone.

next: the same so long after another channel (20 sigma) was declared, beside the fault alone, with all channels and
where the other was taken out from the start (`excluded_channels`), which is the same problem.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from trials import (
    FOUND,
    IDEAL,
    NO_ERRORS,
    NOISE,
    RATE,
    Array,
    Asked,
    Flight,
    Found,
    Row,
    Sines,
    faulty,
    found,
    fresh,
    labelled,
    summary,
)

from fdi_ros import Pipeline
from fdi_ros.experiments.contenders import moustakides_delay
from fdi_ros.experiments.flight import GyroErrors
from fdi_ros.monitor.output import ChannelState, Output

DRIFT_FIGURES = {
    **dict.fromkeys(("declared", "named"), ".1f"),
    **dict.fromkeys(("in_time", "in_name", "wrong"), ".0%"),
    **dict.fromkeys(("off", "most_off"), ".2f"),
    "flights_declared": "d",
    "flights": "d",
}
DRIFTS = (0.003, 0.005, 0.01, 0.02, 0.05)  # deg/s^2
ONSET, FLOWN = 60.0, 1800.0  # s


def off(output: Output, truth: Array) -> float:
    """Largest error over published sigma while all channels are OK, of means over a second."""
    error = (output.rate - truth) / np.sqrt(np.einsum("kii->ki", output.covariance))
    error[(output.state != ChannelState.OK).any(axis=1)] = np.nan
    width = round(RATE)
    means = error[: len(error) // width * width].reshape(-1, width, 3).mean(axis=1)
    return float(np.nanmax(np.abs(means), initial=0.0))


def measure_drifts(asked: Asked) -> Iterator[Row]:
    """Time to the name, and what the monitor says of its rate until then."""
    trials = asked.count(4)
    for label, pipeline, drift in labelled(asked, None, DRIFTS):
        outcomes, errors = [], []
        for k in range(trials):
            rng = asked.rng("drift", label, k)
            flight = Flight.of(
                pipeline, rng, ONSET + FLOWN, Sines.drawn(0.6, rng), GyroErrors()
            )
            added = rng.standard_normal(flight.shape)
            channel, sign = int(rng.integers(flight.shape[1])), rng.choice([-1, 1])
            added[:, channel] += (
                sign * np.radians(drift) / NOISE * np.maximum(flight.seconds - ONSET, 0)
            )
            output = fresh(pipeline, flight.block(added))
            outcomes.append(found(output, channel, round(ONSET * RATE)))
            errors.append(off(output, flight.truth))
        yield (
            f"{label} deg/s^2",
            {
                **_times(outcomes),
                "off": float(np.median(errors)),
                "most_off": max(errors),
            },
        )


def _times(outcomes: Any) -> dict[str, Any]:
    declared, named = (np.array([o[k] for o in outcomes]) / RATE for k in (0, 1))
    return {
        "declared": float(np.median(declared)),
        "named": float(np.median(named)),
        "in_time": float(np.isfinite(declared).mean()),
        "in_name": float(np.isfinite(named).mean()),
        "wrong": float(np.mean([o.wrong for o in outcomes])),
        "flights_declared": sum(o.early for o in outcomes),
        "flights": len(outcomes),
    }


# Steps ----------------------------------------------------------------------------------------------------------------


DELAY_FIGURES = {"bound": ".1f", "times_bound": ".2f", **FOUND}
NEXT_FIGURES = {"times_excluded": ".2f", **FOUND}
SIZES = (0.5, 1.0, 2.0, 4.0, 6.0, 8.0)
RUN_LENGTH = 3.6e8  # samples to a false alarm
CALM = WATCHED = 60.0  # s
MOTIONS = {
    "at rest": (0.0, NO_ERRORS, IDEAL),
    "gentle motion": (0.05, NO_ERRORS, IDEAL),
    "motion 0.5 rad/s, scale errors": (
        0.5,
        GyroErrors(scale_std=0.002, misalignment_std=0.002, delay_std=0.0003),
        {},
    ),
}
"""Amplitude, rad/s, errors of the gyros and settings: axes and clocks are known, or off by what is configured."""
FIRST = 20.0  # size of the fault before, sigma
GAPS = (0.5, 2.0, 5.0, 15.0)  # s from its declaration


def measure_delays(asked: Asked) -> Iterator[Row]:
    """One bias."""
    trials = asked.count(50)
    for motion, (amplitude, errors, settings) in MOTIONS.items():
        for mounting, pipeline in asked.monitors(
            {**settings, "detector.false_alarms_per_hour": 0.001}
        ).items():
            for size in SIZES:
                if not asked.wants(label := f"{mounting}, {motion}, {size:g} sigma"):
                    continue
                outcomes = []
                for k in range(trials):
                    rng = asked.rng("delay", label, k)
                    flight = Flight.of(
                        pipeline,
                        rng,
                        CALM + WATCHED,
                        Sines.drawn(amplitude, rng),
                        errors,
                    )
                    added, onset = rng.standard_normal(flight.shape), round(CALM * RATE)
                    channel = int(rng.integers(flight.shape[1]))
                    added[onset:, channel] += rng.choice([-1, 1]) * size
                    outcomes.append(
                        found(fresh(pipeline, flight.block(added)), channel, onset)
                    )
                bound = moustakides_delay(
                    size * math.sqrt(pipeline.geometry.S[0, 0]), RUN_LENGTH
                )
                figures = summary(outcomes, WATCHED * RATE)
                times = figures["declared"] / bound if "declared" in figures else None
                yield label, {"bound": bound, "times_bound": times, **figures}


def measure_next(asked: Asked) -> Iterator[Row]:
    """Add the next bias, of another channel."""
    trials = asked.count(20)
    settings = {**IDEAL, "detector.false_alarms_per_hour": 0.001}
    for (mounting, config), size in (
        (c, s) for c in asked.configs(settings).items() for s in (2.0, 4.0)
    ):
        if not asked.wants(f"{mounting}, {size:g} sigma"):
            continue
        pipeline = Pipeline.from_config(config)
        names = pipeline.channel_names
        without = [
            Pipeline.from_config(config.replaced({"excluded_channels": (name,)}))
            for name in names
        ]
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
            outcomes.setdefault("alone", []).append(
                found(fresh(pipeline, block), other, onset)
            )
            outcomes.setdefault("other excluded", []).append(
                found(fresh(without[one], block), other, onset, (one,))
            )
            for gap in GAPS:
                both = noise.copy()
                # The fault before is declared at a sample that is not known beforehand.
                both[onset - round((gap + 20) * RATE) :, one] += faults[0]
                alone = faulty(fresh(pipeline, flight.block(both)))[:, one]
                begin = int(alone.argmax()) + round(gap * RATE)
                both[begin:, other] += faults[1]
                struck = found(
                    fresh(pipeline, flight.block(both)),
                    other,
                    begin,
                    (one,),
                    int(alone.argmax()),
                )
                outcomes.setdefault(f"{gap:g} s after", []).append(
                    struck._replace(judged=bool(alone.any()))
                )
        figures = {
            name: summary(those, WATCHED * RATE) for name, those in outcomes.items()
        }
        base = figures["other excluded"].get("declared")
        for name, those in figures.items():
            times = those["declared"] / base if base and "declared" in those else None
            yield (
                f"{mounting}, {size:g} sigma, {name}",
                {"times_excluded": times, **those},
            )
