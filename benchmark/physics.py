# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Real physics: is a healthy gyro named, is the rate true, and how soon is a fault named all the same.

A flight rests for 11 s, turns at up to 1 rad/s (steps, yaw, hover) and rests again. Gyros have scale errors of 0.3 %,
misalignments of 0.2 deg, biases of 10 mrad/s and white noise of 3 mrad/s. Each condition adds its physics. Conditions
of healthy gyros are flown without a fault, and with a bias of 0.02, 0.1 and 0.3 rad/s on one channel from 60 % of the
flight on. Mountings: cone (two triads turned against each other), 2, 3 and 4 parallel units. --only takes a part, as
"3 units, 100 Hz" or "thermal".

flights: flown; wrong: flights in which a healthy channel is FAULTY; sets: share of time in which a healthy channel
stands in a set, flights without a fault; nees: e' P^-1 e / 3 of the fused rate from 15 s on, mean, and worst flight;
level: share of samples beyond the protection level; no_rate: share of samples without a rate.
t_002, t_01, t_03: s from the onset of the fault until its channel stands alone (with two parallel units: with its
twin), median. missed: flights with a fault that is not named.

Conditions with a faulty unit; an axis is affected if its error ever reaches ten standard deviations of the noise:
touched: s from the onset to the first sample in which all declared channels are of that unit, also if it is one axis
for one sample (with two units: all affected axes), median. unit: s from the onset until the unit stands, median. It
stands if for a second without a break all affected axes are declared (FAULTY or in a set) and no channel of another
unit is; with two units a channel of the other one may be in the set. in_2_s: flights in which it stands within 2 s of
the time at which the last of the affected axes has shown its error. held: share of the time from then on in which the
unit is declared like that, mean; 0 where it never stands. episodes, most: episodes that a replay tells from the onset
on, mean and largest number.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import vibration
from trials import CONFIGS, NOISE, START, Array, Asked, Rng, Row, first, fresh
from vibration import BIAS, COUNTED, MISALIGNMENT, SCALE

from fdi_ros import Block, Config, Pipeline
from fdi_ros.experiments.flight import regular_stamps
from fdi_ros.monitor.output import ChannelState, Output
from fdi_ros.replay.episodes import Story
from fdi_ros.replay.recorder import Recorder

MOUNTINGS = ("cone", "2 units", "3 units", "4 units")
RATES = (100.0, 50.0, 400.0)  # samples a second
SIZES = {"t_002": 0.02, "t_01": 0.1, "t_03": 0.3}  # of faults, rad/s
ONSET = 0.6  # of a fault, share of the flight
GRAVITY = 9.81  # m/s^2
SHOWN = 10 * NOISE  # error of an axis that is affected, rad/s
STANDS, SOON = (
    1.0,
    2.0,
)  # s without a break until a unit stands, and after which it is late
FIGURES = {
    "flights": "d",
    "wrong": "d",
    "sets": ".1%",
    "nees": ".2f",
    "worst": ".2f",
    "level": ".2%",
    "no_rate": ".1%",
    **dict.fromkeys(SIZES, ".2f"),
    "missed": "d",
    "touched": ".2f",
    "unit": ".2f",
    "in_2_s": "d",
    "held": ".0%",
    "episodes": ".1f",
    "most": "d",
}


@dataclass
class Flight(vibration.Flight):
    """A flight with physics beyond vibration; a condition changes it in place."""

    culprits: tuple[int, ...] = ()  # faulty channels
    onset: float = 0.0  # of their fault, s
    steps: list[Callable[[Array], Array]] = field(default_factory=list)
    """What the electronics make of the values (N, n), in turn."""
    lost: Array = field(default_factory=lambda: np.empty(0))  # channels silent (n,)
    off: Array = field(default_factory=lambda: np.empty(0))
    """By how much a faulty unit is off (N, n), rad/s; known with the values."""

    def __post_init__(self) -> None:
        self.lost = np.zeros(len(self.axes), bool)
        self.off = np.zeros((len(self.t), len(self.axes)))

    @property
    def length(self) -> float:
        """Duration, s."""
        return float(self.t[-1])

    def values(self) -> Array:
        """Return what the gyros show, (N, n) rad/s."""
        z = super().values()
        for step in self.steps:
            z = step(z)
        return z

    def along(self) -> Array:
        """Rate along each axis, (N, n) rad/s."""
        return self.motion(self.t) @ self.axes.T

    def a_unit(self) -> slice:
        """Draw the unit that fails."""
        unit = int(self.rng.integers(self.units))
        self.culprits = tuple(range(3 * unit, 3 * unit + 3))
        self.onset = 0.4 * self.length
        return slice(3 * unit, 3 * unit + 3)


