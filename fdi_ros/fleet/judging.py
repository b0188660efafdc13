# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""One recording through the pipeline: its row, its events, and what came of faults injected into it."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fdi_ros.bag.raw import Topic
from fdi_ros.bag.reader import Recording
from fdi_ros.bag.samples import Samples, joined, read_block
from fdi_ros.calibration.settings import REPLACED
from fdi_ros.config.config import Config
from fdi_ros.config.edit import with_parameters
from fdi_ros.episodes.recorder import Recorder
from fdi_ros.episodes.story import Episode
from fdi_ros.episodes.stretches import Stretches
from fdi_ros.errors import BagError, FdiError
from fdi_ros.fleet.recordings import vehicle_of
from fdi_ros.fleet.rows import Flight, FlightEpisode, FlightEvent, InjectedFault, Judged
from fdi_ros.inspection.inspect import Stretch, TopicReport, candidates, inspect, missing, take_stretches
from fdi_ros.inspection.starting_config import config_text
from fdi_ros.model.block import Block
from fdi_ros.monitor.diagnostics import degraded
from fdi_ros.monitor.output import ChannelState, Output
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.replay.summary import SampleRate
from fdi_ros.replay.verdict import RATE_TOLERANCE, sample_rate_notes
from fdi_ros.sweep.plan import Plan
from fdi_ros.sweep.sweep import Subject, sweep

Array = NDArray[np.float64]
GAP = 3.0
"""Intervals longer than this many usual ones are gaps."""
FEW = 5
"""Samples after start-up before the first has to be judged."""
PARTS = 120
"""Of the course of the statistic."""
ON = "on "
"""Begins the words on what a vehicle was calibrated on."""
QUIETEST, ALIKE = 3, 1.5
"""Stretches of a second that tell the noise at rest, at least, and how much noisier those may be that count, too."""
STILL = 2.0
"""Nothing moves where the standard deviation is no more than so many times the noise."""
Calibrate = Literal["none", "each", "first"]


@dataclass(frozen=True)
class Settings:
    """How every recording is judged."""

    parameters: str
    """Text of the parameter file; empty: of each recording what ``fdi inspect`` writes for it."""
    calibrate: Calibrate = "none"
    plan: Plan | None = None
    """Faults to be injected; None: none."""


@dataclass(frozen=True)
class Vehicle:
    """Settings of one vehicle, where they are not those of all."""

    parameters: str
    config: str
    """Where that text lies."""
    calibration: str
    """What it was calibrated on, or why it could not be."""
    rate: float = math.nan
    """Of that recording, Hz."""


def judge(flight: str, path: Path, settings: Settings, vehicle: Vehicle) -> Judged:
    """Judge one recording; what is wrong with it is said in its row.

    Parameters
    ----------
    flight
        Its key.
    path
        Where it lies.
    settings
        How all are judged.
    vehicle
        How this vehicle is.
    """
    row = _row(flight, path, vehicle)
    try:
        return _judged(row, path, settings, vehicle)
    except FdiError as error:
        return Judged(replace(row, error=_line(error)))
    except Exception as error:  # A defect met in one recording must not cost the others.
        return Judged(replace(row, error=f"defect of fdi_ros: {type(error).__name__}: {_line(error)}"))


def given_up(flight: str, path: Path, vehicle: Vehicle, words: str) -> Judged:
    """Return the row of a recording whose judging was given up, and why."""
    return Judged(replace(_row(flight, path, vehicle), error=words))


def _row(flight: str, path: Path, vehicle: Vehicle) -> Flight:
    """Return the row of a recording that nothing is known of yet."""
    return Flight(
        flight=flight,
        path=str(path),
        vehicle=vehicle_of(path),
        config=vehicle.config,
        calibration=vehicle.calibration,
    )


