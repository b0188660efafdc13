# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Logs of flight stacks as recordings: what their formats have in common.

A log is walked twice, portion by portion, in bounded memory: when it is opened, to find the IMUs, their sample rates
and the time of day, and again to read it. A format reads samples out of a portion; here these become
sensor_msgs/msg/Imu messages on ``/imu_0``, ``/imu_1`` and so on: the instances of the log, whichever kind of message
they were logged in.

Flight stacks count body axes front, right, down (FRD); messages are in front, left, up (FLU, REP-103). Stamps are those
of the samples: time since the start of the autopilot, and from a log with GPS time the UTC of that start is added. A
log whose stamps are dates (a simulation by the clock of its computer) is read as it is.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fdi_ros.bag.log_parts import Field, ImuSamples, LogFormat, LogReader, Portion, Source, row_type
from fdi_ros.bag.raw import NO_HORIZON, Batch, Damage, Topic, open_file
from fdi_ros.core.messages import ImuTemplate
from fdi_ros.errors import BagError
from fdi_ros.limits import EARLIEST, LATEST, LOG_SPAN
from fdi_ros.model.samples import Array, Bytes, Int
from fdi_ros.text import shown

IMU = "sensor_msgs/msg/Imu"
_FAR = 10_000_000
"""us; a sample that far from those logged before and after it has a damaged time."""
_HEAD = 1 << 10
"""First bytes of a file, by which its parts are known."""
_PORTION = 1 << 22
"""Bytes that are read at once, much more than the longest record."""
_TOGETHER = 1 << 10
"""Messages handed on at once: so few that in a bag made of them a chunk holds what is near in time."""
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


# What a first walk finds, and which messages are then read ----------------------------------------------------------


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
    setting = f"{form.settings.get(survey.vehicle, form.settings[''])} ({SETTINGS})"
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


# The log -------------------------------------------------------------------------------------------------------------


