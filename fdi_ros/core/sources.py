# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What arrives: the kinds of input, each named in a row of `fdi_ros.config.settings.INPUTS`.

A kind is a class derived from `UnitSource` or `ArraySource`, with its message type and
three compiled functions, which are listed in `Source`. They are functions of the kind's
own, and not arguments of a common one: so Numba compiles each once and keeps the
result, and no call is added to the way of a sample.
"""

from __future__ import annotations

import math
import struct
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import MAX_CHANNELS, MAX_UNITS, compiled
from fdi_ros.config.config import Config
from fdi_ros.config.settings import INPUTS
from fdi_ros.core.live import receive_arrived, receive_force, receive_stamped
from fdi_ros.core.messages import (
    CUT_VALUES,
    ENCAPSULATION,
    FIRST_OWN,
    GOOD,
    IMU_BEFORE_FORCE,
    IMU_BEFORE_RATE,
    IMU_DOUBLES,
    NO_CDR,
    NO_HEADER,
    Decoded,
    MessageError,
    as_batch,
    byte_order,
    is_cdr,
    place_after_header,
    read_bits,
    read_doubles,
    read_force,
    read_only,
    read_rate,
)
from fdi_ros.errors import ConfigError
from fdi_ros.model.geometry import MIN_CHANNELS
from fdi_ros.model.samples import Array, Bytes, Int


class Brought(NamedTuple):
    """Which channels of a sample the messages of one topic bring."""

    #: places of their values in a sample
    gyros: slice
    accelerometers: slice  #: their values stand behind those of the gyros

    @property
    def size(self) -> int:
        """Number of values in a message."""
        return sum(part.stop - part.start for part in self)


class Source(ABC):
    """One kind of input, with the settings of one monitor.

    What needs no settings is on the class: the messages of a recording are read before
    there are any.
    """

    type: ClassVar[str]  #: of its messages: ``sensor_msgs/msg/Imu``
    stamped: ClassVar[bool]
    """Whether messages carry the stamp of their measurement, and those of several units
    are aligned by it; else they are stamped when they arrive, and each is a sample of
    all channels."""
    topic_counts: ClassVar[range]  #: numbers of topics that a monitor takes
    value_counts: ClassVar[
        range
    ]  #: numbers of values that a message may have to be the gyros of a monitor
    called: ClassVar[str]  #: a message in words: ``an Imu``

    # Compiled, per kind
    # -------------------------------------------------------------------------------------------

    @staticmethod
    @abstractmethod
    def place(data: Bytes, offset: int, length: int, count: int) -> int:
        """Return the index of ``count`` values in a message, or a negative error code."""

    @staticmethod
    @abstractmethod
    def decode_into(
        data: Bytes, offset: Int, length: Int, code: Bytes, stamp: Int, values: Array
    ) -> None:
        """Read k messages into code (k,), stamp (k,) and values (k, c), which are zero before."""

    @staticmethod
    @abstractmethod
    def receive(
        aligner: NDArray[Any], live: NDArray[Any], inlet: int, data: Bytes, stamp: int
    ) -> int:
        """Take in one live message, its bytes, of the input topic ``inlet``, which arrived at ``stamp``, ns.

        ``aligner``, ``live``: as for `fdi_ros.core.live.process`. Returned is
        `fdi_ros.core.live.MORE` if a sample is ready to be worked, `MALFORMED` if the
        message was refused, else 0.
        """

    # Messages
    # -----------------------------------------------------------------------------------------------------

    @classmethod
    def explain(cls, code: int, data: bytes, count: int) -> str:
        """Return one line on the error of a message that should have ``count`` values."""
        size = len(data)
        order = byte_order(data)
        if code == NO_CDR:
            return f"{size} bytes with encapsulation {data[:2].hex() or 'none'} are no plain CDR"
        if code == NO_HEADER:
            return f"{size} bytes are too few for {cls.called}"
        if code == CUT_VALUES:
            (name,) = struct.unpack_from(f"{order}I", data, ENCAPSULATION + 8)
            return f"{size} bytes are too few for {cls.called} whose frame_id has {name} bytes"
        sec, nanosec = struct.unpack_from(f"{order}iI", data, ENCAPSULATION)
        return f"stamp has {sec} s and {nanosec} ns, expected at least 0 s and less than 1000000000 ns"

    @classmethod
    def announced(cls, buffer: Bytes, offset: Int, length: Int) -> int:
        """Return how many values the first readable one of k messages says that it has; 0: none is readable."""
        return cls.value_counts.start

    @classmethod
    def value_names(cls, count: int) -> list[str]:
        """Names of the values of one message."""
        return list("xyz") if cls.stamped else [f"value {k + 1}" for k in range(count)]

    @classmethod
    def decode(cls, buffer: Bytes, offset: Int, length: Int, count: int) -> Decoded:
        """Read messages, each at ``offset`` (k,) and of ``length`` (k,) within the buffer; a number of values in each.

        One with another number of values is malformed.
        """
        k = len(offset)
        decoded = Decoded(
            np.zeros(k, dtype=np.uint8),
            np.zeros(k, dtype=np.int64),
            np.zeros((k, count)),
        )
        cls.decode_into(read_only(buffer), offset, length, *decoded)
        return decoded

    @classmethod
    def parse(cls, data: bytes, count: int) -> tuple[int, tuple[float, ...]]:
        """Return stamp, ns, and values (count,), rad/s, of one message.

        The stamp is 0 for messages without one. Raise `MessageError` for a malformed one.
        """
        (code,), (stamp,), (values,) = cls.decode(*as_batch(data), count)
        if code != GOOD:
            raise MessageError(cls.explain(int(code), data, count))
        return int(stamp), tuple(values.tolist())

    @classmethod
    def patch(cls, data: bytes, values: Sequence[float]) -> bytes:
        """Return a message with as many other values, rad/s, and the rest unchanged.

        Raise `MessageError` for a malformed message.
        """
        at = cls.place(as_batch(data)[0], 0, len(data), len(values))
        if at < 0:
            raise MessageError(cls.explain(-at, data, len(values)))
        packed = struct.pack(f"{byte_order(data)}{len(values)}d", *values)
        return b"".join((data[:at], packed, data[at + len(packed) :]))

    # Settings
    # -----------------------------------------------------------------------------------------------------

    names: tuple[str, ...]  #: what each topic brings, as an operator sees it
    units: tuple[str, ...] = ()
    """Names of the three-axis units that the channels belong to; empty: which of them
    share one is not known."""
    timeout: float  #: time after which a topic is silent, s
    max_lag = math.inf  #: how far the stamps of a topic may stay behind the others, s
    delays: tuple[
        float, ...
    ] = ()  #: by how much the stamps of each unit are late, as set, s
    mounts: Sequence[Array] = ()  #: mount rotation (3, 3) of each unit

    def __init__(self, config: Config) -> None:
        self.config = config
        self.topics = config.topics  #: the input topics

    @property
    def alignment(self) -> tuple[int, int, int, tuple[float, ...]]:
        """How the messages of the topics are aligned: units, largest skew ns, timeout ns, delays s."""
        imus = self.config.imus
        return (
            len(self.topics),
            round(imus.max_skew * 1e9),
            round(self.config.unit_timeout * 1e9),
            imus.delays,
        )

    def check_channels(self, n: int) -> None:
        """Raise ConfigError if the units do not have n channels."""
        if self.units and n != 3 * len(self.units):
            raise ConfigError(
                f"geometry has {n} channels, expected 3 per topic: {3 * len(self.units)}"
                f" for {len(self.units)} imus.topics"
            )

    @abstractmethod
    def brought(self, topic: int, n: int, m: int) -> Brought:
        """Return which of n gyros and m accelerometers a topic brings."""

    def chip_of(self, channel: int) -> int:
        """Return a number that is the same for channels that surely share a chip."""
        return channel // 3 if self.units else channel


class UnitSource(Source):
    """One topic per three-axis unit, with messages aligned by stamps (settings ``imus``)."""

    stamped = True
    topic_counts, value_counts = range(2, MAX_UNITS + 1), range(3, 4)

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        imus = config.imus
        count = len(config.topics)
        self.names = self.units = config.imu_names
        self.timeout = config.unit_timeout
        self.max_lag = imus.max_skew
        self.delays = imus.delays or (0.0,) * count
        along_body = tuple(np.eye(3).ravel()) * count
        self.mounts = list(np.reshape(imus.mounts or along_body, (-1, 3, 3)))

    def brought(self, topic: int, n: int, m: int) -> Brought:
        """Return the channels of the unit."""
        own = slice(3 * topic, 3 * topic + 3)
        return Brought(own, own if m else slice(0, 0))


class ArraySource(Source):
    """One topic: messages of all gyros, stamped when they arrive; settings ``channels``.

    A second topic may bring the accelerometers.
    """

    stamped = False
    topic_counts, value_counts = range(1, 2), range(MIN_CHANNELS, MAX_CHANNELS + 1)

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        self.names = config.topics
        self.timeout = config.stale_timeout

    def brought(self, topic: int, n: int, m: int) -> Brought:
        """Return all gyros, or of the second topic all accelerometers."""
        gyros, accelerometers = (n, 0) if topic == 0 else (0, m)
        return Brought(slice(0, gyros), slice(0, accelerometers))


# sensor_msgs/Imu
# ------------------------------------------------------------------------------------------------------


NO_RATE = FIRST_OWN  #: an Imu that measures no angular rate, by its covariance


@compiled
def _imu_place(data: Bytes, offset: int, length: int, count: int) -> int:
    return place_after_header(data, offset, length, IMU_BEFORE_RATE, IMU_DOUBLES)


@compiled
def _imu_read(data: Bytes, offset: int, length: int, rate: Array) -> int:
    """Read the rate of an Imu into rate (3,). Return its stamp, ns, or a negative error code."""
    at = _imu_place(data, offset, length, 3)
    if at >= 0:
        first = np.int64(read_bits(data, at + 24, 8, data[offset + 1] == 1))
        # REP-145: -1 in the covariance means that the rate is not measured.
        if first.view(np.float64) == -1.0:
            return -NO_RATE
    return read_rate(data, offset, length, IMU_BEFORE_RATE, IMU_DOUBLES, rate)


@compiled
def _imu_read_force(data: Bytes, offset: int, length: int, force: Array) -> None:
    """Read the specific force of an Imu, whose rate was read, into force (3,)."""
    at = _imu_place(data, offset, length, 3)
    read_force(data, at, data[offset + 1] == 1, force)


@compiled
def _imu_decode_into(
    data: Bytes, offset: Int, length: Int, code: Bytes, stamp: Int, values: Array
) -> None:
    for k in range(len(offset)):
        measured = _imu_read(data, offset[k], length[k], values[k])
        if measured < 0:
            code[k] = -measured
        else:
            stamp[k] = measured
            if values.shape[1] == 6:
                _imu_read_force(data, offset[k], length[k], values[k, 3:])


@compiled
def _imu_receive(
    aligner: NDArray[Any], live: NDArray[Any], inlet: int, data: Bytes, stamp: int
) -> int:
    if not 0 <= inlet < aligner[0].n:
        return 0
    measured = _imu_read(data, 0, len(data), aligner[0].rate)
    if measured >= 0:
        _imu_read_force(data, 0, len(data), aligner[0].felt)
    return receive_stamped(live[0], aligner[0], inlet, measured, stamp)


class ImuSource(UnitSource):
    """Angular velocity and linear acceleration of sensor_msgs/Imu messages, one topic per unit.

    Reading three values gives the rate, reading six also the specific force.
    """

    type = "sensor_msgs/msg/Imu"
    called = "an Imu"
    place = staticmethod(_imu_place)
    decode_into = staticmethod(_imu_decode_into)
    receive = staticmethod(_imu_receive)

    @classmethod
    def explain(cls, code: int, data: bytes, count: int) -> str:
        """Return one line on the error of a message."""
        if code == NO_RATE:
            return "angular_velocity_covariance[0] is -1: this Imu measures no angular rate (REP-145)"
        return super().explain(code, data, count)

    @classmethod
    def patch(cls, data: bytes, values: Sequence[float]) -> bytes:
        """Return a message with another rate, and with six values also another specific force."""
        patched = super().patch(data, values[:3])
        if len(values) == 6:
            begin = cls.place(as_batch(data)[0], 0, len(data), 3)
            at = begin + 8 * IMU_BEFORE_FORCE
            force = struct.pack(f"{byte_order(data)}3d", *values[3:])
            patched = patched[:at] + force + patched[at + len(force) :]
        return patched


# std_msgs/Float64MultiArray
# -------------------------------------------------------------------------------------------


#: a product of damaged dimensions ends here, before it overflows
_MANY = 1 << 31
MAX_DIMENSIONS = 16  # an array whose layout has more dimensions is no message of ours
_DIMENSIONS, _CUT_ARRAY, _WRONG_COUNT, _CUT_VALUES, _GAPS = range(
    FIRST_OWN, FIRST_OWN + 5
)


@compiled
def _count_at(data: Bytes, offset: int, length: int) -> int:
    """Return the index of the number of values of an array, or a negative error code."""
    if not is_cdr(data, offset, length):
        return -NO_CDR
    little = data[offset + 1] == 1
    at = ENCAPSULATION + 4
    if at > length:
        return -_CUT_ARRAY
    dimensions = read_bits(data, offset + ENCAPSULATION, 4, little)
    if dimensions > MAX_DIMENSIONS:
        return -_DIMENSIONS
    span, values = 0, 1  # stride of the first dimension, product of all sizes
    for k in range(dimensions):
        if at + 4 > length:
            return -_CUT_ARRAY
        # Label, aligned to 4, then size and stride.
        at += 4 + (read_bits(data, offset + at, 4, little) + 3) // 4 * 4
        if at + 8 > length:
            return -_CUT_ARRAY
        # Many publishers leave sizes or strides at 0.
        values = min(values * read_bits(data, offset + at, 4, little), _MANY)
        if k == 0:
            span = read_bits(data, offset + at + 4, 4, little)
        at += 8
    if 0 < values < span:
        return -_GAPS
    # The offset of the data, then the number of values.
    at += 4
    return offset + at if at + 4 <= length else -_CUT_ARRAY


@compiled
def _array_place(data: Bytes, offset: int, length: int, count: int) -> int:
    at = _count_at(data, offset, length)
    if at < 0:
        return at
    little = data[offset + 1] == 1
    before = read_bits(data, at - 4, 4, little)  # values that are padding
    if read_bits(data, at, 4, little) != before + count:
        return -_WRONG_COUNT
    # The values are aligned even if the array is empty.
    start = ENCAPSULATION + (at + 4 - offset - ENCAPSULATION + 7) // 8 * 8
    if start + 8 * (before + count) > length:
        return -_CUT_VALUES
    return offset + start + 8 * before


@compiled
def _array_read(
    data: Bytes, offset: int, length: int, count: int, values: Array
) -> int:
    at = _array_place(data, offset, length, count)
    if at < 0:
        return -at
    read_doubles(data, at, count, data[offset + 1] == 1, values)
    return GOOD


@compiled
def _array_decode_into(
    data: Bytes, offset: Int, length: Int, code: Bytes, stamp: Int, values: Array
) -> None:
    for k in range(len(offset)):
        code[k] = _array_read(data, offset[k], length[k], values.shape[1], values[k])


@compiled
def _array_receive(
    aligner: NDArray[Any], live: NDArray[Any], inlet: int, data: Bytes, stamp: int
) -> int:
    monitor = live[0]
    if not 0 <= inlet < aligner[0].n:
        return 0
    if inlet == 1:
        count = monitor.accelerometers
        return receive_force(
            monitor, _array_read(data, 0, len(data), count, monitor.force)
        )
    return receive_arrived(
        monitor,
        _array_read(data, 0, len(data), monitor.channels, monitor.sample.z),
        stamp,
    )


class ChannelsSource(ArraySource):
    """The values of std_msgs/Float64MultiArray messages.

    The layout may have any dimensions and a ``data_offset``; strides that leave gaps
    between values are refused.
    """

    type = "std_msgs/msg/Float64MultiArray"
    called = "an array"
    place = staticmethod(_array_place)
    decode_into = staticmethod(_array_decode_into)
    receive = staticmethod(_array_receive)

    @classmethod
    def explain(cls, code: int, data: bytes, count: int) -> str:
        """Explain in one line what is wrong with a message in which count values were expected."""
        size = len(data)
        order = byte_order(data)
        if code < FIRST_OWN:
            return super().explain(code, data, count)
        if code == _DIMENSIONS:
            (dimensions,) = struct.unpack_from(f"{order}I", data, ENCAPSULATION)
            return (
                f"array has {dimensions} dimensions, expected at most {MAX_DIMENSIONS}"
            )
        if code == _GAPS:
            return (
                "the strides of the array leave gaps between its values, expected none"
            )
        if code == _CUT_ARRAY:
            return f"{size} bytes are too few for the array they announce"
        if code == _WRONG_COUNT:
            return (
                f"array has {cls.announced(*as_batch(data))} values, expected {count}"
            )
        return f"{size} bytes are too few for {count} values ({'little' if order == '<' else 'big'} endian)"

    @classmethod
    def announced(cls, buffer: Bytes, offset: Int, length: Int) -> int:
        """Return how many values the first readable one of k messages says that it has; 0: none is readable."""
        data = read_only(buffer)
        for start, size in zip(offset.tolist(), length.tolist(), strict=True):
            at = _count_at(data, start, size)
            if at >= 0:
                order = "<" if data[start + 1] else ">"
                padding, count = struct.unpack_from(
                    f"{order}II", data[at - 4 : at + 4].tobytes()
                )
                return max(0, int(count) - int(padding))
        return 0


SOURCES: dict[str, type[Source]] = {
    name: globals()[row.source] for name, row in INPUTS.items()
}
"""By the value of the parameter ``input``."""


def source_of(config: Config) -> Source:
    """Return the source of a configuration."""
    return SOURCES[config.input](config)


def input_of(kind: type[Source]) -> str:
    """Return the value of the parameter ``input`` for a kind."""
    return next(name for name, one in SOURCES.items() if one is kind)


def source_of_type(message_type: str) -> type[Source] | None:
    """Return the kind of input of a message type, or None if it contains no gyros."""
    return next((kind for kind in SOURCES.values() if kind.type == message_type), None)
