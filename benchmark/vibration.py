# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Is the published rate true in vibration: healthy flights of 2, 3 and 4 units, as vehicles shake them.

A flight of 60 s: rest, motors from 10 s on, hover with small attitude motion, yaw turns and fast steps, a landing.
Gyros have scale errors of 0.3 %, misalignments of 0.2 deg and biases of 10 mrad/s that the monitor has to find, and
white noise of 0.003 rad/s. From 10 s on each condition adds its own. The truth is the rate of the body, with what of
the vibration turns it.

nees: e' P^-1 e / 3 of the fused rate from 15 s on, mean of the flights, worst flight beside; sigma: largest error over
its published deviation about one axis while all is OK; level: share of samples whose error is beyond the protection
level; over best: rms error over the best weighted mean of known noise; ok: share of channel-samples OK; declared,
faulty: declarations of sets and channels in all flights.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from healthy import autoregressive
from trials import CONFIGS, NOISE, START, Array, Asked, Rng, Row, fresh

from fdi_ros import Block, Config, Pipeline
from fdi_ros.experiments.flight import Motion, regular_stamps
from fdi_ros.monitor.output import ChannelState

LENGTH, MOTORS, COUNTED = (
    60.0,
    10.0,
    15.0,
)  # s: of a flight, until the motors start, and from where on errors count
SCALE, MISALIGNMENT, BIAS = 0.003, float(np.radians(0.2)), 0.01
SUMS = {
    "nees": (np.mean, ".2f"),
    "worst": (np.max, ".2f"),
    "sigma": (np.max, ".2f"),
    "over_best": (np.mean, ".2f"),
    "level": (np.mean, ".1%"),
    "ok": (np.mean, ".1%"),
    "declared": (np.sum, ".0f"),
    "faulty": (np.sum, ".0f"),
}
"""What is made of the figure of each flight, and its format."""
FIGURES = {name: form for name, (_, form) in SUMS.items()}


