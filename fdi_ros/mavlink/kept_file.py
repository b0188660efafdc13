# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A file of the node of a link that outlives its restarts.

A thread writes, because a card may hold fsync for seconds, or for ever, while the link must
go on. One write is under way at most. A file that cannot be read or written ends nothing:
the vehicle may be in flight.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from pathlib import Path
from threading import Thread
from typing import Any, Generic, TypeVar

from fdi_ros.errors import ConfigError
from fdi_ros.mavlink.protocol import NS
from fdi_ros.system.files import read_trusted, replacing

LARGEST_FILE = 4096  #: Largest file that is read, bytes.
RETRY = NS  #: Time between two attempts to write, ns.
HANGING = 2 * NS  #: A write that takes longer is announced, ns.
LONGEST_END = 5.0  #: Longest wait for a write at the end, s.
UNANSWERED = "is not saved: the disk does not answer"

Content = TypeVar("Content")


class KeptFile(ABC, Generic[Content]):
    """Reads and writes a file, as JSON.

    A file that cannot be read counts as one without content, and is written anew.
    """

    name: str  #: The file, in messages.
    unfit: str  #: What is wrong with a file that holds something else, in messages.
    pause = 0  #: Least time between two writes, ns.

    def __init__(self, path: Path, nothing: Content) -> None:
        self._path = path
        self.written = nothing  #: Content on the disk, as far as known.
        #: Why the file is not read or not written. Empty: it is.
        self.trouble = ""
        self._error = ""  # of the last write
        self._writer: Thread | None = None
        self._begun = 0  # when the last write began, ns. 0: in the constructor
        try:
            self.written = self._read()
            # That it can be written shows before the flight.
            self._begin(self.written)
        except ConfigError as error:
            self.trouble = self._error = str(error)
        self._wanted = self.written

    @abstractmethod
    def decode(self, found: Any) -> Content:
        """Return the content of parsed JSON. Raise what a wrong type or value raises if it is none."""

    @abstractmethod
    def encode(self, content: Content) -> dict[str, Any]:
        """Return content as JSON is made of it."""

    def is_same(self, one: Content, other: Content) -> bool:
        """Return whether two contents differ in nothing that has to be written."""
        return one == other

    def keep(self, content: Content, now: int) -> str:
        """Write new content in another thread. Return an error that is new, or an empty text."""
        before = self.trouble
        self._wanted = content
        self._begun = self._begun or now
        if not self._is_writing:
            self.trouble = self._error
            pause = RETRY if self.trouble else self.pause
            if (self.trouble or self._is_behind) and now - self._begun >= pause:
                self._begun = now
                self._begin(content)
        elif now - self._begun >= HANGING:
            self.trouble = f"{self.name} {self._path} {UNANSWERED}"
        return self.trouble if self.trouble != before else ""

    def close(self) -> None:
        """Write the last content, if that has not been done. Raise `ConfigError` if it fails."""
        self._wait()
        if self._is_behind and not self._is_writing:
            self._begin(self._wanted)
            self._wait()
        if self._is_behind:
            hangs = f"{self.name} {self._path} {UNANSWERED}"
            raise ConfigError(hangs if self._is_writing else self._error)

    @property
    def _is_writing(self) -> bool:
        return self._writer is not None and self._writer.is_alive()

    @property
    def _is_behind(self) -> bool:
        return not self.is_same(self._wanted, self.written)

    def _begin(self, content: Content) -> None:
        """Begin to write in a thread that does not hold up the end of the process."""
        self._writer = Thread(target=self._write, args=(content,), daemon=True)
        self._writer.start()

    def _wait(self) -> None:
        if self._writer is not None:
            self._writer.join(LONGEST_END)

    def _read(self) -> Content:
        try:
            return self.decode(json.loads(read_trusted(self._path, LARGEST_FILE)))
        except FileNotFoundError:
            return self.written
        except (
            ValueError,
            KeyError,
            TypeError,
            AttributeError,
            OverflowError,
            RecursionError,
        ) as error:
            raise ConfigError(f"{self.name} {self._path} {self.unfit}") from error
        except OSError as error:
            raise ConfigError(f"{self.name} {self._path}: {error.strerror}") from error

    def _write(self, content: Content) -> None:
        try:
            with replacing(self._path) as file:
                file.write(json.dumps(self.encode(content)).encode())
        except OSError as error:
            self._error = (
                f"{self.name} {self._path} cannot be written: {error.strerror}"
            )
        else:
            self._error = ""
            self.written = content
