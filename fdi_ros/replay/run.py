# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Passes a recorded or simulated stream through a monitor.

    recording or samples -> stretches -> faults -> monitor -> evaluation, episodes, sinks

`Walk` passes a stream through one monitor, block by block, in bounded memory. `Judge` is a walk with
a result. `replay` judges a recording, and `read` only reads a recording.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from fdi_ros.bag.flight_context import FlightContext
from fdi_ros.bag.raw import Batch, LogText
from fdi_ros.bag.reader import Recording
from fdi_ros.bag.samples import Samples
from fdi_ros.compiling.notice import clock
from fdi_ros.config.config import Config
from fdi_ros.core.sources import source_of
from fdi_ros.core.states import Reason
from fdi_ros.faults.fault import Fault, Injector, fault_from, parse_fault
from fdi_ros.inspection.starting_config import assumed_config, starting_config_of
from fdi_ros.inspection.values import Values
from fdi_ros.model.geometry import one_of_words
from fdi_ros.model.quantity import RATE
from fdi_ros.model.samples import Array, Block, Int
from fdi_ros.monitor.diagnostics import degraded
from fdi_ros.monitor.output import Output
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.monitor.soundness import (
    STAYED_OUT,
    RateHealth,
    UnitHealth,
    checked_share,
)
from fdi_ros.monitor.status import UNUSUAL_ERRORS, Status
from fdi_ros.replay.episodes import EPISODE_TIMES, Episode, Story, join_halves, pieces
from fdi_ros.replay.health import (
    Deliveries,
    Holes,
    UsualNoise,
    with_context,
    with_delivery,
)
from fdi_ros.replay.outcomes import Evaluation, finite
from fdi_ros.replay.recorder import Recorder
from fdi_ros.replay.recurring import (
    NoisyTime,
    join_noise,
    join_recurring,
    with_all_candidates,
)
from fdi_ros.replay.span_means import SpanMeans, Temperature, with_warming
from fdi_ros.replay.summary import (
    AutopilotText,
    BiasResult,
    ChannelResult,
    DelayResult,
    FarBias,
    Judgement,
    MonitorResult,
    ProtectionLevel,
    SampleRate,
    StreamResult,
    Summary,
)
from fdi_ros.replay.verdict import SILENT_TO_END, verdict_of

OnProgress = Callable[[float], None]
"""Called with the share done, 0 to 1."""
Source = str | PathLike[str]
ConfigSource = Config | Source | None
"""Settings, or a parameter file. None: the settings that ``fdi inspect`` writes."""
PORTION = 16384
"""Largest number of samples that are judged at once, which bounds the memory for their outputs."""

BY_VALUES = tuple(
    reason.value
    for reason in (Reason.NON_FINITE, Reason.STUCK, Reason.FROZEN, Reason.OLD)
)
"""Reasons that each wrong value shows. Such a declaration ends ``clean_time`` after the last of them."""
TOGETHER_S = 1.0
"""Time within which units begin to repeat one value at the same time, s."""


class Sink:
    """Receives the outputs of a pipeline, block by block."""

    stops_at_events: ClassVar[bool] = False
    """Whether each output ends at a sample with events, so that the pipeline has the state after them."""
    period: ClassVar[int] = 0
    """Period of `tick` in the time of recording, ns. 0: never."""

    def tap(self, batch: Batch, rows: Int) -> None:
        """Receive raw messages: the rows of a batch that are used."""

    def begin(self, samples: Samples) -> None:
        """Prepare for the next samples of a recording."""

    def begin_stretch(self) -> None:
        """Begin a stretch after a long gap, with all declarations cleared."""

    def add(self, block: Block, output: Output, pipeline: Pipeline) -> None:
        """Receive the next samples, with the pipeline in its state after them."""

    def tick(self, samples: Samples, pipeline: Pipeline) -> None:
        """Look at recording and pipeline, once per `period`."""


