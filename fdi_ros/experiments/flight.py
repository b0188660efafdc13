# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Simulated flights: motion, gyros with real errors, and trials of the whole monitor.

Measurement of channel i at time t, in this order:

    z_i(t) = round(clip(h_i . omega(t + delay_i) + bias_i + walk_i(t) + noise_i(t)))

h_i (3,) is the true axis: the nominal one, turned by the misalignment and lengthened by
the scale factor.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.config.config import Config
from fdi_ros.errors import FdiError, StudyError
from fdi_ros.experiments.montecarlo import (
    Counts,
    Field,
    Figures,
    Preparation,
    Refusals,
    Schema,
    TrialProtocol,
    geometry_of,
)
from fdi_ros.faults.fault import Fault, Injector, create_kind
from fdi_ros.faults.kinds import FAULT_KINDS
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.samples import Array, Block
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.replay.outcomes import OutcomeKind, quantiles, rms, score, share, standing


@dataclass(frozen=True)
class Motion:
    """Body rate as a smooth function of time: holds and smooth steps between knots."""

    #: (K,) knots, s, strictly increasing
    time: Array
    #: (K, 3) body rate at the knots, rad/s. It is constant before the first and after
    #: the last
    rate: Array

    def rate_at(self, t: Array) -> Array:
        """Body rate (N, 3) rad/s at times t (N,) s."""
        k = np.clip(
            np.searchsorted(self.time, t, side="right") - 1, 0, len(self.time) - 2
        )
        u = np.clip((t - self.time[k]) / (self.time[k + 1] - self.time[k]), 0, 1)
        return (
            self.rate[k]
            + (self.rate[k + 1] - self.rate[k]) * (u * u * (3 - 2 * u))[:, None]
        )


def vehicle_motion(
    duration: float,
    rng: np.random.Generator,
    *,
    rest: float = 6.0,
    max_rate: float = 2.0,
    max_acceleration: float = 20.0,
) -> Motion:
    """Draw a motion of a small vehicle: rest, then rests, slow turns and fast manoeuvres.

    The motion ends at rest after about ``duration``, s. The first rest takes ``rest``,
    s. ``max_rate``: largest rate of a component in a fast manoeuvre, rad/s. Slow turns
    reach 0.15 of that rate. ``max_acceleration``: largest angular acceleration of a
    component, rad/s^2.
    """
    times: list[float] = [0.0, rest]
    rates: list[Array] = [np.zeros(3), np.zeros(3)]
    while times[-1] < duration:
        kind = rng.choice(["rest", "turn", "manoeuvre"], p=[0.25, 0.35, 0.4])
        for target, hold in _phase(str(kind), max_rate, rng):
            step = float(np.abs(target - rates[-1]).max())
            slowest = 1.0 if kind == "turn" else 0.1
            # 1.5: the largest slope of 3 u^2 - 2 u^3, at its middle.
            times += [times[-1] + max(slowest, 1.5 * step / max_acceleration)]
            times += [times[-1] + hold]
            rates += [target, target]
    return Motion(np.array(times), np.array(rates))


def _phase(
    kind: str, max_rate: float, rng: np.random.Generator
) -> list[tuple[Array, float]]:
    """Rates with the time to hold each, s, ending at rest."""
    stop = (np.zeros(3), float(rng.uniform(0.2, 0.6)))
    if kind == "rest":
        return [(np.zeros(3), float(rng.uniform(1.0, 3.0)))]
    if kind == "turn":
        # Mostly about the vertical, as vehicles turn.
        heading = rng.uniform(-0.15, 0.15, 3) * max_rate * [0.3, 0.3, 1.0]
        return [(heading, float(rng.uniform(1.0, 3.0))), stop]
    count = int(rng.integers(3, 7))
    swings = [
        (rng.uniform(-max_rate, max_rate, 3), float(rng.uniform(0.02, 0.3)))
        for _ in range(count)
    ]
    return [*swings, stop]


