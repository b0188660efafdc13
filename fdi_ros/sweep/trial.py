# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""One recording, one fault at a time, each from the monitor as it stands when the fault begins."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.config.config import Config
from fdi_ros.core.output import ChannelState
from fdi_ros.faults.fault import Fault
from fdi_ros.faults.injection import Injector
from fdi_ros.model.block import Block
from fdi_ros.monitor.diagnostics import degraded
from fdi_ros.monitor.output import Event, Output
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.monitor.status import Status
from fdi_ros.sweep.plan import Plan, Swept
from fdi_ros.sweep.snapshot import Snapshot

Mask = NDArray[np.bool_]
Array = NDArray[np.float64]

PORTION = 16384
"""Samples judged at once of the recording without a fault."""
LEAD = 1000
"""Samples before a fault that kinds with a memory may look back on."""
_DECLARED = (ChannelState.FAULTY, ChannelState.STALE)


@dataclass(frozen=True)
class Sound:
    """What the monitor says of a recording without a fault."""

    samples: int
    duration: float
    """s."""
    begins: float
    """When it first judges, s; NaN: never."""
    judged: float
    """Share of the samples that are judged."""
    declared: tuple[tuple[float, Event], ...]
    """Declarations with their times, s."""
    doubtful: Mask
    """(N,) a channel stands declared, by itself or in a set, or gives nothing."""
    speed: Array
    """(N,) fused rate, rad/s; NaN: none."""
    degraded: tuple[str, ...]
    """What is worse than it should be, beside what is declared."""
    note: str
    """Why nothing was judged, or why checking is limited at the end; empty if neither."""

    def doubted(self, rows: slice) -> bool:
        """Whether something stands declared somewhere in these samples, or right before them."""
        return bool(self.doubtful[max(0, rows.start - 1) : rows.stop].any())

    def speeds(self, rows: slice) -> tuple[float, float]:
        """Median and largest rate in these samples, rad/s; NaN: none."""
        known = self.speed[rows][np.isfinite(self.speed[rows])]
        return (float(np.median(known)), float(known.max())) if len(known) else (np.nan, np.nan)


@dataclass(frozen=True)
class Onset:
    """A time from which faults are injected."""

    at: float
    """s from the first sample."""
    origin: int
    """Stamp of the first sample, ns."""
    snapshot: Snapshot
    """The monitor right before."""
    block: Block
    """Samples from some before the onset to the end of the watch."""
    row: int
    """First sample of these that is faulty."""


class Outcome(NamedTuple):
    """What came of one fault."""

    words: str
    """named, in a set, silent, false set or wrong: see `outcome`."""
    named_after: float
    """Until the channel was declared by itself, s; inf: it was not."""
    found_after: float
    """Until the channel was declared by itself or in a set, s."""


@dataclass(frozen=True)
class Trial:
    """One fault, and what came of it."""

    channel: int
    swept: Swept
    fault: Fault
    outcome: Outcome


def watch_sound(pipeline: Pipeline, block: Block) -> Sound:
    """Replay a recording without a fault."""
    origin = int(block.stamp[0])
    doubtful, speed, judged = [], [], []
    declared: list[tuple[float, Event]] = []
    worse: dict[str, str] = {}
    for first in range(0, len(block), PORTION):
        output = pipeline.process(block[first : first + PORTION])
        alone, among = standing(output)
        doubtful.append((alone | among).any(axis=1))
        speed.append(np.linalg.norm(output.rate, axis=1))
        judged.append(np.isfinite(output.threshold))
        worse |= degraded(pipeline.status())
        declared += [((event.stamp - origin) * 1e-9, event) for event in output.events if event.declares]
    checked = np.concatenate(judged)
    seconds = (block.stamp - origin) * 1e-9
    status = pipeline.status()
    return Sound(
        len(block),
        float(seconds[-1]),
        float(seconds[checked.argmax()]) if checked.any() else np.nan,
        float(checked.mean()),
        tuple(declared),
        np.concatenate(doubtful),
        np.concatenate(speed),
        tuple(worse.values()),
        status.note if checked.any() else _why_nothing(status),
    )