class Kept(Sink):
    """Keeps columns of all outputs, which a function derives from each output."""

    def __init__(self, columns_of: Callable[[Output], Sequence[NDArray[Any]]]) -> None:
        self._columns_of = columns_of
        self._parts: list[Sequence[NDArray[Any]]] = []

    def add(self, block: Block, output: Output, pipeline: Pipeline) -> None:
        """Keep the columns of the next samples."""
        self._parts.append(self._columns_of(output))

    @property
    def columns(self) -> list[NDArray[Any]]:
        """The columns over all samples."""
        return [np.concatenate(column) for column in zip(*self._parts, strict=True)]


class Walk:
    """Passes one stream through one monitor, and clears all declarations at long gaps.

    Biases are kept, because the sensors are the same.
    """

    def __init__(self, pipeline: Pipeline, sinks: Sequence[Sink] = ()) -> None:
        self.pipeline = pipeline
        self.sinks = sinks
        self.seconds = 0.0
        """Time spent in the pipeline, s."""
        self._last: int | None = None
        """Stamp of the last sample, ns."""

    def take(self, block: Block) -> None:
        """Take any number of samples."""
        for first in range(0, len(block), PORTION):
            for piece in self.pieces(block[first : first + PORTION]):
                self.feed(piece)

    def pieces(self, block: Block) -> Iterator[Block]:
        """Cut a block at gaps. The caller feeds each piece before the next one."""
        if not len(block):
            yield block
        for rows in pieces(block.stamp, EPISODE_TIMES.stretch_gap):
            first = int(block.stamp[rows.start])
            if (
                self._last is not None
                and first - self._last > EPISODE_TIMES.stretch_gap * 1e9
            ):
                self.begin_stretch(first)
            self._last = int(block.stamp[rows.stop - 1])
            yield block[rows]

    def begin_stretch(self, first: int) -> None:
        """Clear declarations and suspicions. ``first``: stamp of the next sample, ns."""
        self.pipeline.reset()
        for sink in self.sinks:
            sink.begin_stretch()

    def feed(self, block: Block) -> None:
        """Pass a piece without a long gap through the monitor."""
        stepwise = any(sink.stops_at_events for sink in self.sinks)
        row = 0
        begun = clock()
        for output in (
            self.pipeline.steps(block) if stepwise else [self.pipeline.process(block)]
        ):
            self.seconds += clock() - begun
            rows = slice(row, row + len(output))
            self.add(block[rows], output, rows)
            row += len(output)
            begun = clock()

    def add(self, block: Block, output: Output, rows: slice) -> None:
        """Pass the output for some rows of a piece to the sinks."""
        for sink in self.sinks:
            sink.add(block, output, self.pipeline)


