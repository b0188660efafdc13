# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Start the monitor: ros2 launch fdi_ros fdi.launch.py config:=my_gyros.yaml namespace:=drone."""

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.launch_context import LaunchContext
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from fdi_ros.ros.launching import FLAGS, arguments, checked, node
from launch import LaunchDescription


def nodes(context: LaunchContext) -> list[Node]:
    file, _ = checked(context)
    given = {"autostart": LaunchConfiguration("autostart")}
    # Where it is not given, SetParameter of a launch file around this one says it.
    if LaunchConfiguration("use_sim_time").perform(context):
        given["use_sim_time"] = LaunchConfiguration("use_sim_time")
    return [node("fdi_node", [file, given])]


def generate_launch_description() -> LaunchDescription:
    clock, start = (
        "take the time from /clock; empty: not set here",
        "false: a lifecycle manager starts it",
    )
    return LaunchDescription(
        [
            *arguments("two_imus.yaml"),
            DeclareLaunchArgument(
                "use_sim_time",
                default_value="",
                choices=("", *FLAGS),
                description=clock,
            ),
            DeclareLaunchArgument(
                "autostart", default_value="true", choices=FLAGS, description=start
            ),
            OpaqueFunction(function=nodes),
        ]
    )
