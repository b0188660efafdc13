# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a first walk through a flight log finds, and which of its messages are then read."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fdi_ros.arrays import Int
from fdi_ros.bag.log_parts import ImuSamples, LogFormat, Source
from fdi_ros.bag.raw import Damage
from fdi_ros.errors import BagError
from fdi_ros.limits import LOG_SPAN
from fdi_ros.text import shown

FEWEST = 20
"""Samples by which the rate of a source can be judged."""
_TOLERANCE = 0.95
"""Of that rate; clocks and loggers are not exact."""
_APART = 1.5
"""Times the longest interval between two samples: a longer one is a gap, a shorter one may be jitter."""
_STEP = 1_000_000
"""us; a log continues as long as its times differ by no more."""
_SETTLED = 8
"""Records with times elsewhere after which the log is taken to go on there: so many in a row are not damaged."""


@dataclass
class Track:
    """What was seen of one source."""

    slowest: float
    """Samples per second that it must be logged at."""
    count: int = 0
    fast: int = 0
    """Samples that follow the one before without a gap."""
    fast_time: int = 0
    """us between these and the ones before."""
    first: int = 0
    last: int = 0
    """Stamps of the first and the last, us."""

    def add(self, stamp: Int) -> None:
        """Take in the stamps (k,) of further samples."""
        if not len(stamp):
            return
        steps = np.diff(stamp, prepend=self.last) if self.count else np.diff(stamp)
        steps = steps[(steps > 0) & (steps <= 1e6 * _APART / self.slowest)]
        self.fast += len(steps)
        self.fast_time += int(steps.sum())
        self.first = self.first if self.count else int(stamp[0])
        self.last = int(stamp[-1])
        self.count += len(stamp)

    @property
    def steady(self) -> bool:
        """Whether most samples follow one another without gaps."""
        return 2 * self.fast > self.count

    @property
    def usable(self) -> bool:
        """Whether it is mostly logged fast enough; gaps do not count against it."""
        return self.count >= FEWEST and self.fast_enough

    @property
    def fast_enough(self) -> bool:
        """Whether it is logged fast enough, as far as its samples tell."""
        return (self.steady or self.count < FEWEST) and self.rate >= _TOLERANCE * self.slowest

    @property
    def rate(self) -> float:
        """Samples per second: between gaps, or if there is little else than gaps, on average."""
        if self.steady:
            return self.fast * 1e6 / self.fast_time
        return (self.count - 1) * 1e6 / (self.last - self.first) if self.last > self.first else 0.0

    @property
    def figures(self) -> str:
        """Words for how fast it is logged."""
        if self.count < 2:
            return "once"
        if self.last <= self.first:
            return "at times that do not advance"
        bursts = " in bursts" if not self.fast_enough and self.rate >= _TOLERANCE * self.slowest else ""
        return f"at {self.rate:.3g} Hz{bursts}"


@dataclass
class Clock:
    """Follows the time of one source to find where it steps back: there a second log begins in the same file."""

    latest: int = 0
    """Stamp up to which the log has come, us."""
    held: int = 0
    """Samples that continue one another up to there."""
    end: int = 0
    """Where the record of the last of them ends, bytes."""
    elsewhere: int = 0
    """Stamp of the last sample, if it does not continue them, us."""
    away: int = 0
    """Samples that continue one another up to that."""
    left: int = 0
    """Where the record of the first of these ends, bytes."""

    def steps_back(self, samples: ImuSamples, offset: int) -> bool:
        """Take in the samples of a portion that begins at an offset; return whether the time steps back for good."""
        stamp = samples.stamp
        if not len(stamp):
            return False
        steps = np.diff(stamp, prepend=self.latest if self.held else stamp[0])
        if (np.abs(steps) <= _STEP).all():
            self._hold(int(stamp.max()), len(stamp), offset + int(samples.end[-1]))
            return False
        # Only here and there in a log there are times that do not continue.
        settled = _SETTLED * samples.together
        for at, end in zip(stamp.tolist(), (samples.end + offset).tolist(), strict=True):
            if not self.held or abs(at - self.latest) <= _STEP:
                self._hold(at, 1, end)
                continue
            if not self.away or abs(at - self.elsewhere) > _STEP:
                self.away, self.left = 0, end
            self.elsewhere = at
            self.away += 1
            if self.away == settled:
                # Nor does a log go on years later: there its times begin to be dates, or no longer are.
                if self.held >= settled and (at < self.latest or at - self.latest > LOG_SPAN):
                    return True
                self.latest = self.held = 0
                self._hold(at, self.away, end)
        return False

    def _hold(self, stamp: int, count: int, end: int) -> None:
        """Go on to a stamp by so many samples, the last of which ends there."""
        self.latest, self.end = max(self.latest, stamp), end
        self.held += count
        self.away = 0


