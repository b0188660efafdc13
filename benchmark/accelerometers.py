# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Is the fused specific force true: healthy flights of 2, 3 and 4 units whose gyros and accelerometers are judged.

A flight of 60 s: rest, motors from 10 s on, turns of up to 1 rad/s, specific forces of up to 5 m/s^2 beside gravity.
Accelerometers have scale errors of 1 %, misalignments of 1 deg, biases of 0.3 m/s^2 and white noise of 0.15 m/s^2;
settings are the defaults but for noise_std. Each condition adds its own from 10 s on. The truth is the specific force
at the first unit, with the vibration of the body.

nees: e' P^-1 e / 3 of the fused specific force from 15 s on, mean of the flights, worst flight beside; rms: of its
error, m/s^2; level: share of samples whose error is beyond the protection level; ok: share of accelerometer-samples
OK; sets: declarations of sets in all flights, by channels; faulty: healthy channels that were named; gyros included.

logs: each accelerometer of the real flights with three units is off by so much, at three times a flight (--trials) and
with signs in turn. named, held: share that is named, or in a set, within 10 s; faulty: others named.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np
import vibration
from trials import CONFIGS, NOISE, START, Array, Asked, Rng, Row, fresh
from vibration import COUNTED, LENGTH, MOTORS, running_at

from fdi_ros import Block, Config, Pipeline
from fdi_ros.bag.samples import read_block
from fdi_ros.experiments.flight import Motion, regular_stamps
from fdi_ros.monitor.output import ChannelState
from fdi_ros.replay.run import assumed_config

GRAVITY, FORCE_NOISE, FORCE_BIAS = 9.81, 0.15, 0.3  # m/s^2
SCALE, MISALIGNMENT = 0.01, float(np.radians(1.0))
RANGE = 156.9  # m/s^2
LANDING = 50.0  # s: then white vibration ends
MOUNTINGS = ("2 units", "3 units", "4 units")
FIGURES = {
    "nees": ".2f",
    "worst": ".2f",
    "rms": ".3f",
    "level": ".3%",
    "ok": ".1%",
    "sets": "d",
    "faulty": "d",
    "faults": "d",
    "named": ".1%",
    "held": ".1%",
}
SIZES, WITHIN = (5.0, 1.0, 0.3), 10.0  # m/s^2, s


@dataclass
class Flight:
    """Motion and accelerometers of one flight; a condition changes it in place."""

    rng: Rng
    rate: float  # samples a second
    t: Array  # (N,) s
    turning: Callable[[Array], Array]  # body rate (N, 3) at times (N,), rad/s
    force: Array  # specific force at the first unit, (N, 3) m/s^2
    axes: Array  # true axes of the accelerometers, (n, 3)
    noise: Array  # errors of the accelerometers, (N, n) m/s^2
    arms: Array  # positions from the first unit, (units, 3) m
    settings: dict[str, Any] = field(default_factory=dict)
    culprits: set[int] = field(
        default_factory=set
    )  # accelerometers that are not healthy

    def values(self) -> Array:
        """Return what the accelerometers show, (N, n) m/s^2."""
        omega, step = self.turning(self.t), 1e-3
        alpha = (self.turning(self.t + step) - self.turning(self.t - step)) / (2 * step)
        felt = []
        for unit, arm in enumerate(self.arms):
            turned = np.cross(omega, np.cross(omega, arm))
            own = self.axes[3 * unit : 3 * unit + 3]
            felt.append((self.force + np.cross(alpha, arm) + turned) @ own.T)
        return np.clip(np.hstack(felt) + self.noise, -RANGE, RANGE)