class Judge(Walk):
    """A walk with a result.

    With injected faults, a second monitor works on the stream without faults, for comparison.
    """

    def __init__(
        self, pipeline: Pipeline, injector: Injector, sinks: Sequence[Sink] = ()
    ) -> None:
        super().__init__(pipeline, sinks)
        self.injector = injector
        self.evaluation = Evaluation(
            injector, pipeline.geometry, pipeline.channel_names
        )
        self.holes = Holes()
        """Times in which no unit delivered."""
        self._intervals: list[tuple[float, int]] = []
        """Median interval, ns, and number of samples of each piece."""
        self._recorders = [
            Recorder(half.geometry, half.noise, half.quantity)
            for half in pipeline.halves
        ]
        self._means = [
            SpanMeans(half.geometry, half.quantity) for half in pipeline.halves
        ]
        self._degraded: dict[str, str] = {}
        """Last message on each degraded channel or unit, by name."""
        self._reference = pipeline.twin() if injector.faults else None
        self._values = [
            Values(half.geometry.n, half.quantity) for half in pipeline.halves
        ]
        self._noise = [UsualNoise(half.geometry.axes) for half in pipeline.halves]
        self._delivered = np.zeros(pipeline.geometry.n, dtype=np.int64)
        """Stamp of the last recorded value of each channel, ns."""
        self._clean: Array | None = None
        """(N, 3) rate of the piece without the faults, rad/s. NaN: a gyro is saturated."""

    def begin_stretch(self, first: int) -> None:
        """Clear declarations and suspicions, and end the episodes of the stretch before."""
        before, after = self.injector.time(
            np.array([self.evaluation.last, first])
        ).tolist()
        self.injector.refuse_between(before, after, "between them nothing is recorded")
        super().begin_stretch(first)
        if self._reference is not None:
            self._reference.reset()
        self.evaluation.begin_stretch()
        for recorder in self._recorders:
            recorder.begin_stretch()

    def feed(self, block: Block) -> None:
        """Pass a piece without a long gap through the monitor, with the faults injected."""
        block = self.pipeline.arranged(block)
        self.holes.add(block.stamp)
        if len(block) > 1:
            interval = float(np.median(np.diff(block.stamp)))
            self._intervals.append((interval, len(block)))
        there = np.isfinite(block.z)
        for i in np.flatnonzero(there.any(axis=0)).tolist():
            self._delivered[i] = block.stamp[there[:, i]][-1]
        faulty = self.injector.apply(block)
        for values, half in zip(self._values, faulty.halves, strict=True):
            values.add(half.z)
        if self._reference is not None:
            # A saturated gyro is wrong in both streams, so that their difference means nothing.
            limit = np.array(self.pipeline.config.health.max_rate)
            saturated = (np.abs(block.z) >= limit).any(axis=1, keepdims=True)
            self._clean = np.where(
                saturated, np.nan, self._reference.process(block).rate
            )
            self.evaluation.add_unmonitored(
                faulty, Block(block.stamp, np.where(saturated, np.nan, block.z))
            )
        super().feed(faulty)
        self._degraded |= degraded(self.pipeline.status())

    def add(self, block: Block, output: Output, rows: slice) -> None:
        """Evaluate and record the output for some rows of a piece."""
        self.evaluation.add(output, None if self._clean is None else self._clean[rows])
        time = np.round(self.injector.time(output.stamp), 9)
        for recorder, noise, half in zip(
            self._recorders, self._noise, output.halves, strict=True
        ):
            recorder.add(time, half)
            noise.add(half)
        for means, values, half in zip(
            self._means, block.halves, output.halves, strict=True
        ):
            # The states of the accelerometers stand behind those of the gyros.
            means.add(time, values.z, half.state[:, : half.n])
        super().add(block, output, rows)

    def judgement(self) -> Judgement:
        """Return the result so far."""
        status = self.pipeline.status()
        evaluation = self.evaluation
        end = self._end
        delays = zip(status.units, status.delays, status.delay_std, strict=False)
        levels = (status.protection_level, status.protection_level_after_loss)
        channels = tuple(self._channels(end, status))
        monitor = MonitorResult(
            channels=channels,
            units=tuple(self._units(status)),
            delays=tuple(
                DelayResult(unit.name, late, std) for unit, late, std in delays
            ),
            degraded=tuple(self._degraded.values()),
            bias=_bias_result(status),
            note=status.note,
            protection_level=ProtectionLevel(
                *(tuple(map(finite, level)) for level in levels)
            ),
            us_per_sample=1e6 * self.seconds / max(1, evaluation.samples),
            rate=self._rate_health(),
        )
        story = self._story(status)
        rate = replace(monitor.rate, frozen=_frozen_when(monitor, story))
        return Judgement(
            status.detector,
            evaluation.scores(),
            replace(monitor, rate=rate),
            story,
        )

    def _story(self, status: Status) -> Story:
        """Return the episodes of both halves, with the faults injected into them."""
        units = {
            name: unit
            for half in self.pipeline.halves
            for name, unit in zip(
                half.geometry.channel_names, half.geometry.unit_of, strict=True
            )
        }
        stories = [one.story(self._end) for one in self._recorders]
        story = _joined(stories, units, self._noisy_times(status))
        return replace(story, episodes=tuple(map(self._completed, story.episodes)))

    def _completed(self, episode: Episode) -> Episode:
        """Return an episode with all its candidates, injected faults and last wrong value."""
        one = with_all_candidates(episode, self._words_for)
        known = [
            followed.fault
            for followed in self.evaluation.faults
            if followed.explains(one.start_s, one.ever)
        ]
        injected = tuple(f"{fault.kind.name} on {fault.channel}" for fault in known)
        wrong_to = None
        if one.declares and not one.stands and one.evidence.reason in BY_VALUES:
            clean_time = self.pipeline.config.decision.clean_time
            wrong_to = round(max(one.end_s - clean_time, one.since_s), 9)
        return replace(one, injected=injected, wrong_to_s=wrong_to)

    def _words_for(self, names: Sequence[str]) -> str:
        """Return the words for a set of channels of one half."""
        half = next(
            half
            for half in self.pipeline.halves
            if names[0] in half.geometry.channel_names
        )
        geometry = half.geometry
        channels = [geometry.channel_names.index(name) for name in names]
        return one_of_words(geometry, channels, half.quantity.name)

    def explained(self, story: Story, context: FlightContext, origin: int) -> Story:
        """Return a story with the errors that follow a temperature of the flight log.

        ``origin``: stamp of the first message, ns.
        """
        source = source_of(self.pipeline.config)
        courses = {
            name: context.temperatures[topic]
            for name, topic in zip(source.names, source.topics, strict=True)
            if topic in context.temperatures
        }
        temperatures = {
            name: Temperature(np.asarray((one.stamp - origin) * 1e-9), one.value)
            for name, one in courses.items()
        }
        means = {
            half.quantity.unit: one
            for half, one in zip(self.pipeline.halves, self._means, strict=True)
        }
        return with_warming(story, means, temperatures)

    def _rate_health(self) -> RateHealth:
        """Return how the fused rate was published."""
        evaluation = self.evaluation
        missing = evaluation.without_rate
        return RateHealth(
            missing_s=missing / (self.rate or math.inf),
            missing_from_s=evaluation.without_rate_from,
            share=1.0 - missing / max(1, evaluation.samples),
        )

    def _channels(self, end: float, status: Status) -> Iterator[ChannelResult]:
        """Yield the result of each channel. ``end``: time of its state, s."""
        evaluation = self.evaluation
        samples = max(1, self._values[0].samples)
        finite_values, saturated = (
            np.concatenate([getattr(one, name) for one in self._values]).tolist()
            for name in ("finite", "saturated")
        )
        units = [
            unit for half in self.pipeline.halves for unit in half.geometry.unit_of
        ]
        residual_rms = evaluation.residual_rms
        usual = [usual for one in self._noise for usual in one.result()]
        names = [one.name for one in status.channels]
        followed = {
            name: (own.followed, own.followed_std)
            for name, own in zip(names, usual, strict=True)
            if own.followed
        }
        scales = status.certain_scale_errors(followed)
        for i, one in enumerate(status.channels):
            changes = [
                change for change in evaluation.events if change.channel == one.name
            ]
            before = [change for change in changes if change.at_s <= end]
            state = one.state.name
            since = None
            reason = one.reason.value
            if before:
                state = before[-1].state
                since = before[-1].at_s
                reason = before[-1].reason
            elif changes:
                state = changes[0].before
                reason = ""
            delivered = float(finite_values[i]) / samples
            checked = checked_share(one.checked, one.finite)
            noisy = one.longest_noisy
            yield ChannelResult(
                name=one.name,
                unit=units[i],
                measured_in=one.unit,
                checked=checked,
                delivered=delivered,
                spikes=one.counts["spikes"],
                saturated_s=float(saturated[i]) / (self.rate or math.inf),
                noisy_s=noisy.seconds,
                noisy_from_s=evaluation.time(noisy.since) if noisy.since else 0.0,
                noisy_times=noisy.times,
                own_noise_rad_s=finite(usual[i].noise),
                residual_rms_rad_s=residual_rms[i],
                doubt=_doubt_words(state, since, reason, end),
                state=state,
                since_s=since,
                reason=reason,
                repeated=one.counts["stuck"] / max(1, one.finite),
                drift=status.drift_since_rest(one),
                scale=scales[one.name].size,
                scale_seen=scales[one.name].seen,
                noise=one.noise or None,
                unchecked=1.0 - checked,
            )

    def _noisy_times(self, status: Status) -> list[NoisyTime]:
        """Return the longest and the last time of noise of each channel."""
        time = self.evaluation.time
        return [
            NoisyTime(one.name, one.unit, time(spell.since), time(spell.until))
            for one in status.channels
            for spell in dict.fromkeys((one.longest_noisy, one.last_noisy))
            if spell.since
        ]

    def _units(self, status: Status) -> Iterator[UnitHealth]:
        """Yield the health of each unit, or of the one topic with all channels."""
        source = source_of(self.pipeline.config)
        measured = {unit.name: unit for unit in status.units if unit.against}
        # The status names copies with their topics: "imu_2 (/imu_2/data)".
        copies = {second: first for first, second in status.copies}
        for name, topic in zip(source.names, source.topics, strict=True):
            health = UnitHealth(
                name=name, topic=topic, copy_of=copies.get(f"{name} ({topic})", "")
            )
            if unit := measured.get(name):
                # The same reference as in the notes, which are the monitor's.
                health = replace(
                    health,
                    delay_s=unit.delay,
                    delay_std_s=unit.delay_std,
                    delay_to=unit.against,
                )
            yield health

    @property
    def _end(self) -> float:
        """Time of the last sample of all channels that deliver to the end, s from the first message.

        A corrected delay or the end of a log leaves some units without the last samples.
        """
        last = self.evaluation.last
        to_end = round(SILENT_TO_END * 1e9)
        delivered = self._delivered[self._delivered >= last - to_end]
        return round(self.evaluation.time(int(delivered.min(initial=last))), 9)

    @property
    def rate(self) -> float | None:
        """Median number of samples per second, Hz. None: too few samples."""
        if not self._intervals:
            return None
        step, count = np.array(sorted(self._intervals)).T
        middle = np.searchsorted(np.cumsum(count), count.sum() / 2)
        return float(1e9 / step[middle])


