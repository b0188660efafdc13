# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A notice before anything is compiled, which takes a minute: to log it, or to refuse it."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterator
from typing import Any

from numba.core import event

from fdi_ros.errors import FdiError

LOG = logging.getLogger("fdi_ros")
_KIND = "numba:run_pass"
"""Every compilation, and nothing that is only loaded, goes through the passes of the compiler."""


class _Begin(event.Listener):  # type: ignore[misc,unused-ignore]
    """Calls a function when the first compilation begins."""

    def __init__(self, call: Callable[[], None]) -> None:
        self._call = call
        self._called = False

    def on_start(self, event: Any) -> None:
        if not self._called:
            self._called = True
            self._call()

    def on_end(self, event: Any) -> None:
        pass


@contextlib.contextmanager
def announced() -> Iterator[None]:
    """Log one line before anything is compiled within."""

    def announce() -> None:
        LOG.warning("compiling, about a minute, once on this machine (fdi compile does it beforehand)")

    with event.install_listener(_KIND, _Begin(announce)):
        yield


@contextlib.contextmanager
def refused(words: str) -> Iterator[None]:
    """Compile nothing within.

    Raises
    ------
    FdiError
        With these words, when something within is to be compiled.
    """

    def refuse() -> None:
        raise FdiError(words)

    with event.install_listener(_KIND, _Begin(refuse)):
        yield