def flight_of(units: int, rate: float, rng: Rng) -> Flight:
    """Draw accelerometers and their motion."""
    n = 3 * units
    t = np.arange(round(LENGTH * rate)) / rate
    knots = np.concatenate([[0.0, MOTORS], np.arange(MOTORS + 1.0, LENGTH + 2.0)])
    pushes = rng.normal(0, [2.0, 2.0, 1.5], (len(knots), 3))
    pushes[:2] = GRAVITY * np.sin(rng.normal(0, 0.05)) * np.array([1.0, 0.0, 0.0])
    force = Motion(knots, np.clip(pushes, -5.0, 5.0)).rate_at(t)
    force[:, 2] += GRAVITY
    axes = np.tile(np.eye(3), (units, 1)) * (1 + rng.normal(0, SCALE, (n, 1)))
    axes += rng.normal(0, MISALIGNMENT, (n, 3)) * (axes == 0.0)
    noise = rng.normal(0, FORCE_BIAS, n) + FORCE_NOISE * rng.standard_normal(
        (len(t), n)
    )
    turning = vibration.manoeuvres(rng)
    return Flight(rng, rate, t, turning, force, axes, noise, np.zeros((units, 3)))


def plain(flight: Flight) -> None:
    """Nothing beyond the errors of every flight."""


def lines(flight: Flight, size: float, *hertz: float) -> None:
    """Lines of their own phase in each accelerometer, amplitude size, m/s^2."""
    for frequency in hertz:
        phase = flight.rng.uniform(0, 2 * np.pi, flight.axes.shape[0])
        wave = np.sin(2 * np.pi * frequency * flight.t[:, np.newaxis] + phase)
        flight.noise += size * running_at(flight.t) * wave


def body(flight: Flight, size: float, hertz: float) -> None:
    """Shake the whole body, which units see 15 % differently, amplitude size, m/s^2."""
    wave = np.sin(2 * np.pi * hertz * flight.t + flight.rng.uniform(0, 2 * np.pi))
    along = size * flight.rng.uniform(0.5, 1.0, 3)
    shaken = running_at(flight.t) * wave[:, np.newaxis] * along
    flight.force = flight.force + shaken
    units = len(flight.arms)
    flight.noise += np.tile(shaken, units) * np.repeat(
        flight.rng.normal(0, 0.15, units), 3
    )


def rectified(flight: Flight, size: float) -> None:
    """Biases that move by up to size, m/s^2, as the motors start, beside lines of 3 m/s^2."""
    each = flight.rng.uniform(-1.0, 1.0, flight.axes.shape[0])
    flight.noise += size * each * running_at(flight.t)
    lines(flight, 3.0, 41.0)


