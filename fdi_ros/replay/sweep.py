# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Injects faults of several kinds and sizes into every channel of a recording, one at a time.

The recording is replayed once without faults. Each fault continues from the state of the monitor at
its onset. So hundreds of faults take seconds, they do not affect each other, and the result equals a
full replay bit by bit.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.config.config import Config
from fdi_ros.detectors.base import Detector
from fdi_ros.errors import BagError, FaultError, FdiError
from fdi_ros.faults.fault import Fault, Injector, fault_from, key_values
from fdi_ros.faults.kinds import FAULT_KINDS
from fdi_ros.model.samples import Array, Block, Mask
from fdi_ros.monitor.accelerometers import felt_units
from fdi_ros.monitor.building import build_geometry
from fdi_ros.monitor.output import Output
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.replay.episodes import pieces
from fdi_ros.replay.outcomes import (
    DECLARED_STATES,
    StateChange,
    TrialOutcome,
    score,
    standing,
)
from fdi_ros.replay.run import Judge, Kept, Walk
from fdi_ros.replay.summary import Judgement
from fdi_ros.system.jobs import run_jobs

DEFAULT_FAULTS = (
    "kind=bias size=0.005,0.01,0.02,0.05,0.1,0.2,0.5",
    "kind=drift size=0.005,0.01,0.02,0.05",
    "kind=noise size=0.05,0.2",
    "kind=scale size=0.05,0.2",
    "kind=stuck",
    "kind=dropout",
)
"""Default faults of gyros. Sizes are in rad/s, in rad/s^2, or a share of the rate."""
FORCE_FAULTS = (
    "channel=accelerometers kind=bias size=0.1,0.3,1,3,10",
    "channel=accelerometers kind=drift size=0.03,0.1,0.3",
    "channel=accelerometers kind=noise size=1,5",
    "channel=accelerometers kind=scale size=0.05,0.2",
    "channel=accelerometers kind=stuck",
    "channel=accelerometers kind=dropout",
)
"""Default faults of accelerometers. Sizes are in m/s^2, in m/s^3, or a share of the specific force."""
GYROS, FORCES = "gyros", "accelerometers"
FORCE_UNITS = {"rad/s": "m/s^2", "rad/s^2": "m/s^3"}
"""Units of sizes in accelerometers, by those in gyros."""


@dataclass(frozen=True)
class Swept:
    """One kind of fault with one size."""

    #: name in `FAULT_KINDS`, such as ``bias``
    kind: str
    items: tuple[tuple[str, str], ...]
    """Its numbers by name, as the user wrote them."""
    channels: str = GYROS
    """Channels that are struck: `GYROS` or `FORCES`."""

    @property
    def size(self) -> float | None:
        """Size of the fault. None: the kind has no size."""
        return next(
            (float(value) for name, value in self.items if name == "size"), None
        )

    @property
    def unit(self) -> str:
        """Unit of the size."""
        option = FAULT_KINDS[self.kind].options().get("size")
        unit = option.unit if option else ""
        return FORCE_UNITS.get(unit, unit) if self.channels == FORCES else unit

    @property
    def family(self) -> str:
        """Name that the fault shares with other sizes."""
        options = (f"{name}={value}" for name, value in self.items if name != "size")
        return " ".join([self.called, *options])

    @property
    def called(self) -> str:
        """Its kind, with the channels where these are accelerometers."""
        return self.kind if self.channels == GYROS else f"accelerometer {self.kind}"

    @property
    def words(self) -> str:
        """Title: kind, size with unit, other numbers."""
        size = "" if self.size is None else f" {self.size:g} {self.unit}".rstrip()
        return f"{self.called}{size}{self.family.removeprefix(self.called)}"

    def fault(self, channel: str, start: float, sign: float, seed: int) -> Fault:
        """Return the fault on a channel from a time on, s, with a sign if the kind allows one."""
        items: dict[str, object] = {
            "channel": channel,
            "kind": self.kind,
            "start": start,
            "seed": seed,
        }
        items |= dict(self.items)
        if self.size is not None and FAULT_KINDS[self.kind].has_signed_size():
            items["size"] = sign * self.size
        return fault_from(items)