def _frozen_when(monitor: MonitorResult, story: Story) -> tuple[str, ...]:
    """Return all units, if each repeated one value when the fused rate was missing first."""
    since = monitor.rate.missing_from_s
    if since is None:
        return ()
    frozen = {
        name
        for one in story.episodes
        if one.evidence.reason == Reason.FROZEN.value
        and abs(one.start_s - since) < TOGETHER_S
        for name in one.channels
    }
    gyros = [one for one in monitor.channels if one.measured_in == RATE.unit]
    if not frozen.issuperset(one.name for one in gyros):
        return ()
    return tuple(dict.fromkeys(one.unit or one.name for one in gyros))


def _joined(
    stories: Sequence[Story], unit_of: Mapping[str, str], noisy: Sequence[NoisyTime]
) -> Story:
    """Merge the stories of gyros and accelerometers, with the stretches of the gyros.

    ``unit_of``: unit of each channel. ``noisy``: times of noise of all channels.
    """
    episodes = [one for story in stories for one in story.episodes]
    episodes.sort(key=lambda one: (one.start_s, one.since_s))
    joined = join_recurring(episodes, unit_of)
    joined = join_noise(joined, noisy, stories[0].stretches, unit_of)
    return Story(
        stories[0].stretches,
        tuple(join_halves(joined, unit_of)),
        sum(story.more for story in stories),
    )