@dataclass(frozen=True)
class GyroErrors:
    """Errors of gyros of one make. The defaults are typical of a small MEMS unit."""

    #: white noise of one sample, rad/s
    noise_std: float = 0.0025
    #: bias at switch-on, rad/s
    bias_std: float = 0.01
    #: random walk of the bias, rad/s per square root of a second
    bias_walk: float = 2e-5
    #: error of the scale factor, dimensionless
    scale_std: float = 0.001
    #: angle of the true axis in each of the two directions across the nominal axis, rad
    misalignment_std: float = 0.001
    #: sampling instant of a chip against the stamp, s
    delay_std: float = 0.0002
    #: step of the converter, rad/s. 0: none
    resolution: float = float(np.radians(1 / 16.4))
    #: range of the converter, rad/s
    max_rate: float = 34.9
    #: number of channels that are sampled together
    channels_per_chip: int = 3

    def draw(self, geometry: Geometry, rng: np.random.Generator) -> Gyros:
        """Make one unit: draw all that stays as it is from switch-on."""
        n = geometry.n
        across = rng.normal(0, self.misalignment_std, (n, 3))
        along = np.sum(across * geometry.axes, axis=1) / np.sum(
            geometry.axes**2, axis=1
        )
        tilted = geometry.axes + across - along[:, None] * geometry.axes
        chip = np.arange(n) // self.channels_per_chip
        return Gyros(
            axes=tilted * (1 + rng.normal(0, self.scale_std, (n, 1))),
            bias=rng.normal(0, self.bias_std, n),
            delay=rng.normal(0, self.delay_std, n)[chip],
            errors=self,
        )


@dataclass(frozen=True)
class Gyros:
    """One made unit: its true axes (n, 3), bias (n,) rad/s and sampling delay (n,) s."""

    #: (n, 3) true axes times true scale factors
    axes: Array
    #: (n,) at switch-on, rad/s
    bias: Array
    #: (n,) of the sampling instant against the stamp, s
    delay: Array
    #: from which the unit was drawn
    errors: GyroErrors

    def measure(
        self, motion: Motion, stamp: NDArray[np.int64], rng: np.random.Generator
    ) -> Block:
        """Sample at increasing stamps (N,), ns. The motion begins at the first one."""
        errors = self.errors
        seconds = (stamp - stamp[0]) * 1e-9
        z: Array = np.empty((len(stamp), len(self.axes)))
        for delay in np.unique(self.delay):
            chip = np.flatnonzero(self.delay == delay)
            z[:, chip] = motion.rate_at(seconds + delay) @ self.axes[chip].T
        step = np.sqrt(np.diff(seconds, prepend=0.0))[:, None]
        walk = np.cumsum(errors.bias_walk * step * rng.standard_normal(z.shape), axis=0)
        z += self.bias + walk + errors.noise_std * rng.standard_normal(z.shape)
        np.clip(z, -errors.max_rate, errors.max_rate, out=z)
        if errors.resolution:
            z = np.round(z / errors.resolution) * errors.resolution
        return Block(stamp, z)


def regular_stamps(
    duration: float, sample_rate: float, start: int = 0
) -> NDArray[np.int64]:
    """Stamps of evenly spaced samples, (N,) ns, from start ns."""
    count = int(np.floor(duration * sample_rate)) + 1
    return start + np.round(np.arange(count) * (1e9 / sample_rate)).astype(np.int64)


# The trials ---------------------------------------------------------------------------

NONE = "none"  # the cell in which every channel stays healthy
DEFAULT_SIZES = {
    name: kind.study_size
    for name, kind in FAULT_KINDS.items()
    if kind.study_size is not None
}
"""Of each kind that needs one, in its own unit."""


