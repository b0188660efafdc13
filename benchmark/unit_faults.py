# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A unit that is wrong as a whole: is a sound channel named, and is the delay of its stamps told rightly.

Flights of small MEMS units in white noise, at rest for 6 s, then in motion with angular accelerations up to 20 rad/s^2.
One unit has late (or early) stamps, a clock that runs away, jittering stamps, a gain, repeats its values, or drifts as
if the body turned. A sample is what the unit showed at its true instant, under the stamp of the others.

    python benchmark/unit_faults.py [--detector NAME] [--flights 100] [--quick] [--json FILE]

other: flights with a channel of another unit FAULTY; single: one of this unit, but not all three; unit: all three and
nothing else; in sets: channels AMBIGUOUS; unjudged: the start-up was refused. told: flights with a delay reported at
the end; off: its rms error between units, ms; within: share of the flights in which it is right to 0.3 ms.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from trials import (
    Array,
    Rng,
    Table,
    arguments_of,
    by_mounting,
    faulty,
    in_set,
    made,
    seconds_of,
    simulated,
    size_of,
    unchecked,
)

from fdi_ros import Pipeline
from fdi_ros.experiments.simulate import vehicle_motion

LENGTH, ONSET = 120.0, 20.0
"""Of a flight, and when a fault begins that is not there from the start, s."""
RIGHT = 0.3e-3
"""What a delay is to be right to, s."""

COUNTED = ("other", "single", "unit", "in_sets", "unjudged")

Late = Callable[[Array, Rng], Array]
"""By how much the stamps of the unit are late, (N,) s, at times (N,) s."""
Change = Callable[[Array, Array, Array, Rng], Array]
"""What the unit shows instead: of times (N,) s, values (N, 3) rad/s and axes (3, 3)."""


def constant(late: float) -> Late:
    return lambda seconds, rng: np.full(len(seconds), late)


def running(share: float) -> Late:
    return lambda seconds, rng: share * rng.choice([-1.0, 1.0]) * seconds


def jittering(std: float) -> Late:
    return lambda seconds, rng: std * rng.standard_normal(len(seconds))


def gain(factor: float) -> Change:
    return lambda seconds, shown, axes, rng: factor * shown


def repeating(length: float, period: float = 10.0) -> Change:
    def change(seconds: Array, shown: Array, axes: Array, rng: Rng) -> Array:
        held = (seconds >= ONSET) & ((seconds - ONSET) % period < length)
        rows = np.where(held, 0, np.arange(len(seconds)))
        return np.asarray(shown[np.maximum.accumulate(rows)])

    return change


def turning(growth: float, step: float = 0.0) -> Change:
    """Turn on the whole as the body does, by a step, rad/s, or ever more, rad/s^2."""

    def change(seconds: Array, shown: Array, axes: Array, rng: Rng) -> Array:
        direction = rng.standard_normal(3)
        course = (seconds >= ONSET) * (step + growth * (seconds - ONSET))
        return shown + course[:, None] * (axes @ (direction / np.linalg.norm(direction)))

    return change


LATE: dict[str, Late] = {
    **{f"late by {late:g} ms": constant(1e-3 * late) for late in (0, 0.5, 1, 2, 3, 5, 10)},
    **{f"early by {late:g} ms": constant(-1e-3 * late) for late in (0.5, 1, 2, 3, 5, 10)},
    **{f"clock {share:g} ppm off": running(1e-6 * share) for share in (20, 100, 200)},
    **{f"jitter {std:g} ms": jittering(1e-3 * std) for std in (1, 3)},
}
CHANGES: dict[str, Change] = {
    "gain 0.95": gain(0.95),
    "gain 1.05": gain(1.05),
    "repeats for 0.1 s": repeating(0.1),
    "drift 0.002 rad/s^2": turning(0.002),
    "drift 0.02 rad/s^2": turning(0.02),
    "step 0.05 rad/s": turning(0.0, 0.05),
}


def fly(pipeline: Pipeline, rng: Rng, kind: str) -> dict[str, Any]:
    """Fly once; return what came of it."""
    unit = made(pipeline, rng)
    stamp = unit.stamps(LENGTH)
    seconds, units = seconds_of(stamp), unit.geometry.n // 3
    struck = int(rng.integers(units))
    own = slice(3 * struck, 3 * struck + 3)
    late = np.zeros((len(stamp), units))
    if kind in LATE:
        late[:, struck] = LATE[kind](seconds, rng)
    clean = unit.rates(vehicle_motion(LENGTH, rng), seconds, late)
    block = simulated(unit, stamp, clean, rng.standard_normal(clean.shape))
    if kind in CHANGES:
        block.z[:, own] = CHANGES[kind](seconds, block.z[:, own], unit.gyros.axes[own], rng)
    output = pipeline.process(block)
    alone, among = np.asarray(faulty(output).any(axis=0)), in_set(output)
    other = bool(np.delete(alone, own).any())
    return {
        "other": other,
        "single": bool(alone[own].any() and not alone[own].all()),
        "unit": bool(alone[own].all()) and not other,
        "in_sets": bool(among.any()),
        "unjudged": bool(unchecked(output)[int(np.searchsorted(seconds, ONSET))].any()),
        "off": delay_error(pipeline, late[-1] - unit.gyros.delay[::3]) if "jitter" not in kind else None,
    }


def delay_error(pipeline: Pipeline, late: Array) -> float | None:
    """Root mean square error, s, of the delays between units that the monitor reports; None: it reports none."""
    delays = getattr(pipeline.status(), "delays", ())
    if not delays or not np.isfinite(delays).all():
        return None
    error = np.asarray(delays) - late
    # Delays common to all units cannot be seen.
    return float(np.sqrt(((error - error.mean()) ** 2).sum() / (len(late) - 1)))


def main() -> None:
    about: dict[str, dict[str, Any]] = {
        "flights": {"type": int, "default": 100, "help": "of each kind and mounting; 20 with --quick"},
        "only": {"default": "", "help": "faults with this in their name"},
    }
    arguments = arguments_of(__doc__, **about)
    flights = size_of(arguments, "flights", 20)
    table = Table(
        mounting="<9",
        fault="<20",
        flights=">7d",
        **dict.fromkeys(COUNTED, ">6d"),
        told=">6d",
        off=">6.2f",
        within=">7.1%",
        took_s=">7.1f",
    )
    kinds = [kind for kind in (*LATE, *CHANGES) if arguments.only in kind]
    for mounting, kind, outcomes, took in by_mounting(arguments, flights, fly, kinds):
        told = np.array([o["off"] for o in outcomes if o["off"] is not None])
        table.add(
            mounting=mounting,
            fault=kind,
            flights=flights,
            **{name: sum(o[name] for o in outcomes) for name in COUNTED},
            told=len(told),
            off=1e3 * float(np.sqrt((told**2).mean())) if len(told) else None,
            within=float((told <= RIGHT).mean()) if len(told) else None,
            took_s=took,
        )
    table.write(arguments)


if __name__ == "__main__":
    main()
