"""Starting, spinning and ending a node: one line for a known error, exit 0 on signals, no traceback."""

from __future__ import annotations

import gc
import signal
import sys
from collections.abc import Callable, Sequence
from types import FrameType
from typing import Any

from fdi_ros.errors import FdiError

TIMEOUT = 0.1
"""Of one turn of the executor, s: within it a signal is answered. The EventsExecutor needs one to work at all."""


class Stop:
    """Set by SIGINT or SIGTERM, once or many times; whoever spins looks at it."""

    def __init__(self) -> None:
        self.asked = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._ask)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        self.asked = True


def spin(node: Any, stop: Stop) -> None:
    """Turn the executor until stopped; the node's method ``work`` is called whenever messages have been taken."""
    import rclpy
    from rclpy.executors import ExternalShutdownException

    executor = make_executor(node)
    # What is there now stays: the collector need not look at it again.
    gc.collect()
    gc.freeze()
    try:
        while rclpy.ok() and not stop.asked:
            executor.spin_once(timeout_sec=TIMEOUT)
            node.work()
    except ExternalShutdownException:
        return
    finally:
        executor.remove_node(node)


def make_executor(node: Any) -> Any:
    """Choose the executor, add the node to it, and say which it is."""
    from rclpy.executors import SingleThreadedExecutor

    wanted = node.get_parameter("executor").value
    if wanted != "single":
        try:
            from rclpy.experimental import EventsExecutor

            executor = EventsExecutor()
            executor.add_node(node)
            executor.spin_once(timeout_sec=0.0)
            node.get_logger().info("executor: EventsExecutor")
        except (ImportError, RuntimeError) as error:
            if wanted == "events":
                raise FdiError(f"executor events does not work here: {error}") from error
            node.get_logger().info(f"executor: SingleThreadedExecutor, EventsExecutor does not work here: {error}")
        else:
            return executor
    single = SingleThreadedExecutor()
    single.add_node(node)
    return single


def run(
    name: str,
    make: Callable[[], Any],
    argv: Sequence[str] | None = None,
    loop: Callable[[Any, Stop], None] = spin,
) -> int:
    """Make a node, spin it until a signal or a shutdown, and take it down.

    Parameters
    ----------
    name
        For error messages.
    make
        Makes the node.
    argv
        Arguments, ROS ones among them; None: those of the process.
    loop
        Runs the node until it is done or asked to stop.

    Returns
    -------
    Exit code: 0, or 2 if the node cannot start.
    """
    stop = Stop()
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    try:
        # RuntimeError: what rclpy raises for a parameter file that it cannot read.
        rclpy.init(args=None if argv is None else list(argv), signal_handler_options=SignalHandlerOptions.NO)
        node = make()
    except (FdiError, RuntimeError) as error:
        # rcl adds where in its sources it noticed.
        print(f"{name}: {' '.join(str(error).split(', at ')[0].split())}", file=sys.stderr)
        rclpy.try_shutdown()
        return 2
    try:
        loop(node, stop)
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return 0
