"""Starting, spinning and ending a node: one line for a known error, exit 0 on signals, no traceback."""

from __future__ import annotations

import gc
import signal
import sys
import time
from collections.abc import Callable, Sequence
from itertools import pairwise
from types import FrameType
from typing import Any

from fdi_ros.errors import FdiError

TIMEOUT = 0.1
"""Of one turn of the executor, s: within it a signal is answered. The EventsExecutor needs one to work at all."""
SHORT = 0.001
"""The same in a flood, when inputs are polled after each turn, s."""


class Stop:
    """Set by SIGINT or SIGTERM, once or many times; whoever spins looks at it."""

    def __init__(self) -> None:
        self.asked = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._ask)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        self.asked = True


def spin(node: Any, stop: Stop) -> None:
    """Turn the executor until stopped; the node's ``intake`` is drained after every turn.

    What a callback raises ends no node: rclpy itself raises for requests and times that anybody can send.
    """
    import rclpy
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor

    executor, intake, aside = make_executor(node), node.intake, _Aside(node, ExternalShutdownException)
    bounded = isinstance(executor, SingleThreadedExecutor)
    # What is there now stays: the collector need not look at it again.
    gc.collect()
    gc.freeze()
    try:
        while rclpy.ok() and not stop.asked:
            with aside:
                executor.spin_once(timeout_sec=SHORT if intake.flooded else TIMEOUT)
                if intake.turn(executor, time.monotonic(), bounded):
                    # Nothing else empties its queue.
                    executor.shutdown()
                    executor = _events_executor(node)
    except ExternalShutdownException:
        return
    finally:
        executor.remove_node(node)


class _Aside:
    """Logs what is raised inside, but for some kinds, and goes on."""

    def __init__(self, node: Any, *passed: type[BaseException]) -> None:
        self._node, self._passed = node, passed

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> bool:
        if kind is None or not issubclass(kind, Exception) or issubclass(kind, self._passed):
            return False
        words = f"left aside, as it cannot be worked: {kind.__name__}: {' '.join(str(error).split())}"
        self._node.get_logger().error(words, throttle_duration_sec=1.0)
        return True


def make_executor(node: Any) -> Any:
    """Choose the executor, add the node to it, and say which it is."""
    from rclpy.executors import SingleThreadedExecutor

    wanted = node.get_parameter("executor").value
    if wanted != "single":
        try:
            executor = _events_executor(node)
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


def _events_executor(node: Any) -> Any:
    from rclpy.experimental import EventsExecutor

    executor = EventsExecutor()
    executor.add_node(node)
    return executor


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
    try:
        import rclpy
    except ImportError as error:
        return _refuse(
            name, f"needs ROS 2 Jazzy (source /opt/ros/jazzy/setup.bash, or pip install 'fdi_ros[ros]'): {error}"
        )
    from rclpy.signals import SignalHandlerOptions

    try:
        # RuntimeError: what rclpy raises for a parameter file that it cannot read.
        rclpy.init(args=None if argv is None else list(argv), signal_handler_options=SignalHandlerOptions.NO)
        arguments = list(sys.argv[1:] if argv is None else argv)
        _check_arguments(name, arguments)
        node = None if stop.asked else make()
        if node is not None:
            _check_files(node, arguments)
    except (FdiError, ImportError, RuntimeError) as error:
        rclpy.try_shutdown()
        # rcl adds where in its sources it noticed.
        return _refuse(name, str(error).split(", at ")[0])
    code = 0
    try:
        if node is not None:
            loop(node, stop)
    except FdiError as error:
        code = _refuse(name, str(error))
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return code


def _refuse(name: str, words: str) -> int:
    print(f"{name}: {' '.join(words.split())}", file=sys.stderr)
    return 2


def _check_arguments(name: str, arguments: list[str]) -> None:
    """Refuse what ROS has left of the arguments: nobody would read it."""
    from rclpy.utilities import remove_ros_args

    left = remove_ros_args([name, *arguments])[1:]
    if left:
        expected = f"{name} --ros-args --params-file FILE -p NAME:=VALUE"
        raise FdiError(f"unknown argument {left[0]!r}, expected: {expected}")


def _check_files(node: Any, arguments: list[str]) -> None:
    """Refuse parameter files of which none speaks of this node: it would run with nothing but defaults."""
    files = [file for word, file in pairwise(arguments) if word == "--params-file"]
    if files and not node.given:
        raise FdiError(f"no parameters for {node.get_fully_qualified_name()} in {', '.join(files)}, nor in /**")
