# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The signals that ask a process to end, for the command line and for nodes."""

from __future__ import annotations

import signal

#: Keyboard, service manager, closed terminal: each ends a process in the same way.
STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def heeded(*, by_node: bool = False) -> list[signal.Signals]:
    """Return the stopping signals that this process was not started to ignore.

    A shell lets its background jobs ignore SIGINT, and ``nohup`` lets a command ignore
    SIGHUP. A node heeds all but SIGHUP in any case: ros2 launch stops nodes by SIGINT.
    """
    ignored = [one for one in STOPPING if signal.getsignal(one) is signal.SIG_IGN]
    if by_node:
        ignored = [one for one in ignored if one is signal.SIGHUP]
    return [one for one in STOPPING if one not in ignored]
