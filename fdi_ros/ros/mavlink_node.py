# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The gyros of PX4 or ArduPilot over MAVLink as Imu topics, and the monitor's declarations back as STATUSTEXT.

Settings come from the parameter file of the monitor, so that both have the same units. Nothing that is sent commands
the vehicle.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

from fdi_ros.ros.process import ErrorGuard, Stop, make_executor, run

if TYPE_CHECKING:
    from fdi_ros.ros.autopilot import AutopilotNode

WAIT = 0.02
"""The link is waited for at most so long, and the executor gets its turn as often, s."""
MOST_CALLS = 32
"""Callbacks of a turn of the executor."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node until it is stopped; exit code 0, or 2 with one line if it cannot start."""
    return run("mavlink_node", _node, argv, live)


def _node() -> AutopilotNode:
    # Here, so that a signal during these imports, which take most of the start, finds its handler.
    from fdi_ros.ros.autopilot import AutopilotNode

    return AutopilotNode()


def live(node: AutopilotNode, stop: Stop) -> None:
    """Wait for the link, pass on what came, and give the executor its turn, until stopped.

    One thread: what comes over the link is bounded per turn, so the executor never waits for long.
    """
    import rclpy
    from rclpy.executors import ExternalShutdownException

    # Its queues are bounded, whoever floods the diagnostics; the gyros do not come through it.
    executor, guard = make_executor(node, "single"), ErrorGuard(node, ExternalShutdownException)
    due = time.monotonic()
    try:
        while rclpy.ok() and not stop.asked:
            node.link.wait(max(0.0, due - time.monotonic()))
            with guard:
                node.turn()
            if (now := time.monotonic()) >= due:
                due = now + WAIT
                with guard:
                    for _ in range(MOST_CALLS):
                        executor.spin_once(timeout_sec=0.0)
                        if not node.was_called():
                            break
    except ExternalShutdownException:
        return
    finally:
        executor.remove_node(node)


if __name__ == "__main__":
    sys.exit(main())