def parse_swept(text: str) -> tuple[Swept, ...]:
    """Read the faults of a sweep: ``kind=bias size=0.05,0.1,0.3`` gives one entry per size.

    ``channel=accelerometers`` strikes these instead of the gyros, with sizes in m/s^2.
    `FaultError` if the form is wrong, or a number does not fit its kind.
    """
    items = key_values(text)
    channels = items.pop("channel", GYROS)
    if channels not in (GYROS, FORCES):
        raise FaultError(
            f"fault {text!r}: channel is {channels!r}, expected {GYROS} or {FORCES}: a sweep strikes each of them"
        )
    if chosen := [name for name in items if name in ("start", "stop", "seed")]:
        raise FaultError(f"fault {text!r}: {chosen[0]} is chosen by the sweep")
    kind = items.pop("kind", "")
    if kind in FAULT_KINDS and FAULT_KINDS[kind].whole_unit:
        raise FaultError(
            f"fault {kind} strikes a whole unit; a sweep strikes one channel at a time"
        )
    sizes = items.pop("size", "").split(",")
    options = {
        size: {"size": size, **items} if size else items
        for size in dict.fromkeys(sizes)
    }
    found = tuple(Swept(kind, tuple(own.items()), channels) for own in options.values())
    for one in found:
        fault_from({"channel": "any", "kind": kind, **dict(one.items)})
        if (
            one.size is not None
            and one.size < 0
            and FAULT_KINDS[kind].has_signed_size()
        ):
            raise FaultError(
                f"fault {kind}: size is {one.size:g}, expected more than 0: signs are drawn"
            )
    return tuple(sorted(found, key=lambda one: one.size or 0.0))


@dataclass(frozen=True)
class Plan:
    """Faults, start times and detection time of a sweep."""

    #: kinds and sizes to be tried
    faults: tuple[Swept, ...]
    times: int = 10
    """Number of start times per channel, spread over the recording."""
    within: float = 5.0
    """Time in which a fault must be found, s."""
    seed: int = 1
    """Seed of the signs and of random faults."""


# The recording without faults


@dataclass(frozen=True)
class Baseline:
    """Result for a recording without injected faults."""

    #: as of any replay
    judgement: Judgement
    judged: float
    """Share of judged samples."""
    #: (N,) a channel stands declared, by itself or in a set, or gives nothing
    doubtful: Mask
    speed: Array
    """(N,) norm of the fused rate, rad/s. NaN: no rate."""
    begins: float
    """Time of the first judged sample, s. NaN: never."""
    duration: float
    """Time from the first sample to the last, s."""

    @property
    def declared(self) -> list[StateChange]:
        """Declarations, in the order of time."""
        return [event for event in self.judgement.scores.events if event.declares]

    @property
    def note(self) -> str:
        """Why no sample was judged, or why checking is limited at the end. Empty: neither."""
        monitor = self.judgement.monitor
        samples = self.judgement.scores.samples
        if monitor.note or self.judged:
            return monitor.note
        if monitor.bias.state == "learning":
            count = f"{samples} sample{'' if samples == 1 else 's'}"
            return f"it ends after {count}, before the biases are learned (bias.startup_bias_duration)"
        if monitor.bias.state.startswith("refused"):
            return f"biases not learned: {monitor.bias.state}"
        return f"no sample of {samples} has values of enough channels"


def watch_baseline(pipeline: Pipeline, block: Block, start: float = 0.0) -> Baseline:
    """Judge a recording without faults. `BagError` if it has no sample.

    ``start``: time of the first sample, s; times in the judgement count from its origin.
    """
    if not len(block):
        raise BagError(
            "its topics have no time in common: there is no sample of all channels"
        )

    def what_counts(output: Output) -> tuple[Mask, Mask, Array]:
        doubtful = np.asarray(np.isin(output.state, DECLARED_STATES).any(axis=1))
        return (
            np.isfinite(output.threshold),
            doubtful,
            np.asarray(np.linalg.norm(output.rate, axis=1)),
        )

    kept = Kept(what_counts)
    origin = int(block.stamp[0]) - round(start * 1e9)
    judge = Judge(pipeline, Injector((), pipeline.channel_names, origin), [kept])
    judge.take(block)
    judged, doubtful, speed = kept.columns
    seconds = _seconds(block)
    begins = float(seconds[judged.argmax()]) if judged.any() else np.nan
    return Baseline(
        judge.judgement(),
        float(judged.mean()),
        doubtful,
        speed,
        begins,
        float(seconds[-1]),
    )


