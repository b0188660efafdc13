# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The process of ``fdi`` from its first moment to its last; ``python -m fdi_ros.cli`` where no script is installed.

Little is imported here: before `fdi` runs a signal has Python's own handler, which prints a traceback.
"""

from __future__ import annotations

import os
import signal
import sys

from fdi_ros.cli import STOPPED, heeded


def fdi() -> int:
    """Run the command line; return its exit code."""
    for number in heeded():
        # Nothing is open yet, or any more.
        signal.signal(number, lambda *_: os._exit(STOPPED))
    for name, descriptor in (("stdout", 1), ("stderr", 2)):
        if getattr(sys, name) is None:
            # Closed (>&-): whatever is opened next would get its number, and what is printed.
            os.dup2(os.open(os.devnull, os.O_WRONLY), descriptor)
            setattr(sys, name, open(descriptor, "w", encoding="utf-8", closefd=False))  # noqa: SIM115, until the end
    from fdi_ros.cli.command_line import main

    try:
        return main()
    finally:
        for number in heeded():
            # While Python ends, it gives signals their first effect back; what is ignored stays so.
            signal.signal(number, signal.SIG_IGN)


if __name__ == "__main__":
    sys.exit(fdi())