def _why_nothing(status: Status) -> str:
    """Say why none of the samples was judged."""
    if status.note:
        return status.note
    count = f"{status.samples} sample{'' if status.samples == 1 else 's'}"
    if status.bias_state == "learning":
        return f"it ends after {count}, before the biases are learned (bias.startup_bias_duration)"
    if status.bias_state.startswith("refused"):
        return f"biases not learned: {status.bias_state}"
    return f"no sample of {status.samples} has values of enough channels"


def rows_at(block: Block, at: float, watch: float) -> slice:
    """Find the samples from a time on, s from the first, for so long."""
    seconds = (block.stamp - block.stamp[0]) * 1e-9
    return slice(*np.searchsorted(seconds, (at, at + watch)).tolist())


def onsets_of(
    pipeline: Pipeline, block: Block, times: Sequence[float], watch: float, lead: int = LEAD
) -> Iterator[Onset]:
    """Replay a recording without a fault up to each of these times, s in increasing order."""
    done = 0
    for at in times:
        rows = rows_at(block, at, watch)
        for first in range(done, rows.start, PORTION):
            pipeline.process(block[first : min(first + PORTION, rows.start)])
        snapshot = Snapshot.of(pipeline)
        done, first = rows.start, max(0, rows.start - lead)
        yield Onset(at, int(block.stamp[0]), snapshot, block[first : rows.stop], rows.start - first)


def judged_with(pipeline: Pipeline, onset: Onset, fault: Fault) -> Output:
    """Go on from an onset with one fault: what the monitor says of its samples from there on."""
    onset.snapshot.restore(pipeline)
    injected = Injector([fault], pipeline.channel_names, onset.origin).apply(onset.block)
    return pipeline.process(injected[onset.row :])


def standing(output: Output) -> tuple[Mask, Mask]:
    """(N, n) whether a channel stands declared by itself, or silent; and whether it stands in a set."""
    state = output.state
    return np.isin(state, _DECLARED), np.asarray(state == ChannelState.AMBIGUOUS)


def outcome(alone: Mask, among: Mask, channel: int, since: Array, within: float) -> Outcome:
    """Say what came of a fault.

    Parameters
    ----------
    alone, among
        (N, n) as of `standing`, from the start of the fault on.
    channel
        That is faulty.
    since
        (N,) s from the start of the fault.
    within
        A fault is named, or in a set, if it is by then, s.

    Returns
    -------
    wrong: a channel without a fault was declared by itself at any time; named: the faulty one was, in time; in a set:
    it was one of a set; false set: only sets without it were given; silent: nothing was.
    """
    named_after, found_after = _first(alone[:, channel], since), _first((alone | among)[:, channel], since)
    soon = since <= within
    if np.delete(alone, channel, axis=1).any():
        words = "wrong"
    elif named_after <= within:
        words = "named"
    elif among[soon, channel].any():
        words = "in a set"
    else:
        words = "false set" if among[soon].any() else "silent"
    return Outcome(words, named_after, found_after)


def _first(declared: Mask, since: Array) -> float:
    return float(since[declared.argmax()]) if declared.any() else np.inf


def try_faults(config: Config, onset: Onset, channel: int, plan: Plan) -> list[Trial]:
    """Inject every fault into one channel at one time, each for itself."""
    pipeline = monitor_of(config)
    name, stamp = pipeline.channel_names[channel], onset.block.stamp[onset.row :]
    # From the first faulty sample: before it there is nothing to be found.
    since, start = np.asarray((stamp - stamp[0]) * 1e-9), float((stamp[0] - onset.origin) * 1e-9)
    trials = []
    for swept in plan.faults:
        rng = np.random.default_rng([plan.seed, zlib.crc32(f"{name} {swept.family} {onset.at:.6f}".encode())])
        # One sign and one seed for all sizes: then the sizes alone differ.
        fault = swept.fault(name, start, float(rng.choice([-1.0, 1.0])), int(rng.integers(2**31)))
        output = judged_with(pipeline, onset, fault)
        trials.append(Trial(channel, swept, fault, outcome(*standing(output), channel, since, plan.within)))
    return trials


@lru_cache(maxsize=2)
def monitor_of(config: Config) -> Pipeline:
    """Monitor of a config: built once in each process."""
    return Pipeline.from_config(config)


def lead_of(faults: Sequence[Swept]) -> int:
    """Count the samples before an onset that the faults may look back on."""
    return max([LEAD, *(int(one.size or 0) + 1 for one in faults if one.kind == "delay")])