class Flown(NamedTuple):
    """One simulated flight."""

    #: samples of all channels
    block: Block
    #: (N, 3) true body rates, rad/s
    truth: Array
    #: the faulty channel. None: all are healthy
    channel: int | None
    #: row at which the fault begins, or would
    onset: int


class Flight(TrialProtocol[str]):
    """Declarations, names, delays and errors of the fused rate, by method and kind of fault.

    Each trial draws a vehicle's motion, the gyros of one unit with all their errors,
    one channel and an onset. Every method flies the same flights. The monitor has the
    settings given by the file, and no knowledge of the rest. A cell is a kind of fault.
    """

    schema: ClassVar[Schema] = {
        "geometry": Field("geometry", "two_triad_cone"),
        "detectors": Field("detectors", "all"),
        "kinds": Field(
            "texts",
            [
                NONE,
                *(name for name, kind in FAULT_KINDS.items() if not kind.whole_unit),
            ],
            choices=(NONE, *FAULT_KINDS),
        ),
        "sizes": Field("mapping", DEFAULT_SIZES),
        "monitor": Field("mapping", {}),
        "duration": Field("float", 8.0, 2.0, 3600.0),
        "rest": Field("float", 2.5, 0.5, 600.0),
        "max_rate": Field("float", 2.0, 0.01, 30.0),
        "trials": Field("int", 30, 1, 1e6),
        "block": Field("int", 5, 1, 1e4),
    }

    def __init__(self, settings: Mapping[str, Any]) -> None:
        super().__init__(settings)
        rest = self.settings["rest"]
        duration = self.settings["duration"]
        if duration < 2 * rest + 1:
            raise StudyError(
                f"flight.duration is {duration:g} s, expected at least 2 flight.rest + 1 s: {2 * rest + 1:g} s"
            )

    def trial_cells(self) -> list[str]:
        """List the kinds of faults."""
        return list(self.settings["kinds"])

    def run(
        self, cell: str, count: int, rng: np.random.Generator, preparation: Preparation
    ) -> Counts:
        """Simulate flights and run the monitor with every method on them."""
        flights = [self._flight(cell, rng) for _ in range(count)]
        running = {
            name: one
            for name, one in self._monitors.items()
            if isinstance(one, Pipeline)
        }
        return {
            "trials": count,
            "methods": {name: _counted(one, flights) for name, one in running.items()},
        }

    def summary(self, cell: str, counts: Counts, preparation: Preparation) -> Figures:
        """Return shares of flights by outcome, delays, and RMS errors of the rate, rad/s."""
        rate = self._config().sample_rate
        methods = {name: _figures(own, rate) for name, own in counts["methods"].items()}
        return {"fault": cell, "trials": counts["trials"], "methods": methods}

    def refusals(self) -> Refusals:
        """Return the methods that do not run on the geometry."""
        refused = {
            name: why for name, why in self._monitors.items() if isinstance(why, str)
        }
        return {str(self.settings["geometry"]): refused}

    @cached_property
    def _geometry(self) -> Geometry:
        return geometry_of(self.settings["geometry"])

    def _config(self, **settings: str) -> Config:
        """Return the settings of the monitor, with others beside those of the study."""
        axes = {
            "geometry.preset": "axes",
            "geometry.axes": self._geometry.axes.ravel().tolist(),
        }
        return Config.from_parameters({**axes, **self.settings["monitor"], **settings})

    def _monitor(self, name: str) -> Pipeline | str:
        """Make the monitor with a method, or say why it does not run."""
        try:
            return Pipeline(self._config(**{"detector.name": name}))
        except FdiError as error:
            return str(error)

    @cached_property
    def _monitors(self) -> dict[str, Pipeline | str]:
        return {name: self._monitor(name) for name in self.settings["detectors"]}

    def _flight(self, kind: str, rng: np.random.Generator) -> Flown:
        """Draw one flight."""
        settings = self.settings
        stamp = regular_stamps(settings["duration"], self._config().sample_rate)
        motion: Motion = vehicle_motion(
            settings["duration"],
            rng,
            rest=settings["rest"],
            max_rate=settings["max_rate"],
        )
        block = GyroErrors().draw(self._geometry, rng).measure(motion, stamp, rng)
        channel = int(rng.integers(self._geometry.n))
        onset = float(rng.uniform(settings["rest"] + 0.5, settings["duration"] / 2))
        seed = int(rng.integers(2**31))
        sign = float(rng.choice([-1.0, 1.0]))
        truth = motion.rate_at((stamp - stamp[0]) * 1e-9)
        if kind == NONE:
            return Flown(
                block,
                truth,
                None,
                int(np.searchsorted(stamp, stamp[0] + round(onset * 1e9))),
            )
        size = settings["sizes"].get(kind, DEFAULT_SIZES.get(kind))
        if size is not None and FAULT_KINDS[kind].has_signed_size():
            size *= sign
        names = self._geometry.channel_names
        injector = Injector(
            [
                Fault(
                    names[channel], create_kind(kind, size=size), start=onset, seed=seed
                )
            ],
            names,
        )
        return Flown(
            injector.apply(block),
            truth,
            channel,
            int(injector.active(stamp)[:, 0].argmax()),
        )


