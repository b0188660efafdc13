# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Recordings of every make for the tests, and messages of every shape."""

import contextlib
import json
import resource
import shutil
import struct
import time
from functools import partial

import numpy as np
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

STORE, ROS1 = get_typestore(Stores.ROS2_JAZZY), get_typestore(Stores.ROS1_NOETIC)
IMU, ARRAY = "sensor_msgs/msg/Imu", "std_msgs/msg/Float64MultiArray"
TOPICS = ("/imu_1/data_raw", "/imu_2/data_raw")
START = 1_700_000_000_000_000_000
STEP = 10_000_000
PARAMETERS = {
    "input": "imus",
    "sample_rate": 100.0,
    "imus.topics": list(TOPICS),
    "imus.mounts": [
        0.6,
        0.8,
        0.0,
        -0.8,
        0.6,
        0.0,
        0.0,
        0.0,
        1.0,
        1.0,
        0.0,
        0.0,
        0.0,
        0.6,
        0.8,
        0.0,
        -0.8,
        0.6,
    ],
    "noise.noise_std": [0.003],
}


def write_config(path, parameters=PARAMETERS):
    """A parameter file."""
    path.write_text(json.dumps({"/**": {"ros__parameters": parameters}}))
    return path


def imu(stamp, rate, frame="imu", order="<", force=None):
    """A serialised Imu; without a specific force it says that it measures none."""
    absent = -1.0 if force is None else 0.0
    name = frame.encode() + b"\0"
    out = struct.pack(order + "iII", *divmod(stamp, 10**9), len(name)) + name
    out += bytes(-len(out) % 8) + struct.pack(
        order + "37d",
        *range(13),
        *rate,
        *range(9),
        *(force or (0.0, 0.0, 0.0)),
        absent,
        *range(8),
    )
    return bytes([0, order == "<", 0, 0]) + out


def array(values, labels=(), order="<"):
    out = struct.pack(order + "I", len(labels))
    for label in labels:
        name = label.encode() + b"\0"
        out += bytes(-len(out) % 4) + struct.pack(order + "I", len(name)) + name
        out += bytes(-len(out) % 4) + struct.pack(order + "II", 3, 3)
    out += bytes(-len(out) % 4) + struct.pack(order + "II", 0, len(values))
    out += bytes(-len(out) % 8) if values else b""
    return (
        bytes([0, order == "<", 0, 0])
        + out
        + struct.pack(f"{order}{len(values)}d", *values)
    )


def imu_messages(stamp, z, topics=TOPICS, apart=0):
    """Messages (topic, log time, bytes) of IMUs: samples z (samples, 3 units), each unit logged `apart` ns later."""
    return [
        (topic, at + apart * k, imu(at, row[3 * k : 3 * k + 3], f"imu_{k + 1}"))
        for at, row in zip(np.asarray(stamp).tolist(), z, strict=True)
        for k, topic in enumerate(topics)
    ]


def flight(samples=600, seed=0, rate=100.0):
    """Messages (topic, log time, bytes) of two IMUs in motion, and the rates that they carry, (samples, 6)."""
    random = np.random.default_rng(seed)
    step = round(1e9 / rate)
    time = np.arange(samples) * step * 1e-9
    omega = np.column_stack(
        [np.sin(time), np.cos(1.3 * time), 0.5 * np.sin(0.7 * time)]
    )
    mounts = np.array(PARAMETERS["imus.mounts"]).reshape(2, 3, 3)
    z = np.hstack([omega @ mount for mount in mounts]) + random.normal(
        0, 0.002, (samples, 6)
    )
    return imu_messages(START + step * np.arange(samples), z, apart=1000), z


def send(messages, types, connect, write):
    """Write messages, each on the connection that the first of its topic makes."""
    connections = {}
    for topic, log_time, data in messages:
        if topic not in connections:
            connections[topic] = connect(topic, (types or {}).get(topic, IMU))
        write(connections[topic], log_time, data)


