# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A stream through the monitor: what it would have declared, and when.

    recording, or samples at hand -> segments -> faults -> monitor -> evaluation, episodes, sinks

`Walk` is the only place where what was recorded or simulated passes a monitor; `Judge` is a walk that says what came of
it; `replay` judges a recording. The stream passes block by block; memory does not grow with it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from fdi_ros.bag.raw import Batch
from fdi_ros.bag.reader import Recording
from fdi_ros.bag.samples import Samples
from fdi_ros.compiling.notice import clock
from fdi_ros.config.config import Config
from fdi_ros.faults.fault import Fault, Injector
from fdi_ros.model.samples import Array, Block, Int
from fdi_ros.monitor.diagnostics import degraded
from fdi_ros.monitor.output import Output
from fdi_ros.monitor.pipeline import Pipeline, build_geometry
from fdi_ros.replay.episodes import Stretches
from fdi_ros.replay.evaluate import Evaluation
from fdi_ros.replay.outcomes import finite
from fdi_ros.replay.recorder import Recorder
from fdi_ros.replay.summary import (
    AutopilotText,
    BiasResult,
    DelayResult,
    Judgement,
    MonitorResult,
    ProtectionLevel,
    SampleRate,
    StreamResult,
    Summary,
)

OnProgress = Callable[[float], None]  # called with the share done, 0 to 1
PORTION = 16384  # samples judged at once where many are at hand: their outputs take little memory
LAST_SAMPLES = 1_000_000_000
"""A channel whose values end no sooner than this before the recording delivers to its end, ns."""


class Sink:
    """Takes the outputs of a pipeline as they come."""

    stops_at_events: ClassVar[bool] = False
    """Each output is to end at the sample that brings events, so that the pipeline stands right after them."""

    def tap(self, batch: Batch, rows: Int) -> None:
        """Take raw messages as they are read: those rows of a batch that are used."""

    def begin(self, samples: Samples) -> None:
        """Look at the recording before its next samples come."""

    def begin_stretch(self) -> None:
        """Note that the next samples come after a long gap, and that nothing stands declared any more."""

    def add(self, block: Block, output: Output, pipeline: Pipeline) -> None:
        """Take the next samples, with the pipeline as it is right after them."""

    def tick(self, samples: Samples, pipeline: Pipeline) -> None:
        """Look at recording and pipeline: once per period of the recording, where there is one."""


class Kept(Sink):
    """Keeps, for all samples, what a function makes of each output: arrays of as many rows."""

    def __init__(self, columns_of: Callable[[Output], Sequence[NDArray[Any]]]) -> None:
        self._columns_of = columns_of
        self._parts: list[Sequence[NDArray[Any]]] = []

    def add(self, block: Block, output: Output, pipeline: Pipeline) -> None:
        """Keep what is made of the next samples."""
        self._parts.append(self._columns_of(output))

    @property
    def columns(self) -> list[NDArray[Any]]:
        """The arrays, over all samples."""
        return [np.concatenate(column) for column in zip(*self._parts, strict=True)]


class Walk:
    """One monitor, taken as it is, on one stream, cut into stretches at gaps; with each it forgets what is declared.

    Biases stay: they are the same sensors'.
    """

    def __init__(self, pipeline: Pipeline, sinks: Sequence[Sink] = ()) -> None:
        self.pipeline, self.sinks = pipeline, sinks
        self.seconds = 0.0  # spent in the pipeline
        self._stretches = Stretches()

    def take(self, block: Block) -> None:
        """Take the next samples, of any number."""
        for first in range(0, len(block), PORTION):
            for piece in self.pieces(block[first : first + PORTION]):
                self.feed(piece)

    def pieces(self, block: Block) -> Iterator[Block]:
        """Cut the next block at gaps; each piece is to be fed before the next."""
        for anew, piece in self._stretches.cut(block):
            if anew:
                self.begin_stretch(int(piece.stamp[0]))
            yield piece

    def begin_stretch(self, first: int) -> None:
        """Forget what is declared and suspected; first: stamp of the next sample, ns."""
        self.pipeline.reset()
        for sink in self.sinks:
            sink.begin_stretch()

    def feed(self, block: Block) -> None:
        """Pass a piece without a gap through the monitor."""
        stepwise = any(sink.stops_at_events for sink in self.sinks)
        row, begun = 0, clock()
        for output in self.pipeline.steps(block) if stepwise else [self.pipeline.process(block)]:
            self.seconds += clock() - begun
            rows = slice(row, row + len(output))
            self.add(block[rows], output, rows)
            row += len(output)
            begun = clock()

    def add(self, block: Block, output: Output, rows: slice) -> None:
        """Hand on what came of some rows of the piece."""
        for sink in self.sinks:
            sink.add(block, output, self.pipeline)


