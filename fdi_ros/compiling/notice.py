# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What is seen of compiling, which takes half a minute to two: a notice, the share done, a clock that leaves it out.

While it lasts, garbage is collected less often.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

from numba.core import event

from fdi_ros.compiling.compiled import missing
from fdi_ros.errors import FdiError

LOG = logging.getLogger("fdi_ros")
_PASS = "numba:run_pass"  # every compilation, and nothing that is only loaded, goes through the passes of the compiler
_WHOLE = "numba:compile"  # one function, with all that it calls
WORDS = "compiling what every sample passes through, once: half a minute to two (fdi compile does it beforehand)"
YOUNG_OBJECTS = 7000
"""The compiler makes millions of objects that last: looking for garbage among them ten times as often as this, which is
Python's default, is a seventh of its time. More seldom still costs memory and saves nothing."""
LOG_PERIOD = 10.0  # how often it is logged, s


class _Watch(event.Listener):  # type: ignore[misc,unused-ignore]
    """Knows when the compiler runs, in this process."""

    def __init__(self) -> None:
        self.depth = 0
        self.seconds = 0.0
        self.begun = 0.0
        self.collected = (
            gc.get_threshold()
        )  # when garbage is collected while nothing is compiled
        self.hooks: list[
            Callable[[bool], None]
        ] = []  # called when the compiler begins, and when it has ended

    def on_start(self, event: Any) -> None:
        self.depth += 1
        if self.depth == 1:
            self.begun = time.perf_counter()
            # Before the hooks: where one of them refuses, `on_end` is called, too.
            young, *older = self.collected = gc.get_threshold()
            gc.set_threshold(max(young, YOUNG_OBJECTS) if young else 0, *older)
            for hook in tuple(self.hooks):
                hook(True)

    def on_end(self, event: Any) -> None:
        self.depth -= 1
        if self.depth == 0:
            self.seconds += time.perf_counter() - self.begun
            gc.set_threshold(*self.collected)
            for hook in tuple(self.hooks):
                hook(False)

    @contextlib.contextmanager
    def calling(self, hook: Callable[[bool], None]) -> Iterator[None]:
        """Call a hook, too, for what is compiled within."""
        self.hooks.append(hook)
        try:
            yield
        finally:
            self.hooks.remove(hook)


_watch = _Watch()
for _kind in (_PASS, _WHOLE):
    event.register(_kind, _watch)


def is_compiling() -> bool:
    """Return whether this process compiles now."""
    return _watch.depth > 0


def compiling_seconds() -> float:
    """Return for how long this process has compiled so far, s."""
    return _watch.seconds + (
        time.perf_counter() - _watch.begun if is_compiling() else 0.0
    )


def clock() -> float:
    """Return a time that passes as `time.perf_counter` does, but stands still while anything is compiled, s."""
    return time.perf_counter() - compiling_seconds()


@contextlib.contextmanager
def share_logged() -> Iterator[None]:
    """Log that what is missing is compiled within, here or in other processes, and now and then how far it is."""
    LOG.warning(WORDS)
    begun, over = time.monotonic(), threading.Event()

    def tick() -> None:
        most = before = missing()
        while not over.wait(LOG_PERIOD):
            left = missing()
            # What is to be compiled may become more on the way.
            most = max(most, left)
            if most and (left != before or is_compiling()):
                share, spent = 1 - left / most, time.monotonic() - begun
                LOG.warning(
                    "compiling %3.0f %% |%-20s| %.0f s",
                    100 * share,
                    "#" * round(20 * share),
                    spent,
                )
            before = left

    thread = threading.Thread(target=tick, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


@contextlib.contextmanager
def announced() -> Iterator[None]:
    """Log, before anything is compiled within, that it is, and now and then how far it is."""
    with contextlib.ExitStack() as stack:
        begun = False

        def hook(begins: bool) -> None:
            nonlocal begun
            if not begun:
                begun = True
                stack.enter_context(share_logged())

        stack.enter_context(_watch.calling(hook))
        yield


@contextlib.contextmanager
def refused(words: str) -> Iterator[None]:
    """Compile nothing within: `FdiError` with these words when something is to be compiled."""

    def hook(begins: bool) -> None:
        if begins:
            raise FdiError(words)

    with _watch.calling(hook):
        yield
