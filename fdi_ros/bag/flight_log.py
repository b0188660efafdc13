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
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np

from fdi_ros.arrays import Array, Bytes, Int
from fdi_ros.bag.log_parts import Field, ImuSamples, LogFormat, LogReader, Portion, Source, row_type
from fdi_ros.bag.log_survey import Survey, Track, at_one_time, choose, first_step
from fdi_ros.bag.raw import NO_HORIZON, Batch, Damage, Topic
from fdi_ros.core.messages import ImuTemplate
from fdi_ros.errors import BagError
from fdi_ros.limits import EARLIEST, LATEST, LOG_SPAN

IMU = "sensor_msgs/msg/Imu"
_FAR = 10_000_000
"""us; a sample that far from those logged before and after it has a damaged time."""
_HEAD = 1 << 10
"""First bytes of a file, by which its parts are known."""
_PORTION = 1 << 22
"""Bytes that are read at once, much more than the longest record."""
_TOGETHER = 1 << 10
"""Messages handed on at once: so few that in a bag made of them a chunk holds what is near in time."""


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
        try:
            self._file: BinaryIO = path.open("rb")
        except OSError as error:
            raise BagError(f"cannot open {path}: {error.strerror}") from error
        try:
            self.size = os.fstat(self._file.fileno()).st_size
            head = self._file.read(_HEAD)
            begin = head[: len(form.magic)]
            if begin != form.magic:
                words = f"is no log of {form.stack}: it starts with {begin!r}" if begin else "is empty"
                raise BagError(f"{path} {words}")
            self._parts = self._parts_of(head)
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