class Judge(Walk):
    """A walk that says what came of it; where faults are injected, beside a monitor on the stream without faults.

    The injector has the stamp that times count from.
    """

    def __init__(self, pipeline: Pipeline, injector: Injector, sinks: Sequence[Sink] = ()) -> None:
        super().__init__(pipeline, sinks)
        self.injector = injector
        self.evaluation = Evaluation(injector, pipeline.geometry)
        self._intervals: list[tuple[float, int]] = []  # of each piece: the usual one, ns, and how many samples have it
        self._recorder = Recorder(pipeline.geometry, pipeline.noise)
        self._degraded: dict[str, str] = {}
        """What is worse than it should be without being declared: the last message on each channel and unit."""
        self._reference = Pipeline.from_config(pipeline.config) if injector.faults else None
        self._delivered = np.zeros(pipeline.geometry.n, dtype=np.int64)
        """Stamp of the last value of each channel as it was recorded, ns."""
        self._clean: Array | None = None
        """(N, 3) rate of the piece without the faults, rad/s; NaN: a gyro is at the end of its range."""

    def begin_stretch(self, first: int) -> None:
        """Forget what is declared and suspected; what happened in the stretch before is over."""
        before, after = self.injector.time(np.array([self.evaluation.last, first])).tolist()
        self.injector.refuse_between(before, after, "between them nothing is recorded")
        super().begin_stretch(first)
        if self._reference is not None:
            self._reference.reset()
        self.evaluation.begin_stretch()
        self._recorder.begin_stretch()

    def feed(self, block: Block) -> None:
        """Pass a piece without a gap through the monitor, with the faults in it."""
        if len(block) > 1:
            self._intervals.append((float(np.median(np.diff(block.stamp))), len(block)))
        for i in np.flatnonzero(np.isfinite(block.z).any(axis=0)).tolist():
            self._delivered[i] = block.stamp[np.isfinite(block.z[:, i])][-1]
        faulty = self.injector.apply(block)
        if self._reference is not None:
            # A gyro at the end of its range is wrong in both streams: what differs then is no effect of the fault.
            limit = np.array(self.pipeline.config.health.max_rate)
            saturated = (np.abs(block.z) >= limit).any(axis=1, keepdims=True)
            self._clean = np.where(saturated, np.nan, self._reference.process(block).rate)
            self.evaluation.add_unmonitored(faulty, Block(block.stamp, np.where(saturated, np.nan, block.z)))
        super().feed(faulty)
        self._degraded |= degraded(self.pipeline.status())

    def add(self, block: Block, output: Output, rows: slice) -> None:
        """Take in what came of some rows of the piece."""
        self.evaluation.add(output, None if self._clean is None else self._clean[rows])
        self._recorder.add(self.evaluation.times(output.stamp), output)
        super().add(block, output, rows)

    def judgement(self) -> Judgement:
        """Return what the monitor made of the stream so far."""
        status, evaluation, end = self.pipeline.status(), self.evaluation, self._end
        delays = zip(status.units, status.delays, status.delay_std, strict=False)
        levels = (status.protection_level, status.protection_level_after_loss)
        far = [one.name for one in status.channels if status.is_far(one)]
        monitor = MonitorResult(
            channels=tuple(evaluation.channel_at(end, i, one) for i, one in enumerate(status.channels)),
            delays=tuple(DelayResult(unit.name, late, std) for unit, late, std in delays),
            degraded=tuple(self._degraded.values()),
            bias=BiasResult(status.bias_state, tuple(status.bias), tuple(far)),
            note=status.note,
            protection_level=ProtectionLevel(*(tuple(map(finite, level)) for level in levels)),
            us_per_sample=1e6 * self.seconds / max(1, evaluation.samples),
        )
        return Judgement(status.detector, evaluation.scores(), monitor, evaluation.explained(self._recorder.story(end)))

    @property
    def _end(self) -> float:
        """Time of the last sample that all channels have which deliver to the end, s from the first message.

        Delays that are taken off, and the end of a log, leave units without the last samples.
        """
        last = self.evaluation.last
        delivered = self._delivered[self._delivered >= last - LAST_SAMPLES]
        return round(self.evaluation.time(int(delivered.min(initial=last))), 9)

    @property
    def rate(self) -> float | None:
        """Usual number of samples per second; None: too few samples to say."""
        if not self._intervals:
            return None
        step, count = np.array(sorted(self._intervals)).T
        return float(1e9 / step[np.searchsorted(np.cumsum(count), count.sum() / 2)])