@dataclass
class Flight:
    """Times, truth and values of one flight; a condition changes it in place."""

    rng: Rng
    rate: float
    t: Array  # (N,) s
    motion: Callable[[Array], Array]  # body rate (N, 3) at times (N,), rad/s
    axes: Array  # true axes (n, 3)
    late: Array  # (N, units) s
    noise: Array  # (N, n) rad/s
    std: Array  # (n,) of the noise, rad/s; NaN: no best error is known.
    shaken: Callable[[Array], Array] | None = None
    """Rotation of the whole body (N, 3) by vibration at times (N,), rad/s."""
    gain: Array | float = 1.0
    phase: Array | float = 0.0  # of each channel (n,) in it; phase as a delay, s

    @property
    def units(self) -> int:
        """How many units there are."""
        return len(self.axes) // 3

    def truth_at(self, t: Array) -> Array:
        """Body rate (N, 3) at times t (N,) s, rad/s."""
        rate = self.motion(t)
        return rate if self.shaken is None else rate + self.shaken(t)

    def values(self) -> Array:
        """Return what the gyros show, (N, n) rad/s."""
        n, z = len(self.axes), np.empty(self.noise.shape)
        gain, phase = np.broadcast_to(self.gain, n), np.broadcast_to(self.phase, n)
        for i in range(n):
            at = self.t - self.late[:, i // 3]
            z[:, i] = self.motion(at) @ self.axes[i]
            if self.shaken is not None:
                z[:, i] += gain[i] * (self.shaken(at - phase[i]) @ self.axes[i])
        return z + self.noise


def manoeuvres(rng: Rng, length: float = LENGTH) -> Callable[[Array], Array]:
    """Rest, hover, yaw turns, steps, and rest at the end."""
    times, rates = [0.0, MOTORS + 1.0], [np.zeros(3), np.zeros(3)]
    while times[-1] < length - 6.0:
        kind = rng.choice(["hover", "yaw", "step"], p=[0.4, 0.3, 0.3])
        if kind == "hover":
            targets = [(0.03 * rng.standard_normal(3), 0.4) for _ in range(8)]
        elif kind == "yaw":
            targets = [
                (
                    np.array([0.0, 0.0, rng.choice([-1, 1]) * rng.uniform(0.5, 1.3)]),
                    rng.uniform(1.0, 3.0),
                )
            ]
        else:
            targets = [
                (rng.uniform(-1.0, 1.0, 3), rng.uniform(0.1, 0.4)) for _ in range(4)
            ]
        for target, hold in [*targets, (np.zeros(3), 0.3)]:
            ramp = 0.15 + rng.uniform(0.0, 0.2)
            times += [times[-1] + ramp, times[-1] + ramp + hold]
            rates += [target, target]
    return Motion(np.array(times), np.array(rates)).rate_at


def flight_of(config: Config, nominal: Array, rng: Rng) -> Flight:
    """Draw gyros and their motion."""
    n, rate = len(nominal), config.sample_rate
    across = rng.normal(0, MISALIGNMENT, (n, 3))
    across -= (across * nominal).sum(axis=1)[:, None] * nominal
    axes = (nominal + across) * (1 + rng.normal(0, SCALE, (n, 1)))
    t = np.arange(round(LENGTH * rate)) / rate
    noise = rng.normal(0, BIAS, n) + NOISE * rng.standard_normal((len(t), n))
    return Flight(
        rng,
        rate,
        t,
        manoeuvres(rng),
        axes,
        np.zeros((len(t), n // 3)),
        noise,
        np.full(n, NOISE),
    )


def white(flight: Flight) -> None:
    """Nothing but white noise."""


def late(flight: Flight, unit: int, by: float = 0.02) -> None:
    """One unit is late."""
    if unit < flight.units:
        flight.late[:, unit] += by
    flight.std[:] = np.nan


def tones(flight: Flight, size: float, *hertz: float) -> None:
    """Lines of their own phase in each channel, amplitude size, rad/s."""
    for frequency in hertz:
        phase = flight.rng.uniform(0, 2 * np.pi, len(flight.axes))
        flight.noise += (
            size
            * running_at(flight.t)
            * np.sin(2 * np.pi * frequency * flight.t[:, None] + phase)
        )
    flight.std[:] = np.nan


def running_at(t: Array) -> Array:
    """How far the motors have started at times t (N,) s, (N, 1), 0 to 1."""
    return np.clip((t - MOTORS) / 0.5, 0.0, 1.0)[:, None]


def body(flight: Flight, size: float, hertz: float) -> None:
    """Rotate the whole body, which units see 15 % and 0.15 rad differently."""
    along, angle = (
        size * flight.rng.uniform(0.5, 1.0, 3),
        flight.rng.uniform(0, 2 * np.pi, 3),
    )
    flight.shaken = lambda t: (
        running_at(t) * along * np.sin(2 * np.pi * hertz * t[:, None] + angle)
    )
    flight.gain = np.repeat(1 + 0.15 * flight.rng.standard_normal(flight.units), 3)
    flight.phase = np.repeat(0.15 * flight.rng.standard_normal(flight.units), 3) / (
        2 * np.pi * hertz
    )
    flight.std[:] = np.nan


def broad(flight: Flight, size: float) -> None:
    """Vibration of the whole body from 20 to 90 Hz, folded, seen 15 % differently."""
    hertz, angle = (
        flight.rng.uniform(20, 90, 40),
        flight.rng.uniform(0, 2 * np.pi, (40, 3)),
    )
    along = size * np.sqrt(2 / 40) * flight.rng.standard_normal((40, 3))

    def shaken(t: Array) -> Array:
        parts = zip(hertz, along, angle, strict=True)
        return running_at(t) * sum(
            a * np.sin(2 * np.pi * f * t[:, None] + p) for f, a, p in parts
        )

    flight.shaken = shaken
    flight.gain = np.repeat(1 + 0.15 * flight.rng.standard_normal(flight.units), 3)
    flight.std[:] = np.nan


def coloured(flight: Flight, memory: float) -> None:
    """Noise of the first order with this memory from sample to sample, of the same variance."""
    drawn = NOISE * autoregressive(memory)(flight.rng, *flight.noise.shape)
    flight.noise += drawn - (flight.noise - flight.noise.mean(axis=0))


def low_pass(flight: Flight, hertz: float) -> None:
    """White noise through a filter of the first order."""
    coloured(flight, float(np.exp(-2 * np.pi * hertz / flight.rate)))


def clocks(flight: Flight, ppm: float) -> None:
    """Units whose clocks drift apart."""
    flight.late[:] += (
        1e-6
        * ppm
        * flight.t[:, None]
        * flight.rng.permutation(np.linspace(0, 1, flight.units))
    )
    flight.std[:] = np.nan


def louder(flight: Flight, count: int, factor: float) -> None:
    """Noise of one channel, or of a unit, so many times as strong."""
    n = len(flight.axes)
    own = (
        [int(flight.rng.integers(n))]
        if count == 1
        else 3 * int(flight.rng.integers(n // 3)) + np.arange(3)
    )
    added = flight.rng.standard_normal((len(flight.t), count))
    flight.noise[:, own] += (
        np.sqrt(factor**2 - 1) * NOISE * running_at(flight.t) * added
    )
    flight.std[own] *= factor


def landing(flight: Flight, size: float) -> None:
    """Shake the body when it lands; units are not sampled together."""
    before, at = flight.motion, LENGTH - 5.0 + flight.rng.uniform(0, 0.1)
    along = size * flight.rng.standard_normal(3) / np.sqrt(3)

    def shock(t: Array) -> Array:
        since = np.maximum(t - at, 0.0)[:, None]
        return before(t) + along * np.sin(2 * np.pi * 12.0 * since) * np.exp(
            -since / 0.06
        )

    flight.motion = shock
    flight.late += (
        flight.rng.uniform(0, 1 / flight.rate, flight.units) - 0.5 / flight.rate
    )
    flight.std[:] = np.nan


def rectified(flight: Flight, size: float) -> None:
    """Biases that move as the motors start."""
    flight.noise += (
        size * flight.rng.standard_normal(len(flight.axes)) * running_at(flight.t)
    )
    tones(flight, 0.02, 41.0)


def warming(flight: Flight, size: float) -> None:
    """Biases that warm by so much with a time constant of 30 s."""
    since = np.maximum(flight.t - MOTORS, 0.0)[:, None]
    flight.noise += (
        size
        * flight.rng.standard_normal(len(flight.axes))
        * (1 - np.exp(-since / 30.0))
    )


def misaligned(flight: Flight) -> None:
    """Units off by 0.5 deg more than was stated."""
    turned = flight.rng.normal(0, np.radians(0.5), (flight.units, 3))
    for u, (x, y, z) in enumerate(turned):
        own = slice(3 * u, 3 * u + 3)
        flight.axes[own] = flight.axes[own] @ (
            np.eye(3) + np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        )
    flight.std[:] = np.nan


TONES = [
    (size, hertz, rate)
    for size in (0.03, 0.1)
    for hertz, rate in (
        (12.7, 100.0),
        (43.0, 100.0),
        (87.3, 100.0),
        (149.0, 100.0),
        (149.0, 50.0),
        (87.3, 50.0),
    )
]
CONDITIONS: dict[str, tuple[Any, ...]] = {
    "white": (100.0, white),
    **{f"unit {u + 1} late by 20 ms": (100.0, late, u) for u in range(4)},
    **{
        f"own tones {size} {hertz} Hz at {rate:.0f}": (rate, tones, size, hertz)
        for size, hertz, rate in TONES
    },
    "two own tones 0.1": (100.0, tones, 0.1, 31.0, 43.0),
    **{
        f"body {size} {hertz} Hz at {rate:.0f}": (rate, body, size, hertz)
        for size, hertz, rate in TONES
    },
    "body broadband 0.05": (100.0, broad, 0.05),
    "AR 0.9": (100.0, coloured, 0.9),
    "low pass 30 Hz at 400": (400.0, low_pass, 30.0),
    "clocks 50 ppm": (100.0, clocks, 50.0),
    "misalignment 0.5 deg": (100.0, misaligned),
    "one unit x3": (100.0, louder, 3, 3.0),
    "one channel x10": (100.0, louder, 1, 10.0),
    "landing shock 5 rad/s": (100.0, landing, 5.0),
    "rectified 5 mrad/s": (100.0, rectified, 0.005),
    "warming 20 mrad/s": (100.0, warming, 0.02),
}
"""Samples a second, what happens, and its numbers."""


def config_of(units: int, rate: float, asked: Asked) -> Config:
    """Two units on the cone, or three or four parallel ones."""
    changes: dict[str, Any] = {
        "sample_rate": rate,
        "noise.noise_std": (NOISE,),
        "noise.scale_std": (0.01,),
        "noise.timing_std": (0.0003,),
    }
    if units > 2:
        names = tuple(f"imu_{u + 1}" for u in range(units))
        changes |= {
            "imus.topics": tuple(f"{name}/data_raw" for name in names),
            "imus.names": names,
            "imus.mounts": (),
        }
    return Config.from_file(CONFIGS / "two_imus.yaml", {**changes, **asked.settings})


def measure(asked: Asked) -> Iterator[Row]:
    """Every condition with two, three and four units."""
    monitors: dict[tuple[int, float], Pipeline] = {}
    for name, (rate, *_) in CONDITIONS.items():
        for units in (2, 3, 4):
            label = f"{units} units, {name}"
            if not asked.wants(label) or (
                name.startswith("unit ") and int(name[5]) > units
            ):
                continue
            if (units, rate) not in monitors:
                monitors[units, rate] = Pipeline.from_config(
                    config_of(units, rate, asked)
                )
            pipeline = monitors[units, rate]
            flights = [
                judged(pipeline, name, asked.rng(label, k))
                for k in range(asked.count(4))
            ]
            yield (
                label,
                {
                    key: of([one[key] for one in flights])
                    for key, (of, _) in SUMS.items()
                },
            )


def judged(pipeline: Pipeline, name: str, rng: Rng) -> dict[str, Any]:
    """Fly once in a condition."""
    _, condition, *numbers = CONDITIONS[name]
    flight = flight_of(pipeline.config, pipeline.geometry.axes, rng)
    condition(flight, *numbers)
    output = fresh(
        pipeline,
        Block(
            regular_stamps(LENGTH, flight.rate, START)[: len(flight.t)], flight.values()
        ),
    )
    # The rate is of the instant that the values are of, which delays put before the stamp.
    at = (output.instant - START) * 1e-9
    truth = flight.truth_at(at)
    rows = output.valid & (flight.t >= COUNTED)
    error, covariance = (output.rate - truth)[rows], output.covariance[rows]
    std = np.sqrt(np.einsum("kii->ki", covariance))
    ok = output.state[rows] == ChannelState.OK
    weighted = flight.axes / flight.std[:, None] ** 2
    best = (
        np.sqrt(np.trace(np.linalg.inv(flight.axes.T @ weighted)))
        if np.isfinite(flight.std).all()
        else np.nan
    )
    sigmas = np.abs(error) / std
    nees = float(
        np.einsum(
            "ki,ki->k", error, np.linalg.solve(covariance, error[..., None])[..., 0]
        ).mean()
        / 3
    )
    return {
        "nees": nees,
        "worst": nees,
        "sigma": float(sigmas[ok.all(axis=1)].max(initial=0.0)),
        "over_best": float(np.sqrt((error**2).sum(axis=1).mean()) / best),
        "level": float((np.abs(error) > output.level[rows]).any(axis=1).mean()),
        "ok": float((output.state[flight.t >= COUNTED] == ChannelState.OK).mean()),
        "declared": sum(
            event.declares and event.after == ChannelState.AMBIGUOUS
            for event in output.events
        ),
        "faulty": sum(
            event.declares and event.after == ChannelState.FAULTY
            for event in output.events
        ),
    }