def _counted(monitor: Pipeline, flights: Sequence[Flown]) -> Counts:
    """Run the monitor over flights, and count the outcomes.

    ``right``: the faulty channel is isolated, and no other. ``wrong``: a healthy one is
    isolated. ``ambiguous``: the faulty one is in an ambiguity group, and never
    isolated. ``silent``: neither. ``without_rate``: samples from the onset on
    without a fused rate. ``delays``: flights by samples from the onset to the
    isolation. ``after`` and ``before`` the onset: sum of the squared errors of the
    fused rate, (rad/s)^2, over as many samples.
    """
    outcomes: Counter[OutcomeKind] = Counter()
    delays: Counter[str] = Counter()
    without_rate = 0
    errors: dict[str, list[Array]] = {"before": [], "after": []}
    for flown in flights:
        monitor.restart()
        output = monitor.process(flown.block)
        scored = score(
            *standing(output),
            flown.channel,
            np.arange(len(output), dtype=np.float64) - flown.onset,
        )
        outcomes[scored.outcome] += 1
        if math.isfinite(scored.isolated_after):
            delays[str(int(scored.isolated_after))] += 1
        without_rate += int((~output.valid[flown.onset :]).sum())
        for part, rows in (
            ("before", slice(flown.onset)),
            ("after", slice(flown.onset, None)),
        ):
            error = output.rate[rows] - flown.truth[rows]
            squares = (error**2).sum(axis=1)
            errors[part].append(squares[output.valid[rows]])
    return {
        "trials": len(flights),
        "right": outcomes[OutcomeKind.ISOLATED],
        "wrong": outcomes[OutcomeKind.FALSE_ISOLATION],
        "ambiguous": outcomes[OutcomeKind.AMBIGUOUS],
        "silent": outcomes[OutcomeKind.MISSED] + outcomes[OutcomeKind.FALSE_GROUP],
        "without_rate": without_rate,
        "delays": dict(delays),
        **{
            part: {
                "squares": math.fsum(float(e.sum()) for e in found),
                "count": sum(map(len, found)),
            }
            for part, found in errors.items()
        },
    }


def _figures(counts: Counts, sample_rate: float) -> Figures:
    """Shares of the flights by outcome, and how good the rate is."""
    delays = quantiles(counts["delays"])
    return {
        **{
            name: share(counts[name], counts["trials"])
            for name in ("right", "wrong", "ambiguous", "silent")
        },
        "delay_s": {
            level: None if d is None else d / sample_rate for level, d in delays.items()
        },
        "rms_before": rms(**counts["before"]),
        "rms_after": rms(**counts["after"]),
        "samples_without_rate": counts["without_rate"],
    }