class FlightLog:
    """An open log of a flight stack, read as a recording of Imu topics.

    Parameters
    ----------
    path
        The file.
    damage
        Takes what cannot be read.
    form
        Its format.

    Raises
    ------
    BagError
        If the file cannot be opened, is no such log, or has no IMU that is logged fast enough.
    """

    def __init__(self, path: Path, damage: Damage, form: LogFormat) -> None:
        self.path = path
        self.damage = damage
        self._form = form
        self._file, self.size = open_file(path, form.magic, f"is no log of {form.stack}")
        try:
            self._parts = self._parts_of(form.magic + self._file.read(_HEAD))
            while (survey := self._survey()).step:
                self._end_at(survey.step)
            self._sources = choose(path, form, survey, damage)
        except BaseException:
            self.close()
            raise
        self._offsets = survey.offsets
        self._starts = np.minimum.accumulate(survey.starts[::-1])[::-1].tolist()
        """Earliest stamp in each portion and those after it, us; `NO_HORIZON`: they have no samples."""
        dated = EARLIEST // 1000 <= self._starts[0] < NO_HORIZON
        self._shift = 0 if dated else survey.start_utc or 0
        """UTC of the start of the autopilot, us; 0: not known, and times count from there, or they are dates."""
        self.topics = tuple(Topic(_topic(source), IMU, count=survey.tracks[source].count) for source in self._sources)
        self.start_time = self._log_time(self._starts[0])

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def batches(self, topics: Sequence[str]) -> Iterator[Batch]:
        """Read the messages of the topics, those of a portion in the order of their stamps."""
        wanted = {source: topics.index(_topic(source)) for source in self._sources if _topic(source) in topics}
        if not wanted:
            return
        encoder = _Encoder(wanted)
        reader = self._form.reader()
        for offset, later in zip(self._offsets, [*self._starts[1:], NO_HORIZON], strict=True):
            if os.fstat(self._file.fileno()).st_size < self.size:
                self.damage.add(f"{self.path.name} has become shorter while it was read: read as far as it goes")
            portion = self._read(reader, offset)
            found = [self._possible(samples) for samples in portion.samples if samples.source in wanted]
            if found:
                progress = (offset + portion.end) / self.size
                yield from encoder.batches(found, self._shift, self._log_time(later), progress)

    def _survey(self) -> Survey:
        """Walk the whole file, or to where the time steps back, and note what of it cannot be read."""
        survey = Survey(end=self._form.head)
        reader = self._form.reader()
        while survey.end < self.size or not survey.offsets:
            offset = survey.end
            portion = self._read(reader, offset)
            found = [self._possible(samples) for samples in portion.samples]
            if step := first_step(survey.clocks, found, offset):
                survey.step = step
                return survey
            for samples in found:
                survey.tracks.setdefault(samples.source, Track(self._form.slowest)).add(samples.stamp)
            survey.shared.update(
                at_one_time([one for one in found if self._form.counted_by not in ("", one.source.kind)])
            )
            survey.offsets.append(offset)
            survey.starts.append(min([int(one.stamp.min()) for one in found if len(one.stamp)], default=NO_HORIZON))
            survey.start_utc = portion.start_utc if survey.start_utc is None else survey.start_utc
            survey.lost += portion.lost
            survey.end += portion.end
            # Nothing comes of the rest of a part, or of a file that is cut off meanwhile.
            if not portion.end or offset + _PORTION >= self._end_of_part(offset):
                survey.lost += self._end_of_part(offset) - survey.end
                survey.end = self._end_of_part(offset)
        survey.unread, survey.counts, survey.vehicle = reader.unread, reader.counts, reader.vehicle
        if survey.lost > 0:
            self.damage.add(f"{self.path.name}: {survey.lost} bytes belong to no whole record and were left out")
        for note in reader.notes():
            self.damage.add(f"{self.path.name}: {note}")
        return survey

    def _parts_of(self, head: bytes) -> list[int]:
        """Return where parts of the file end that are read each by itself."""
        try:
            begins = self._form.parts(head)
        except BagError as error:
            raise BagError(f"{self.path} {error}") from error
        return [at for at in begins if at < self.size]

    def _end_of_part(self, offset: int) -> int:
        """Return where the part of the file ends that a place lies in, bytes."""
        return min([self.size, *(at for at in self._parts if at > offset)])

    def _end_at(self, step: int) -> None:
        """Leave out what lies behind a place in the file, because the time steps back there."""
        rest = self.size - step
        self.damage.add(
            f"{self.path.name}: the time steps back at byte {step}, as where a second log begins in the file: "
            f"the {rest} bytes behind it ({100 * rest / self.size:.3g} % of the file) were left out"
        )
        self.size = step

    def _possible(self, samples: ImuSamples) -> ImuSamples:
        """Leave out samples at times that no log lasts to, and at times far from those beside them."""
        stamp = samples.stamp
        good = ((stamp >= 0) & (stamp <= LOG_SPAN)) | ((stamp >= EARLIEST // 1000) & (stamp <= LATEST // 1000))
        if len(stamp) > 2 and (np.abs(np.diff(stamp)) > _FAR).any():
            # Of five neighbours most are right; a gap in the log has as many on its one side as on its other.
            beside = np.lib.stride_tricks.sliding_window_view(np.pad(stamp, 2, mode="reflect"), 5)
            good &= np.abs(stamp - np.median(beside, axis=1)) <= _FAR
        if good.all():
            return samples
        self.damage.add(f"{self.path.name}: samples with impossible times were left out")
        return samples.at(good)

    def _read(self, reader: LogReader, offset: int) -> Portion:
        end = self._end_of_part(offset)
        self._file.seek(offset)
        data = np.frombuffer(self._file.read(max(0, min(_PORTION, end - offset))), dtype=np.uint8)
        # Numbers of a damaged log may be anything.
        with np.errstate(all="ignore"):
            portion = reader.read(data, offset + _PORTION >= end)
            return portion._replace(samples=[samples.in_flu() for samples in portion.samples])

    def _log_time(self, stamp: int) -> int:
        """Time of recording, ns, of what happened at a stamp in us."""
        return NO_HORIZON if stamp == NO_HORIZON else (stamp + self._shift) * 1000


def _topic(source: Source) -> str:
    return f"/imu_{source.instance}"


class _Encoder:
    """Makes serialised sensor_msgs/msg/Imu messages in bulk.

    Parameters
    ----------
    topics
        The number of the topic of each source.
    """

    def __init__(self, topics: Mapping[Source, int]) -> None:
        self._place = {source: k for k, source in enumerate(topics)}
        self._topic = np.array(list(topics.values()))
        # The frame_id of an instance has up to eight bytes with its end: all messages are equally long.
        templates = [ImuTemplate(_topic(source).removeprefix("/")) for source in topics]
        self._templates = np.stack([template.bytes for template in templates])
        rate = templates[0].at
        acceleration = rate + 8 * (3 + 9)
        fields = {
            "sec": Field("<i4", 4),
            "nanosec": Field("<u4", 8),
            "rate": Field("<f8", rate, 3),
            "acceleration": Field("<f8", acceleration, 3),
            "absent": Field("<f8", acceleration + 8 * 3),
        }
        self._fields = row_type(fields, self._templates.shape[1])

    def batches(self, found: Sequence[ImuSamples], shift: int, horizon: int, progress: float) -> Iterator[Batch]:
        """Encode samples in the order of their stamps, to which shift is added, us."""
        place = np.concatenate([np.full(len(samples.stamp), self._place[samples.source]) for samples in found])
        stamp = (np.concatenate([samples.stamp for samples in found]) + shift) * 1000
        rate = np.concatenate([samples.rate for samples in found])
        acceleration = np.concatenate([samples.acceleration for samples in found])
        order = np.argsort(stamp, kind="stable")
        for k in range(0, len(order), _TOGETHER):
            rows, rest = order[k : k + _TOGETHER], order[k + _TOGETHER :]
            data = self._encoded(place[rows], stamp[rows], rate[rows], acceleration[rows])
            count, size = data.shape
            yield Batch(
                buffer=data.reshape(-1),
                topic=self._topic[place[rows]],
                log_time=stamp[rows],
                offset=np.arange(count) * size,
                length=np.full(count, size),
                horizon=min(horizon, int(stamp[rest[0]])) if len(rest) else horizon,
                progress=progress,
            )

    def _encoded(self, place: Int, stamp: Int, rate: Array, acceleration: Array) -> Bytes:
        """Return k messages, (k, size); stamp in ns, rate and acceleration (k, 3) in FLU."""
        data = self._templates[place]
        fields = data.view(self._fields)[:, 0]
        fields["sec"], fields["nanosec"] = np.divmod(stamp, 1_000_000_000)
        fields["rate"] = rate
        fields["acceleration"] = np.where(np.isnan(acceleration), 0.0, acceleration)
        # A covariance of zeros is an unknown one; that of what is absent begins with -1 (REP-145).
        fields["absent"] = -1.0 * np.isnan(acceleration).any(axis=1)
        return data
