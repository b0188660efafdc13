# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The gyros of an autopilot and their monitor.

ros2 launch fdi_ros mavlink.launch.py config:=px4.yaml url:=udpin:0.0.0.0:14540

Several vehicles: one launch each, with a namespace and a system_id. If mavlink_node ends, as of a wrong url, the launch
ends; if it has failed, the launch fails.
"""

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.launch_context import LaunchContext
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from fdi_ros.ros.launching import FLAGS, arguments, checked, end, node
from launch import LaunchDescription


def nodes(context: LaunchContext) -> list[Node]:
    file, _ = checked(context)
    link = {
        name: LaunchConfiguration(name) for name in ("url", "system_id", "named_values")
    }
    # Empty is a text, and so is off, which YAML takes for false.
    texts = ("signing_key", "failover")
    link |= {
        name: ParameterValue(LaunchConfiguration(name), value_type=str)
        for name in texts
    }
    # Without the link nothing can be monitored; without the monitor the link tells the pilot so.
    return [node("mavlink_node", [file, link], on_exit=end), node("fdi_node", [file])]


def generate_launch_description() -> LaunchDescription:
    url = "udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:DEVICE:BAUD"
    return LaunchDescription(
        [
            *arguments("px4.yaml"),
            DeclareLaunchArgument(
                "url", default_value="udpin:0.0.0.0:14540", description=url
            ),
            DeclareLaunchArgument(
                "system_id",
                default_value="0",
                description="of the autopilot; 0: the first heard",
            ),
            DeclareLaunchArgument(
                "signing_key",
                default_value="",
                description="file with the key; empty: off",
            ),
            DeclareLaunchArgument(
                "named_values",
                default_value="false",
                choices=FLAGS,
                description="send the statistic too",
            ),
            DeclareLaunchArgument(
                "failover",
                default_value="off",
                choices=("off", "ardupilot"),
                description="take an IMU that is declared faulty out of use: docs/flight_stack.md",
            ),
            OpaqueFunction(function=nodes),
        ]
    )
