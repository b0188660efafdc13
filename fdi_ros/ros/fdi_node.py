"""Entry point of the live monitor."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from fdi_ros.ros.spinning import run


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node until it is told to stop; exit code 0, or 2 with one line if it cannot start."""
    return run("fdi_node", _node, argv)


def _node() -> object:
    # Here, so that a signal during these imports, which take most of the start, finds its handler.
    from rclpy.lifecycle import TransitionCallbackReturn

    from fdi_ros.ros.monitor_node import MonitorNode

    node = MonitorNode()
    if node.get_parameter("autostart").value:
        if node.trigger_configure() == TransitionCallbackReturn.SUCCESS:
            node.trigger_activate()
    else:
        node.get_logger().info(
            f"autostart is false: waiting for a lifecycle manager, or ros2 lifecycle set"
            f" {node.get_fully_qualified_name()} configure"
        )
    return node


if __name__ == "__main__":
    sys.exit(main())
