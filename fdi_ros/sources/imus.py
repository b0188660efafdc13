# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""One sensor_msgs/Imu topic per unit."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from fdi_ros.compiling.compiled import compiled
from fdi_ros.core.messages import IMU_BEFORE_RATE, IMU_DOUBLES, place_after_header, read_rate
from fdi_ros.core.path import receive_stamped
from fdi_ros.model.samples import Array, Bytes, Int
from fdi_ros.sources.source import UnitSource


@compiled
def _place(data: Bytes, offset: int, length: int, count: int) -> int:
    return place_after_header(data, offset, length, IMU_BEFORE_RATE, IMU_DOUBLES)


@compiled
def _decode_into(data: Bytes, offset: Int, length: Int, code: Bytes, stamp: Int, values: Array) -> None:
    for k in range(len(offset)):
        measured = read_rate(data, offset[k], length[k], IMU_BEFORE_RATE, IMU_DOUBLES, values[k])
        if measured < 0:
            code[k] = -measured
        else:
            stamp[k] = measured


@compiled
def _receive(aligner: NDArray[Any], live: NDArray[Any], inlet: int, data: Bytes, stamp: int) -> int:
    if not 0 <= inlet < aligner[0].n:
        return 0
    measured = read_rate(data, 0, len(data), IMU_BEFORE_RATE, IMU_DOUBLES, aligner[0].rate)
    return receive_stamped(live[0], aligner[0], inlet, measured, stamp)


class ImuSource(UnitSource):
    """The angular velocity of sensor_msgs/Imu messages."""

    type = "sensor_msgs/msg/Imu"
    called = "an Imu"
    place = staticmethod(_place)
    decode_into = staticmethod(_decode_into)
    receive = staticmethod(_receive)
