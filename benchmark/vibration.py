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
from trials import CONFIGS, NOISE, START, Array, Asked, Rng, Row

from fdi_ros import Block, Config, Pipeline
from fdi_ros.experiments.simulate import Motion, regular_stamps
from fdi_ros.monitor.output import ChannelState

LENGTH, MOTORS, COUNTED = 60.0, 10.0, 15.0
"""s: of a flight, until the motors start, and from where on errors count."""
SCALE, MISALIGNMENT, BIAS = 0.003, float(np.radians(0.2)), 0.01
FINE = 16
"""Steps within a sample for what filters and shocks do between samples."""
FIGURES = {
    **dict.fromkeys(("nees", "worst", "sigma", "over_best"), ".2f"),
    **dict.fromkeys(("level", "ok"), ".1%"),
    **dict.fromkeys(("declared", "faulty"), ".0f"),
}


@dataclass
class Flight:
    """Times, truth and values of one flight; a condition changes it in place."""

    rng: Rng
    rate: float
    t: Array
    """(N,) s."""
    motion: Callable[[Array], Array]
    """Body rate (N, 3) at times (N,), rad/s."""
    axes: Array
    """True axes (n, 3)."""
    late: Array
    """(N, units) s."""
    noise: Array
    """(N, n) rad/s."""
    std: Array
    """(n,) of the noise, rad/s; NaN: no best error is known."""
    shaken: Callable[[Array], Array] | None = None
    """Rotation of the whole body (N, 3) by vibration at times (N,), rad/s."""
    gain: Array | float = 1.0
    phase: Array | float = 0.0
    """Of each channel (n,) in it; phase as a delay, s."""

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

    @property
    def running(self) -> Array:
        """(N,) how far the motors have started, 0 to 1."""
        return np.clip((self.t - MOTORS) / 0.5, 0.0, 1.0)


