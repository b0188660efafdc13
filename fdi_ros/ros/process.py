# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Starting, spinning and ending a node: one line for a known error, exit 0 on signals, no traceback.

`python -m fdi_ros.ros.process fdi_node` does what `ros2 run fdi_ros fdi_node` does, without the tools of ROS 2.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import re
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import pairwise
from types import FrameType
from typing import Any

from fdi_ros.errors import ConfigError, FdiError
from fdi_ros.signals import heeded
from fdi_ros.system import BAGS, require

ROS_ARGUMENTS = (
    "--params-file",
    "--param",
    "--remap",
    "--log-level",
    "--log-config-file",
    "--enclave",
)
NODES = {
    "fdi_node": "monitor_node.MonitorNode",
    "injector_node": "injector_node.InjectorNode",
    "mavlink_node": "mavlink_node.AutopilotNode",
    "player_node": "player_node.PlayerNode",
}  # where the class of each node is
NO_ROS = "needs ROS 2 Jazzy: source /opt/ros/jazzy/setup.bash, or in a clone pip install '.[ros]'"


class Stop:
    """Set by any number of stopping signals, checked by the loop of the node."""

    def __init__(self) -> None:
        self.asked = False
        for number in heeded(by_node=True):
            signal.signal(number, self._ask)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        self.asked = True


def spin(node: Any, stop: Stop) -> None:
    """Turn the executor until stopped, and drain the node's ``inputs`` after every turn."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor

    executor = make_executor(node)
    flooded = False
    single = isinstance(executor, SingleThreadedExecutor)
    # Objects that exist now stay: the garbage collector need not visit them again.
    gc.collect()
    gc.freeze()
    try:
        while rclpy.ok() and not stop.asked:
            with guarded(node):
                # A turn delays a signal. The EventsExecutor needs a limit to work.
                executor.spin_once(timeout_sec=0.1)
                if single:
                    node.inputs.drain()
                else:
                    node.inputs.turn()
                if node.inputs.flooded != flooded:
                    flooded = not flooded
                    executor.remove_node(node)
                    # Nothing else empties its queue. The next executor finds pending
                    # work by itself.
                    executor.shutdown()
                    executor = _executor(node, events=not flooded)
                node.keep_up()
    finally:
        executor.remove_node(node)


@contextlib.contextmanager
def guarded(node: Any) -> Iterator[None]:
    """Log any exception raised inside, and go on."""
    try:
        yield
    except Exception as error:
        words = f"left aside, as it cannot be worked: {type(error).__name__}: {' '.join(str(error).split())}"
        node.get_logger().error(words, throttle_duration_sec=1.0)


def make_executor(node: Any, auto: str = "events") -> Any:
    """Choose the executor, add the node, and log the choice. The node resolves auto."""
    wanted = node.get_parameter("executor").value
    if (auto if wanted == "auto" else wanted) == "events":
        try:
            executor = _executor(node, events=True)
            executor.spin_once(timeout_sec=0.0)
            node.get_logger().info("executor: EventsExecutor")
        except (ImportError, RuntimeError) as error:
            if wanted == "events":
                raise FdiError(
                    f"executor events does not work here: {error}"
                ) from error
            node.get_logger().info(
                f"executor: SingleThreadedExecutor, EventsExecutor does not work here: {error}"
            )
        else:
            return executor
    return _executor(node, events=False)


def _executor(node: Any, events: bool) -> Any:
    if events:
        from rclpy.experimental import EventsExecutor as Executor
    else:
        from rclpy.executors import SingleThreadedExecutor as Executor
    executor = Executor(context=node.context)
    executor.add_node(node)
    return executor


def _make(name: str) -> Any:
    if name not in NODES:
        raise FdiError(f"no such node, expected one of: {', '.join(NODES)}")
    if name == "player_node":
        require("reading recordings", BAGS)
    # Numba loads SciPy's linear algebra, 17 MB, if installed. No node calls SciPy.
    sys.modules.setdefault("scipy", None)  # type: ignore[arg-type]
    module, _, kind = NODES[name].partition(".")
    return getattr(importlib.import_module(f"fdi_ros.ros.{module}"), kind)()


def run(
    name: str, argv: Sequence[str] | None = None, make: Callable[[], Any] | None = None
) -> int:
    """Make one of `NODES`, and run the node until its end, a signal or a shutdown. Return the exit code, 0 or 2.

    Arguments are those of ROS, by default those of the process. Something else may make the node.
    """
    # A signal ends the process until the node is up: while something is compiled, no
    # handler in Python runs.
    for number in heeded(by_node=True):
        signal.signal(number, signal.SIG_DFL)
    try:
        import rclpy
    except ImportError as error:
        return _refuse(name, f"{NO_ROS} ({error})")
    from rclpy.exceptions import ParameterException
    from rclpy.signals import SignalHandlerOptions
    from rclpy.utilities import remove_ros_args

    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        # rclpy raises RuntimeError for a parameter file that cannot be read.
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
        if left := remove_ros_args([name, *arguments])[1:]:
            # The argument would have no effect.
            expected = f"{name} --ros-args --params-file FILE -p NAME:=VALUE"
            raise FdiError(f"unknown argument {left[0]!r}, expected: {expected}")
        node = _make(name) if make is None else make()
        _check_files(node, arguments)
        stop = Stop()
    except (FdiError, ImportError, RuntimeError, ParameterException) as error:
        rclpy.try_shutdown()
        # rcl adds the place in its sources, and only lists unknown arguments.
        words = str(error).split(", at ")[0]
        if unknown := re.match(r"\[.*?'(-.*?)'", words):
            words = f"unknown ROS argument {unknown[1]!r}, expected one of: {', '.join(ROS_ARGUMENTS)}"
        return _refuse(name, words)
    code = 0
    try:
        node.live(stop)
    except FdiError as error:
        code = _refuse(name, str(error))
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return code


def _refuse(name: str, words: str) -> int:
    print(f"{name}: {' '.join(words.split())}", file=sys.stderr)
    return 2


def _check_files(node: Any, arguments: list[str]) -> None:
    """Refuse parameter files without parameters of this node.

    The node would run with defaults or old values.
    """
    # Imported here: without ROS 2 YAML may be missing, too, and the error must name it.
    from fdi_ros.system.yaml_file import read_yaml

    name = node.get_fully_qualified_name()
    for file in (file for word, file in pairwise(arguments) if word == "--params-file"):
        document = read_yaml(file, "parameter file", ConfigError)
        if not any(
            re.fullmatch(pattern, name) for pattern in _node_names("", document)
        ):
            raise FdiError(f"no parameters for {name} in {file}, nor in /**")


def _node_names(prefix: str, document: Any) -> Iterator[str]:
    """Names of nodes, as regular expressions, for which a parameter file has at least one parameter."""
    wildcards = {"**": r"(/\w+)*", "*": r"/\w+"}
    for key, value in document.items() if isinstance(document, Mapping) else ():
        if key != "ros__parameters":
            parts = [
                wildcards.get(part, "/" + re.escape(part))
                for part in str(key).split("/")
                if part
            ]
            yield from _node_names(prefix + "".join(parts), value)
        elif value:
            yield prefix


# The installed commands.
fdi_node = partial(run, "fdi_node")
injector_node = partial(run, "injector_node")
mavlink_node = partial(run, "mavlink_node")
player_node = partial(run, "player_node")


if __name__ == "__main__":
    node = sys.argv[1] if len(sys.argv) > 1 else "fdi_ros"
    sys.exit(run(node, sys.argv[2:]))
