# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Play a bag through injector and monitor: ros2 launch fdi_ros replay.launch.py bag:=my_bag config:=my_gyros.yaml.

The bag is played on the topics it was recorded on; the injector passes them on as <topic>_faulty, which is what the
monitor listens to. faults:="channel=imu_2.y kind=bias size=0.2 start=30" strikes 30 s after the first message. The
launch ends when the bag has been played, with loop:=true not before it is stopped; ros2 service call
/player_node/pause std_srvs/srv/Trigger halts it. It is played when the monitor listens, through the injector, however
long that takes: the first start on a machine compiles for a minute or two. If a node fails, the launch ends and fails.
"""

from pathlib import Path

from launch.actions import Action, DeclareLaunchArgument, OpaqueFunction, Shutdown
from launch.events.process import ProcessExited
from launch.launch_context import LaunchContext
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from fdi_ros.config.config import Config
from fdi_ros.errors import FdiError
from launch import LaunchDescription

SUFFIX = "_faulty"
PATIENCE = 3600.0
"""How long the player waits for the monitor, s; if that ends, so does the launch."""


def nodes(context: LaunchContext) -> list[Node]:
    names = ("bag", "config", "faults", "rate", "loop", "log_level", "namespace")
    bag, file, faults, rate, loop, level, namespace = (LaunchConfiguration(name).perform(context) for name in names)
    # Before anything starts: what is wrong ends the launch with one line.
    config = checked(file)
    if not Path(bag).exists():
        raise RuntimeError(f"no recording at {bag}")
    levels = ["--ros-args", "--log-level", level]
    injection = {"suffix": SUFFIX, "faults": faults, "enabled": bool(faults)}
    renamed = [(topic, topic + SUFFIX) for topic in config.topics]
    return [
        Node(
            package="fdi_ros",
            executable="injector_node",
            name="injector_node",
            namespace=namespace,
            parameters=[file, injection, {"use_sim_time": True}],
            arguments=levels,
            output="screen",
            on_exit=ended,
        ),
        Node(
            package="fdi_ros",
            executable="fdi_node",
            name="fdi_node",
            namespace=namespace,
            parameters=[file, {"use_sim_time": True}],
            remappings=renamed,
            arguments=levels,
            output="screen",
            on_exit=ended,
        ),
        Node(
            package="fdi_ros",
            executable="player_node",
            name="player_node",
            namespace=namespace,
            parameters=[file, {"bag": bag, "rate": float(rate), "loop": loop.lower() == "true", "wait": PATIENCE}],
            arguments=levels,
            output="screen",
            on_exit=ended,
        ),
    ]


def ended(event: ProcessExited, context: LaunchContext) -> list[Action]:
    """End the launch with the first of its nodes that ends; raising makes it fail with a node that failed."""
    if context.is_shutdown:
        return []
    if event.returncode:
        raise RuntimeError(f"{event.process_name} has failed: exit code {event.returncode}")
    return [Shutdown(reason=f"{event.process_name} has ended")]


def checked(file: str) -> Config:
    """Return the settings of a parameter file."""
    try:
        return Config.from_file(file)
    except FdiError as error:
        raise RuntimeError(str(error)) from None


def generate_launch_description() -> LaunchDescription:
    config = PathJoinSubstitution([FindPackageShare("fdi_ros"), "config", "two_imus.yaml"])
    return LaunchDescription(
        [
            DeclareLaunchArgument("bag", description="rosbag2 folder or .mcap file"),
            DeclareLaunchArgument("config", default_value=config, description="ROS 2 parameter file"),
            DeclareLaunchArgument("faults", default_value="", description="faults to inject, separated by semicolons"),
            DeclareLaunchArgument("rate", default_value="1.0", description="speed of playing"),
            DeclareLaunchArgument("loop", default_value="false", description="begin anew at the end of the bag"),
            DeclareLaunchArgument("namespace", default_value="", description="namespace of the nodes and their topics"),
            DeclareLaunchArgument("log_level", default_value="info", description="debug, info, warn, error or fatal"),
            OpaqueFunction(function=nodes),
        ]
    )
