# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Trials of a short flight each, through the whole monitor: what is declared, when, and how good the rate stays."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np

from fdi_ros.arrays import Array
from fdi_ros.config.config import Config
from fdi_ros.errors import FdiError, StudyError
from fdi_ros.experiments.protocol import PreparationTally, Refusals, TrialProtocol
from fdi_ros.experiments.simulate import GyroErrors, Motion, regular_stamps, vehicle_motion
from fdi_ros.experiments.study_file import Field, Schema, geometry_of
from fdi_ros.faults.fault import Fault, create_kind
from fdi_ros.faults.injection import Injector
from fdi_ros.faults.kinds import KINDS
from fdi_ros.model.block import Block
from fdi_ros.model.geometry import Geometry
from fdi_ros.monitor.output import Output
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.scoring import Estimate, Outcome, Tally, quantiles, score, share, standing

NONE = "none"
"""The cell in which every channel stays healthy."""
DEFAULT_SIZES = {name: kind.study_size for name, kind in KINDS.items() if kind.study_size is not None}
"""Of each kind that needs one, in its own unit."""


class Cell(NamedTuple):
    """Flights with one kind of fault, or none."""

    fault: str


@dataclass(frozen=True)
class Preparation:
    """Nothing: each method keeps the threshold that the monitor gives it."""


@dataclass(frozen=True)
class SquaredError(Tally):
    """Sum of the squared errors of the fused rate, (rad/s)^2, over so many samples."""

    total: float
    samples: int

    @property
    def rms(self) -> float | None:
        """Root mean square error, rad/s; None: no samples."""
        return math.sqrt(self.total / self.samples) if self.samples else None


@dataclass(frozen=True)
class FlightCounts(Tally):
    """What one method made of flights."""

    trials: int
    right: int
    """The faulty channel is isolated, and no other."""
    wrong: int
    """A healthy channel is declared by itself."""
    ambiguous: int
    """The faulty channel is one of an ambiguity group, and never declared by itself."""
    silent: int
    """None of these."""
    without_rate: int
    """Samples from the onset on without a fused rate."""
    delays: dict[int, int]
    """Flights by delay to the declaration, in samples."""
    after: SquaredError
    """From the onset on."""
    before: SquaredError


@dataclass(frozen=True)
class FlightTally(Tally):
    """Counts by method."""

    trials: int
    methods: dict[str, FlightCounts]


@dataclass(frozen=True)
class FlightFigures:
    """Shares of the flights by outcome, and how good the rate is."""

    right: Estimate
    wrong: Estimate
    ambiguous: Estimate
    silent: Estimate
    delay_s: dict[str, float | None]
    """Quantiles."""
    rms_before: float | None
    """Root mean square error of the fused rate, rad/s."""
    rms_after: float | None
    samples_without_rate: int

    @classmethod
    def of(cls, counts: FlightCounts, sample_rate: float) -> FlightFigures:
        """Make shares of counts."""
        delays = {level: None if d is None else d / sample_rate for level, d in quantiles(counts.delays).items()}
        right, wrong, ambiguous, silent = (
            share(count, counts.trials) for count in (counts.right, counts.wrong, counts.ambiguous, counts.silent)
        )
        rms = counts.before.rms, counts.after.rms
        return cls(right, wrong, ambiguous, silent, delays, *rms, counts.without_rate)


@dataclass(frozen=True)
class FlightResult:
    """Figures of one cell."""

    fault: str
    trials: int
    methods: dict[str, FlightFigures]


class Flown(NamedTuple):
    """One simulated flight."""

    block: Block
    truth: Array
    """True body rates, (N, 3) rad/s."""
    channel: int | None
    """The faulty one; None: all are healthy."""
    onset: int
    """Row at which the fault begins, or would."""


class FlownOutcome(NamedTuple):
    """What one method made of one flight."""

    outcome: Outcome
    delay: int | None
    """Samples from the onset to the declaration of the faulty channel by itself; None: it is not declared."""
    without_rate: int
    after: SquaredError
    before: SquaredError


