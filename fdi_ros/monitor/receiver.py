# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Messages handed to a pipeline one at a time, checks of their flow, and compilation ahead of the first."""

from __future__ import annotations

import contextlib
import sys
from collections import deque
from itertools import pairwise
from typing import Any

import numpy as np

from fdi_ros.compiling.compiled import Callback, allocate
from fdi_ros.config.config import Config
from fdi_ros.core.alignment import Alignment, as_block
from fdi_ros.core.copies import copies_among
from fdi_ros.core.decision import clear_declarations, clear_disagreements
from fdi_ros.core.live import MORE, NO_STAMP, process
from fdi_ros.core.messages import ImuTemplate, MessageError, as_batch
from fdi_ros.core.path import Path
from fdi_ros.core.records import EventRow, Live
from fdi_ros.core.sources import SOURCES, Source, source_of
from fdi_ros.detectors import create_detector, detector_class
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.samples import Array, Block
from fdi_ros.monitor.accelerometers import felt_units, varies
from fdi_ros.monitor.building import GUARD
from fdi_ros.monitor.output import (
    FUSED,
    INTEGRITY,
    OUTPUTS,
    Encoder,
    Event,
    Rows,
    SampleOutput,
    events_of,
)
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.system.text import figures

STANDING_TIME = 2_000_000_000  # ns of steady time. A simulation at a tenth of real time steps by 0.2 s
RATE_TOLERANCE = 0.1  # relative difference to the configured rate that is reported
# consecutive measurements that must agree: a pause or a loss is no rate
RATE_WINDOWS = 4


class SilenceClock:
    """Clock for judging silence: the clock of the node, continued by a steady clock while that one stands.

    The clock of a simulation or a recording stands for `STANDING_TIME` between two messages at most. Longer, and the
    clock is paused or lost, and silence must not look healthy.
    """

    def __init__(self) -> None:
        self.standing = 0.0
        """Time for which the clock has stood, s, 0 while the clock runs."""
        self._clock = -1  # clock time of the last reading, ns
        self._moved = 0  # steady time at which the clock moved last, ns

    def read(self, now: int, steady: int) -> int:
        """Return the time at the clock time now and a steady time, ns."""
        if now != self._clock:
            self._clock = now
            self._moved = steady
        stood = steady - self._moved
        self.standing = stood / 1e9 if stood > STANDING_TIME else 0.0
        return now + max(0, stood - STANDING_TIME)


class Watchdog:
    """Whether a counter has stood still for longer than a timeout, ns, by a `SilenceClock`."""

    def __init__(self, timeout: int) -> None:
        self.timeout = timeout
        self.silent = False
        self.at = 0  # clock time at which the counter last moved, to the precision of the checks, ns
        self.rate = 0.0  # of the counter, 1/s, by the clock between the last two calls of `measure`
        self._count = -1
        self._measured = 0, 0  # count and clock time, ns, of the last call

    def check(self, count: int, now: int) -> bool:
        """Check the count at the clock time now, ns. Return whether silence began or ended."""
        # Where the clock went back, or was not running at the last check, the time
        # between is unknown.
        if count != self._count or now < self.at or not self.at:
            self._count = count
            self.at = now
        before = self.silent
        self.silent = now - self.at > self.timeout
        return self.silent != before

    def seconds(self, now: int) -> float:
        """How long the counter has stood still, s."""
        return max(0, now - self.at) / 1e9

    def measure(self, count: int, now: int) -> None:
        """Measure the rate of the counter since this was last called."""
        before, then = self._measured
        self.rate = 1e9 * (count - before) / (now - then) if now > then > 0 else 0.0
        self._measured = count, now