def _judged(row: Flight, path: Path, settings: Settings, vehicle: Vehicle) -> Judged:
    text = own = vehicle.parameters
    row = replace(row, measured=bool(text))
    if not text:
        text = own = inspected(path)
    if settings.calibrate == "each":
        try:
            own, _ = calibrated(path, text)
            row = replace(row, calibration="on itself", measured=True)
        except FdiError as error:
            row = replace(row, calibration=f"refused: {_line(error)}")
    config = config_of(own)
    pipeline = Pipeline.from_config(config)
    pipeline.restart()
    with Recording(path) as recording:
        samples = Samples(recording, config, pipeline.geometry.n)
        watch = _Watch(pipeline)
        blocks = []
        stretches = Stretches()
        for block in samples.blocks():
            for anew, part in stretches.cut(block):
                watch.take(part, anew)
            blocks.append(block)
        row = replace(
            row,
            messages=samples.messages,
            malformed=sum(samples.malformed.values()),
            damage="; ".join(recording.damage.report()),
        )
    block = joined(blocks)
    row = _figures(row, block, watch, config.bias.startup_bias_duration)
    if row.rate is not None and abs(row.rate / vehicle.rate - 1.0) > RATE_TOLERANCE:
        # Judged by the mounts of another vehicle sound gyros would be called faulty.
        raise BagError(
            f"the vehicle is calibrated {vehicle.calibration} at {vehicle.rate:.4g} Hz, and this has {row.rate:.4g} Hz:"
            " another vehicle; give its recordings a folder of their own"
        )
    row = replace(row, doubts="; ".join(sample_rate_notes(SampleRate(config.sample_rate, row.rate))))
    faults: tuple[InjectedFault, ...] = ()
    if settings.plan is not None:
        faults, why = _injected(row, config, block, settings.plan)
        row = replace(row, not_injected=why)
    events = _events(row, block, watch, pipeline.channel_names)
    told = tuple(_episode_row(row, one) for one in watch.recorder.story().episodes)
    return Judged(row, events, faults, own if own != vehicle.parameters else "", told)


