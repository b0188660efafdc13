# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Slow drifts of one gyro in motion, and healthy gyros that warm up or whose biases walk.

0.6 rad/s about each axis, gyros of small MEMS units; the drift begins after a minute and is watched for 30. declared,
named: s since it began, where it was (median of those); off: largest error of the fused rate, averaged over a second,
over its published standard deviation, while no channel is other than OK: median and largest of the flights. Healthy
twins fly for ten minutes.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from conditions import walking, warming
from trials import NOISE, RATE, Array, Asked, Flight, Row, Sines, faulty, found, fresh, in_set, labelled

from fdi_ros.experiments.simulate import GyroErrors
from fdi_ros.monitor.output import ChannelState, Output

FIGURES = {
    **dict.fromkeys(("declared", "named"), ".1f"),
    **dict.fromkeys(("in_time", "in_name", "wrong"), ".0%"),
    **dict.fromkeys(("off", "most_off"), ".2f"),
    "flights_declared": "d",
    "flights": "d",
}
DRIFTS = (0.003, 0.005, 0.01, 0.02, 0.05)
"""deg/s^2."""
ONSET, WATCHED, TWIN = 60.0, 1800.0, 600.0
"""s."""
TWINS = {
    "walk 2e-5": walking(2e-5),
    "walk 5e-5": walking(5e-5),
    "warming 0.02 rad/s in 20 min": warming(0.02),
}


def off(output: Output, truth: Array) -> float:
    """Largest error over published sigma while all channels are OK, of means over a second."""
    error = (output.rate - truth) / np.sqrt(np.einsum("kii->ki", output.covariance))
    error[(output.state != ChannelState.OK).any(axis=1)] = np.nan
    width = round(RATE)
    means = error[: len(error) // width * width].reshape(-1, width, 3).mean(axis=1)
    return float(np.nanmax(np.abs(means), initial=0.0))


def measure(asked: Asked) -> Iterator[Row]:
    """Time to the name, and what the monitor says of its rate until then."""
    trials = asked.count(4)
    for label, pipeline, drift in labelled(asked, None, DRIFTS):
        outcomes, errors = [], []
        for k in range(trials):
            rng = asked.rng("drift", label, k)
            flight = Flight.of(pipeline, rng, ONSET + WATCHED, Sines.drawn(0.6, rng), GyroErrors())
            added = rng.standard_normal(flight.shape)
            channel, sign = int(rng.integers(flight.shape[1])), rng.choice([-1, 1])
            added[:, channel] += sign * np.radians(drift) / NOISE * np.maximum(flight.seconds - ONSET, 0)
            output = fresh(pipeline, flight.block(added))
            outcomes.append(found(output, channel, round(ONSET * RATE)))
            errors.append(off(output, flight.truth))
        yield f"{label} deg/s^2", {**_times(outcomes), "off": float(np.median(errors)), "most_off": max(errors)}
    for label, pipeline, twin in labelled(asked, None, TWINS):
        declared, errors = 0, []
        for k in range(trials):
            rng = asked.rng("twin", label, k)
            flight = Flight.of(pipeline, rng, TWIN, Sines.drawn(0.6, rng), GyroErrors())
            added = rng.standard_normal(flight.shape) + TWINS[twin](rng, flight.seconds, flight.shape[1]) / NOISE
            output = fresh(pipeline, flight.block(added))
            declared += bool((faulty(output) | in_set(output)).any())
            errors.append(off(output, flight.truth))
        figures = {"flights_declared": declared, "flights": trials}
        yield f"{label}, healthy", {**figures, "off": float(np.median(errors)), "most_off": max(errors)}


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
