# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Faults of several kinds and sizes on every channel of a recording, one at a time, with one monitor or several.

The recording is replayed once as it is. Each fault then goes on from the monitor as it stood when the fault
begins (`fdi_ros.sweep.trial`), so that hundreds of faults take seconds and none meets the traces of another.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from fdi_ros.config.config import Config
from fdi_ros.errors import FaultError, FdiError
from fdi_ros.jobs import run_jobs
from fdi_ros.model.block import Block
from fdi_ros.monitor.build import build_geometry
from fdi_ros.sweep.plan import Plan
from fdi_ros.sweep.trial import (
    Onset,
    Sound,
    Trial,
    has_hole,
    lead_of,
    monitor_of,
    onsets_of,
    rows_at,
    try_faults,
    watch_sound,
    windows_of,
)

Job = tuple[Config, Onset, int, Plan]
"""Arguments of `fdi_ros.sweep.trial.try_faults`."""


@dataclass(frozen=True)
class Subject:
    """A monitor to be tried, and the samples as it aligns them."""

    name: str
    config: Config
    block: Block


@dataclass(frozen=True)
class MonitorResult:
    """What came of all faults with one monitor."""

    name: str
    config: Config
    channels: tuple[str, ...]
    """Names of all channels; those excluded are tried with no fault."""
    sound: Sound | None
    """None: the monitor does not run."""
    refused: str
    """Why it does not run, or judges nothing; empty: it does."""
    times: tuple[float, ...] = ()
    """At which faults began, s."""
    speeds: tuple[tuple[float, float], ...] = ()
    """Median and largest fused rate while they are watched, rad/s; NaN: none."""
    skipped: tuple[float, ...] = ()
    """At which none did, as something stands declared without one, or a channel gives nothing, s."""
    trials: tuple[Trial, ...] = ()

    @property
    def used(self) -> tuple[int, ...]:
        """Channels that are tried."""
        return tuple(i for i, name in enumerate(self.channels) if name not in self.config.excluded_channels)


def times_of(sound: Sequence[Sound], block: Block, plan: Plan) -> tuple[float, ...]:
    """Spread the times of the faults evenly over what all of the monitors judge, s; none of them meets a gap.

    Raises
    ------
    FaultError
        If that is too short to watch a fault.
    """
    begins, end = max(one.begins for one in sound), min(one.duration for one in sound)
    windows = windows_of(block, begins, end, plan.within)
    if not windows:
        gaps = ", in no piece of it without a gap long enough" if end - begins > plan.within else ": too short"
        raise FaultError(
            f"the recording is judged from {begins:.1f} s to {end:.1f} s{gaps} to watch a fault for"
            f" {plan.within:g} s (within)"
        )
    room = sum(high - low for low, high in windows)
    return tuple(_placed(windows, room * (k + 0.5) / plan.times) for k in range(plan.times))


def _placed(windows: Sequence[tuple[float, float]], after: float) -> float:
    """Find the time that lies so far, s, into windows put end to end."""
    for low, high in windows:
        if after <= high - low:
            return low + after
        after -= high - low
    return windows[-1][1]


def sweep(
    subjects: Sequence[Subject], plan: Plan, workers: int = 1, progress: Callable[[float], None] | None = None
) -> tuple[MonitorResult, ...]:
    """Try every monitor with every fault of the plan, at the same times.

    Parameters
    ----------
    subjects
        With the same channels.
    plan
        The faults.
    workers
        Processes; 1: this one alone.
    progress
        Called with the share done.

    Raises
    ------
    FdiError
        If no monitor judges the recording for long enough.
    """
    tried = [_watched(subject) for subject in subjects]
    able = [
        (one.sound, subject.block)
        for subject, one in zip(subjects, tried, strict=True)
        if one.sound is not None and not one.refused
    ]
    if not able:
        raise FaultError(f"no fault can be tried: {tried[0].refused}")
    times = times_of([sound for sound, _ in able], able[0][1], plan)
    jobs: list[Job] = []
    owner: list[int] = []
    for k, (subject, one) in enumerate(zip(subjects, tried, strict=True)):
        if one.sound is not None and not one.refused:
            tried[k] = _timed(one, one.sound, times, subject.block, plan.within)
            own = _jobs_of(subject, tried[k], plan)
            jobs += own
            owner += [k] * len(own)
    found: dict[int, list[Trial]] = {}
    for done, (job, trials) in enumerate(run_jobs(try_faults, jobs, workers, None), 1):
        found[job] = trials
        if progress is not None:
            progress(done / len(jobs))
    for k, one in enumerate(tried):
        trials_of = (trial for job in sorted(found) if owner[job] == k for trial in found[job])
        tried[k] = replace(one, trials=tuple(trials_of))
    return tuple(tried)


def _watched(subject: Subject) -> MonitorResult:
    names: tuple[str, ...] = ()
    try:
        names = build_geometry(subject.config).channel_names
        pipeline = monitor_of(subject.config)
    except FdiError as error:
        return MonitorResult(subject.name, subject.config, names, None, str(error))
    pipeline.restart()
    sound = watch_sound(pipeline, subject.block)
    refused = "" if sound.judged else f"it judges nothing of this recording: {sound.note}"
    return MonitorResult(subject.name, subject.config, names, sound, refused)


def _jobs_of(subject: Subject, one: MonitorResult, plan: Plan) -> list[Job]:
    """One job per time and channel."""
    pipeline = monitor_of(subject.config)
    pipeline.restart()
    onsets = onsets_of(pipeline, subject.block, one.times, plan.within, lead_of(plan.faults))
    return [(subject.config, onset, channel, plan) for onset in onsets for channel in one.used]


def _timed(one: MonitorResult, sound: Sound, times: Sequence[float], block: Block, within: float) -> MonitorResult:
    """Take the times at which nothing stands declared, nothing injected."""
    rows = {at: rows_at(block, at, within) for at in times}
    good = tuple(at for at in times if not has_hole(block[rows[at]]) and not sound.doubted(rows[at]))
    skipped = tuple(at for at in times if at not in good)
    return replace(one, times=good, speeds=tuple(sound.speeds(rows[at]) for at in good), skipped=skipped)
