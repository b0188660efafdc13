"""A recording through the monitor: what it would have declared, and when.

    reading -> decoding -> alignment -> faults -> pipeline -> evaluation, sinks

The stream passes block by block; memory does not grow with the recording.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from fdi_ros.bag.reader import Recording
from fdi_ros.bag.samples import Samples, Tap
from fdi_ros.config.config import Config
from fdi_ros.detectors import DETECTORS
from fdi_ros.errors import FdiError
from fdi_ros.faults.injection import Injector
from fdi_ros.faults.kinds import Fault
from fdi_ros.model.block import Block
from fdi_ros.monitor.build import build_geometry
from fdi_ros.monitor.diagnostics import degraded
from fdi_ros.monitor.output import ChannelStatus, Output
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.replay.evaluate import Evaluation

Show = Callable[[float], None]
"""Is told the share done, 0 to 1."""


class Sink:
    """Takes what the monitor says, as it says it."""

    stops_at_events: ClassVar[bool] = False
    """Each output is to end at the sample that brings events, so that the pipeline stands right after them."""

    def begin(self, samples: Samples) -> None:
        """Look at the stream before its next samples come."""

    def add(self, block: Block, output: Output, pipeline: Pipeline) -> None:
        """Take the next samples; the pipeline stands right after them."""

    def tick(self, samples: Samples, pipeline: Pipeline) -> None:
        """Look at stream and pipeline: once a period of the recording, where there is one."""


@dataclass(frozen=True)
class Request:
    """What is to be replayed.

    Attributes
    ----------
    bag
        rosbag2 folder, or one .mcap, .db3, .bin or .ulg file.
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


class Monitor:
    """One pipeline on the stream, scored; where faults are injected, beside its twin on the stream without them."""

    def __init__(self, config: Config, injector: Injector, sinks: Sequence[Sink] = ()) -> None:
        self.pipeline = Pipeline.from_config(config)
        self._max_rate = np.array(config.health.max_rate)
        self.evaluation = Evaluation(injector, self.pipeline.geometry)
        self.seconds = 0.0
        """Spent in the pipeline."""
        self.sinks = sinks
        self.degraded: dict[str, str] = {}
        """What was found worse than it should be, beside what was declared: the last words on each channel and unit."""
        self._twin = Pipeline.from_config(config) if injector.faults else None

    def feed(self, faulty: Block, sound: Block, samples: Samples) -> None:
        """Judge the next block."""
        clean = None
        for sink in self.sinks:
            sink.begin(samples)
        if self._twin is not None:
            # A gyro at the end of its range is wrong in both streams: what differs then is no effect of the fault.
            saturated = (np.abs(sound.z) >= self._max_rate).any(axis=1, keepdims=True)
            clean = np.where(saturated, np.nan, self._twin.process(sound).rate)
            self.evaluation.add_unmonitored(faulty, Block(sound.stamp, np.where(saturated, np.nan, sound.z)))
        row = 0
        begun = time.perf_counter()
        for output in self._outputs(faulty):
            self.seconds += time.perf_counter() - begun
            rows = slice(row, row + len(output))
            self.evaluation.add(output, None if clean is None else clean[rows])
            for sink in self.sinks:
                sink.add(faulty[rows], output, self.pipeline)
            row += len(output)
            begun = time.perf_counter()
        self.degraded |= degraded(self.pipeline.status())
        if samples.period:
            for sink in self.sinks:
                sink.tick(samples, self.pipeline)

    def _outputs(self, block: Block) -> Iterable[Output]:
        if any(sink.stops_at_events for sink in self.sinks):
            return self.pipeline.steps(block)
        return [self.pipeline.process(block)]

    def summary(self) -> dict[str, Any]:
        """Return the figures, ready for JSON."""
        status = self.pipeline.status()
        figures = self.evaluation.summary()
        return {
            "detector": status.detector,
            **figures,
            "channels": [_channel(channel, self._since(channel)) for channel in status.channels],
            "delays": [
                {"unit": unit.name, "late_s": late, "std_s": std}
                for unit, late, std in zip(status.units, status.delays, status.delay_std, strict=False)
            ],
            "degraded": list(self.degraded.values()),
            "bias": {"state": status.bias_state, "value": list(status.bias)},
            "note": status.note,
            "protection_level": {
                "at_end": _finite(status.protection_level),
                "after_one_more_loss": _finite(status.protection_level_after_loss),
            },
            "us_per_sample": 1e6 * self.seconds / max(1, figures["samples"]),
        }

    def _since(self, channel: ChannelStatus) -> float | None:
        """When a channel came into its state, s from the first message; None: it began in it."""
        return round(self.evaluation.time(channel.since), 9) if channel.since else None


