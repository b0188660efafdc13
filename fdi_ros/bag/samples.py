# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A recording as a stream of samples: decoded, put into the order of recording, aligned."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fdi_ros.bag.raw import NO_HORIZON, Batch
from fdi_ros.bag.reader import Recording
from fdi_ros.config.config import Config
from fdi_ros.core.alignment import Alignment, as_block
from fdi_ros.errors import BagError
from fdi_ros.model.samples import Array, Block, Int
from fdi_ros.monitor.build import build_geometry
from fdi_ros.sources import source_of

_TOGETHER = 16384
"""Messages handed on together: enough that calls do not count, little enough for the cache."""
_HELD = 1 << 20
"""Messages that wait for earlier ones at most."""
RATE_TOLERANCE = 0.2
"""Share by which a recording may be faster or slower than configured: beyond, every threshold and time is wrong."""
_RATE_SAMPLES, _FEWEST_STEPS = 5000, 50
"""Samples from which the rate of a recording is told, and steps between samples that this takes at least."""
Tap = Callable[[Batch, Int], None]
"""Is shown each batch and the numbers of the messages in it that are used."""


class Newest(NamedTuple):
    """How far a topic has come."""

    received: int = 0
    log_time: int = 0
    """Of its last message, ns; 0 before the first."""
    stamp: int = 0


@dataclass(frozen=True)
class Messages:
    """M decoded messages."""

    topic: Int
    """(M,) index of the input topic."""
    log_time: Int
    """(M,) ns."""
    stamp: Int
    """(M,) ns; the time of recording where messages carry none."""
    values: Array
    """(M, c) rad/s."""

    def __len__(self) -> int:
        return len(self.topic)

    def at(self, rows: slice | Int) -> Messages:
        """Return some of the messages."""
        return Messages(self.topic[rows], self.log_time[rows], self.stamp[rows], self.values[rows])

    @classmethod
    def joined(cls, parts: list[Messages]) -> Messages:
        """Return all messages of the parts."""
        if len(parts) == 1:
            return parts[0]
        columns = zip(*((p.topic, p.log_time, p.stamp, p.values) for p in parts), strict=True)
        return cls(*(np.concatenate(column) for column in columns))