# A recording ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Request:
    """What is to be replayed."""

    bag: Path  # rosbag2 folder, or one .mcap, .db3, .bag, .csv, .bin, .ulg or .tlog file
    config: Config
    faults: tuple[Fault, ...] = ()  # to be injected
    start: float = 0.0
    end: float = math.inf  # part of the recording, s from its first message
    period: int = 0  # the sinks look at the pipeline at multiples of this time of recording, ns; 0: never


def replay(request: Request, sinks: Sequence[Sink] = (), progress: OnProgress | None = None) -> Summary:
    """Replay a recording once; sinks take the outputs of the monitor, progress is called with the share done.

    `FdiError` if the recording, the settings or the faults do not fit.
    """
    begun, config = clock(), request.config
    injector = Injector(request.faults, build_geometry(config).channel_names)
    judge = Judge(Pipeline.from_config(config), injector, sinks)

    def tap(batch: Batch, rows: Int) -> None:
        for sink in sinks:
            sink.tap(batch, rows)

    with Recording(request.bag) as recording:
        span = (request.start, request.end)
        samples = Samples(recording, config, len(injector.channel_names), *span, tap, request.period)
        for block in samples.blocks():
            injector.start_stamp = samples.origin
            if len(block) and not judge.evaluation.samples:
                first, learned = float(injector.time(block.stamp[0])), config.bias.startup_bias_duration
                why = "until then the biases are learned" if learned > 0 else "there the part that is read begins"
                injector.refuse_between(-math.inf, first + learned if learned > 0 else request.start, why)
            for piece in judge.pieces(block):
                for sink in sinks:
                    sink.begin(samples)
                judge.feed(piece)
                for sink in sinks if request.period else ():
                    sink.tick(samples, judge.pipeline)
            if progress is not None:
                progress(samples.progress)
        if judge.evaluation.samples:
            last = float(injector.time(np.array(judge.evaluation.last)))
            injector.refuse_between(last, math.inf, "that is the last sample")
        stream = StreamResult(
            sample_rate=SampleRate(config.sample_rate, judge.rate),
            origin_ns=samples.origin,
            messages=samples.messages,
            malformed=samples.malformed,
            disordered=samples.disordered,
            alignment=dict(zip(samples.topics, samples.alignment.counters, strict=True)),
            damage=recording.damage.report(),
        )
        texts = [AutopilotText(judge.evaluation.time(one.stamp), one.kind, one.text) for one in recording.texts]
    judgement = judge.judgement()
    end = judgement.scores.start_s + judgement.scores.duration_s
    said = tuple(replace(one, at_s=round(one.at_s, 6)) for one in texts if judgement.scores.start_s <= one.at_s <= end)
    return Summary(**vars(judgement), bag=str(request.bag), stream=stream, seconds=clock() - begun, autopilot=said)
