# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Logs of flight stacks as recordings: what their formats have in common.

A log is gone through twice, portion by portion: when it is opened, to find the IMUs, their sample rates and the time of
day, and again to read it. A format reads samples out of a portion; here these become sensor_msgs/msg/Imu messages on
``/imu_0``, ``/imu_1`` and so on: the instances of the log, whichever kind of message they were logged in.

Flight stacks count body axes front, right, down (FRD); messages are in front, left, up (FLU, REP-103). Stamps are those
of the samples: time since the start of the autopilot, and from a log with GPS time the UTC of that start is added. A
log whose stamps are dates (a simulation by the clock of its computer) is read as it is.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fdi_ros.bag.log_parts import COARSE_RATE, SETTINGS, Field, ImuSamples, LogFormat, LogReader, Source, row_type
from fdi_ros.bag.raw import NO_HORIZON, Batch, Damage, Topic, open_file
from fdi_ros.core.messages import ImuTemplate
from fdi_ros.errors import BagError
from fdi_ros.model.samples import Array, Bytes, Int
from fdi_ros.system.limits import EARLIEST, LATEST, LOG_SPAN
from fdi_ros.system.text import shown

IMU = "sensor_msgs/msg/Imu"
_FAR = 10_000_000
"""us; a sample that far from those logged before and after it has a damaged time."""
_TOGETHER = 1 << 10
"""Messages handed on at once: so few that in a bag made of them a chunk holds what is near in time."""
FEWEST = 20
"""Samples by which the rate of a source can be judged."""
_FEWEST_IMUS = 2
"""One has nothing to be compared with."""
_TOLERANCE = 0.95
"""Of that rate; clocks and loggers are not exact."""
_APART = 1.5
"""Times the longest interval between two samples: a longer one is a gap, a shorter one may be jitter."""
_STEP = 1_000_000
"""us; a log goes on as long as its times step back by no more."""
_BESIDE = 17
"""Samples whose median says where a log has come to: no few damaged times move it."""


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
    """Follows the time of one source to find where it steps back for good: there a second log begins in the file."""

    latest: int | None = None
    """Stamp up to which the log has come, us; None: at its start."""
    stamp: Int = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """Of the last samples, us."""
    end: Int = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """Where the records of these end, bytes."""

    def first_behind(self, samples: ImuSamples) -> int:
        """Take in samples; return where the record of the first one behind a step ends, bytes; 0: there is none."""
        stamp, end = np.append(self.stamp, samples.stamp), np.append(self.end, samples.end)
        self.stamp, self.end = stamp[1 - _BESIDE :], end[1 - _BESIDE :]
        if not len(stamp):
            return 0
        steady = bool((np.abs(np.diff(stamp)) <= _STEP).all())
        come = stamp if steady else _medians(stamp, _BESIDE)
        first = int(come[0]) if self.latest is None else self.latest
        before = np.maximum.accumulate(np.append(first, come[:-1]))
        self.latest = max(first, int(come.max()))
        # Nor does a log go on years later: there its times begin to be dates, or no longer are.
        behind = (come < before - _STEP) | (come - before > LOG_SPAN)
        return int(end[np.argmax(behind)]) if behind.any() else 0


