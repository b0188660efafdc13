# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Progress on a terminal."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Any, TextIO

from fdi_ros.compiling.notice import WORDS, compiling_seconds, is_compiling

_FORMAT = "{percentage:3.0f} %|{bar:40}| {elapsed}, {remaining} left"
_COMPILE_FORMAT = "{desc}: {percentage:3.0f} %|{bar:30}| {elapsed}"
_TICK = 1.0
"""How often the time of work with no known share done is drawn anew, s."""


class Progress:
    """A bar on the last line of a terminal, wiped at the end.

    Parameters
    ----------
    stream
        Where to draw; nothing is drawn if it is no terminal.
    quiet
        Draw nothing there either.
    """

    def __init__(self, stream: TextIO, quiet: bool = False) -> None:
        from tqdm import tqdm

        self._stream = stream
        # None: tqdm asks the stream whether it is a terminal.
        self._disable = True if quiet else None
        self._bar = tqdm(total=1.0, file=stream, disable=self._disable, bar_format=_FORMAT, leave=False)
        self._compiled = compiling_seconds()

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.close()

    def show(self, share: float) -> None:
        """Draw the share done, 0 to 1; time spent compiling is none of the work."""
        before, self._compiled = self._compiled, compiling_seconds()
        if not self._bar.disable:
            self._bar.start_t += self._compiled - before
        self._bar.update(share - self._bar.n)

    @contextmanager
    def during(self, words: str) -> Iterator[None]:
        """Say what goes on, and for how long already, where no share done is known."""
        from tqdm import tqdm

        self._bar.clear()
        bar = tqdm(
            desc=words,
            file=self._stream,
            disable=self._disable,
            position=0,  # on the same line as the bar
            leave=False,
            bar_format="{desc}, {elapsed}",
        )
        ended = threading.Event()

        def tick() -> None:
            while not ended.wait(_TICK):
                # Compiling has a bar of its own on this line.
                if not is_compiling():
                    bar.refresh()

        thread = threading.Thread(target=tick, daemon=True)
        if not bar.disable:
            thread.start()
        try:
            yield
        finally:
            ended.set()
            if thread.is_alive():
                thread.join()
            bar.close()


class CompileBar:
    """The share compiled, on the last line of a terminal while anything is compiled: a `View` of `announced`.

    Parameters
    ----------
    stream
        A terminal.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._bar: Any = None

    def begin(self) -> None:
        """Say that it begins."""
        from tqdm import tqdm

        self._stream.write(f"{WORDS}\n")
        self._bar = tqdm(total=1.0, desc="compiling", file=self._stream, bar_format=_COMPILE_FORMAT, leave=False)

    def draw(self, share: float) -> None:
        """Draw the share done."""
        if self._bar is not None:
            self._bar.n = share
            self._bar.refresh()

    def wipe(self) -> None:
        """Leave the line to others."""
        if self._bar is not None:
            self._bar.clear()