@dataclass
class Survey:
    """What a first walk found."""

    tracks: dict[Source, Track] = field(default_factory=dict)
    offsets: list[int] = field(default_factory=list)
    """Where each portion begins, bytes."""
    starts: list[int] = field(default_factory=list)
    """Earliest stamp in each portion, us; `NO_HORIZON`: it has no samples."""
    start_utc: int | None = None
    lost: int = 0
    end: int = 0
    """Where the last whole record ends, bytes."""
    clocks: dict[Source, Clock] = field(default_factory=dict)
    shared: Counter[tuple[Source, Source]] = field(default_factory=Counter)
    """Samples that two sources, in order, have at the same time."""
    unread: dict[str, str] = field(default_factory=dict)
    """Messages of IMUs that cannot be read, by name, and why."""
    counts: Counter[str] = field(default_factory=Counter)
    """Records of every message, by name."""
    vehicle: str = ""
    step: int = 0
    """Where the log ends, since the time steps back behind it, bytes; 0: it does not."""


def first_step(clocks: dict[Source, Clock], found: Sequence[ImuSamples], offset: int) -> int:
    """Return where the log ends because the time of a source steps back in a portion, bytes; 0: it does not."""
    stepped = [
        clock for samples in found if (clock := clocks.setdefault(samples.source, Clock())).steps_back(samples, offset)
    ]
    if not stepped:
        return 0
    begun = min(clock.left for clock in stepped)
    return max(clock.end for clock in clocks.values() if clock.end < begun)


def at_one_time(found: Sequence[ImuSamples]) -> Counter[tuple[Source, Source]]:
    """Count the samples that sources have at the same time; of more than two, those next to each other count."""
    shared: Counter[tuple[Source, Source]] = Counter()
    sources = sorted({samples.source for samples in found})
    if len(sources) < 2:
        return shared
    stamp = np.concatenate([samples.stamp for samples in found])
    number = np.concatenate([np.full(len(samples.stamp), sources.index(samples.source)) for samples in found])
    order = np.lexsort((number, stamp))
    stamp, number = stamp[order], number[order]
    same = (np.diff(stamp) == 0) & (np.diff(number) > 0)
    pairs, counts = np.unique(number[:-1][same] * len(sources) + number[1:][same], return_counts=True)
    for pair, count in zip(pairs.tolist(), counts.tolist(), strict=True):
        one, other = divmod(pair, len(sources))
        shared[sources[one], sources[other]] = count
    return shared


def copies_of(sensors: Mapping[Source, Track], shared: Mapping[tuple[Source, Source], int]) -> dict[Source, Source]:
    """Return which sources are copies of which others: those with the same times, since sensors have their own.

    A copy has the number of the sensor and that of all sensors in the sum. Where more than two have the same times, as
    in a simulation, an even number of sources is taken for sensors and their copies; an odd one cannot be that.
    """
    same = [
        (one, other)
        for (one, other), count in shared.items()
        if one in sensors and other in sensors and 2 * count > min(sensors[one].count, sensors[other].count)
    ]
    ordered = sorted({source for pair in same for source in pair})
    if len(ordered) == 2 * len(same):
        return {other: one for one, other in same}
    half = len(ordered) // 2
    return {} if len(ordered) % 2 else dict(zip(ordered[half:], ordered[:half], strict=True))


