# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The process of ``fdi``. Without an installed script, ``python -m fdi_ros.cli`` starts the same.

This module imports little: until `fdi` runs, Python's own handler answers a signal with a
traceback.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from types import FrameType

from fdi_ros.cli import ExitCode
from fdi_ros.signals import heeded

SIGNAL_PATIENCE = 2.0
"""Time after the first signal in which others are ignored, s: fdi removes unfinished files."""


class Stop:
    """Handler of signals: the first one interrupts the verb, a much later one ends the process.

    Before a verb runs, the first signal ends the process, too.
    """

    def __init__(self) -> None:
        self.running = False
        self.asked: float | None = None
        """Time of the first signal, s on the monotonic clock. None: no signal yet."""

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Handle a signal."""
        now = time.monotonic()
        if not self.running or (
            self.asked is not None and now - self.asked > SIGNAL_PATIENCE
        ):
            os._exit(ExitCode.STOPPED)
        if self.asked is None:
            self.asked = now
            raise KeyboardInterrupt


def fdi() -> int:
    """Run the command line and return its exit code."""
    stop = Stop()
    stopping = heeded()
    for number in stopping:
        signal.signal(number, stop)
    for name, descriptor in (("stdout", 1), ("stderr", 2)):
        if getattr(sys, name) is None:
            # The stream is closed (>&-). Otherwise the next file to be opened gets its
            # number, and with it all printed text.
            os.dup2(os.open(os.devnull, os.O_WRONLY), descriptor)
            setattr(sys, name, open(descriptor, "w", encoding="utf-8", closefd=False))  # noqa: SIM115, until the end
    # The matrices are small: threads of a linear algebra library wait for each other
    # longer than they compute.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from fdi_ros.cli.command_line import main

    try:
        stop.running = True
        return main(stopped=lambda: stop.asked is not None)
    except KeyboardInterrupt:
        return ExitCode.STOPPED
    finally:
        for number in stopping:
            # At exit Python restores the original handlers, but keeps ignored signals ignored.
            signal.signal(number, signal.SIG_IGN)


if __name__ == "__main__":
    sys.exit(fdi())
