# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A recording through the monitor: what it would have declared, and when.

    reading -> decoding -> alignment -> faults -> pipeline -> evaluation, sinks

The stream passes block by block; memory does not grow with the recording.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from fdi_ros.bag.raw import Batch
from fdi_ros.bag.reader import Recording
from fdi_ros.bag.samples import Samples, Tap
from fdi_ros.compiling.notice import clock
from fdi_ros.config.config import Config
from fdi_ros.faults.fault import Fault, Injector
from fdi_ros.model.samples import Block, Int
from fdi_ros.monitor.build import build_geometry
from fdi_ros.monitor.diagnostics import degraded
from fdi_ros.monitor.output import Output
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.monitor.status import ChannelStatus
from fdi_ros.replay.episodes import Stretches
from fdi_ros.replay.evaluate import Evaluation
from fdi_ros.replay.outcomes import finite
from fdi_ros.replay.recorder import Recorder
from fdi_ros.replay.summary import (
    BiasResult,
    ChannelResult,
    DelayResult,
    MonitorResult,
    ProtectionLevel,
    SampleRate,
    StreamResult,
    Summary,
)

OnProgress = Callable[[float], None]
"""Called with the share done, 0 to 1."""


class Sink:
    """Takes the outputs of a pipeline as they come."""

    stops_at_events: ClassVar[bool] = False
    """Each output is to end at the sample that brings events, so that the pipeline stands right after them."""

    def tap(self, batch: Batch, rows: Int) -> None:
        """Take raw messages as they are read: those rows of a batch that are used."""

    def begin(self, samples: Samples) -> None:
        """Look at the stream before its next samples come."""

    def begin_stretch(self) -> None:
        """Note that the next samples come after a long gap, and that nothing stands declared any more."""

    def add(self, block: Block, output: Output, pipeline: Pipeline) -> None:
        """Take the next samples, with the pipeline as it is right after them."""

    def tick(self, samples: Samples, pipeline: Pipeline) -> None:
        """Look at stream and pipeline: once per period of the recording, where there is one."""


@dataclass(frozen=True)
class Request:
    """What is to be replayed.

    Attributes
    ----------
    bag
        rosbag2 folder, or one .mcap, .db3, .bin, .ulg or .tlog file.
    config
        Settings of the monitor.
    faults
        To be injected.
    start, end
        Part of the recording, s from its first message.
    period
        The sinks look at the pipeline at multiples of this time of recording, ns; 0: never.
    """

    bag: Path
    config: Config
    faults: tuple[Fault, ...] = ()
    start: float = 0.0
    end: float = math.inf
    period: int = 0


class EvaluatedPipeline:
    """One pipeline on the stream, evaluated; where faults are injected, beside a reference pipeline without faults."""

    def __init__(self, config: Config, injector: Injector, sinks: Sequence[Sink] = ()) -> None:
        self.pipeline = Pipeline.from_config(config)
        self._max_rate = np.array(config.health.max_rate)
        self.evaluation = Evaluation(injector, self.pipeline.geometry)
        self.recorder = Recorder(self.pipeline.geometry, self.pipeline.noise)
        self.seconds = 0.0
        """Spent in the pipeline."""
        self.sinks = sinks
        self.degraded: dict[str, str] = {}
        """What is worse than it should be without being declared: the last message on each channel and unit."""
        self._reference = Pipeline.from_config(config) if injector.faults else None

    def begin_stretch(self) -> None:
        """Forget what is declared and suspected: a new stretch begins. Biases stay, they are the same sensors'."""
        self.pipeline.reset()
        if self._reference is not None:
            self._reference.reset()
        self.evaluation.begin_stretch()
        self.recorder.begin_stretch()
        for sink in self.sinks:
            sink.begin_stretch()

    def feed(self, faulty: Block, healthy: Block, samples: Samples) -> None:
        """Take the next block, with the faults and without."""
        clean = None
        for sink in self.sinks:
            sink.begin(samples)
        if self._reference is not None:
            # A gyro at the end of its range is wrong in both streams: what differs then is no effect of the fault.
            saturated = (np.abs(healthy.z) >= self._max_rate).any(axis=1, keepdims=True)
            clean = np.where(saturated, np.nan, self._reference.process(healthy).rate)
            self.evaluation.add_unmonitored(faulty, Block(healthy.stamp, np.where(saturated, np.nan, healthy.z)))
        row = 0
        begun = clock()
        for output in self._outputs(faulty):
            self.seconds += clock() - begun
            rows = slice(row, row + len(output))
            self.evaluation.add(output, None if clean is None else clean[rows])
            self.recorder.add(self.evaluation.times(output.stamp), output)
            for sink in self.sinks:
                sink.add(faulty[rows], output, self.pipeline)
            row += len(output)
            begun = clock()
        self.degraded |= degraded(self.pipeline.status())
        if samples.period:
            for sink in self.sinks:
                sink.tick(samples, self.pipeline)

    def _outputs(self, block: Block) -> Iterable[Output]:
        if any(sink.stops_at_events for sink in self.sinks):
            return self.pipeline.steps(block)
        return [self.pipeline.process(block)]

    def summary(self, bag: str, stream: StreamResult, seconds: float) -> Summary:
        """Return the figures, with what belongs to the replay as a whole."""
        story = self.evaluation.explained(self.recorder.story())
        scores, detector = self.evaluation.scores(), self.pipeline.status().detector
        return Summary(bag, detector, scores, self._result(), stream, seconds, story)

    def _result(self) -> MonitorResult:
        status = self.pipeline.status()
        delays = zip(status.units, status.delays, status.delay_std, strict=False)
        return MonitorResult(
            channels=tuple(map(self._channel, status.channels)),
            delays=tuple(DelayResult(unit.name, late, std) for unit, late, std in delays),
            degraded=tuple(self.degraded.values()),
            bias=BiasResult(status.bias_state, tuple(status.bias)),
            note=status.note,
            protection_level=ProtectionLevel(
                tuple(map(finite, status.protection_level)), tuple(map(finite, status.protection_level_after_loss))
            ),
            us_per_sample=1e6 * self.seconds / max(1, self.evaluation.samples),
        )

    def _channel(self, channel: ChannelStatus) -> ChannelResult:
        since = round(self.evaluation.time(channel.since), 9) if channel.since else None
        noise = channel.noise or None
        return ChannelResult(channel.name, channel.state.name, since, channel.reason.value, channel.drift, noise)


