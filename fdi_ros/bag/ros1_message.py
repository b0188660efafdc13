# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Messages of ROS 1 as messages of ROS 2, converted by rosbags."""

from __future__ import annotations

import struct
from functools import cache
from typing import Any

from fdi_ros.core.sources import source_of_type


@cache
def _store() -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def converted_from_ros1(data: bytes, kind: str) -> bytes:
    """Convert a message of a type (``sensor_msgs/msg/Imu``) to ROS 2.

    A damaged one, or a type without gyros, becomes empty, which counts as malformed.
    """
    from rosbags.serde import SerdeError

    if source_of_type(kind) is None:
        return b""
    try:
        return bytes(_store().ros1_to_cdr(data, kind))
    except (
        *(SerdeError, struct.error, AssertionError, LookupError, ValueError),
        *(RuntimeError, MemoryError, RecursionError),
    ):
        return b""
