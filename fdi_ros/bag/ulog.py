# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""PX4's ULog files (.ulg, .ulog), read whole by pyulog.

Rates are in sensor_gyro (board frame; specific forces in sensor_accel), vehicle_imu (body frame, calibrated: angles and
the time that each took) and sensor_gyro_fifo (board frame, all samples of the sensor,
stamped with the last). By default these are logged at 1 to 2 Hz, as is
vehicle_imu_status (body frame, calibrated: the mean of the last 0.1 s). The means of a
default log serve a coarse check. Times count from the start of the autopilot. A
simulation on the clock of its computer stamps with dates.

pyulog keeps one object per message without samples and per announced field, retries
byte by byte in damaged files, and prints. Its input is therefore cut off when a file
holds more than any logger writes.
"""

from __future__ import annotations

import contextlib
import io
from collections import defaultdict
from collections.abc import Mapping, Sequence
from itertools import count, takewhile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.bag.flight_log import (
    FLU,
    GPS_FIX_3D,
    LARGEST_DEVICE,
    SETTINGS,
    ImuSamples,
    Source,
    imu_samples,
    per_time,
    possible_start,
)
from fdi_ros.bag.library_log import Columns, LibraryLog, message_count
from fdi_ros.bag.modes import px4_navigation_mode
from fdi_ros.bag.raw import MUCH_LOST
from fdi_ros.errors import BagError
from fdi_ros.model.samples import Array, Int
from fdi_ros.system import require
from fdi_ros.system.files import LOGS
from fdi_ros.system.text import figures

#: bytes of a message before its content: two of its size, one of its kind
_HEAD = 3
_SUBSCRIPTION, _DATA = b"AD"
#: formats within formats
_DEEPEST = 16
_SELECTED, _STATUS = "sensor_combined", "vehicle_imu_status"
_IMU_TOPICS = ("vehicle_imu", "sensor_gyro", "sensor_gyro_fifo", _SELECTED, _STATUS)
_RAW_GYRO, _RAW_FORCE = "sensor_gyro", "sensor_accel"
"""Messages of a gyro, and of an accelerometer, which may be samples of other times."""
_GPS_TOPICS = ("sensor_gps", "vehicle_gps_position")
_LACKS = "its format lacks a field, or is not that of its samples"
_PYULOG_ERRORS = (
    ArithmeticError,
    AttributeError,
    LookupError,
    MemoryError,
    RuntimeError,
    TypeError,
    ValueError,
)
"""Exceptions of pyulog for a damaged file."""
#: us over which PX4 takes the means of vehicle_imu_status
_MEAN_TIME = 100_000
_THROTTLE = (
    ("vehicle_thrust_setpoint", "xyz[2]"),
    ("actuator_controls_0", "control[3]"),
)
"""Topics and fields with the throttle, of newer and older versions."""
_TEMPERATURES = (("gyro_device_id", "temperature_gyro"), ("device_id", "temperature"))
"""Fields with the device of a gyro and its temperature."""
_HELD = {
    "temperature_gyro": "up to {high:.0f} °C",
    "gyro_vibration_metric": "vibration up to {plain} rad/s",
    "gyro_error_count": "{high:.0f} errors",
    "gyro_clipping": "{high:.0f} samples clipped on an axis",
}
"""Fields of vehicle_imu_status to report, with their format; none of zeros only."""


class _Bounded(io.BytesIO):
    """A file that ends where messages without samples exceed those of any logger."""

    def __init__(self, data: bytes) -> None:
        super().__init__(data)
        self.reached = 0  # up to there the file was read, bytes
        self.cut = False  # whether the file ends within a message
        self._left = LOGS.ulog_other_bytes

    def read(self, size: int | None = -1, /) -> bytes:
        """Read bytes. A read of three bytes is the head of a message."""
        data = super().read(size) if self._left > 0 else b""
        if size == _HEAD and len(data) == _HEAD and data[2] != _DATA:
            cost = (
                LOGS.ulog_topic_cost
                if data[2] == _SUBSCRIPTION
                else LOGS.ulog_message_cost
            )
            self._left -= (data[0] | data[1] << 8) + cost
        is_end = size == _HEAD and not data
        self.cut = len(data) < (size or 0) and not is_end
        self.reached = max(self.reached, self.tell())
        return data


class Ulog(LibraryLog):
    """An open file of PX4."""

    magic = b"ULog\x01\x12\x35"
    refusal = "is no log of PX4"
    kinds = ("vehicle_imu", "sensor_gyro", "sensor_gyro_fifo")
    settings = "on PX4, add the line vehicle_imu to etc/logging/logger_topics.txt on the SD card"
    one_imu = (
        "one IMU cannot be checked: this autopilot logged no other ({}). If the board has more, add the line"
        f" vehicle_imu to etc/logging/logger_topics.txt on the SD card ({SETTINGS}), and check that CAL_GYROn_PRIO"
        " is not 0"
    )
    coarse = _STATUS
    selected = _SELECTED
    most = LOGS.ulog_bytes
    together = 1 << 14

    def load(self, data: bytes) -> dict[Source, Columns]:
        """Read messages with pyulog, and note the damage."""
        require("reading PX4's logs (.ulg)", ("pyulog",))
        if (second := data.find(self.magic, 1)) > 0:
            self.note(
                f"a second log begins at byte {second}: the {len(data) - second} bytes from there on were left out"
            )
            data = data[:second]
        bounded = _Bounded(data)
        log = _parsed(bounded, self.file.name)
        if bounded.cut or bounded.reached < len(data):
            much = len(data) - bounded.reached > MUCH_LOST * len(data)
            note = self.lose if much else self.note
            note(f"it is cut off or damaged: read up to byte {bounded.reached}")
        if log.file_corruption:
            self.lose("it is damaged: what pyulog could not read was left out")
        if dropouts := [1e-3 * one.duration for one in log.dropouts]:
            times = f"{len(dropouts)} time{'s' * (len(dropouts) > 1)}"
            self.note(
                f"the logger dropped out {times}, for {sum(dropouts):.3g} s in all and {max(dropouts):.3g} s at most"
            )
        self.hardware_id = str(log.msg_info_dict.get("sys_uuid", ""))[:64]
        for text in log.logged_messages:
            self.add_text(int(text.timestamp), text.log_level_str(), text.message)
        parts: defaultdict[Source, list[Columns]] = defaultdict(list)
        for one in log.data_list:
            self.counts[one.name] += message_count(one.data)
            if one.name in _IMU_TOPICS:
                parts[Source(one.name, one.multi_id)].append(one.data)
            elif one.name in _GPS_TOPICS and self.start_utc is None:
                self.start_utc = _start_utc(one.data)
            self._take_flight(one.name, one.data)
        joined = {source: _joined(columns) for source, columns in parts.items()}
        found = {
            source: columns
            for source, columns in joined.items()
            if self.samples(
                source.kind, {name: column[:0] for name, column in columns.items()}
            )
            is not None
        }
        unread = parts.keys() - found.keys()
        lacking = {source.kind for source in unread} - {_STATUS}
        announced = (
            log.message_formats.keys() - self.counts.keys()
            if log.file_corruption
            else set()
        )
        self.unread = dict.fromkeys(lacking | (announced & set(_IMU_TOPICS)), _LACKS)
        # Before version 1.12 the status has no means of the rate.
        status = {one: joined[one] for one in sorted(joined) if one.kind == _STATUS}
        together = _simultaneous(
            {one: columns for one, columns in status.items() if one in found}
        )
        self.status = _status_words(status, together)
        self._take_temperatures(found)
        return _with_forces(found, _accelerometers(log)) | together

    def _take_flight(self, name: str, columns: Columns) -> None:
        """Take modes and throttle."""
        if name == "vehicle_status" and {"timestamp", "nav_state"} <= columns.keys():
            for stamp, number in zip(
                columns["timestamp"].tolist(),
                columns["nav_state"].tolist(),
                strict=True,
            ):
                self.add_mode(stamp, px4_navigation_mode(number))
        for topic, field in _THROTTLE:
            if name == topic and {"timestamp", field} <= columns.keys():
                self.throttle.add(columns["timestamp"], np.abs(columns[field]))

    def _take_temperatures(self, topics: Mapping[Source, Columns]) -> None:
        """Take the temperature and the device of each IMU, matched by its device."""
        for source, columns in topics.items():
            for device_field, field in _TEMPERATURES:
                if device_field in columns and message_count(columns):
                    device = int(columns[device_field][0])
                    if 0 < device < LARGEST_DEVICE:
                        self.devices.setdefault(source.instance, device)
                    if field in columns:
                        stamp = columns["timestamp"]
                        self.add_temperature(source.instance, stamp, columns[field])

    def samples(self, kind: str, columns: Columns) -> ImuSamples | None:
        """Return the samples in messages of a kind, None if a field is missing or malformed."""
        acceleration = None
        try:
            # Numbers of a damaged log may be anything.
            with np.errstate(all="ignore"):
                stamp = _stamp(columns)
                if kind == "vehicle_imu":
                    # Changes of angle and velocity over the time of each sample.
                    rate = per_time(
                        _array(columns, "delta_angle"), columns["delta_angle_dt"] * 1e-6
                    )
                    acceleration = per_time(
                        _array(columns, "delta_velocity"),
                        columns["delta_velocity_dt"] * 1e-6,
                    )
                elif kind == "sensor_gyro_fifo":
                    stamp, rate = _unpacked(stamp, columns)
                elif kind == _STATUS:
                    # The mean of 0.1 s belongs to the middle of that time.
                    stamp = stamp - _MEAN_TIME // 2
                    rate = _array(columns, "mean_gyro")
                elif kind == _SELECTED:
                    rate = _array(columns, "gyro_rad")
                else:
                    rate = _vectors(columns)
                    if "force[0]" in columns:
                        acceleration = _array(columns, "force")
        except (KeyError, ValueError):
            return None
        acceleration = (
            np.full(rate.shape, np.nan) if acceleration is None else acceleration
        )
        if not rate.shape == acceleration.shape == (len(stamp), 3):
            return None
        return imu_samples(stamp, rate * FLU, acceleration * FLU)


def _vectors(columns: Columns) -> Array:
    """Return the values along x, y and z, (k, 3)."""
    return np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=1)


def _accelerometers(log: Any) -> dict[int, Columns]:
    """Return the messages of each accelerometer by its instance."""
    parts: defaultdict[int, list[Columns]] = defaultdict(list)
    for one in log.data_list:
        if one.name == _RAW_FORCE:
            parts[one.multi_id].append(one.data)
    return {instance: _joined(columns) for instance, columns in parts.items()}


def _with_forces(
    topics: Mapping[Source, Columns], felt: Mapping[int, Columns]
) -> dict[Source, Columns]:
    """Add the specific force to the messages of raw gyros, (k,) ``force[0]`` to ``[2]``.

    It is that of the accelerometer of the same device, or else of the same instance.
    """
    by_device = {_device(columns): columns for columns in felt.values()}
    by_device.pop(0, None)
    found = dict(topics)
    for source, columns in topics.items():
        own = by_device.get(_device(columns)) or felt.get(source.instance)
        if source.kind == _RAW_GYRO and own is not None:
            found[source] = {**columns, **_forces_at(_stamp(columns), own)}
    return found


def _device(columns: Columns) -> int:
    """Return the id of the device of messages. 0: not known."""
    return int(max(columns.get("device_id", np.zeros(1))[:1], default=0))


def _forces_at(times: Int, columns: Columns) -> Columns:
    """Interpolate the samples of an accelerometer at times (k,), us. NaN outside."""
    try:
        stamp, first = np.unique(_stamp(columns), return_index=True)
        force = _vectors(columns)[first]
    except (KeyError, ValueError):
        return {}
    if len(stamp) < 2:
        return {}
    step = np.diff(stamp)
    after = np.searchsorted(stamp, times).clip(1, len(step))
    # A longer step is a gap.
    bridged = step[after - 1] <= 3.0 * np.median(step)
    inside = bridged & (times >= stamp[0]) & (times <= stamp[-1])
    return {
        f"force[{k}]": np.where(inside, np.interp(times, stamp, force[:, k]), np.nan)
        for k in range(3)
    }


def _joined(parts: Sequence[Columns]) -> Columns:
    """Join the parts of a topic: data appended to a file repeats the topics."""
    if len(parts) == 1:
        return parts[0]
    common = set.intersection(*(set(part) for part in parts))
    return {name: np.concatenate([part[name] for part in parts]) for name in common}


def _parsed(file: _Bounded, path: str) -> Any:
    """Parse a file with pyulog. `BagError` if that fails."""
    from pyulog import ULog
    from pyulog.exceptions import ULogException, ULogIncompatibleFlagException

    try:
        # pyulog prints warnings.
        with contextlib.redirect_stdout(io.StringIO()):
            formats = ULog(
                _Bounded(file.getvalue()), parse_header_only=True
            ).message_formats
            known: dict[str, int] = {}
            if any(
                count_fields(formats, name, known) > LOGS.ulog_fields
                for name in formats
            ):
                raise BagError(
                    f"{path} defines a message of more than {LOGS.ulog_fields} fields"
                )
            return ULog(file)
    except ULogIncompatibleFlagException as error:
        raise BagError(
            f"{path} is a ULog of a later version, whose flags say that it must not be read"
        ) from error
    except (ULogException, *_PYULOG_ERRORS) as error:
        raise BagError(f"{path} cannot be read by pyulog: {error}") from error


def count_fields(
    formats: Mapping[str, Any], name: str, known: dict[str, int], depth: int = 0
) -> int:
    """Count the fields of a message with nested formats, up to one beyond the limit."""
    if name not in known:
        if depth > _DEEPEST:
            return LOGS.ulog_fields + 1
        # A format within itself has no end.
        known[name] = LOGS.ulog_fields + 1
        total = sum(
            max(1, length)
            * (count_fields(formats, kind, known, depth + 1) if kind in formats else 1)
            for kind, length, _ in formats[name].fields
        )
        known[name] = min(total, LOGS.ulog_fields + 1)
    return known[name]


def _simultaneous(topics: Mapping[Source, Columns]) -> dict[Source, Columns]:
    """Return the means of several IMUs at common stamps, if taken over mostly the same time.

    Interpolation over a second of flight differs by more than any fault.
    """
    stamps = {
        source: _stamp(columns)
        for source, columns in topics.items()
        if message_count(columns)
    }
    if len(stamps) < 2:
        return {}
    times = np.sort(min(stamps.values(), key=len))
    nearest = {source: _nearest(stamp, times) for source, stamp in stamps.items()}
    late = [stamps[source][k] - times for source, k in nearest.items()]
    kept = np.max(np.abs(late), axis=0) <= _MEAN_TIME // 2
    return {
        source: {
            "timestamp": times[kept],
            **{
                name: column[k[kept]]
                for name, column in topics[source].items()
                if name.startswith("mean_gyro")
            },
        }
        for source, k in nearest.items()
    }


def _status_words(
    topics: Mapping[Source, Columns], together: Mapping[Source, Columns]
) -> str:
    """Describe each IMU in vehicle_imu_status, and the differences of the means.

    ``together``: means at common stamps. Empty without such fields.
    """
    words = []
    means = [(one, _array(columns, "mean_gyro")) for one, columns in together.items()]
    for source, mean in means[1:]:
        first, reference = means[0]
        if len(mean):
            apart = np.median(mean - reference, axis=0) * FLU
            differences = ", ".join(f"{value:+.4f}" for value in apart)
            words.append(
                f"imu_{source.instance} less imu_{first.instance}, median of"
                f" {len(mean)} means: {differences} rad/s"
            )
    for source, columns in topics.items():
        held = []
        for name, form in _HELD.items():
            values = [column for key, column in columns.items() if _is_of(key, name)]
            found = np.concatenate([np.empty(0), *values])
            found = found[np.isfinite(found)]
            # A temperature of exactly 0 is not measured.
            if found.any():
                high = float(found.max())
                held.append(form.format(high=high, plain=figures(high, 2)))
        if held:
            words.append(f"imu_{source.instance} {', '.join(held)}")
    return f"{_STATUS} ({'; '.join(words)})" if words else ""


def _is_of(key: str, name: str) -> bool:
    """Whether a column is this field or an element of this field."""
    return key == name or key.startswith(f"{name}[")


def _nearest(stamp: Int, times: Int) -> Int:
    """Return which of k stamps are next to m times, (m,)."""
    order = np.argsort(stamp, kind="stable")
    ordered = stamp[order]
    after = np.searchsorted(ordered, times).clip(0, len(stamp) - 1)
    before = (after - 1).clip(0)
    return order[
        np.where(times - ordered[before] < ordered[after] - times, before, after)
    ]


def _array(columns: Columns, name: str) -> NDArray[Any]:
    """Return an array field, (k, length). `ValueError` if the field is missing."""
    there = takewhile(columns.__contains__, (f"{name}[{k}]" for k in count()))
    return np.stack([columns[one].astype(np.float64) for one in there], axis=1)


def _stamp(columns: Columns) -> Int:
    """Return the times of samples (k,), us; before version 1.11 those of publication."""
    stamp = columns["timestamp"].astype(np.int64)
    if "timestamp_sample" not in columns:
        return stamp
    sampled = columns["timestamp_sample"].astype(np.int64)
    return np.where(sampled > 0, sampled, stamp)


def _unpacked(last: Int, columns: Columns) -> tuple[Int, Array]:
    """Return all samples of k FIFO messages, equally spaced up to their times (k,)."""
    raw = np.stack([_array(columns, axis) for axis in "xyz"], axis=-1)
    room = raw.shape[1]
    size = np.minimum(columns["samples"].astype(np.int64), room)
    before = size[:, None] - 1 - np.arange(room)
    spacing = columns["dt"].astype(np.float64)
    spacing = np.where((spacing > 0) & (spacing < 1e6), spacing, 0.0)
    earlier = np.round(before * spacing[:, None]).astype(np.int64)
    stamp = last[:, None] - earlier
    rate = raw * columns["scale"].astype(np.float64)[:, None, None]
    return stamp[before >= 0], rate[before >= 0]


def _start_utc(columns: Columns) -> int | None:
    """Return the UTC of the start of the autopilot by GPS messages (k,), us since 1970."""
    if not {"timestamp", "time_utc_usec"} <= columns.keys():
        return None
    fixed = (
        columns["fix_type"] >= GPS_FIX_3D
        if "fix_type" in columns
        else np.ones(message_count(columns), dtype=bool)
    )
    utc, stamp = (
        columns[name].astype(np.int64)[fixed] for name in ("time_utc_usec", "timestamp")
    )
    return possible_start(utc, stamp)