def _medians(stamp: Int, window: int) -> Int:
    """Return the median of so many stamps (k,) beside each; before the first and after the last they are mirrored."""
    beside = np.lib.stride_tricks.sliding_window_view(np.pad(stamp, window // 2, mode="reflect"), window)
    return np.sort(beside, axis=1)[:, window // 2]


@dataclass
class Survey:
    """What a first walk found."""

    tracks: dict[Source, Track] = field(default_factory=dict)
    starts: list[int] = field(default_factory=list)
    """Earliest stamp in each portion, us; `NO_HORIZON`: it has no samples."""
    clocks: dict[Source, Clock] = field(default_factory=dict)
    shared: Counter[tuple[Source, Source]] = field(default_factory=Counter)
    """Samples that two sources, in order, have at the same time."""


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


MESSAGES = 'docs/flight_logs.md, "messages read"'
_MOST_NAMES = 6
"""Messages that are named of a log without IMUs."""


def choose(path: Path, form: LogFormat, survey: Survey, reader: LogReader, damage: Damage) -> list[Source]:
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
    reader
        Has gone through it.
    damage
        Takes what is left out.

    Raises
    ------
    BagError
        If there are no two IMUs that are logged fast enough.
    """
    tracks = _sensors(path.name, form, survey, damage)

    def merit(kind: str) -> tuple[int, int]:
        usable = [track for source, track in tracks.items() if source.kind == kind and track.usable]
        return len(usable), sum(track.count for track in usable)

    kind = max(form.kinds, key=merit)
    count = merit(kind)[0]
    if count < _FEWEST_IMUS <= merit(form.coarse)[0]:
        kind = form.coarse
        damage.add(
            f"{path.name}: A COARSE CHECK: no gyros are logged at {form.slowest:g} Hz or more, so {kind} is read, means"
            " at about 1 Hz. They show biases and drifts; noise, vibration and short faults cannot be seen"
        )
    elif count < _FEWEST_IMUS:
        raise BagError(f"{path}{_refusal(form, survey, reader, tracks)}")
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
    tracks = {source: track for source, track in survey.tracks.items() if source.kind in (*form.kinds, form.coarse)}
    tracks = {source: track for source, track in tracks.items() if track.count}
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


def _refusal(form: LogFormat, survey: Survey, reader: LogReader, tracks: dict[Source, Track]) -> str:
    """Say what a log has in place of IMUs that can be read, and which line of the documentation applies."""
    kinds = {kind: [track for source, track in tracks.items() if source.kind == kind] for kind in form.kinds}
    there = [_logged(kind, own) for kind, own in kinds.items() if own]
    unread = [f"{name}, which is not read ({why})" for name, why in sorted(reader.unread.items())]
    alone = [track for source, track in survey.tracks.items() if source.kind == form.selected and track.count]
    if alone:
        there.append(f"{form.selected} of the one selected IMU {alone[0].figures}")
    if unread and not there:
        return f" has of IMUs only {', '.join(unread)}: {MESSAGES}"
    setting = f"{form.settings.get(reader.vehicle, form.settings[''])} ({SETTINGS})"
    if not there:
        most = ", ".join(f"{count} {shown(name, 32)}" for name, count in reader.counts.most_common(_MOST_NAMES))
        return f" has no {' or '.join(form.kinds)}, it has {most or 'no records'}: {setting}"
    has = ", ".join((*there, *unread))
    if not unread and max(map(len, kinds.values())) < _FEWEST_IMUS:
        return f": {form.one_imu.format(has)}"
    needed = f"two IMUs or more, each by itself, at {form.slowest:g} Hz or more, {FEWEST} samples or more"
    return f" has {has}; needed: {needed}: {setting}"


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
        self._file, self._end = open_file(path, form.magic, f"is no log of {form.stack}")
        try:
            if form.most and self._end > form.most:
                raise BagError(
                    f"{path} has {self._end >> 20} MB, expected at most {form.most >> 20}: such a log is read whole"
                )
            self._reader = form.reader(self._file, lambda line: damage.add(f"{path.name}: {line}"))
            while (survey := self._survey()) is None:
                pass
            self._sources = choose(path, form, survey, self._reader, damage)
        except BaseException:
            self.close()
            raise
        self._starts = np.minimum.accumulate(survey.starts[::-1])[::-1].tolist()
        """Earliest stamp in each portion and those after it, us; `NO_HORIZON`: they have no samples."""
        dated = EARLIEST // 1000 <= self._starts[0] < NO_HORIZON
        self._shift = 0 if dated else self._reader.start_utc or 0
        """UTC of the start of the autopilot, us; 0: not known, and times count from there, or they are dates."""
        self.texts = tuple(one._replace(stamp=self._log_time(one.stamp)) for one in self._reader.texts)
        """What the autopilot said, with the times of recording, ns."""
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
        for portion, later in zip(self._reader.portions(self._end), [*self._starts[1:], NO_HORIZON], strict=False):
            found = [self._possible(samples) for samples in portion.samples if samples.source in wanted]
            if found:
                yield from encoder.batches(found, self._shift, self._log_time(later), portion.progress)

    def _survey(self) -> Survey | None:
        """Go through the log; None: it ends where the time steps back, and is to be gone through again up to there."""
        survey = Survey()
        for portion in self._reader.portions(self._end):
            found = [self._possible(samples) for samples in portion.samples]
            if self._ends_within(found, survey.clocks):
                return None
            for samples in found:
                survey.tracks.setdefault(samples.source, Track(self._slowest(samples.source))).add(samples.stamp)
            survey.shared.update(
                at_one_time([one for one in found if self._form.counted_by not in ("", one.source.kind)])
            )
            survey.starts.append(min([int(one.stamp.min()) for one in found if len(one.stamp)], default=NO_HORIZON))
        return survey

    def _slowest(self, source: Source) -> float:
        return COARSE_RATE if source.kind == self._form.coarse else self._form.slowest

    def _ends_within(self, found: Sequence[ImuSamples], clocks: dict[Source, Clock]) -> bool:
        """Leave out what lies behind the place in the file where the time of a source steps back in a portion."""
        ends = [0, *(int(clock.end[-1]) for clock in clocks.values() if len(clock.end))]
        behind = [clocks.setdefault(samples.source, Clock()).first_behind(samples) for samples in found]
        first = min(filter(None, behind), default=0)
        if not first:
            return False
        ends += [int(one.end[one.end < first].max(initial=0)) for one in found]
        step, size = max(end for end in ends if end < first), self._end
        self.damage.add(
            f"{self.path.name}: the time steps back at byte {step}, as where a second log begins in the file: "
            f"the {size - step} bytes behind it ({100 * (size - step) / size:.3g} % of the file) were left out"
        )
        self._end = step
        return True

    def _possible(self, samples: ImuSamples) -> ImuSamples:
        """Leave out samples at times that no log lasts to, and at times far from those beside them."""
        stamp = samples.stamp
        good = ((stamp >= 0) & (stamp <= LOG_SPAN)) | ((stamp >= EARLIEST // 1000) & (stamp <= LATEST // 1000))
        if len(stamp) > 2 and (np.abs(np.diff(stamp)) > _FAR).any():
            # Of five neighbours most are right; a gap in the log has as many on its one side as on its other.
            good &= np.abs(stamp - _medians(stamp, 5)) <= _FAR
        if good.all():
            return samples
        self.damage.add(f"{self.path.name}: samples with impossible times were left out")
        return samples.at(good)

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