def flight_of(config: Config, nominal: Array, length: float, rng: Rng) -> Flight:
    """Draw gyros and their motion."""
    n = len(nominal)
    across = rng.normal(0, MISALIGNMENT, (n, 3))
    across -= (across * nominal).sum(axis=1)[:, None] * nominal
    t = np.arange(round(length * config.sample_rate)) / config.sample_rate
    return Flight(
        rng,
        config.sample_rate,
        t,
        vibration.manoeuvres(rng, length),
        (nominal + across) * (1 + rng.normal(0, SCALE, (n, 1))),
        np.zeros((len(t), n // 3)),
        rng.normal(0, BIAS, n) + NOISE * rng.standard_normal((len(t), n)),
        np.full(n, NOISE),
    )


# Healthy gyros --------------------------------------------------------------------------------------------------------


def plain(flight: Flight) -> None:
    """Nothing beyond the errors of every flight."""


def asymmetric(flight: Flight, share: float) -> None:
    """Scale factors of positive and negative rates differ by a share."""
    side = flight.rng.choice([-1.0, 1.0], len(flight.axes))
    flight.noise += 0.5 * share * side * np.abs(flight.along())


def bent(flight: Flight, share: float, order: int) -> None:
    """Nonlinearity, a share of the rate at the largest rate of the flight."""
    along = flight.along()
    size = share * flight.rng.uniform(-1.0, 1.0, len(flight.axes))
    flight.noise += size * along * (np.abs(along) / np.abs(along).max()) ** (order - 1)


def faster(flight: Flight, times: float) -> None:
    """Turn so many times as fast."""
    before = flight.motion
    flight.motion = lambda t: times * before(t)


def asymmetric_fast(flight: Flight, share: float) -> None:
    """Asymmetry, in turns of up to 3 rad/s."""
    faster(flight, 3.0)
    asymmetric(flight, share)


def bent_fast(flight: Flight, share: float, order: int) -> None:
    """Nonlinearity, in turns of up to 3 rad/s."""
    faster(flight, 3.0)
    bent(flight, share, order)


def thermal_shock(flight: Flight, size: float) -> None:
    """Biases of one unit after another move by `size` within 5 to 60 s each."""
    n = len(flight.axes)
    starts = flight.rng.permutation(flight.units) * 0.15 * flight.length + 15.0
    for unit, start in enumerate(starts):
        lasts = flight.rng.uniform(5.0, 60.0)
        done = np.clip((flight.t - start) / lasts, 0.0, 1.0)[:, None]
        by = size * flight.rng.choice([-1.0, 1.0], 3) * flight.rng.uniform(0.5, 1.0, 3)
        flight.noise[:, 3 * unit : min(3 * unit + 3, n)] += done * by


def flicker(flight: Flight, size: float) -> None:
    """Noise of 1 / f with a bias instability of `size` rad/s, from 1 / length on."""
    count = len(flight.t)
    hertz = np.fft.rfftfreq(count, 1.0 / flight.rate)
    shape = np.sqrt(size**2 / (2 * np.pi * np.maximum(hertz, hertz[1])))
    shape[0] = 0.0
    for i in range(len(flight.axes)):
        white = flight.rng.standard_normal(count) * np.sqrt(flight.rate / 2)
        flight.noise[:, i] += np.fft.irfft(np.fft.rfft(white) * shape, count)


def lands_early(flight: Flight, size: float) -> None:
    """Flicker, and a long rest after landing at 40 % of the flight."""
    before, at = flight.motion, 0.4 * flight.length
    flight.motion = lambda t: before(t) * np.clip(at - t, 0.0, 1.0)[:, None]
    flicker(flight, size)


def rocket(flight: Flight, sensitivity: float, spin: float) -> None:
    """Boost of 10 g from 14 to 19 s with a spin; biases go with the acceleration, rad/s a g."""
    before, boost = flight.motion, (14.0, 19.0)

    def motion(t: Array) -> Array:
        begun = np.clip((t - boost[0]) / 1.0, 0.0, 1.0)
        ends = np.clip((flight.length - 8.0 - t) / 3.0, 0.0, 1.0)
        around = np.column_stack([0.0 * t, 0.0 * t, spin * begun * ends])
        return before(t) + around

    flight.motion = motion
    pushed = (np.clip((flight.t - boost[0]) / 0.2, 0.0, 1.0)) * np.clip(
        (boost[1] - flight.t) / 0.5, 0.0, 1.0
    )
    each = sensitivity * flight.rng.standard_normal(len(flight.axes))
    flight.noise += 10.0 * pushed[:, None] * each
    vibration.tones(flight, 0.05, 37.0)


def saturated(flight: Flight) -> None:
    """Spin beyond the range of all gyros (2000 deg/s chips) for a second."""
    before, middle = flight.motion, 0.4 * flight.length

    def motion(t: Array) -> Array:
        spin = 45.0 * np.clip(2.0 - np.abs(t - middle), 0.0, 1.0)
        return before(t) + np.column_stack([0.0 * t, 0.0 * t, spin])

    flight.motion = motion
    end = np.radians(32767 / 16.4)
    flight.steps.append(lambda z: np.clip(z, -end, end))


def one_unit(flight: Flight) -> None:
    """Give values of one unit alone."""
    keeps = int(flight.rng.integers(flight.units))
    flight.lost[:] = True
    flight.lost[3 * keeps : 3 * keeps + 3] = False

    def alone(z: Array) -> Array:
        z[:, flight.lost] = np.nan
        return z

    flight.steps.append(alone)


def unit_lost(flight: Flight, lines: float) -> None:
    """Lose a unit at rest, at 8 s."""
    own = flight.a_unit()
    flight.culprits = ()
    flight.lost[own] = True

    def silent(z: Array) -> Array:
        z[flight.t >= 8.0, own] = np.nan
        return z

    flight.steps.append(silent)
    if lines:
        vibration.tones(flight, lines, 43.0)


# Faults ---------------------------------------------------------------------------------------------------------------


def quiet(flight: Flight, kind: str) -> None:
    """Quiet gyros in steps of 1 mrad/s stay at rest beside one that fails."""
    flight.motion = lambda t: np.zeros((len(t), 3))
    mean = flight.noise.mean(axis=0)
    flight.noise = mean + 0.1 * (flight.noise - mean)
    channel = int(flight.rng.integers(len(flight.axes)))
    flight.culprits, flight.onset = (channel,), 0.5 * flight.length
    since = np.maximum(flight.t - flight.onset, 0.0)
    size = flight.rng.choice([-1.0, 1.0]) * flight.rng.choice([0.02, 0.1, 0.3, 1.0])
    added = {
        "bias": size * (since > 0),
        "ramp": 0.2 * size * since,
        "noise": size * flight.rng.standard_normal(len(since)) * (since > 0),
        "pulses": size * ((since > 0) & (since % 3.0 < 1.5)),
    }[kind]
    flight.noise[:, channel] += added
    flight.steps.append(lambda z: np.round(z, 3))


def unit_turned(flight: Flight, matrix: Any) -> None:
    """Pass the rates of a unit through a matrix (3, 3) from 40 % of the flight on."""
    own, matrix = flight.a_unit(), np.array(matrix, dtype=float)

    def turned(z: Array) -> Array:
        after = flight.t >= flight.onset
        wrong = z[after, own] @ matrix.T
        flight.off[after, own] = wrong - z[after, own]
        z[after, own] = wrong
        return z

    flight.steps.append(turned)


def unit_gain(flight: Flight, gain: float) -> None:
    """Set the wrong range in a unit."""
    unit_turned(flight, gain * np.eye(3))


def unit_offset(flight: Flight) -> None:
    """Add a constant offset to all axes of a unit."""
    own = flight.a_unit()
    offset = np.array([0.5, -0.3, 0.2])
    flight.off[:, own] = (flight.t >= flight.onset)[:, None] * offset
    flight.noise += flight.off


def unit_loose(flight: Flight, hertz: float, size: float) -> None:
    """Loosen a unit in its mounting: it oscillates about an axis of its own."""
    own = flight.a_unit()
    axis = flight.rng.standard_normal(3)
    axis /= np.linalg.norm(axis)
    since = np.maximum(flight.t - flight.onset, 0.0)
    swing = size * np.sin(2 * np.pi * hertz * since)[:, None] * axis
    flight.off[:, own] = swing @ flight.axes[own].T
    flight.noise += flight.off


SWAPPED = ((0, 1, 0), (1, 0, 0), (0, 0, 1))
MIRRORED = ((1, 0, 0), (0, -1, 0), (0, 0, 1))
TURNED = ((0, -1, 0), (1, 0, 0), (0, 0, 1))
ARDUPILOT = {
    "noise.noise_std": (0.003,),
    "bias.startup_bias_duration": 0.0,
    "health.stuck_time": 0.5,
    "health.stuck_time_at_rest": 0.0,
}


class Condition(NamedTuple):
    """What happens in a flight."""

    change: Callable[..., None]
    numbers: tuple[Any, ...] = ()
    length: float = 60.0  # s
    settings: Mapping[str, Any] = MappingProxyType({})
    judged: int = 2  # units at least, for a channel to be checked
    biased: bool = True  # Also flown with a bias on one channel.


CONDITIONS: dict[str, Condition] = {
    "plain": Condition(plain),
    "asymmetry 0.5 %": Condition(asymmetric, (0.005,)),
    "asymmetry 0.5 %, fast": Condition(asymmetric_fast, (0.005,)),
    "nonlinearity 1 %, even": Condition(bent, (0.01, 2)),
    "nonlinearity 1 %, odd": Condition(bent, (0.01, 3)),
    "nonlinearity 1 %, even, fast": Condition(bent_fast, (0.01, 2)),
    "nonlinearity 1 %, odd, fast": Condition(bent_fast, (0.01, 3)),
    "thermal shock 6 mrad/s": Condition(thermal_shock, (0.006,), 120.0),
    "flicker 100 deg/h": Condition(flicker, (np.radians(100.0) / 3600,), 120.0),
    "flicker 100 deg/h, landed": Condition(
        lands_early, (np.radians(100.0) / 3600,), 180.0
    ),
    "rectified 5 mrad/s": Condition(vibration.rectified, (0.005,)),
    "warming 20 mrad/s": Condition(vibration.warming, (0.02,), 90.0),
    "own tones 0.1 43 Hz": Condition(vibration.tones, (0.1, 43.0)),
    "body 0.1 43 Hz": Condition(vibration.body, (0.1, 43.0)),
    "rocket, no spin": Condition(rocket, (0.002, 0.0), 90.0),
    "rocket, 10 rad/s": Condition(rocket, (0.002, 10.0), 90.0),
    "all saturated": Condition(saturated),
    "one unit ever": Condition(one_unit, biased=False),
    "unit lost at rest": Condition(unit_lost, (0.0,), judged=3),
    "unit lost at rest, tones 0.05": Condition(unit_lost, (0.05,), judged=3),
    **{
        f"quiet, fails by {kind}": Condition(
            quiet, (kind,), 40.0, ARDUPILOT, biased=False
        )
        for kind in ("bias", "ramp", "noise", "pulses")
    },
    **{
        f"unit x{gain}": Condition(unit_gain, (gain,), biased=False)
        for gain in (0.5, 2.0, 8.0)
    },
    "unit swapped": Condition(unit_turned, (SWAPPED,), biased=False),
    "unit mirrored": Condition(unit_turned, (MIRRORED,), biased=False),
    "unit turned": Condition(unit_turned, (TURNED,), biased=False),
    "unit offset": Condition(unit_offset, biased=False),
    **{
        f"unit loose {hertz} Hz": Condition(unit_loose, (hertz, 0.4), biased=False)
        for hertz in (2.0, 6.3, 20.0)
    },
}


def config_of(
    mounting: str, rate: float, settings: Mapping[str, Any], asked: Asked
) -> Config:
    """Build the settings of a mounting at a rate."""
    changes: dict[str, Any] = {
        "sample_rate": rate,
        "noise.noise_std": (NOISE,),
        "noise.scale_std": (0.01,),
        "noise.timing_std": (0.0003,),
    }
    if mounting != "cone":
        names = tuple(f"imu_{u + 1}" for u in range(int(mounting[0])))
        changes["imus.topics"] = tuple(f"{name}/data_raw" for name in names)
        changes["imus.names"] = names
        changes["imus.mounts"] = ()
    return Config.from_file(
        CONFIGS / "two_imus.yaml", {**changes, **settings, **asked.settings}
    )


class Flown(NamedTuple):
    """Figures of one flight."""

    wrong: bool
    sets: float
    nees: float
    level: float
    no_rate: float
    named: float  # s until the fault of a channel is named
    whole: Whole | None  # of a faulty unit


class Whole(NamedTuple):
    """Figures of a unit that is wrong as a whole."""

    touched: float  # s until nothing but channels of the unit is declared
    unit: float  # s until the unit stands
    soon: bool  # within SOON of the time from which all affected axes have shown their error
    held: float
    episodes: int


def measure(asked: Asked) -> Iterator[Row]:
    """Every condition with every mounting and rate."""
    monitors: dict[tuple[Any, ...], Pipeline] = {}
    for rate in RATES:
        for mounting in MOUNTINGS:
            for name, condition in CONDITIONS.items():
                label = f"{mounting}, {rate:.0f} Hz, {name}"
                if not asked.wants(label):
                    continue
                key = (mounting, rate, tuple(condition.settings))
                if key not in monitors:
                    monitors[key] = Pipeline.from_config(
                        config_of(mounting, rate, condition.settings, asked)
                    )
                yield label, figures_of(asked, monitors[key], label, mounting, name)


def figures_of(
    asked: Asked, pipeline: Pipeline, label: str, mounting: str, name: str
) -> dict[str, Any]:
    """Fly a row."""
    count = asked.count(2)
    condition = CONDITIONS[name]
    healthy = [
        fly(pipeline, mounting, name, 0.0, asked.rng(label, k)) for k in range(count)
    ]
    flights = list(healthy)
    nees = [one.nees for one in healthy if np.isfinite(one.nees)]
    figures: dict[str, Any] = {
        "sets": np.mean([one.sets for one in healthy]),
        "nees": np.mean(nees) if nees else np.nan,
        "worst": max(nees, default=np.nan),
        "level": np.mean([one.level for one in healthy]),
        "no_rate": np.mean([one.no_rate for one in healthy]),
    }
    if whole := [one.whole for one in healthy if one.whole is not None]:
        told = [one.episodes for one in whole]
        figures |= {
            "touched": np.median([one.touched for one in whole]),
            "unit": np.median([one.unit for one in whole]),
            "in_2_s": sum(one.soon for one in whole),
            "held": np.mean([one.held for one in whole]),
            "episodes": np.mean(told),
            "most": max(told),
        }
    biased = condition.biased and pipeline.geometry.n // 3 >= condition.judged
    named = np.array([one.named for one in healthy if not biased])
    for column, size in SIZES.items() if biased else ():
        failing = [
            fly(pipeline, mounting, name, size, asked.rng(label, column, k))
            for k in range(count)
        ]
        flights += failing
        times = np.array([one.named for one in failing])
        figures[column] = np.median(times)
        named = np.append(named, times)
    figures["flights"] = len(flights)
    figures["wrong"] = sum(one.wrong for one in flights)
    figures["missed"] = int(np.isinf(named).sum())
    return figures


def fly(pipeline: Pipeline, mounting: str, name: str, size: float, rng: Rng) -> Flown:
    """Fly once in a condition, with a bias of `size` on one channel from ONSET on."""
    condition = CONDITIONS[name]
    axes = pipeline.geometry.axes
    flight = flight_of(pipeline.config, axes, condition.length, rng)
    condition.change(flight, *condition.numbers)
    if size:
        channel = int(rng.choice(np.flatnonzero(~flight.lost)))
        flight.culprits, flight.onset = (channel,), ONSET * condition.length
        flight.noise[:, channel] += (
            rng.choice([-1.0, 1.0]) * size * (flight.t >= flight.onset)
        )
    stamps = regular_stamps(condition.length, flight.rate, START)[: len(flight.t)]
    output = fresh(pipeline, Block(stamps, flight.values()))
    recorder = Recorder(pipeline.geometry, pipeline.noise)
    recorder.add(flight.t, output)
    return judged(flight, output, mounting, recorder.story())


def judged(flight: Flight, output: Output, mounting: str, story: Story) -> Flown:
    """Compare what was said with what happened."""
    truth = flight.truth_at((output.instant - START) * 1e-9)
    counted = flight.t >= COUNTED
    rows = output.valid & counted
    error, covariance = (output.rate - truth)[rows], output.covariance[rows]
    weighed = np.linalg.solve(covariance, error[..., None])[..., 0]
    nees = np.einsum("ki,ki->k", error, weighed).mean() / 3 if rows.any() else np.nan
    # Silent channels are declared too, and rightly.
    faulty = (output.state == ChannelState.FAULTY) & ~flight.lost
    among = (output.state == ChannelState.AMBIGUOUS) & ~flight.lost
    declared = faulty | among
    guilty = np.zeros(faulty.shape, bool)
    guilty[:, list(flight.culprits)] = (flight.t >= flight.onset)[:, None]
    after = flight.t >= flight.onset
    named, whole = np.nan, None
    if len(flight.culprits) == 1:
        twins = mounting != "cone" and (~flight.lost).sum() == 6
        own = (declared if twins else faulty)[:, flight.culprits[0]]
        alone = declared.sum(axis=1) <= (2 if twins else 1)
        named = first((own & alone)[after]) / flight.rate
    elif flight.culprits:
        whole = whole_of(flight, faulty, declared, story)
    return Flown(
        wrong=bool((faulty & ~guilty).any()),
        sets=float((among & ~guilty).any(axis=1).mean()),
        nees=float(nees),
        level=float((np.abs(error) > output.level[rows]).any(axis=1).mean())
        if rows.any()
        else 0.0,
        no_rate=float(1.0 - rows.sum() / counted.sum()),
        named=float(named),
        whole=whole,
    )


def whole_of(flight: Flight, faulty: Array, declared: Array, story: Story) -> Whole:
    """Return how a faulty unit is told; channels (N, n) FAULTY, and declared: FAULTY or in a set."""
    after = flight.t >= flight.onset
    off = np.abs(flight.off[after]) >= SHOWN
    affected = off.any(axis=0)
    all_declared = declared[after][:, affected].all(axis=1)
    others = np.ones(len(affected), bool)
    others[list(flight.culprits)] = False
    # Of two units nobody can say which is wrong, so that the other one may be in the set.
    blamed = (faulty if flight.units == 2 else declared)[after]
    others_blamed = blamed[:, others].any(axis=1)
    complete = all_declared & ~others_blamed
    inside = complete if flight.units == 2 else declared[after].any(axis=1)
    lasting = np.lib.stride_tricks.sliding_window_view(
        complete, round(STANDS * flight.rate)
    ).all(axis=1)
    unit = first(lasting)
    has_shown = np.logical_or.accumulate(off, axis=0)[:, affected].all(axis=1)
    held = complete[int(unit) :].mean() if np.isfinite(unit) else 0.0
    return Whole(
        touched=first(inside & ~others_blamed) / flight.rate,
        unit=unit / flight.rate,
        soon=unit <= first(has_shown) + SOON * flight.rate,
        held=float(held),
        episodes=sum(one.start_s >= flight.onset for one in story.declared),
    )
