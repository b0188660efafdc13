# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Injection of faults into a stream: the same to the last bit however the stream is cut into blocks.

The injector is used on whole recordings and, one sample at a time, live. Each fault has a random generator of its
own, so that no other fault changes its draws.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fdi_ros.arrays import Array, Mask
from fdi_ros.errors import FaultError
from fdi_ros.faults.fault import Fault
from fdi_ros.faults.kinds import ChannelSamples
from fdi_ros.model.block import Block


def _named(fault: Fault) -> str:
    return f"fault {fault.kind.name} on {fault.channel}"


class Injector:
    """Injects faults into a stream of blocks, in the order of the list.

    Parameters
    ----------
    faults
        What to inject; several on one channel act one after the other.
    channel_names
        Names of the n channels of the stream.
    start_stamp
        Stamp that the times of the faults count from, ns; None: that of the first sample.

    Raises
    ------
    FaultError
        If a fault strikes a channel that is not there.
    """

    def __init__(self, faults: Sequence[Fault], channel_names: Sequence[str], start_stamp: int | None = None) -> None:
        self.faults = tuple(faults)
        self.channel_names = tuple(channel_names)
        self.channels = tuple(fault.channels(channel_names) for fault in self.faults)
        self.start_stamp = start_stamp
        self._effects = [
            fault.kind.effect(np.random.default_rng([fault.seed, k])) for k, fault in enumerate(self.faults)
        ]

    def time(self, stamp: NDArray[np.int64]) -> Array:
        """Seconds since the first sample, (N,), of stamps (N,) ns."""
        if self.start_stamp is None:
            raise FaultError("no sample has been seen yet: the time of a fault has no origin")
        return np.asarray((stamp - self.start_stamp) * 1e-9)

    def active(self, stamp: NDArray[np.int64]) -> Mask:
        """Ground truth: (N, faults) whether each fault is active at stamps (N,) ns."""
        time = self.time(stamp)
        columns = [(time >= fault.start) & (time < fault.stop) for fault in self.faults]
        return np.column_stack(columns) if columns else np.zeros((len(stamp), 0), dtype=bool)

    def struck(self, stamp: NDArray[np.int64]) -> Mask:
        """Ground truth: (N, n) whether each channel carries an active fault at stamps (N,) ns."""
        truth = np.zeros((len(stamp), len(self.channel_names)), dtype=bool)
        for column, struck in zip(self.active(stamp).T, self.channels, strict=True):
            truth[:, struck] |= column[:, None]
        return truth

    def check_start(self, start: float, first: int, learned: float) -> None:
        """Refuse faults that begin before they can be found.

        Parameters
        ----------
        start
            Beginning of the part that is read, s.
        first
            Stamp of its first sample, ns.
        learned
            Time from then on over which biases are learned, s.

        Raises
        ------
        FaultError
            Naming the first time that is allowed.
        """
        least, why = start, "there the part that is read begins"
        if learned > 0:
            least, why = float(self.time(np.array([first]))[0]) + learned, "until then the biases are learned"
        for fault in self.faults:
            if fault.start < least:
                raise FaultError(
                    f"{_named(fault)} starts at {fault.start:g} s, expected at least {least:.12g} s: {why}"
                )

    def check_gap(self, before: int, after: int) -> None:
        """Refuse faults that begin where nothing is recorded.

        Parameters
        ----------
        before, after
            Stamps of the last sample before the gap and of the first after it, ns.

        Raises
        ------
        FaultError
            Naming the times that are allowed.
        """
        last, first = self.time(np.array([before, after])).tolist()
        for fault in self.faults:
            if last < fault.start < first:
                raise FaultError(
                    f"{_named(fault)} starts at {fault.start:g} s, in a gap of the recording: expected at most"
                    f" {last:.12g} s, or at least {first:.12g} s"
                )

    def check_end(self, last: int) -> None:
        """Refuse faults that begin after the last sample.

        Parameters
        ----------
        last
            Its stamp, ns.

        Raises
        ------
        FaultError
            Naming the last time that is allowed.
        """
        most = float(self.time(np.array([last]))[0])
        for fault in self.faults:
            if fault.start > most:
                raise FaultError(
                    f"{_named(fault)} starts at {fault.start:g} s, expected at most {most:.12g} s, the last sample"
                )

    def apply(self, block: Block) -> Block:
        """Return the next block of the stream with the faults in it; the block given is left as it is."""
        if len(block) == 0 or not self.faults:
            return block
        if self.start_stamp is None:
            self.start_stamp = int(block.stamp[0])
        time = self.time(block.stamp)
        active = self.active(block.stamp)
        z = block.z.copy()
        received = np.ones(z.shape, dtype=bool) if block.received is None else block.received.copy()
        for k, fault in enumerate(self.faults):
            index = list(self.channels[k])
            struck = ChannelSamples(time, time - fault.start, active[:, k], z[:, index], received[:, index])
            # What is recorded may be infinite, and so may be what is added.
            with np.errstate(invalid="ignore", over="ignore"):
                self._effects[k](struck)
            z[:, index], received[:, index] = struck.z, struck.received
        return Block(block.stamp, z, None if block.received is None and received.all() else received)
