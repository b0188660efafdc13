# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The flight that the demo plays, with its fault, and how the monitor did on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fdi_ros.arrays import Array
from fdi_ros.bag.reader import Recording
from fdi_ros.bag.samples import Samples
from fdi_ros.config.config import Config
from fdi_ros.faults.fault import Fault, Injector
from fdi_ros.model.block import Block
from fdi_ros.model.geometry import Geometry
from fdi_ros.monitor.build import build_geometry
from fdi_ros.monitor.output import ChannelState
from fdi_ros.ros.demo.screen import rate_error

LEARNING = 3.0
"""The recording is at rest for longer than this, s: its own mean over it is the bias of the rates to compare with."""
NAMED = (ChannelState.FAULTY, ChannelState.STALE)
BAD = (*NAMED, ChannelState.AMBIGUOUS)


@dataclass
class Flight:
    """A recorded flight with a fault in it, and the rates to compare with."""

    geometry: Geometry
    fault: Fault
    block: Block
    """With the fault."""
    truth: Array
    """(N, 3) least-squares rate of all channels of the recording as it is, rad/s."""
    unmonitored: Array
    """(N, 3) least-squares rate of all channels with the fault, rad/s."""

    @classmethod
    def load(cls, bag: Path, config: Config, fault: Fault, seconds: float) -> Flight:
        """Read the first seconds of a recording and put the fault in."""
        geometry = build_geometry(config)
        with Recording(bag) as recording:
            blocks = list(Samples(recording, config, geometry.n, end=seconds).blocks())
        clean = Block(np.concatenate([b.stamp for b in blocks]), np.concatenate([b.z for b in blocks]))
        block = Injector([fault], geometry.channel_names).apply(clean)
        bias = clean.z[clean.stamp - clean.stamp[0] < LEARNING * 1e9].mean(axis=0)
        rates = [(z - bias) @ geometry.least_squares.T for z in (clean.z, block.z)]
        return cls(geometry, fault, block, *rates)

    @property
    def seconds(self) -> Array:
        """(N,) time of each sample from the first, s."""
        return (self.block.stamp - self.block.stamp[0]) * 1e-9


@dataclass
class MonitorLog:
    """What the node published, and when the samples went out to it."""

    rates: dict[int, Array] = field(default_factory=dict)
    """Fused rate by its stamp, ns."""
    changes: list[tuple[float, int, ChannelState]] = field(default_factory=list)
    """When (s, monotonic clock), channel, new state."""
    published: list[float] = field(default_factory=list)
    """When each sample was published, s, monotonic clock."""


def first_time(log: MonitorLog, channel: int, states: Sequence[ChannelState], after: float) -> float | None:
    """Seconds from a time to the first change of a channel into one of the states; None if there is none."""
    return next((t - after for t, c, state in log.changes if c == channel and t >= after and state in states), None)


def summary(flight: Flight, log: MonitorLog) -> tuple[list[str], bool]:
    """Lines that say how it went, and whether the monitor did what it should."""
    names = flight.geometry.channel_names
    struck = flight.fault.channels(names)
    k = int(np.searchsorted(flight.seconds, flight.fault.start))
    begin = log.published[k]
    lines = [f"injected    {flight.fault} (it is not in the recording)"]
    for channel in struck:
        out = first_time(log, channel, (*BAD, ChannelState.SUSPECT), begin)
        declared = first_time(log, channel, NAMED, begin)
        lines.append(
            f"missed      {names[channel]} was not isolated"
            if out is None or declared is None
            else f"isolated    {names[channel]}: left out of the fused rate {out * 1e3:.0f} ms after the first faulty"
            f" message, isolated after {declared * 1e3:.0f} ms"
        )
    # In a set for a moment is not declared: what counts is a name, and the set that is left.
    last = {c: state for _, c, state in log.changes}
    named = {c for _, c, state in log.changes if state == ChannelState.FAULTY}
    others = sorted({names[c] for c in named | {c for c, state in last.items() if state in BAD} if c not in struck})
    lines.append(f"others      {', '.join(others)} declared too" if others else "others      none declared")
    errors = _errors_from(flight, log, k)
    if errors is not None:
        with_, without = map(rate_error, errors)
        lines.append(f"rate error  {with_} RMS with monitoring, {without} without, since the fault")
    found = all(first_time(log, channel, NAMED, begin) is not None for channel in struck)
    return lines, found and not others and errors is not None


def _errors_from(flight: Flight, log: MonitorLog, k: int) -> tuple[float, float] | None:
    """RMS error, rad/s, of the fused rate and of the rate of all channels, from sample k on."""
    stamps = flight.block.stamp.tolist()
    rows = [i for i in range(k, len(stamps)) if stamps[i] in log.rates]
    if not rows:
        return None
    fused = np.array([log.rates[stamps[i]] for i in rows])
    squares = [np.sum((rate - flight.truth[rows]) ** 2, axis=1) for rate in (fused, flight.unmonitored[rows])]
    return float(np.sqrt(np.mean(squares[0]))), float(np.sqrt(np.mean(squares[1])))
