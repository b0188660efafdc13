# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Reports of compiling: a notice with the share done and the time left, and a clock without the time of compiling.

While the compiler runs, garbage is collected less often.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from numba.core import event

from fdi_ros.compiling.compiled import missing, name_of
from fdi_ros.errors import FdiError

LOG = logging.getLogger("fdi_ros")
COMPILING = "compiling for the first use; later runs find the result"
YOUNG_OBJECTS = 7000
"""Young objects that start a garbage collection while the compiler runs. Python's default is a tenth of this. The
compiler makes millions of objects that last, and the default costs a seventh of its time."""


class _ProgressReports(NamedTuple):
    """When progress of the compilation is reported."""

    #: time from the notice to the first report, s: by then some twenty functions
    #: are compiled
    first: float = 2.0
    #: time between two reports, s
    period: float = 5.0
    #: share of the functions from which on the time left is reported. The first
    #: ones are small and say little
    share: float = 0.2


_REPORTS = _ProgressReports()

_PASS = "numba:run_pass"
"""Event of Numba: a compiler pass.

Every compilation has passes, a result loaded from disk has none.
"""
_FUNCTION = "numba:compile"  # event of Numba: the compilation of one function with all functions that it calls


class _Watch(event.Listener):  # type: ignore[misc,unused-ignore]
    """Knows when the compiler runs in this process, and which functions it has compiled."""

    def __init__(self) -> None:
        self.depth = 0  # of nested compilations
        self.seconds = 0.0  # spent compiling before the current compilation
        self.begun = 0.0  # time at which the current compilation began, s
        self.thresholds = gc.get_threshold()  # outside the compiler
        self.hooks: list[Callable[[bool], None]] = []
        """Called with True when the compiler begins, with False when it has ended."""
        self.counters: list[Callable[[str], None]] = []
        """Called with the name of each function that was compiled."""

    def on_start(self, event: Any) -> None:
        self.depth += 1
        if self.depth == 1:
            self.begun = time.perf_counter()
            # Before the hooks: if one raises, `on_end` is called, too.
            young, *older = self.thresholds = gc.get_threshold()
            gc.set_threshold(max(young, YOUNG_OBJECTS) if young else 0, *older)
            for hook in tuple(self.hooks):
                hook(True)

    def on_end(self, event: Any) -> None:
        self.depth -= 1
        if event.kind == _FUNCTION:
            name = name_of(event.data["dispatcher"].py_func)
            for count in tuple(self.counters):
                count(name)
        if self.depth == 0:
            self.seconds += time.perf_counter() - self.begun
            gc.set_threshold(*self.thresholds)
            for hook in tuple(self.hooks):
                hook(False)

    @contextlib.contextmanager
    def calling(self, hook: Callable[[bool], None]) -> Iterator[None]:
        """Call another hook for compilations within the context."""
        self.hooks.append(hook)
        try:
            yield
        finally:
            self.hooks.remove(hook)


_watch = _Watch()
for _kind in (_PASS, _FUNCTION):
    event.register(_kind, _watch)


def is_compiling() -> bool:
    """Return whether this process compiles now."""
    return _watch.depth > 0


def compiling_seconds() -> float:
    """Return for how long this process has compiled so far, s."""
    current = time.perf_counter() - _watch.begun if is_compiling() else 0.0
    return _watch.seconds + current


def clock() -> float:
    """Return a time in s that passes as `time.perf_counter` does, but stands still while the compiler runs."""
    return time.perf_counter() - compiling_seconds()


def call_for_each(counter: Callable[[str], None]) -> None:
    """Call a counter with the name of each function that this process compiles from now on."""
    _watch.counters.append(counter)


@contextlib.contextmanager
def progress_logged(
    functions: set[str], done: Callable[[], set[str]], needs_all: bool = True
) -> Iterator[None]:
    """Log that functions are compiled within the context, and how many are done, where the number grew.

    Parameters
    ----------
    functions
        Names of the functions without a result.
    done
        Returns the names of the functions that were compiled so far.
    needs_all
        Whether all will be compiled. Otherwise neither share nor time left are known.

    The time left, reported once a fifth of the functions is done, assumes that the rest takes as
    long for each function.
    """
    LOG.warning(COMPILING)
    begun = time.monotonic()
    over = threading.Event()

    def report() -> None:
        wait = _REPORTS.first
        last = 0
        while not over.wait(wait):
            wait = _REPORTS.period
            left = (functions - done()) & missing()
            count = len(functions) - len(left)
            if count == last:
                continue
            last = count
            if not needs_all:
                LOG.warning("compiling: functions done: %d", count)
                continue
            share = count / len(functions)
            spent = time.monotonic() - begun
            LOG.warning(
                "compiling |%-20s| %d of %d functions%s",
                "#" * round(20 * share),
                count,
                len(functions),
                f", about {spent / share - spent:.0f} s left"
                if share >= _REPORTS.share
                else "",
            )

    thread = threading.Thread(target=report, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


@contextlib.contextmanager
def announced() -> Iterator[None]:
    """Log compilations within the context, before they begin, with their progress. Log nothing if all results exist."""
    done: set[str] = set()
    with contextlib.ExitStack() as stack:
        begun = False

        def hook(begins: bool) -> None:
            nonlocal begun
            if not begun:
                begun = True
                _watch.counters.append(done.add)
                stack.callback(_watch.counters.remove, done.add)
                stack.enter_context(
                    progress_logged(missing(), lambda: done, needs_all=False)
                )

        stack.enter_context(_watch.calling(hook))
        yield


@contextlib.contextmanager
def refused(words: str) -> Iterator[None]:
    """Compile nothing within the context: raise `FdiError` with these words instead."""

    def hook(begins: bool) -> None:
        if begins:
            raise FdiError(words)

    with _watch.calling(hook):
        yield