def _seconds(block: Block) -> Array:
    """Return the times (N,) of the samples, s from the first sample."""
    return np.asarray((block.stamp - block.stamp[0]) * 1e-9)


def _rows_at(block: Block, at: float, watch: float) -> slice:
    """Return the samples from a time on, s from the first sample, for ``watch`` s."""
    ends = np.searchsorted(_seconds(block), (at, at + watch))
    return slice(*ends.tolist())


# One fault, from the state of the monitor at its onset


LEAD = 1000
"""Samples before a fault that kinds with a memory can use."""


@dataclass(frozen=True)
class Onset:
    """A start time of faults, with the memory of the monitor before it."""

    at: float
    """Start time, s from the first sample."""
    origin: int
    """Stamp of the first sample, ns."""
    cores: list[NDArray[Any]]
    """Bytes of `fdi_ros.core.records.Core` of the gyros, and of the accelerometers if any."""
    states: list[dict[int, NDArray[Any]]]
    """Bytes of the memory of each detector, by the bits of the set of channels, of both halves."""
    felt: tuple[int, ...]
    """Units whose accelerometers are judged."""
    block: Block
    """Samples from shortly before the onset to the end of the detection time."""
    row: int
    """Row of the first faulty sample."""


@dataclass(frozen=True)
class Trial:
    """One fault with its result."""

    #: number of the faulty channel
    channel: int
    #: kind and size of the fault
    swept: Swept
    #: as injected
    fault: Fault
    #: what the monitor made of it
    scored: TrialOutcome


def onsets_of(
    pipeline: Pipeline,
    block: Block,
    times: Sequence[float],
    watch: float,
    lead: int = LEAD,
) -> Iterator[Onset]:
    """Replay a recording without faults up to each time, s. Times increase and lie in no gap."""
    walk = Walk(pipeline)
    done = 0
    for at in times:
        rows = _rows_at(block, at, watch)
        walk.take(block[done : rows.start])
        done = rows.start
        first = max(0, rows.start - lead)
        cores = [_bytes_of(half.core).copy() for half in pipeline.halves]
        states = [_memory_of(detector) for detector in _detectors(pipeline)]
        part = block[first : rows.stop]
        row = rows.start - first
        yield Onset(at, int(block.stamp[0]), cores, states, pipeline.felt, part, row)


def _detectors(pipeline: Pipeline) -> list[Detector]:
    """Return the detectors of both halves."""
    return [detector for half in pipeline.halves for detector in half.detectors]


def _bytes_of(rows: NDArray[Any]) -> NDArray[np.uint8]:
    """Return the bytes of records (N,) as they lie, (N, size), to be read and written.

    NumPy copies and clears the fields of records singly, which takes many times as long.
    """
    return rows.view(np.ndarray).view(np.uint8).reshape(len(rows), -1)


def _memory_of(detector: Detector) -> dict[int, NDArray[Any]]:
    """Return the memory of a detector by the bits of the set of channels."""
    rows = detector.bank["row"][0]
    memory = _bytes_of(detector.states)
    masks = np.flatnonzero(rows >= 0)
    return {int(mask): memory[rows[mask]].copy() for mask in masks}