class Flight(TrialProtocol[Cell, Preparation, FlightTally, FlightResult]):
    """Kind of fault by method: declared, named rightly, delay, and error of the fused rate, false declarations.

    Each trial draws a vehicle's motion, the gyros of one unit with all their errors, one channel and an onset; every
    method flies the same flights. The monitor has the settings given by the file, and no knowledge of the rest.
    """

    kind = "flight"
    preparation_type = Preparation
    tally_type = FlightTally
    schema: ClassVar[Schema] = {
        "geometry": Field("geometry", "two_triad_cone"),
        "detectors": Field("detectors", "all"),
        "kinds": Field(
            "texts", [NONE, *(name for name, kind in KINDS.items() if not kind.whole_unit)], choices=(NONE, *KINDS)
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
        rest, duration = self.settings["rest"], self.settings["duration"]
        if duration < 2 * rest + 1:
            raise StudyError(
                f"flight.duration is {duration:g} s, expected at least 2 flight.rest + 1 s: {2 * rest + 1:g} s"
            )

    def trial_cells(self) -> list[Cell]:
        """List the kinds of faults."""
        return [Cell(kind) for kind in self.settings["kinds"]]

    def trials(self, cell: Cell) -> tuple[int, int]:
        """Return the trials of a cell and of a block: as set."""
        return self.settings["trials"], self.settings["block"]

    def conclude(self, cells: Sequence[Cell], tallies: Sequence[PreparationTally]) -> Preparation:
        """Return nothing: there is no first stage."""
        return Preparation()

    def run(self, cell: Cell, count: int, rng: np.random.Generator, preparation: Preparation) -> FlightTally:
        """Simulate flights and run the monitor with every method on them."""
        flights = [self._flight(cell.fault, rng) for _ in range(count)]
        methods = {name: [_outcome(one, flown) for flown in flights] for name, one in self._monitors[0].items()}
        return FlightTally(count, {name: _counted(outcomes) for name, outcomes in methods.items()})

    def summary(self, cell: Cell, tally: FlightTally, preparation: Preparation) -> FlightResult:
        """Return shares of flights by outcome, delays, and root mean square errors of the fused rate, rad/s."""
        rate = self._config.sample_rate
        methods = {name: FlightFigures.of(counts, rate) for name, counts in tally.methods.items()}
        return FlightResult(cell.fault, tally.trials, methods)

    def refusals(self) -> Refusals:
        """Return the methods that do not run on the geometry."""
        return {str(self.settings["geometry"]): self._monitors[1]}

    @property
    def _parameters(self) -> dict[str, Any]:
        axes = self._geometry.axes.ravel().tolist()
        return {"geometry.preset": "axes", "geometry.axes": axes, **self.settings["monitor"]}

    @cached_property
    def _geometry(self) -> Geometry:
        return geometry_of(self.settings["geometry"])

    @property
    def _config(self) -> Config:
        return Config.from_parameters(self._parameters)

    @cached_property
    def _monitors(self) -> tuple[dict[str, Pipeline], dict[str, str]]:
        """One monitor per method, and why the others do not run."""
        monitors, refused = {}, {}
        for name in self.settings["detectors"]:
            monitor = self._monitor(name)
            if isinstance(monitor, Pipeline):
                monitors[name] = monitor
            else:
                refused[name] = monitor
        return monitors, refused

    def _monitor(self, name: str) -> Pipeline | str:
        try:
            return Pipeline(Config.from_parameters({**self._parameters, "detector.name": name}))
        except FdiError as error:
            return str(error)

    def _flight(self, kind: str, rng: np.random.Generator) -> Flown:
        """Draw one flight."""
        settings = self.settings
        stamp = regular_stamps(settings["duration"], self._config.sample_rate)
        motion: Motion = vehicle_motion(settings["duration"], rng, rest=settings["rest"], max_rate=settings["max_rate"])
        block = GyroErrors().draw(self._geometry, rng).measure(motion, stamp, rng)
        channel = int(rng.integers(self._geometry.n))
        onset = float(rng.uniform(settings["rest"] + 0.5, settings["duration"] / 2))
        seed, sign = int(rng.integers(2**31)), float(rng.choice([-1.0, 1.0]))
        truth = motion.rate_at((stamp - stamp[0]) * 1e-9)
        if kind == NONE:
            return Flown(block, truth, None, int(np.searchsorted(stamp, stamp[0] + round(onset * 1e9))))
        size = settings["sizes"].get(kind, DEFAULT_SIZES.get(kind))
        if size is not None and KINDS[kind].has_signed_size():
            size *= sign
        names = self._geometry.channel_names
        injector = Injector([Fault(names[channel], create_kind(kind, size=size), start=onset, seed=seed)], names)
        return Flown(injector.apply(block), truth, channel, int(injector.active(stamp)[:, 0].argmax()))


def _outcome(monitor: Pipeline, flown: Flown) -> FlownOutcome:
    """Run the monitor over one flight."""
    monitor.restart()
    output, channel = monitor.process(flown.block), flown.channel
    samples = np.arange(len(output), dtype=np.float64) - flown.onset
    scored = score(*standing(output), channel, samples)
    return FlownOutcome(
        outcome=scored.outcome,
        delay=int(scored.isolated_after) if math.isfinite(scored.isolated_after) else None,
        without_rate=int((~output.valid[flown.onset :]).sum()),
        after=_squared_error(output, flown.truth, slice(flown.onset, None)),
        before=_squared_error(output, flown.truth, slice(flown.onset)),
    )


def _squared_error(output: Output, truth: Array, rows: slice) -> SquaredError:
    """Squared error of the fused rate in some samples, where there is one."""
    error = ((output.rate[rows] - truth[rows]) ** 2).sum(axis=1)[output.valid[rows]]
    return SquaredError(float(error.sum()), len(error))


def _counted(outcomes: Sequence[FlownOutcome]) -> FlightCounts:
    came_to = Counter(o.outcome for o in outcomes)
    return FlightCounts(
        trials=len(outcomes),
        right=came_to[Outcome.ISOLATED],
        wrong=came_to[Outcome.FALSE_ISOLATION],
        ambiguous=came_to[Outcome.AMBIGUOUS],
        silent=came_to[Outcome.MISSED] + came_to[Outcome.FALSE_GROUP],
        without_rate=sum(o.without_rate for o in outcomes),
        delays=dict(Counter(o.delay for o in outcomes if o.delay is not None)),
        after=_total([o.after for o in outcomes]),
        before=_total([o.before for o in outcomes]),
    )


def _total(errors: Sequence[SquaredError]) -> SquaredError:
    """Sum of the flights of one block, exactly rounded."""
    return SquaredError(math.fsum(one.total for one in errors), sum(one.samples for one in errors))
