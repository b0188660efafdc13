"""Trials of a short flight each, through the whole monitor: what is declared, when, and how good the rate stays."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from fdi_ros.config.config import Config
from fdi_ros.core.output import ChannelState
from fdi_ros.errors import FdiError, StudyError
from fdi_ros.experiments.experiment import FIRST, Cell, Experiment, Found
from fdi_ros.experiments.simulate import GyroErrors, Motion, regular_stamps, vehicle_motion
from fdi_ros.experiments.study_file import Field, Schema, geometry_of
from fdi_ros.experiments.tally import Tally, quantiles, share
from fdi_ros.faults.fault import Fault, create_kind
from fdi_ros.faults.injection import Injector
from fdi_ros.faults.kinds import KINDS
from fdi_ros.model.block import Block
from fdi_ros.model.geometry import Geometry
from fdi_ros.monitor.output import Output
from fdi_ros.monitor.pipeline import Pipeline

Array = NDArray[np.float64]

NONE = "none"
"""The cell in which every channel stays sound."""
SINGLE_CHANNEL = tuple(name for name, kind in KINDS.items() if not kind.whole_unit)
"""Kinds that strike one channel."""
DEFAULT_SIZES = {name: kind.study_size for name, kind in KINDS.items() if kind.study_size is not None}
"""Of each kind that needs one, in its own unit."""


class Flight(Experiment):
    """Kind of fault by method: declared, named rightly, delay, and error of the fused rate, false declarations.

    Each trial draws a vehicle's motion, the gyros of one unit with all their errors, one channel and an onset; every
    method flies the same flights. The monitor has the settings given by the file, and no knowledge of the rest.
    """

    kind = "flight"
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

    def cells(self, stage: int) -> list[Cell]:
        """List the cells: a kind of fault each; nothing has to be found first."""
        return [] if stage == FIRST else [{"fault": kind} for kind in self.settings["kinds"]]

    def trials(self, stage: int, cell: Cell) -> tuple[int, int]:
        """Return the trials of a cell and of a block: as set."""
        return self.settings["trials"], self.settings["block"]

    def run(self, stage: int, cell: Cell, count: int, rng: np.random.Generator, found: Found) -> Tally:
        """Fly, and let the monitor with every method watch."""
        flights = [self._flight(cell["fault"], rng) for _ in range(count)]
        monitors = self._monitors[0]
        methods = {name: [_outcome(monitor, *flight) for flight in flights] for name, monitor in monitors.items()}
        return {"trials": count, "methods": {name: _counted(outcomes) for name, outcomes in methods.items()}}

    def conclude(self, cells: Sequence[Cell], tallies: Sequence[Tally]) -> Found:
        """Return nothing: each method keeps the threshold that the monitor gives it."""
        return {}

    def summary(self, cell: Cell, tally: Tally, found: Found) -> dict[str, Any]:
        """Return shares of flights by outcome, delays, and root mean square errors of the fused rate, rad/s."""
        rate = Config.from_parameters(self._parameters).sample_rate
        methods = {name: _figures(counts, rate) for name, counts in tally["methods"].items()}
        return {"fault": cell["fault"], "trials": tally["trials"], "methods": methods}

    def refusals(self) -> dict[str, Any]:
        """Say which methods do not run on the geometry."""
        return {str(self.settings["geometry"]): self._monitors[1]}

    @property
    def _parameters(self) -> dict[str, Any]:
        axes = self._geometry.axes.ravel().tolist()
        return {"geometry.preset": "axes", "geometry.axes": axes, **self.settings["monitor"]}

    @cached_property
    def _geometry(self) -> Geometry:
        return geometry_of(self.settings["geometry"])

    @cached_property
    def _monitors(self) -> tuple[dict[str, Pipeline], dict[str, str]]:
        """One monitor a method, and why the others do not run."""
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

    def _flight(self, kind: str, rng: np.random.Generator) -> tuple[Block, Array, int | None, int]:
        """Return samples, true rates (N, 3) rad/s, the faulty channel if any, and the row at which the fault begins."""
        settings = self.settings
        sample_rate = Config.from_parameters(self._parameters).sample_rate
        stamp = regular_stamps(settings["duration"], sample_rate)
        motion: Motion = vehicle_motion(settings["duration"], rng, rest=settings["rest"], max_rate=settings["max_rate"])
        block = GyroErrors().draw(self._geometry, rng).measure(motion, stamp, rng)
        channel = int(rng.integers(self._geometry.n))
        onset = float(rng.uniform(settings["rest"] + 0.5, settings["duration"] / 2))
        seed, sign = int(rng.integers(2**31)), float(rng.choice([-1.0, 1.0]))
        truth = motion.rate_at((stamp - stamp[0]) * 1e-9)
        names = self._geometry.channel_names
        if kind == NONE:
            return block, truth, None, int(np.searchsorted(stamp, stamp[0] + round(onset * 1e9)))
        size = settings["sizes"].get(kind, DEFAULT_SIZES.get(kind))
        if size is not None and KINDS[kind].has_signed_size():
            size *= sign
        struck = names[channel]
        injector = Injector([Fault(struck, create_kind(kind, size=size), start=onset, seed=seed)], names)
        faulty = injector.apply(block)
        return faulty, truth, channel, int(injector.active(stamp)[:, 0].argmax())


def _outcome(monitor: Pipeline, block: Block, truth: Array, channel: int | None, onset: int) -> dict[str, Any]:
    """Watch one flight and say what came of it."""
    monitor.restart()
    output = monitor.process(block)
    named = (output.state == ChannelState.FAULTY) | (output.state == ChannelState.STALE)
    ever = named.any(axis=0)
    delay = None
    if channel is not None and ever[channel]:
        delay = int(named[:, channel].argmax()) - onset
    ambiguous = (output.state == ChannelState.AMBIGUOUS).any(axis=0)
    wrong = ever.copy()
    if channel is not None:
        wrong[channel] = False
    return {
        "delay": delay,
        "wrong": bool(wrong.any()),
        "ambiguous": channel is not None and bool(ambiguous[channel]) and not ever[channel],
        **_errors(output, truth, onset),
    }


def _errors(output: Output, truth: Array, onset: int) -> dict[str, Any]:
    """Squared error of the fused rate from the onset on, and before it once the bias is known."""
    error = ((output.rate - truth) ** 2).sum(axis=1)
    valid = output.valid
    after, before = np.flatnonzero(valid[onset:]) + onset, np.flatnonzero(valid[:onset])
    return {
        "after": (float(error[after].sum()), len(after)),
        "before": (float(error[before].sum()), len(before)),
        "without_rate": int((~valid[onset:]).sum()),
    }


def _counted(outcomes: Sequence[dict[str, Any]]) -> Tally:
    delays: dict[str, int] = {}
    for outcome in outcomes:
        if outcome["delay"] is not None:
            delays[str(outcome["delay"])] = delays.get(str(outcome["delay"]), 0) + 1
    sums = {
        name: [math.fsum(o[name][0] for o in outcomes), sum(o[name][1] for o in outcomes)]
        for name in ("after", "before")
    }
    return {
        "trials": len(outcomes),
        "right": sum(o["delay"] is not None and not o["wrong"] for o in outcomes),
        "wrong": sum(o["wrong"] for o in outcomes),
        "ambiguous": sum(o["ambiguous"] for o in outcomes),
        "silent": sum(o["delay"] is None and not o["wrong"] and not o["ambiguous"] for o in outcomes),
        "without_rate": sum(o["without_rate"] for o in outcomes),
        "delays": delays,
        **sums,
    }


def _figures(counts: Tally, rate: float) -> dict[str, Any]:
    trials = counts["trials"]
    delays = {level: None if d is None else d / rate for level, d in quantiles(counts["delays"]).items()}
    shares = {name: share(counts[name], trials) for name in ("right", "wrong", "ambiguous", "silent")}
    rms = {
        f"rms_{name}": math.sqrt(counts[name][0] / counts[name][1]) if counts[name][1] else None
        for name in ("before", "after")
    }
    return {**shares, "delay_s": delays, **rms, "samples_without_rate": counts["without_rate"]}