def _doubt_words(state: str, since: float | None, reason: str, end: float) -> str:
    """Return why an undeclared channel is not used at the end. Empty: it is used."""
    if state == "EXCLUDED":
        return f"{STAYED_OUT}: {reason}"
    if state != "SUSPECT" or since is None or end - since < SILENT_TO_END:
        return ""
    return f"remained suspected from {since:.1f} s to the end ({reason})"


# A recording


def read(
    path: Source, config: ConfigSource = None, start: float = 0.0, end: float = math.inf
) -> Iterator[Block]:
    """Read a recording block by block, aligned as the node aligns its messages.

    Parameters
    ----------
    path
        rosbag2 folder, or one .mcap, .db3, .bag, .csv, .tsv, .bin, .ulg or .tlog file.
    config
        Settings, or a ROS 2 parameter file. None: the settings that ``fdi inspect`` writes.
    start, end
        Part to read, s from the first message.

    Returns
    -------
    Blocks of consecutive samples for `Pipeline.process`: ``stamp`` (N,), ns, and ``z`` (N, n), rad/s.

    Raises
    ------
    FdiError
        If the recording cannot be read, or lacks a topic of the settings.
    """
    bag = Path(path)
    if config is None:
        settings = Config.from_parameters(
            starting_config_of(bag, f"{bag}: no settings for it").parameters
        )
    else:
        settings = Config.of(config)
    # Raise errors now, not with the first block.
    recording = Recording(bag)
    samples = Samples(recording, settings, start, end)

    def blocks() -> Iterator[Block]:
        with recording:
            yield from samples.blocks()

    return blocks()


