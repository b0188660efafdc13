# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The command line: one file per kind of verb. Here: signals that end ``fdi``, as from the keyboard."""

from __future__ import annotations

import os
import signal
import time
from types import FrameType

STOPPED = 130  # exit code, as a shell has it of what the keyboard has interrupted
PATIENCE = 2.0  # s in which further signals do not disturb the end: what is half written is removed


def heeded() -> list[signal.Signals]:
    """Return the signals that end the process; a shell has what it starts in the background ignore the keyboard."""
    return [one for one in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(one) is not signal.SIG_IGN]


class Stop:
    """Handler of signals: the first is as from the keyboard, and one that comes much later ends the process at once."""

    def __init__(self) -> None:
        self._asked: float | None = None

    @property
    def asked(self) -> bool:
        """Whether there was a signal; what it broke off may have failed in any way."""
        return self._asked is not None

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Take a signal."""
        now = time.monotonic()
        if self._asked is None:
            self._asked = now
            raise KeyboardInterrupt
        if now - self._asked > PATIENCE:
            os._exit(STOPPED)