def write_bag(
    path, messages, storage=StoragePlugin.MCAP, mode=CompressionMode.NONE, types=None
):
    """A rosbag2 folder written by rosbags."""
    writer = Writer(path, version=9, storage_plugin=storage)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        send(
            messages,
            types,
            partial(writer.add_connection, typestore=STORE),
            writer.write,
        )
    return path


def write_mcap(path, messages, compression=CompressionType.ZSTD, types=None, **options):
    """A bare MCAP file written by the mcap library, in small chunks."""
    path, options = path.with_suffix(".mcap"), {"chunk_size": 16_384, **options}
    with path.open("wb") as file:
        writer = McapWriter(file, compression=compression, **options)

        def connect(topic, kind):
            definition = STORE.generate_msgdef(kind, ros_version=2)[0].encode()
            return writer.register_channel(
                topic, "cdr", writer.register_schema(kind, "ros2msg", definition)
            )

        writer.start("ros2", "test")
        send(
            messages,
            types,
            connect,
            lambda channel, at, data: writer.add_message(channel, at, data, at),
        )
        writer.finish()
    return path


def split(path, messages, storage):
    """A bag of three files, as a recorder leaves it that begins a new file now and then."""
    third = len(messages) // 3
    for k in range(3):
        part = write_bag(
            path.with_name(f"part_{k}"), messages[k * third : (k + 1) * third], storage
        )
        path.mkdir(exist_ok=True)
        file = next(file for file in part.iterdir() if file.suffix in (".mcap", ".db3"))
        shutil.move(file, path / f"bag_{k + 8}{file.suffix}")
    return path


def write_ros1(path, messages, compression=None, types=None):
    """A bag of ROS 1, as its recorder or roscpp write it; a message that is none of the type is written as it is."""
    path = path.with_suffix(".bag")
    writer = Ros1Writer(path)
    if compression is not None:
        writer.set_compression(compression)

    def write(connection, log_time, data):
        with contextlib.suppress(SerdeError, struct.error, IndexError, ValueError):
            data = bytes(STORE.cdr_to_ros1(data, connection.msgtype))
        writer.write(connection, log_time, data)

    with writer:
        send(messages, types, partial(writer.add_connection, typestore=ROS1), write)
    return path


SQLITE3 = partial(write_bag, storage=StoragePlugin.SQLITE3)
MAKES = {
    "ros 1": write_ros1,
    "ros 1, bz2": partial(write_ros1, compression=Ros1Writer.CompressionFormat.BZ2),
    "ros 1, lz4": partial(write_ros1, compression=Ros1Writer.CompressionFormat.LZ4),
    "rosbag2 mcap": write_bag,
    "rosbag2 sqlite3": SQLITE3,
    "rosbag2 sqlite3, messages compressed": partial(
        SQLITE3, mode=CompressionMode.MESSAGE
    ),
    "rosbag2 sqlite3, file compressed": partial(SQLITE3, mode=CompressionMode.FILE),
    "rosbag2 mcap, file compressed": partial(write_bag, mode=CompressionMode.FILE),
    "rosbag2 mcap, storage compressed": partial(
        write_bag, mode=CompressionMode.STORAGE
    ),
    "three mcap files": partial(split, storage=StoragePlugin.MCAP),
    "three sqlite3 files": partial(split, storage=StoragePlugin.SQLITE3),
    "zstd chunks": write_mcap,
    "lz4 chunks": partial(write_mcap, compression=CompressionType.LZ4),
    "plain chunks": partial(write_mcap, compression=CompressionType.NONE),
    "no chunks": partial(write_mcap, use_chunking=False),
    "no checksums": partial(
        write_mcap, compression=CompressionType.NONE, enable_crcs=False
    ),
    "no summary": partial(
        write_mcap,
        use_statistics=False,
        repeat_channels=False,
        repeat_schemas=False,
        index_types=IndexType.NONE,
        use_summary_offsets=False,
    ),
}
"""Ways to write the messages of a flight: to a path, which gets the suffix that it needs."""


@contextlib.contextmanager
def bounded(seconds=20.0, growth=600_000):
    """Time of the processor in s, growth of the memory at its largest in kB."""
    begun, before = (
        time.process_time(),
        resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
    )
    yield
    assert time.process_time() - begun < seconds
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < growth