def _channel(channel: ChannelStatus, since: float | None) -> dict[str, Any]:
    return {
        "name": channel.name,
        "state": channel.state.name,
        "since_s": since,
        "reason": channel.reason.value,
        "bias_followed": channel.drift,
        "noise": channel.noise or None,
    }


def _finite(values: Sequence[float]) -> list[float | None]:
    """Values for JSON, which knows no infinity: None where there is no level."""
    return [value if math.isfinite(value) else None for value in values]


def replay(
    request: Request, sinks: Sequence[Sink] = (), tap: Tap | None = None, progress: Show | None = None
) -> dict[str, Any]:
    """Replay a recording once.

    Parameters
    ----------
    request
        What is to be replayed.
    sinks
        Take what the monitor says.
    tap
        Is shown the raw messages.
    progress
        Is told how far it is.

    Returns
    -------
    The summary, ready for JSON.

    Raises
    ------
    FdiError
        If the recording, the settings or the faults do not fit.
    """
    begun = time.perf_counter()
    injector = Injector(request.faults, build_geometry(request.config).channel_names)
    monitor = Monitor(request.config, injector, sinks)
    about = _stream(request, injector, [monitor], tap, progress)
    return {"bag": str(request.bag), **monitor.summary(), **about, "seconds": time.perf_counter() - begun}


def compare(
    request: Request, progress: Show | None = None, watch: Callable[[str], Sequence[Sink]] | None = None
) -> list[dict[str, Any]]:
    """Replay a recording once with all detectors side by side.

    Parameters
    ----------
    request
        What is to be replayed.
    progress
        Is told how far it is.
    watch
        Gives the sinks of each detector that runs.

    Returns
    -------
    A summary each; of a detector that cannot run on this geometry: its name and the reason under ``refused``.
    """
    injector = Injector(request.faults, build_geometry(request.config).channel_names)
    monitors, entries = [], []
    for name in DETECTORS:
        monitor = _monitor(request.config.replaced({"detector.name": name}), injector)
        if watch is not None and isinstance(monitor, Monitor):
            monitor.sinks = watch(name)
        entries.append(monitor if isinstance(monitor, Monitor) else {"detector": name, "refused": monitor})
        monitors += [monitor] if isinstance(monitor, Monitor) else []
    about = _stream(request, injector, monitors, None, progress)
    return [{**entry.summary(), **about} if isinstance(entry, Monitor) else entry for entry in entries]


def _monitor(config: Config, injector: Injector) -> Monitor | str:
    try:
        return Monitor(config, injector)
    except FdiError as error:
        return str(error)


class Steps:
    """Time from sample to sample of a stream."""

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
        """Usual number of samples a second; None if there are too few to tell."""
        if not self._usual:
            return None
        step, count = np.array(sorted(self._usual)).T
        return float(1e9 / step[np.searchsorted(np.cumsum(count), count.sum() / 2)])


def _stream(
    request: Request, injector: Injector, monitors: Sequence[Monitor], tap: Tap | None, progress: Show | None
) -> dict[str, Any]:
    """Pass the recording through the monitors; return what is to be said about the stream itself."""
    steps = Steps()
    with Recording(request.bag) as recording:
        channels = len(injector.channel_names)
        span = (request.start, request.end)
        samples = Samples(recording, request.config, channels, *span, tap, request.period)
        for block in samples.blocks():
            injector.start_stamp = samples.origin
            if len(block) and steps.first is None:
                injector.check_start(request.start, int(block.stamp[0]), request.config.bias.startup_bias_duration)
            steps.add(block.stamp)
            faulty = injector.apply(block)
            for monitor in monitors:
                monitor.feed(faulty, block, samples)
            if progress is not None:
                progress(samples.progress)
        if steps.last is not None:
            injector.check_end(steps.last)
        counters = samples.alignment.counters
        return {
            "sample_rate": {"configured_hz": request.config.sample_rate, "recorded_hz": steps.rate},
            "messages": samples.messages,
            "malformed": samples.malformed,
            "disordered": samples.disordered,
            "alignment": dict(zip(samples.topics, counters, strict=True)),
            "damage": list(recording.damage.report()),
        }