def judged_with(pipeline: Pipeline, onset: Onset, fault: Fault) -> Output:
    """Continue from an onset with one fault. Return the output from there on.

    The monitor must have the same settings. Its own memory is overwritten.
    """
    pipeline.sense(onset.felt)
    for detector, states in zip(_detectors(pipeline), onset.states, strict=True):
        memory = _bytes_of(detector.states)
        # Sets that were used later only are reset.
        memory[: int(detector.bank["rows"][0])] = 0
        for mask, state in states.items():
            detector.prepare(mask)
            memory[int(detector.bank["row"][0, mask])] = state
    for half, core in zip(pipeline.halves, onset.cores, strict=True):
        _bytes_of(half.core)[:] = core
    injected = Injector([fault], pipeline.channel_names, onset.origin).apply(
        onset.block
    )
    return pipeline.process(injected[onset.row :])


def try_faults(config: Config, onset: Onset, channel: int, plan: Plan) -> list[Trial]:
    """Inject each fault separately into one channel at one time."""
    pipeline = monitor_of(config)
    pipeline.sense(onset.felt)
    name = pipeline.channel_names[channel]
    stamp = onset.block.stamp[onset.row :]
    # Times count from the first faulty sample.
    since = np.asarray((stamp - stamp[0]) * 1e-9)
    start = float((stamp[0] - onset.origin) * 1e-9)
    trials = []
    struck = FORCES if channel >= pipeline.geometry.n else GYROS
    for swept in plan.faults:
        if swept.channels != struck:
            continue
        rng = np.random.default_rng(
            [plan.seed, zlib.crc32(f"{name} {swept.family} {onset.at:.6f}".encode())]
        )
        # All sizes share sign and seed, so that only the size differs.
        sign = float(rng.choice([-1.0, 1.0]))
        fault = swept.fault(name, start, sign, int(rng.integers(2**31)))
        output = judged_with(pipeline, onset, fault)
        trials.append(
            Trial(
                channel,
                swept,
                fault,
                score(*standing(output), channel, since, plan.within),
            )
        )
    return trials


@lru_cache(maxsize=2)
def monitor_of(config: Config) -> Pipeline:
    """Return the monitor of a config, which is built once in each process."""
    return Pipeline(config)


# All faults with all monitors


@dataclass
class Subject:
    """A monitor with its aligned samples. `sweep` adds the results."""

    #: of the monitor in the report
    name: str
    #: settings of the monitor
    config: Config
    #: its samples, aligned
    block: Block
    #: names of all channels. Those excluded are tried with no fault
    channels: tuple[str, ...] = ()
    gyros: int = 0
    """Number of the channels that are gyros, the first ones."""
    felt: tuple[int, ...] = ()
    """Units whose accelerometers are judged."""
    baseline: Baseline | None = None
    """Result without faults. None: the monitor does not run."""
    start: float = 0.0
    """Time of the first sample, s from the first message of the recording."""
    refused: str = ""
    """Why the monitor does not run or judges nothing. Empty: it does."""
    times: tuple[float, ...] = ()
    """Start times of the faults, s."""
    skipped: tuple[float, ...] = ()
    """Times without faults, because a channel was already declared or silent, s."""
    #: largest fused rate while the faults of each time are watched, rad/s. 0: none
    speeds: tuple[float, ...] = ()
    #: one for each injected fault
    trials: tuple[Trial, ...] = ()

    @property
    def used(self) -> tuple[int, ...]:
        """Indices of the channels with injected faults."""
        return tuple(
            i
            for i, name in enumerate(self.channels)
            if name not in self.config.excluded_channels
        )

    def struck(self, swept: Swept) -> tuple[int, ...]:
        """Channels that a fault is tried on."""
        forces = swept.channels == FORCES
        return tuple(i for i in self.used if (i >= self.gyros) == forces)