def replay(request: Request, sinks: Sequence[Sink] = (), progress: OnProgress | None = None) -> Summary:
    """Replay a recording once.

    Parameters
    ----------
    request
        What is to be replayed.
    sinks
        Take the outputs of the monitor.
    progress
        Called with the share done.

    Raises
    ------
    FdiError
        If the recording, the settings or the faults do not fit.
    """
    begun = clock()
    injector = Injector(request.faults, build_geometry(request.config).channel_names)
    pipeline = EvaluatedPipeline(request.config, injector, sinks)
    stream = _stream(request, injector, pipeline, progress)
    return pipeline.summary(str(request.bag), stream, clock() - begun)


class StampStatistics:
    """First and last stamp of a stream, and its usual sample rate."""

    def __init__(self) -> None:
        self.first: int | None = None
        self.last: int | None = None
        """Stamps, ns."""
        self._usual: list[tuple[float, int]] = []

    def add(self, stamp: NDArray[np.int64]) -> None:
        """Take in the stamps (N,) of the next samples, ns."""
        if not len(stamp):
            return
        if len(stamp) > 1:
            self._usual.append((float(np.median(np.diff(stamp))), len(stamp)))
        self.first = int(stamp[0]) if self.first is None else self.first
        self.last = int(stamp[-1])

    @property
    def rate(self) -> float | None:
        """Usual number of samples per second; None: too few samples to say."""
        if not self._usual:
            return None
        step, count = np.array(sorted(self._usual)).T
        return float(1e9 / step[np.searchsorted(np.cumsum(count), count.sum() / 2)])


def _tap_of(sinks: Sequence[Sink]) -> Tap:
    def tap(batch: Batch, rows: Int) -> None:
        for sink in sinks:
            sink.tap(batch, rows)

    return tap


def _stream(
    request: Request,
    injector: Injector,
    pipeline: EvaluatedPipeline,
    progress: OnProgress | None,
) -> StreamResult:
    """Pass the recording through the pipeline; return what is found about the stream itself."""
    stamps, stretches = StampStatistics(), Stretches()
    with Recording(request.bag) as recording:
        channels = len(injector.channel_names)
        span = (request.start, request.end)
        samples = Samples(recording, request.config, channels, *span, _tap_of(pipeline.sinks), request.period)
        for block in samples.blocks():
            injector.start_stamp = samples.origin
            if len(block) and stamps.first is None:
                injector.check_start(request.start, int(block.stamp[0]), request.config.bias.startup_bias_duration)
            for anew, part in stretches.cut(block):
                if anew:
                    assert stamps.last is not None
                    injector.check_gap(stamps.last, int(part.stamp[0]))
                    pipeline.begin_stretch()
                stamps.add(part.stamp)
                pipeline.feed(injector.apply(part), part, samples)
            if progress is not None:
                progress(samples.progress)
        if stamps.last is not None:
            injector.check_end(stamps.last)
        return StreamResult(
            sample_rate=SampleRate(request.config.sample_rate, stamps.rate),
            messages=samples.messages,
            malformed=samples.malformed,
            disordered=samples.disordered,
            alignment=dict(zip(samples.topics, samples.alignment.counters, strict=True)),
            damage=recording.damage.report(),
        )