OneFault = Fault | str | Mapping[str, Any]


def replay(
    path: Source,
    config: ConfigSource = None,
    faults: OneFault | Sequence[OneFault] = (),
    start: float = 0.0,
    end: float = math.inf,
    *,
    sinks: Sequence[Sink] = (),
    progress: OnProgress | None = None,
) -> Summary:
    """Replay a recording as ``fdi replay`` does.

    Parameters
    ----------
    path, start, end
        As for `read`.
    config
        Settings, or a ROS 2 parameter file. None: the settings that ``fdi inspect`` writes, if all
        units are mounted alike.
    faults
        One fault or several, each as text or as a mapping:
        ``"channel=imu_2.y kind=bias size=0.2 start=30"`` or
        ``{"channel": "imu_2.y", "kind": "bias", "size": 0.2, "start": 30}``.
    sinks
        Receive the outputs of the monitor.
    progress
        Called with the share done, 0 to 1.

    Returns
    -------
    Verdict, declarations, results for the faults, and the state of the monitor at the end.

    Raises
    ------
    FdiError
        If recording, settings or faults do not fit, or no settings are given and none can be
        assumed.
    """
    bag = Path(path)
    begun = clock()
    unused: tuple[tuple[str, str], ...] = ()
    if config is None:
        assumed = assumed_config(bag)
        settings = assumed.config
        unused = assumed.unused
    else:
        settings = Config.of(config)
    deliveries = Deliveries(len(settings.topics), start)
    taps = [*(sink.tap for sink in sinks), deliveries.tap]
    period = max((sink.period for sink in sinks), default=0)
    with Recording(bag) as recording:
        samples = Samples(recording, settings, start, end, taps, period)
        judge = _judged(samples, settings, _faults(faults), start, sinks, progress)
        stream = _stream_result(samples, settings, judge)
        texts = recording.texts
        context = recording.context
    judgement = judge.judgement()
    units = [
        with_context(with_delivery(unit, delivery), context)
        for unit, delivery in zip(
            judgement.monitor.units, deliveries.result(), strict=True
        )
    ]
    summary = Summary(
        detector=judgement.detector,
        scores=judgement.scores,
        monitor=replace(judgement.monitor, units=tuple(units)),
        story=judge.explained(judgement.story, context, stream.origin_ns or 0),
        bag=str(bag),
        stream=stream,
        seconds=clock() - begun,
        autopilot=tuple(_autopilot_texts(texts, judge)),
        context=context,
    )
    return with_unused(summary, unused)


def _judged(
    samples: Samples,
    settings: Config,
    faults: Sequence[Fault],
    start: float,
    sinks: Sequence[Sink],
    progress: OnProgress | None,
) -> Judge:
    """Pass a recording through a monitor. ``start``: begin of the part that is read, s."""
    judge: Judge | None = None
    for block in samples.blocks():
        if judge is None:
            judge = _judge_of(settings, samples, faults, sinks)
        judge.injector.start_stamp = samples.origin
        if len(block) and not judge.evaluation.samples:
            _refuse_early_faults(judge, block, start)
        for piece in judge.pieces(block):
            for sink in sinks:
                sink.begin(samples)
            judge.feed(piece)
            for sink in sinks if samples.period else ():
                sink.tick(samples, judge.pipeline)
        if progress is not None:
            progress(samples.progress)
    assert judge is not None  # `Samples.blocks` refuses a recording without messages
    if judge.evaluation.samples:
        last = judge.evaluation.time(judge.evaluation.last)
        judge.injector.refuse_between(last, math.inf, "that is the last sample")
    return judge


