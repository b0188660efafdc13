# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Make the recording of docs/tutorial.md: python examples/make_tutorial_bag.py FOLDER.

Two IMUs as they come: scale 1 %, axes 1 deg off, biases, the second one mounted turned and sampled 0.4 ms later. The
vehicle stands still for 10 s, is turned by hand about every axis, and is flown.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from fdi_ros import Block, Geometry
from fdi_ros.experiments.flight import (
    GyroErrors,
    Motion,
    regular_stamps,
    vehicle_motion,
)

SEED = 42
START = 1_760_000_000 * 10**9
SAMPLE_RATE = 100.0
SECOND_MOUNT = np.array([[-1, 2, 2], [2, -1, 2], [2, 2, -1]]) / 3
"""The best turn of a second triad: 180 deg about (1, 1, 1)."""
CONFIG = """\
# Two IMUs on one bracket, mounts from the drawing.
/**:
  ros__parameters:
    input: imus
    sample_rate: 100.0 # Hz

    imus:
      topics: [/front/imu, /rear/imu]
      names: [front, rear]
      # By rows: v_body = R v_imu. The rear one is turned by 180 deg about (1, 1, 1).
      mounts:
        [ 1.0,  0.0,  0.0,
          0.0,  1.0,  0.0,
          0.0,  0.0,  1.0,
         -0.3333333,  0.6666667,  0.6666667,
          0.6666667, -0.3333333,  0.6666667,
          0.6666667,  0.6666667, -0.3333333]

    noise:
      noise_std: [0.005] # rad/s, from the data sheet
      scale_std: [0.02]
      timing_std: [0.001] # s

    bias:
      startup_bias_duration: 3.0 # s

    health:
      max_rate: [34.8] # rad/s
"""


def motion(rng: np.random.Generator) -> Motion:
    """Rest, turns by hand about every axis in turn, rest, a flight."""
    time, rate = [0.0, 10.0], [np.zeros(3), np.zeros(3)]
    for axis in np.eye(3):
        for swing in (1.5, -1.5, 1.0, -1.0, 0.0):
            time += [time[-1] + 0.5, time[-1] + 0.9]
            rate += [swing * axis, swing * axis]
        time, rate = [*time, time[-1] + 2.0], [*rate, np.zeros(3)]
    flight = vehicle_motion(80.0, rng, rest=1.0)
    return Motion(
        np.concatenate([time, time[-1] + 1.0 + flight.time]),
        np.vstack([rate, flight.rate]),
    )


def record() -> Block:
    """Measure with two IMUs."""
    motion_rng, unit_rng, noise_rng = (
        np.random.default_rng(s) for s in np.random.SeedSequence(SEED).spawn(3)
    )
    moved = motion(motion_rng)
    nominal = Geometry.from_triads([np.eye(3), SECOND_MOUNT])
    errors = GyroErrors(scale_std=0.01, misalignment_std=np.radians(1.0), delay_std=0.0)
    gyros = replace(errors.draw(nominal, unit_rng), delay=np.repeat([0.0, 4e-4], 3))
    return gyros.measure(
        moved, regular_stamps(float(moved.time[-1]), SAMPLE_RATE, START), noise_rng
    )


def write(block: Block, path: Path) -> None:
    """Write two topics of sensor_msgs/Imu."""
    store, kind = get_typestore(Stores.ROS2_JAZZY), "sensor_msgs/msg/Imu"
    types = store.types
    vector, upright = (
        types["geometry_msgs/msg/Vector3"],
        types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
    )
    absent, covariance = np.array([-1.0, *np.zeros(8)]), np.eye(3).ravel() * 0.0025**2
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics = [
            writer.add_connection(f"/{name}/imu", kind, typestore=store)
            for name in ("front", "rear")
        ]
        for stamp, z in zip(block.stamp.tolist(), block.z, strict=True):
            time = types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9))
            for k, rate in enumerate(z.reshape(2, 3).tolist()):
                header = types["std_msgs/msg/Header"](time, f"imu_{k}")
                message = types[kind](
                    header,
                    upright,
                    absent,
                    vector(*rate),
                    covariance,
                    vector(0.0, 0.0, 0.0),
                    absent,
                )
                writer.write(
                    topics[k],
                    stamp + 200_000 * (k + 1),
                    store.serialize_cdr(message, kind),
                )


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path("tutorial")
    if (folder / "bracket").exists():
        sys.exit(
            f"{folder / 'bracket'} exists already: remove it first, or name another folder"
        )
    folder.mkdir(parents=True, exist_ok=True)
    write(record(), folder / "bracket")
    (folder / "bracket.yaml").write_text(CONFIG, encoding="utf-8")
    print(f"wrote {folder / 'bracket'} and {folder / 'bracket.yaml'}")
