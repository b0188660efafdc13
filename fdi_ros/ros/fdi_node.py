# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Entry point of the live monitor."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from fdi_ros.ros.process import Stop, run, spin

if TYPE_CHECKING:
    from fdi_ros.ros.monitor_node import MonitorNode


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node until it is stopped; exit code 0, or 2 with one line if it cannot start."""
    return run("fdi_node", _node, argv, _live)


def _node() -> MonitorNode:
    # Here, so that a signal during these imports, which take most of the start, finds its handler.
    from fdi_ros.ros.monitor_node import MonitorNode

    return MonitorNode()


def _live(node: MonitorNode, stop: Stop) -> None:
    if node.get_parameter("autostart").value:
        node.start()
    else:
        node.get_logger().info(
            f"autostart is false: waiting for a lifecycle manager, or ros2 lifecycle set"
            f" {node.get_fully_qualified_name()} configure"
        )
    spin(node, stop)


if __name__ == "__main__":
    sys.exit(main())
