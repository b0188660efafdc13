# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Logs that a library reads whole, with samples handed on in portions."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

from numpy.typing import NDArray

from fdi_ros.bag.flight_log import (
    FlightLog,
    ImuSamples,
    Portion,
    Source,
)
from fdi_ros.errors import BagError

Columns = Mapping[str, NDArray[Any]]
"""(k,) values of each field of k messages. Elements of an array are fields ``name[0]``."""


class LibraryLog(FlightLog):
    """An open log, read whole."""

    #: largest size, bytes
    most: ClassVar[int]
    #: messages of a source handed on at once, about
    together: ClassVar[int]

    def begin(self) -> None:
        """Begin a walk, and read the log up to `end`."""
        super().begin()
        if self.size > self.most:
            sizes = f"{self.size >> 20} MB, expected at most {self.most >> 20}"
            raise BagError(f"{self.path} has {sizes}: such a log is read whole")
        self.file.seek(0)
        self._columns = self.load(self.file.read(self.end))

    @abstractmethod
    def load(self, data: bytes) -> dict[Source, Columns]:
        """Return the messages of IMUs, and take texts and counts."""

    @abstractmethod
    def samples(self, kind: str, columns: Columns) -> ImuSamples | None:
        """Return the samples in messages of a kind, None if a field is missing or malformed."""

    def portions(self) -> Iterator[Portion]:
        """Return the samples, some of each source together."""
        portions = (
            max(map(message_count, self._columns.values()), default=0) // self.together
            + 1
        )
        for k in range(portions):
            found = []
            for source, columns in self._columns.items():
                rows = slice(
                    message_count(columns) * k // portions,
                    message_count(columns) * (k + 1) // portions,
                )
                samples = self.samples(
                    source.kind,
                    {name: column[rows] for name, column in columns.items()},
                )
                if samples is not None:
                    found.append((source, samples))
            yield found, (k + 1) / portions


def message_count(columns: Columns) -> int:
    """Return the number of messages."""
    return len(next(iter(columns.values())))