def _refuse_early_faults(judge: Judge, first: Block, start: float) -> None:
    """Refuse faults before the part that is read, or before the start-up biases are known."""
    learned = judge.pipeline.config.bias.startup_bias_duration
    if learned <= 0:
        why = "the part that is read begins there"
        judge.injector.refuse_between(-math.inf, start, why)
        return
    known = float(judge.injector.time(first.stamp[0])) + learned
    why = "the start-up biases are measured until then"
    judge.injector.refuse_between(-math.inf, known, why)


def _stream_result(samples: Samples, settings: Config, judge: Judge) -> StreamResult:
    """Return the counters of a recording that was read."""
    counters = samples.alignment.counters
    return StreamResult(
        sample_rate=SampleRate(settings.sample_rate, judge.rate),
        origin_ns=samples.origin,
        messages=samples.messages,
        malformed=samples.malformed,
        disordered=samples.disordered,
        alignment=dict(zip(samples.topics, counters, strict=True)),
        damage=samples.recording.damage.losses(),
        lost=samples.recording.damage.lost,
        cut_off=samples.recording.damage.cut_off and samples.reads_to_end,
        holes=tuple(
            (judge.evaluation.time(begin), judge.evaluation.time(end))
            for begin, end in judge.holes.found
        ),
        set_back_s=samples.set_back_s,
        steps_back=_steps_back(samples, judge),
        facts=tuple(samples.recording.damage.facts),
        unused=tuple(samples.recording.damage.left_out),
    )


def _bias_result(status: Status) -> BiasResult:
    """Return the learned biases, with those that are far from any healthy one."""
    far = [
        FarBias(
            one.name,
            abs(one.start_bias),
            UNUSUAL_ERRORS.start_bias * status.turn_on_std(one),
            one.unit,
        )
        for one in status.channels
        if status.has_implausible_start_bias(one)
    ]
    return BiasResult(
        status.bias_state,
        tuple(status.bias),
        tuple(one.channel for one in far),
        tuple(far),
    )


def _steps_back(samples: Samples, judge: Judge) -> dict[str, tuple[float, float]]:
    """Return when the clock of each topic was set back, s from the first message, and by how much, s."""
    return {
        topic: (judge.evaluation.time(one.first), 1e-9 * one.largest)
        for topic, one in zip(samples.topics, samples.steps_back, strict=True)
        if samples.source.stamped and one.first is not None
    }


def _autopilot_texts(texts: Iterable[LogText], judge: Judge) -> Iterator[AutopilotText]:
    """Yield the messages of the autopilot between the first sample and the last."""
    scores = judge.evaluation.scores()
    for one in texts:
        at = judge.evaluation.time(one.stamp)
        if scores.start_s <= at <= scores.end_s:
            yield AutopilotText(round(at, 6), one.kind, one.text)


def _judge_of(
    config: Config, samples: Samples, faults: Sequence[Fault], sinks: Sequence[Sink]
) -> Judge:
    """Build a judge. The first messages show which units have accelerometers."""
    pipeline = Pipeline(config)
    if pipeline.undecided:
        pipeline.sense(samples.felt)
    return Judge(pipeline, Injector(faults, pipeline.channel_names), sinks)


def with_unused(summary: Summary, unused: Sequence[tuple[str, str]]) -> Summary:
    """Return a summary whose verdict includes gyro topics that were left out, with reasons."""
    stream = replace(summary.stream, unused=(*summary.stream.unused, *unused))
    summary = replace(summary, stream=stream)
    return replace(summary, verdict=verdict_of(summary))


def _faults(given: OneFault | Sequence[OneFault]) -> tuple[Fault, ...]:
    """Return the faults, of one or several."""
    if isinstance(given, (Fault, str, Mapping)):
        return (_fault(given),)
    return tuple(map(_fault, given))


def _fault(given: Fault | str | Mapping[str, Any]) -> Fault:
    if isinstance(given, Fault):
        return given
    return parse_fault(given) if isinstance(given, str) else fault_from(given)
