# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A recording as a stream of samples: decoded, ordered by time of recording, aligned."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.bag.raw import NO_HORIZON, Batch
from fdi_ros.bag.reader import Recording
from fdi_ros.bag.recorder_clock import RecorderClock
from fdi_ros.config.config import Config
from fdi_ros.core.alignment import Alignment, as_block
from fdi_ros.core.sources import source_of
from fdi_ros.errors import BagError
from fdi_ros.model.samples import Array, Block, Int
from fdi_ros.monitor.accelerometers import places, possible_units, varies
from fdi_ros.monitor.building import build_geometry
from fdi_ros.system.text import figures

#: messages handed on together: enough that calls do not count, little enough for the
#: cache
_MOST_AT_ONCE = 16384
#: messages that wait for earlier ones at most
_MOST_WAITING = 1 << 20
WRONG_RATE = 0.2
"""Relative error of a configured sample rate at which thresholds and times are wrong."""
_NOT_SECONDS = 900.0
"""Factor between rates from which on a unit of time is wrong, not a setting: ms or us for ns."""
_RATE_SAMPLES, _FEWEST_STEPS = 5000, 50
"""Samples that determine the rate of a recording, and the fewest intervals for that."""
#: decoded messages, by field
Rows = NDArray[Any]
#: receives each batch and the numbers of its messages in use
Tap = Callable[[Batch, Int], None]


class Newest(NamedTuple):
    """How far a topic has come."""

    #: number of messages so far
    received: int = 0
    #: time of recording of the last message, ns, 0 before the first
    log_time: int = 0
    #: stamp of the last message, ns, 0 before the first
    stamp: int = 0