SETTINGS = 'docs/flight_logs.md, "Settings of the logger"'
MESSAGES = 'docs/flight_logs.md, "messages read"'
_MOST_NAMES = 6
"""Messages that are named of a log without IMUs."""


def choose(path: Path, form: LogFormat, survey: Survey, damage: Damage) -> list[Source]:
    """Return the sources to read: of the kind of message with the most usable ones, else the most samples.

    A sensor may be logged in several kinds of messages, and must not be its own witness.

    Parameters
    ----------
    path
        Of the log, for messages.
    form
        Its format.
    survey
        What a first walk found in it.
    damage
        Takes what is left out.

    Raises
    ------
    BagError
        If there is no IMU that is logged fast enough.
    """
    tracks = _sensors(path.name, form, survey, damage)

    def merit(kind: str) -> tuple[int, int]:
        usable = [track for source, track in tracks.items() if source.kind == kind and track.usable]
        return len(usable), sum(track.count for track in usable)

    kind = max(form.kinds, key=merit)
    if not merit(kind)[0]:
        raise BagError(f"{path} {_refusal(form, survey, tracks)}")
    for source, track in tracks.items():
        if source.kind == kind and not track.usable:
            few = f"has too few samples to judge its rate ({track.count})"
            slow = f"is logged {track.figures}, expected at least {form.slowest:g} Hz"
            damage.add(
                f"{path.name}: {kind} {source.instance} {few if track.count < FEWEST else slow}, and was left out"
            )
    return sorted(source for source, track in tracks.items() if source.kind == kind and track.usable)


def _sensors(name: str, form: LogFormat, survey: Survey, damage: Damage) -> dict[Source, Track]:
    """Return the sources that are sensors of their own."""
    tracks = {source: track for source, track in survey.tracks.items() if source.kind in form.kinds and track.count}
    there = {source.instance for source in tracks if source.kind == form.counted_by}
    sensors = {source: track for source, track in tracks.items() if not there or source.instance in there}
    for copy, source in ({} if there else copies_of(sensors, survey.shared)).items():
        del sensors[copy]
        damage.add(
            f"{name}: {copy.kind} {copy.instance} has the times of {source.kind} {source.instance}: taken for the same"
            f" sensor behind its filters, and left out (without {form.counted_by} the log does not say how many sensors"
            " there are)"
        )
    return sensors


def _refusal(form: LogFormat, survey: Survey, tracks: dict[Source, Track]) -> str:
    """Say what a log has in place of IMUs that can be read, and which line of the documentation applies."""
    kinds = {kind: [track for source, track in tracks.items() if source.kind == kind] for kind in form.kinds}
    there = [_logged(kind, own) for kind, own in kinds.items() if own]
    unread = [f"{name}, which is not read ({why})" for name, why in sorted(survey.unread.items())]
    alone = [track for source, track in survey.tracks.items() if source.kind == form.selected and track.count]
    if alone:
        there.append(f"{form.selected} of the one selected IMU {alone[0].figures}")
    if unread and not there:
        return f"has of IMUs only {', '.join(unread)}: {MESSAGES}"
    setting = f"{form.settings(survey.vehicle)} ({SETTINGS})"
    if not there:
        most = ", ".join(f"{count} {shown(name, 32)}" for name, count in survey.counts.most_common(_MOST_NAMES))
        return f"has no {' or '.join(form.kinds)}, it has {most or 'no records'}: {setting}"
    has = f"has {', '.join((*there, *unread))}"
    if any(track.fast_enough for track in tracks.values()):
        return f"{has}; needed: {FEWEST} samples of an IMU or more ({SETTINGS})"
    return f"{has}; needed: each IMU by itself at {form.slowest:g} Hz or more: {setting}"


def _logged(kind: str, tracks: list[Track]) -> str:
    """Say how a kind of message is logged."""
    fastest = max(tracks, key=lambda track: (track.count >= FEWEST, track.rate))
    few = f", {fastest.count} samples" if 1 < fastest.count < FEWEST else ""
    return f"{kind} of {len(tracks)} IMU{'s' * (len(tracks) > 1)} {fastest.figures}{few}"
