# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Start the monitor: ros2 launch fdi_ros fdi.launch.py config:=my_gyros.yaml namespace:=drone."""

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.launch_context import LaunchContext
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from fdi_ros.config.config import Config
from fdi_ros.errors import FdiError
from launch import LaunchDescription


def check(context: LaunchContext) -> None:
    """Refuse a config that is missing or wrong before anything starts: launch_ros would leave it out with a warning."""
    try:
        Config.from_file(LaunchConfiguration("config").perform(context))
    except FdiError as error:
        raise RuntimeError(str(error)) from None


def generate_launch_description() -> LaunchDescription:
    default = PathJoinSubstitution([FindPackageShare("fdi_ros"), "config", "two_imus.yaml"])
    arguments = [
        DeclareLaunchArgument("config", default_value=default, description="ROS 2 parameter file"),
        DeclareLaunchArgument("namespace", default_value="", description="namespace of the node and its topics"),
        DeclareLaunchArgument("log_level", default_value="info", description="debug, info, warn, error or fatal"),
        DeclareLaunchArgument("use_sim_time", default_value="false", description="take the time from /clock"),
        DeclareLaunchArgument("autostart", default_value="true", description="false: a lifecycle manager starts it"),
    ]
    flags = {name: ParameterValue(LaunchConfiguration(name), value_type=bool) for name in ("use_sim_time", "autostart")}
    node = Node(
        package="fdi_ros",
        executable="fdi_node",
        name="fdi_node",
        namespace=LaunchConfiguration("namespace"),
        parameters=[LaunchConfiguration("config"), flags],
        arguments=["--ros-args", "--log-level", LaunchConfiguration("log_level")],
        output="screen",
    )
    return LaunchDescription([*arguments, OpaqueFunction(function=check), node])
