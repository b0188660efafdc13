# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The process of ``fdi`` from its first moment to its last; ``python -m fdi_ros.cli`` where no script is installed.

Little is imported here: before `fdi` runs a signal has Python's own handler, which prints a traceback.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from types import FrameType

from fdi_ros.cli import STOPPED
from fdi_ros.signals import heeded

PATIENCE = 2.0  # s in which further signals do not disturb the end: what is half written is removed


class Stop:
    """Handler of signals: the first is as from the keyboard, and one that comes much later ends the process at once.

    So does the first while nothing is open yet.
    """

    def __init__(self) -> None:
        self.running = False
        self.asked: float | None = None  # when

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Take a signal."""
        now = time.monotonic()
        if not self.running or (self.asked is not None and now - self.asked > PATIENCE):
            os._exit(STOPPED)
        if self.asked is None:
            self.asked = now
            raise KeyboardInterrupt


def fdi() -> int:
    """Run the command line; return its exit code."""
    stop = Stop()
    stopping = heeded()
    for number in stopping:
        signal.signal(number, stop)
    for name, descriptor in (("stdout", 1), ("stderr", 2)):
        if getattr(sys, name) is None:
            # Closed (>&-): whatever is opened next would get its number, and what is printed.
            os.dup2(os.open(os.devnull, os.O_WRONLY), descriptor)
            setattr(sys, name, open(descriptor, "w", encoding="utf-8", closefd=False))  # noqa: SIM115, until the end
    from fdi_ros.cli.command_line import main

    try:
        stop.running = True
        return main(stopped=lambda: stop.asked is not None)
    except KeyboardInterrupt:
        return STOPPED
    finally:
        for number in stopping:
            # While Python ends, it gives signals their first effect back; what is ignored stays so.
            signal.signal(number, signal.SIG_IGN)


if __name__ == "__main__":
    sys.exit(fdi())
