# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The interface of an input kind, and the two arrangements of topics that there are.

A kind is a class derived from `UnitSource` or `ArraySource`, with its message type and three compiled functions, which
are listed in `Source`. They are functions of the kind's own module, and not arguments of a common one: so Numba
compiles each once and keeps the result, and no call is added to the way of a sample.
"""

from __future__ import annotations

import math
import struct
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import MAX_CHANNELS, MAX_UNITS
from fdi_ros.config.config import Config
from fdi_ros.core.messages import GOOD, Decoded, MessageError, as_batch, byte_order, explain, read_only
from fdi_ros.errors import ConfigError
from fdi_ros.model.geometry import MIN_CHANNELS
from fdi_ros.model.samples import Array, Bytes, Int

Alignment = tuple[int, int, int, tuple[float, ...]]
"""Units, largest skew ns, timeout ns, delays s: what `fdi_ros.core.alignment` takes."""


class Source(ABC):
    """One kind of input, with the settings of one monitor.

    What needs no settings is on the class: the messages of a recording are read before there are any.
    """

    type: ClassVar[str]
    """Of its messages: ``sensor_msgs/msg/Imu``."""
    stamped: ClassVar[bool]
    """Whether messages carry the stamp of their measurement, and those of several units are aligned by it; else they
    are stamped when they arrive, and each is a sample of all channels."""
    topic_counts: ClassVar[range]
    """Numbers of topics that a monitor takes."""
    value_counts: ClassVar[range]
    """Numbers of values that a message may have to be the gyros of a monitor."""
    called: ClassVar[str]
    """A message in words: ``an Imu``."""

    # Compiled, per kind -------------------------------------------------------------------------------------------

    @staticmethod
    @abstractmethod
    def place(data: Bytes, offset: int, length: int, count: int) -> int:
        """Return where count values begin in a message; what is wrong, negative, if they cannot be there."""

    @staticmethod
    @abstractmethod
    def decode_into(data: Bytes, offset: Int, length: Int, code: Bytes, stamp: Int, values: Array) -> None:
        """Read k messages; code (k,), stamp (k,) and values (k, c), zeros before, take what each holds."""

    @staticmethod
    @abstractmethod
    def receive(aligner: NDArray[Any], live: NDArray[Any], inlet: int, data: Bytes, stamp: int) -> int:
        """Take in one live message, its bytes, of the input topic ``inlet``, which arrived at ``stamp``, ns.

        ``aligner``, ``live``: as for `fdi_ros.core.path.process`. Returned is `fdi_ros.core.path.MORE` if a sample is
        ready to be worked, `MALFORMED` if the message was refused, else 0.
        """

    # Messages -----------------------------------------------------------------------------------------------------

    @classmethod
    def explain(cls, code: int, data: bytes, count: int) -> str:
        """Explain in one line what is wrong with a message in which count values were expected."""
        return explain(code, data, cls.called)

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
        decoded = Decoded.nothing(len(offset), count)
        cls.decode_into(read_only(buffer), offset, length, *decoded)
        return decoded

    @classmethod
    def parse(cls, data: bytes, count: int) -> tuple[int, tuple[float, ...]]:
        """Read stamp (ns; 0: it carries none) and values (count,) rad/s of one message, or raise `MessageError`."""
        (code,), (stamp,), (values,) = cls.decode(*as_batch(data), count)
        if code != GOOD:
            raise MessageError(cls.explain(int(code), data, count))
        return int(stamp), tuple(values.tolist())

    @classmethod
    def patch(cls, data: bytes, values: Sequence[float]) -> bytes:
        """Return a message with other values, as many, rad/s, and all else as it was, or raise `MessageError`."""
        at = cls.place(as_batch(data)[0], 0, len(data), len(values))
        if at < 0:
            raise MessageError(cls.explain(-at, data, len(values)))
        packed = struct.pack(f"{byte_order(data)}{len(values)}d", *values)
        return b"".join((data[:at], packed, data[at + len(packed) :]))

    # Settings -----------------------------------------------------------------------------------------------------

    names: tuple[str, ...]
    """What each topic brings, as an operator sees it."""
    units: tuple[str, ...] = ()
    """Names of the three-axis units that the channels belong to; empty: which of them share one is not known."""
    timeout: float
    """Time after which a topic is silent, s."""
    max_lag = math.inf
    """How far the stamps of a topic may stay behind the others, s."""
    delays: tuple[float, ...] = ()
    """By how much the stamps of each unit are late, as set, s."""
    mounts: Sequence[Array] = ()
    """Mount rotation (3, 3) of each unit."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.topics = config.topics
        """The input topics."""

    @property
    def alignment(self) -> Alignment:
        """How the messages of the topics are aligned."""
        imus = self.config.imus
        return len(self.topics), round(imus.max_skew * 1e9), round(imus.timeout * 1e9), imus.delays

    def check_channels(self, n: int) -> None:
        """Raise ConfigError if the units do not have n channels."""
        if self.units and n != 3 * len(self.units):
            raise ConfigError(
                f"geometry has {n} channels, expected 3 per topic: {3 * len(self.units)}"
                f" for {len(self.units)} imus.topics"
            )

    def channels_of(self, topic: int, n: int) -> slice:
        """Return which of the n channels a topic brings."""
        return slice(3 * topic, 3 * topic + 3) if self.units else slice(0, n)

    def chip_of(self, channel: int) -> int:
        """Return a number that is the same for channels that surely share a chip."""
        return channel // 3 if self.units else channel


class UnitSource(Source):
    """One topic per three-axis unit: messages with a std_msgs/Header, aligned by their stamps; settings ``imus``."""

    stamped = True
    topic_counts, value_counts = range(2, MAX_UNITS + 1), range(3, 4)

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        imus, count = config.imus, len(config.topics)
        self.names = self.units = config.imu_names
        self.timeout, self.max_lag = imus.timeout, imus.max_skew
        self.delays = imus.delays or (0.0,) * count
        self.mounts = list(np.reshape(imus.mounts or tuple(np.eye(3).ravel()) * count, (-1, 3, 3)))


class ArraySource(Source):
    """One topic: messages of all channels, stamped when they arrive; settings ``channels``."""

    stamped = False
    topic_counts, value_counts = range(1, 2), range(MIN_CHANNELS, MAX_CHANNELS + 1)

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        self.names, self.timeout = config.topics, config.health.stale_timeout
