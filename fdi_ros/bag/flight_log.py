# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Logs of flight stacks as recordings: the common part of all formats.

A log is walked twice in portions: first to find the IMUs, their sample rates and the
date, then to read. A format turns a portion into samples. This module turns samples
into sensor_msgs/msg/Imu messages on ``/imu_1``, ``/imu_2`` and so on, whatever the logged
message. The number is the one that the pilot sees: ArduPilot counts IMUs from 1 in its
messages and parameters (INS_USE2, SCALED_IMU2), PX4 from 0 (CAL_GYRO0_ID).

Flight stacks use body axes front, right, down (FRD), messages front, left, up (FLU,
REP-103). Stamps count from the start of the autopilot. With GPS time in the log, the
UTC of that start is added. Stamps that are dates (a simulation on its computer's clock)
are kept.
"""

from __future__ import annotations

import re
from abc import abstractmethod
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.bag.flight_context import (
    COLDEST,
    HOTTEST,
    KEPT,
    Course,
    FlightContext,
    Mode,
    Thinned,
)
from fdi_ros.bag.raw import NO_HORIZON, BagFile, Batch, Damage, LogText, Topic
from fdi_ros.bag.recorder_clock import RecorderClock
from fdi_ros.core.messages import ImuTemplate
from fdi_ros.errors import BagError
from fdi_ros.model.samples import Array, Bytes, Int
from fdi_ros.system.files import TIMES
from fdi_ros.system.text import figures, percent, shown

IMU = "sensor_msgs/msg/Imu"
SETTINGS = 'docs/flight_logs.md, "Settings of the logger"'
MESSAGES_READ = 'docs/flight_logs.md, "messages read"'
#: from FRD
FLU = np.array([1.0, -1.0, -1.0])


class _Judged(NamedTuple):
    """How many samples, and how fast, a source must have to be judged."""

    #: samples by which the rate of a source can be judged
    samples: int = 20
    #: means of a coarse check: the shortest log has few
    means: int = 3
    #: lowest rate of logged means, Hz
    mean_rate: float = 0.5


_JUDGED = _Judged()


class _Damage(NamedTuple):
    """From where the times of a log are damaged."""

    #: largest step back of time within one log, us
    step_back: int = 1_000_000
    #: distance from neighbours at which a time is damaged, us
    step: int = 10_000_000
    #: samples whose median time marks the progress of a log, robust to damaged
    #: times
    neighbours: int = 17


_DAMAGE = _Damage()

#: messages per batch, few enough that a chunk of a converted bag covers a short time
_LOG_BATCH = 1 << 10
#: instances of one kind, more than any autopilot has, that are looked at for copies
_MOST_COMPARED = 16
#: share of a log that must be read for a verdict on the whole of it
LEAST_READ = 0.9
#: board and its serial number, as ArduPilot sends both at its start
_BOARD = re.compile(r"[\w-]+ ([0-9A-F]{8} [0-9A-F]{8} [0-9A-F]{8})")
#: parameter of ArduPilot with the device of a gyro
_DEVICE_PARAMETER = re.compile(r"INS_GYR([23]?)_ID")
#: ids of devices have 32 bits
LARGEST_DEVICE = 1 << 32
#: GPS status from which on the time is known, in logs of both autopilots: a fix in three dimensions
GPS_FIX_3D = 3
#: full throttle, by the message: 1, per cent, or thousandths in old logs
_FULL = (1.0, 100.0, 1000.0)


class Source(NamedTuple):
    """Where samples come from: one instance of one kind of logged message."""

    #: name of the message, such as GYR or ``sensor_gyro``
    kind: str
    #: number of the sensor among those of the kind, from 0
    instance: int


ImuSamples = NDArray[np.void]
"""(k,) samples of one IMU in FLU. ``stamp``: us since the start of the autopilot or
since 1970. ``rate`` (3,): rad/s. ``acceleration`` (3,): m/s^2, NaN if not logged.
``end``: end of the record in the file, bytes, 0 if unknown.
"""
_SAMPLE = np.dtype(
    [("stamp", "i8"), ("rate", "f8", 3), ("acceleration", "f8", 3), ("end", "i8")]
)

Portion = tuple[list[tuple[Source, ImuSamples]], float]
"""Samples in one portion of a log, and the share of the log read so far, 0 to 1."""


def imu_samples(
    stamp: Int, rate: Array, acceleration: Array | float = np.nan, end: Int | int = 0
) -> ImuSamples:
    """Return samples (k,) from stamps and ends (k,), rates and accelerations (k, 3)."""
    samples = np.empty(len(stamp), _SAMPLE)
    samples["stamp"] = stamp
    samples["end"] = end
    samples["rate"] = rate
    samples["acceleration"] = acceleration
    return samples


def _joined(parts: Sequence[ImuSamples]) -> ImuSamples:
    """Concatenate samples as bytes: NumPy copies fields singly and 30 times slower."""
    return np.concatenate([one.view(f"V{_SAMPLE.itemsize}") for one in parts]).view(
        _SAMPLE
    )


@dataclass
class Track:
    """Rate of one source, and the progress of its time."""

    #: lowest acceptable rate, samples per second
    slowest: float
    #: samples by which its rate can be judged
    fewest: int = _JUDGED.samples
    #: number of samples so far
    count: int = 0
    #: samples that follow the one before without a gap
    fast: int = 0
    #: us between these and the ones before
    fast_time: int = 0
    #: stamp of the first sample, us
    first: int = 0
    #: stamp of the last sample, us
    last: int = 0
    #: latest stamp so far, us, None at the start
    come: int | None = None
    #: the last samples
    recent: ImuSamples = field(default_factory=lambda: np.empty(0, _SAMPLE))

    def add(self, stamp: Int) -> None:
        """Take in the stamps (k,) of further samples."""
        if not len(stamp):
            return
        steps = np.diff(stamp, prepend=self.last) if self.count else np.diff(stamp)
        # A longer interval is a gap, a shorter one may be jitter.
        steps = steps[(steps > 0) & (steps <= 1e6 * 1.5 / self.slowest)]
        self.fast += len(steps)
        self.fast_time += int(steps.sum())
        self.first = self.first if self.count else int(stamp[0])
        self.last = int(stamp[-1])
        self.count += len(stamp)

    def first_behind(self, samples: ImuSamples) -> int:
        """Return the end of the first record behind a step back of time, bytes, 0 if none.

        A second log begins there.
        """
        samples = _joined([self.recent, samples])
        self.recent = samples[1 - _DAMAGE.neighbours :]
        if not len(samples):
            return 0
        come = stamp = samples["stamp"]
        if (np.abs(np.diff(stamp)) > _DAMAGE.step_back).any():
            come = _medians(stamp, _DAMAGE.neighbours)
        first = int(come[0]) if self.come is None else self.come
        before = np.maximum.accumulate(np.append(first, come[:-1]))
        self.come = max(first, int(come.max()))
        # A jump ahead by years is a second log too: its times became dates, or ceased.
        behind = (come < before - _DAMAGE.step_back) | (come - before > TIMES.log_span)
        return int(samples["end"][np.argmax(behind)]) if behind.any() else 0

    @property
    def steady(self) -> bool:
        """Whether most samples follow one another without gaps."""
        return 2 * self.fast > self.count

    @property
    def rate(self) -> float:
        """Samples per second: between gaps if most samples follow closely, else on average."""
        if self.steady:
            return self.fast * 1e6 / self.fast_time
        return (
            (self.count - 1) * 1e6 / (self.last - self.first)
            if self.last > self.first
            else 0.0
        )

    @property
    def fast_enough(self) -> bool:
        """Whether its rate can be judged and is high enough, in bursts at least."""
        # Clocks and loggers are inexact.
        return self.count >= self.fewest and self.rate >= 0.95 * self.slowest

    @property
    def usable(self) -> bool:
        """Whether the source is mostly logged fast enough. Gaps do not count."""
        return self.fast_enough and self.steady

    @property
    def figures(self) -> str:
        """Words for the rate."""
        if self.count < 2:
            return "once"
        if self.last <= self.first:
            return "at times that do not advance"
        in_bursts = self.fast_enough and not self.steady
        return f"at {figures(self.rate)} Hz{' in bursts' if in_bursts else ''}"


class FlightLog(BagFile):
    """An open log of a flight stack; each format derives from this class.

    `BagError` if fewer IMUs than needed are logged fast enough.
    """

    #: messages that samples of every IMU are logged in
    kinds: ClassVar[tuple[str, ...]]
    #: line of the documentation by which all IMUs are logged fast enough
    settings: ClassVar[str]
    #: sentence for a log of a single IMU, with a place for its figures
    one_imu: ClassVar[str]
    slowest: ClassVar[float] = 20.0
    """Lowest usable rate of an IMU, Hz: fewer samples show too little of the motion."""
    #: one has nothing to be compared with
    fewest_imus: ClassVar[int] = 2
    #: number of instance 0 in messages and parameters of the autopilot
    first_imu: ClassVar[int] = 0
    #: kind of message with means of the rate, read where nothing better is there
    coarse: ClassVar[str] = ""
    counted_by: ClassVar[str] = ""
    """Kind of message with one instance per sensor. Other kinds may have further
    instances.
    """
    selected: ClassVar[str] = ""
    """Kind of message with samples of the selected IMU alone, which cannot be compared."""

    def __init__(self, path: Path, damage: Damage, most: int) -> None:
        super().__init__(path, damage, most)
        self.end = self.size  # the log is read up to there, bytes
        try:
            while not self._survey():
                pass
            if self.end < LEAST_READ * self.size:
                share = (self.size - self.end) / self.size
                rest = f"the last {percent(share)} of {self.path.name}"
                self.leave_out(rest, "the time steps back before it")
            self._sources = self._choose()
        except BaseException:  # Close the file whatever ends the opening.
            self.close()
            raise
        dated = TIMES.earliest // 1000 <= self._starts[0] < NO_HORIZON
        if self.status:
            self.state(self.status)
        self._shift = (
            0 if dated else self.start_utc or 0
        )  # added to stamps, us; 0 for stamps that are dates, or without a date
        self.texts = tuple(
            one._replace(stamp=self._log_time(one.stamp)) for one in self.said
        )
        self.topics = tuple(
            Topic(self._topic(one), IMU, count=self._tracks[one].count)
            for one in self._sources
        )
        self.context = self.find_context()
        self.start_time = self._log_time(self._starts[0])

    def begin(self) -> None:
        """Begin a walk and forget the findings of earlier ones."""
        self.unread: dict[
            str, str
        ] = {}  # messages of IMUs that are there and cannot be read, by name, and why
        self.counts: Counter[str] = Counter()  # records of every message, by name
        self.status = ""  # further figures of each IMU, in words
        self.start_utc: int | None = (
            None  # UTC of the start of the autopilot, us since 1970, or None
        )
        self.hardware_id = ""
        self.said: list[LogText] = []  # texts of the autopilot up to here, stamps in us
        self.modes: list[Mode] = []  # changes of the flight mode, stamps in us
        self.throttle = Thinned(0.0, KEPT.throttle)
        self.temperatures: defaultdict[int, Thinned] = defaultdict(
            lambda: Thinned(COLDEST, HOTTEST)
        )  # of each instance, degC
        self.devices: dict[int, int] = {}  # device id of the gyro of each instance

    @abstractmethod
    def portions(self) -> Iterator[Portion]:
        """Read the log from its start up to `end`, in the order of the file."""

    def add_text(self, stamp: int, kind: str, text: str) -> None:
        """Take a text of the autopilot at a time, us."""
        board = _BOARD.fullmatch(text.strip())
        if board and not self.hardware_id:
            self.hardware_id = board[1]
        if len(self.said) < KEPT.texts and (line := " ".join(text.split())):
            self.said.append(LogText(stamp, kind, line))

    def add_mode(self, stamp: int, name: str) -> None:
        """Take the flight mode at a time, us."""
        changed = not self.modes or self.modes[-1].name != name
        if changed and len(self.modes) < KEPT.modes:
            self.modes.append(Mode(stamp, name))

    def take_parameter(self, name: str, value: float) -> None:
        """Take a parameter of ArduPilot. Those with the device of a gyro are kept."""
        found = _DEVICE_PARAMETER.fullmatch(name)
        if found and 0 < value < LARGEST_DEVICE:
            self.devices[int(found[1] or 1) - 1] = int(value)

    def add_temperature(
        self, instance: int, stamp: NDArray[Any], value: NDArray[Any]
    ) -> None:
        """Take temperatures of an IMU (k,), degC, at stamps (k,), us."""
        if instance in self.temperatures or len(self.temperatures) < _MOST_COMPARED:
            self.temperatures[instance].add(stamp, value)

    def origin(self, source: Source) -> str:
        """Return the message and instance of a source, as the log names them."""
        return f"{source.kind} {source.instance}"

    def mode_name(self, mode: str) -> str:
        """Return the name of a mode that was taken."""
        return mode

    def _topic(self, source: Source) -> str:
        return f"/imu_{source.instance + self.first_imu}"

    def find_context(self) -> FlightContext:
        """Return what was found beside the rates, with times of recording."""
        origins: dict[str, str] = {}
        temperatures: dict[str, Course] = {}
        for source in self._sources:
            topic = self._topic(source)
            device = self.devices.get(source.instance)
            named = "" if device is None else f", device {device}"
            origins[topic] = f"{self.origin(source)}{named}"
            course = self.temperatures[source.instance].course(self._shift)
            # Autopilots log 0 where an IMU has no thermometer.
            if course is not None and course.value.any():
                temperatures[topic] = course
        throttle = self.throttle.course(self._shift)
        if throttle is not None:
            peak = float(throttle.value.max())
            possible = (one for one in _FULL if peak <= 1.5 * one)
            full = next(possible, _FULL[-1])
            throttle = throttle._replace(value=throttle.value / full)
        modes = tuple(
            Mode(self._log_time(one.stamp), self.mode_name(one.name))
            for one in self.modes
        )
        return FlightContext(origins, temperatures, throttle, modes)

    def batches(self, topics: Sequence[str], clock: RecorderClock) -> Iterator[Batch]:
        """Read the messages of the topics, those of a portion in the order of their stamps."""
        sources = [source for source in self._sources if self._topic(source) in topics]
        if not sources:
            return
        # The frame_id of an instance has up to eight bytes with its end: all messages are equally long.
        templates = np.stack(
            [
                ImuTemplate(self._topic(source).removeprefix("/")).bytes
                for source in sources
            ]
        )
        number = np.array([topics.index(self._topic(source)) for source in sources])
        for (portion, progress), later in zip(
            self.portions(), [*self._starts[1:], NO_HORIZON], strict=False
        ):
            found = [
                (source, self._possible(one))
                for source, one in portion
                if source in sources
            ]
            if not found:
                continue
            place = np.repeat(
                [sources.index(source) for source, _ in found],
                [len(one) for _, one in found],
            )
            samples = _joined([one for _, one in found])
            stamp = (samples["stamp"] + self._shift) * 1000
            order = np.argsort(stamp, kind="stable")
            horizon = self._log_time(later)
            for k in range(0, len(order), _LOG_BATCH):
                rows = order[k : k + _LOG_BATCH]
                rest = order[k + _LOG_BATCH :]
                data = _encoded(templates[place[rows]], stamp[rows], samples.take(rows))
                count, size = data.shape
                yield Batch(
                    buffer=data.reshape(-1),
                    topic=number[place[rows]],
                    log_time=stamp[rows],
                    offset=np.arange(count) * size,
                    length=np.full(count, size),
                    horizon=min(horizon, int(stamp[rest[0]])) if len(rest) else horizon,
                    progress=progress,
                )

    # What a first walk finds -----------------------------------------------------------------------------------------

    def _survey(self) -> bool:
        """Walk the log; False if it must be walked again up to a step back of time."""
        self.begin()
        self._tracks: dict[Source, Track] = {}
        self._shared: Counter[tuple[Source, Source]] = Counter()
        """Samples that two sources, in order, have at the same time."""
        starts: list[int] = []
        for portion, _ in self.portions():
            found = [(source, self._possible(samples)) for source, samples in portion]
            # The step may lie among the last samples of the portion before.
            ends = [track.recent["end"] for track in self._tracks.values()]
            steps = [
                self._track(source).first_behind(samples) for source, samples in found
            ]
            if first := min(filter(None, steps), default=0):
                before = np.concatenate(
                    [[0], *ends, *(samples["end"] for _, samples in found)]
                )
                self._end_at(int(before[before < first].max()))
                return False
            for source, samples in found:
                self._track(source).add(samples["stamp"])
            others = [one for one in found if self.counted_by not in ("", one[0].kind)]
            others = sorted(others, key=lambda one: one[0])[:_MOST_COMPARED]
            for (one, samples), (other, beside) in combinations(others, 2):
                if one != other:
                    self._shared[one, other] += len(
                        np.intersect1d(samples["stamp"], beside["stamp"])
                    )
            starts.append(
                min(
                    [int(one["stamp"].min()) for _, one in found if len(one)],
                    default=NO_HORIZON,
                )
            )
        self._starts: list[int] = np.minimum.accumulate(starts[::-1])[::-1].tolist()
        """Earliest stamp in each portion and all later ones, us; `NO_HORIZON` without
        samples.
        """
        return True

    def _track(self, source: Source) -> Track:
        """Return the track of a source."""
        coarse = source.kind == self.coarse
        new = Track(_JUDGED.mean_rate, _JUDGED.means) if coarse else Track(self.slowest)
        return self._tracks.setdefault(source, new)

    def _end_at(self, step: int) -> None:
        """Leave out the rest of the file behind a byte."""
        self.note(
            f"the time steps back at byte {step}, as where a second log begins in the file: the {self.end - step}"
            f" bytes behind it ({percent((self.end - step) / self.end)} of the file) were left out"
        )
        self.end = step

    def _possible(self, samples: ImuSamples) -> ImuSamples:
        """Leave out samples with impossible times, or times far from their neighbours."""
        stamp = samples["stamp"]
        good = ((stamp >= 0) & (stamp <= TIMES.log_span)) | (
            (stamp >= TIMES.earliest // 1000) & (stamp <= TIMES.latest // 1000)
        )
        steps = np.abs(np.diff(stamp))
        if len(stamp) > 2 and (steps > _DAMAGE.step).any():
            # Most of five neighbours are right, and a gap has neighbours on both sides.
            good &= np.abs(stamp - _medians(stamp, 5)) <= _DAMAGE.step
        if good.all():
            return samples
        self.note("samples with impossible times were left out")
        return samples[good]

    def _log_time(self, stamp: int) -> int:
        """Return the time of recording, ns, for a stamp, us."""
        return NO_HORIZON if stamp == NO_HORIZON else (stamp + self._shift) * 1000

    # Which messages are then read ------------------------------------------------------------------------------------

    def _choose(self) -> list[Source]:
        """Return the sources to read: the kind of message with most usable IMUs, then samples.

        A sensor may be logged in several kinds of messages, but must not confirm
        itself.
        """
        sensors = self._sensors()

        def merit(kind: str) -> tuple[int, int]:
            usable = [
                track
                for source, track in sensors.items()
                if source.kind == kind and track.usable
            ]
            return len(usable), sum(track.count for track in usable)

        kind = max(self.kinds, key=merit)
        count = merit(kind)[0]
        if count < self.fewest_imus <= merit(self.coarse)[0]:
            kind = self.coarse
            self.note(
                f"A COARSE CHECK: no gyros are logged at {self.slowest:g} Hz or more, so {kind} is read, means at about"
                " 1 Hz. They show biases and drifts; noise, vibration and short faults cannot be seen"
            )
        elif count < self.fewest_imus:
            raise BagError(f"{self.path}{self._refusal(sensors)}")
        for source, track in sensors.items():
            if source.kind == kind and not track.usable:
                few = f"has too few samples to judge its rate ({track.count})"
                slow = (
                    f"is logged {track.figures}, expected at least {self.slowest:g} Hz"
                )
                self.note(
                    f"{self.origin(source)} {few if track.count < track.fewest else slow}, and was left out"
                )
        return sorted(
            source
            for source, track in sensors.items()
            if source.kind == kind and track.usable
        )

    def _sensors(self) -> dict[Source, Track]:
        """Return the sources that are sensors of their own."""
        kinds = (*self.kinds, self.coarse)
        tracks = {
            source: track
            for source, track in self._tracks.items()
            if source.kind in kinds and track.count
        }
        there = {source.instance for source in tracks if source.kind == self.counted_by}
        if there:
            return {
                source: track
                for source, track in tracks.items()
                if source.instance in there
            }
        for copy, source in _copies_of(tracks, self._shared).items():
            del tracks[copy]
            self.note(
                f"{copy.kind} {copy.instance} has the times of {source.kind} {source.instance}: taken for the same"
                f" sensor behind its filters, and left out (without {self.counted_by} the log does not say how many"
                " sensors there are)"
            )
        return tracks

    def _refusal(self, sensors: Mapping[Source, Track]) -> str:
        """Describe the IMUs in the log and the setting of the logger that helps."""
        kinds = {
            kind: [track for source, track in sensors.items() if source.kind == kind]
            for kind in self.kinds
        }
        there = [_logged(kind, tracks) for kind, tracks in kinds.items() if tracks]
        if self.status:
            there.append(self.status)
        unread = [
            f"{name}, which is not read ({why})"
            for name, why in sorted(self.unread.items())
        ]
        alone = [
            track
            for source, track in self._tracks.items()
            if source.kind == self.selected and track.count
        ]
        if alone:
            there.append(f"{self.selected} of the one selected IMU {alone[0].figures}")
        if unread and not there:
            return f" has of IMUs only {', '.join(unread)}: {MESSAGES_READ}"
        setting = f"{self.settings} ({SETTINGS})"
        if not there:
            most = ", ".join(
                f"{count} {shown(name, 32)}"
                for name, count in self.counts.most_common(6)
            )
            return f" has no {' or '.join(self.kinds)}, it has {most or 'no records'}. What to do: {setting}"
        has = "; ".join((*there, *unread))
        if not unread and max(map(len, kinds.values())) < self.fewest_imus:
            return f": {self.one_imu.format(has)}"
        needed = f"two IMUs or more, each with {_JUDGED.samples} samples or more at {self.slowest:g} Hz or more"
        return f" has too few samples to compare two IMUs: it has {has}; needed: {needed}. What to do: {setting}"


def _logged(kind: str, tracks: Sequence[Track]) -> str:
    """Describe how a kind of message is logged."""
    fastest = max(
        tracks, key=lambda track: (track.count >= _JUDGED.samples, track.rate)
    )
    few = f", {fastest.count} samples" if 1 < fastest.count < _JUDGED.samples else ""
    plural = "s" if len(tracks) > 1 else ""
    return f"{kind} of {len(tracks)} IMU{plural} {fastest.figures}{few}"


def _encoded(data: Bytes, stamp: Int, samples: ImuSamples) -> Bytes:
    """Encode k messages of sensor_msgs/msg/Imu, (k, size), stamps in ns."""
    at = ImuTemplate("imu_0").at
    layout: Any = {
        "names": ("sec", "nanosec", "rate", "acceleration", "absent"),
        "formats": ("<i4", "<u4", ("<f8", 3), ("<f8", 3), "<f8"),
        # Behind rate and acceleration stand their covariances.
        "offsets": (4, 8, at, at + 8 * 12, at + 8 * 15),
        "itemsize": data.shape[1],
    }
    fields = data.view(np.dtype(layout))[:, 0]
    fields["sec"], fields["nanosec"] = np.divmod(stamp, 1_000_000_000)
    fields["rate"] = samples["rate"]
    absent = np.isnan(samples["acceleration"])
    fields["acceleration"] = np.where(absent, 0.0, samples["acceleration"])
    # Zero covariance means unknown, -1 as the first element absent (REP-145).
    fields["absent"] = -1.0 * absent.any(axis=1)
    return data


def _medians(stamp: Int, window: int) -> Int:
    """Return the median of the stamps (k,) around each, mirrored at both ends."""
    beside = np.lib.stride_tricks.sliding_window_view(
        np.pad(stamp, window // 2, mode="reflect"), window
    )
    return np.sort(beside, axis=1)[:, window // 2]


def _copies_of(
    sensors: Mapping[Source, Track], shared: Mapping[tuple[Source, Source], int]
) -> dict[Source, Source]:
    """Return which sources are filtered copies of others: pairs with the same times.

    A copy has the instance of its sensor plus the number of sensors. If all sources
    share their times, as in a simulation, an even number is taken for sensors and
    copies.
    """
    same: set[Source] = set()
    for pair, count in shared.items():
        if sensors.keys() >= set(pair) and 2 * count > min(
            sensors[source].count for source in pair
        ):
            same.update(pair)
    ordered = sorted(same)
    if len(same) % 2:
        return {}
    half = len(same) // 2
    return dict(zip(ordered[half:], ordered[:half], strict=True))


def possible_start(utc: Int, stamp: Int) -> int | None:
    """Return the UTC of the start of the autopilot, us since 1970, by the first plausible fix.

    ``utc`` (k,): us since 1970. ``stamp`` (k,): us since the start.
    """
    good = (
        (stamp >= 0)
        & (stamp <= TIMES.log_span)
        & (utc >= TIMES.earliest // 1000)
        & (utc <= TIMES.latest // 1000 - TIMES.log_span)
    )
    return int((utc - stamp)[np.argmax(good)]) if good.any() else None


def per_time(change: Array, seconds: NDArray[Any]) -> Array:
    """Divide changes (k, 3) by their durations (k,), s, NaN for unknown durations."""
    seconds = seconds.astype(np.float64)
    return change / np.where(seconds > 0, seconds, np.nan)[:, None]
