# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Trials of a short flight each, through the whole monitor: what is declared, when, and how good the rate stays."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np

from fdi_ros.config.config import Config
from fdi_ros.errors import FdiError, StudyError
from fdi_ros.experiments.simulate import GyroErrors, Motion, regular_stamps, vehicle_motion
from fdi_ros.experiments.study import Counts, Field, Figures, Preparation, Refusals, Schema, TrialProtocol, geometry_of
from fdi_ros.faults.fault import Fault, Injector, create_kind
from fdi_ros.faults.kinds import FAULT_KINDS
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.samples import Array, Block
from fdi_ros.monitor.output import Output
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.replay.outcomes import OutcomeKind, quantiles, score, share, standing

NONE = "none"  # the cell in which every channel stays healthy
DEFAULT_SIZES = {name: kind.study_size for name, kind in FAULT_KINDS.items() if kind.study_size is not None}
"""Of each kind that needs one, in its own unit."""


class Flown(NamedTuple):
    """One simulated flight."""

    block: Block
    truth: Array  # true body rates, (N, 3) rad/s
    channel: int | None  # the faulty one; None: all are healthy.
    onset: int  # row at which the fault begins, or would


class Flight(TrialProtocol[str]):
    """Kind of fault by method: declared, named rightly, delay, and error of the fused rate, false declarations.

    Each trial draws a vehicle's motion, the gyros of one unit with all their errors, one channel and an onset; every
    method flies the same flights. The monitor has the settings given by the file, and no knowledge of the rest. A cell
    is a kind of fault.
    """

    kind = "flight"
    schema: ClassVar[Schema] = {
        "geometry": Field("geometry", "two_triad_cone"),
        "detectors": Field("detectors", "all"),
        "kinds": Field(
            "texts",
            [NONE, *(name for name, kind in FAULT_KINDS.items() if not kind.whole_unit)],
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
        rest, duration = self.settings["rest"], self.settings["duration"]
        if duration < 2 * rest + 1:
            raise StudyError(
                f"flight.duration is {duration:g} s, expected at least 2 flight.rest + 1 s: {2 * rest + 1:g} s"
            )

    def trial_cells(self) -> list[str]:
        """List the kinds of faults."""
        return list(self.settings["kinds"])

    def trials(self, cell: str) -> tuple[int, int]:
        """Return the trials of a cell and of a block: as set."""
        return self.settings["trials"], self.settings["block"]

    def run(self, cell: str, count: int, rng: np.random.Generator, preparation: Preparation) -> Counts:
        """Simulate flights and run the monitor with every method on them."""
        flights = [self._flight(cell, rng) for _ in range(count)]
        return {"trials": count, "methods": {name: _counted(one, flights) for name, one in self._monitors[0].items()}}

    def summary(self, cell: str, counts: Counts, preparation: Preparation) -> Figures:
        """Return shares of flights by outcome, delays, and root mean square errors of the fused rate, rad/s."""
        rate = self._config.sample_rate
        methods = {name: _figures(own, rate) for name, own in counts["methods"].items()}
        return {"fault": cell, "trials": counts["trials"], "methods": methods}

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
        built = {name: self._monitor(name) for name in self.settings["detectors"]}
        monitors = {name: monitor for name, monitor in built.items() if isinstance(monitor, Pipeline)}
        return monitors, {name: why for name, why in built.items() if isinstance(why, str)}

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
        if size is not None and FAULT_KINDS[kind].has_signed_size():
            size *= sign
        names = self._geometry.channel_names
        injector = Injector([Fault(names[channel], create_kind(kind, size=size), start=onset, seed=seed)], names)
        return Flown(injector.apply(block), truth, channel, int(injector.active(stamp)[:, 0].argmax()))


def _counted(monitor: Pipeline, flights: Sequence[Flown]) -> Counts:
    """Run the monitor over flights, and count what came of them.

    ``right``: the faulty channel is isolated, and no other; ``wrong``: a healthy one is; ``ambiguous``: the faulty one
    is in an ambiguity group, and never isolated; ``silent``: none of these. ``without_rate``: samples from the onset on
    without a fused rate. ``delays``: flights by samples from the onset to the isolation. ``after`` and ``before`` the
    onset: sum of the squared errors of the fused rate, (rad/s)^2, over so many samples.
    """
    outcomes: Counter[OutcomeKind] = Counter()
    delays: Counter[str] = Counter()
    without_rate, after, before = 0, [], []
    for flown in flights:
        monitor.restart()
        output = monitor.process(flown.block)
        scored = score(*standing(output), flown.channel, np.arange(len(output), dtype=np.float64) - flown.onset)
        outcomes[scored.outcome] += 1
        if math.isfinite(scored.isolated_after):
            delays[str(int(scored.isolated_after))] += 1
        without_rate += int((~output.valid[flown.onset :]).sum())
        after.append(_squared_error(output, flown.truth, slice(flown.onset, None)))
        before.append(_squared_error(output, flown.truth, slice(flown.onset)))
    return {
        "trials": len(flights),
        "right": outcomes[OutcomeKind.ISOLATED],
        "wrong": outcomes[OutcomeKind.FALSE_ISOLATION],
        "ambiguous": outcomes[OutcomeKind.AMBIGUOUS],
        "silent": outcomes[OutcomeKind.MISSED] + outcomes[OutcomeKind.FALSE_GROUP],
        "without_rate": without_rate,
        "delays": dict(delays),
        "after": _total(after),
        "before": _total(before),
    }


def _squared_error(output: Output, truth: Array, rows: slice) -> tuple[float, int]:
    """Sum of the squared errors of the fused rate in some samples, and how many of them have one."""
    error = ((output.rate[rows] - truth[rows]) ** 2).sum(axis=1)[output.valid[rows]]
    return float(error.sum()), len(error)


def _total(errors: Sequence[tuple[float, int]]) -> Counts:
    """Sum of the flights of one block, exactly rounded."""
    return {"total": math.fsum(total for total, _ in errors), "samples": sum(samples for _, samples in errors)}


def _figures(counts: Counts, sample_rate: float) -> Figures:
    """Shares of the flights by outcome, and how good the rate is."""
    delays = quantiles(counts["delays"])
    return {
        **{name: share(counts[name], counts["trials"]) for name in ("right", "wrong", "ambiguous", "silent")},
        "delay_s": {level: None if d is None else d / sample_rate for level, d in delays.items()},
        "rms_before": _rms(**counts["before"]),
        "rms_after": _rms(**counts["after"]),
        "samples_without_rate": counts["without_rate"],
    }


def _rms(total: float, samples: int) -> float | None:
    """Root mean square error, rad/s; None: no samples."""
    return math.sqrt(total / samples) if samples else None
