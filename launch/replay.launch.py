# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Play a bag through injector and monitor: ros2 launch fdi_ros replay.launch.py bag:=my_bag config:=my_gyros.yaml.

The bag is played on the topics it was recorded on; the injector passes them on as <topic>_faulty, which is what the
monitor listens to. faults:="channel=imu_2.y kind=bias size=0.2 start=30" strikes 30 s after the first message. The
launch ends when the bag has been played, with loop:=true not before it is stopped; ros2 service call
/player_node/pause std_srvs/srv/Trigger halts it. It is played when the monitor listens, through the injector, however
long that takes: the first start on a machine compiles for a minute or two. If a node fails, the launch ends and fails.
With a namespace the clock of the recording is in it, too: /drone/clock.
"""

from pathlib import Path

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.launch_context import LaunchContext
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from fdi_ros.ros.launching import FLAGS, arguments, checked, end, node
from launch import LaunchDescription

SUFFIX = "_faulty"
PATIENCE = 3600.0
"""How long the player waits for the monitor, s; if that ends, so does the launch."""


def nodes(context: LaunchContext) -> list[Node]:
    file, config = checked(context)
    bag, faults = (
        LaunchConfiguration(name).perform(context) for name in ("bag", "faults")
    )
    if not Path(bag).exists():
        raise RuntimeError(f"no recording at {bag}")
    clock = [("/clock", "clock")]
    renamed = [(topic, topic + SUFFIX) for topic in config.topics]
    text = {
        name: ParameterValue(value, value_type=str)
        for name, value in (("bag", bag), ("faults", faults))
    }
    injection = {
        "suffix": SUFFIX,
        "faults": text["faults"],
        "enabled": bool(faults),
        "use_sim_time": True,
    }
    playing = {
        "bag": text["bag"],
        "rate": LaunchConfiguration("rate"),
        "loop": LaunchConfiguration("loop"),
    }
    return [
        node("injector_node", [file, injection], clock, on_exit=end),
        node(
            "fdi_node", [file, {"use_sim_time": True}], [*renamed, *clock], on_exit=end
        ),
        node("player_node", [file, {**playing, "wait": PATIENCE}], clock, on_exit=end),
    ]


def generate_launch_description() -> LaunchDescription:
    again = "begin anew at the end of the bag"
    return LaunchDescription(
        [
            *arguments("two_imus.yaml"),
            DeclareLaunchArgument("bag", description="rosbag2 folder or .mcap file"),
            DeclareLaunchArgument(
                "faults",
                default_value="",
                description="faults to inject, separated by semicolons",
            ),
            DeclareLaunchArgument(
                "rate", default_value="1.0", description="speed of playing"
            ),
            DeclareLaunchArgument(
                "loop", default_value="false", choices=FLAGS, description=again
            ),
            OpaqueFunction(function=nodes),
        ]
    )