def manoeuvres(rng: Rng) -> Callable[[Array], Array]:
    """Rest, hover, yaw turns, steps, and rest at the end."""
    times, rates = [0.0, MOTORS + 1.0], [np.zeros(3), np.zeros(3)]
    while times[-1] < LENGTH - 6.0:
        kind = rng.choice(["hover", "yaw", "step"], p=[0.4, 0.3, 0.3])
        if kind == "hover":
            targets = [(0.03 * rng.standard_normal(3), 0.4) for _ in range(8)]
        elif kind == "yaw":
            targets = [(np.array([0.0, 0.0, rng.choice([-1, 1]) * rng.uniform(0.5, 1.3)]), rng.uniform(1.0, 3.0))]
        else:
            targets = [(rng.uniform(-1.0, 1.0, 3), rng.uniform(0.1, 0.4)) for _ in range(4)]
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
    return Flight(rng, rate, t, manoeuvres(rng), axes, np.zeros((len(t), n // 3)), noise, np.full(n, NOISE))


Condition = Callable[[Flight], None]


def white(flight: Flight) -> None:
    """Nothing but white noise."""


def late(unit: int, by: float = 0.02) -> Condition:
    """One unit is late."""

    def change(flight: Flight) -> None:
        if unit < flight.units:
            flight.late[:, unit] += by
        flight.std[:] = np.nan

    return change


def tones(size: float, *hertz: float) -> Condition:
    """Lines of their own phase in each channel, amplitude size, rad/s."""

    def change(flight: Flight) -> None:
        for frequency in hertz:
            phase = flight.rng.uniform(0, 2 * np.pi, len(flight.axes))
            line = np.sin(2 * np.pi * frequency * flight.t[:, None] + phase)
            flight.noise += size * flight.running[:, None] * line
        flight.std[:] = np.nan

    return change


def body(size: float, hertz: float) -> Condition:
    """Rotate the whole body, which units see 15 % and 0.15 rad differently."""

    def change(flight: Flight) -> None:
        rng, units = flight.rng, flight.units
        along = size * rng.uniform(0.5, 1.0, 3)
        angle = rng.uniform(0, 2 * np.pi, 3)

        def shaken(t: Array) -> Array:
            running = np.clip((t - MOTORS) / 0.5, 0.0, 1.0)[:, None]
            return running * along * np.sin(2 * np.pi * hertz * t[:, None] + angle)

        flight.shaken = shaken
        flight.gain = np.repeat(1 + 0.15 * rng.standard_normal(units), 3)
        flight.phase = np.repeat(0.15 * rng.standard_normal(units), 3) / (2 * np.pi * hertz)
        flight.std[:] = np.nan

    return change


def broad(size: float) -> Condition:
    """Vibration of the whole body from 20 to 90 Hz, folded, seen 15 % differently."""

    def change(flight: Flight) -> None:
        rng = flight.rng
        hertz, angle = rng.uniform(20, 90, 40), rng.uniform(0, 2 * np.pi, (40, 3))
        along = size * np.sqrt(2 / 40) * rng.standard_normal((40, 3))

        def shaken(t: Array) -> Array:
            running = np.clip((t - MOTORS) / 0.5, 0.0, 1.0)[:, None]
            total = np.zeros((len(t), 3))
            for f, a, p in zip(hertz, along, angle, strict=True):
                total += a * np.sin(2 * np.pi * f * t[:, None] + p)
            return running * total

        flight.shaken = shaken
        flight.gain = np.repeat(1 + 0.15 * rng.standard_normal(flight.units), 3)
        flight.std[:] = np.nan

    return change


def autoregressive(memory: float) -> Condition:
    """Noise of the first order with this memory from sample to sample, of the same variance."""

    def change(flight: Flight) -> None:
        drawn = NOISE * flight.rng.standard_normal(flight.noise.shape)
        coloured = np.empty_like(drawn)
        coloured[0] = drawn[0]
        for k in range(1, len(drawn)):
            coloured[k] = memory * coloured[k - 1] + np.sqrt(1 - memory**2) * drawn[k]
        flight.noise += coloured - (flight.noise - flight.noise.mean(axis=0))

    return change


def low_pass(hertz: float) -> Condition:
    """White noise through a filter of the first order."""

    def change(flight: Flight) -> None:
        autoregressive(float(np.exp(-2 * np.pi * hertz / flight.rate)))(flight)

    return change


def clocks(ppm: float) -> Condition:
    """Units whose clocks drift apart."""

    def change(flight: Flight) -> None:
        flight.late[:] += 1e-6 * ppm * flight.t[:, None] * flight.rng.permutation(np.linspace(0, 1, flight.units))
        flight.std[:] = np.nan

    return change


def louder(count: int, factor: float) -> Condition:
    """Noise of one channel, or of a unit, so many times as strong."""

    def change(flight: Flight) -> None:
        n = len(flight.axes)
        own = [int(flight.rng.integers(n))] if count == 1 else 3 * int(flight.rng.integers(n // 3)) + np.arange(3)
        flight.noise[:, own] += (
            np.sqrt(factor**2 - 1)
            * NOISE
            * flight.running[:, None]
            * flight.rng.standard_normal((len(flight.t), count))
        )
        flight.std[own] *= factor

    return change


def landing(size: float) -> Condition:
    """Shake the body when it lands; units are not sampled together."""

    def change(flight: Flight) -> None:
        before, at = flight.motion, LENGTH - 5.0 + flight.rng.uniform(0, 0.1)
        along = size * flight.rng.standard_normal(3) / np.sqrt(3)

        def shock(t: Array) -> Array:
            since = np.maximum(t - at, 0.0)[:, None]
            return before(t) + along * np.sin(2 * np.pi * 12.0 * since) * np.exp(-since / 0.06)

        flight.motion = shock
        flight.late += flight.rng.uniform(0, 1 / flight.rate, flight.units) - 0.5 / flight.rate
        flight.std[:] = np.nan

    return change


def rectified(size: float) -> Condition:
    """Biases that move as the motors start."""

    def change(flight: Flight) -> None:
        flight.noise += size * flight.rng.standard_normal(len(flight.axes)) * flight.running[:, None]
        tones(0.02, 41.0)(flight)

    return change


def warming(size: float) -> Condition:
    """Biases that warm by so much with a time constant of 30 s."""

    def change(flight: Flight) -> None:
        since = np.maximum(flight.t - MOTORS, 0.0)[:, None]
        flight.noise += size * flight.rng.standard_normal(len(flight.axes)) * (1 - np.exp(-since / 30.0))

    return change


def misaligned(flight: Flight) -> None:
    """Units off by 0.5 deg more than was stated."""
    turned = flight.rng.normal(0, np.radians(0.5), (flight.units, 3))
    for u, (x, y, z) in enumerate(turned):
        own = slice(3 * u, 3 * u + 3)
        flight.axes[own] = flight.axes[own] @ (np.eye(3) + np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]))
    flight.std[:] = np.nan


CONDITIONS: dict[str, tuple[Condition, float]] = {
    "white": (white, 100.0),
    **{f"unit {u + 1} late by 20 ms": (late(u), 100.0) for u in range(4)},
    **{
        f"own tones {size} {hertz} Hz at {rate:.0f}": (tones(size, hertz), rate)
        for size in (0.03, 0.1)
        for hertz, rate in ((12.7, 100.0), (43.0, 100.0), (87.3, 100.0), (149.0, 100.0), (149.0, 50.0), (87.3, 50.0))
    },
    "two own tones 0.1": (tones(0.1, 31.0, 43.0), 100.0),
    **{
        f"body {size} {hertz} Hz at {rate:.0f}": (body(size, hertz), rate)
        for size in (0.03, 0.1)
        for hertz, rate in ((12.7, 100.0), (43.0, 100.0), (87.3, 100.0), (149.0, 100.0), (149.0, 50.0), (87.3, 50.0))
    },
    "body broadband 0.05": (broad(0.05), 100.0),
    "AR 0.9": (autoregressive(0.9), 100.0),
    "low pass 30 Hz at 400": (low_pass(30.0), 400.0),
    "clocks 50 ppm": (clocks(50.0), 100.0),
    "misalignment 0.5 deg": (misaligned, 100.0),
    "one unit x3": (louder(3, 3.0), 100.0),
    "one channel x10": (louder(1, 10.0), 100.0),
    "landing shock 5 rad/s": (landing(5.0), 100.0),
    "rectified 5 mrad/s": (rectified(0.005), 100.0),
    "warming 20 mrad/s": (warming(0.02), 100.0),
}


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
        changes |= {"imus.topics": tuple(f"{name}/data_raw" for name in names), "imus.names": names, "imus.mounts": ()}
    return Config.from_file(CONFIGS / "two_imus.yaml", {**changes, **asked.settings})


def measure(asked: Asked) -> Iterator[Row]:
    """Every condition with two, three and four units."""
    monitors: dict[tuple[int, float], Pipeline] = {}
    for name, (condition, rate) in CONDITIONS.items():
        for units in (2, 3, 4):
            label = f"{units} units, {name}"
            if not asked.wants(label) or (name.startswith("unit ") and int(name[5]) > units):
                continue
            if (units, rate) not in monitors:
                monitors[units, rate] = Pipeline.from_config(config_of(units, rate, asked))
            pipeline = monitors[units, rate]
            nominal = pipeline.geometry.axes
            yield (
                label,
                figures([judged(pipeline, nominal, condition, asked.rng(label, k)) for k in range(asked.count(4))]),
            )


def judged(pipeline: Pipeline, nominal: Array, condition: Condition, rng: Rng) -> dict[str, Any]:
    """Fly once."""
    flight = flight_of(pipeline.config, nominal, rng)
    condition(flight)
    pipeline.restart()
    output = pipeline.process(Block(regular_stamps(LENGTH, flight.rate, START)[: len(flight.t)], flight.values()))
    # The rate is of the instant that the values are of, which delays put before the stamp.
    at = (output.instant - START) * 1e-9
    truth = flight.truth_at(at)
    rows = output.valid & (flight.t >= COUNTED)
    error, covariance = (output.rate - truth)[rows], output.covariance[rows]
    std = np.sqrt(np.einsum("kii->ki", covariance))
    ok = output.state[rows] == ChannelState.OK
    weighted = flight.axes / flight.std[:, None] ** 2
    best = np.sqrt(np.trace(np.linalg.inv(flight.axes.T @ weighted))) if np.isfinite(flight.std).all() else np.nan
    sigmas = np.abs(error) / std
    return {
        "nees": float(np.einsum("ki,ki->k", error, np.linalg.solve(covariance, error[..., None])[..., 0]).mean() / 3),
        "sigma": float(sigmas[ok.all(axis=1)].max(initial=0.0)),
        "over_best": float(np.sqrt((error**2).sum(axis=1).mean()) / best),
        "level": float((np.abs(error) > output.level[rows]).any(axis=1).mean()),
        "ok": float((output.state[flight.t >= COUNTED] == ChannelState.OK).mean()),
        "declared": sum(event.declares and event.after == ChannelState.AMBIGUOUS for event in output.events),
        "faulty": sum(event.declares and event.after == ChannelState.FAULTY for event in output.events),
    }


def figures(flights: list[dict[str, Any]]) -> dict[str, Any]:
    """Of all flights of a row."""
    column = {name: np.array([flight[name] for flight in flights]) for name in flights[0]}
    return {
        "nees": column["nees"].mean(),
        "worst": column["nees"].max(),
        "sigma": column["sigma"].max(),
        "over_best": column["over_best"].mean(),
        "level": column["level"].mean(),
        "ok": column["ok"].mean(),
        "declared": column["declared"].sum(),
        "faulty": column["faulty"].sum(),
    }