class SampleRateCheck:
    """Compares the rate of the samples, by their stamps, with the configured one, Hz, which all times are made for."""

    def __init__(self, configured: float) -> None:
        self.words = ""  # fault in words, empty if none is known
        self._configured = configured
        self._points: deque[tuple[int, int]] = deque(
            maxlen=RATE_WINDOWS + 1
        )  # numbers of samples, with their stamps

    def check(self, count: int, stamp: int) -> None:
        """Take the number of samples so far and the stamp of the last one, ns."""
        points = self._points
        if points:
            last_count, last_stamp = points[-1]
            if count <= last_count or stamp <= last_stamp:
                points.clear()
        points.append((count, stamp))
        rates = [
            1e9 * (now[0] - before[0]) / (now[1] - before[1])
            for before, now in pairwise(points)
        ]
        if len(rates) < RATE_WINDOWS:
            return
        if max(rates) > (1 + RATE_TOLERANCE) * min(rates):
            return
        rate = sum(rates) / RATE_WINDOWS
        self.words = ""
        if abs(rate / self._configured - 1) > RATE_TOLERANCE:
            self.words = (
                f"samples come at {figures(rate)} Hz, sample_rate is {self._configured:g} Hz:"
                " the false-alarm rate and all times are wrong by as much"
            )


_NOTHING = np.frombuffer(b"\0", dtype=np.uint8)


class Receiver:
    """Takes messages one at a time, aligns those of several units, and has the pipeline work one sample a call."""

    def __init__(self, pipeline: Pipeline) -> None:
        config = pipeline.config
        n = pipeline.geometry.n
        self.pipeline = pipeline
        self.source = source_of(config)
        self.alignment = Alignment(*self.source.alignment)
        self.live = allocate(Live)  # record of received messages, (1,)
        self.errors = [""] * len(
            self.source.topics
        )  # why the last malformed message of each topic was refused
        self.live["channels"] = n
        self.live["accelerometers"] = len(pipeline.channel_names) - n
        self.live["inlets"]["stamp"] = self.live["inlets"]["lag"] = NO_STAMP
        if pipeline.undecided:
            # Built now: no sample is to wait for that.
            pipeline.build_accelerometers(range(len(self.source.topics)))
        self._first_force: Array | None = None
        """(1, m) accelerations of the first sample that had any, m/s^2."""
        pipeline.prepare()
        self._equip()
        self.warm(self.source)

    def _equip(self) -> None:
        """Make room for events and messages of the channels that there are now."""
        pipeline = self.pipeline
        names = pipeline.channel_names
        self._events = allocate(EventRow, len(names))
        self.encoder = Encoder(pipeline.config.body_frame, names, pipeline.geometry.n)
        fused, integrity = (
            self.encoder.templates[output] for output in (FUSED, INTEGRITY)
        )
        self.live["fused_at"] = fused.at
        self.live["integrity_at"] = integrity.at
        self._records = (
            len(pipeline.halves),
            self.alignment.rows,
            self.live,
            self._events,
            fused.bytes,
            integrity.bytes,
        )

    def receive(self, inlet: int, data: bytes, stamp: int = 0) -> int:
        """Take in a message of an input topic.

        The stamp is its time of arrival, ns, or 0 if unknown.
        """
        # Bytes: arrays of what can be written would be compiled once more.
        message = np.frombuffer(bytes(data), dtype=np.uint8)
        flags = self.source.receive(
            self.alignment.rows, self.live, inlet, message, stamp
        )
        return self.go_on() if flags & MORE else flags

    @property
    def last_stamp(self) -> int:
        """Stamp of the last sample that the monitor has processed, ns."""
        return int(self.pipeline.core["last_stamp"][0])

    def go_on(self) -> int:
        """Work the next sample."""
        if self.pipeline.undecided:
            self._sense()
        return int(process(self.pipeline.paths, *self._records))

    def _sense(self) -> None:
        """Judge the accelerometers from the first sample on whose accelerations are not those of the first."""
        sample = self.live["sample"]
        if not sample["felt"].any():
            return
        if self._first_force is None:
            self._first_force = sample["force"].copy()
        if varies(np.vstack([self._first_force, sample["force"]])):
            units = felt_units(as_block(sample, len(self.source.topics)))
            self.pipeline.sense(units)
            self._equip()

    def supply(self) -> None:
        """Prepare the constants requested by `SUPPLY`."""
        self.pipeline.supply()
        self.encoder.fill(INTEGRITY, self._rows, self.shift)

    @property
    def _rows(self) -> Rows:
        """What the last sample gave."""
        return Rows(*(half.core[0]["last"] for half in self.pipeline.halves))

    def refused(self, unit: int, data: bytes) -> None:
        """Keep why a message was refused."""
        code = int(self.live["inlets"]["error"][0, unit])
        n = self.live["channels"][0]
        m = self.live["accelerometers"][0]
        expected = self.source.brought(unit, int(n), int(m)).size
        self.errors[unit] = self.source.explain(code, data, expected)

    def message(self, output: SampleOutput) -> bytes:
        """Return the message of an output about the last sample."""
        if output not in (FUSED, INTEGRITY):
            # Compiled code fills the other two.
            self.encoder.fill(output, self._rows, self.shift)
        return self.encoder.templates[output].bytes.tobytes()

    @property
    def events(self) -> list[Event]:
        """Changes of state that the last sample brought."""
        count = self.live["events"][0]
        return events_of(self._events[:count], self.pipeline.geometry.n)

    @property
    def shift(self) -> int:
        """Shift to subtract from the stamp of the last sample for its message, ns."""
        return int(self.live["shift"][0])

    @property
    def restarts(self) -> int:
        """How often the time of all inputs began anew."""
        return int(self.alignment.rows["restarts"][0] + self.live["restarts"][0])

    def counts(self, unit: int) -> dict[str, int]:
        """Count messages not taken as they came, by kind."""
        malformed = {"malformed": int(self.live["inlets"]["malformed"][0, unit])}
        if not self.source.stamped:
            return malformed
        counters = self.alignment.counters[unit]
        del counters["received"]
        return malformed | counters

    def warm(self, kind: Source | type[Source]) -> None:
        """Load or compile the code for messages of a kind now, on copies, so that the first message need not wait."""
        path = Path(*(one.copy() for one in self.pipeline.path))
        halves, *records = self._records
        aside: Any = tuple(one.copy() for one in records)
        kind.receive(self.alignment.rows.copy(), self.live.copy(), 0, _NOTHING, 0)
        process((path, path), halves, *aside)
        row = path.core[0]["last"]
        names = self.pipeline.geometry.channel_names
        encoder = Encoder("", 2 * names, len(names))
        for output in OUTPUTS:
            encoder.fill(output, Rows(row, row))
        self.alignment.is_live(0)
        _ = self.alignment.are_parted
        clear_declarations(path.core)
        clear_disagreements(path.core)


