# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Make the bags in this folder: python bags/make_bags.py [FOLDER]. The same seed gives the same samples."""

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode
from rosbags.typesys import Stores, get_typestore

from fdi_ros import Block, Geometry
from fdi_ros.experiments.flight import GyroErrors, regular_stamps, vehicle_motion

SEED = 7
START = 1_750_000_000 * 10**9
DURATION, SAMPLE_RATE = 60.0, 100.0
# The lower triad of the cone is left-handed; an Imu is not. Its x axis is turned round to make one of it, which
# changes the sign of that channel and nothing else: neither what is redundant nor what can be told apart.
UNIT_SIGNS = np.array([1.0, 1.0, 1.0, -1.0, 1.0, 1.0])
TRANSPORT = 200_000  # each Imu arrives this many ns after the one before, the first after its own stamp


def mounts() -> NDArray[np.float64]:
    """Mount rotations (2, 3, 3) of the two units, ``v_body = R @ v_unit``."""
    axes = Geometry.two_triad_cone().axes * UNIT_SIGNS[:, None]
    return axes.reshape(2, 3, 3).transpose(0, 2, 1)


def fly() -> Block:
    """Simulate the six channels of the two-triad cone over one flight."""
    motion_seed, unit_seed, noise_seed = np.random.SeedSequence(SEED).spawn(3)
    motion = vehicle_motion(DURATION, np.random.default_rng(motion_seed), rest=8.0)
    gyros = GyroErrors().draw(
        Geometry.two_triad_cone(), np.random.default_rng(unit_seed)
    )
    return gyros.measure(
        motion,
        regular_stamps(DURATION, SAMPLE_RATE, START),
        np.random.default_rng(noise_seed),
    )


def write(block: Block, path: Path) -> None:
    """Write a block as one Float64MultiArray topic and as two Imu topics."""
    store = get_typestore(Stores.ROS2_JAZZY)
    array, imu = "std_msgs/msg/Float64MultiArray", "sensor_msgs/msg/Imu"
    types = store.types
    layout = types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    nothing = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    absent = np.array([-1.0, *np.zeros(8)])
    upright = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    rate_covariance = np.eye(3).ravel() * GyroErrors().noise_std ** 2
    writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        channels = writer.add_connection("/gyro_channels", array, typestore=store)
        imus = [
            writer.add_connection(f"/imu_{k}/data_raw", imu, typestore=store)
            for k in (1, 2)
        ]
        for stamp, z in zip(block.stamp.tolist(), block.z, strict=True):
            writer.write(
                channels, stamp, store.serialize_cdr(types[array](layout, z), array)
            )
            time = types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9))
            for k, rate in enumerate((z * UNIT_SIGNS).reshape(2, 3)):
                header = types["std_msgs/msg/Header"](time, f"imu_{k + 1}")
                turning = types["geometry_msgs/msg/Vector3"](*rate.tolist())
                message = types[imu](
                    header, upright, absent, turning, rate_covariance, nothing, absent
                )
                writer.write(
                    imus[k],
                    stamp + (k + 1) * TRANSPORT,
                    store.serialize_cdr(message, imu),
                )


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    write(fly(), folder / "cone_flight")
