# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The gyros of an autopilot and their monitor.

ros2 launch fdi_ros mavlink.launch.py config:=px4.yaml url:=udpin:0.0.0.0:14540

A shipped config is found by its name alone. Several vehicles: one launch each, with a namespace and a system_id.
"""

from pathlib import Path

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.launch_context import LaunchContext
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from fdi_ros.config.config import Config
from fdi_ros.errors import FdiError
from fdi_ros.installation import shipped_folder
from launch import LaunchDescription


def nodes(context: LaunchContext) -> list[Node]:
    given = Path(LaunchConfiguration("config").perform(context))
    shipped = (shipped_folder() or Path()) / given
    file = str(given if given.exists() or not shipped.is_file() else shipped)
    # Before anything starts: launch_ros would leave out a wrong file with a warning.
    try:
        Config.from_file(file)
    except FdiError as error:
        raise RuntimeError(str(error)) from None
    own = {
        "url": LaunchConfiguration("url"),
        "system_id": ParameterValue(LaunchConfiguration("system_id"), value_type=int),
        "signing_key": ParameterValue(LaunchConfiguration("signing_key"), value_type=str),
        "named_values": ParameterValue(LaunchConfiguration("named_values"), value_type=bool),
        "failover": ParameterValue(LaunchConfiguration("failover"), value_type=str),
    }
    executables = {"mavlink_node": [file, own], "fdi_node": [file]}
    return [
        Node(
            package="fdi_ros",
            executable=name,
            name=name,
            namespace=LaunchConfiguration("namespace"),
            parameters=parameters,
            arguments=["--ros-args", "--log-level", LaunchConfiguration("log_level")],
            output="screen",
        )
        for name, parameters in executables.items()
    ]


def generate_launch_description() -> LaunchDescription:
    url = "udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:DEVICE:BAUD"
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "config", default_value="px4.yaml", description="a path, or px4.yaml, ardupilot.yaml"
            ),
            DeclareLaunchArgument("url", default_value="udpin:0.0.0.0:14540", description=url),
            DeclareLaunchArgument("system_id", default_value="0", description="of the autopilot; 0: the first heard"),
            DeclareLaunchArgument("signing_key", default_value="", description="file with the key; empty: off"),
            DeclareLaunchArgument("named_values", default_value="false", description="send the statistic too"),
            DeclareLaunchArgument(
                "failover", default_value="off", description="off or ardupilot: docs/flight_stack.md"
            ),
            DeclareLaunchArgument("namespace", default_value="", description="namespace of the nodes and their topics"),
            DeclareLaunchArgument("log_level", default_value="info", description="debug, info, warn, error or fatal"),
            OpaqueFunction(function=nodes),
        ]
    )