def shaken(flight: Flight, size: float, alike: bool, moved: float) -> None:
    """Move all biases by moved, m/s^2, while white vibration shakes the units alike or each channel alone, up to 50 s.

    Biases follow the vibration at once, or within 2 or 5 s.
    """
    rng = flight.rng
    length, n = flight.noise.shape
    runs = running_at(flight.t) * (flight.t < LANDING)[:, np.newaxis]
    slow = np.clip((flight.t - MOTORS) / rng.choice([0.5, 2.0, 5.0]), 0.0, 1.0)
    own = rng.standard_normal((length, n))
    if alike:
        of_body = size * runs * rng.standard_normal((length, 3))
        flight.force = flight.force + of_body
        unequal = rng.normal(0, 0.05, n // 3)
        flight.noise += np.tile(of_body, n // 3) * np.repeat(unequal, 3)
        own *= 0.1
    flight.noise += size * runs * own
    flight.noise += moved * rng.standard_normal(n) * runs * slow[:, np.newaxis]


def apart(flight: Flight, length: float, turns: float, known: bool) -> None:
    """Units up to length apart, m, in turns so many times as fast; their positions may be known."""
    units = len(flight.arms)
    towards = flight.rng.standard_normal((units, 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    flight.arms = towards * flight.rng.uniform(0.0, length, (units, 1))
    flight.arms[0] = 0.0
    before = flight.turning
    flight.turning = lambda t: turns * before(t)
    if known:
        flight.settings["accelerometers.positions"] = flight.arms.ravel().tolist()


def clipped(flight: Flight) -> None:
    """Shake one unit beyond its range, 40 % of a second in every five: it is no healthy one."""
    own = 3 * int(flight.rng.integers(len(flight.arms))) + np.arange(3)
    flight.culprits = set(own.tolist())
    burst = (flight.t > MOTORS + 5.0) & (flight.t % 5.0 < 0.4)
    phase = flight.rng.uniform(0, 2 * np.pi, 3)
    wave = np.sin(2 * np.pi * 37.0 * flight.t[:, np.newaxis] + phase)
    flight.noise[:, own] += 250.0 * burst[:, np.newaxis] * wave


def struck(flight: Flight) -> None:
    """Strike the body: 400 m/s^2 for 0.1 s, beyond the range of all units."""
    pushed = (flight.t > 30.0) & (flight.t < 30.1)
    flight.force = flight.force + 400.0 * pushed[:, np.newaxis] * np.array([0, 0, 1.0])


CONDITIONS: dict[str, tuple[Any, ...]] = {
    "white noise": (100.0, plain),
    "white noise at 400": (400.0, plain),
    **{
        f"own lines {size:g} m/s^2 at {rate:.0f}": (rate, lines, size, 37.0, 81.3)
        for size in (1.0, 5.0, 20.0)
        for rate in (50.0, 100.0, 400.0)
    },
    "body 5 m/s^2": (100.0, body, 5.0, 43.0),
    "body 20 m/s^2": (100.0, body, 20.0, 43.0),
    "rectified 0.2 m/s^2": (100.0, rectified, 0.2),
    **{
        f"{name} {size:g} m/s^2, rectified {moved:g}": (
            100.0,
            shaken,
            size,
            name == "shaken alike",
            moved,
        )
        for name in ("shaken alike", "shaken apart")
        for size, moved in ((1.0, 0.1), (1.0, 0.3), (5.0, 0.2), (5.0, 0.5))
    },
    "arms 0.1 m": (100.0, apart, 0.1, 1.0, False),
    "arms 0.1 m, turns x3": (100.0, apart, 0.1, 3.0, False),
    "known arms 0.1 m, turns x3": (100.0, apart, 0.1, 3.0, True),
    "a unit clips": (100.0, clipped),
    "all are struck": (100.0, struck),
}
"""Samples a second, what happens, and its numbers."""


def config_of(
    units: int, rate: float, settings: dict[str, Any], asked: Asked
) -> Config:
    """Build the settings of parallel units at a rate."""
    names = tuple(f"imu_{unit + 1}" for unit in range(units))
    changes: dict[str, Any] = {
        "sample_rate": rate,
        "imus.topics": tuple(f"{name}/data_raw" for name in names),
        "imus.names": names,
        "imus.mounts": (),
        "noise.noise_std": (NOISE,),
        "accelerometers.enabled": "on",
        "accelerometers.noise_std": (FORCE_NOISE,),
    }
    return Config.from_file(
        CONFIGS / "two_imus.yaml", {**changes, **settings, **asked.settings}
    )


def measure(asked: Asked) -> Iterator[Row]:
    """Every condition with every mounting; faults in real flights."""
    for mounting in MOUNTINGS:
        for name, (rate, change, *numbers) in CONDITIONS.items():
            label = f"{mounting}, {name}"
            if asked.wants(label):
                flown = [
                    fly(int(mounting[0]), rate, change, numbers, asked, label, k)
                    for k in range(asked.count(3))
                ]
                yield label, figures_of(flown)
    for size in SIZES:
        label = f"logs, {size:g} m/s^2"
        if asked.wants(label):
            yield label, in_logs(size, asked)


def in_logs(size: float, asked: Asked) -> dict[str, Any]:
    """Count what becomes of errors of one size, m/s^2, in real flights."""
    faults = named = held = faulty = 0
    times = asked.count(3)
    for path in sorted(asked.data.glob("logs/*.bin")):
        config = assumed_config(path).config.replaced(asked.settings)
        n = 3 * len(config.topics)
        if n < 9:
            continue
        block = read_block(path, config)
        for k, channel in product(range(times), range(n)):
            start = round(len(block) * (0.3 + 0.5 * k / times))
            end = start + round((WITHIN + 1.0) * config.sample_rate)
            error = -size if (k + channel) % 2 else size
            events = events_of_fault(
                Pipeline(config), block[:end], start, channel, error
            )
            in_time = [
                state for state, late in events.get(channel, ()) if late <= WITHIN
            ]
            faults += 1
            named += ChannelState.FAULTY in in_time
            held += bool(in_time)
            faulty += any(
                state == ChannelState.FAULTY
                for other, own in events.items()
                for state, _ in own
                if other != channel
            )
    shares = {"named": named / max(faults, 1), "held": held / max(faults, 1)}
    return {"faults": faults, "faulty": faulty, **shares}


def events_of_fault(
    pipeline: Pipeline, block: Block, start: int, channel: int, error: float
) -> dict[int, list[tuple[ChannelState, float]]]:
    """Return the declarations of each accelerometer, and s since an error in one begins."""
    given = block.acceleration
    assert given is not None
    force = given.z.copy()
    force[start:, channel] += error
    output = pipeline.process(
        replace(block, acceleration=Block(block.stamp, force, given.received))
    )
    n = pipeline.geometry.n
    events: dict[int, list[tuple[ChannelState, float]]] = {}
    for one in output.events:
        late = (one.stamp - int(block.stamp[start])) * 1e-9
        if one.declares and one.channel >= n and late >= 0.0:
            events.setdefault(one.channel - n, []).append((one.after, late))
    return events


def figures_of(flown: list[dict[str, Any]]) -> dict[str, Any]:
    """Join the figures of the flights of a row."""
    by = {name: np.array([one[name] for one in flown]) for name in flown[0]}
    return {
        "nees": by["nees"].mean(),
        "worst": by["nees"].max(),
        "rms": np.sqrt((by["rms"] ** 2).mean()),
        "level": by["level"].mean(),
        "ok": by["ok"].mean(),
        "sets": int(by["sets"].sum()),
        "faulty": int(by["faulty"].sum()),
    }


def fly(
    units: int,
    rate: float,
    change: Callable[..., None],
    numbers: list[Any],
    asked: Asked,
    label: str,
    k: int,
) -> dict[str, Any]:
    """Fly once, and compare what is published with the truth."""
    flight = flight_of(units, rate, asked.rng(label, k))
    change(flight, *numbers)
    pipeline = Pipeline(config_of(units, rate, flight.settings, asked))
    stamps = regular_stamps(LENGTH, rate, START)[: len(flight.t)]
    still = flight.rng.standard_normal((len(flight.t), 3 * units))
    gyros = np.tile(flight.turning(flight.t), units) + NOISE * still
    block = Block(stamps, gyros, None, Block(stamps, flight.values()))
    output = fresh(pipeline, block)
    force = output.acceleration
    assert force is not None
    rows = force.valid & (flight.t >= COUNTED)
    error = (force.rate - flight.force)[rows]
    weighed = np.linalg.solve(force.covariance[rows], error[..., np.newaxis])[..., 0]
    return {
        "nees": np.einsum("ki,ki->k", error, weighed).mean() / 3,
        "rms": np.sqrt((error**2).mean()),
        "level": (np.abs(error) > force.level[rows]).any(axis=1).mean(),
        "ok": (force.state[flight.t >= COUNTED] == ChannelState.OK).mean(),
        "sets": sum(one.after == ChannelState.AMBIGUOUS for one in output.events),
        "faulty": sum(
            one.after == ChannelState.FAULTY
            and one.channel - 3 * units not in flight.culprits
            for one in output.events
        ),
    }