class Samples:
    """The samples of a recording, block by block.

    ``start``, ``end``: part to read, s from the first message. ``taps`` receive every
    batch of raw messages and the rows in use. ``period``: blocks end at multiples of
    this time of recording, ns; 0 chooses the fastest size. `BagError` if a topic of the
    config is missing or has another type.
    """

    def __init__(
        self,
        recording: Recording,
        config: Config,
        start: float = 0.0,
        end: float = math.inf,
        taps: Sequence[Tap] = (),
        period: int = 0,
    ) -> None:
        self.recording = recording
        self.topics = config.topics
        self.source = source_of(config)
        recording.require(self.topics, self.source.type)
        self.alignment = Alignment(*self.source.alignment)
        n = build_geometry(config).n
        m = len(places(config, possible_units(config, n)))
        topics = range(len(self.topics))
        brought = [self.source.brought(k, n, m) for k in topics]
        self._brought = np.array([one.size for one in brought])
        """Number of values that a message of each topic brings."""
        self._gyros = n
        self._forces = m
        self._values = max(self._brought)
        columns = [
            ("topic", "i8"),
            ("log_time", "i8"),
            ("stamp", "i8"),
            ("values", "f8", (self._values,)),
        ]
        self._row = np.dtype(columns)
        """Decoded message: index of the topic, times, ns (without a stamp the time of
        recording), rates, rad/s, and accelerations, m/s^2; NaN behind fewer.
        """
        self._waiting: Array | None = None
        """(m,) accelerations of an array that the next sample takes, m/s^2."""
        self._span = (start, end)
        self._span_clock = RecorderClock()
        self._taps = taps
        self.period = period
        self._configured = config.sample_rate
        self._first: (
            list[Int] | None
        ) = []  # stamps of the first samples, ns; None after the check of the rate
        self._last = -1
        self.origin: int | None = None
        """Stamp of the first message, ns, the origin of the times of faults, start and
        end.
        """
        self.messages = 0  #: used so far
        self.felt: tuple[int, ...] = ()
        """Numbers of the units whose accelerometers are to be judged, by the messages of the
        first block, as `fdi_ros.monitor.accelerometers.felt_units` finds them."""
        self.malformed = dict.fromkeys(
            self.topics, 0
        )  #: malformed messages of each topic
        self.disordered = 0  #: messages without a stamp recorded before one that was handed on already: left out
        self._stamped = np.full(len(self.topics), -1, dtype=np.int64)
        """Stamp of the last message of each topic, ns. -1: none."""
        self._set_back = np.zeros(len(self.topics), dtype=np.int64)
        """Longest step back of the stamps of each topic, ns."""
        self.steps_back = [StepBack() for _ in self.topics]
        """Whether the clock of each topic was set back."""
        self.progress = 0.0  #: share of the recording read so far
        self.newest = [Newest() for _ in self.topics]
        """Last message of each topic so far, if blocks are cut by period."""

    @property
    def reads_to_end(self) -> bool:
        """Whether the part that is read lasts to the end of the recording."""
        return math.isinf(self._span[1])

    def blocks(self) -> Iterator[Block]:
        """Read the recording.

        `BagError` if no message can be used, or the rate contradicts the config.
        """
        for messages in self._portions():
            if not self.messages:
                self.felt = self._felt_in(messages)
            self.messages += len(messages)
            if self.period:
                self._note_newest(messages)
            for k in np.unique(messages["topic"]).tolist():
                stamps = messages["stamp"][messages["topic"] == k]
                steps = steps_of(self._stamped, k, stamps)
                self._set_back[k] = max(self._set_back[k], -steps.min())
                self.steps_back[k].add(stamps)
            block = self._block(messages)
            self._check_rate(block.stamp)
            yield block
        if self.messages == 0:
            raise BagError(
                f"{self.recording.path} has no usable message on: {', '.join(self.topics)}{self._why()}"
            )
        if self.source.stamped and len(rest := self.alignment.flush()):
            yield as_block(rest, len(self.topics))
        self._check_rate(None)

    def _felt_in(self, messages: Rows) -> tuple[int, ...]:
        if not (self.source.units and self._forces):
            return ()
        topic = messages["topic"]
        values = messages["values"]
        forces = [values[topic == u, 3:] for u in range(len(self.topics))]
        if not any(map(varies, forces)):
            return ()
        return tuple(
            unit
            for unit, force in enumerate(forces)
            if not len(force) or not np.isnan(force).all()
        )

    def _check_rate(self, stamp: Int | None) -> None:
        """Collect stamps (k,), ns, and check the rate once enough arrived; None at the end."""
        if self._first is None:
            return
        self._first += [] if stamp is None else [stamp]
        if self._first and (
            stamp is None or sum(map(len, self._first)) >= _RATE_SAMPLES
        ):
            check_sample_rate(
                self.recording.path, np.concatenate(self._first), self._configured
            )
            self._first = None

    def _portions(self) -> Iterator[Rows]:
        """Join or split messages into blocks."""
        together = np.empty(0, self._row)
        for messages in self._ordered():
            together = np.concatenate([together, messages])
            if self.period:
                *whole, together = np.split(
                    together,
                    np.flatnonzero(np.diff(together["log_time"] // self.period)) + 1,
                )
                yield from whole
            elif len(together) >= _MOST_AT_ONCE:
                yield together
                together = together[:0]
        if len(together):
            yield together

    def _note_newest(self, messages: Rows) -> None:
        for k, before in enumerate(self.newest):
            of_topic = messages[messages["topic"] == k]
            if len(of_topic):
                last = of_topic[-1]
                self.newest[k] = Newest(
                    before.received + len(of_topic),
                    int(last["log_time"]),
                    int(last["stamp"]),
                )

    def _why(self) -> str:
        wrong = sum(self.malformed.values())
        if wrong:
            words = "rates" if self.source.units else "values"
            expected = 3 if self.source.units else self._gyros
            return f" ({wrong} malformed, expected {expected} {words} in each)"
        if self.recording.damage:
            return f" ({self.recording.damage.lines[0]})"
        start, end = self._span
        if self.origin is not None:
            # Messages were read, but none within the part that was asked for.
            to = "its end" if math.isinf(end) else f"{end:g} s"
            return f" from {start:g} s to {to}"
        return ""

    def _block(self, messages: Rows) -> Block:
        stamp, values = (
            np.ascontiguousarray(messages[name]) for name in ("stamp", "values")
        )
        if self.source.stamped:
            return self.alignment.push_block(
                np.ascontiguousarray(messages["topic"]), stamp, values
            )
        # As the live node does with messages that carry no stamp: the time of arrival, made strictly increasing.
        rows = np.flatnonzero(messages["topic"] == 0)
        count = np.arange(len(rows))
        free = stamp[rows] - count
        free[:1] = np.maximum(free[:1], self._last + 1)
        stamp = np.maximum.accumulate(free) + count
        self._last = int(stamp[-1]) if len(rows) else self._last
        block = Block(stamp, values[rows, : self._gyros])
        if not self._forces:
            return block
        return replace(block, acceleration=self._forces_of(block, values, rows))

    def _forces_of(self, block: Block, values: Array, gyros: Int) -> Block:
        """Return the accelerations of the samples of an array, whose messages stand in rows ``gyros``.

        Each takes the last ones that came after the sample before.
        """
        force = np.full((len(block), self._forces), np.nan)
        before = np.concatenate([[-1], gyros[:-1]])
        newest = gyros - 1
        found = newest > before
        force[found] = values[newest[found], : self._forces]
        if len(gyros) and not found[0] and self._waiting is not None:
            force[0] = self._waiting
            found[0] = True
        last = gyros[-1] if len(gyros) else -1
        if last < len(values) - 1:
            self._waiting = values[-1, : self._forces].copy()
        elif len(gyros):
            self._waiting = None
        received = np.repeat(found[:, np.newaxis], self._forces, axis=1)
        return Block(block.stamp, force, received)

    def _ordered(self) -> Iterator[Rows]:
        """Put the messages into the order of recording, as a player would publish them."""
        waiting = np.empty(0, self._row)
        done = -1
        for batch in self.recording.batches(self.topics):
            waiting = np.concatenate([waiting, self._decoded(batch)])
            if (np.diff(waiting["log_time"]) < 0).any():
                waiting = waiting[np.argsort(waiting["log_time"], kind="stable")]
            all_ready = batch.horizon == NO_HORIZON or len(waiting) > _MOST_WAITING
            ready = (
                len(waiting)
                if all_ready
                else int(np.searchsorted(waiting["log_time"], batch.horizon))
            )
            messages = waiting[:ready]
            waiting = waiting[ready:]
            self.progress = batch.progress
            if (
                len(messages)
                and not self.source.stamped
                and messages["log_time"][0] < done
            ):
                late = messages["log_time"] < done
                self.disordered += int(late.sum())
                messages = messages[~late]
            if len(messages):
                done = int(messages["log_time"][-1])
                yield messages
        if len(waiting):
            yield waiting

    @property
    def set_back_s(self) -> float:
        """By how much the stamps of all units were set back together, s. 0: never."""
        row = self.alignment.rows[0]
        least = int(self._set_back.min())
        if not self.source.stamped or not row["restarts"] or least <= row["timeout"]:
            return 0.0
        return 1e-9 * least

    def _decoded(self, batch: Batch) -> Rows:
        """Decode a batch; malformed messages and those outside the span are left out."""
        messages = np.empty(len(batch), self._row)
        messages["topic"] = batch.topic
        messages["log_time"] = batch.log_time
        messages["stamp"] = batch.log_time
        messages["values"] = np.nan
        keep = np.zeros(len(batch), dtype=bool)
        for count in np.unique(self._brought).tolist():
            rows = np.flatnonzero(self._brought[batch.topic] == count)
            decoded = self.source.decode(
                batch.buffer, batch.offset[rows], batch.length[rows], count
            )
            keep[rows] = decoded.good
            messages["values"][rows, :count] = decoded.values
            if self.source.stamped:
                messages["stamp"][rows] = decoded.stamp
        stamp = messages["stamp"]
        for topic in batch.topic[~keep].tolist():
            self.malformed[self.topics[topic]] += 1
        if self.origin is None and keep.any():
            self.origin = int(stamp[np.argmax(keep)])
        if self._span != (0.0, math.inf):
            # As the monitor counts them: they go on where all clocks were set back.
            going_on = self._span_clock.follow(batch.topic, stamp)
            seconds = (going_on - (self.origin or 0)) * 1e-9
            keep = keep & (seconds >= self._span[0]) & (seconds < self._span[1])
        for tap in self._taps:
            tap(batch, np.flatnonzero(keep))
        return messages[keep]


class StepBack:
    """Finds stamps of a topic that go on below earlier ones, as if its clock was set back.

    A message that was overtaken, or that came twice, is alone.
    """

    def __init__(self) -> None:
        self._newest: int | None = None
        """Largest stamp so far, ns."""
        self._before = 0
        """By how much the last stamp was below the largest before it, ns. -1: it was not."""
        self.largest = 0
        """Largest step back, ns. 0: none."""
        self.first: int | None = None
        """Largest stamp before the first one, ns. None: no step back."""

    def add(self, stamp: Int) -> None:
        """Take further stamps, ns."""
        newest = int(stamp[0]) - 1 if self._newest is None else self._newest
        highest = np.maximum.accumulate(np.concatenate([[newest], stamp]))
        behind = np.maximum(highest[:-1] - stamp, -1)
        depth = np.concatenate(
            [[self._before if self._newest is not None else -1], behind]
        )
        several = (depth[1:] >= 0) & (depth[:-1] >= 0)
        back = np.where(several, np.maximum(depth[1:], depth[:-1]), 0)
        if back.any():
            self.largest = max(self.largest, int(back.max()))
            if self.first is None:
                self.first = int(highest[:-1][np.argmax(back > 0)])
        self._newest = int(highest[-1])
        self._before = int(behind[-1])


def steps_of(last: Int, k: int, times: Int) -> Int:
    """Return the steps (N,) to further times (N,) of topic k, ns, and keep the last time.

    ``last`` (topics,) are the last times so far, -1: none. The first step of a topic is 0.
    """
    before = times[:1] if last[k] < 0 else last[k : k + 1]
    steps = np.diff(np.concatenate([before, times]))
    last[k] = times[-1]
    return steps


def check_sample_rate(path: Path, stamp: Int | Array, configured: float) -> None:
    """Check that samples with stamps (k,), ns, have the configured rate, Hz.

    `BagError` if both the median and the mean without gaps are off by more than
    `WRONG_RATE`: lost samples and bursts change only one. Fewer than 51
    stamps are not checked.
    """
    steps = np.sort(np.diff(stamp)) * 1e-9
    if len(steps) < _FEWEST_STEPS or steps[0] <= 0:
        return
    usual = 1.0 / np.median(steps)
    without_longest = steps[: -max(1, len(steps) // 100)]
    mean = 1.0 / without_longest.mean()
    off = np.array([usual, mean]) / configured
    if (off > _NOT_SECONDS).all() or (off < 1.0 / _NOT_SECONDS).all():
        times, side = (
            (off[0], "closer together")
            if off[0] > 1.0
            else (1.0 / off[0], "farther apart")
        )
        raise BagError(
            f"{path}: its stamps are about {float(f'{times:.1g}'):.0f} times {side} than sample_rate,"
            f" {configured:g} Hz, allows: they are not in seconds and nanoseconds"
        )
    if (off > 1.0 + WRONG_RATE).all() or (off < 1.0 - WRONG_RATE).all():
        raise BagError(
            f"{path}: sample_rate is {configured:g} Hz in the config and {figures(usual, 4)} Hz in the recording: set"
            f" sample_rate to {figures(usual, 4)}"
        )


def read_block(
    bag: Path, config: Config, start: float = 0.0, end: float = math.inf
) -> Block:
    """Read a part of a recording, aligned as in a replay (errors as `Recording`, `Samples`)."""
    with Recording(bag) as recording:
        return joined(list(Samples(recording, config, start, end).blocks()))


def joined(blocks: Sequence[Block]) -> Block:
    """Join consecutive blocks; those without accelerations have received none where others have some."""

    def half(parts: Sequence[Block]) -> Block:
        return Block(
            np.concatenate([b.stamp for b in parts]),
            np.concatenate([b.z for b in parts]),
            np.concatenate([b.delivered for b in parts]),
        )

    felt = [b.acceleration for b in blocks if b.acceleration is not None]
    if not felt:
        return half(blocks)
    shapes = [(len(b), felt[0].z.shape[1]) for b in blocks]
    others = [
        b.acceleration
        or Block(b.stamp, np.full(shape, np.nan), np.zeros(shape, dtype=bool))
        for b, shape in zip(blocks, shapes, strict=True)
    ]
    return replace(half(blocks), acceleration=half(others))