class _Watch:
    """What the pipeline says of a recording, block by block."""

    def __init__(self, pipeline: Pipeline) -> None:
        self.pipeline = pipeline
        self.outputs: list[Output] = []
        self.degraded: dict[str, str] = {}
        self.recorder = Recorder(pipeline.geometry, pipeline.noise)
        self._first: int | None = None

    def take(self, block: Block, anew: bool) -> None:
        """Judge the next block; anew: a new stretch begins with it."""
        if anew:
            self.pipeline.reset()
            self.recorder.begin_stretch()
        output = self.pipeline.process(block)
        self.outputs.append(output)
        if len(block):
            self._first = int(block.stamp[0]) if self._first is None else self._first
            self.recorder.add(np.round((output.stamp - self._first) * 1e-9, 9), output)
        self.degraded |= degraded(self.pipeline.status())

    def standing(self) -> NDArray[np.bool_]:
        """(N,) whether anything stood declared after the sample."""
        states = np.concatenate([output.state for output in self.outputs])
        declared = np.isin(states, (ChannelState.FAULTY, ChannelState.AMBIGUOUS))
        return np.asarray(declared.any(axis=1))

    def ratio(self) -> Array:
        """(N,) statistic over threshold; NaN where nothing was judged."""
        statistic, threshold = (
            np.concatenate([getattr(output, name) for output in self.outputs]) for name in ("statistic", "threshold")
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(threshold > 0, statistic / threshold, np.nan)


def _figures(row: Flight, block: Block, watch: _Watch, startup: float) -> Flight:
    status, ratio = watch.pipeline.status(), watch.ratio()
    judged = np.concatenate([np.isfinite(output.threshold) for output in watch.outputs])
    seconds = (block.stamp - block.stamp[0]) * 1e-9
    steps = np.diff(seconds)
    usual = float(np.median(steps)) if len(steps) else math.nan
    after = seconds > startup + FEW * usual
    known = judged[1:] & (steps <= GAP * usual)
    events = [event for output in watch.outputs for event in output.events]
    story = watch.recorder.story()
    # What hides for a while, and comes back as it was, is declared once.
    told = [step for one in story.declared for step in one.steps]
    alone = sum(len(step.channels) for step in told if step.state == "FAULTY")
    sets = sum(step.state == "AMBIGUOUS" for step in told)
    largest = int(np.nanargmax(ratio)) if np.isfinite(ratio).any() else None
    rest, motion, mean = _noise(block, usual)
    return replace(
        row,
        start=int(block.stamp[0]),
        duration=float(seconds[-1]),
        samples=len(block),
        rate=1.0 / usual if usual > 0 else None,
        gaps=int((steps > GAP * usual).sum()) if usual > 0 else 0,
        longest_gap=float(steps.max()) if len(steps) else None,
        judged=float(judged[after].mean() if after.any() else judged.mean()),
        judged_time=float(steps[known].sum()),
        watched=float(steps[known & ~watch.standing()[:-1]].sum()),
        note=status.note,
        degraded="; ".join(watch.degraded.values()),
        episodes=_onsets(story.declared) + story.more,
        stretches=len(story.stretches),
        happened=tuple(one.words for one in story.episodes),
        declared=alone + sets,
        sets=sets,
        suspected=sum(event.after is ChannelState.SUSPECT for event in events),
        largest=None if largest is None else float(ratio[largest]),
        largest_at=None if largest is None else float(seconds[largest]),
        course=_course(seconds, ratio),
        channels=watch.pipeline.channel_names,
        state=tuple(channel.state.name for channel in status.channels),
        reason=tuple(channel.reason.value for channel in status.channels),
        noise_rest=tuple(rest.tolist()),
        noise_motion=tuple(motion.tolist()),
        vibration=tuple(np.sqrt(np.maximum(0.0, motion**2 - rest**2)).tolist()),
        mean_rest=tuple(mean.tolist()),
        bias=tuple(
            math.nan if channel.state is ChannelState.UNCHECKED else bias
            for channel, bias in zip(status.channels, status.bias, strict=True)
        ),
        bias_state=status.bias_state,
        units=tuple(unit.name for unit in status.units),
        delay=tuple(status.delays),
        delay_std=tuple(status.delay_std),
    )


def _onsets(episodes: Sequence[Episode]) -> int:
    """Count the episodes that begin while none stands: those that do while another stands may be its doing."""
    count, until = 0, -math.inf
    for one in episodes:
        count += one.start_s > until
        until = max(until, one.end_s)
    return count


def _episode_row(row: Flight, one: Episode) -> FlightEpisode:
    """Return the row of an episode; of a set of channels that measure one axis, the size is their difference."""
    sizes = [candidate.size for candidate in one.candidates if candidate.size is not None]
    size = one.apart.size if one.apart else max(sizes, key=lambda size: abs(size.rad_s), default=None)
    return FlightEpisode(
        flight=row.flight,
        path=row.path,
        vehicle=row.vehicle,
        stretch=one.stretch,
        state=one.state,
        channels=one.channels,
        axes=tuple(candidate.axis for candidate in one.candidates),
        start=one.start_s,
        since=one.since_s,
        end=one.end_s,
        size=None if size is None else size.rad_s,
        size_std=None if size is None else size.std_rad_s,
        course="" if size is None else size.course,
        ratio=one.evidence.ratio,
        reason=one.evidence.reason,
        published=one.rate.published,
        words=one.words,
    )


def _noise(block: Block, step: float) -> tuple[Array, Array, Array]:
    """Noise (n,) at the quietest and in motion, and mean at the quietest, rad/s; NaN where there is none of it."""
    n = block.z.shape[1]
    report = TopicReport(Topic("", ""), None, channels=n, interval=step if step > 0 else 0.0)
    whole = np.isfinite(block.z).all(axis=1)
    take_stretches(report, block.z[whole], block.stamp[whole])
    rest, mean = _quietest(report.all_stretches(), n)
    return rest, report.moving_noise(), mean


def _quietest(stretches: Sequence[Stretch], n: int) -> tuple[Array, Array]:
    """Noise and mean (n,) of the stretches about as quiet as the quietest, rad/s; NaN: there are none.

    Of a long flight the rest before it is few of them. The mean is of those in which nothing moves.
    """
    if not stretches:
        return np.full(n, np.nan), np.full(n, np.nan)
    noise, spread, mean = (np.array([getattr(one, name) for one in stretches]) for name in ("noise", "spread", "mean"))
    few = np.argsort((noise**2).sum(axis=1))[: max(QUIETEST, len(noise) // 100)]
    least = np.median(noise[few], axis=0)
    alike = (noise <= ALIKE * least).all(axis=1)
    still = alike & (spread <= STILL * noise).all(axis=1)
    return (
        np.asarray(np.median(noise[alike], axis=0) if alike.any() else least),
        np.asarray(np.median(mean[still], axis=0) if still.any() else np.full(n, np.nan)),
    )


def _course(seconds: Array, ratio: Array) -> tuple[float, ...]:
    """Largest ratio in each of equal parts of the time; NaN where nothing was judged."""
    part = np.minimum((PARTS * seconds / max(seconds[-1], 1e-9)).astype(int), PARTS - 1)
    largest = np.full(PARTS, -np.inf)
    known = np.isfinite(ratio)
    np.maximum.at(largest, part[known], ratio[known])
    return tuple(np.where(np.isfinite(largest), largest, np.nan).tolist())


def _events(row: Flight, block: Block, watch: _Watch, names: Sequence[str]) -> tuple[FlightEvent, ...]:
    first = int(block.stamp[0])
    return tuple(
        FlightEvent(
            flight=row.flight,
            path=row.path,
            vehicle=row.vehicle,
            at=(event.stamp - first) * 1e-9,
            stamp=event.stamp,
            channel=names[event.channel],
            before=event.before.name,
            after=event.after.name,
            declares=event.declares,
            group=tuple(names[i] for i in event.group),
            reason=event.reason.value,
            error=event.error,
        )
        for output in watch.outputs
        for event in output.events
    )


def _injected(row: Flight, config: Config, block: Block, plan: Plan) -> tuple[tuple[InjectedFault, ...], str]:
    """Inject every fault of a plan into every channel; or say why none or not all could be."""
    try:
        (tried,) = sweep([Subject(row.path, config, block)], plan)
    except FdiError as error:
        return (), _line(error)
    why = f"at {len(tried.skipped)} of {plan.times} times something stood declared" if tried.skipped else ""
    faults = tuple(
        InjectedFault(
            flight=row.flight,
            path=row.path,
            vehicle=row.vehicle,
            channel=tried.channels[trial.channel],
            fault=trial.swept.words,
            kind=trial.swept.kind,
            size=trial.swept.size,
            at=trial.fault.start,
            outcome=trial.scored.outcome.value,
            named_after=_finite(trial.scored.isolated_after),
            found_after=_finite(trial.scored.detected_after),
        )
        for trial in tried.trials
    )
    return faults, why


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def inspected(path: Path) -> str:
    """Return the text of a parameter file to start from, as ``fdi inspect`` writes it.

    Raises
    ------
    FdiError
        If the recording shows no gyros.
    """
    reports, _ = inspect(path)
    chosen = candidates(reports)
    if not chosen:
        raise BagError(f"no config: {missing(reports)}")
    return config_text(chosen, path)


def calibrated(path: Path, parameters: str) -> tuple[str, float]:
    """Return the text of a parameter file, calibrated on a recording, and the sample rate of that, Hz.

    Raises
    ------
    FdiError
        If the recording does not show what is needed.
    """
    from fdi_ros.calibration.calibrate import calibrate

    config = config_of(parameters)
    block = read_block(path, config)
    result = calibrate(block, config)
    note = f"made by fdi calibrate from {path.name}"
    with _as_file(parameters) as file:
        return with_parameters(file, result.settings, note, REPLACED), 1e9 / float(np.median(np.diff(block.stamp)))


def vehicle_calibrated(path: Path, parameters: str) -> tuple[str, float, str]:
    """Return the parameters calibrated on a recording, its rate, and nothing; or what to start from, and why not."""
    try:
        text = parameters or inspected(path)
    except FdiError as error:
        return parameters, math.nan, _line(error)
    try:
        return *calibrated(path, text), ""
    except FdiError as error:
        return text, math.nan, _line(error)


def config_of(parameters: str) -> Config:
    """Read settings from the text of a parameter file."""
    with _as_file(parameters) as file:
        return Config.from_file(file)


@contextmanager
def _as_file(text: str) -> Iterator[Path]:
    with tempfile.NamedTemporaryFile("w", suffix=".yaml", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        yield Path(file.name)


def _line(error: BaseException) -> str:
    return " ".join(str(error).split())
