"""Progress bar: on a terminal, and nowhere else."""

from __future__ import annotations

import time
from types import TracebackType
from typing import TextIO

_WIDTH = 40
_EVERY = 0.1
"""Drawn anew at most this often, s."""


class Progress:
    """A bar on the last line of a terminal, wiped at the end.

    Parameters
    ----------
    stream
        Where to draw; nothing is drawn if it is no terminal.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._drawn = -_EVERY
        self._live = stream.isatty()

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live:
            self._stream.write("\r\x1b[K")
            self._stream.flush()

    def show(self, share: float) -> None:
        """Draw the share done, 0 to 1."""
        now = time.monotonic()
        if self._live and now - self._drawn >= _EVERY:
            self._drawn = now
            done = round(_WIDTH * share)
            self._stream.write(f"\r[{'#' * done}{' ' * (_WIDTH - done)}] {100 * share:3.0f} %")
            self._stream.flush()
