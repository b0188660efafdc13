# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the launch files share.

A value that is wrong is refused by its name: by a choice, or by the node.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from launch.actions import DeclareLaunchArgument, Shutdown
from launch.events.process import ProcessExited
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from fdi_ros.config.config import Config
from fdi_ros.errors import FdiError
from fdi_ros.system import resolve
from launch import Action, LaunchContext

LEVELS = ("debug", "info", "warn", "error", "fatal")
FLAGS = ("true", "false", "True", "False")


def arguments(config: str) -> list[Action]:
    """Declare the arguments of every launch file, with a shipped config as the default."""
    return [
        DeclareLaunchArgument(
            "config",
            default_value=config,
            description="ROS 2 parameter file: a path, or the name of a shipped file",
        ),
        DeclareLaunchArgument(
            "namespace",
            default_value="",
            description="namespace of the nodes and their topics",
        ),
        DeclareLaunchArgument(
            "log_level",
            default_value="info",
            choices=LEVELS,
            description="of the nodes",
        ),
    ]


def checked(context: LaunchContext) -> tuple[str, Config]:
    """Return the parameter file and its settings.

    launch_ros would skip a wrong file with a warning.
    """
    file = str(resolve(LaunchConfiguration("config").perform(context)))
    try:
        return file, Config.from_file(file)
    except FdiError as error:
        raise RuntimeError(str(error)) from None


def node(
    name: str,
    parameters: Sequence[Any],
    remappings: Sequence[Any] = (),
    on_exit: Any = None,
) -> Node:
    """Make a node of this package."""
    return Node(
        package="fdi_ros",
        executable=name,
        name=name,
        namespace=LaunchConfiguration("namespace"),
        parameters=list(parameters),
        remappings=list(remappings),
        arguments=["--ros-args", "--log-level", LaunchConfiguration("log_level")],
        output="screen",
        on_exit=on_exit,
    )


def end(event: ProcessExited, context: LaunchContext) -> list[Action]:
    """End the launch with the first node that ends.

    Raise to fail the launch with a node that failed.
    """
    if context.is_shutdown:
        return []
    if event.returncode:
        raise RuntimeError(
            f"{event.process_name} has failed: exit code {event.returncode}"
        )
    return [Shutdown(reason=f"{event.process_name} has ended")]