def sweep(
    subjects: Sequence[Subject],
    plan: Plan,
    workers: int = 1,
    progress: Callable[[float], None] | None = None,
) -> Sequence[Subject]:
    """Try every fault of the plan with every monitor, at the same times.

    All monitors must have the same channels. ``workers``: number of processes. ``progress`` is called
    with the share done. `FdiError` if no monitor judges the recording for long enough.
    """
    for one in subjects:
        _watch(one)
    baselines = [
        (one, one.baseline)
        for one in subjects
        if one.baseline is not None and not one.refused
    ]
    if not baselines:
        raise FaultError(f"no fault can be tried: {subjects[0].refused}")
    if not any(one.struck(swept) for one, _ in baselines for swept in plan.faults):
        raise FaultError(
            "no fault can be tried: all are of accelerometers, and none are judged in this recording"
        )
    block = baselines[0][0].block
    times = _times([baseline for _, baseline in baselines], block, plan)
    lead = max(
        [
            LEAD,
            *(
                int(fault.size or 0) + 1
                for fault in plan.faults
                if fault.kind == "delay"
            ),
        ]
    )
    owned: list[tuple[Subject, tuple[Config, Onset, int, Plan]]] = []
    for one, baseline in baselines:
        _take_times(one, baseline, times, plan.within)
        pipeline = monitor_of(one.config)
        pipeline.sense(one.felt)
        pipeline.restart()
        onsets = onsets_of(pipeline, one.block, one.times, plan.within, lead)
        owned += [
            (one, (one.config, onset, channel, plan))
            for onset in onsets
            for channel in one.used
            if any(channel in one.struck(swept) for swept in plan.faults)
        ]
    found: dict[int, list[Trial]] = {}
    for done, (k, trials) in enumerate(
        run_jobs(try_faults, [job for _, job in owned], workers, None), 1
    ):
        found[k] = trials
        if progress is not None:
            progress(done / len(owned))
    for k, (owner, _) in enumerate(owned):
        owner.trials += tuple(found[k])
    return subjects


def _watch(one: Subject) -> None:
    """Judge the recording without faults, or store why this is not possible."""
    try:
        one.channels = build_geometry(one.config).channel_names
        one.gyros = len(one.channels)
        pipeline = monitor_of(one.config)
        pipeline.restart()
        if one.config.has_units and one.config.accelerometers.enabled == "auto":
            # The monitor may have been built for another recording.
            pipeline.sense(felt_units(one.block))
        one.block = pipeline.arranged(one.block)
        one.felt = pipeline.felt
        one.channels = pipeline.channel_names
        one.baseline = watch_baseline(pipeline, one.block, one.start)
        one.refused = (
            ""
            if one.baseline.judged
            else f"it judges nothing of this recording: {one.baseline.note}"
        )
    except FdiError as error:
        one.refused = str(error)


def _times(baselines: Sequence[Baseline], block: Block, plan: Plan) -> list[float]:
    """Spread start times, s, evenly over the part that all monitors judge, outside of gaps.

    `FaultError` if this part is too short for a fault.
    """
    begins = max(one.begins for one in baselines)
    end = min(one.duration for one in baselines)
    seconds = _seconds(block)
    spans = (
        (float(seconds[rows.start]), float(seconds[rows.stop - 1]))
        for rows in pieces(block.stamp)
    )
    inside = [(max(low, begins), min(high, end)) for low, high in spans]
    windows = [(low, high - plan.within) for low, high in inside]
    windows = [(low, high) for low, high in windows if high > low]
    if not windows:
        gaps = (
            ", in no piece of it without a gap long enough"
            if end - begins > plan.within
            else ": too short"
        )
        raise FaultError(
            f"the recording is judged from {begins:.1f} s to {end:.1f} s{gaps} to watch a fault for"
            f" {plan.within:g} s (within)"
        )
    low, high = np.array(windows).T
    # The judged parts count as one continuous time.
    ends = np.cumsum(high - low)
    after = ends[-1] * (np.arange(plan.times) + 0.5) / plan.times
    place = np.searchsorted(ends, after)
    before = ends - (high - low)
    return np.asarray(low[place] + (after - before[place])).tolist()


def _take_times(
    one: Subject, baseline: Baseline, times: Sequence[float], within: float
) -> None:
    """Keep the times without a declaration and without missing samples."""
    for at in times:
        rows = _rows_at(one.block, at, within)
        doubted = baseline.doubtful[max(0, rows.start - 1) : rows.stop].any()
        if doubted or len(pieces(one.block.stamp[rows])) != 1:
            one.skipped += (at,)
        else:
            one.times += (at,)
            one.speeds += (float(np.nan_to_num(baseline.speed[rows]).max()),)