class Samples:
    """The samples of a recording, block after block.

    Parameters
    ----------
    recording
        Open recording.
    config
        Says the input topics.
    channels
        Number of channels.
    start, end
        Part to be read, s from the first message.
    tap
        Is shown every batch of raw messages with those that are used.
    period
        Cut the blocks at multiples of this time of recording, ns; 0: where it is fastest.

    Raises
    ------
    BagError
        If a topic is missing or of another type.
    """

    def __init__(
        self,
        recording: Recording,
        config: Config,
        channels: int,
        start: float = 0.0,
        end: float = math.inf,
        tap: Tap | None = None,
        period: int = 0,
    ) -> None:
        self.recording = recording
        self.topics = config.topics
        self.channels = channels
        self.source = source_of(config)
        recording.require(self.topics, self.source.type)
        self.alignment = Alignment(*self.source.alignment)
        first = self.source.channels_of(0, channels)
        self._width = first.stop - first.start
        """Values in a message."""
        self._span = (start, end)
        self._tap = tap
        self.period = period
        self._configured = config.sample_rate
        self._first: list[Int] | None = []
        """Stamps of the first samples; None: their rate was checked."""
        self._last = -1
        self.origin: int | None = None
        """Stamp of the first message, ns: the times of faults, start and end count from here."""
        self.messages = 0
        """Used so far."""
        self.malformed = dict.fromkeys(self.topics, 0)
        """Messages of each topic that do not hold what they should."""
        self.disordered = 0
        """Messages without a stamp recorded before one that was handed on already: left out."""
        self.progress = 0.0
        """Share of the recording read so far."""
        self.newest = [Newest() for _ in self.topics]
        """Last message of each topic in the blocks so far; kept only where blocks are cut by period."""

    def blocks(self) -> Iterator[Block]:
        """Read the recording.

        Raises
        ------
        BagError
            If it holds not a single message that can be used, or samples of another rate than configured.
        """
        for messages in self._portions():
            self.messages += len(messages)
            if self.period:
                self._note_newest(messages)
            block = self._block(messages)
            self._check_rate(block.stamp)
            yield block
        if self.messages == 0:
            raise BagError(f"{self.recording.path} has no usable message on: {', '.join(self.topics)}{self._why()}")
        if self.source.stamped and len(rest := self.alignment.flush()):
            yield as_block(rest, len(self.topics))
        self._check_rate(None)

    def _check_rate(self, stamp: Int | None) -> None:
        """Take the stamps (k,) of a block, ns, None at the end, and check the rate once enough are there."""
        if self._first is None:
            return
        self._first += [stamp] if stamp is not None else []
        if stamp is None or sum(map(len, self._first)) >= _RATE_SAMPLES:
            first, self._first = self._first, None
            check_sample_rate(self.recording.path, np.concatenate(first) if first else np.zeros(0), self._configured)

    def _portions(self) -> Iterator[Messages]:
        """Put messages together, or apart, into what becomes a block."""
        together: list[Messages] = []
        for messages in self._ordered():
            together.append(messages)
            if self.period:
                joined = Messages.joined(together)
                cuts = np.flatnonzero(np.diff(joined.log_time // self.period)) + 1
                for first, last in itertools.pairwise([0, *cuts.tolist()]):
                    yield joined.at(slice(first, last))
                together = [joined.at(slice(int(cuts[-1]), None))] if len(cuts) else [joined]
            elif sum(map(len, together)) >= _TOGETHER:
                yield Messages.joined(together)
                together = []
        if together:
            yield Messages.joined(together)

    def _note_newest(self, messages: Messages) -> None:
        for k in range(len(self.topics)):
            rows = np.flatnonzero(messages.topic == k)
            if len(rows):
                last = rows[-1]
                received = self.newest[k].received + len(rows)
                self.newest[k] = Newest(received, int(messages.log_time[last]), int(messages.stamp[last]))

    def _why(self) -> str:
        wrong = sum(self.malformed.values())
        if wrong:
            words = "rates" if self.source.units else "values"
            return f" ({wrong} malformed, expected {self._width} {words} in each)"
        return f" ({self.recording.damage.lines[0]})" if self.recording.damage else ""

    def _block(self, messages: Messages) -> Block:
        if self.source.stamped:
            return self.alignment.push_block(messages.topic, messages.stamp, messages.values)
        # As the live node does with messages that carry no stamp: the time of arrival, made strictly increasing.
        count = np.arange(len(messages))
        free = messages.stamp - count
        free[0] = max(free[0], self._last + 1)
        stamp = np.maximum.accumulate(free) + count
        self._last = int(stamp[-1])
        return Block(stamp, messages.values)

    def _ordered(self) -> Iterator[Messages]:
        """Put the messages into the order of recording, as a player would publish them."""
        held: list[Messages] = []
        done = -1
        for batch in self.recording.batches(self.topics):
            held.append(self._decoded(batch))
            messages = Messages.joined(held)
            if (np.diff(messages.log_time) < 0).any():
                messages = messages.at(np.argsort(messages.log_time, kind="stable"))
            ready = int(np.searchsorted(messages.log_time, batch.horizon)) if batch.horizon < NO_HORIZON else None
            if len(messages) > _HELD:
                ready = None
            first, held = messages.at(slice(ready)), [messages.at(slice(ready, None))] if ready is not None else []
            self.progress = batch.progress
            if len(first) and not self.source.stamped and first.log_time[0] < done:
                self.disordered += int((first.log_time < done).sum())
                first = first.at(np.flatnonzero(first.log_time >= done))
            if len(first):
                done = int(first.log_time[-1])
                yield first
        if held and len(held[0]):
            yield held[0]

    def _decoded(self, batch: Batch) -> Messages:
        """Decode a batch; malformed messages are counted and left out, and so is what lies outside the span."""
        decoded = self.source.decode(batch.buffer, batch.offset, batch.length, self._width)
        stamp = decoded.stamp if self.source.stamped else batch.log_time
        keep = decoded.good
        if not keep.all():
            for topic in batch.topic[~keep].tolist():
                self.malformed[self.topics[topic]] += 1
        if self.origin is None and keep.any():
            self.origin = int(stamp[np.argmax(keep)])
        if self._span != (0.0, math.inf):
            seconds = (stamp - (self.origin or 0)) * 1e-9
            keep = keep & (seconds >= self._span[0]) & (seconds < self._span[1])
        rows = np.flatnonzero(keep)
        if self._tap is not None:
            self._tap(batch, rows)
        messages = Messages(batch.topic, batch.log_time, stamp, decoded.values)
        return messages if len(rows) == len(keep) else messages.at(rows)


def check_sample_rate(path: Path, stamp: Int | Array, configured: float) -> None:
    """Check that the samples of a recording come about as often as configured.

    Parameters
    ----------
    path
        Of the recording, for the message.
    stamp
        (k,) stamps of its samples, ns; of fewer than 51 nothing is known.
    configured
        Sample rate, Hz.

    Raises
    ------
    BagError
        If both the median and the mean, gaps left out, are off by more than `RATE_TOLERANCE`: neither samples that
        are lost nor samples that come in bursts are a wrong rate.
    """
    steps = np.sort(np.diff(stamp)) * 1e-9
    if len(steps) < _FEWEST_STEPS or steps[0] <= 0:
        return
    usual, mean = 1.0 / np.median(steps), 1.0 / steps[: -max(1, len(steps) // 100)].mean()
    off = np.array([usual, mean]) / configured
    if (off > 1.0 + RATE_TOLERANCE).all() or (off < 1.0 - RATE_TOLERANCE).all():
        raise BagError(
            f"{path}: sample_rate is {configured:g} Hz in the config, the recording has {usual:.4g} Hz: set"
            f" sample_rate to {usual:.4g}"
        )


def read_block(bag: Path, config: Config, start: float = 0.0, end: float = math.inf) -> Block:
    """Read all samples of a part of a recording, aligned as in a replay.

    Raises
    ------
    FdiError
        If there is no such recording, or it lacks a topic of the configuration.
    """
    with Recording(bag) as recording:
        return joined(list(Samples(recording, config, build_geometry(config).n, start, end).blocks()))


def joined(blocks: Sequence[Block]) -> Block:
    """Join consecutive blocks."""
    received = [np.ones(b.z.shape, dtype=bool) if b.received is None else b.received for b in blocks]
    return Block(
        np.concatenate([b.stamp for b in blocks]), np.concatenate([b.z for b in blocks]), np.concatenate(received)
    )
