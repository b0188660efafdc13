# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Parameters of the nodes that are no settings of the monitor; ``ros2 param describe`` shows what stands here."""

from __future__ import annotations

from fdi_ros.config.settings import Field

ALL_NODES = {
    "executor": Field(
        "text",
        "auto",
        choices=("auto", "events", "single"),
        description="executor; auto: events, or single where it does not work",
    )
}
"""Parameters that every node has."""
MONITOR = {
    "autostart": Field(
        "bool", True, description="configure and activate at the start; false: wait for a lifecycle manager"
    ),
    "state_file": Field("text", "", description="file that keeps biases and declarations over a restart; empty: none"),
    "state_max_age": Field("float", 3600.0, unit="s", description="a kept state older than this is not taken over"),
}
INJECTOR = {
    "enabled": Field("bool", False, description="inject; false: pass all on as it is", runtime=True),
    "faults": Field(
        "text",
        "",
        description="faults, separated by semicolons, each as 'channel=imu_2.y kind=bias size=0.2 start=0 stop=10';"
        " times count from when the injector is switched on",
        runtime=True,
    ),
    "scenario": Field("text", "", description="scenario file with faults, besides those in 'faults'", runtime=True),
    "suffix": Field("text", "_faulty", description="added to the name of each input topic for that of the output"),
}
PLAYER = {
    "bag": Field("text", "", description="rosbag2 folder, .mcap or .db3 file"),
    "rate": Field("float", 1.0, 1e-3, 1e3, description="speed; 2.0: twice as fast as recorded"),
    "loop": Field("bool", False, description="begin anew at the end of the recording"),
    "clock": Field("bool", True, description="publish /clock, the time of recording"),
    "wait": Field("float", 10.0, unit="s", description="wait at most this long for a subscriber to every topic"),
}
MAVLINK = {
    "url": Field(
        "text",
        "udpin:0.0.0.0:14540",
        description="the link: udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:DEVICE:BAUD",
    ),
    "system_id": Field(
        "int", 0, 0, 255, description="system id of the autopilot; 0: the first that gives gyros, until it is lost"
    ),
    "component_id": Field("int", 191, 1, 255, description="own component id; 191: onboard computer"),
    "messages": Field(
        "text",
        "auto",
        choices=("auto", "highres", "raw", "scaled"),
        description="messages to be used; auto: all are asked for, and those that show the most units are kept",
    ),
    "rate": Field("float", 0.0, 0.0, 1e3, unit="Hz", description="rate to ask for, 1 or more; 0: sample_rate"),
    "monitor": Field("text", "fdi_node", description="name of the monitor whose declarations are sent"),
    "statustext": Field("bool", True, description="send declarations as STATUSTEXT"),
    "named_values": Field(
        "bool", False, description="send statistic and threshold as NAMED_VALUE_FLOAT fdi_stat, fdi_limit"
    ),
    "signing_key": Field(
        "text", "", description="file with the key for signing, 32 bytes or 64 hexadecimal digits; empty: off"
    ),
    "failover": Field(
        "text", "off", choices=("off", "ardupilot"), description="take an IMU that is declared faulty out of use"
    ),
    "failover_limit": Field("int", 1, 1, 3, description="at most so many IMUs are out of use by failover at a time"),
    "failover_file": Field(
        "text", "", description="holds the IMUs out of use by failover; empty: ~/.ros/NODE_failover.json"
    ),
}
NODES = {"fdi_node": MONITOR, "injector_node": INJECTOR, "player_node": PLAYER, "mavlink_node": MAVLINK}
