# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Orders that failover would have given in a recorded flight, had the vehicle been armed."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.mavlink.failover.controller import OVERSAMPLING
from fdi_ros.mavlink.failover.evidence import SILENCE, Evidence
from fdi_ros.mavlink.failover.policy import (
    PolicySettings,
    PolicyState,
    View,
    decide,
)
from fdi_ros.mavlink.failover.raw import LARGE_DIFFERENCE
from fdi_ros.mavlink.failover.ready import INS_USE
from fdi_ros.mavlink.failover.records import DOUBTS
from fdi_ros.mavlink.failover.words import imu_name
from fdi_ros.mavlink.protocol import NS
from fdi_ros.model.samples import Block
from fdi_ros.monitor.output import Output
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.replay.run import Sink

#: Shortest interval of the samples that are compared, ns: that of a live link at 50 Hz.
SHORTEST = round(NS / (50.0 * OVERSAMPLING))
BEGIN = 10 * NS  #: Time of the policy at the start of the recording, ns.
BEFORE = 3 * NS  #: The policy looks at this time before a doubt, ns: IMUs gain trust,
AFTER = 40 * NS  #: and at this time after it, ns: longer than every pause.


class _Sample(NamedTuple):
    #: time of the policy, ns
    at: int
    #: of each channel, rad/s. NaN: not delivered
    rates: list[float]
    #: numbers of `ChannelState` of each channel
    states: list[float]


class _Done(NamedTuple):
    """An order of failover."""

    #: what was done, for a report
    words: str
    #: from the first sample, ns
    at: int


class FailoverReplay(Sink):
    """Asks the policy of failover in a recording, with the evidence of a live vehicle.

    Only the times near a doubt of the monitor or near a large raw difference are looked
    at: nothing else can bring about an order.

    Parameters
    ----------
    channels
        Names of all gyro channels, three for each IMU.
    rate
        Sample rate of the recording, Hz.
    """

    def __init__(self, channels: Sequence[str], rate: float) -> None:
        self._channels = channels
        self._interval = max(SHORTEST, round(NS / rate))
        self._count = len(channels) // 3
        self._settings = PolicySettings()
        self._state = PolicyState.begin(self._count)
        self._use = [True] * self._count
        self._first: int | None = None  # stamp of the first sample, ns
        self._next = 0
        self._until = 0  # the policy is asked until this time, ns
        self._done: list[_Done] = []
        self.begin_stretch()

    def begin_stretch(self) -> None:
        """Forget what was compared: the next samples come after a long gap."""
        least = self._settings.min_size
        self._evidence = Evidence(self._count, self._interval, least)
        self._delivered = [0] * self._count
        self._waiting: deque[_Sample] = deque(maxlen=BEFORE // self._interval)

    def add(self, block: Block, output: Output, pipeline: Pipeline) -> None:
        """Take the next samples."""
        if not len(block):
            return
        count = len(self._channels)
        self._first = int(block.stamp[0]) if self._first is None else self._first
        rates = block.z[:, :count]
        if block.received is not None:
            rates = np.where(block.received[:, :count], rates, np.nan)
        states = output.state[:, :count]
        matters = np.isin(states, list(DOUBTS)).any(axis=1) | _is_far(rates)
        for row, stamp in enumerate((block.stamp - self._first + BEGIN).tolist()):
            self._until = stamp + AFTER if matters[row] else self._until
            if stamp < self._next:
                continue
            # On average at this interval, as an autopilot sends.
            self._next = max(self._next, stamp - SHORTEST) + SHORTEST
            sample = _Sample(stamp, rates[row].tolist(), states[row].tolist())
            self._waiting.append(sample)
            while stamp <= self._until and self._waiting:
                self._ask(self._waiting.popleft())

    def _ask(self, sample: _Sample) -> None:
        """Ask the policy about one sample, and note its orders."""
        now = sample.at
        for k in range(self._count):
            x, y, z = sample.rates[3 * k : 3 * k + 3]
            if np.isfinite(x + y + z):
                self._evidence.raw.feed(k, now, (x, y, z))
                self._delivered[k] = now
        self._evidence.hear(sample.states, now)
        memories = self._state.memories
        out = [k for k, memory in enumerate(memories) if memory.ours]
        delivers = [now - last < SILENCE for last in self._delivered]
        taken = [k for k, memory in enumerate(memories) if memory.taken]
        imus = self._evidence.look(delivers, out, now, taken)
        imus = tuple(
            imu._replace(use=use, heard=now)
            for imu, use in zip(imus, self._use, strict=True)
        )
        view = View(imus, linked=True, armed=True, monitored=True)
        decision = decide(self._state, view, now, self._settings)
        self._state = decision.state
        for k, in_use in decision.orders:
            if self._use[k] != in_use:
                words = "in use again" if in_use else "out of use"
                self._done.append(_Done(f"{self._name(k)} {words}", now - BEGIN))
            self._use[k] = in_use

    def _name(self, imu: int) -> str:
        """Return the autopilot's name of an IMU, from 0. A log may lack one between others."""
        unit = self._channels[3 * imu].rpartition(".")[0]
        numbered = re.fullmatch(r"imu_([1-9])", unit)
        return f"IMU {numbered[1]}" if numbered else imu_name(imu, self._channels)

    def text(self, origin: int | None = None) -> str:
        """Return the orders in one line.

        ``origin``: stamp from which times count, ns. None: the stamp of the first sample.
        """
        shift = 0 if origin is None or self._first is None else self._first - origin
        times = [(one.words, (one.at + shift) / NS) for one in self._done]
        done = [f"{words} at {at:.1f} s" for words, at in times]
        least = self._settings.min_size
        none = f"no IMU out of use (it acts on errors of {least:g} rad/s and more)"
        return f"what failover would have done if armed: {'; '.join(done) or none}"


def is_possible(channels: Sequence[str]) -> bool:
    """Return whether failover works with these channels: three for each of 2 or 3 IMUs."""
    count, rest = divmod(len(channels), 3)
    return 2 <= count <= len(INS_USE) and not rest


def _is_far(rates: NDArray[np.float64]) -> NDArray[Any]:
    """Return for each sample whether any two IMUs differ by `LARGE_DIFFERENCE`; rates (N, 3 IMUs)."""
    units = rates.reshape(len(rates), -1, 3)
    missing = np.isnan(units)
    low = np.nanmin(np.where(missing, np.inf, units), axis=1)
    high = np.nanmax(np.where(missing, -np.inf, units), axis=1)
    far: NDArray[Any] = (high - low >= LARGE_DIFFERENCE).any(axis=1)
    return far