def warm_detector(name: str) -> None:
    """Compile or load the code of one detector. Raise `DetectorError` for an unknown name."""
    method = detector_class(name)
    for one in vars(sys.modules[method.__module__]).values():
        if isinstance(one, Callback):
            _ = one.address
    geometry = Geometry.cone(5) if method.refuses(6) else Geometry.two_triad_cone()
    create_detector(name, geometry, NoiseModel(0.01, bound=0.04)).detect(
        np.zeros((1, geometry.n))
    )


def warm_path() -> None:
    """Compile or load what takes samples through any monitor, in blocks and in messages, and what messages need."""
    pipeline = Pipeline(Config.from_parameters({"detector.name": GUARD}))
    # Nothing is prepared for a set of channels that lacks two.
    z = np.zeros((2, pipeline.geometry.n))
    z[1, :2] = np.nan
    pipeline.process(Block(np.arange(2), z))
    pipeline.status()
    pipeline.reset()
    copies_among(2 * [np.zeros((100, 3))])
    alignment = Alignment(2, 1, 1)
    stamps = np.zeros(2, dtype=np.int64)
    alignment.push_block(np.arange(2), stamps, np.zeros((2, 3)))
    alignment.flush()
    alignment.is_live(0)
    receiver = Receiver(pipeline)
    for kind in SOURCES.values():
        receiver.warm(kind)
        warm_codec(kind)
    ImuTemplate("").fill(0, (0.0, 0.0, 0.0), (0.0,) * 9)


def warm_codec(kind: type[Source] | Source) -> None:
    """Compile or load the reading and patching of messages of a kind from Python."""
    # What is compiled does not depend on what the bytes are.
    kind.announced(*as_batch(b"\0"))
    kind.decode(*as_batch(b"\0"), 1)
    with contextlib.suppress(MessageError):
        kind.patch(b"\0", (0.0,))
