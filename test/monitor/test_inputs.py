# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Which input a config lacks to read the topics that are there."""

import pytest
from bag.recordings import ARRAY, IMU

from fdi_ros.monitor.inputs import is_of_a_monitor, other_input


def imus(count):
    return [(f"/imu_{k + 1}", IMU) for k in range(count)]


def test_imu_topics_are_named_with_the_settings_to_read_them():
    words = "topics of type sensor_msgs/msg/Imu: to read them, set `input: imus` and `imus.topics: [/imu_1, /imu_2]`"
    assert other_input(ARRAY, imus(2)) == words
    # The monitor's own rate is no IMU, and an array may hold something else than gyros.
    own = [("/fused", IMU), ("/drone/fused", IMU)]
    assert other_input(ARRAY, [*imus(2), *own, ("/motors", ARRAY)]) == words
    assert other_input(ARRAY, imus(5)) == (
        "topics of type sensor_msgs/msg/Imu: set `input: imus`, and `imus.topics` to 2 to 4 of"
        " /imu_1, /imu_2, /imu_3, /imu_4, /imu_5"
    )


@pytest.mark.parametrize(
    "topics",
    [
        [],
        imus(1),
        [*imus(1), ("/fused", IMU)],
        [("/gyros", ARRAY)],
        [("/scan", "sensor_msgs/msg/LaserScan")],
    ],
)
def test_too_few_imus_for_a_monitor_are_no_other_input(topics):
    assert other_input(ARRAY, topics) == ""


def test_an_array_is_another_input_only_where_there_is_no_imu():
    assert other_input(IMU, [("/gyros", ARRAY)]) == (
        "topics of type std_msgs/msg/Float64MultiArray: if /gyros has the gyros, set `input: channels`"
        " and `channels.topic`"
    )
    assert other_input(IMU, [("/gyros", ARRAY), *imus(1)]) == ""
    assert is_of_a_monitor("/drone/fdi_node/integrity")
    assert not is_of_a_monitor("/imu_1")
